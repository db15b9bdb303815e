"""A problem that is made exact where its fit comes out: at the numbers of the description and at the sizes of the effects.

Columns are first orders. What the first order of a large effect leaves would pass for further effects, and numbers that are
far off are compared with effects there, and not at the description.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import numpy as np

from ..regression.noise_model import (
    channel_deviations,
    fit_noise_model,
    huber_weights,
    reliability,
    white_noise_model,
)
from ..regression.regression_problem import FloatArray, IntArray, RegressionProblem, SizedTerm
from ..regression.whitened_regression import Fit, Instance, WhitenedRegression
from .shape_search import refined_shape

# So many times the problem is made exact where its fit came out, or this part of the way there.
EXACT_ROUNDS = 6
STEPS = (1.0, 0.5, 0.2)
RESHAPINGS = 3  # the first under the noise that a wrong shape leaves, which makes shapes alike
GROWTH = 1.01  # by which the error of a step may be more, numbers of a first order having been put right
# After so many rounds that did not settle columns are taken anew; where they have been before, after twice as many.
DERIVED_AFTER = 2
# A fit that moves less than this part of its intervals' deviations has arrived.
STEADY = 0.2
SHORTER = 0.25  # part of a step that led to less than there was
STEADY_EVIDENCE = 1.0  # nats; what a set is worth where it is exact is not asked for more exactly


class ExactProblem:
    """A problem, and where it is exact now."""

    def __init__(self, problem: RegressionProblem, block: IntArray) -> None:
        """Take a problem that is exact at the description.

        Args:
            problem: the problem.
            block: which block of the cross-validation each sample is in (T,).
        """
        self.problem = problem
        self.block = block
        # Where the problem is exact: all numbers of the description by name, of effects by term, shape and parameter.
        self._point: dict[object, float] | None = None
        # Of the problem and set that were last asked for: one step of a search ends where the next one begins.
        self._last_left: tuple[RegressionProblem, tuple[Instance, ...], FloatArray, float] | None = None
        self._last_beside: tuple[FloatArray, WhitenedRegression] | None = None

    @property
    def place(self) -> tuple[RegressionProblem, dict[object, float] | None]:
        """The problem as it is exact now, to come back to."""
        return self.problem, self._point

    @place.setter
    def place(self, place: tuple[RegressionProblem, dict[object, float] | None]) -> None:
        self.problem, self._point = place

    def whiten_at(self, residual: FloatArray, white: bool = False, by_channel: bool = False) -> WhitenedRegression:
        """Whiten the problem by the noise of a residual (T, C); the regression's blocks are those of time, or channels."""
        problem = self.problem
        if white:
            noise = white_noise_model(residual, problem.valid)
        else:
            noise = fit_noise_model(residual, problem.valid, problem.segment, problem.apart)
        # What is large at the first look may be an event, which held down like an outlier would never be found.
        weights = reliability(problem, residual, robust=not by_channel)
        return WhitenedRegression(problem, noise, weights, None if by_channel else self.block)

    def residual_of(self, instances: Sequence[Instance]) -> FloatArray:
        """Residual (T, C) of the least-squares fit of a set, with robust weights."""
        return self._left_and_cost(instances)[0]

    def _left_and_cost(self, instances: Sequence[Instance]) -> tuple[FloatArray, float]:
        """The same with what its re-tuning costs [nats]."""
        last, wanted = self._last_left, tuple(instances)
        if last is not None and last[0] is self.problem and last[1] == wanted:
            return last[2], last[3]
        residual, cost = self.problem.residual, 0.0
        for _ in range(3):
            regression = self.whiten_at(residual, white=True)
            fit = regression.fit(instances)
            residual, cost = regression.unwhitened_residual(fit), regression.tolerance_cost(fit)
        self._last_left = self.problem, wanted, residual, cost
        return residual, cost

    def whiten_beside(self, instances: Sequence[Instance]) -> WhitenedRegression:
        """Whiten the problem by the noise that a set leaves."""
        residual = self.residual_of(instances)
        if self._last_beside is None or self._last_beside[0] is not residual:
            self._last_beside = residual, self.whiten_at(residual)
        return self._last_beside[1]

    def _error(self, residual: FloatArray, noise: FloatArray) -> float:
        """Sum of squares of a residual (T, C) in units of the deviations of another, outliers held down."""
        valid, total = self.problem.valid, 0.0
        for channel, deviation in enumerate(channel_deviations(noise, valid)):
            values = residual[valid[:, channel], channel] / deviation
            total += float(np.sum(huber_weights(values) * values**2))
        return total

    def made_exact(self, instances: tuple[Instance, ...]) -> tuple[Instance, ...]:
        """Make the problem exact at the sizes of these effects and of the numbers beside them, and search shapes again.

        What their first order leaves would pass for other effects. A step that leaves more than there was is halved.
        """
        reshapings = 0
        for count in range(EXACT_ROUNDS):
            known = self.problem.point is not None and self.problem.point.derived
            if count == (2 * DERIVED_AFTER if known else DERIVED_AFTER):
                self.problem = self.problem.derived()
            residual, cost = self._left_and_cost(instances)
            fit = self.whiten_beside(instances).fit(instances)
            allowed = GROWTH * self._error(residual, residual) + 2.0 * cost
            before, tried = (self.problem, self._point), []
            for part in STEPS:
                if not self._exact_at(fit, part):
                    if self.problem.point is None or self.problem.point.derived:
                        return self._reshaped(instances, residual, False)
                    # With the slopes of another place one arrives where those are level, and not where the error is least.
                    self.problem, again = self.problem.derived(), instances
                    break
                again = instances if reshapings == RESHAPINGS else self._reshaped(instances, residual, reshapings == 0)
                left, cost = self._left_and_cost(again)
                tried.append((self._error(left, residual) + 2.0 * cost, (self.problem, self._point), again))
                if tried[-1][0] <= allowed:
                    break
                self.problem, self._point = before
            else:
                # What was promised is not reached. What is reached may be much all the same, and the rest of it nearer.
                least, there, again = min(tried, key=lambda step: step[0])
                if least >= self._error(self._left_here(), residual):
                    return instances
                self.problem, self._point = there
            reshapings = RESHAPINGS if again == instances else reshapings + 1
            instances = again
        return instances

    def _left_here(self) -> FloatArray:
        """Residual (T, C) with all numbers and effects as they are where the problem is exact."""
        problem, known = self.problem, self._point or {}
        left = problem.residual - problem.nuisance_columns() @ np.array([known.get(n.name, 0.0) for n in problem.nuisances])
        for key, size in known.items():
            if isinstance(key, tuple):
                left = left - problem.columns(key[0], key[1])[..., key[2]] * size
        return left

    def _reshaped(self, instances: tuple[Instance, ...], residual: FloatArray, coarse: bool) -> tuple[Instance, ...]:
        """Search the shapes again, near where they are; coarse: of what is at work once also as far as its neighbours."""
        regression = self.whiten_at(residual)
        for index, instance in enumerate(instances):
            term = self.problem.terms[instance.term]
            if not term.resolution:
                continue
            others = (*instances[:index], *instances[index + 1 :])
            around = self.problem.around(instance.term, instance.shape)
            near = regression if around is self.problem else regression.moved(around)
            found = refined_shape(near, others, instance, coarse and term.once)
            if found != instance:
                self.problem, regression = around, near
            instances = (*instances[:index], found, *instances[index + 1 :])
        return instances

    def _exact_at(self, fit: Fit, part: float = 1.0) -> bool:
        """Make the problem exact where a fit comes out, or a part of the way there; False where it has been so already."""
        problem, terms = self.problem, self.problem.terms
        keys: list[object] = [nuisance.name for nuisance in problem.nuisances]
        bounds = [nuisance.changes for nuisance in problem.nuisances]
        for instance in fit.instances:
            parameters = terms[instance.term].parameters
            keys += [(instance.term, instance.shape, k) for k in instance.active]
            bounds += [(parameters[k].lower, parameters[k].upper) for k in instance.active]
        known = {} if self._point is None else self._point
        wanted = np.array([float(np.clip(mean, *bound)) for mean, bound in zip(fit.mean, bounds, strict=True)])
        start = np.array([known.get(key, value) for key, value in zip(keys, wanted, strict=True)])
        for index, key in enumerate(keys):
            # Its column is a secant, which leads past the size that is sought as far as the effect is curved.
            power = problem.powers.get(key, 1.0)  # type: ignore[call-overload]
            if power != 1.0 and wanted[index] * start[index] > 0.0:
                wanted[index] = start[index] * (wanted[index] / start[index]) ** (1.0 / power)
        deviation = np.sqrt(np.maximum(np.diag(fit.covariance), 1e-300))
        if set(known) == set(keys) and np.all(np.abs(wanted - start) < STEADY * deviation):
            return False
        point = dict(zip(keys, start + part * (wanted - start), strict=True))
        sizes = []
        for instance in fit.instances:
            coefficients = np.zeros(len(terms[instance.term].parameters))
            coefficients[list(instance.active)] = [point[instance.term, instance.shape, k] for k in instance.active]
            sizes.append(SizedTerm(instance.term, instance.shape, coefficients, instance.active))
        self._point = point
        self.problem = problem.exact_at({n.name: point[n.name] for n in problem.nuisances}, sizes)
        return self.problem is not problem

    def _point_of(self, fit: Fit) -> FloatArray:
        """Sizes (k,) of nuisances and effects where the problem is exact."""
        point = self._point or {}
        keys: list[object] = [nuisance.name for nuisance in self.problem.nuisances]
        keys += [(instance.term, instance.shape, k) for instance in fit.instances for k in instance.active]
        return np.array([point[key] for key in keys])

    def _exact_evidence(self, regression: WhitenedRegression, fit: Fit) -> float:
        """Log evidence of a set where it is exact, and its columns with it: what is reached there, not what is promised."""
        return self._reached(regression, fit)[0]

    def _reached_with(self, noise: WhitenedRegression, instances: tuple[Instance, ...]) -> tuple[float, FloatArray]:
        """As `_reached`, of a set where the problem is exact now, by the noise of another regression."""
        regression = noise.moved(self.problem)
        return self._reached(regression, regression.fit(instances))

    def _reached(self, regression: WhitenedRegression, fit: Fit) -> tuple[float, FloatArray]:
        """The same, and the whitened residual there."""
        here = self.problem, self._point
        evidence, left = self._arrived(regression, fit, EXACT_ROUNDS)
        self.problem, self._point = here
        return evidence, left

    def _arrived(self, regression: WhitenedRegression, fit: Fit, rounds: int) -> tuple[float, FloatArray]:
        """Log evidence and whitened residual of a set at the best of so many steps; the problem stays exact there.

        Where a step leads past what it promised a shorter one is tried from where it began: tyres near the peak of their
        friction make it swing to and fro between places that are worth hundreds of nats less than what is between them.
        """
        reached, left, place, part = -math.inf, regression.whitened_residual(fit), (self.problem, self._point), 1.0
        for _ in range(rounds):
            if not self._exact_at(fit, part):
                break
            self.problem = self.problem.derived()
            moved = regression.moved(self.problem)
            trial = moved.fit(fit.instances)
            point = self._point_of(trial)
            missing = point - trial.mean
            promised = trial.log_evidence
            there = promised - 0.5 * float(missing @ np.linalg.solve(trial.covariance, missing))
            if there <= reached:
                (self.problem, self._point), part = place, SHORTER * part
                continue
            reached, left = there, moved.whitened_residual(dataclasses.replace(trial, mean=point))
            place, regression, fit, part = (self.problem, self._point), moved, trial, min(part / math.sqrt(SHORTER), 1.0)
            if promised - there < STEADY_EVIDENCE:
                break
        self.problem, self._point = place
        return (reached if math.isfinite(reached) else fit.log_evidence), left
