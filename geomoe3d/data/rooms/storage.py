"""Cupboards, shelves, kitchens and bathrooms, and what stands about or hangs on walls; each drawn anew."""

from __future__ import annotations

import numpy as np

from geomoe3d.data.rooms.pieces import Piece, Shelf, books, color, fronts, legs
from geomoe3d.data.rooms.solids import Solids, between


def wardrobe(rng: np.random.Generator) -> Piece:
    """A tall cupboard with doors and handles."""
    s, c = Solids(), color(rng)
    n = int(rng.integers(1, 4))
    w, d, h = n * between(rng, 0.4, 0.6), between(rng, 0.4, 0.65), between(rng, 1.6, 2.3)
    s.box((-w / 2, 0, 0), (w, d, h), c)
    for k in range(n):
        x = -w / 2 + k * w / n
        fronts(s, rng, x, w / n, d, 0.08, h - 0.03, int(rng.integers(1, 4)), c)
    if rng.random() < 0.3:
        s.box((-w / 2 - 0.03, 0, h), (w + 0.06, d + 0.03, 0.05), c)
    return Piece("wardrobe", s, w, d, h, [Shelf((-w / 2, w / 2), (0, d), h, 0.4)])


def chest(rng: np.random.Generator) -> Piece:
    """Drawers at hip height: sideboards, night stands, filing cabinets."""
    s, c = Solids(), color(rng)
    n = int(rng.integers(1, 4))
    w, d, h = (
        n * between(rng, 0.38, 0.6),
        between(rng, 0.35, 0.55),
        between(rng, 0.45, 1.15),
    )
    foot = float(rng.choice([0.0, 0.06, 0.15]))
    s.box((-w / 2, 0, foot), (w, d, h - foot), c)
    if foot:
        legs(s, rng, w, d, foot, c)
    for k in range(n):
        fronts(s, rng, -w / 2 + k * w / n, w / n, d, foot + 0.03, h - 0.03, int(rng.integers(1, 6)), c)
    return Piece("chest", s, w, d, h, [Shelf((-w / 2, w / 2), (0, d), h)])


def bookshelf(rng: np.random.Generator) -> Piece:
    """Boards between two sides, full of books and things."""
    s, c = Solids(), color(rng)
    w, d, h = between(rng, 0.5, 1.3), between(rng, 0.24, 0.42), between(rng, 1.0, 2.2)
    thick = between(rng, 0.015, 0.035)
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


def wall_shelf(rng: np.random.Generator) -> Piece:
    """Boards on brackets at eye height, with books."""
    s, c = Solids(), color(rng)
    w, d, n = between(rng, 0.6, 1.5), between(rng, 0.18, 0.3), int(rng.integers(1, 4))
    z0, shelves = between(rng, 1.1, 1.5), []
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
    w, h, d = between(rng, 0.25, 1.6), between(rng, 0.2, 1.0), between(rng, 0.015, 0.08)
    z = between(rng, 1.2, 1.6) - h / 2 + 0.2
    s.box((-w / 2, 0, z), (w, d, h), color(rng))
    if rng.random() < 0.5:
        s.box((-w / 2 + 0.03, d - 0.01, z + 0.03), (w - 0.06, 0.02, h - 0.06), color(rng))
    return Piece("picture", s, w, d, z + h, hangs=True)


def lamp(rng: np.random.Generator) -> Piece:
    """A floor lamp."""
    s, c = Solids(), color(rng)
    h, r = between(rng, 1.3, 1.9), between(rng, 0.12, 0.25)
    s.cylinder((0, 0.2, 0), 0.15, 0.03, c)
    s.cylinder((0, 0.2, 0), 0.015, h, c)
    s.cylinder((0, 0.2, h - 0.25), r, 0.28, color(rng), r * between(rng, 0.5, 1.0))
    return Piece("lamp", s, 0.4, 0.4, h)


def plant(rng: np.random.Generator) -> Piece:
    """A pot with leaves."""
    s = Solids()
    r, h = between(rng, 0.1, 0.2), between(rng, 0.4, 1.5)
    s.cylinder((0, 0.2, 0), r * 0.8, 0.25, color(rng), r)
    s.rod((0, 0.2, 0.2), (0, 0.2, 0.2 + h * 0.5), 0.015)
    for _ in range(int(rng.integers(8, 30))):
        a, reach = rng.uniform(0, 2 * np.pi), between(rng, 0.02, 0.32)
        z = 0.25 + h * between(rng, 0.25, 1.0)
        size = rng.uniform(0.03, 0.13, 2)
        center = (reach * float(np.cos(a)), 0.2 + reach * float(np.sin(a)), z)
        s.blob(center, (float(size[0]), float(size[1]), 0.03), rng, 0.3, (0.3, 0.5, 0.25))
    return Piece("plant", s, 0.5, 0.5, h)


def counter(rng: np.random.Generator) -> Piece:
    """A run of kitchen units: cupboards below and above, sink, oven, taps, tiles."""
    s, c = Solids(), color(rng)
    n = int(rng.integers(2, 6))
    each, d, h = between(rng, 0.4, 0.65), between(rng, 0.58, 0.65), between(rng, 0.85, 0.95)
    w = n * each
    s.box((-w / 2, 0, 0.1), (w, d - 0.03, h - 0.14), c)
    s.box((-w / 2, 0, 0), (w, d - 0.1, 0.1), c)
    sink = int(rng.integers(n)) if rng.random() < 0.6 else -1
    top, overhang = color(rng), 0.02
    for k in range(n):
        x = -w / 2 + k * each
        fronts(s, rng, x, each, d - 0.03, 0.12, h - 0.06, int(rng.integers(1, 4)), c)
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
        up, z = between(rng, 0.3, 0.38), between(rng, 1.35, 1.5)
        for k in range(n):
            if rng.random() < 0.8:
                x, tall = -w / 2 + k * each, float(rng.choice([0.6, 0.6, 0.35]))
                s.box((x, 0, z), (each, up, tall), c)
                fronts(s, rng, x, each, up, z, z + tall, 1, c)
    free = [
        Shelf((-w / 2 + k * each, -w / 2 + (k + 1) * each), (0.03, d), h, 0.4) for k in range(n) if k != sink
    ]
    return Piece("counter", s, w, d, h, free)


def fridge(rng: np.random.Generator) -> Piece:
    """A fridge, washing machine or oven tower."""
    s, c = Solids(), color(rng)
    w, d, h = between(rng, 0.55, 0.75), between(rng, 0.55, 0.7), between(rng, 0.85, 1.95)
    s.box((-w / 2, 0, 0), (w, d, h), c)
    fronts(s, rng, -w / 2, w, d, 0.05, h, int(rng.integers(1, 3)), c)
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
    w, d, h = between(rng, 1.4, 1.8), between(rng, 0.7, 0.85), between(rng, 0.5, 0.6)
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
    w, d, h = between(rng, 0.45, 0.9), between(rng, 0.4, 0.5), between(rng, 0.8, 0.9)
    s.blob((0, d / 2, h - 0.06), (w / 2, d / 2, 0.1), rng)
    if rng.random() < 0.5:
        s.cylinder((0, 0.15, 0), 0.1, h - 0.1)
    else:
        s.box((-w / 2, 0, 0.1), (w, d * 0.8, h - 0.2), c)
        fronts(s, rng, -w / 2, w, d * 0.8, 0.12, h - 0.12, 2, c)
    s.rod((0, 0.05, h), (0, 0.15, h + 0.15), 0.015)
    s.box((-w / 2, 0, h + 0.35), (w, between(rng, 0.02, 0.15), 0.6), c)
    return Piece("washbasin", s, w, d, h)


def boxes(rng: np.random.Generator) -> Piece:
    """A pile of cartons, bags and bins on the floor."""
    s = Solids()
    z, top = 0.0, 0.0
    w = between(rng, 0.3, 0.6)
    if rng.random() < 0.3:
        r = between(rng, 0.12, 0.2)
        h = between(rng, 0.25, 0.6)
        s.cylinder((0, r, 0), r * 0.8, h, color(rng), r)
        return Piece("bin", s, 2 * r, 2 * r, h)
    if rng.random() < 0.3:
        h = between(rng, 0.25, 0.5)
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
    w, h, z = between(rng, 0.5, 1.4), between(rng, 0.4, 0.7), 0.12
    ribs = max(3, int(w / 0.09))
    for k in range(ribs):
        s.box((-w / 2 + k * w / ribs, 0.04, z), (0.06, 0.1, h))
    return Piece("radiator", s, w, 0.16, h + z)
