"""One filter for every signal of a channel, so that both sides of a balance are delayed and smoothed alike.

A second difference of a measured position amplifies its noise by the fourth power of frequency. Here every signal
passes the same zero-phase low-pass, derivatives are taken of the filtered signal, and all of it is decimated to a rate
at which little more than the pass band is left.
"""

from __future__ import annotations

import dataclasses
import functools

import numpy as np
from scipy import interpolate, signal, sparse

from pcw_description.compiled import compiled

from .regression_problem import BoolArray, FloatArray

FILTER_ORDER = 4
# Samples per period of the cut-off after decimation: the stop band that whitening would have to blow up again stays small.
OVERSAMPLING = 2.5
# A step of more median ones than the first is a gap, as samples are missing in it; one of the second may always be filled.
GAP_STEPS, FILLED_STEPS = 1.5, 3.0
# So much of what belongs on either side of a gap, for as long as the largest that is filled, must be there to fill it.
SURROUNDED = 0.5
# Samples that are so many times rarer than what is asked for are a slow sensor's.
SLOW_STEPS = 1.5
# Central differences of eighth order: exact to 0.1 % up to a fifth of the sampling rate. Weights of what is 1, 2, 3 and 4
# samples later less what is as much earlier.
_STENCIL = np.array([4 / 5, -1 / 5, 4 / 105, -1 / 280])


@dataclasses.dataclass(frozen=True)
class SignalFilter:
    """Zero-phase low-pass with decimation.

    Attributes:
        rate: of the incoming samples [Hz].
        cutoff: of the low-pass [Hz].
    """

    rate: float
    cutoff: float

    @property
    def step(self) -> int:
        """Every how many samples one is kept."""
        return max(1, int(self.rate / (OVERSAMPLING * self.cutoff)))

    @property
    def decimated_rate(self) -> float:
        """Rate of what `decimate` returns [Hz]."""
        return self.rate / self.step

    @property
    def settling(self) -> int:
        """Samples at each end that the filter's start disturbs."""
        return int(np.ceil(2.5 * self.rate / self.cutoff))

    def smooth(self, values: FloatArray) -> FloatArray:
        """Low-pass along the first axis, same rate; (T, ...) -> (T, ...)."""
        if self.cutoff >= 0.45 * self.rate:
            return np.asarray(values, dtype=float)
        sos = _low_pass(self.cutoff, self.rate)
        padding = min(len(values) - 1, 3 * self.settling)
        smoothed: FloatArray = signal.sosfiltfilt(sos, values, axis=0, padlen=padding)
        return smoothed

    def decimate(self, values: FloatArray) -> FloatArray:
        """Keep every `step`-th sample of the undisturbed middle; (T, ...) -> (T', ...)."""
        return values[self.settling : len(values) - self.settling : self.step]

    def apply(self, values: FloatArray) -> FloatArray:
        """Low-pass and decimate."""
        kept = self.decimate(values)
        if self.cutoff >= 0.45 * self.rate or len(kept) == 0:
            return np.asarray(kept, dtype=float)
        result: FloatArray = _decimation(self, len(values)) @ np.reshape(values, (len(values), -1))
        return result.reshape(kept.shape)

    def gain(self, frequency: FloatArray) -> FloatArray:
        """Amplitude that a sine of `frequency` [Hz] keeps (forward and backward pass)."""
        warped = np.tan(np.pi * np.minimum(np.abs(frequency), 0.499 * self.rate) / self.rate)
        edge = np.tan(np.pi * min(self.cutoff, 0.499 * self.rate) / self.rate)
        gain: FloatArray = 1.0 / (1.0 + (warped / edge) ** (2 * FILTER_ORDER))
        return gain


@functools.lru_cache(maxsize=64)
def _low_pass(cutoff: float, rate: float) -> FloatArray:
    """Second-order sections, not to be changed; designing them takes longer than filtering a second with them."""
    sections: FloatArray = signal.butter(FILTER_ORDER, cutoff, fs=rate, output="sos")
    return sections


@functools.lru_cache(maxsize=64)
def _decimation(own: SignalFilter, length: int) -> sparse.csr_array:
    """Matrix (T', T) that filters the undisturbed middle of a signal where it is kept, and nowhere else."""
    reach = own.settling
    impulse = np.zeros(6 * reach + 1)
    impulse[3 * reach] = 1.0
    response = signal.sosfiltfilt(_low_pass(own.cutoff, own.rate), impulse, padlen=0)[2 * reach : 4 * reach + 1]
    response /= response.sum()
    centres = own.decimate(np.arange(length, dtype=float)).astype(np.int64)
    columns = centres[:, None] + np.arange(-reach, reach + 1)
    starts = len(response) * np.arange(len(centres) + 1)
    return sparse.csr_array((np.tile(response, len(centres)), columns.ravel(), starts), shape=(len(centres), length))


def derivative(values: FloatArray, rate: float) -> FloatArray:
    """First derivative of a smooth signal along its first axis, (T, ...) -> (T, ...)."""
    if len(values) < 4 * len(_STENCIL):
        return np.asarray(np.gradient(values, 1.0 / rate, axis=0))
    flat = np.ascontiguousarray(values, dtype=np.float64).reshape(len(values), -1)
    result: FloatArray = _derivative(flat, rate, _STENCIL).reshape(np.shape(values))
    return result


@compiled
def _derivative(values, rate, stencil):  # type: ignore[no-untyped-def]
    """Derivative (T, K), of lower order where the stencil does not fit."""
    result = np.empty_like(values)
    count, half = len(values), len(stencil)
    step = 1.0 / rate
    first, second, third, fourth = rate * stencil
    for t in range(count):
        if half <= t < count - half:
            # Written out: a loop over the stencil takes several times as long.
            for k in range(values.shape[1]):
                result[t, k] = (
                    first * (values[t + 1, k] - values[t - 1, k]) + second * (values[t + 2, k] - values[t - 2, k])
                    + third * (values[t + 3, k] - values[t - 3, k]) + fourth * (values[t + 4, k] - values[t - 4, k])
                )
        else:
            before, after = max(t - 1, 0), min(t + 1, count - 1)
            for k in range(values.shape[1]):
                result[t, k] = (values[after, k] - values[before, k]) / ((after - before) * step)
    return result


def refined(values: FloatArray, factor: int) -> FloatArray:
    """Interpolate a smooth signal by quintic splines, (T, ...) -> (factor (T - 1) + 1, ...), along its first axis.

    What depends on a signal sharply, as a friction does on the sign of a speed, has a spectrum far beyond the signal's
    own; evaluated on coarse samples it would fold back into the channel.
    """
    if factor == 1:
        return values
    samples = np.arange(len(values))
    finer: FloatArray = interpolate.make_interp_spline(samples, values, k=5)(np.arange(factor * samples[-1] + 1) / factor)
    return finer


def white_noise_level(values: FloatArray) -> float:
    """Standard deviation of the white part of a smooth signal, from its fourth differences.

    White noise of deviation s has fourth differences of deviation sqrt(70) s; a motion sampled well above its
    bandwidth has almost none.
    """
    if len(values) < 16:
        return 0.0
    differences = np.diff(values, 4)
    # Quantisation at low speed leaves most differences at zero, where the median would say "no noise".
    robust = 1.4826 * float(np.median(np.abs(differences)))
    ordinary = float(
        np.sqrt(np.mean(np.minimum(np.abs(differences), np.quantile(np.abs(differences), 0.98)) ** 2))
    )
    return max(robust, ordinary) / np.sqrt(70.0) if robust == 0.0 else robust / np.sqrt(70.0)


def reading_noise_level(values: FloatArray) -> float:
    """Standard deviation of the white part of what is read in steps, where it moves: standing still it has none."""
    changed = np.diff(values) != 0.0
    moves = np.flatnonzero(np.convolve(changed, np.ones(4)) > 0.0)
    moves = moves[(moves >= 3) & (moves < len(changed))] - 3
    if len(moves) < 16:
        return 0.0
    return 1.4826 * float(np.median(np.abs(np.diff(values, 4)[moves]))) / np.sqrt(70.0)


def uniform_segments(
    time: FloatArray, signals: FloatArray, largest_gap: float
) -> tuple[float, list[tuple[FloatArray, FloatArray]]]:
    """Cut at gaps and put each piece on a uniform grid, see `interpolated`.

    Args:
        time: increasing stamps (T,) [s].
        signals: (T, S).
        largest_gap: see `_is_pause` [s].

    Returns:
        The rate [Hz] and the pieces (stamps (T_i,), signals (T_i, S)).
    """
    step = float(np.median(np.diff(time)))
    cuts = np.flatnonzero(_is_pause(time, largest_gap)) + 1
    # The mean step of the pieces, not the median: over a minute the difference of the two is a drift.
    steps = np.delete(np.diff(time), cuts - 1)
    rate = 1.0 / float(np.mean(steps))
    pieces = []
    for index in np.split(np.arange(len(time)), cuts):
        if len(index) < 2:
            continue
        stamps, values = time[index], signals[index]
        grid = stamps[0] + np.arange(int((stamps[-1] - stamps[0]) * rate + 1e-6) + 1) / rate
        if len(grid) == len(stamps) and np.max(np.abs(grid - stamps)) < 0.01 / rate:
            pieces.append((grid, values))
            continue
        pieces.append((grid, _without_pause(grid, stamps, values, GAP_STEPS * step, False)))
    return rate, pieces


def interpolated(grid: FloatArray, time: FloatArray, values: FloatArray, largest_gap: float) -> FloatArray:
    """Values (T', S) at the times `grid` (T',): between samples on lines, or on a spline where they are much rarer.

    A line cuts a bend by more than the noise of an encoder over a gap of ten samples, and a slow sensor's signal everywhere.
    In a gap stands a cubic that is fitted to as long a time on either side as the gap lasts, so that it averages noise.

    Args:
        grid: increasing [s].
        time: increasing stamps (T,) [s]; values: (T, S).
        largest_gap: see `_is_pause`; in a pause, before the first sample and after the last one, values are NaN [s].
    """
    step = float(np.median(np.diff(time)))
    spline = len(grid) > 1 and step > SLOW_STEPS * float(np.median(np.diff(grid)))
    result = np.full((len(grid), values.shape[1]), np.nan)
    for index in np.split(np.arange(len(time)), np.flatnonzero(_is_pause(time, largest_gap)) + 1):
        inside = slice(*np.searchsorted(grid, time[index[[0, -1]]] + [0.0, 1e-9]))
        result[inside] = _without_pause(grid[inside], time[index], values[index], GAP_STEPS * step, spline)
    return result


def _without_pause(grid: FloatArray, time: FloatArray, values: FloatArray, least_gap: float, spline: bool) -> FloatArray:
    """The same between the first and the last sample, with gaps that are all to be filled."""
    if spline and len(time) >= 4 and np.isfinite(values).all():
        result = np.asarray(interpolate.CubicSpline(time, values)(grid))
    else:
        result = np.stack([np.interp(grid, time, column) for column in values.T], axis=1)
    for index in np.flatnonzero(np.diff(time) > least_gap):
        start, stop = time[index], time[index + 1]
        gap = stop - start
        inside = slice(np.searchsorted(grid, start, side="right"), np.searchsorted(grid, stop))
        before, after = np.searchsorted(time, [start - gap, stop + gap])
        used = slice(max(0, min(before, index - 1)), max(after, index + 3))
        there = np.isfinite(values[used]).all(axis=0)  # a signal that was not recorded leaves the others theirs
        if len(time[used]) < 4:
            continue
        scaled = [(times - 0.5 * (start + stop)) / (1.5 * gap) for times in (time[used], grid[inside])]
        known, wanted = (np.vander(times, 4) for times in scaled)
        result[inside, there] = wanted @ np.linalg.lstsq(known, values[used][:, there], rcond=None)[0]
    return result


def _is_pause(time: FloatArray, largest_gap: float) -> BoolArray:
    """Whether steps (T - 1,) between stamps are longer than what may be filled, or gaps with too few samples around them."""
    steps = np.diff(time)
    step = float(np.median(steps))
    pause: BoolArray = steps > max(largest_gap, FILLED_STEPS * step)
    for index in np.flatnonzero(~pause & (steps > GAP_STEPS * step)):
        reach = max(steps[index], largest_gap)
        before = index + 1 - np.searchsorted(time, time[index] - reach)
        after = np.searchsorted(time, time[index + 1] + reach, side="right") - (index + 1)
        pause[index] = min(before, after) < SURROUNDED * reach / step
    return pause
