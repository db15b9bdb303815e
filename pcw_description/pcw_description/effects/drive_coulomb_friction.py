"""Coulomb friction of the drive: a constant torque against the direction of motion."""

import math

from ..compiled import compiled, compiled_joint_torque
from .effect import EffectParameter
from .kinds import JointTorqueEffect

# tanh(v / smoothing_speed) for the sign of v: at 0.05 rad/s a wheel of 75 mm creeps by 4 mm/s, below what encoders resolve
# as steady motion, and the plant needs no event handling.
SMOOTHING_SPEED = EffectParameter(
    "smoothing_speed", "rad/s", "speed over which the friction reverses", 1e-6, 10.0, 0.05, default=0.05
)


@compiled
def smooth_sign(velocity, smoothing_speed):  # type: ignore[no-untyped-def]
    """Return tanh(velocity / smoothing_speed)."""
    ratio = velocity / smoothing_speed
    # Beyond 20 it is the sign to the last digit, at a third of the time: most of the time that a wheel rolls.
    return math.copysign(1.0, ratio) if abs(ratio) > 20.0 else math.tanh(ratio)


@compiled_joint_torque
def coulomb_torque(position, velocity, motor_torque, normal_force, parameters):  # type: ignore[no-untyped-def]
    """Return -(coulomb + asymmetry * sgn(v)) sgn(v), with a smoothed sign [N m]."""
    sign = smooth_sign(velocity, parameters[2])
    slope = (parameters[0] + 2.0 * parameters[1] * sign) * (1.0 - sign * sign) / parameters[2]
    return -(parameters[0] * sign + parameters[1] * sign * sign), slope


EFFECT = JointTorqueEffect(
    name="drive_coulomb_friction",
    target_kind="caster",
    axis="drive",
    summary="Dry friction in the drive: a constant torque that opposes rolling.",
    sentence="Coulomb friction of {coulomb:.3g} N m in the drive of {target}.",
    parameters=(
        EffectParameter("coulomb", "N m", "friction torque, mean of both directions", 0.0, 1e4, 1.0, linear=True),
        EffectParameter(
            "asymmetry", "N m", "half the difference of the friction forwards and backwards", -1e4, 1e4, 0.2, default=0.0,
            linear=True, clause=", asymmetric by {asymmetry:+.3g} N m forwards and the opposite backwards",
        ),
        SMOOTHING_SPEED,
    ),
    sensors=("joint_states",),
    look_alikes=("rolling_resistance", "drive_stribeck_friction", "drive_viscous_friction"),
    separating_experiment="drive at several constant speeds and reverse often; shift a payload to load the wheels unevenly",
    torque=coulomb_torque,
)
