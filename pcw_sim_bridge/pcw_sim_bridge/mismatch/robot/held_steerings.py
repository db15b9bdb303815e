"""Steerings that stick: while one stands, dry friction holds whatever is applied to it, up to its size.

A simulation's friction, smoothed over a small speed, creeps instead, and at no speed is none. What a stuck steering holds
would pass for something else that depends on where it stands, and its friction for less than it is. How large the friction is
the samples tell in which steerings turn; those in which one that sticks stands tell nothing, and are not judged. Where
hardly any others are left, as of a robot that drives straight on, they tell as much as a torque that is wrong by up to that
friction lets them.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from pcw_description.effects.registry import get
from pcw_description.robot_description import AXIS_NAMES, STEER, RobotDescription

from ..regression.noise_model import channel_deviations
from ..regression.regression_problem import BoolArray, FloatArray, Nuisance
from .channel_differences import ChannelDifferences
from .lost_torques import DRY_SPEED, FORCES, by_joint

# Part of the judged samples that a steering has to stand in to be looked at, and that has to be left to do without those.
LEAST_PART, LEFT_PART = 0.05, 0.25
LEAST_TURNING = 30  # samples that tell how large a friction is
RUBS = 6.0  # standard errors from which on a steering rubs
# Times what is left in rms where steerings turn, from which on it is left by one that stands.
LEFT_BEHIND = 2.0
AT_MOST = 1.5  # times what the friction does where steerings turn, up to which it may do where they stand


@dataclasses.dataclass(frozen=True)
class HeldSteerings:
    """Which steerings stick.

    Attributes:
        sticks: whether each does (n,).
        friction: of those that stick, by the samples in which they turn (n,) [N m].
        dispensable: whether enough is left without the samples in which they stand.
    """

    sticks: BoolArray
    friction: FloatArray
    dispensable: bool


def held_steerings(
    robot: RobotDescription,
    differences: ChannelDifferences,
    valid: BoolArray,
    standing: BoolArray,
    instruments: Sequence[Nuisance],
) -> HeldSteerings:
    """Return which steerings rub and hold, while they stand, what no smoothed friction does.

    Args:
        robot: the nominal robot, some of whose steerings may be described to rub.
        differences: the channels of the motions under the description.
        valid: samples (T, C) that can be judged.
        standing: those in which each steering stands (T, n).
        instruments: numbers of the description that are masses.
    """
    usable: BoolArray = valid[:, FORCES].min(axis=1)
    n = standing.shape[1]
    nothing = HeldSteerings(np.zeros(n, dtype=bool), np.zeros(n), True)
    turning = usable & ~standing.any(axis=1)
    if turning.sum() < LEAST_TURNING:
        return nothing
    looked_at = standing[usable].mean(axis=0) > LEAST_PART
    if not looked_at.any():
        return nothing
    shapes = []
    for motion in differences.motions:
        shape = np.zeros((len(motion.time), 2 * n, 1))
        shape[:, STEER::2, 0] = -np.tanh(motion.velocity[:, :, STEER] / DRY_SPEED)
        shapes.append(by_joint(shape))
    friction = differences.of_torque(shapes)[:, FORCES, STEER::2]
    columns = np.concatenate([friction, *(number.column[:, FORCES, None] for number in instruments)], axis=2)
    residual = differences.residual[:, FORCES]
    deviation = channel_deviations(residual, np.repeat(turning[:, None], residual.shape[1], axis=1))
    columns /= deviation[:, None]
    residual = residual / deviation
    left, sizes, errors = _fitted(columns, residual, turning)
    described = _described(robot)
    rubs = looked_at & ((described > 0.0) | (sizes[:n] > RUBS * errors[:n]))
    held = usable & standing[:, rubs].any(axis=1)
    if not held.any():
        return nothing
    usual, there = (float(np.mean(left[rows] ** 2)) for rows in (turning, held))
    # A friction holds no more than its size: what is left of more than that is something else. Nor does what frictions do to
    # the robot cancel out, as that of steerings does which swing together.
    found, whole = (np.where(rubs, more + sizes[:n], 0.0) for more in (0.0, described))
    seen, most = (float(np.mean((columns[turning, :, :n] @ of) ** 2)) for of in (found, whole))
    cancels = seen > AT_MOST**2 * float(np.mean(residual[turning] ** 2))
    if cancels or not LEFT_BEHIND**2 * usual < there < AT_MOST**2 * most:
        return nothing
    return HeldSteerings(rubs, np.maximum(whole, 0.0), bool((usable & ~held).sum() >= LEFT_PART * usable.sum()))


def _described(robot: RobotDescription) -> FloatArray:
    """Dry friction of the steerings in the description (n,) [N m]."""
    found = np.zeros(robot.n)
    for instance in robot.physics:
        axis = instance.axis or getattr(get(instance.name), "axis", None)
        if "coulomb" in instance.parameters and axis == AXIS_NAMES[STEER]:
            found[np.isin(robot.caster_names, instance.target)] += instance.parameters["coulomb"]
    return found


def _fitted(columns: FloatArray, residual: FloatArray, rows: BoolArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """What columns (T, C, K) leave of a residual (T, C), and their sizes and standard errors (K,) by some rows (T,) alone."""
    design, target = columns[rows].reshape(-1, columns.shape[2]), residual[rows].ravel()
    scale = np.maximum(np.linalg.norm(design, axis=0), 1e-300)
    inverse = np.linalg.pinv(design / scale, rcond=1e-6)
    sizes = inverse @ target / scale
    left: FloatArray = residual - columns @ sizes
    spread = float(np.sqrt(np.mean(left[rows] ** 2)))
    errors: FloatArray = spread * np.linalg.norm(inverse, axis=1) / scale
    return left, sizes, errors
