"""The drive interface: what the robot asks of one motor and its drive, whatever the drive speaks.

All numbers are those of the motor and the drive's own counting: rad, rad/s, N m; gears, signs and zeros are in `motor_map`. A
drive makes frames and reads frames; it sends nothing itself and has no clock, so it works in real and in simulated time.
"""

from __future__ import annotations

import enum
import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Generator, Sequence
from typing import NamedTuple

from .can_file import DriveJoint
from .frame import Frame, PeriodicFrame


class Mode(enum.Enum):
    """What a drive holds."""

    TORQUE = "torque"
    VELOCITY = "velocity"
    HOMING = "homing"


class DriveState(enum.Enum):
    """What a drive says of itself."""

    UNKNOWN = "unknown"
    DISABLED = "disabled"
    ENABLED = "enabled"
    FAULT = "fault"


class Want(NamedTuple):
    """What a drive shall do.

    Attributes:
        enabled: with torque, or without.
        mode: what it holds when enabled.
        value: torque [N m] or velocity [rad/s] of the motor.
    """

    enabled: bool
    mode: Mode = Mode.TORQUE
    value: float = 0.0


OFF = Want(False)


class Ask(NamedTuple):
    """One question of a procedure.

    Attributes:
        frame: the question; None to wait only.
        accept: whether a frame is the answer.
        what: what is asked, for people.
        timeout: for the answer, each time it is asked [s].
        tries: how often it is asked.
    """

    frame: Frame | None
    accept: Callable[[Frame], bool]
    what: str
    timeout: float = 0.1
    tries: int = 3


# Yields questions and is sent the answers; an answer of None is that none came.
Procedure = Generator[Ask, Frame | None, None]


class Feedback:
    """The newest that a drive has said; motor side, in the drive's counting.

    Attributes:
        position: [rad], continuous over the wrap of the drive's counter.
        velocity: [rad/s].
        torque: [N m].
        temperature: the largest that it reports [degC]; NaN where it reports none.
        position_time, velocity_time, torque_time, temperature_time: when each came [s].
        state_time: when the drive last said in which state it is [s].
        heard_time: when anything came [s].
        error_names: what the drive says is wrong.
        homing: None, "busy", "attained" or "failed".
    """

    __slots__ = (
        "position", "velocity", "torque", "temperature", "position_time", "heard_time", "state", "error_names", "homing",
        "restarted", "velocity_time", "torque_time", "state_time", "temperature_time",
    )  # fmt: skip

    def __init__(self) -> None:
        self.position = self.velocity = self.torque = self.temperature = math.nan
        self.position_time = self.heard_time = self.velocity_time = -math.inf
        self.torque_time = self.state_time = self.temperature_time = -math.inf
        self.state = DriveState.UNKNOWN
        self.error_names: tuple[str, ...] = ()
        self.homing: str | None = None
        self.restarted = False


def newer_than(feedback: Feedback, since: float, now: float, period: float) -> bool:
    """Whether position, speed and torque have come since a time [s].

    A torque is waited for only where torques come at the rate of positions: it belongs to the same instant then, and in the
    order of its frames a drive may send it last.
    """
    if feedback.position_time <= since or feedback.velocity_time <= since:
        return False
    return feedback.torque_time > since or now - feedback.torque_time > 2.0 * period


class Drive(ABC):
    """One drive.

    Args:
        joint: its entry in the CAN file.
        rate: of torques and positions [Hz].
        heartbeat: between two heartbeats [s].
        watchdog: without the computer for so long it shall stop [s].
    """

    def __init__(self, joint: DriveJoint, rate: float, heartbeat: float, watchdog: float) -> None:
        self.joint, self.rate, self.heartbeat, self.watchdog = joint, rate, heartbeat, watchdog
        self.node_id = int(joint.node_id)
        self.feedback = Feedback()
        self.firmware = ""
        self.identity = ""
        self.notes: list[str] = []  # what `configure` found that is worth saying
        self.refused_frames = 0
        self._was_enabled = False

    def _begins(self, want: Want) -> bool:
        """Whether torque is wanted now and was not before. What the drive said before is forgotten."""
        begins, self._was_enabled = want.enabled and not self._was_enabled, want.enabled
        if begins and self.feedback.state is DriveState.ENABLED:
            self.feedback.state = DriveState.DISABLED
        return begins

    @property
    def name(self) -> str:
        """The joint's name."""
        return self.joint.name

    @property
    @abstractmethod
    def identifiers(self) -> Sequence[int]:
        """Identifiers of the frames that the drive sends."""

    @abstractmethod
    def receive(self, frame: Frame, now: float) -> None:
        """Take a frame of one of `identifiers`; one that is malformed is counted in `refused_frames` and changes nothing."""

    @abstractmethod
    def configure(self) -> Procedure:
        """Check who the drive is and set it up; leaves it without torque.

        Raises:
            DriveError: no answer, or the wrong one.
        """

    @abstractmethod
    def clear(self) -> Procedure:
        """Reset the drive's faults; leaves it without torque."""

    @abstractmethod
    def output(self, want: Want, now: float) -> list[Frame]:
        """Return what to send for what is wanted, one step nearer to it where the drive needs several."""

    def feed(self) -> list[Frame]:
        """Return what keeps the drive's watchdog content, without torque, while it is being set up."""
        return []

    @abstractmethod
    def prepare_homing(self, method: str, speed: float, direction: float) -> Procedure:
        """Set up a search for the mark, at a speed of the motor [rad/s]; `Mode.HOMING` then begins it."""

    @abstractmethod
    def periodic_frames(self) -> list[PeriodicFrame]:
        """Return what is on the bus for this drive."""

    @abstractmethod
    def decode_command(self, frame: Frame) -> Want | None:
        """Return what a logged frame from the computer asks of this drive; None for any other frame."""

    @property
    def spoken_identifiers(self) -> Sequence[int]:
        """Of `identifiers` those that only the drive uses for frames with data."""
        return self.identifiers

    @property
    @abstractmethod
    def command_identifiers(self) -> Sequence[int]:
        """Identifiers of the frames with torques and velocities to the drive."""


def shorter_angle(count: int, previous: int, bits: int = 32) -> int:
    """Return the change of a counter that wraps at 2^bits, the shorter way round."""
    half = 1 << (bits - 1)
    return (count - previous + half) % (1 << bits) - half
