"""Which slips say something of the ground, where they come from an observer that believes in a friction curve.

Such an observer takes the slip of a wheel that grips from its force, by the lower root of the curve it believes in. To
estimate the ground from that slip would give back the belief. The slip of a wheel that has let go is another matter: it
follows from the motion of the robot, which the other wheels and the forces know. A slip counts as known if the force is so
near its believed peak, or the slip so far beyond the believed root, that the root was not trusted.
"""

from __future__ import annotations

import numpy as np

from pcw_description.contact.contact_model import slip_of_force, tyre_parameters
from pcw_description.robot_description import FloatArray, RobotDescription

# Use of friction from which observers of pcw_estimation do not trust the root, and how far a slip must be off it [1].
TRUSTED_USE, ROOT_TOLERANCE = 0.85, 0.5
LEAST_SPEED = 0.05


def independent_slip(
    robot: RobotDescription, sensed: FloatArray, slip: FloatArray, force: FloatArray, normal_force: FloatArray
) -> np.ndarray:
    """Return for which casters the slip does not follow from their own force by the curve of the robot file (n,).

    Args:
        robot: as the observer believes it.
        sensed: B q_dot (n, 2) [m/s].
        slip: slip velocities (n, 2) [m/s].
        force: of the ground on the wheels (n, 2) [N].
        normal_force: (n,) [N].
    """
    known = np.zeros(robot.n, dtype=bool)
    for i, tyre in enumerate(robot.tyres):
        if normal_force[i] <= 0.0:
            continue
        numbers = tyre_parameters(tyre)
        use = np.hypot(force[i, 0] / tyre.mu_p, force[i, 1] / tyre.lateral.mu_p) / normal_force[i]
        root = np.hypot(*slip_of_force(numbers, force[i, 0], force[i, 1], normal_force[i]))
        speed = max(abs(sensed[i, 0]), abs(sensed[i, 0] - slip[i, 0]), LEAST_SPEED)
        size = np.hypot(slip[i, 0], slip[i, 1]) / speed
        known[i] = use >= TRUSTED_USE or size > (1.0 + ROOT_TOLERANCE) * root + ROOT_TOLERANCE * tyre.lambda_p
    return known
