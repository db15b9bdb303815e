"""A recording without a running graph: plant, sensors and a computed-torque controller in one loop, in simulated time."""

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

from .plants.plant import make_plant
from .sensors import Encoders, read_imu, read_tracker

CommandedTwist = Callable[[float], FloatArray]
CONTROL_RATE = 500.0  # [Hz], of the controller; sensors have the rates of the robot file


def record_run(
    robot: RobotDescription,
    commanded_twist: CommandedTwist,
    duration: float,
    seed: int,
    path: str | Path,
    plant_name: str = "reduced",
    controlled_as: RobotDescription | None = None,
) -> None:
    """Drive a robot along a commanded twist and write the recording a real one would have left.

    Args:
        robot: the robot as it really is; its `physics` are at work.
        commanded_twist: time [s] -> twist (3,) of base_link.
        duration: [s].
        seed: of all sensor noise; the same seed gives the same bytes of data.
        path: folder of the recording, which must not exist.
        plant_name: see `make_plant`.
        controlled_as: the robot that the controller and the joint readings believe in; default: `robot`.

    Raises:
        RecordingError: `path` exists.
        PlantError: the plant cannot be made.
    """
    believed = controlled_as or robot
    rng = np.random.default_rng(seed)
    plant = make_plant(plant_name, robot)
    controller, state = ComputedTorque(believed), initial_state()
    limits = TorqueLimits.of_robot(believed)
    encoders, reading = Encoders(believed), None
    sensors = robot.sensors
    every = {
        "control": _steps(CONTROL_RATE, plant.dt),
        "joints": _steps(sensors.encoders.rate, plant.dt),
        "imu": _steps(sensors.imu.rate, plant.dt) if sensors.imu else 0,
        "tracker": _steps(sensors.tracker.rate, plant.dt) if sensors.tracker else 0,
    }
    torque = np.zeros((robot.n, 2))
    saturated = False
    try:
        with RecordingWriter(path, flush_interval=None) as writer:
            for step in range(round(duration / plant.dt)):
                truth = plant.state()
                stamp = round(truth.time * 1e9) + 1_000_000_000
                if step % every["joints"] == 0:
                    reading = encoders.read(truth, reading, every["joints"] * plant.dt, rng)
                    writer.write(
                        "/joint_states",
                        joint_state(
                            stamp, robot.joint_names, reading.position, reading.velocity, reading.effort
                        ),
                    )
                if sensors.imu and step % every["imu"] == 0:
                    sensed = read_imu(sensors.imu, truth, rng)
                    writer.write("/imu/data", imu(stamp, sensed.angular_velocity, sensed.linear_acceleration))
                if sensors.tracker and step % every["tracker"] == 0:
                    writer.write(
                        "/ground_truth/odom",
                        odometry(stamp, read_tracker(sensors.tracker, truth, rng), truth.twist),
                    )
                if step % every["control"] == 0 and reading is not None:
                    target = commanded_twist(truth.time)
                    writer.write("/cmd_vel", twist_stamped(stamp, target))
                    measurement = ComputedTorqueMeasurement(
                        reading.position, reading.velocity, np.zeros(3), saturated
                    )
                    dt = every["control"] * plant.dt
                    state, wanted = controller.step(state, measurement, TwistReference(target), dt)
                    limited = limit_torque(limits, torque, wanted.torque, reading.velocity, dt)
                    torque, saturated = limited.torque, limited.saturated
                    writer.write("/joint_commands", joint_state(stamp, robot.joint_names, effort=torque))
                plant.step(torque)
    finally:
        plant.close()


def _steps(rate: float, dt: float) -> int:
    return max(round(1.0 / (rate * dt)), 1)
