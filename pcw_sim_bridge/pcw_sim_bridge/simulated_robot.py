"""A plant with the sensors, drives and timing of a real robot around it: what the bridge puts on topics, without ROS.

Time is counted in whole steps of the plant, so that stamps are exact and a run is repeated bit by bit by its seed. A sensor
of a rate that does not fit into whole steps is read at the first step at or after each of its instants.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator

import numpy as np

from pcw_description.robot_description import FloatArray, RobotDescription

from .plants.plant import Plant, PlantError, PlantState
from .plants.true_robot import as_it_really_is
from .sensors import Encoders, Imu, ImuReading, JointReading, read_tracker

NANOSECONDS = 1_000_000_000
LARGEST_LOOP_STEP = 0.5  # of a speed error that a loop takes from a wheel that slips within one of its steps
DEFAULT_TRUTH_RATE = 100.0  # [Hz], of a robot file without a tracker


@dataclasses.dataclass(frozen=True)
class JointCommand:
    """A command to all joints; one of the two is given.

    Attributes:
        effort: joint torques (n, 2) [N m].
        velocity: joint speeds (n, 2) [rad/s], held by the drives' own velocity loops.
    """

    effort: FloatArray | None = None
    velocity: FloatArray | None = None

    def __post_init__(self) -> None:
        """Check that exactly one field is given, and finite.

        Raises:
            PlantError: both, neither, NaN or infinity.
        """
        given = [values for values in (self.effort, self.velocity) if values is not None]
        if len(given) != 1:
            found = "both" if given else "none"
            raise PlantError(f"joint command: {found} of effort and velocity set; allowed: exactly one of them")
        if not np.isfinite(given[0]).all():
            raise PlantError("joint command holds NaN or infinity; allowed: finite numbers")


@dataclasses.dataclass(frozen=True)
class TrackedPose:
    """What the external tracker reports: a measured pose (3,), and the truth it is taken from."""

    pose: FloatArray
    truth: PlantState


@dataclasses.dataclass(frozen=True)
class Sample:
    """One reading of one sensor.

    Attributes:
        time_ns: simulated time [ns].
        reading: JointReading, ImuReading, TrackedPose, or PlantState for the contact forces.
    """

    time_ns: int
    reading: JointReading | ImuReading | TrackedPose | PlantState


class VelocityLoops:
    """The velocity loop of every drive: proportional and integral, both poles at `bandwidth`.

    Each joint is designed for on its own, with the inertia that it feels when the robot's mass is shared by all casters; and
    no faster than a loop with steps of `dt` may be where the tyre slips and leaves it the wheel alone: beyond, wheels shake.
    """

    def __init__(self, robot: RobotDescription, bandwidth: float, dt: float) -> None:
        allowed = LARGEST_LOOP_STEP * robot.own_inertia / (2.0 * robot.felt_inertia * dt)
        poles = np.minimum(bandwidth, allowed)
        self._damping = 2.0 * poles * robot.felt_inertia
        self._stiffness = poles**2 * robot.felt_inertia
        self._limit = robot.torque_limit
        self._integral = np.zeros_like(robot.felt_inertia)

    def reset(self) -> None:
        """Forget the integral."""
        self._integral[:] = 0.0

    def torque(self, wanted: FloatArray, measured: FloatArray, dt: float) -> FloatArray:
        """Return joint torques (n, 2) [N m] for joint speeds (n, 2) [rad/s]."""
        error = wanted - measured
        # Clipping the integral's share to the torque limit keeps it from winding up.
        self._integral = np.clip(self._integral + self._stiffness * error * dt, -self._limit, self._limit)
        return np.clip(self._damping * error + self._integral, -self._limit, self._limit)


class SimulatedRobot:
    """A plant behind the sensors and drives that its robot file describes.

    Args:
        plant: the plant, at its reset state.
        seed: seed of all sensor noise.
        velocity_source: see `sensors.Encoders`.
        command_timeout: without a new command for so long, simulated time, the torque is zero [s].
        velocity_bandwidth: of the drives' velocity loops, at most [rad/s].

    Raises:
        PlantError: a sensor is faster than the plant's step.
    """

    def __init__(
        self,
        plant: Plant,
        seed: int = 0,
        velocity_source: str = "drive",
        command_timeout: float = 0.1,
        velocity_bandwidth: float = 30.0,
    ) -> None:
        robot = plant.robot
        sensors = robot.sensors
        self.plant, self.robot = plant, robot
        self.command_timeout = command_timeout
        self._seed = seed
        self._encoders = Encoders(robot, velocity_source)
        self._imu = Imu(as_it_really_is(robot)) if sensors.imu else None
        self._loops = VelocityLoops(robot, velocity_bandwidth, plant.dt)
        self._control = _Schedule("sensors.encoders.rate", sensors.encoders.rate, plant.dt)
        truth_rate = sensors.tracker.rate if sensors.tracker else DEFAULT_TRUTH_RATE
        self._truth = _Schedule("sensors.tracker.rate", truth_rate, plant.dt)
        self._imu_times = _Schedule("sensors.imu.rate", sensors.imu.rate, plant.dt) if sensors.imu else None
        self._begin()

    def _begin(self) -> None:
        self.steps = 0
        self._rng = np.random.default_rng(self._seed)
        self._joints: JointReading | None = None
        self._joints_ns = 0
        self._command: JointCommand | None = None
        self._command_ns = 0
        self._loops.reset()
        for schedule in self._schedules():
            schedule.restart()

    def _schedules(self) -> list[_Schedule]:
        return [schedule for schedule in (self._control, self._truth, self._imu_times) if schedule is not None]

    @property
    def time_ns(self) -> int:
        """Simulated time [ns]."""
        return round(self.steps * self.plant.dt * NANOSECONDS)

    @property
    def control_period(self) -> float:
        """Time between two joint readings [s]."""
        return 1.0 / self.robot.sensors.encoders.rate

    @property
    def timed_out(self) -> bool:
        """Whether the newest command is too old to be used; before the first command there is nothing to time out."""
        if self._command is None:
            return False
        return self.time_ns - self._command_ns > self.command_timeout * NANOSECONDS

    def reset(self) -> None:
        """Put the robot back to its start, at time zero, with the same noise to come as the first time."""
        self.plant.reset()
        self._begin()

    def command(self, command: JointCommand | None) -> None:
        """Take a command for the time from now on; None is zero torque."""
        if command is None or command.velocity is None:
            self._loops.reset()
        self._command = command
        self._command_ns = self.time_ns

    def _samples_now(self) -> Iterator[Sample]:
        """Read the sensors that are due at this instant; the joints come last, as a controller answers to them."""
        due = [schedule for schedule in self._schedules() if schedule.due_at(self.steps)]
        if not due:
            return
        truth = self.plant.state()
        if not (np.isfinite(truth.twist).all() and np.isfinite(truth.joint_velocity).all()):
            raise PlantError(f"the plant's state is not finite at {truth.time:.3f} s")
        tracker = self.robot.sensors.tracker
        if self._truth in due:
            pose = read_tracker(tracker, truth, self._rng) if tracker else truth.pose
            yield Sample(self.time_ns, TrackedPose(pose, truth))
            yield Sample(self.time_ns, truth)
        if self._imu is not None and self._imu_times in due:
            yield Sample(self.time_ns, self._imu.read(truth, self._rng))
        if self._control in due:
            dt = (self.time_ns - self._joints_ns) / NANOSECONDS
            self._joints = self._encoders.read(truth, self._joints, dt, self._rng)
            self._joints_ns = self.time_ns
            yield Sample(self.time_ns, self._joints)
        for schedule in due:
            schedule.advance()

    def advance(self) -> Iterator[Sample]:
        """Advance to the next joint reading and yield all readings on the way, it being the last.

        The first call yields those of time zero, and nothing has moved yet.
        """
        target = self._control.next_step
        if self.steps == target:
            yield from self._samples_now()
            return
        if self.timed_out:
            self._loops.reset()
        command = None if self.timed_out else self._command
        while self.steps < target:
            halt = min(target, *(schedule.next_step for schedule in self._schedules()))
            self._drive(command, halt)
            yield from self._samples_now()

    def _drive(self, command: JointCommand | None, halt: int) -> None:
        """Advance the plant to the step `halt` under a command; None is zero torque."""
        if command is not None and command.velocity is not None:
            for _ in range(halt - self.steps):  # the drives' own loops are faster than joint_states: as fast as the plant
                torque = self._loops.torque(command.velocity, self.plant.state().motor_velocity, self.plant.dt)
                self.plant.step(torque)
        else:
            effort = None if command is None else command.effort
            self.plant.step(np.zeros((self.robot.n, 2)) if effort is None else effort, halt - self.steps)
        self.steps = halt

    def close(self) -> None:
        """Free what the plant holds."""
        self.plant.close()


class _Schedule:
    """The instants of a sensor, in whole steps of the plant; the first is at time zero."""

    def __init__(self, key: str, rate: float, dt: float) -> None:
        self._steps_per_sample = 1.0 / (rate * dt)
        if self._steps_per_sample < 1.0 - 1e-9:
            raise PlantError(f"{key} = {rate:g} Hz is not allowed with dt = {dt:g} s; allowed: at most {1.0 / dt:g} Hz")
        self.restart()

    def restart(self) -> None:
        self._count = 0
        self.next_step = 0

    def due_at(self, step: int) -> bool:
        return step == self.next_step

    def advance(self) -> None:
        self._count += 1
        self.next_step = math.ceil(self._count * self._steps_per_sample - 1e-6)
