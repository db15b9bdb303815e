"""Steerings that stick: while one stands, dry friction holds whatever is applied to it, up to its size.

A simulation's friction, smoothed over a small speed, creeps instead, and at no speed is none. What a stuck steering holds
would pass for something else that depends on where it stands, and its friction for less than it is. How large the friction is
the samples tell in which steerings turn; those in which one that sticks stands tell nothing, and are not judged.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pcw_description.robot_description import STEER

from .channel_differences import ChannelDifferences
from .lost_torques import DRY_SPEED, FORCES, by_joint
from .noise_model import channel_deviations
from .regression_problem import BoolArray, FloatArray, Nuisance

# Part of the judged samples that a steering has to stand in to be looked at, and that has to be left without those.
LEAST_PART, LEFT_PART = 0.05, 0.25
LEAST_TURNING = 30  # samples that tell how large a friction is
RUBS = 6.0  # standard errors from which on a steering rubs
# Times what is left in rms where steerings turn, from which on it is left by one that stands.
LEFT_BEHIND = 2.0


def held_steerings(
    differences: ChannelDifferences, valid: BoolArray, standing: BoolArray, instruments: Sequence[Nuisance]
) -> BoolArray:
    """Return which steerings (n,) rub and hold, while they stand, what no smoothed friction does.

    Args:
        differences: the channels of the motions under the description.
        valid: samples (T, C) that can be judged.
        standing: those in which each steering stands (T, n).
        instruments: numbers of the description that are masses.
    """
    usable: BoolArray = valid[:, FORCES].min(axis=1)
    nothing = np.zeros(standing.shape[1], dtype=bool)
    turning = usable & ~standing.any(axis=1)
    looked_at = standing[usable].mean(axis=0) > LEAST_PART
    if turning.sum() < LEAST_TURNING or not looked_at.any():
        return nothing
    shapes = []
    for motion in differences.motions:
        shape = np.zeros((len(motion.time), 2 * len(nothing), 1))
        shape[:, STEER::2, 0] = -np.tanh(motion.velocity[:, :, STEER] / DRY_SPEED)
        shapes.append(by_joint(shape))
    friction = differences.of_torque(shapes)[:, FORCES, STEER::2]
    columns = np.concatenate([friction, *(number.column[:, FORCES, None] for number in instruments)], axis=2)
    residual = differences.residual[:, FORCES]
    deviation = channel_deviations(residual, np.repeat(turning[:, None], residual.shape[1], axis=1))
    left, sizes, errors = _fitted(columns / deviation[:, None], residual / deviation, turning)
    rubs = looked_at & (sizes[: len(nothing)] > RUBS * errors[: len(nothing)])
    held = usable & standing[:, rubs].any(axis=1)
    if not held.any() or (usable & ~held).sum() < LEFT_PART * usable.sum():
        return nothing
    usual, there = (float(np.mean(left[rows] ** 2)) for rows in (turning, held))
    return rubs if there > LEFT_BEHIND**2 * usual else nothing


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
