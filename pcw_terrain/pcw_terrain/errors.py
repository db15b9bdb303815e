"""The base exception of pcw_terrain, and the checks of numbers that raise it."""

from __future__ import annotations

from pcw_description.errors import NumberChecks, PcwError


class TerrainError(PcwError):
    """A parameter or a measurement that is not allowed; the message names it, its value and what is."""


_CHECKS = NumberChecks(TerrainError)
require, require_dt = _CHECKS.number, _CHECKS.time_step
