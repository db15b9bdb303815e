"""How what is left changes with the shapes of effects at work: for steps to better ones, and for intervals beside all numbers.

A search finds shapes by first orders of effects. Beside numbers that do nearly the same, as a centre of mass does beside a
payload's place, the evidence of first orders is largest elsewhere than that of the model. Slopes are the model's own, where
the problem is exact; with them a shape is one more number of a joint fit.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Collection, Sequence

import numpy as np

from ..regression.regression_problem import FloatArray, LinearParameter, RegressionProblem, SizedTerm, Term
from ..regression.whitened_regression import Instance

SLOPE = "shape"  # what the terms are called that stand for shapes
NEARBY = 0.01  # of the distance between neighbours on a shape's grid, over which its slope is taken
WIDE = 10.0  # such distances that nothing is expected of a shape within
USUAL = 2.0  # and those that are expected of one that nothing but slopes tells


@dataclasses.dataclass(frozen=True)
class ShapeSlope:
    """One shaping parameter of one effect.

    Attributes:
        index: of the instance in its set; name: of the parameter.
        is_log: whether it is searched on a logarithmic scale; spacing: distance of neighbours on its grid on that scale.
        least, largest: values that it may have.
        deviation: that is expected of it, in distances of neighbours.
    """

    index: int
    name: str
    is_log: bool
    spacing: float
    least: float = -math.inf
    largest: float = math.inf
    deviation: float = WIDE

    def interval(self, instance: Instance, half: float) -> tuple[float, float]:
        """Return the values of the parameter so many distances of neighbours to either side."""
        low, high = (dict(self.moved(instance, side * half).shape)[self.name] for side in (-1.0, 1.0))
        return low, high

    def moved(self, instance: Instance, steps: float) -> Instance:
        """Return the instance with the parameter so many distances of neighbours away."""
        shape = dict(instance.shape)
        away = steps * self.spacing
        value = shape[self.name] * math.exp(away) if self.is_log else shape[self.name] + away
        shape[self.name] = min(max(value, self.least), self.largest)
        return dataclasses.replace(instance, shape=tuple(sorted(shape.items())))


def with_slopes(
    problem: RegressionProblem, instances: Sequence[Instance], sizes: Sequence[FloatArray], fixed: Collection[int] = ()
) -> tuple[RegressionProblem, list[ShapeSlope]]:
    """Return the problem with one further term per shaping parameter of a set, in distances of neighbours on its grid.

    Args:
        problem: exact at the set, with its columns as they are there.
        instances: the set.
        sizes: of the active parameters of each.
        fixed: terms whose shapes stay as they are.
    """
    slopes: list[ShapeSlope] = []
    terms: list[Term] = []
    for index, (instance, size) in enumerate(zip(instances, sizes, strict=True)):
        own = problem.terms[instance.term]
        # What is there or not there as a whole has a likelihood with many peaks.
        if instance.term in fixed or any(parameter.hidden for parameter in own.parameters):
            continue
        shape, found = dict(instance.shape), []
        for name, (kind, distance) in own.resolution.items():
            if not kind or (kind == "log" and shape[name] <= 0.0) or (name in own.whole and shape[name] == round(shape[name])):
                continue
            found.append(ShapeSlope(index, name, kind == "log", math.log(distance) if kind == "log" else distance))
        found += [
            ShapeSlope(index, name, False, distance, least, largest, USUAL)
            for name, (distance, least, largest) in own.settled.items()
        ]
        for slope in found:
            less, more = (slope.moved(instance, side * NEARBY) for side in (-1.0, 1.0))
            change = problem.change_between(_sized(own, instance, size), less.shape, more.shape)
            if change is None or not np.any(change):
                continue
            slopes.append(slope)
            terms.append(_term(slope, own.target, (change / (2.0 * NEARBY))[:, :, None]))
    return (problem.with_terms(terms) if terms else problem), slopes


def slope_instances(problem: RegressionProblem, slopes: Sequence[ShapeSlope]) -> tuple[Instance, ...]:
    """The last terms of a problem with slopes, as instances."""
    first = len(problem.terms) - len(slopes)
    return tuple(Instance(first + k, (), (0,)) for k in range(len(slopes)))


def sizes_of(instances: Sequence[Instance], numbers: FloatArray) -> list[FloatArray]:
    """Sizes of the active parameters of each instance of a set, the last of its numbers (k,)."""
    ends = np.cumsum([len(instance.active) for instance in instances])
    return np.split(numbers[len(numbers) - int(ends[-1]) :], ends[:-1]) if len(ends) else []


def _sized(term: Term, instance: Instance, size: FloatArray) -> SizedTerm:
    coefficients = np.zeros(len(term.parameters))
    coefficients[list(instance.active)] = size
    return SizedTerm(instance.term, instance.shape, coefficients, instance.active)


def _term(slope: ShapeSlope, target: tuple[str, ...], columns: FloatArray) -> Term:
    parameter = LinearParameter(slope.name, "", -math.inf, math.inf, slope.deviation)
    return Term(effect=SLOPE, target=target, parameters=(parameter,), shapes=({},), columns=lambda shape: columns)
