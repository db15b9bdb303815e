"""What a motor can give at most: its current limit, and at speed the voltage that its back-EMF leaves."""

from ..compiled import compiled_array_kernel
from ..robot_description import AXIS_NAMES
from .effect import EffectParameter
from .kinds import MOTOR_RATE, TORQUE, ActuatorEffect


@compiled_array_kernel
def saturated_torque(at, parameters, result):  # type: ignore[no-untyped-def]
    """Clip to +-torque; driving, full torque up to knee_speed and from there in a line to zero at no_load_speed."""
    limit, knee, no_load = parameters[0], parameters[1], parameters[2]
    torque, speed = result[TORQUE], abs(at[MOTOR_RATE])
    driving = limit
    if torque * at[MOTOR_RATE] > 0.0 and speed > knee:
        driving = limit * max(no_load - speed, 0.0) / (no_load - knee) if no_load > knee else 0.0
    result[TORQUE] = min(max(torque, -driving), driving)


EFFECT = ActuatorEffect(
    name="torque_saturation",
    target_kind="caster",
    axis="drive",
    summary="The motor gives no more than its current limit, and less at speed, where its back-EMF uses up the voltage.",
    sentence="The {joint} of {target} gives at most {torque:.3g} N m.",
    parameters=(
        EffectParameter("torque", "N m", "largest torque, joint side", 0.0, 1e5, 5.0),
        EffectParameter(
            "knee_speed", "rad/s", "joint speed up to which it is there", 0.0, 1e4, 10.0, default=1e4,
            clause=", less above {knee_speed:.3g} rad/s",
        ),
        EffectParameter(
            "no_load_speed", "rad/s", "joint speed at which nothing is left", 0.0, 1e5, 20.0, default=1e5,
            clause=", and nothing from {no_load_speed:.3g} rad/s on",
        ),
    ),
    sensors=("joint_states", "joint_commands"),
    look_alikes=("torque_constant_error", "actuator_lag"),
    separating_experiment="plot measured against commanded torque: a limit is a wall, a wrong torque constant a slope",
    drive=saturated_torque,
    stage=2,
    axes=AXIS_NAMES,
)
