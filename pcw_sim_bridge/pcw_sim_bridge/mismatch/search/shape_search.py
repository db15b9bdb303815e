"""Parameters that shape an effect's columns (an order, a phase, a place): where the evidence is largest, and intervals.

    found = refined_shape(regression, others, instance)
    low, high = shape_interval(regression, others, found, "phase")

Each parameter is searched on the scale of its grid, linear or logarithmic, one after the other: first between the
neighbours on the grid, since there may be two maxima, then by parabolas through the best point and those beside it. An
interval is that of the profile likelihood: all numbers are fitted again at each value, the other shapes stay. With slopes
(`shape_slopes`) these move too; the wider of both is told.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from ..regression.whitened_regression import Instance, WhitenedRegression
from .shape_trials import ShapeTrials

# Drop of the log likelihood at the ends of a 95 % interval.
DROP = 1.92
# Widest interval of a parameter on a logarithmic scale, as a ratio to either side.
WIDEST_RATIO = 30.0
UNSEEN_STEPS = 200.0  # to either side of what happens once, on a linear scale
# What moves the other way by as much, so that what began earlier ends when it did: each end of it is seen by itself.
OPPOSITE = {"start": "duration", "duration": "start"}
COARSE = 7  # points between the neighbours on the grid
SWEEPS = 3  # over all parameters, as long as one gains
WORTH = 0.1  # nats; a further point that promises less is not asked for
PARABOLAS = 8
FARTHEST = 2.0  # distances of neighbours on the grid that one search goes


def refined_shape(
    regression: WhitenedRegression, others: Sequence[Instance], instance: Instance, coarse: bool = True
) -> Instance:
    """Return the instance with the shape near its own that explains most beside others; coarse: as far as its neighbours."""
    resolution = regression.problem.terms[instance.term].resolution
    if not resolution:
        return instance
    trials = ShapeTrials(regression, others, instance)
    for sweep in range(SWEEPS):
        before = trials.tried([instance])[0].evidence
        for name, (kind, spacing) in resolution.items():
            place = _Place(trials, instance, name, kind, bounded=True)
            instance = place.moved(_largest(place, place.width(spacing), coarse and sweep == 0))
        if len(resolution) < 2 or trials.tried([instance])[0].evidence < before + WORTH:
            break
    return instance


def shape_interval(
    regression: WhitenedRegression, others: Sequence[Instance], instance: Instance, name: str, widening: float = 1.0
) -> tuple[float, float]:
    """Return the 95 % interval of a shaping parameter; of one that was not searched, its value twice.

    Args:
        widening: so many times the variance that the noise model says.
    """
    centre = dict(instance.shape)[name]
    kind, spacing = regression.problem.terms[instance.term].resolution.get(name, ("", 0.0))
    if not kind or (kind == "log" and centre <= 0.0):
        return centre, centre
    trials = ShapeTrials(regression, others, instance)
    ways = [_Place(trials, instance, name, kind)]
    if OPPOSITE.get(name) in dict(instance.shape):
        ways.append(_Place(trials, instance, name, kind, against=OPPOSITE[name]))
    # What happened once may have ended, or its patch, anywhere in a time or on a floor from which nothing can be judged: just
    # beyond what can be judged the filter still sees it, and further away all is possible again.
    once = regression.problem.terms[instance.term].once
    steps = UNSEEN_STEPS if once else 2.0
    widest = math.log(WIDEST_RATIO) if kind == "log" else steps * spacing

    def end(place: _Place, direction: float) -> float:
        best, drop = place.evidence(0.0), DROP * widening
        inner, outer = 0.0, 1e-4 * (1.0 if kind == "log" else spacing)
        further = outer
        while further < widest and (once or further == outer):
            if best - place.evidence(direction * further) < drop:
                inner, outer = further, further * 3.0
            further *= 3.0
        for _ in range(5):
            middle = math.sqrt(inner * outer) if inner > 0.0 else 0.5 * outer
            if best - place.evidence(direction * middle) < drop:
                inner = middle
            else:
                outer = middle
        return place.value(direction * min(outer, widest))

    return min(end(place, -1.0) for place in ways), max(end(place, 1.0) for place in ways)


class _Place:
    """One shaping parameter of an instance, on the scale that it is searched on; steps count from where it is.

    Args:
        bounded: where sizes are that can be, if they can be anywhere.
        against: the name of another one, which goes the other way by as much.
    """

    def __init__(
        self, trials: ShapeTrials, instance: Instance, name: str, kind: str, bounded: bool = False, against: str = ""
    ) -> None:
        self._trials, self._instance = trials, instance
        self._name, self._kind, self._against = name, kind, against
        self._known: dict[float, float] = {}
        self.whole = trials.whole
        self._least = trials.regression.problem.terms[instance.term].least.get(name, -math.inf)
        # A size that cannot be is no better an explanation for its larger evidence, unless no other is known.
        self._bounded = bounded and trials.tried([instance])[0].allowed

    def width(self, spacing: float) -> float:
        """Distance of a neighbour on the grid."""
        return math.log(spacing) if self._kind == "log" else spacing

    def value(self, step: float) -> float:
        """Value of the parameter at a step."""
        centre = float(dict(self._instance.shape)[self._name])
        return centre * math.exp(step) if self._kind == "log" else centre + step

    def moved(self, step: float) -> Instance:
        """The instance at a step."""
        if step == 0.0:
            return self._instance
        shape = dict(self._instance.shape)
        if self._against:
            shape[self._against] -= self.value(step) - shape[self._name]
        return self._trials.regression.with_shape(self._instance, {**shape, self._name: self.value(step)})

    def evidence(self, step: float) -> float:
        """Log evidence there; none where the size would have to be one that cannot be."""
        self.look_at([step])
        return self._known[step]

    def look_at(self, steps: Sequence[float]) -> None:
        """Find the evidence at several steps at once, which takes hardly longer than at one."""
        self._known |= {step: -math.inf for step in steps if self.value(step) < self._least}
        new = [step for step in dict.fromkeys(steps) if step not in self._known]
        found = self._trials.tried([self.moved(step) for step in new]) if new else []
        for step, trial in zip(new, found, strict=True):
            self._known[step] = -math.inf if self._bounded and not trial.allowed else trial.evidence


def _largest(place: _Place, width: float, coarse: bool) -> float:
    """Step of largest evidence within a width to either side, or near the last one where the search is not coarse."""
    steps = np.linspace(-1.0, 1.0, COARSE) * width
    spacing = float(steps[1] - steps[0])
    if not coarse:
        return _climbed(place, 0.0, 0.5 * spacing, width)
    grid = [float(step) for step in np.round(steps / spacing) * spacing]
    place.look_at(grid)
    peaks = [max(grid, key=place.evidence)]
    if place.whole:  # there is a peak between any two steps of a cycle, each narrower than what lies between two of the grid
        known = [-math.inf, *(place.evidence(step) for step in grid), -math.inf]
        peaks += [step for k, step in enumerate(grid) if known[k] < known[k + 1] > known[k + 2]]
    return max((_climbed(place, peak, spacing, width) for peak in dict.fromkeys(peaks)), key=place.evidence)


def _climbed(place: _Place, best: float, spacing: float, width: float) -> float:
    """Step of the peak next to one, by parabolas through points so far from each other at first."""
    for _ in range(PARABOLAS):
        place.look_at([best - spacing, best, best + spacing])
        left, middle, right = place.evidence(best - spacing), place.evidence(best), place.evidence(best + spacing)
        if max(left, right) > middle:
            further = best + (spacing if right > left else -spacing)
            if abs(further) > FARTHEST * width:  # another wave altogether
                spacing *= 0.3
                continue
            best = further
            spacing = min(2.0 * spacing, width)  # it may be far: where the fit was last made exact the largest was elsewhere
            continue
        bend = left - 2.0 * middle + right
        if not math.isfinite(bend):
            spacing *= 0.3
            continue
        offset = 0.5 * (left - right) / bend if bend < 0.0 else 0.0
        if -0.5 * bend * offset**2 >= WORTH:
            vertex = best + offset * spacing
            if place.evidence(vertex) > middle:
                best = vertex
        elif -0.5 * bend < WORTH:
            break
        spacing *= 0.3
    return best
