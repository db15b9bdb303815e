"""A payload that the description does not know: more mass, carried at a place in base_link."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from .effect import EffectParameter
from .kinds import DescriptionEffect

if TYPE_CHECKING:
    from ..robot_description import RobotDescription


def with_payload(robot: RobotDescription, target: Sequence[str], parameters: Mapping[str, float]) -> RobotDescription:
    """Return the robot carrying a point mass; chassis mass, centre of mass and inertias follow (parallel axes)."""
    payload = parameters["mass"]
    place = (parameters["x"], parameters["y"], parameters["z"])
    chassis = robot.chassis
    mass = chassis.mass + payload
    com = tuple((chassis.mass * c + payload * p) / mass for c, p in zip(chassis.com, place, strict=True))
    arm = [p - c for c, p in zip(chassis.com, place, strict=True)]
    reduced = chassis.mass * payload / mass
    xx, yy, zz = chassis.principal_inertias()
    loaded = dataclasses.replace(
        chassis,
        mass=mass,
        com=(com[0], com[1], com[2]),
        inertia_xx=xx + reduced * (arm[1] ** 2 + arm[2] ** 2),
        inertia_yy=yy + reduced * (arm[0] ** 2 + arm[2] ** 2),
        inertia_zz=zz + reduced * (arm[0] ** 2 + arm[1] ** 2),
    )
    return dataclasses.replace(robot, chassis=loaded)


EFFECT = DescriptionEffect(
    name="payload_mass",
    target_kind="chassis",
    axis="chassis",
    summary="The robot carries a mass that its description does not hold.",
    sentence="A payload of {mass:.3g} kg at ({x:.2f}, {y:.2f}, {z:.2f}) m in base_link.",
    parameters=(
        EffectParameter("mass", "kg", "mass of the payload", 0.0, 1e4, 10.0, linear=True),
        EffectParameter("x", "m", "forward of base_link", -5.0, 5.0, 0.1, default=0.0),
        EffectParameter("y", "m", "left of base_link", -5.0, 5.0, 0.1, default=0.0),
        EffectParameter("z", "m", "above the ground", 0.0, 5.0, 0.5, default=0.5),
    ),
    sensors=("joint_states", "imu/data"),
    look_alikes=("torque_constant_error",),
    separating_experiment="accelerate hard in x, y and yaw; drive at constant speed, where mass does not matter",
    apply=with_payload,
)
