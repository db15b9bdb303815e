"""Coulomb friction of the steering: a constant torque against the direction of turning."""

from .drive_coulomb_friction import EFFECT as DRIVE_EFFECT
from .kinds import JointTorqueEffect

EFFECT = JointTorqueEffect(
    name="steer_coulomb_friction",
    target_kind="caster",
    axis="steer",
    summary="Dry friction in the steering: a constant torque that opposes turning the wheel.",
    sentence="Coulomb friction of {coulomb:.3g} N m in the steering of {target}.",
    parameters=DRIVE_EFFECT.parameters,
    sensors=("joint_states",),
    look_alikes=("steer_viscous_friction",),
    separating_experiment="turn the steering at several constant rates and reverse often; lift the wheel off the ground",
    torque=DRIVE_EFFECT.torque,
)
