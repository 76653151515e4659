"""Furniture from boxes, rods and blobs, each drawn anew: no two chairs of two scenes are alike.

A piece stands in its own frame: back edge along x through the origin, its front at +y, floor at z = 0,
metres. It says how much floor it takes and on which of its surfaces things may lie.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from geomoe3d.data.rooms.solids import Solids, Triple


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


def _slab(
    s: Solids, x: tuple[float, float], y: tuple[float, float], z: tuple[float, float], c: Triple
) -> None:
    s.box((x[0], y[0], z[0]), (x[1] - x[0], y[1] - y[0], z[1] - z[0]), c)


def _legs(s: Solids, rng: np.random.Generator, w: float, d: float, top: float, c: Triple) -> None:
    thick, inset = float(rng.uniform(0.02, 0.07)), float(rng.uniform(0.0, 0.08))
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


def table(rng: np.random.Generator, width: tuple[float, float] = (0.8, 1.8)) -> Piece:
    """A dining, work or coffee table, rectangular or round."""
    s, c = Solids(), color(rng)
    w, d, h = float(rng.uniform(*width)), float(rng.uniform(0.6, 0.95)), float(rng.uniform(0.70, 0.77))
    thick = float(rng.uniform(0.02, 0.05))
    if rng.random() < 0.2:
        w = d = float(rng.uniform(0.7, 1.2))
        s.cylinder((0, d / 2, h - thick), d / 2, thick, c)
        s.cylinder((0, d / 2, 0), 0.05, h - thick, c)
        s.cylinder((0, d / 2, 0), 0.25, 0.03, c)
        half = 0.33 * d
        return Piece("table", s, w, d, h, [Shelf((-half, half), (d / 2 - half, d / 2 + half), h)])
    s.box((-w / 2, 0, h - thick), (w, d, thick), c)
    _legs(s, rng, w, d, h - thick, c)
    if rng.random() < 0.5:
        s.box((-w / 2 + 0.05, 0.05, h - thick - 0.09), (w - 0.1, d - 0.1, 0.09), c)
    return Piece("table", s, w, d, h, [Shelf((-w / 2, w / 2), (0, d), h)])


def coffee_table(rng: np.random.Generator) -> Piece:
    """A low table, sometimes with a board below."""
    s, c = Solids(), color(rng)
    w, d, h = float(rng.uniform(0.6, 1.3)), float(rng.uniform(0.45, 0.8)), float(rng.uniform(0.32, 0.5))
    s.box((-w / 2, 0, h - 0.04), (w, d, 0.04), c)
    _legs(s, rng, w, d, h - 0.04, c)
    if rng.random() < 0.5:
        s.box((-w / 2 + 0.04, 0.04, 0.12), (w - 0.08, d - 0.08, 0.02), c)
    return Piece("coffee table", s, w, d, h, [Shelf((-w / 2, w / 2), (0, d), h)])


def desk(rng: np.random.Generator) -> Piece:
    """A desk with drawers on one side, sometimes a screen of boards around it."""
    s, c = Solids(), color(rng)
    w, d, h = float(rng.uniform(1.1, 2.0)), float(rng.uniform(0.6, 0.85)), float(rng.uniform(0.7, 0.78))
    s.box((-w / 2, 0, h - 0.03), (w, d, 0.03), c)
    side = float(rng.choice([-1, 1]))
    drawer_w = float(rng.uniform(0.35, 0.5))
    x = side * (w / 2 - drawer_w / 2) - drawer_w / 2
    s.box((x, 0.03, 0.06), (drawer_w, d - 0.08, h - 0.1), c)
    _fronts(s, rng, x, drawer_w, d - 0.05, 0.08, h - 0.12, int(rng.integers(2, 5)), c)
    s.box((-side * (w / 2 - 0.03) - 0.02, 0.05, 0), (0.04, d - 0.1, h - 0.03), c)
    if rng.random() < 0.6:
        s.box((-w / 2, 0.02, 0.3), (w, 0.02, h - 0.33), c)
    if rng.random() < 0.25:  # a board that parts it from the neighbour
        s.box((-w / 2, -0.03, 0.4), (w, 0.03, float(rng.uniform(0.6, 0.9))), color(rng))
    return Piece("desk", s, w, d, h, [Shelf((-w / 2, w / 2), (0.02, d), h)])


def _fronts(
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
        out = float(rng.uniform(0.08, 0.25)) if rng.random() < 0.06 else 0.018
        s.box((x + 0.008, y, z0 + 0.006), (width - 0.016, out, z1 - z0 - 0.012), c)
        z = float(z1 - 0.3 * (z1 - z0)) if z1 - z0 > 0.3 else float((z0 + z1) / 2)
        if knob:
            s.blob((x + width / 2, y + out + 0.02, z), (0.018, 0.02, 0.018), rng, 0.0, c)
        else:
            s.box((x + 0.3 * width, y + out + 0.02, z), (0.4 * width, 0.012, 0.015), c)


def chair(rng: np.random.Generator) -> Piece:
    """A four-legged chair; back of bars or a board."""
    s, c = Solids(), color(rng)
    w, d, seat = float(rng.uniform(0.38, 0.5)), float(rng.uniform(0.38, 0.5)), float(rng.uniform(0.42, 0.48))
    _legs(s, rng, w, d, seat - 0.03, c)
    s.box((-w / 2, 0, seat - 0.035), (w, d, 0.035), c)
    top = seat + float(rng.uniform(0.35, 0.6))
    style = rng.integers(3)
    if style == 0:
        s.box((-w / 2, 0, seat), (w, 0.03, top - seat), c)
    else:
        for x in (-w / 2, w / 2 - 0.035):
            s.box((x, 0, seat), (0.035, 0.03, top - seat), c)
        bars = int(rng.integers(2, 5))
        for k in range(bars):
            if style == 1:
                z = seat + (top - seat) * (k + 1) / bars - 0.05
                s.box((-w / 2, 0.005, z), (w, 0.02, 0.05), c)
            else:
                x = -w / 2 + w * (k + 1) / (bars + 1)
                s.rod((x, 0.015, seat), (x, 0.015, top), 0.01, c)
        s.box((-w / 2, 0, top - 0.06), (w, 0.03, 0.06), c)
    if rng.random() < 0.25:
        s.blob((0, d / 2, seat + 0.02), (w / 2.2, d / 2.2, 0.04), rng, 0.1, color(rng))
    if rng.random() < 0.12:  # a jacket over the back
        s.blob((0, 0.02, top - 0.2), (w / 1.9, 0.08, 0.28), rng, 0.35, color(rng))
    return Piece("chair", s, w, d, top, [Shelf((-w / 2, w / 2), (0.08, d), seat)])


def office_chair(rng: np.random.Generator) -> Piece:
    """A swivel chair on five arms."""
    s, c = Solids(), color(rng)
    w, seat = float(rng.uniform(0.44, 0.55)), float(rng.uniform(0.42, 0.52))
    mid = w / 2
    for k in range(5):
        a = 2 * np.pi * k / 5
        s.rod((0, mid, 0.09), (0.3 * np.cos(a), mid + 0.3 * np.sin(a), 0.06), 0.02, c)
        s.blob((0.3 * np.cos(a), mid + 0.3 * np.sin(a), 0.03), (0.03, 0.03, 0.03), rng, 0, c)
    s.cylinder((0, mid, 0.06), 0.03, seat - 0.1, c)
    s.blob((0, mid, seat - 0.03), (w / 2, w / 2, 0.06), rng, 0.08, c)
    back = float(rng.uniform(0.4, 0.75))
    s.blob((0, 0.02, seat + 0.12 + back / 2), (w / 2.2, 0.05, back / 2), rng, 0.08, c)
    s.rod((0, 0.12, seat - 0.05), (0, 0.0, seat + 0.2), 0.02, c)
    if rng.random() < 0.6:
        for x in (-w / 2, w / 2):
            s.box((x - 0.03, 0.1, seat + 0.18), (0.06, 0.26, 0.03), c)
            s.rod((x, 0.2, seat - 0.03), (x, 0.2, seat + 0.18), 0.015, c)
    return Piece("office chair", s, w + 0.1, w + 0.1, seat + back, [])


def sofa(rng: np.random.Generator, seats: int | None = None) -> Piece:
    """An armchair to a three-seater, with cushions."""
    s, c = Solids(), color(rng)
    n = int(rng.integers(1, 4)) if seats is None else seats
    arm, d = float(rng.uniform(0.12, 0.26)), float(rng.uniform(0.75, 1.0))
    w = n * float(rng.uniform(0.55, 0.75)) + 2 * arm
    seat, back = float(rng.uniform(0.36, 0.46)), float(rng.uniform(0.7, 0.95))
    foot = float(rng.choice([0.0, 0.08, 0.14]))
    s.box((-w / 2, 0, foot), (w, d, seat - 0.12 - foot), c)
    s.box((-w / 2, 0, foot), (w, 0.22, back - foot), c)
    arm_top = seat + float(rng.uniform(0.1, 0.25))
    for x in (-w / 2, w / 2 - arm):
        if rng.random() < 0.3:
            s.rod((x + arm / 2, 0.05, arm_top - arm / 2), (x + arm / 2, d, arm_top - arm / 2), arm / 2, c)
        s.box((x, 0, foot), (arm, d, arm_top - foot - (arm / 2)), c)
    each = (w - 2 * arm) / n
    for k in range(n):
        x = -w / 2 + arm + (k + 0.5) * each
        s.blob((x, 0.22 + (d - 0.22) / 2, seat - 0.07), (each / 1.9, (d - 0.22) / 1.9, 0.1), rng, 0.06, c)
        s.blob((x, 0.25, (seat + back) / 2), (each / 2.05, 0.12, (back - seat) / 1.9), rng, 0.08, c)
    for _ in range(int(rng.integers(0, n + 2))):
        x = float(rng.uniform(-w / 2 + arm, w / 2 - arm))
        s.blob((x, 0.42, seat + 0.16), (0.22, 0.09, 0.2), rng, 0.15, color(rng))
    if rng.random() < 0.25:
        s.blob(
            (float(rng.uniform(-0.3, 0.3)) * w, d * 0.6, seat + 0.05), (0.35, 0.3, 0.07), rng, 0.4, color(rng)
        )
    return Piece("sofa", s, w, d, back, [Shelf((-w / 2 + arm, w / 2 - arm), (0.4, d), seat + 0.03)])


def bed(rng: np.random.Generator) -> Piece:
    """A bed with its head at the wall, blanket and pillows in folds."""
    s, c, cloth = Solids(), color(rng), color(rng)
    w, d, top = float(rng.uniform(0.9, 1.9)), float(rng.uniform(1.95, 2.1)), float(rng.uniform(0.4, 0.6))
    s.box((-w / 2, 0, 0.1), (w, d, top - 0.28), c)
    s.box((-w / 2 + 0.02, 0.02, top - 0.2), (w - 0.04, d - 0.04, 0.18), cloth)
    if rng.random() < 0.8:
        s.box((-w / 2, -0.02, 0), (w, 0.06, float(rng.uniform(0.75, 1.3))), c)
    rows, columns = 30, 20
    y, x = np.mgrid[0 : 1 : rows * 1j, 0 : 1 : columns * 1j]
    folds = (
        0.05
        + 0.03
        * sum(np.sin(rng.uniform(3, 16) * x + rng.uniform(-9, 9) * y + rng.uniform(0, 6)) for _ in range(4))
        / 2
    )
    reach = float(rng.uniform(0.6, 0.75)) * d
    s.sheet(np.maximum(folds, 0.01), (-w / 2 - 0.01, d - reach, top - 0.02), (w + 0.02, reach), cloth)
    for k in range(1 if w < 1.2 else 2):
        px = 0.0 if w < 1.2 else (k - 0.5) * w / 2
        s.blob((px, 0.28, top + 0.06), (0.32, 0.2, 0.1), rng, 0.15, color(rng))
    if rng.random() < 0.4:
        s.blob(
            (float(rng.uniform(-0.3, 0.3)) * w, d * 0.7, top + 0.08),
            (min(0.4, 0.3 * w), 0.3, 0.12),
            rng,
            0.5,
            color(rng),
        )
    return Piece("bed", s, w, d, top, [Shelf((-w / 2, w / 2), (0.6, d - 0.1), top + 0.05)])


def wardrobe(rng: np.random.Generator) -> Piece:
    """A tall cupboard with doors and handles."""
    s, c = Solids(), color(rng)
    n = int(rng.integers(1, 4))
    w, d, h = n * float(rng.uniform(0.4, 0.6)), float(rng.uniform(0.4, 0.65)), float(rng.uniform(1.6, 2.3))
    s.box((-w / 2, 0, 0), (w, d, h), c)
    for k in range(n):
        x = -w / 2 + k * w / n
        _fronts(s, rng, x, w / n, d, 0.08, h - 0.03, int(rng.integers(1, 4)), c)
    if rng.random() < 0.3:
        s.box((-w / 2 - 0.03, 0, h), (w + 0.06, d + 0.03, 0.05), c)
    return Piece("wardrobe", s, w, d, h, [Shelf((-w / 2, w / 2), (0, d), h, 0.4)])


def chest(rng: np.random.Generator) -> Piece:
    """Drawers at hip height: sideboards, night stands, filing cabinets."""
    s, c = Solids(), color(rng)
    n = int(rng.integers(1, 4))
    w, d, h = (
        n * float(rng.uniform(0.38, 0.6)),
        float(rng.uniform(0.35, 0.55)),
        float(rng.uniform(0.45, 1.15)),
    )
    foot = float(rng.choice([0.0, 0.06, 0.15]))
    s.box((-w / 2, 0, foot), (w, d, h - foot), c)
    if foot:
        _legs(s, rng, w, d, foot, c)
    for k in range(n):
        _fronts(s, rng, -w / 2 + k * w / n, w / n, d, foot + 0.03, h - 0.03, int(rng.integers(1, 6)), c)
    return Piece("chest", s, w, d, h, [Shelf((-w / 2, w / 2), (0, d), h)])


def bookshelf(rng: np.random.Generator) -> Piece:
    """Boards between two sides, full of books and things."""
    s, c = Solids(), color(rng)
    w, d, h = float(rng.uniform(0.5, 1.3)), float(rng.uniform(0.24, 0.42)), float(rng.uniform(1.0, 2.2))
    thick = float(rng.uniform(0.015, 0.035))
    rows = max(2, round(h / rng.uniform(0.28, 0.42)))
    for x in (-w / 2, w / 2 - thick):
        s.box((x, 0, 0), (thick, d, h), c)
    if rng.random() < 0.7:
        s.box((-w / 2, 0, 0), (w, 0.01, h), c)
    shelves = []
    gap = h / rows
    for k in range(rows + 1):
        z = min(k * gap, h - thick) + (0.02 if k == 0 else 0)
        s.box((-w / 2, 0, z), (w, d, thick), c)
        if k < rows and rng.random() < 0.75:
            books(s, rng, (-w / 2 + thick, w / 2 - thick), 0.02, d - 0.02, z + thick, gap - thick - 0.02)
        elif k < rows:
            shelves.append(Shelf((-w / 2 + 0.03, w / 2 - 0.03), (0.02, d), z + thick, gap - 0.06))
    shelves.append(Shelf((-w / 2, w / 2), (0, d), h, 0.4))
    return Piece("bookshelf", s, w, d, h, shelves)


def books(
    s: Solids, rng: np.random.Generator, x: tuple[float, float], y: float, depth: float, z: float, high: float
) -> None:
    """A row of books, leaning, lying and missing here and there."""
    at = x[0] + float(rng.uniform(0, 0.05))
    end = x[0] + (x[1] - x[0]) * float(rng.uniform(0.4, 1.0))
    while at < end:
        thick = float(rng.uniform(0.012, 0.06))
        tall, deep = high * float(rng.uniform(0.55, 0.97)), depth * float(rng.uniform(0.5, 0.98))
        if at + thick > x[1]:
            break
        if rng.random() < 0.06:
            pile = float(rng.uniform(0.15, 0.28))
            if at + pile > x[1]:
                break
            s.box((at, y, z), (pile, deep * 0.8, min(high, thick * 3)), color(rng))
            at += pile
            continue
        s.box((at, y, z), (thick, deep, tall), color(rng))
        at += thick + (float(rng.uniform(0.02, 0.15)) if rng.random() < 0.12 else 0.001)


def wall_shelf(rng: np.random.Generator) -> Piece:
    """Boards on brackets at eye height, with books."""
    s, c = Solids(), color(rng)
    w, d, n = float(rng.uniform(0.6, 1.5)), float(rng.uniform(0.18, 0.3)), int(rng.integers(1, 4))
    z0, shelves = float(rng.uniform(1.1, 1.5)), []
    for k in range(n):
        z = z0 + 0.33 * k
        s.box((-w / 2, 0, z), (w, d, 0.025), c)
        for x in (-w / 2 + 0.08, w / 2 - 0.1):
            s.box((x, 0, z - 0.12), (0.02, d * 0.7, 0.12), c)
        if rng.random() < 0.6:
            books(s, rng, (-w / 2, w / 2), 0.01, d - 0.02, z + 0.025, 0.28)
        else:
            shelves.append(Shelf((-w / 2, w / 2), (0, d), z + 0.025, 0.28))
    return Piece("wall shelf", s, w, d, z0 + 0.33 * n, shelves, hangs=True)


def picture(rng: np.random.Generator) -> Piece:
    """A frame, board or screen on the wall."""
    s = Solids()
    w, h, d = float(rng.uniform(0.25, 1.6)), float(rng.uniform(0.2, 1.0)), float(rng.uniform(0.015, 0.08))
    z = float(rng.uniform(1.2, 1.6)) - h / 2 + 0.2
    s.box((-w / 2, 0, z), (w, d, h), color(rng))
    if rng.random() < 0.5:
        s.box((-w / 2 + 0.03, d - 0.01, z + 0.03), (w - 0.06, 0.02, h - 0.06), color(rng))
    return Piece("picture", s, w, d, z + h, hangs=True)


def lamp(rng: np.random.Generator) -> Piece:
    """A floor lamp."""
    s, c = Solids(), color(rng)
    h, r = float(rng.uniform(1.3, 1.9)), float(rng.uniform(0.12, 0.25))
    s.cylinder((0, 0.2, 0), 0.15, 0.03, c)
    s.cylinder((0, 0.2, 0), 0.015, h, c)
    s.cylinder((0, 0.2, h - 0.25), r, 0.28, color(rng), r * float(rng.uniform(0.5, 1.0)))
    return Piece("lamp", s, 0.4, 0.4, h)


def plant(rng: np.random.Generator) -> Piece:
    """A pot with leaves."""
    s = Solids()
    r, h = float(rng.uniform(0.1, 0.2)), float(rng.uniform(0.4, 1.5))
    s.cylinder((0, 0.2, 0), r * 0.8, 0.25, color(rng), r)
    s.rod((0, 0.2, 0.2), (0, 0.2, 0.2 + h * 0.5), 0.015)
    for _ in range(int(rng.integers(8, 30))):
        a, reach = rng.uniform(0, 2 * np.pi), float(rng.uniform(0.02, 0.32))
        z = 0.25 + h * float(rng.uniform(0.25, 1.0))
        size = rng.uniform(0.03, 0.13, 2)
        center = (reach * float(np.cos(a)), 0.2 + reach * float(np.sin(a)), z)
        s.blob(center, (float(size[0]), float(size[1]), 0.03), rng, 0.3, (0.3, 0.5, 0.25))
    return Piece("plant", s, 0.5, 0.5, h)


def counter(rng: np.random.Generator) -> Piece:
    """A run of kitchen units: cupboards below and above, sink, oven, taps, tiles."""
    s, c = Solids(), color(rng)
    n = int(rng.integers(2, 6))
    each, d, h = float(rng.uniform(0.4, 0.65)), float(rng.uniform(0.58, 0.65)), float(rng.uniform(0.85, 0.95))
    w = n * each
    s.box((-w / 2, 0, 0.1), (w, d - 0.03, h - 0.14), c)
    s.box((-w / 2, 0, 0), (w, d - 0.1, 0.1), c)
    sink = int(rng.integers(n)) if rng.random() < 0.6 else -1
    top, overhang = color(rng), 0.02
    for k in range(n):
        x = -w / 2 + k * each
        _fronts(s, rng, x, each, d - 0.03, 0.12, h - 0.06, int(rng.integers(1, 4)), c)
        if k == sink:
            for px, py, sx, sy in ((0, 0, each, 0.1), (0, d - 0.1, each, 0.1), (0, 0.1, 0.06, d - 0.2)):
                s.box((x + px, py, h - 0.04), (sx, sy, 0.04), top)
            s.box((x + each - 0.06, 0.1, h - 0.04), (0.06, d - 0.2, 0.04), top)
            s.box((x, 0.1, h - 0.18), (each, d - 0.2, 0.01), top)
            s.rod((x + each / 2, 0.06, h), (x + each / 2, 0.06, h + 0.25), 0.015)
            s.rod((x + each / 2, 0.06, h + 0.25), (x + each / 2, 0.24, h + 0.22), 0.013)
        else:
            s.box((x, 0, h - 0.04), (each, d + overhang, 0.04), top)
    if rng.random() < 0.7:
        up, z = float(rng.uniform(0.3, 0.38)), float(rng.uniform(1.35, 1.5))
        for k in range(n):
            if rng.random() < 0.8:
                x, tall = -w / 2 + k * each, float(rng.choice([0.6, 0.6, 0.35]))
                s.box((x, 0, z), (each, up, tall), c)
                _fronts(s, rng, x, each, up, z, z + tall, 1, c)
    free = [
        Shelf((-w / 2 + k * each, -w / 2 + (k + 1) * each), (0.03, d), h, 0.4) for k in range(n) if k != sink
    ]
    return Piece("counter", s, w, d, h, free)


def fridge(rng: np.random.Generator) -> Piece:
    """A fridge, washing machine or oven tower."""
    s, c = Solids(), color(rng)
    w, d, h = float(rng.uniform(0.55, 0.75)), float(rng.uniform(0.55, 0.7)), float(rng.uniform(0.85, 1.95))
    s.box((-w / 2, 0, 0), (w, d, h), c)
    _fronts(s, rng, -w / 2, w, d, 0.05, h, int(rng.integers(1, 3)), c)
    return Piece("fridge", s, w, d, h, [Shelf((-w / 2, w / 2), (0, d), h, 0.4)])


def toilet(rng: np.random.Generator) -> Piece:
    """A toilet with its cistern."""
    s = Solids()
    s.box((-0.2, 0, 0.38), (0.4, 0.18, 0.42))
    s.blob((0, 0.42, 0.36), (0.19, 0.27, 0.07), rng)
    s.cylinder((0, 0.38, 0), 0.12, 0.36, top_radius=0.18)
    return Piece("toilet", s, 0.42, 0.72, 0.8, [Shelf((-0.18, 0.18), (0.02, 0.16), 0.8)])


def bathtub(rng: np.random.Generator) -> Piece:
    """A tub along the wall."""
    s = Solids()
    w, d, h = float(rng.uniform(1.4, 1.8)), float(rng.uniform(0.7, 0.85)), float(rng.uniform(0.5, 0.6))
    for x, y, sx, sy in (
        (-w / 2, 0, w, 0.08),
        (-w / 2, d - 0.08, w, 0.08),
        (-w / 2, 0, 0.1, d),
        (w / 2 - 0.1, 0, 0.1, d),
    ):
        s.box((x, y, 0), (sx, sy, h))
    s.box((-w / 2, 0, 0.12), (w, d, 0.03))
    s.rod((-w / 2 + 0.2, 0.04, h), (-w / 2 + 0.2, 0.12, h + 0.15), 0.02)
    return Piece("bathtub", s, w, d, h)


def washbasin(rng: np.random.Generator) -> Piece:
    """A basin on a pillar or a cupboard, a mirror cabinet above."""
    s, c = Solids(), color(rng)
    w, d, h = float(rng.uniform(0.45, 0.9)), float(rng.uniform(0.4, 0.5)), float(rng.uniform(0.8, 0.9))
    s.blob((0, d / 2, h - 0.06), (w / 2, d / 2, 0.1), rng)
    if rng.random() < 0.5:
        s.cylinder((0, 0.15, 0), 0.1, h - 0.1)
    else:
        s.box((-w / 2, 0, 0.1), (w, d * 0.8, h - 0.2), c)
        _fronts(s, rng, -w / 2, w, d * 0.8, 0.12, h - 0.12, 2, c)
    s.rod((0, 0.05, h), (0, 0.15, h + 0.15), 0.015)
    s.box((-w / 2, 0, h + 0.35), (w, float(rng.uniform(0.02, 0.15)), 0.6), c)
    return Piece("washbasin", s, w, d, h)


def boxes(rng: np.random.Generator) -> Piece:
    """A pile of cartons, bags and bins on the floor."""
    s = Solids()
    z, top = 0.0, 0.0
    w = float(rng.uniform(0.3, 0.6))
    if rng.random() < 0.3:
        r = float(rng.uniform(0.12, 0.2))
        h = float(rng.uniform(0.25, 0.6))
        s.cylinder((0, r, 0), r * 0.8, h, color(rng), r)
        return Piece("bin", s, 2 * r, 2 * r, h)
    if rng.random() < 0.3:
        h = float(rng.uniform(0.25, 0.5))
        s.blob((0, 0.2, h / 2), (w / 2, 0.18, h / 2), rng, 0.35, color(rng))
        return Piece("bag", s, w, 0.4, h)
    for _ in range(int(rng.integers(1, 4))):
        size = rng.uniform([0.25, 0.2, 0.12], [0.6, 0.45, 0.4])
        s.box((-size[0] / 2, 0.02, z), (size[0], size[1], size[2]), color(rng), float(rng.normal(0, 12)))
        z += float(size[2])
        top = z
    return Piece("boxes", s, 0.6, 0.45, top, [Shelf((-0.12, 0.12), (0.06, 0.2), top)])


def radiator(rng: np.random.Generator) -> Piece:
    """Ribs under a window."""
    s = Solids()
    w, h, z = float(rng.uniform(0.5, 1.4)), float(rng.uniform(0.4, 0.7)), 0.12
    ribs = max(3, int(w / 0.09))
    for k in range(ribs):
        s.box((-w / 2 + k * w / ribs, 0.04, z), (0.06, 0.1, h))
    return Piece("radiator", s, w, 0.16, h + z)
