"""Robot description, kinematics, dynamics, contact and recordings of robots on powered caster wheels."""

from .augmented_object_model import AugmentedObjectModel
from .differential_kinematics import (
    forward_kinematics,
    inverse_kinematics,
    joint_matrix,
    slip_velocity,
    wheel_centres,
    wheel_jacobian,
)
from .displacement_kinematics import forward_displacement, inverse_displacement
from .errors import DescriptionError, KinematicsError, PcwError
from .robot_description import DRIVE, LATERAL, LONGITUDINAL, STEER, RobotDescription
from .robot_file import load_robot, parse_robot, save_robot, shipped_robots

__all__ = [
    "DRIVE",
    "LATERAL",
    "LONGITUDINAL",
    "STEER",
    "AugmentedObjectModel",
    "DescriptionError",
    "KinematicsError",
    "PcwError",
    "RobotDescription",
    "forward_displacement",
    "forward_kinematics",
    "inverse_displacement",
    "inverse_kinematics",
    "joint_matrix",
    "load_robot",
    "parse_robot",
    "save_robot",
    "shipped_robots",
    "slip_velocity",
    "wheel_centres",
    "wheel_jacobian",
]
