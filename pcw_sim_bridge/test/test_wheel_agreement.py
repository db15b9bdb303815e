"""Wheels that contradict each other, and the one mistake in the set-up with which they would agree."""

import copy
import dataclasses
from pathlib import Path

import numpy as np
import pytest

from pcw_description import load_robot
from pcw_description.recording import Recording
from pcw_description.robot_description import DRIVE, STEER
from pcw_sim_bridge.mismatch.robot.wheel_agreement import contradictions
from pcw_sim_bridge.simulated_run import record_run

ROBOT = load_robot("thesis")
FRONT_LEFT, REAR_RIGHT = ROBOT.caster_names[0], ROBOT.caster_names[3]


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    def twist(time: float) -> np.ndarray:
        return min(time, 1.0) * np.array([0.5 * np.cos(0.7 * time), 0.4 * np.sin(1.3 * time), 0.6 * np.sin(0.9 * time)])

    path = tmp_path_factory.mktemp("wheels") / "run"
    record_run(ROBOT, twist, 10.0, 1, path, "reduced")
    return Recording.open(path, ROBOT)


def changed(recording: Recording, position: np.ndarray, velocity: np.ndarray) -> Recording:
    other = copy.copy(recording)
    other.joint_states = dataclasses.replace(recording.joint_states, position=position, velocity=velocity)
    return other


@pytest.mark.parametrize(
    ("casters", "axis", "words"),
    [
        ([0], DRIVE, f"with {FRONT_LEFT}_drive counted the other way they would agree"),
        ([3], STEER, f"with {REAR_RIGHT}_steer counted the other way they would agree"),
        ([0, 1, 2, 3], STEER, "with all steerings counted the other way they would agree"),
    ],
)
def test_joints_that_count_the_other_way(recording: Recording, casters: list[int], axis: int, words: str) -> None:
    position, velocity = (np.array(v) for v in (recording.joint_states.position, recording.joint_states.velocity))
    position[:, casters, axis] *= -1.0
    velocity[:, casters, axis] *= -1.0
    [told] = contradictions(ROBOT, changed(recording, position, velocity))
    assert words in told


@pytest.mark.parametrize("degrees", [180.0, 90.0, -37.0])
def test_a_steering_whose_zero_is_elsewhere(recording: Recording, degrees: float) -> None:
    position, velocity = (np.array(v) for v in (recording.joint_states.position, recording.joint_states.velocity))
    position[:, 1, STEER] += np.radians(degrees)
    [told] = contradictions(ROBOT, changed(recording, position, velocity))
    back = {180.0: "180", 90.0: "-90", -37.0: "37"}[degrees]
    assert f"with {back} degrees added to the angle of {ROBOT.caster_names[1]}_steer they would agree" in told


def test_casters_whose_names_are_exchanged(recording: Recording) -> None:
    position, velocity = (np.array(v) for v in (recording.joint_states.position, recording.joint_states.velocity))
    order = [3, 1, 2, 0]
    [told] = contradictions(ROBOT, changed(recording, position[:, order], velocity[:, order]))
    assert f"with the joints of {FRONT_LEFT} and {REAR_RIGHT} exchanged they would agree" in told


def test_two_mistakes_at_once_and_another_robot_are_not_explained_by_one(recording: Recording) -> None:
    position, velocity = (np.array(v) for v in (recording.joint_states.position, recording.joint_states.velocity))
    velocity[:, 0, DRIVE] *= -1.0
    position[:, 2, STEER] += 1.0
    [told] = contradictions(ROBOT, changed(recording, position, velocity))
    assert "it may be a recording of another robot" in told
    assert contradictions(ROBOT, recording) == []


@pytest.mark.parametrize("name", ["tidybot2", "flow_base", "dyros_pcv"])
def test_other_robots_agree_as_they_are_described(name: str, tmp_path: Path) -> None:
    robot = load_robot(name)
    record_run(robot, lambda time: min(time, 1.0) * np.array([0.3, 0.2 * np.sin(time), 0.3]), 5.0, 2, tmp_path / "run")
    assert contradictions(robot, Recording.open(tmp_path / "run", robot)) == []
