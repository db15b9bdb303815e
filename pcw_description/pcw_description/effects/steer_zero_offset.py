"""A steering whose zero is not where the description has it."""

from collections.abc import Mapping

from .effect import EffectParameter, FloatArray
from .kinds import EncoderEffect


def shifted_reading(
    position: FloatArray, velocity: FloatArray, parameters: Mapping[str, float]
) -> tuple[FloatArray, FloatArray]:
    """Return the angles with the offset added, the velocities as they are."""
    return position + parameters["offset"], velocity


EFFECT = EncoderEffect(
    name="steer_zero_offset",
    target_kind="caster",
    axis="steer",
    summary="The steering reads zero where the wheel does not point straight ahead.",
    sentence="The steering of {target} reads {offset:+.3g} rad more than the wheel's heading.",
    parameters=(EffectParameter("offset", "rad", "reported minus true heading", -3.2, 3.2, 0.01, near_linear=True),),
    sensors=("joint_states",),
    look_alikes=("caster_offset_error", "gear_backlash"),
    separating_experiment="drive straight in several directions and reverse: the robot drifts to the same side of its heading",
    measure=shifted_reading,
)
