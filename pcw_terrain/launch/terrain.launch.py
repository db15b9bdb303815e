"""The ground under every caster: the terrain node. Start `estimation.launch.py` as well, for slip and odometry.

ros2 launch pcw_terrain terrain.launch.py robot:=tidybot2 source:=odom
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue


def generate_launch_description() -> LaunchDescription:
    """Entry point of `ros2 launch`."""
    robot = ParameterValue(LaunchConfiguration("robot"), value_type=str)
    source = ParameterValue(LaunchConfiguration("source"), value_type=str)
    return LaunchDescription(
        [
            DeclareLaunchArgument("robot", default_value="thesis", description="a .yaml file or a shipped robot"),
            DeclareLaunchArgument("source", default_value="observer", description="where slip comes from: observer or odom"),
            Node(
                package="pcw_terrain", executable="terrain", output="screen", parameters=[{"robot": robot, "source": source}]
            ),
        ]
    )
