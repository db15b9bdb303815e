"""Sensors that are mounted otherwise than described are told of, and others are not."""

import copy
import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pcw_description import load_robot
from pcw_description.effects.registry import read_physics
from pcw_description.recording import Recording
from pcw_sim_bridge.mismatch.robot.sensor_axes import unlike_axes
from pcw_sim_bridge.mismatch.subjects.robot_subject import RobotSubject
from pcw_sim_bridge.simulated_run import record_run

ROBOT = load_robot("thesis")


def twist(time: float) -> np.ndarray:
    swing = np.array([0.5 * np.cos(1.7 * time), 0.4 * np.sin(2.3 * time), 0.6 * np.sin(1.1 * time)])
    return min(time, 1.0) * swing


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    path = tmp_path_factory.mktemp("axes") / "run"
    record_run(ROBOT, twist, 14.0, 1, path, "reduced")
    return Recording.open(path, ROBOT)


def turned(values: np.ndarray, angle: float) -> np.ndarray:
    """Vectors (T, 2 or more) turned by an angle about z."""
    c, s = np.cos(angle), np.sin(angle)
    found = values.copy()
    found[:, 0], found[:, 1] = c * values[:, 0] - s * values[:, 1], s * values[:, 0] + c * values[:, 1]
    return found


def gyro_back(imu: Any) -> Any:
    return dataclasses.replace(imu, gyro=-imu.gyro)


def imu_turned(degrees: float) -> Callable[[Any], Any]:
    return lambda imu: dataclasses.replace(imu, acceleration=turned(imu.acceleration, np.radians(degrees)))


def imu_mirrored(imu: Any) -> Any:
    return dataclasses.replace(imu, acceleration=imu.acceleration * [1.0, -1.0, 1.0])


def tracker_turned(degrees: float) -> Callable[[Any], Any]:
    return lambda truth: dataclasses.replace(truth, pose=truth.pose + [0.0, 0.0, np.radians(degrees)])


def tracker_in_mm(truth: Any) -> Any:
    return dataclasses.replace(truth, pose=truth.pose * [1e3, 1e3, 1.0])


def tracker_clockwise(truth: Any) -> Any:
    return dataclasses.replace(truth, pose=truth.pose * [1.0, 1.0, -1.0])


@pytest.mark.parametrize(
    ("sensor", "change", "words"),
    [
        ("imu", gyro_back, ["imu/data: the gyro turns the other way"]),
        ("imu", imu_turned(90.0), ["feels what the wheels do, but turned by 90 degrees"]),
        ("imu", imu_turned(180.0), ["turned by ", "180 degrees about z"]),
        ("imu", imu_mirrored, ["imu/data: the accelerometer feels what the wheels do, but mirrored"]),
        ("imu", imu_turned(10.0), []),
        ("ground_truth", tracker_turned(90.0), ["ground_truth/odom: it moves as the wheels do, but turned by -90 degrees"]),
        ("ground_truth", tracker_in_mm, ["ground_truth/odom: it moves as the wheels do", "times as far: is it in metres?"]),
        ("ground_truth", tracker_clockwise, ["ground_truth/odom: it turns the other way"]),
    ],
)
def test_a_sensor_that_is_mounted_otherwise_is_told_of(
    recording: Recording, sensor: str, change: Callable[[Any], Any], words: list[str]
) -> None:
    """With the gyro upside down nothing was said to be missing."""
    changed = copy.copy(recording)
    setattr(changed, sensor, change(getattr(recording, sensor)))
    told = unlike_axes(ROBOT, changed)
    assert len(told) <= 1 + (change is tracker_clockwise) and bool(told) == bool(words)
    for word in words:
        assert word in told[0]


@pytest.mark.parametrize("name", ["thesis", "tidybot2", "flow_base", "xr4000", "dyros_pcv"])
def test_of_a_robot_as_it_is_described_nothing_is_said(name: str, tmp_path: Path) -> None:
    """Nor of one that slips, carries something and has a gyro that is a little off."""
    robot = load_robot(name)
    physics = [{"name": "payload_mass", "mass": 0.3 * robot.chassis.mass, "x": 0.1, "y": 0.1, "z": 0.3}]
    if robot.sensors.imu:
        physics.append({"name": "imu_bias", "gyro": 0.02, "accelerometer_x": 0.3, "accelerometer_y": -0.2})
    loaded = dataclasses.replace(robot, physics=read_physics(physics, robot.caster_names))
    record_run(loaded, lambda time: 0.5 * twist(time), 12.0, 2, tmp_path / "run", "reduced", controlled_as=robot)
    assert unlike_axes(robot, RobotSubject(robot).open(tmp_path / "run", "fit", {}).recording) == []
