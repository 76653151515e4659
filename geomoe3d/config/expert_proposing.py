"""Constants of matching and proposing."""

from __future__ import annotations

from geomoe3d.config.section import Section, constant


class CorrespondencesExpert(Section):
    """Correspondences without clouds (`correspondence_registration.py`)."""

    most_looked_at: int = constant(6, "hypotheses", (1, 100), "that a network looks at")
    first_looked_at: int = constant(
        2, "hypotheses", (1, 100), "that it looks at before it is asked whether it has seen enough"
    )
    convinced: float = constant(
        3.0, "logit", (-100, 100), "verdict from which on no further hypotheses are looked at"
    )
    most_rows: int = constant(
        1000,
        "correspondences",
        (3, 1_000_000),
        "that a hypothesis is scored on; mutual ones first where there are more",
    )
