"""What a piece of furniture is, and the parts that many of them share.

A piece stands in its own frame: back edge along x through the origin, its front at +y, floor at z = 0,
metres. It says how much floor it takes and on which of its surfaces things may lie.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from geomoe3d.data.rooms.solids import Solids, Triple, between


@dataclass(frozen=True)
class Shelf:
    """A level rectangle in a piece's frame on which things may lie, with the room above it."""

    x: tuple[float, float]
    y: tuple[float, float]
    z: float
    clearance: float = 1.0


@dataclass
class Piece:
    """One thing that stands on the floor or hangs on a wall.

    Attributes:
        name: what it is.
        solids: its triangles.
        width: along the wall.
        depth: into the room.
        height: top.
        shelves: where things may lie.
        hangs: True takes no floor.
    """

    name: str
    solids: Solids
    width: float
    depth: float
    height: float
    shelves: list[Shelf] = field(default_factory=list)
    hangs: bool = False


Maker = Callable[[np.random.Generator], Piece]


def color(rng: np.random.Generator) -> Triple:
    """Any colour that is neither black nor white."""
    a, b, c = rng.uniform(0.2, 0.9, 3).tolist()
    return a, b, c


def legs(s: Solids, rng: np.random.Generator, w: float, d: float, top: float, c: Triple) -> None:
    """Four legs under a rectangle of width w and depth d, up to ``top``."""
    thick, inset = between(rng, 0.02, 0.07), between(rng, 0.0, 0.08)
    style = rng.integers(3)
    for sx in (-1, 1):
        for y in (inset, d - inset - thick):
            x = sx * (w / 2 - inset) - (thick if sx > 0 else 0)
            if style == 0:
                s.box((x, y, 0), (thick, thick, top), c)
            else:
                lean = 0.06 if style == 2 else 0.0
                foot = (x + thick / 2 + sx * lean, y + thick / 2, 0.0)
                s.rod(foot, (x + thick / 2, y + thick / 2, top), thick / 2, c)


def fronts(
    s: Solids,
    rng: np.random.Generator,
    x: float,
    width: float,
    y: float,
    low: float,
    high: float,
    rows: int,
    c: Triple,
) -> None:
    """Drawer or door fronts with handles, standing out a little, one now and then left open."""
    edges = np.linspace(low, high, rows + 1)
    knob = rng.random() < 0.5
    for z0, z1 in pairwise(edges):
        out = between(rng, 0.08, 0.25) if rng.random() < 0.06 else 0.018
        s.box((x + 0.008, y, z0 + 0.006), (width - 0.016, out, z1 - z0 - 0.012), c)
        z = float(z1 - 0.3 * (z1 - z0)) if z1 - z0 > 0.3 else float((z0 + z1) / 2)
        if knob:
            s.blob((x + width / 2, y + out + 0.02, z), (0.018, 0.02, 0.018), rng, 0.0, c)
        else:
            s.box((x + 0.3 * width, y + out + 0.02, z), (0.4 * width, 0.012, 0.015), c)


def books(
    s: Solids, rng: np.random.Generator, x: tuple[float, float], y: float, depth: float, z: float, high: float
) -> None:
    """A row of books, leaning, lying and missing here and there."""
    at = x[0] + between(rng, 0, 0.05)
    end = x[0] + (x[1] - x[0]) * between(rng, 0.4, 1.0)
    while at < end:
        thick = between(rng, 0.012, 0.06)
        tall, deep = high * between(rng, 0.55, 0.97), depth * between(rng, 0.5, 0.98)
        if at + thick > x[1]:
            break
        if rng.random() < 0.06:
            pile = between(rng, 0.15, 0.28)
            if at + pile > x[1]:
                break
            s.box((at, y, z), (pile, deep * 0.8, min(high, thick * 3)), color(rng))
            at += pile
            continue
        s.box((at, y, z), (thick, deep, tall), color(rng))
        at += thick + (between(rng, 0.02, 0.15) if rng.random() < 0.12 else 0.001)
