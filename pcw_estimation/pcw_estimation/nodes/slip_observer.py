"""Slip, motion and contact forces from joints and motor torques alone: joint_states in, slip/observer out."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from rclpy.node import Node
from sensor_msgs.msg import JointState

from pcw_description import PcwError, load_robot
from pcw_description.nodes.diagnostics import OK, WARN, Diagnostics, Problems, Status
from pcw_description.nodes.measured_joints import MeasuredJoints
from pcw_description.nodes.node_tools import (
    SENSOR_SOURCE,
    SENSOR_STREAM,
    Decimator,
    all_declared,
    declare,
    fill_joint_state,
    run_node,
)

from ..motor_current_slip import RobotCurrentDetector
from ..robot_sliding_mode_observer import RobotSlidingModeObserver
from ..sliding_mode_observer import MEASURED, SlidingModeParameters
from ..slip_estimate import JointMeasurement, SlipEstimate
from ..slip_kalman_filter import RobotKalmanFilter

METHODS = ("sliding_mode", "kalman_filter", "motor_current")
_DIRECTIONS = ("longitudinal", "lateral")


class SlipObserverNode(Node):
    """Runs one of the slip observers on every joint_states and publishes at a lower rate.

    A field of slip/observer is sent only while the observer vouches for all its entries, else it is left empty. After a gap or
    a jump back in time the observer begins anew.
    """

    def __init__(self) -> None:
        super().__init__("slip_observer")
        self.robot = load_robot(declare(self, "robot", "thesis", "robot file, or the name of a shipped robot", read_only=True))
        method = declare(self, "method", METHODS[0], "observer", read_only=True, choices=METHODS)
        measured = declare(self, "measured", MEASURED[0], "what sliding_mode measures", read_only=True, choices=MEASURED)
        tolerance = declare(
            self, "mass_tolerance", 0.1, "how far the mass may be off, a payload included", "1", (0.0, 0.5), read_only=True
        )
        rate = declare(
            self, "publish_rate", 100.0, "rate of slip/observer; at most that of joint_states", "Hz", (0.1, 1e4),
            read_only=True,
        )  # fmt: skip
        longest_gap = declare(
            self, "longest_gap", 0.1, "longest time between joint_states that is bridged", "s", (0.001, 1.0), read_only=True
        )
        all_declared(self)
        if method == "sliding_mode":
            parameters = SlidingModeParameters(measured=measured, mass_tolerance=tolerance)
            self._observer = RobotSlidingModeObserver(self.robot, parameters)
        else:
            self._observer = (RobotKalmanFilter if method == "kalman_filter" else RobotCurrentDetector)(self.robot)
        self._warm_up()
        self._state = self._observer.initial_state()
        self._estimate: SlipEstimate | None = None
        by_angle = (method, measured) == ("sliding_mode", "angle")
        needed = ["position", "effort"] if by_angle else ["position", "velocity", "effort"]
        self._unusable, self._problems = 0, Problems(self)
        self._joints = MeasuredJoints(self.robot, needed, self._problems, longest_gap)
        self._watch = self._joints.watch
        self._decimator = Decimator(rate)
        self._names = [f"{caster}_{direction}" for caster in self.robot.caster_names for direction in _DIRECTIONS]
        self._message = JointState(name=self._names)
        self._slip = self.create_publisher(JointState, "slip/observer", SENSOR_SOURCE)
        self.create_subscription(JointState, "joint_states", self._on_joint_states, SENSOR_STREAM)
        self._diagnostics = Diagnostics(self, self.robot.name, self._status, aspect="slip")

    def _warm_up(self) -> None:
        """Have everything compiled before the first measurement."""
        at_rest = np.zeros((self.robot.n, 2))
        state = self._observer.initial_state()
        for _ in range(3):
            state, _ = self._observer.step(state, JointMeasurement(at_rest, at_rest, at_rest), 1e-3)

    def _on_joint_states(self, message: JointState) -> None:
        if not self._joints.are_in(message):
            return
        dt = self._watch.update(message.header.stamp)
        if self._watch.repeated:
            return
        if dt is None:
            self._state, self._estimate = self._observer.initial_state(), None
            if self._watch.last_gap:
                allowed = f"at most longest_gap = {self._watch.longest_gap:g} s"
                self._problems.add(f"joint_states: none for {self._watch.last_gap:.3g} s; allowed: {allowed}; it begins anew")
        try:
            position, velocity, effort = self._joints.read(message)
            # The first reading has nothing before it, and its dt means nothing.
            self._state, estimate = self._observer.step(self._state, JointMeasurement(position, velocity, effort), dt or 1e-3)
        except PcwError as error:
            self._watch.take_back()
            self._unusable += 1
            self._problems.add(str(error))
            return
        self._estimate = estimate
        if self._contradicted():
            self._problems.add("forces and accelerations contradict each other; does the robot file match the robot?")
        if dt is not None and self._decimator.due(dt):
            self._publish(message, estimate)

    def _contradicted(self) -> bool:
        return isinstance(self._observer, RobotSlidingModeObserver) and self._observer.contradicted(self._state)

    def _publish(self, measured: JointState, estimate: SlipEstimate) -> None:
        self._message.header.stamp = measured.header.stamp
        refused = fill_joint_state(
            self._message,
            position=estimate.slip_ratio if estimate.slip_valid.all() else None,
            velocity=estimate.slip_velocity if estimate.velocity_valid.all() else None,
            effort=estimate.force if estimate.force_valid.all() else None,
        )
        if refused:
            self._problems.add(f"slip/observer: {', '.join(refused)} not finite, left empty")
            self._state = self._observer.initial_state()
        self._slip.publish(self._message)

    def _status(self) -> Status:
        values: dict[str, object] = {"gaps": self._watch.gaps, "repeated_stamps": self._watch.repeats}
        values |= {"backward_jumps": self._watch.backward_jumps, "unusable_joint_states": self._unusable}
        level, text, problems = OK, "observing", self._joints.silence() or self._problems.take()
        estimate = self._estimate
        if estimate is not None:
            values |= {"velocity_bound": estimate.velocity_bound, "velocity_valid": bool(estimate.velocity_valid.all())}
            values |= {"slip_valid": bool(estimate.slip_valid.all()), "force_valid": bool(estimate.force_valid.all())}
            if isinstance(self._observer, RobotSlidingModeObserver):
                trust = self._observer.trust(self._state)
                values |= {f"trust_{name}": float(t) for name, t in zip(self.robot.caster_names, trust, strict=True)}
        if problems:
            level, text = WARN, problems
        elif estimate is None or not estimate.velocity_valid.any():
            level, text = WARN, "no velocity is vouched for"
        return Status(level, text, values)


def main(args: Sequence[str] | None = None) -> int:
    """Run the slip observer."""
    return run_node(SlipObserverNode, args)


if __name__ == "__main__":
    raise SystemExit(main())
