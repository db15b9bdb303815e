"""The controller as a lifecycle node: cmd_vel or goal_pose and joint_states in, joint_commands out.

Gains follow from the robot: in the help their defaults are those of `thesis`, and a value that is given counts instead.
"""

from __future__ import annotations

import dataclasses
import math
import time
import traceback
from collections.abc import Sequence

import numpy as np
from geometry_msgs.msg import PoseStamped, Twist, TwistStamped
from rclpy.clock import Clock, ClockType
from rclpy.lifecycle import State, TransitionCallbackReturn
from sensor_msgs.msg import JointState

from pcw_description import PcwError, load_robot, odometry
from pcw_description.nodes.diagnostics import ERROR, OK, WARN, Diagnostics, Problems, Status
from pcw_description.nodes.lifecycle import RobustLifecycleNode
from pcw_description.nodes.measured_joints import MeasuredJoints
from pcw_description.nodes.node_tools import (
    COMMAND,
    COMMAND_SOURCE,
    SENSOR,
    all_declared,
    declare,
    fill_joint_state,
    run_node,
    stamp_to_ns,
    wait_until_heard,
)

from .. import handover
from ..controller_interface import ControllerMeasurement, ForceReference, Reference, TwistReference
from ..controllers import CONTROLLERS, make_controller
from ..friction_budget import FrictionBudget, plan_within_friction
from ..quintic_trajectory import TrajectoryPoint
from ..safety import HAZARDS, Reaction, SafetyGate
from .controller_inputs import SLIP_SOURCES, OptionalInputs, Refused, pose_of, twist_of
from .controller_parameters import (
    controller_parameters,
    declare_controller_parameters,
    motion_limits,
    torque_limits,
)

ODOMETRY = odometry.OdometryParameters()
# The longest time between two joint_states that a controller bridges; beyond it starts afresh with zero torque.
LONGEST_GAP = 0.1  # [s]


class ControllerNode(RobustLifecycleNode):
    """Follows cmd_vel, or a quintic trajectory to goal_pose, by joint torques of the controller that is chosen.

    The torque is computed in the callback of joint_states and not by a timer: it belongs to just that measurement, a timer
    would let the measurement wait for up to one period (the loop bears 2 ms of delay and not 3), and a simulator in
    lock-step waits for exactly this answer. dt is measured from the stamps, and the answer carries the stamp.

    What is wrong in a cycle is collected as names out of `HAZARDS`; the safety gate, last, decides what leaves.
    """

    def __init__(self, name: str = "controller") -> None:
        super().__init__(name)
        robot = load_robot(declare(self, "robot", "thesis", "robot file, or the name of a shipped robot", read_only=True))
        autostart = declare(self, "autostart", True, "configure and activate at once", read_only=True)
        self._stamped = declare(self, "cmd_vel_stamped", True, "cmd_vel is a TwistStamped, not a Twist", read_only=True)
        self._slip_source = declare(
            self, "slip_source", "none", "topic of the slip that controllers use", read_only=True, choices=SLIP_SOURCES
        )
        declare(self, "cmd_vel_timeout", 0.5, "zero torque after so long without it, time of joint_states", "s", (0.01, 60.0))
        declare(self, "joint_states_timeout", 0.1, "zero torque after so long without them, real time", "s", (0.01, 60.0))
        declare(self, "input_timeout", 0.2, "slip, terrain and wrenches older than this do not count", "s", (0.01, 60.0))
        self.robot, self._budget = robot, FrictionBudget(robot)
        self._name = ""  # of the controller at work
        self._active, self._driving = False, False
        self._steady = Clock(clock_type=ClockType.STEADY_TIME)
        declare(
            self, "controller", "computed_torque", "the controller at work", choices=tuple(CONTROLLERS),
            check=self._reason_against,
        )
        declare_controller_parameters(self, robot)
        self._declare_more()
        all_declared(self)
        self._message = JointState(name=list(robot.joint_names))
        self._faults = self._timeouts = self._refused = self._switches = 0
        self._problems = Problems(self)
        self._fault = ""
        self._adopt_parameters()
        self.add_post_set_parameters_callback(lambda _: self._adopt_parameters())
        self._forget()
        self._diagnostics = Diagnostics(self, robot.name, self._status, aspect="controller")
        if autostart:
            self.trigger_configure()
            self.trigger_activate()

    # --- What a subclass may add ------------------------------------------------------------------------

    def _declare_more(self) -> None:
        """Declare parameters of one's own."""

    def _seen(
        self, position: np.ndarray, velocity: np.ndarray, effort: np.ndarray, dt: float | None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the joint angles and speeds (n, 2) by which odometry and controller go: as they are measured.

        Called once for each joint_states in use; `dt` is None where there is no time step, and effort NaN where not sent.
        """
        return position, velocity

    def _with_more(self, torque: np.ndarray) -> np.ndarray:
        """Return the torque (n, 2) that goes to the gate for the one that the controller asks for."""
        return torque

    # --- Parameters -------------------------------------------------------------------------------------

    def _reason_against(self, name: str) -> str | None:
        """Say why a controller cannot take over now; None when it can."""
        uses = CONTROLLERS[name].parameters.uses
        if self._active and "external_wrench" in uses and self._optional.fresh("measured", self._input_timeout) is None:
            return "there is no ft_sensor/wrench, which this controller cannot be without"
        return None

    def _adopt_parameters(self) -> None:
        name = self.get_parameter("controller").value
        controller = make_controller(name, self.robot, controller_parameters(self, name))
        switched = bool(self._name) and name != self._name
        self._controller, self._name = controller, name
        self._uses = CONTROLLERS[name].parameters.uses
        self._gate = SafetyGate(torque_limits(self, self.robot))
        self._cmd_vel_timeout: float = self.get_parameter("cmd_vel_timeout").value
        self._joint_states_timeout: float = self.get_parameter("joint_states_timeout").value
        self._input_timeout: float = self.get_parameter("input_timeout").value
        if switched:
            self._switches += 1
            self._take_over()

    def _take_over(self) -> None:
        """Let the new controller begin where the old one is: at its reference twist, and without a jump of torque."""
        if self._driving:
            self._state = self._controller.initial_state(self._reference_twist)
            self._handover = handover.begin_handover(self._passed.torque)

    def _forget(self) -> None:
        """Start afresh: nothing commanded, nothing measured, nothing latched."""
        self._joints = MeasuredJoints(self.robot, ["position", "velocity"], self._problems, LONGEST_GAP)
        self._watch = self._joints.watch
        self._odometry = odometry.initial_state()
        self._state = self._controller.initial_state()
        self._passed = self._gate.initial_state()
        self._handover = handover.no_handover(self.robot.n)
        self._driving = False  # a torque other than zero may be out
        self._reference_twist = np.zeros(3)
        self._twist: np.ndarray | None = None
        self._twist_ns = 0
        self._trajectory, self._trajectory_start_ns = None, 0
        self._now_ns = -1  # before any stamp, zero included
        self._heard = time.monotonic()
        if hasattr(self, "_optional"):
            self._optional.forget()

    # --- Lifecycle --------------------------------------------------------------------------------------

    def on_configure(self, state: State) -> TransitionCallbackReturn:
        """Create the topics, and have everything compiled before the robot waits for an answer."""
        self._warm_up()
        self._commands = self.create_publisher(JointState, "joint_commands", COMMAND_SOURCE)
        self._optional = OptionalInputs(self, self.robot, self._slip_source, lambda: self._now_ns, self._refuse)
        self._inputs = [
            self.create_subscription(JointState, "joint_states", self._on_joint_states, SENSOR),
            self.create_subscription(TwistStamped if self._stamped else Twist, "cmd_vel", self._on_cmd_vel, COMMAND),
            self.create_subscription(PoseStamped, "goal_pose", self._on_goal_pose, COMMAND),
            *self._optional.subscriptions,
        ]
        self._watchdog = self.create_timer(0.02, self._look_after_joint_states, clock=self._steady)
        return super().on_configure(state)

    def _warm_up(self) -> None:
        """Have odometry, every controller and the gate compiled: any of them may take over while the robot drives."""
        at_rest = np.zeros((self.robot.n, 2))
        moving, _ = odometry.update(self.robot, ODOMETRY, odometry.initial_state(), at_rest, 1.0)
        odometry.update(self.robot, ODOMETRY, moving, at_rest, 1.0)
        measurement = ControllerMeasurement(
            at_rest, at_rest, np.zeros(3), slip=at_rest, slip_valid=np.ones(at_rest.shape, dtype=bool),
            friction=np.full(self.robot.n, 0.5), external_wrench=np.zeros(3),
        )
        for name, entry in CONTROLLERS.items():
            controller = make_controller(name, self.robot, controller_parameters(self, name))
            motion = TwistReference(np.zeros(3))
            reference = ForceReference(np.zeros(3), motion) if "external_wrench" in entry.parameters.uses else motion
            controller.step(controller.initial_state(), measurement, TrajectoryPoint(np.zeros(3)), 0.01)  # what a goal needs
            _, output = controller.step(controller.initial_state(), measurement, reference, 0.01)
            self._gate.pass_torque(self._gate.initial_state(), output.torque, at_rest, 0.01, frozenset())

    def on_activate(self, state: State) -> TransitionCallbackReturn:
        """Begin to answer joint_states, with zero torque until there is a reference."""
        self._forget()
        self._fault = ""
        self._active = True
        return super().on_activate(state)

    def on_deactivate(self, state: State) -> TransitionCallbackReturn:
        """Let go of the robot."""
        self._active = False
        self._send({"inactive"})
        return super().on_deactivate(state)

    def on_cleanup(self, state: State) -> TransitionCallbackReturn:
        """Remove the topics."""
        self._active = False
        self.destroy_timer(self._watchdog)
        for subscription in self._inputs:
            self.destroy_subscription(subscription)
        self.destroy_publisher(self._commands)
        del self._commands, self._optional
        return super().on_cleanup(state)

    def close(self) -> None:
        """Send zero torque and wait until it has left."""
        self._active = False
        if hasattr(self, "_commands"):
            self._send({"inactive"})
            wait_until_heard(self._commands)

    # --- References -------------------------------------------------------------------------------------

    def _on_cmd_vel(self, message: TwistStamped | Twist) -> None:
        try:
            values = twist_of(message, self._stamped)
        except Refused as error:
            self._refuse(str(error))
            values = None
        if self._now_ns < 0:
            values = None  # no measurement yet to date it by: once the robot speaks, it may be long outdated
        self._twist, self._twist_ns = values, self._now_ns
        self._trajectory = None

    def _on_goal_pose(self, message: PoseStamped) -> None:
        try:
            goal = pose_of(message)
            if not self._active or self._odometry.joint_position is None:
                raise Refused("goal_pose; allowed: in the active state and with joint_states")
            terrain = self._optional.fresh("terrain", self._input_timeout)
            self._trajectory = plan_within_friction(
                self._budget, self._start_of_trajectory(), TrajectoryPoint(goal), motion_limits(self),
                self.get_parameter("ground_share").value, None if terrain is None else terrain[0],
            )
        except Refused as error:
            self._refuse(str(error))
            return
        except PcwError as error:
            self._refuse(f"goal_pose: {error}")
            return
        self._trajectory_start_ns = self._now_ns
        self._twist = None

    def _start_of_trajectory(self) -> TrajectoryPoint:
        """Where a trajectory begins: at the pose now, with the velocity wanted now as far as the limits allow it."""
        limits = motion_limits(self)
        V = self._reference_twist if self._driving else np.zeros(3)
        V = V / max(1.0, math.hypot(V[0], V[1]) / limits.speed, abs(V[2]) / limits.yaw_rate)
        yaw = self._odometry.pose[2]
        c, s = math.cos(yaw), math.sin(yaw)
        return TrajectoryPoint(self._odometry.pose.copy(), np.array([c * V[0] - s * V[1], s * V[0] + c * V[1], V[2]]))

    def _reference(self, hazards: set[str]) -> Reference | None:
        """Return what to follow now; None for nothing, with the hazard that it is."""
        motion: TwistReference | TrajectoryPoint | None = None
        if self._trajectory is not None:
            motion = self._trajectory.sample((self._now_ns - self._trajectory_start_ns) * 1e-9)
        elif self._twist is not None and self._now_ns - self._twist_ns > self._cmd_vel_timeout * 1e9:
            self._twist = None
            self._timeouts += 1
            hazards.add("cmd_vel_timeout")
        elif self._twist is not None:
            motion = TwistReference(self._twist)
        if "external_wrench" not in self._uses:
            return motion
        # A robot that is pushed needs no cmd_vel: what nobody pushes stands still.
        if self._optional.fresh("measured", self._input_timeout) is None:
            hazards.add("wrench_timeout")
            return None
        wanted = self._optional.fresh("wanted", self._cmd_vel_timeout)
        return ForceReference(np.zeros(3) if wanted is None else wanted, motion or TwistReference(np.zeros(3)))

    def _told(self, measurement: ControllerMeasurement, hazards: set[str] | None = None) -> ControllerMeasurement:
        """Return the measurement with what estimators say, as far as the controller uses it and it is fresh."""
        hazards, extra = set() if hazards is None else hazards, {}
        if not hasattr(self, "_optional"):
            return measurement
        if "slip" in self._uses and self._slip_source != "none":
            found = self._optional.fresh("slip", self._input_timeout)
            if found is None:
                hazards.add("slip_invalid")
            else:
                extra["slip"], extra["slip_valid"] = found
        terrain = self._optional.fresh("terrain", self._input_timeout) if "friction" in self._uses else None
        if terrain is not None:
            extra["friction"], extra["critical_slip"] = terrain
            self._ground_known = True
        elif "friction" in self._uses and getattr(self, "_ground_known", False):
            hazards.add("friction_invalid")  # nobody who estimates it is no fault, one who fell silent is
        if "external_wrench" in self._uses:
            extra["external_wrench"] = self._optional.fresh("measured", self._input_timeout)
        return dataclasses.replace(measurement, **extra) if extra else measurement

    # --- Control ----------------------------------------------------------------------------------------

    def _on_joint_states(self, message: JointState) -> None:
        if not self._active or not self._joints.are_in(message):
            return
        self._heard = time.monotonic()
        self._message.header.stamp = message.header.stamp
        now_ns = stamp_to_ns(message.header.stamp)
        if now_ns < self._now_ns:
            self._twist, self._trajectory = None, None  # time was set back: what was wanted belongs to another run
        repeated, self._now_ns = now_ns == self._now_ns, now_ns
        dt = self._watch.update(message.header.stamp)
        if repeated:
            self._commands.publish(self._message)  # the same question, the same answer
            return
        try:
            self._control(message, dt)
        except PcwError as error:
            self._faults += 1
            self._problems.add(str(error))
            self._send({"joint_states_unusable"})
        except Exception as error:
            self._fault = f"{type(error).__name__}: {error}"
            self.get_logger().error(f"zero torque until the next activation\n{traceback.format_exc()}")
            self._send({"exception"})

    def _control(self, message: JointState, dt: float | None) -> None:
        try:
            position, measured_velocity, effort = self._joints.read(message)
        except PcwError:
            # The motion since the last usable position is divided by the time since then, or the robot would seem fast.
            self._watch.take_back()
            raise
        position, velocity = self._seen(position, measured_velocity, effort, dt)
        if dt is None:
            # Before the first dt there is no odometry; after a gap or a jump the pose is kept and the motion between unknown.
            self._odometry = odometry.initial_state(self._odometry.pose)
        self._odometry, moved = odometry.update(self.robot, ODOMETRY, self._odometry, position, dt or 1.0)
        hazards: set[str] = set()
        reference = self._reference(hazards)
        if dt is None:
            hazards.add("no_time_step")
        if reference is None:
            hazards.add("nothing_commanded")
        if dt is None or reference is None or self._passed.latched:
            self._send(hazards)
            return
        if not self._driving:
            self._state, self._driving = self._controller.initial_state(moved.twist), True
        measurement = self._told(
            ControllerMeasurement(position, velocity, self._odometry.pose, self._passed.saturated), hazards
        )
        self._state, output = self._controller.step(self._state, measurement, reference, dt)
        self._reference_twist = output.reference_twist
        self._handover, torque = handover.step(self._handover, output.torque, dt)
        self._send(hazards, self._with_more(torque), measured_velocity, dt)

    def _send(
        self, hazards: set[str], torque: np.ndarray | None = None, velocity: np.ndarray | None = None, dt: float | None = None
    ) -> None:
        """Let the gate decide what leaves, and send it."""
        self._passed, gated = self._gate.pass_torque(self._passed, torque, velocity, dt, hazards)
        if torque is None or (gated.reaction or 0) >= Reaction.LET_GO:
            self._driving, self._handover = False, handover.no_handover(self.robot.n)
        for name in set(gated.hazards) - {"inactive", "nothing_commanded", "no_time_step", "joint_states_unusable"}:
            self._problems.add(HAZARDS[name].said)
        self._faults += "torque_not_finite" in gated.hazards
        fill_joint_state(self._message, effort=gated.torque)
        self._commands.publish(self._message)

    def _look_after_joint_states(self) -> None:
        if self._active and self._driving and time.monotonic() - self._heard > self._joint_states_timeout:
            self._timeouts += 1
            self._twist, self._trajectory = None, None
            self._send({"joint_states_timeout"})

    # --- Diagnostics ------------------------------------------------------------------------------------

    def _refuse(self, what: str) -> None:
        self._refused += 1
        self._problems.add(f"refused: {what}")

    def _status(self) -> Status:
        silence, problems = self._joints.silence(), self._problems.take()
        if not self._active:
            level, message = OK, "not active"
        elif self._passed.latched:
            level, message = ERROR, f"latched: {self._fault}"
        elif problems:
            level, message = WARN, problems
        elif silence:
            level, message = WARN, f"{silence}; the torque is zero"
        else:
            wanted = "cmd_vel" if self._twist is not None else "ft_sensor/wrench"
            following = "a trajectory" if self._trajectory is not None else wanted if self._driving else "nothing"
            level, message = OK, f"following {following}"
        return Status(
            level, message,
            {
                "controller": self._name, "switches": self._switches, "timeouts": self._timeouts, "faults": self._faults,
                "refused": self._refused, "gaps": self._watch.gaps, "repeated_stamps": self._watch.repeats,
                "backward_jumps": self._watch.backward_jumps,
            },
        )


def main(args: Sequence[str] | None = None) -> int:
    """Run the controller."""
    return run_node(ControllerNode, args)


if __name__ == "__main__":
    raise SystemExit(main())
