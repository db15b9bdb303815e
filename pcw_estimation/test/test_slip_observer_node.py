"""The slip observer as a process over real DDS: what it publishes, and what it makes of every kind of bad input."""

import math
import subprocess
import sys

import numpy as np
import pytest

pytest.importorskip("rclpy")

from diagnostic_msgs.msg import DiagnosticArray  # noqa: E402
from sensor_msgs.msg import JointState  # noqa: E402

from pcw_description import AugmentedObjectModel, inverse_kinematics, load_robot  # noqa: E402
from pcw_description.differential_kinematics import joint_matrix, wheel_jacobian  # noqa: E402
from pcw_description.nodes.node_testing import RosTest  # noqa: E402
from pcw_description.nodes.node_tools import ns_to_stamp, stamp_to_ns  # noqa: E402

THESIS = load_robot("thesis")
PERIOD = 0.002
ENTRIES = [f"{caster}_{direction}" for caster in THESIS.caster_names for direction in ("longitudinal", "lateral")]


@pytest.fixture
def ros():
    with RosTest() as ros:
        yield ros


class SwayingRobot:
    """Publishes joint_states of a robot that rolls to and fro along x, with the torques that this takes.

    Tyres are stiff here: it rolls without slip, and the ground gives Lambda V_dot.
    """

    def __init__(self, ros):
        self.ros, self.time_ns, self.phase, self.roll = ros, 1_000_000_000, 0.0, np.zeros(THESIS.n)
        self.heavier = 1.0
        self.change = lambda message: message
        self.publisher = ros.peer.create_publisher(JointState, "joint_states", 1000)
        inertia, _ = AugmentedObjectModel(THESIS).evaluate(np.zeros(THESIS.n), np.zeros(3))
        steering = wheel_jacobian(THESIS, np.zeros(THESIS.n))
        spread = joint_matrix(THESIS).T @ np.linalg.pinv(steering.T)
        self.torque_per_acceleration = (spread @ inertia[:, 0]).reshape(THESIS.n, 2)

    def publish(self, periods=5):
        for _ in range(periods):
            self.time_ns += round(PERIOD * 1e9)
            self.phase += 6.0 * PERIOD
            speed, acceleration = 0.5 + 0.3 * math.sin(self.phase), 1.8 * math.cos(self.phase - 3.0 * PERIOD)
            rates = inverse_kinematics(THESIS, np.zeros(THESIS.n), np.array([speed, 0.0, 0.0]))
            self.roll = self.roll + PERIOD * rates[:, 0]
            position = np.stack([self.roll, np.zeros(THESIS.n)], axis=1)
            effort = self.heavier * self.torque_per_acceleration * acceleration
            message = JointState(name=list(THESIS.joint_names))
            message.position, message.velocity = position.ravel().tolist(), rates.ravel().tolist()
            message.effort = effort.ravel().tolist()
            message.header.stamp = ns_to_stamp(self.time_ns)
            changed = self.change(message)
            if changed is not None:
                self.publisher.publish(changed)

    def run(self, condition, while_doing=None):
        self.ros.wait_for(lambda: self.publisher.get_subscription_count() > 0)
        self.ros.wait_for(condition, while_doing=while_doing or self.publish, every=0.01)


def values_of(diagnostics):
    return {v.key: v.value for s in diagnostics[-1].status for v in s.values} if diagnostics else {}


def said(diagnostics):
    return " ".join(s.message for d in diagnostics for s in d.status)


def start(ros, *parameters):
    node = ros.start("pcw_estimation.nodes.slip_observer", *parameters)
    slip, diagnostics = ros.listen(JointState, "slip/observer"), ros.listen(DiagnosticArray, "/diagnostics")
    return node, slip, diagnostics, SwayingRobot(ros)


@pytest.mark.parametrize("measured", ["speed", "angle"])
def test_it_publishes_slip_and_forces_in_the_order_of_the_contract(ros, measured):
    node, slip, _, robot = start(ros, "-p", f"measured:={measured}")
    robot.run(lambda: len(slip) > 150)
    last = slip[-1]
    assert list(last.name) == ENTRIES
    assert len(last.position) == len(last.velocity) == len(last.effort) == 2 * THESIS.n
    # It rolls without slip, where the tyres believed in slip by half a percent under these forces.
    assert np.abs(last.velocity).max() < 0.02 and np.abs(last.position).max() < 0.05
    along = np.array([m.effort[0] for m in slip[20:] if len(m.effort)])
    force = THESIS.total_mass / THESIS.n * 1.8
    assert along.max() == pytest.approx(force, rel=0.1) and along.min() == pytest.approx(-force, rel=0.1)
    times = np.array([stamp_to_ns(m.header.stamp) for m in slip])
    assert np.median(np.diff(times)) == 10e6
    # Empty until it is known; never NaN.
    assert all(np.isfinite([*m.position, *m.velocity, *m.effort]).all() for m in slip)
    assert node.interrupt() == 0


@pytest.mark.parametrize("method", ["kalman_filter", "motor_current"])
def test_the_other_methods_have_the_same_interface(ros, method):
    _, slip, _, robot = start(ros, "-p", f"method:={method}")
    robot.run(lambda: len(slip) > 20 and len(slip[-1].velocity) > 0)
    assert list(slip[-1].name) == ENTRIES and np.abs(slip[-1].velocity).max() < 0.05
    if method == "motor_current":  # it knows nothing of what is across, and a field is sent as a whole
        assert all(len(m.position) == len(m.effort) == 0 for m in slip)


def test_that_it_begins_anew_after_a_gap_is_told(ros):
    """With messages as seldom as longest_gap allows, and stamps that tremble, every other one was a gap, and all was well."""
    _, slip, diagnostics, robot = start(ros)
    robot.run(lambda: len(slip) > 30 and len(slip[-1].velocity) > 0)
    robot.time_ns += 105_000_000
    told = "; allowed: at most longest_gap = 0.1 s; it begins anew"
    robot.run(lambda: any(told in status.message for d in diagnostics for status in d.status))


@pytest.mark.nightly  # on a loaded machine messages are lost, and with them what it waits for
def test_gaps_and_stamps_that_repeat_or_go_back_are_counted_and_it_begins_anew(ros):
    _, slip, diagnostics, robot = start(ros)
    robot.run(lambda: len(slip) > 30 and len(slip[-1].velocity) > 0)

    robot.time_ns += 1_000_000_000
    count = len(slip)
    robot.run(lambda: len(slip) > count + 20)
    assert len(slip[count].velocity) == 0  # the first one after the gap vouches for nothing
    assert len(slip[-1].velocity) > 0

    robot.time_ns -= 500_000_000
    count = len(slip)
    robot.run(lambda: len(slip) > count + 20)
    assert len(slip[-1].velocity) > 0

    def twice():
        robot.publish()
        robot.time_ns -= round(PERIOD * 1e9)
        robot.change = lambda message: message

    robot.run(lambda: int(values_of(diagnostics).get("repeated_stamps", 0)) > 0, while_doing=twice)
    values = values_of(diagnostics)
    assert values["gaps"] == "1" and int(values["backward_jumps"]) >= 1
    assert all(np.isfinite([*m.position, *m.velocity, *m.effort]).all() for m in slip)


def test_nan_and_missing_fields_are_left_out_and_told(ros):
    _, slip, diagnostics, robot = start(ros)
    for field in ("position", "velocity", "effort"):
        count = len(slip)
        robot.run(lambda: len(slip) > count + 20)  # noqa: B023 - it is waited for here

        def with_nan(message):
            getattr(message, field)[3] = math.nan  # noqa: B023
            return message

        robot.change = with_nan
        robot.publish(2)
        ros.wait_for(lambda: f"{field} of front_right_steer is NaN" in said(diagnostics))  # noqa: B023
        robot.change = lambda message: message
        count = len(slip)
        robot.run(lambda: len(slip) > count + 5)  # noqa: B023
        assert len(slip[-1].velocity) > 0  # two readings were bridged

        def without(message):
            setattr(message, field, [])  # noqa: B023
            return message

        robot.change = without
        before = int(values_of(diagnostics).get("unusable_joint_states", 0))
        robot.run(lambda: int(values_of(diagnostics).get("unusable_joint_states", 0)) > before + 20)  # noqa: B023
        robot.change = lambda message: message
    assert all(np.isfinite([*m.position, *m.velocity, *m.effort]).all() for m in slip)


def test_the_angle_version_does_without_velocities(ros):
    _, slip, _, robot = start(ros, "-p", "measured:=angle")

    def without(message):
        message.velocity = []
        return message

    robot.change = without
    robot.run(lambda: len(slip) > 30 and len(slip[-1].velocity) > 0)


def test_a_missing_joint_is_named_and_another_order_makes_no_difference(ros):
    _, slip, diagnostics, robot = start(ros)

    def shuffled(message):
        order = [5, 2, 7, 0, 3, 6, 1, 4]
        for field in ("name", "position", "velocity", "effort"):
            values = list(getattr(message, field))
            setattr(message, field, [values[i] for i in order])
        message.name.append("gripper")
        for field in ("position", "velocity", "effort"):
            getattr(message, field).append(1.0)
        return message

    robot.change = shuffled
    robot.run(lambda: len(slip) > 60)
    assert list(slip[-1].name) == ENTRIES and np.abs(slip[-1].velocity).max() < 0.02

    def without_the_last(message):
        for field in ("name", "position", "velocity", "effort"):
            setattr(message, field, list(getattr(message, field))[:-1])
        return message

    robot.change = without_the_last
    robot.publish(2)
    ros.wait_for(lambda: f"lacks {THESIS.joint_names[-1]}" in said(diagnostics))


def test_a_robot_file_with_other_joints_gives_nothing_and_says_so(ros):
    _, slip, diagnostics, robot = start(ros, "-p", "robot:=tidybot2")
    robot.change = lambda message: JointState(
        header=message.header, name=[f"wheel{i}" for i in range(8)], position=message.position, velocity=message.velocity,
        effort=message.effort,
    )  # fmt: skip
    robot.run(lambda: "allowed: all joints of tidybot2" in said(diagnostics))
    assert slip == []


@pytest.mark.nightly
def test_a_robot_file_with_other_masses_is_told_and_no_velocity_is_vouched_for(ros):
    """The torques are those of a robot of 0.7 times the mass of the file; on a loaded machine it comes and goes."""
    _, slip, diagnostics, robot = start(ros)
    robot.heavier = 0.7
    robot.run(lambda: "does the robot file match" in said(diagnostics))
    count = len(slip)
    robot.run(lambda: len(slip) > count + 20)
    assert all(len(m.position) == len(m.velocity) == 0 for m in slip[count + 5 :])


def test_silence_is_told(ros):
    _, _, diagnostics, _ = start(ros)
    ros.wait_for(lambda: "no joint_states" in said(diagnostics))


@pytest.mark.parametrize(
    ("parameter", "mentioned"),
    [("robot:=mpo700", "caster_offset"), ("method:=guess", "method"), ("measured:=torque", "measured")],
)
def test_what_cannot_work_ends_it_with_one_line(parameter, mentioned):
    result = subprocess.run(
        [sys.executable, "-m", "pcw_estimation.nodes.slip_observer", "--ros-args", "-p", parameter],
        capture_output=True, text=True, timeout=120,
    )  # fmt: skip
    assert result.returncode == 2
    assert mentioned in result.stderr and len(result.stderr.strip().splitlines()) == 1
