"""A floor with waves: wheels are lifted one by one, and climb."""

import math

from ..compiled import compiled_array_kernel
from .effect import EffectParameter
from .kinds import CONTACT_X, CONTACT_Y, GRADIENT_X, GRADIENT_Y, HEIGHT, ContactEffect


@compiled_array_kernel
def wavy_ground(at, parameters, result):  # type: ignore[no-untyped-def]
    """Add the height amplitude sin(k x) cos(k y) and its gradient, k = 2 pi / wavelength, axes turned by direction."""
    k = 2.0 * math.pi / parameters[1]
    c, s = math.cos(parameters[2]), math.sin(parameters[2])
    along = k * (c * at[CONTACT_X] + s * at[CONTACT_Y])
    across = k * (-s * at[CONTACT_X] + c * at[CONTACT_Y])
    slope_along = parameters[0] * k * math.cos(along) * math.cos(across)
    slope_across = -parameters[0] * k * math.sin(along) * math.sin(across)
    result[HEIGHT] += parameters[0] * math.sin(along) * math.cos(across)
    result[GRADIENT_X] += c * slope_along - s * slope_across
    result[GRADIENT_Y] += s * slope_along + c * slope_across


EFFECT = ContactEffect(
    name="uneven_ground",
    target_kind="caster",
    axis="drive",
    summary="The floor has waves: the load shifts between the wheels, and each wheel climbs and descends.",
    sentence="The floor has waves of {amplitude:.3g} m, every {wavelength:.3g} m, turned by {direction:.3g} rad.",
    parameters=(
        EffectParameter("amplitude", "m", "height of the crests", 0.0, 0.1, 2e-3, near_linear=True),
        EffectParameter("wavelength", "m", "from crest to crest", 0.05, 100.0, 1.0, default=1.0),
        EffectParameter("direction", "rad", "of the waves in the world", -6.3, 6.3, 0.0, default=0.0),
    ),
    sensors=("joint_states", "imu/data"),
    look_alikes=("wheel_eccentricity", "motor_cogging", "ground_slope"),
    separating_experiment="drive the same path again: what belongs to the floor comes at the same places",
    contact=wavy_ground,
)
