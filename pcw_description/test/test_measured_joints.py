"""joint_states as nodes read them: whose they are, what is missing in them, and headings that a driver wraps."""

from __future__ import annotations

import math

import numpy as np
import pytest

pytest.importorskip("rclpy")

from sensor_msgs.msg import JointState  # noqa: E402

from pcw_description import PcwError, load_robot  # noqa: E402
from pcw_description.nodes.diagnostics import Problems  # noqa: E402
from pcw_description.nodes.measured_joints import MeasuredJoints  # noqa: E402
from pcw_description.nodes.node_tools import ns_to_stamp  # noqa: E402

THESIS = load_robot("thesis")
NAMES = list(THESIS.joint_names)


class Log:
    """Stands for a node and its logger."""

    def __init__(self) -> None:
        self.lines: list[str] = []

    def get_logger(self) -> Log:
        return self

    def warning(self, text: str) -> None:
        self.lines.append(text)


@pytest.fixture
def log() -> Log:
    return Log()


@pytest.fixture
def problems(log: Log) -> Problems:
    return Problems(log)  # type: ignore[arg-type]


@pytest.fixture
def joints(problems: Problems) -> MeasuredJoints:
    return MeasuredJoints(THESIS, ["position", "velocity"], problems)


def message(position: list[float], velocity: list[float] | None = None, names: list[str] = NAMES) -> JointState:
    return JointState(name=names, position=position, velocity=[0.0] * len(position) if velocity is None else velocity)


def test_a_heading_that_is_wrapped_goes_on(joints: MeasuredJoints) -> None:
    """Absolute encoders of steerings tell an angle within one turn; the jump had moved the robot."""
    true = np.linspace(0.0, 4.0 * math.pi, 100)[:, None, None] * np.array([1.0, -1.0])
    true = np.broadcast_to(true, (100, 4, 2)).copy()
    true[:, :2, 1] *= -1.0
    read = []
    for sample in true:
        sent = sample.copy()
        sent[:, 1] = (sent[:, 1] + math.pi) % math.tau - math.pi
        read.append(joints.read(message(sent.ravel().tolist()))[0])
    np.testing.assert_allclose(read, true, atol=1e-12)


def test_a_drive_that_is_wrapped_or_begins_anew_does_not_race(joints: MeasuredJoints, problems: Problems) -> None:
    """A board that starts again counts from zero, within a period; odom had moved by all that the robot had driven."""
    true = np.linspace(0.0, 30.0, 301)
    read = []
    for k, angle in enumerate(true):
        joints.watch.update(ns_to_stamp(k * 10_000_000))
        sent = np.full((4, 2), angle)
        sent[:, 1] = 0.0
        sent[0, 0] = (angle + math.pi) % math.tau - math.pi  # wrapped
        if k >= 200:
            sent[1, 0] -= 17.0  # began anew
        read.append(joints.read(message(sent.ravel().tolist()))[0][:, 0])
    read = np.array(read)
    np.testing.assert_allclose(read[:, 0], true, atol=1e-9)
    np.testing.assert_allclose(read[200:, 1], true[200:] - 0.1, atol=1e-9)  # what it moved in that period is not known
    np.testing.assert_allclose(read[:, 2], true, atol=1e-9)
    assert problems.take().startswith("joint_states: front_right_drive jumped by -16.9 rad in 0.01 s; allowed: 40 rad/s; ")


def test_fast_drives_that_are_seldom_told_are_believed(joints: MeasuredJoints) -> None:
    """At 10 Hz a wheel at its limit turns by 4 rad between two messages."""
    for k in range(20):
        joints.watch.update(ns_to_stamp(k * 100_000_000))
        position, _, _ = joints.read(message([4.0 * k, 0.0] * 4))
        assert (position[:, 0] == 4.0 * k).all()


def test_what_is_missing_is_named_by_joint_and_field_without_what_was_measured(joints: MeasuredJoints) -> None:
    cases = (
        (message([1.25] * 7, names=NAMES[:7]), "lacks rear_right_steer; allowed: all joints of thesis"),
        (message([1.25] * 8, []), "has no velocity of front_left_drive, front_left_steer, .*; allowed: position and velocity"),
        (message([1.25] * 8, [1.25] * 5), "has no velocity of rear_left_steer, rear_right_drive, rear_right_steer; "),
        (message([1.25] * 8, [1.25, math.nan] * 4), "velocity of front_left_steer, .* is NaN or infinite"),
        (message([math.inf] + [1.25] * 7), "position of front_left_drive is NaN or infinite"),
    )
    for sent, reason in cases:
        with pytest.raises(PcwError, match=reason) as refused:
            joints.read(sent)
        assert "1.25" not in str(refused.value)
    position, velocity, effort = joints.read(message([1.25] * 8))
    assert (position == 1.25).all() and (velocity == 0.0).all() and np.isnan(effort).all()


def test_joints_of_others_are_no_message_of_the_robot_and_named_where_nothing_else_comes(
    joints: MeasuredJoints, problems: Problems, log: Log
) -> None:
    arm = message([0.0, 0.0], names=["arm_1", "arm_2"])
    assert joints.silence() == "no joint_states since the last report"
    assert not joints.are_in(arm) and joints.are_in(message([0.0], names=["rear_left_drive"]))
    assert joints.silence() == ""
    assert problems.take() == log.lines[0]
    assert "names arm_1, arm_2 and no joint of thesis; allowed: all joints of thesis" in log.lines[0]
    joints.are_in(arm)
    joints.watch.update(ns_to_stamp(1))
    assert joints.silence() == "" == problems.take()


def test_stamps_that_stand_still_are_told(joints: MeasuredJoints, problems: Problems) -> None:
    """A driver that never sets the stamp had every message left out as a repeat, and the node was content."""
    for _ in range(3):
        joints.watch.update(ns_to_stamp(0))
    assert joints.silence() == "" == problems.take()  # the first was one to compute with
    joints.watch.update(ns_to_stamp(0))
    assert joints.silence() == ""
    assert "all joint_states have the stamp 0.000000000 s; allowed: the time of each" in problems.take()


def test_numbers_alone_are_no_news(problems: Problems, log: Log) -> None:
    """Problems that held what was measured were a line of the log each, a hundred a second, and all of them one status."""
    assert problems.add("imu/data lies 1.5 s after wheel_1")
    assert not problems.add("imu/data lies 2.75e-3 s after wheel_1")
    assert problems.add("imu/data lies 2.75 s after wheel_2")
    assert not problems.add("imu/data lies nan s after wheel_2") and len(log.lines) == 2
    assert problems.take() == "imu/data lies 2.75e-3 s after wheel_1; imu/data lies nan s after wheel_2"
    assert not problems.add("imu/data lies 7 s after wheel_1")
    problems.take()
    problems.take()
    assert problems.add("imu/data lies 7 s after wheel_1")
