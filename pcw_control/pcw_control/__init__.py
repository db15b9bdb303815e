"""Controllers for powered-caster robots: computed torque, quintic trajectories and torque limits."""

from .computed_torque import (
    ComputedTorque,
    ComputedTorqueMeasurement,
    ComputedTorqueOutput,
    ComputedTorqueParameters,
    ComputedTorqueState,
    TwistReference,
)
from .errors import ControlError
from .quintic_trajectory import MotionLimits, QuinticTrajectory, TrajectoryPoint, plan_point_to_point
from .torque_limits import LimitedTorque, TorqueLimits, limit_torque

__all__ = [
    "ComputedTorque",
    "ComputedTorqueMeasurement",
    "ComputedTorqueOutput",
    "ComputedTorqueParameters",
    "ComputedTorqueState",
    "ControlError",
    "LimitedTorque",
    "MotionLimits",
    "QuinticTrajectory",
    "TorqueLimits",
    "TrajectoryPoint",
    "TwistReference",
    "limit_torque",
    "plan_point_to_point",
]
