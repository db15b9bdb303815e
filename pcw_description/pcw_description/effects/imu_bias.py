"""An IMU that does not read zero at rest."""

from collections.abc import Mapping

import numpy as np

from .effect import EffectParameter, FloatArray
from .kinds import ImuEffect


def biased_reading(
    angular_velocity: FloatArray, linear_acceleration: FloatArray, parameters: Mapping[str, float]
) -> tuple[FloatArray, FloatArray]:
    """Return both readings with the biases added."""
    turning = np.array([0.0, 0.0, parameters["gyro"]])
    push = np.array([parameters["accelerometer_x"], parameters["accelerometer_y"], 0.0])
    return angular_velocity + turning, linear_acceleration + push


EFFECT = ImuEffect(
    name="imu_bias",
    target_kind="imu",
    axis="imu",
    summary="The IMU reads a rate or an acceleration where there is none.",
    sentence=(
        "The IMU reads {gyro:+.3g} rad/s too much about z, {accelerometer_x:+.3g} m/s^2 along x and {accelerometer_y:+.3g} "
        "m/s^2 along y."
    ),
    parameters=(
        EffectParameter("gyro", "rad/s", "yaw rate read at rest", -10.0, 10.0, 0.01, linear=True),
        EffectParameter("accelerometer_x", "m/s^2", "read at rest, forwards", -50.0, 50.0, 0.1, default=0.0, linear=True),
        EffectParameter("accelerometer_y", "m/s^2", "read at rest, to the left", -50.0, 50.0, 0.1, default=0.0, linear=True),
    ),
    sensors=("imu/data",),
    look_alikes=("ground_slope", "imu_scale"),
    separating_experiment="stand still, then turn the robot by 180 degrees: a slope changes its sign, a bias does not",
    measure=biased_reading,
)
