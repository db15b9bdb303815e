"""The CAN driver on the topics of the robot, and on request the emulated drives that it talks to.

ros2 launch pcw_sim_bridge can_driver.launch.py robot:=thesis can_file:=my_drives.yaml
ros2 launch pcw_sim_bridge can_driver.launch.py emulate:=true autostart:=true
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration, PythonExpression
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

# name, default, meaning
ARGUMENTS = (
    ("robot", "thesis", "a .yaml file or a shipped robot"),
    ("can_file", "thesis_cia402", "file of the drives, or the name of a shipped one"),
    ("autostart", "false", "configure and activate once the drives answer"),
    ("emulate", "false", "start the emulated drives too, on UDP multicast"),
    ("udp_port", "28850", "port of the emulated buses"),
)


def generate_launch_description() -> LaunchDescription:
    """Entry point of `ros2 launch`."""
    value = {name: LaunchConfiguration(name) for name, _, _ in ARGUMENTS}
    port = PythonExpression(["int('", value["udp_port"], "') if '", value["emulate"], "'.lower() == 'true' else 0"])
    parameters = {
        "robot": ParameterValue(value["robot"], value_type=str),
        "can_file": ParameterValue(value["can_file"], value_type=str),
        "autostart": ParameterValue(value["autostart"], value_type=bool),
        "udp_port": ParameterValue(port, value_type=int),
    }
    return LaunchDescription(
        [
            *(DeclareLaunchArgument(name, default_value=default, description=what) for name, default, what in ARGUMENTS),
            Node(
                package="pcw_sim_bridge", executable="drive_emulator", output="screen",
                condition=IfCondition(value["emulate"]),
                arguments=["--robot", value["robot"], "--can-file", value["can_file"], "--udp-port", value["udp_port"]],
            ),
            Node(package="pcw_sim_bridge", executable="can_driver", output="screen", parameters=[parameters]),
        ]
    )  # fmt: skip
