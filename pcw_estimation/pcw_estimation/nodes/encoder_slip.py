"""Slip from the encoders' own contradictions: joint_states in, slip/encoder and slip flags out."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from rclpy.node import Node
from sensor_msgs.msg import JointState

from pcw_description import PcwError, load_robot
from pcw_description.nodes.diagnostics import OK, WARN, Diagnostics, Problems, Status
from pcw_description.nodes.node_tools import (
    SENSOR_SOURCE,
    SENSOR_STREAM,
    Decimator,
    Silence,
    StampWatch,
    declare,
    fill_joint_state,
    joint_state_arrays,
    run_node,
)

from .. import encoder_slip

_DEFAULTS = encoder_slip.EncoderSlipParameters()
_DIRECTIONS = ("longitudinal", "lateral")


class EncoderSlipNode(Node):
    """Estimates slip from every joint_states and publishes it at a lower rate; a new flag is told at once.

    In slip/encoder `position` is slip ratio or slip angle, `velocity` the slip velocity, and `effort` is left empty, as
    encoders know nothing of forces.
    """

    def __init__(self) -> None:
        super().__init__("encoder_slip")
        self.robot = load_robot(declare(self, "robot", "thesis", "robot file, or the name of a shipped robot", read_only=True))
        rate = declare(
            self, "publish_rate", 100.0, "rate of slip/encoder; at most that of joint_states", "Hz", (0.1, 1e4), read_only=True
        )
        declare(self, "floor", _DEFAULTS.floor, "residual of a healthy robot at standstill", "m/s", (1e-4, 1.0))
        declare(self, "speed_fraction", _DEFAULTS.speed_fraction, "residual of a healthy robot per speed", "1", (0.0, 1.0))
        declare(self, "steering_length", _DEFAULTS.steering_length, "residual per steering rate", "m", (0.0, 0.1))
        declare(self, "confirm_time", _DEFAULTS.confirm_time, "how long a residual must last to be slip", "s", (0.0, 10.0))
        declare(self, "ratio_speed", _DEFAULTS.ratio_speed, "least speed that ratio and angle refer to", "m/s", (1e-3, 10.0))
        self._adopt_parameters()
        self.add_post_set_parameters_callback(lambda _: self._adopt_parameters())
        self._state = encoder_slip.initial_state(self.robot)
        at_rest = np.zeros((self.robot.n, 2))  # compiles everything before the first measurement
        encoder_slip.step(self.robot, self._thresholds, self._state, at_rest, at_rest, 0.0)
        self._output: encoder_slip.EncoderSlipOutput | None = None
        self._watch = StampWatch()
        self._silence = Silence(self._watch)
        self._decimator = Decimator(rate)
        self._unusable, self._problems = 0, Problems(self)
        self._ever = np.zeros((self.robot.n, 2), dtype=bool)  # flagged since the last report
        self._joint_index = {name: i for i, name in enumerate(self.robot.joint_names)}
        self._names = [f"{caster}_{direction}" for caster in self.robot.caster_names for direction in _DIRECTIONS]
        self._message = JointState(name=self._names)
        self._slip = self.create_publisher(JointState, "slip/encoder", SENSOR_SOURCE)
        self.create_subscription(JointState, "joint_states", self._on_joint_states, SENSOR_STREAM)
        self._diagnostics = Diagnostics(self, self.robot.name, self._status, aspect="slip")

    def _adopt_parameters(self) -> None:
        names = ("floor", "speed_fraction", "steering_length", "confirm_time", "ratio_speed")
        self._thresholds = encoder_slip.EncoderSlipParameters(**{name: self.get_parameter(name).value for name in names})

    def _on_joint_states(self, message: JointState) -> None:
        dt = self._watch.update(message.header.stamp)
        if self._watch.repeated:
            return
        position, velocity, _ = joint_state_arrays(message, self._joint_index, (self.robot.n, 2))
        if dt is None:
            self._state = encoder_slip.initial_state(self.robot)
        try:
            self._state, output = encoder_slip.step(self.robot, self._thresholds, self._state, position, velocity, dt or 0.0)
        except PcwError as error:
            self._watch.take_back()
            self._unusable += 1
            self._problems.add(str(error))
            return
        self._output = output
        flagged = output.slipping | output.skidding
        news = bool(np.any(flagged & ~self._ever))
        self._ever |= flagged
        if news:
            self._diagnostics.report()
        if dt is not None and self._decimator.due(dt):
            self._message.header.stamp = message.header.stamp
            fill_joint_state(self._message, position=output.ratio, velocity=output.slip)
            self._slip.publish(self._message)

    def _status(self) -> Status:
        flagged = [name for name, is_flagged in zip(self._names, self._ever.ravel()) if is_flagged]
        values: dict[str, object] = {"gaps": self._watch.gaps, "repeated_stamps": self._watch.repeats}
        values |= {"backward_jumps": self._watch.backward_jumps, "unusable_joint_states": self._unusable}
        output = self._output
        level, text, problems = OK, "no slip", self._problems.take()
        if output is not None:
            values["threshold"] = output.threshold
            for name, slipping, skidding in zip(self._names, output.slipping.ravel(), output.skidding.ravel()):
                values[name] = "slipping" if slipping else "skidding" if skidding else "rolling"
            self._ever = output.slipping | output.skidding
        if flagged:
            level, text = WARN, "slip since the last report: " + ", ".join(flagged)
        elif problems:
            level, text = WARN, problems
        elif self._silence.since_last_report():
            level, text = WARN, "no joint_states since the last report"
        return Status(level, text, values)


def main(args: Sequence[str] | None = None) -> int:
    """Run the slip detector."""
    return run_node(EncoderSlipNode, args)


if __name__ == "__main__":
    raise SystemExit(main())
