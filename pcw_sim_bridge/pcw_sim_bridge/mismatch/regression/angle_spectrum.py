"""The spectrum of a signal over an angle: how much of it turns so many times with every turn of a joint."""

from __future__ import annotations

import math

import numpy as np

from .regression_problem import FloatArray

SAMPLES_PER_WAVE = 8.0
FINENESS = 4  # of the orders, in those that the angle tells apart


def angle_spectrum(values: FloatArray, angle: FloatArray, largest: float) -> tuple[FloatArray, FloatArray]:
    """Return orders (K,) up to the largest one and beyond [1/rad], and the power (K,) of values (T,) over an angle (T,) [rad].

    A signal over evenly spaced angles has its orders by one transform; each sample is shared by the two next to it.
    """
    density = SAMPLES_PER_WAVE * largest / math.tau
    place = (angle - angle.min()) * density
    before = place.astype(np.int64)
    count, part = int(before.max()) + 2, place - before
    along = np.bincount(before, (1.0 - part) * values, count) + np.bincount(before + 1, part * values, count)
    power = np.abs(np.fft.rfft(along, FINENESS * count)) ** 2
    orders = math.tau * density / (FINENESS * count) * np.arange(len(power))
    return np.asarray(orders, dtype=np.float64), np.asarray(power, dtype=np.float64)
