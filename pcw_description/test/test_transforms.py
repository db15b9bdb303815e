"""The transforms node as a process over real DDS.

Where tf2_msgs is not installed, a stand-in takes its place that sends the same transforms as JSON in a String: so the node is
tested there too, down to what it puts on the wire.
"""

from __future__ import annotations

import importlib.util
import json
import math
import os
import subprocess
import sys

import numpy as np
import pytest

pytest.importorskip("rclpy")

from diagnostic_msgs.msg import DiagnosticArray  # noqa: E402
from nav_msgs.msg import Odometry  # noqa: E402
from sensor_msgs.msg import JointState  # noqa: E402
from std_msgs.msg import String  # noqa: E402

from pcw_description import load_robot  # noqa: E402
from pcw_description.nodes.node_testing import RosTest  # noqa: E402
from pcw_description.nodes.node_tools import ns_to_stamp, stamp_to_ns  # noqa: E402

TRANSFORMS = "pcw_description.nodes.transforms"
THESIS = load_robot("thesis")
HAS_TF2 = importlib.util.find_spec("tf2_msgs") is not None
STAND_IN = """
import json
from std_msgs.msg import String

type(String).__import_type_support__()  # of String itself: what is published is one

class OfStrings(type(String)):
    def __instancecheck__(cls, message):
        return type(message) is String

class TFMessage(String, metaclass=OfStrings):
    def __new__(cls, transforms):
        return String(data=json.dumps([as_list(transform) for transform in transforms]))

def as_list(t):
    p, q, stamp = t.transform.translation, t.transform.rotation, t.header.stamp
    time = stamp.sec * 1_000_000_000 + stamp.nanosec
    return [t.header.frame_id, t.child_frame_id, time, [p.x, p.y, p.z], [q.x, q.y, q.z, q.w]]
"""


class Viewer:
    """Hears what a transforms node says, and gives it a robot that stands still and a pose in two streams."""

    def __init__(self, ros, folder):
        self.ros, self.time_ns, self.position = ros, 1_000_000_000, np.linspace(-1.0, 1.0, 2 * THESIS.n)
        if not HAS_TF2:
            (folder / "tf2_msgs").mkdir()
            (folder / "tf2_msgs/__init__.py").touch()
            (folder / "tf2_msgs/msg.py").write_text(STAND_IN)
            ros.environment["PYTHONPATH"] = os.pathsep.join(filter(None, [str(folder), ros.environment.get("PYTHONPATH")]))
        self.states = ros.peer.create_publisher(JointState, "joint_states", 10)
        self.odom = ros.peer.create_publisher(Odometry, "odom", 10)
        self.truth = ros.peer.create_publisher(Odometry, "ground_truth/odom", 10)
        if HAS_TF2:
            from tf2_msgs.msg import TFMessage

            self._messages = ros.listen(TFMessage, "/tf")
        else:
            self._messages = ros.listen(String, "/tf")

    def frames(self):
        """(parent, child, time, position, quaternion) of every transform so far."""
        if not HAS_TF2:
            return [tuple(frame) for message in self._messages for frame in json.loads(message.data)]
        found = []
        for message in self._messages:
            for t in message.transforms:
                p, q = t.transform.translation, t.transform.rotation
                found.append(
                    (t.header.frame_id, t.child_frame_id, stamp_to_ns(t.header.stamp), [p.x, p.y, p.z], [q.x, q.y, q.z, q.w])
                )
        return found

    def publish(self):
        """Joints, odom at (1, 0, 0.1) and the truth at (2, 3, 0.1 + pi/2); the truth drives on by 1 m/s, and odom with it."""
        self.time_ns += 10_000_000
        state = JointState(name=list(THESIS.joint_names), position=self.position.tolist())
        state.header.stamp = ns_to_stamp(self.time_ns)
        self.states.publish(state)
        along = self.time_ns * 1e-9
        self.odom.publish(pose("odom", self.time_ns, 1.0 + along, 0.0, 0.1))
        # 4 ms later, as streams of different rates are: at that time it has come 4 mm further.
        self.truth.publish(pose("map", self.time_ns + 4_000_000, 2.0, 3.0 + along + 0.004, 0.1 + 0.5 * math.pi))

    def wait_for(self, condition):
        self.ros.wait_for(lambda: condition(self.frames()), while_doing=self.publish)
        return self.frames()


def pose(frame, time_ns, x, y, yaw):
    message = Odometry(child_frame_id="base_link")
    message.header.frame_id, message.header.stamp = frame, ns_to_stamp(time_ns)
    message.pose.pose.position.x, message.pose.pose.position.y = x, y
    message.pose.pose.orientation.z, message.pose.pose.orientation.w = math.sin(0.5 * yaw), math.cos(0.5 * yaw)
    return message


def yaw_of(quaternion):
    return 2.0 * math.atan2(quaternion[2], quaternion[3])


@pytest.fixture
def ros():
    with RosTest() as ros:
        yield ros


@pytest.fixture
def viewer(ros, tmp_path):
    return Viewer(ros, tmp_path)


def test_links_follow_the_joints_and_odom_its_drift(ros, viewer):
    node = ros.start(TRANSFORMS)
    frames = viewer.wait_for(lambda frames: {"map", "base_link", "rear_left_fork"} <= {frame[0] for frame in frames})
    links = {child: parent for parent, child, *_ in frames if parent != "map"}
    expected = {f"{name}_fork": "base_link" for name in THESIS.caster_names} | {"imu_link": "base_link"}
    assert links == expected | {f"{name}_wheel": f"{name}_fork" for name in THESIS.caster_names}
    # Each is stamped as the joints that it was computed from: on the 10 ms of the streams.
    [fork] = [frame for frame in frames if frame[1] == "rear_left_fork"][:1]
    index = THESIS.caster_index("rear_left")
    assert fork[2] % 10_000_000 == 0
    np.testing.assert_allclose(fork[3], [*THESIS.steer_axis[index], THESIS.wheel_radius[index]])
    assert yaw_of(fork[4]) == pytest.approx(viewer.position[2 * index + 1])

    # odom is turned by pi/2 and started 1 m along its x: both poses at one time give the same drift at all times.
    drift = [frame for frame in frames if frame[0] == "map"]
    assert {child for _, child, *_ in drift} == {"odom"}
    for *_, position, quaternion in drift:
        np.testing.assert_allclose(position, [2.0, 2.0, 0.0], atol=1e-6)
        assert yaw_of(quaternion) == pytest.approx(0.5 * math.pi)
    assert node.interrupt() == 0


@pytest.mark.parametrize(("base", "parent"), [("odom", "odom"), ("ground_truth", "map")])
def test_base_link_in_one_frame_and_no_links(ros, viewer, base, parent):
    ros.start(TRANSFORMS, "-p", f"base:={base}", "-p", "joints:=false")
    frames = viewer.wait_for(lambda frames: len(frames) > 3)
    assert {frame[:2] for frame in frames} == {(parent, "base_link")}
    for *_, time_ns, position, quaternion in frames:
        if base == "odom":
            np.testing.assert_allclose(position, [1.0 + time_ns * 1e-9, 0.0, 0.0], atol=1e-9)
            assert yaw_of(quaternion) == pytest.approx(0.1)
        else:
            np.testing.assert_allclose(position, [2.0, 3.0 + time_ns * 1e-9, 0.0], atol=1e-9)


def test_without_base_the_links_alone_and_only_those_that_are_known(ros, viewer):
    ros.start(TRANSFORMS, "-p", "base:=none")
    diagnostics = ros.listen(DiagnosticArray, "/diagnostics")
    viewer.position[1] = math.nan
    viewer.wait_for(lambda frames: frames and any("front_left_steer" in s.message for d in diagnostics for s in d.status))
    children = {child for _, child, *_ in viewer.frames()}
    assert "front_left_fork" not in children and {"front_right_fork", "front_left_wheel"} <= children
    assert not children & {"base_link", "odom"}
    assert np.isfinite([number for *_, position, turn in viewer.frames() for number in (*position, *turn)]).all()
    ros.spin_for(1.0)
    count = len(viewer.frames())
    ros.spin_for(1.0)
    assert len(viewer.frames()) == count  # each measurement once


def test_joints_of_others_hide_none_of_the_robot_and_are_no_problem(ros, viewer):
    """An arm on the same topic, if its message was the newest, took the links away, and each joint was missed in a warning."""
    ros.start(TRANSFORMS, "-p", "base:=none", "-p", "rate:=10.0")
    diagnostics = ros.listen(DiagnosticArray, "/diagnostics")

    def arm():
        state = JointState(name=["arm_1", "arm_2"], position=[0.1, 0.2])
        state.header.stamp = ns_to_stamp(viewer.time_ns + 1_000_000)
        viewer.states.publish(state)

    def both():
        viewer.publish()
        arm()

    ros.wait_for(lambda: len(viewer.frames()) > 20, while_doing=both)
    ros.wait_for(lambda: len(diagnostics) > 2, while_doing=both)
    assert "rear_left_fork" in {child for _, child, *_ in viewer.frames()}
    assert not any("no position of" in status.message or "arm_1" in status.message for d in diagnostics for status in d.status)
    told = "joint_states names arm_1, arm_2 and no joint of thesis"
    ros.wait_for(lambda: any(told in status.message for status in diagnostics[-1].status), while_doing=arm)


@pytest.mark.parametrize(
    ("parameter", "complaint"), [("robot:=/no/such/robot.yaml", "/no/such/robot.yaml"), ("base:=odmo", "did you mean 'odom'?")]
)
def test_bad_parameter_ends_it_with_one_line(viewer, ros, parameter, complaint):
    process = ros.start(TRANSFORMS, "-p", parameter)
    assert process.wait() == 2
    assert complaint in process.log and len(process.log.strip().splitlines()) == 1


@pytest.mark.skipif(HAS_TF2, reason="tf2_msgs is installed here")
def test_without_tf2_it_says_so_in_one_line():
    result = subprocess.run([sys.executable, "-m", TRANSFORMS], capture_output=True, text=True, timeout=120)
    assert result.returncode == 2
    assert "tf2_msgs" in result.stderr and len(result.stderr.strip().splitlines()) == 1
