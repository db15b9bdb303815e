"""Terrain pinned to places: a grid that remembers what was found where, so that a patch found once is known next time.

A cell fuses the estimates made on it as independent ones, in log mu_p and log lambda_p. What is written is only what a wheel
felt there and then: it slipped enough to know, and nothing contradicted it. A cell never becomes surer than `least_spread`, as
the ground under a robot's wheels is not the same all over a cell; an estimate that contradicts a cell replaces it.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from pcw_description.robot_description import FloatArray

from .errors import require

UNKNOWN = -1  # of nav_msgs/OccupancyGrid
# An estimate this many standard deviations from a cell's is another ground.
CONTRADICTION = 3.0


@dataclasses.dataclass(frozen=True)
class MapParameters:
    """The grid.

    Attributes:
        resolution: side of a cell [m].
        width, height: cells along x and y.
        origin: place of the outer corner of the first cell in the map's frame (2,) [m].
        least_spread: standard deviation of the logarithms below which a cell is not believed [1].
    """

    resolution: float = 0.1
    width: int = 400
    height: int = 400
    origin: tuple[float, float] = (-20.0, -20.0)
    least_spread: float = 0.03

    def __post_init__(self) -> None:
        """Check the parameters.

        Raises:
            TerrainError: names the field, its value and what is allowed.
        """
        require("resolution", self.resolution, minimum=0.01, maximum=10.0)
        for name in ("width", "height"):
            require(name, getattr(self, name), minimum=1, maximum=4000)
        for index, value in enumerate(self.origin):
            require(f"origin[{index}]", value)
        require("least_spread", self.least_spread, above=0.0, maximum=1.0)


@dataclasses.dataclass(frozen=True)
class Place:
    """What is known of a place: mu_p and lambda_p [1], and the standard deviations of their logarithms."""

    mu_p: float
    lambda_p: float
    mu_spread: float
    lambda_spread: float


class TerrainMap:
    """The map; see the module's docstring.

    Args:
        parameters: the grid.
    """

    def __init__(self, parameters: MapParameters | None = None) -> None:
        self.parameters = parameters or MapParameters()
        p = self.parameters
        # Per cell: information and information times value, of log mu_p and log lambda_p.
        self._cells = np.zeros((p.height, p.width, 4))

    def cell(self, x: float, y: float) -> tuple[int, int] | None:
        """Return row and column of a place [m], None outside the grid or where it is not finite."""
        p = self.parameters
        if not (math.isfinite(x) and math.isfinite(y)):
            return None
        column, row = math.floor((x - p.origin[0]) / p.resolution), math.floor((y - p.origin[1]) / p.resolution)
        return (row, column) if 0 <= row < p.height and 0 <= column < p.width else None

    def add(self, x: float, y: float, mu_p: float, lambda_p: float, covariance: FloatArray) -> bool:
        """Write what was felt at a place; returns whether it lies in the grid.

        Raises:
            TerrainError: an estimate that is not positive, or a spread that is not finite.
        """
        require("mu_p", mu_p, above=0.0)
        require("lambda_p", lambda_p, above=0.0)
        variances = (float(covariance[0, 0]), float(covariance[1, 1]))
        for variance in variances:
            require("variance", variance, minimum=0.0)
        index = self.cell(x, y)
        if index is None:
            return False
        cell, least = self._cells[index], self.parameters.least_spread**2
        for k, (value, variance) in enumerate(zip((math.log(mu_p), math.log(lambda_p)), variances, strict=True)):
            information = 1.0 / max(variance, least)
            if cell[2 * k] > 0.0:
                off = value - cell[2 * k + 1] / cell[2 * k]
                if off * off > CONTRADICTION**2 * (1.0 / cell[2 * k] + 1.0 / information):
                    cell[:] = 0.0
            cell[2 * k + 1] += information * value
            cell[2 * k] += information
            if cell[2 * k] > 1.0 / least:
                cell[2 * k + 1] *= 1.0 / least / cell[2 * k]
                cell[2 * k] = 1.0 / least
        return True

    def at(self, x: float, y: float) -> Place | None:
        """Return what is known of a place [m], None where nothing is."""
        index = self.cell(x, y)
        if index is None or self._cells[index][0] <= 0.0 or self._cells[index][2] <= 0.0:
            return None
        a, b, c, d = (float(value) for value in self._cells[index])
        return Place(math.exp(b / a), math.exp(d / c), math.sqrt(1.0 / a), math.sqrt(1.0 / c))

    @property
    def known(self) -> int:
        """How many cells hold something."""
        return int(np.count_nonzero(self._cells[:, :, 0]))

    def occupancy(self) -> np.ndarray:
        """Return how slippery it is (height, width) int8 for an OccupancyGrid: 100 (1 - mu_p), 0 from mu_p = 1; -1 unknown."""
        information, sums = self._cells[:, :, 0], self._cells[:, :, 1]
        grid = np.full(information.shape, UNKNOWN, dtype=np.int8)
        known = information > 0.0
        grid[known] = np.round(100.0 * (1.0 - np.minimum(np.exp(sums[known] / information[known]), 1.0))).astype(np.int8)
        return grid
