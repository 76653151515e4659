"""Constants that decide an answer: each says what it is, can be changed, and is in every result."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
import yaml
from command_line import call
from pydantic.fields import FieldInfo
from small_scans import CUTS, SETTINGS, cut, scene

import geomoe3d
from geomoe3d.config import ExpertConfig, Section, expert, in_force, load_config
from geomoe3d.decision.scale import Scale
from geomoe3d.errors import ConfigError
from geomoe3d.runtime.threads import each


def leaves(section: type[Section], prefix: str = "expert.") -> Iterator[tuple[str, FieldInfo]]:
    for name, info in section.model_fields.items():
        kind = info.annotation
        if isinstance(kind, type) and issubclass(kind, Section):
            yield from leaves(kind, f"{prefix}{name}.")
        else:
            yield prefix + name, info


CONSTANTS = dict(leaves(ExpertConfig))


@pytest.mark.parametrize("key", CONSTANTS)
def test_every_constant_has_a_meaning_a_unit_a_source_and_a_range(key: str) -> None:
    info = CONSTANTS[key]
    assert info.description
    assert isinstance(info.json_schema_extra, dict)
    assert info.json_schema_extra["unit"]
    assert info.json_schema_extra["source"]
    for far in (-1e30, 1e30):
        value = [far] * len(info.default) if isinstance(info.default, tuple) else far
        with pytest.raises(ConfigError, match=key):
            load_config(None, [f"{key}={value}"])


def test_constants_in_force_are_those_of_the_innermost_and_reach_threads() -> None:
    off = Scale(1.1, 0.01)
    assert off.differs
    lenient, strict = (ExpertConfig(scale={"tolerated": limit}) for limit in (0.5, 0.0))
    with in_force(lenient):
        assert not off.differs
        assert each(lambda scale: scale.differs, [off] * 8) == [False] * 8
        with in_force(strict):
            assert off.differs
        assert expert() is lenient
    assert expert() == ExpertConfig()


def test_a_registration_takes_the_constants_of_its_configuration_and_its_result_holds_them() -> None:
    points = scene()
    source, target = (cut(points, *CUTS[k], seed=k)[0] for k in (0, 1))
    usual, changed = (
        geomoe3d.register(
            source, target, config=load_config(None, [*SETTINGS, f"expert.scale.least_points={least}"])
        )
        for least in (60, 100_000)
    )
    assert "scale_ratio" in usual.evidence
    assert "scale_ratio" not in changed.evidence
    assert changed.config["expert"]["scale"]["least_points"] == 100_000
    assert expert() == ExpertConfig()
    np.testing.assert_allclose(changed.T_target_source, usual.T_target_source)


def test_config_prints_them_on_request_or_where_they_were_changed(capsys: pytest.CaptureFixture[str]) -> None:
    assert call("config") == 0
    assert "expert" not in yaml.safe_load(capsys.readouterr().out)
    assert call("config", "--set", "expert.causes.sure=0.9") == 0
    assert yaml.safe_load(capsys.readouterr().out)["expert"] == {"causes": {"sure": 0.9}}
    assert call("config", "--all") == 0
    text = capsys.readouterr().out
    assert yaml.safe_load(text)["expert"] == ExpertConfig().model_dump(mode="json")
    assert "# probability; an ok answer above it is not tried mirrored" in text
