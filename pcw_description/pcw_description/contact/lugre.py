"""Average lumped LuGre tyre (Canudas de Wit, Tsiotras, Velenis, Basset, Gissinger 2003).

    z_dot = v_r - sigma_0 |v_r| / g(v_r) z - kappa |V| z,    g(v_r) = mu_c + (mu_s - mu_c) exp(-(|v_r| / v_s)^(1/2)),
    mu = sigma_0 z

Bristle damping is the contact model's common `DAMPING_TIME`. mu_s is the description's mu_p; sigma_0 follows from the
slip stiffness 2 mu_p / lambda_p of the other curves, kappa is one over the relaxation length.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

from ..compiled import compiled
from ..errors import DescriptionError, nearest_name

SHAPE_NAMES = ("mu_c", "v_s")


def shape_numbers(mu_p: float, lambda_p: float, shape: Mapping[str, float]) -> tuple[float, float, float]:
    """Return (slip stiffness [1], mu_c / mu_p [1], v_s [m/s]).

    Raises:
        DescriptionError: unknown name, mu_c above mu_p or a Stribeck velocity that is not positive.
    """
    for name in shape:
        if name not in SHAPE_NAMES:
            raise DescriptionError(f"contact.shape.{name}", shape[name], f"unknown key; {nearest_name(name, SHAPE_NAMES)}")
    mu_c, v_s = float(shape.get("mu_c", 0.7 * mu_p)), float(shape.get("v_s", 1.0))
    if not 0.0 < mu_c <= mu_p:
        raise DescriptionError("contact.shape.mu_c", mu_c, f"allowed: above 0, at most mu_p = {mu_p:g}")
    if not v_s > 0.0:
        raise DescriptionError("contact.shape.v_s", v_s, "allowed: above 0 m/s")
    return 2.0 * mu_p / lambda_p, mu_c / mu_p, v_s


@compiled
def sliding_friction(slip_speed, mu_p, ratio, v_s):  # type: ignore[no-untyped-def]
    """Return g(v_r) [1]: friction of full sliding at a slip speed >= 0 [m/s]."""
    return mu_p * (ratio + (1.0 - ratio) * math.exp(-math.sqrt(slip_speed / v_s)))


@compiled
def friction(slip, mu_p, lambda_p, a, b, c):  # type: ignore[no-untyped-def]
    """Return the steady mu for a slip >= 0 [1] at a rolling speed of 1 m/s."""
    return a * slip / (1.0 + a * slip / sliding_friction(slip, mu_p, b, c))
