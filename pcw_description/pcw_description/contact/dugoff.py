"""Dugoff's tyre (Dugoff, Fancher, Segel 1970), longitudinal form: stiffness and limit, no peak.

    mu = C s / (1 - s) f(t),   t = mu_p (1 - s) / (2 C s),   f(t) = t (2 - t) for t < 1, else 1.

It rises towards mu_p for ever; lambda_p is the slip at which it has reached 95 % of it.
"""

from __future__ import annotations

from collections.abc import Mapping

from ..compiled import compiled
from ..errors import DescriptionError, nearest_name

SHAPE_NAMES = ("stiffness",)
REACHED = 0.95


def shape_numbers(mu_p: float, lambda_p: float, shape: Mapping[str, float]) -> tuple[float, float, float]:
    """Return (C, 0, 0): slip stiffness per normal force [1], from lambda_p unless `stiffness` is given.

    Raises:
        DescriptionError: unknown name or a stiffness that is not positive.
    """
    for name in shape:
        if name not in SHAPE_NAMES:
            raise DescriptionError(f"contact.shape.{name}", shape[name], f"unknown key; {nearest_name(name, SHAPE_NAMES)}")
    stiffness = float(shape.get("stiffness", mu_p * (1.0 - lambda_p) / (4.0 * (1.0 - REACHED) * lambda_p)))
    if not stiffness > 0.0:
        raise DescriptionError("contact.shape.stiffness", stiffness, "allowed: above 0")
    return stiffness, 0.0, 0.0


@compiled
def friction(slip, mu_p, lambda_p, a, b, c):  # type: ignore[no-untyped-def]
    """Return mu for a slip >= 0 [1]; a is the stiffness."""
    if slip >= 1.0:
        return mu_p
    linear = a * slip
    if 2.0 * linear <= mu_p * (1.0 - slip):
        return linear / (1.0 - slip)
    return mu_p * (1.0 - mu_p * (1.0 - slip) / (4.0 * linear))
