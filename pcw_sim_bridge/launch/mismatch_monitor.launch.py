"""The live watch for physics that the robot's description does not hold.

ros2 launch pcw_sim_bridge mismatch_monitor.launch.py robot:=tidybot2 keep_folder:=departures
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

# name, default, meaning, type
ARGUMENTS = (
    ("robot", "thesis", "a .yaml file or a shipped robot", str),
    ("rate", "4.0", "how often it is judged [Hz]", float),
    ("learning", "20.0", "motion of a healthy robot to learn from [s]", float),
    ("calibration", "", "calibration file to begin with, instead of learning", str),
    ("save_calibration", "", "calibration file to write when learning ends", str),
    ("keep_folder", "", "folder for recordings of departures; none are kept by default", str),
)


def generate_launch_description() -> LaunchDescription:
    """Entry point of `ros2 launch`."""
    parameters = {name: ParameterValue(LaunchConfiguration(name), value_type=kind) for name, _, _, kind in ARGUMENTS}
    return LaunchDescription(
        [
            *(DeclareLaunchArgument(name, default_value=value, description=what) for name, value, what, _ in ARGUMENTS),
            Node(package="pcw_sim_bridge", executable="mismatch_monitor", output="screen", parameters=[parameters]),
        ]
    )
