"""The evidence of one effect beside a set, for one shape after another."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ..regression.regression_problem import FloatArray
from ..regression.whitened_regression import Instance, WhitenedRegression, forward_substituted, marginal_gains


class Trial(NamedTuple):
    """A set with one instance beside it: its log evidence, whether the parameters are within bounds, and their values (P,)."""

    evidence: float
    allowed: bool
    coefficients: FloatArray


class ShapeTrials:
    """A set whose fit is known, beside which an instance is tried with many shapes.

    Only what a shape adds is computed, and nothing of it is kept in the regression: a search tries hundreds of shapes, of
    which one is chosen.
    """

    def __init__(self, regression: WhitenedRegression, others: Sequence[Instance], instance: Instance) -> None:
        """Take the set that stays, and what is tried beside it."""
        self.regression = regression
        gram, deviations = regression.gram(others), regression.deviations(others)
        self._factor = np.linalg.cholesky(gram[:-1, :-1] + np.diag(1.0 / deviations**2))
        self._projected = forward_substituted(self._factor, gram[:-1, -1:])
        self._design = regression.design(others)
        term = regression.problem.terms[instance.term]
        parameters = [term.parameters[k] for k in instance.active]
        self._deviations = np.array([[p.deviation for p in parameters]])
        # What is there or not there is as a whole where its shape is the right one, whatever part of another would do.
        self.whole = len(parameters) == 1 and parameters[0].hidden
        self._lower, self._upper = np.array([p.lower for p in parameters]), np.array([p.upper for p in parameters])
        self._without = regression.fit(others).log_evidence + term.log_prior

    def tried(self, instances: Sequence[Instance]) -> list[Trial]:
        """What the set makes of each of some instances of that term."""
        own, cross, moment = self._products(instances)
        gains, means = marginal_gains(own, cross, moment, self._projected, self._deviations)
        gains, means = gains[:, 0], means[:, :, 0]
        allowed = np.all((means >= self._lower) & (means <= self._upper), axis=1)
        if self.whole:
            size = own[:, 0, 0] - np.sum(cross**2, axis=0)
            gains = moment[:, 0] - (cross.T @ self._projected)[:, 0] - 0.5 * size
            allowed[:] = True
        return [
            Trial(self._without + float(gain) - instance.occam, bool(within), mean)
            for instance, gain, within, mean in zip(instances, gains, allowed, means, strict=True)
        ]

    def _products(self, instances: Sequence[Instance]) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Gram matrices of the columns of each instance, and their products with the set and with the target."""
        pieces = self.regression.tried_columns(instances)
        columns = np.concatenate(pieces, axis=1)
        cross = forward_substituted(self._factor, self._design.T @ columns)
        return np.stack([piece.T @ piece for piece in pieces]), cross, columns.T @ self.regression.target[:, None]
