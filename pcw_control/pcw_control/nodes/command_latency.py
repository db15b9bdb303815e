"""How long a controller takes to answer joint_states by joint_commands, both through DDS, composed in one process.

    ros2 run pcw_control command_latency --ros-args -p controller:=friction_optimal_slip_constraint -p cycles:=10000

A node that plays a robot which rolls a little slower than the 0.3 m/s that are wanted, so that torques are needed in every
cycle, stands beside the controller in one process and one executor. It publishes joint_states at a fixed rate of real time and
takes the time until the answer with the same stamp has come back to it. Prints median, p99 and worst, and how many had no
answer by the end, and ends. To be run on a machine that does nothing else.
"""

from __future__ import annotations

import time
from collections.abc import Sequence

import numpy as np
from geometry_msgs.msg import TwistStamped
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from sensor_msgs.msg import JointState

from pcw_description.differential_kinematics import inverse_kinematics
from pcw_description.nodes.node_tools import (
    COMMAND,
    COMMAND_SOURCE,
    SENSOR_SOURCE,
    all_declared,
    declare,
    fill_joint_state,
    ns_to_stamp,
    run_nodes,
    stamp_to_ns,
)

from .controller import ControllerNode

TWIST = np.array([0.3, 0.0, 0.0])
LEFT_BEHIND = 0.05  # part of it that the robot does not reach
NOT_COUNTED = 500  # cycles at the start: discovery, and what is compiled or allocated late
WAIT_CYCLES = 100  # after the last question


class _ComposedController(ControllerNode):
    """The controller, which ends with the measurement."""

    finished = False


class LatencyNode(Node):
    """Asks and takes the time."""

    def __init__(self, made: list[_ComposedController]) -> None:
        super().__init__("command_latency")
        rate: float = declare(self, "rate", 500.0, "rate of joint_states", "Hz", (1.0, 2000.0), read_only=True)
        self._cycles: int = declare(self, "cycles", 10_000, "answers that are counted", "", (100, 10_000_000), read_only=True)
        all_declared(self)
        (self._controller,) = made
        robot = self._controller.robot
        self._period_ns = round(1e9 / rate)
        self._rates = inverse_kinematics(robot, np.zeros(robot.n), (1.0 - LEFT_BEHIND) * TWIST)
        self._position = np.zeros((robot.n, 2))
        self._message = JointState(name=list(robot.joint_names))
        self._twist = TwistStamped()
        self._twist.header.frame_id, self._twist.twist.linear.x = "base_link", float(TWIST[0])
        self._asked = np.zeros(NOT_COUNTED + self._cycles, dtype=np.int64)
        self._answered = np.zeros_like(self._asked)
        self._cycle, self._torque, self.finished = 0, 0, False
        self._states = self.create_publisher(JointState, "joint_states", SENSOR_SOURCE)
        self._wanted = self.create_publisher(TwistStamped, "cmd_vel", COMMAND)
        self._subscription = self.create_subscription(JointState, "joint_commands", self._on_command, COMMAND_SOURCE)
        self._timer = self.create_timer(1.0 / rate, self._ask, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def _ask(self) -> None:
        cycle = self._cycle
        self._cycle += 1
        if cycle >= len(self._asked):
            if cycle >= len(self._asked) + WAIT_CYCLES and not self.finished:
                self._report()
            return
        if cycle % 50 == 0:
            self._wanted.publish(self._twist)
        self._position += self._rates * self._period_ns * 1e-9
        self._message.header.stamp = ns_to_stamp((cycle + 1) * self._period_ns)
        fill_joint_state(self._message, position=self._position, velocity=self._rates)
        self._asked[cycle] = time.perf_counter_ns()
        self._states.publish(self._message)

    def _on_command(self, message: JointState) -> None:
        now = time.perf_counter_ns()
        cycle = stamp_to_ns(message.header.stamp) // self._period_ns - 1
        if 0 <= cycle < len(self._answered) and not self._answered[cycle]:
            self._answered[cycle] = now
            self._torque += any(message.effort)

    def _report(self) -> None:
        asked, answered = self._asked[NOT_COUNTED:], self._answered[NOT_COUNTED:]
        heard = answered > 0
        if heard.any():
            took = 1e-6 * (answered - asked)[heard]
            found = f"median {np.median(took):.3f} ms, p99 {np.percentile(took, 99):.3f} ms, worst {took.max():.3f} ms"
        else:
            found = "no answer at all"
        name = self._controller.get_parameter("controller").value
        print(
            f"{self._controller.robot.name}, {name}, joint_states at {1e9 / self._period_ns:g} Hz: joint_states to "
            f"joint_commands {found}; {int(np.sum(~heard))} of {len(asked)} without an answer, {self._torque} with torque",
            flush=True,
        )
        self._controller.finished = self.finished = True


def main(args: Sequence[str] | None = None) -> int:
    """Run the measurement."""
    made: list[_ComposedController] = []

    def controller() -> _ComposedController:
        made.append(_ComposedController())
        return made[0]

    return run_nodes([controller, lambda: LatencyNode(made)], args)


if __name__ == "__main__":
    raise SystemExit(main())
