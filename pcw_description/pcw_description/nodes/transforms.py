"""Publishes on /tf what a viewer needs and nobody else publishes: forks and wheels from the joints, base_link in the world."""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from functools import partial

import numpy as np
from geometry_msgs.msg import TransformStamped
from nav_msgs.msg import Odometry
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from sensor_msgs.msg import JointState

from ..errors import PcwError
from ..frame_tree import Frame, PoseTrack, drift_of_odometry, planar_frame, robot_frames
from ..robot_description import DRIVE, STEER
from ..robot_file import load_robot
from .diagnostics import OK, WARN, Diagnostics, Problems, Status
from .measured_joints import MeasuredJoints
from .node_tools import (
    SENSOR,
    SENSOR_STREAM,
    all_declared,
    declare,
    joint_state_arrays,
    ns_to_stamp,
    run_node,
    stamp_to_ns,
)

try:
    from tf2_msgs.msg import TFMessage
except ImportError:  # not everywhere installed
    TFMessage = None

# What `base` may be -> the topics that it needs.
BASES = {"none": (), "odom": ("odom",), "ground_truth": ("ground_truth/odom",), "drift": ("odom", "ground_truth/odom")}


class TransformsNode(Node):
    """Turns joint_states and poses into transforms, each measurement once, at a lower rate.

    A frame must have one source, or it jumps between two; hence the parameters, which leave to others what others do.

    Raises:
        PcwError: tf2_msgs is not installed.
    """

    def __init__(self) -> None:
        super().__init__("transforms")
        self.robot = load_robot(declare(self, "robot", "thesis", "robot file, or the name of a shipped robot", read_only=True))
        rate = declare(self, "rate", 50.0, "rate of the transforms, real time", "Hz", (1.0, 1000.0), read_only=True)
        joints = declare(self, "joints", True, "publish the links; not beside a robot_state_publisher", read_only=True)
        self._base = declare(
            self, "base", "drift",
            "odom: odom -> base_link; ground_truth: map -> base_link; drift: map -> odom, if others publish odom -> base_link",
            read_only=True, choices=tuple(BASES),
        )  # fmt: skip
        all_declared(self)
        if TFMessage is None:
            raise PcwError("transforms need the package tf2_msgs, which is not installed; it comes with a ROS 2 installation")
        self._joint_index = {name: i for i, name in enumerate(self.robot.joint_names)}
        self._joint_states: JointState | None = None
        self._poses: dict[str, Odometry] = {}  # the newest by topic, until used
        self._tracks = {topic: PoseTrack() for topic in BASES[self._base]}
        self._sent, self._problems = 0, Problems(self)
        self._joints = MeasuredJoints(self.robot, ["position"], self._problems) if joints else None
        self._tf = self.create_publisher(TFMessage, "/tf", 100)
        if self._joints is not None:
            on_joint_states = partial(self._on_joint_states, self._joints)
            self.create_subscription(JointState, "joint_states", on_joint_states, SENSOR)
        for topic in BASES[self._base]:
            self.create_subscription(Odometry, topic, partial(self._on_pose, topic), SENSOR_STREAM)
        self.create_timer(1.0 / rate, self._publish, clock=Clock(clock_type=ClockType.STEADY_TIME))
        self._diagnostics = Diagnostics(self, self.robot.name, self._status, aspect="transforms")

    def _on_joint_states(self, joints: MeasuredJoints, message: JointState) -> None:
        if joints.are_in(message):
            joints.watch.update(message.header.stamp)
            self._joint_states = message

    def _on_pose(self, topic: str, message: Odometry) -> None:
        position, rotation = message.pose.pose.position, message.pose.pose.orientation
        pose = np.array([position.x, position.y, 2.0 * math.atan2(rotation.z, rotation.w)])
        if not np.isfinite(pose).all():
            self._problems.add(f"{topic}: a pose that is not a number; left out")
            return
        self._tracks[topic].add(stamp_to_ns(message.header.stamp), pose)
        self._poses[topic] = message

    def _publish(self) -> None:
        transforms = self._links() + self._base_link()
        if transforms:
            self._tf.publish(TFMessage(transforms=transforms))
            self._sent += len(transforms)

    def _links(self) -> list[TransformStamped]:
        """The links of the newest joint_states; none if there is nothing new."""
        message, self._joint_states = self._joint_states, None
        if message is None:
            return []
        position, _, _ = joint_state_arrays(message, self._joint_index, (self.robot.n, 2))
        unknown = [
            f"{caster}_{joint}" for i, caster in enumerate(self.robot.caster_names)
            for joint, axis in (("drive", DRIVE), ("steer", STEER)) if not math.isfinite(position[i, axis])
        ]  # fmt: skip
        if unknown:
            self._problems.add(f"joint_states: no position of {', '.join(unknown)}; frames left out")
        stamp_ns = stamp_to_ns(message.header.stamp)
        return [_transform(frame, stamp_ns) for frame in robot_frames(self.robot, position)]

    def _base_link(self) -> list[TransformStamped]:
        """base_link or odom in the world, at the newest time that all of their topics have reached; none if nothing is new."""
        if self._base == "none" or self._poses.keys() != self._tracks.keys():
            return []
        time_ns = min(track.newest or 0 for track in self._tracks.values())
        poses = [track.at(time_ns) for track in self._tracks.values()]
        if any(pose is None for pose in poses):
            return []  # one stream went back in time, the other will follow
        if self._base == "drift":
            child = self._poses["odom"].header.frame_id
            parent = self._poses["ground_truth/odom"].header.frame_id
            pose = drift_of_odometry(poses[1], poses[0])
        else:
            [message], [pose] = self._poses.values(), poses
            parent, child = message.header.frame_id, message.child_frame_id
        self._poses.clear()
        return [_transform(planar_frame(parent, child, pose), time_ns)]

    def _status(self) -> Status:
        silence = self._joints.silence() if self._joints is not None else ""
        problems, sent = self._problems.take() or silence, self._sent
        self._sent = 0
        level, text = (WARN, problems) if problems else (OK, "publishing")
        if not sent and not problems:
            level, text = WARN, "nothing to publish since the last report"
        return Status(level, text, {"transforms_since_last_report": sent})


def _transform(frame: Frame, time_ns: int) -> TransformStamped:
    message = TransformStamped(child_frame_id=frame.child)
    message.header.frame_id, message.header.stamp = frame.parent, ns_to_stamp(time_ns)
    place, turn = message.transform.translation, message.transform.rotation
    place.x, place.y, place.z = frame.position.tolist()
    turn.x, turn.y, turn.z, turn.w = frame.quaternion.tolist()
    return message


def main(args: Sequence[str] | None = None) -> int:
    """Run the node until it is told to stop."""
    return run_node(TransformsNode, args)


if __name__ == "__main__":
    sys.exit(main())
