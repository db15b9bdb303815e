"""Play in a gear: around a reversal the motor turns without moving the joint."""

from collections.abc import Mapping

from ..robot_description import AXIS_NAMES
from .effect import EffectParameter
from .kinds import Gear, TransmissionEffect


def gear_with_play(parameters: Mapping[str, float]) -> Gear:
    """Return a stiff gear with play; its damping keeps the teeth from ringing."""
    return Gear(parameters["tooth_stiffness"], parameters["tooth_damping"], parameters["play"])


EFFECT = TransmissionEffect(
    name="gear_backlash",
    target_kind="caster",
    axis="drive",
    summary="Play between the teeth: after a reversal the motor turns through it before the joint follows.",
    sentence="A play of {play:.3g} rad in the gear of the {joint} of {target}.",
    parameters=(
        EffectParameter("play", "rad", "joint angle between the two flanks", 0.0, 0.5, 0.005, near_linear=True),
        EffectParameter(
            "tooth_stiffness", "N m/rad", "of the engaged teeth, joint side", 10.0, 1e7, 5e3, default=5e3, reciprocal=True
        ),
        EffectParameter("tooth_damping", "N m s/rad", "of the engaged teeth, joint side", 0.0, 1e4, 1.0, default=1.0),
    ),
    sensors=("joint_states",),
    look_alikes=("gear_elasticity", "steer_zero_offset", "drive_coulomb_friction"),
    separating_experiment="reverse slowly and often: the dead band stays the same at every speed and torque",
    gear=gear_with_play,
    axes=AXIS_NAMES,
)
