"""Drives an excitation of pcw_control by cmd_vel in simulated time, once everybody who shall see it is there."""

from __future__ import annotations

import time
from collections.abc import Sequence

from geometry_msgs.msg import Twist, TwistStamped
from rclpy.clock import Clock as RclpyClock
from rclpy.clock import ClockType
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.task import Future
from rosgraph_msgs.msg import Clock
from std_srvs.srv import SetBool

from pcw_control.excitation import EXCITATIONS, read_excitation
from pcw_description.errors import PcwError
from pcw_description.nodes.node_tools import (
    COMMAND_SOURCE,
    SENSOR,
    all_declared,
    declare,
    run_node,
    stamp_to_ns,
    wait_until_heard,
)
from pcw_description.robot_file import load_robot

# What has to be heard by a node of `wait_for` before the simulation starts, if the node listens to it at all.
PROGRESS_PERIOD = 2.0  # real time between two lines on the progress [s]
HEARD = ("joint_states", "joint_commands", "cmd_vel", "imu/data", "ground_truth/odom")


class ManoeuvreNode(Node):
    """Waits for the nodes of `wait_for`, lets a paused bridge run, drives, pauses the bridge again and ends.

    A node is there when it subscribes to joint_states; a recorder, when it subscribes to all that tells of the robot.
    """

    def __init__(self) -> None:
        super().__init__("manoeuvre")
        name = declare(
            self, "manoeuvre", "identification", f"which one: {', '.join(EXCITATIONS)}; or a file from mismatch suggest",
            read_only=True,
        )
        robot = declare(self, "robot", "thesis", "to measure for whom: robot file, or shipped robot", read_only=True)
        seed = declare(self, "seed", 0, "of what the manoeuvre draws", range=(0, 2**31 - 1), read_only=True)
        duration = declare(self, "duration", 0.0, "length; 0 is its own", "s", (0.0, 3600.0), read_only=True)
        rate = declare(self, "rate", 50.0, "rate of cmd_vel, simulated time", "Hz", (1.0, 1000.0), read_only=True)
        self._wait_for = declare(self, "wait_for", Parameter.Type.STRING_ARRAY, "nodes that must listen first", read_only=True)
        self._patience = declare(
            self, "patience", 60.0, "give up after so long in vain, real time", "s", (1.0, 3600.0), read_only=True
        )
        all_declared(self)
        self._manoeuvre = read_excitation(name, load_robot(robot), duration or None, seed)
        self._period_ns = round(1e9 / rate)
        self._start_ns: int | None = None
        self._next_ns = 0
        self._phase = "waiting"
        self._heard = self._told = time.monotonic()
        self._answer: Future | None = None
        self.finished = False
        self._command = TwistStamped()
        self._command.header.frame_id = "base_link"
        self._cmd_vel = self.create_publisher(TwistStamped, "cmd_vel", COMMAND_SOURCE)
        self._pause = self.create_client(SetBool, "bridge/pause")
        self.create_subscription(Clock, "/clock", self._on_clock, SENSOR)
        self.create_timer(0.05, self._look_round, clock=RclpyClock(clock_type=ClockType.STEADY_TIME))

    def _look_round(self) -> None:
        if time.monotonic() - self._heard > self._patience:
            missing = f"; missing: {', '.join(self._missing())}" if self._phase == "waiting" else ""
            raise PcwError(f"nothing happened for {self._patience:g} s while {self._phase}{missing}")
        if self._phase == "waiting" and not self._missing():
            self._phase = "starting"
            self._answer = self._pause.call_async(SetBool.Request(data=False))
        elif self._phase == "starting" and self._answer is not None and self._answer.done():
            self._phase = "driving"
        elif self._phase == "stopping" and self._answer is not None and self._answer.done():
            self.finished = True

    def _missing(self) -> list[str]:
        if not self._pause.service_is_ready():
            return ["bridge/pause"]
        missing = []
        for topic in (topic for topic in HEARD if self.count_publishers(topic) > 0):
            listeners = {info.node_name for info in self.get_subscriptions_info_by_topic(self.resolve_topic_name(topic))}
            wanted = self._wait_for if topic == "joint_states" else [name for name in self._wait_for if name == "recorder"]
            missing += [f"{name} on {topic}" for name in wanted if name not in listeners]
        return missing

    def _on_clock(self, message: Clock) -> None:
        self._heard = time.monotonic()
        now_ns = stamp_to_ns(message.clock)
        if self._phase not in ("starting", "driving") or now_ns < self._next_ns:
            return
        if self._start_ns is None:
            self._start_ns = now_ns
        self._next_ns = now_ns + self._period_ns
        elapsed = (now_ns - self._start_ns) * 1e-9
        if self._heard - self._told > PROGRESS_PERIOD:
            self._told = self._heard
            self.get_logger().info(f"progress {elapsed:.1f} of {self._manoeuvre.duration:.1f} s")
        twist = self._manoeuvre.twist(elapsed)
        if twist is not None:  # else the motors shall be off, which a controller does that no longer hears of cmd_vel
            command = self._command
            command.header.stamp = message.clock
            command.twist.linear.x, command.twist.linear.y, command.twist.angular.z = twist.tolist()
            self._cmd_vel.publish(command)
        if elapsed >= self._manoeuvre.duration:
            self._phase = "stopping"
            self._answer = self._pause.call_async(SetBool.Request(data=True))

    def close(self) -> None:
        """Leave the robot with a command to stand, once it has arrived."""
        if self._start_ns is not None and not self.finished:  # it may drive before the bridge's answer has been seen
            self._command.twist = Twist()
            self._cmd_vel.publish(self._command)
            wait_until_heard(self._cmd_vel)


def main(args: Sequence[str] | None = None) -> int:
    """Run the manoeuvre."""
    return run_node(ManoeuvreNode, args)


if __name__ == "__main__":
    raise SystemExit(main())
