"""The motor gives another torque than its current says: an error of the torque constant."""

from ..compiled import compiled_joint_torque
from ..robot_description import AXIS_NAMES
from .effect import EffectParameter
from .kinds import JointTorqueEffect


@compiled_joint_torque
def torque_gain_error(position, velocity, motor_torque, normal_force, parameters):  # type: ignore[no-untyped-def]
    """Return error * motor_torque [N m]."""
    return parameters[0] * motor_torque, 0.0


EFFECT = JointTorqueEffect(
    name="torque_constant_error",
    target_kind="caster",
    axis="drive",
    summary="The torque constant of the motor differs from the description.",
    sentence="The {joint} of {target} gives {error:+.3g} of the reported torque in addition.",
    parameters=(EffectParameter("error", "1", "relative error of the torque constant", -0.9, 5.0, 0.1, linear=True),),
    sensors=("joint_states",),
    look_alikes=("payload_mass", "load_dependent_friction", "torque_saturation", "scrub_torque"),
    separating_experiment="add a known mass and repeat; drive on a known slope",
    torque=torque_gain_error,
    motor_side=True,
    axes=AXIS_NAMES,
)
