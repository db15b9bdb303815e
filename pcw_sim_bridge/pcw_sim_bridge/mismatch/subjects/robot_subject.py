"""A robot on powered casters as a subject of analysis."""

from __future__ import annotations

import copy
import dataclasses
import functools
import math
import threading
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pcw_description.effect_instance import EffectInstance
from pcw_description.effects.kinds import ActuatorEffect
from pcw_description.effects.registry import get
from pcw_description.recording import Recording
from pcw_description.robot_description import (
    AXIS_NAMES,
    DRIVE,
    STEER,
    Caster,
    ContactDescription,
    RobotDescription,
    possible_caster,
)
from pcw_description.robot_file import load_robot, robot_to_mapping

from ...plants.true_robot import as_it_really_is
from ..errors import MismatchError
from ..findings.findings import InputFinding
from ..found_effect import effect_instance
from ..readings.even_stamps import EvenStamps, late_stamps
from ..readings.joint_glitches import without_glitches
from ..readings.reported_torques import doubtful_reports, told_of, unmeasured_torques
from ..regression.regression_problem import BoolArray, FloatArray, RegressionProblem
from ..robot.command_tracking import command_problems, joints_that_report_commands
from ..robot.joint_ripples import JointRipple, joint_ripples
from ..robot.long_recordings import part_of
from ..robot.off_ground import wheels_off_ground, wheels_turn_alone
from ..robot.ripple_sizes import RippleScale, RippleSize
from ..robot.robot_channels import RobotProblemBuilder
from ..robot.robot_motion import base_pose, choose_cutoff, has_torques, seldom_read, seldom_tracked
from ..robot.robot_nuisances import FLOOR, common_relaxation, rotor_armature
from ..robot.robot_rollout import Undescribed, robot_windows, rollout_floor, rollout_squares
from ..robot.rolling_model import WRENCH, model_awaits_compiling
from ..robot.sensor_axes import unlike_axes
from ..robot.speed_response import responses_in_words, speed_responses
from ..robot.torque_units import torque_units
from ..robot.turned_steering import TurnedSteering
from ..robot.wheel_agreement import contradictions
from ..rollout import Windows
from .subject import Opened

OFF_GROUND = "joint_states: the wheels turn and the robot stands: they are off the ground, and each joint is judged by itself"
UNBALANCED = 0.15  # of the force that torques make, which a steering that is turned far leaves at least
LEAST_PART = 0.1  # of a number that cannot vanish, however far a fit runs off
WEIGHED = 0.3  # of the mean square that a ripple makes, which may be left beside it
Reader = Callable[[Path, RobotDescription, Mapping[str, str]], Recording]


class RobotSubject:
    """A robot; see `Subject`."""

    def __init__(self, robot: RobotDescription, read: Reader = Recording.open) -> None:
        self.robot, self._read = robot, read
        self.name = f"robot {robot.name}"
        self._cutoff: float | None = None
        self._leads: FloatArray | None = None
        self._held: BoolArray | None = None
        self._choosing = threading.Lock()
        self._undescribed = Undescribed()
        self._missing: tuple[str, ...] = ()
        self._sensors: tuple[Path, tuple[bool, bool]] | None = None
        self._lifted: tuple[Path, bool] | None = None

    @classmethod
    def load(cls, path: Path, read: Reader = Recording.open) -> RobotSubject:
        """Load a `pcw_robot/1` file; `read` opens its recordings."""
        return cls(load_robot(path), read)

    def open(self, path: Path, role: str, topics: Mapping[str, str]) -> Opened:
        """Read one rosbag2 folder or file."""
        recording = self._read(path, self.robot, topics)
        found = recording.warnings
        missing = _missing_casters(self.robot, recording)
        self._check_casters(path, missing)
        if missing:
            recording = self._read(path, self._seen_robot(), topics)
        unmeasured = unmeasured_torques(self._seen_robot(), recording)
        if missing or unmeasured:
            # The force of one caster unknown, that of all together is.
            recording = _without_torques(recording)
        self._check_sensors(path, recording)
        evened = EvenStamps().evenly_stamped(recording)
        late = late_stamps(recording, evened)
        recording, jumps = without_glitches(evened)
        warnings = [*(f"{warning.topic}: {warning.text}" for warning in found), *late, *jumps]
        warnings += [text for text in (unmeasured, seldom_read(recording), seldom_tracked(recording)) if text]
        if self._is_lifted(path, recording):
            warnings.append(OFF_GROUND)
        else:
            against = contradictions(self._seen_robot(), recording)
            warnings += against or unlike_axes(self._seen_robot(), recording)
        warnings += told_of(self._seen_robot(), doubtful_reports(self._seen_robot(), recording))
        started = recording.t0_ns * 1e-9
        finding = InputFinding(str(path), recording.sha256, recording.duration, role, tuple(warnings), started)
        return Opened(recording, finding)

    def _seen_robot(self) -> RobotDescription:
        """The robot as far as its recordings hold it."""
        if not self._missing:
            return self.robot
        casters = tuple(caster for caster in self.robot.casters if caster.name not in self._missing)
        physics = tuple(i for i in self.robot.physics if not set(i.target) & set(self._missing))
        return dataclasses.replace(self.robot, casters=casters, physics=physics)

    def _check_casters(self, path: Path, missing: tuple[str, ...]) -> None:
        """All recordings of one analysis lack the same casters, if any."""
        if self._sensors is None:
            self._missing = missing
        elif missing != self._missing:
            raise MismatchError(
                f"{path} lacks {', '.join(missing) or 'no caster'}, and {self._sensors[0]} lacks "
                f"{', '.join(self._missing) or 'none'}; allowed: recordings with the same casters in one analysis"
            )

    def _check_sensors(self, path: Path, recording: Recording) -> None:
        """All recordings of one analysis have the same channels, those held out too."""
        present = _has_effort(recording), _has_imu(recording)
        if self._sensors is None:
            self._sensors = path, present
        first, expected = self._sensors
        for name, here, there in zip(("effort in joint_states", "imu/data"), present, expected, strict=True):
            if here != there:
                has, lacks = (path, first) if here else (first, path)
                raise MismatchError(
                    f"{lacks} has no {name}, and {has} has; allowed: recordings with the same sensors in one analysis"
                )

    def _is_lifted(self, path: Path, recording: Recording) -> bool:
        """Whether the wheels are off the ground: in all recordings of one analysis, or in none."""
        lifted = wheels_off_ground(self._seen_robot(), recording)
        if self._lifted is None:
            self._lifted = path, lifted
        first, expected = self._lifted
        if lifted != expected:
            off, on = (path, first) if lifted else (first, path)
            raise MismatchError(
                f"in {off} the wheels are off the ground, and in {on} they move the robot; allowed: one kind in one analysis"
            )
        return lifted

    @property
    def _off_ground(self) -> bool:
        return self._lifted is not None and self._lifted[1]

    def part_of(self, opened: Sequence[Opened], use: str) -> tuple[Sequence[Opened], str]:
        """Return recordings of some minutes together; see `long_recordings`."""
        parts, told = part_of([o.recording for o in opened], use)
        return [dataclasses.replace(o, recording=part) for o, part in zip(opened, parts, strict=True)], told

    def awaits_compiling(self) -> bool:
        """Return whether the channels' model was not used on this machine before."""
        return model_awaits_compiling()

    def problem(self, opened: Sequence[Opened]) -> RegressionProblem:
        """Return the regression problem of the recordings that are fitted."""
        self._leads, self._held = None, None
        builder = self._builder(opened)
        problem = builder.build()
        # In what is held out the same clocks are ahead by as much, and the same steerings stick, though the robot may move too
        # little to show it.
        self._leads, self._held = builder.leads, builder.held if builder.held.any() else None
        return problem

    def put_right(self, problem: RegressionProblem, opened: Sequence[Opened]) -> Sequence[Opened]:
        """Return recordings with torques at the joints, or without any where nobody knows their units and no wheel is turned.

        They stay as they are, for a problem of another kind, where torques alone tell that the wheels are off the ground.
        """
        if not self._off_ground and wheels_turn_alone(problem):
            self._lifted, self._cutoff = (Path(opened[0].finding.path), True), None
            return [Opened(one.recording, dataclasses.replace(one.finding, warnings=(OFF_GROUND,))) for one in opened]
        found = torque_units(self._seen_robot(), problem)
        if found is None:
            return opened
        # One wheel that points elsewhere makes all torques look wrong.
        left_out = not found.is_known and self.turned_steering(problem, opened) is None
        right = []
        for one in opened:
            recording = _without_torques(one.recording) if left_out else copy.copy(one.recording)
            if found.is_known:
                recording.joint_states, recording.joint_commands = found.put_right(self._seen_robot(), one.recording)
            warnings = (*one.finding.warnings, f"{found.warning}, and are left out" if left_out else found.warning)
            right.append(Opened(recording, dataclasses.replace(one.finding, warnings=warnings)))
        return right

    def turned_steering(self, problem: RegressionProblem, opened: Sequence[Opened]) -> TurnedSteering | None:
        """Return the one steering whose zero makes wheels work against each other, where they do."""
        # Where forces do nearly what the robot does, or there are none, a second look would be time lost.
        force = [c for c, channel in enumerate(problem.channels) if channel.name in WRENCH[:2]]
        left, made = (float(np.sum(values[:, force] ** 2)) for values in (problem.residual, problem.measured))
        if not force or left < UNBALANCED**2 * made:
            return None
        return self._builder(opened).turned_steering(problem.limited)

    def ripples(self, opened: Sequence[Opened]) -> Sequence[RippleSize]:
        """Return ripples of joints that pass too fast for the channels, with their sizes.

        None of robots that cannot be simulated, nor without torques; off the ground joints are judged one by one.
        """
        recordings = [o.recording for o in opened]
        if self._off_ground or not self._can_be_simulated(recordings):
            return ()
        found = joint_ripples(self._seen_robot(), recordings, self._band(opened))
        sizes = [self._ripple_scale(ripple, recordings).size() for ripple in found]
        return [size for size in sizes if size is not None and size.after.mean() < WEIGHED * size.before.mean()]

    def with_ripples(self, sizes: Sequence[RippleSize], opened: Sequence[Opened]) -> Sequence[RippleSize | None]:
        """Return what ripples of such sizes leave of other recordings, None where these do not show them."""
        recordings = [o.recording for o in opened]
        if not recordings or not self._can_be_simulated(recordings):
            return [None] * len(sizes)
        return [self._ripple_scale(size.ripple, recordings).again(size) for size in sizes]

    def _ripple_scale(self, ripple: JointRipple, recordings: Sequence[Recording]) -> RippleScale:
        retuned = functools.partial(retuned_robot, self._seen_robot())
        return RippleScale(retuned, recordings, ripple, self.band())

    def band(self) -> float:
        """Return the frequency that the channels of the first problem end at [Hz]."""
        return self._cutoff if self._cutoff is not None else math.inf

    def describing(self, effects: Sequence[EffectInstance]) -> RobotSubject:
        """Return the robot with effects in its description, for the same recordings."""
        subject = copy.copy(self)
        subject.robot = dataclasses.replace(self.robot, physics=(*self.robot.physics, *effects))
        return subject

    def problem_with(self, opened: Sequence[Opened]) -> Callable[[Collection[str]], RegressionProblem]:
        """Return what makes it of the candidates of some keys alone."""
        builder = self._builder(opened)
        return lambda keys: builder.build(keys=keys)

    def _builder(self, opened: Sequence[Opened]) -> RobotProblemBuilder:
        recordings, robot = [o.recording for o in opened], self._seen_robot()
        try:
            return RobotProblemBuilder(
                robot, recordings, self._band(opened), lifted=self._off_ground, leads=self._leads, held=self._held
            )
        except MismatchError as error:
            told = dict.fromkeys(warning for o in opened for warning in o.finding.warnings)
            raise MismatchError("; ".join((str(error), *told))) from None

    def _band(self, opened: Sequence[Opened]) -> float:
        """Frequency that the channels end at [Hz], chosen by the first recordings."""
        with self._choosing:
            if self._cutoff is None:
                self._cutoff = choose_cutoff(self._seen_robot(), [o.recording for o in opened], self._off_ground)
            return self._cutoff

    def command_problems(self, opened: Sequence[Opened], searched: bool = True) -> Sequence[RegressionProblem]:
        """Return one problem per joint whose torque commands and torques were recorded."""
        return command_problems(self._seen_robot(), [o.recording for o in opened], searched)

    def unit(self, unit: str) -> str:
        """Return a unit as it is."""
        return unit

    def statement(self, instance: EffectInstance) -> str:
        """Return the plain sentence of an effect."""
        return get(instance.name).statement(instance.target, instance.parameters, instance.axis)

    def patched(self, effects: Sequence[EffectInstance], retuned: Mapping[str, float]) -> RobotSubject:
        """Return the robot with effects added and its numbers re-tuned; see `retuned_robot`.

        Raises:
            PcwError: there is no such robot.
        """
        robot = dataclasses.replace(self.robot, physics=(*self.robot.physics, *effects))
        subject = RobotSubject(retuned_robot(robot, retuned))
        as_it_really_is(subject.robot)
        subject._cutoff, subject._lifted = self._cutoff, self._lifted
        subject._leads, subject._held = self._leads, self._held
        subject._undescribed = Undescribed.of(retuned, self.robot.caster_names)
        return subject

    def mapping(self) -> dict[str, Any]:
        """Return the description as it stands in a file."""
        return robot_to_mapping(self.robot)

    def path(self, opened: Opened) -> tuple[FloatArray, FloatArray] | None:
        """Return stamps (S,) and pose (S, 3) by `ground_truth/odom`, else by `odom`; None without both."""
        recording: Recording = opened.recording
        for series in (recording.ground_truth, recording.odom):
            if series is not None and len(series.stamp) > 1:
                return series.stamp, base_pose(self.robot, series.pose) if series is recording.ground_truth else series.pose
        return None

    def absent(self, opened: Sequence[Opened]) -> tuple[tuple[str, str], ...]:
        """Return what was not recorded, and what that costs, in words."""
        recordings = [o.recording for o in opened]
        if self._off_ground:
            return (("the ground", "each joint is judged by itself; chassis, wheels, tyres, floor and IMU are not seen"),)
        cannot = "forces, friction and masses cannot be judged, nor simulated"
        casters = tuple((f"caster {name}", f"{cannot}, and its wheel is not seen") for name in self._missing)
        known = any(isinstance(get(instance.name), ActuatorEffect) for instance in self.robot.physics)
        echoed = joints_that_report_commands(self._seen_robot(), recordings) if known else []
        reports = "their drives report the commands: whether they are as late or limited as described is not seen"
        told = ((f"torques of {', '.join(echoed)}", reports),) if echoed else ()
        return casters + told + tuple(
            (sensor, cost)
            for sensor, there, cost in (
                ("effort in joint_states", _has_effort, cannot),
                ("effort in joint_commands", _has_torque_commands, "dead times, lags and limits of the motors cannot be seen"),
                ("imu/data", _has_imu, "slip of all wheels together, and faults of the sensor itself, cannot be seen"),
                ("angular_velocity in imu/data", _has_gyro, "all wheels slipping as the robot turns cannot be seen"),
                ("linear_acceleration in imu/data", _has_acceleration, "all wheels slipping at once cannot be seen"),
                ("ground_truth/odom", _has_truth, "the path is the robot's own; what all wheels do wrong alike is not seen"),
            )
            if not all(map(there, recordings))
        )

    def responses(self, opened: Sequence[Opened]) -> tuple[str, ...]:
        """Return how the joints follow commanded speeds, in words."""
        return responses_in_words(speed_responses(self._seen_robot(), [o.recording for o in opened]))

    def windows(self, opened: Sequence[Opened]) -> Windows | None:
        """Return the windows to simulate; None without torques, or for a robot that cannot be driven by them."""
        recordings = [o.recording for o in opened]
        return robot_windows(self.robot, recordings, self._off_ground) if self._can_be_simulated(recordings) else None

    def _can_be_simulated(self, recordings: Sequence[Recording]) -> bool:
        """Whether the reduced plant can be driven by the torques of recordings."""
        without_offset = bool(np.any(np.abs(self.robot.caster_offset[:, 0]) < 1e-3))
        return not (without_offset or self.robot.fixed_wheels or self._missing) and all(map(_has_effort, recordings))

    def rollout(self, windows: Windows) -> FloatArray:
        """Return the squared errors of the reduced plant under the measured torques, (W, H, S)."""
        return rollout_squares(self.robot, windows, self._undescribed)

    def rollout_floor(self, windows: Windows, rng: np.random.Generator) -> FloatArray:
        """Return the squared errors that the noise of the sensors makes in it, (W, H, S)."""
        return rollout_floor(self.robot, windows, self._undescribed, rng)


def _without_torques(recording: Recording) -> Recording:
    """Return the recording as if no torque had been measured."""
    left, joints = copy.copy(recording), recording.joint_states
    left.joint_states = dataclasses.replace(joints, effort=np.full_like(joints.effort, np.nan))
    return left


def _missing_casters(robot: RobotDescription, recording: Recording) -> tuple[str, ...]:
    """Casters of which one joint's angle was never measured, if others' were."""
    joint_seen: BoolArray = np.asarray(np.isfinite(recording.joint_states.position).any(axis=0))
    missing = tuple(name for name, joints in zip(robot.caster_names, joint_seen, strict=True) if not joints.all())
    return missing if len(missing) < robot.n else ()


def _has_effort(recording: Recording) -> bool:
    return has_torques([recording])


def _has_torque_commands(recording: Recording) -> bool:
    """Whether most commands are torques; drives that hold speeds are commanded none while they are off, too."""
    commands = recording.joint_commands
    return commands is not None and commands.effort is not None and bool(np.isfinite(commands.effort).mean() > 0.5)


def _has_imu(recording: Recording) -> bool:
    return recording.imu is not None


def _has_gyro(recording: Recording) -> bool:
    """Whether an IMU, where there is one, has a gyro."""
    return recording.imu is None or bool(np.isfinite(recording.imu.gyro).any())


def _has_acceleration(recording: Recording) -> bool:
    """Whether an IMU, where there is one, has an accelerometer."""
    return recording.imu is None or bool(np.isfinite(recording.imu.acceleration).any())


def _has_truth(recording: Recording) -> bool:
    return recording.ground_truth is not None and not seldom_tracked(recording)


def retuned_robot(robot: RobotDescription, retuned: Mapping[str, float]) -> RobotDescription:
    """Return the robot with numbers of its description re-tuned.

    Args:
        robot: the robot.
        retuned: by the names that the findings give them. Wheels read turned, torque constants and the floor's slope are no
            numbers of a description and become effects; what an IMU or a clock says moves no robot and changes nothing, and no
            effect stands for a crosstalk of reported torques.
    """
    chassis = robot.chassis
    x, y, z = chassis.com
    com = (
        x + retuned.get("chassis.com.x", 0.0), y + retuned.get("chassis.com.y", 0.0), z + retuned.get("chassis.com.z", 0.0)
    )
    chassis = dataclasses.replace(
        chassis,
        mass=_positive(retuned.get("chassis.mass", chassis.mass), chassis.mass),
        com=com,
        inertia_zz=_positive(retuned.get("chassis.inertia_zz", chassis.inertia_zz), chassis.inertia_zz),
    )
    first = robot.casters[0]
    # Numbers of a kind are re-tuned together: what is stated of the first caster, in proportion for all.
    stated = {
        "module.mass": first.module.mass,
        "module.inertia_zz": first.module.inertia_zz,
        "wheel.inertia_axle": first.wheel.inertia_axle,
        "rotors.drive": float(rotor_armature(robot, DRIVE)[0, DRIVE, DRIVE]),
        "rotors.steer": float(rotor_armature(robot, STEER)[0, STEER, STEER]),
    }
    scale = {
        name: _positive(retuned.get(name, value), value) / value if value > 0.0 else 1.0 for name, value in stated.items()
    }

    def caster(old: Caster) -> Caster:
        def moved(key: str, place: tuple[float, float]) -> tuple[float, float]:
            x, y = (retuned.get(f"{key}.{axis}/{old.name}", 0.0) for axis in "xy")
            return place[0] + x, place[1] + y

        new = dataclasses.replace(
            old,
            caster_offset=moved("caster_offset", old.caster_offset),
            steer_axis=moved("steer_axis", old.steer_axis),
            wheel_radius=_positive(retuned.get(f"wheel_radius/{old.name}", old.wheel_radius), old.wheel_radius),
            module=dataclasses.replace(
                old.module,
                mass=old.module.mass * scale["module.mass"],
                inertia_zz=old.module.inertia_zz * scale["module.inertia_zz"],
            ),
            wheel=dataclasses.replace(old.wheel, inertia_axle=old.wheel.inertia_axle * scale["wheel.inertia_axle"]),
            rotors=dataclasses.replace(
                old.rotors,
                drive=old.rotors.drive * scale["rotors.drive"],
                steer=old.rotors.steer * scale["rotors.steer"],
            ),
        )
        return _possible(new)

    robot = dataclasses.replace(robot, chassis=chassis, casters=tuple(caster(old) for old in robot.casters))
    return _with_tyres(dataclasses.replace(robot, physics=(*robot.physics, *_small_effects(robot, retuned))), retuned)


def _small_effects(robot: RobotDescription, retuned: Mapping[str, float]) -> Iterator[EffectInstance]:
    """Effects that stand for re-tuned numbers for which a description has no place."""
    for name in robot.caster_names:
        if turned := retuned.get(f"steer_zero/{name}", 0.0):
            yield effect_instance("steer_zero_offset", (name,), {"offset": -turned})
        for axis in AXIS_NAMES:
            if error := retuned.get(f"torque_constant/{name}_{axis}", 1.0) - 1.0:
                yield effect_instance("torque_constant_error", (name,), {"error": error}, axis)
    along, across = (retuned.get(name, 0.0) for name in FLOOR)
    if along or across:
        slope = {"angle": math.hypot(along, across), "direction": math.atan2(across, along)}
        yield effect_instance("ground_slope", ("chassis",), slope)


def _with_tyres(robot: RobotDescription, retuned: Mapping[str, float]) -> RobotDescription:
    """Return the robot with tyres that give more or less, each by what all share and by its own."""
    if not any(name.startswith("contact.") for name in retuned):
        return robot
    common, friction = retuned.get("contact.stiffness", 1.0), retuned.get("contact.mu_p", 1.0)
    described = common_relaxation(robot)
    longer = retuned.get("contact.relaxation_length", described) - described

    def tyre(caster: str, old: ContactDescription) -> ContactDescription:
        along, across = (
            friction * max(common + retuned.get(f"contact.stiffness/{caster}_{axis}", 1.0) - 1.0, LEAST_PART)
            for axis in AXIS_NAMES
        )
        lateral = dataclasses.replace(
            old.lateral, mu_p=friction * old.lateral.mu_p, lambda_p=min(old.lateral.lambda_p * across, 1.0)
        )
        relaxation = _positive(old.relaxation_length + longer, old.relaxation_length)
        # Of the numbers that shape a curve one is a friction, too.
        shape = {name: value * friction if name == "mu_c" else value for name, value in old.shape.items()}
        return dataclasses.replace(
            old,
            mu_p=friction * old.mu_p,
            lambda_p=min(old.lambda_p * along, 1.0),
            shape=shape,
            lateral=lateral,
            relaxation_length=min(relaxation, 1.0),
        )

    for name in robot.caster_names:
        robot = robot.with_tyres([name], functools.partial(tyre, name))
    return robot


def _possible(caster: Caster) -> Caster:
    """The caster with masses that it can have: where they hardly show in a recording, a fit may leave these bounds."""
    mass = max(caster.module.mass, (1.0 + LEAST_PART) * caster.wheel.mass)
    return possible_caster(dataclasses.replace(caster, module=dataclasses.replace(caster.module, mass=mass)))


def _positive(value: float, nominal: float) -> float:
    """The value, or where a fit ran off to what no robot is, a small part of the nominal one."""
    return max(value, LEAST_PART * nominal)
