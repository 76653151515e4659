"""Floors, walls, doors, windows and ceilings of a room or a flat.

A flat is a rectangle cut into rooms; neighbours are joined by doorways. Ceilings are level or slope down to
one side as under a roof. The shell notes where a door needs space, so that furniture stays out of its way.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from geomoe3d.data.rooms.solids import Solids, between

_WALL = 0.12  # thickness between two rooms, metres

Rect = tuple[float, float, float, float]
"""x0, y0, x1, y1."""

SIDES = ("south", "north", "west", "east")


@dataclass(frozen=True)
class Opening:
    """A hole in a wall: from, to along the wall and bottom, top."""

    start: float
    end: float
    bottom: float
    top: float
    kind: str


@dataclass
class Room:
    """One room of a flat.

    Attributes:
        rect: inner faces of the walls.
        height: of the ceiling at its highest.
        openings: side -> holes in that wall.
        taken: floor that is not free: furniture, chimney breasts, the space doors need.
        low_side: side to which the ceiling slopes down, or None.
        low_height: of the ceiling there.
    """

    rect: Rect
    height: float
    openings: dict[str, list[Opening]] = field(default_factory=lambda: {side: [] for side in SIDES})
    taken: list[Rect] = field(default_factory=list)
    low_side: str | None = None
    low_height: float = 0.0

    def wall(self, side: str) -> tuple[float, float]:
        """From and to of a wall along its axis."""
        x0, y0, x1, y1 = self.rect
        return (x0, x1) if side in ("south", "north") else (y0, y1)

    def place(self, side: str, along: float, away: float) -> tuple[float, float]:
        """Where on the floor a place is that is given along a wall and away from it."""
        x0, y0, x1, y1 = self.rect
        return {
            "south": (along, y0 + away),
            "north": (along, y1 - away),
            "west": (x0 + away, along),
            "east": (x1 - away, along),
        }[side]


def plan_flat(rng: np.random.Generator, num_rooms: int) -> list[Room]:
    """Rooms of a flat with doorways, windows and doors, before anything is built."""
    area = num_rooms * between(rng, 9.0, 26.0)
    ratio = between(rng, 0.6, 1.6)
    rects: list[Rect] = [(0.0, 0.0, float(np.sqrt(area * ratio)), float(np.sqrt(area / ratio)))]
    while len(rects) < num_rooms:
        rects.sort(key=lambda r: (r[2] - r[0]) * (r[3] - r[1]))
        x0, y0, x1, y1 = rects.pop()
        cut = between(rng, 0.38, 0.62)
        if x1 - x0 > y1 - y0:
            middle = x0 + cut * (x1 - x0)
            rects += [(x0, y0, middle - _WALL / 2, y1), (middle + _WALL / 2, y0, x1, y1)]
        else:
            middle = y0 + cut * (y1 - y0)
            rects += [(x0, y0, x1, middle - _WALL / 2), (x0, middle + _WALL / 2, x1, y1)]
    height = between(rng, 2.3, 3.2)
    rooms = [Room(rect, height) for rect in rects]
    shared = join(rng, rooms)
    for room in rooms:
        for side in SIDES:
            if (id(room), side) not in shared:
                _outer_openings(rng, room, side)
        if rng.random() < 0.15:
            room.low_side, room.low_height = str(rng.choice(SIDES)), between(rng, 1.2, 1.9)
    return rooms


def build_shell(rng: np.random.Generator, solids: Solids, room: Room) -> None:
    """Floor, walls, ceiling and what is fixed to them."""
    x0, y0, x1, y1 = room.rect
    pad = _WALL / 2
    solids.box((x0 - pad, y0 - pad, -0.1), (x1 - x0 + 2 * pad, y1 - y0 + 2 * pad, 0.1))
    _ceiling(rng, solids, room)
    skirting = between(rng, 0.05, 0.12) if rng.random() < 0.7 else 0.0
    for side in SIDES:
        _wall(solids, room, side, 0.0, room.height, -pad, pad)
        if skirting:
            _wall(solids, room, side, 0.0, skirting, 0.0, 0.015)
        for opening in room.openings[side]:
            _fill(rng, solids, room, side, opening)
    for _ in range(int(rng.integers(0, 3))):
        _breast(rng, solids, room)


def along(
    solids: Solids,
    room: Room,
    side: str,
    span: tuple[float, float],
    levels: tuple[float, float],
    reach: tuple[float, float],
) -> None:
    """A box given in a wall's own terms: along it, upwards, and from the wall's face into the room."""
    (a, b), (z0, z1), (near, far) = span, levels, reach
    if b - a <= 0 or z1 - z0 <= 0:
        return
    x, y = room.place(side, a, near if side in ("south", "west") else far)
    size = (b - a, far - near) if side in ("south", "north") else (far - near, b - a)
    solids.box((x, y, z0), (*size, z1 - z0))


def strip(room: Room, side: str, start: float, end: float, depth: float) -> Rect:
    """The floor in front of a piece of wall."""
    first, second = room.place(side, start, 0.0), room.place(side, end, depth)
    if side in ("north", "east"):  # seen from there, the room lies towards zero
        first, second = room.place(side, start, depth), room.place(side, end, 0.0)
    return (*first, *second)


def join(rng: np.random.Generator, rooms: list[Room]) -> set[tuple[int, str]]:
    """Doorways between neighbours; gives the sides that face another room."""
    shared = set()
    for first in rooms:
        for second in rooms:
            for side, other, axis in (("east", "west", 0), ("north", "south", 1)):
                gap = second.rect[axis] - first.rect[axis + 2]
                low = max(first.rect[1 - axis], second.rect[1 - axis])
                high = min(first.rect[3 - axis], second.rect[3 - axis])
                if abs(gap - _WALL) > 1e-6 or high - low < 0.3:
                    continue
                shared |= {(id(first), side), (id(second), other)}
                if high - low < 1.3:
                    continue
                width = between(rng, 0.8, 1.0) if rng.random() < 0.75 else between(rng, 1.1, 2.0)
                width = min(width, high - low - 0.2)
                # The least place and the most can be one, and rounding turns them round.
                start = between(rng, low + 0.1, max(high - 0.1 - width, low + 0.1))
                top = between(rng, 1.98, 2.1)
                for room, where, leaf in ((first, side, rng.random() < 0.5), (second, other, False)):
                    kind = "door ajar" if leaf and width < 1.05 else "passage"
                    room.openings[where].append(Opening(start, start + width, 0.0, top, kind))
                    room.taken.append(strip(room, where, start - 0.1, start + width + 0.1, 0.7))
    return shared


def _outer_openings(rng: np.random.Generator, room: Room, side: str) -> None:
    low, high = room.wall(side)
    at = low + between(rng, 0.2, 0.8)
    while at < high - 0.9 and rng.random() < 0.75:
        if rng.random() < 0.65:
            width, bottom = between(rng, 0.7, 2.2), float(rng.choice([0.1, 0.5, 0.85, 1.0]))
            width = min(width, high - 0.15 - at)
            top = min(room.height - 0.1, bottom + between(rng, 1.0, 1.6))
            kind = str(rng.choice(["window", "window", "blind"]))
            room.openings[side].append(Opening(at, at + width, bottom, top, kind))
        else:
            width = min(between(rng, 0.75, 0.95), high - 0.1 - at)
            room.openings[side].append(Opening(at, at + width, 0.0, 2.03, "door shut"))
            room.taken.append(strip(room, side, at, at + width, 0.8))
        at += width + between(rng, 0.3, 2.0)


def _wall(solids: Solids, room: Room, side: str, bottom: float, top: float, near: float, far: float) -> None:
    """A wall, or a part of its height, left open where its openings are."""
    low, high = room.wall(side)
    face = (near, far) if near >= 0 else (near, 0.0)
    at = low - (_WALL / 2 if near < 0 else 0)
    end = high + (_WALL / 2 if near < 0 else 0)
    for hole in sorted(room.openings[side], key=lambda o: o.start):
        along(solids, room, side, (at, hole.start), (bottom, top), face)
        along(solids, room, side, (hole.start, hole.end), (bottom, min(top, hole.bottom)), face)
        along(solids, room, side, (hole.start, hole.end), (max(bottom, hole.top), top), face)
        at = hole.end
    along(solids, room, side, (at, end), (bottom, top), face)


def _fill(rng: np.random.Generator, solids: Solids, room: Room, side: str, hole: Opening) -> None:
    """Frames, panes, leaves, sills, radiators and curtains."""
    a, b, z0, z1 = hole.start, hole.end, hole.bottom, hole.top
    frame = between(rng, 0.04, 0.09)
    out = between(rng, 0.0, 0.03)
    for span, levels in (
        ((a - frame, a), (z0, z1)),
        ((b, b + frame), (z0, z1)),
        ((a - frame, b + frame), (z1, z1 + frame)),
    ):
        along(solids, room, side, span, levels, (-_WALL / 2, out))
    if hole.kind == "door shut":
        along(solids, room, side, (a, b), (z0, z1), (-0.05, -0.01))
        for k in range(int(rng.integers(0, 3))):
            inset = 0.12
            level = (z0 + 0.2 + k * 0.9, min(z1 - 0.15, z0 + 0.95 + k * 0.9))
            along(solids, room, side, (a + inset, b - inset), level, (-0.01, 0.005))
        along(solids, room, side, (a + 0.06, a + 0.18), (1.02, 1.05), (-0.01, 0.06))
    elif hole.kind == "door ajar":
        _leaf(rng, solids, room, side, hole)
    elif hole.kind in ("window", "blind"):
        recess = -between(rng, 0.03, _WALL / 2)
        panes = max(1, round((b - a) / between(rng, 0.5, 0.9)))
        for k in range(panes + 1):
            at = a + (b - a) * k / panes
            along(solids, room, side, (at - 0.03, at + 0.03), (z0, z1), (recess - 0.03, recess + 0.03))
        for level in ((z0, z0 + 0.06), (z1 - 0.06, z1)):
            along(solids, room, side, (a, b), level, (recess - 0.03, recess + 0.03))
        if hole.kind == "blind" or rng.random() < 0.4:
            bottom = z0 + between(rng, 0, 0.7) * (z1 - z0)
            along(solids, room, side, (a, b), (bottom, z1), (recess + 0.02, recess + 0.04))
        sill = between(rng, 0.02, 0.25)
        along(solids, room, side, (a - 0.05, b + 0.05), (z0 - 0.04, z0), (-_WALL / 2, sill))
        if z0 > 0.7 and rng.random() < 0.6:
            ribs = np.arange(a + 0.05, b - 0.1, 0.09)
            for x in ribs[: int(rng.integers(6, 20))]:
                along(solids, room, side, (float(x), float(x) + 0.06), (0.12, z0 - 0.15), (0.03, 0.13))
            room.taken.append(strip(room, side, a, b, 0.16))
        if rng.random() < 0.45:
            for span in ((a - 0.35, a + 0.1), (b - 0.1, b + 0.35)):
                _curtain(rng, solids, room, side, span, z1 + 0.15)


def _curtain(
    rng: np.random.Generator, solids: Solids, room: Room, side: str, span: tuple[float, float], top: float
) -> None:
    bottom = float(rng.choice([0.03, 0.7]))
    low, high = room.wall(side)
    at = max(span[0], low + 0.05)
    while at < min(span[1], high - 0.05):
        r = between(rng, 0.02, 0.05)
        x, y = room.place(side, at, 0.09)
        solids.cylinder((x, y, bottom), r, min(top, room.height) - bottom, top_radius=r * 0.7)
        at += 1.5 * r


def _leaf(rng: np.random.Generator, solids: Solids, room: Room, side: str, hole: Opening) -> None:
    """A door leaf that stands open into the room."""
    x0, y0, x1, y1 = room.rect
    width, angle = hole.end - hole.start, between(rng, 60, 110)
    hinge, base = {
        "south": ((hole.start, y0), 0.0),
        "north": ((hole.end, y1), 180.0),
        "west": ((x0, hole.end), -90.0),
        "east": ((x1, hole.start), 90.0),
    }[side]
    corner = (hinge[0], hinge[1], hole.bottom)
    solids.box(corner, (width, 0.04, hole.top - hole.bottom), turn_deg=base + angle, about=hinge)


def _ceiling(rng: np.random.Generator, solids: Solids, room: Room) -> None:
    x0, y0, x1, y1 = room.rect
    h = room.height
    solids.box((x0 - 0.05, y0 - 0.05, h), (x1 - x0 + 0.1, y1 - y0 + 0.1, 0.05))
    if room.low_side is not None:
        reach = between(rng, 0.35, 0.7)
        a, b = room.low_height, h
        sx, sy = x1 - x0, y1 - y0
        corners = {
            "south": [(x0, y0, a), (x1, y0, a), (x1, y0 + reach * sy, b), (x0, y0 + reach * sy, b)],
            "north": [(x0, y1, a), (x1, y1, a), (x1, y1 - reach * sy, b), (x0, y1 - reach * sy, b)],
            "west": [(x0, y0, a), (x0, y1, a), (x0 + reach * sx, y1, b), (x0 + reach * sx, y0, b)],
            "east": [(x1, y0, a), (x1, y1, a), (x1 - reach * sx, y1, b), (x1 - reach * sx, y0, b)],
        }[room.low_side]
        solids.triangles(np.array(corners), np.array([[0, 1, 2], [0, 2, 3]]))
    if rng.random() < 0.15:
        for x in np.arange(x0 + 0.4, x1 - 0.2, between(rng, 0.6, 1.2)):
            solids.box((float(x), y0, h - 0.18), (0.14, y1 - y0, 0.18))
    for _ in range(int(rng.integers(0, 3))):
        x, y = between(rng, x0 + 0.5, x1 - 0.5), between(rng, y0 + 0.5, y1 - 0.5)
        drop, r = between(rng, 0.1, 0.7), between(rng, 0.1, 0.3)
        solids.rod((x, y, h), (x, y, h - drop), 0.008)
        solids.cylinder((x, y, h - drop - 0.15), r, 0.16, top_radius=r * 0.4)


def _breast(rng: np.random.Generator, solids: Solids, room: Room) -> None:
    """A chimney breast, pillar, pipe or duct that breaks a wall."""
    side = str(rng.choice(SIDES))
    low, high = room.wall(side)
    width, depth = between(rng, 0.15, 1.2), between(rng, 0.08, 0.5)
    start = float(rng.choice([low, high - width, rng.uniform(low, max(high - width, low + 0.01))]))
    rect = strip(room, side, start, start + width, depth)
    if any(overlaps(rect, other, 0.05) for other in room.taken):
        return
    if any(o.start - 0.1 < start + width and start < o.end + 0.1 for o in room.openings[side]):
        return
    along(solids, room, side, (start, start + width), (0.0, room.height), (0.0, depth))
    room.taken.append(rect)


def overlaps(a: Rect, b: Rect, gap: float = 0.0) -> bool:
    """Whether two rectangles come closer than ``gap``."""
    return a[0] < b[2] + gap and b[0] < a[2] + gap and a[1] < b[3] + gap and b[1] < a[3] + gap
