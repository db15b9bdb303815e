"""An encoder whose disc is mounted off its axis: the angle swings around the true one once per turn."""

from collections.abc import Mapping

import numpy as np

from ..robot_description import AXIS_NAMES
from .effect import EffectParameter, FloatArray
from .kinds import EncoderEffect


def swinging_reading(
    position: FloatArray, velocity: FloatArray, parameters: Mapping[str, float]
) -> tuple[FloatArray, FloatArray]:
    """Return the angles with amplitude sin(angle + phase) added, and the velocities that belong to them."""
    angle, amplitude = position + parameters["phase"], parameters["amplitude"]
    return position + amplitude * np.sin(angle), velocity * (1.0 + amplitude * np.cos(angle))


EFFECT = EncoderEffect(
    name="encoder_eccentricity",
    target_kind="caster",
    axis="steer",
    summary="The encoder's disc is mounted off its axis, so that the reading swings around the angle once per turn.",
    sentence="The encoder of the {joint} of {target} swings by {amplitude:.3g} rad once per turn, phase {phase:.3g} rad.",
    parameters=(
        EffectParameter("amplitude", "rad", "largest error of the angle", 0.0, 0.5, 5e-3, near_linear=True),
        EffectParameter("phase", "rad", "the error is the sine of the angle plus this", -6.3, 6.3, 1.0, default=0.0),
    ),
    sensors=("joint_states",),
    look_alikes=("steer_zero_offset", "wheel_eccentricity", "motor_cogging"),
    separating_experiment="turn the joint slowly through whole turns with the wheel off the ground",
    measure=swinging_reading,
    axes=AXIS_NAMES[::-1],
)
