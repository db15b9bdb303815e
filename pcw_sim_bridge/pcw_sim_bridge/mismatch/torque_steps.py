"""Torques that were reported in steps as large as themselves: of what a drive was asked for they hold next to nothing."""

from __future__ import annotations

import numpy as np

from pcw_description.recording import Recording
from pcw_description.robot_description import AXIS_NAMES, RobotDescription

from .regression_problem import FloatArray

# Steps that a torque has to reach. Of fewer most of it is zero, as if the drive gave next to nothing, or always the same.
LEAST_STEPS = 4


def coarse_step(torque: FloatArray) -> float:
    """Return the step [N m] in which a torque (T,) was reported that never reached `LEAST_STEPS` of it; 0 where it did."""
    levels = np.unique(np.abs(torque[np.isfinite(torque)]))
    if len(levels) < 2:
        return 0.0
    step = float(np.min(np.diff(levels)))
    return step if levels[-1] < (LEAST_STEPS - 0.5) * step else 0.0


def coarse_reports(robot: RobotDescription, recording: Recording) -> list[str]:
    """Return a sentence on the joints whose torques were reported so, none where there are none."""
    effort = recording.joint_states.effort
    if effort is None:
        return []
    steps = {
        f"{caster}_{name}": step
        for i, caster in enumerate(robot.caster_names)
        for axis, name in enumerate(AXIS_NAMES)
        if (step := coarse_step(effort[:, i, axis])) > 0.0
    }
    if not steps:
        return []
    return [
        f"joint_states: the effort of {', '.join(steps)} comes in steps of {max(steps.values()):.2g} N m and never reached "
        f"{LEAST_STEPS} of them: what happens between commands and torques is not looked for there"
    ]
