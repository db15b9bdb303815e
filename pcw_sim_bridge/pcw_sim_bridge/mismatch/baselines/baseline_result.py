"""What a baseline gives, and the held-out error that it is judged by."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np

from ..regression.regression_problem import BoolArray, FloatArray, RegressionProblem


@dataclasses.dataclass(frozen=True)
class BaselineResult:
    """One method on one set of recordings.

    Attributes:
        name: of the method, with its settings.
        names: what it says is there. `effect/target` (targets joined by `+`) where that is an honest reading, as
            `drive_coulomb_friction/front_left`; else its own expression, as `gyro: speed * v_x`.
        inverse_nrmse: before and after on the held-out recordings, as `fit.holdout.inverse_nrmse` of a report; None where
            it could not run.
        gap_closed: (before - after) / (before - floor) within 0 and 1; None without a floor.
        seconds: wall time, reading and filtering of the recordings left out.
        remark: why it could not run, or what a reader has to know.
    """

    name: str
    names: tuple[str, ...]
    inverse_nrmse: tuple[float, float] | None
    gap_closed: float | None
    seconds: float
    remark: str = ""


@dataclasses.dataclass(frozen=True)
class Explained:
    """What a baseline has found: names, and what it predicts of the held-out residual (T, C)."""

    names: tuple[str, ...]
    predicted: FloatArray
    remark: str = ""


def rms(values: FloatArray, rows: BoolArray) -> FloatArray:
    """Root mean square per channel over the rows that count, (T, C) -> (C,)."""
    mean_square = np.sum(np.where(rows, values, 0.0) ** 2, axis=0) / np.maximum(rows.sum(axis=0), 1)
    root: FloatArray = np.sqrt(mean_square)
    return root


def inverse_error(problem: RegressionProblem, residual: FloatArray) -> float:
    """Error of a residual (T, C) as the report has it: over the channels, each relative to its measured side's spread."""
    rows = problem.valid
    return float(np.sqrt(np.mean((rms(residual, rows) / measured_spread(problem)) ** 2)))


def measured_spread(problem: RegressionProblem) -> FloatArray:
    """Standard deviation of the measured side of each channel, (C,)."""
    rows = problem.valid
    mean = np.sum(np.where(rows, problem.measured, 0.0), axis=0) / np.maximum(rows.sum(axis=0), 1)
    spread: FloatArray = np.maximum(rms(problem.measured - mean, rows), 1e-300)
    return spread


def gap_closed(
    problem: RegressionProblem, errors: tuple[float, float], floor: Mapping[str, float] | None
) -> float | None:
    """Part of the gap between the description's error and the noise that was closed; see `BaselineResult`.

    Args:
        floor: rms of the noise by channel name, in the channel's unit.
    """
    if floor is None:
        return None
    levels = np.array([floor[channel.name] for channel in problem.channels])
    lowest = float(np.sqrt(np.mean((levels / measured_spread(problem)) ** 2)))
    before, after = errors
    if before <= lowest:
        return 0.0
    return float(min(max((before - after) / (before - lowest), 0.0), 1.0))


def joined_targets(names: Sequence[str], caster_names: Sequence[str]) -> tuple[str, ...]:
    """Join the same effect on every caster into one name; each name once, in order."""
    found = dict.fromkeys(names)
    for effect in dict.fromkeys(name.partition("/")[0] for name in found):
        single = [f"{effect}/{caster}" for caster in caster_names]
        if len(single) > 1 and all(name in found for name in single):
            found = {name: None for name in found if name not in single}
            found[f"{effect}/{'+'.join(caster_names)}"] = None
    return tuple(found)
