"""Controllers for powered-caster robots: computed torque, quintic trajectories, torque limits; excitations."""

from .computed_torque import ComputedTorque, ComputedTorqueParameters, ComputedTorqueState
from .controller_interface import (
    Controller,
    ControllerMeasurement,
    ControllerOutput,
    ControllerParameters,
    ForceReference,
    TwistReference,
    internal_forces,
)
from .controllers import CONTROLLERS, make_controller
from .errors import ControlError
from .excitation import EXCITATIONS, Excitation, make_excitation, read_excitation
from .motion_range import MotionRange
from .quintic_trajectory import MotionLimits, QuinticTrajectory, TrajectoryPoint, plan_point_to_point
from .torque_limits import LimitedTorque, TorqueLimits, limit_torque

__all__ = [
    "CONTROLLERS",
    "ComputedTorque",
    "ComputedTorqueParameters",
    "ComputedTorqueState",
    "ControlError",
    "Controller",
    "ControllerMeasurement",
    "ControllerOutput",
    "ControllerParameters",
    "EXCITATIONS",
    "Excitation",
    "ForceReference",
    "LimitedTorque",
    "MotionLimits",
    "MotionRange",
    "QuinticTrajectory",
    "TorqueLimits",
    "TrajectoryPoint",
    "TwistReference",
    "internal_forces",
    "limit_torque",
    "make_controller",
    "make_excitation",
    "plan_point_to_point",
    "read_excitation",
]
