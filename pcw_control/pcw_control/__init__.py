"""Controllers for powered-caster robots: computed torque, quintic trajectories, torque limits; excitations."""

from .computed_torque import (
    ComputedTorque,
    ComputedTorqueMeasurement,
    ComputedTorqueOutput,
    ComputedTorqueParameters,
    ComputedTorqueState,
    TwistReference,
)
from .errors import ControlError
from .excitation import EXCITATIONS, Excitation, make_excitation, read_excitation
from .motion_range import MotionRange
from .quintic_trajectory import MotionLimits, QuinticTrajectory, TrajectoryPoint, plan_point_to_point
from .torque_limits import LimitedTorque, TorqueLimits, limit_torque

__all__ = [
    "ComputedTorque",
    "ComputedTorqueMeasurement",
    "ComputedTorqueOutput",
    "ComputedTorqueParameters",
    "ComputedTorqueState",
    "ControlError",
    "EXCITATIONS",
    "Excitation",
    "LimitedTorque",
    "MotionLimits",
    "MotionRange",
    "QuinticTrajectory",
    "TorqueLimits",
    "TrajectoryPoint",
    "TwistReference",
    "limit_torque",
    "make_excitation",
    "plan_point_to_point",
    "read_excitation",
]
