"""Changing the controller while the robot drives: the new one takes over at the twist, and the torque changes without a jump.

    tau(t) = tau_new(t) + (tau_old - tau_new(0)) exp(-t / T)

The new controller begins with the reference twist of the old one, so that its own reference does not step. What its
torque differs by at that moment, integrals that the other had, fades out.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from pcw_description.robot_description import FloatArray

FADE = 0.1  # T [s]: slower than the motors, faster than the motion


@dataclasses.dataclass(frozen=True)
class Handover:
    """What is left of the old torque.

    Attributes:
        before: torque of the old controller (n, 2) [N m]; None once the new one has begun.
        offset: what is still added to the new one's (n, 2) [N m].
    """

    before: FloatArray | None
    offset: FloatArray


def no_handover(n: int) -> Handover:
    """Return the state in which nothing is handed over."""
    return Handover(None, np.zeros((n, 2)))


def begin_handover(torque: FloatArray) -> Handover:
    """Return the state at the change, with the torque sent last (n, 2)."""
    return Handover(torque, np.zeros_like(torque))


def step(state: Handover, torque: FloatArray, dt: float) -> tuple[Handover, FloatArray]:
    """Return the new state and the torque to send (n, 2) for the one that the controller asks for now."""
    offset = state.offset * math.exp(-dt / FADE) if state.before is None else state.before - torque
    if not np.isfinite(offset).all():
        offset = np.zeros_like(offset)  # a torque that is not finite is caught by the gate
    return dataclasses.replace(state, before=None, offset=offset), torque + offset
