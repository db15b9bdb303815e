"""Errors before and after on the same data, with intervals from a bootstrap over blocks of time."""

from __future__ import annotations

import dataclasses

import numpy as np
from scipy import stats

from ..regression.regression_problem import BoolArray, FloatArray, IntArray

Pair = tuple[float, float]

DRAWS = 400
BLOCK = 4.0  # [s]; longer than any memory of a residual, and than the longest horizon of a simulation


@dataclasses.dataclass(frozen=True)
class PairedErrors:
    """Mean squared errors of K quantities, each over the square of its own size.

    Attributes:
        before, after: (K,); NaN where there is nothing to judge.
        before_draws, after_draws: of the bootstrap (D, K), block by block the same data in both.
        blocks: in which there is anything to judge (K,).
    """

    before: FloatArray
    after: FloatArray
    before_draws: FloatArray
    after_draws: FloatArray
    blocks: FloatArray

    @classmethod
    def of(cls, before: FloatArray, after: FloatArray, block: IntArray, rng: np.random.Generator) -> PairedErrors:
        """Average squared relative errors (N, K), NaN where not to be judged; `block` (N,) says what is drawn together."""
        _, place = np.unique(block, return_inverse=True)
        blocks = int(place.max()) + 1 if len(place) else 1
        usable = np.isfinite(before) & np.isfinite(after)
        sums = [np.zeros((blocks, before.shape[1])) for _ in range(3)]
        for total, values in zip(sums, (before, after, np.ones_like(before)), strict=True):
            np.add.at(total, place, np.where(usable, values, 0.0))
        draws = rng.multinomial(blocks, np.full(blocks, 1.0 / blocks), size=DRAWS).astype(float)
        with np.errstate(invalid="ignore", divide="ignore"):
            first, second = (total.sum(axis=0) / sums[2].sum(axis=0) for total in sums[:2])
            counts = draws @ sums[2]
            there = np.count_nonzero(sums[2], axis=0).astype(np.float64)
            return cls(first, second, draws @ sums[0] / counts, draws @ sums[1] / counts, there)

    def take(self, positions: IntArray) -> PairedErrors:
        """Return some of the quantities."""
        return PairedErrors(*(getattr(self, field.name)[..., positions] for field in dataclasses.fields(self)))

    @property
    def judged(self) -> IntArray:
        """Positions of the quantities with anything to judge."""
        return np.flatnonzero(np.isfinite(self.before))

    def pooled(self, weights: FloatArray | None = None) -> PairedErrors:
        """Return the mean over all quantities that can be judged, as one (1,); weights (K,) of these, None: all alike."""
        own = self.take(self.judged)
        share = np.ones(len(own.before)) if weights is None else weights[self.judged]
        if not len(own.before):
            nothing = np.full((DRAWS, 1), np.nan)
            return PairedErrors(np.full(1, np.nan), np.full(1, np.nan), nothing, nothing, np.zeros(1))
        parts = [getattr(own, field.name) for field in dataclasses.fields(own)]
        # A draw may leave out all blocks in which one quantity could be judged.
        return PairedErrors(*(_mean(part, share) for part in parts))

    def worse(self, floors: FloatArray | None = None, among: int = 0) -> FloatArray:
        """By what part the root mean square error has grown (K,), zero where that may be chance (95 %) or it has not.

        Args:
            floors: squared errors (K,) below which there is no better and no worse; None: of 0.
            among: so many quantities of which the worst will be told. What is the chance of one is not that of the worst of
                many, nor does a bootstrap over three blocks know: then it is Student's t of the blocks, at a part of 5 %.
        """
        found = np.zeros(len(self.before))
        least = np.full(len(self.before), 1e-300) if floors is None else floors
        for k in self.judged:
            sure = self._change(k, 0.025) > 0.0 if not among else self._is_sure_among(k, among)
            if sure and self.after[k] > self.before[k]:
                found[k] = max(np.sqrt(self.after[k] / max(self.before[k], least[k])) - 1.0, 0.0)
        return found

    def better(self) -> BoolArray:
        """Whether the error has fallen (K,), and not by chance (97.5 %)."""
        return np.array([k in self.judged and self._change(k, 0.975) < 0.0 for k in range(len(self.before))])

    def _is_sure_among(self, k: int, among: int) -> bool:
        """Whether the error of quantity k has grown by more than the worst of so many grows by chance."""
        if self.blocks[k] < 2.0:
            return False
        change = self.after_draws[:, k] - self.before_draws[:, k]
        # A bootstrap knows the spread about the mean of the blocks, that about the truth is larger.
        spread = float(np.std(change[np.isfinite(change)])) * float(np.sqrt(self.blocks[k] / (self.blocks[k] - 1.0)))
        least = float(stats.t.ppf(1.0 - 0.025 / among, self.blocks[k] - 1.0))
        return bool(self.after[k] - self.before[k] > least * spread)

    def _change(self, k: int, quantile: float) -> float:
        """A quantile of how far the squared error of quantity k has grown."""
        change = self.after_draws[:, k] - self.before_draws[:, k]
        return float(np.quantile(change[np.isfinite(change)], quantile))


def _mean(values: FloatArray, share: FloatArray) -> FloatArray:
    """Weighted mean of (..., K) over what is there, (..., 1)."""
    there = np.isfinite(values)
    total = np.sum(np.where(there, values * share, 0.0), axis=-1, keepdims=True)
    with np.errstate(invalid="ignore", divide="ignore"):
        mean: FloatArray = total / np.sum(there * share, axis=-1, keepdims=True)
    return mean


def interval(draws: FloatArray) -> Pair:
    """Return the 95 % interval of draws (D,)."""
    finite = draws[np.isfinite(draws)]
    if not len(finite):
        return float("nan"), float("nan")
    low, high = np.quantile(finite, [0.025, 0.975])
    return float(low), float(high)


def gap_closed(before: FloatArray, after: FloatArray, floor: float) -> FloatArray:
    """(before - after) / (before - floor) of root mean square errors, kept within 0 and 1; 0 where there is no gap."""
    with np.errstate(invalid="ignore", divide="ignore"):
        closed = (before - after) / (before - floor)
    return np.where(before > floor, np.clip(closed, 0.0, 1.0), 0.0)


def blocks_of(recording: IntArray, time: FloatArray) -> IntArray:
    """Number the blocks of `BLOCK` seconds of recordings, (N,)."""
    within = np.floor(time / BLOCK).astype(np.int64)
    return recording.astype(np.int64) * (int(within.max(initial=0)) + 2) + within
