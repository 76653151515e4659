"""Furniture where people put it: against walls, chairs at tables, lamps in corners, things on everything.

Each kind of room has its own list of pieces; what does not fit is left out. Pieces come from `pieces`, or
from a folder of models where one is given.
"""

from __future__ import annotations

import re

import numpy as np

from geomoe3d.data.rooms import seats, storage
from geomoe3d.data.rooms.clutter import litter, put_things
from geomoe3d.data.rooms.models import ModelLibrary
from geomoe3d.data.rooms.pieces import Maker, Piece
from geomoe3d.data.rooms.shell import SIDES, Rect, Room, overlaps
from geomoe3d.data.rooms.solids import Solids, between, pose_on_floor
from geomoe3d.types import FloatArray

MAKERS: dict[str, Maker] = {
    "bathtub": storage.bathtub,
    "bed": seats.bed,
    "bookshelf": storage.bookshelf,
    "boxes": storage.boxes,
    "chair": seats.chair,
    "chest": storage.chest,
    "coffee table": seats.coffee_table,
    "counter": storage.counter,
    "desk": seats.desk,
    "fridge": storage.fridge,
    "lamp": storage.lamp,
    "office chair": seats.office_chair,
    "picture": storage.picture,
    "plant": storage.plant,
    "radiator": storage.radiator,
    "sofa": seats.sofa,
    "table": seats.table,
    "toilet": storage.toilet,
    "wall shelf": storage.wall_shelf,
    "wardrobe": storage.wardrobe,
    "washbasin": storage.washbasin,
}

# Piece, least and most of it. Earlier ones get the better places.
_PROGRAMS = {
    "living": (
        "sofa 1-3, bookshelf 0-3, chest 1-3, table 0-2, lamp 0-2, plant 0-3, wall shelf 0-2, picture 1-6, "
        "boxes 0-2"
    ),
    "bedroom": (
        "bed 1-2, wardrobe 1-2, chest 1-3, desk 0-1, chair 0-2, lamp 0-1, picture 0-4, wall shelf 0-2, "
        "boxes 0-3"
    ),
    "kitchen": "counter 1-3, fridge 1-2, table 1-1, wall shelf 0-2, chest 0-1, picture 0-3, boxes 0-2",
    "office": (
        "desk 2-5, bookshelf 1-4, chest 0-3, table 0-1, wardrobe 0-2, wall shelf 0-3, picture 0-4, "
        "plant 0-2, boxes 0-4"
    ),
    "bathroom": "bathtub 0-1, toilet 1-1, washbasin 1-2, chest 0-2, picture 0-1, boxes 0-2",
    "meeting": "table 1-3, chair 2-6, bookshelf 0-2, picture 1-3, plant 0-2",
    "store": "bookshelf 2-5, boxes 3-9, table 0-2, wardrobe 0-2, chest 0-2",
}
PROGRAMS: dict[str, list[tuple[str, int, int]]] = {
    kind: [
        (name, int(least), int(most))
        for name, least, most in re.findall(r"([a-z ]+) (\d+)-(\d+)", text.replace(", ", ","))
    ]
    for kind, text in _PROGRAMS.items()
}
"""Kind of room -> pieces, least and most of each."""


def furnish(
    rng: np.random.Generator, solids: Solids, room: Room, library: ModelLibrary | None, density: float
) -> str:
    """Fill a room; gives the kind of room that it has become.

    Args:
        rng: decides everything.
        solids: of the scene, in the frame of the room's rectangle.
        room: its free floor shrinks.
        library: models to be mixed in, or None.
        density: small things per square metre of table or shelf.
    """
    area = (room.rect[2] - room.rect[0]) * (room.rect[3] - room.rect[1])
    kinds = [kind for kind in PROGRAMS if kind != "bathroom" or area < 14]
    often = {"living": 4, "bedroom": 3, "kitchen": 4, "office": 5, "bathroom": 1, "meeting": 2, "store": 1}
    weights = np.array([often[kind] for kind in kinds], dtype=np.float64)
    kind = str(rng.choice(kinds, p=weights / weights.sum()))
    decorator = _Decorator(rng, solids, room, library, density)
    for _ in range(max(1, round(area / 18))):
        for name, least, most in PROGRAMS[kind]:
            for _ in range(int(rng.integers(least, most + 1))):
                decorator.put(name)
    low, high = np.array(room.rect[:2]), np.array(room.rect[2:])
    litter(solids, rng, low, high, int(rng.poisson(0.4 * area)))
    return kind


class _Decorator:
    def __init__(
        self,
        rng: np.random.Generator,
        solids: Solids,
        room: Room,
        library: ModelLibrary | None,
        density: float,
    ) -> None:
        self.rng, self.solids, self.room, self.library, self.density = rng, solids, room, library, density

    def put(self, name: str) -> None:
        """Place one piece of a kind with what belongs to it."""
        piece = self.make(name)
        free = name in ("table", "plant", "chair") and self.rng.random() < 0.6
        T = self._in_the_room(piece) if free else self._at_a_wall(piece)
        if T is None:
            return
        if name == "table":
            self._chairs_around(piece, T)
        elif name == "desk":
            self._before(piece, T, "office chair" if self.rng.random() < 0.7 else "chair", 0.05, turned=180)
        elif name == "sofa" and self.rng.random() < 0.6:
            self._before(piece, T, "coffee table", 0.35, turned=0)
        elif name == "bed":
            self._beside(piece, T)

    def make(self, name: str) -> Piece:
        """A piece from the models, where there are any of that kind, or a primitive one."""
        if self.library is not None and self.rng.random() < 0.6:
            model = self.library.draw(name, self.rng)
            if model is not None:
                return model
        return MAKERS[name](self.rng)

    def _at_a_wall(self, piece: Piece) -> FloatArray | None:
        room, rng = self.room, self.rng
        for _ in range(12):
            side = str(rng.choice(SIDES))
            low, high = room.wall(side)
            if high - low < piece.width + 0.02:
                continue
            at = between(rng, low + piece.width / 2, high - piece.width / 2)
            gap = 0.0 if piece.hangs else between(rng, 0.0, 0.06)
            if piece.height > 0.9 and not piece.hangs and self._covers_window(side, at, piece):
                continue
            if piece.hangs and self._covers_window(side, at, piece):
                continue
            x, y = room.place(side, at, gap)
            angle = {"south": 0.0, "north": 180.0, "west": -90.0, "east": 90.0}[side]
            T = self._try(piece, x, y, angle + float(rng.normal(0, 1.0)) * (not piece.hangs))
            if T is not None:
                return T
        return None

    def _covers_window(self, side: str, at: float, piece: Piece) -> bool:
        half = piece.width / 2
        return any(o.start < at + half and at - half < o.end for o in self.room.openings[side])

    def _in_the_room(self, piece: Piece) -> FloatArray | None:
        x0, y0, x1, y1 = self.room.rect
        for _ in range(12):
            x, y = between(self.rng, x0 + 0.4, x1 - 0.4), between(self.rng, y0 + 0.4, y1 - 0.4)
            angle = float(self.rng.choice([0.0, 90.0, 180.0, 270.0]) + self.rng.normal(0, 8))
            T = self._try(piece, x, y, angle)
            if T is not None:
                return T
        return None

    def _try(self, piece: Piece, x: float, y: float, angle: float) -> FloatArray | None:
        """Put a piece there if the floor is free."""
        T = pose_on_floor(x, y, angle)
        rect = _footprint(piece, T)
        x0, y0, x1, y1 = self.room.rect
        if rect[0] < x0 - 0.03 or rect[1] < y0 - 0.03 or rect[2] > x1 + 0.03 or rect[3] > y1 + 0.03:
            return None
        if self.room.low_side is not None and piece.height > self.room.low_height and not piece.hangs:
            return None
        if not piece.hangs:
            if any(overlaps(rect, other) for other in self.room.taken):
                return None
            self.room.taken.append(rect)
        self.solids.place(piece.solids, T)
        put_things(self.solids, self.rng, piece, T, self.density)
        return T

    def _chairs_around(self, piece: Piece, T: FloatArray) -> None:
        same = self.make("chair")
        for k in range(int(self.rng.integers(0, 7))):
            # Seats of one table are often alike: the repeated structure that misleads a matcher.
            seat = same if self.rng.random() < 0.8 else self.make("chair")
            side, share = (1 if k % 2 else -1), between(self.rng, -0.4, 0.4)
            tucked = between(self.rng, -0.25, 0.15)
            local = pose_on_floor(
                share * piece.width,
                piece.depth / 2 + side * (piece.depth / 2 + seat.depth + tucked),
                (180.0 if side > 0 else 0.0) + float(self.rng.normal(0, 20)),
            )
            self._force(seat, T @ local, allowed=_footprint(piece, T))

    def _before(self, piece: Piece, T: FloatArray, name: str, gap: float, turned: float) -> None:
        other = self.make(name)
        reach = piece.depth + gap + (other.depth if turned else 0.0) * between(self.rng, 0.4, 1.1)
        angle = turned + float(self.rng.normal(0, 25 if turned else 4))
        x = between(self.rng, -0.2, 0.2) * piece.width
        self._force(other, T @ pose_on_floor(x, reach, angle), allowed=_footprint(piece, T))

    def _beside(self, piece: Piece, T: FloatArray) -> None:
        for side in (-1, 1):
            other = self.make("chest")
            if other.width < 0.7:
                at = side * (piece.width / 2 + other.width / 2 + 0.05)
                self._force(other, T @ pose_on_floor(at, 0.0, 0.0), allowed=_footprint(piece, T))

    def _force(self, piece: Piece, T: FloatArray, allowed: Rect) -> None:
        """Put a piece there if it stays in the room and meets nothing but the one that it belongs to."""
        rect = _footprint(piece, T)
        x0, y0, x1, y1 = self.room.rect
        if rect[0] < x0 or rect[1] < y0 or rect[2] > x1 or rect[3] > y1:
            return
        if any(overlaps(rect, other) for other in self.room.taken if other != allowed):
            return
        self.room.taken.append(rect)
        self.solids.place(piece.solids, T)
        put_things(self.solids, self.rng, piece, T, self.density * 0.3)


def _footprint(piece: Piece, T: FloatArray) -> Rect:
    half = piece.width / 2
    corners = np.array([[-half, 0], [half, 0], [half, piece.depth], [-half, piece.depth]])
    moved = corners @ T[:2, :2].T + T[:2, 3]
    low, high = moved.min(axis=0), moved.max(axis=0)
    return float(low[0]), float(low[1]), float(high[0]), float(high[1])
