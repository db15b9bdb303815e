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

from pcw_description.compiled import compiled
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
    begins = state.auxiliary is None or saturated
    z, filtered, switched, u, s = _low_pass_integral(
        begins, state.filtered if state.auxiliary is None else state.auxiliary, state.filtered, state.switched, state.force,
        error, continuous, mass, gain, filter_time, settling, dt,
    )  # fmt: skip
    return SlidingModeState(z, filtered, switched, u, s), u


@compiled
def _low_pass_integral(  # type: ignore[no-untyped-def]
    begins, auxiliary, filtered_before, switched_before, force, error, continuous, mass, gain, filter_time, settling, dt
):
    """Return z, u_dis, K sgn(s), u and s, each (n, 2)."""
    z, filtered, switched = np.empty(error.shape), filtered_before.copy(), filtered_before.copy()
    u, s = np.empty(error.shape), np.empty(error.shape)
    passed = 1.0 - math.exp(-dt / filter_time)
    for i in range(len(error)):
        for j in range(2):
            stiffness = mass[i, j] / max(settling[i, j], dt)
            if begins:
                # Begin where s says what is known of the disturbance already.
                s[i, j] = filtered[i, j] / stiffness
            else:
                reached = error[i, j] + auxiliary[i, j] + dt / mass[i, j] * (force[i, j] - switched_before[i, j])
                bound = gain[i, j] / stiffness
                # What D is more than K cannot be made up for and is not stored: s waits at its bound instead of winding up.
                s[i, j] = min(max(reached, -bound), bound)
                switched[i, j] = s[i, j] * stiffness
                filtered[i, j] += passed * (switched[i, j] - filtered[i, j])
            z[i, j] = s[i, j] - error[i, j]
            u[i, j] = continuous[i, j] + filtered[i, j]
    return z, filtered, switched, u, s
