"""What a model's own errors look like: its torques and its tyres' stiffness are a little wrong, and not always by as much.

An effect that is no larger than these is still no error of the model where it looks like none: a ripple that repeats with
each turn, or a slip that lags behind its force.
"""

from __future__ import annotations

import numpy as np

from .regression_problem import FloatArray, IntArray, RegressionProblem, segment_slices

# An error of the model may be another one after this time [s].
DRIFT_TIME = 10.0
# Relative to its largest, below which an eigenvalue of the columns' products is none.
DEGENERATE = 1e-8


def drifting_columns(problem: RegressionProblem) -> FloatArray:
    """Columns (T, C, K) of all drifts of a problem, each over every stretch of the recordings by itself."""
    if problem.drifts is None:
        return np.zeros((*problem.residual.shape, 0))
    course = _courses(problem.time, problem.segment)
    drifting: FloatArray = problem.drifts[:, :, :, None] * course[:, None, None, :]
    return drifting.reshape(*problem.residual.shape, -1)


def beside(columns: FloatArray, target: FloatArray) -> float:
    """Squared length of what a combination of columns (R, K) leaves of a target (R,)."""
    lengths = np.linalg.norm(columns, axis=0)
    scaled = columns[:, lengths > 0.0] / lengths[lengths > 0.0]
    values, vectors = np.linalg.eigh(scaled.T @ scaled)
    kept = values > DEGENERATE * values[-1] if len(values) else np.zeros(0, dtype=bool)
    parts = vectors[:, kept].T @ (scaled.T @ target) / np.sqrt(values[kept])
    return max(float(target @ target - parts @ parts), 0.0)


def _courses(time: FloatArray, segment: IntArray) -> FloatArray:
    """Functions of time (T, M) that add up to one, each piecewise linear over two neighbouring stretches."""
    found = []
    for piece in segment_slices(segment):
        since = time[piece] - time[piece.start]
        count = max(round(float(since[-1]) / DRIFT_TIME), 1)
        place = since / max(float(since[-1]), 1e-9) * count
        for k in range(count + 1):
            course = np.zeros(len(time))
            course[piece] = np.maximum(0.0, 1.0 - np.abs(place - k))
            found.append(course)
    return np.stack(found, axis=1)
