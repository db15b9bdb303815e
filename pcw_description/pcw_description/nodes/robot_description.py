"""Publishes the URDF of a robot description on `robot_description`, kept for late joiners.

No transforms: robot_state_publisher makes those from `robot_description` and `joint_states`.
"""

from __future__ import annotations

import sys

from rclpy.node import Node
from std_msgs.msg import String

from ..robot_file import load_robot
from ..urdf import robot_urdf
from .node_tools import LATCHED, all_declared, declare, run_node


class RobotDescriptionNode(Node):
    """Latched publisher of the URDF; parameter `robot`, read once.

    Raises:
        DescriptionError: no such robot, or its description is not valid.
    """

    def __init__(self) -> None:
        super().__init__("robot_description")
        name = declare(self, "robot", "thesis", "robot description: a .yaml file or a shipped robot", read_only=True)
        all_declared(self)
        robot = load_robot(name)
        self._publisher = self.create_publisher(String, "robot_description", LATCHED)
        self._publisher.publish(String(data=robot_urdf(robot)))
        self.get_logger().info(f"{robot.name}: URDF with {robot.n} casters published")


def main(args: list[str] | None = None) -> int:
    """Run the node until it is told to stop."""
    return run_node(RobotDescriptionNode, args)


if __name__ == "__main__":
    sys.exit(main())
