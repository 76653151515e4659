"""A registration result for the eye: the verdict first, then what it rests on, then the matrix."""

from __future__ import annotations

import math
from pathlib import Path

import click

from geomoe3d.clouds.transform_files import has_transform, transform_text
from geomoe3d.result import RegistrationResult
from geomoe3d.runtime.words import counted, of_the_score
from geomoe3d.types import CloudReport, FloatArray
from geomoe3d.visual.accuracy_facts import accuracy_facts, length, margin_facts

_COLORS = {"ok": "green", "low_confidence": "yellow", "ambiguous": "yellow", "failed": "red"}
_MEANING = {
    "ok": "the transform is reliable",
    "low_confidence": "the transform may be wrong",
    "ambiguous": "more than one transform fits about as well",
    "failed": "no reliable transform was found",
}


def summary(result: RegistrationResult, inverted: bool = False, unit: str = "") -> str:
    """The whole answer as text with terminal colours (`click.echo` drops them where nobody sees them).

    Args:
        result: what is to be shown.
        inverted: whether `result` is the inverse of what was asked, its source the user's target.
        unit: name of the files' unit of length, or empty.
    """
    first, second = (result.target, result.source) if inverted else (result.source, result.target)
    lines = [
        click.style(result.status.replace("_", " "), fg=_COLORS[result.status], bold=True)
        + f": {_MEANING[result.status]} (confidence {result.confidence:.2f})",
        *(f"  {reason}" for reason in result.reasons),
        "",
        *_found(result, unit),
        _row("source", _cloud(first)),
        _row("target", _cloud(second)),
        _row("seconds", ", ".join(f"{stage} {time:.2f}" for stage, time in result.seconds.items())),
        "",
        direction(result, inverted),
    ]
    if has_transform(result):
        lines.append(matrix_text(result.T_target_source))
    else:
        lines.append("no transform was found")
    return "\n".join(lines)


def print_quietly(result: RegistrationResult, *, matrix: bool = True, name: str = "") -> None:
    """The four rows of the matrix alone, and one line on stderr where the answer is not ok.

    Args:
        result: what is to be shown.
        matrix: leave False to print no rows.
        name: of the scan, to stand before the line, or empty.
    """
    if matrix and has_transform(result):
        click.echo(transform_text(result.T_target_source, []), nl=False)
    if not result.ok:
        told = f"{result.status.replace('_', ' ')}: {(*result.reasons, 'no reason')[0]}"
        click.echo(f"{name}: {told}" if name else told, err=True)


def direction(result: RegistrationResult, inverted: bool = False) -> str:
    """Which way the transform maps, in one sentence with the names of the clouds."""
    first, second = Path(result.source.name).name, Path(result.target.name).name
    times = "" if result.scale == 1.0 else f"{result.scale:.9g} "
    if inverted:
        return f"maps TARGET ({first}) into SOURCE ({second}): p_source = {times}R p_target + t"
    return f"maps SOURCE ({first}) into TARGET ({second}): p_target = {times}R p_source + t"


def matrix_text(T: FloatArray) -> str:
    """Four rows; 15 decimals for the rotation, and the translation to 1e-9 of the unit."""
    cells = [[f"{value:.15f}" for value in row[:3]] + [f"{row[3]:.9f}"] for row in T]
    widths = [max(len(row[column]) for row in cells) for column in range(4)]
    return "\n".join(
        "  " + "  ".join(cell.rjust(width) for cell, width in zip(row, widths, strict=True)) for row in cells
    )


def _row(name: str, text: str) -> str:
    return f"{name:12}{text}"


def _found(result: RegistrationResult, unit: str) -> list[str]:
    """The rows of what was measured; none where a pair was given up before."""
    if not math.isfinite(result.voxel_size):
        return []
    return [
        *(_row(name, text) for name, text in (*accuracy_facts(result, unit), *margin_facts(result))),
        _row("inliers", _inliers(result, unit)),
        _row("runner-up", _alternative(result, unit)),
        _row("voxel size", f"{length(result.voxel_size, unit)}{_chosen(result)}"),
    ]


def _inliers(result: RegistrationResult, unit: str) -> str:
    return (
        f"{result.num_inliers:,} of {counted(result.num_correspondences, 'correspondence')} within "
        f"{length(result.inlier_threshold, unit)}"
    )


def _chosen(result: RegistrationResult) -> str:
    given = result.config.get("voxel_size") is not None
    return "" if given else " (chosen from the clouds; set it with --voxel-size)"


def _cloud(cloud: CloudReport) -> str:
    dropped = [
        counted(count, what) + where
        for count, what, where in (
            (cloud.num_non_finite, "point", " with NaN or infinite coordinates"),
            (cloud.num_duplicates, "duplicate", ""),
            (cloud.num_isolated, "isolated voxel", ""),
        )
        if count
    ]
    text = f"{cloud.name}: {counted(cloud.num_input, 'point')} in"
    if not cloud.num_points:  # given up before any grid was chosen
        return text
    text += f", {cloud.num_points:,} voxel points used"
    return text + (f"; dropped {', '.join(dropped)}" if dropped else "; nothing dropped")


def _alternative(result: RegistrationResult, unit: str) -> str:
    other = result.alternative
    if other is None:
        return "none that differs clearly comes near"
    return (
        f"{of_the_score(other.relative_score)}, "
        f"differs by {other.rotation_difference_deg:.1f} deg and {length(other.translation_difference, unit, '.4g')}"
    )
