"""What can be analysed: a bench axis or a robot, behind one interface."""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from pcw_description.effect_instance import EffectInstance

from ..findings.findings import InputFinding
from ..regression.regression_problem import FloatArray, RegressionProblem
from ..robot.ripple_sizes import RippleSize
from ..robot.turned_steering import TurnedSteering
from ..rollout import Windows


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

    def part_of(self, opened: Sequence[Opened], use: str) -> tuple[Sequence[Opened], str]:
        """Return recordings with as much of them as can be used at once, and a sentence on that, empty where it is all."""

    def awaits_compiling(self) -> bool:
        """Return whether the first problem will take seconds longer than any later one on this machine."""

    def problem(self, opened: Sequence[Opened]) -> RegressionProblem:
        """Return the regression problem of recordings; later calls keep the filters that the first one chose."""

    def put_right(self, problem: RegressionProblem, opened: Sequence[Opened]) -> Sequence[Opened]:
        """Return recordings in the units that a description asks for, told by their problem; the same if they are."""

    def turned_steering(self, problem: RegressionProblem, opened: Sequence[Opened]) -> TurnedSteering | None:
        """Return the one cause beside which nothing can be judged, see `turned_steering`; None where there is none."""

    def ripples(self, opened: Sequence[Opened]) -> Sequence[RippleSize]:
        """Return ripples of joints that pass too fast for the channels, with their sizes."""

    def with_ripples(self, sizes: Sequence[RippleSize], opened: Sequence[Opened]) -> Sequence[RippleSize | None]:
        """Return what ripples of such sizes leave of other recordings, None where these do not show them."""

    def band(self) -> float:
        """Return the frequency that the channels of a problem end at [Hz]."""

    def describing(self, effects: Sequence[EffectInstance]) -> Subject:
        """Return the subject with effects in its description, for the same recordings."""

    def problem_with(self, opened: Sequence[Opened]) -> Callable[[Collection[str]], RegressionProblem]:
        """Return what makes the same of the candidates of some keys alone, none of which is made before."""

    def command_problems(self, opened: Sequence[Opened], searched: bool = True) -> Sequence[RegressionProblem]:
        """Return one problem per joint between its commands and its torques; none where nothing was commanded.

        Args:
            opened: the recordings.
            searched: False: the candidates get no numbers to try, which is most of the work.
        """

    def unit(self, unit: str) -> str:
        """Return a unit of the vocabulary as it is here (a linear axis has N for N m)."""

    def statement(self, instance: EffectInstance) -> str:
        """Return the plain sentence of an effect."""

    def patched(self, effects: Sequence[EffectInstance], retuned: Mapping[str, float]) -> Subject:
        """Return the subject with effects added to its description, and numbers the caller may rely on re-tuned."""

    def mapping(self) -> dict[str, Any]:
        """Return the description as it stands in a file."""

    def path(self, opened: Opened) -> tuple[FloatArray, FloatArray] | None:
        """Return stamps (S,) and pose (S, 3) of a robot by a tracker or by its odometry; None where there is none."""

    def absent(self, opened: Sequence[Opened]) -> tuple[tuple[str, str], ...]:
        """Return what was not recorded, and what that costs, in words."""

    def responses(self, opened: Sequence[Opened]) -> tuple[str, ...]:
        """Return how drives follow commanded speeds, in words; nothing where none were commanded."""

    def windows(self, opened: Sequence[Opened]) -> Windows | None:
        """Return windows of the recordings to drive models of this subject over; None where that cannot be done."""

    def rollout(self, windows: Windows) -> FloatArray:
        """Return the squared errors of forward simulation at the horizons of every window, (W, H, S)."""

    def rollout_floor(self, windows: Windows, rng: np.random.Generator) -> FloatArray:
        """Return the squared errors that noise of start and input makes in a model that is right, (W, H, S)."""


def file_digest(path: Path) -> str:
    """Return the SHA-256 of one file, in hexadecimal."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
