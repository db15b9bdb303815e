"""Friction of a gear that grows with the torque it transmits, as in gears."""

from ..compiled import compiled_joint_torque
from ..robot_description import AXIS_NAMES
from .drive_coulomb_friction import SMOOTHING_SPEED, smooth_sign
from .effect import EffectParameter
from .kinds import JointTorqueEffect


@compiled_joint_torque
def load_friction_torque(position, velocity, motor_torque, normal_force, parameters):  # type: ignore[no-untyped-def]
    """Return -fraction |motor_torque| sgn(v), with a smoothed sign [N m]."""
    sign, level = smooth_sign(velocity, parameters[1]), parameters[0] * abs(motor_torque)
    return -level * sign, level * (1.0 - sign * sign) / parameters[1]


EFFECT = JointTorqueEffect(
    name="load_dependent_friction",
    target_kind="caster",
    axis="drive",
    summary="Gear friction: a fraction of the transmitted torque is lost.",
    sentence="Gear friction of {fraction:.3g} of the transmitted torque in the {joint} of {target}.",
    parameters=(
        EffectParameter("fraction", "1", "part of the motor torque lost to friction", 0.0, 0.9, 0.1, linear=True),
        SMOOTHING_SPEED,
    ),
    sensors=("joint_states",),
    look_alikes=("drive_coulomb_friction", "torque_constant_error"),
    separating_experiment="accelerate hard and gently at the same speeds, with and without payload",
    torque=load_friction_torque,
    axes=AXIS_NAMES,
)
