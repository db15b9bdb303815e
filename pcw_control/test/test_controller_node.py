"""The controller as a process over real DDS: it drives, and it lets go of the robot whenever in doubt."""

import math
import re
import signal
import subprocess
import sys

import numpy as np
import pytest

pytest.importorskip("rclpy")

from diagnostic_msgs.msg import DiagnosticArray  # noqa: E402
from geometry_msgs.msg import PoseStamped, TwistStamped, WrenchStamped  # noqa: E402
from lifecycle_msgs.msg import Transition  # noqa: E402
from lifecycle_msgs.srv import ChangeState, GetState  # noqa: E402
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue  # noqa: E402
from rcl_interfaces.srv import GetParameters, SetParameters  # noqa: E402
from sensor_msgs.msg import JointState  # noqa: E402

from pcw_control.force_guided import ForceGuidedParameters  # noqa: E402
from pcw_description import inverse_kinematics, load_robot  # noqa: E402
from pcw_description.nodes.node_testing import RosTest  # noqa: E402
from pcw_description.nodes.node_tools import ns_to_stamp, stamp_to_ns  # noqa: E402

CONTROLLER = "pcw_control.nodes.controller"
THESIS = load_robot("thesis")
NAMES = list(THESIS.joint_names)
PERIOD_NS = 2_000_000


@pytest.fixture
def ros():
    with RosTest() as ros:
        yield ros


class Robot:
    """An ideal robot that publishes joint_states 2 ms apart, one for each command it gets, and cmd_vel.

    It follows the force of the last torque as if it were a mass on ice; the tests care for what the controller sends.
    """

    def __init__(self, ros, target=(0.3, 0.0, 0.0)):
        self.ros, self.target = ros, target
        self.time_ns, self.twist, self.position = -PERIOD_NS, np.zeros(3), np.zeros((4, 2))
        self.commands, self.bad_velocity, self.bad_position = [], False, False
        self.states = ros.peer.create_publisher(JointState, "joint_states", 10)
        self.cmd_vel = ros.peer.create_publisher(TwistStamped, "cmd_vel", 1)
        ros.peer.create_subscription(JointState, "joint_commands", self._on_command, 1000)

    @property
    def torque(self):
        return np.array(self.commands[-1].effort).reshape(4, 2)

    def _on_command(self, message):
        self.commands.append(message)

    def publish_states(self, at_ns=None):
        self.time_ns = self.time_ns + PERIOD_NS if at_ns is None else at_ns
        if self.commands:
            force = self.torque[:, 0].sum() / 0.075
            self.twist = self.twist + np.array([force / 100.0 * 0.002, 0.0, 0.0])
        rates = inverse_kinematics(THESIS, np.zeros(4), self.twist)
        self.position = self.position + rates * 0.002
        message = JointState(name=NAMES, position=self.position.ravel().tolist(), velocity=rates.ravel().tolist())
        if self.bad_velocity:
            message.velocity[3] = math.nan
        if self.bad_position:
            message.position[0] = math.nan
        message.header.stamp = ns_to_stamp(self.time_ns)
        self.states.publish(message)

    def publish_twist(self):
        message = TwistStamped()
        message.header.frame_id = "base_link"
        message.twist.linear.x, message.twist.linear.y, message.twist.angular.z = self.target
        self.cmd_vel.publish(message)

    def run(self, condition, cmd_vel=True):
        """Publish joint_states, and cmd_vel, until the condition holds."""

        def publish():
            if cmd_vel:
                self.publish_twist()
            self.publish_states()

        return self.ros.wait_for(condition, while_doing=publish, every=0.004)

    def drives(self):
        return bool(self.commands) and self.torque[:, 0].sum() > 1.0

    def let_go(self):
        return bool(self.commands) and not self.torque.any()


def warnings_of(diagnostics):
    return " ".join(s.message for d in diagnostics for s in d.status)


def test_follows_cmd_vel_and_stamps_each_answer_with_its_question(ros):
    controller = ros.start(CONTROLLER)
    robot = Robot(ros)
    # Every measurement is answered, the first one at time zero too: a simulator in lock-step waits for it.
    ros.wait_for(lambda: robot.commands, while_doing=lambda: robot.publish_states(at_ns=0))
    assert stamp_to_ns(robot.commands[0].header.stamp) == 0
    robot.run(robot.drives)
    robot.run(lambda: abs(robot.twist[0] - 0.3) < 0.01)
    command = robot.commands[-1]
    assert command.name == NAMES and not command.velocity and not command.position
    assert 0 < stamp_to_ns(command.header.stamp) <= robot.time_ns
    assert np.all(np.abs(robot.torque) <= THESIS.torque_limit)
    assert controller.interrupt() == 0


def test_without_cmd_vel_it_lets_go(ros):
    ros.start(CONTROLLER, "-p", "cmd_vel_timeout:=0.1")
    robot, diagnostics = Robot(ros), ros.listen(DiagnosticArray, "/diagnostics")
    robot.run(robot.let_go, cmd_vel=False)  # nothing was ever wanted
    robot.run(robot.drives)
    since = robot.time_ns
    robot.run(robot.let_go, cmd_vel=False)
    assert robot.time_ns - since >= 0.09e9
    ros.wait_for(lambda: "cmd_vel_timeout" in warnings_of(diagnostics))


def test_without_joint_states_it_lets_go(ros):
    ros.start(CONTROLLER)
    robot, diagnostics = Robot(ros), ros.listen(DiagnosticArray, "/diagnostics")
    robot.run(robot.drives)
    ros.wait_for(robot.let_go, while_doing=robot.publish_twist)
    ros.wait_for(lambda: "joint_states_timeout" in warnings_of(diagnostics))
    robot.run(robot.drives)  # and takes over again


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_lets_go_before_the_end(ros, number):
    controller = ros.start(CONTROLLER)
    robot = Robot(ros)
    robot.run(robot.drives)
    assert controller.interrupt(number) == 0
    ros.wait_for(robot.let_go)


def test_nan_in_lets_go_and_never_comes_out(ros):
    ros.start(CONTROLLER)
    robot, diagnostics = Robot(ros), ros.listen(DiagnosticArray, "/diagnostics")
    robot.run(robot.drives)
    robot.bad_velocity = True
    robot.run(robot.let_go)
    ros.wait_for(lambda: "velocity of front_right_steer is NaN" in warnings_of(diagnostics))
    robot.bad_velocity = False
    robot.run(robot.drives)
    robot.target = (math.nan, 0.0, 0.0)
    robot.run(robot.let_go)
    ros.wait_for(lambda: "refused: cmd_vel" in warnings_of(diagnostics))
    assert all(np.isfinite(command.effort).all() for command in robot.commands)


def test_joints_of_an_arm_on_the_same_topic_do_not_let_go(ros):
    """Drivers share joint_states: each message of an arm was one without the robot's joints, and every other torque zero."""
    ros.start(CONTROLLER)
    robot = Robot(ros)
    robot.run(robot.drives)
    arm = JointState(name=["arm_1", "arm_2"], position=[0.1, 0.2], velocity=[0.0, 0.0])
    count = len(robot.commands)

    def with_arm():
        arm.header.stamp = ns_to_stamp(robot.time_ns + PERIOD_NS // 2)
        robot.states.publish(arm)
        return len(robot.commands) > count + 100

    robot.run(with_arm)
    assert all(any(command.effort) for command in robot.commands[count:])


def test_unusable_positions_do_not_make_it_race(ros):
    """What moved meanwhile is divided by the time meanwhile: the robot was not faster than before."""
    ros.start(CONTROLLER)
    robot = Robot(ros)
    robot.run(lambda: robot.drives() and abs(robot.twist[0] - 0.3) < 0.01)
    robot.bad_position = True
    until = robot.time_ns + 40_000_000
    robot.run(lambda: robot.time_ns >= until and robot.let_go())
    robot.bad_position, count, until = False, len(robot.commands), robot.time_ns + 400_000_000
    robot.run(lambda: robot.time_ns >= until)
    largest = max(np.abs(command.effort).max() for command in robot.commands[count:])
    assert 0.0 < largest < 0.5 * THESIS.torque_limit.min()
    assert abs(robot.twist[0] - 0.3) < 0.05


def test_a_command_from_before_the_first_measurement_is_outdated(ros):
    ros.start(CONTROLLER)
    robot, diagnostics = Robot(ros), ros.listen(DiagnosticArray, "/diagnostics")
    ros.wait_for(lambda: robot.cmd_vel.get_subscription_count() > 0)
    ros.spin_for(0.3, while_doing=robot.publish_twist)
    ros.wait_for(lambda: "no joint_states since the last report" in warnings_of(diagnostics))
    robot.run(lambda: robot.time_ns > 400_000_000 and len(robot.commands) > 20, cmd_vel=False)
    assert not any(np.any(command.effort) for command in robot.commands)
    robot.run(robot.drives)


def test_goes_to_a_goal(ros):
    # A machine busy with other tests may pause for longer than a robot: that would take the goal away.
    unhurried = ("-p", "joint_states_timeout:=1.0")
    ros.start(CONTROLLER, "-p", "goal_speed:=1.0", "-p", "goal_acceleration:=2.0", *unhurried)
    robot = Robot(ros)
    robot.run(lambda: robot.commands, cmd_vel=False)
    goals = ros.peer.create_publisher(PoseStamped, "goal_pose", 1)
    ros.wait_for(lambda: goals.get_subscription_count() > 0)
    goal = PoseStamped()
    goal.header.frame_id = "odom"
    goal.pose.position.x, goal.pose.orientation.w = 0.2, 1.0
    goals.publish(goal)
    robot.run(robot.drives, cmd_vel=False)
    # cmd_vel has a timeout, a goal has none: it is reached and held.
    travelled = lambda: robot.position[:, 0].mean() * 0.075  # noqa: E731
    robot.run(lambda: abs(travelled() - 0.2) < 0.002 and abs(robot.twist[0]) < 0.002, cmd_vel=False)

    goal.header.frame_id = "map"
    diagnostics = ros.listen(DiagnosticArray, "/diagnostics")
    goals.publish(goal)
    ros.wait_for(lambda: "in frame 'map'" in warnings_of(diagnostics))


def change_state(ros, transition):
    return ros.call(
        ChangeState, "controller/change_state", ChangeState.Request(transition=Transition(id=transition))
    ).success


def test_lifecycle_lets_go_on_deactivation_and_can_be_cleaned_up(ros):
    ros.start(CONTROLLER, "-p", "autostart:=false")
    robot = Robot(ros)
    state = ros.call(GetState, "controller/get_state").current_state.label
    assert state == "unconfigured"
    assert change_state(ros, Transition.TRANSITION_CONFIGURE)
    ros.wait_for(lambda: robot.states.get_subscription_count() > 0)
    for _ in range(20):
        robot.publish_twist()
        robot.publish_states()
        ros.spin_once()
    assert robot.commands == []  # configured is not active
    assert change_state(ros, Transition.TRANSITION_ACTIVATE)
    robot.run(robot.drives)
    # A transition that the state does not have ended the node: rclpy raises where it should refuse.
    assert not change_state(ros, Transition.TRANSITION_ACTIVATE)
    robot.run(robot.drives)
    assert change_state(ros, Transition.TRANSITION_DEACTIVATE)
    ros.wait_for(robot.let_go)
    count = len(robot.commands)
    for _ in range(20):
        robot.publish_states()
        ros.spin_once()
    assert len(robot.commands) == count
    assert change_state(ros, Transition.TRANSITION_ACTIVATE)
    robot.run(robot.drives)
    assert change_state(ros, Transition.TRANSITION_DEACTIVATE)
    assert change_state(ros, Transition.TRANSITION_CLEANUP)
    assert change_state(ros, Transition.TRANSITION_CONFIGURE)


def test_gaps_repeats_and_jumps_of_the_stamps_are_counted_and_let_go(ros):
    ros.start(CONTROLLER)
    robot, diagnostics = Robot(ros), ros.listen(DiagnosticArray, "/diagnostics")

    def counts():
        values = [{v.key: v.value for v in s.values} for d in diagnostics for s in d.status]
        return values[-1] if values else {}

    robot.run(robot.drives)
    robot.time_ns += 1_000_000_000
    robot.publish_states()
    ros.wait_for(robot.let_go)
    robot.run(robot.drives)
    robot.time_ns -= 500_000_000
    robot.publish_states()
    ros.wait_for(robot.let_go)
    robot.run(robot.drives)
    robot.time_ns -= PERIOD_NS
    robot.publish_states()
    ros.wait_for(lambda: counts().get("gaps") == "1" and counts().get("backward_jumps") == "1")
    ros.wait_for(lambda: counts().get("repeated_stamps") == "1")


def set_parameter(ros, name, value):
    if isinstance(value, str):
        number = ParameterValue(type=ParameterType.PARAMETER_STRING, string_value=value)
    elif isinstance(value, list):
        number = ParameterValue(type=ParameterType.PARAMETER_DOUBLE_ARRAY, double_array_value=value)
    else:
        number = ParameterValue(type=ParameterType.PARAMETER_DOUBLE, double_value=value)
    request = SetParameters.Request(parameters=[Parameter(name=name, value=number)])
    [result] = ros.call(SetParameters, "controller/set_parameters", request).results
    return result


def test_refused_parameter_keeps_the_old_value(ros):
    ros.start(CONTROLLER)

    def set_gain(value):
        result = set_parameter(ros, "velocity_gain", value)
        request = GetParameters.Request(names=["velocity_gain"])
        [found] = ros.call(GetParameters, "controller/get_parameters", request).values
        return result.successful, found.double_value

    assert set_gain(-1.0) == (False, 20.0)
    assert set_gain(math.inf) == (False, 20.0)
    assert set_gain(10.0) == (True, 10.0)


def test_gains_are_those_of_the_robot_unless_given_and_nested_and_several_numbers_are_parameters(ros):
    """Tidybot2 bears less than the thesis robot; what is declared is what `gain_check` ships, to the digits of its file."""
    ros.start(CONTROLLER, "-p", "robot:=tidybot2", "-p", "position_gain:=50.0", "-p", "slip.loop_delay:=0.003")
    names = ["velocity_gain", "integral_gain", "tracking_gain", "position_gain", "slip.loop_delay", "force_controlled"]

    def values():
        return ros.call(GetParameters, "controller/get_parameters", GetParameters.Request(names=names)).values

    found = {name: value.double_value for name, value in zip(names, values(), strict=True)}
    derived = ForceGuidedParameters.of_robot(load_robot("tidybot2"))
    assert found["velocity_gain"] == found["tracking_gain"] == pytest.approx(derived.velocity_gain)
    assert found["velocity_gain"] < 20.0 and found["integral_gain"] == pytest.approx(derived.integral_gain)
    assert (found["position_gain"], found["slip.loop_delay"]) == (50.0, 0.003)
    assert list(values()[-1].double_array_value) == [1.0, 1.0, 1.0]
    assert set_parameter(ros, "force_controlled", [1.0, 0.0, 1.0]).successful
    for bad in ([1.0, 0.5, 1.0], [1.0, 1.0]):
        result = set_parameter(ros, "force_controlled", bad)
        assert not result.successful and "force_controlled" in result.reason
    assert list(values()[-1].double_array_value) == [1.0, 0.0, 1.0]


@pytest.mark.parametrize(
    ("parameter", "complaint"),
    [
        ("robot:=/no/such/robot.yaml", "/no/such/robot.yaml"),
        ("velocity_gain:=-3.0", "velocity_gain"),
        ("robot:=mpo700", "torque control"),
    ],
)
def test_bad_input_ends_it_with_one_line(parameter, complaint):
    result = subprocess.run(
        [sys.executable, "-m", CONTROLLER, "--ros-args", "-p", parameter], capture_output=True, text=True, timeout=120
    )
    assert result.returncode == 2
    assert complaint in result.stderr and "Traceback" not in result.stderr
    assert len(result.stderr.strip().splitlines()) == 1


def test_the_controller_changes_while_driving_without_a_jump_of_torque(ros):
    """From computed torque to each of two others and back; the torque before is known, the ones after come close by."""
    ros.start(CONTROLLER)
    robot, diagnostics = Robot(ros), ros.listen(DiagnosticArray, "/diagnostics")
    ros.client(SetParameters, "controller/set_parameters")  # while it drives, no time is left to wait for it
    robot.run(lambda: robot.drives() and abs(robot.twist[0] - 0.3) < 0.01)
    for name in ("sliding_mode_rate", "friction_optimal", "computed_torque"):
        before, start = robot.torque, len(robot.commands)
        assert set_parameter(ros, "controller", name).successful
        until = robot.time_ns + 200_000_000
        robot.run(lambda until=until: robot.time_ns >= until)
        after = np.array([command.effort for command in robot.commands[start:]]).reshape(-1, 4, 2)
        change = np.abs(np.diff(np.concatenate([before[None], after]), axis=0)).max()
        # A twentieth of the torque limit: of what a reference with its limit of acceleration asks for in one cycle.
        assert change < 0.05 * THESIS.torque_limit.min()
        assert np.abs(after[:, :, 1]).max() < THESIS.torque_limit.min() and not np.all(after[-1] == 0.0)
        assert abs(robot.twist[0] - 0.3) < 0.05

    def last(key):
        return [v.value for d in diagnostics for s in d.status for v in s.values if v.key == key][-1:]

    ros.wait_for(lambda: last("switches") == ["3"] and last("controller") == ["computed_torque"])
    # What needs a measured wrench cannot take over without one, and what drives goes on.
    result = set_parameter(ros, "controller", "force_guided")
    assert not result.successful and "ft_sensor/wrench" in result.reason
    assert not set_parameter(ros, "controller", "computed_tork").successful
    robot.run(lambda: robot.drives() or abs(robot.twist[0] - 0.3) < 0.02)


def test_without_slip_and_terrain_it_says_so_and_goes_on(ros):
    """Two inputs that a controller can do without: heard, then silent."""
    ros.start(
        CONTROLLER, "-p", "controller:=sliding_mode_rate", "-p", "slip_source:=slip/encoder", "-p", "slip_share:=0.5",
        "-p", "input_timeout:=0.05",
    )
    robot, diagnostics = Robot(ros), ros.listen(DiagnosticArray, "/diagnostics")
    slip = ros.peer.create_publisher(JointState, "slip/encoder", 10)
    terrain = ros.peer.create_publisher(JointState, "terrain", 10)
    names = [f"{name}_{axis}" for name in THESIS.caster_names for axis in ("longitudinal", "lateral")]

    def tell(velocity=(0.0,) * 8):
        slip.publish(JointState(name=names, velocity=list(velocity)))
        terrain.publish(JointState(name=list(THESIS.caster_names), position=[0.1] * 4, effort=[0.5] * 4))

    ros.wait_for(lambda: slip.get_subscription_count() > 0 and terrain.get_subscription_count() > 0)
    robot.run(lambda: tell() or robot.drives())
    robot.run(lambda: "no valid slip" in warnings_of(diagnostics))
    robot.run(robot.drives)
    # A slip of which nothing is vouched for is none: NaN does not get in.
    robot.run(lambda: tell([math.nan] * 8) or robot.drives())
    assert set_parameter(ros, "controller", "weighted_pseudo_inverse").successful
    robot.run(lambda: tell() or robot.drives())
    robot.run(lambda: "no valid terrain" in warnings_of(diagnostics))
    robot.run(robot.drives)
    assert all(np.isfinite(command.effort).all() for command in robot.commands)


def test_a_pushed_robot_lets_go_when_the_sensor_falls_silent_or_lies(ros):
    ros.start(CONTROLLER, "-p", "controller:=force_guided")
    robot, diagnostics = Robot(ros), ros.listen(DiagnosticArray, "/diagnostics")
    sensor = ros.peer.create_publisher(WrenchStamped, "ft_sensor/wrench", 10)

    def push(force=20.0, frame="base_link"):
        message = WrenchStamped()
        message.header.frame_id, message.wrench.force.x = frame, force
        sensor.publish(message)

    ros.wait_for(lambda: sensor.get_subscription_count() > 0)
    gives_way = lambda: bool(robot.commands) and robot.torque[:, 0].sum() > 0.05  # noqa: E731
    robot.run(lambda: push() or gives_way(), cmd_vel=False)
    told = "following ft_sensor/wrench"  # it was "following cmd_vel", which nobody sends
    robot.run(lambda: push() or any(told == status.message for d in diagnostics for status in d.status), cmd_vel=False)
    # Silent. On a busy machine it may let go for want of joint_states first, so the robot goes on until it says why.
    robot.run(lambda: robot.let_go() and "no ft_sensor/wrench" in warnings_of(diagnostics), cmd_vel=False)
    robot.run(lambda: push() or bool(robot.torque.any()), cmd_vel=False)
    robot.run(lambda: push(math.nan) or robot.let_go(), cmd_vel=False)  # lies
    ros.wait_for(lambda: "refused: ft_sensor/wrench" in warnings_of(diagnostics))
    robot.run(lambda: push(20.0, "wrist") or robot.let_go(), cmd_vel=False)
    assert all(np.isfinite(command.effort).all() for command in robot.commands)


@pytest.mark.nightly  # the core's test shows the limits; this one that the parameters reach it
def test_power_and_jerk_are_limited_in_the_node(ros):
    ros.start(CONTROLLER, "-p", "drive_power:=2.0", "-p", "drive_jerk:=20.0")
    robot = Robot(ros)
    robot.run(lambda: robot.drives() or robot.time_ns > 2e9)
    until = robot.time_ns + 500_000_000
    robot.run(lambda: robot.time_ns >= until)
    effort = np.array([command.effort for command in robot.commands]).reshape(-1, 4, 2)
    # 20 m/s^3 of 26 kg at a lever of 75 mm is 39 N m/s, and 2 ms of it 0.08 N m; a message may be lost, but not ten.
    rises = np.diff(np.abs(effort[:, :, 0]), axis=0)
    assert 0.0 < rises.max() < 0.8
    assert np.abs(effort).max() > 0.0


def test_the_latency_is_measured_and_printed(ros):
    """Few cycles: what counts is that every question is answered, with torque, and that the figure is there."""
    measured = ros.start("pcw_control.nodes.command_latency", "-p", "cycles:=200")
    assert measured.wait() == 0
    assert "p99" in measured.log and " 0 of 200 without an answer" in measured.log
    # Of the 700 questions those before the first cmd_vel need none: it comes with the first, and discovery takes its time.
    (driven,) = re.findall(r"(\d+) with torque", measured.log)
    assert int(driven) >= 200


def test_the_first_name_still_starts_it(ros):
    controller = ros.start("pcw_control.nodes.computed_torque", "-p", "autostart:=false")
    assert ros.call(GetState, "computed_torque/get_state").current_state.label == "unconfigured"
    assert controller.interrupt() == 0


FAULTY = """
import dataclasses
import numpy as np
from pcw_control.computed_torque import ComputedTorque
from pcw_control.nodes import controller

step = ComputedTorque.step

def faulty(self, state, measurement, reference, dt):
    state, output = step(self, state, measurement, reference, dt)
    yaw_rate = getattr(reference, "twist", np.zeros(3))[2]
    if yaw_rate == 2.0:
        raise RuntimeError("a fault on purpose")
    if yaw_rate == 1.0:
        output = dataclasses.replace(output, torque=np.full((4, 2), np.nan))
    return state, output

ComputedTorque.step = faulty
raise SystemExit(controller.main())
"""


def test_a_torque_that_is_no_number_lets_go_and_an_exception_latches(ros):
    """A controller with two faults on purpose, chosen by the yaw rate that is wanted."""
    ros.run([sys.executable, "-c", FAULTY])
    robot, diagnostics = Robot(ros), ros.listen(DiagnosticArray, "/diagnostics")
    robot.run(robot.drives)
    robot.target = (0.3, 0.0, 1.0)
    robot.run(robot.let_go)
    ros.wait_for(lambda: "not finite" in warnings_of(diagnostics))
    robot.target = (0.3, 0.0, 0.0)
    robot.run(robot.drives)  # it lets go for as long as it lasts
    robot.target = (0.3, 0.0, 2.0)
    robot.run(robot.let_go)
    ros.wait_for(lambda: "latched: RuntimeError: a fault on purpose" in warnings_of(diagnostics))
    robot.target, count = (0.3, 0.0, 0.0), len(robot.commands)
    robot.run(lambda: len(robot.commands) > count + 50)
    assert not any(np.any(command.effort) for command in robot.commands[count:])
    assert change_state(ros, Transition.TRANSITION_DEACTIVATE)
    assert change_state(ros, Transition.TRANSITION_ACTIVATE)
    robot.run(robot.drives)
    assert all(np.isfinite(command.effort).all() for command in robot.commands)


# Kernels count what they have been compiled for; nothing may be added once the robot drives.
_AFTER_THE_WARM_UP = """
import sys

import numpy as np
import rclpy

from pcw_control import CONTROLLERS, ControllerMeasurement, TrajectoryPoint, TwistReference, make_controller
from pcw_control.nodes.controller import ControllerNode
from pcw_control.quintic_trajectory import MotionLimits, plan_point_to_point


def compiled():
    kernels = {}
    for name, module in list(sys.modules.items()):
        if name.startswith("pcw_"):
            kernels |= {f"{name}.{key}": len(k.signatures) for key, k in vars(module).items() if hasattr(k, "signatures")}
    return kernels


rclpy.init()
node = ControllerNode()
node._warm_up()
before = compiled()
assert len(before) > 20, before
rng = np.random.default_rng(0)
goal = plan_point_to_point(TrajectoryPoint(np.zeros(3)), TrajectoryPoint(np.ones(3)), MotionLimits(1.0, 0.5, 2.0, 1.0))
for name in CONTROLLERS:
    controller = make_controller(name, node.robot)
    state = controller.initial_state()
    for reference in (TwistReference(np.array([0.3, 0.0, 0.1])), goal.sample(0.5), goal.sample(1e3)):
        for heard in ({}, {"slip": rng.normal(size=(4, 2)), "friction": np.full(4, 0.5), "critical_slip": np.full(4, 0.1)}):
            measured = ControllerMeasurement(rng.normal(size=(4, 2)), rng.normal(size=(4, 2)), np.zeros(3), **heard)
            state, _ = controller.step(state, measured, reference, 0.002)
late = {key: count for key, count in compiled().items() if count != before.get(key, 0)}
node.destroy_node()
rclpy.try_shutdown()
assert not late, late
"""


def test_nothing_is_left_to_compile_once_the_robot_drives(ros):
    """To compile takes a second, in which a robot that drives has no answer: a goal must not be the first of its kind."""
    pytest.importorskip("numba")
    command = [sys.executable, "-c", _AFTER_THE_WARM_UP]
    found = subprocess.run(command, capture_output=True, text=True, timeout=240, check=False)
    assert found.returncode == 0, found.stderr[-2000:]
