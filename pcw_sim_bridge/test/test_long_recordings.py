"""Hours of a robot that mostly stands: minutes in which it moves are used, from all over them, and it is said."""

import dataclasses
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from pcw_description import load_robot
from pcw_description.recording import Recording
from pcw_description.recording_series import ImuSeries, JointSeries, OdometrySeries
from pcw_sim_bridge.mismatch.robot.long_recordings import STRETCH, part_of
from pcw_sim_bridge.mismatch.robot.robot_channels import RobotProblemBuilder
from pcw_sim_bridge.mismatch.subjects.robot_subject import RobotSubject
from pcw_sim_bridge.simulated_run import record_run

THESIS = load_robot("thesis")


@dataclasses.dataclass
class Readings:
    """As much of a recording as is cut."""

    joint_states: JointSeries
    joint_commands: JointSeries | None = None
    imu: ImuSeries | None = None
    ground_truth: OdometrySeries | None = None


def readings(duration: float, moves: Callable[[np.ndarray], np.ndarray], begin: float = 3.0) -> Readings:
    """Joints at 50 Hz that turn at 5 rad/s while `moves`, with the noise of an encoder, and a slower tracker."""
    rng = np.random.default_rng(1)
    stamp = begin + np.arange(0.0, duration, 0.02)
    position = np.zeros((len(stamp), 4, 2))
    position[:, :, 0] = 0.02 * np.cumsum(5.0 * moves(stamp - begin))[:, None] + 1e-3 * rng.standard_normal((len(stamp), 4))
    joints = JointSeries(stamp, (stamp * 1e9).astype(np.int64), ("a",), position, 2.0 * position, np.zeros_like(position))
    slow = stamp[::5] + 0.003
    pose = np.zeros((len(slow), 3))
    truth = OdometrySeries(
        slow, (slow * 1e9).astype(np.int64), pose=pose, twist=pose.copy(), frame_id="map", child_frame_id="base"
    )
    return Readings(joints, ground_truth=truth)


def drives_now_and_then(time: np.ndarray) -> np.ndarray:
    return (time % 100.0 < 40.0).astype(float)


def test_what_is_short_is_used_as_it_is() -> None:
    runs = [readings(100.0, np.ones_like), readings(60.0, np.zeros_like)]
    parts, told = part_of(runs, "searched", 200.0)
    assert parts == runs and told == ""


def test_a_long_one_is_cut_to_stretches_of_motion_from_all_over_it() -> None:
    [part], told = part_of([readings(2000.0, drives_now_and_then)], "searched", 200.0)
    stamp = part.joint_states.stamp
    assert 0.02 * len(stamp) == pytest.approx(200.0, abs=1.0)
    assert drives_now_and_then(stamp - 3.0).mean() > 0.99
    assert stamp[0] < 103.0 and stamp[-1] > 1903.0 and np.diff(stamp).max() < 300.0
    np.testing.assert_array_equal(part.joint_states.velocity, 2.0 * part.joint_states.position)
    assert len(part.ground_truth.stamp) == len(part.ground_truth.twist) == pytest.approx(len(stamp) / 5, abs=10)
    nearest = np.abs(part.ground_truth.stamp[:, None] - stamp).min(axis=1)
    assert nearest.max() < 0.02
    assert part.imu is None and part.joint_commands is None
    assert told.startswith("Of 2000 s of recordings 200 s were searched: 10 stretches of 20 s")


def test_a_robot_that_hardly_moves_is_seen_where_it_does() -> None:
    [part], _ = part_of([readings(2000.0, lambda time: (time > 1700.0) & (time < 1755.0))], "searched", 100.0)
    moving = (part.joint_states.stamp > 1703.0) & (part.joint_states.stamp < 1758.0)
    assert 0.02 * moving.sum() == pytest.approx(55.0, abs=1.0)


def test_every_one_of_several_gives_its_share() -> None:
    parts, told = part_of([readings(300.0, np.ones_like), readings(600.0, np.ones_like)], "held out", 180.0)
    lengths = [0.02 * len(part.joint_states.stamp) for part in parts]
    assert lengths == pytest.approx([60.0, 120.0], abs=STRETCH + 1.0) and sum(lengths) == pytest.approx(180.0, abs=1.0)
    assert "900 s" in told and "180 s were held out" in told


def test_none_of_them_is_left_without_readings() -> None:
    """One that stands beside a long one, and each of more than there are stretches."""
    moves, stands = part_of([readings(300.0, np.ones_like), readings(100.0, np.zeros_like)], "searched", 100.0)[0]
    assert 0.02 * len(moves.joint_states.stamp) == pytest.approx(100.0, abs=1.0)
    assert 0.02 * len(stands.joint_states.stamp) == pytest.approx(STRETCH, abs=0.1)
    parts, told = part_of([readings(60.0, np.ones_like) for _ in range(8)], "searched", 100.0)
    assert all(0.02 * len(part.joint_states.stamp) == pytest.approx(STRETCH, abs=0.1) for part in parts)
    assert "160 s were searched: 8 stretches" in told


def test_a_problem_is_made_of_the_stretches_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Between them nothing is filled: each is a piece of its own."""
    monkeypatch.setattr("pcw_sim_bridge.mismatch.robot.long_recordings.STRETCH", 2.0)
    record_run(THESIS, lambda time: min(time, 1.0) * np.array([0.3 * np.sin(time), 0.2, 0.4]), 12.0, 1, tmp_path / "run")
    recording = RobotSubject(THESIS).open(tmp_path / "run", "fit", {}).recording
    [part], _ = part_of([recording], "searched", 6.0)
    assert isinstance(part, Recording)
    builder = RobotProblemBuilder(THESIS, [part])
    assert len(builder.motions) == 3 and all(1.9 < m.time[-1] - m.time[0] < 2.1 for m in builder.motions)
    problem = builder.build(with_terms=False)
    assert problem.valid.mean() > 0.5 and np.isfinite(problem.residual).all()
