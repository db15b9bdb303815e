"""Stribeck friction of the drive: extra dry friction that vanishes as the speed grows."""

import math

from ..compiled import compiled_joint_torque
from .drive_coulomb_friction import SMOOTHING_SPEED, smooth_sign
from .effect import EffectParameter
from .kinds import JointTorqueEffect


@compiled_joint_torque
def stribeck_torque(position, velocity, motor_torque, normal_force, parameters):  # type: ignore[no-untyped-def]
    """Return -stribeck exp(-(v / stribeck_speed)^2) sgn(v), with a smoothed sign [N m]."""
    ratio = velocity / parameters[1]
    sign = smooth_sign(velocity, parameters[2])
    level = parameters[0] * math.exp(-ratio * ratio)
    return -level * sign, level * ((1.0 - sign * sign) / parameters[2] - 2.0 * ratio * sign / parameters[1])


EFFECT = JointTorqueEffect(
    name="drive_stribeck_friction",
    target_kind="caster",
    axis="drive",
    summary="Breakaway friction above the Coulomb level that fades within the Stribeck speed.",
    sentence="Stribeck friction of {stribeck:.3g} N m below {stribeck_speed:.3g} rad/s in the drive of {target}.",
    parameters=(
        EffectParameter("stribeck", "N m", "friction above the Coulomb level near standstill", 0.0, 1e4, 0.5, linear=True),
        EffectParameter("stribeck_speed", "rad/s", "speed at which it has fallen to 37 %", 1e-5, 1e3, 0.5),
        SMOOTHING_SPEED,
    ),
    sensors=("joint_states",),
    look_alikes=("drive_coulomb_friction",),
    separating_experiment="stop and go at creep speed, several times",
    torque=stribeck_torque,
)
