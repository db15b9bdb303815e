"""The controller under its first name: controller.launch.py with the node named computed_torque.

ros2 launch pcw_control computed_torque.launch.py robot:=tidybot2 autostart:=false
"""

from launch import LaunchDescription
from launch.actions import IncludeLaunchDescription
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import PathJoinSubstitution
from launch_ros.substitutions import FindPackageShare


def generate_launch_description() -> LaunchDescription:
    """Entry point of `ros2 launch`."""
    path = PathJoinSubstitution([FindPackageShare("pcw_control"), "launch", "controller.launch.py"])
    return LaunchDescription(
        [IncludeLaunchDescription(PythonLaunchDescriptionSource(path), launch_arguments=[("node_name", "computed_torque")])]
    )
