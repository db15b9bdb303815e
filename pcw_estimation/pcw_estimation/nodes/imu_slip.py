"""Slip of every wheel against the IMU, all of them at once included: joint_states and imu/data in, slip/imu out."""

from __future__ import annotations

from collections.abc import Sequence

from builtin_interfaces.msg import Time
from rclpy.node import Node

from pcw_description import load_robot
from pcw_description.nodes.diagnostics import WARN, Diagnostics, Status
from pcw_description.nodes.node_tools import Decimator, declare, run_node

from ..imu_slip import Motion
from .imu_stream import ImuStream
from .slip_topics import SlipTopic


class ImuSlipNode(Node):
    """Compares every joint_states with the motion that the IMU carries on, and publishes slip at a lower rate."""

    def __init__(self) -> None:
        super().__init__("imu_slip")
        self.robot = load_robot(declare(self, "robot", "thesis", "robot file, or the name of a shipped robot", read_only=True))
        rate = declare(self, "publish_rate", 100.0, "rate of slip/imu", "Hz", (0.1, 1e4), read_only=True)
        self._decimator = Decimator(rate)
        self._motion: Motion | None = None
        self._all_slip = False
        self._stream = ImuStream(self, self.robot, self._on_motion)  # declares the rest
        self._topic = SlipTopic(self, "slip/imu", self.robot)
        self._diagnostics = Diagnostics(self, self.robot.name, self._status, aspect="slip")

    def _on_motion(self, stamp: Time, dt: float | None, motion: Motion) -> None:
        self._motion = motion
        flagged = bool((motion.finding.slipping | motion.finding.skidding).any(axis=1).all())
        all_slip = motion.all_slip and flagged
        news = self._topic.take(motion.finding) or (all_slip and not self._all_slip)
        self._all_slip |= all_slip
        self._diagnostics.report_news(news)
        # Without an IMU this is the encoders' opinion, which has a topic of its own.
        if motion.inertial and dt is not None and self._decimator.due(dt):
            self._topic.publish(stamp, motion.finding)

    def _status(self) -> Status:
        values = self._stream.values()
        if self._motion is not None:
            values |= {"imu_in_use": self._motion.inertial, "gyro_bias": self._motion.gyro_bias}
        alone = self._motion is None or not self._motion.inertial
        silent = self._stream.silent()
        status = self._topic.status(values, self._stream.problems(), silent, encoders_alone=alone)
        if self._all_slip:
            status = Status(WARN, f"all wheels slip; {status.message}", status.values)
        self._all_slip = False
        return status


def main(args: Sequence[str] | None = None) -> int:
    """Run the slip detector."""
    return run_node(ImuSlipNode, args)


if __name__ == "__main__":
    raise SystemExit(main())
