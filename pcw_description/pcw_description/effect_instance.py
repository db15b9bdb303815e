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
    """

    name: str
    target: tuple[str, ...]
    parameters: Mapping[str, float]

    def to_mapping(self) -> dict[str, Any]:
        """Return the entry as it stands under `physics:`."""
        return {"name": self.name, "target": list(self.target), **dict(self.parameters)}
