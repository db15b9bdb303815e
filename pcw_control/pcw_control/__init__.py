"""Controllers for powered-caster robots, trajectories, torque limits and safety; excitations."""

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
from .cross_coupling import (
    CrossCoupling,
    CrossCouplingParameters,
)
from .errors import ControlError
from .excitation import EXCITATIONS, Excitation, make_excitation, read_excitation
from .force_distribution import (
    SharedForces,
    friction_optimal_forces,
    jacobian_forces,
    limited_forces,
    weighted_forces,
)
from .friction_budget import FrictionBudget, plan_within_friction
from .friction_sharing import (
    FrictionOptimal,
    FrictionParameters,
    JacobianPseudoInverse,
    TractionLimitAvoidance,
    TractionLimitParameters,
    WeightedPseudoInverse,
)
from .motion_range import MotionRange
from .quintic_trajectory import MotionLimits, QuinticTrajectory, TrajectoryPoint, plan_point_to_point
from .reference_motion import (
    MotionParameters,
    ReferenceMotion,
)
from .resolved_motion_rate import (
    ResolvedMotionRate,
    ResolvedMotionRateParameters,
    SlidingModeRate,
    SlidingModeRateParameters,
)
from .safety import (
    HAZARDS,
    GatedTorque,
    Hazard,
    Reaction,
    SafetyGate,
)
from .steady_path import SteadyPath
from .torque_limits import LimitedTorque, TorqueLimits, limit_torque
from .wheel_loads import (
    WheelLoads,
)

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
    "CrossCoupling",
    "CrossCouplingParameters",
    "EXCITATIONS",
    "Excitation",
    "ForceReference",
    "FrictionBudget",
    "FrictionOptimal",
    "FrictionParameters",
    "GatedTorque",
    "HAZARDS",
    "Hazard",
    "JacobianPseudoInverse",
    "LimitedTorque",
    "MotionLimits",
    "MotionParameters",
    "MotionRange",
    "QuinticTrajectory",
    "Reaction",
    "ReferenceMotion",
    "ResolvedMotionRate",
    "ResolvedMotionRateParameters",
    "SafetyGate",
    "SharedForces",
    "SlidingModeRate",
    "SlidingModeRateParameters",
    "SteadyPath",
    "TorqueLimits",
    "TractionLimitAvoidance",
    "TractionLimitParameters",
    "TrajectoryPoint",
    "TwistReference",
    "WeightedPseudoInverse",
    "WheelLoads",
    "friction_optimal_forces",
    "internal_forces",
    "jacobian_forces",
    "limit_torque",
    "limited_forces",
    "make_controller",
    "make_excitation",
    "plan_point_to_point",
    "plan_within_friction",
    "read_excitation",
    "weighted_forces",
]
