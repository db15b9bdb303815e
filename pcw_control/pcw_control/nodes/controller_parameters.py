"""The parameters that torque controllers share: declared once, turned into the cores' dataclasses."""

from __future__ import annotations

from rclpy.node import Node

from pcw_description.nodes.node_tools import declare
from pcw_description.robot_description import RobotDescription

from ..computed_torque import ComputedTorqueParameters
from ..quintic_trajectory import MotionLimits
from ..torque_limits import MODES, TorqueLimits

_DEFAULTS = ComputedTorqueParameters()
_GOAL_LIMITS = MotionLimits()


def declare_controller_parameters(node: Node) -> None:
    """Declare gains and limits; all can be changed while the controller runs."""
    declare(node, "velocity_gain", _DEFAULTS.velocity_gain, "gain on the velocity error, k_d", "1/s", (0.0, 200.0))
    declare(node, "position_gain", _DEFAULTS.position_gain, "gain on the pose error, k_p", "1/s^2", (0.0, 1e4))
    declare(node, "integral_gain", _DEFAULTS.integral_gain, "gain on the integral of the velocity error", "1/s^2", (0.0, 1e4))
    declare(
        node, "joint_speed_fraction", _DEFAULTS.joint_speed_fraction, "the reference uses this part of the speed limits",
        "1", (0.01, 1.0),
    )
    for prefix, limits, what in (
        ("cmd_vel", _DEFAULTS.limits, "of the reference that follows cmd_vel"),
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


def motion_limits(node: Node, prefix: str = "goal") -> MotionLimits:
    """Return the limits of the reference as the parameters are now."""
    names = ("speed", "acceleration", "yaw_rate", "yaw_acceleration")
    return MotionLimits(*(node.get_parameter(f"{prefix}_{name}").value for name in names))


def controller_parameters(node: Node) -> ComputedTorqueParameters:
    """Return gains and limits as the parameters are now."""
    names = ("velocity_gain", "position_gain", "integral_gain", "joint_speed_fraction")
    return ComputedTorqueParameters(
        **{name: node.get_parameter(name).value for name in names}, limits=motion_limits(node, "cmd_vel")
    )


def torque_limits(node: Node, robot: RobotDescription) -> TorqueLimits:
    """Return the robot's torque limits with the mode and slew of the parameters."""
    slew = node.get_parameter("torque_slew").value
    return TorqueLimits.of_robot(robot, node.get_parameter("torque_limit_mode").value, slew if slew > 0.0 else None)
