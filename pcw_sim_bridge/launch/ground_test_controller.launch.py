"""The controller that tests the ground on request: in place of controller.launch.py of pcw_control.

ros2 launch pcw_sim_bridge ground_test_controller.launch.py robot:=flow_base
ros2 service call /identify_ground std_srvs/srv/Trigger
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import LifecycleNode
from launch_ros.parameter_descriptions import ParameterValue

# name, default, meaning, type
ARGUMENTS = (
    ("robot", "thesis", "a .yaml file or a shipped robot; gains are derived from it", str),
    ("controller", "computed_torque", "the controller at work; a test needs one that it works with", str),
    ("slip_source", "none", "topic of the slip that controllers use, or none", str),
    ("node_name", "ground_test_controller", "name of the node", str),
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
                package="pcw_sim_bridge", executable="ground_test_controller", name=LaunchConfiguration("node_name"),
                namespace="", output="screen", parameters=[parameters],
            ),
        ]
    )
