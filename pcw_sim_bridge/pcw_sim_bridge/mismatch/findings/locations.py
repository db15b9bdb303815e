"""Where an effect or a leftover shows: when, in which operating region, at which place on the floor."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pcw_description.effects.kinds import ContactEffect
from pcw_description.effects.registry import get

from ..regression.regression_problem import BoolArray, FloatArray, IntArray, RegressionProblem
from ..search.open_set import Leftover
from .explanation import Explanation, NamedTerm
from .findings import LocationFinding, Place

# An effect shows in a channel that it moves by this part of the noise, and is at work where it moves one by all of it.
SHOWS, AT_WORK = 0.5, 1.0
# A time without an effect counts if the recording speaks against the effect in it by so many nats.
ABSENT = 10.0
PAUSE = 0.3  # [s]; a shorter one does not end an interval
MOST_INTERVALS = 50
# A leftover has a place if most of it lies in a part of the path: shares of what is left, and of the samples.
PLACE_SHARE, PATH_SHARE = 0.8, 0.3
CELL = 0.25  # [m] of the search for it
# What a region narrower than this part of all that was driven says.
NARROW = 0.9


def locate(explanation: Explanation, named: NamedTerm) -> LocationFinding:
    """Where an effect shows."""
    problem, effect = explanation.search.problem, get(named.term.effect)
    part = np.where(problem.valid, named.contribution, 0.0)
    floor = np.maximum(explanation.floor, 1e-300)
    moved = np.sqrt(np.sum(part**2, axis=0) / np.maximum(problem.valid.sum(axis=0), 1)) / floor
    channels = [c for c in range(len(problem.channels)) if moved[c] > SHOWS] or [int(np.argmax(moved))]
    at_work = np.any(np.abs(part[:, channels]) > AT_WORK * floor[channels], axis=1)
    values = {name: estimate.value for name, estimate in named.estimates.items()} | dict(named.instance.shape)
    return LocationFinding(
        channels=tuple(problem.channels[c].name for c in channels),
        casters=named.term.target if effect.target_kind == "caster" and named.term.target != ("axis",) else (),
        axis=named.term.axis or effect.axis,
        intervals=_intervals_of(explanation, named, values, at_work),
        region=region(problem, named.term.arguments, at_work),
        place=_place_of(effect, values),
    )


def locate_leftover(explanation: Explanation, leftover: Leftover, path: FloatArray | None) -> LocationFinding:
    """Where something outside the library shows.

    Args:
        explanation: what is known.
        leftover: what is left of a channel.
        path: position (T, 2) of the robot on the floor; None on a bench.
    """
    problem = explanation.search.problem
    names = [channel.name for channel in problem.channels]
    if leftover.channel not in names:  # a law at a joint: it shows in all channels, and stands where it acts
        axis, _, caster = leftover.channel.partition("_torque/")
        everywhere = tuple((float(t.min()), float(t.max())) for t in [problem.time[problem.recording == problem.recording[0]]])
        return LocationFinding((leftover.channel,), (caster,) if caster else (), axis, everywhere, {})
    c = names.index(leftover.channel)
    channel, valid = problem.channels[c], problem.valid[:, c]
    power = np.where(valid, _left(explanation)[:, c] ** 2, 0.0)
    power /= max(float(explanation.floor[c]), 1e-300) ** 2
    smooth = _smoothed(power, problem)
    loud = valid & (smooth > 0.5 * (1.0 + float(np.quantile(smooth[valid], 0.99)))) if valid.any() else valid
    caster = leftover.variable.partition("/")[2]
    return LocationFinding(
        channels=(leftover.channel,),
        casters=channel.casters or ((caster,) if caster else ()),
        axis=channel.axis,
        intervals=intervals(problem, loud),
        region=region(problem, (leftover.variable,), loud),
        place=None if path is None else place_of_power(path, np.maximum(power - 1.0, 0.0), valid),
    )


# -- when -----------------------------------------------------------------------------------------------------------


def _intervals_of(
    explanation: Explanation, named: NamedTerm, values: dict[str, float], at_work: BoolArray
) -> tuple[tuple[float, float], ...]:
    """By the effect's own start and duration; while a wheel is on its place; else as long as the recording supports it."""
    problem, effect = explanation.search.problem, get(named.term.effect)
    if "start" in values and "duration" in values:
        return ((values["start"], values["start"] + values["duration"]),)
    if isinstance(effect, ContactEffect) and _place_of(effect, values) is not None:
        # What the channels show of it begins earlier, as they are filtered, or later, where the wheel does not slip yet.
        wheels = problem.wheel_places
        on_it: BoolArray = np.zeros_like(at_work) if wheels is None else np.any(effect.is_at(wheels, values), axis=1)
        return intervals(problem, on_it if on_it.any() else at_work)
    shown = np.flatnonzero(np.any(np.abs(named.contribution) > 0.0, axis=1))
    first = problem.recording[shown[0]] if len(shown) else 0
    own = np.flatnonzero(problem.recording == first)
    start, stop = supported(_support(explanation, named)[own])
    return ((float(problem.time[own[start]]), float(problem.time[own[stop - 1]])),)


def _support(explanation: Explanation, named: NamedTerm) -> FloatArray:
    """What every sample says for an effect [nats], (T,): half the squared whitened error without it less that with it."""
    regression, left = explanation.selection.regression, _left(explanation)
    white = regression.whiten_columns(np.stack([left, left + named.contribution], axis=2))
    gain: FloatArray = np.sum(regression.spread(0.5 * (white[:, 1] ** 2 - white[:, 0] ** 2)), axis=1)
    return gain


def _left(explanation: Explanation) -> FloatArray:
    """What the chosen effects leave (T, C)."""
    return explanation.selection.regression.unwhitened_residual(explanation.fit)


def supported(gain: FloatArray) -> tuple[int, int]:
    """First and one past the last sample (T,) between which an effect is supported.

    The piece with the largest sum; what is outside belongs to it too, unless it speaks against the effect by `ABSENT`.
    """
    total = np.concatenate([[0.0], np.cumsum(gain)])
    lowest = np.minimum.accumulate(total)
    stop = int(np.argmax(total - lowest))
    start = int(np.argmin(total[: stop + 1]))
    if total[0] - total[start] < ABSENT:
        start = 0
    if total[stop] - total[-1] < ABSENT:
        stop = len(gain)
    return (start, stop) if stop > start else (0, len(gain))


def intervals(problem: RegressionProblem, active: BoolArray) -> tuple[tuple[float, float], ...]:
    """Join the active samples (T,) of the first recording that has any, over pauses; the longest of the intervals."""
    rows = np.flatnonzero(active)
    if not len(rows):
        return ()
    times = problem.time[rows[problem.recording[rows] == problem.recording[rows[0]]]]
    cuts = np.flatnonzero(np.diff(times) > PAUSE)
    starts, stops = np.r_[0, cuts + 1], np.r_[cuts, len(times) - 1]
    found = sorted(((float(times[a]), float(times[b])) for a, b in zip(starts, stops, strict=True)), key=lambda s: s[0] - s[1])
    return tuple(sorted(found[:MOST_INTERVALS]))


def _smoothed(power: FloatArray, problem: RegressionProblem) -> FloatArray:
    """Power (T,) averaged over `PAUSE`."""
    width = max(1, round(PAUSE * problem.rate))
    smooth: FloatArray = np.convolve(power, np.full(width, 1.0 / width), mode="same")
    return smooth


# -- in which region ------------------------------------------------------------------------------------------------


def region(
    problem: RegressionProblem, arguments: Sequence[str], active: BoolArray
) -> dict[str, tuple[float, float]]:
    """Range of each operating variable in which something is at work.

    Of what it depends on, always; of speed and direction, where the range is narrower than all that was driven.
    """
    found: dict[str, tuple[float, float]] = {}
    if not active.any():
        return found
    judged = problem.valid.any(axis=1)
    for name in dict.fromkeys((*arguments[:2], "speed", "v_x", "v_y", "omega")):
        if name not in problem.variables:
            continue
        values = problem.variables[name]
        low, high = np.quantile(values[active], [0.01, 0.99])
        driven = np.quantile(values[judged], [0.01, 0.99])
        if name in arguments or high - low < NARROW * (driven[1] - driven[0]):
            found[name] = (float(low), float(high))
    return found


# -- at which place -------------------------------------------------------------------------------------------------


def _place_of(effect: object, values: dict[str, float]) -> Place | None:
    """The place of an effect of the floor that has one."""
    if not isinstance(effect, ContactEffect) or not {"x", "y"} <= set(values):
        return None
    sizes = [values.get(p.name, p.default or 0.0) for p in effect.parameters if p.name in ("length", "width")]
    return Place(values["x"], values["y"], 0.5 * max(sizes, default=0.0))


def place_of_power(path: FloatArray, power: FloatArray, valid: BoolArray) -> Place | None:
    """The circle that holds most of a power (T,) on little of a path (T, 2), or None if there is none."""
    usable = valid & np.isfinite(path).all(axis=1)
    total = float(power[usable].sum())
    if total <= 0.0 or usable.sum() < 10:
        return None
    places, weights = path[usable], power[usable]
    cells: IntArray = np.floor(places / CELL).astype(np.int64)
    _, number = np.unique(cells, axis=0, return_inverse=True)
    loudest = int(np.argmax(np.bincount(number.ravel(), weights)))
    centre = np.average(places[number.ravel() == loudest], axis=0, weights=weights[number.ravel() == loudest])
    for _ in range(10):  # towards the middle of what is near, as far as a quarter of the power reaches
        distance = np.linalg.norm(places - centre, axis=1)
        near = distance < _radius(distance, weights, 0.6)
        if not near.any() or weights[near].sum() <= 0.0:
            break
        centre = np.average(places[near], axis=0, weights=weights[near])
    distance = np.linalg.norm(places - centre, axis=1)
    radius = _radius(distance, weights, PLACE_SHARE)
    if np.mean(distance <= radius) > PATH_SHARE:
        return None
    return Place(float(centre[0]), float(centre[1]), max(radius, 0.5 * CELL))


def _radius(distance: FloatArray, weights: FloatArray, share: float) -> float:
    """Radius within which a share of the weights lies."""
    order = np.argsort(distance)
    inside = np.cumsum(weights[order])
    return float(distance[order][min(int(np.searchsorted(inside, share * inside[-1])), len(order) - 1)])


def walked(problem: RegressionProblem, tracked: Sequence[tuple[FloatArray, FloatArray] | None]) -> FloatArray | None:
    """Position (T, 2) of base_link on the floor; None where nothing tells.

    Args:
        problem: with the variables v_x, v_y and omega where there is a robot.
        tracked: per recording stamps (S,) and poses (S, 2 or 3) by a tracker or the robot's odometry; None: by the wheels,
            from the origin on.
    """
    if not {"v_x", "v_y", "omega"} <= set(problem.variables):
        return None
    path = np.full((len(problem.time), 2), np.nan)
    for recording in np.unique(problem.recording):
        rows = problem.recording == recording
        time, series = problem.time[rows], tracked[int(recording)]
        if series is not None:
            path[rows] = np.stack([np.interp(time, series[0], series[1][:, k]) for k in range(2)], axis=1)
            continue
        speeds = np.stack([problem.variables[name][rows] for name in ("v_x", "v_y", "omega")], axis=1)
        steps = np.diff(time, prepend=time[0])
        yaw = np.cumsum(speeds[:, 2] * steps)
        c, s = np.cos(yaw), np.sin(yaw)
        world = np.stack([c * speeds[:, 0] - s * speeds[:, 1], s * speeds[:, 0] + c * speeds[:, 1]], axis=1)
        path[rows] = np.cumsum(world * steps[:, None], axis=0)
    return path
