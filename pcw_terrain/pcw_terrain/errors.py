"""The base exception of pcw_terrain, and the checks of numbers that raise it."""

from __future__ import annotations

import math

from pcw_description.errors import PcwError


class TerrainError(PcwError):
    """A parameter or a measurement that is not allowed; the message names it, its value and what is."""


def require(name: str, value: float, minimum: float = -math.inf, above: float = -math.inf, maximum: float = math.inf) -> None:
    """Check a number.

    Raises:
        TerrainError: it is not finite or out of range.
    """
    if not (math.isfinite(value) and minimum <= value <= maximum and value > above):
        lowest = f"above {above:g}" if above > -math.inf else f"at least {minimum:g}"
        raise TerrainError(f"{name} = {value!r} is not allowed; allowed: {lowest}, at most {maximum:g}")


def require_dt(dt: float) -> None:
    """Check a measured time step.

    Raises:
        TerrainError: it is not positive and finite.
    """
    if not (math.isfinite(dt) and dt > 0.0):
        raise TerrainError(f"dt = {dt!r} s is not allowed; allowed: above 0, measured from stamps")
