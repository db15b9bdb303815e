"""Gradient boosting on the residual of each channel: the black box that knows nothing of physics.

Trained on the first part of every recording, with as many trees as serve its last part best, then on all of it. Named are
the variables whose shuffling hurts on that last part more than the shuffling of any decoy does, which is one of the same
variables moved along the time, so that it has the colour of the variable and nothing to say.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ..regression.regression_problem import BoolArray, FloatArray, RegressionProblem
from .baseline_result import Explained
from .candidate_columns import features
from .comparison_packages import comparison_module

MOST_TREES = 150
LEARNING_RATE = 0.08
LAST_PART = 0.3
SHUFFLES = 3
# So many variables at most are named per channel.
MOST_NAMES = 5


def boosted(fitted: RegressionProblem, held_out: RegressionProblem, seed: int) -> Explained:
    """Explain each channel by boosted trees over the measured variables."""
    inputs, proof = features(fitted), features(held_out)
    names = [name for name in inputs if name in proof]
    table, proof_table = (np.stack([source[name] for name in names], axis=1) for source in (inputs, proof))
    decoys = _decoys(table, np.random.default_rng(seed))
    last = _last_part(fitted)
    found: list[str] = []
    predicted = np.zeros_like(held_out.residual)
    for c, channel in enumerate(fitted.channels):
        valid, target = fitted.valid[:, c], fitted.residual[:, c]
        trees, leading = _choose(table, decoys, target, valid & ~last, valid & last, seed)
        if trees:
            model = _regressor(trees, seed).fit(table[valid], target[valid])
            predicted[:, c] = model.predict(proof_table)
            found += [f"{channel.name}: {names[k]}" for k in leading]
    return Explained(tuple(found), predicted)


def _regressor(trees: int, seed: int) -> Any:
    ensemble = comparison_module("sklearn.ensemble")
    return ensemble.HistGradientBoostingRegressor(
        max_iter=trees, learning_rate=LEARNING_RATE, early_stopping=False, random_state=seed
    )


def _choose(
    table: FloatArray, decoys: FloatArray, target: FloatArray, rows: BoolArray, last: BoolArray, seed: int
) -> tuple[int, list[int]]:
    """Number of trees that serves the last part best, 0 where none does, and the leading variables' places."""
    if rows.sum() < 50 or last.sum() < 20:
        return 0, []
    model = _regressor(MOST_TREES, seed).fit(table[rows], target[rows])
    errors = [float(np.mean((target[last] - guess) ** 2)) for guess in model.staged_predict(table[last])]
    best = int(np.argmin(errors))
    if errors[best] >= float(np.mean(target[last] ** 2)):
        return 0, []
    both = np.concatenate([table, decoys], axis=1)
    judged = _regressor(best + 1, seed).fit(both[rows], target[rows])
    inspection = comparison_module("sklearn.inspection")
    importance = inspection.permutation_importance(judged, both[last], target[last], n_repeats=SHUFFLES, random_state=seed)
    mean, deviation = importance.importances_mean, importance.importances_std
    width = table.shape[1]
    floor = max(float(np.max(mean[width:])), 0.0)
    order = np.argsort(-mean[:width])
    return best + 1, [int(k) for k in order[:MOST_NAMES] if mean[k] - 2.0 * deviation[k] > floor]


def _decoys(table: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Every variable moved round by a quarter to three quarters of the samples, (T, K)."""
    count = len(table)
    columns = [np.roll(column, int(rng.integers(count // 4, 3 * count // 4 + 1))) for column in table.T]
    moved: FloatArray = np.stack(columns, axis=1)
    return moved


def _last_part(problem: RegressionProblem) -> BoolArray:
    last = np.zeros(len(problem.time), dtype=bool)
    for index in np.unique(problem.recording):
        own = problem.recording == index
        last |= own & (problem.time > np.quantile(problem.time[own], 1.0 - LAST_PART))
    return last
