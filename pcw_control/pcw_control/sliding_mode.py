"""Sliding mode on the velocity errors of the wheels: low-pass-filtered integral (table 5.1), and what it is compared with.

A wheel centre of effective mass m obeys m e_dot = D - u with its velocity error e (5.1), the force u on it, and D all that the
controller does not know: the acceleration wanted, other wheels, friction, load.

    low_pass_integral   s = e + z,  m z_dot = u - K sgn(s),  z(0) = -e(0),  u_dis = K sgn(s) / (eps p + 1)     LPFISMC
    boundary_layer      s = e,  u_dis = K sat(s / phi)
    plain               s = e,  u_dis = K sgn(s)

With the first, m s_dot = D - K sgn(s), whatever u does: s = 0 from the first instant on if K > |D|, there is no reaching
phase, and the mean of K sgn(s) is D. The motors get only that mean.

A motor feels the robot through the tyre, a spring: above its resonance w_t the mass is only the wheel's own, m_w, and a
law that counts on m is g = m / m_w - 1 times too strong. So sgn is replaced by sat(s m / (K T)): s stays within K T / m,
and the loop over filter and s, g / (eps T w^2) there, stays below 1 / 4 from w_t on with T = 4 g / (eps w_t^2).
And what
it adds stays below half of k_p there, T >= 4 m / (k_p eps w_t); `settling_time` derives it. The thesis writes s = -slip +
z; with the motion wanted in place of the unknown true one, -slip = A V - B q_dot is e.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from pcw_description.robot_description import FloatArray

from .errors import ControlError

SLIDING_LAWS = ("boundary_layer", "low_pass_integral", "plain")


@dataclasses.dataclass(frozen=True)
class SlidingModeState:
    """What the sliding mode remembers; None before the first error.

    Attributes:
        auxiliary: z (n, 2) [m/s].
        filtered: u_dis (n, 2) [N].
        switched: K sgn(s) of the step before (n, 2) [N].
        force: u of the step before (n, 2) [N].
        sliding: s (n, 2) [m/s].
    """

    auxiliary: FloatArray | None
    filtered: FloatArray
    switched: FloatArray
    force: FloatArray
    sliding: FloatArray


def initial_state(n: int) -> SlidingModeState:
    """Return the state before the first step of n wheels."""
    zero = np.zeros((n, 2))
    return SlidingModeState(None, zero, zero, zero, zero)


def step(
    law: str,
    state: SlidingModeState,
    error: FloatArray,
    continuous: FloatArray,
    mass: FloatArray,
    gain: FloatArray,
    filter_time: float,
    settling: FloatArray,
    boundary: float,
    saturated: bool,
    dt: float,
) -> tuple[SlidingModeState, FloatArray]:
    """Return the new state and the force u = u_c + u_dis (n, 2) [N].

    Args:
        law: one of `SLIDING_LAWS`.
        state: state after the step before.
        error: e (n, 2) [m/s].
        continuous: u_c (n, 2) [N].
        mass: m (n, 2) [kg].
        gain: K (n, 2) [N].
        filter_time: eps [s].
        settling: T (n, 2) [s]; at least dt is used.
        boundary: phi [m/s].
        saturated: the force before was not made in full: z starts anew, as u is not known.
        dt: measured time since the step before [s].

    Raises:
        ControlError: the law is unknown.
    """
    if law == "plain":
        u_dis = gain * np.sign(error)
        return dataclasses.replace(state, filtered=u_dis, sliding=error), continuous + u_dis
    if law == "boundary_layer":
        u_dis = gain * np.clip(error / boundary, -1.0, 1.0)
        return dataclasses.replace(state, filtered=u_dis, sliding=error), continuous + u_dis
    if law != "low_pass_integral":
        raise ControlError(f"sliding law {law!r} is not allowed; allowed: {', '.join(SLIDING_LAWS)}")
    if state.auxiliary is None or saturated:
        # Begin where s says what is known of the disturbance already.
        filtered = switched = state.filtered
        s = filtered * np.maximum(settling, dt) / mass
        z = s - error
    else:
        z = state.auxiliary + dt / mass * (state.force - state.switched)
        bound = gain * np.maximum(settling, dt) / mass
        # What D is more than K cannot be made up for and is not stored: s waits at its bound instead of winding up.
        s = np.clip(error + z, -bound, bound)
        z = s - error
        switched = s * mass / np.maximum(settling, dt)
        filtered = state.filtered + (1.0 - math.exp(-dt / filter_time)) * (switched - state.filtered)
    u = continuous + filtered
    return SlidingModeState(z, filtered, switched, u, s), u
