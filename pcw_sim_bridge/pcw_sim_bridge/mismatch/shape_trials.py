"""The evidence of one effect beside a set, for one shape after another."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import linalg

from .regression_problem import FloatArray
from .whitened_regression import Instance, WhitenedRegression, marginal_gains

AT_ONCE = 64  # instances whose columns are held at a time


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
        self._projected = linalg.solve_triangular(self._factor, gram[:-1, -1:], lower=True)
        self._design = regression.design(others)
        term = regression.problem.terms[instance.term]
        parameters = [term.parameters[k] for k in instance.active]
        self._deviations = np.array([[p.deviation for p in parameters]])
        # What is there or not there is as a whole where its shape is the right one, whatever part of another would do.
        self.whole = len(parameters) == 1 and parameters[0].hidden
        self._lower, self._upper = np.array([p.lower for p in parameters]), np.array([p.upper for p in parameters])
        self._without = regression.fit(others).log_evidence + term.log_prior

    def evidence(self, instances: Sequence[Instance]) -> list[tuple[float, bool]]:
        """Log evidence of the set with each of some instances of that term, and whether its parameters are within bounds."""
        own, cross, moment = self._products(instances)
        if self.whole:
            size = own[:, 0, 0] - np.sum(cross**2, axis=0)
            product = moment[:, 0] - (cross.T @ self._projected)[:, 0]
            return [
                (self._without + float(gain) - instance.occam, True)
                for instance, gain in zip(instances, product - 0.5 * size, strict=True)
            ]
        gains, means = marginal_gains(own, cross, moment, self._projected, self._deviations)
        allowed = np.all((means[:, :, 0] >= self._lower) & (means[:, :, 0] <= self._upper), axis=1)
        return [
            (self._without + float(gain) - instance.occam, bool(within))
            for instance, gain, within in zip(instances, gains[:, 0], allowed, strict=True)
        ]

    def coefficients(self, instances: Sequence[Instance]) -> FloatArray:
        """Return what the active parameters of each come out as (len(instances), P)."""
        found = []
        for start in range(0, len(instances), AT_ONCE):
            own, cross, moment = self._products(instances[start : start + AT_ONCE])
            found.append(marginal_gains(own, cross, moment, self._projected, self._deviations)[1][:, :, 0])
        return np.concatenate(found)

    def _products(self, instances: Sequence[Instance]) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Gram matrices of the columns of each instance, and their products with the set and with the target."""
        pieces = self.regression.tried_columns(instances)
        columns = np.concatenate(pieces, axis=1)
        cross = linalg.solve_triangular(self._factor, self._design.T @ columns, lower=True)
        return np.stack([piece.T @ piece for piece in pieces]), cross, columns.T @ self.regression.target[:, None]
