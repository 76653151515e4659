"""Tables, seats and beds, each drawn anew: no two chairs of two scenes are alike."""

from __future__ import annotations

import numpy as np

from geomoe3d.data.rooms.pieces import Piece, Shelf, color, fronts, legs
from geomoe3d.data.rooms.solids import Solids, between


def table(rng: np.random.Generator) -> Piece:
    """A dining, work or coffee table, rectangular or round."""
    s, c = Solids(), color(rng)
    w, d, h = between(rng, 0.8, 1.8), between(rng, 0.6, 0.95), between(rng, 0.70, 0.77)
    thick = between(rng, 0.02, 0.05)
    if rng.random() < 0.2:
        w = d = between(rng, 0.7, 1.2)
        s.cylinder((0, d / 2, h - thick), d / 2, thick, c)
        s.cylinder((0, d / 2, 0), 0.05, h - thick, c)
        s.cylinder((0, d / 2, 0), 0.25, 0.03, c)
        half = 0.33 * d
        return Piece("table", s, w, d, h, [Shelf((-half, half), (d / 2 - half, d / 2 + half), h)])
    s.box((-w / 2, 0, h - thick), (w, d, thick), c)
    legs(s, rng, w, d, h - thick, c)
    if rng.random() < 0.5:
        s.box((-w / 2 + 0.05, 0.05, h - thick - 0.09), (w - 0.1, d - 0.1, 0.09), c)
    return Piece("table", s, w, d, h, [Shelf((-w / 2, w / 2), (0, d), h)])


def coffee_table(rng: np.random.Generator) -> Piece:
    """A low table, sometimes with a board below."""
    s, c = Solids(), color(rng)
    w, d, h = between(rng, 0.6, 1.3), between(rng, 0.45, 0.8), between(rng, 0.32, 0.5)
    s.box((-w / 2, 0, h - 0.04), (w, d, 0.04), c)
    legs(s, rng, w, d, h - 0.04, c)
    if rng.random() < 0.5:
        s.box((-w / 2 + 0.04, 0.04, 0.12), (w - 0.08, d - 0.08, 0.02), c)
    return Piece("coffee table", s, w, d, h, [Shelf((-w / 2, w / 2), (0, d), h)])


def desk(rng: np.random.Generator) -> Piece:
    """A desk with drawers on one side, sometimes a screen of boards around it."""
    s, c = Solids(), color(rng)
    w, d, h = between(rng, 1.1, 2.0), between(rng, 0.6, 0.85), between(rng, 0.7, 0.78)
    s.box((-w / 2, 0, h - 0.03), (w, d, 0.03), c)
    side = float(rng.choice([-1, 1]))
    drawer_w = between(rng, 0.35, 0.5)
    x = side * (w / 2 - drawer_w / 2) - drawer_w / 2
    s.box((x, 0.03, 0.06), (drawer_w, d - 0.08, h - 0.1), c)
    fronts(s, rng, x, drawer_w, d - 0.05, 0.08, h - 0.12, int(rng.integers(2, 5)), c)
    s.box((-side * (w / 2 - 0.03) - 0.02, 0.05, 0), (0.04, d - 0.1, h - 0.03), c)
    if rng.random() < 0.6:
        s.box((-w / 2, 0.02, 0.3), (w, 0.02, h - 0.33), c)
    if rng.random() < 0.25:  # a board that parts it from the neighbour
        s.box((-w / 2, -0.03, 0.4), (w, 0.03, between(rng, 0.6, 0.9)), color(rng))
    return Piece("desk", s, w, d, h, [Shelf((-w / 2, w / 2), (0.02, d), h)])


def chair(rng: np.random.Generator) -> Piece:
    """A four-legged chair; back of bars or a board."""
    s, c = Solids(), color(rng)
    w, d, seat = between(rng, 0.38, 0.5), between(rng, 0.38, 0.5), between(rng, 0.42, 0.48)
    legs(s, rng, w, d, seat - 0.03, c)
    s.box((-w / 2, 0, seat - 0.035), (w, d, 0.035), c)
    top = seat + between(rng, 0.35, 0.6)
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
    w, seat = between(rng, 0.44, 0.55), between(rng, 0.42, 0.52)
    mid = w / 2
    for k in range(5):
        a = 2 * np.pi * k / 5
        s.rod((0, mid, 0.09), (0.3 * np.cos(a), mid + 0.3 * np.sin(a), 0.06), 0.02, c)
        s.blob((0.3 * np.cos(a), mid + 0.3 * np.sin(a), 0.03), (0.03, 0.03, 0.03), rng, 0, c)
    s.cylinder((0, mid, 0.06), 0.03, seat - 0.1, c)
    s.blob((0, mid, seat - 0.03), (w / 2, w / 2, 0.06), rng, 0.08, c)
    back = between(rng, 0.4, 0.75)
    s.blob((0, 0.02, seat + 0.12 + back / 2), (w / 2.2, 0.05, back / 2), rng, 0.08, c)
    s.rod((0, 0.12, seat - 0.05), (0, 0.0, seat + 0.2), 0.02, c)
    if rng.random() < 0.6:
        for x in (-w / 2, w / 2):
            s.box((x - 0.03, 0.1, seat + 0.18), (0.06, 0.26, 0.03), c)
            s.rod((x, 0.2, seat - 0.03), (x, 0.2, seat + 0.18), 0.015, c)
    return Piece("office chair", s, w + 0.1, w + 0.1, seat + back, [])


def sofa(rng: np.random.Generator) -> Piece:
    """An armchair to a three-seater, with cushions."""
    s, c = Solids(), color(rng)
    n = int(rng.integers(1, 4))
    arm, d = between(rng, 0.12, 0.26), between(rng, 0.75, 1.0)
    w = n * between(rng, 0.55, 0.75) + 2 * arm
    seat, back = between(rng, 0.36, 0.46), between(rng, 0.7, 0.95)
    foot = float(rng.choice([0.0, 0.08, 0.14]))
    s.box((-w / 2, 0, foot), (w, d, seat - 0.12 - foot), c)
    s.box((-w / 2, 0, foot), (w, 0.22, back - foot), c)
    arm_top = seat + between(rng, 0.1, 0.25)
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
        x = between(rng, -w / 2 + arm, w / 2 - arm)
        s.blob((x, 0.42, seat + 0.16), (0.22, 0.09, 0.2), rng, 0.15, color(rng))
    if rng.random() < 0.25:
        s.blob((between(rng, -0.3, 0.3) * w, d * 0.6, seat + 0.05), (0.35, 0.3, 0.07), rng, 0.4, color(rng))
    return Piece("sofa", s, w, d, back, [Shelf((-w / 2 + arm, w / 2 - arm), (0.4, d), seat + 0.03)])


def bed(rng: np.random.Generator) -> Piece:
    """A bed with its head at the wall, blanket and pillows in folds."""
    s, c, cloth = Solids(), color(rng), color(rng)
    w, d, top = between(rng, 0.9, 1.9), between(rng, 1.95, 2.1), between(rng, 0.4, 0.6)
    s.box((-w / 2, 0, 0.1), (w, d, top - 0.28), c)
    s.box((-w / 2 + 0.02, 0.02, top - 0.2), (w - 0.04, d - 0.04, 0.18), cloth)
    if rng.random() < 0.8:
        s.box((-w / 2, -0.02, 0), (w, 0.06, between(rng, 0.75, 1.3)), c)
    rows, columns = 30, 20
    y, x = np.mgrid[0 : 1 : rows * 1j, 0 : 1 : columns * 1j]
    folds = (
        0.05
        + 0.03
        * sum(np.sin(rng.uniform(3, 16) * x + rng.uniform(-9, 9) * y + rng.uniform(0, 6)) for _ in range(4))
        / 2
    )
    reach = between(rng, 0.6, 0.75) * d
    s.sheet(np.maximum(folds, 0.01), (-w / 2 - 0.01, d - reach, top - 0.02), (w + 0.02, reach), cloth)
    for k in range(1 if w < 1.2 else 2):
        px = 0.0 if w < 1.2 else (k - 0.5) * w / 2
        s.blob((px, 0.28, top + 0.06), (0.32, 0.2, 0.1), rng, 0.15, color(rng))
    if rng.random() < 0.4:
        s.blob(
            (between(rng, -0.3, 0.3) * w, d * 0.7, top + 0.08),
            (min(0.4, 0.3 * w), 0.3, 0.12),
            rng,
            0.5,
            color(rng),
        )
    return Piece("bed", s, w, d, top, [Shelf((-w / 2, w / 2), (0.6, d - 0.1), top + 0.05)])
