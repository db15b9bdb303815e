"""What the controller node hears besides joint_states: what is wanted, and what estimators say of the ground."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseStamped, Twist, TwistStamped, WrenchStamped
from rclpy.node import Node
from sensor_msgs.msg import JointState

from pcw_description.nodes.node_tools import COMMAND, SENSOR, joint_state_arrays
from pcw_description.robot_description import RobotDescription

SLIP_SOURCES = ("none", "slip/encoder", "slip/imu", "slip/observer")


class Refused(ValueError):
    """A message that cannot be used; says which and what is allowed."""


def twist_of(message: TwistStamped | Twist, stamped: bool) -> np.ndarray:
    """Return the twist (3,) of a cmd_vel.

    Raises:
        Refused: not finite, or in another frame than base_link.
    """
    twist, frame = (message.twist, message.header.frame_id) if stamped else (message, "")
    values = np.array([twist.linear.x, twist.linear.y, twist.angular.z])
    if not np.isfinite(values).all() or frame not in ("", "base_link"):
        raise Refused(f"cmd_vel {values.tolist()} in frame {frame!r}; allowed: finite numbers in base_link")
    return values


def pose_of(message: PoseStamped) -> np.ndarray:
    """Return the pose (3,) of a goal_pose; the yaw of any rotation, a goal off the plane is taken onto it.

    Raises:
        Refused: not finite, no unit quaternion, or in another frame than odom.
    """
    position, q = message.pose.position, message.pose.orientation
    yaw = math.atan2(2.0 * (q.w * q.z + q.x * q.y), 1.0 - 2.0 * (q.y * q.y + q.z * q.z))
    goal = np.array([position.x, position.y, yaw])
    frame = message.header.frame_id
    norm = q.w * q.w + q.x * q.x + q.y * q.y + q.z * q.z
    if frame not in ("", "odom") or not np.isfinite(goal).all() or not 0.5 < norm < 2.0:
        raise Refused(f"goal_pose {goal.tolist()} in frame {frame!r}; allowed: finite numbers, a unit quaternion, in odom")
    return goal


def wrench_of(message: WrenchStamped, topic: str) -> np.ndarray:
    """Return the wrench (3,) in the plane.

    Raises:
        Refused: not finite, or in another frame than base_link.
    """
    force, torque, frame = message.wrench.force, message.wrench.torque, message.header.frame_id
    values = np.array([force.x, force.y, torque.z])
    if not np.isfinite(values).all() or frame not in ("", "base_link"):
        raise Refused(f"{topic} {values.tolist()} in frame {frame!r}; allowed: finite numbers in base_link")
    return values


class OptionalInputs:
    """What only some controllers use: slip, terrain, a measured and a wanted wrench; each with its age.

    Args:
        node: the node that subscribes.
        robot: the robot.
        slip_source: one of `SLIP_SOURCES`.
        now_ns: the time of joint_states now [ns], in which ages are counted.
        refuse: told of every message that cannot be used.
    """

    def __init__(
        self, node: Node, robot: RobotDescription, slip_source: str, now_ns: Callable[[], int], refuse: Callable[[str], None]
    ) -> None:
        self._robot, self._now_ns, self._refuse = robot, now_ns, refuse
        names = [f"{name}_{axis}" for name in robot.caster_names for axis in ("longitudinal", "lateral")]
        self._slip_index = {name: i for i, name in enumerate(names)}
        self._caster_index = {name: i for i, name in enumerate(robot.caster_names)}
        self._nominal = np.array([[tyre.mu_p, tyre.lambda_p] for tyre in robot.tyres])
        self.forget()
        topics: list[tuple[type, str, Callable[[Any], None], Any]] = [
            (JointState, "terrain", self._on_terrain, SENSOR),
            (WrenchStamped, "ft_sensor/wrench", self._on_measured, SENSOR),
            (WrenchStamped, "wrench_cmd", self._on_wanted, COMMAND),
        ]
        if slip_source != "none":
            topics.append((JointState, slip_source, self._on_slip, SENSOR))
        self.subscriptions = [node.create_subscription(*topic) for topic in topics]

    def forget(self) -> None:
        """Forget everything that was heard."""
        self._heard: dict[str, tuple[int, Any]] = {}

    def fresh(self, name: str, timeout: float) -> Any:
        """Return what was heard of `slip`, `terrain`, `measured` or `wanted`, None if it is older than `timeout` [s]."""
        at, value = self._heard.get(name, (None, None))
        return None if at is None or not 0 <= self._now_ns() - at <= timeout * 1e9 else value

    def _store(self, name: str, value: Any) -> None:
        self._heard[name] = (self._now_ns(), value)

    def _on_slip(self, message: JointState) -> None:
        _, slip, _ = joint_state_arrays(message, self._slip_index, (self._robot.n, 2))
        valid = np.isfinite(slip)
        if valid.any():  # a message in which nothing is vouched for is as good as none
            self._store("slip", (np.where(valid, slip, 0.0), valid))

    def _on_terrain(self, message: JointState) -> None:
        critical, _, friction = joint_state_arrays(message, self._caster_index, (self._robot.n,))
        if np.isfinite(friction).any() or np.isfinite(critical).any():
            known = np.stack([friction, critical], axis=1)
            filled = np.where(np.isfinite(known) & (known > 0.0), known, self._nominal)
            self._store("terrain", (filled[:, 0].copy(), filled[:, 1].copy()))

    def _on_measured(self, message: WrenchStamped) -> None:
        self._take("measured", "ft_sensor/wrench", message)

    def _on_wanted(self, message: WrenchStamped) -> None:
        self._take("wanted", "wrench_cmd", message)

    def _take(self, name: str, topic: str, message: WrenchStamped) -> None:
        try:
            self._store(name, wrench_of(message, topic))
        except Refused as error:
            self._heard.pop(name, None)
            self._refuse(str(error))
