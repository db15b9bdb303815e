"""The base exception of pcw_estimation, and the checks of numbers that raise it."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Collection
from typing import Any

from pcw_description.errors import NumberChecks, PcwError


class EstimationError(PcwError):
    """An estimator's parameter or measurement that is not allowed; the message says what is."""


_CHECKS = NumberChecks(EstimationError)
require, require_dt = _CHECKS.number, _CHECKS.time_step


def require_not_negative(parameters: Any, positive: Collection[str]) -> None:
    """Check that all fields of a dataclass are finite and at least 0, those in `positive` above it.

    Raises:
        EstimationError: names the field, its value and what is allowed.
    """
    for field in dataclasses.fields(parameters):
        value = getattr(parameters, field.name)
        excluded = field.name in positive
        if not math.isfinite(value) or value < 0.0 or (excluded and value == 0.0):
            allowed = "a positive number" if excluded else "a finite number, at least 0"
            raise EstimationError(f"{field.name} = {value!r} is not allowed; allowed: {allowed}")
