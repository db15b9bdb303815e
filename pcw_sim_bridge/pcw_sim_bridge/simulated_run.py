"""A recording without a running graph: a simulated robot and a computed-torque controller in one loop, in simulated time."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from pcw_control.computed_torque import (
    ComputedTorque,
    ComputedTorqueMeasurement,
    TwistReference,
    initial_state,
)
from pcw_control.torque_limits import TorqueLimits, limit_torque
from pcw_description.recording_writer import RecordingWriter
from pcw_description.robot_description import FloatArray, RobotDescription
from pcw_description.ros_messages import imu, joint_state, odometry, twist_stamped

from .plants.factory import make_plant
from .sensors import ImuReading, JointReading
from .simulated_robot import JointCommand, Sample, SimulatedRobot, TrackedPose

CommandedTwist = Callable[[float], FloatArray]
# A stamp of zero means "no stamp" in ROS, so recordings begin at one second [ns].
START_NS = 1_000_000_000


def record_run(
    robot: RobotDescription,
    commanded_twist: CommandedTwist,
    duration: float,
    seed: int,
    path: str | Path,
    plant_name: str = "reduced",
    controlled_as: RobotDescription | None = None,
) -> None:
    """Drive a robot along a commanded twist and write the recording that a real one would have left.

    Args:
        robot: the robot as it really is; its `physics` are at work.
        commanded_twist: time [s] -> twist (3,) of base_link.
        duration: [s].
        seed: of all sensor noise; the same seed gives the same bytes of data.
        path: folder of the recording, which must not exist.
        plant_name: see `make_plant`.
        controlled_as: the robot that the controller believes in; default: `robot`.

    Raises:
        RecordingError: `path` exists.
        PlantError: the plant cannot be made.
    """
    believed = controlled_as or robot
    simulated = SimulatedRobot(make_plant(plant_name, robot), seed)
    controller, state = ComputedTorque(believed), initial_state()
    limits = TorqueLimits.of_robot(believed)
    torque, saturated = np.zeros((robot.n, 2)), False
    try:
        with RecordingWriter(path, flush_interval=None) as writer:
            while simulated.time_ns < duration * 1e9:
                for sample in simulated.advance():
                    _write(writer, robot, sample)
                    if not isinstance(sample.reading, JointReading):
                        continue
                    joints = sample.reading
                    target = commanded_twist(sample.time_ns * 1e-9)
                    measurement = ComputedTorqueMeasurement(joints.position, joints.velocity, np.zeros(3), saturated)
                    dt = simulated.control_period
                    state, wanted = controller.step(state, measurement, TwistReference(target), dt)
                    limited = limit_torque(limits, torque, wanted.torque, joints.velocity, dt)
                    torque, saturated = limited.torque, limited.saturated
                    simulated.command(JointCommand(effort=torque))
                    stamp = sample.time_ns + START_NS
                    writer.write("/cmd_vel", twist_stamped(stamp, target))
                    writer.write("/joint_commands", joint_state(stamp, robot.joint_names, effort=torque))
    finally:
        simulated.close()


def _write(writer: RecordingWriter, robot: RobotDescription, sample: Sample) -> None:
    """Write one reading on its topic; contact forces stay with the simulator, as on a real robot."""
    stamp, reading = sample.time_ns + START_NS, sample.reading
    if isinstance(reading, JointReading):
        message = joint_state(stamp, robot.joint_names, reading.position, reading.velocity, reading.effort)
        writer.write("/joint_states", message)
    elif isinstance(reading, ImuReading):
        writer.write("/imu/data", imu(stamp, reading.angular_velocity, reading.linear_acceleration))
    elif isinstance(reading, TrackedPose):
        writer.write("/ground_truth/odom", odometry(stamp, reading.pose, reading.truth.twist))
