"""Forces that change along the floor, finer than a map of it: grooves, joints of plates, cables and magnets under it.

    force along an axis of the world = w_0 + sum_i (a_i cos(k_i . r) + b_i sin(k_i . r))

Which wave vectors k_i are worth trying is seen from the residual: sums of the force over the cells of the floor have them as
peaks of their spectrum. They are taken one after the other, each where it explains most together with those before it.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import numpy as np
from scipy import optimize

from ..regression.regression_problem import FloatArray, RegressionProblem
from .unknown_law import Basis, Combination, Factor, Law, Place

CELLS = 64  # along the longer side of the floor; a few of them are the shortest wave
SHORTEST = 4.0  # cells
PADDED = 4  # times as many points of the spectrum, so that a peak is not missed between two
# A wave is seen if this many of it lie on the floor that was driven; longer ones are for a map.
FEWEST_WAVES = 1.5
MOST_WAVES = 4
KNOTS = 49  # along each side, of the map that stands for the waves in a file

Vector = tuple[float, float]


@dataclasses.dataclass(frozen=True)
class Waves(Basis):
    """Waves along the floor: 1, and the cosine and the sine of each vector [rad/m] times the place."""

    vectors: tuple[Vector, ...] = ()

    def functions(self, arguments: Sequence[FloatArray]) -> FloatArray:
        """Evaluate at places x and y, (N,) each; (N, 2 * waves + 1)."""
        phases = [first * arguments[0] + second * arguments[1] for first, second in self.vectors]
        waves = [function(phase) for phase in phases for function in (np.cos, np.sin)]
        return np.stack([np.ones_like(arguments[0]), *waves], axis=1)

    def values_at_knots(self, weights: FloatArray) -> FloatArray:
        """Return the map of weights (K,) at its knots."""
        x, y = np.meshgrid(*(np.array(knots) for knots in self.knots), indexing="ij")
        values: FloatArray = self.functions([x.ravel(), y.ravel()]) @ weights
        return values


def place_waves(problem: RegressionProblem, left: FloatArray) -> list[Law]:
    """Return the laws, along each axis of the world, whose waves a residual (T, C) holds most of.

    None without a place, or without forces.
    """
    names = [channel.name for channel in problem.channels]
    if "x" not in problem.variables or "chassis_force/x" not in names:
        return []
    channels = [names.index("chassis_force/x"), names.index("chassis_force/y")]
    valid = problem.valid[:, channels].all(axis=1)
    if valid.sum() < 4 * MOST_WAVES:
        return []
    x, y, yaw = (problem.variables[name][valid] for name in ("x", "y", "yaw"))
    along, across = left[valid][:, channels].T
    c, s = np.cos(yaw), np.sin(yaw)
    knots = tuple(tuple(np.linspace(values.min(), values.max(), KNOTS).tolist()) for values in (x, y))
    arguments: tuple[Combination, ...] = ((("x", 1.0),), (("y", 1.0),))
    cos, sin = Factor("cos", "yaw"), Factor("sin", "yaw")
    laws = []
    to_x, to_y = c * along - s * across, s * along + c * across
    for force, (first, second, sign) in ((to_x, (cos, sin, -1.0)), (to_y, (sin, cos, 1.0))):
        places = (Place("chassis_force/x", first, arguments), Place("chassis_force/y", second, arguments, sign))
        vectors = _vectors(x, y, force)
        if vectors:
            laws.append(Law(places, Waves("waves", knots, vectors=vectors)))
    return laws


def _vectors(x: FloatArray, y: FloatArray, force: FloatArray) -> tuple[Vector, ...]:
    """Wave vectors [rad/m] that explain most of forces (T,) at places (T,)."""
    extent = max(float(np.ptp(x)), float(np.ptp(y)))
    if extent <= 0.0:
        return ()
    cell = extent / CELLS
    place = tuple(np.floor((values - values.min()) / cell).astype(np.int64) for values in (x, y))
    size = PADDED * CELLS
    first, second = math.tau * np.fft.fftfreq(size, cell), math.tau * np.fft.rfftfreq(size, cell)
    lengths = np.hypot(first[:, None], second)
    seen = (lengths > math.tau * FEWEST_WAVES / extent) & (lengths < math.tau / (SHORTEST * cell))
    found: list[Vector] = []

    def left(vectors: Sequence[Vector]) -> FloatArray:
        columns = Waves("waves", (), vectors=tuple(vectors)).functions([x, y])
        remainder: FloatArray = force - columns @ np.linalg.lstsq(columns, force, rcond=1e-6)[0]
        return remainder

    for _ in range(MOST_WAVES):
        floor = np.zeros((CELLS + 1, CELLS + 1))
        np.add.at(floor, place, left(found))
        power = np.where(seen, np.abs(np.fft.rfft2(floor, (size, size))) ** 2, 0.0)
        row, column = np.unravel_index(int(np.argmax(power)), power.shape)
        start = np.array([first[row], second[column]])

        def cost(vector: FloatArray) -> float:
            return float(np.sum(left([*found, (float(vector[0]), float(vector[1]))]) ** 2))

        step = math.pi / extent * np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
        best = optimize.minimize(cost, start, method="Nelder-Mead", options={"maxfev": 60, "initial_simplex": start + step}).x
        found.append((float(best[0]), float(best[1])))
    return tuple(found)
