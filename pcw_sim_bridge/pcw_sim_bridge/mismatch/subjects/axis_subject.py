"""A bench axis as a subject of analysis."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pcw_description.axis_recording import (
    AxisDescription,
    axis_to_mapping,
    load_axis_description,
    read_axis_recording,
)
from pcw_description.effect_instance import EffectInstance
from pcw_description.effects.registry import get

from ..axis.axis_channels import AxisProblemBuilder
from ..axis.axis_rollout import axis_windows, rollout_floor, rollout_squares
from ..axis.late_speed import with_timely_speed
from ..findings.findings import InputFinding
from ..regression.regression_problem import HEALTHY, FloatArray, RegressionProblem
from ..robot.ripple_sizes import RippleSize
from ..rollout import Windows
from .subject import Opened, file_digest

# Sentences name rotary units; on a linear axis the longest match is replaced first.
_LINEAR_WORDS = ("N m s/rad", "rad/s", "1/rad", "N m")


class AxisSubject:
    """A bench axis; see `Subject`."""

    def __init__(self, axis: AxisDescription) -> None:
        self.axis = axis
        self.name = f"axis {axis.name}"
        self._cutoff: float | None = None
        self._smoothing: float | None = None

    @classmethod
    def load(cls, path: Path) -> AxisSubject:
        """Load a `pcw_axis/1` file."""
        return cls(load_axis_description(path))

    def open(self, path: Path, role: str, topics: Mapping[str, str]) -> Opened:
        """Read one CSV, NPY, NPZ or MAT file; topics mean nothing here."""
        recording = with_timely_speed(read_axis_recording(path, self.axis))
        finding = InputFinding(str(path), file_digest(path), recording.duration, role, recording.warnings)
        return Opened(recording, finding)

    def part_of(self, opened: Sequence[Opened], use: str) -> tuple[Sequence[Opened], str]:
        """Return them as they are: one channel takes little memory."""
        return opened, ""

    def awaits_compiling(self) -> bool:
        """Return False: its kernels are compiled as they are imported."""
        return False

    def problem(self, opened: Sequence[Opened]) -> RegressionProblem:
        """Return the regression problem."""
        builder = AxisProblemBuilder(self.axis, [o.recording for o in opened], self._cutoff)
        if self._smoothing is None:
            self._smoothing = builder.choose_smoothing()
        self._cutoff = builder.cutoff
        return builder.build(self._smoothing)

    def put_right(self, problem: RegressionProblem, opened: Sequence[Opened]) -> Sequence[Opened]:
        """Return the recordings with forces put back in time, with a warning, where they act at another time than recorded."""
        fitted = [one.recording for one in opened if one.finding.role == "fit"]
        builder = AxisProblemBuilder(self.axis, fitted, self._cutoff)
        late, tolerance = builder.delay(), next(n.deviation for n in problem.nuisances if n.name == "clock_offset")
        if abs(late) <= HEALTHY * tolerance:
            return opened
        when = "earlier" if late > 0.0 else "later"
        warning = f"the force acts about {1e3 * abs(late):.0f} ms {when} than recorded, by the motor or a filter; put back"
        right = []
        for one in opened:
            acted = np.interp(one.recording.time + late, one.recording.time, one.recording.force)
            finding = dataclasses.replace(one.finding, warnings=(*one.finding.warnings, warning))
            right.append(Opened(dataclasses.replace(one.recording, force=acted), finding))
        return right

    def turned_steering(self, problem: RegressionProblem, opened: Sequence[Opened]) -> None:
        """Return None: an axis has none."""

    def ripples(self, opened: Sequence[Opened]) -> tuple[()]:
        """Return nothing: the one channel of an axis is searched for ripples as it is."""
        return ()

    def with_ripples(self, sizes: Sequence[RippleSize], opened: Sequence[Opened]) -> tuple[()]:
        """Return nothing."""
        return ()

    def band(self) -> float:
        """Return infinity: there is nothing above the channel."""
        return math.inf

    def describing(self, effects: Sequence[EffectInstance]) -> AxisSubject:
        """Return the axis with effects in its description."""
        return self.patched(effects, {})

    def problem_with(self, opened: Sequence[Opened]) -> Callable[[Collection[str]], RegressionProblem]:
        """Return what returns the problem: all candidates of one channel are made in no time."""
        problem = self.problem(opened)
        return lambda keys: problem

    def command_problems(self, opened: Sequence[Opened], searched: bool = True) -> Sequence[RegressionProblem]:
        """Return nothing: what a bench records is the force itself."""
        return ()

    def unit(self, unit: str) -> str:
        """Return a unit as it is on this axis."""
        return self.axis.unit(unit)

    def statement(self, instance: EffectInstance) -> str:
        """Return the plain sentence, in the axis's units."""
        sentence = get(instance.name).statement(("the axis",), instance.parameters)
        if self.axis.kind == "rotary" and instance.parameters.get("order") == 1.0:
            cosine, sine = instance.parameters["cosine"], instance.parameters["sine"]
            moment, hanging = math.hypot(cosine, sine), math.atan2(cosine, -sine)
            gravity = f"gravity on an arm of {moment:.3g} N m that hangs at {hanging:.3g} rad"
            sentence = f"{sentence.removesuffix('.')}, or {gravity}."
        sentence = sentence.replace("the drive of the axis", "the axis")
        for index, unit in enumerate(_LINEAR_WORDS):
            sentence = sentence.replace(f" {unit}", f" \0{index}")
        for index, unit in enumerate(_LINEAR_WORDS):
            sentence = sentence.replace(f"\0{index}", self.axis.unit(unit))
        return sentence.replace("per radian", "per metre") if self.axis.kind == "linear" else sentence

    def patched(self, effects: Sequence[EffectInstance], retuned: Mapping[str, float]) -> AxisSubject:
        """Return the axis with effects added, its inertia and arm as the recordings have them."""
        arm = self.axis.gravity_arm
        if arm is not None:
            moment = retuned.get("gravity_moment", arm.moment)
            arm = dataclasses.replace(
                arm, moment=moment, hanging_position=retuned.get("hanging_position", arm.hanging_position)
            )
        axis = dataclasses.replace(
            self.axis,
            physics=(*self.axis.physics, *effects),
            inertia=retuned.get("inertia", self.axis.inertia),
            gravity_arm=arm,
        )
        subject = AxisSubject(axis)
        subject._cutoff, subject._smoothing = self._cutoff, self._smoothing
        return subject

    def mapping(self) -> dict[str, Any]:
        """Return the description as it stands in a file."""
        return axis_to_mapping(self.axis)

    def path(self, opened: Opened) -> None:
        """A bench axis goes nowhere."""

    def absent(self, opened: Sequence[Opened]) -> tuple[tuple[str, str], ...]:
        """Return nothing: without what an axis needs its recording is not read."""
        return ()

    def responses(self, opened: Sequence[Opened]) -> tuple[str, ...]:
        """Return nothing: a bench records no commands."""
        return ()

    def windows(self, opened: Sequence[Opened]) -> Windows | None:
        """Return the windows to simulate."""
        assert self._cutoff is not None
        return axis_windows(self.axis, [o.recording for o in opened], self._cutoff)

    def rollout(self, windows: Windows) -> FloatArray:
        """Return the squared errors of position and speed under the measured force, (W, H, 2)."""
        return rollout_squares(self.axis, windows)

    def rollout_floor(self, windows: Windows, rng: np.random.Generator) -> FloatArray:
        """Return the squared errors that the noise of the sensors makes in it, (W, H, 2)."""
        return rollout_floor(self.axis, windows, rng)
