"""A slippery place on the floor."""

import math

from ..compiled import compiled_array_kernel
from .effect import EffectParameter
from .kinds import CONTACT_X, CONTACT_Y, FRICTION, ContactEffect

# The factor fades in over this length [m], about a tyre's contact patch, which is not a point.
EDGE = 0.01


@compiled_array_kernel
def slippery_place(at, parameters, result):  # type: ignore[no-untyped-def]
    """Multiply the friction by factor inside |x/a|^p + |y/b|^p < 1, a and b half the sides, p from 2 (ellipse) to 50."""
    c, s = math.cos(parameters[5]), math.sin(parameters[5])
    x, y = at[CONTACT_X] - parameters[1], at[CONTACT_Y] - parameters[2]
    a, b = 0.5 * parameters[3], 0.5 * parameters[4]
    along, across = abs(c * x + s * y) / a, abs(-s * x + c * y) / b
    if along > 1.0 + EDGE / a or across > 1.0 + EDGE / b:
        return
    power = 2.0 / max(parameters[6], 0.04)
    radius = (along**power + across**power) ** (1.0 / power)
    # From one edge to the other the distance to the border goes from + to - half of EDGE.
    inside = min(max(0.5 + (1.0 - radius) * min(a, b) / EDGE, 0.0), 1.0)
    result[FRICTION] *= 1.0 + inside * (parameters[0] - 1.0)


EFFECT = ContactEffect(
    name="low_friction_patch",
    target_kind="caster",
    axis="drive",
    summary="A place on the floor where the tyres hold less.",
    sentence=(
        "A patch of {length:.3g} m by {width:.3g} m at ({x:.3g}, {y:.3g}) m, where friction is {factor:.3g} of the usual."
    ),
    parameters=(
        EffectParameter(
            "factor", "1", "friction on the patch relative to the floor's", 1e-3, 10.0, 0.3, reciprocal=True, neutral=1.0
        ),
        EffectParameter("x", "m", "centre in the world", -1e4, 1e4, 1.0),
        EffectParameter("y", "m", "centre in the world", -1e4, 1e4, 1.0, default=0.0),
        EffectParameter("length", "m", "whole length", 0.02, 1e4, 0.5, default=0.5),
        EffectParameter("width", "m", "whole width", 0.02, 1e4, 0.5, default=0.5),
        EffectParameter("yaw", "rad", "direction of the length in the world", -6.3, 6.3, 0.0, default=0.0),
        EffectParameter("roundness", "1", "1 is an ellipse, 0 a rectangle", 0.0, 1.0, 1.0, default=1.0),
    ),
    sensors=("joint_states", "imu/data", "ground_truth/odom"),
    look_alikes=("tyre_longitudinal_stiffness", "wheel_radius_error", "uneven_ground"),
    separating_experiment="drive over the same place again, slowly and accelerating: what belongs to the floor stays there",
    contact=slippery_place,
)
