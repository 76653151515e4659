"""A reader and a writer of your own: a point per line as JSON, as loggers write them.

    geomoe3d register source.jsonl target.jsonl --reader examples/reader.py:read_lines
    geomoe3d register source.jsonl target.jsonl --reader examples/reader.py:read_lines \\
        --writer examples/reader.py:LineWriter --aligned moved.jsonl
"""

import json

import numpy as np

from geomoe3d.clouds.formats.raw import RawCloud
from geomoe3d.clouds.formats.registry import reader, writer
from geomoe3d.errors import FormatError


@reader(".jsonl")
def read_lines(path):
    """Lines such as {"p": [1.0, 2.0, 3.0], "intensity": 17}; any further numbers become fields."""
    rows = []
    with path.open(encoding="utf-8") as lines:
        for number, line in enumerate(lines, 1):
            try:
                row = json.loads(line)
                rows.append([*map(float, row.pop("p")), *map(float, row.values())])
            except (ValueError, KeyError, TypeError, AttributeError) as error:
                raise FormatError(f"'{path}' line {number} is no point: {error}") from None
    if not rows:
        raise FormatError(f"'{path}' holds no points")
    table = np.array(rows)
    return RawCloud(table[:, :3], fields=dict(zip(row, table[:, 3:].T, strict=True)))


@writer(".jsonl")
class LineWriter:
    """The same lines again; what they have no place for is named."""

    def __call__(self, handle, cloud):
        for k, point in enumerate(cloud.points.tolist()):
            row = {"p": point, **{name: float(values[k]) for name, values in cloud.fields.items()}}
            handle.write(json.dumps(row).encode() + b"\n")
        return [name for name in ("normals", "colors") if getattr(cloud, name) is not None]
