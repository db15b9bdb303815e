"""A bench axis as a subject of analysis."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
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
from pcw_description.effects.kinds import JointTorqueEffect
from pcw_description.effects.registry import get

from .axis_channels import AxisProblemBuilder, axis_motion
from .findings import InputFinding
from .regression_problem import RegressionProblem
from .subject import Opened, file_digest

ROLLOUT_WINDOW = 0.5  # [s]
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
        recording = read_axis_recording(path, self.axis)
        finding = InputFinding(str(path), file_digest(path), recording.duration, role, recording.warnings)
        return Opened(recording, finding)

    def problem(self, opened: Sequence[Opened]) -> RegressionProblem:
        """Return the regression problem."""
        builder = AxisProblemBuilder(self.axis, [o.recording for o in opened], self._cutoff)
        if self._smoothing is None:
            self._smoothing = builder.choose_smoothing()
        self._cutoff = builder.cutoff
        return builder.build(self._smoothing)

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

    def rollout(self, opened: Sequence[Opened]) -> dict[str, float]:
        """Simulate position and speed from the measured force over windows, started at the measured state."""
        errors, spreads = {"position": [], "velocity": []}, {"position": [], "velocity": []}  # type: ignore[var-annotated]
        assert self._cutoff is not None
        for index, item in enumerate(opened):
            rate, motions = axis_motion(self.axis, item.recording, index, self._cutoff)
            length = int(ROLLOUT_WINDOW * rate)
            for motion in motions:
                starts = np.arange(0, len(motion.time) - length, length)
                if not len(starts):
                    continue
                rows = starts[:, None] + np.arange(length)
                position, velocity = self._simulate(
                    motion.position[starts], motion.velocity[starts], motion.force[rows], rate
                )
                for name, simulated, truth in (
                    ("position", position, motion.position[rows]),
                    ("velocity", velocity, motion.velocity[rows]),
                ):
                    errors[name].append((simulated - truth).ravel())
                    spreads[name].append((truth - truth[:, :1]).ravel())
        return {name: _relative(errors[name], spreads[name]) for name in errors if errors[name]}

    def _simulate(
        self, position: np.ndarray, velocity: np.ndarray, force: np.ndarray, rate: float
    ) -> tuple[np.ndarray, np.ndarray]:
        """Step all windows side by side: position, velocity (W,), force (W, L) -> both (W, L); friction implicit."""
        axis, dt = self.axis, 1.0 / rate
        q, v = position.copy(), velocity.copy()
        positions, velocities = np.empty_like(force), np.empty_like(force)
        zero = np.zeros_like(q)
        nudge = 1e-6 * max(float(np.max(np.abs(velocity))), 1e-6)
        for k in range(force.shape[1]):
            positions[:, k], velocities[:, k] = q, v
            total, slope = force[:, k].copy(), zero.copy()
            if axis.gravity_arm is not None:
                total -= axis.gravity_arm.moment * np.sin(q - axis.gravity_arm.hanging_position)
            for instance in axis.physics:
                effect = get(instance.name)
                if isinstance(effect, JointTorqueEffect):
                    here = effect.contribution(q, v, force[:, k], zero, instance.parameters)
                    ahead = effect.contribution(q, v + nudge, force[:, k], zero, instance.parameters)
                    total += here
                    slope += np.maximum((here - ahead) / nudge, 0.0)
            v = v + dt * total / (axis.inertia + dt * slope)
            q = q + dt * v
        return positions, velocities


def _relative(errors: list[np.ndarray], spreads: list[np.ndarray]) -> float:
    """Root mean square of errors over that of spreads."""
    spread = float(np.mean(np.concatenate(spreads) ** 2))
    return float(np.sqrt(np.mean(np.concatenate(errors) ** 2) / max(spread, 1e-300)))
