"""Cogging of a motor: a torque periodic in its angle, joint side."""

import math

from ..compiled import compiled_joint_torque
from ..robot_description import AXIS_NAMES
from .effect import EffectParameter
from .kinds import JointTorqueEffect


@compiled_joint_torque
def cogging_torque(position, velocity, motor_torque, normal_force, parameters):  # type: ignore[no-untyped-def]
    """Return cosine cos(k q) + sine sin(k q), k periods per radian of the motor, joint side [N m]."""
    angle = parameters[2] * position
    return parameters[0] * math.cos(angle) + parameters[1] * math.sin(angle), 0.0


EFFECT = JointTorqueEffect(
    name="motor_cogging",
    target_kind="caster",
    axis="drive",
    summary="Torque ripple tied to the angle of the motor: magnets pulling on the slots.",
    sentence=(
        "Cogging of order {order:.4g} per radian with cosine {cosine:.3g} and sine {sine:.3g} N m in the {joint} of {target}."
    ),
    parameters=(
        EffectParameter("cosine", "N m", "cosine part of the ripple", -1e4, 1e4, 0.2, linear=True),
        EffectParameter("sine", "N m", "sine part of the ripple", -1e4, 1e4, 0.2, default=0.0, linear=True),
        EffectParameter("order", "1/rad", "ripple periods per radian of the motor, joint side", 0.05, 1e5, 40.0),
    ),
    sensors=("joint_states",),
    look_alikes=("wheel_eccentricity",),
    separating_experiment="turn slowly over many revolutions in both directions, at two speeds",
    torque=cogging_torque,
    motor_side=True,
    axes=AXIS_NAMES,
)
