"""What the controller does when something is wrong: one table of hazards and reactions, and the one gate before the motors.

| reaction | what it means |
|---|---|
| `DO_WITHOUT` | the controller goes on without an input that it can spare |
| `LET_GO` | zero torque, at once and without the slew limit, until the hazard is over and something is commanded |
| `LATCH` | zero torque until the next activation |

Zero torque lets go of the robot; it does not brake. All torque that leaves has passed `SafetyGate.pass_torque`, and
with it the torque limits; the worst reaction of all hazards present wins.
"""

from __future__ import annotations

import dataclasses
import enum
from collections.abc import Mapping, Set

import numpy as np

from pcw_description.robot_description import FloatArray

from .errors import ControlError
from .torque_limits import TorqueLimits, limit_torque


class Reaction(enum.IntEnum):
    """What is done about a hazard, from the mildest to the hardest."""

    DO_WITHOUT = 1
    LET_GO = 2
    LATCH = 3


@dataclasses.dataclass(frozen=True)
class Hazard:
    """One thing that may go wrong.

    Attributes:
        reaction: what is done.
        said: one line for diagnostics.
    """

    reaction: Reaction
    said: str


HAZARDS: Mapping[str, Hazard] = {
    "inactive": Hazard(Reaction.LET_GO, "not active"),
    "nothing_commanded": Hazard(Reaction.LET_GO, "nothing is commanded"),
    "cmd_vel_timeout": Hazard(Reaction.LET_GO, "no cmd_vel within cmd_vel_timeout; the torque is zero"),
    "cmd_vel_refused": Hazard(Reaction.LET_GO, "cmd_vel is not usable; the torque is zero"),
    "joint_states_timeout": Hazard(Reaction.LET_GO, "no joint_states within joint_states_timeout; the torque is zero"),
    "joint_states_unusable": Hazard(Reaction.LET_GO, "joint_states are not usable; the torque is zero"),
    "no_time_step": Hazard(Reaction.LET_GO, "no time step: the first joint_states, a gap, or a stamp that goes back"),
    "torque_not_finite": Hazard(Reaction.LET_GO, "the computed torque is not finite; the torque is zero"),
    "wrench_timeout": Hazard(Reaction.LET_GO, "no ft_sensor/wrench within input_timeout; the torque is zero"),
    "slip_invalid": Hazard(Reaction.DO_WITHOUT, "no valid slip within input_timeout; the controller goes on without it"),
    "friction_invalid": Hazard(Reaction.DO_WITHOUT, "no valid terrain within input_timeout; the nominal ground is assumed"),
    "exception": Hazard(Reaction.LATCH, "an exception; zero torque until the next activation"),
}


@dataclasses.dataclass(frozen=True)
class GateState:
    """What the gate remembers.

    Attributes:
        torque: torque sent before (n, 2) [N m].
        saturated: it was less than asked for.
        latched: name of the hazard that keeps the torque at zero; "" for none.
    """

    torque: FloatArray
    saturated: bool = False
    latched: str = ""


@dataclasses.dataclass(frozen=True)
class GatedTorque:
    """What leaves.

    Attributes:
        torque: (n, 2) [N m], finite and within all limits.
        reaction: the hardest reaction; None where there was no hazard.
        hazards: names of those present, the torque that is not finite included.
    """

    torque: FloatArray
    reaction: Reaction | None
    hazards: tuple[str, ...]


class SafetyGate:
    """The last gate of one robot.

    Args:
        limits: the torque limits.
    """

    def __init__(self, limits: TorqueLimits) -> None:
        self.limits = limits
        self._zero = np.zeros_like(limits.torque)

    def initial_state(self) -> GateState:
        """Return the state with nothing sent and nothing latched."""
        return GateState(self._zero)

    def pass_torque(
        self, state: GateState, torque: FloatArray | None, joint_velocity: FloatArray | None, dt: float | None,
        hazards: Set[str],
    ) -> tuple[GateState, GatedTorque]:
        """Return what may be sent.

        Args:
            state: state after the torque before.
            torque: wanted (n, 2) [N m]; None where there is none, which is zero torque.
            joint_velocity: measured (n, 2) [rad/s].
            dt: measured time since the torque before [s].
            hazards: names out of `HAZARDS` that are present.

        Raises:
            ControlError: a hazard that is not in the table.
        """
        unknown = set(hazards) - set(HAZARDS)
        if unknown:
            raise ControlError(f"hazards {sorted(unknown)} are not allowed; allowed: {', '.join(HAZARDS)}")
        present = set(hazards)
        allowed = None
        if torque is not None and joint_velocity is not None and dt is not None:
            allowed = limit_torque(self.limits, state.torque, torque, joint_velocity, dt)
            if allowed.fault:
                present.add("torque_not_finite")
        latched = state.latched or next((name for name in sorted(present) if HAZARDS[name].reaction is Reaction.LATCH), "")
        reaction = max((HAZARDS[name].reaction for name in present), default=None)
        if latched:
            reaction = Reaction.LATCH
        names = tuple(sorted(present))
        if allowed is None or (reaction is not None and reaction >= Reaction.LET_GO):
            return GateState(self._zero, False, latched), GatedTorque(self._zero.copy(), reaction, names)
        return GateState(allowed.torque, allowed.saturated, latched), GatedTorque(allowed.torque, reaction, names)
