"""Brings joint_states and imu/data to the filter of `imu_slip` by their stamps, and counts what is wrong with them."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from builtin_interfaces.msg import Time
from rclpy.node import Node
from sensor_msgs.msg import Imu, JointState

from pcw_description import PcwError, RobotDescription
from pcw_description.nodes.diagnostics import Problems
from pcw_description.nodes.measured_joints import MeasuredJoints
from pcw_description.nodes.node_tools import (
    SENSOR_STREAM,
    Silence,
    StampWatch,
    all_declared,
    declare,
    stamp_to_ns,
)

from ..gyro_unit import GyroUnit
from ..imu_slip import ImuSlip, ImuSlipParameters, Motion
from ..slip_verdict import ConfirmParameters
from .slip_topics import declare_noise, stamp_values

_DEFAULTS, _CONFIRM = ImuSlipParameters(), ConfirmParameters()


class ImuStream:
    """The filter of a node, fed by its two topics; calls back with every motion.

    Args:
        node: the node; the parameters of the filter are declared at it.
        robot: the robot.
        on_motion: called with the stamp, the time since the last motion (None after a gap) and the motion.
    """

    def __init__(
        self, node: Node, robot: RobotDescription, on_motion: Callable[[Time, float | None, Motion], None]
    ) -> None:
        noise = declare_noise(node, robot)
        confirm_time = declare(
            node, "confirm_time", _CONFIRM.confirm_time, "how long slip, and its end, must last", "s", (0.0, 10.0),
            read_only=True,
        )
        ratio_speed = declare(
            node, "ratio_speed", _CONFIRM.ratio_speed, "least speed that ratio and angle refer to", "m/s", (1e-3, 10.0),
            read_only=True,
        )
        timeout = declare(
            node, "imu_timeout", _DEFAULTS.imu_timeout, "without an IMU sample for so long the wheels carry on alone", "s",
            (1e-3, 10.0), read_only=True,
        )
        yield_time = declare(
            node, "yield_time", _DEFAULTS.yield_time, "wheels that agree against the IMU for so long are believed", "s",
            (0.1, 1e3), read_only=True,
        )
        offset = declare(
            node, "imu_time_offset", 0.0, "added to the stamps of imu/data", "s", (-1.0, 1.0), read_only=True
        )
        longest_gap = declare(
            node, "longest_gap", 0.5, "longest time between joint_states that is bridged", "s", (0.001, 60.0), read_only=True
        )
        all_declared(node)
        self.filter = ImuSlip(
            robot, noise, ConfirmParameters(confirm_time, confirm_time, ratio_speed), ImuSlipParameters(timeout, yield_time)
        )
        self._robot, self._on_motion = robot, on_motion
        self._timeout_ns, self._offset_ns = int(timeout * 1e9), int(offset * 1e9)
        self._problems = Problems(node)
        self._measured_joints = MeasuredJoints(robot, ["position", "velocity"], self._problems, longest_gap)
        self.joints, self.imu = self._measured_joints.watch, StampWatch(longest_gap)
        self._imu_silence, self._gyro_unit = Silence(self.imu), GyroUnit(robot)
        self._unusable, self._unusable_imu, self._late = 0, 0, 0
        self._warm_up()
        self._state = self.filter.initial_state()
        self._event_ns: int | None = None  # up to when the state is carried on
        node.create_subscription(JointState, "joint_states", self._on_joint_states, SENSOR_STREAM)
        node.create_subscription(Imu, "imu/data", self._on_imu, SENSOR_STREAM)

    def _warm_up(self) -> None:
        at_rest = np.zeros((self._robot.n, 2))
        state, _ = self.filter.correct(self.filter.initial_state(), at_rest, at_rest, 0.0)
        state = self.filter.predict(state, 0.0, 0.0, 0.0, 0.001)
        self.filter.correct(state, at_rest, at_rest, 0.001)

    def _on_imu(self, message: Imu) -> None:
        dt = self.imu.update(message.header.stamp)
        if self.imu.repeated:
            return
        now_ns = stamp_to_ns(message.header.stamp) + self._offset_ns
        if self._event_ns is None or (dt is None and now_ns < self._event_ns - self._timeout_ns):
            return  # before the first joint_states, or from a clock that went back before theirs did
        elapsed = (now_ns - self._event_ns) * 1e-9
        if elapsed > self.joints.longest_gap:
            self._problems.add(f"imu/data lies {elapsed:.3g} s after the last joint_states and is left out")
            self._unusable_imu += 1
            return
        gyro, acceleration = message.angular_velocity, message.linear_acceleration
        self._gyro_unit.add_gyro(now_ns, gyro.z)
        if self._gyro_unit.fault:
            self._unusable_imu += 1
            self._problems.add(self._gyro_unit.fault)
            return
        try:
            # A sample older than the state only takes the place of the last one: 1 ns is no time to carry on.
            self._state = self.filter.predict(self._state, gyro.z, acceleration.x, acceleration.y, max(elapsed, 1e-9))
        except PcwError as error:
            self.imu.take_back()
            self._unusable_imu += 1
            self._problems.add(str(error))
            return
        self._event_ns = max(now_ns, self._event_ns)

    def _on_joint_states(self, message: JointState) -> None:
        if not self._measured_joints.are_in(message):
            return
        dt = self.joints.update(message.header.stamp)
        if self.joints.repeated:
            return
        now_ns = stamp_to_ns(message.header.stamp)
        event_ns = now_ns if self._event_ns is None else self._event_ns
        state, ahead = self._state, 0.0
        if dt is None:
            self._gyro_unit.clear()
            # An IMU that went on all the while knows the speed; else nobody does.
            if not 0 <= now_ns - event_ns <= self._timeout_ns or self.joints.count == 1:
                state = self.filter.interrupted(state, self.joints.last_gap)
                event_ns = now_ns
        if event_ns - now_ns > self._timeout_ns:
            self._late += 1
            self._problems.add(f"joint_states lies {(event_ns - now_ns) * 1e-9:.3g} s before imu/data")
        ahead = max(now_ns - event_ns, 0) * 1e-9
        try:
            position, velocity, _ = self._measured_joints.read(message)
            self._state, motion = self.filter.correct(state, position, velocity, dt or 0.0, ahead)
        except PcwError as error:
            self.joints.take_back()
            self._unusable += 1
            self._problems.add(str(error))
            return
        self._event_ns = max(now_ns, event_ns)
        was_at_fault = bool(self._gyro_unit.fault)
        self._gyro_unit.add_joints(now_ns, position, velocity)
        if self._gyro_unit.fault and not was_at_fault:
            self._state = self.filter.without_imu(self._state)
        self._on_motion(message.header.stamp, dt, motion)

    def silent(self) -> str:
        """Return which topic went silent since the last call, in words; "" for none."""
        imu_silent, joints_silent = self._imu_silence.since_last_report(), self._measured_joints.silence()
        # A robot that has none, by its file, need not be told so every second.
        without_imu = imu_silent and self._robot.sensors.imu is not None
        return joints_silent or ("no imu/data since the last report" if without_imu else "")

    def problems(self) -> str:
        """Return what went wrong since the last call."""
        return self._problems.take()

    def values(self) -> dict[str, object]:
        """Return the counts for the diagnostics."""
        return stamp_values(self.joints, self._unusable) | {
            "imu_gaps": self.imu.gaps, "imu_repeated_stamps": self.imu.repeats, "imu_backward_jumps": self.imu.backward_jumps,
            "unusable_imu": self._unusable_imu, "late_joint_states": self._late,
        }
