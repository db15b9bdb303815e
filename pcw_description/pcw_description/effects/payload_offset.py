"""Mass that sits elsewhere than described: the centre of mass of the chassis is displaced."""

import dataclasses
from collections.abc import Mapping, Sequence

from ..robot_description import RobotDescription
from .effect import EffectParameter
from .kinds import DescriptionEffect


def with_displaced_mass(robot: RobotDescription, target: Sequence[str], parameters: Mapping[str, float]) -> RobotDescription:
    """Return the robot whose chassis has its centre of mass displaced by (x, y, z); the loads of the wheels follow."""
    chassis = robot.chassis
    com = (chassis.com[0] + parameters["x"], chassis.com[1] + parameters["y"], chassis.com[2] + parameters["z"])
    return dataclasses.replace(robot, chassis=dataclasses.replace(chassis, com=com))


EFFECT = DescriptionEffect(
    name="payload_offset",
    target_kind="chassis",
    axis="chassis",
    summary="The load sits elsewhere than described: the centre of mass is displaced, and some wheels carry more than others.",
    sentence="The centre of mass is displaced by {x:+.3g} m forwards, {y:+.3g} m to the left and {z:+.3g} m upwards.",
    parameters=(
        EffectParameter("x", "m", "forwards", -2.0, 2.0, 0.03, near_linear=True),
        EffectParameter("y", "m", "to the left", -2.0, 2.0, 0.03, default=0.0, near_linear=True),
        EffectParameter("z", "m", "upwards", -2.0, 2.0, 0.05, default=0.0),
    ),
    sensors=("joint_states", "imu/data"),
    look_alikes=("payload_mass", "ground_slope"),
    separating_experiment="accelerate along both axes: a displaced mass turns the robot as it accelerates",
    apply=with_displaced_mass,
)
