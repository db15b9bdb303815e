"""Computed torque: cmd_vel or goal_pose and joint_states in, joint_commands out.

ros2 launch pcw_control computed_torque.launch.py robot:=tidybot2 autostart:=false
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import LifecycleNode
from launch_ros.parameter_descriptions import ParameterValue

# name, default, meaning, type
ARGUMENTS = (
    ("robot", "thesis", "a .yaml file or a shipped robot", str),
    ("autostart", "true", "configure and activate at once; otherwise by lifecycle services", bool),
    ("cmd_vel_stamped", "true", "cmd_vel is a TwistStamped, not a Twist", bool),
)


def generate_launch_description() -> LaunchDescription:
    """Entry point of `ros2 launch`."""
    parameters = {name: ParameterValue(LaunchConfiguration(name), value_type=kind) for name, _, _, kind in ARGUMENTS}
    return LaunchDescription(
        [
            *(DeclareLaunchArgument(name, default_value=value, description=what) for name, value, what, _ in ARGUMENTS),
            LifecycleNode(
                package="pcw_control", executable="computed_torque", name="computed_torque", namespace="", output="screen",
                parameters=[parameters],
            ),
        ]
    )
