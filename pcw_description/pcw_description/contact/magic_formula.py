"""Pacejka's magic formula, mu = D sin(C atan(B s - E (B s - atan(B s)))) (Pacejka, Tyre and Vehicle Dynamics, ch. 4).

D is the peak mu_p; B follows from the slip at the peak lambda_p, so that all curves share those two numbers.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

from ..compiled import compiled
from ..errors import DescriptionError, nearest_name

SHAPE_NAMES = ("C", "E")


def shape_numbers(mu_p: float, lambda_p: float, shape: Mapping[str, float]) -> tuple[float, float, float]:
    """Return (B, C, E) with B such that the peak lies at lambda_p.

    Raises:
        DescriptionError: unknown name, C outside (1, 2] or E at 1 or above, where the curve has no peak or ends below zero.
    """
    for name in shape:
        if name not in SHAPE_NAMES:
            raise DescriptionError(f"contact.shape.{name}", shape[name], f"unknown key; {nearest_name(name, SHAPE_NAMES)}")
    c, e = float(shape.get("C", 1.65)), float(shape.get("E", 0.0))
    if not 1.0 < c <= 2.0:
        raise DescriptionError(
            "contact.shape.C", c, "allowed: above 1, where the curve has a peak, and at most 2, where it ends at zero"
        )
    if not -20.0 <= e < 1.0:
        raise DescriptionError("contact.shape.E", e, "allowed: -20 to below 1, where the curve has a peak")
    target = math.tan(math.pi / (2.0 * c))

    def offset(x: float) -> float:
        return x - e * (x - math.atan(x)) - target

    if e == 0.0:
        return target / lambda_p, c, e
    # Here, since it takes half a second, for which every node that starts would wait.
    from scipy.optimize import brentq

    upper = 1.0
    while offset(upper) < 0.0:
        upper *= 2.0
    return float(brentq(offset, 0.0, upper, xtol=1e-14)) / lambda_p, c, e


@compiled
def friction(slip, mu_p, lambda_p, a, b, c):  # type: ignore[no-untyped-def]
    """Return mu for a slip >= 0 [1]; a, b, c are B, C, E."""
    x = a * slip
    return mu_p * math.sin(b * math.atan(x - c * (x - math.atan(x))))
