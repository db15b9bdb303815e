"""The simulated robot on the topics of a real one.

ros2 launch pcw_sim_bridge bridge.launch.py robot:=tidybot2 plant:=pybullet gui:=true
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

# name, default, meaning, type
ARGUMENTS = (
    ("robot", "thesis", "a .yaml file or a shipped robot", str),
    ("plant", "reduced", "reduced, pybullet or mujoco", str),
    ("real_time_factor", "1.0", "simulated per real time; 0 is as fast as possible", float),
    ("seed", "0", "seed of the sensor noise", int),
    ("gui", "false", "show the window of PyBullet or MuJoCo", bool),
    ("lockstep", "false", "wait for a command after each joint_states", bool),
)


def generate_launch_description() -> LaunchDescription:
    """Entry point of `ros2 launch`."""
    parameters = {name: ParameterValue(LaunchConfiguration(name), value_type=kind) for name, _, _, kind in ARGUMENTS}
    return LaunchDescription(
        [
            *(DeclareLaunchArgument(name, default_value=value, description=what) for name, value, what, _ in ARGUMENTS),
            Node(package="pcw_sim_bridge", executable="bridge", output="screen", parameters=[parameters]),
        ]
    )
