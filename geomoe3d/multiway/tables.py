"""A model as two tables for spreadsheets and scripts: its scans, and the pairs that were registered."""

from __future__ import annotations

from typing import TYPE_CHECKING

from geomoe3d.runtime.csv_text import csv_text

if TYPE_CHECKING:
    from geomoe3d.multiway.model import SceneModel

SCANS_FILE, EDGES_FILE = "scans.csv", "edges.csv"
_SCANS = ("scan", "group", "x", "y", "z", "edges_kept", "largest_shift", "reason", "path")
_EDGES = (
    "source", "target", "fate", "confidence", "belief", "shift", "turn_deg", "closes_loop", "local_maps",
    "reason",
)  # fmt: skip
SCANS_HEADER, EDGES_HEADER = ",".join(_SCANS), ",".join(_EDGES)


def scans_text(model: SceneModel) -> str:
    """One row per scan: its group and place there, how many edges hold it, or why it is in none."""
    home = {name: (k, T) for k, group in enumerate(model.groups, 1) for name, T in group.poses.items()}
    rows = []
    for scan in model.scans:
        mine = [e for e in model.edges if e.kept and scan.name in (e.source, e.target)]
        shifts = [e.shift for e in mine if e.shift is not None]
        number, T = home.get(scan.name, ("", None))
        place = ["", "", ""] if T is None else [f"{value:.17g}" for value in T[:3, 3]]
        worst = f"{max(shifts):.4g}" if shifts else ""
        loose = "" if mine else "held loosely: no single pair is kept"
        same = f"the same file as '{model.copies[scan.name]}'" if scan.name in model.copies else loose
        reason = model.unplaced.get(scan.name, model.doubted.get(scan.name, same))
        rows.append([scan.name, number, *place, len(mine), worst, reason, scan.path])
    return csv_text(_SCANS, rows)


def edges_text(model: SceneModel) -> str:
    """One row per pair with a motion: what became of it and why, and how far it is from the final poses."""
    rows = [
        [
            edge.source, edge.target, edge.fate, f"{edge.confidence:.4f}", f"{edge.belief:.4f}",
            "" if edge.shift is None else f"{edge.shift:.4g}",
            "" if edge.turn_deg is None else f"{edge.turn_deg:.3g}",
            "yes" if edge.closes_loop else "no", "yes" if edge.of_maps else "no", edge.reason,
        ]
        for edge in model.edges
    ]  # fmt: skip
    return csv_text(_EDGES, rows)
