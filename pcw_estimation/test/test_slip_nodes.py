"""Slip and faults as processes over real DDS: what is said, what is left out, and that nothing that is not finite is sent."""

import math
import time

import numpy as np
import pytest

pytest.importorskip("rclpy")

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus  # noqa: E402
from geometry_msgs.msg import TwistWithCovarianceStamped  # noqa: E402
from nav_msgs.msg import Odometry  # noqa: E402
from sensor_msgs.msg import Imu, JointState  # noqa: E402

from pcw_description import inverse_kinematics, load_robot  # noqa: E402
from pcw_description.nodes.node_testing import RosTest  # noqa: E402
from pcw_description.nodes.node_tools import ns_to_stamp, stamp_to_ns  # noqa: E402
from pcw_estimation import SlipNoise  # noqa: E402

THESIS = load_robot("thesis")
NAMES = list(THESIS.joint_names)
ALONE = "no slip of one wheel against another; whether all wheels slip alike cannot be known from encoders"


@pytest.fixture
def ros():
    with RosTest() as ros:
        yield ros


class Robot:
    """Publishes joint_states at 500 Hz and imu/data at 250 Hz, both in its own time; drives straight on, or turns."""

    def __init__(self, ros, with_imu=True):
        self.ros, self.time_ns, self.count, self.turning = ros, 0, 0, 0.0
        self.position, self.speed, self.shown_speed = np.zeros((4, 2)), 0.0, None
        self.names, self.order, self.falsify, self.gyro = NAMES, list(range(8)), lambda position, velocity: None, 0.0
        self.joints = ros.peer.create_publisher(JointState, "joint_states", 1000)
        self.imu = ros.peer.create_publisher(Imu, "imu/data", 1000) if with_imu else None

    def publish(self, periods=5):
        for _ in range(periods):
            shown = self.speed if self.shown_speed is None else self.shown_speed
            rates = inverse_kinematics(THESIS, self.position[:, 1], np.array([shown, 0.0, self.turning]))
            self.position = self.position + 0.002 * rates
            self.time_ns += 2_000_000
            self.count += 1
            stamp = ns_to_stamp(self.time_ns)
            if self.imu is not None and self.count % 2 == 0:
                imu = Imu()
                imu.header.stamp = stamp
                imu.angular_velocity.z = self.gyro
                self.imu.publish(imu)
            position, velocity = self.position.copy(), rates.copy()
            self.falsify(position, velocity)
            message = JointState(name=[self.names[k] for k in self.order])
            message.position = position.ravel()[self.order].tolist()
            message.velocity = velocity.ravel()[self.order].tolist()
            message.header.stamp = stamp
            self.joints.publish(message)

    def run(self, condition):
        wanted = [self.joints] + ([self.imu] if self.imu is not None else [])
        self.ros.wait_for(lambda: all(p.get_subscription_count() > 0 for p in wanted[:1]))
        return self.ros.wait_for(condition, while_doing=self.publish, every=0.01)

    def run_for(self, seconds):
        end = self.time_ns + int(seconds * 1e9)
        self.run(lambda: self.time_ns >= end)


def statuses(diagnostics):
    return {s.name: s for d in diagnostics for s in d.status}


def said(diagnostics):
    return " ".join(s.message for d in diagnostics for s in d.status)


def test_a_dead_encoder_is_named_and_no_other_joint(ros):
    node = ros.start("pcw_estimation.nodes.encoder_slip")
    diagnostics, robot = ros.listen(DiagnosticArray, "/diagnostics"), Robot(ros, with_imu=False)
    robot.speed = 0.5
    robot.order = [5, 0, 7, 2, 1, 4, 3, 6]  # another order of the joints is none of its business
    robot.run(lambda: statuses(diagnostics).get("encoder_slip: joints"))
    assert statuses(diagnostics)["encoder_slip: joints"].message == "no fault"
    stood = robot.position[1, 0]

    def dead(position, velocity):
        position[1, 0], velocity[1, 0] = stood, 0.0

    robot.falsify = dead
    robot.run(lambda: "encoder_slip: front_right_drive" in statuses(diagnostics))
    found = statuses(diagnostics)
    assert found["encoder_slip: front_right_drive"].level == DiagnosticStatus.ERROR
    assert {v.key: v.value for v in found["encoder_slip: front_right_drive"].values} == {"fault": "dead"}
    assert [name for name in found if name.endswith(("_drive", "_steer"))] == ["encoder_slip: front_right_drive"]
    assert node.interrupt() == 0


def test_a_missing_joint_is_said_and_not_made_up(ros):
    ros.start("pcw_estimation.nodes.encoder_slip")
    slip, diagnostics = ros.listen(JointState, "slip/encoder"), ros.listen(DiagnosticArray, "/diagnostics")
    robot = Robot(ros, with_imu=False)
    robot.order = list(range(7))
    robot.run(lambda: "lacks rear_right_steer" in said(diagnostics))
    assert not slip


def test_slip_of_before_does_not_hide_that_nothing_comes_any_more(ros):
    """The last flags were reported for as long as joint_states stayed away."""
    ros.start("pcw_estimation.nodes.encoder_slip")
    diagnostics, robot = ros.listen(DiagnosticArray, "/diagnostics"), Robot(ros, with_imu=False)

    def spins(position, velocity):
        velocity[1, 0] += 5.0

    robot.falsify, robot.speed = spins, 0.5
    robot.run(lambda: "slip since" in said(diagnostics))
    ros.wait_for(lambda: statuses(diagnostics)["encoder_slip: slip"].message == "no joint_states since the last report")


def test_that_nothing_slips_is_said_only_by_who_has_an_imu(ros):
    """Slip of all wheels alike is motion to every encoder: who has encoders alone cannot know, and once said "no slip"."""
    ros.start("pcw_estimation.nodes.encoder_slip")
    ros.start("pcw_estimation.nodes.imu_slip")
    diagnostics, robot = ros.listen(DiagnosticArray, "/diagnostics"), Robot(ros)

    def messages():
        return [statuses(diagnostics)[f"{node}: slip"].message for node in ("encoder_slip", "imu_slip")]

    both = {"encoder_slip: slip", "imu_slip: slip"}
    robot.run(lambda: both <= set(statuses(diagnostics)) and messages() == [ALONE, "no slip"])


@pytest.mark.nightly
def test_method_and_learned_noise_are_parameters(ros, tmp_path):
    SlipNoise.of_robot(THESIS).save(tmp_path / "noise.yaml", "thesis")
    ros.start(
        "pcw_estimation.nodes.encoder_slip", "-p", "method:=procedure", "-p", f"noise:={tmp_path / 'noise.yaml'}",
        "-r", "__node:=other",
    )
    diagnostics, robot = ros.listen(DiagnosticArray, "/diagnostics"), Robot(ros, with_imu=False)
    robot.run(lambda: "other: slip" in statuses(diagnostics) and statuses(diagnostics)["other: slip"].message == ALONE)
    assert {v.key: v.value for v in statuses(diagnostics)["other: slip"].values}["method"] == "procedure"
    (tmp_path / "bad.yaml").write_text("format: pcw_slip_noise/1\nrobot: tidybot2\n")
    bad = ros.start("pcw_estimation.nodes.encoder_slip", "-p", f"noise:={tmp_path / 'bad.yaml'}")
    assert bad.wait() == 2 and "robot = 'tidybot2' is not allowed; allowed: 'thesis'" in bad.log


def test_all_wheels_that_spin_are_said_to_slip_and_do_not_move_odom(ros):
    slip_node = ros.start("pcw_estimation.nodes.imu_slip")
    fusion = ros.start("pcw_estimation.nodes.slip_fusion", "-p", "publish_rate:=50.0")
    slip, odom = ros.listen(JointState, "slip/imu"), ros.listen(Odometry, "odom")
    twist, diagnostics = ros.listen(TwistWithCovarianceStamped, "slip/twist"), ros.listen(DiagnosticArray, "/diagnostics")
    robot = Robot(ros)
    ros.wait_for(lambda: robot.joints.get_subscription_count() > 1 and robot.imu.get_subscription_count() > 1)
    robot.run(lambda: len(slip) > 50 and len(odom) > 20)
    assert np.median(np.diff([stamp_to_ns(m.header.stamp) for m in odom])) == 20e6
    robot.shown_speed = 0.4  # the wheels turn, the IMU feels nothing
    robot.run(lambda: "all wheels slip" in said(diagnostics))
    robot.run(lambda: slip[-1].velocity and min(slip[-1].velocity[::2]) > 0.38)
    assert len(slip[-1].effort) == 0 and slip[-1].name[0] == "front_left_longitudinal"
    robot.run_for(0.5)
    last = odom[-1]
    assert last.header.frame_id == "odom" and last.child_frame_id == "base_link"
    assert math.hypot(last.pose.pose.position.x, last.pose.pose.position.y) < 0.02
    assert twist[-1].header.frame_id == "base_link" and abs(twist[-1].twist.twist.linear.x) < 0.02
    covariance = np.reshape(last.pose.covariance, (6, 6))[np.ix_([0, 1, 5], [0, 1, 5])]
    assert (np.linalg.eigvalsh(covariance) > 0.0).all()
    assert slip_node.interrupt() == 0 and fusion.interrupt() == 0


def test_a_gyro_in_degrees_is_named_and_left_out(ros):
    """All wheels slipped, for all that was said, and the odometry turned with the gyro."""
    nodes = [ros.start("pcw_estimation.nodes.imu_slip"), ros.start("pcw_estimation.nodes.slip_fusion")]
    diagnostics, twist = ros.listen(DiagnosticArray, "/diagnostics"), ros.listen(TwistWithCovarianceStamped, "slip/twist")
    robot = Robot(ros)
    ros.wait_for(lambda: robot.joints.get_subscription_count() > 1 and robot.imu.get_subscription_count() > 1)
    robot.run_for(0.5)
    robot.turning, robot.gyro = 0.5, math.degrees(0.5)
    told = "imu/data: angular_velocity.z turns 57.3 times as far as the wheels; it looks as if it is in degrees/s; "

    def last():
        return [statuses(diagnostics).get(name) for name in ("imu_slip: slip", "slip_fusion: fusion")]

    robot.run(lambda: all(status is not None and told in status.message for status in last()))
    robot.run_for(2.5)
    assert [status.level for status in last()] == [DiagnosticStatus.WARN] * 2
    assert not any("slip since" in status.message or "all wheels" in status.message for status in last())
    values = {entry.key: entry.value for entry in last()[1].values}
    assert values["imu_in_use"] == "False" and int(values["unusable_imu"]) > 100
    assert twist[-1].twist.twist.angular.z == pytest.approx(0.5, abs=0.02)
    assert [node.interrupt() for node in nodes] == [0, 0]


def test_flags_that_come_and_go_are_not_told_dozens_of_times_a_second(ros):
    ros.start("pcw_estimation.nodes.encoder_slip", "-p", "confirm_time:=0.002")
    diagnostics, robot = ros.listen(DiagnosticArray, "/diagnostics"), Robot(ros, with_imu=False)

    def comes_and_goes(position, velocity):
        if robot.count // 10 % 2:
            velocity[robot.count // 20 % 4, 0] += 5.0

    robot.speed = 0.5
    robot.run(lambda: diagnostics)
    robot.falsify = comes_and_goes
    robot.run(lambda: "slip since" in said(diagnostics))
    diagnostics.clear()
    begun = time.monotonic()
    robot.run(lambda: time.monotonic() > begun + 3.0)
    told = [status.message for d in diagnostics for status in d.status if status.name == "encoder_slip: slip"]
    assert 6 <= len(told) <= 13 and all("slip since the last report: " in message for message in told)


def test_bad_stamps_and_numbers_are_counted_and_nothing_of_them_leaves(ros):
    ros.start("pcw_estimation.nodes.slip_fusion", "-p", "longest_gap:=0.2")
    odom, twist = ros.listen(Odometry, "odom"), ros.listen(TwistWithCovarianceStamped, "slip/twist")
    diagnostics, robot = ros.listen(DiagnosticArray, "/diagnostics"), Robot(ros)
    ros.wait_for(lambda: robot.joints.get_subscription_count() and robot.imu.get_subscription_count())
    robot.run(lambda: len(odom) > 20)

    def not_a_number(position, velocity):
        velocity[2, 1] = math.nan

    robot.falsify = not_a_number
    robot.run(lambda: "velocity of rear_left_steer is NaN" in said(diagnostics))
    robot.falsify, robot.gyro = lambda position, velocity: None, math.inf
    robot.run(lambda: "gyro, acceleration = inf" in said(diagnostics))
    robot.gyro = 0.0
    robot.time_ns -= 2_000_000  # the same stamp again
    robot.publish(1)
    robot.time_ns += 1_000_000_000  # a gap
    robot.run_for(0.1)
    robot.time_ns -= 1_500_000_000  # and back
    count = len(odom)
    robot.run(lambda: len(odom) > count + 20)

    def counts():
        values = {v.key: v.value for s in diagnostics[-1].status for v in s.values}
        return all(int(values.get(name, 0)) > 0 for name in ("gaps", "backward_jumps", "repeated_stamps", "unusable_imu"))

    robot.run(counts)
    for message in odom:
        assert np.isfinite([message.pose.pose.position.x, *message.pose.covariance, *message.twist.covariance]).all()
    assert all(math.isfinite(m.twist.twist.linear.x) for m in twist)


def test_without_an_imu_fusion_goes_by_the_wheels_and_slip_imu_is_silent(ros):
    ros.start("pcw_estimation.nodes.slip_fusion")
    ros.start("pcw_estimation.nodes.imu_slip")
    odom, slip = ros.listen(Odometry, "odom"), ros.listen(JointState, "slip/imu")
    diagnostics, robot = ros.listen(DiagnosticArray, "/diagnostics"), Robot(ros, with_imu=False)
    robot.speed = 0.5
    ros.wait_for(lambda: robot.joints.get_subscription_count() > 1)
    robot.run(lambda: len(odom) > 40 and "no imu/data" in said(diagnostics))
    assert odom[-1].twist.twist.linear.x == pytest.approx(0.5, abs=1e-3)
    assert not slip
