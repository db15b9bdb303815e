"""A simulated robot that drives: bridge, controller, odometry and slip, and its URDF; a recorder on demand.

ros2 launch pcw_bringup_scripts sim.launch.py robot:=tidybot2 plant:=pybullet record:=run_1
ros2 topic pub -r 20 /cmd_vel geometry_msgs/msg/TwistStamped "{twist: {linear: {x: 0.3}}}"
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, IncludeLaunchDescription
from launch.conditions import IfCondition
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution, PythonExpression
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare

# name, default, meaning
ARGUMENTS = (
    ("robot", "thesis", "a .yaml file or a shipped robot"),
    ("plant", "reduced", "reduced or pybullet"),
    ("real_time_factor", "1.0", "simulated per real time; 0 is as fast as possible"),
    ("seed", "0", "seed of the sensor noise"),
    ("gui", "false", "show the window of PyBullet"),
    ("lockstep", "false", "the simulation waits for the controller"),
    ("record", "", "folder to make for a recording; empty: none"),
)
# package, launch file, the arguments that it takes
PARTS = (
    ("pcw_description", "robot_description.launch.py", ("robot",)),
    ("pcw_sim_bridge", "bridge.launch.py", ("robot", "plant", "real_time_factor", "seed", "gui", "lockstep")),
    ("pcw_control", "computed_torque.launch.py", ("robot",)),
    ("pcw_estimation", "estimation.launch.py", ("robot",)),
)


def _part(package: str, file: str, arguments: tuple[str, ...]) -> IncludeLaunchDescription:
    path = PathJoinSubstitution([FindPackageShare(package), "launch", file])
    return IncludeLaunchDescription(
        PythonLaunchDescriptionSource(path), launch_arguments=[(name, LaunchConfiguration(name)) for name in arguments]
    )


def generate_launch_description() -> LaunchDescription:
    """Entry point of `ros2 launch`."""
    record = LaunchConfiguration("record")
    return LaunchDescription(
        [
            *(DeclareLaunchArgument(name, default_value=value, description=what) for name, value, what in ARGUMENTS),
            *(_part(*part) for part in PARTS),
            Node(
                package="pcw_sim_bridge", executable="recorder", output="screen",
                # A name that is a number stays a name.
                parameters=[{"output": ParameterValue(record, value_type=str)}],
                condition=IfCondition(PythonExpression(["'", record, "' != ''"])),
            ),
        ]
    )
