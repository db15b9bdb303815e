"""An IMU that is mounted elsewhere than described."""

import dataclasses
from collections.abc import Mapping, Sequence

from ..robot_description import RobotDescription
from .effect import EffectParameter
from .kinds import DescriptionEffect


def with_displaced_imu(robot: RobotDescription, target: Sequence[str], parameters: Mapping[str, float]) -> RobotDescription:
    """Return the robot whose IMU is displaced by (x, y); a robot without one is unchanged."""
    imu = robot.sensors.imu
    if imu is None:
        return robot
    position = (imu.position[0] + parameters["x"], imu.position[1] + parameters["y"], imu.position[2])
    sensors = dataclasses.replace(robot.sensors, imu=dataclasses.replace(imu, position=position))
    return dataclasses.replace(robot, sensors=sensors)


EFFECT = DescriptionEffect(
    name="imu_lever_arm",
    target_kind="imu",
    axis="imu",
    summary="The IMU is mounted elsewhere than described, so that turning adds to what it accelerates.",
    sentence="The IMU sits {x:+.3g} m ahead and {y:+.3g} m to the left of its described place.",
    parameters=(
        EffectParameter("x", "m", "forwards", -5.0, 5.0, 0.02, near_linear=True),
        EffectParameter("y", "m", "to the left", -5.0, 5.0, 0.02, default=0.0, near_linear=True),
    ),
    sensors=("imu/data",),
    look_alikes=("imu_bias", "imu_scale"),
    separating_experiment="spin on the spot at changing rates: the error goes with the square and the change of the rate",
    apply=with_displaced_imu,
)
