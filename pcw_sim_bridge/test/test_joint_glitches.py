"""Readings that jump away for one message and back, and motions that do not."""

from pathlib import Path

import numpy as np
import pytest

from pcw_description import load_robot
from pcw_sim_bridge.mismatch.readings.joint_glitches import MOST, glitches, without_glitches
from pcw_sim_bridge.mismatch.subjects.robot_subject import RobotSubject
from pcw_sim_bridge.simulated_run import record_run

STEP, COUNT = 0.004, 4000
TIME = STEP * np.arange(COUNT)
MOTIONS = {
    "smooth": 3.0 * np.sin(1.3 * TIME) + TIME,
    "starts and stops": np.cumsum(np.where(np.sin(0.8 * TIME) > 0.0, 5.0, 0.0)) * STEP,  # within one reading
    "steps": np.floor(TIME),  # of an angle that a driver hands on once a second
    "still": np.zeros(COUNT),
    "one kick": np.where(TIME > 8.0, 0.05, 0.0) + 1e-4 * np.sin(9.0 * TIME),
}


@pytest.mark.parametrize("resolution", [0.0, 1e-3, 0.02])
@pytest.mark.parametrize("motion", MOTIONS)
def test_no_motion_is_one(motion: str, resolution: float) -> None:
    rng = np.random.default_rng(1)
    position = MOTIONS[motion] + 2e-4 * rng.standard_normal(COUNT) * (motion != "still")
    assert not glitches(TIME, np.round(position / resolution) * resolution if resolution else position).any()


@pytest.mark.parametrize("size", [0.05, 0.5, -2.0])
@pytest.mark.parametrize("motion", ["smooth", "starts and stops"])
def test_those_that_jump_are_found_and_no_others(motion: str, size: float) -> None:
    rng = np.random.default_rng(2)
    position = MOTIONS[motion] + 2e-4 * rng.standard_normal(COUNT)
    bad = np.zeros(COUNT, dtype=bool)
    bad[10 + 37 * np.arange(40)] = True
    stamp = TIME + 2e-4 * rng.standard_normal(COUNT)
    np.testing.assert_array_equal(glitches(stamp, position + size * bad), bad)


def test_what_jumps_all_the_time_is_no_accident() -> None:
    bad = np.arange(COUNT) % int(0.8 / MOST) == 0
    assert not glitches(TIME, MOTIONS["smooth"] + 0.3 * bad).any()


def test_a_recording_is_read_without_them_and_says_so(tmp_path: Path) -> None:
    """One reading in five hundred: tyres came out 7 tolerances off, and held-out errors were five times as large."""
    robot = load_robot("thesis")

    def twist(time: float) -> np.ndarray:
        return min(time, 1.0) * np.array([0.4 * np.cos(time), 0.3 * np.sin(1.3 * time), 0.5 * np.sin(0.9 * time)])

    record_run(robot, twist, 6.0, 1, tmp_path / "run", "reduced")
    opened = RobotSubject(robot).open(tmp_path / "run", "fit", {})
    same, told = without_glitches(opened.recording)
    assert same is opened.recording and told == []
    opened.recording.joint_states.position[[200, 400], 0, 1] += 0.3
    left, [told] = without_glitches(opened.recording)
    assert len(left.joint_states) == len(opened.recording.joint_states) - 2
    assert f"{robot.caster_names[0]}_steer jump away for one message and back in 2 messages" in told
    assert without_glitches(left)[1] == []
