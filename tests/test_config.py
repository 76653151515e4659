"""Configurations: strict about keys, lenient about numbers, overridden by assignments, never changed."""

from __future__ import annotations

import copy
import re
from pathlib import Path
from typing import Any

import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

import geomoe3d
from geomoe3d.config import (
    RegistrationConfig,
    Section,
    build_config,
    known_keys,
    load_config,
    read_yaml,
    set_keys,
)
from geomoe3d.errors import ConfigError

KEYS = known_keys(RegistrationConfig)


def leaf(config: Section, key: str) -> Any:
    value: Any = config
    for part in key.split("."):
        value = getattr(value, part)
    return value


def test_every_leaf_is_known_once_and_can_be_read() -> None:
    assert len(KEYS) == len(set(KEYS))
    assert {"voxel_size", "seed", "estimator.inlier_threshold", "matching.name"} <= set(KEYS)
    tree = RegistrationConfig().model_dump()

    def leaves(node: dict[str, Any], prefix: str = "") -> set[str]:
        return {
            name
            for key, value in node.items()
            for name in (
                leaves(value, f"{prefix}{key}.") if isinstance(value, dict) and value else {prefix + key}
            )
        }

    assert leaves(tree) == set(KEYS)
    for key in KEYS:
        leaf(RegistrationConfig(), key)


@pytest.mark.parametrize("key", KEYS)
def test_every_default_can_be_assigned_to_itself(key: str) -> None:
    """The value as YAML writes it passes the key's own limits and changes nothing."""
    value = leaf(RegistrationConfig(), key)
    value = list(value) if isinstance(value, tuple) else value
    text = yaml.safe_dump(value, default_flow_style=True).splitlines()[0]
    assert load_config(None, [f"{key}={text}"]) == RegistrationConfig()


@pytest.mark.parametrize("key", KEYS)
def test_a_misspelt_key_names_the_right_one(key: str) -> None:
    *parents, name = key.split(".")
    wrong = ".".join([*parents, name[:-2] + name[-1]])  # the last letter but one is missing
    with pytest.raises(ConfigError, match=f"unknown key '{wrong}'; did you mean '{key}'"):
        load_config(None, [f"{wrong}=1"])


def test_a_key_without_its_section_is_found() -> None:
    with pytest.raises(ConfigError, match=r"did you mean 'estimator.inlier_threshold'"):
        load_config(None, ["inlier_threshold=1"])
    with pytest.raises(ConfigError, match=r"unknown key 'desicion.prior'; did you mean 'decision.prior'"):
        load_config(None, ["desicion.prior=0.5"])
    for unlike in ("qqqq", "qqqq.wwww"):
        with pytest.raises(ConfigError, match=f"unknown key '{unlike}'; known here: ") as told:
            load_config(None, [f"{unlike}=1"])
        said = str(told.value)
        assert "decision" in said and "`geomoe3d config --all` lists all keys" in said and len(said) < 250


@pytest.mark.parametrize(
    "assignment",
    [
        "voxel_size=0",
        "voxel_size=-1",
        "voxel_size=.nan",
        "voxel_size=.inf",
        "voxel_size=small",
        "seed=-1",
        "seed=1.5",
        "matching.neighbors=0",
        "matching.neighbors=11",
        "matching.max_correspondences=2",
        "matching.max_ratio=1.1",
        "estimator.ransac_confidence=1",
        "estimator.inlier_threshold=0",
        "decision.min_confidence=1.01",
        "preparation.voxel_points=199",
        "second_look.flip=perhaps",
        "estimator=5",
        "estimator=",
        "refinement.max_iterations=[1]",
    ],
)
def test_values_out_of_range_are_named_with_their_value(assignment: str) -> None:
    key, _, text = assignment.partition("=")
    with pytest.raises(ConfigError) as caught:
        load_config(None, [assignment])
    assert f"'{key}" in str(caught.value)
    assert repr(yaml.safe_load(text)) in str(caught.value)


def test_two_mistakes_are_both_told() -> None:
    with pytest.raises(ConfigError) as caught:
        load_config(None, ["voxel_sise=1", "seed=-3"])
    assert "'voxel_sise'" in str(caught.value)
    assert "'seed' = -3" in str(caught.value)


@pytest.mark.parametrize(
    ("assignment", "expected"),
    [("voxel_size=1", 1.0), ("voxel_size=1e-3", 0.001), ("voxel_size=null", None), ("seed=3.0", 3)],
)
def test_numbers_are_taken_however_they_are_written(assignment: str, expected: float | None) -> None:
    value = leaf(load_config(None, [assignment]), assignment.partition("=")[0])
    assert value == expected
    assert type(value) is type(expected)


def test_a_configuration_does_not_change() -> None:
    config = RegistrationConfig()
    with pytest.raises(ValidationError):
        config.seed = 3  # type: ignore[misc]
    with pytest.raises(ValidationError):
        config.estimator.name = "svd"  # type: ignore[misc]
    assert hash(config) == hash(RegistrationConfig())


# ---- assignments and files ------------------------------------------------------------------------------

names = st.sampled_from(["a", "b", "c"])
trees = st.recursive(st.integers(), lambda inner: st.dictionaries(names, inner, max_size=3), max_leaves=8)


@given(st.dictionaries(names, trees, max_size=3), st.lists(names, min_size=1, max_size=3), st.integers())
@settings(max_examples=60, deadline=None)
def test_an_assignment_changes_one_leaf_of_a_copy(tree: dict[str, Any], path: list[str], value: int) -> None:
    before = copy.deepcopy(tree)
    node: Any = tree
    blocked = False
    for name in path[:-1]:
        node = node.get(name, {})
        if not isinstance(node, dict):
            blocked = True
            break
    assignment = f"{'.'.join(path)}={value}"
    if blocked:
        with pytest.raises(ConfigError, match="holds a value, not a section"):
            set_keys(tree, [assignment])
    else:
        changed = set_keys(tree, [assignment])
        node = changed
        for name in path[:-1]:
            node = node[name]
        assert node.pop(path[-1]) == value
        node = before_pruned = copy.deepcopy(before)
        for name in path[:-1]:
            node = node.setdefault(name, {})
        node.pop(path[-1], None)
        assert changed == before_pruned
    assert tree == before


def test_later_assignments_win_and_values_may_hold_an_equals_sign() -> None:
    assert set_keys({}, ["a=1", "a=2"]) == {"a": 2}
    assert set_keys({}, ["a.b = x=y"]) == {"a": {"b": "x=y"}}
    assert set_keys({"a": {"b": 1}}, ["a.c=[1, 2]"]) == {"a": {"b": 1, "c": [1, 2]}}


@pytest.mark.parametrize("text", ["", "seed", "=3", " =3"])
def test_what_is_no_assignment_is_refused(text: str) -> None:
    with pytest.raises(ConfigError, match="write key=value"):
        set_keys({}, [text])


def test_values_that_are_no_yaml_are_refused() -> None:
    with pytest.raises(ConfigError, match="the value cannot be read"):
        set_keys({}, ["a=[1"])


def test_files_and_assignments_combine(tmp_path) -> None:
    path = tmp_path / "my.yaml"
    path.write_text("seed: 3\nestimator:\n  name: ransac\n  inlier_threshold: 3\n")
    config = load_config(path, ["estimator.inlier_threshold=1.5"])
    assert (config.seed, config.estimator.name, config.estimator.inlier_threshold) == (3, "ransac", 1.5)
    assert config.matching == RegistrationConfig().matching
    path.write_text("# nothing but a comment\n")
    assert load_config(path) == RegistrationConfig() == load_config()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("- 1\n- 2\n", "holds a list"),
        ("a: [", "no configuration .YAML."),
        ("just words", "holds text, expected lines"),
    ],
)
def test_files_that_hold_no_mapping_are_refused(tmp_path, text: str, message: str) -> None:
    path = tmp_path / "bad.yaml"
    path.write_text(text)
    with pytest.raises(ConfigError, match=f"bad.yaml.*{message}"):
        read_yaml(path)


def test_files_that_cannot_be_read_are_refused(tmp_path) -> None:
    with pytest.raises(ConfigError, match=r"cannot read.*none.yaml.*No such file"):
        read_yaml(tmp_path / "none.yaml")
    with pytest.raises(ConfigError, match="cannot read"):
        read_yaml(tmp_path)
    (tmp_path / "latin.yaml").write_bytes(b"name: \xff\xfe\xe9")
    with pytest.raises(ConfigError, match=r"latin.yaml.*no configuration .YAML."):
        read_yaml(tmp_path / "latin.yaml")


def test_only_mappings_build_a_configuration() -> None:
    assert build_config(RegistrationConfig, None) == build_config(RegistrationConfig, {})
    with pytest.raises(ConfigError, match=r"my place: expected sections of .*found a list"):
        build_config(RegistrationConfig, [1], "my place")  # type: ignore[arg-type]


def test_a_dumped_configuration_builds_the_same() -> None:
    config = load_config(None, ["voxel_size=0.3", "filter.name=spectral", "scoring.scorers=[]"])
    assert build_config(RegistrationConfig, config.model_dump(mode="json")) == config
    assert build_config(RegistrationConfig, yaml.safe_load(yaml.safe_dump(config.model_dump()))) == config


# ---- configurations that come with the package -------------------------------------------------------


def test_shipped_configurations_are_found_by_name_from_anywhere(tmp_path, monkeypatch):
    from geomoe3d.training.config import load_train_config

    monkeypatch.chdir(tmp_path)
    assert load_config("configs/default.yaml") == RegistrationConfig()
    assert load_train_config("configs/train/transforms.yaml").data.train
    assert load_train_config("configs/train/paper/oanet.yaml")  # has a base beside it
    (tmp_path / "configs").mkdir()
    (tmp_path / "configs" / "default.yaml").write_text("seed: 5")
    assert load_config("configs/default.yaml").seed == 5  # a file of the user's own comes first


def test_a_missing_configuration_names_the_nearest_that_comes_with_the_package():
    with pytest.raises(FileNotFoundError, match=r"did you mean configs/train/transforms\.yaml"):
        load_config("configs/train/transform.yaml")
    with pytest.raises(FileNotFoundError, match=r"it is now configs/train/transforms\.yaml"):
        load_config("configs/train/motions.yaml")


def test_a_key_that_stands_twice_in_a_file_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "twice.yaml"
    file.write_text("decision:\n  min_confidence: 0.9\n  min_confidence: 0.2\n")
    with pytest.raises(ConfigError, match=r"twice\.yaml.*'decision\.min_confidence' more than once"):
        load_config(file)
    file.write_text("decision:\n  min_confidence: 0.9\nseed: 3\n")
    assert load_config(file).decision.min_confidence == 0.9


def test_a_key_of_a_section_leaves_its_others_as_they_are_by_default() -> None:
    usual = RegistrationConfig().expert.confidence
    changed = load_config(None, ["expert.confidence.with_network.offset=-2"]).expert.confidence
    assert changed.with_network.offset == -2
    assert changed.with_network.slopes == usual.with_network.slopes != (0.0,) * 7
    assert changed.surfaces_alone == usual.surfaces_alone


def test_a_value_for_a_section_names_keys_that_there_are() -> None:
    with pytest.raises(ConfigError, match=r"did you mean decision\.min_confidence, decision\."):
        load_config(None, ["decision=3"])
    with pytest.raises(ConfigError, match=r"did you mean descriptor\.name\?"):
        load_config(None, ["descriptor=fpfh"])
    with pytest.raises(ConfigError, match="'seed' = -1: it must be greater than or equal to 0"):
        load_config(None, ["seed=-1"])


@pytest.mark.parametrize(
    ("assignment", "words"),
    [
        (
            "second_look.scorers=none",
            r"'none': it must be a list in brackets, such as \[a, b\], or \[\] for none$",
        ),
        ("expert.scale.reaches=2", "= 2: it must be a list"),
        ("second_look.grids=[a]", "'second_look.grids.0' = 'a': it must be a number$"),
        ("descriptor.options=3", "it must be pairs of name and value in braces"),
        ("estimator.name=3", "= 3: it must be text$"),
        ("preparation.max_points=1.5", "it must be a whole number$"),
        ("preparation.max_points=true", "'true': it must be a whole number$"),
        ("second_look.grids=[2, true]", "'second_look.grids.1' = 'true': it must be a number$"),
        ("decision.min_confidence=null", "= null: it must be a number$"),
        ("refinement.parallel=maybe", "it must be true or false$"),
    ],
)
def test_a_value_of_the_wrong_kind_is_told_of_without_words_of_python(assignment: str, words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        load_config(None, [assignment])


@pytest.mark.parametrize(
    "key",
    [
        "expert.scale.reaches",
        "expert.locating.polishing",
        "expert.many_poses.reaches",
        "expert.many_poses.group_reaches",
    ],
)
def test_a_list_of_reaches_is_never_empty(key: str) -> None:
    with pytest.raises(ConfigError, match=re.escape(key)):
        load_config(None, [f"{key}=[]"])
    load_config(None, [f"{key}=[2.0]"])


@pytest.mark.parametrize(
    ("setting", "words"),
    [
        ("descriptor.options={a: 1}", "the descriptor 'fpfh' takes none"),
        ("matching.options={a: 1}", "the matcher 'one_way' takes none"),
        ("estimator.options={a: 1}", "the estimator 'consensus' takes none"),
        ("refinement.options={a: 1}", "the refiner 'gicp' takes none"),
        ("scoring.options={surfaces: {a: 1}}", "the scorer 'surfaces' takes none"),
        ("scoring.options={surfcaes: {a: 1}}", "surfcaes.*none of the scorers surfaces, network"),
        ("scoring.options={network: {weights: x}}", "scoring.weights"),
    ],
)
def test_options_that_nothing_takes_are_refused(setting: str, words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        geomoe3d.Registrar(load_config(None, [setting])).pipeline.warm_up()
