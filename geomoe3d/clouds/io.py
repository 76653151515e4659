"""Reading and writing of clouds: the first and the last step of every run.

`load_points` takes paths, arrays, tensors and library objects and gives a recentred `PointCloud`;
`save_points` and `save_aligned` write what was found, in file coordinates, in double precision wherever the
format allows. The work is done in `loading`, `saving` and one module per format family under `formats`.
"""

from geomoe3d.clouds.formats.registry import use_part
from geomoe3d.clouds.loading import READABLE_SUFFIXES, load_points
from geomoe3d.clouds.saving import (
    WRITABLE_MESH_SUFFIXES,
    WRITABLE_SUFFIXES,
    check_aligned,
    check_cloud_output,
    save_aligned,
    save_points,
)

__all__ = [
    "READABLE_SUFFIXES",
    "WRITABLE_MESH_SUFFIXES",
    "WRITABLE_SUFFIXES",
    "check_aligned",
    "check_cloud_output",
    "load_points",
    "save_aligned",
    "save_points",
    "use_part",
]
