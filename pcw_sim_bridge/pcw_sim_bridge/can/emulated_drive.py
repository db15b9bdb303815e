"""What both kinds of emulated drives share: power, faults on request, and what they keep of the commands."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Iterable

from .can_file import DriveJoint
from .drive import Mode
from .frame import Frame

AMBIENT, HOT = 35.0, 120.0  # [degC]
JUMP = 4.0 * math.tau  # of a motor's count [rad]


class EmulatedDrive(ABC):
    """A drive with its motor, which does what real ones do with frames; the robot sets what its sensors see.

    Args:
        joint: its entry in the CAN file.
        rate, heartbeat, watchdog: as set in the drive.

    Attributes:
        position, velocity, torque: of the motor, in the drive's counting.
        command_time: when a torque or velocity last came [s].
        commands: how many came.
        mark_wanted: it turns and looks for its mark, at `value` of `want`.
        failure: why it failed, by the name of `supervisor`; "" in health.
    """

    def __init__(self, joint: DriveJoint, rate: float, heartbeat: float, watchdog: float) -> None:
        self.joint, self.name, self.node_id = joint, joint.name, int(joint.node_id)
        self.rate, self.heartbeat, self.watchdog = rate, heartbeat, watchdog
        self.position = self.velocity = self.torque = 0.0
        self.offset = 0.0  # of the count: homing and jumps
        self.temperature = AMBIENT
        self.dead = self.silent = False
        self.report_factor = 0.0  # torque that it reports beyond what it gives [N m]
        self._frozen: float | None = None
        self._jumped = 0.0
        self._blind = False  # its speed stands with its position
        self.command_time = -math.inf
        self.commands = 0
        self.mark_wanted = 0
        self.homing_speed, self.homing_direction = 1.0, 1
        self.failure = ""

    # --- What the robot sees -----------------------------------------------------------------------------

    @abstractmethod
    def want(self) -> tuple[Mode, float] | None:
        """Return what it does to the motor now: torque [N m] or velocity [rad/s]; None without torque."""

    @property
    def shown_position(self) -> float:
        """What its encoder says [rad]."""
        return self._frozen if self._frozen is not None else self.position - self.offset

    @property
    def shown_velocity(self) -> float:
        """What it makes of its encoder [rad/s]."""
        return 0.0 if self._blind else self.velocity

    @property
    def shown_torque(self) -> float:
        """What it measures [N m]."""
        return self.torque + self.report_factor

    def mark_passed(self, position: float) -> None:
        """The mark was at this angle of the motor [rad]: it counts from there."""
        self.offset, self._jumped, self.mark_wanted = position, 0.0, 0
        self._homed()

    @abstractmethod
    def _homed(self) -> None:
        """Say that the mark was found, and stop."""

    # --- Frames ------------------------------------------------------------------------------------------

    @abstractmethod
    def receive(self, frame: Frame, now: float) -> list[Frame]:
        """Take a frame of the bus, whoever it is for, and return the answers."""

    @abstractmethod
    def tick(self, now: float) -> list[Frame]:
        """Return what it sends by itself, and look after its watchdog."""

    @abstractmethod
    def power_on(self, now: float) -> list[Frame]:
        """Start anew, without torque and with everything that was set gone."""

    # --- Faults ------------------------------------------------------------------------------------------

    @abstractmethod
    def trip(self, name: str, now: float) -> list[Frame]:
        """Fail by the name of `supervisor`: no torque until it is cleared."""

    def inject(self, name: str, now: float) -> list[Frame]:
        """Do a fault; see `FAULTS`. `heal` ends what lasts."""
        if name in ("over_temperature", "over_current"):
            if name == "over_temperature":
                self.temperature = HOT
            return self.trip(name, now)
        if name == "dead":
            self.dead = True
        elif name == "silent":
            self.silent = True
        elif name == "hot":
            self.temperature = HOT
        elif name == "encoder_jump":
            self.offset += JUMP
            self._jumped += JUMP
        elif name in ("encoder_stuck", "encoder_dead"):
            self._frozen, self._blind = self.shown_position, name == "encoder_dead"
        elif name == "over_torque":
            self.report_factor = 10.0 * self.joint.torque_constant * self.joint.current_limit
        elif name == "restart":
            return self.power_on(now)
        elif name == "heal":
            was_dead = self.dead
            self.offset, self._jumped = self.offset - self._jumped, 0.0
            self.dead = self.silent = False
            self.temperature, self.report_factor, self._frozen, self._blind = AMBIENT, 0.0, None, False
            return self.power_on(now) if was_dead else []
        return []


# What can be asked of an emulated drive, and what it does.
FAULTS = {
    "dead": "no power: it neither hears nor speaks, and gives no torque",
    "silent": "it hears, but says nothing",
    "over_temperature": "it is hot and trips",
    "hot": "its temperature is high, and it does not trip (odrive alone reports one)",
    "over_current": "it trips",
    "encoder_jump": "its count steps by four turns of the motor",
    "encoder_stuck": "its position stands while its speed goes on",
    "encoder_dead": "its position stands and its speed is zero, whatever the motor does",
    "over_torque": "it reports far more torque than it was told",
    "restart": "it starts anew, with everything that was set gone",
    "heal": "all of this ends, and it can be set up again",
}


def first_due(next_time: float, period: float, now: float) -> float:
    """Return the next of a series of times after `now`, without making up for those missed."""
    next_time += period
    return next_time if next_time > now else now + period


def joined(frames: Iterable[list[Frame]]) -> list[Frame]:
    """Return all frames in one list."""
    return [frame for some in frames for frame in some]
