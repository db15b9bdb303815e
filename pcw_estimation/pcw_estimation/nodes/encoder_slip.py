"""Slip and faults from the encoders' own contradictions: joint_states in, slip/encoder, slip flags and faulty joints out."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from rclpy.node import Node
from sensor_msgs.msg import JointState

from pcw_description import PcwError, load_robot
from pcw_description.nodes.diagnostics import ERROR, OK, Diagnostics, Problems, Status
from pcw_description.nodes.measured_joints import MeasuredJoints
from pcw_description.nodes.node_tools import (
    COMMAND,
    SENSOR_STREAM,
    Decimator,
    all_declared,
    declare,
    joint_state_arrays,
    run_node,
)

from ..encoder_slip import EncoderSlipParameters, SlipProjection
from ..fault_isolation import Fault, FaultIsolation
from ..slip_consensus import SlipConsensus
from ..slip_procedure import SlipProcedure
from ..slip_verdict import ConfirmParameters
from .slip_topics import SlipTopic, declare_noise, stamp_values

_DEFAULTS = EncoderSlipParameters()
METHODS = ("consensus", "procedure", "projection")


class EncoderSlipNode(Node):
    """Estimates slip from every joint_states and publishes it at a lower rate; new slip or a new fault is told at once.

    In slip/encoder `position` is slip ratio or slip angle, `velocity` the slip velocity, and `effort` is left empty, as
    encoders know nothing of forces.
    """

    def __init__(self) -> None:
        super().__init__("encoder_slip")
        self.robot = load_robot(declare(self, "robot", "thesis", "robot file, or the name of a shipped robot", read_only=True))
        self._method = declare(self, "method", "consensus", "how slipping wheels are found", read_only=True, choices=METHODS)
        self._noise = declare_noise(self, self.robot)
        rate = declare(
            self, "publish_rate", 100.0, "rate of slip/encoder; at most that of joint_states", "Hz", (0.1, 1e4), read_only=True
        )
        isolates = declare(self, "isolate_faults", True, "name joints at fault; not with `projection`", read_only=True)
        declare(self, "gate", self._noise.gate, "studentised residual that counts as slip", "1", (2.0, 100.0))
        declare(self, "floor", _DEFAULTS.floor, "projection: residual of a healthy robot at standstill", "m/s", (1e-4, 1.0))
        declare(self, "speed_fraction", _DEFAULTS.speed_fraction, "projection: residual per speed", "1", (0.0, 1.0))
        declare(self, "steering_length", _DEFAULTS.steering_length, "projection: residual per steering rate", "m", (0.0, 0.1))
        declare(self, "confirm_time", _DEFAULTS.confirm_time, "how long slip, and its end, must last", "s", (0.0, 10.0))
        declare(self, "ratio_speed", _DEFAULTS.ratio_speed, "least speed that ratio and angle refer to", "m/s", (1e-3, 10.0))
        all_declared(self)
        self._adopt_parameters()
        self.add_post_set_parameters_callback(lambda _: self._adopt_parameters())
        self._faults = FaultIsolation(self.robot, self._noise) if isolates and self._method != "projection" else None
        self._warm_up()
        self._state = self._detector.initial_state()
        self._unusable, self._problems = 0, Problems(self)
        self._joints = MeasuredJoints(self.robot, ["position", "velocity"], self._problems)
        self._watch = self._joints.watch
        self._decimator = Decimator(rate)
        self._joint_index = {name: i for i, name in enumerate(self.robot.joint_names)}
        self._commanded: np.ndarray | None = None
        self._topic = SlipTopic(self, "slip/encoder", self.robot)
        self.create_subscription(JointState, "joint_states", self._on_joint_states, SENSOR_STREAM)
        if self._faults is not None:
            self.create_subscription(JointState, "joint_commands", self._on_joint_commands, COMMAND)
        self._diagnostics = Diagnostics(self, self.robot.name, self._status, aspect="slip", parts=self._faulty_joints)

    def _adopt_parameters(self) -> None:
        def number(name: str) -> float:
            return float(self.get_parameter(name).value)

        self._detector: Any
        if self._method == "projection":
            names = [field.name for field in dataclasses.fields(EncoderSlipParameters)]
            self._detector = SlipProjection(self.robot, EncoderSlipParameters(**{name: number(name) for name in names}))
            return
        confirm = ConfirmParameters(number("confirm_time"), number("confirm_time"), number("ratio_speed"))
        noise = dataclasses.replace(self._noise, gate=number("gate"))
        self._detector = (SlipConsensus if self._method == "consensus" else SlipProcedure)(self.robot, noise, confirm)

    def _warm_up(self) -> None:
        """Have everything compiled before the first measurement."""
        at_rest = np.zeros((self.robot.n, 2))
        _, finding = self._detector.step(self._detector.initial_state(), at_rest, at_rest, 0.0)
        if self._faults is not None:
            self._faults.update(at_rest, at_rest, finding, 0.001, at_rest, at_rest)
            self._faults.reset()

    def _on_joint_commands(self, message: JointState) -> None:
        _, _, effort = joint_state_arrays(message, self._joint_index, (self.robot.n, 2))
        self._commanded = effort

    def _on_joint_states(self, message: JointState) -> None:
        if not self._joints.are_in(message):
            return
        dt = self._watch.update(message.header.stamp)
        if self._watch.repeated:
            return
        if dt is None:
            self._state = self._detector.initial_state()
        try:
            position, velocity, effort = self._joints.read(message)
            self._state, finding = self._detector.step(self._state, position, velocity, dt or 0.0)
        except PcwError as error:
            self._watch.take_back()
            self._unusable += 1
            self._problems.add(str(error))
            return
        news = self._topic.take(finding)
        if self._faults is not None:
            if dt is None:
                self._faults.reset()
            news |= self._faults.update(position, velocity, finding, dt or 0.0, effort, self._commanded)
        self._diagnostics.report_news(news)
        if dt is not None and self._decimator.due(dt):
            self._topic.publish(message.header.stamp, finding)

    def _status(self) -> Status:
        silent = self._joints.silence()
        values = stamp_values(self._watch, self._unusable) | {"method": self._method}
        return self._topic.status(values, self._problems.take(), silent, encoders_alone=True)

    def _faulty_joints(self) -> Mapping[str, Status]:
        """One status for each joint at fault; for all together where none is."""
        if self._faults is None:
            return {}
        found = self._faults.faults()
        if not found:
            return {"joints": Status(OK, Fault.NONE.value)}
        return {"joints": Status(ERROR, "at fault: " + ", ".join(found))} | {
            name: Status(ERROR, fault.value, {"fault": fault.name.lower()}) for name, fault in found.items()
        }


def main(args: Sequence[str] | None = None) -> int:
    """Run the slip detector."""
    return run_node(EncoderSlipNode, args)


if __name__ == "__main__":
    raise SystemExit(main())
