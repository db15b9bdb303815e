"""What the balance of forces shows of the errors that reported torques have.

Whoever multiplies all torques by a number below one makes their errors smaller, too, and the masses that go with them weigh
hardly more than that is worth. So what effects are functions of must not hold the errors that the residual holds. Of all
torques that could have made a residual r the most likely are those of least squares,

    e = J^T (J J^T)^-1 r,      r = J e,

J being what torques add to force and moment. From r goes first what holds no torque: masses and frictions. These are the
instruments of two-stage least squares, by which a number is found that is a factor of something measured. Lengths are none:
a lever multiplies the torque, and its errors with it.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from scipy import interpolate

from .channel_differences import ChannelDifferences
from .noise_model import channel_deviations
from .regression_problem import BoolArray, FloatArray, Nuisance
from .robot_motion import RobotMotion

FORCES = slice(0, 3)  # channels of the balance
INSTRUMENTS = ("chassis.", "module.", "wheel.inertia", "rotors.", "suspension.", "ground.")  # numbers that hold no torque
FRICTION_SPEED = 0.05  # [rad/s], at which dry friction reverses
RIDGE = 1e-6  # of what a number explains, so that numbers which are the same thing share it
LEAST_ROWS = 200  # of the balance; fewer tell no errors from masses and frictions


def with_balanced_torques(
    read: Sequence[RobotMotion], differences: ChannelDifferences, valid: BoolArray, nuisances: Sequence[Nuisance]
) -> list[RobotMotion]:
    """Return motions with the errors of reported torques taken out of their `balanced_torque`.

    Args:
        read: the motions as they were read; differences: their channels under the description.
        valid: samples (T, C) that can be judged.
        nuisances: numbers of the description.
    """
    usable: BoolArray = valid[:, FORCES].min(axis=1)
    if not any(motion.reported.any() for motion in read) or usable.sum() < LEAST_ROWS:
        return list(read)
    left = np.where(usable[:, None], _without_instruments(differences, usable, nuisances), 0.0)
    maps = differences.wrench_of_torque()
    found, start = [], 0
    for motion, own, of_torque in zip(read, differences.filters, maps, strict=True):
        stamps, there = own.decimate(motion.time), own.decimate(of_torque)  # (T, 3, n, 2)
        rows = left[start : start + len(stamps)]
        start += len(stamps)
        there = (there * motion.reported).reshape(len(stamps), 3, -1)
        plain = there @ there.swapaxes(1, 2)
        plain += 1e-9 * np.trace(plain, axis1=1, axis2=2)[:, None, None] * np.eye(3)
        errors = there.swapaxes(1, 2) @ np.linalg.solve(plain, rows[:, :, None])
        along = interpolate.CubicSpline(stamps, errors[:, :, 0])(np.clip(motion.time, stamps[0], stamps[-1]))
        found.append(dataclasses.replace(motion, balanced_torque=motion.quiet_torque - along.reshape(motion.torque.shape)))
    return found


def _without_instruments(differences: ChannelDifferences, usable: BoolArray, nuisances: Sequence[Nuisance]) -> FloatArray:
    """What masses and frictions leave of the balance (T, 3), however far they have to go for it."""
    torques = []
    for motion in differences.motions:
        size = motion.torque[0].size
        columns = np.zeros((len(motion.time), size, 3 * size))
        speed = motion.velocity.reshape(-1, size)
        for joint, values in enumerate(speed.T):
            columns[:, joint, 3 * joint : 3 * joint + 3] = np.stack(
                [np.ones_like(values), values, np.tanh(values / FRICTION_SPEED)], axis=1
            )
        torques.append(columns.reshape(*motion.torque.shape, -1))
    known = [n.column[:, FORCES, None] for n in nuisances if n.name.startswith(INSTRUMENTS)]
    columns = np.concatenate([*known, differences.of_torque(torques)[:, FORCES]], axis=2)
    # The residual holds the torque as it was reported; its errors are sought beyond those that are out of the quiet one.
    known_errors = [(motion.torque - motion.quiet_torque)[..., None] for motion in differences.motions]
    residual = differences.residual[:, FORCES] + differences.of_torque(known_errors)[:, FORCES, 0]
    deviation = channel_deviations(residual, np.repeat(usable[:, None], residual.shape[1], axis=1))
    design = (columns / deviation[:, None])[usable].reshape(-1, columns.shape[2])
    target = (residual / deviation)[usable].ravel()
    gram = design.T @ design
    gram[np.diag_indices_from(gram)] = (1.0 + RIDGE) * np.diag(gram) + 1e-300
    left: FloatArray = residual - columns @ np.linalg.solve(gram, design.T @ target)
    return left
