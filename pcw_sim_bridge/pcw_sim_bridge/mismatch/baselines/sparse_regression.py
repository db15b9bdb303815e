"""PySINDy on the residual: sequentially thresholded least squares over a library of candidate columns.

Used as its documentation advises: normalised columns, and a median over twenty bootstrap models. Columns and target have
unit rms, so that a threshold of 0.1 keeps what makes a tenth of the residual and more. The ridge, and whether the kept
terms are fitted again without it, are what predicts left-out blocks of the recordings best; where nothing predicts them
better than zero does, nothing is kept. Without this the many columns that run alike on a robot get large weights of opposite
signs, and the prediction is worth nothing.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence

import numpy as np

from ..regression.regression_problem import FloatArray, IntArray, RegressionProblem, contiguous_blocks
from .baseline_result import Explained, joined_targets, rms
from .candidate_columns import column_in, effect_columns, variable_columns
from .comparison_packages import comparison_module

# PySINDy's own default, and one that keeps only what nobody would overlook.
THRESHOLDS = (0.1, 0.3)
BOOTSTRAP_MODELS = 20
# Ridge per sample, and whether the kept terms are fitted again without it.
Tuning = tuple[float, bool]
TUNINGS: tuple[Tuning, ...] = tuple((ridge, again) for ridge in (1e-4, 1e-2, 1e-1) for again in (True, False))
BLOCKS = 5
# A number of the description is re-tuned, not named, as far as this many of its tolerances.
TOLERANCES = 3.0


def by_variables(
    fitted: RegressionProblem, held_out: RegressionProblem, casters: Sequence[str], threshold: float, seed: int
) -> Explained:
    """Explain each channel on its own by functions of the measured variables."""
    candidates, proof = variable_columns(fitted), variable_columns(held_out)
    block = contiguous_blocks(fitted.segment, BLOCKS)
    names: list[str] = []
    predicted = np.zeros_like(held_out.residual)
    for c, channel in enumerate(fitted.channels):
        rows = fitted.valid[:, c]
        columns = np.stack([candidate.column[:, c] for candidate in candidates], axis=1)
        weights = sparse_weights(columns[rows], fitted.residual[rows, c], block[rows], threshold, seed)
        predicted[:, c] = np.stack([candidate.column[:, c] for candidate in proof], axis=1) @ weights
        for candidate, weight in zip(candidates, weights, strict=True):
            if weight != 0.0:
                names.append(candidate.effect or f"{channel.name}: {candidate.label}")
    return Explained(joined_targets(names, casters), predicted)


def by_effects(
    fitted: RegressionProblem, held_out: RegressionProblem, casters: Sequence[str], threshold: float, seed: int
) -> Explained:
    """Explain all channels together by the columns of this package's own effects."""
    candidates = effect_columns(fitted)
    scale = np.maximum(rms(fitted.residual, fitted.valid), 1e-300)
    columns = np.stack([(candidate.column / scale)[fitted.valid] for candidate in candidates], axis=1)
    block = np.repeat(contiguous_blocks(fitted.segment, BLOCKS)[:, None], len(scale), axis=1)[fitted.valid]
    weights = sparse_weights(columns, (fitted.residual / scale)[fitted.valid], block, threshold, seed)
    predicted = np.zeros_like(held_out.residual)
    names = []
    for candidate, weight in zip(candidates, weights, strict=True):
        if weight != 0.0:
            predicted += weight * column_in(held_out, candidate)
            if abs(weight) > TOLERANCES * candidate.tolerance:
                names.append(candidate.effect)
    return Explained(joined_targets(names, casters), predicted)


def sparse_weights(columns: FloatArray, target: FloatArray, block: IntArray, threshold: float, seed: int) -> FloatArray:
    """Weights (K,) of columns (T, K) that explain a target (T,), most of them exactly zero.

    Args:
        block: contiguous block of each row (T,), for the tuning.
        threshold: least weight between columns and target of unit rms.
        seed: of the bootstrap.
    """
    size = np.sqrt(np.mean(columns**2, axis=0))
    spread = float(np.sqrt(np.mean(target**2)))
    used = size > 1e-12
    weights = np.zeros(columns.shape[1])
    if spread < 1e-300 or not used.any():
        return weights
    scaled, aim = columns[:, used] / size[used], target / spread
    # PySINDy draws from numpy's global source.
    state = np.random.get_state()
    np.random.seed(seed)
    try:
        with warnings.catch_warnings():
            # It warns of every model that keeps nothing, which is an answer here.
            warnings.simplefilter("ignore")
            tuning = _best_tuning(scaled, aim, block, threshold)
            if tuning is not None:
                weights[used] = _fit(scaled, aim, threshold, tuning, BOOTSTRAP_MODELS) * spread / size[used]
    finally:
        np.random.set_state(state)
    return weights


def _best_tuning(columns: FloatArray, target: FloatArray, block: IntArray, threshold: float) -> Tuning | None:
    """The tuning that predicts left-out blocks best, None where zero does."""
    errors = dict.fromkeys(TUNINGS, 0.0)
    for label in np.unique(block):
        out = block == label
        if out.all():
            return None
        for tuning in TUNINGS:
            weights = _fit(columns[~out], target[~out], threshold, tuning, 1)
            errors[tuning] += float(np.sum((target[out] - columns[out] @ weights) ** 2))
    best = min(errors, key=lambda tuning: errors[tuning])
    return best if errors[best] < float(np.sum(target**2)) else None


def _fit(columns: FloatArray, target: FloatArray, threshold: float, tuning: Tuning, models: int) -> FloatArray:
    """Weights (K,) by PySINDy, the median over bootstrap models where there are several."""
    pysindy = comparison_module("pysindy")
    ridge, again = tuning
    optimizer = pysindy.STLSQ(threshold=threshold, alpha=ridge * len(target), unbias=again)
    if models > 1:
        optimizer = pysindy.EnsembleOptimizer(optimizer, bagging=True, n_models=models)
    model = pysindy.SINDy(optimizer=optimizer, feature_library=pysindy.IdentityLibrary())
    model.fit(columns, t=1.0, x_dot=target[:, None])
    return np.asarray(model.coefficients(), dtype=np.float64)[0]
