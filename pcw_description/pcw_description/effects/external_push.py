"""Somebody, or something, pushes the robot for a while."""

from ..compiled import compiled_array_kernel
from .effect import EffectParameter
from .kinds import FORCE_TIME, ChassisForceEffect


@compiled_array_kernel
def push(at, parameters, result):  # type: ignore[no-untyped-def]
    """Add a constant force at a point of base_link from start on, for duration."""
    since = at[FORCE_TIME] - parameters[2]
    # Half a nanosecond for the rounding of times that are counted in steps.
    if -5e-10 <= since < parameters[3] - 5e-10:
        force_x, force_y = parameters[0], parameters[1]
        x, y, z = parameters[4], parameters[5], parameters[6]
        result[0] += force_x
        result[1] += force_y
        result[3] -= z * force_y
        result[4] += z * force_x
        result[5] += x * force_y - y * force_x


EFFECT = ChassisForceEffect(
    name="external_push",
    target_kind="chassis",
    axis="chassis",
    summary="A force from outside acts on the chassis for a while.",
    sentence=(
        "A push of ({force_x:.3g}, {force_y:.3g}) N in base_link from {start:.3g} s on, for {duration:.3g} s, at "
        "({x:.3g}, {y:.3g}, {z:.3g}) m."
    ),
    parameters=(
        EffectParameter("force_x", "N", "forwards", -1e5, 1e5, 20.0, linear=True),
        EffectParameter("force_y", "N", "to the left", -1e5, 1e5, 20.0, default=0.0, linear=True),
        EffectParameter("start", "s", "since the start of the simulation", 0.0, 1e6, 5.0),
        EffectParameter("duration", "s", "how long it lasts", 0.0, 1e6, 1.0, default=1.0),
        EffectParameter("x", "m", "where it acts, in base_link", -10.0, 10.0, 0.0, default=0.0),
        EffectParameter("y", "m", "where it acts, in base_link", -10.0, 10.0, 0.0, default=0.0),
        EffectParameter("z", "m", "where it acts, above the ground", 0.0, 10.0, 0.3, default=0.3),
    ),
    sensors=("joint_states", "imu/data"),
    look_alikes=("ground_slope", "payload_mass"),
    separating_experiment="repeat the manoeuvre: what comes from outside does not come again",
    wrench=push,
)
