"""Kiencke's friction curve, (3.47) [Li2009]: mu = 2 mu_p lambda_p lambda / (lambda_p^2 + lambda^2)."""

from __future__ import annotations

from collections.abc import Mapping

from ..compiled import compiled
from ..errors import DescriptionError

SHAPE_NAMES: tuple[str, ...] = ()


def shape_numbers(mu_p: float, lambda_p: float, shape: Mapping[str, float]) -> tuple[float, float, float]:
    """Return the three further numbers of the curve; Kiencke's has none."""
    for name in shape:
        raise DescriptionError(f"contact.shape.{name}", shape[name], "allowed: no shape numbers for kiencke")
    return 0.0, 0.0, 0.0


@compiled
def friction(slip, mu_p, lambda_p, a, b, c):  # type: ignore[no-untyped-def]
    """Return mu for a slip >= 0 [1]."""
    return 2.0 * mu_p * lambda_p * slip / (lambda_p * lambda_p + slip * slip)
