"""The controller that tests the ground on request, with a plant in lock-step, as processes over real DDS."""

import dataclasses
import re

import numpy as np
import pytest

pytest.importorskip("rclpy")

from diagnostic_msgs.msg import DiagnosticArray  # noqa: E402
from geometry_msgs.msg import TwistStamped  # noqa: E402
from lifecycle_msgs.msg import Transition  # noqa: E402
from lifecycle_msgs.srv import ChangeState  # noqa: E402
from nav_msgs.msg import Odometry  # noqa: E402
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue  # noqa: E402
from rcl_interfaces.srv import SetParameters  # noqa: E402
from rosgraph_msgs.msg import Clock  # noqa: E402
from sensor_msgs.msg import JointState  # noqa: E402
from std_srvs.srv import Trigger  # noqa: E402

from pcw_description import load_robot  # noqa: E402
from pcw_description.nodes.node_testing import RosTest  # noqa: E402
from pcw_description.nodes.node_tools import LATCHED, ns_to_stamp, stamp_to_ns  # noqa: E402
from pcw_description.robot_file import save_robot  # noqa: E402
from pcw_sim_bridge.ground_test import GroundTest  # noqa: E402
from pcw_sim_bridge.nodes.ground_test_messages import caster_parts  # noqa: E402
from pcw_sim_bridge.terrain_study import on_ground  # noqa: E402
from pcw_terrain.active_identification import Refusal  # noqa: E402

THESIS = load_robot("thesis")
CASTERS = list(THESIS.caster_names)
MU, CRITICAL = 0.5, 0.12  # of the ground; the robot file, which the controller believes in, has 0.8 and 0.1
SPEED = 0.3
NAME = "ground_test_controller"


class Drive:
    """Commands a twist in the time of joint_states, and keeps what the nodes say."""

    def __init__(self, ros):
        self.ros, self.speed, self.torque = ros, None, np.zeros((4, 2))
        self.truth, self.ahead_ns = [], 0
        self.clock = ros.peer.create_publisher(Clock, "test_clock", 1)
        self.tested = ros.listen(JointState, "terrain/tested", LATCHED)
        self.diagnostics = ros.listen(DiagnosticArray, "/diagnostics")
        self.cmd_vel = ros.peer.create_publisher(TwistStamped, "cmd_vel", 1)
        ros.peer.create_subscription(Odometry, "ground_truth/odom", self._on_truth, 1000)
        ros.peer.create_subscription(JointState, "joint_commands", self._on_command, 1)

    def _on_truth(self, message):
        self.truth.append(message)
        self.clock.publish(Clock(clock=ns_to_stamp(stamp_to_ns(message.header.stamp) + self.ahead_ns)))
        if len(self.truth) % 5 == 0 and self.speed is not None:
            command = TwistStamped()
            command.twist.linear.x = self.speed
            self.cmd_vel.publish(command)

    def _on_command(self, message):
        self.torque = np.array(message.effort).reshape(4, 2)

    def statuses(self, name):
        """All statuses of a name, oldest first."""
        return [s for d in self.diagnostics for s in d.status if s.name == f"{NAME}: {name}"]

    def says(self, name, text):
        found = [s for s in self.statuses(name) if text in s.message]
        return found[-1] if found else None

    def speed_now(self):
        return self.truth[-1].twist.twist.linear.x if self.truth else 0.0

    def under_way(self):
        """Drive, and wait until that is steady."""
        self.speed = SPEED
        self.ros.wait_for(lambda: abs(self.speed_now() - SPEED) < 0.005)
        self.passes(0.5)

    def passes(self, duration):
        """Wait until so much simulated time has passed [s]."""
        since = len(self.truth)
        self.ros.wait_for(lambda: len(self.truth) > since + 100 * duration)

    def ask(self, service="identify_ground"):
        return self.ros.call(Trigger, service)

    def change_to(self, controller):
        value = ParameterValue(type=ParameterType.PARAMETER_STRING, string_value=controller)
        request = SetParameters.Request(parameters=[Parameter(name="controller", value=value)])
        return self.ros.call(SetParameters, f"{NAME}/set_parameters", request).results[0].successful

    def first_slips(self):
        """Wait until the first wheel has been slipping for 0.2 s."""
        self.ros.wait_for(lambda: self.torque_apart() > 1.0)
        self.passes(0.2)

    def torque_apart(self):
        """By how much the drives differ from each other [N m]: on a straight line only a test makes them."""
        return float(np.ptp(self.torque[:, 0]))


@pytest.fixture
def drive(tmp_path):
    save_robot(on_ground(THESIS, MU, CRITICAL), tmp_path / "real.yaml")
    with RosTest() as ros:
        drive = Drive(ros)
        # On a busy machine an answer may take its time, and the plant waits for it.
        ros.start(
            "pcw_sim_bridge.nodes.ground_test_controller", "-p", "cmd_vel_timeout:=2.0", "-p", "joint_states_timeout:=30.0",
            "-p", "ground_test.replay:=20", "-p", "use_sim_time:=true", "-r", "/clock:=/test_clock",
        )  # fmt: skip
        ros.start(
            "pcw_sim_bridge.nodes.bridge", "-p", f"robot:={tmp_path / 'real.yaml'}", "-p", "lockstep:=true",
            "-p", "real_time_factor:=1.0", "-p", "lockstep_timeout:=3.0",
        )  # fmt: skip
        yield drive


def place(message):
    q = message.pose.pose.orientation
    return np.array([message.pose.pose.position.x, message.pose.pose.position.y, 2.0 * np.arctan2(q.z, q.w)])


def test_the_ground_is_found_while_the_robot_drives_and_keeps_its_path(drive):
    """Nobody was told the ground. It is asked for at 0.3 m/s; all casters are found, and the base stays within 5 mm."""
    drive.passes(0.1)
    standing = drive.ask()
    assert not standing.success and "follows no cmd_vel" in standing.message
    drive.under_way()
    begun = len(drive.truth)
    answer = drive.ask()
    assert answer.success, answer.message
    assert all(name in answer.message for name in CASTERS)
    predicted = float(re.findall(r"up to ([\d.]+) mm", answer.message)[0])
    again = drive.ask()
    assert not again.success and "goes on" in again.message
    done = drive.ros.wait_for(lambda: drive.says("ground test", "done") or drive.says("ground test", "ended"))
    assert done.message == "done; ground known under 4 of 4 casters"
    drive.ros.wait_for(lambda: drive.tested and list(drive.tested[-1].name) == CASTERS)
    found, values = drive.tested[-1], {v.key: float(v.value) for v in done.values if v.key != "phase"}
    assert np.array(found.effort) == pytest.approx(MU, rel=0.10)
    assert np.median(np.abs(np.array(found.position) / CRITICAL - 1.0)) < 0.12
    assert [list(m.name) for m in drive.tested] == [CASTERS[: i + 1] for i in range(4)]
    stamps = [stamp_to_ns(m.header.stamp) for m in drive.tested]
    assert stamps == sorted(set(stamps))
    for name in CASTERS:
        part = {v.key: float(v.value) for v in drive.statuses(name)[-1].values}
        assert part["mu_p_low"] < part["mu_p"] < part["mu_p_high"]
    way = np.array([[stamp_to_ns(m.header.stamp) * 1e-9, *place(m)] for m in drive.truth[begun:]])
    # Off the line along which it moved before, at the speed of the command.
    along = way[:, 1] - way[0, 1] - SPEED * (way[:, 0] - way[0, 0])
    assert np.hypot(along, way[:, 2] - way[0, 2]).max() <= 0.005
    assert 0.0 < values["measured_path"] <= 0.005 and 1e3 * values["predicted_path"] == pytest.approx(predicted, abs=0.06)


def test_cancelled_and_changed_requests_bring_the_wheel_back(drive):
    """First by the service, then by another cmd_vel: the robot follows that one at once."""
    drive.under_way()
    assert not drive.ask("cancel_identification").success
    assert drive.ask().success
    drive.first_slips()
    assert drive.ask("cancel_identification").success
    drive.ros.wait_for(lambda: drive.says("ground test", "ended: cancelled"))
    drive.ros.wait_for(lambda: drive.torque_apart() < 0.5)
    drive.ros.wait_for(lambda: drive.ask().success)
    drive.first_slips()
    drive.speed = 0.0
    drive.ros.wait_for(lambda: drive.says("ground test", "ended: something else is commanded"))
    drive.ros.wait_for(lambda: abs(drive.speed_now()) < 0.005)
    standing = drive.ask()
    assert not standing.success and "too slow" in standing.message


def test_answers_that_come_late_cancel_the_test(drive):
    """By the node's clock, which this test sets forward."""
    drive.under_way()
    assert drive.ask().success
    drive.first_slips()
    drive.ahead_ns = 50_000_000
    late = drive.ros.wait_for(lambda: drive.says("ground test", "ms old as they are answered"))
    assert late.message.startswith("ended: joint_states are")


def test_nothing_is_added_after_deactivation(drive):
    drive.under_way()
    assert drive.ask().success
    drive.first_slips()
    request = ChangeState.Request(transition=Transition(id=Transition.TRANSITION_DEACTIVATE))
    assert drive.ros.call(ChangeState, f"{NAME}/change_state", request).success
    drive.ros.wait_for(lambda: not drive.torque.any())
    drive.ros.wait_for(lambda: drive.says("ground test", "ended: not active"))
    answer = drive.ask()
    assert not answer.success and answer.message == "not active"


def test_a_jump_of_the_stamps_and_a_command_that_falls_silent_end_the_test(drive):
    drive.under_way()
    assert drive.ask().success
    drive.first_slips()
    assert drive.ask("bridge/reset").success
    drive.ros.wait_for(lambda: drive.says("ground test", "ended: no time step"))
    drive.ros.wait_for(lambda: abs(drive.speed_now()) < 0.1)
    drive.under_way()
    assert drive.ask().success
    drive.first_slips()
    drive.speed = None
    drive.ros.wait_for(lambda: drive.says("ground test", "ended: no cmd_vel within cmd_vel_timeout"))
    drive.ros.wait_for(lambda: not drive.torque.any())
    answer = drive.ask()
    assert not answer.success and "follows no cmd_vel" in answer.message


def test_another_controller_ends_the_test(drive):
    """Nothing is added to the new one's torques, and what was added to the old one's is not handed over."""
    drive.under_way()
    assert drive.ask().success
    drive.first_slips()
    assert drive.change_to("jacobian_pseudo_inverse")
    drive.ros.wait_for(lambda: drive.says("ground test", "ended: the controller was changed"))
    drive.under_way()
    assert drive.torque_apart() < 0.5
    assert drive.change_to("resolved_motion_rate")
    drive.passes(0.1)
    answer = drive.ask()
    assert not answer.success and "controller = 'resolved_motion_rate' is not allowed" in answer.message
    assert not drive.tested or not drive.tested[-1].name


def test_a_caster_that_is_asked_again_waits_and_is_not_left_out_yet():
    test = GroundTest(THESIS)
    state = test.request(test.initial_state())
    testing = dataclasses.replace(state.testing, queue=(1, 0), refused=((0, Refusal.TORQUE), (3, Refusal.TOO_SLOW)))
    parts = caster_parts(THESIS.caster_names, dataclasses.replace(state, testing=testing))
    said = [parts[name].message for name in THESIS.caster_names]
    assert said[0] == f"waits until the others have told of the ground: {Refusal.TORQUE.value}"
    assert said[1:3] == ["not tested yet", "not tested yet"]
    assert said[3] == f"left out: {Refusal.TOO_SLOW.value}"
