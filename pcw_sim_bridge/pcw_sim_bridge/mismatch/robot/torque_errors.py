"""Torques that fit the motion as it was measured: without what the balance of forces shows of the errors of both.

Weaker motors, less mass and less friction at once are the same balance of forces, times a number below one, and all its errors
are smaller by that number, be they of the torques or of the accelerations. That is worth more than the masses' tolerances, and
a payload passed for weak motors of a light robot. So what effects are functions of must not hold the errors that the residual
holds: then no factor makes them smaller. Of all torques that could have made a residual r the most likely are those of least
squares,

    e = J^T (J J^T)^-1 r,      r = J e,

J being what torques add to force and moment. From r goes first what holds no torque: masses and frictions. These are the
instruments of two-stage least squares, by which a number is found that is a factor of something measured. Lengths are none:
a lever multiplies the torque, and its errors with it. What depends on how a robot moves may be physics that is missing.
Reports of torques may be wrong in that way, commands are not, and there only what fluctuates faster is taken for an error.

Nor do levers multiply what fluctuates faster: of a robot that drives straight ahead the steerings report noise alone, and
casters that are longer by the half would make a third less of it. The wrench of those errors stays that of the description.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from scipy import interpolate, ndimage

from ..regression.noise_model import channel_deviations
from ..regression.regression_problem import BoolArray, FloatArray, Nuisance
from .channel_differences import ChannelDifferences
from .robot_motion import RobotMotion, TorqueError

FORCES = slice(0, 3)  # channels of the balance
INSTRUMENTS = ("chassis.", "module.", "wheel.inertia", "rotors.", "suspension.", "ground.")  # of those without torques
FRICTION_SPEED = 0.05  # [rad/s], at which dry friction reverses
RIDGE = 1e-6  # of what a number explains, so that numbers which are the same thing share it
SLOW = 0.4  # [s]; errors fluctuate faster than robots move, and than most of what depends on how they move
FLUCTUATES = 0.75  # of the part that is faster in white errors; of what holds less of it, missing physics is a part
LEAST_STAMPS = 2  # of a piece; between one and none there is nothing to interpolate
LEAST_ROWS = 60  # of the balance; fewer tell no errors from masses and frictions


def with_balanced_torques(
    read: Sequence[RobotMotion], differences: ChannelDifferences, valid: BoolArray, instruments: Sequence[Nuisance]
) -> list[RobotMotion]:
    """Return motions whose `balanced_torque` fits them, and whose errors are known.

    Args:
        read: the motions as they were read; differences: their channels under the description.
        valid: samples (T, C) that can be judged.
        instruments: those numbers of the description that are `INSTRUMENTS`.
    """
    usable: BoolArray = valid[:, FORCES].min(axis=1)
    if usable.sum() < LEAST_ROWS:
        return list(read)
    left = np.where(usable[:, None], _without_instruments(differences, usable, instruments), 0.0)
    maps = differences.wrench_of_torque()
    found, start = [], 0
    for motion, own, of_torque in zip(read, differences.filters, maps, strict=True):
        stamps, there = own.decimate(motion.time), own.decimate(of_torque)  # (T, 3, n, 2)
        if len(stamps) < LEAST_STAMPS:
            found.append(motion)
            start += len(stamps)
            continue
        here = slice(start, start + len(stamps))
        rows, start = left[here], start + len(stamps)
        fluctuating = rows * _fluctuates(rows, usable[here], own.decimated_rate)
        balance = rows if motion.reported.any() else fluctuating
        along, fast = (
            interpolate.CubicSpline(stamps, _least_torques(there, part))(np.clip(motion.time, stamps[0], stamps[-1]))
            for part in (balance, fluctuating)
        )
        error = motion.torque - motion.quiet_torque + fast
        wrench = np.einsum("tcnj,tnj->tc", of_torque, error)
        balanced = motion.quiet_torque - along
        found.append(dataclasses.replace(motion, balanced_torque=balanced, error=TorqueError(error, wrench)))
    return found


def _least_torques(of_torque: FloatArray, wrench: FloatArray) -> FloatArray:
    """The torques (T, n, 2) of least squares that add wrenches (T, 3), by what torques add to these (T, 3, n, 2)."""
    flat = of_torque.reshape(len(wrench), 3, -1)
    plain = flat @ flat.swapaxes(1, 2)
    plain += 1e-9 * np.trace(plain, axis1=1, axis2=2)[:, None, None] * np.eye(3)
    torques = flat.swapaxes(1, 2) @ np.linalg.solve(plain, wrench[:, :, None])
    return torques.reshape(len(wrench), *of_torque.shape[2:])


def _fluctuates(left: FloatArray, usable: BoolArray, rate: float) -> BoolArray:
    """Which channels of a balance (T, 3) at a rate [Hz] fluctuate as errors do, and not as what a robot's motion makes."""
    width = max(round(SLOW * rate), 3)
    here = usable[:, None].astype(float)
    mean = ndimage.uniform_filter1d(left * here, width, axis=0, mode="constant")
    mean /= np.maximum(ndimage.uniform_filter1d(here, width, axis=0, mode="constant"), 1.0 / width)
    fast, total = (np.sum((values * here) ** 2, axis=0) for values in (left - mean, left))
    found: BoolArray = fast > FLUCTUATES * (1.0 - 1.0 / width) * total
    return found


def _without_instruments(differences: ChannelDifferences, usable: BoolArray, instruments: Sequence[Nuisance]) -> FloatArray:
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
    known = [n.column[:, FORCES, None] for n in instruments]
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
