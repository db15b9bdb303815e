"""The friction by which a controller may share forces among the wheels, at every time, whatever is known of the ground.

Three things are known, in this order:

- where an estimate of the ground under a wheel is valid and nothing contradicts it, its mu_p and lambda_p;
- elsewhere what the wheel holds compared with the others (`slip_slope`), on the scale of those whose ground is known: a wheel
  that creeps like one on ice is taken to stand on ice, whatever the robot file says;
- before anything was felt at all, the ground of the robot file under every wheel. That shares forces evenly, as a controller
  does that never heard of friction; nobody is asked for more than the others because of a guess.

Sharing depends on ratios only. Who needs an upper bound of the force, as a slip-ratio controller does, finds in `known` which
wheels have one.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from pcw_description.robot_description import FloatArray, RobotDescription

from .robot_terrain import RobotTerrainEstimate
from .slip_slope import SlipSlopeEstimate
from .terrain_estimator import GREATEST_FRICTION, LEAST_FRICTION


@dataclasses.dataclass(frozen=True)
class SharedFriction:
    """What a controller is told.

    Attributes:
        mu_p, lambda_p: to be believed in, per caster (n,) [1]; never NaN.
        known: which of them are estimates that are vouched for (n,).
    """

    mu_p: FloatArray
    lambda_p: FloatArray
    known: np.ndarray


def shared_friction(
    robot: RobotDescription, ground: RobotTerrainEstimate | None, slopes: SlipSlopeEstimate | None
) -> SharedFriction:
    """Return what to believe; see the module's docstring.

    Args:
        robot: as its file says.
        ground: of the estimators of the casters; None: nothing is known.
        slopes: of the slip slopes; None: nothing was felt.
    """
    mu_p = np.array([tyre.mu_p for tyre in robot.tyres]) if slopes is None else slopes.friction.copy()
    lambda_p = np.array([tyre.lambda_p for tyre in robot.tyres])
    known = np.zeros(robot.n, dtype=bool)
    if ground is not None:
        known = ground.valid & ~ground.suspect
    if ground is not None and known.any():
        mu_p = mu_p * float(np.exp(np.median(np.log(ground.mu_p[known] / mu_p[known]))))
        mu_p, lambda_p = np.where(known, ground.mu_p, mu_p), np.where(known, ground.lambda_p, lambda_p)
    return SharedFriction(np.clip(mu_p, LEAST_FRICTION, GREATEST_FRICTION), lambda_p, known)
