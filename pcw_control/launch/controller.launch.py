"""A controller chosen by name: cmd_vel or goal_pose and joint_states in, joint_commands out.

ros2 launch pcw_control controller.launch.py robot:=tidybot2 controller:=slip_constraint_force slip_source:=slip/encoder
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import LifecycleNode
from launch_ros.parameter_descriptions import ParameterValue

# name, default, meaning, type
ARGUMENTS = (
    ("robot", "thesis", "a .yaml file or a shipped robot; gains are derived from it", str),
    ("controller", "computed_torque", "the controller at work", str),
    ("slip_source", "none", "topic of the slip that controllers use, or none", str),
    ("node_name", "controller", "name of the node", str),
    ("autostart", "true", "configure and activate at once; otherwise by lifecycle services", bool),
    ("cmd_vel_stamped", "true", "cmd_vel is a TwistStamped, not a Twist", bool),
)


def generate_launch_description() -> LaunchDescription:
    """Entry point of `ros2 launch`."""
    parameters = {
        name: ParameterValue(LaunchConfiguration(name), value_type=kind)
        for name, _, _, kind in ARGUMENTS
        if name != "node_name"
    }
    return LaunchDescription(
        [
            *(DeclareLaunchArgument(name, default_value=value, description=what) for name, value, what, _ in ARGUMENTS),
            LifecycleNode(
                package="pcw_control", executable="controller", name=LaunchConfiguration("node_name"), namespace="",
                output="screen", parameters=[parameters],
            ),
        ]
    )
