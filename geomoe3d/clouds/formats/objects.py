"""The points of objects in memory: arrays, torch tensors, Open3D and trimesh objects.

Libraries are recognised by the module of the object's type, so none of them is imported. Arrays are copied:
a cloud never shares memory with the caller's data.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from geomoe3d.clouds.formats.arrays import table_cloud
from geomoe3d.clouds.formats.raw import RawCloud, scale_colors
from geomoe3d.errors import EmptyCloudError, InputError
from geomoe3d.types import FloatArray


def points_array(data: Any, what: str = "the points") -> FloatArray:
    """(N, 3) float64, a copy, of anything numpy understands. Raises InputError: not a real-number array of
    shape (N, 3); the message says what was found; EmptyCloudError: no rows."""
    return _array_cloud(data, what).points


def _array_cloud(data: Any, what: str = "the points") -> RawCloud:
    if isinstance(data, np.ma.MaskedArray) and data.dtype.names is None:
        data = np.ma.filled(data.astype(np.float64), np.nan)
    try:
        array = np.asarray(data)
    except (ValueError, TypeError) as error:
        raise InputError(f"{what} do not form an array of shape (N, 3): {error}") from None
    if array.ndim == 0:
        raise InputError(
            f"cannot take points from a {type(data).__name__}; pass a path, an (N, 3) array, a torch tensor, "
            "an Open3D or trimesh object, or a PointCloud"
        )
    if array.size == 0:
        raise EmptyCloudError(f"{what} are empty: shape {array.shape}")
    return table_cloud(array, f"{what}", columns=False, error=InputError)


def raw_from_object(data: Any) -> RawCloud:
    """The content of an object in memory, copied. Raises InputError: nothing that holds points;
    EmptyCloudError: no points."""
    library = library_of(data)
    if library == "torch":
        return _array_cloud(_from_torch(data))
    if library == "open3d":
        return _from_open3d(data)
    if library == "trimesh":
        from geomoe3d.clouds.formats.meshes import flatten

        return flatten(data)
    return _array_cloud(data)


def library_of(data: Any) -> str | None:
    """Which of torch, open3d and trimesh an object, or a class that it derives from, comes from."""
    for base in type(data).__mro__:
        library = base.__module__.split(".")[0]
        if library in ("torch", "open3d", "trimesh"):
            return library
    return None


def _from_torch(tensor: Any) -> Any:
    if not hasattr(tensor, "detach"):
        raise InputError(f"cannot take points from a {type(tensor).__name__}")
    if tensor.is_complex() or str(tensor.dtype) == "torch.bool":
        raise InputError(f"the points are of type {tensor.dtype}, expected floats or integers")
    return tensor.detach().cpu().double().numpy()


def _from_open3d(data: Any) -> RawCloud:
    """Legacy and tensor clouds and triangle meshes."""
    kind = type(data).__name__
    faces = None
    if kind == "PointCloud" and hasattr(data, "point"):
        points, normals, colors = (_field(data.point, key) for key in ("positions", "normals", "colors"))
    elif kind == "TriangleMesh" and hasattr(data, "vertex"):
        points, normals, colors = (_field(data.vertex, key) for key in ("positions", "normals", "colors"))
        faces = _field(data.triangle, "indices")
    elif kind == "PointCloud":
        points, normals, colors = map(np.asarray, (data.points, data.normals, data.colors))
    elif kind == "TriangleMesh":
        points, normals, colors = map(np.asarray, (data.vertices, data.vertex_normals, data.vertex_colors))
        faces = np.asarray(data.triangles)
    else:
        raise InputError(f"cannot take points from an Open3D {kind}; pass a PointCloud or a TriangleMesh")
    if points is None or not len(points):
        raise EmptyCloudError(f"the Open3D {kind} is empty")
    return RawCloud(
        points_array(points),
        None if normals is None or len(normals) != len(points) else np.array(normals, dtype=np.float64),
        None if colors is None or len(colors) != len(points) else scale_colors(colors),
        None if faces is None or not len(faces) else np.array(faces, dtype=np.int64),
    )


def _field(attributes: Any, key: str) -> NDArray[Any] | None:
    return attributes[key].cpu().numpy() if key in attributes else None
