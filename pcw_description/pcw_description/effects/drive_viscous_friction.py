"""Viscous friction of the drive: a torque proportional to speed, against it."""

from ..compiled import compiled_joint_torque
from .effect import EffectParameter
from .kinds import JointTorqueEffect


@compiled_joint_torque
def viscous_torque(position, velocity, motor_torque, normal_force, parameters):  # type: ignore[no-untyped-def]
    """Return -(viscous v + asymmetry |v|) [N m]."""
    slope = parameters[0] + (parameters[1] if velocity >= 0.0 else -parameters[1])
    return -(parameters[0] * velocity + parameters[1] * abs(velocity)), slope


EFFECT = JointTorqueEffect(
    name="drive_viscous_friction",
    target_kind="caster",
    axis="drive",
    summary="Friction in the drive that grows with speed.",
    sentence="Viscous friction of {viscous:.3g} N m s/rad in the drive of {target}.",
    parameters=(
        EffectParameter("viscous", "N m s/rad", "friction per speed, mean of both directions", 0.0, 1e5, 0.1, linear=True),
        EffectParameter(
            "asymmetry", "N m s/rad", "half the difference of the friction forwards and backwards", -1e5, 1e5, 0.02,
            default=0.0, linear=True, clause=", asymmetric by {asymmetry:+.3g} N m s/rad forwards and the opposite backwards",
        ),
    ),
    sensors=("joint_states",),
    look_alikes=("drive_coulomb_friction", "aerodynamic_drag"),
    separating_experiment="drive at several constant speeds in both directions, or let the robot coast down",
    torque=viscous_torque,
)
