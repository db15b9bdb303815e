"""A floor that is not level."""

import math
from collections.abc import Mapping

import numpy as np

from .effect import EffectParameter, FloatArray
from .kinds import GravityEffect


def tilted_gravity(parameters: Mapping[str, float]) -> FloatArray:
    """Return the change of gravity's unit vector (3,): it leans towards the downhill direction."""
    angle, downhill = parameters["angle"], parameters["direction"]
    return np.array(
        [math.sin(angle) * math.cos(downhill), math.sin(angle) * math.sin(downhill), 1.0 - math.cos(angle)]
    )


EFFECT = GravityEffect(
    name="ground_slope",
    target_kind="chassis",
    axis="chassis",
    summary="The floor is an inclined plane: gravity pulls the robot downhill and loads the lower wheels.",
    sentence="The floor falls by {angle:.3g} rad towards {direction:.3g} rad in the world.",
    parameters=(
        EffectParameter("angle", "rad", "inclination", 0.0, 0.7, 0.01, near_linear=True),
        EffectParameter("direction", "rad", "where downhill is, from x of the world", -6.3, 6.3, 0.0, default=0.0),
    ),
    sensors=("joint_states", "imu/data"),
    look_alikes=("constant_load", "imu_bias", "payload_offset"),
    separating_experiment="turn the robot by 180 degrees and repeat: a slope changes sign in base_link",
    gravity=tilted_gravity,
)
