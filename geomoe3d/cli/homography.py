"""``geomoe3d homography``; see `geomoe3d.cli.pose`, with which it shares all but the last step."""

from __future__ import annotations

from geomoe3d.cli.pose import homography as command

__all__ = ["command"]
