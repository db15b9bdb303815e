"""The current loop of a motor follows its command like a first-order low-pass."""

import math

from ..compiled import compiled_array_kernel
from ..robot_description import AXIS_NAMES
from .effect import EffectParameter
from .kinds import MEMORY, STEP, TORQUE, ActuatorEffect


@compiled_array_kernel
def lagging_torque(at, parameters, result):  # type: ignore[no-untyped-def]
    """Advance torque_dot = (command - torque) / time_constant by a step, exactly for a command held over it."""
    if parameters[0] > 0.0:
        result[MEMORY] += (1.0 - math.exp(-at[STEP] / parameters[0])) * (result[TORQUE] - result[MEMORY])
        result[TORQUE] = result[MEMORY]


EFFECT = ActuatorEffect(
    name="actuator_lag",
    target_kind="caster",
    axis="drive",
    summary="The torque follows its command like a first-order low-pass: the bandwidth of the current loop.",
    sentence="The torque of the {joint} of {target} follows its command with a time constant of {time_constant:.3g} s.",
    parameters=(EffectParameter("time_constant", "s", "time to reach 63 % of a step", 0.0, 1.0, 0.005),),
    sensors=("joint_states", "joint_commands"),
    look_alikes=("actuator_delay",),
    separating_experiment="command a chirp: a lag loses gain with the frequency, a dead time does not",
    drive=lagging_torque,
    memory=lambda parameters, step: 1,
    stage=1,
    axes=AXIS_NAMES,
)
