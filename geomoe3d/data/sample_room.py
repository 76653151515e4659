"""The room of the sample pair: boxes and cylinders with a plain colour each.

4.4 by 3.8 metres with table, chairs, sofa, shelf, sideboard, lamp, plant and clutter. The furniture stands
fast; the clutter is drawn from a generator. No wall and no piece repeats another, so the room has no
symmetry. Milliseconds.
"""

from __future__ import annotations

import numpy as np

from geomoe3d.data.rooms.solids import Solids as Room
from geomoe3d.data.rooms.solids import Triple


def _draw(rng: np.random.Generator, low: float, high: float) -> Triple:
    a, b, c = rng.uniform(low, high, 3).tolist()
    return a, b, c


def furnished_room(rng: np.random.Generator) -> Room:
    """4.4 by 3.8 metres: the furniture stands fast, the clutter is drawn."""
    room = Room()
    wall, oak, dark = (0.87, 0.85, 0.80), (0.66, 0.47, 0.28), (0.30, 0.22, 0.17)
    room.box((0.0, 0.0, -0.1), (4.4, 3.8, 0.1), (0.55, 0.45, 0.36))
    room.box((0.0, -0.1, 0.0), (4.4, 0.1, 2.6), wall)
    room.box((0.0, 3.8, 0.0), (4.4, 0.1, 2.6), wall)
    room.box((-0.1, 0.0, 0.0), (0.1, 3.8, 2.6), wall)
    room.box((4.4, 0.0, 0.0), (0.1, 3.8, 2.6), (0.72, 0.80, 0.78))
    room.box((3.75, 3.3, 0.0), (0.65, 0.5, 2.6), wall)  # a chimney breast breaks the corner
    room.box((1.2, 3.72, 0.95), (1.0, 0.08, 1.1), (0.35, 0.45, 0.60))  # window frame
    room.box((1.15, 3.60, 0.88), (1.1, 0.20, 0.05), (0.95, 0.95, 0.95))  # its sill
    for i in range(9):  # radiator under the window
        room.box((1.25 + 0.095 * i, 3.66, 0.15), (0.06, 0.10, 0.6), (0.92, 0.92, 0.90))
    room.box((2.55, 3.76, 1.35), (0.55, 0.04, 0.40), (0.75, 0.30, 0.25))  # picture
    room.box((4.33, 0.9, 1.2), (0.07, 0.8, 0.5), (0.15, 0.15, 0.18))  # screen on the wall
    _shelf(room, rng)
    _table_and_chairs(room, oak, dark)
    _sofa(room)
    room.box((3.95, 0.55, 0.0), (0.45, 1.5, 0.55), (0.93, 0.91, 0.86))  # sideboard under the screen
    room.box((3.92, 0.60, 0.08), (0.03, 0.66, 0.40), (0.80, 0.78, 0.72))
    room.box((3.92, 1.33, 0.08), (0.03, 0.66, 0.40), (0.80, 0.78, 0.72))
    room.cylinder((3.35, 3.45, 0.0), 0.16, 0.03, dark)  # floor lamp
    room.cylinder((3.35, 3.45, 0.03), 0.02, 1.35, dark)
    room.cylinder((3.35, 3.45, 1.35), 0.24, 0.30, (0.95, 0.90, 0.70), top_radius=0.13)
    room.cylinder((0.32, 3.45, 0.0), 0.15, 0.32, (0.70, 0.38, 0.25), top_radius=0.20)  # plant
    for _ in range(14):
        lean = rng.uniform(-0.22, 0.22, 2)
        height = rng.uniform(0.25, 0.6)
        foot = (0.34 + 0.4 * lean[0], 3.43 + 0.4 * lean[1], 0.32)
        room.box(foot, (0.04, 0.16, height), (0.25, 0.50, 0.22), turn_deg=float(rng.uniform(0, 180)))
    for _ in range(7):  # toys and parcels on the floor, books and cups on the furniture
        x, y = rng.uniform(1.2, 3.4), rng.uniform(2.75, 3.35)
        size = _draw(rng, 0.08, 0.30)
        color = _draw(rng, 0.2, 0.9)
        room.box((x, y, 0.0), size, color, turn_deg=float(rng.uniform(0, 90)))
    for _ in range(5):
        x, y = rng.uniform(1.85, 2.85), rng.uniform(1.55, 2.15)
        size = _draw(rng, 0.06, 0.22)
        color = _draw(rng, 0.2, 0.9)
        room.box((x, y, 0.75), size, color, turn_deg=float(rng.uniform(0, 90)))
    for _ in range(4):
        y, height = rng.uniform(0.6, 1.9), rng.uniform(0.12, 0.4)
        color = _draw(rng, 0.2, 0.9)
        room.cylinder((4.15, y, 0.55), float(rng.uniform(0.04, 0.10)), height, color)
    return room


def _shelf(room: Room, rng: np.random.Generator) -> None:
    wood = (0.50, 0.36, 0.22)
    for x in (0.55, 1.05):
        room.box((x, 3.48, 0.0), (0.03, 0.32, 1.9), wood)
    for level in range(6):
        z = 0.05 + 0.36 * level
        room.box((0.55, 3.48, z), (0.53, 0.32, 0.03), wood)
        x = 0.60
        while level < 5 and x < 0.98:
            width, height = rng.uniform(0.02, 0.06), rng.uniform(0.15, 0.31)
            depth, color = rng.uniform(0.14, 0.26), _draw(rng, 0.15, 0.9)
            room.box((x, 3.78 - depth, z + 0.03), (width, depth, height), color)
            x += width + (0.0 if rng.uniform() < 0.8 else 0.1)


def _table_and_chairs(room: Room, oak: Triple, dark: Triple) -> None:
    turn, center = 14.0, (2.4, 1.9)
    room.box((1.8, 1.5, 0.71), (1.2, 0.8, 0.04), oak, turn, center)
    for x in (1.84, 2.90):
        for y in (1.54, 2.20):
            room.box((x, y, 0.0), (0.06, 0.06, 0.71), oak, turn, center)
    for x, y, angle in ((1.55, 2.35, 118.0), (3.05, 2.45, -62.0), (2.95, 1.15, 195.0)):
        about = (x, y)
        room.box((x - 0.21, y - 0.21, 0.43), (0.42, 0.42, 0.04), dark, angle, about)
        room.box((x - 0.21, y + 0.17, 0.47), (0.42, 0.04, 0.45), dark, angle, about)
        for leg_x in (-0.20, 0.16):
            for leg_y in (-0.20, 0.16):
                room.box((x + leg_x, y + leg_y, 0.0), (0.04, 0.04, 0.43), dark, angle, about)


def _sofa(room: Room) -> None:
    cloth, cushion = (0.28, 0.38, 0.52), (0.80, 0.62, 0.25)
    room.box((0.02, 1.25, 0.08), (0.82, 1.75, 0.34), cloth)
    room.box((0.02, 1.25, 0.42), (0.24, 1.75, 0.42), cloth)
    for y in (1.25, 2.80):
        room.box((0.02, y, 0.42), (0.82, 0.20, 0.20), cloth)
    room.box((0.27, 1.52, 0.42), (0.14, 0.42, 0.38), cushion, 12.0)
    room.box((0.30, 2.30, 0.42), (0.16, 0.40, 0.36), (0.65, 0.25, 0.30), -20.0)
