"""The parameters of the controller node: those of all controllers, declared once, turned into the cores' dataclasses."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

from rclpy.node import Node

from pcw_description.nodes.node_tools import declare
from pcw_description.robot_description import RobotDescription

from ..computed_torque import ComputedTorqueParameters
from ..controller_interface import ControllerParameters, reason_against, settable_fields, with_values
from ..controllers import CONTROLLERS
from ..quintic_trajectory import MotionLimits
from ..torque_limits import MODES, TorqueLimits

_DEFAULT_LIMITS = ComputedTorqueParameters().limits
_GOAL_LIMITS = MotionLimits()


def parameter_names() -> dict[tuple[str, str], str]:
    """Return the ROS name of every field of every controller: the field's own, unless two controllers mean different things.

    Keys are (controller, field), `slip.loop_delay` for a field of a field. Fields of one name that differ in default, unit
    or range are told apart as CONTROLLER.FIELD.
    """
    meanings: dict[str, set[str]] = {}
    fields = [(name, *found) for name, entry in CONTROLLERS.items() for found in settable_fields(entry.parameters())]
    for _, path, field, value in fields:
        meanings.setdefault(path, set()).add(repr((value, sorted(field.metadata.items()))))
    return {(name, path): path if len(meanings[path]) == 1 else f"{name}.{path}" for name, path, _, _ in fields}


def declare_controller_parameters(node: Node, robot: RobotDescription) -> None:
    """Declare gains and limits, by default those that suit the robot; all can be changed while the controller runs.

    Raises:
        KinematicsError: a caster without offset, whose steering torque makes no side force.
    """
    declared = set()
    names = parameter_names()
    for controller, entry in CONTROLLERS.items():
        for path, field, value in settable_fields(entry.parameters.of_robot(robot)):
            name, meta = names[controller, path], field.metadata
            if name in declared:
                continue
            declared.add(name)
            declare(
                node, name, list(value) if isinstance(value, tuple) else value, meta["description"], meta.get("unit", ""),
                meta.get("range"), choices=meta.get("choices"), check=_refusal(field),
            )
    for prefix, limits, what in (
        ("cmd_vel", _DEFAULT_LIMITS, "of the reference that follows cmd_vel"),
        ("goal", _GOAL_LIMITS, "of the trajectory to goal_pose"),
    ):
        declare(node, f"{prefix}_speed", limits.speed, f"largest speed {what}", "m/s", (0.01, 10.0))
        declare(node, f"{prefix}_acceleration", limits.acceleration, f"largest acceleration {what}", "m/s^2", (0.01, 20.0))
        declare(node, f"{prefix}_yaw_rate", limits.yaw_rate, f"largest yaw rate {what}", "rad/s", (0.01, 20.0))
        declare(
            node, f"{prefix}_yaw_acceleration", limits.yaw_acceleration, f"largest yaw acceleration {what}", "rad/s^2",
            (0.01, 100.0),
        )
    declare(node, "torque_limit_mode", "scale", "scale keeps the direction of the wrench, clip cuts each joint", choices=MODES)
    declare(node, "torque_slew", 0.0, "largest change of a joint torque per time; 0 is no limit", "N m/s", (0.0, 1e6))
    declare(node, "drive_jerk", 0.0, "largest jerk that a wheel is driven with; 0 is no limit", "m/s^3", (0.0, 1e5))
    declare(node, "drive_power", 0.0, "largest mechanical power of all joints that drive; 0 is no limit", "W", (0.0, 1e6))


def _refusal(field: dataclasses.Field[Any]) -> Callable[[Any], str | None]:
    """Return what says why a value is refused; None for one that is allowed."""

    def refusal(value: Any) -> str | None:
        allowed = reason_against(field, value)
        return None if allowed is None else f"{value!r} is not allowed; allowed: {allowed}"

    return refusal


def motion_limits(node: Node, prefix: str = "goal") -> MotionLimits:
    """Return the limits of the reference as the parameters are now."""
    names = ("speed", "acceleration", "yaw_rate", "yaw_acceleration")
    return MotionLimits(*(node.get_parameter(f"{prefix}_{name}").value for name in names))


def controller_parameters(node: Node, controller: str) -> ControllerParameters:
    """Return the gains and limits of one controller as the parameters are now."""
    names = parameter_names()
    found: Any = with_values(
        CONTROLLERS[controller].parameters(), lambda path: node.get_parameter(names[controller, path]).value
    )
    limited: ControllerParameters = dataclasses.replace(found, limits=motion_limits(node, "cmd_vel"))
    return limited


def torque_limits(node: Node, robot: RobotDescription) -> TorqueLimits:
    """Return the robot's torque limits with the mode, slew, jerk and power of the parameters."""
    numbers = {name: node.get_parameter(parameter).value for name, parameter in (
        ("slew", "torque_slew"), ("power", "drive_power"), ("jerk", "drive_jerk"),
    )}
    given = {name: value if value > 0.0 else None for name, value in numbers.items()}
    return TorqueLimits.of_robot(robot, node.get_parameter("torque_limit_mode").value, **given)
