"""What the nodes that find slip share: the noise, the JointState of slip, flags in the diagnostics, the 6x6 covariance."""

from __future__ import annotations

import numpy as np
from builtin_interfaces.msg import Time
from rclpy.node import Node
from sensor_msgs.msg import JointState

from pcw_description.nodes.diagnostics import OK, WARN, Status
from pcw_description.nodes.node_tools import SENSOR_SOURCE, StampWatch, declare, fill_joint_state
from pcw_description.robot_description import RobotDescription

from ..slip_noise import SlipNoise, load_slip_noise
from ..slip_verdict import COMMON_SLIP, REASONS, SlipFinding, Verdict

_DIRECTIONS = ("longitudinal", "lateral")
# x, y and yaw among the rows of a 6x6 covariance; the others are zero because the model is planar, not measured.
_PLANAR = np.ix_([0, 1, 5], [0, 1, 5])


def declare_noise(node: Node, robot: RobotDescription) -> SlipNoise:
    """Declare the parameter `noise` and return what it stands for."""
    path = declare(node, "noise", "", "file that `calibrate` wrote; empty: what the robot file says", read_only=True)
    return load_slip_noise(path, robot) if path else SlipNoise.of_robot(robot)


def six_by_six(covariance: np.ndarray) -> np.ndarray:
    """Return a covariance of (x, y, yaw) (3, 3) as ROS wants it, (36,)."""
    full = np.zeros((6, 6))
    full[_PLANAR] = covariance
    return full.ravel()


class SlipTopic:
    """Publishes slip as a JointState, and remembers which wheels were flagged since the last report."""

    def __init__(self, node: Node, topic: str, robot: RobotDescription) -> None:
        self.names = [f"{caster}_{direction}" for caster in robot.caster_names for direction in _DIRECTIONS]
        self._message = JointState(name=self.names)
        self._publisher = node.create_publisher(JointState, topic, SENSOR_SOURCE)
        self._ever = np.zeros((robot.n, 2), dtype=bool)
        self._finding: SlipFinding | None = None
        self._unknown = False

    def take(self, finding: SlipFinding) -> bool:
        """Note a finding; returns whether it flags what was not flagged since the last report."""
        flagged = finding.slipping | finding.skidding
        unknown = finding.verdict == Verdict.CANNOT_KNOW
        news = bool(np.any(flagged & ~self._ever)) or (unknown and not self._unknown)
        self._ever |= flagged
        self._unknown |= unknown
        self._finding = finding
        return news

    def publish(self, stamp: Time, finding: SlipFinding) -> None:
        """Send slip ratio or angle and slip velocity; `effort` stays empty, as nothing here knows of forces."""
        self._message.header.stamp = stamp
        fill_joint_state(self._message, position=finding.ratio, velocity=finding.slip)
        self._publisher.publish(self._message)

    def status(self, values: dict[str, object], problems: str, silent: str, encoders_alone: bool) -> Status:
        """Return the status since the last report.

        Args:
            values: numbers to report as well.
            problems: what else went wrong, in words.
            silent: which topic went silent, in words; "" for none.
            encoders_alone: no other sensor was asked, so that slip of all wheels alike cannot be excluded.
        """
        finding, found, self._finding = self._finding, "", None  # what was found before the last report is no news
        if finding is not None:
            flagged = ", ".join(name for name, is_flagged in zip(self.names, self._ever.ravel()) if is_flagged)
            if self._unknown:
                found = REASONS[Verdict.CANNOT_KNOW] + (f"; suspected: {flagged}" if flagged else "")
            elif flagged:
                found = f"slip since the last report: {flagged}"
            values["verdict"] = REASONS[finding.verdict]
            for name, slipping, skidding in zip(self.names, finding.slipping.ravel(), finding.skidding.ravel()):
                values[name] = "slipping" if slipping else "skidding" if skidding else "rolling"
            self._ever = finding.slipping | finding.skidding
            self._unknown = finding.verdict == Verdict.CANNOT_KNOW
        if found or problems or silent:
            return Status(WARN, "; ".join(filter(None, [found, problems, silent])), values)
        # That nothing slips is more than encoders can say.
        return Status(OK, f"no slip of one wheel against another; {COMMON_SLIP}" if encoders_alone else "no slip", values)


def stamp_values(watch: StampWatch, unusable: int) -> dict[str, object]:
    """Return what is reported of the stamps of joint_states."""
    return {
        "gaps": watch.gaps, "repeated_stamps": watch.repeats, "backward_jumps": watch.backward_jumps,
        "unusable_joint_states": unusable,
    }
