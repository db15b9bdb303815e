"""A gear or belt that twists under torque: motor and joint move apart like the ends of a spring."""

from collections.abc import Mapping

from ..robot_description import AXIS_NAMES
from .effect import EffectParameter
from .kinds import Gear, TransmissionEffect


def twisting_gear(parameters: Mapping[str, float]) -> Gear:
    """Return a spring and damper without play."""
    return Gear(parameters["stiffness"], parameters["damping"], 0.0)


EFFECT = TransmissionEffect(
    name="gear_elasticity",
    target_kind="caster",
    axis="drive",
    summary="The gear twists under torque, so that motor and joint swing against each other.",
    sentence="The gear in the {joint} of {target} twists by one radian per {stiffness:.4g} N m.",
    parameters=(
        EffectParameter("stiffness", "N m/rad", "torque per twist, joint side", 1.0, 1e7, 500.0, reciprocal=True),
        EffectParameter("damping", "N m s/rad", "damping of the twist, joint side", 0.0, 1e4, 0.5, default=0.5),
    ),
    sensors=("joint_states",),
    look_alikes=("gear_backlash", "actuator_lag", "tyre_longitudinal_stiffness"),
    separating_experiment="block the joint and ramp the torque both ways: a spring is a line, play is a step at zero torque",
    gear=twisting_gear,
    axes=AXIS_NAMES,
)
