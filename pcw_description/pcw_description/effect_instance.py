"""An effect as it stands in a robot description."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any


@dataclasses.dataclass(frozen=True)
class EffectInstance:
    """An effect at work in a robot description.

    Attributes:
        name: name of the effect in the vocabulary.
        target: caster names, or ("chassis",), ("imu",), ("clock",).
        parameters: values by name, defaults filled in.
        axis: "drive" or "steer" for an effect that can stand at either joint; None for the effect's own place.
    """

    name: str
    target: tuple[str, ...]
    parameters: Mapping[str, float]
    axis: str | None = None

    def to_mapping(self) -> dict[str, Any]:
        """Return the entry as it stands under `physics:`."""
        place = {} if self.axis is None else {"axis": self.axis}
        return {"name": self.name, "target": list(self.target), **place, **dict(self.parameters)}
