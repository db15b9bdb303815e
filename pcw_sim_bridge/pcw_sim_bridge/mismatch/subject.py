"""What can be analysed: a bench axis or a robot, behind one interface."""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

from pcw_description.effect_instance import EffectInstance

from .findings import InputFinding
from .regression_problem import RegressionProblem


@dataclasses.dataclass(frozen=True)
class Opened:
    """A recording that was read: the object of its own kind, and what the report says of it."""

    recording: Any
    finding: InputFinding


class Subject(Protocol):
    """A description with recordings of the thing that it describes."""

    name: str

    def open(self, path: Path, role: str, topics: Mapping[str, str]) -> Opened:
        """Read one recording.

        Raises:
            PcwError: it cannot be read; the message names it and says what is wrong.
        """

    def problem(self, opened: Sequence[Opened]) -> RegressionProblem:
        """Return the regression problem of recordings; later calls keep the filters that the first one chose."""

    def unit(self, unit: str) -> str:
        """Return a unit of the vocabulary as it is here (a linear axis has N for N m)."""

    def statement(self, instance: EffectInstance) -> str:
        """Return the plain sentence of an effect."""

    def patched(self, effects: Sequence[EffectInstance], retuned: Mapping[str, float]) -> Subject:
        """Return the subject with effects added to its description, and numbers the caller may rely on re-tuned."""

    def mapping(self) -> dict[str, Any]:
        """Return the description as it stands in a file."""

    def rollout(self, opened: Sequence[Opened]) -> dict[str, float]:
        """Return the error of forward simulation over short windows, per signal, relative to the signal's spread."""


def file_digest(path: Path) -> str:
    """Return the SHA-256 of one file, in hexadecimal."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
