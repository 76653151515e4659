"""Scores as strict JSON, for programs."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict

from geomoe3d.evaluation.compare import Comparison
from geomoe3d.evaluation.records import RunScore
from geomoe3d.evaluation.report_words import finite

FORMAT = "geomoe3d evaluation 1"


def to_json(scores: Sequence[RunScore], comparisons: Sequence[Comparison] = ()) -> str:
    """Everything as strict JSON with keys as in the records; numbers that are not finite become null."""
    document = {
        "format": FORMAT,
        "runs": [finite(asdict(run)) for run in scores],
        "comparisons": [finite(asdict(comparison)) for comparison in comparisons],
    }
    return json.dumps(document, indent=1, allow_nan=False) + "\n"
