"""The regression in whitened coordinates: evidence, joint fit, scan of all candidates, blocked cross-validation.

With whitened rows y = X theta + e, theta ~ Normal(0, D), e ~ Normal(0, 1),

    A = X^T X + D^-1,   m = A^-1 X^T y,
    log evidence = -1/2 (log|A| + log|D|) - 1/2 (y^T y - m^T X^T y) + const,

so that every question is answered from Gram matrices. They are kept per block of time, which makes a cross-validation
as cheap as a fit.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from .noise_model import NoiseModel
from .regression_problem import FloatArray, IntArray, RegressionProblem, Shape


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


class WhitenedRegression:
    """One problem under one noise model and one set of robust weights."""

    def __init__(
        self, problem: RegressionProblem, noise: NoiseModel, weights: FloatArray, block: IntArray
    ) -> None:
        """Whiten residual and nuisances.

        Args:
            weights: robust weight per whitened sample (T, C).
            block: block of each sample for cross-validation (T,), non-decreasing.
        """
        self.problem = problem
        self.noise = noise
        usable = noise.usable(problem.valid, problem.segment)
        self._flat = np.flatnonzero(usable.ravel())
        self._root = np.sqrt(weights.ravel()[self._flat])
        self.target = self._rows(problem.residual)
        self.nuisance = self._rows(problem.nuisance_columns())
        self.rows = len(self._flat)
        # Robust weights lower the information; the evidence counts samples by weight.
        self.effective_rows = float(np.sum(self._root**2))
        sample_block = block[self._flat // problem.residual.shape[1]]
        self._sample_block = sample_block
        edges = np.flatnonzero(np.diff(sample_block)) + 1
        bounds = [0, *edges.tolist(), self.rows]
        self.blocks = [slice(a, b) for a, b in zip(bounds[:-1], bounds[1:], strict=True)]
        self._columns: dict[tuple[int, tuple[tuple[str, float], ...]], FloatArray] = {}
        self._products: dict[tuple[object, object], FloatArray] = {}
        self._scans: dict[int, tuple[FloatArray, FloatArray]] = {}

    def _rows(self, values: FloatArray) -> FloatArray:
        """Whiten (T, C) or (T, C, K), keep usable rows, apply root weights -> (R,) or (R, K)."""
        white = self.noise.whiten(values, self.problem.valid, self.problem.segment)
        flat = white.reshape(-1, *values.shape[2:])[self._flat]
        return flat * self._root.reshape(-1, *(1,) * (flat.ndim - 1))

    def block_labels(self) -> list[int]:
        """Labels of the blocks that hold usable rows, in the order of `blocks`."""
        return [int(self._sample_block[piece.start]) for piece in self.blocks]

    def spread(self, rows: FloatArray) -> FloatArray:
        """Put values of the usable rows back in their place (T, C), zero elsewhere."""
        full = np.zeros(self.problem.residual.size)
        full[self._flat] = rows
        return full.reshape(self.problem.residual.shape)

    def gather(self, values: FloatArray) -> FloatArray:
        """Inverse of `spread`: take the usable rows (R,) out of (T, C)."""
        gathered: FloatArray = values.ravel()[self._flat]
        return gathered

    def whiten_columns(self, columns: FloatArray) -> FloatArray:
        """Whiten further columns (T, C, K) -> (R, K)."""
        return self._rows(columns)

    def columns(self, instance: Instance) -> FloatArray:
        """Whitened exact columns of an instance's active parameters (R, active)."""
        key = (instance.term, instance.shape)
        if key not in self._columns:
            self._columns[key] = self._rows(self.problem.columns(*key))
        return self._columns[key][:, list(instance.active)]

    def deviations(self, instances: Sequence[Instance]) -> FloatArray:
        """Prior deviations of nuisances and active parameters (k,)."""
        parts = [self.problem.nuisance_deviations()]
        for instance in instances:
            parameters = self.problem.terms[instance.term].parameters
            parts.append(np.array([parameters[i].deviation for i in instance.active]))
        return np.concatenate(parts)

    def _product(self, a: object, left: FloatArray, b: object, right: FloatArray) -> FloatArray:
        """Block-wise left^T right, (blocks, ka, kb), remembered."""
        if (a, b) in self._products:
            return self._products[a, b]
        if (b, a) in self._products:
            return self._products[b, a].transpose(0, 2, 1)
        product = np.stack([left[piece].T @ right[piece] for piece in self.blocks])
        self._products[a, b] = product
        return product

    def grams(self, instances: Sequence[Instance]) -> FloatArray:
        """Block-wise Gram matrices of [nuisances, instances..., target], (blocks, k + 1, k + 1)."""
        keys: list[object] = ["nuisance", *[(i.term, i.shape, i.active) for i in instances], "target"]
        parts = [self.nuisance, *[self.columns(i) for i in instances], self.target[:, None]]
        sizes = [part.shape[1] for part in parts]
        starts = np.concatenate([[0], np.cumsum(sizes)])
        gram = np.empty((len(self.blocks), starts[-1], starts[-1]))
        for i, left in enumerate(parts):
            for j in range(i, len(parts)):
                product = self._product(keys[i], left, keys[j], parts[j])
                gram[:, starts[i] : starts[i + 1], starts[j] : starts[j + 1]] = product
                gram[:, starts[j] : starts[j + 1], starts[i] : starts[i + 1]] = product.transpose(0, 2, 1)
        return gram

    def fit(self, instances: Sequence[Instance]) -> Fit:
        """Joint fit of nuisances and instances."""
        gram = self.grams(instances).sum(axis=0)
        deviations = self.deviations(instances)
        mean, inverse, log_determinant, rss = _solve(gram, deviations)
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
        total = grams.sum(axis=0)
        deviations = self.deviations(instances)
        scores = np.empty(len(grams))
        for index, gram in enumerate(grams):
            mean, *_ = _solve(total - gram, deviations)
            extended = np.append(-mean, 1.0)
            scores[index] = extended @ gram @ extended
        return scores

    def tolerance_cost(self, fit: Fit) -> float:
        """Half the squared distance of the description's numbers from nominal, in tolerances [nats]."""
        count = len(self.problem.nuisances)
        return 0.5 * float(np.sum((fit.mean[:count] / self.problem.nuisance_deviations()) ** 2))

    def _scan_arrays(self, term_index: int) -> tuple[FloatArray, FloatArray]:
        """Whitened scan columns (R, shapes, P) of base parameters, and their Gram matrices (shapes, P, P)."""
        if term_index not in self._scans:
            term = self.problem.terms[term_index]
            if term.scan is not None:
                full = term.scan()
            else:
                shapes_tried = [tuple(sorted(shape.items())) for shape in term.shapes]
                full = np.stack([self.problem.columns(term_index, shape) for shape in shapes_tried], axis=2)
            base = full[..., list(term.base_indices())]
            samples, channels, shapes, width = base.shape
            white = self._rows(base.reshape(samples, channels, shapes * width))
            white = white.astype(np.float32 if shapes * width > 200 else float).reshape(-1, shapes, width)
            gram = np.einsum("rsp,rsq->spq", white, white, optimize=True).astype(float)
            self._scans[term_index] = (white, gram)
        return self._scans[term_index]

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
            N lists of candidates; gain is marginal over the grid of shapes, -inf where a sign is not allowed.
        """
        own = targets is None
        right = self.target[:, None] if targets is None else targets
        design = self.design(instances)
        deviations = self.deviations(instances)
        precision = design.T @ design + np.diag(1.0 / deviations**2)
        factor = np.linalg.cholesky(precision)
        projected = np.linalg.solve(factor, design.T @ right)
        results: list[list[Candidate]] = [[] for _ in range(right.shape[1])]
        used = {instance.term for instance in instances}
        for index, term in enumerate(self.problem.terms):
            if (only is not None and index not in only) or (index in used and not term.repeatable):
                continue
            white, gram = self._scan_arrays(index)
            _, shapes, width = white.shape
            flat = white.reshape(len(white), shapes * width)
            cross = np.linalg.solve(factor, (flat.T @ design.astype(flat.dtype)).astype(float).T)
            moment = (flat.T @ right.astype(flat.dtype)).astype(float) - cross.T @ projected
            prior = np.array([term.parameters[i].deviation for i in term.base_indices()])
            cross = cross.reshape(-1, shapes, width)
            schur = gram + np.diag(1.0 / prior**2) - np.einsum("ksp,ksq->spq", cross, cross)
            moment = moment.reshape(shapes, width, -1)
            mean = np.linalg.solve(schur, moment)
            explained = np.einsum("spn,spn->sn", moment, mean)
            log_determinant = np.linalg.slogdet(schur)[1] + 2.0 * np.sum(np.log(prior))
            gain = 0.5 * explained - 0.5 * log_determinant[:, None] + term.log_prior
            lower = np.array([term.parameters[i].lower for i in term.base_indices()])
            upper = np.array([term.parameters[i].upper for i in term.base_indices()])
            allowed = np.all((mean >= lower[:, None]) & (mean <= upper[:, None]), axis=1)
            gain = np.where(allowed, gain, -np.inf)
            best = np.argmax(gain, axis=0)
            top = gain[best, np.arange(gain.shape[1])]
            with np.errstate(invalid="ignore"):
                marginal = top + np.log(np.mean(np.exp(gain - top), axis=0))
            for n in range(gain.shape[1]):
                value = float(marginal[n]) if np.isfinite(top[n]) else -np.inf
                occam = float(top[n] - marginal[n]) if np.isfinite(top[n]) else 0.0
                shape = tuple(sorted(term.shapes[int(best[n])].items()))
                results[n].append(Candidate(Instance(index, shape, term.base_indices(), occam), value))
        if own:
            results[0].sort(key=lambda candidate: -candidate.gain)
        return results

    def within_bounds(self, fit: Fit) -> bool:
        """Whether every parameter of a fit lies within its bounds."""
        position = self.nuisance.shape[1]
        for instance in fit.instances:
            parameters = self.problem.terms[instance.term].parameters
            for index in instance.active:
                if not parameters[index].lower <= fit.mean[position] <= parameters[index].upper:
                    return False
                position += 1
        return True

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
    factor = np.linalg.cholesky(scaled)
    half = np.linalg.solve(factor, moment)
    inverse = np.linalg.inv(scaled)
    mean = inverse @ moment * deviations
    rss = max(float(gram[k, k] - half @ half), 1e-12 * float(gram[k, k]) + 1e-300)
    return mean, inverse * np.outer(deviations, deviations), 2.0 * float(np.sum(np.log(np.diag(factor)))), rss
