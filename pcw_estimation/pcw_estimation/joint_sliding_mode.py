"""Sliding-mode observers of one joint: its load from its motion, by the equivalent injection, (4.14) and (4.15) [Li2009].

A joint turns as q_ddot = a_tau - a_load: what its torque would do to it, less what its load takes. The observer copies the
first, and its correction has to make up for the second:

    e = y - y_hat,      u = H e + K sat(e / layer),      q_dot_hat' = a_tau - a_load_hat + u

In sliding mode e stays within the layer, and the mean of u is the load that the copy lacks: the equivalent injection. It is
what a_load_hat integrates, -a_load_hat' ~ u, so that the load is read off a state instead of off a filtered sign function.

sat is the sign function with a boundary layer, which ends the chattering: of the correction only the share `linear_share`
grows beyond the layer, the rest is bounded. Within the layer all poles are at exp(-bandwidth dt) exactly, for the dt that was
measured, so a late reading changes the gain and not the stability. Measured is either the speed (4.14), state (q_dot, a_load),
or the angle alone (4.15), state (q, q_dot, a_load).
"""

from __future__ import annotations

import math

from pcw_description.compiled import compiled


@compiled
def bounded_correction(error, layer, linear_share):  # type: ignore[no-untyped-def]
    """Return H e + K sat(e / layer), normalised to e within the layer."""
    return linear_share * error + (1.0 - linear_share) * min(max(error, -layer), layer)


@compiled
def from_speed(speed, load, torque_acceleration, measured, dt, bandwidth, layer, linear_share):  # type: ignore[no-untyped-def]
    """Advance the observer of a joint whose speed is measured.

    Args:
        speed, load: q_dot_hat [rad/s] and a_load_hat [rad/s^2] of the reading before.
        torque_acceleration: a_tau over dt [rad/s^2].
        measured: q_dot [rad/s].
        dt: measured time step [s].
        bandwidth: of the poles within the layer [rad/s].
        layer: half width of the boundary layer [rad/s].
        linear_share: H in shares of the gain within the layer, in (0, 1].

    Returns:
        speed, load, and e [rad/s].
    """
    pole = math.exp(-bandwidth * dt)
    predicted = speed + dt * (torque_acceleration - load)
    error = measured - predicted
    correction = bounded_correction(error, layer, linear_share)
    return predicted + (1.0 - pole * pole) * correction, load - (1.0 - pole) ** 2 / dt * correction, error


@compiled
def from_angle(angle, speed, load, torque_acceleration, measured, dt, bandwidth, layer, linear_share):  # type: ignore[no-untyped-def]
    """Advance the observer of a joint whose angle alone is measured; as `from_speed`, `layer` and e in [rad].

    Returns:
        angle, speed, load, and e [rad].
    """
    pole = math.exp(-bandwidth * dt)
    rest = 1.0 - pole
    acceleration = torque_acceleration - load
    predicted = angle + dt * (speed + 0.5 * dt * acceleration)
    error = measured - predicted
    correction = bounded_correction(error, layer, linear_share)
    return (
        predicted + (1.0 - pole**3) * correction,
        speed + dt * acceleration + 1.5 * rest * rest * (1.0 + pole) / dt * correction,
        load - rest**3 / (dt * dt) * correction,
        error,
    )
