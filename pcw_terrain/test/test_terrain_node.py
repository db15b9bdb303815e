"""The terrain node as a process over real DDS: what it publishes, and what it makes of every kind of bad input."""

import math
import subprocess
import sys

import numpy as np
import pytest

pytest.importorskip("rclpy")

from diagnostic_msgs.msg import DiagnosticArray  # noqa: E402
from nav_msgs.msg import OccupancyGrid, Odometry  # noqa: E402
from sensor_msgs.msg import JointState  # noqa: E402

from pcw_description import load_robot  # noqa: E402
from pcw_description.nodes.node_testing import RosTest  # noqa: E402
from pcw_description.nodes.node_tools import LATCHED, ns_to_stamp, stamp_to_ns  # noqa: E402
from pcw_terrain import RobotTerrain  # noqa: E402

THESIS = load_robot("thesis")
PERIOD = 0.002
MU, CRITICAL = 0.5, 0.12  # another ground than that of the robot file


@pytest.fixture
def ros():
    with RosTest() as ros:
        yield ros


class SlippingRobot:
    """Publishes joint_states, slip/observer and odom of a robot whose wheels slip to and fro, the tyre in steady state."""

    def __init__(self, ros):
        self.ros, self.time_ns, self.x, self.phase, self.roll = ros, 1_000_000_000, 0.0, 0.0, 0.0
        self.speed, self.force_sign, self.change = 0.8, 1.0, lambda message: message
        self.joints = ros.peer.create_publisher(JointState, "joint_states", 1000)
        self.slip = ros.peer.create_publisher(JointState, "slip/observer", 1000)
        self.odom = ros.peer.create_publisher(Odometry, "odom", 1000)
        self.loads, self.force = RobotTerrain(THESIS), np.zeros((4, 2))
        self.slip_names = [f"{c}_{d}" for c in THESIS.caster_names for d in ("longitudinal", "lateral")]

    def publish(self, periods=10):
        for _ in range(periods):
            self.time_ns += round(PERIOD * 1e9)
            # Slowly: at this speed the tyre relaxes in 25 ms, which is left out here.
            self.phase += 2.0 * PERIOD
            self.x += self.speed * PERIOD
            slip = 1.0 * CRITICAL * (1.0 - math.cos(self.phase))
            rolling = self.speed / (1.0 - slip)
            self.roll += rolling / 0.075 * PERIOD
            friction = self.force_sign * 2.0 * MU * CRITICAL * slip / (CRITICAL**2 + slip**2)
            for _ in range(3):  # what the wheels push tilts the robot, and loads them by that
                self.force[:, 0] = friction * self.loads.normal_force(np.zeros(4), self.force)
            stamp = ns_to_stamp(self.time_ns)
            odom = Odometry()
            odom.header.stamp, odom.header.frame_id = stamp, "odom"
            odom.pose.pose.position.x, odom.twist.twist.linear.x = self.x, self.speed
            odom.pose.pose.orientation.w = 1.0
            slips = JointState(name=self.slip_names)
            slips.header.stamp = stamp
            slips.position, slips.velocity = 4 * [slip, 0.0], 4 * [rolling - self.speed, 0.0]
            slips.effort = self.force.ravel().tolist()
            joints = JointState(name=list(THESIS.joint_names))
            joints.header.stamp = stamp
            joints.position, joints.velocity = 4 * [self.roll, 0.0], 4 * [rolling / 0.075, 0.0]
            joints.effort = (0.075 * self.force).ravel().tolist()
            self.odom.publish(odom)
            self.slip.publish(slips)
            changed = self.change(joints)
            if changed is not None:
                self.joints.publish(changed)

    def run(self, condition):
        self.ros.wait_for(lambda: self.joints.get_subscription_count() > 0 and self.slip.get_subscription_count() > 0)
        self.ros.wait_for(condition, while_doing=self.publish, every=0.01)


def start(ros, *parameters):
    node = ros.start("pcw_terrain.nodes.terrain", *parameters)
    return node, ros.listen(JointState, "terrain"), ros.listen(DiagnosticArray, "/diagnostics"), SlippingRobot(ros)


def said(diagnostics):
    return " ".join(s.message for d in diagnostics for s in d.status)


def values_of(diagnostics):
    return {v.key: v.value for s in diagnostics[-1].status for v in s.values} if diagnostics else {}


def finite(messages):
    return all(np.isfinite([*m.position, *m.velocity, *m.effort]).all() for m in messages)


def test_what_a_test_has_told_counts_until_the_wheel_itself_has_felt_its_ground(ros):
    """A test that has just ended is heard, and one of long ago, which a node that starts late is sent, is not."""
    _, terrain, diagnostics, robot = start(ros)
    grip, tested = ros.listen(JointState, "terrain/grip"), ros.peer.create_publisher(JointState, "terrain/tested", LATCHED)
    told = JointState(name=["front_left"], position=[0.15], effort=[0.6])
    told.header.stamp = ns_to_stamp(robot.time_ns)
    robot.time_ns += 30_000_000_000
    tested.publish(told)
    robot.run(lambda: len(terrain) > 5)
    assert all("front_left" not in m.name for m in terrain[:5])
    told.header.stamp = ns_to_stamp(robot.time_ns - 500_000_000)
    tested.publish(told)
    robot.run(lambda: terrain and list(terrain[-1].name) == ["front_left"])
    assert (terrain[-1].effort[0], terrain[-1].position[0]) == (0.6, 0.15) and len(terrain[-1].velocity) == 1
    robot.run(lambda: grip[-1].effort[0] == 0.6)
    robot.run(lambda: len(terrain[-1].name) == 4 and terrain[-1].effort[0] != 0.6)
    assert terrain[-1].effort[0] == pytest.approx(MU, rel=0.1)
    robot.run(lambda: values_of(diagnostics).get("known_by_tests") == "0")


def test_it_finds_the_ground_names_its_kind_and_draws_the_map(ros):
    node, terrain, diagnostics, robot = start(ros)
    maps = ros.listen(OccupancyGrid, "terrain/map")
    robot.run(lambda: terrain and len(terrain[-1].name) == 4 and maps and "ground known under 4" in said(diagnostics))
    last = terrain[-1]
    assert list(last.name) == list(THESIS.caster_names)
    np.testing.assert_allclose(last.effort, MU, rtol=0.08)
    np.testing.assert_allclose(last.position, CRITICAL, rtol=0.2)
    assert len(last.velocity) == 4 and finite(terrain)
    assert np.median(np.diff([stamp_to_ns(m.header.stamp) for m in terrain])) == 20e6
    assert maps[-1].header.frame_id == "odom" and maps[-1].info.resolution == pytest.approx(0.1)
    grid = np.array(maps[-1].data)
    assert set(np.unique(grid[grid >= 0])) <= set(range(35, 65)) and (grid == -1).any()
    ros.wait_for(lambda: any("%)" in s.message for d in diagnostics for s in d.status), while_doing=robot.publish)
    assert node.interrupt() == 0


def test_before_there_is_slip_it_knows_nothing_and_says_so(ros):
    _, terrain, diagnostics, robot = start(ros)
    robot.speed, robot.force_sign = 0.0, 0.0
    robot.run(lambda: len(terrain) > 20 and "ground known under 0" in said(diagnostics))
    assert all(len(m.name) == 0 for m in terrain)


def test_a_torque_of_the_wrong_sign_is_told(ros):
    _, terrain, diagnostics, robot = start(ros)
    robot.force_sign = -1.0
    robot.run(lambda: "wrong sign" in said(diagnostics))
    assert all(len(m.name) == 0 for m in terrain)


def test_nan_gaps_and_missing_joints_are_told_and_nothing_of_it_is_sent(ros):
    _, terrain, diagnostics, robot = start(ros)
    robot.run(lambda: len(terrain) > 5)

    def with_nan(message):
        message.velocity[0] = math.nan
        return message

    robot.change = with_nan
    robot.run(lambda: "velocity of front_left_drive is NaN" in said(diagnostics))
    assert int(values_of(diagnostics)["unusable_joint_states"]) > 0
    robot.change = lambda message: message
    robot.publish()
    robot.time_ns += 1_000_000_000
    robot.publish()
    robot.run(lambda: int(values_of(diagnostics).get("gaps", 0)) >= 1)
    robot.time_ns -= 500_000_000
    robot.run(lambda: int(values_of(diagnostics).get("backward_jumps", 0)) >= 1)
    count = len(terrain)
    robot.run(lambda: len(terrain) > count + 5)
    assert finite(terrain)


@pytest.mark.nightly  # two processes
def test_without_an_observer_it_says_what_it_waits_for_and_takes_odom_where_told(ros):
    _, _, diagnostics, robot = start(ros)
    ros.wait_for(lambda: "no joint_states" in said(diagnostics) or "no slip/observer" in said(diagnostics))
    other, _, _, _ = start(ros, "-p", "source:=odom", "-r", "__node:=by_odom", "-r", "terrain:=terrain_by_odom")
    found = ros.listen(JointState, "terrain_by_odom")
    robot.run(lambda: found and len(found[-1].name) == 4)
    assert other.process.poll() is None


@pytest.mark.parametrize(
    ("parameter", "mentioned"),
    [("robot:=mpo700", "caster_offset"), ("source:=guess", "source"), ("map_resolution:=0.0", "map_resolution")],
)
def test_what_cannot_work_ends_it_with_one_line(parameter, mentioned):
    result = subprocess.run(
        [sys.executable, "-m", "pcw_terrain.nodes.terrain", "--ros-args", "-p", parameter],
        capture_output=True, text=True, timeout=120,
    )  # fmt: skip
    assert result.returncode == 2
    assert mentioned in result.stderr and len(result.stderr.strip().splitlines()) == 1
