"""Dead time between a torque command and the motor's answer: bus cycles, buffers, computing."""

import math
from collections.abc import Mapping

from ..compiled import compiled_array_kernel
from ..robot_description import AXIS_NAMES
from .effect import EffectParameter
from .kinds import MEMORY, STEP, TORQUE, ActuatorEffect


@compiled_array_kernel
def delayed_torque(at, parameters, result):  # type: ignore[no-untyped-def]
    """Put the torque of `delay` ago in the place of the new one: a ring of past torques, between two of them a line."""
    steps = parameters[0] / at[STEP]
    whole = int(steps)
    size = len(result) - MEMORY - 1
    head = int(result[MEMORY])
    result[MEMORY + 1 + head] = result[TORQUE]
    newer = result[MEMORY + 1 + (head - whole) % size]
    older = result[MEMORY + 1 + (head - whole - 1) % size]
    result[TORQUE] = newer + (steps - whole) * (older - newer)
    result[MEMORY] = (head + 1) % size


def ring_size(parameters: Mapping[str, float], step: float) -> int:
    """Return how many numbers the delay remembers: its place in the ring, and the ring."""
    return 1 + math.floor(parameters["delay"] / step) + 2


EFFECT = ActuatorEffect(
    name="actuator_delay",
    target_kind="caster",
    axis="drive",
    summary="Torque commands take effect late: dead time of the bus, of buffers, of the drive's own cycle.",
    sentence="A dead time of {delay:.3g} s before the {joint} of {target} obeys a torque command.",
    parameters=(EffectParameter("delay", "s", "time from command to torque", 0.0, 0.2, 0.003),),
    sensors=("joint_states", "joint_commands"),
    look_alikes=("actuator_lag", "clock_offset"),
    separating_experiment="command a chirp: a dead time turns the phase in proportion to the frequency, a lag also loses gain",
    drive=delayed_torque,
    memory=ring_size,
    stage=0,
    axes=AXIS_NAMES,
)
