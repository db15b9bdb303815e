"""A constant torque on the drive: a cable pulling, an unbalanced weight, an offset of the torque sensor or amplifier."""

from ..compiled import compiled_joint_torque
from .effect import EffectParameter
from .kinds import JointTorqueEffect


@compiled_joint_torque
def constant_torque(position, velocity, motor_torque, normal_force, parameters):  # type: ignore[no-untyped-def]
    """Return -load: positive loads must be overcome when moving forwards [N m]."""
    return -parameters[0], 0.0


EFFECT = JointTorqueEffect(
    name="constant_load",
    target_kind="caster",
    axis="drive",
    summary="A constant torque against the drive, the same at rest, forwards and backwards.",
    sentence="A constant load of {load:.3g} N m against the drive of {target}.",
    parameters=(
        EffectParameter(
            "load", "N m", "torque needed to hold against it; negative helps forwards", -1e4, 1e4, 1.0, linear=True
        ),
    ),
    sensors=("joint_states",),
    look_alikes=("ground_slope", "torque_constant_error"),
    separating_experiment="turn the robot by 180 degrees and repeat: a slope changes sign, an offset does not",
    # Every drive has friction; few pull to one side. A wheel that never turned back shows no difference.
    log_prior=-1.0,
    torque=constant_torque,
)
