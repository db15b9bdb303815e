"""A first look at a robot's residual for what has too many places to be tried one by one: the orders of a ripple.

The tolerances are fitted first, as closely as their sizes allow. What remains is held against every order by sums alone;
the best of them are worth an exact fit. A choice among many is paid for as such (`Term.grid_size`).
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import numpy as np

from .noise_model import robust_deviation
from .regression_problem import BoolArray, FloatArray, Nuisance

LARGEST_ORDER = 400.0
MOST_ORDERS = 4


@dataclasses.dataclass(frozen=True)
class Chosen:
    """What a first look chose: `values` (K,), the best of `among` tried."""

    values: FloatArray
    among: int


def remainder(residual: FloatArray, valid: BoolArray, nuisances: Sequence[Nuisance]) -> FloatArray:
    """Residual (T, C) over its noise, tolerances fitted, zero where it is not to be judged."""
    deviations = np.array([max(robust_deviation(residual[valid[:, c], c]), 1e-300) for c in range(residual.shape[1])])
    target = np.where(valid, residual / deviations, 0.0)
    if not nuisances:
        return target
    columns = np.stack([n.column * n.deviation for n in nuisances], axis=2) / deviations[:, None]
    columns = np.where(valid[:, :, None], columns, 0.0).reshape(-1, len(nuisances))
    flat = target.ravel()
    fitted = np.linalg.solve(columns.T @ columns + np.eye(len(nuisances)), columns.T @ flat)
    left = (flat - columns @ fitted).reshape(residual.shape)
    # Over its noise again, now that the tolerances no longer pass for it.
    scale = [max(robust_deviation(left[valid[:, c], c]), 1e-300) for c in range(left.shape[1])]
    result: FloatArray = left / np.array(scale)
    return result


def orders(signal: FloatArray, angle: FloatArray, rate: float) -> Chosen:
    """Return the orders (K,) [1/rad] of the waves over an angle (T,) that a signal (T,) holds most of.

    Args:
        signal: zero where it is not to be judged.
        angle: of the joint [rad].
        rate: samples per second: a wave that passes faster than half of it in most samples cannot be seen.
    """
    span = float(np.ptp(angle))
    speed = float(np.median(np.abs(np.diff(angle)))) * rate
    if span < math.tau or speed <= 0.0:
        return Chosen(np.zeros(0), 1)
    largest = min(math.pi * rate / speed, LARGEST_ORDER)
    spacing = math.pi / (2.0 * span)
    tried = np.arange(max(spacing, 0.5), largest, spacing)
    if not len(tried):
        return Chosen(np.zeros(0), 1)
    power = np.empty(len(tried))
    for start in range(0, len(tried), 512):
        some = tried[start : start + 512]
        power[start : start + 512] = np.abs(np.exp(1j * np.outer(some, angle)) @ signal) ** 2
    found = []
    for _ in range(MOST_ORDERS):
        best = int(np.argmax(power))
        if power[best] <= 0.0:
            break
        found.append(float(tried[best]))
        power[max(0, best - 4) : best + 5] = 0.0
    return Chosen(np.array(found), len(tried))
