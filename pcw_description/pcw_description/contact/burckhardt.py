"""Burckhardt's friction curve, mu = c1 (1 - exp(-c2 s)) - c3 s (Burckhardt, Radschlupf-Regelsysteme, 1993).

The published triple (c1, c2, c3) of a road gives the curve's shape; it is scaled to the peak (lambda_p, mu_p) of the
description, so that every curve shares those two numbers. With the road's own peak the curve is the published one.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

from ..compiled import compiled
from ..errors import DescriptionError, nearest_name

SHAPE_NAMES = ("c1", "c2", "c3")
DRY_ASPHALT = {"c1": 1.2801, "c2": 23.99, "c3": 0.52}


def peak(c1: float, c2: float, c3: float) -> tuple[float, float]:
    """Return (lambda_p, mu_p) of a published triple.

    Raises:
        DescriptionError: the triple has no peak at positive slip.
    """
    if not (c1 > 0.0 and c3 > 0.0 and c1 * c2 > c3):
        raise DescriptionError("contact.shape", {"c1": c1, "c2": c2, "c3": c3}, "allowed: c1, c3 > 0 and c1 c2 > c3 (a peak)")
    ratio = c1 * c2 / c3
    lambda_p = math.log(ratio) / c2
    return lambda_p, c1 - c3 / c2 * (1.0 + math.log(ratio))


def shape_numbers(mu_p: float, lambda_p: float, shape: Mapping[str, float]) -> tuple[float, float, float]:
    """Return (c1, c2, c3) scaled to the peak of the description.

    Raises:
        DescriptionError: unknown name, or a triple without a peak.
    """
    for name in shape:
        if name not in SHAPE_NAMES:
            raise DescriptionError(f"contact.shape.{name}", shape[name], f"unknown key; {nearest_name(name, SHAPE_NAMES)}")
    c1, c2, c3 = (float({**DRY_ASPHALT, **shape}[name]) for name in SHAPE_NAMES)
    own_lambda, own_mu = peak(c1, c2, c3)
    height, width = mu_p / own_mu, lambda_p / own_lambda
    return c1 * height, c2 / width, c3 * height / width


@compiled
def friction(slip, mu_p, lambda_p, a, b, c):  # type: ignore[no-untyped-def]
    """Return mu for a slip >= 0 [1]; a, b, c are the scaled c1, c2, c3. Never below zero."""
    return max(a * (1.0 - math.exp(-b * slip)) - c * slip, 0.0)
