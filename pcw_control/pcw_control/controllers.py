"""All controllers by name, so that a node, a command or a study can choose one."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

from pcw_description.errors import nearest_name
from pcw_description.robot_description import RobotDescription

from .computed_torque import ComputedTorque, ComputedTorqueParameters
from .controller_interface import Controller, ControllerParameters
from .cross_coupling import CrossCoupling, CrossCouplingParameters
from .errors import ControlError
from .force_guided import ForceGuided, ForceGuidedParameters, UnifiedForceMotion
from .friction_sharing import (
    FrictionOptimal,
    FrictionParameters,
    JacobianPseudoInverse,
    TractionLimitAvoidance,
    TractionLimitParameters,
    WeightedPseudoInverse,
)
from .resolved_motion_rate import (
    ResolvedMotionRate,
    ResolvedMotionRateParameters,
    SlidingModeRate,
    SlidingModeRateParameters,
)
from .slip_constraint_force import (
    FrictionOptimalSlipConstraint,
    FrictionOptimalSlipConstraintParameters,
    SlipConstraintForce,
    SlipConstraintForceParameters,
)
from .slip_ratio_limit import SlipRatioLimit, SlipRatioLimitParameters


@dataclasses.dataclass(frozen=True)
class ControllerEntry:
    """One controller to choose.

    Attributes:
        controller: its class, made from a robot and parameters.
        parameters: the class of its parameters.
        summary: one line on what it does.
    """

    controller: Callable[..., Controller]
    parameters: type[ControllerParameters]
    summary: str


CONTROLLERS: dict[str, ControllerEntry] = {
    "computed_torque": ControllerEntry(
        ComputedTorque, ComputedTorqueParameters, "computed torque with the least internal force, through A (table 5.2)"
    ),
    "cross_coupling": ControllerEntry(
        CrossCoupling, CrossCouplingParameters, "RMRC whose wheels also agree with each other (Feng, Koren, Borenstein)"
    ),
    "friction_optimal": ControllerEntry(
        FrictionOptimal, FrictionParameters, "the largest use of friction is as small as can be (a quadratic program)"
    ),
    "jacobian_pseudo_inverse": ControllerEntry(
        JacobianPseudoInverse, ComputedTorqueParameters, "computed torque with the least joint torques, through J (fig. 5.7)"
    ),
    "resolved_motion_rate": ControllerEntry(
        ResolvedMotionRate, ResolvedMotionRateParameters, "RMRC: PI control of each wheel on its own (table 5.1)"
    ),
    "sliding_mode_rate": ControllerEntry(
        SlidingModeRate, SlidingModeRateParameters, "SME-RMRC: RMRC enhanced by sliding mode (table 5.1)"
    ),
    "traction_limit_avoidance": ControllerEntry(
        TractionLimitAvoidance, TractionLimitParameters, "TLA: no wheel beyond a part of its limits (table 5.3)"
    ),
    "weighted_pseudo_inverse": ControllerEntry(
        WeightedPseudoInverse, FrictionParameters, "wheels share the force as friction and load allow, (mu F_z)^2"
    ),
    "slip_constraint_force": ControllerEntry(
        SlipConstraintForce, SlipConstraintForceParameters, "computed torque with internal forces that hold slip (table 5.4)"
    ),
    "friction_optimal_slip_constraint": ControllerEntry(
        FrictionOptimalSlipConstraint, FrictionOptimalSlipConstraintParameters,
        "shares the force as friction allows, with internal forces that hold slip",
    ),
    "slip_ratio_limit": ControllerEntry(
        SlipRatioLimit, SlipRatioLimitParameters, "as slip_constraint_force, with every wheel's slip ratio kept in a band"
    ),
    "force_guided": ControllerEntry(
        ForceGuided, ForceGuidedParameters, "gives way to a measured push, with internal forces that hold slip (table 5.5)"
    ),
    "force_guided_plain": ControllerEntry(
        UnifiedForceMotion, ForceGuidedParameters, "gives way to a measured push; slip is not held"
    ),
}


def make_controller(name: str, robot: RobotDescription, parameters: ControllerParameters | None = None) -> Controller:
    """Make the controller of a name.

    Raises:
        ControlError: the name is unknown, or the parameters are another controller's.
        KinematicsError: a caster without offset.
    """
    if name not in CONTROLLERS:
        raise ControlError(f"controller {name!r} is not known; {nearest_name(name, CONTROLLERS)}")
    entry = CONTROLLERS[name]
    if parameters is not None and not isinstance(parameters, entry.parameters):
        raise ControlError(
            f"parameters of {name} = {type(parameters).__name__} are not allowed; allowed: {entry.parameters.__name__}"
        )
    return entry.controller(robot, parameters)
