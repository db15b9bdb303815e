"""Clocks that are far off: by how much, from what a sensor and the wheels say of the same motion.

Columns are first orders, and of a shift by more than a small part of the time in which a motion changes they say nothing.
So it is sought by correlation, which minds neither scales nor biases, and the columns are those of where that leads.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from scipy import ndimage, signal

from ..regression.regression_problem import BoolArray, FloatArray
from ..regression.signal_filter import derivative
from .robot_motion import RobotMotion
from .rolling_model import ModelNumbers, acceleration_of, at_place, twists

LONGEST_LEAD = 1.0  # [s], either way
FIRST_ORDER = 0.5  # periods of the fastest that motions hold; first orders tell of a shorter lead
CLEARLY = 0.7  # of what a sensor has besides the motion of the wheels a shift leaves at most so much
# Motions are compared as they are and as means over these times [s]: of the velocity of a tracker that is slow or coarse most
# is noise, which hides what a shift does.
SMOOTHINGS = (0.0, 0.1, 0.3)
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
    """By how much what was sensed (T, K) comes later than what the wheels say (T, K), in pieces of a rate [Hz], [s].

    Of all smoothings that counts by which a shift leaves least of what there is without one; the others have to say at least
    that it leaves less. A clock does not mind how long one looks: what is late for a moment, behind wheels that slip, does.
    """
    if not pieces:
        return 0.0
    reach = int(LONGEST_LEAD * pieces[0][0])
    leads = np.arange(-reach, reach + 1) / pieces[0][0]
    lefts = [_left(pieces, leads, smoothing) for smoothing in SMOOTHINGS]
    left = min(lefts, key=lambda of_one: float(of_one.min() - of_one[reach]))
    best = int(np.argmin(left))
    agreed = all(of_one[best] <= of_one[reach] for of_one in lefts)
    return float(leads[best]) if agreed and left[best] - left[reach] < math.log(CLEARLY) else 0.0


def _left(pieces: Sequence[tuple[float, FloatArray, FloatArray]], leads: FloatArray, smoothing: float) -> FloatArray:
    """Logarithm of what shifts (L,) [s] leave of what was sensed, in parts of its power, of means over a time [s]."""
    sums = np.zeros((3, len(leads), pieces[0][1].shape[1]))
    for rate, sensed, rolled in pieces:
        known: BoolArray = np.asarray(np.isfinite(sensed) & np.isfinite(rolled))
        there = known.astype(np.float64)
        width = max(1, round(smoothing * rate))
        ours, theirs = (
            np.where(known, ndimage.uniform_filter1d(_centred(values, known), width, axis=0, mode="constant"), 0.0)
            for values in (sensed, rolled)
        )
        lags = np.arange(1 - len(known), len(known)) / rate
        # Of what overlaps with each shift: products, and powers of both.
        for total, one, other in zip(sums, (ours, ours**2, there), (theirs, there, theirs**2), strict=True):
            for k in range(total.shape[1]):
                total[:, k] += np.interp(leads, lags, signal.correlate(one[:, k], other[:, k])) / rate
    alike = np.clip(sums[0], 0.0, None) ** 2 / np.maximum(sums[1] * sums[2], 1e-300)
    left: FloatArray = np.sum(np.log(np.maximum(1.0 - alike, 1e-12)), axis=1)
    return left


def _centred(values: FloatArray, known: BoolArray) -> FloatArray:
    """Values (T, K) about their mean, zero where they are not known."""
    mean = np.sum(np.where(known, values, 0.0), axis=0) / np.maximum(known.sum(axis=0), 1)
    centred: FloatArray = np.where(known, values - mean, 0.0)
    return centred
