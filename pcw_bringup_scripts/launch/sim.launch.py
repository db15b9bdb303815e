"""A simulated robot that drives: bridge, controller, odometry and slip, and its URDF; a recorder and RViz on demand.

ros2 launch pcw_bringup_scripts sim.launch.py robot:=tidybot2 plant:=pybullet record:=run_1
ros2 launch pcw_bringup_scripts sim.launch.py rviz:=true
ros2 topic pub -r 20 /cmd_vel geometry_msgs/msg/TwistStamped "{twist: {linear: {x: 0.3}}}"
"""

import shutil

from launch import LaunchDescription
from launch.action import Action
from launch.actions import DeclareLaunchArgument, ExecuteProcess, IncludeLaunchDescription, LogInfo
from launch.conditions import IfCondition
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution, PythonExpression
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare

# name, default, meaning
ARGUMENTS = (
    ("robot", "thesis", "a .yaml file or a shipped robot"),
    ("plant", "reduced", "reduced, pybullet or mujoco"),
    ("real_time_factor", "1.0", "simulated per real time; 0 is as fast as possible"),
    ("seed", "0", "seed of the sensor noise"),
    ("gui", "false", "show the window of PyBullet or MuJoCo"),
    ("lockstep", "false", "the simulation waits for the controller"),
    ("rviz", "false", "show the robot, its contact forces, slip and ground patches in RViz"),
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


def _viewer(condition: IfCondition) -> Action:
    """RViz with the layout of this package; where it is not installed, a line that says what does without."""
    if shutil.which("rviz2") is None:
        what = "rviz2 is not in the PATH; markers and transforms are published all the same, for Foxglove or an RViz elsewhere"
        return LogInfo(msg=what, condition=condition)
    layout = PathJoinSubstitution([FindPackageShare("pcw_bringup_scripts"), "config", "pcw.rviz"])
    # The robot's stamps are simulated time, and so is the time after which an arrow vanishes.
    command = ["rviz2", "-d", layout, "--ros-args", "-p", "use_sim_time:=true"]
    return ExecuteProcess(cmd=command, condition=condition)


def generate_launch_description() -> LaunchDescription:
    """Entry point of `ros2 launch`."""
    record = LaunchConfiguration("record")
    robot = ParameterValue(LaunchConfiguration("robot"), value_type=str)
    looked_at = IfCondition(LaunchConfiguration("rviz"))
    return LaunchDescription(
        [
            *(DeclareLaunchArgument(name, default_value=value, description=what) for name, value, what in ARGUMENTS),
            *(_part(*part) for part in PARTS),
            Node(package="pcw_sim_bridge", executable="markers", parameters=[{"robot": robot}], condition=looked_at),
            # The odometry publishes odom -> base_link; what is left are the links, and map -> odom.
            Node(
                package="pcw_description", executable="transforms", parameters=[{"robot": robot, "base": "drift"}],
                condition=looked_at,
            ),
            _viewer(looked_at),
            Node(
                package="pcw_sim_bridge", executable="recorder", output="screen",
                # A name that is a number stays a name.
                parameters=[{"output": ParameterValue(record, value_type=str)}],
                condition=IfCondition(PythonExpression(["'", record, "' != ''"])),
            ),
        ]
    )
