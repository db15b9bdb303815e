"""Moments at which wheels and tracker part suddenly: where no wheel says that another one slips, or all slip together.

A wrong number of the description parts them slowly, as the robot turns and changes its speed. What comes within a moment
and is gone again is no number: a wheel spun, a counter lost its place, the tracker saw something else.
"""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from .regression_problem import BoolArray, FloatArray

USUAL_DURATION = 3.0  # [s]; what stays for half of it is the usual difference
MEDIAN_RATE = 25.0  # [Hz]; of faster samples about so many are enough for a median of seconds
SUDDEN = 6.0  # times what the difference usually departs from that, as the standard deviation of its quiet part
MEDIAN_OF_NORMAL = 0.6745  # of the absolute value of a standard normal number
# Wheels spin where they and the tracker part by so much of their speed: no number of a description is so wrong. Where they do
# so nearly all the time, one of the two is read wrongly; they have to agree to a part of it now and then.
SPINNING, AGREEING, AT_TIMES = 0.5, 0.1, 0.1
OFTEN = 0.25  # of the time; what comes more seldom does not make the usual departure larger, and is told by it


def sudden_slip(tracked: FloatArray, rolled: FloatArray, rate: float, reach: float, least: FloatArray) -> BoolArray:
    """Samples (T,) at which the tracked twist departs from that of the wheels more than it usually does, or by half of it.

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
    return found | _spinning(_speed(apart, reach), _speed(rolled, reach), known, least)


def _speed(twist: FloatArray, reach: float) -> FloatArray:
    """Size (T,) of twists (T, 3) [m/s]."""
    speed: FloatArray = np.hypot(twist[:, 0], twist[:, 1]) + reach * np.abs(twist[:, 2])
    return speed


def _spinning(apart: FloatArray, rolled: FloatArray, known: BoolArray, least: FloatArray) -> BoolArray:
    """Samples (T,) at which the robot hardly moves as its wheels roll, however long; see `sudden_slip`."""
    moving = known & (rolled > least)
    agreeing, spinning = moving & (apart < AGREEING * rolled), moving & (apart > SPINNING * rolled)
    often = float(moving.sum())
    return spinning if agreeing.sum() > AT_TIMES * often and spinning.sum() > OFTEN * often else np.zeros_like(known)


def _usually(apart: FloatArray, rate: float) -> FloatArray:
    """Median of the seconds about every sample (T, 3); of fast samples some stand for all."""
    step = max(1, round(rate / MEDIAN_RATE))
    some = apart[::step]
    window = min(round(USUAL_DURATION * rate / step) | 1, len(some) | 1)
    median = ndimage.median_filter(some, size=(window, 1), mode="nearest")
    rows = np.arange(len(apart))
    usual: FloatArray = np.stack([np.interp(rows, rows[::step], column) for column in median.T], axis=1)
    return usual
