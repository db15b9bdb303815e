"""The joint_states of one robot: which messages are its own, all joints of them, and headings that do not jump by a turn."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from sensor_msgs.msg import JointState

from pcw_description.errors import PcwError
from pcw_description.robot_description import DRIVE, STEER, RobotDescription

from .diagnostics import Problems
from .node_tools import StampWatch, joint_state_arrays

FIELDS = ("position", "velocity", "effort")
MOST_STRANGERS = 8  # joints of others that are named in a report
LEEWAY = 1.5  # times its limit that the speed of a drive is possible


class MeasuredJoints:
    """Reads joint_states for a node, and says why none of them could be used.

        if not joints.are_in(message):
            return                                     # an arm publishes on the same topic
        dt = joints.watch.update(message.header.stamp)
        position, velocity, effort = joints.read(message)

    Args:
        robot: the robot.
        needed: fields that have to hold a finite number for every joint, position among them.
        problems: those of the node, to which it adds its own.
        longest_gap: longest time between two messages that is bridged [s].
    """

    def __init__(self, robot: RobotDescription, needed: Sequence[str], problems: Problems, longest_gap: float = 0.5) -> None:
        self.watch = StampWatch(longest_gap)
        self._robot, self._needed, self._problems = robot, tuple(needed), problems
        self._index = {name: i for i, name in enumerate(robot.joint_names)}
        self._all = f"all joints of {robot.name}, in any order, in one message"
        self._sent: np.ndarray | None = None  # the last positions (n, 2), as they were sent
        self._sent_ns = 0
        self._offset = np.zeros((robot.n, 2))  # from the angle that is sent to the one that goes on
        self._strangers: dict[str, None] = {}
        self._reported = (0, 0)  # messages of the robot's joints, those of a stamp that came before

    def are_in(self, message: JointState) -> bool:
        """Whether a message names any joint of the robot; one that names none is about something else."""
        if any(name in self._index for name in message.name):
            return True
        for name in message.name[:MOST_STRANGERS]:
            if len(self._strangers) < MOST_STRANGERS:
                self._strangers[name] = None
        return False

    def read(self, message: JointState) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return position, velocity and effort (n, 2) of all joints; NaN for what is not needed and not sent.

        A heading that jumps by more than half a turn went the shorter way round: it is a wheel's direction, and drivers wrap
        it at a full turn. So did a drive that would have been faster than it can be; where it was too fast that way as well,
        its encoder began anew, and it goes on from where it was.

        Raises:
            PcwError: a joint is missing, or a needed number is missing or not finite; names it, and holds no measured number.
        """
        shape = (self._robot.n, 2)
        arrays = dict(zip(FIELDS, joint_state_arrays(message, self._index, shape), strict=True))
        for field in self._needed:
            if not np.isfinite(arrays[field]).all():
                raise PcwError(self._reason_against(message, field, arrays[field].ravel()))
        self._go_on(arrays["position"])
        return arrays["position"], arrays["velocity"], arrays["effort"]

    def _go_on(self, position: np.ndarray) -> None:
        """Take out of the positions (n, 2), in place, what is no motion."""
        before, before_ns, now_ns = self._sent, self._sent_ns, self.watch.last_ns or 0
        self._sent, self._sent_ns = position.copy(), now_ns
        dt = (now_ns - before_ns) * 1e-9
        if before is not None:
            step = position - before
            shorter = step - math.tau * np.round(step / math.tau)
            self._offset[:, STEER] += (shorter - step)[:, STEER]
            if 0.0 < dt <= self.watch.longest_gap:  # else nobody goes by the step
                possible = LEEWAY * self._robot.speed_limit[:, DRIVE] * dt
                for i in np.nonzero(np.abs(step[:, DRIVE]) > np.maximum(possible, math.pi))[0]:
                    wraps = abs(shorter[i, DRIVE]) <= possible[i]
                    self._offset[i, DRIVE] += (shorter[i, DRIVE] if wraps else 0.0) - step[i, DRIVE]
                    if not wraps:
                        jump = f"{self._robot.caster_names[i]}_drive jumped by {step[i, DRIVE]:.3g} rad in {dt:.3g} s"
                        allowed = f"{self._robot.speed_limit[i, DRIVE]:g} rad/s"
                        self._problems.add(f"joint_states: {jump}; allowed: {allowed}; taken for an encoder that begins anew")
        position += self._offset

    def _reason_against(self, message: JointState, field: str, values: np.ndarray) -> str:
        lacking = [name for name in self._index if name not in message.name]
        if lacking:
            return f"joint_states lacks {', '.join(lacking)}; allowed: {self._all}"
        bad = ", ".join(name for name, value in zip(self._index, values) if not math.isfinite(value))
        if len(getattr(message, field)) < len(message.name):
            return f"joint_states has no {field} of {bad}; allowed: {' and '.join(self._needed)} of {self._all}"
        return f"joint_states: {field} of {bad} is NaN or infinite; allowed: finite numbers"

    def silence(self) -> str:
        """Return that nothing came since the last call, "" when something did; what came in vain is added to the problems."""
        now, before = (self.watch.count, self.watch.repeats), self._reported
        strangers, self._reported, self._strangers = ", ".join(self._strangers), now, {}
        heard, repeats = now[0] - before[0], now[1] - before[1]
        if heard > repeats:
            return ""
        if heard:
            stamp = "" if self.watch.last_ns is None else f" {self.watch.last_ns * 1e-9:.9f} s"
            self._problems.add(f"all joint_states have the stamp{stamp}; allowed: the time of each measurement")
        elif strangers:
            self._problems.add(f"joint_states names {strangers} and no joint of {self._robot.name}; allowed: {self._all}")
        else:
            return "no joint_states since the last report"
        return ""
