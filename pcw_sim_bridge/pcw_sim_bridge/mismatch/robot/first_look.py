"""A first look at a robot's residual for what can be in too many places to be tried one by one.

That is the order of a ripple, beginning and end of a push, a place on the floor, length and direction of waves.

The tolerances are fitted first, as closely as their sizes allow. What remains is held against every order by sums alone;
the best of them are worth an exact fit. A choice among many is paid for as such (`Term.grid_size`).
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence

import numpy as np
from scipy import signal as filters

from pcw_description.compiled import compiled

from ..regression.angle_spectrum import angle_spectrum
from ..regression.noise_model import robust_deviation
from ..regression.regression_problem import BoolArray, FloatArray, IntArray, Nuisance

LARGEST_ORDER = 400.0
MOST_ORDERS = 4
# A ripple may show in this part of the samples alone, those in which the joint turns slowly.
SLOW_PART = 0.1
# Of a joint that turns by so much [rad], and by no whole turn, ripples are known by so many of their waves.
LEAST_TURN, LEAST_WAVES = 1.5, 3.0
# Pushes last so long [s]; patches of floor have such radii [m], on a grid of such cells.
LONGEST_PUSH, SHORTEST_PUSH = 12.0, 0.4
PATCHES = (0.08, 0.12, 0.18, 0.27, 0.4, 0.6, 0.9)
CELL, MOST_CELLS = 0.05, 400
# A patch that most of the way lies on is a floor.
LARGEST_PATCH_PART = 0.4
WAVES, WAVE_DIRECTIONS = (0.15, 5.0), 24
MOST_SHAPES = 3
# Patches are chosen as if nothing else were re-tuned for them: which of so many it is, beside that, a fit to all says.
MOST_PATCHES = 12


@dataclasses.dataclass(frozen=True)
class ChosenShapes:
    """Shapes that a first look chose, the best of `among` tried, with the scale and the spacing of a search around them."""

    shapes: tuple[dict[str, float], ...]
    among: int
    resolution: Mapping[str, tuple[str, float]]


@dataclasses.dataclass(frozen=True)
class Chosen:
    """What a first look chose: `values` (K,), the best of `among` tried."""

    values: FloatArray
    among: int


@dataclasses.dataclass(frozen=True)
class Looked:
    """The residual as a first look sees it.

    Attributes:
        left: over its noise, tolerances fitted, zero where it is not to be judged (T, C); deviation: that noise (C,).
        valid: samples that may be judged (T, C).
        time: since each recording's start (T,) [s]; recording: the number of that (T,); rate: samples per second.
        angle: of every motor, joint side (T, n, 2) [rad].
        places: of the wheels' centres in the world (T, n, 2) [m]; heading: of the wheels there (T, n) [rad].
    """

    left: FloatArray
    deviation: FloatArray
    valid: BoolArray
    time: FloatArray
    recording: IntArray
    rate: float
    angle: FloatArray
    places: FloatArray
    heading: FloatArray

    def only(self, recording: int) -> Looked:
        """Return the same with nothing to be judged in other recordings."""
        return dataclasses.replace(self, valid=self.valid & (self.recording == recording)[:, None])

    def held_against(self, columns: FloatArray) -> tuple[FloatArray, FloatArray]:
        """How much of columns (T, C, K) is in the residual, and how much there would be of one unit: (T, K) each."""
        scaled = np.where(self.valid[:, :, None], columns / self.deviation[:, None], 0.0)
        return np.einsum("tc,tck->tk", self.left, scaled), np.einsum("tck,tck->tk", scaled, scaled)


def remainder(residual: FloatArray, valid: BoolArray, nuisances: Sequence[Nuisance]) -> tuple[FloatArray, FloatArray]:
    """Residual (T, C) over its noise, tolerances fitted, zero where it is not to be judged; and that noise (C,)."""
    deviations = np.array([max(robust_deviation(residual[valid[:, c], c]), 1e-300) for c in range(residual.shape[1])])
    target = np.where(valid, residual / deviations, 0.0)
    if not nuisances:
        return target, deviations
    columns = np.stack([n.column * n.deviation for n in nuisances], axis=2) / deviations[:, None]
    columns = np.where(valid[:, :, None], columns, 0.0).reshape(-1, len(nuisances))
    flat = target.ravel()
    fitted = np.linalg.solve(columns.T @ columns + np.eye(len(nuisances)), columns.T @ flat)
    left = (flat - columns @ fitted).reshape(residual.shape)
    # Over its noise again, now that the tolerances no longer pass for it.
    scale = [max(robust_deviation(left[valid[:, c], c]), 1e-300) for c in range(left.shape[1])]
    return left / np.array(scale), deviations * np.array(scale)


def orders(signal: FloatArray, angle: FloatArray, rate: float) -> Chosen:
    """Return the orders (K,) [1/rad] of the waves over an angle (T,) that a signal (T,) holds most of.

    Args:
        signal: zero where it is not to be judged.
        angle: of the joint [rad].
        rate: samples per second: a wave that passes faster than half of it wherever the joint turns cannot be seen.
    """
    span = float(np.ptp(angle))
    moved = np.abs(np.diff(angle))[signal[1:] != 0.0]
    speed = float(np.quantile(moved, SLOW_PART)) * rate if len(moved) else 0.0
    if span < LEAST_TURN:
        return Chosen(np.zeros(0), 1)
    least = 0.5 if span >= math.tau else LEAST_WAVES * math.tau / span
    largest = min(math.pi * rate / max(speed, 1e-9), LARGEST_ORDER)
    tried, power = angle_spectrum(signal, angle, largest)
    wanted = (tried >= max(tried[1], least)) & (tried < largest)
    tried, power = tried[wanted], power[wanted]
    if not len(tried):
        return Chosen(np.zeros(0), 1)
    found = []
    for _ in range(MOST_ORDERS):
        best = int(np.argmax(power))
        if power[best] <= 0.0:
            break
        found.append(float(tried[best]))
        power[max(0, best - 4) : best + 5] = 0.0
    return Chosen(np.array(found), len(tried))


def common_orders(each: Sequence[FloatArray], widths: Sequence[float]) -> list[float]:
    """Return the orders [1/rad] that more than half of some joints have, the mean of theirs, the clearest first.

    In one joint others may be louder: what the rest of the robot does passes for ripples of it.

    Args:
        each: orders of every joint, the clearest first (K,).
        widths: how far two of them may differ and be one, by joint.
    """
    common: list[float] = []
    ranked = [float(found[rank]) for rank in range(MOST_ORDERS) for found in each if rank < len(found)]
    for value in ranked:
        nearest = [float(found[int(np.argmin(np.abs(found - value)))]) for found in each]
        near = [order for order, width in zip(nearest, widths, strict=True) if abs(order - value) < width]
        mean = float(np.mean(near))
        if 2 * len(near) > len(each) and all(abs(mean - other) > min(widths) for other in common):
            common.append(mean)
    return common


def windows(looked: Looked, columns: FloatArray) -> ChosenShapes:
    """Return the times (`start`, `duration`) in which something is at work that would else be so all the time.

    Args:
        columns: of all its parameters, at work all the time (T, C, K), each in channels of its own.
    """
    held, there = looked.held_against(columns)
    index = np.floor(looked.time * looked.rate).astype(np.int64)
    count = int(index.max()) + 1
    sums = []
    for values in (held, there):
        binned = np.zeros((count, values.shape[1]))
        np.add.at(binned, index, values)
        sums.append(np.concatenate([np.zeros((1, values.shape[1])), np.cumsum(binned, axis=0)]))
    lengths = np.arange(max(1, round(SHORTEST_PUSH * looked.rate)), min(count // 2, round(LONGEST_PUSH * looked.rate)))
    found: list[tuple[float, int, int]] = []
    tried = 0
    for length in lengths.tolist():
        moment, energy = (s[length:] - s[:-length] for s in sums)
        gain = np.sum(moment**2 / np.maximum(energy, 1e-300), axis=1)
        best = int(np.argmax(gain))
        tried += len(gain)
        found.append((float(gain[best]), best, length))
    kept: list[tuple[int, int]] = []
    for _, start, lasting in sorted(found, reverse=True):
        if all(start + lasting <= other or other + more <= start for other, more in kept):
            kept.append((start, lasting))
        if len(kept) == MOST_SHAPES:
            break
    step = 1.0 / looked.rate
    shapes = tuple({"start": start * step, "duration": lasting * step} for start, lasting in kept)
    return ChosenShapes(shapes, tried, {"start": ("linear", step), "duration": ("linear", step)})


def patches(looked: Looked, columns: FloatArray) -> ChosenShapes:
    """Return places on the floor (`x`, `y`, `length`, `width`) where something is at work under every wheel that comes there.

    Args:
        columns: of each wheel, at work everywhere (T, C, n).
    """
    held, there = looked.held_against(columns)
    places = looked.places.reshape(-1, 2)
    low, high = places.min(axis=0), places.max(axis=0)
    cell = max(CELL, float(np.max(high - low)) / MOST_CELLS)
    size = tuple((np.floor((high - low) / cell) + 1).astype(np.int64))
    index = np.floor((places - low) / cell).astype(np.int64)
    maps = []
    for values in (held, there):
        floor = np.zeros(size)
        np.add.at(floor, (index[:, 0], index[:, 1]), values.ravel())
        maps.append(floor)
    whole = float(maps[1].sum())
    found: list[tuple[float, float, float, float]] = []
    for radius in PATCHES:
        reach = int(np.ceil(radius / cell))
        if 2 * reach + 1 > 2 * max(size):
            break
        offsets = np.arange(-reach, reach + 1) * cell
        disc = (offsets[:, None] ** 2 + offsets**2 <= radius**2).astype(np.float64)
        moment, energy = (filters.oaconvolve(m, disc, mode="same") for m in maps)
        enough = (energy > 1e-6 * whole) & (energy < LARGEST_PATCH_PART * whole) & (moment > 0.0)
        gain = np.where(enough, moment**2 / np.maximum(energy, 1e-6 * whole + 1e-300), 0.0)
        for _ in range(MOST_SHAPES):
            row, column = np.unravel_index(int(np.argmax(gain)), gain.shape)
            if gain[row, column] <= 0.0:
                break
            x, y = low + (np.array([row, column]) + 0.5) * cell
            found.append((float(gain[row, column]), float(x), float(y), radius))
            gain[max(0, row - reach) : row + reach + 1, max(0, column - reach) : column + reach + 1] = 0.0
    kept = sorted(found, reverse=True)[:MOST_PATCHES]
    shapes = tuple({"x": x, "y": y, "length": 2.0 * r, "width": 2.0 * r} for _, x, y, r in kept)
    resolution = {"x": ("linear", 0.1), "y": ("linear", 0.1), "length": ("log", 1.6), "width": ("log", 1.6)}
    return ChosenShapes(shapes, int(np.count_nonzero(maps[1])) * len(PATCHES), resolution)


def waves(looked: Looked, climbing: FloatArray) -> ChosenShapes:
    """Return the waves of the floor (`wavelength`, `direction`) that the wheels seem to climb.

    Args:
        climbing: what a slope of one along each wheel's heading adds to the channels (T, C, n).
    """
    held, there = looked.held_against(climbing)
    x, y = looked.places[:, :, 0], looked.places[:, :, 1]
    extent = max(float(np.ptp(x)), float(np.ptp(y)), 1e-3)
    numbers = np.arange(1.0 / WAVES[1], 1.0 / WAVES[0], min(0.25 / extent, 0.5))
    directions = np.arange(WAVE_DIRECTIONS) * math.tau / WAVE_DIRECTIONS
    moment, energy = _wave_sums(held, there, x, y, looked.heading, numbers, directions)
    gain = np.where(moment > 0.0, moment**2 / np.maximum(energy, 1e-300), 0.0)
    tried = gain.size
    shapes: list[dict[str, float]] = []
    for _ in range(2 * MOST_SHAPES):
        best, way = (int(k) for k in np.unravel_index(int(np.argmax(gain)), gain.shape))
        if gain[best, way] <= 0.0:
            break
        shapes.append({"wavelength": 1.0 / float(numbers[best]), "direction": float(directions[way])})
        gain[max(0, best - 1) : best + 2, way] = 0.0
    spacing = 0.5 * math.tau / WAVE_DIRECTIONS
    return ChosenShapes(tuple(shapes), tried, {"wavelength": ("log", 1.12), "direction": ("linear", spacing)})


@compiled
def _wave_sums(held, there, x, y, heading, numbers, directions):  # type: ignore[no-untyped-def]
    """Sums over samples and wheels of slope times `held`, and of its square times `there`, (M, D) each.

    The slope under a wheel of a wave of number k, by its place along and across the wave and its heading phi to it, is
    k (cos(k along) cos(k across) cos(phi) - sin(k along) sin(k across) sin(phi)).

    Args:
        held, there, x, y, heading: (T, n); numbers: of the waves (M,), evenly spaced [1/m]; directions: of these (D,) [rad].
    """
    moment, energy = np.zeros((len(numbers), len(directions))), np.zeros((len(numbers), len(directions)))
    step = math.tau * (numbers[1] - numbers[0]) if len(numbers) > 1 else 0.0
    for d in range(len(directions)):
        c, s = math.cos(directions[d]), math.sin(directions[d])
        for t in range(held.shape[0]):
            for i in range(held.shape[1]):
                if held[t, i] == 0.0 and there[t, i] == 0.0:
                    continue
                along, across = c * x[t, i] + s * y[t, i], -s * x[t, i] + c * y[t, i]
                forward, aside = math.cos(heading[t, i] - directions[d]), math.sin(heading[t, i] - directions[d])
                # Products of cosines as cosines of sums, each turned on from one wave to the next.
                k = math.tau * numbers[0]
                one, other = np.exp(1j * k * (along + across)), np.exp(1j * k * (along - across))
                turn_one, turn_other = np.exp(1j * step * (along + across)), np.exp(1j * step * (along - across))
                for m in range(len(numbers)):
                    slope = math.pi * numbers[m] * (one.real * (forward + aside) + other.real * (forward - aside))
                    moment[m, d] += held[t, i] * slope
                    energy[m, d] += there[t, i] * slope * slope
                    one *= turn_one
                    other *= turn_other
    return moment, energy
