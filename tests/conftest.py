"""What several test files share."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    import numpy as np
    from command_line import FakeRegistrar

    from geomoe3d import Map
    from geomoe3d.data.rooms.solids import Solids
    from geomoe3d.evaluation.records import EvaluationPair, Prediction, RunScore

# What these assert for several files explains itself as in a test.
pytest.register_assert_rewrite(
    "cloud_files", "estimator_problems", "headless_browser", "report_runs", "training_runs"
)


def pytest_configure() -> None:
    """In CI nothing is skipped for want of a package: `scripts/test.sh` installs them all."""
    if not os.environ.get("CI"):
        return
    skip = pytest.importorskip

    def required(name: str, **named: Any) -> Any:
        if name == "gtsam" and sys.version_info < (3, 11):  # no wheels
            return skip(name, **named)
        try:
            return import_module(name)
        except ImportError as error:
            return pytest.fail(f"{name} cannot be imported, and nothing is skipped in CI: {error}")

    pytest.importorskip = required


@pytest.fixture(scope="module")
def one_thread() -> Iterator[None]:
    """For files whose tensors are so small that threads only get in each other's way."""
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture(scope="module")
def two_runs(
    tmp_path_factory: pytest.TempPathFactory,
) -> list[tuple[RunScore, list[EvaluationPair], list[Prediction]]]:
    """Two made-up runs of the same pairs, for the reports of an evaluation."""
    from report_runs import make_pairs, make_two_runs

    return make_two_runs(make_pairs(tmp_path_factory.mktemp("clouds")))


@pytest.fixture
def fake_registrar(monkeypatch: pytest.MonkeyPatch) -> type[FakeRegistrar]:
    """The registrar of every verb called in this test."""
    from command_line import install_registrar

    return install_registrar(monkeypatch)


@pytest.fixture
def scan_files(tmp_path: Path) -> list[str]:
    """Two tiny files to name on the command line."""
    from command_line import write_scans

    return write_scans(tmp_path)


@pytest.fixture(scope="module")
def scanned_room(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, np.ndarray]]:
    """A folder of small scans to be aligned with each other, and their true poses."""
    from small_scans import write_room

    return write_room(tmp_path_factory.mktemp("room"))


@pytest.fixture(scope="module")
def scans(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, np.ndarray]]:
    """A folder with scans and a table of their pairs for a batch, and the true poses."""
    from small_scans import write_batch

    folder = tmp_path_factory.mktemp("scans")
    return folder, write_batch(folder)


@pytest.fixture(scope="module")
def posed_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A set of posed scans with all its pairs."""
    from posed_scans import write_posed

    return write_posed(tmp_path_factory.mktemp("posed"))


@pytest.fixture(scope="module")
def own_cache(tmp_path_factory):
    """A cache of features of the test file's own."""
    kept = os.environ.get("GEOMOE3D_CACHE")
    os.environ["GEOMOE3D_CACHE"] = str(tmp_path_factory.mktemp("cache"))
    yield
    if kept is None:
        del os.environ["GEOMOE3D_CACHE"]
    else:
        os.environ["GEOMOE3D_CACHE"] = kept


@pytest.fixture(scope="module")
def rooms() -> tuple[Solids, Solids]:
    """Two rooms that have nothing in common."""
    from generated_buildings import first_room, other_room

    return first_room(), other_room(3)


@pytest.fixture(scope="module")
def building(rooms: tuple[Solids, Solids]) -> np.ndarray:
    """Both side by side, as one cloud."""
    from generated_buildings import two_rooms

    return two_rooms(rooms)


@pytest.fixture(scope="module")
def house(building: np.ndarray) -> Map:
    """A map of them."""
    from generated_buildings import GRID

    from geomoe3d import Map

    return Map.from_cloud(building, voxel_size=GRID)


@pytest.fixture(scope="module")
def scan(rooms: tuple[Solids, Solids]) -> tuple[np.ndarray, np.ndarray]:
    """A view of the first room, and its true pose."""
    from generated_buildings import UTM, view

    return view(rooms[0], UTM, 5)
