"""Odometry and slip detection as processes over real DDS."""

import math
import subprocess
import sys

import numpy as np
import pytest

pytest.importorskip("rclpy")

from diagnostic_msgs.msg import DiagnosticArray  # noqa: E402
from nav_msgs.msg import Odometry  # noqa: E402
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue  # noqa: E402
from rcl_interfaces.srv import GetParameters, SetParameters  # noqa: E402
from sensor_msgs.msg import JointState  # noqa: E402

from pcw_description import inverse_kinematics, load_robot  # noqa: E402
from pcw_description.nodes.node_testing import RosTest  # noqa: E402
from pcw_description.nodes.node_tools import ns_to_stamp, stamp_to_ns  # noqa: E402

THESIS = load_robot("thesis")
NAMES = list(THESIS.joint_names)
PERIOD_NS = 2_000_000
TWIST = np.array([0.5, 0.0, 0.4])


@pytest.fixture
def ros():
    with RosTest() as ros:
        yield ros


class RollingRobot:
    """Publishes joint_states of a robot on a circle, 2 ms apart in its own time; every joint can be falsified."""

    def __init__(self, ros, topic="joint_states"):
        self.ros, self.time_ns = ros, 0
        self.position, self.extra_velocity = np.zeros((4, 2)), np.zeros((4, 2))
        axis = THESIS.steer_axis
        self.position[:, 1] = np.arctan2(TWIST[2] * axis[:, 0], TWIST[0] - TWIST[2] * axis[:, 1])
        self.publisher = ros.peer.create_publisher(JointState, topic, 1000)

    def publish(self, periods=5):
        for _ in range(periods):
            dt = PERIOD_NS * 1e-9
            middle = self.position.copy()
            middle[:, 1] += 0.5 * dt * inverse_kinematics(THESIS, self.position[:, 1].copy(), TWIST)[:, 1]
            rates = inverse_kinematics(THESIS, middle[:, 1].copy(), TWIST) + self.extra_velocity
            self.position = self.position + dt * rates
            self.time_ns += PERIOD_NS
            message = JointState(name=NAMES, position=self.position.ravel().tolist(), velocity=rates.ravel().tolist())
            message.header.stamp = ns_to_stamp(self.time_ns)
            self.publisher.publish(message)

    def run(self, condition):
        self.ros.wait_for(lambda: self.publisher.get_subscription_count() > 0)
        self.ros.wait_for(condition, while_doing=self.publish, every=0.01)


def messages_of(diagnostics):
    return " ".join(s.message for d in diagnostics for s in d.status)


def test_odometry_follows_a_circle_from_measured_stamps(ros):
    node = ros.start("pcw_estimation.nodes.odometry", "-p", "publish_rate:=50.0")
    odom, robot = ros.listen(Odometry, "odom"), RollingRobot(ros)
    robot.run(lambda: odom and stamp_to_ns(odom[-1].header.stamp) > 2e9)
    first, last = odom[0], odom[-1]
    assert last.header.frame_id == "odom" and last.child_frame_id == "base_link"
    times = np.array([stamp_to_ns(m.header.stamp) for m in odom])
    # Every 20 ms of the measurement's own time, whatever time it was here; a lost sample shifts it by a few.
    assert np.median(np.diff(times)) == 20e6

    turned = 2.0 * (math.atan2(last.pose.pose.orientation.z, last.pose.pose.orientation.w)
                    - math.atan2(first.pose.pose.orientation.z, first.pose.pose.orientation.w))
    duration = (times[-1] - times[0]) * 1e-9
    assert math.remainder(turned - TWIST[2] * duration, math.tau) == pytest.approx(0.0, abs=1e-6)
    # On a circle the centre stays where it is: position + R (left of the heading).

    def centre(message):
        yaw = 2.0 * math.atan2(message.pose.pose.orientation.z, message.pose.pose.orientation.w)
        radius = TWIST[0] / TWIST[2]
        place = message.pose.pose.position
        return np.array([place.x - radius * math.sin(yaw), place.y + radius * math.cos(yaw)])

    np.testing.assert_allclose(centre(first), centre(last), atol=1e-5)
    assert last.twist.twist.linear.x == pytest.approx(0.5, abs=1e-5)
    assert last.twist.twist.angular.z == pytest.approx(0.4, abs=1e-5)
    assert all(np.isfinite(m.pose.covariance).all() and np.isfinite(m.twist.covariance).all() for m in odom)
    assert node.interrupt() == 0


def test_odometry_covariance_comes_from_what_the_wheels_contradict(ros):
    ros.start("pcw_estimation.nodes.odometry")
    odom, robot = ros.listen(Odometry, "odom"), RollingRobot(ros)
    robot.run(lambda: odom and stamp_to_ns(odom[-1].header.stamp) > 1e9)
    clean = odom[-1].twist.covariance[0]
    robot.extra_velocity[1, 0] = 2.0
    since = robot.time_ns
    robot.run(lambda: stamp_to_ns(odom[-1].header.stamp) > since + 1e9)
    assert odom[-1].twist.covariance[0] > 100.0 * clean > 0.0


def test_odometry_keeps_its_pose_over_a_gap_and_unusable_joints(ros):
    ros.start("pcw_estimation.nodes.odometry", "-p", "longest_gap:=0.2")
    odom, robot = ros.listen(Odometry, "odom"), RollingRobot(ros)
    diagnostics = ros.listen(DiagnosticArray, "/diagnostics")
    robot.run(lambda: odom and stamp_to_ns(odom[-1].header.stamp) > 0.5e9)
    before = odom[-1].pose.pose.position
    robot.time_ns += 1_000_000_000
    robot.position[:, 0] += 5.0  # rolled on unseen: 375 mm
    count = len(odom)
    robot.run(lambda: len(odom) > count + 1)
    after = odom[-1].pose.pose.position
    assert math.hypot(after.x - before.x, after.y - before.y) < 0.1

    good, robot.position[2, 0] = robot.position.copy(), math.nan
    robot.publish(1)
    ros.wait_for(lambda: "position of rear_left_drive is NaN" in messages_of(diagnostics))
    robot.position = good
    count = len(odom)
    robot.run(lambda: len(odom) > count + 5)
    assert all(math.isfinite(m.pose.pose.position.x) for m in odom)
    values = {v.key: v.value for s in diagnostics[-1].status for v in s.values}
    assert values["gaps"] == "1"

    # Forty milliseconds without a usable measurement are no haste.
    turning = robot.position.copy()
    for _ in range(20):
        robot.position[2, 0] = math.nan
        robot.publish(1)
        ros.spin_once()
    robot.position[2, 0] = turning[2, 0] + (robot.position[1, 0] - turning[1, 0])
    count = len(odom)
    robot.run(lambda: len(odom) > count + 5)
    assert max(m.twist.twist.linear.x for m in odom[count:]) < 0.6


def test_headings_that_are_wrapped_and_joints_of_others_do_not_move_odom(ros):
    """Steerings with absolute encoders jump by a turn, and drivers of arms share the topic."""
    ros.start("pcw_estimation.nodes.odometry")
    odom, diagnostics, robot = ros.listen(Odometry, "odom"), ros.listen(DiagnosticArray, "/diagnostics"), RollingRobot(ros)
    arm, publish = JointState(name=["arm_1"], position=[0.1]), robot.publisher.publish

    def wrapped(message):
        for i in range(1, 8, 2):
            message.position[i] -= math.tau * ((robot.time_ns // PERIOD_NS // 10 + i // 2) % 2)
        publish(message)
        arm.header.stamp = ns_to_stamp(robot.time_ns + PERIOD_NS // 4)
        publish(arm)

    robot.publisher.publish = wrapped
    robot.run(lambda: odom and stamp_to_ns(odom[-1].header.stamp) > 2e9)
    assert max(abs(m.twist.twist.linear.x - TWIST[0]) for m in odom) < 1e-3
    assert {s.message for d in diagnostics for s in d.status} <= {"integrating", "no joint_states since the last report"}


def test_two_robots_in_one_domain_can_be_told_apart(ros):
    """All nodes share /diagnostics, and each robot's odometry had the same name there."""
    for namespace in ("a", "b"):
        ros.start("pcw_estimation.nodes.odometry", "-r", f"__ns:=/{namespace}", "-p", f"base_frame:={namespace}/base_link")
    diagnostics, odom = ros.listen(DiagnosticArray, "/diagnostics"), ros.listen(Odometry, "/a/odom")
    robot = RollingRobot(ros, "/a/joint_states")

    def statuses():
        return {(s.name, s.message) for d in diagnostics for s in d.status}

    robot.run(lambda: ("/a/odometry: odometry", "integrating") in statuses() and odom)
    ros.wait_for(lambda: ("/b/odometry: odometry", "no joint_states since the last report") in statuses())
    assert ("/b/odometry: odometry", "integrating") not in statuses()
    assert odom[-1].child_frame_id == "a/base_link"


def test_stamps_that_stand_still_are_said(ros):
    ros.start("pcw_estimation.nodes.odometry")
    diagnostics, robot = ros.listen(DiagnosticArray, "/diagnostics"), RollingRobot(ros)

    def publish():
        robot.time_ns = -PERIOD_NS
        robot.publish(1)

    ros.wait_for(lambda: "all joint_states have the stamp 0.000000000 s" in messages_of(diagnostics), while_doing=publish)


def test_silence_is_reported(ros):
    ros.start("pcw_estimation.nodes.odometry")
    ros.start("pcw_estimation.nodes.encoder_slip")
    diagnostics = ros.listen(DiagnosticArray, "/diagnostics")
    said = lambda: {s.name for d in diagnostics for s in d.status if "no joint_states" in s.message}  # noqa: E731
    ros.wait_for(lambda: said() == {"odometry: odometry", "encoder_slip: slip"})


def test_slip_names_the_wheel_and_never_sends_what_it_does_not_know(ros):
    node = ros.start("pcw_estimation.nodes.encoder_slip")
    slip, diagnostics = ros.listen(JointState, "slip/encoder"), ros.listen(DiagnosticArray, "/diagnostics")
    robot = RollingRobot(ros)
    robot.run(lambda: len(slip) > 20)
    assert slip[-1].name == [f"{c}_{d}" for c in THESIS.caster_names for d in ("longitudinal", "lateral")]
    assert np.abs(slip[-1].velocity).max() < 1e-3
    assert len(slip[-1].effort) == 0  # encoders know nothing of forces
    assert np.median(np.diff([stamp_to_ns(m.header.stamp) for m in slip])) == 10e6

    robot.extra_velocity[1, 0] = 0.4 / 0.075
    # Which of the two topics arrives first is nobody's promise.
    robot.run(lambda: "front_right_longitudinal" in messages_of(diagnostics) and max(slip[-1].velocity) > 0.1)
    assert slip[-1].velocity[2] == max(slip[-1].velocity)
    assert slip[-1].position[2] > 0.1
    robot.extra_velocity[1, 0] = 0.0
    diagnostics.clear()
    robot.run(lambda: "no slip" in messages_of(diagnostics))

    robot.extra_velocity[0, 0] = math.nan
    robot.run(lambda: "NaN" in messages_of(diagnostics) or "joint_" in messages_of(diagnostics))
    assert all(np.isfinite(m.velocity).all() and np.isfinite(m.position).all() for m in slip)
    assert node.interrupt() == 0


def test_refused_parameter_keeps_the_old_value(ros):
    ros.start("pcw_estimation.nodes.encoder_slip")

    def set_floor(value):
        number = ParameterValue(type=ParameterType.PARAMETER_DOUBLE, double_value=value)
        request = SetParameters.Request(parameters=[Parameter(name="floor", value=number)])
        [result] = ros.call(SetParameters, "encoder_slip/set_parameters", request).results
        [found] = ros.call(GetParameters, "encoder_slip/get_parameters", GetParameters.Request(names=["floor"])).values
        return result.successful, found.double_value

    assert set_floor(0.0) == (False, 0.010)
    assert set_floor(0.02) == (True, 0.02)


@pytest.mark.parametrize("node", ["odometry", "encoder_slip"])
def test_bad_robot_ends_it_with_one_line(node):
    result = subprocess.run(
        [sys.executable, "-m", f"pcw_estimation.nodes.{node}", "--ros-args", "-p", "robot:=/no/such/robot.yaml"],
        capture_output=True, text=True, timeout=120,
    )
    assert result.returncode == 2
    assert "/no/such/robot.yaml" in result.stderr and len(result.stderr.strip().splitlines()) == 1
