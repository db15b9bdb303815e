"""What the controller says of a test of the ground in /diagnostics."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pcw_description.nodes.diagnostics import OK, WARN, Status
from pcw_terrain.active_identification import Phase, Refusal

from ..ground_test import GroundTestState


def test_status(
    names: Sequence[str], state: GroundTestState, ended: str, predicted_path: float, disturbance: np.ndarray
) -> Status:
    """Return what goes on, or how it ended.

    Args:
        names: of the casters.
        state: of the test.
        ended: why it ended early; "" if it did not.
        predicted_path: by which the base was expected to leave its path [m].
        disturbance: way [m] and turn [rad] by which odometry has seen it do so (2,).
    """
    testing, ground = state.testing, state.ground
    values: dict[str, object] = {"phase": testing.phase.value, "predicted_path": float(predicted_path)}
    values |= {"measured_path": float(disturbance[0]), "measured_yaw": float(disturbance[1])}
    known = f"ground known under {int(ground.valid.sum())} of {len(names)} casters"
    if state.under_test >= 0:
        return Status(OK, f"{names[state.under_test]} is made to slip", values)
    if state.busy:
        said = "what the last test says is worked out" if state.replay is not None else "the next test begins"
        return Status(OK, said, values)
    if testing.phase is Phase.IDLE:
        return Status(OK, "no test was asked for", values)
    if ended:
        return Status(WARN, f"ended: {ended}; {known}", values)
    return Status(OK, f"done; {known}", values)


def caster_parts(names: Sequence[str], state: GroundTestState) -> dict[str, Status]:
    """Return a status per caster: its ground with 95 % intervals, or why it is not known."""
    ground, left_out = state.ground, dict(state.testing.refused)
    parts = {}
    for i, name in enumerate(names):
        if ground.valid[i]:
            low, high = ground.interval(i)
            values: dict[str, object] = {"mu_p": float(ground.mu_p[i]), "mu_p_low": float(low[0]), "mu_p_high": float(high[0])}
            values |= {"lambda_p": float(ground.lambda_p[i])}
            values |= {"lambda_p_low": float(low[1]), "lambda_p_high": float(high[1])}
            parts[name] = Status(
                OK,
                f"mu_p {ground.mu_p[i]:.3f} ({low[0]:.3f} to {high[0]:.3f}), lambda_p {ground.lambda_p[i]:.3f} "
                f"({low[1]:.3f} to {high[1]:.3f})",
                values,
            )
        elif ground.said[i]:
            parts[name] = Status(WARN, f"its test told nothing: {ground.said[i]}")
        elif left_out.get(i, Refusal.NONE) is not Refusal.NONE and i in state.testing.queue:
            parts[name] = Status(OK, f"waits until the others have told of the ground: {left_out[i].value}")
        elif left_out.get(i, Refusal.NONE) is not Refusal.NONE:
            parts[name] = Status(WARN, f"left out: {left_out[i].value}")
        elif i in state.testing.tested:
            parts[name] = Status(OK, "under test" if state.busy else "its test was ended before it told anything")
        else:
            parts[name] = Status(OK, "not tested yet" if state.busy else "not tested")
    return parts
