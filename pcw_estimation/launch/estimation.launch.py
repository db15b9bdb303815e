"""What a robot knows of its own motion: odometry, slip by encoders, IMU and motor torques, and motion without slipping wheels.

ros2 launch pcw_estimation estimation.launch.py robot:=tidybot2 publish_tf:=false fused_odom:=true
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.conditions import UnlessCondition
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue


def generate_launch_description() -> LaunchDescription:
    """Entry point of `ros2 launch`."""
    robot = ParameterValue(LaunchConfiguration("robot"), value_type=str)
    noise = ParameterValue(LaunchConfiguration("noise"), value_type=str)
    publish_tf = ParameterValue(LaunchConfiguration("publish_tf"), value_type=bool)
    fused_odom = ParameterValue(LaunchConfiguration("fused_odom"), value_type=bool)
    slip = {"robot": robot, "noise": noise}
    return LaunchDescription(
        [
            DeclareLaunchArgument("robot", default_value="thesis", description="a .yaml file or a shipped robot"),
            DeclareLaunchArgument("publish_tf", default_value="true", description="publish odom -> base_link on /tf"),
            DeclareLaunchArgument("noise", default_value="", description="file that `calibrate` wrote"),
            DeclareLaunchArgument("fused_odom", default_value="false", description="odom from slip_fusion, not from odometry"),
            Node(
                package="pcw_estimation", executable="odometry", output="screen",
                parameters=[{"robot": robot, "publish_tf": publish_tf}],
                condition=UnlessCondition(LaunchConfiguration("fused_odom")),
            ),
            Node(package="pcw_estimation", executable="encoder_slip", output="screen", parameters=[slip]),
            Node(package="pcw_estimation", executable="imu_slip", output="screen", parameters=[slip]),
            Node(
                package="pcw_estimation", executable="slip_fusion", output="screen",
                parameters=[slip | {"publish_odom": fused_odom, "publish_tf": publish_tf}],
            ),
            Node(package="pcw_estimation", executable="slip_observer", output="screen", parameters=[{"robot": robot}]),
        ]
    )
