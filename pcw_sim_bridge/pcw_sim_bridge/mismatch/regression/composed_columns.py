"""Columns of all shapes of an effect, put together from those of a few: of a direction, or of a place on the robot."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np

from .regression_problem import FloatArray, Shape

TURNING_ERROR = 0.01  # of columns at one direction that are put together from those at two others
PLACED_ERROR = 1e-3  # of columns at one place on the robot that are put together from those at six others
REACH = 0.05  # [m]; places are not taken closer together
Columns = Callable[[Shape], FloatArray]


class Turning:
    """Columns of an effect that a direction or a phase shapes, of which two a quarter turn apart make all others.

    That an effect is of this kind is seen by trying one direction in between; one that is not is evaluated at each.
    """

    def __init__(self, columns: Columns, name: str) -> None:
        self._columns, self._name = columns, name
        self._turns: bool | None = None
        self._quarters: dict[tuple[tuple[str, float], ...], tuple[FloatArray, FloatArray]] = {}

    def __call__(self, shape: Shape) -> FloatArray:
        """Columns (T, C, P) at one shape."""
        rest = {name: value for name, value in shape.items() if name != self._name}
        if self._turns is None:
            self._turns = self._is_of_two(rest)
        if not self._turns:
            return self._columns(shape)
        first, last = self._quarters_of(rest)
        return math.cos(shape[self._name]) * first + math.sin(shape[self._name]) * last

    def _is_of_two(self, rest: Shape) -> bool:
        first, last = self._quarters_of(rest)
        between = self._columns({**rest, self._name: math.pi / 4.0})
        error = float(np.linalg.norm(math.sqrt(0.5) * (first + last) - between))
        return error <= TURNING_ERROR * float(np.linalg.norm(between))

    def _quarters_of(self, rest: Shape) -> tuple[FloatArray, FloatArray]:
        key = frozen(rest)
        if key not in self._quarters:
            first, last = (self._columns({**rest, self._name: angle}) for angle in (0.0, math.pi / 2.0))
            self._quarters[key] = first, last
        return self._quarters[key]


class Placed:
    """Columns of an effect that a place on the robot shapes, of which six make all others: moments and inertias.

    That they are of second degree in the place is seen by trying a seventh; others are evaluated at each.
    """

    PLACES = np.array([[0.0, 0.0], [1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0], [1.0, 1.0]])

    def __init__(self, columns: Columns, reach: FloatArray) -> None:
        self._columns, self._reach = columns, np.maximum(reach, REACH)
        self._inverse = np.linalg.inv(_second_degree(self.PLACES))
        self._weights: dict[tuple[tuple[str, float], ...], FloatArray] = {}
        self._is_quadratic: bool | None = None

    def __call__(self, shape: Shape) -> FloatArray:
        """Columns (T, C, P) at one shape."""
        if self._is_quadratic is None:
            self._is_quadratic = self._fits(shape)
        return self._quadratic(shape) if self._is_quadratic else self._columns(shape)

    def _fits(self, shape: Shape) -> bool:
        between = self._at(shape, (-0.4, 0.6))
        there = self._columns(between)
        return float(np.linalg.norm(self._quadratic(between) - there)) <= PLACED_ERROR * float(np.linalg.norm(there))

    def _quadratic(self, shape: Shape) -> FloatArray:
        rest = frozen({name: value for name, value in shape.items() if name not in ("x", "y")})
        if rest not in self._weights:
            at = [self._columns(self._at(shape, place)) for place in self.PLACES]
            self._weights[rest] = np.tensordot(self._inverse, np.stack(at), axes=1)
        place = np.array([[shape["x"], shape["y"]]]) / self._reach
        found: FloatArray = np.tensordot(_second_degree(place)[0], self._weights[rest], axes=1)
        return found

    def _at(self, shape: Shape, place: Sequence[float]) -> Shape:
        """The shape with a place in parts of the reach."""
        return {**shape, "x": float(place[0] * self._reach[0]), "y": float(place[1] * self._reach[1])}


def _second_degree(places: FloatArray) -> FloatArray:
    """Monomials up to second degree of places (K, 2), (K, 6)."""
    x, y = places.T
    return np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=1)


def frozen(shape: Shape) -> tuple[tuple[str, float], ...]:
    """A shape as the key of a dictionary."""
    return tuple(sorted(shape.items()))
