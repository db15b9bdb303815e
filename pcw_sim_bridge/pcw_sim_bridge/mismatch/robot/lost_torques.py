"""Torques that joints lose before these reach the ground, where tyres would use up their friction if they did not.

A steering of a short offset that rubs takes a torque which, were it the ground's, would be more than tyres can hold: how much
they slip would be open, hardly a sample be judged, and the rest by slips from the peak of a curve. The balance of forces
needs no tyres. What every joint loses by rubbing, and a wheel by turning over the ground, it tells well enough to say where
on their curves tyres are, and which samples hang on when a dry friction reverses. What it is called, and how much it is,
the search finds.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np

from pcw_description.robot_description import STEER

from ..regression.noise_model import channel_deviations
from ..regression.regression_problem import BoolArray, FloatArray, Nuisance
from .channel_differences import ChannelDifferences
from .robot_motion import LostTorque, RobotMotion
from .rolling_model import ModelNumbers, twists

FORCES = slice(0, 3)  # channels of the balance
DRY_SPEED = 0.05  # [rad/s], at which dry friction reverses
RIDGE = 1e-6  # of what a number explains, so that numbers which are the same thing share it
# Samples' worth of doubt whether a joint rubs with as much as it is given: what wheels do against one another no balance sees.
DOUBT = 10.0
LEAST_ROWS = 200  # of the balance; fewer tell no friction
LEAST_PART = 0.05  # of the samples that tyres have to come off the peak of their friction


def lost_torques(
    differences: ChannelDifferences,
    valid: BoolArray,
    instruments: Sequence[Nuisance],
    at_peak: Callable[[RobotMotion], BoolArray],
) -> list[LostTorque] | None:
    """Return what joints lose along each motion; None where that takes no tyres off the peak of their friction.

    Args:
        differences: the channels of the motions under the description.
        valid: samples (T, C) in which nothing is seen to slide.
        instruments: numbers of the description that are masses.
        at_peak: in which samples (T,) of a motion tyres use so much friction that their slip is open.
    """
    motions, before = differences.motions, _part(differences.motions, at_peak)
    usable: BoolArray = valid[:, FORCES].min(axis=1)
    if usable.sum() < LEAST_ROWS or before < LEAST_PART:
        return None
    shapes = [_rubbing(differences.model.numbers, motion) for motion in motions]
    sizes = _sizes(differences, shapes, usable, instruments)
    found = [
        LostTorque(
            np.einsum("tjk,jk->tj", shape, sizes).reshape(motion.torque.shape),
            np.linalg.norm(sizes[:, 1:] * (1.0 - np.abs(shape[:, :, 1:])), axis=2).reshape(motion.torque.shape),
        )
        for motion, shape in zip(motions, shapes, strict=True)
    ]
    after = _part([dataclasses.replace(motion, lost=lost) for motion, lost in zip(motions, found, strict=True)], at_peak)
    return found if before - after > LEAST_PART else None


def by_joint(shapes: FloatArray) -> FloatArray:
    """Return what is at each joint (T, 2n, K) as torques on all joints (T, n, 2, 2n K), each at work alone."""
    count, joints, kinds = shapes.shape
    torque = np.zeros((count, joints, joints, kinds))
    torque[:, np.arange(joints), np.arange(joints)] = shapes
    return torque.reshape(count, joints // 2, 2, joints * kinds)


def _part(motions: Sequence[RobotMotion], at_peak: Callable[[RobotMotion], BoolArray]) -> float:
    """Part of all samples at the peak."""
    return float(np.mean(np.concatenate([at_peak(motion) for motion in motions])))


def _rubbing(numbers: ModelNumbers, motion: RobotMotion) -> FloatArray:
    """Shapes (T, 2n, 3) of what each joint may lose: in proportion to its speed, by its direction, by that over the ground."""
    twist, _ = twists(numbers, numbers.headings(motion.position), motion.velocity)
    over_ground = np.zeros(motion.velocity.shape)
    over_ground[:, :, STEER] = motion.velocity[:, :, STEER] + twist[:, 2:]
    speed, turning = (values.reshape(len(values), -1) for values in (motion.velocity, over_ground))
    shapes: FloatArray = np.stack([speed, np.tanh(speed / DRY_SPEED), np.tanh(turning / DRY_SPEED)], axis=2)
    return shapes


def _sizes(
    differences: ChannelDifferences, shapes: Sequence[FloatArray], usable: BoolArray, instruments: Sequence[Nuisance]
) -> FloatArray:
    """Sizes (2n, 3) of the shapes (T, 2n, 3) along each motion by which forces balance best, masses free."""
    rubbing = differences.of_torque([by_joint(shape) for shape in shapes])[:, FORCES]
    columns = np.concatenate([rubbing, *(n.column[:, FORCES, None] for n in instruments)], axis=2)
    residual = differences.residual[:, FORCES]
    deviation = channel_deviations(residual, np.repeat(usable[:, None], residual.shape[1], axis=1))
    design = (columns / deviation[:, None])[usable].reshape(-1, columns.shape[2])
    target = (residual / deviation)[usable].ravel()
    gram = design.T @ design
    gram[np.diag_indices_from(gram)] *= 1.0 + RIDGE
    gram[np.diag_indices_from(gram)] += 1e-300
    given = np.concatenate([motion.quiet_torque.reshape(len(motion.time), -1) for motion in differences.motions])
    usual = np.sqrt(np.mean(np.concatenate(shapes) ** 2, axis=0))
    largest = np.sqrt(np.mean(given**2, axis=0))[:, None]
    gram[np.diag_indices(usual.size)] += DOUBT * ((usual / np.maximum(largest, 1e-300)) ** 2).ravel()
    sizes: FloatArray = np.linalg.solve(gram, design.T @ target)[: usual.size].reshape(usual.shape)
    return sizes
