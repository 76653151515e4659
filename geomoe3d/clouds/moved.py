"""A rigid motion or a similarity applied to whatever holds points in memory; what comes back is of the same kind.

Libraries are recognised by the module of the object's type, so none of them is imported for an array. Nothing is
changed in place. Cost: one pass over the points, in float64.
"""

from __future__ import annotations

import os
from dataclasses import replace
from typing import Any

import numpy as np

from geomoe3d.clouds.formats.objects import library_of
from geomoe3d.clouds.recentre import choose_origin
from geomoe3d.errors import InputError
from geomoe3d.geometry.se3 import scale_of, transform_points
from geomoe3d.types import FloatArray, PointCloud


def moved(data: Any, T: FloatArray) -> Any:
    """Points (N, 3) in file coordinates, moved: p -> R p + t, R with its scale.

    Args:
        data: an array or what makes one; a torch tensor; an Open3D cloud or mesh, legacy or tensor; a trimesh
            cloud, mesh or scene; or a `PointCloud`.
        T: (4, 4) rigid motion or similarity.

    Returns:
        A float64 array for arrays. A tensor on the same device, of the same type where it is a float, through
        which gradients pass. Else a moved copy of the object, with normals turned.

    Raises:
        InputError: nothing that holds points, or another shape than (N, 3).
    """
    if isinstance(data, PointCloud):
        points = transform_points(T, data.file_points)
        origin, normals = choose_origin(points), data.normals
        turned = None if normals is None else normals @ (T[:3, :3] / scale_of(T)).T
        sensor = None if data.sensor is None else transform_points(T, data.sensor[None])[0]
        return replace(data, points=points - origin, origin=origin, normals=turned, sensor=sensor)
    library = library_of(data)
    if library == "torch" and hasattr(data, "detach"):
        return _moved_tensor(data, T)
    if library == "open3d" and hasattr(data, "transform"):
        return _moved_open3d(data, T)
    if library == "trimesh" and hasattr(data, "apply_transform"):
        copy = data.copy()
        copy.apply_transform(T)
        return copy
    if isinstance(data, (str, os.PathLike)):
        raise InputError(
            f"apply moves points in memory, found the path '{os.fspath(data)}'; save_aligned(path) of the result "
            "writes the source moved, and geomoe3d.load_points reads a file"
        )
    try:
        array = np.asarray(data, dtype=np.float64)
    except (TypeError, ValueError):
        raise InputError(
            f"points must be numbers of shape (N, 3), a tensor, or a cloud of Open3D or trimesh; found a "
            f"{type(data).__name__}"
        ) from None
    _check_shape(array.shape)
    return transform_points(T, array)


def _moved_tensor(tensor: Any, T: FloatArray) -> Any:
    import torch

    _check_shape(tuple(tensor.shape))
    device = "cpu" if tensor.device.type == "mps" else tensor.device  # Apple's has no float64
    motion = torch.as_tensor(T, device=device)
    result = tensor.to(device).double() @ motion[:3, :3].T + motion[:3, 3]
    return result.to(tensor.device, tensor.dtype if tensor.is_floating_point() else torch.float64)


def _moved_open3d(data: Any, T: FloatArray) -> Any:
    scaled = scale_of(T) != 1.0  # normals of length 1 get the scale too
    if not hasattr(data, "clone"):  # legacy: float64 throughout
        turned = type(data)(data).transform(T)
        return turned.normalize_normals() if scaled else turned
    import open3d

    host = open3d.core.Device("CPU:0")
    copy = data.clone().transform(open3d.core.Tensor(T, open3d.core.float64, host))
    copy = copy.normalize_normals() if scaled else copy
    part = "point" if hasattr(data, "point") else "vertex"
    before = getattr(data, part)["positions"]
    exact = transform_points(T, before.cpu().numpy().astype(np.float64))  # float32 loses what lies far away
    getattr(copy, part)["positions"] = open3d.core.Tensor(exact, open3d.core.float64, host).to(
        before.device, before.dtype
    )
    return copy


def _check_shape(shape: tuple[int, ...]) -> None:
    if len(shape) != 2 or shape[1] != 3:
        raise InputError(f"points must have shape (N, 3), found {shape}")
