"""A tyre whose rolling radius shrinks under load."""

from ..compiled import compiled_array_kernel
from .effect import EffectParameter
from .kinds import LOAD, RADIUS_CHANGE, ContactEffect


@compiled_array_kernel
def radius_under_load(at, parameters, result):  # type: ignore[no-untyped-def]
    """Take a third of the deflection off the radius, (load - reference load) / (3 stiffness).

    A tyre's rolling radius is about the free radius less a third of its deflection (Gillespie, Fundamentals of Vehicle
    Dynamics, 1992, chapter 10).
    """
    result[RADIUS_CHANGE] -= (at[LOAD] - parameters[1]) / (3.0 * parameters[0])


EFFECT = ContactEffect(
    name="tyre_radial_compliance",
    target_kind="caster",
    axis="drive",
    summary="The tyre flattens under load, and a third of its deflection is missing from the rolling radius.",
    sentence="The tyre of {target} has {stiffness:.4g} N/m of radial stiffness; the described radius holds at {load:.4g} N.",
    parameters=(
        EffectParameter("stiffness", "N/m", "load per deflection of the tyre", 1e4, 1e9, 1e5, reciprocal=True),
        EffectParameter("load", "N", "load under which the described radius holds", 0.0, 1e5, 200.0, default=0.0),
    ),
    sensors=("joint_states", "imu/data", "ground_truth/odom"),
    look_alikes=("wheel_radius_error", "payload_mass"),
    separating_experiment="drive straight over a measured distance with and without a payload",
    contact=radius_under_load,
)
