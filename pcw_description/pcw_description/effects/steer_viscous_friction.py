"""Viscous friction of the steering: a torque proportional to its rate, against it."""

from .drive_viscous_friction import EFFECT as DRIVE_EFFECT
from .kinds import JointTorqueEffect

EFFECT = JointTorqueEffect(
    name="steer_viscous_friction",
    target_kind="caster",
    axis="steer",
    summary="Friction in the steering that grows with its rate.",
    sentence="Viscous friction of {viscous:.3g} N m s/rad in the steering of {target}.",
    parameters=DRIVE_EFFECT.parameters,
    sensors=("joint_states",),
    look_alikes=("steer_coulomb_friction",),
    separating_experiment="turn the steering at several constant rates in both directions",
    torque=DRIVE_EFFECT.torque,
)
