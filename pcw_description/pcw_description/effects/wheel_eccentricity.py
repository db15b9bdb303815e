"""A wheel that runs out of true: its axle is beside the middle of the tread."""

import math

from ..compiled import compiled_array_kernel
from .effect import EffectParameter
from .kinds import RADIUS_CHANGE, RADIUS_SLOPE, ROLL_ANGLE, ContactEffect


@compiled_array_kernel
def height_of_axle(at, parameters, result):  # type: ignore[no-untyped-def]
    """Add eccentricity cos(roll angle + phase) to the axle's height over the ground, which is the rolling radius."""
    angle = at[ROLL_ANGLE] + parameters[1]
    result[RADIUS_CHANGE] += parameters[0] * math.cos(angle)
    result[RADIUS_SLOPE] -= parameters[0] * math.sin(angle)


EFFECT = ContactEffect(
    name="wheel_eccentricity",
    target_kind="caster",
    axis="drive",
    summary="The axle is beside the middle of the tread: the rolling radius swings once per turn of the wheel.",
    sentence="The wheel of {target} runs out of true by {eccentricity:.3g} m, highest at {phase:.3g} rad before its zero.",
    parameters=(
        EffectParameter(
            "eccentricity", "m", "distance of the axle from the middle of the tread", 0.0, 0.1, 5e-4, near_linear=True
        ),
        EffectParameter("phase", "rad", "roll angle from which the highest point is counted", -6.3, 6.3, 0.0, default=0.0),
    ),
    sensors=("joint_states", "imu/data"),
    look_alikes=("motor_cogging", "encoder_eccentricity", "uneven_ground"),
    separating_experiment="drive straight at two speeds, and again with the wheel lifted: cogging stays, running out goes",
    contact=height_of_axle,
)
