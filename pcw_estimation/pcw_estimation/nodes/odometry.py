"""Odometry from joint_states, with the covariance that the redundant wheels themselves show."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from geometry_msgs.msg import TransformStamped
from nav_msgs.msg import Odometry
from rclpy.node import Node
from sensor_msgs.msg import JointState

from pcw_description import PcwError, load_robot, odometry
from pcw_description.nodes.diagnostics import OK, WARN, Diagnostics, Problems, Status
from pcw_description.nodes.measured_joints import MeasuredJoints
from pcw_description.nodes.node_tools import (
    SENSOR_SOURCE,
    SENSOR_STREAM,
    Decimator,
    all_declared,
    declare,
    run_node,
)

try:
    from tf2_msgs.msg import TFMessage
except ImportError:  # not everywhere installed; odom alone does without
    TFMessage = None

# x, y and yaw among the rows of a 6x6 covariance; the others are zero because the model is planar, not measured.
_PLANAR = np.ix_([0, 1, 5], [0, 1, 5])


class OdometryNode(Node):
    """Integrates every joint_states and publishes odom, and odom -> base_link on /tf, at a lower rate.

    Each message is stamped with the last measurement in it; its twist is the mean since the message before. After a gap, a
    jump back in time or unusable joints the pose is kept (odom is continuous, REP-105) and the motion between is missing.
    """

    def __init__(self) -> None:
        super().__init__("odometry")
        self.robot = load_robot(declare(self, "robot", "thesis", "robot file, or the name of a shipped robot", read_only=True))
        method = declare(
            self, "method", "differential", "(3.33) or (3.31)", read_only=True, choices=odometry.METHODS
        )
        memory = declare(
            self, "residual_memory", 50.0, "updates over which the residual is averaged for the covariance", "1", (1.0, 1e5),
            read_only=True,
        )
        rate = declare(self, "publish_rate", 100.0, "rate of odom", "Hz", (0.1, 1e4), read_only=True)
        self._odom_frame = declare(self, "odom_frame", "odom", "frame of the pose", read_only=True)
        self._base_frame = declare(self, "base_frame", "base_link", "frame of the twist", read_only=True)
        publish_tf = declare(self, "publish_tf", True, "publish the transform, where tf2_msgs is installed", read_only=True)
        longest_gap = declare(
            self, "longest_gap", 0.5, "longest time between joint_states that is bridged", "s", (0.001, 60.0), read_only=True
        )
        all_declared(self)
        self._parameters_of_odometry = odometry.OdometryParameters(method, memory)
        self._state = odometry.initial_state()
        self._unusable, self._problems = 0, Problems(self)
        self._joints, self._twist = MeasuredJoints(self.robot, ["position"], self._problems, longest_gap), np.zeros(3)
        self._watch = self._joints.watch
        self._decimator = Decimator(rate)
        self._clear_mean()
        self._warm_up()
        self._odom = self.create_publisher(Odometry, "odom", SENSOR_SOURCE)
        self._tf = self.create_publisher(TFMessage, "/tf", 100) if publish_tf and TFMessage is not None else None
        self.create_subscription(JointState, "joint_states", self._on_joint_states, SENSOR_STREAM)
        self._diagnostics = Diagnostics(self, self.robot.name, self._status, aspect="odometry")

    def _warm_up(self) -> None:
        """Have everything compiled before the first measurement."""
        at_rest = np.zeros((self.robot.n, 2))
        first, _ = odometry.update(self.robot, self._parameters_of_odometry, self._state, at_rest, 1.0)
        odometry.update(self.robot, self._parameters_of_odometry, first, at_rest, 1.0)

    def _clear_mean(self) -> None:
        self._duration, self._moved, self._moved_covariance = 0.0, np.zeros(3), np.zeros((3, 3))

    def _on_joint_states(self, message: JointState) -> None:
        if not self._joints.are_in(message):
            return
        dt = self._watch.update(message.header.stamp)
        if self._watch.repeated:
            return
        if dt is None:
            # In a gap the robot may have gone on as it went before; after a jump back nobody knows.
            self._state = odometry.interrupted(self._state, self._twist * self._watch.last_gap)
            self._clear_mean()
        try:
            position, _, _ = self._joints.read(message)
            self._state, output = odometry.update(
                self.robot, self._parameters_of_odometry, self._state, position, dt if dt is not None else 1.0
            )
        except PcwError as error:
            self._watch.take_back()
            self._unusable += 1
            self._problems.add(str(error))
            return
        if dt is None:
            return
        self._twist = output.twist
        self._duration += dt
        self._moved += output.twist * dt
        self._moved_covariance += output.twist_covariance * dt**2
        if self._decimator.due(dt):
            self._publish(message)
            self._clear_mean()

    def _publish(self, measured: JointState) -> None:
        x, y, yaw = self._state.pose.tolist()
        message = Odometry(child_frame_id=self._base_frame)
        message.header.stamp, message.header.frame_id = measured.header.stamp, self._odom_frame
        pose, twist = message.pose.pose, message.twist.twist
        pose.position.x, pose.position.y = x, y
        pose.orientation.z, pose.orientation.w = math.sin(0.5 * yaw), math.cos(0.5 * yaw)
        twist.linear.x, twist.linear.y, twist.angular.z = (self._moved / self._duration).tolist()
        message.pose.covariance = _six_by_six(self._state.pose_covariance)
        message.twist.covariance = _six_by_six(self._moved_covariance / self._duration**2)
        self._odom.publish(message)
        if self._tf is not None:
            transform = TransformStamped(header=message.header, child_frame_id=self._base_frame)
            transform.transform.translation.x, transform.transform.translation.y = x, y
            transform.transform.rotation = pose.orientation
            self._tf.publish(TFMessage(transforms=[transform]))

    def _status(self) -> Status:
        problem = self._joints.silence() or self._problems.take()
        level, text = (WARN, problem) if problem else (OK, "integrating")
        return Status(
            level, text,
            {
                "gaps": self._watch.gaps, "repeated_stamps": self._watch.repeats,
                "backward_jumps": self._watch.backward_jumps, "unusable_joint_states": self._unusable,
            },
        )


def _six_by_six(covariance: np.ndarray) -> np.ndarray:
    full = np.zeros((6, 6))
    full[_PLANAR] = covariance
    return full.ravel()


def main(args: Sequence[str] | None = None) -> int:
    """Run the odometry."""
    return run_node(OdometryNode, args)


if __name__ == "__main__":
    raise SystemExit(main())
