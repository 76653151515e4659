"""Small things that lie about: on tables, desks, shelves, beds and floors.

Most of what a descriptor can hold on to in a room are such things, so their number and variety decide how
many matches are right.
"""

from __future__ import annotations

import numpy as np

from geomoe3d.data.rooms.pieces import Piece, Shelf, color
from geomoe3d.data.rooms.solids import Solids, between, pose_on_floor


def put_things(
    solids: Solids,
    rng: np.random.Generator,
    piece: Piece,
    T_room_piece: np.ndarray,
    density: float,
) -> None:
    """Lay things on the shelves of a piece.

    Args:
        solids: what the things are added to, in the room's frame.
        rng: decides them.
        piece: has shelves.
        T_room_piece: (4, 4) where the piece stands.
        density: things per square metre.
    """
    for shelf in piece.shelves:
        area = (shelf.x[1] - shelf.x[0]) * (shelf.y[1] - shelf.y[0])
        count = int(rng.poisson(density * area))
        made = Solids()
        for _ in range(min(count, 25)):
            _one(made, rng, shelf, desk=piece.name == "desk")
        if piece.name == "desk" and shelf.x[1] - shelf.x[0] > 0.7:
            _workplace(made, rng, shelf)
        if made.vertices:
            solids.place(made, T_room_piece)


def _one(s: Solids, rng: np.random.Generator, shelf: Shelf, *, desk: bool) -> None:
    x, y = float(rng.uniform(*shelf.x)), float(rng.uniform(*shelf.y))
    if not (shelf.x[0] + 0.04 < x < shelf.x[1] - 0.04 and shelf.y[0] + 0.04 < y < shelf.y[1] - 0.04):
        return
    item = thing(rng, min(shelf.clearance, 0.5), flat=0.5 if desk else 0.25)
    s.place(item, pose_on_floor(x, y, between(rng, 0, 360), shelf.z))


def thing(rng: np.random.Generator, tallest: float, flat: float = 0.25) -> Solids:
    """One small thing at the origin, standing on z = 0, at most ``tallest`` high.

    Args:
        rng: decides it.
        tallest: metres.
        flat: chance of paper, books or boards that lie flat.
    """
    s, c = Solids(), color(rng)
    kind = rng.random()
    if kind < flat:  # papers, books, a keyboard
        z = 0.0
        for _ in range(int(rng.integers(1, 5))):
            size = rng.uniform([0.12, 0.1, 0.008], [0.34, 0.26, 0.05])
            if z + size[2] > tallest:
                break
            corner = (-size[0] / 2, -size[1] / 2, z)
            s.box(corner, (size[0], size[1], size[2]), color(rng), float(rng.normal(0, 15)), (0.0, 0.0))
            z += float(size[2])
    elif kind < flat + 0.2:  # bottles, cans, mugs, vases
        r, h = between(rng, 0.025, 0.07), min(tallest, between(rng, 0.08, 0.33))
        s.cylinder((0, 0, 0), r, h * 0.65, c)
        s.cylinder((0, 0, h * 0.65), r, h * 0.35, c, r * between(rng, 0.3, 1.3))
    elif kind < flat + 0.45:  # boxes, devices
        size = rng.uniform([0.06, 0.05, 0.05], [0.4, 0.3, 0.35])
        s.box((-size[0] / 2, -size[1] / 2, 0), (size[0], size[1], min(tallest, float(size[2]))), c)
    elif kind < flat + 0.6:  # bags, fruit, toys, cloth
        radii = rng.uniform([0.04, 0.04, 0.03], [0.2, 0.16, 0.15])
        h = min(float(radii[2]), tallest / 2.5)
        s.blob((0, 0, h), (float(radii[0]), float(radii[1]), h), rng, between(rng, 0.1, 0.5), c)
    elif kind < flat + 0.7:  # bowls and plates
        r = between(rng, 0.08, 0.18)
        s.cylinder((0, 0, 0), r * 0.5, min(tallest, between(rng, 0.02, 0.1)), c, r)
    else:  # a lamp, a plant, a figure: a foot and something on it
        h = min(tallest * 0.95, between(rng, 0.2, 0.5))
        s.cylinder((0, 0, 0), 0.07, 0.02, c)
        s.rod((0, 0, 0), (between(rng, -0.1, 0.1), 0, h * 0.8), 0.012, c)
        r = between(rng, 0.05, 0.13)
        if rng.random() < 0.5:
            s.cylinder((0, 0, h * 0.6), r, h * 0.4, c, r * 0.6)
        else:
            for _ in range(int(rng.integers(3, 9))):
                at = rng.normal((0.0, 0.0, h * 0.75), 0.06)
                s.blob((at[0], at[1], max(at[2], 0.05)), (r * 0.6, r * 0.4, 0.03), rng, 0.3, c)
    return s


def _workplace(s: Solids, rng: np.random.Generator, shelf: Shelf) -> None:
    """Screen, keyboard and cables of a desk."""
    if rng.random() < 0.15:
        return
    for _ in range(int(rng.integers(1, 3))):
        x, y = between(rng, shelf.x[0] + 0.3, shelf.x[1] - 0.3), between(rng, 0.12, 0.3)
        w, h, angle = between(rng, 0.38, 0.65), between(rng, 0.26, 0.4), float(rng.normal(0, 18))
        screen = Solids()
        depth = 0.04 if rng.random() < 0.75 else 0.35  # flat, or a tube
        screen.box((-w / 2, -depth, 0.1), (w, depth, h))
        screen.box((-0.03, -0.05, 0), (0.06, 0.03, 0.3))
        screen.cylinder((0, -0.02, 0), 0.12, 0.015)
        s.place(screen, pose_on_floor(x, y, angle, shelf.z))
        s.box((x - 0.2, y + 0.15, shelf.z), (0.42, 0.14, 0.025), turn_deg=angle)


def litter(solids: Solids, rng: np.random.Generator, low: np.ndarray, high: np.ndarray, count: int) -> None:
    """Things on the floor of a room between two corners (2,)."""
    for _ in range(count):
        x, y = rng.uniform(low + 0.3, high - 0.3)
        solids.place(thing(rng, 0.4), pose_on_floor(float(x), float(y), between(rng, 0, 360)))
