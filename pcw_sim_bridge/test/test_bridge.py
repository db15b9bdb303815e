"""The bridge as a process over real DDS: topics, rates, services, commands, lock-step."""

import math
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

pytest.importorskip("rclpy")

from diagnostic_msgs.msg import DiagnosticArray  # noqa: E402
from geometry_msgs.msg import WrenchStamped  # noqa: E402
from nav_msgs.msg import Odometry  # noqa: E402
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue  # noqa: E402
from rcl_interfaces.srv import GetParameters, SetParameters  # noqa: E402
from rosgraph_msgs.msg import Clock  # noqa: E402
from sensor_msgs.msg import Imu, JointState  # noqa: E402
from std_srvs.srv import SetBool, Trigger  # noqa: E402

from pcw_description import load_robot, shipped_robots  # noqa: E402
from pcw_description.nodes.node_testing import RosTest  # noqa: E402
from pcw_description.nodes.node_tools import stamp_to_ns  # noqa: E402

BRIDGE = "pcw_sim_bridge.nodes.bridge"
THESIS = load_robot("thesis")
NAMES = list(THESIS.joint_names)
PERIOD_NS = 2_000_000  # of the thesis robot's joint_states


@pytest.fixture
def ros():
    with RosTest() as ros:
        yield ros


def stamps(messages):
    return [stamp_to_ns(message.header.stamp) for message in messages]


class Commander:
    """Answers every joint_states with a command of the fields given, and remembers what it saw."""

    def __init__(self, ros, **fields):
        self.fields, self.states = fields, []
        self.publisher = ros.peer.create_publisher(JointState, "joint_commands", 10)
        ros.peer.create_subscription(JointState, "joint_states", self._answer, 1000)

    def _answer(self, state):
        self.states.append(state)
        if self.fields is not None:
            message = JointState(**{"name": NAMES, **self.fields})
            message.header.stamp = state.header.stamp
            self.publisher.publish(message)


def drive_torques(state):
    return np.array(state.effort[0::2])


def test_a_robot_at_rest_reports_everything_at_its_rates(ros):
    bridge = ros.start(BRIDGE, "-p", "robot:=thesis", "-p", "real_time_factor:=1.0")
    joints, imu = ros.listen(JointState, "joint_states"), ros.listen(Imu, "imu/data")
    truth, clock = ros.listen(Odometry, "ground_truth/odom"), ros.listen(Clock, "/clock")
    contact = ros.listen(WrenchStamped, "contact/rear_left/wrench")
    ros.wait_for(lambda: len(truth) > 50 and len(contact) > 50 and len(imu) > 100 and len(joints) > 250)

    for messages, period in ((joints, 2e6), (imu, 5e6), (truth, 10e6), (contact, 10e6)):
        differences = np.diff(stamps(messages[-50:]))
        assert np.all(differences == period), (type(messages[0]), set(differences))
    assert joints[-1].name == NAMES
    assert np.abs(joints[-1].position).max() < 1e-3 and np.abs(joints[-1].velocity).max() < 0.05
    assert imu[-1].linear_acceleration.z == pytest.approx(9.81, abs=0.2)
    assert imu[-1].header.frame_id == "imu_link" and imu[-1].orientation_covariance[0] == -1.0
    assert truth[-1].header.frame_id == "map" and truth[-1].child_frame_id == "base_link"
    assert contact[-1].header.frame_id == "rear_left_fork"
    assert contact[-1].wrench.force.z == pytest.approx(THESIS.total_mass * 9.81 / 4, rel=0.2)  # the wheels trail to one side
    assert np.all(np.diff([stamp_to_ns(message.clock) for message in clock[-50:]]) == 10e6)
    assert bridge.interrupt() == 0


def test_pause_step_reset(ros):
    ros.start(BRIDGE, "-p", "real_time_factor:=1.0", "-p", "start_paused:=true", "-p", "step_duration:=0.01")
    joints = ros.listen(JointState, "joint_states")

    refused = ros.call(SetBool, "bridge/pause", SetBool.Request(data=True))
    assert refused.success and refused.message == "paused"
    ros.spin_for(0.3)
    assert joints == []

    stepped = ros.call(Trigger, "bridge/step")
    assert stepped.success and stepped.message == "time 0.010000 s"
    ros.wait_for(lambda: len(joints) == 6)
    assert stamps(joints) == [k * PERIOD_NS for k in range(6)]

    ros.call(SetBool, "bridge/pause", SetBool.Request(data=False))
    ros.wait_for(lambda: len(joints) > 50)
    refused = ros.call(Trigger, "bridge/step")
    assert not refused.success and "pause it first" in refused.message

    ros.call(SetBool, "bridge/pause", SetBool.Request(data=True))
    assert ros.call(Trigger, "bridge/reset").success
    ros.wait_for(lambda: stamps(joints)[-1] == 0)
    assert ros.call(Trigger, "bridge/step").message == "time 0.010000 s"


def test_torque_moves_the_robot_and_ends_at_the_timeout(ros):
    ros.start(BRIDGE, "-p", "real_time_factor:=1.0", "-p", "command_timeout:=0.05", "-p", "plant:=reduced")
    commander = Commander(ros, effort=[1.0, 0.0] * 4)
    truth, diagnostics = ros.listen(Odometry, "ground_truth/odom"), ros.listen(DiagnosticArray, "/diagnostics")
    ros.wait_for(lambda: truth and truth[-1].twist.twist.linear.x > 0.05)
    assert drive_torques(commander.states[-1]) == pytest.approx(1.0, abs=0.2)

    commander.fields = None
    ros.wait_for(lambda: np.abs(drive_torques(commander.states[-1])).max() < 0.2)
    ros.wait_for(lambda: any("command_timeout" in s.message for d in diagnostics for s in d.status))


UNUSABLE_COMMANDS = [
    ({"effort": [math.nan] * 8}, "NaN or infinity"),
    ({"effort": [1.0] * 8, "velocity": [1.0] * 8}, "both of effort and velocity set"),
    ({}, "none of effort and velocity set"),
    ({"name": NAMES[:7], "effort": [1.0] * 7}, "allowed: each of"),
    ({"name": NAMES[:7] + ["nose"], "effort": [1.0] * 8}, "'nose'"),
    ({"effort": [1.0] * 5}, "5 values of effort"),
]


def test_a_command_it_cannot_use_is_zero_torque_and_said(ros):
    bridge = ros.start(BRIDGE, "-p", "real_time_factor:=1.0")
    commander = Commander(ros)
    diagnostics = ros.listen(DiagnosticArray, "/diagnostics")
    for fields, reason in UNUSABLE_COMMANDS:
        commander.fields = {"effort": [1.0, 0.0] * 4}
        ros.wait_for(lambda: commander.states and drive_torques(commander.states[-1]).min() > 0.5)
        diagnostics.clear()
        commander.fields = fields
        ros.wait_for(lambda: np.abs(drive_torques(commander.states[-1])).max() < 0.2)
        ros.wait_for(lambda: any(reason in s.message for d in diagnostics for s in d.status))  # noqa: B023
    assert bridge.process.poll() is None


def test_velocity_commands_turn_the_wheels(ros):
    ros.start(BRIDGE, "-p", "real_time_factor:=1.0")
    commander = Commander(ros, velocity=[4.0, 0.0] * 4)
    ros.wait_for(
        lambda: commander.states and np.abs(np.array(commander.states[-1].velocity[0::2]) - 4.0).max() < 0.1
    )


def run_in_lockstep(seed, lateness, *parameters):
    """Stamps and readings of 300 control periods against a commander that takes its time."""
    with RosTest() as ros:
        more = [argument for parameter in parameters for argument in ("-p", parameter)]
        ros.start(BRIDGE, "-p", "lockstep:=true", "-p", "real_time_factor:=0.0", "-p", f"seed:={seed}", *more)
        states = []
        publisher = ros.peer.create_publisher(JointState, "joint_commands", 10)

        def answer(state):
            states.append(state)
            time.sleep(lateness * (len(states) % 3))
            effort = 0.5 * math.sin(0.03 * len(states)) - 0.1 * state.velocity[0]
            message = JointState(name=NAMES, effort=[effort, 0.0] * 4)
            message.header.stamp = state.header.stamp
            publisher.publish(message)

        ros.peer.create_subscription(JointState, "joint_states", answer, 1000)
        ros.wait_for(lambda: len(states) >= 300)
        return np.array(stamps(states[:300])), np.array([[*s.position, *s.velocity, *s.effort] for s in states[:300]])


def test_lockstep_gives_the_same_result_bit_by_bit_however_long_the_answers_take():
    (stamp, prompt), (_, late) = run_in_lockstep(5, 0.0), run_in_lockstep(5, 0.004)
    np.testing.assert_array_equal(stamp, np.arange(300) * PERIOD_NS)
    np.testing.assert_array_equal(prompt, late)
    assert np.abs(prompt[-1, 0]) > 1e-3  # it did move
    assert not np.array_equal(prompt, run_in_lockstep(6, 0.0)[1])


def test_lockstep_holds_with_jittered_stamps_and_lost_messages():
    """A stamp before its time is still answered, and a joint_states that nobody got is not waited for: either would cost the
    lockstep_timeout each time.
    """
    parameters = ("stamp_jitter:=0.0003", "loss:=0.2", "lockstep_timeout:=60.0")
    (stamp, prompt), (late_stamp, late) = run_in_lockstep(5, 0.0, *parameters), run_in_lockstep(5, 0.004, *parameters)
    np.testing.assert_array_equal(stamp, late_stamp)
    np.testing.assert_array_equal(prompt, late)
    assert np.all(np.diff(stamp) > 0)
    periods = np.round(stamp / PERIOD_NS).astype(int)
    assert np.std(stamp - periods * PERIOD_NS) == pytest.approx(0.0003e9, rel=0.2)
    assert 0.05 < 1.0 - len(periods) / (periods[-1] + 1) < 0.4


def test_lockstep_waits_for_a_controller_and_survives_its_end(ros):
    ros.start(BRIDGE, "-p", "lockstep:=true", "-p", "real_time_factor:=0.0", "-p", "lockstep_timeout:=0.1")
    joints, diagnostics = ros.listen(JointState, "joint_states"), ros.listen(DiagnosticArray, "/diagnostics")
    ros.wait_for(lambda: any("waits for a controller" in s.message for d in diagnostics for s in d.status))
    assert joints == []
    commander = Commander(ros, effort=[1.0, 0.0] * 4)
    ros.wait_for(lambda: len(commander.states) > 100 and drive_torques(commander.states[-1]).min() > 0.5)
    commander.fields = None
    at_the_end = len(commander.states)
    # Each period now waits in vain; after command_timeout, 50 periods, the torque is zero.
    ros.wait_for(lambda: np.abs(drive_torques(commander.states[-1])).max() < 0.2)
    assert len(commander.states) > at_the_end + 50


def test_lockstep_at_a_pace_goes_on_after_a_reading_that_nobody_answers(ros):
    """Longer than the lag after which the pace begins anew."""
    ros.start(BRIDGE, "-p", "lockstep:=true", "-p", "real_time_factor:=1.0", "-p", "lockstep_timeout:=0.3")
    ros.peer.create_publisher(JointState, "joint_commands", 1)
    joints = ros.listen(JointState, "joint_states")
    ros.wait_for(lambda: len(joints) > 3)


def test_refused_parameter_keeps_the_old_value(ros):
    ros.start(BRIDGE, "-p", "real_time_factor:=2.0")

    def set_factor(value):
        parameter = Parameter(
            name="real_time_factor", value=ParameterValue(type=ParameterType.PARAMETER_DOUBLE, double_value=value)
        )
        [result] = ros.call(SetParameters, "bridge/set_parameters", SetParameters.Request(parameters=[parameter])).results
        [found] = ros.call(GetParameters, "bridge/get_parameters", GetParameters.Request(names=["real_time_factor"])).values
        return result, found.double_value

    result, value = set_factor(-1.0)
    assert not result.successful and "real_time_factor" in result.reason and value == 2.0
    result, value = set_factor(math.nan)
    assert not result.successful and value == 2.0
    result, value = set_factor(3.0)
    assert result.successful and value == 3.0


@pytest.mark.parametrize(
    ("parameter", "complaint"),
    [
        ("robot:=/no/such/robot.yaml", "/no/such/robot.yaml"),
        ("plant:=bullet", "did you mean 'pybullet'?"),
        ("dt:=0.1", "dt"),
        ("robot:=mpo700", "torque control"),
    ],
)
def test_bad_input_ends_it_with_one_line(parameter, complaint):
    if parameter == "robot:=mpo700" and "mpo700" not in shipped_robots():
        pytest.skip("no such robot here")
    result = subprocess.run(
        [sys.executable, "-m", BRIDGE, "--ros-args", "-p", parameter], capture_output=True, text=True, timeout=120
    )
    assert result.returncode == 2
    assert complaint in result.stderr and "Traceback" not in result.stderr
    assert len(result.stderr.strip().splitlines()) == 1


def test_sigterm_ends_it_in_order(ros):
    bridge = ros.start(BRIDGE)
    joints = ros.listen(JointState, "joint_states")
    ros.wait_for(lambda: joints)
    assert bridge.interrupt(signal.SIGTERM) == 0
