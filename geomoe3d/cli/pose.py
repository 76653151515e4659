"""``geomoe3d pose`` and ``geomoe3d homography``: two photographs in, how they lie to each other out."""

from __future__ import annotations

import filecmp
import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from geomoe3d.cli.errors import HELP, ExitCode, Verb, traceback_option
from geomoe3d.cli.files import check_outputs
from geomoe3d.cli.parts import Number, Option, together
from geomoe3d.runtime.words import counted

if TYPE_CHECKING:
    from geomoe3d.images.cameras import Camera
    from geomoe3d.images.features import Matches
    from geomoe3d.images.network import Verdict
    from geomoe3d.types import BoolArray, FloatArray


def _shared(estimators: tuple[str, ...], threshold: str) -> Option:
    return together(
        click.argument("image0", type=click.Path()),
        click.argument("image1", type=click.Path()),
        click.option("--detector", default="rootsift", show_default=True,
                     type=click.Choice(("rootsift", "sift", "orb")), help="What finds keypoints."),
        click.option("--keypoints", metavar="N", default=2000, show_default=True,
                     type=Number(8, 100_000), help="Most keypoints of an image."),
        click.option("--matches", type=click.Choice(("distinct", "loose", "mutual", "all")),
                     help="Which nearest neighbours go to the estimator: mutual ones that pass the ratio test "
                     "at 0.8 or, loosely, at 0.95, all mutual ones, or all. [distinct; loose with --weights]"),
        click.option("--weights", metavar="FILE",
                     help="Network that rejects wrong matches (.safetensors, see configs/train/images)."),
        click.option("--estimator", default="magsac", show_default=True, type=click.Choice(estimators),
                     help="What fits the matches that are right and rejects the others."),
        click.option("--threshold", metavar="PIXELS", type=Number(above=0, whole=False),
                     help=f"Inlier threshold. [{threshold}]"),
        click.option("--seed", metavar="N", default=0, show_default=True, type=Number(0, 2**31 - 1),
                     help="Random seed: the same seed, the same answers."),
        click.option("--output", metavar="FILE.json", help="Write the answer as JSON."),
        click.option("--picture", metavar="FILE", help="Draw the matches: .png, .jpg, .webp, .pdf or .svg."),
        click.option("--force", is_flag=True, help="Replace files that exist."),
    )  # fmt: skip


@click.command(
    cls=Verb, context_settings=HELP, short_help="Find how the cameras of two photographs lie to each other."
)
@_shared(("magsac", "ransac", "eight_point"), "1/800 of the image's longer side")
@click.option("--intrinsics", metavar="FX,FY,CX,CY",
              help="Of both cameras, pixels; four distortions k1,k2,p1,p2 may follow; or a folder of photographs "
              "with cameras that holds both. [guessed: the answer is never 'ok']")  # fmt: skip
@click.option("--intrinsics1", metavar="FX,FY,CX,CY", help="Of IMAGE1, where it has another camera.")
@traceback_option
@click.pass_context
def command(context: click.Context, /, intrinsics: str | None, intrinsics1: str | None, **given: Any) -> None:
    """Relative pose of the camera of IMAGE1 from that of IMAGE0: X1 = R X0 + t, t of unit length.

    Camera frames: x right, y down, z forward. Exit code 0 for the status ok, 3 for any other, 2 for bad input.
    """
    from geomoe3d.images.cameras import rays_of
    from geomoe3d.images.pose import find_pose

    if intrinsics is None and intrinsics1 is not None:
        raise click.UsageError("--intrinsics1 is of IMAGE1 alone; give --intrinsics for IMAGE0 too")
    matches, sizes = _matches(given)
    paths = (Path(given["image0"]), Path(given["image1"]))
    first = _camera(intrinsics, paths[0], sizes[0])
    second = _camera(intrinsics1 or intrinsics, paths[1], sizes[1])
    weights, verdict = _weights(given, matches, rays_of(matches.pixels, (first, second)))
    result = find_pose(
        matches.pixels, (first, second), weights=weights, estimator=given["estimator"], threshold=given["threshold"],
        seed=given["seed"],
    )  # fmt: skip
    status, reasons = result.status, list(result.reasons)
    if intrinsics is None:
        reasons.append("the focal length is a guess (--intrinsics)")
        status = "low_confidence" if status == "ok" else status
    _tell(
        context, given, matches, result.inliers, result.residuals, status, reasons, verdict,
        {"R": result.R, "t": result.t, "parallax": result.parallax, "alternatives": list(result.alternatives)},
    )  # fmt: skip


@click.command(
    cls=Verb, context_settings=HELP, short_help="Find the homography between two photographs of a plane."
)
@_shared(("magsac", "ransac", "dlt"), "3")
@traceback_option
@click.pass_context
def homography(context: click.Context, /, **given: Any) -> None:
    """Homography from IMAGE0 to IMAGE1, of a plane or of photographs from one place: pixel1 ~ H pixel0.

    Exit code 0 for the status ok, 3 for any other, 2 for bad input.
    """
    from geomoe3d.images.cameras import Camera, rays_of
    from geomoe3d.images.config import HOMOGRAPHY
    from geomoe3d.images.homography import find_homography

    matches, sizes = _matches(given)
    rays = rays_of(matches.pixels, [Camera.guess(*size) for size in sizes])
    weights, verdict = _weights(given, matches, rays)
    result = find_homography(
        matches.pixels, weights=weights, estimator=given["estimator"],
        threshold=given["threshold"] or HOMOGRAPHY.threshold, seed=given["seed"],
    )  # fmt: skip
    _tell(context, given, matches, result.inliers, result.residuals, result.status, list(result.reasons), verdict,
          {"H": result.H})  # fmt: skip


def _matches(given: dict[str, Any]) -> tuple[Matches, list[tuple[int, int]]]:
    from geomoe3d.images.features import detect, match
    from geomoe3d.visual.paper import FORMATS

    names = [given["image0"], given["image1"]]
    wanted = (("--output", given["output"], (".json",)), ("--picture", given["picture"], FORMATS))
    check_outputs(wanted, [*names, *filter(None, [given["weights"]])], given["force"])
    keypoints = [detect(name, given["detector"], given["keypoints"]) for name in names]
    for name, one in zip(names, keypoints, strict=True):
        if len(one.pixels) == 0:
            click.echo(f"warning: no keypoints were found in '{name}'", err=True)
    return match(*keypoints), [one.size for one in keypoints]


def _weights(given: dict[str, Any], matches: Matches, rays: FloatArray) -> tuple[FloatArray, Verdict | None]:
    import numpy as np

    from geomoe3d.images.config import KEYPOINTS
    from geomoe3d.images.network import ImageNetwork

    which = given["matches"] or ("loose" if given["weights"] else "distinct")
    chosen = {
        "all": np.ones(len(matches), dtype=bool), "mutual": matches.mutual, "distinct": matches.distinct(),
        "loose": matches.distinct(KEYPOINTS.loose_ratio),
    }[which]  # fmt: skip
    if given["weights"] is None:
        return chosen.astype(np.float64), None
    verdict = ImageNetwork(given["weights"])(rays)
    return chosen * verdict.weights, verdict


def _camera(text: str | None, image: Path, size: tuple[int, int]) -> Camera:
    from geomoe3d.errors import InputError
    from geomoe3d.images.cameras import Camera
    from geomoe3d.images.scenes import read_scene

    if text is None:
        return Camera.guess(*size)
    if Path(text).is_dir():
        for view in read_scene(text).views:
            if view.path.resolve() == image.resolve():
                return view.camera
        raise InputError(f"'{image}' is none of the photographs of '{text}'; give its intrinsics as numbers")
    try:
        numbers = [float(word) for word in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) not in (4, 8):
        raise InputError(f"'{text}' is no folder, and not fx,fy,cx,cy or fx,fy,cx,cy,k1,k2,p1,p2")
    k1, k2, p1, p2 = numbers[4:] or (0.0,) * 4
    fx, fy, cx, cy = numbers[:4]
    return Camera(fx, fy, cx, cy, (k1, k2, p1, p2), size)


def _tell(
    context: click.Context, given: dict[str, Any], matches: Matches, inliers: BoolArray, residuals: FloatArray,
    status: str, reasons: list[str], verdict: Verdict | None, answer: dict[str, Any],
) -> None:  # fmt: skip
    import numpy as np

    from geomoe3d.images.features import read_grey
    from geomoe3d.images.picture import draw_matches
    from geomoe3d.runtime.files import write_text
    from geomoe3d.visual.paper import save_figure

    if filecmp.cmp(given["image0"], given["image1"], shallow=False):
        reasons.append("both images are the same file")
    click.echo(f"status: {status}")
    for reason in reasons:
        click.echo(f"  {reason}")
    for name, value in answer.items():
        if isinstance(value, np.ndarray):
            rows = np.array2string(value, precision=6, suppress_small=True, prefix=" " * 4)
            click.echo(f"{name} = {rows}")
    middle = f", median residual {np.median(residuals[inliers]):.2f} pixels" if inliers.any() else ""
    click.echo(
        f"{counted(int(inliers.sum()), 'inlier')} of {counted(len(matches), 'match', 'matches')}{middle}"
    )
    if given["output"] is not None:
        plain = {
            name: np.asarray(value).tolist() if value is not None else None for name, value in answer.items()
        }
        whole = {"status": status, "reasons": reasons, **plain, "matches": len(matches),
                 "inliers": np.flatnonzero(inliers).tolist(),
                 "inlier_pixels": matches.pixels[inliers].tolist(),
                 "inlier_residuals": residuals[inliers].tolist()}  # fmt: skip
        write_text(Path(given["output"]), json.dumps(whole, indent=2) + "\n", force=given["force"])
    if given["picture"] is not None:
        images = (read_grey(given["image0"]), read_grey(given["image1"]))
        sub_field, expert = (None, None) if verdict is None else verdict[1:]
        save_figure(
            given["picture"],
            lambda _: draw_matches(images, matches.pixels, inliers, sub_field=sub_field, expert=expert),
            force=given["force"],
        )
    context.exit(0 if status == "ok" else ExitCode.NOT_SURE)
