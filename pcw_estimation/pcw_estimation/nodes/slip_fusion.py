"""The motion of the robot without the wheels that slip: joint_states and imu/data in, slip/twist and odom out."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import TransformStamped, TwistWithCovarianceStamped
from nav_msgs.msg import Odometry
from rclpy.node import Node

from pcw_description import load_robot
from pcw_description.nodes.diagnostics import OK, WARN, Diagnostics, Status
from pcw_description.nodes.node_tools import SENSOR_SOURCE, Decimator, declare, run_node

from ..imu_slip import Motion
from ..slip_verdict import Verdict
from .imu_stream import ImuStream
from .slip_topics import six_by_six

try:
    from tf2_msgs.msg import TFMessage
except ImportError:  # not everywhere installed; odom alone does without
    TFMessage = None


class SlipFusionNode(Node):
    """Integrates every joint_states and imu/data, and publishes slip/twist and odom at a lower rate."""

    def __init__(self) -> None:
        super().__init__("slip_fusion")
        self.robot = load_robot(declare(self, "robot", "thesis", "robot file, or the name of a shipped robot", read_only=True))
        rate = declare(self, "publish_rate", 100.0, "rate of slip/twist and odom", "Hz", (0.1, 1e4), read_only=True)
        self._odom_frame = declare(self, "odom_frame", "odom", "frame of the pose", read_only=True)
        self._base_frame = declare(self, "base_frame", "base_link", "frame of the twist", read_only=True)
        with_odom = declare(self, "publish_odom", True, "publish odom; `odometry` does so as well", read_only=True)
        with_tf = declare(self, "publish_tf", True, "publish the transform, where tf2_msgs is installed", read_only=True)
        self._decimator = Decimator(rate)
        self._motion: Motion | None = None
        self._left_out, self._coasted = 0, 0
        self._stream = ImuStream(self, self.robot, self._on_motion)  # declares the rest
        self._twist = self.create_publisher(TwistWithCovarianceStamped, "slip/twist", SENSOR_SOURCE)
        self._odom = self.create_publisher(Odometry, "odom", SENSOR_SOURCE) if with_odom else None
        send_tf = with_odom and with_tf and TFMessage is not None
        self._tf = self.create_publisher(TFMessage, "/tf", 100) if send_tf else None
        self._diagnostics = Diagnostics(self, self.robot.name, self._status, aspect="fusion")

    def _on_motion(self, stamp: Time, dt: float | None, motion: Motion) -> None:
        self._motion = motion
        self._left_out += bool(motion.finding.suspect.any())
        self._coasted += motion.inertial and not motion.told
        if dt is not None and self._decimator.due(dt):
            self._publish(stamp, motion)

    def _publish(self, stamp: Time, motion: Motion) -> None:
        finding = motion.finding
        numbers = np.concatenate([finding.twist, finding.covariance.ravel(), motion.pose, motion.pose_covariance.ravel()])
        if not math.isfinite(numbers.sum()):
            return
        velocity = TwistWithCovarianceStamped()
        velocity.header.stamp, velocity.header.frame_id = stamp, self._base_frame
        twist = velocity.twist.twist
        twist.linear.x, twist.linear.y, twist.angular.z = finding.twist.tolist()
        velocity.twist.covariance = six_by_six(finding.covariance)
        self._twist.publish(velocity)
        if self._odom is None:
            return
        message = Odometry(child_frame_id=self._base_frame, twist=velocity.twist)
        message.header.stamp, message.header.frame_id = stamp, self._odom_frame
        pose = message.pose.pose
        pose.position.x, pose.position.y, yaw = motion.pose.tolist()
        pose.orientation.z, pose.orientation.w = math.sin(0.5 * yaw), math.cos(0.5 * yaw)
        message.pose.covariance = six_by_six(motion.pose_covariance)
        self._odom.publish(message)
        if self._tf is not None:
            transform = TransformStamped(header=message.header, child_frame_id=self._base_frame)
            transform.transform.translation.x, transform.transform.translation.y = pose.position.x, pose.position.y
            transform.transform.rotation = pose.orientation
            self._tf.publish(TFMessage(transforms=[transform]))

    def _status(self) -> Status:
        values = self._stream.values()
        values |= {"measurements_with_slip": self._left_out, "measurements_by_imu_alone": self._coasted}
        silent, problems, motion = self._stream.silent(), self._stream.problems(), self._motion
        if motion is not None:
            values |= {"imu_in_use": motion.inertial, "gyro_bias": motion.gyro_bias}
        if problems:
            return Status(WARN, problems, values)
        if silent:
            return Status(WARN, silent, values)
        if motion is not None and motion.finding.verdict == Verdict.CANNOT_KNOW:
            return Status(WARN, "no wheel is known to roll, and there is no IMU to go by", values)
        if motion is not None and not motion.told:
            return Status(WARN, "the wheels that do not slip do not tell the speed: the IMU goes on alone", values)
        return Status(OK, "integrating", values)


def main(args: Sequence[str] | None = None) -> int:
    """Run the fusion."""
    return run_node(SlipFusionNode, args)


if __name__ == "__main__":
    raise SystemExit(main())
