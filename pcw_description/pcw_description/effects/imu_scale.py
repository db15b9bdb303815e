"""An IMU that reads too much or too little in proportion."""

from collections.abc import Mapping

import numpy as np

from .effect import EffectParameter, FloatArray
from .kinds import ImuEffect


def scaled_reading(
    angular_velocity: FloatArray, linear_acceleration: FloatArray, parameters: Mapping[str, float]
) -> tuple[FloatArray, FloatArray]:
    """Return both readings with their scale errors."""
    turning = np.array([1.0, 1.0, 1.0 + parameters["gyro"]])
    push = np.array([1.0 + parameters["accelerometer_x"], 1.0 + parameters["accelerometer_y"], 1.0])
    return angular_velocity * turning, linear_acceleration * push


EFFECT = ImuEffect(
    name="imu_scale",
    target_kind="imu",
    axis="imu",
    summary="The IMU reads too much or too little in proportion to the motion.",
    sentence=(
        "The IMU reads {gyro:+.3g} of the yaw rate too much, {accelerometer_x:+.3g} of the acceleration along x and "
        "{accelerometer_y:+.3g} along y."
    ),
    parameters=(
        EffectParameter("gyro", "1", "relative error of the yaw rate", -0.9, 10.0, 0.02, linear=True),
        EffectParameter("accelerometer_x", "1", "relative error forwards", -0.9, 10.0, 0.02, default=0.0, linear=True),
        EffectParameter("accelerometer_y", "1", "relative error to the left", -0.9, 10.0, 0.02, default=0.0, linear=True),
    ),
    sensors=("imu/data",),
    look_alikes=("imu_bias", "wheel_radius_error"),
    separating_experiment="spin at several rates both ways against a measured number of turns",
    measure=scaled_reading,
)
