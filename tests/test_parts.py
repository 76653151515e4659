"""Parts by name: the registries, what tells two parts apart, and a user's own through the command line."""

from __future__ import annotations

import importlib
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import geomoe3d
from geomoe3d.clouds.io import load_points
from geomoe3d.clouds.prepare import prepare
from geomoe3d.config import (
    DescriptorConfig,
    EstimatorConfig,
    FilterConfig,
    PartConfig,
    RegistrationConfig,
    load_config,
)
from geomoe3d.data.sample import make_sample_pair, write_sample_pair
from geomoe3d.errors import ConfigError
from geomoe3d.estimators.base import estimator
from geomoe3d.features.base import descriptor, with_features, with_normals_flipped
from geomoe3d.features.cache import FeatureCache
from geomoe3d.filters.base import outlier_filter
from geomoe3d.geometry.se3 import rotation_error_deg
from geomoe3d.matching.base import matcher
from geomoe3d.pipeline import Pipeline, resolved
from geomoe3d.refinement.base import refiner
from geomoe3d.registration import Registrar
from geomoe3d.runtime.sources import library_versions, source_closure, source_hash
from geomoe3d.scoring.base import scorer

ROOT = Path(__file__).parents[1]
EXAMPLES = ROOT / "examples"


# ---- names ------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("registry", "names"),
    [
        (descriptor, {"fpfh"}),
        (matcher, {"one_way", "mutual", "ratio", "dual_softmax"}),
        (outlier_filter, {"none", "spectral", "geomoe"}),
        (estimator, {"consensus", "ransac", "svd"}),
        (scorer, {"surfaces", "network"}),
        (refiner, {"none", "icp", "gicp", "svd"}),
    ],
    ids=lambda value: getattr(value, "kind", ""),
)
def test_every_part_of_the_package_is_known_by_its_name(registry, names) -> None:
    assert names <= set(registry.names())
    with pytest.raises(ConfigError, match=rf"unknown {registry.kind} 'zzzzz'; known: .*file\.py:Class"):
        registry.find("zzzzz")


def test_a_name_that_is_nearly_right_gets_the_nearest() -> None:
    with pytest.raises(ConfigError, match="did you mean 'consensus'"):
        Registrar(load_config(None, ["estimator.name=consensis"]))


def test_listing_names_loads_no_network_library() -> None:
    code = (
        "import sys\nfrom geomoe3d.pipeline import Pipeline, outlier_filter, resolved\n"
        "outlier_filter.names(); print(Pipeline(resolved(None)).identity()['parts'].keys())\n"
        "print('torch' in sys.modules, 'open3d' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "False False"


def test_the_shipped_network_scores_without_torch() -> None:
    code = (
        "import sys\n"
        "class NoTorch:\n"
        "    def find_spec(self, name, *rest):\n"
        "        if name.partition('.')[0] == 'torch':\n"
        "            raise ModuleNotFoundError(name)\n"
        "sys.meta_path.insert(0, NoTorch())\n"
        "from geomoe3d.data.sample import make_sample_pair\n"
        "from geomoe3d.registration import Registrar\n"
        "source, target, _ = make_sample_pair(0)\nexplained = Registrar().explain(source, target)\n"
        "print(explained.result.status, explained.weighed.weights.max() > 0.5)"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "ok True"


@pytest.mark.parametrize(
    ("spec", "message"),
    [
        ("nowhere.py:Mine", "no file 'nowhere.py' to take a descriptor from"),
        ("no.such.module:Mine", "module 'no.such.module' cannot be imported"),
        (f"{EXAMPLES / 'descriptor.py'}:Spred", "did you mean 'Spread'"),
        (
            f"{EXAMPLES / 'estimator.py'}:Triples",
            "is no descriptor: derive the class from geomoe3d.features.base.Desc",
        ),
    ],
)
def test_a_part_that_cannot_be_had_says_why(spec: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        descriptor.find(spec)


def test_an_unfinished_class_and_wrong_options_are_named(tmp_path) -> None:
    path = tmp_path / "unfinished.py"
    path.write_text(
        "from geomoe3d.features.base import Descriptor\n\nclass Mine(Descriptor):\n    dimension = 3\n"
    )
    with pytest.raises(ConfigError, match="not complete: it lacks __call__"):
        descriptor.find(f"{path}:Mine")
    spread = f"{EXAMPLES / 'descriptor.py'}:Spread"
    with pytest.raises(ConfigError, match=r"\{'draws': 3\} are given, but the filter 'none' takes none"):
        Pipeline(resolved(RegistrationConfig(filter=FilterConfig(options={"draws": 3}))))
    with pytest.raises(ConfigError, match=r"does not take these options \{'radius': 3\}"):
        descriptor.make(DescriptorConfig(name=spread, options={"radius": 3}))


# ---- identities -------------------------------------------------------------------------------------


def test_identity_follows_name_settings_and_code(tmp_path) -> None:
    def of(name: str, **options: object) -> str:
        return json.dumps(
            descriptor.make(DescriptorConfig(name=name, options=options)).identity(), sort_keys=True
        )

    path = tmp_path / "mine.py"
    shutil.copy(EXAMPLES / "descriptor.py", path)
    first = of(f"{path}:Spread")
    assert of(f"{path}:Spread") == first
    assert of(f"{path}:Spread", radii=[4]) != first
    path.write_text(path.read_text() + "\n# a comment is a change too\n")
    assert of(f"{path}:Spread") != first
    assert (
        estimator.make(EstimatorConfig()).identity() != estimator.make(EstimatorConfig(name="svd")).identity()
    )


def test_a_part_with_other_code_is_not_answered_from_the_cache(tmp_path) -> None:
    path, cache = tmp_path / "mine.py", FeatureCache(tmp_path / "cache")
    shutil.copy(EXAMPLES / "descriptor.py", path)
    cloud = make_sample_pair(seed=0)[0]
    cloud = load_points(cloud.points[::40])
    config = load_config(
        None, [f"descriptor.name={path}:Spread", "voxel_size=0.3", "scoring.scorers=[surfaces]"]
    )

    def entries() -> int:
        Registrar(config, cache=cache).register(cloud, cloud)
        return len(list((tmp_path / "cache").iterdir()))

    once = entries()
    assert entries() == once
    path.write_text(path.read_text().replace("(0.1, 0.3, 0.5, 0.7)", "(0.2, 0.4, 0.6, 0.8)"))
    assert entries() > once


def test_the_identity_of_a_pipeline_holds_every_part_and_follows_its_settings() -> None:
    def of(*assignments: str) -> dict[str, object]:
        return Pipeline(resolved(load_config(None, list(assignments)))).identity()

    plain = of()
    parts = {"descriptor", "second descriptor", "matcher", "estimator", "surfaces", "network", "refiner"}
    parts.add("surface_network")  # of the second look
    assert set(plain["parts"]) == parts
    assert json.loads(json.dumps(plain)) == plain
    assert {"numpy", "scipy", "torch", "small_gicp"} <= set(plain["versions"])
    assert of() == plain
    for change in (
        "descriptor.neighbors=70",
        "matching.neighbors=2",
        "estimator.name=svd",
        "refinement.name=icp",
        "second_look.descriptor=multiscale",
    ):
        assert of(change)["parts"] != plain["parts"], change


def test_source_hash_covers_what_a_module_imports_however_far() -> None:
    closure = source_closure("geomoe3d.registration")
    for name in (
        "clouds.prepare",
        "clouds.formats.ply",
        "geometry.rigid_fit",
        "decision.confidence",
        "types",
    ):
        assert f"geomoe3d.{name}" in closure
    for name in ("cli.main", "evaluation.methods", "training.trainer", "doctor"):
        assert f"geomoe3d.{name}" not in closure
    assert "geomoe3d.networks.aligned" in source_closure("geomoe3d.networks.motion_judge")
    assert source_hash("geomoe3d.types") != source_hash("geomoe3d.errors")
    assert library_versions(closure)["numpy"] == np.__version__


# ---- descriptors ------------------------------------------------------------------------------------


def test_features_of_another_shape_or_no_numbers_are_refused() -> None:
    class Wrong(type(descriptor.make(DescriptorConfig()))):
        dimension = 5

    cloud = load_points(make_sample_pair(seed=0)[0].points[::40])
    made = prepare(cloud, 0.3, load_config().preparation)
    with pytest.raises(geomoe3d.InputError, match=rf"shape \({len(made)}, 33\).*expected \({len(made)}, 5\)"):
        with_features(made, Wrong())


def test_a_descriptor_without_normals_keeps_its_features_when_they_are_flipped() -> None:
    calls = []

    class Plain(type(descriptor.make(DescriptorConfig()))):
        needs_normals = False

        def __call__(self, cloud):
            calls.append(cloud)
            return super().__call__(cloud)

    cloud = load_points(make_sample_pair(seed=0)[0].points[::40])
    made = with_features(prepare(cloud, 0.3, load_config().preparation), Plain())
    flipped = with_normals_flipped(made, Plain())
    assert len(calls) == 1
    np.testing.assert_array_equal(flipped.features, made.features)
    np.testing.assert_array_equal(flipped.normals, -made.normals)


# ---- a user's own, as a user calls them -------------------------------------------------------------


@pytest.mark.parametrize(
    "options",
    [
        ["--descriptor", "examples/descriptor.py:Spread"],
        ["--estimator", "examples/estimator.py:Triples", "--set", "estimator.options.draws=5000"],
        ["--scorer", "surfaces", "--scorer", "examples/scorer.py:Near"],
    ],
    ids=["descriptor", "estimator", "scorer"],
)
def test_examples_register_the_sample_pair_from_the_command_line(tmp_path, options: list[str]) -> None:
    files = write_sample_pair(tmp_path)
    command = [sys.executable, "-m", "geomoe3d", "register", str(files.source), str(files.target)]
    done = subprocess.run(
        [*command, "--json", "--quiet", "--voxel-size", "0.1", *options],
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode in (0, 3), done.stderr
    result = json.loads(done.stdout)
    truth = make_sample_pair(seed=0)[2]
    assert rotation_error_deg(np.array(result["T_target_source"]), truth) < 2
    if "--scorer" in options:
        assert result["config"]["scoring"]["scorers"] == ["surfaces", "examples/scorer.py:Near"]


@pytest.mark.parametrize("verb", ["register", "batch", "multiway"])
def test_every_verb_that_registers_pairs_takes_parts(verb: str) -> None:
    command = importlib.import_module(f"geomoe3d.cli.{verb}").command
    options = {option for parameter in command.params for option in parameter.opts}
    assert {"--descriptor", "--matcher", "--filter", "--estimator", "--scorer", "--refiner"} <= options


def test_examples_are_short() -> None:
    for path in (EXAMPLES / f"{name}.py" for name in ("descriptor", "estimator", "reader", "scorer")):
        assert len(path.read_text().splitlines()) <= 60, path


def test_matches_of_a_users_own_are_scored_refined_and_decided_by_the_clouds() -> None:
    source, target, T = make_sample_pair(seed=0)
    rng = np.random.default_rng(0)
    ours = Registrar().explain(source.file_points, target.file_points)
    shift = np.concatenate([ours.source.origin, ours.target.origin])
    rows = ours.correspondences.points + shift
    given = geomoe3d.register(
        source.file_points, target.file_points, correspondences=rows[rng.permutation(len(rows))]
    )
    assert given.ok
    assert rotation_error_deg(given.T_target_source, T) < 1
    assert given.num_correspondences == len(rows)
    wrong = np.hstack([rows[:, :3], rows[rng.permutation(len(rows)), 3:]])
    found = geomoe3d.register(source.file_points, target.file_points, correspondences=wrong[:40])
    assert not found.ok or rotation_error_deg(found.T_target_source, T) < 1
    with pytest.raises(geomoe3d.InputError, match=r"shape \(N, 6\)"):
        geomoe3d.register(source.file_points, target.file_points, correspondences=rows[:, :5])


def test_part_config_of_a_users_own_keeps_its_options_in_the_result() -> None:
    config = PartConfig(name="mine.py:Mine", options={"a": 1})
    assert config.model_dump() == {"name": "mine.py:Mine", "options": {"a": 1}}
