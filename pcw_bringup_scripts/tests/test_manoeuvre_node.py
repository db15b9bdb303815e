"""The node that drives a manoeuvre, over real DDS, with a bridge that we play."""

import pytest

pytest.importorskip("rclpy")

from geometry_msgs.msg import TwistStamped  # noqa: E402
from rosgraph_msgs.msg import Clock  # noqa: E402
from sensor_msgs.msg import JointState  # noqa: E402
from std_srvs.srv import SetBool  # noqa: E402

from pcw_description.nodes.node_testing import RosTest  # noqa: E402
from pcw_description.nodes.node_tools import ns_to_stamp, stamp_to_ns  # noqa: E402

NODE = "pcw_bringup_scripts.nodes.manoeuvre"


class PlayedBridge:
    """Publishes /clock 20 ms apart while it is not paused."""

    def __init__(self, ros):
        self.ros, self.time_ns, self.asked = ros, 0, []
        self.clock = ros.peer.create_publisher(Clock, "/clock", 1)
        ros.peer.create_publisher(JointState, "joint_states", 1)
        ros.peer.create_service(SetBool, "bridge/pause", self._on_pause)

    def _on_pause(self, request, response):
        self.asked.append(request.data)
        response.success = True
        return response

    def tick(self):
        if self.asked and not self.asked[-1]:
            self.time_ns += 20_000_000
            self.clock.publish(Clock(clock=ns_to_stamp(self.time_ns)))


def test_lets_the_bridge_run_drives_in_its_time_and_pauses_it_again():
    with RosTest() as ros:
        bridge, commands = PlayedBridge(ros), ros.listen(TwistStamped, "cmd_vel")
        node = ros.start(NODE, "-p", "manoeuvre:=holdout", "-p", "duration:=10.0")
        ros.wait_for(lambda: node.process.poll() is not None, while_doing=bridge.tick, every=0.001)
        assert node.wait() == 0
        assert bridge.asked == [False, True]
        assert 9.9e9 < bridge.time_ns < 12.0e9
        assert any(c.twist.linear.x or c.twist.linear.y or c.twist.angular.z for c in commands)
        last = commands[-1].twist
        assert (last.linear.x, last.linear.y, last.angular.z) == (0.0, 0.0, 0.0)
        stamps = [stamp_to_ns(c.header.stamp) for c in commands]
        assert stamps == sorted(stamps) and {c.header.frame_id for c in commands} == {"base_link"}


def test_falls_silent_where_the_motors_shall_be_off():
    with RosTest() as ros:
        bridge, commands = PlayedBridge(ros), ros.listen(TwistStamped, "cmd_vel")
        node = ros.start(NODE, "-p", "manoeuvre:=coast_down", "-p", "duration:=10.0")
        ros.wait_for(lambda: node.process.poll() is not None, while_doing=bridge.tick, every=0.001)
        assert node.wait() == 0
        assert bridge.asked == [False, True] and bridge.time_ns > 9.9e9
        last = commands[-1]
        assert 4.5e9 < stamp_to_ns(last.header.stamp) < 5.5e9 and last.twist.linear.x > 0.3


@pytest.mark.parametrize(
    ("parameter", "complaint"),
    [("duration:=5.0", "allowed: 10 to 3600 s"), ("manoeuvre:=figure9", "figure8"), ("robot:=thesos", "'thesis'?")],
)
def test_what_cannot_be_driven_ends_it_with_one_line(parameter, complaint):
    with RosTest() as ros:
        node = ros.start(NODE, "-p", parameter)
        assert node.wait() == 2
        assert complaint in node.log and "Traceback" not in node.log


def test_waits_for_who_shall_listen_and_gives_up_with_their_names():
    with RosTest() as ros:
        bridge = PlayedBridge(ros)
        node = ros.start(NODE, "-p", "wait_for:=[recorder]", "-p", "patience:=2.0")
        assert node.wait() == 2
        assert "missing: recorder on joint_states" in node.log
        assert bridge.asked == []


def test_interrupted_it_leaves_a_command_to_stand():
    with RosTest() as ros:
        bridge, commands = PlayedBridge(ros), ros.listen(TwistStamped, "cmd_vel")
        node = ros.start(NODE)
        moving = lambda: commands and any((commands[-1].twist.linear.x, commands[-1].twist.angular.z))  # noqa: E731
        ros.wait_for(moving, while_doing=bridge.tick, every=0.002)
        assert node.interrupt() == 0
        ros.wait_for(lambda: not commands[-1].twist.linear.x and not commands[-1].twist.angular.z)
