"""Motion too small for the encoders: what a joint that rests on one count does within it, nobody has measured.

A count that is crossed often errs like white noise, and a channel's filter leaves little of that. A joint that turns by less
than a count within the time of that filter errs by as much as it moves: its angle is reported to stand still. Steerings of a
robot that drives straight do so, and what torques move them by seems, on tyres as they are described, not to happen.
"""

from __future__ import annotations

import math

import numpy as np

from pcw_description.robot_description import RobotDescription

from ..regression.regression_problem import FloatArray

ROUNDING = 1e-9  # [rad]; angles that differ by less are the same
RESTING = 0.05  # of the samples in which a joint that encoders resolve reports its last angle again


def resolution(robot: RobotDescription, position: FloatArray) -> FloatArray:
    """Return the steps (n, 2) [rad] in which angles (T, n, 2) were reported; 0 where they hardly ever stay the same.

    Of a joint that never left its angle the step is that of the others of its kind, and where none did the described one.
    """
    sensor, gears = robot.sensors.encoders, np.abs(robot.gear_matrix)
    described = math.tau / np.array([sensor.drive_counts, sensor.steer_counts]) / gears[:, [0, 1], [0, 1]]
    steps = np.full(position.shape[1:], np.nan)
    for joint in np.ndindex(steps.shape):
        change = np.abs(np.diff(position[(slice(None), *joint)]))
        change = change[np.isfinite(change)]
        moved = change > ROUNDING
        if moved.any():
            steps[joint] = float(np.min(change[moved])) if np.mean(~moved) > RESTING else 0.0
    for axis in range(2):
        unknown = np.isnan(steps[:, axis])
        known = steps[~unknown, axis]
        steps[unknown, axis] = np.max(known) if len(known) and np.max(known) > 0.0 else described[unknown, axis]
    return steps


def unresolved_rate(velocity: FloatArray, resolution: FloatArray, cutoff: float) -> FloatArray:
    """Return by how much encoders miss the rates of joints (T, n, 2) [rad/s], a standard deviation.

    A count has a variance of step^2 / 12. Of a joint at rest all of it may be within the channels' filter, of which the
    derivative is left; the faster counts are crossed, the less of it is.

    Args:
        velocity: of the joints (T, n, 2) [rad/s].
        resolution: of their encoders (n, 2) [rad].
        cutoff: of the channels' filter [Hz].
    """
    crossed = np.abs(velocity) / np.maximum(resolution, 1e-300)
    at_rest = resolution / math.sqrt(12.0) * math.tau * cutoff / math.sqrt(3.0)
    missed: FloatArray = at_rest * cutoff / np.maximum(crossed, cutoff)
    return missed
