"""The regression in whitened coordinates: evidence, joint fit, scan of all candidates, blocked cross-validation.

With whitened rows y = X theta + e, theta ~ Normal(0, D), e ~ Normal(0, 1),

    A = X^T X + D^-1,   m = A^-1 X^T y,
    log evidence = -1/2 (log|A| + log|D|) - 1/2 (y^T y - m^T X^T y) + const,

so that every question is answered from Gram matrices. They are kept per block of time, which makes a cross-validation
as cheap as a fit.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
import math
from collections import OrderedDict
from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy import linalg, special, stats

from ..all_cores import on_all_cores
from .column_bank import ColumnBank
from .noise_model import NoiseModel
from .regression_problem import FloatArray, IntArray, RegressionProblem, Shape
from .slow_drifts import beside, drifting_columns

PIECE = 1.0  # of a recording, long enough for the errors of one to say little of the next [s]
# Re-tuning that leaves less than this part of what an effect does may be all there is to it, the rest being curvature.
RETUNED_SHARE = 0.05
# By so much more may a size come out to first order than there can be: numbers beside it multiply it.
CURVED_ROOM = 2.0
ROUNDING = 1e-12  # of the largest square in a matrix of some hundred rows
TRIED_BYTES = 2**26  # of columns of shapes that were only tried
TOGETHER = 40  # shapes whose columns are whitened in one go
FINITE = 2.0  # deviations, by which an inverse has to be told from zero
Frozen = tuple[tuple[str, float], ...]  # a shape as the key of a dictionary


@dataclasses.dataclass(frozen=True)
class Instance:
    """A term at work, with one shape.

    Attributes:
        term: index into the problem's terms.
        shape: items of the shaping parameters.
        active: positions of the linear parameters in use (refinements may be off).
        occam: evidence paid for having chosen the shape among others (>= 0).
    """

    term: int
    shape: tuple[tuple[str, float], ...]
    active: tuple[int, ...]
    occam: float = 0.0


@dataclasses.dataclass(frozen=True)
class Fit:
    """Joint posterior of nuisances and effects.

    Attributes:
        mean: nuisances first, then the instances' active parameters in order (k,).
        covariance: of `mean` (k, k).
        log_evidence: up to a constant shared by all sets on the same whitened problem.
        scale: mean square of the whitened residual; below 1 for a red residual, see `noise_model`.
    """

    instances: tuple[Instance, ...]
    mean: FloatArray
    covariance: FloatArray
    log_evidence: float
    scale: float
    rows: int


@dataclasses.dataclass(frozen=True)
class Candidate:
    """Outcome of a scan: the best shape of one term when it is added to a set, and the gain in log evidence."""

    instance: Instance
    gain: float


@dataclasses.dataclass(frozen=True)
class _ScanGroup:
    """Candidates of one number P of base parameters, one row per term and shape, shapes of a term on end.

    Attributes:
        keys: term and shape of each; term: the former alone (K,).
        columns: places in the bank (K, P); gram: their products with one another (K, P, P).
        deviations, lower, upper: of the parameters (K, P).
        log_prior: of the terms (K,).
    """

    keys: tuple[tuple[int, Frozen], ...]
    term: IntArray
    columns: IntArray
    gram: FloatArray
    deviations: FloatArray
    lower: FloatArray
    upper: FloatArray
    log_prior: FloatArray


def forward_substituted(factor: npt.NDArray[Any], values: npt.NDArray[Any]) -> FloatArray:
    """Return the solution (k, N) of a lower triangle (k, k) for values (k, N); k may be 0, which not every LAPACK takes."""
    if not len(factor):
        return values
    solved: FloatArray = linalg.solve_triangular(factor, values, lower=True)
    return solved


def marginal_gains(
    gram: FloatArray, cross: FloatArray, moment: FloatArray, projected: FloatArray, deviations: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Gain in log evidence (K, N) of K candidates of P parameters each, for N targets, and their parameters (K, P, N).

    Args:
        gram: of each candidate's own columns (K, P, P).
        cross: L^-1 X^T of all candidates' columns (k, K P), with L L^T the precision of the set.
        moment: candidates' columns times targets (K P, N).
        projected: L^-1 X^T of the targets (k, N).
        deviations: of the parameters (K or 1, P).
    """
    count, width = gram.shape[0], gram.shape[1]
    moment = (moment - cross.T @ projected).reshape(count, width, -1)
    cross = cross.reshape(-1, count, width)
    schur = gram - np.einsum("ksp,ksq->spq", cross, cross, optimize=True)
    schur = schur + np.eye(width) / deviations[:, :, None] ** 2
    mean: FloatArray = np.linalg.solve(schur, moment)
    explained = np.einsum("spn,spn->sn", moment, mean)
    log_determinant = np.linalg.slogdet(schur)[1] + 2.0 * np.sum(np.log(deviations), axis=1)
    gain: FloatArray = 0.5 * explained - 0.5 * log_determinant[:, None]
    return gain, mean


def _gains_within(
    gram: FloatArray,
    cross: FloatArray,
    moment: FloatArray,
    projected: FloatArray,
    deviations: FloatArray,
    lower: FloatArray,
    upper: FloatArray,
) -> FloatArray:
    """The same, -inf where a parameter is beyond its bounds (K or 1, P)."""
    gain, mean = marginal_gains(gram, cross, moment, projected, deviations)
    allowed = np.all((mean >= lower[:, :, None]) & (mean <= upper[:, :, None]), axis=1)
    result: FloatArray = np.where(allowed, gain, -np.inf)
    return result


class WhitenedRegression:
    """One problem under one noise model and one set of robust weights.

    Whitened columns stand in one bank, to which those are added that are asked for; fits and scans only pick from it.
    """

    def __init__(
        self, problem: RegressionProblem, noise: NoiseModel, weights: FloatArray, block: IntArray | None
    ) -> None:
        """Whiten residual and nuisances.

        Args:
            weights: robust weight per whitened sample (T, C).
            block: block of each sample for cross-validation (T,), non-decreasing; None: the channels are the blocks, and
                `rescale` may weigh them anew (with white noise only, which ties no channel to another).
        """
        self.problem = problem
        self.noise = noise
        self._weights, self._block = weights, block
        usable = problem.valid
        samples = np.arange(usable.size).reshape(usable.shape)
        self._flat = samples[usable] if block is not None else samples.T[usable.T]
        self._root = np.sqrt(weights.ravel()[self._flat])
        self.target = self._rows(problem.residual)
        self.nuisance = self._rows(problem.nuisance_columns())
        self.rows = len(self._flat)
        # Robust weights lower the information; the evidence counts samples by weight.
        self.effective_rows = float(np.sum(self._root**2))
        channels = problem.residual.shape[1]
        sample_block = self._flat % channels if block is None else block[self._flat // channels]
        self._sample_block = sample_block
        edges = np.flatnonzero(np.diff(sample_block)) + 1
        bounds = [0, *edges.tolist(), self.rows]
        self.blocks = [slice(a, b) for a, b in zip(bounds[:-1], bounds[1:], strict=True)]
        self._bank = ColumnBank(self.blocks, self.rows)
        self._base = slice(self._bank.add(self.nuisance).start, self._bank.add(self.target[:, None]).stop)
        self._places: dict[tuple[int, Frozen], slice] = {}
        self._long_scans: dict[int, tuple[npt.NDArray[np.float32], FloatArray]] = {}
        self._short_scans: list[_ScanGroup] | None = None
        self._tried: OrderedDict[tuple[int, Frozen], FloatArray] = OrderedDict()
        self._tried_bytes = 0

    def _rows(self, values: FloatArray) -> FloatArray:
        """Whiten (T, C) or (T, C, K), keep usable rows, apply root weights -> (R,) or (R, K)."""
        rows = self.noise.whitened_rows(values, self.problem.valid, self.problem.segment, self._flat, self._root)
        return rows if values.ndim > 2 else rows[:, 0]

    def moved(self, problem: RegressionProblem) -> WhitenedRegression:
        """Whiten the same problem, exact elsewhere, by the same noise."""
        return WhitenedRegression(problem, self.noise, self._weights, self._block)

    def rescale(self, deviations: FloatArray) -> None:
        """Take the noise of each channel to have these deviations (C,)."""
        before = 1.0 / self.noise.taps[self.block_labels(), 0]
        self.noise = dataclasses.replace(self.noise, taps=1.0 / deviations[:, None])
        factors = before / deviations[self.block_labels()]
        for piece, factor in zip(self.blocks, factors, strict=True):
            self.target[piece] *= factor
            self.nuisance[piece] *= factor
        self._bank.rescale(factors)
        self._long_scans.clear()
        self._tried.clear()
        self._tried_bytes = 0
        self._short_scans = None

    def block_labels(self) -> list[int]:
        """Labels of the blocks that hold usable rows, in the order of `blocks`."""
        return [int(self._sample_block[piece.start]) for piece in self.blocks]

    def spread(self, rows: FloatArray) -> FloatArray:
        """Put values of the usable rows back in their place (T, C), zero elsewhere."""
        full = np.zeros(self.problem.residual.size)
        full[self._flat] = rows
        return full.reshape(self.problem.residual.shape)

    @functools.cached_property
    def _drifting(self) -> FloatArray:
        """Whitened columns (R, K) of the model's own errors."""
        return self._rows(drifting_columns(self.problem))

    def peculiar(self, values: FloatArray) -> float:
        """Evidence of a contribution (T, C) that the model's own errors, varying slowly, could not give [nats]."""
        return 0.5 * beside(self._drifting, self._rows(values))

    def gather(self, values: FloatArray) -> FloatArray:
        """Inverse of `spread`: take the usable rows (R,) out of (T, C)."""
        gathered: FloatArray = values.ravel()[self._flat]
        return gathered

    def whiten_columns(self, columns: FloatArray) -> FloatArray:
        """Whiten further columns (T, C, K) -> (R, K)."""
        return self._rows(columns)

    def _place(self, term: int, shape: Frozen) -> slice:
        """Where the columns of a term at one shape stand in the bank."""
        if (term, shape) not in self._places:
            self._places[term, shape] = self._bank.add(self._rows(self.problem.columns(term, shape)))
        return self._places[term, shape]

    def _indices(self, instance: Instance) -> IntArray:
        return self._place(instance.term, instance.shape).start + np.array(instance.active, dtype=np.int64)

    def columns(self, instance: Instance) -> FloatArray:
        """Whitened exact columns of an instance's active parameters (R, active)."""
        return self._bank.columns(self._indices(instance))

    def tried_columns(self, instances: Sequence[Instance]) -> list[FloatArray]:
        """The same of shapes of terms that are only tried, all at once; the last ones are remembered."""
        keys = [(instance.term, instance.shape) for instance in instances]
        known = {key: self._tried[key] for key in keys if key in self._tried}
        new = [key for key in dict.fromkeys(keys) if key not in known and key not in self._places]
        if new:
            raw = on_all_cores(lambda key: self.problem.tried_columns(*key), new)
            edges = np.cumsum([columns.shape[2] for columns in raw])[:-1]
            known |= zip(new, np.split(self._rows(np.concatenate(raw, axis=2)), edges, axis=1), strict=True)
        for key in known:
            if key not in self._tried:
                self._tried_bytes += known[key].nbytes
            self._tried[key] = known[key]
            self._tried.move_to_end(key)
        while self._tried_bytes > TRIED_BYTES and len(self._tried) > 1:
            self._tried_bytes -= self._tried.popitem(last=False)[1].nbytes
        return [
            known[key][:, list(instance.active)] if key in known else self.columns(instance)
            for key, instance in zip(keys, instances, strict=True)
        ]

    def deviations(self, instances: Sequence[Instance]) -> FloatArray:
        """Prior deviations of nuisances and active parameters (k,)."""
        parts = [self.problem.nuisance_deviations()]
        for instance in instances:
            parameters = self.problem.terms[instance.term].parameters
            parts.append(np.array([parameters[i].deviation for i in instance.active]))
        return np.concatenate(parts)

    def _picked(self, instances: Sequence[Instance]) -> IntArray:
        """Places in the bank of [nuisances, instances..., target]."""
        nuisances = np.arange(self._base.start, self._base.stop - 1)
        return np.concatenate([nuisances, *[self._indices(i) for i in instances], [self._base.stop - 1]])

    def grams(self, instances: Sequence[Instance]) -> FloatArray:
        """Block-wise Gram matrices of [nuisances, instances..., target], (blocks, k + 1, k + 1)."""
        picked = self._picked(instances)
        return self._bank.by_block(picked)

    def gram(self, instances: Sequence[Instance]) -> FloatArray:
        """Gram matrix of [nuisances, instances..., target], (k + 1, k + 1)."""
        return self._bank.gram(self._picked(instances))

    def fit(self, instances: Sequence[Instance]) -> Fit:
        """Joint fit of nuisances and instances."""
        deviations = self.deviations(instances)
        mean, inverse, log_determinant, rss = _solve(self.gram(instances), deviations)
        occam = sum(instance.occam for instance in instances)
        prior = sum(self.problem.terms[instance.term].log_prior for instance in instances)
        log_evidence = -0.5 * log_determinant - 0.5 * rss - occam + prior
        scale = rss / self.effective_rows
        return Fit(tuple(instances), mean, inverse, float(log_evidence), float(scale), self.rows)

    def design(self, instances: Sequence[Instance]) -> FloatArray:
        """Whitened columns of nuisances and instances (R, k)."""
        return np.concatenate([self.nuisance, *[self.columns(i) for i in instances]], axis=1)

    def whitened_residual(self, fit: Fit) -> FloatArray:
        """Whitened, weighted residual of a fit (R,)."""
        return self.target - self.design(fit.instances) @ fit.mean

    def block_scores(self, instances: Sequence[Instance]) -> FloatArray:
        """Squared whitened error of every block, predicted from the fit to all other blocks, (blocks,)."""
        grams = self.grams(instances)
        deviations = self.deviations(instances)
        precision = np.diag(1.0 / deviations**2)
        others = grams.sum(axis=0) - grams
        mean = np.linalg.solve(others[:, :-1, :-1] + precision, others[:, :-1, -1:])[:, :, 0]
        extended = np.concatenate([-mean, np.ones((len(grams), 1))], axis=1)
        scores: FloatArray = np.einsum("bi,bij,bj->b", extended, grams, extended)
        return scores

    def misfit_covariance(self, fit: Fit) -> FloatArray:
        """Covariance (k, k) of a fit's numbers by how the blocks disagree about them, whatever the residual is like.

        Where the model is not quite right the residual is no noise, and one block pulls the numbers this way and another that
        way by more than their own noise would: (A^-1 S A^-1), S the covariance of the sum of the blocks' scores. How much they
        disagree few blocks hardly tell: it is that of a normal distribution with intervals as wide as Student's.
        Source: White, Econometrica 48 (1980); with blocks as clusters, Liang and Zeger, Biometrika 73 (1986).
        """
        grams = self.grams(fit.instances)
        scores = grams[:, :-1, -1] - grams[:, :-1, :-1] @ fit.mean
        scores -= scores.mean(axis=0)
        pulled = scores @ fit.covariance
        freedom = max(len(grams) - 1, 1)
        wider = float(stats.t.ppf(0.975, freedom) / stats.norm.ppf(0.975))
        covariance: FloatArray = pulled.T @ pulled * (len(grams) / freedom * wider**2)
        return covariance

    def log_odds(self, other: Fit, fit: Fit) -> float:
        """Log odds of one set against another that has more evidence; see `odds`."""
        left, other_left = self.whitened_residual(fit), self.whitened_residual(other)
        return self.odds(other.log_evidence - fit.log_evidence, left, other_left)

    def odds(self, difference: float, left: FloatArray, other_left: FloatArray) -> float:
        """Log odds of a set that has so much more evidence than another, no surer than the recording's pieces agree on them.

        Args:
            difference: in evidence [nats]; below zero where the other set is the better one.
            left, other_left: what the other one and it leave, whitened by this regression's noise (N,).

        Evidence adds up advantages as if one of the two were exact. Where neither is, one describes this piece better and
        the other that one, and a sum of which the pieces make a large part by chance decides nothing.
        Source: Vuong, Econometrica 57 (1989): the sum against its own scatter; here by pieces, whose errors are related.
        """
        advantage = left**2 - other_left**2
        time = self._flat // self.problem.residual.shape[1]
        _, piece = np.unique(time // max(round(PIECE * self.problem.rate), 1), return_inverse=True)
        pieces = np.bincount(piece, weights=0.5 * advantage)
        scatter = float(np.std(pieces, ddof=1)) * math.sqrt(len(pieces)) if len(pieces) > 1 else math.inf
        doubt = float(special.logit(stats.t.cdf(difference / max(scatter, 1e-300), len(pieces) - 1)))
        return max(difference, doubt)

    def retuned_instead(self, fit: Fit, index: int) -> Fit | None:
        """The fit without one of its instances, whose work is done by re-tuning; None where that would leave much of it.

        Of all the ways to do nearly the same the one that the tolerances like best: closer ones follow the curvature of the
        instance's columns, and may be far away.
        """
        instance, count = fit.instances[index], self.nuisance.shape[1]
        start = count + sum(len(other.active) for other in fit.instances[:index])
        own = slice(start, start + len(instance.active))
        work = self.columns(instance) @ fit.mean[own]
        deviations = self.problem.nuisance_deviations()
        scaled = self.nuisance * (deviations / max(RETUNED_SHARE * float(np.linalg.norm(work)), 1e-300))
        target = work / max(RETUNED_SHARE * float(np.linalg.norm(work)), 1e-300)
        steps = np.linalg.solve(scaled.T @ scaled + np.eye(count), scaled.T @ target)
        if float(np.linalg.norm(target - scaled @ steps)) > 1.0:
            return None
        others = fit.instances[:index] + fit.instances[index + 1 :]
        mean = np.delete(fit.mean, own)
        mean[:count] += steps * deviations
        return dataclasses.replace(self.fit(others), mean=mean)

    def cost(self, fit: Fit) -> float:
        """Half the squared error of a fit's numbers, and half their squared distance from what is expected of them [nats]."""
        error = float(np.sum(self.whitened_residual(fit) ** 2))
        return 0.5 * (error + float(np.sum((fit.mean / self.deviations(fit.instances)) ** 2)))

    def tolerance_cost(self, fit: Fit, firm: bool = False) -> float:
        """Half the squared distance of numbers from the description [nats], in tolerances; firm: without loose ones."""
        numbers = self.problem.nuisances
        counted = np.array([not (firm and number.loose) for number in numbers], dtype=bool)
        distances = fit.mean[: len(numbers)] / self.problem.nuisance_deviations()
        return 0.5 * float(np.sum(distances[counted] ** 2))

    # -- scan ---------------------------------------------------------------------------------------------------

    def _long_scan(self, term_index: int) -> tuple[npt.NDArray[np.float32], FloatArray]:
        """Whitened scan columns (R, shapes, P) of a term with a long grid, and their Gram matrices (shapes, P, P)."""
        if term_index not in self._long_scans:
            term = self.problem.terms[term_index]
            base = term.scan()[..., list(term.base_indices())]  # type: ignore[misc]
            samples, channels, shapes, width = base.shape
            white = self._rows(base.reshape(samples, channels, shapes * width))
            narrow = white.astype(np.float32).reshape(-1, shapes, width)
            gram = np.einsum("rsp,rsq->spq", narrow, narrow, optimize=True).astype(float)
            self._long_scans[term_index] = (narrow, gram)
        return self._long_scans[term_index]

    def _short_scan(self) -> list[_ScanGroup]:
        """All terms without a long grid, grouped by their number of base parameters."""
        if self._short_scans is None:
            problem = self.problem
            wanted = [
                (index, tuple(sorted(shape.items())))
                for index, term in enumerate(problem.terms)
                if term.scan is None
                for shape in term.shapes
            ]
            missing = [key for key in wanted if key not in self._places]
            if missing:
                # Shapes of one term may share what they are put together from: one after the other.
                by_term = [list(keys) for _, keys in itertools.groupby(missing, key=lambda key: key[0])]
                raw = sum(on_all_cores(lambda keys: [problem.columns(*key) for key in keys], by_term), [])
                self._bank.reserve(sum(columns.shape[2] for columns in raw))
                pieces = [raw[k : k + TOGETHER] for k in range(0, len(raw), TOGETHER)]
                whitened = on_all_cores(lambda some: self._rows(np.concatenate(some, axis=2)), pieces)
                place = min(self._bank.add(columns).start for columns in whitened)
                for key, columns in zip(missing, raw, strict=True):
                    self._places[key] = slice(place, place + columns.shape[2])
                    place += columns.shape[2]
            groups: dict[int, list[tuple[int, Frozen]]] = {}
            for key in wanted:
                groups.setdefault(len(problem.terms[key[0]].base_indices()), []).append(key)
            self._short_scans = []
            for keys in groups.values():
                places = np.array(
                    [[self._places[key].start + i for i in problem.terms[key[0]].base_indices()] for key in keys],
                    dtype=np.int64,
                )
                room = np.array([[self._room(index)] for index, _ in keys])
                self._short_scans.append(_ScanGroup(
                    keys=tuple(keys),
                    term=np.array([index for index, _ in keys]),
                    columns=places,
                    gram=self._bank.own_grams(places),
                    deviations=self._per_key(keys, "deviation"),
                    lower=self._per_key(keys, "lower") * room,
                    upper=self._per_key(keys, "upper") * room,
                    log_prior=np.array([problem.terms[index].log_prior for index, _ in keys]),
                ))  # fmt: skip
        return self._short_scans

    def _per_key(self, keys: Sequence[tuple[int, Frozen]], name: str) -> FloatArray:
        terms = self.problem.terms
        return np.array([[getattr(terms[t].parameters[i], name) for i in terms[t].base_indices()] for t, _ in keys])

    def _room(self, term: int) -> float:
        """Factor on the bounds of a term's sizes: of what is not in proportion to its size a first order says only so much."""
        point = self.problem.point
        there = point is not None and any(size.term == term for size in point.sizes)
        return CURVED_ROOM if self.problem.terms[term].is_curved and not there else 1.0

    def scan(
        self,
        instances: Sequence[Instance],
        targets: FloatArray | None = None,
        only: Sequence[int] | None = None,
    ) -> list[list[Candidate]]:
        """Return for each target the best candidate of every term that may be added to a set.

        Args:
            instances: the set.
            targets: whitened targets (R, N); None for the problem's own. A surrogate of pure noise goes in here.
            only: indices of the terms to look at; None for all.

        Returns:
            N lists of candidates, for the problem's own target sorted by gain; gain is marginal over the grid of shapes,
            -inf where a sign is not allowed.
        """
        short = self._short_scan()
        with_target = self._picked(instances)
        picked = with_target[:-1]
        bank, deviations = self._bank, self.deviations(instances)
        gram = bank.gram(with_target)
        factor = np.linalg.cholesky(gram[:-1, :-1] + np.diag(1.0 / deviations**2))
        own = gram[:-1, -1:] if targets is None else bank.columns(picked).T @ targets
        projected = forward_substituted(factor, own)
        used = {instance.term for instance in instances}

        def wanted(index: int) -> bool:
            return (only is None or index in only) and (index not in used or self.problem.terms[index].repeatable)

        results: list[list[Candidate]] = [[] for _ in range(own.shape[1])]
        for group in short:
            keep = np.array([wanted(index) for index in group.term], dtype=bool)
            if not keep.any():
                continue
            columns = group.columns[keep]
            flat = columns.ravel()
            products = bank.products(with_target, flat)
            cross = forward_substituted(factor, products[:-1])
            moment = products[-1:].T if targets is None else bank.columns(flat).T @ targets
            gains = _gains_within(
                group.gram[keep], cross, moment, projected,
                group.deviations[keep], group.lower[keep], group.upper[keep],
            ) + group.log_prior[keep][:, None]  # fmt: skip
            keys = [key for key, kept in zip(group.keys, keep, strict=True) if kept]
            self._collect(keys, gains, results)
        for index, term in enumerate(self.problem.terms):
            if term.scan is None or not wanted(index):
                continue
            white, gram = self._long_scan(index)
            flat_columns = white.reshape(len(white), -1)
            design = bank.columns(picked)
            cross = forward_substituted(factor, (flat_columns.T @ design.astype(np.float32)).astype(float).T)
            right = self.target[:, None] if targets is None else targets
            moment = (flat_columns.T @ right.astype(np.float32)).astype(float)
            parameters = [term.parameters[i] for i in term.base_indices()]
            deviation = np.array([[p.deviation for p in parameters]])
            lower, upper = (self._room(index) * np.array([[getattr(p, n) for p in parameters]]) for n in ("lower", "upper"))
            gains = _gains_within(gram, cross, moment, projected, deviation, lower, upper) + term.log_prior
            self._collect([(index, tuple(sorted(shape.items()))) for shape in term.shapes], gains, results)
        if targets is None:
            results[0].sort(key=lambda candidate: -candidate.gain)
        return results

    def _collect(
        self, keys: Sequence[tuple[int, Frozen]], gains: FloatArray, results: list[list[Candidate]]
    ) -> None:
        """Add the best shape of every term to the results, with its gain marginal over the shapes; gains (keys, N)."""
        terms = np.array([index for index, _ in keys])
        starts = np.flatnonzero(np.r_[True, np.diff(terms) != 0])
        counts = np.diff([*starts, len(terms)])
        top = np.maximum.reduceat(gains, starts, axis=0)
        order = np.arange(len(terms))[:, None]
        best = np.minimum.reduceat(np.where(gains == np.repeat(top, counts, axis=0), order, len(terms)), starts, axis=0)
        # A grid that was narrowed down beforehand is paid for as the whole that it was chosen from.
        whole = [max(self.problem.terms[index].grid_size, count) for index, count in zip(terms[starts], counts, strict=True)]
        with np.errstate(invalid="ignore", over="ignore"):
            shares = np.add.reduceat(np.exp(gains - np.repeat(top, counts, axis=0)), starts, axis=0)
            marginal = top + np.log(shares) - np.log(whole)[:, None]
        for row, index in enumerate(terms[starts].tolist()):
            base = self.problem.terms[index].base_indices()
            for n, result in enumerate(results):
                finite = bool(np.isfinite(top[row, n]))
                value = float(marginal[row, n]) if finite else -np.inf
                occam = float(top[row, n] - marginal[row, n]) if finite else 0.0
                result.append(Candidate(Instance(index, keys[int(best[row, n])][1], base, occam), value))

    def within_bounds(self, fit: Fit) -> bool:
        """Whether every parameter of a fit lies within its bounds."""
        return all(self.each_within_bounds(fit))

    def each_within_bounds(self, fit: Fit, strictly: bool = False) -> list[bool]:
        """Whether all parameters of an instance lie within their bounds, per instance; strictly: a first order's, too."""
        position, within = self.nuisance.shape[1], []
        for instance in fit.instances:
            parameters = self.problem.terms[instance.term].parameters
            room = 1.0 if strictly else self._room(instance.term)
            means = fit.mean[position : position + len(instance.active)] / room
            within.append(
                all(parameters[k].lower <= mean <= parameters[k].upper for k, mean in zip(instance.active, means, strict=True))
            )
            position += len(instance.active)
        return within

    def each_finite(self, fit: Fit) -> list[bool]:
        """Whether the value of every reciprocal parameter is told from an infinite one, per instance.

        A tyre of which all slip is missing that it is described to have is no tyre of infinite stiffness: no force was there.
        """
        position, finite, variances = self.nuisance.shape[1], [], None
        for instance in fit.instances:
            told = True
            for k, parameter in enumerate(self.problem.terms[instance.term].parameters[i] for i in instance.active):
                if parameter.reciprocal and math.isfinite(parameter.origin) and parameter.origin != parameter.pole:
                    if variances is None:
                        variances = np.maximum(np.diag(fit.covariance), np.diag(self.misfit_covariance(fit)))
                    low = fit.mean[position + k] - FINITE * math.sqrt(variances[position + k])
                    told &= bool(low > parameter.coefficient(math.inf))
            finite.append(told)
            position += len(instance.active)
        return finite

    def with_shape(self, instance: Instance, shape: Shape) -> Instance:
        """Return the instance with another shape."""
        return dataclasses.replace(instance, shape=tuple(sorted(shape.items())))

    def unwhitened_residual(self, fit: Fit) -> FloatArray:
        """Residual of a fit in the channels' units (T, C)."""
        return self.problem.residual - predicted(self.problem, fit)


def predicted(problem: RegressionProblem, fit: Fit) -> FloatArray:
    """What nuisances and effects of a fit add to the nominal prediction (T, C)."""
    count = len(problem.nuisances)
    total: FloatArray = problem.nuisance_columns() @ fit.mean[:count]
    position = count
    for instance in fit.instances:
        columns = problem.columns(instance.term, instance.shape)[..., list(instance.active)]
        total = total + columns @ fit.mean[position : position + len(instance.active)]
        position += len(instance.active)
    return total


def _solve(gram: FloatArray, deviations: FloatArray) -> tuple[FloatArray, FloatArray, float, float]:
    """Posterior from the Gram matrix of [X, y]: mean, A^-1, log|A| + log|D|, RSS with the prior's part."""
    k = len(deviations)
    scaled = gram[:k, :k] * np.outer(deviations, deviations) + np.eye(k)
    moment = gram[:k, k] * deviations
    try:
        factor = np.linalg.cholesky(scaled)
    except np.linalg.LinAlgError:
        # The model was followed to where it leaves so much that rounding swallows the prior: that place has no evidence in any
        # case, and a prior as large as the rounding says so.
        scaled += ROUNDING * float(np.max(np.diag(scaled))) * np.eye(k)
        factor = np.linalg.cholesky(scaled)
    half = np.linalg.solve(factor, moment)
    inverse = np.linalg.inv(scaled)
    mean = inverse @ moment * deviations
    rss = max(float(gram[k, k] - half @ half), 1e-12 * float(gram[k, k]) + 1e-300)
    return mean, inverse * np.outer(deviations, deviations), 2.0 * float(np.sum(np.log(np.diag(factor)))), rss
