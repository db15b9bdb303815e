"""What the terrain node says of every caster in /diagnostics."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pcw_description.nodes.diagnostics import OK, WARN, Status

from ..robot_terrain import RobotTerrainEstimate
from ..slip_slope import SlipSlopeEstimate
from ..terrain_classes import classify


def caster_status(
    names: Sequence[str], estimate: RobotTerrainEstimate, grip: SlipSlopeEstimate | None
) -> dict[str, Status]:
    """Return a status per caster: the kind of ground with its probability, or why nothing is known."""
    parts = {}
    for i, name in enumerate(names):
        values: dict[str, object] = {
            "slip": float(estimate.slip[i]),
            "friction": float(estimate.friction[i]),
            "changes": int(estimate.changes[i]),
        }
        if grip is not None:
            values["grip"] = float(grip.friction[i])
        if not estimate.valid[i]:
            wrong = "wrong sign" in estimate.reason[i] or "does not fit" in estimate.reason[i]
            parts[name] = Status(WARN if wrong else OK, estimate.reason[i], values)
            continue
        spread = np.sqrt(np.diag(estimate.covariance[i]))
        values |= {"mu_p": float(estimate.mu_p[i]), "mu_p_spread": float(spread[0])}
        values |= {"lambda_p": float(estimate.lambda_p[i]), "lambda_p_spread": float(spread[1])}
        classes = classify(float(estimate.mu_p[i]), float(estimate.lambda_p[i]), estimate.covariance[i])
        values |= {f"class {c.name}": c.probability for c in classes[:3]}
        parts[name] = Status(OK, f"{classes[0].name} ({classes[0].probability:.0%})", values)
    return parts
