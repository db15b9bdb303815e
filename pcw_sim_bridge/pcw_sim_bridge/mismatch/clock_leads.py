"""Clocks that are far off: by how much, from what a sensor and the wheels say of the same motion.

Columns are first orders, and of a shift by more than a small part of the time in which a motion changes they say nothing.
So it is sought by correlation, which minds neither scales nor biases, and the columns are those of where that leads.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from scipy import signal

from .regression_problem import BoolArray, FloatArray
from .robot_motion import RobotMotion
from .rolling_model import ModelNumbers, acceleration_of, at_place, twists
from .signal_filter import derivative

LONGEST_LEAD = 1.0  # [s], either way
FIRST_ORDER = 0.5  # periods of the fastest that motions hold; first orders tell of a shorter lead
CLEARLY = 0.7  # of what a sensor has besides the motion of the wheels a shift leaves at most so much
SHORTEST_PIECE = 4.0 * LONGEST_LEAD  # [s]; of a shorter one too little is left beside such a shift


def clock_leads(motions: Sequence[RobotMotion], numbers: ModelNumbers, sliding: Sequence[BoolArray]) -> FloatArray:
    """Return by how much the stamps of IMU and tracker are ahead of the joints' (2,) [s]; zero where first orders tell.

    Args:
        motions: true motions, as far as the description knows.
        numbers: of the model.
        sliding: rows (T,) of every motion in which wheels do not say how the robot moves.
    """
    inertial, tracked = [], []
    for motion, slides in zip(motions, sliding, strict=True):
        if motion.time[-1] - motion.time[0] < SHORTEST_PIECE:
            continue
        twist = twists(numbers, numbers.headings(motion.position), motion.velocity)[0]
        twist[slides] = np.nan
        felt = acceleration_of(twist, derivative(twist, motion.rate))
        inertial.append((motion.rate, motion.imu, np.column_stack([twist[:, 2], felt[:, :2]])))
        tracked.append((motion.rate, motion.tracked_twist, at_place(twist, numbers.tracked)))
    least = FIRST_ORDER / max((motion.cutoff for motion in motions), default=math.inf)
    return np.array([lead if abs(lead) > least else 0.0 for lead in (_lead(inertial), _lead(tracked))])


def _lead(pieces: Sequence[tuple[float, FloatArray, FloatArray]]) -> float:
    """By how much what was sensed (T, K) comes later than what the wheels say (T, K), in pieces of a rate [Hz], [s]."""
    if not pieces:
        return 0.0
    reach = int(LONGEST_LEAD * pieces[0][0])
    leads = np.arange(-reach, reach + 1) / pieces[0][0]
    sums = np.zeros((3, len(leads), pieces[0][1].shape[1]))
    for rate, sensed, rolled in pieces:
        known: BoolArray = np.asarray(np.isfinite(sensed) & np.isfinite(rolled))
        there = known.astype(np.float64)
        ours, theirs = _centred(sensed, known), _centred(rolled, known)
        lags = np.arange(1 - len(known), len(known)) / rate
        # Of what overlaps with each shift: products, and powers of both.
        for total, one, other in zip(sums, (ours, ours**2, there), (theirs, there, theirs**2), strict=True):
            for k in range(total.shape[1]):
                total[:, k] += np.interp(leads, lags, signal.correlate(one[:, k], other[:, k])) / rate
    alike = np.clip(sums[0], 0.0, None) ** 2 / np.maximum(sums[1] * sums[2], 1e-300)
    left = np.sum(np.log(np.maximum(1.0 - alike, 1e-12)), axis=1)
    best = int(np.argmin(left))
    clear = left[best] - left[reach] < math.log(CLEARLY)
    return float(leads[best]) if clear else 0.0


def _centred(values: FloatArray, known: BoolArray) -> FloatArray:
    """Values (T, K) about their mean, zero where they are not known."""
    mean = np.sum(np.where(known, values, 0.0), axis=0) / np.maximum(known.sum(axis=0), 1)
    centred: FloatArray = np.where(known, values - mean, 0.0)
    return centred
