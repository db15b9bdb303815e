"""The noise of a recording: its colour per channel, and how the channels share it.

Residuals of filtered and differentiated signals are never white, and without their colour every p-value is wrong. The
colour is an autoregression fitted with Huber weights (a real residual has bursts that a Gaussian has not), whose
spectrum S(f) is then made non-decreasing:

    S_w(f) = max over f' <= f of S(f'),      whitening filter = the minimum-phase root of 1 / S_w.

So the analysis may trust slow time scales more than fast ones (the noise of derivatives is blue), never the reverse. A
red residual is mostly what the model still leaves out; whitening it fully would turn the fit into one of the signal's
edges, where reversals and resonances make every simple model wrong. Such a residual is taken as white with the power of
its slow part: parameters stay those of a least-squares fit, intervals and evidence count only independent stretches.
"""

from __future__ import annotations

import dataclasses
import functools

import numpy as np
from scipy import linalg

from pcw_description.compiled import compiled

from .regression_problem import BoolArray, FloatArray, IntArray, RegressionProblem, segment_slices

HUBER = 4.0  # in robust standard deviations: spares a Gaussian and tames bursts
AUTOREGRESSION_ORDER = 8
LONGEST_FILTER = 24
# Periodogram ordinates averaged for the slowest noise: enough that the mean is good to a third, few enough to see a drift.
SLOW_ORDINATES = 8
_SPECTRUM_POINTS = 512
# In SI units, below the noise of every sensor: a recording of an ideal simulation may leave nothing at all.
LEAST_DEVIATION = 1e-6
# Part of what a model may misjudge of slips that it always does: some twentieth of them in all.
LEAST_SLIPS = 0.2


@dataclasses.dataclass(frozen=True)
class NoiseModel:
    """Whitening filters (C, L) whose outputs have at most unit variance, and their correlation (C, C)."""

    taps: FloatArray
    correlation: FloatArray

    @property
    def memory(self) -> int:
        """Samples before the present one that the filters look at."""
        return int(self.taps.shape[1]) - 1

    @functools.cached_property
    def is_white(self) -> bool:
        """Whether the noise of every sample of every channel is independent of all others."""
        return self.memory == 0 and np.array_equal(self.correlation, np.eye(len(self.taps)))

    def filtered(self, values: FloatArray, valid: BoolArray, segment: IntArray) -> FloatArray:
        """Filter (T, C) or (T, C, K) channel by channel, zero where not valid.

        The first samples after a gap are foretold from as many as there are since, as well as these allow.
        """
        position = _positions(valid.tobytes(), valid.shape, segment.tobytes())[0]
        wide = np.ascontiguousarray(values.reshape(*valid.shape, -1), dtype=np.float64)
        return _filtered(wide, position, *_weights(self.taps.tobytes(), self.taps.shape)).reshape(values.shape)

    def whiten(self, values: FloatArray, valid: BoolArray, segment: IntArray) -> FloatArray:
        """Return whitened values: (T, C) or (T, C, K) -> the same shape, zero where not valid."""
        samples = np.flatnonzero(valid)
        flat = np.zeros((valid.size, values[0, 0].size))
        flat[samples] = self.whitened_rows(values, valid, segment, samples, np.ones(len(samples)))
        return flat.reshape(values.shape)

    def whitened_rows(
        self, values: FloatArray, valid: BoolArray, segment: IntArray, samples: IntArray, weights: FloatArray
    ) -> FloatArray:
        """Return whitened values (R, K) at some valid samples, each times a weight; a column is in one piece of memory.

        Rows with some channels masked are decorrelated with the correlation of the others.

        Args:
            values: (T, C) or (T, C, K).
            samples: places in `valid` as one line (R,); weights: of these (R,).
        """
        wide = np.ascontiguousarray(values, dtype=np.float64).reshape(*valid.shape, -1)
        if self.is_white:  # nothing ties a sample to others
            scale = self.taps[samples % valid.shape[1], 0] * weights
            return _picked(wide.reshape(valid.size, -1), samples, scale).T
        position, pattern, present = _positions(valid.tobytes(), valid.shape, segment.tobytes())
        roots = _inverse_roots(self.correlation.tobytes(), present.tobytes(), present.shape)
        row = np.full(valid.shape, -1)
        row.ravel()[samples] = np.arange(len(samples))
        return _whitened(wide, position, *_weights(self.taps.tobytes(), self.taps.shape), pattern, roots, row, weights).T


@compiled
def _picked(values, samples, scale):  # type: ignore[no-untyped-def]
    """Some rows of values (N, K), each times a factor (R,), as (K, R)."""
    result = np.empty((values.shape[1], len(samples)))
    for r in range(len(samples)):
        for k in range(values.shape[1]):
            result[k, r] = values[samples[r], k] * scale[r]
    return result


@compiled
def _filtered(values, position, weights, lengths):  # type: ignore[no-untyped-def]
    """Filter (T, C, K): at a position after a gap (T, C) with the weights (C, L, L) of that row."""
    result = np.zeros_like(values)
    for t in range(values.shape[0]):
        for c in range(values.shape[1]):
            if position[t, c] < 0:
                continue
            row = min(position[t, c], lengths[c] - 1)
            for lag in range(row + 1):
                weight = weights[c, row, lag]
                for k in range(values.shape[2]):
                    result[t, c, k] += weight * values[t - lag, c, k]
    return result


@compiled
def _whitened(values, position, weights, lengths, pattern, roots, row, factor):  # type: ignore[no-untyped-def]
    """Filter (T, C, K) as `_filtered`, multiply the channels of each sample by the matrix (P, C, C) of its pattern.

    What comes out stands at the row (T, C) of the result (K, R), times a factor (R,); nowhere if that is negative.
    """
    channels, width = values.shape[1:]
    result = np.empty((width, len(factor)))
    filtered, mixed = np.empty((channels, width)), np.empty(width)
    for t in range(values.shape[0]):
        for c in range(channels):
            filtered[c] = 0.0
            if position[t, c] < 0:
                continue
            first = min(position[t, c], lengths[c] - 1)
            for lag in range(first + 1):
                weight = weights[c, first, lag]
                for k in range(width):
                    filtered[c, k] += weight * values[t - lag, c, k]
        root = roots[pattern[t]]
        for c in range(channels):
            r = row[t, c]
            if r < 0:
                continue
            mixed[:] = 0.0
            for other in range(c + 1):  # the roots are lower triangles
                weight = root[c, other] * factor[r]
                if weight != 0.0:
                    for k in range(width):
                        mixed[k] += weight * filtered[other, k]
            for k in range(width):
                result[k, r] = mixed[k]
    return result


@functools.lru_cache(maxsize=16)
def _positions(content: bytes, shape: tuple[int, int], segments: bytes) -> tuple[IntArray, IntArray, BoolArray]:
    """Of valid samples (T, C): places after gaps (T, C), and the pattern (T,) of those present (P, C) in each row."""
    valid, segment = np.frombuffer(content, dtype=np.bool_).reshape(shape), np.frombuffer(segments, dtype=np.int64)
    position = np.stack([_since_gap(valid[:, c], segment) for c in range(shape[1])], axis=1)
    present, pattern = np.unique(valid, axis=0, return_inverse=True)
    return position, pattern.ravel(), present


@functools.lru_cache(maxsize=64)
def _weights(content: bytes, shape: tuple[int, int]) -> tuple[FloatArray, IntArray]:
    """Of taps (C, L): weights (C, L, L), see `_weights_after_gaps`, and how many of each channel are not zero (C,)."""
    taps = np.frombuffer(content).reshape(shape)
    weights, lengths = np.zeros((*shape, shape[1])), np.zeros(shape[0], dtype=np.int64)
    for channel, own in enumerate(taps):
        trimmed = np.trim_zeros(own, "b")
        lengths[channel] = len(trimmed)
        weights[channel, : len(trimmed), : len(trimmed)] = _weights_after_gaps(trimmed)
    return weights, lengths


@functools.lru_cache(maxsize=64)
def _inverse_roots(content: bytes, patterns: bytes, shape: tuple[int, int]) -> FloatArray:
    """Inverse Cholesky roots (P, C, C) of a correlation (C, C), of the channels present in each pattern (P, C)."""
    correlation = np.frombuffer(content).reshape(shape[1], shape[1])
    roots = np.zeros((shape[0], shape[1], shape[1]))
    for root, present in zip(roots, np.frombuffer(patterns, dtype=np.bool_).reshape(shape), strict=True):
        there = np.flatnonzero(present)
        root[np.ix_(there, there)] = np.linalg.inv(np.linalg.cholesky(correlation[np.ix_(there, there)]))
    return roots


def _since_gap(valid: BoolArray, segment: IntArray) -> IntArray:
    """How many samples before each one (T,) belong to the same run of valid ones; -1 where it is not valid itself."""
    index = np.arange(len(valid))
    begins = valid & ~np.r_[False, valid[:-1] & (segment[1:] == segment[:-1])]
    start = np.maximum.accumulate(np.where(begins, index, 0))
    position: IntArray = np.where(valid, index - start, -1)
    return position


def _weights_after_gaps(taps: FloatArray) -> FloatArray:
    """Weights (L, L) of the present sample and those before it, by how many there are: the whitening of what taps whiten."""
    count = len(taps)
    spectrum = 1.0 / np.maximum(np.abs(np.fft.rfft(taps, 2 * _SPECTRUM_POINTS)) ** 2, 1e-300)
    covariance = linalg.toeplitz(np.fft.irfft(spectrum)[:count])
    inverse = np.linalg.inv(np.linalg.cholesky(covariance))
    weights = np.zeros((count, count))
    for before in range(count):
        weights[before, : before + 1] = inverse[before, before::-1] if before else inverse[0, :1]
    weights[-1] = taps
    return weights


def channel_deviations(residual: FloatArray, valid: BoolArray) -> FloatArray:
    """Standard deviation of every channel of a residual (T, C), outliers held down, (C,)."""
    return np.array([robust_deviation(residual[valid[:, c], c]) for c in range(residual.shape[1])])


def huber_weights(standardised: FloatArray) -> FloatArray:
    """Weights min(1, HUBER / |x|) of standardised values."""
    size = np.abs(standardised)
    return np.where(size > HUBER, HUBER / np.maximum(size, 1e-300), 1.0)


def reliability(problem: RegressionProblem, residual: FloatArray, robust: bool) -> FloatArray:
    """Weights of samples (T, C) besides the noise: what channels tell, where the model guesses, and `robust`: outliers."""
    weights, misjudged = np.ones_like(residual), seen_misjudged(problem, residual, LEAST_SLIPS)
    for channel in range(residual.shape[1]):
        values = residual[:, channel]
        deviation = robust_deviation(values[problem.valid[:, channel]])
        weights[:, channel] = problem.channels[channel].information * (huber_weights(values / deviation) if robust else 1.0)
        if misjudged is not None:
            weights[:, channel] /= 1.0 + (misjudged[:, channel] / deviation) ** 2
    return weights


def seen_misjudged(problem: RegressionProblem, residual: FloatArray, least: float) -> FloatArray | None:
    """What the model misjudges in each sample (T, C), of slips no more than a residual (T, C) shows; None: nothing.

    The loads of wheels may be anybody's guess, or nearly right: where slips are misjudged, more is left where there is more of
    them. In each channel the halves of the samples with less and with more of them are compared.

    Args:
        least: part of what may be misjudged of slips that is in any case.
    """
    if problem.misjudged is None or problem.misjudged_slips is None:
        return problem.misjudged
    found = problem.misjudged.copy()
    for channel, slips in enumerate(problem.misjudged_slips.T):
        valid = problem.valid[:, channel]
        more = valid & (slips > np.median(slips[valid])) if valid.any() else valid
        less = valid & ~more
        if not more.any():
            continue
        left = [robust_deviation(residual[rows, channel]) ** 2 for rows in (more, less)]
        may_be = [float(np.mean(slips[rows] ** 2)) for rows in (more, less)]
        part = np.clip((left[0] - left[1]) / max(may_be[0] - may_be[1], 1e-300), least**2, 1.0)
        found[:, channel] = np.sqrt(np.maximum(found[:, channel] ** 2 - (1.0 - part) * slips**2, 0.0))
    return found


def robust_deviation(values: FloatArray) -> float:
    """Standard deviation with Huber weights around zero, started at the median absolute value; at least `LEAST_DEVIATION`."""
    if len(values) == 0:
        return 1.0
    deviation = 1.4826 * float(np.median(np.abs(values)))
    if deviation <= 0.0:
        deviation = float(np.sqrt(np.mean(values**2)))
    if deviation <= LEAST_DEVIATION:
        return LEAST_DEVIATION
    return max(_huber_deviation(values, deviation), LEAST_DEVIATION)


@compiled
def _huber_deviation(values, deviation):  # type: ignore[no-untyped-def]
    """Root mean square of values (T,), those beyond `HUBER` deviations held down; from a first guess in three rounds."""
    for _ in range(3):
        squares, weights = 0.0, 0.0
        for t in range(len(values)):
            size = abs(values[t]) / deviation
            weight = HUBER / size if size > HUBER else 1.0
            squares += weight * values[t] * values[t]
            weights += weight
        deviation = np.sqrt(squares / weights)
    return deviation


def fit_noise_model(residual: FloatArray, valid: BoolArray, segment: IntArray, apart: bool = False) -> NoiseModel:
    """Estimate the noise model from a residual (T, C).

    Args:
        residual: what is left; valid: where it is (T, C); segment: of every sample (T,).
        apart: each channel has effects of its own. What one of them leaves there while it is named is the whole residual, and
            smooth: an autoregression makes more slow noise of it than it can hold. Where all effects are in all channels that
            keeps out of the search what a large one leaves of itself while it is searched, and stays so.
    """
    channels = residual.shape[1]
    longest = max((piece.stop - piece.start for piece in segment_slices(segment)), default=0)
    order = int(max(0, min(AUTOREGRESSION_ORDER, longest // 20)))
    filters = []
    for channel in range(channels):
        coefficients, deviation = _autoregression(residual[:, channel], valid[:, channel], segment, order)
        slow = slow_power(residual[:, channel], valid[:, channel], segment)
        whole = float(np.sum(residual[valid[:, channel], channel] ** 2)) if apart else np.inf
        filters.append(_whitening_taps(coefficients, deviation, slow, whole))
    length = max(len(taps) for taps in filters)
    length = max(1, min(length, longest // 4 + 1))
    taps = np.zeros((channels, length))
    for channel, own in enumerate(filters):
        taps[channel, : min(length, len(own))] = own[:length]
    model = NoiseModel(taps, np.eye(channels))
    return NoiseModel(taps, _correlation(model.filtered(residual, valid, segment), valid))


def white_noise_model(residual: FloatArray, valid: BoolArray) -> NoiseModel:
    """The model that takes a residual (T, C) for white: least squares, channel by channel."""
    deviations = [robust_deviation(residual[valid[:, c], c]) for c in range(residual.shape[1])]
    return NoiseModel(1.0 / np.array(deviations)[:, None], np.eye(residual.shape[1]))


def _autoregression(
    values: FloatArray, valid: BoolArray, segment: IntArray, order: int
) -> tuple[FloatArray, float]:
    """Coefficients (order,) and innovation deviation, by iteratively reweighted least squares."""
    rows = np.flatnonzero(_since_gap(valid, segment) >= order)
    if len(rows) < 5 * (order + 1):
        usable = values[valid]
        return np.zeros(0), robust_deviation(usable)
    target = values[rows]
    lags = (
        np.stack([values[rows - lag] for lag in range(1, order + 1)], axis=1)
        if order
        else np.zeros((len(rows), 0))
    )
    weight = np.ones(len(rows))
    ridge = 1e-8 * float(np.sum(target**2)) + 1e-300
    coefficients: FloatArray = np.zeros(order)
    for _ in range(4):
        weighted = lags * weight[:, None]
        coefficients = np.asarray(
            np.linalg.solve(lags.T @ weighted + ridge * np.eye(order), weighted.T @ target), float
        )
        innovation = target - lags @ coefficients
        weight = huber_weights(innovation / robust_deviation(innovation))
    return coefficients, robust_deviation(target - lags @ coefficients)


def slow_power(values: FloatArray, valid: BoolArray, segment: IntArray) -> float:
    """Spectral density at the slowest time scales that a recording resolves, in units of white noise of variance 1.

    A short autoregression knows nothing of drifts over seconds; the mean of the first periodogram ordinates does. Masked
    samples count as zero.
    """
    powers = []
    for piece in segment_slices(segment):
        usable = valid[piece]
        if usable.sum() < 8 * SLOW_ORDINATES:
            continue
        masked = np.where(usable, values[piece], 0.0)
        ordinates = np.abs(np.fft.rfft(masked)[1 : SLOW_ORDINATES + 1]) ** 2 / usable.sum()
        powers.append((float(np.mean(ordinates)), int(usable.sum())))
    if not powers:
        return 0.0
    return sum(power * count for power, count in powers) / sum(count for _, count in powers)


def _whitening_taps(coefficients: FloatArray, deviation: float, slow: float, whole: float) -> FloatArray:
    """Minimum-phase filter of 1 / S_w, with S_w the running maximum of `slow` and the autoregression's spectrum.

    No ordinate of a residual holds more than the `whole` sum of its squares, whatever an autoregression of smooth values says.
    """
    polynomial = np.zeros(2 * _SPECTRUM_POINTS)
    polynomial[0] = 1.0
    polynomial[1 : len(coefficients) + 1] = -coefficients
    response = np.abs(np.fft.rfft(polynomial)) ** 2
    spectrum = np.minimum(deviation**2 / np.maximum(response, 1e-12), max(whole, deviation**2))
    rising = np.maximum.accumulate(np.maximum(spectrum, slow))
    # Minimum phase by the folded cepstrum.
    cepstrum = np.fft.irfft(-0.5 * np.log(rising))
    folded = np.zeros_like(cepstrum)
    half = len(cepstrum) // 2
    folded[0] = cepstrum[0]
    folded[1:half] = 2.0 * cepstrum[1:half]
    taps = np.fft.irfft(np.exp(np.fft.rfft(folded)))[:LONGEST_FILTER]
    needed = np.flatnonzero(np.abs(taps) > 2e-3 * abs(taps[0]))
    result: FloatArray = taps[: needed[-1] + 1]
    return result


def _correlation(filtered: FloatArray, usable: BoolArray) -> FloatArray:
    """Correlation of the filtered channels with outliers clipped, slightly shrunk to the identity."""
    channels = filtered.shape[1]
    together = usable.all(axis=1)
    if channels == 1 or together.sum() <= 10 * channels:
        return np.eye(channels)
    values = filtered[together]
    scale = np.array([robust_deviation(values[:, channel]) for channel in range(channels)])
    standard = values / scale
    clipped = standard * huber_weights(standard)
    covariance = clipped.T @ clipped / len(clipped)
    deviation = np.sqrt(np.diag(covariance))
    shrink = min(0.5, 2.0 * channels / len(clipped))
    result: FloatArray = (1.0 - shrink) * covariance / np.outer(deviation, deviation) + shrink * np.eye(
        channels
    )
    return result
