"""E57 files: scans merged in the global frame, of pye57, cut short or damaged."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from cloud_files import STEP, UTM, cloud, fails, small_cloud

from geomoe3d.clouds.io import load_points


def write_e57(
    path: Path, scans: list[dict[str, np.ndarray]], poses: list[tuple[np.ndarray, np.ndarray]]
) -> None:
    """Scans of any supported fields in double precision, colours up to 65535."""
    import pye57
    from pye57 import libe57

    with pye57.E57(str(path), mode="w") as file:
        image = file.image_file
        for data, (quaternion, translation) in zip(scans, poses, strict=True):
            scan = libe57.StructureNode(image)
            scan.set("guid", libe57.StringNode(image, f"{{{len(file.data3d)}}}"))
            pose, rotation, shift = (libe57.StructureNode(image) for _ in range(3))
            for name, value in zip("xyzw", quaternion, strict=True):  # x first: the order must not matter
                rotation.set(name, libe57.FloatNode(image, float(value)))
            for name, value in zip("xyz", translation, strict=True):
                shift.set(name, libe57.FloatNode(image, float(value)))
            scan.set("pose", pose)
            pose.set("rotation", rotation)
            pose.set("translation", shift)
            prototype = libe57.StructureNode(image)
            buffers = libe57.VectorSourceDestBuffer()
            num = len(next(iter(data.values())))
            for name, values in data.items():
                if "color" in name or "State" in name:
                    prototype.set(name, libe57.IntegerNode(image, 0, 0, 65535))
                else:
                    prototype.set(name, libe57.FloatNode(image, 0.0, libe57.E57_DOUBLE, -1e9, 1e9))
                data[name] = np.ascontiguousarray(values, dtype=np.float64)
                buffers.append(libe57.SourceDestBuffer(image, name, data[name], num, True, True))
            points = libe57.CompressedVectorNode(image, prototype, libe57.VectorNode(image, True))
            scan.set("points", points)
            file.data3d.append(scan)
            writer = points.writer(buffers)
            writer.write(num)
            writer.close()


def test_e57_scans_are_merged_in_the_global_frame(tmp_path: Path) -> None:
    pytest.importorskip("pye57")
    from scipy.spatial.transform import Rotation

    first, second = cloud(40, 1), cloud(30, 2)
    R = [Rotation.from_rotvec(v) for v in ([0.3, 1.0, -0.4], [2.0, 0.1, 0.5])]
    poses = [(R[0].as_quat(), UTM), (R[1].as_quat(), UTM + STEP)]
    reach = np.linalg.norm(second, axis=1)
    invalid = np.arange(40) % 10 == 3
    colors = np.random.default_rng(0).integers(0, 65536, (70, 3))
    scans: list[dict[str, np.ndarray]] = [
        {f"cartesian{axis}": first[:, k] for k, axis in enumerate("XYZ")}
        | {"cartesianInvalidState": invalid * 2},
        {
            "sphericalRange": reach,
            "sphericalAzimuth": np.arctan2(second[:, 1], second[:, 0]),
            "sphericalElevation": np.arcsin(second[:, 2] / reach),
        },
    ]
    for scan, part in zip(scans, (colors[:40], colors[40:]), strict=True):
        scan.update({f"color{name}": part[:, k] for k, name in enumerate(("Red", "Green", "Blue"))})
    write_e57(tmp_path / "a.e57", scans, poses)
    loaded = load_points(tmp_path / "a.e57")
    assert loaded.sensor is None  # two of them
    expected = np.concatenate([R[0].apply(first[~invalid]) + UTM, R[1].apply(second) + UTM + STEP])
    np.testing.assert_allclose(loaded.file_points, expected, rtol=0, atol=1e-8)
    np.testing.assert_allclose(loaded.colors, np.concatenate([colors[:40][~invalid], colors[40:]]) / 65535)


def test_e57_of_pye57(tmp_path: Path) -> None:
    pye57 = pytest.importorskip("pye57")
    points = cloud(50).astype(np.float32).astype(np.float64)
    with pye57.E57(str(tmp_path / "a.e57"), mode="w") as file:
        data = {f"cartesian{axis}": points[:, k].copy() for k, axis in enumerate("XYZ")}
        file.write_scan_raw(data, rotation=np.array([1.0, 0, 0, 0]), translation=STEP)
    loaded = load_points(tmp_path / "a.e57")
    assert np.array_equal(loaded.file_points, points + STEP) and np.array_equal(loaded.sensor, STEP)


def test_truncated_e57(tmp_path: Path) -> None:
    pye57 = pytest.importorskip("pye57")
    path = tmp_path / "a.e57"
    with pye57.E57(str(path), mode="w") as file:
        data = {f"cartesian{axis}": small_cloud()[:, k].copy() for k, axis in enumerate("XYZ")}
        file.write_scan_raw(data, rotation=np.array([1.0, 0, 0, 0]), translation=np.zeros(3))
    whole = path.read_bytes()
    path.write_bytes(whole[:-1000])
    fails(path, len(whole), len(whole) - 1000)
    damaged = bytearray(whole)
    damaged[1500] ^= 255
    path.write_bytes(damaged)
    fails(path, "damaged")
    path.write_bytes(b"hello world" * 100)
    fails(path, "no E57 file")
    assert path.exists()
