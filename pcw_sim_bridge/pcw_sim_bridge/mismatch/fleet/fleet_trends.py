"""What became of each robot of a fleet: when each effect appeared, and how its numbers change with time.

Of the recordings of a robot, in the order of time, an effect is named in some. It has appeared at a recording where the
share of those that name it rises by more than chance; with the numbers x_k +- s_k at the times t_k where it is named,

    x_k = a + b t_k + e_k,      e_k ~ Normal(0, s_k^2 + u^2),

the slope b is its wear. The scatter u^2 between recordings is estimated by the method of moments [DerSimonian and Laird
1986]: a floor, a load or a temperature that differs from day to day makes the slope less sure, not wrong.
"""

from __future__ import annotations

import collections
import dataclasses
import datetime
import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from scipy import stats

from pcw_description.effects.registry import get

from ..regression.regression_problem import FloatArray

FORMAT = "pcw_fleet/1"
# Nats by which a change of the share must beat no change: odds of 20 to 1, as the onset is one of many.
CHANGE = 3.0
LEAST_POINTS = 4  # for a slope: two are spent on the line, and of one left nobody can tell the scatter
GONE = 0.01  # probability of as long an absence, if the effect were still there, below which it is gone
DEVIATIONS = 2 * 1.96  # width of a 95 % interval
HOUR, DAY, YEAR = 3600.0, 86400.0, 365.25 * 86400.0
PERIODS = {"hour": HOUR, "day": DAY, "year": YEAR}


@dataclasses.dataclass(frozen=True)
class Trend:
    """A slope with its 95 % interval, per `period` ("hour", "day" or "year"), and the line at the first time."""

    slope: float
    low: float
    high: float
    period: str
    start_time: float
    start_value: float

    @property
    def real(self) -> bool:
        """Whether the interval leaves no doubt that there is a slope."""
        return self.low > 0.0 or self.high < 0.0


@dataclasses.dataclass(frozen=True)
class ParameterHistory:
    """A number over time; arrays (K,) along the recordings that name the effect."""

    unit: str
    time: FloatArray
    value: FloatArray
    low: FloatArray
    high: FloatArray
    trend: Trend | None


@dataclasses.dataclass(frozen=True)
class EffectHistory:
    """An effect on one robot.

    Attributes:
        named: times of the recordings that name it (K,) [s since 1970].
        appeared: time of the recording at which it came; None if it was there from the first one, or never settled.
        settled: whether it is there or gone, rather than named now and then.
        gone: whether it has not been named for so long that it is there no more.
        recordings: how many recordings there are since it appeared (or in all), and how many of them name it.
    """

    name: str
    target: tuple[str, ...]
    named: FloatArray
    appeared: float | None
    settled: bool
    gone: bool
    recordings: tuple[int, int]
    ambiguous_with: tuple[str, ...]
    parameters: Mapping[str, ParameterHistory]

    def sentence(self) -> str:
        """Say it plainly."""
        words = f"{self.name} on {' and '.join(self.target)} "
        count, times = self.recordings
        if not self.settled:
            words += f"was named in {times} of {count} recordings, with no pattern in time"
        else:
            words += "was there from the first recording" if self.appeared is None else f"appeared on {date(self.appeared)}"
            words += f" and was named in {times} of {count} recordings since"
            if self.gone:
                words += f"; it was last seen on {date(float(self.named[-1]))} and is gone"
        for name, history in self.parameters.items():
            if history.trend is not None and history.trend.real:
                trend = history.trend
                verb = "grows" if trend.slope * history.value[-1] > 0.0 else "shrinks"
                unit = f" {history.unit}" if history.unit not in ("", "1") else ""
                words += (
                    f"; {name} {verb}, by {trend.slope:.3g}{unit} per {trend.period} "
                    f"({trend.low:.3g} to {trend.high:.3g}), and was {history.value[-1]:.3g}{unit} at last"
                )
        if self.ambiguous_with:
            words += f" (it may as well be {' or '.join(self.ambiguous_with)})"
        return words + "."


@dataclasses.dataclass(frozen=True)
class RobotHistory:
    """What became of one robot.

    Attributes:
        times: of its recordings with enough data to judge (M,) [s since 1970].
        verdicts: how many recordings had which verdict.
        failed: recordings that could not be analysed: (path, why).
        unknown: channel -> times at which something outside the library was left there.
        other_descriptions: results of this robot that were made with another description, left out.
        uncertain_times: how many times are those of files, not of stamps.
    """

    name: str
    description: str
    times: FloatArray
    verdicts: Mapping[str, int]
    effects: tuple[EffectHistory, ...]
    failed: tuple[tuple[str, str], ...]
    unknown: Mapping[str, FloatArray]
    other_descriptions: int
    uncertain_times: int

    def sentences(self) -> list[str]:
        """Say it plainly, the most important first."""
        said = [effect.sentence() for effect in self.effects if effect.settled]
        if not said and len(self.times) and not self.unknown:
            said = ["Nothing is missing steadily: what differs is within noise and tolerances."]
        said += [effect.sentence() for effect in self.effects if not effect.settled]
        for channel, times in self.unknown.items():
            said.append(
                f"Something outside the library is left in {channel} in {len(times)} of {len(self.times)} recordings, "
                f"first on {date(float(times[0]))}."
            )
        short = self.verdicts.get("insufficient_data", 0)
        if short:
            said.append(f"{_counted(short, 'recording holds', 'recordings hold')} too little motion to judge.")
        if self.failed:
            said.append(f"{_counted(len(self.failed), 'recording', 'recordings')} could not be analysed.")
        if self.other_descriptions:
            made = _counted(self.other_descriptions, "earlier result was", "earlier results were")
            said.append(f"{made} made with another description and left out.")
        if self.uncertain_times:
            bear = _counted(self.uncertain_times, "recording bears", "recordings bear")
            said.append(f"{bear} no date in the stamps; the time of the file stands for it.")
        return said


def _counted(count: int, one: str, many: str) -> str:
    return f"{count} {one if count == 1 else many}"


def date(time: float) -> str:
    """Return a time [s since 1970] as a date, in UTC."""
    return datetime.datetime.fromtimestamp(time, datetime.UTC).strftime("%Y-%m-%d %H:%M")


def histories(results: Iterable[Mapping[str, Any]], current: Mapping[str, str]) -> tuple[RobotHistory, ...]:
    """Return what became of every robot, by name.

    Args:
        results: lines of results.jsonl.
        current: robot -> digest of the description that counts; of other robots the one of their latest result does.
    """
    by_robot: dict[str, list[Mapping[str, Any]]] = {}
    for result in results:
        by_robot.setdefault(result["robot"], []).append(result)
    found = []
    for name in sorted(by_robot):
        own = sorted(by_robot[name], key=lambda result: (result["time"], result["path"]))
        digest = current.get(name, own[-1]["description_sha256"])
        found.append(_robot_history(name, [r for r in own if r["description_sha256"] == digest], len(own)))
    return tuple(found)


def _robot_history(name: str, own: Sequence[Mapping[str, Any]], count: int) -> RobotHistory:
    good = [result for result in own if result["error"] is None and result["verdict"] != "insufficient_data"]
    times = np.array([result["time"] for result in good])
    seen: dict[tuple[str, tuple[str, ...]], list[tuple[int, Mapping[str, Any]]]] = {}
    unknown: dict[str, list[float]] = {}
    for index, result in enumerate(good):
        for effect in result["effects"]:
            seen.setdefault((effect["name"], tuple(effect["target"])), []).append((index, effect))
        for channel in dict.fromkeys(leftover["channel"] for leftover in result["unknown"]):
            unknown.setdefault(channel, []).append(result["time"])
    effects = [_effect_history(*key, times, entries) for key, entries in seen.items()]
    effects.sort(key=lambda effect: (not effect.settled, effect.gone, -len(effect.named), effect.name))
    return RobotHistory(
        name=name,
        description=own[-1]["description"] if own else "",
        times=times,
        verdicts=dict(collections.Counter(result["verdict"] for result in own if result["error"] is None)),
        effects=tuple(effects),
        failed=tuple((result["path"], result["error"]) for result in own if result["error"] is not None),
        unknown={channel: np.array(at) for channel, at in unknown.items()},
        other_descriptions=count - len(own),
        uncertain_times=sum(result["time_from"] != "stamps" for result in good),
    )


def _effect_history(
    name: str, target: tuple[str, ...], times: FloatArray, entries: Sequence[tuple[int, Mapping[str, Any]]]
) -> EffectHistory:
    there = np.zeros(len(times), dtype=bool)
    there[[index for index, _ in entries]] = True
    first, settled = onset(there)
    last = int(np.flatnonzero(there)[-1])
    share = (there[first : last + 1].sum() + 1.0) / (last + 1 - first + 2.0)
    gone = settled and (1.0 - share) ** (len(times) - 1 - last) < GONE
    parameters = {}
    for parameter in dict.fromkeys(key for _, effect in entries for key in effect["parameters"]):
        having = [(times[i], effect["parameters"][parameter]) for i, effect in entries if parameter in effect["parameters"]]
        at = np.array([time for time, _ in having])
        value, low, high = (
            np.array([pick(entry) for _, entry in having])
            for pick in (lambda e: e["value"], lambda e: e["ci95"][0], lambda e: e["ci95"][1])
        )
        line = None if _turns(name, parameter) else trend(at, value, high - low)
        parameters[parameter] = ParameterHistory(having[0][1]["unit"], at, value, low, high, line)
    ambiguous = dict.fromkeys(other for _, effect in entries for other in effect["ambiguous_with"])
    return EffectHistory(
        name=name,
        target=target,
        named=times[there],
        appeared=float(times[first]) if settled and first > 0 else None,
        settled=settled,
        gone=bool(gone),
        recordings=(len(times) - first, int(there[first:].sum())),
        ambiguous_with=tuple(ambiguous),
        parameters=parameters,
    )


def _turns(effect: str, parameter: str) -> bool:
    """Whether a parameter is a direction, whose values have no order."""
    declared = get(effect).parameter(parameter)
    return declared.unit == "rad" and declared.upper - declared.lower > math.tau


def onset(there: np.ndarray) -> tuple[int, bool]:
    """Return the index of the recording at which an effect came, and whether it then was there steadily.

    The share of the recordings (M,) that name it is one number before the onset and a larger one from it on. An effect that
    is named in most recordings from the first to the last needs no onset; one that neither has an onset nor is in most of
    them is named now and then, and its index is 0.
    """
    whole = _log_likelihood(there)
    best, split = 0.0, 0
    for index in np.flatnonzero(there):
        before, after = there[:index], there[index:]
        if index == 0 or before.mean() >= after.mean():
            continue
        gain = _log_likelihood(before) + _log_likelihood(after) - whole
        if gain > best:
            best, split = gain, int(index)
    if best >= CHANGE:
        return split, True
    present = there[: int(np.flatnonzero(there)[-1]) + 1]
    return 0, bool(present.mean() > 0.5 and (len(there) < 2 or present.sum() > 1))


def _log_likelihood(there: np.ndarray) -> float:
    """Largest log likelihood of independent draws of one share."""
    count, times = len(there), int(there.sum())
    if times in (0, count):
        return 0.0
    return times * math.log(times / count) + (count - times) * math.log(1.0 - times / count)


def trend(time: FloatArray, value: FloatArray, width: FloatArray) -> Trend | None:
    """Return the slope of values (K,) with 95 % intervals `width` wide, at times [s]; None for too few of them."""
    span = float(np.ptp(time)) if len(time) else 0.0
    if len(time) < LEAST_POINTS or span <= 0.0:
        return None
    period = "hour" if span < 2.0 * DAY else "day" if span < 2.0 * YEAR else "year"
    design = np.column_stack([np.ones(len(time)), (time - time[0]) / PERIODS[period]])
    own = np.maximum(width / DEVIATIONS, 1e-9 * (np.abs(value) + float(np.ptp(value)) + 1e-300)) ** 2
    covariance, mean = _weighted_fit(design, value, 1.0 / own)
    spare = len(value) - 2
    # Method of moments: expected Q = spare + u^2 (sum w - trace(...)), solved for the scatter between recordings.
    weight = 1.0 / own
    excess = float(np.sum(weight * (value - design @ mean) ** 2)) - spare
    room = float(weight.sum() - np.trace(covariance @ (design.T @ (weight[:, None] ** 2 * design))))
    scatter = max(0.0, excess / room) if room > 0.0 else 0.0
    covariance, mean = _weighted_fit(design, value, 1.0 / (own + scatter))
    half = float(stats.t.ppf(0.975, spare) * math.sqrt(covariance[1, 1]))
    slope = float(mean[1])
    return Trend(slope, slope - half, slope + half, period, float(time[0]), float(mean[0]))


def _weighted_fit(design: FloatArray, value: FloatArray, weight: FloatArray) -> tuple[FloatArray, FloatArray]:
    covariance: FloatArray = np.linalg.inv(design.T @ (weight[:, None] * design)).astype(float)
    return covariance, covariance @ (design.T @ (weight * value))


def to_json(robots: Sequence[RobotHistory]) -> dict[str, Any]:
    """Return the content of fleet.json."""
    return {
        "format": FORMAT,
        "recordings": sum(len(robot.times) for robot in robots),
        "failed": sum(len(robot.failed) for robot in robots),
        "robots": [
            {
                "name": robot.name,
                "description": robot.description,
                "sentences": robot.sentences(),
                "recordings": len(robot.times),
                "first": date(float(robot.times[0])) if len(robot.times) else None,
                "last": date(float(robot.times[-1])) if len(robot.times) else None,
                "verdicts": dict(robot.verdicts),
                "effects": [_effect_json(effect) for effect in robot.effects],
                "unknown": {channel: at.tolist() for channel, at in robot.unknown.items()},
                "failed": [{"path": path, "error": error} for path, error in robot.failed],
            }
            for robot in robots
        ],
    }


def _effect_json(effect: EffectHistory) -> dict[str, Any]:
    return {
        "name": effect.name,
        "target": list(effect.target),
        "statement": effect.sentence(),
        "appeared_s": effect.appeared,
        "settled": effect.settled,
        "gone": effect.gone,
        "recordings_since": effect.recordings[0],
        "named_since": effect.recordings[1],
        "named_s": effect.named.tolist(),
        "ambiguous_with": list(effect.ambiguous_with),
        "parameters": {
            name: {
                "unit": history.unit,
                "time_s": history.time.tolist(),
                "value": history.value.tolist(),
                "ci95": np.column_stack([history.low, history.high]).tolist(),
                "slope": None
                if history.trend is None
                else {
                    "value": history.trend.slope,
                    "ci95": [history.trend.low, history.trend.high],
                    "per": history.trend.period,
                },
            }
            for name, history in effect.parameters.items()
        },
    }
