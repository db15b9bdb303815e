"""Dynamics of one wheel and its slip ratio, (3.43)-(3.46) [Li2009]."""

from __future__ import annotations

from .compiled import compiled


@compiled
def slip_ratio(rolling_speed: float, wheel_speed: float) -> float:
    """Return the slip ratio (r rho_dot - v_x) / max(|r rho_dot|, |v_x|), (3.43).

    The thesis writes the maximum without absolute values, which is meant for forward motion; with them the ratio is
    positive for traction and negative for braking forwards and the mirror of that backwards. At rest it is zero.

    Args:
        rolling_speed: r rho_dot [m/s].
        wheel_speed: velocity of the wheel centre along its heading [m/s].
    """
    largest = max(abs(rolling_speed), abs(wheel_speed))
    if largest == 0.0:
        return 0.0
    return (rolling_speed - wheel_speed) / largest


@compiled
def wheel_acceleration(inertia: float, drive_torque: float, longitudinal_force: float, radius: float) -> float:
    """Return rho_ddot = (tau_rho - F_x r) / I_rho [rad/s^2], (3.45)."""
    return (drive_torque - longitudinal_force * radius) / inertia


@compiled
def lateral_force_from_statics(steer_torque: float, caster_offset_x: float) -> float:
    """Return the side force F_y = tau_phi / b [N] that balances a steering torque, b = -b_x, section 3.3.2."""
    return steer_torque / -caster_offset_x
