"""Numbers that the command line names too, apart from what computes, so that its help comes quickly."""

from __future__ import annotations

ALL_PAIRS_UP_TO = 30
"""Scans of which all pairs are registered; of more, those that look alike."""
NEIGHBORS = 6
"""Pairs proposed per scan; twice as many in every further round, for scans that are still apart."""
MOST_ROUNDS = 3
"""Rounds of further pairs, for scans and groups that are still apart."""
