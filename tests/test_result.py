"""The result as a user holds it: JSON bit for bit, moving points, exchanged roles, its information."""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from geomoe3d.config import RegistrationConfig
from geomoe3d.decision.answer import failed_result
from geomoe3d.errors import InputError
from geomoe3d.geometry.se3 import inverse, make_transform, transform_points
from geomoe3d.result import RegistrationResult
from geomoe3d.types import Alternative, CloudReport, PointCloud

SEEDS = st.integers(0, 2**32 - 1)


def random_motion(rng: np.random.Generator, reach: float = 3.0) -> np.ndarray:
    return make_transform(Rotation.from_quat(rng.normal(size=4)).as_matrix(), rng.normal(size=3) * reach)


def result(seed: int = 0, **changes: Any) -> RegistrationResult:
    rng = np.random.default_rng(seed)
    J = rng.normal(size=(40, 6))
    made = RegistrationResult(
        T_target_source=random_motion(rng),
        status="ambiguous",
        reasons=("a clearly different motion fits 91 % as well", "Ümläute and \u2265 too"),
        confidence=float(rng.random()),
        overlap=float(rng.random()),
        evidence={"overlap": float(rng.random()), "score": 1 / 3},
        num_correspondences=2000,
        num_inliers=123,
        inlier_threshold=0.1,
        voxel_size=0.05,
        alternative=Alternative(random_motion(rng), 0.91, 179.5, 1.25),
        information_matrix=J.T @ J * 1e5,
        information_center=rng.normal(size=3) * 10,
        source=CloudReport("a.ply", 1000, 3, 2, 1, 500, (583394.0, 5283100.0, 498.0)),
        target=CloudReport("b.ply", 2000, 0, 0, 0, 700, (0.0, 0.0, 0.0)),
        seconds={"load": 0.1, "total": 0.3},
        seed=7,
        versions={"geomoe3d": "0.1"},
        config=RegistrationConfig().model_dump(mode="json"),
    )
    return replace(made, **changes)


def failed() -> RegistrationResult:
    clouds = PointCloud(np.eye(3), name="a"), PointCloud(np.eye(3), name="b", num_non_finite=4)
    return failed_result(clouds, "units differ", RegistrationConfig(), {"total": 0.1})


def bits(value: Any) -> Any:
    """A comparable form in which NaN equals NaN and 0.0 differs from -0.0; types count."""
    if isinstance(value, np.ndarray):
        return "array", value.shape, str(value.dtype), value.tobytes()
    if isinstance(value, dict):
        return {key: bits(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return type(value).__name__, [bits(item) for item in value]
    if isinstance(value, float):
        return "float", "nan" if value != value else value.hex()
    return type(value).__name__, value


# ---- JSON -----------------------------------------------------------------------------------------------


@given(SEEDS)
@settings(max_examples=30, deadline=None)
def test_json_keeps_every_bit(seed: int) -> None:
    made = result(seed)
    for indent in (2, None):
        assert bits(asdict(RegistrationResult.from_json(made.to_json(indent)))) == bits(asdict(made))


@pytest.mark.parametrize("value", [-0.0, 5e-324, 1.7976931348623157e308, 1 / 3, 583394.1234567891])
def test_json_keeps_peculiar_numbers(value: float) -> None:
    T = np.eye(4)
    T[:3, 3] = value
    again = RegistrationResult.from_json(result(T_target_source=T).to_json())
    assert again.T_target_source.tobytes() == T.tobytes()


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"status": "great"}, "status 'great' is none of ok"),
        ({"confidence": 7.0}, "confidence 7.0"),
        ({"T_target_source": np.full((4, 4), np.nan)}, "no rotation and translation"),
        ({"T_target_source": np.diag([1.0, 1, -1, 1])}, "no rotation and translation"),
        ({"T_target_source": np.diag([1.0, 1, 1, 5])}, "no rotation and translation"),
    ],
)
def test_json_that_was_changed_by_hand_is_refused(changed: dict, said: str) -> None:
    with pytest.raises(InputError, match=said):
        RegistrationResult.from_json(result(**changed).to_json())


def test_json_keeps_a_result_without_transform_or_alternative() -> None:
    for made in (failed(), result(alternative=None)):
        again = RegistrationResult.from_json(made.to_json())
        assert bits(asdict(again)) == bits(asdict(made))
        assert again.alternative is None


def test_json_is_strict_and_holds_null_for_missing_numbers() -> None:
    def refuse(name: str) -> None:
        raise AssertionError(f"{name} is no JSON")

    data = json.loads(failed().to_json(), parse_constant=refuse)
    assert data["T_target_source"] == [[None] * 4] * 4
    assert data["information_matrix"] == [[None] * 6] * 6
    assert data["status"] == "failed"
    assert set(data) == set(asdict(failed()))


def test_json_takes_numpy_scalars() -> None:
    made = result(confidence=np.float64(0.25), num_inliers=np.int64(5), overlap=np.float32(0.5))
    data = json.loads(made.to_json())
    assert (data["confidence"], data["num_inliers"], data["overlap"]) == (0.25, 5, 0.5)


@pytest.mark.parametrize(
    "text",
    ["", "{", "[]", "5", "null", '"text"', "{}", "{not json}"],
)
def test_text_that_is_no_result_is_refused(text: str) -> None:
    with pytest.raises(InputError, match="not a registration result"):
        RegistrationResult.from_json(text)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("T_target_source", [[1, 2], [3]]),
        ("T_target_source", "identity"),
        ("T_target_source", [1, 2, 3]),
        ("information_matrix", [[1.0]]),
        ("information_center", [1.0, 2.0]),
        ("source", None),
        ("source", {"name": "a"}),
        ("alternative", {"relative_score": 1}),
        ("alternative", 3),
        ("reasons", None),
        ("unknown_key", 1),
    ],
)
def test_a_damaged_result_is_refused(name: str, value: Any) -> None:
    data = json.loads(result().to_json())
    data[name] = value
    with pytest.raises(InputError, match="not a registration result"):
        RegistrationResult.from_json(json.dumps(data))


@pytest.mark.parametrize("name", ["T_target_source", "status", "source", "information_matrix", "alternative"])
def test_a_result_with_a_missing_part_is_refused(name: str) -> None:
    data = json.loads(result().to_json())
    del data[name]
    with pytest.raises(InputError, match=f"not a registration result.*{name}"):
        RegistrationResult.from_json(json.dumps(data))


# ---- moving points --------------------------------------------------------------------------------------


def test_apply_follows_the_equation_and_takes_lists() -> None:
    made = result(1)
    R, t = made.T_target_source[:3, :3], made.T_target_source[:3, 3]
    points = np.random.default_rng(1).normal(size=(8, 3))
    expected = [R @ p + t for p in points]
    np.testing.assert_allclose(made.apply(points), expected, atol=1e-12)
    np.testing.assert_allclose(made.apply(points.tolist()), expected, atol=1e-12)
    assert made.apply(points.astype(np.float32)).dtype == np.float64
    assert made.apply(np.zeros((0, 3))).shape == (0, 3)


@pytest.mark.parametrize("points", [np.zeros(3), np.zeros((3, 4)), np.zeros((2, 3, 3))])
def test_apply_refuses_other_shapes(points: np.ndarray) -> None:
    with pytest.raises(InputError, match=r"\(N, 3\)"):
        result().apply(points)


def test_a_result_without_transform_moves_nothing_and_says_why() -> None:
    with pytest.raises(InputError, match=r"no transform \(status failed: units differ\)"):
        failed().apply(np.zeros((1, 3)))
    assert not failed().ok
    assert not result().ok
    assert result(status="ok").ok


# ---- exchanged roles ------------------------------------------------------------------------------------


@given(SEEDS)
@settings(max_examples=30, deadline=None)
def test_the_inverse_moves_back_and_its_inverse_is_the_result(seed: int) -> None:
    made = result(seed)
    back = made.inverse()
    points = np.random.default_rng(seed).normal(size=(5, 3))
    np.testing.assert_allclose(back.apply(made.apply(points)), points, atol=1e-10)
    assert (back.source, back.target) == (made.target, made.source)
    again = back.inverse()
    for name in ("T_target_source", "information_center"):
        np.testing.assert_allclose(getattr(again, name), getattr(made, name), atol=1e-10)
    np.testing.assert_allclose(again.information_matrix, made.information_matrix, rtol=1e-9, atol=1e-3)
    np.testing.assert_allclose(
        again.alternative.T_target_source, made.alternative.T_target_source, atol=1e-10
    )
    assert (again.source, again.target) == (made.source, made.target)
    kept = ("T_target_source", "alternative", "information_matrix", "information_center")
    rest = [{k: v for k, v in asdict(r).items() if k not in kept} for r in (again, made)]
    assert bits(rest[0]) == bits(rest[1])


def test_the_inverse_alternative_is_the_inverse_motion() -> None:
    made = result(3)
    np.testing.assert_allclose(
        made.inverse().alternative.T_target_source @ made.alternative.T_target_source, np.eye(4), atol=1e-12
    )
    assert result(3, alternative=None).inverse().alternative is None


def test_the_inverse_of_nothing_is_nothing() -> None:
    back = failed().inverse()
    assert np.isnan(back.T_target_source).all()
    assert (back.source.name, back.target.name) == ("b", "a")
    assert back.status == "failed"


@pytest.mark.parametrize("seed", range(4))
def test_the_information_of_the_inverse_predicts_the_same_cost(seed: int) -> None:
    """The cost of correspondences as a function of the motion, perturbed on either side by finite steps.

    A perturbed T has a cost; the perturbation of T^-1 that gives the inverse of the perturbed T must be
    given the same cost by the inverse's matrix, to second order, wherever the motion lies.
    """
    rng = np.random.default_rng(seed)
    T = random_motion(rng, reach=20)
    source = rng.normal(size=(30, 3)) * [3, 2, 1] + rng.normal(size=3) * 10
    target = transform_points(T, source)
    normals = rng.normal(size=(30, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    center = target.mean(0) + rng.normal(size=3)
    J = np.hstack([np.cross(target - center, normals), normals])
    made = result(seed, T_target_source=T, information_matrix=J.T @ J, information_center=center)
    back = made.inverse()

    def perturb(xi: np.ndarray, about: np.ndarray) -> np.ndarray:
        R = Rotation.from_rotvec(xi[:3]).as_matrix()
        return make_transform(R, about + xi[3:] - R @ about)

    def coordinates(P: np.ndarray, about: np.ndarray) -> np.ndarray:
        """The xi with perturb(xi, about) = P."""
        return np.r_[Rotation.from_matrix(P[:3, :3]).as_rotvec(), transform_points(P, about[None])[0] - about]

    for _ in range(10):
        xi = rng.normal(size=6) * 1e-5
        moved = perturb(xi, center) @ T
        cost = (((transform_points(moved, source) - target) * normals).sum(1) ** 2).sum()
        assert xi @ made.information_matrix @ xi == pytest.approx(cost, rel=1e-3)
        eta = coordinates(inverse(moved) @ T, back.information_center)  # inverse(moved) = P_eta T^-1
        np.testing.assert_allclose(
            perturb(eta, back.information_center) @ back.T_target_source, inverse(moved), atol=1e-12
        )
        assert eta @ back.information_matrix @ eta == pytest.approx(cost, rel=1e-3)


def test_a_failed_result_reports_both_clouds_as_loaded() -> None:
    made = failed()
    assert made.reasons == ("units differ",)
    assert made.confidence == made.overlap == made.num_inliers == 0
    assert (made.source.num_input, made.target.num_input) == (3, 7)
    assert made.target.num_non_finite == 4
    assert made.config == RegistrationConfig().model_dump(mode="json")
    assert "geomoe3d" in made.versions
    assert "numpy" in made.versions
