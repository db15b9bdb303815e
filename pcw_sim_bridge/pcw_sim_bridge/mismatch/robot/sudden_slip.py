"""Moments at which wheels and tracker part suddenly: where no wheel says that another one slips, or all slip together.

A wrong number of the description parts them slowly, as the robot turns and changes its speed. What comes within a moment
and is gone again is no number: a wheel spun, a counter lost its place, the tracker saw something else. Nor is what leaves a
robot nearly where it is while all its wheels roll, however long it lasts (`spinning`).
"""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from ..regression.regression_problem import BoolArray, FloatArray

USUAL_DURATION = 3.0  # [s]; what stays for half of it is the usual difference
MEDIAN_RATE = 25.0  # [Hz]; of faster samples about so many are enough for a median of seconds
SUDDEN = 6.0  # times what the difference usually departs from that, as the standard deviation of its quiet part
MEDIAN_OF_NORMAL = 0.6745  # of the absolute value of a standard normal number
# Wheels spin where the robot moves at less than this part of their speed: no number of a description is so wrong. Where it
# does nearly all the time, one of the two is read wrongly; they have to agree to a part of it now and then.
SPINNING, AGREEING, AT_TIMES = 0.5, 0.1, 0.1
OFTEN = 0.25  # of the time; what comes more seldom does not make the usual departure larger, and is told by it


def sudden_slip(tracked: FloatArray, rolled: FloatArray, rate: float, reach: float, least: FloatArray) -> BoolArray:
    """Samples (T,) at which the tracked twist departs from that of the wheels more than it usually does.

    Args:
        tracked, rolled: twists (T, 3); NaN in `tracked` where nothing was tracked.
        rate: of the samples [Hz].
        reach: length that a yaw rate is multiplied by [m].
        least: departure (T,) below which nothing is sudden [m/s].
    """
    known: BoolArray = np.asarray(np.isfinite(tracked).all(axis=1))
    apart = np.where(known[:, None], tracked - rolled, 0.0)
    size = _speed(apart - _usually(apart, rate), reach)
    usual = float(np.median(size[known])) / MEDIAN_OF_NORMAL if known.any() else 0.0
    found: BoolArray = known & (size > np.maximum(least, SUDDEN * usual))
    return found


def spinning(tracked: FloatArray, rolled: FloatArray, reach: float, least: FloatArray) -> BoolArray:
    """Samples (T,) at which the robot hardly moves as its wheels roll, if that is often; see `sudden_slip`.

    What lasts for most of a recording is usual, and nothing sudden.
    """
    known: BoolArray = np.asarray(np.isfinite(tracked).all(axis=1))
    moved, speed = (_speed(np.where(known[:, None], twist, 0.0), reach) for twist in (tracked, rolled))
    moving = known & (speed > least)
    agreeing = moving & (_speed(np.where(known[:, None], tracked - rolled, 0.0), reach) < AGREEING * speed)
    found: BoolArray = moving & (moved < SPINNING * speed)
    often = float(moving.sum())
    return found if agreeing.sum() > AT_TIMES * often and found.sum() > OFTEN * often else np.zeros_like(found)


def _speed(twist: FloatArray, reach: float) -> FloatArray:
    """Size (T,) of twists (T, 3) [m/s]."""
    speed: FloatArray = np.hypot(twist[:, 0], twist[:, 1]) + reach * np.abs(twist[:, 2])
    return speed


def _usually(apart: FloatArray, rate: float) -> FloatArray:
    """Median of the seconds about every sample (T, 3); of fast samples some stand for all."""
    step = max(1, round(rate / MEDIAN_RATE))
    some = apart[::step]
    window = min(round(USUAL_DURATION * rate / step) | 1, len(some) | 1)
    median = ndimage.median_filter(some, size=(window, 1), mode="nearest")
    rows = np.arange(len(apart))
    usual: FloatArray = np.stack([np.interp(rows, rows[::step], column) for column in median.T], axis=1)
    return usual
