"""Readings of the simulated robot as messages, on the topics of a real robot."""

from __future__ import annotations

import math

import numpy as np
from geometry_msgs.msg import WrenchStamped
from nav_msgs.msg import Odometry
from rclpy.node import Node
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import Imu, JointState

from pcw_description.nodes.node_tools import SENSOR_STREAM_SOURCE, fill_joint_state, ns_to_stamp
from pcw_description.robot_description import LATERAL, LONGITUDINAL, RobotDescription

from ..plants.plant import PlantState
from ..sensors import ImuReading, JointReading
from ..simulated_robot import NANOSECONDS, Sample, TrackedPose
from ..stamping import TopicStamps


class BridgePublishers:
    """The bridge's publishers and their messages, made once and filled again and again.

    What a robot sends has the stamps and losses of `stamps`; /clock and the contact forces are the simulator's own.

    Attributes:
        joint_states_stamp_ns: stamp of the newest joint_states [ns].
        joint_states_lost: whether it was lost.
    """

    def __init__(self, node: Node, robot: RobotDescription, clock_rate: float, stamps: TopicStamps) -> None:
        self._stamps = stamps
        self.joint_states_stamp_ns, self.joint_states_lost = 0, False
        self._clock_period_ns, self._next_clock_ns = round(NANOSECONDS / clock_rate), 0
        self._clock = node.create_publisher(Clock, "/clock", 1)
        self.joint_states = node.create_publisher(JointState, "joint_states", SENSOR_STREAM_SOURCE)
        self._truth = node.create_publisher(Odometry, "ground_truth/odom", SENSOR_STREAM_SOURCE)
        # A robot without an IMU has no such topic, rather than a silent one.
        self._imu = node.create_publisher(Imu, "imu/data", SENSOR_STREAM_SOURCE) if robot.sensors.imu else None
        self._contacts = [
            node.create_publisher(WrenchStamped, f"contact/{name}/wrench", SENSOR_STREAM_SOURCE) for name in robot.caster_names
        ]
        self._joint_message = JointState(name=list(robot.joint_names))
        self._imu_message = _imu_message(robot)
        self._truth_message = _truth_message(robot)
        self._contact_messages = [WrenchStamped() for _ in robot.caster_names]
        for message, name in zip(self._contact_messages, robot.caster_names):
            message.header.frame_id = f"{name}_fork"  # turns with the heading, as the wheel frame does

    def publish(self, sample: Sample) -> None:
        """Publish one reading; the joints are preceded by /clock where that is due, so that whoever answers knows the time."""
        reading = sample.reading
        if isinstance(reading, JointReading):
            self._publish_clock(sample.time_ns)
            self._publish_joints(sample.time_ns, reading)
        elif isinstance(reading, ImuReading) and self._imu is not None:
            self._publish_imu(sample.time_ns, reading)
        elif isinstance(reading, TrackedPose):
            self._publish_truth(sample.time_ns, reading)
        elif isinstance(reading, PlantState):
            self._publish_contacts(ns_to_stamp(sample.time_ns), reading)

    def reset(self) -> None:
        """Begin anew at time zero."""
        self._stamps.reset()

    def _publish_joints(self, time_ns: int, reading: JointReading) -> None:
        self.joint_states_stamp_ns, self.joint_states_lost = self._stamps.stamp("joint_states", time_ns)
        if not self.joint_states_lost:
            self._joint_message.header.stamp = ns_to_stamp(self.joint_states_stamp_ns)
            fill_joint_state(self._joint_message, reading.position, reading.velocity, reading.effort)
            self.joint_states.publish(self._joint_message)

    def _publish_imu(self, time_ns: int, reading: ImuReading) -> None:
        stamp_ns, lost = self._stamps.stamp("imu/data", time_ns)
        if lost:
            return
        message = self._imu_message
        message.header.stamp = ns_to_stamp(stamp_ns)
        for vector, values in (
            (message.angular_velocity, reading.angular_velocity),
            (message.linear_acceleration, reading.linear_acceleration),
        ):
            vector.x, vector.y, vector.z = values.tolist()
        self._imu.publish(message)

    def _publish_clock(self, time_ns: int) -> None:
        if time_ns < self._next_clock_ns - self._clock_period_ns:
            self._next_clock_ns = 0  # set back by a reset
        if time_ns >= self._next_clock_ns:
            self._next_clock_ns = time_ns - time_ns % self._clock_period_ns + self._clock_period_ns
            self._clock.publish(Clock(clock=ns_to_stamp(time_ns)))

    def _publish_truth(self, time_ns: int, reading: TrackedPose) -> None:
        stamp_ns, lost = self._stamps.stamp("ground_truth/odom", time_ns)
        if lost:
            return
        message = self._truth_message
        message.header.stamp = ns_to_stamp(stamp_ns)
        pose, twist = message.pose.pose, message.twist.twist
        x, y, yaw = reading.pose.tolist()
        pose.position.x, pose.position.y = x, y
        pose.orientation.z, pose.orientation.w = math.sin(0.5 * yaw), math.cos(0.5 * yaw)
        twist.linear.x, twist.linear.y, twist.angular.z = reading.truth.twist.tolist()
        self._truth.publish(message)

    def _publish_contacts(self, stamp, truth: PlantState) -> None:  # noqa: ANN001
        if not any(publisher.get_subscription_count() for publisher in self._contacts):
            return  # n messages that no real robot sends: not made for nobody
        for i, (publisher, message) in enumerate(zip(self._contacts, self._contact_messages)):
            message.header.stamp = stamp
            force = message.wrench.force
            force.x = float(truth.contact_force[i, LONGITUDINAL])
            force.y = float(truth.contact_force[i, LATERAL])
            force.z = float(truth.normal_force[i])
            publisher.publish(message)


def _imu_message(robot: RobotDescription) -> Imu:
    message = Imu()
    message.header.frame_id = "imu_link"
    message.orientation_covariance[0] = -1.0  # sensor_msgs/Imu: no orientation in this message
    if robot.sensors.imu is not None:
        message.angular_velocity_covariance = (np.eye(3) * robot.sensors.imu.gyro_noise**2).ravel()
        message.linear_acceleration_covariance = (np.eye(3) * robot.sensors.imu.accelerometer_noise**2).ravel()
    return message


def _truth_message(robot: RobotDescription) -> Odometry:
    """Pose with the tracker's noise and its covariance; the twist is the simulator's truth, its covariance zero."""
    message = Odometry(child_frame_id="base_link")
    message.header.frame_id = "map"  # fixed to the world, where odom drifts (REP-105)
    if robot.sensors.tracker is not None:
        position, yaw = robot.sensors.tracker.position_noise**2, robot.sensors.tracker.yaw_noise**2
        message.pose.covariance[0] = message.pose.covariance[7] = position
        message.pose.covariance[35] = yaw
    return message
