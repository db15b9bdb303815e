"""A recording without a running graph: a simulated robot and a controller in one loop, in simulated time."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Protocol

from pcw_description.recording_writer import RecordingWriter
from pcw_description.robot_description import FloatArray, RobotDescription
from pcw_description.ros_messages import imu, joint_state, odometry, twist_stamped

from .plants.factory import make_plant
from .plants.plant import Plant
from .run_controllers import RunController, make_controller
from .sensors import ImuReading, JointReading
from .simulated_robot import JointCommand, Sample, SimulatedRobot, TrackedPose
from .stamping import StampingParameters, TopicStamps

CommandedTwist = Callable[[float], FloatArray | None]
# A stamp of zero means "no stamp" in ROS, so recordings begin at one second [ns].
START_NS = 1_000_000_000


class RunSink(Protocol):
    """Takes what a robot and its controller send while it is driven."""

    def sample(self, sample: Sample) -> None:
        """Take one reading."""

    def answer(self, time_ns: int, twist: FloatArray | None, command: JointCommand) -> None:
        """Take what was wanted at a time [ns], and the command that answers the last joint reading."""


def drive(
    simulated: SimulatedRobot,
    controller: RunController,
    commanded_twist: CommandedTwist,
    duration: float,
    sink: RunSink,
    progress: Callable[[float], None] | None = None,
) -> None:
    """Drive a simulated robot along a commanded twist for `duration` [s]; see `record_run`.

    Raises:
        PlantError: the plant leaves what it can compute.
    """
    while simulated.time_ns < duration * 1e9:
        for sample in simulated.advance():
            sink.sample(sample)
            if not isinstance(sample.reading, JointReading):
                continue
            twist = commanded_twist(sample.time_ns * 1e-9)
            command = controller.command(sample.reading, twist, simulated.control_period)
            simulated.command(command)
            sink.answer(sample.time_ns, twist, command)
        if progress is not None:
            progress(simulated.time_ns * 1e-9)


def record_run(
    robot: RobotDescription,
    commanded_twist: CommandedTwist,
    duration: float,
    seed: int,
    path: str | Path,
    plant_name: str = "reduced",
    controlled_as: RobotDescription | None = None,
    controller_name: str = "computed_torque",
    stamping: StampingParameters | None = None,
    lifted: bool = False,
    progress: Callable[[float], None] | None = None,
    plant: Plant | None = None,
) -> Mapping[str, int]:
    """Drive a robot along a commanded twist and write the recording that a real one would have left.

    A run that does not come to its end leaves no folder: its seed repeats it, and a part of it would read as a whole.

    Args:
        robot: the robot as it really is; its `physics` are at work.
        commanded_twist: time [s] -> twist (3,) of base_link; None: motors off, and no cmd_vel.
        duration: [s].
        seed: of all noise; the same seed gives the same bytes of data.
        path: folder of the recording, which must not exist.
        plant_name: see `make_plant`.
        controlled_as: the robot that the controller believes in; default: `robot`.
        controller_name: see `make_controller`.
        stamping: of what is recorded; default: exact, and nothing lost. The controller is on board and loses nothing.
        lifted: the robot is jacked up, its wheels off the ground.
        progress: called with the simulated time [s] after each control period.
        plant: of `robot`, instead of one made by `plant_name`; it is closed.

    Returns:
        Number of messages by topic.

    Raises:
        RecordingError: `path` exists or cannot be written.
        PlantError: the plant or the controller cannot be made, or the plant leaves what it can compute.
    """
    simulated = SimulatedRobot(plant or make_plant(plant_name, robot, lifted=lifted), seed)
    try:
        controller = make_controller(controller_name, controlled_as or robot)
        writer = RecordingWriter(path, flush_interval=None)
        try:
            with writer:
                recorder = _Recorder(writer, robot, TopicStamps(stamping or StampingParameters(), seed, robot))
                drive(simulated, controller, commanded_twist, duration, recorder, progress)
        except BaseException:
            shutil.rmtree(writer.path)
            raise
        return writer.counts
    finally:
        simulated.close()


class _Recorder:
    """Writes what a robot and its controller send, as it is stamped and as far as it is not lost."""

    def __init__(self, writer: RecordingWriter, robot: RobotDescription, stamps: TopicStamps) -> None:
        self._writer, self._joint_names, self._stamps = writer, robot.joint_names, stamps
        self._joint_stamp_ns = 0

    def sample(self, sample: Sample) -> None:
        """Write one reading on its topic; contact forces stay with the simulator, as on a real robot."""
        now, reading = sample.time_ns + START_NS, sample.reading
        if isinstance(reading, JointReading):
            self._joint_stamp_ns, lost = self._stamps.stamp("joint_states", now)
            if not lost:
                message = joint_state(
                    self._joint_stamp_ns, self._joint_names, reading.position, reading.velocity, reading.effort
                )
                self._writer.write("/joint_states", message, now)
        elif isinstance(reading, ImuReading):
            stamp, lost = self._stamps.stamp("imu/data", now)
            if not lost:
                self._writer.write("/imu/data", imu(stamp, reading.angular_velocity, reading.linear_acceleration), now)
        elif isinstance(reading, TrackedPose):
            stamp, lost = self._stamps.stamp("ground_truth/odom", now)
            if not lost:
                self._writer.write("/ground_truth/odom", odometry(stamp, reading.pose, reading.truth.twist), now)

    def answer(self, time_ns: int, twist: FloatArray | None, command: JointCommand) -> None:
        """Write what was wanted and the command, which bears the stamp of the joint_states that it answers."""
        now = time_ns + START_NS
        if twist is not None:
            stamp, lost = self._stamps.stamp("cmd_vel", now)
            if not lost:
                self._writer.write("/cmd_vel", twist_stamped(stamp, twist), now)
        _, lost = self._stamps.stamp("joint_commands", now)
        if not lost:
            message = joint_state(
                self._joint_stamp_ns, self._joint_names, velocity=command.velocity, effort=command.effort
            )
            self._writer.write("/joint_commands", message, now)
