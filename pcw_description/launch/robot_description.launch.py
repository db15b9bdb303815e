"""URDF of a robot on `robot_description`; with `frames:=true` its transforms from `joint_states`, too.

ros2 launch pcw_description robot_description.launch.py robot:=tidybot2 frames:=true
"""

from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from pcw_description import load_robot
from pcw_description.urdf import robot_urdf


def nodes(context: LaunchContext) -> list[Node]:
    """Return the one node that publishes the URDF of the robot that the argument names."""
    robot = LaunchConfiguration("robot").perform(context)
    if LaunchConfiguration("frames").perform(context).lower() not in ("true", "1"):
        return [
            Node(package="pcw_description", executable="robot_description", parameters=[{"robot": robot}])
        ]
    # robot_state_publisher publishes the URDF itself; two publishers of one latched topic would be one too many.
    urdf = robot_urdf(load_robot(robot))
    return [
        Node(
            package="robot_state_publisher",
            executable="robot_state_publisher",
            parameters=[{"robot_description": urdf}],
        )
    ]


def generate_launch_description() -> LaunchDescription:
    """Entry point of `ros2 launch`."""
    return LaunchDescription(
        [
            DeclareLaunchArgument(
                "robot", default_value="thesis", description="a .yaml file or a shipped robot"
            ),
            DeclareLaunchArgument(
                "frames", default_value="false", description="use robot_state_publisher, which must be there"
            ),
            OpaqueFunction(function=nodes),
        ]
    )
