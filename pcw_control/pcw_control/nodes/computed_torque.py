"""Computed torque as a lifecycle node: cmd_vel or goal_pose and joint_states in, joint_commands out."""

from __future__ import annotations

import math
import time
import traceback
from collections.abc import Sequence

import numpy as np
from geometry_msgs.msg import PoseStamped, Twist, TwistStamped
from rclpy.clock import Clock, ClockType
from rclpy.lifecycle import LifecycleNode, State, TransitionCallbackReturn
from sensor_msgs.msg import JointState

from pcw_description import PcwError, load_robot, odometry
from pcw_description.nodes.diagnostics import ERROR, OK, WARN, Diagnostics, Problems, Status
from pcw_description.nodes.node_tools import (
    COMMAND,
    COMMAND_SOURCE,
    SENSOR,
    Silence,
    StampWatch,
    declare,
    fill_joint_state,
    joint_state_arrays,
    run_node,
    stamp_to_ns,
    wait_until_heard,
)

from ..computed_torque import ComputedTorque
from ..controller_interface import ControllerMeasurement, TwistReference
from ..quintic_trajectory import TrajectoryPoint, plan_point_to_point
from ..torque_limits import limit_torque
from .controller_parameters import (
    controller_parameters,
    declare_controller_parameters,
    motion_limits,
    torque_limits,
)

ODOMETRY = odometry.OdometryParameters()
# The longest time between two joint_states that a controller bridges; beyond it starts afresh with zero torque.
LONGEST_GAP = 0.1  # [s]


class ComputedTorqueNode(LifecycleNode):
    """Follows cmd_vel, or a quintic trajectory to goal_pose, by joint torques.

    The torque is computed in the callback of joint_states and not by a timer: it belongs to just that measurement, a timer
    would let the measurement wait for up to one period (the loop bears 2 ms of delay and not 3), and a simulator in
    lock-step waits for exactly this answer. dt is measured from the stamps, and the answer carries the stamp.

    Zero torque on deactivation, without a fresh cmd_vel or joint_states, on a value that is not a number, on any exception
    (which latches until the next activation), and on shutdown.
    """

    def __init__(self) -> None:
        super().__init__("computed_torque")
        robot = load_robot(declare(self, "robot", "thesis", "robot file, or the name of a shipped robot", read_only=True))
        autostart = declare(self, "autostart", True, "configure and activate at once", read_only=True)
        self._stamped = declare(self, "cmd_vel_stamped", True, "cmd_vel is a TwistStamped, not a Twist", read_only=True)
        declare(self, "cmd_vel_timeout", 0.5, "zero torque after so long without it, time of joint_states", "s", (0.01, 60.0))
        declare(self, "joint_states_timeout", 0.1, "zero torque after so long without them, real time", "s", (0.01, 60.0))
        declare_controller_parameters(self)
        self.robot = robot
        self._steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._joint_index = {name: i for i, name in enumerate(robot.joint_names)}
        self._message = JointState(name=list(robot.joint_names))
        self._active = False
        self._faults = self._timeouts = self._refused = 0
        self._problems = Problems(self)
        self._fault = ""
        self._adopt_parameters()
        self.add_post_set_parameters_callback(lambda _: self._adopt_parameters())
        self._forget()
        self._diagnostics = Diagnostics(self, robot.name, self._status, aspect="controller")
        if autostart:
            self.trigger_configure()
            self.trigger_activate()

    def _adopt_parameters(self) -> None:
        self._controller = ComputedTorque(self.robot, controller_parameters(self))
        self._limits = torque_limits(self, self.robot)
        self._cmd_vel_timeout: float = self.get_parameter("cmd_vel_timeout").value
        self._joint_states_timeout: float = self.get_parameter("joint_states_timeout").value

    def _forget(self) -> None:
        """Start afresh: nothing commanded, nothing measured."""
        self._watch = StampWatch(LONGEST_GAP)
        self._silence = Silence(self._watch)
        self._odometry = odometry.initial_state()
        self._state = self._controller.initial_state()
        self._engaged = False  # a torque other than zero may be out
        self._torque, self._saturated = np.zeros((self.robot.n, 2)), False
        self._twist: np.ndarray | None = None
        self._twist_ns = 0
        self._trajectory, self._trajectory_start_ns = None, 0
        self._now_ns = -1  # before any stamp, zero included
        self._heard = time.monotonic()

    # --- Lifecycle --------------------------------------------------------------------------------------

    def on_configure(self, state: State) -> TransitionCallbackReturn:
        """Create the topics, and have everything compiled before the robot waits for an answer."""
        self._warm_up()
        self._commands = self.create_publisher(JointState, "joint_commands", COMMAND_SOURCE)
        self._inputs = [
            self.create_subscription(JointState, "joint_states", self._on_joint_states, SENSOR),
            self.create_subscription(TwistStamped if self._stamped else Twist, "cmd_vel", self._on_cmd_vel, COMMAND),
            self.create_subscription(PoseStamped, "goal_pose", self._on_goal_pose, COMMAND),
        ]
        self._watchdog = self.create_timer(0.02, self._look_after_joint_states, clock=self._steady)
        return super().on_configure(state)

    def _warm_up(self) -> None:
        at_rest = np.zeros((self.robot.n, 2))
        moving, _ = odometry.update(self.robot, ODOMETRY, odometry.initial_state(), at_rest, 1.0)
        odometry.update(self.robot, ODOMETRY, moving, at_rest, 1.0)
        measurement = ControllerMeasurement(at_rest, at_rest, np.zeros(3))
        self._controller.step(self._controller.initial_state(), measurement, TwistReference(np.zeros(3)), 1.0)

    def on_activate(self, state: State) -> TransitionCallbackReturn:
        """Begin to answer joint_states, with zero torque until there is a reference."""
        self._forget()
        self._fault = ""
        self._active = True
        return super().on_activate(state)

    def on_deactivate(self, state: State) -> TransitionCallbackReturn:
        """Let go of the robot."""
        self._active = False
        self._send_zero()
        return super().on_deactivate(state)

    def on_cleanup(self, state: State) -> TransitionCallbackReturn:
        """Remove the topics."""
        self._active = False
        self.destroy_timer(self._watchdog)
        for subscription in self._inputs:
            self.destroy_subscription(subscription)
        self.destroy_publisher(self._commands)
        del self._commands
        return super().on_cleanup(state)

    def on_shutdown(self, state: State) -> TransitionCallbackReturn:
        """Let go of the robot for good."""
        self.close()
        return super().on_shutdown(state)

    def on_error(self, state: State) -> TransitionCallbackReturn:
        """Let go of the robot after a failed transition."""
        self.close()
        return super().on_error(state)

    def close(self) -> None:
        """Send zero torque and wait until it has left."""
        self._active = False
        if hasattr(self, "_commands"):
            self._send_zero()
            wait_until_heard(self._commands)

    # --- References -------------------------------------------------------------------------------------

    def _on_cmd_vel(self, message: TwistStamped | Twist) -> None:
        twist, frame = (message.twist, message.header.frame_id) if self._stamped else (message, "")
        values = np.array([twist.linear.x, twist.linear.y, twist.angular.z])
        if not np.isfinite(values).all() or frame not in ("", "base_link"):
            self._refuse(f"cmd_vel {values.tolist()} in frame {frame!r}; allowed: finite numbers in base_link")
            values = None
        if self._now_ns < 0:
            values = None  # no measurement yet to date it by: once the robot speaks, it may be long outdated
        self._twist, self._twist_ns = values, self._now_ns
        self._trajectory = None

    def _on_goal_pose(self, message: PoseStamped) -> None:
        position, q = message.pose.position, message.pose.orientation
        # The yaw of any rotation; a goal off the plane is taken onto it.
        yaw = math.atan2(2.0 * (q.w * q.z + q.x * q.y), 1.0 - 2.0 * (q.y * q.y + q.z * q.z))
        goal = np.array([position.x, position.y, yaw])
        frame = message.header.frame_id
        norm = q.w * q.w + q.x * q.x + q.y * q.y + q.z * q.z
        if frame not in ("", "odom") or not np.isfinite(goal).all() or not 0.5 < norm < 2.0:
            self._refuse(f"goal_pose {goal.tolist()} in frame {frame!r}; allowed: finite numbers, a unit quaternion, in odom")
            return
        if not self._active or self._odometry.joint_position is None:
            self._refuse("goal_pose; allowed: in the active state and with joint_states")
            return
        try:
            self._trajectory = plan_point_to_point(self._start_of_trajectory(), TrajectoryPoint(goal), motion_limits(self))
        except PcwError as error:
            self._refuse(f"goal_pose: {error}")
            return
        self._trajectory_start_ns = self._now_ns
        self._twist = None

    def _start_of_trajectory(self) -> TrajectoryPoint:
        """Where a trajectory begins: at the pose now, with the velocity wanted now as far as the limits allow it."""
        limits = motion_limits(self)
        V = self._state.reference_twist if self._engaged else np.zeros(3)
        V = V / max(1.0, math.hypot(V[0], V[1]) / limits.speed, abs(V[2]) / limits.yaw_rate)
        yaw = self._odometry.pose[2]
        c, s = math.cos(yaw), math.sin(yaw)
        return TrajectoryPoint(self._odometry.pose.copy(), np.array([c * V[0] - s * V[1], s * V[0] + c * V[1], V[2]]))

    def _reference(self) -> TwistReference | TrajectoryPoint | None:
        """Return what to follow now; None for nothing, which is zero torque."""
        if self._trajectory is not None:
            return self._trajectory.sample((self._now_ns - self._trajectory_start_ns) * 1e-9)
        if self._twist is None:
            return None
        if self._now_ns - self._twist_ns > self._cmd_vel_timeout * 1e9:
            self._twist = None
            self._timeouts += 1
            self._problems.add("no cmd_vel within cmd_vel_timeout; the torque is zero")
            return None
        return TwistReference(self._twist)

    # --- Control ----------------------------------------------------------------------------------------

    def _on_joint_states(self, message: JointState) -> None:
        if not self._active:
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
            self._disengage()
        except Exception as error:
            self._fault = f"{type(error).__name__}: {error}"
            self._disengage()
            self.get_logger().error(f"zero torque until the next activation\n{traceback.format_exc()}")

    def _control(self, message: JointState, dt: float | None) -> None:
        position, velocity, _ = joint_state_arrays(message, self._joint_index, (self.robot.n, 2))
        if dt is None:
            # Before the first dt there is no odometry; after a gap or a jump the pose is kept and the motion between unknown.
            self._odometry = odometry.initial_state(self._odometry.pose)
        try:
            self._odometry, moved = odometry.update(self.robot, ODOMETRY, self._odometry, position, dt or 1.0)
        except PcwError:
            # The motion since the last usable position is divided by the time since then, or the robot would seem fast.
            self._watch.take_back()
            raise
        reference = self._reference()
        if dt is None or reference is None or self._fault:
            self._disengage()
            return
        if not self._engaged:
            self._state, self._engaged = self._controller.initial_state(moved.twist), True
        measurement = ControllerMeasurement(position, velocity, self._odometry.pose, self._saturated)
        self._state, output = self._controller.step(self._state, measurement, reference, dt)
        limited = limit_torque(self._limits, self._torque, output.torque, velocity, dt)
        if limited.fault:
            raise PcwError("the computed torque is not finite")
        self._torque, self._saturated = limited.torque, limited.saturated
        fill_joint_state(self._message, effort=self._torque)
        self._commands.publish(self._message)

    def _disengage(self) -> None:
        self._engaged, self._saturated = False, False
        self._torque = np.zeros((self.robot.n, 2))
        self._send_zero()

    def _send_zero(self) -> None:
        fill_joint_state(self._message, effort=np.zeros((self.robot.n, 2)))
        self._commands.publish(self._message)

    def _look_after_joint_states(self) -> None:
        if self._active and self._engaged and time.monotonic() - self._heard > self._joint_states_timeout:
            self._timeouts += 1
            self._twist, self._trajectory = None, None
            self._problems.add("no joint_states within joint_states_timeout; the torque is zero")
            self._disengage()

    # --- Diagnostics ------------------------------------------------------------------------------------

    def _refuse(self, what: str) -> None:
        self._refused += 1
        self._problems.add(f"refused: {what}")

    def _status(self) -> Status:
        problems = self._problems.take()
        if not self._active:
            level, message = OK, "not active"
        elif self._fault:
            level, message = ERROR, f"latched: {self._fault}"
        elif problems:
            level, message = WARN, problems
        elif self._silence.since_last_report():
            level, message = WARN, "no joint_states since the last report; the torque is zero"
        else:
            following = "a trajectory" if self._trajectory is not None else "cmd_vel" if self._engaged else "nothing"
            level, message = OK, f"following {following}"
        return Status(
            level, message,
            {
                "timeouts": self._timeouts, "faults": self._faults, "refused": self._refused, "gaps": self._watch.gaps,
                "repeated_stamps": self._watch.repeats, "backward_jumps": self._watch.backward_jumps,
            },
        )


def main(args: Sequence[str] | None = None) -> int:
    """Run the controller."""
    return run_node(ComputedTorqueNode, args)


if __name__ == "__main__":
    raise SystemExit(main())
