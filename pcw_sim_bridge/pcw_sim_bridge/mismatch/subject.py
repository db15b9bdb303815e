"""What can be analysed: a bench axis or a robot, behind one interface."""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

from pcw_description.axis_recording import FORMAT as AXIS_FORMAT
from pcw_description.description_fields import load_yaml_mapping
from pcw_description.effects.effect import EffectInstance
from pcw_description.robot_description import FORMAT as ROBOT_FORMAT
from pcw_description.robot_description import robots_directory, shipped_robots

from .errors import MismatchError
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


def load_subject(description: str) -> Subject:
    """Load a description of either kind.

    Args:
        description: path of a `pcw_robot/1` or `pcw_axis/1` file, or the name of a shipped robot.

    Raises:
        PcwError: no such file, or it is not valid.
    """
    path = Path(description)
    if path.suffix not in (".yaml", ".yml") and description in shipped_robots():
        path = robots_directory() / f"{description}.yaml"
    found = load_yaml_mapping(path).get("format")
    if found == AXIS_FORMAT:
        from .axis_subject import AxisSubject

        return AxisSubject.load(path)
    if found == ROBOT_FORMAT:
        from .robot_subject import RobotSubject

        return RobotSubject.load(path)
    raise MismatchError(f"{path}: format is {found!r}; allowed: {ROBOT_FORMAT} or {AXIS_FORMAT}")


def file_digest(path: Path) -> str:
    """Return the SHA-256 of one file, in hexadecimal."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
