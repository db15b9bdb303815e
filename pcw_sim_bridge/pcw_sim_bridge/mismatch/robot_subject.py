"""A robot on powered casters as a subject of analysis."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pcw_description.effect_instance import EffectInstance
from pcw_description.effects.registry import get
from pcw_description.recording import Recording
from pcw_description.robot_description import STEER, RobotDescription
from pcw_description.robot_file import load_robot, robot_to_mapping

from ..plants.reduced import ReducedPlant
from ..plants.true_robot import as_it_really_is
from .errors import MismatchError
from .findings import InputFinding
from .regression_problem import RegressionProblem
from .robot_channels import RobotProblemBuilder
from .robot_effects import true_motion
from .robot_motion import choose_cutoff, read_motions
from .rolling_model import ModelNumbers, twists
from .subject import Opened

ROLLOUT_WINDOW = 0.5  # [s]
ROLLOUT_STEP = 1e-3  # [s]
SIGNALS = ("v_x", "v_y", "omega")


class RobotSubject:
    """A robot; see `Subject`."""

    def __init__(self, robot: RobotDescription) -> None:
        self.robot = robot
        self.name = f"robot {robot.name}"
        self._cutoff: float | None = None
        self._sensors: tuple[Path, tuple[bool, bool]] | None = None

    @classmethod
    def load(cls, path: Path) -> RobotSubject:
        """Load a `pcw_robot/1` file."""
        return cls(load_robot(path))

    def open(self, path: Path, role: str, topics: Mapping[str, str]) -> Opened:
        """Read one rosbag2 folder or file."""
        recording = Recording.open(path, self.robot, topics)
        self._check_sensors(path, recording)
        warnings = tuple(f"{warning.topic}: {warning.text}" for warning in recording.warnings)
        started = recording.t0_ns * 1e-9
        return Opened(recording, InputFinding(str(path), recording.sha256, recording.duration, role, warnings, started))

    def _check_sensors(self, path: Path, recording: Recording) -> None:
        """All recordings of one analysis have the same channels, those held out too."""
        effort = recording.joint_states.effort
        present = (effort is not None and bool(np.isfinite(effort).any()), recording.imu is not None)
        if self._sensors is None:
            self._sensors = path, present
        first, expected = self._sensors
        for name, here, there in zip(("effort in joint_states", "imu/data"), present, expected, strict=True):
            if here != there:
                has, lacks = (path, first) if here else (first, path)
                raise MismatchError(
                    f"{lacks} has no {name}, and {has} has; allowed: recordings with the same sensors in one analysis"
                )

    def problem(self, opened: Sequence[Opened]) -> RegressionProblem:
        """Return the regression problem."""
        recordings = [o.recording for o in opened]
        if self._cutoff is None:
            self._cutoff = choose_cutoff(self.robot, recordings)
        return RobotProblemBuilder(self.robot, recordings, self._cutoff).build()

    def unit(self, unit: str) -> str:
        """Return a unit as it is."""
        return unit

    def statement(self, instance: EffectInstance) -> str:
        """Return the plain sentence of an effect."""
        return get(instance.name).statement(instance.target, instance.parameters)

    def patched(self, effects: Sequence[EffectInstance], retuned: Mapping[str, float]) -> RobotSubject:
        """Return the robot with effects added; numbers within their tolerance stay as the file has them."""
        subject = RobotSubject(dataclasses.replace(self.robot, physics=(*self.robot.physics, *effects)))
        subject._cutoff = self._cutoff
        return subject

    def mapping(self) -> dict[str, Any]:
        """Return the description as it stands in a file."""
        return robot_to_mapping(self.robot)

    def rollout(self, opened: Sequence[Opened]) -> dict[str, float]:
        """Drive the reduced plant with the measured torques over windows, started at the measured motion.

        The twist of the simulated robot at the end of each window is held against the recorded one, relative to how much the
        twist changes over a window.
        """
        recordings = [o.recording for o in opened]
        if self._cutoff is None:
            self._cutoff = choose_cutoff(self.robot, recordings)
        numbers = ModelNumbers.of(as_it_really_is(self.robot))
        if np.any(np.abs(self.robot.caster_offset[:, 0]) < 1e-3):
            return {}
        plant = ReducedPlant(self.robot, ROLLOUT_STEP)
        apart, change = [], []
        for index, recording in enumerate(recordings):
            if recording.joint_states.effort is None:
                return {}
            for seen in read_motions(self.robot, recording, index, self._cutoff, with_torque=True):
                motion = true_motion(self.robot, seen)
                angle = np.ascontiguousarray(motion.position[:, :, STEER])
                twist, _ = twists(numbers, angle, motion.velocity)
                length = max(2, round(ROLLOUT_WINDOW * motion.rate))
                steps = max(1, round(1.0 / (motion.rate * ROLLOUT_STEP)))
                for start in range(0, len(motion.time) - length, length):
                    plant.reset(steer_angle=angle[start])
                    plant.set_motion(twist[start], motion.position[start], motion.velocity[start])
                    for row in range(start, start + length):
                        plant.step(motion.torque[row], steps)
                    apart.append(plant.state().twist - twist[start + length])
                    change.append(twist[start + length] - twist[start])
        if not apart:
            return {}
        error = np.sqrt(np.mean(np.square(apart), axis=0))
        size = np.sqrt(np.mean(np.square(change), axis=0))
        return {name: float(error[k] / max(size[k], 1e-12)) for k, name in enumerate(SIGNALS)}
