"""What a robot knows of its own motion: odometry, and slip from encoders and from motor torques.

ros2 launch pcw_estimation estimation.launch.py robot:=tidybot2 publish_tf:=false
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue


def generate_launch_description() -> LaunchDescription:
    """Entry point of `ros2 launch`."""
    robot = ParameterValue(LaunchConfiguration("robot"), value_type=str)
    publish_tf = ParameterValue(LaunchConfiguration("publish_tf"), value_type=bool)
    return LaunchDescription(
        [
            DeclareLaunchArgument("robot", default_value="thesis", description="a .yaml file or a shipped robot"),
            DeclareLaunchArgument("publish_tf", default_value="true", description="publish odom -> base_link on /tf"),
            Node(
                package="pcw_estimation", executable="odometry", output="screen",
                parameters=[{"robot": robot, "publish_tf": publish_tf}],
            ),
            Node(package="pcw_estimation", executable="encoder_slip", output="screen", parameters=[{"robot": robot}]),
            Node(package="pcw_estimation", executable="slip_observer", output="screen", parameters=[{"robot": robot}]),
        ]
    )
