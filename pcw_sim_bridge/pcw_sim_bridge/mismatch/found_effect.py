"""An effect with found numbers, as it stands under `physics:` of a description."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from pcw_description.effect_instance import EffectInstance
from pcw_description.effects.registry import get


def effect_instance(
    effect_name: str, target: Sequence[str], values: Mapping[str, float], axis: str | None = None
) -> EffectInstance:
    """Return an effect with all its parameters; defaults for those not given, and none beyond its range."""
    effect = get(effect_name)
    complete = {p.name: float(p.default or 0.0) for p in effect.parameters} | dict(values)
    # Rounding of an estimate at its bound must not make a file that its own reader refuses.
    bounded = {p.name: min(max(complete[p.name], p.lower), p.upper) for p in effect.parameters}
    return EffectInstance(effect_name, tuple(target), bounded, axis)
