"""Cuts recordings into manoeuvres, so that a proof can hold out whole ones of every character."""

from __future__ import annotations

import numpy as np

from ..regression.regression_problem import FloatArray, IntArray, RegressionProblem, segment_slices

# Speeds whose shares in the motion are its character, on a robot and on a bench axis.
CHARACTER = ("v_x", "v_y", "omega", "velocity")
LOOK = 2.0  # [s] over which a character is judged
SHORTEST, LONGEST = 3.0, 8.0  # [s]
LEAST = 8  # manoeuvres of all recordings together
REST = 0.01  # of the mean square of each speed


def manoeuvres(problem: RegressionProblem) -> IntArray:
    """Number the manoeuvres, in order, (T,): pieces in which one speed leads, none longer than `LONGEST`."""
    number = np.zeros(len(problem.time), dtype=np.int64)
    longest = min(LONGEST * problem.rate, len(number) / LEAST)
    first = 0
    for piece in segment_slices(problem.segment):
        borders = _borders(_character(problem, piece), SHORTEST * problem.rate, longest)
        number[piece] = first + np.searchsorted(borders, np.arange(piece.stop - piece.start), side="right")
        first = int(number[piece.stop - 1]) + 1
    return number


def _character(problem: RegressionProblem, piece: slice) -> IntArray:
    """The leading speed of every sample, or -1 at rest."""
    power = []
    width = max(1, round(LOOK * problem.rate))
    for name in CHARACTER:
        if name in problem.variables:
            values = problem.variables[name]
            mean_square = max(float(np.mean(values**2)), 1e-300)
            power.append(_moving_mean(values[piece] ** 2 / mean_square, width))
    if not power:
        return np.zeros(piece.stop - piece.start, dtype=np.int64)
    shares = np.stack(power)
    leading: IntArray = np.where(shares.max(axis=0) > REST, np.argmax(shares, axis=0), -1).astype(np.int64)
    return leading


def _moving_mean(values: FloatArray, width: int) -> FloatArray:
    total = np.concatenate([[0.0], np.cumsum(values)])
    at = np.arange(len(values))
    low, high = np.maximum(at - width // 2, 0), np.minimum(at + width // 2 + 1, len(values))
    mean: FloatArray = (total[high] - total[low]) / (high - low)
    return mean


def _borders(character: IntArray, shortest: float, longest: float) -> IntArray:
    """First samples of all manoeuvres of a piece but the first one; lengths in samples."""
    count = len(character)
    borders = [0]
    for change in np.flatnonzero(np.diff(character)) + 1:
        if change - borders[-1] >= shortest and count - change >= shortest:
            borders.append(int(change))
    cut = []
    for start, stop in zip(borders, [*borders[1:], count], strict=True):
        parts = max(1, int(np.ceil((stop - start) / longest)))
        cut += [start + (stop - start) * k // parts for k in range(parts)]
    return np.array(cut[1:], dtype=np.int64)
