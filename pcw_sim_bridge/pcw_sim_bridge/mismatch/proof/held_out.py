"""What a fit says of data that it has not seen: other recordings, or manoeuvres left out of the fit in turn.

Everything is answered from Gram matrices of the whitened problem, so that leaving out an effect or a manoeuvre costs no
more than a small system of equations.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Collection, Sequence

import numpy as np
from scipy import optimize

from ..regression.noise_model import channel_deviations, huber_weights, reliability
from ..regression.regression_problem import BoolArray, FloatArray, IntArray, RegressionProblem, SizedTerm
from ..regression.whitened_regression import Instance, WhitenedRegression
from ..search.evidence_selection import Selection
from .manoeuvres import manoeuvres

FOLDS = 4  # parts that manoeuvres are dealt out to in turn
# Held-out data speak against an effect, if its work adds so much to their error [nats], and no more than this part of it would
# be the best there; against one for which the fitted ones say more than that, if manoeuvres agree: by so many deviations of
# their sum.
CONTRADICTED, LEAST_PART, AGREED = 3.0, 0.25, 2.0


@dataclasses.dataclass(frozen=True)
class HeldOut:
    """Folds: what each is fitted on and what it is judged on.

    Attributes:
        problem: that is judged.
        instances: the effects, as the fitted problem has them; only those `proposed` count, others are fitted beside them.
        columns: of nuisances and effects in `problem` (T, C, k); an effect that it does not show has zeros.
        fold: which fold judges each sample (T,).
        train: Gram matrices of [columns, residual], whitened, per fold (F, k + 1, k + 1).
        tests: the same of what is judged, per manoeuvre (M, k + 1, k + 1), and which fold judges it (M,), `judge`.
        deviations: prior deviations (k,); nuisances: how many of the k are numbers of the description.
        healthy: changes (nuisances,) up to which these are those of a healthy robot.
        source: what was held out, in words.
    """

    problem: RegressionProblem
    instances: tuple[Instance, ...]
    proposed: tuple[int, ...]
    columns: FloatArray
    fold: IntArray
    train: FloatArray
    tests: FloatArray
    judge: IntArray
    deviations: FloatArray
    nuisances: int
    healthy: FloatArray
    source: str

    @classmethod
    def recordings(
        cls,
        problem: RegressionProblem,
        instances: Sequence[Instance],
        proposed: Collection[Instance],
        selection: Selection,
        other: RegressionProblem,
        gone: Collection[Instance] = (),
    ) -> HeldOut:
        """Hold out other recordings: fitted on all of `problem`, judged on `other`, where what is `gone` is not at work."""
        regression = selection.regression
        other = _exact_elsewhere(problem, other)
        columns = _columns_elsewhere(problem, instances, other, gone)
        flat = np.concatenate([columns, other.residual[:, :, None]], axis=2)
        everything = np.zeros(len(other.time), dtype=np.int64)
        train = regression.grams(instances).sum(axis=0)
        deviations = regression.deviations(instances)
        mean = np.linalg.solve(train[:-1, :-1] + np.diag(1.0 / deviations**2), train[:-1, -1])
        weights = reliability(other, other.residual - columns @ mean, robust=False)
        judged = WhitenedRegression(other, regression.noise, weights, everything)
        white = judged.whiten_columns(flat)
        left = judged.spread(white[:, -1] - white[:, :-1] @ mean)
        white *= np.sqrt(judged.gather(_trust(left, other.valid)))[:, None]
        number = judged.gather(np.broadcast_to(manoeuvres(other)[:, None], other.valid.shape))
        tests = np.stack([white[number == m].T @ white[number == m] for m in np.unique(number)])
        count = len(np.unique(other.recording))
        return cls(
            other,
            tuple(instances),
            _positions(instances, proposed),
            columns,
            everything,
            train[None],
            tests,
            np.zeros(len(tests), dtype=np.int64),
            deviations,
            len(problem.nuisances),
            np.array([nuisance.healthy for nuisance in problem.nuisances]),
            f"{count} held-out recording{'s' if count > 1 else ''}",
        )

    @classmethod
    def manoeuvres(
        cls, problem: RegressionProblem, instances: Sequence[Instance], proposed: Collection[Instance], selection: Selection
    ) -> HeldOut:
        """Hold out manoeuvres of the fitted recordings in turn, each judged by a fit to the others."""
        number = manoeuvres(problem)
        regression = WhitenedRegression(problem, selection.regression.noise, np.ones_like(problem.residual), number)
        grams = regression.grams(instances)
        labels = np.array(regression.block_labels()) % FOLDS
        test = np.stack([grams[labels == fold].sum(axis=0) for fold in range(FOLDS)])
        count = int(number.max()) + 1
        return cls(
            problem,
            tuple(instances),
            _positions(instances, proposed),
            _columns_elsewhere(problem, instances, problem),
            number % FOLDS,
            test.sum(axis=0) - test,
            grams,
            labels,
            regression.deviations(instances),
            len(problem.nuisances),
            np.array([nuisance.healthy for nuisance in problem.nuisances]),
            f"{count} manoeuvres of the fitted recordings, each predicted from others",
        )

    @property
    def test(self) -> FloatArray:
        """Gram matrices of what each fold judges (F, k + 1, k + 1)."""
        return np.stack([self.tests[self.judge == fold].sum(axis=0) for fold in range(len(self.train))])

    def _kept(self, without: int | None) -> IntArray:
        """Positions of the columns without those of one effect."""
        positions = np.arange(len(self.deviations))
        return positions if without is None else np.setdiff1d(positions, np.arange(*self.span(without)))

    def span(self, index: int) -> tuple[int, int]:
        """First and one past the last column of an effect."""
        start = self.nuisances + sum(len(instance.active) for instance in self.instances[:index])
        return start, start + len(self.instances[index].active)

    def means(self, without: int | None = None) -> FloatArray:
        """Fitted numbers of every fold (F, k), zeros for an effect that is left out."""
        kept = self._kept(without)
        found = np.zeros((len(self.train), len(self.deviations)))
        for mean, gram in zip(found, self.train, strict=True):
            precision = gram[np.ix_(kept, kept)] + np.diag(1.0 / self.deviations[kept] ** 2)
            mean[kept] = np.linalg.solve(precision, gram[kept, -1])
        return found

    def predicted(self, means: FloatArray) -> FloatArray:
        """What nuisances and proposed effects add to the nominal prediction (T, C), each sample by its own fold."""
        total, means = np.zeros_like(self.problem.residual), means.copy()
        for index in range(len(self.instances)):
            if index not in self.proposed:
                means[:, slice(*self.span(index))] = 0.0
        for fold, mean in enumerate(means):
            rows = self.fold == fold
            total[rows] = self.columns[rows] @ mean
        return total

    def help_of(self, index: int) -> tuple[float, float]:
        """How much better held-out data are foretold with an effect than without, and how much it does there at all [nats].

        The first is the logarithm of the ratio of their predictive densities, log p(held out | fitted): numbers of the
        description that the fitted data leave open are open for both. What the fitted data have moved them by foretells as
        well as an effect does, however far that is; so what it costs is counted, too. And what no healthy robot's numbers do
        is not re-tuning: where that is more, the first is by how much the error is smaller than with those. But where what the
        effect does is not in the held-out data, or next to none of it, they speak against it however badly the fitted ones do
        without it: then the first is by how much the error is smaller, and so negative, with what it does than with nothing in
        its place. Beside numbers that are a little off an effect of the right size may be too large by more than half.
        """
        both, alone = self.means(), self.means(index)
        better = self._foretold(self._kept(None)) - self._foretold(self._kept(index))
        better += self._retuning(alone) - self._retuning(both)
        if np.any(np.abs(alone[:, : self.nuisances]) > self._limits(both)):
            better = max(better, self._error(self._healthy_means(index, self._limits(both))) - self._error(both))
        rows = slice(*self.span(index))
        work = 0.5 * float(sum(m[rows] @ gram[rows, rows] @ m[rows] for m, gram in zip(both, self.test, strict=True)))
        by_manoeuvre = self._errors(self._idle(index)) - self._errors(both)
        smaller = float(by_manoeuvre.sum())
        # The error is a parabola of the part of the effect that is at work, and least at (1 + smaller / work) / 2 of it.
        contradicted = smaller < min(-CONTRADICTED, (2.0 * LEAST_PART - 1.0) * work)
        if contradicted and -smaller < self._fitted(index):
            contradicted = smaller < -AGREED * _deviation_of_sum(by_manoeuvre)
        return smaller if contradicted else better, work

    def _fitted(self, index: int) -> float:
        """What the fitted data say for an effect [nats], on average over the folds."""
        kept, everything = self._kept(index), self._kept(None)
        return float(np.mean([self._log_evidence(g, everything) - self._log_evidence(g, kept) for g in self.train]))

    def is_smaller_with(self, index: int) -> bool:
        """Whether the error of held-out data is smaller with an effect than with nothing in its place, and than without it."""
        return self._error(self.means()) < min(self._error(self._idle(index)), self._error(self.means(index)))

    def _idle(self, index: int) -> FloatArray:
        """Fitted numbers of every fold (F, k) with nothing in the place of an effect."""
        idle = self.means()
        idle[:, slice(*self.span(index))] = 0.0
        return idle

    def _limits(self, means: FloatArray) -> FloatArray:
        """Changes (F, nuisances) up to which numbers of the description are those of a healthy robot, or as far as here."""
        limits: FloatArray = np.maximum(self.healthy, np.abs(means[:, : self.nuisances]))
        return limits

    def _healthy_means(self, without: int, limits: FloatArray) -> FloatArray:
        """Fitted numbers of every fold (F, k) without one effect, none of the description's beyond limits (F, nuisances)."""
        kept = self._kept(without)
        found = np.zeros((len(self.train), len(self.deviations)))
        for mean, gram, limit in zip(found, self.train, limits, strict=True):
            root = np.linalg.cholesky(gram[np.ix_(kept, kept)] + np.diag(1.0 / self.deviations[kept] ** 2))
            bound = np.full(len(kept), np.inf)
            bound[: self.nuisances] = limit
            mean[kept] = optimize.lsq_linear(root.T, np.linalg.solve(root, gram[kept, -1]), (-bound, bound)).x
        return found

    def _error(self, means: FloatArray) -> float:
        """Half the squared error of all folds with numbers (F, k), whitened."""
        return float(self._errors(means).sum())

    def _errors(self, means: FloatArray) -> FloatArray:
        """The same of every manoeuvre (M,)."""
        extended = np.concatenate([-means, np.ones((len(means), 1))], axis=1)[self.judge]
        return 0.5 * np.einsum("mi,mij,mj->m", extended, self.tests, extended)

    def _retuning(self, means: FloatArray) -> float:
        """Half the squared distance of the description's numbers from nominal, in tolerances."""
        moved = means[:, : self.nuisances] / self.deviations[: self.nuisances]
        return 0.5 * float(np.mean(np.sum(moved**2, axis=1)))

    def _foretold(self, kept: IntArray) -> float:
        """Logarithm of the predictive density of all folds, but for what no choice of columns changes."""
        return sum(
            self._log_evidence(train + test, kept) - self._log_evidence(train, kept)
            for train, test in zip(self.train, self.test, strict=True)
        )

    def _log_evidence(self, gram: FloatArray, kept: IntArray) -> float:
        """Logarithm of the density of data with a Gram matrix, over the prior of the columns that are kept."""
        deviations = self.deviations[kept]
        factor = np.linalg.cholesky(np.outer(deviations, deviations) * gram[np.ix_(kept, kept)] + np.eye(len(kept)))
        half = np.linalg.solve(factor, deviations * gram[kept, -1])
        return -float(np.sum(np.log(np.diag(factor)))) - 0.5 * float(gram[-1, -1] - half @ half)


def _deviation_of_sum(parts: FloatArray) -> float:
    """Standard deviation of a sum by what its parts (M,) differ by; 0 of one, which says nothing of that."""
    return float(np.std(parts) * len(parts) / math.sqrt(max(len(parts) - 1, 1)))


def _trust(left: FloatArray, valid: BoolArray) -> FloatArray:
    """Weights of held-out samples (T, C), from what the fit leaves of them, whitened by the noise of the fitted ones.

    Where a motion is wilder than all that was fitted, what the model does wrong there is no noise of the fitted recordings:
    it would make sure of differences between two sets of effects that mean nothing.
    """
    deviations = np.maximum(channel_deviations(left, valid), 1.0)
    weights: FloatArray = huber_weights(left / deviations) / deviations**2
    return weights


def _exact_elsewhere(problem: RegressionProblem, other: RegressionProblem) -> RegressionProblem:
    """The other problem, exact where the first one is."""
    if problem.point is None:
        return other
    places = {term.key: index for index, term in enumerate(other.terms)}
    sizes = []
    for size in problem.point.sizes:
        if size.term >= len(problem.terms) or problem.terms[size.term].key not in places:
            continue
        term = problem.terms[size.term]
        place = places[term.key]
        names, there = [p.name for p in term.parameters], [p.name for p in other.terms[place].parameters]
        known = dict(zip(names, size.coefficients, strict=True))
        coefficients = np.array([known.get(name, 0.0) for name in there])
        active = tuple(there.index(names[k]) for k in size.active if names[k] in there)
        sizes.append(SizedTerm(place, size.shape, coefficients, active))
    exact = other.with_headings(problem.point.changes).exact_at(problem.point.changes, sizes)
    exact = exact.derived() if problem.point.derived else exact
    # What was exact at one shape, and then fitted at another one near it, has columns of the same kind here as there.
    refined = {places[problem.terms[index].key] for index in problem.near if problem.terms[index].key in places}
    for size in sizes:
        if size.term in refined:
            exact = exact.around(size.term, size.shape)
    return exact


def _positions(instances: Sequence[Instance], wanted: Collection[Instance]) -> tuple[int, ...]:
    return tuple(index for index, instance in enumerate(instances) if instance in wanted)


def _columns_elsewhere(
    problem: RegressionProblem, instances: Sequence[Instance], other: RegressionProblem, gone: Collection[Instance] = ()
) -> FloatArray:
    """Columns (T, C, k) in another problem of the nuisances and effects of a problem, matched by name; zeros for `gone`."""
    nuisances = {nuisance.name: nuisance.column for nuisance in other.nuisances}
    places = {term.key: index for index, term in enumerate(other.terms)}
    nothing = np.zeros(other.residual.shape)
    parts = [nuisances.get(nuisance.name, nothing)[:, :, None] for nuisance in problem.nuisances]
    for instance in instances:
        term = problem.terms[instance.term]
        names = [term.parameters[k].name for k in instance.active]
        if term.key not in places or instance in gone:
            parts.append(np.zeros((*nothing.shape, len(names))))
            continue
        place = places[term.key]
        shown = {parameter.name: k for k, parameter in enumerate(other.terms[place].parameters)}
        columns = other.columns(place, instance.shape)
        parts.append(np.stack([columns[..., shown[n]] if n in shown else nothing for n in names], axis=2))
    return np.concatenate(parts, axis=2) if parts else np.zeros((*nothing.shape, 0))
