"""Computed torque whose wheels share the wrench as the ground under each allows.

Three ways to do it, each a controller; the pseudo-inverse through A gives every wheel the same whatever it stands on.

* `FrictionOptimal`: the largest use of friction, |F_i| / (mu_i F_zi), is as small as it can be (a quadratic program).
* `WeightedPseudoInverse`: weights (mu_i F_zi)^2; nearly as good, in a tenth of the time.
* `TractionLimitAvoidance`: TLA, table 5.3 [Li2009]. The pseudo-inverse as long as no wheel passes `a` times its traction
  limit, along or across, or its torque limit; from there the internal forces shift the rest to other wheels:

      F_con = (A^T)^+ F + (I - (A^T)^+ A^T) f_o,    |F_con| <= a f_m

  The printed rule clips f_o component by component, which keeps neither the limit nor the wrench. Here f_o is the least one
  that keeps both. Where the wrench cannot be made within the limits, the limits hold and the wrench falls short.

* `JacobianPseudoInverse`: the least joint torques, through J = B^-1 A (fig. 5.7); it asks nothing of the ground, and is here
  to be compared with, as is `BasicSolution`: three forces carry everything.

When a twist is followed, the reference moves no faster than a part of the friction carries it (`ground_share`).

mu comes from the measurement (`friction`), or is that of the robot's ground; F_z is the robot's weight with the load that
its own acceleration shifts, unless it is measured.
"""

from __future__ import annotations

import dataclasses
import math
from typing import ClassVar

import numpy as np

from pcw_description.augmented_object_model import augmented_object_kernel
from pcw_description.compiled import compiled
from pcw_description.robot_description import DRIVE, STEER, FloatArray, RobotDescription

from .computed_torque import (
    ComputedTorque,
    ComputedTorqueParameters,
    ComputedTorqueState,
    Demand,
    approach_kernel,
    follow_twist_kernel,
)
from .controller_interface import ControllerMeasurement, parameter
from .force_distribution import (
    LEAST_LIMIT,
    basic_forces,
    forces_by_limit_kernel,
    friction_optimal_forces,
    jacobian_forces,
    limited_forces_kernel,
    solve_kernel,
    weighted_forces,
)
from .friction_budget import GROUND_SHARE
from .wheel_loads import WheelLoads, traction_limit_kernel


@dataclasses.dataclass(frozen=True)
class FrictionParameters(ComputedTorqueParameters):
    """Gains and limits of a controller that looks at the ground.

    Attributes:
        ground_share: part of the friction that the reference may need when a twist is followed, see `friction_budget` [1].
    """

    uses: ClassVar[frozenset[str]] = frozenset({"friction"})

    ground_share: float = parameter(
        GROUND_SHARE, "1", "part of the friction that a reference may need", above=0.0, maximum=1.0
    )


@dataclasses.dataclass(frozen=True)
class TractionLimitParameters(FrictionParameters):
    """Gains and limits of TLA.

    Attributes:
        traction_share: a, the part of traction and torque limits that may be used [1].
    """

    traction_share: float = parameter(
        0.8, "1", "part of traction and torque limits that may be used, a", above=0.0, maximum=1.0
    )


class JacobianPseudoInverse(ComputedTorque):
    """Computed torque through J: the least sum of squared joint torques (fig. 5.7)."""

    def _distribute(
        self, state: ComputedTorqueState, demand: Demand, measurement: ControllerMeasurement, dt: float
    ) -> tuple[ComputedTorqueState, FloatArray]:
        return state, jacobian_forces(demand.A, demand.wrench, self._B_inverse)


class BasicSolution(ComputedTorque):
    """Computed torque by three forces only; one of the solutions of (5.4) that has internal forces."""

    def _distribute(
        self, state: ComputedTorqueState, demand: Demand, measurement: ControllerMeasurement, dt: float
    ) -> tuple[ComputedTorqueState, FloatArray]:
        return state, basic_forces(demand.A, demand.wrench)


class _OnGround(ComputedTorque):
    """A controller that knows what its wheels hold, and whose reference waits where they do not hold enough."""

    parameters: FrictionParameters

    def __init__(self, robot: RobotDescription, parameters: ComputedTorqueParameters | None = None) -> None:
        super().__init__(robot, parameters or FrictionParameters.of_robot(robot))
        self._loads = WheelLoads(robot)

    def _twist_demand(
        self, state: ComputedTorqueState, measurement: ControllerMeasurement, position: FloatArray, velocity: FloatArray,
        target: FloatArray, dt: float,
    ) -> tuple[FloatArray, FloatArray, Demand]:
        """As that of computed torque, but of the change no more is asked than what the share of the friction carries."""
        V_d, e, *demand = _follow_twist_on_ground(
            self._approach_numbers, self._follow_numbers, self._loads.numbers, position, velocity, state.reference_twist,
            target, state.error_integral, measurement.saturated, dt, self.parameters.ground_share,
            *self._loads.known(measurement.friction, measurement.normal_force),
        )  # fmt: skip
        return V_d, e, Demand(*demand)

    def _traction_limit(self, demand: Demand, measurement: ControllerMeasurement) -> FloatArray:
        """Return mu F_z (n, 2) [N] at the acceleration that the demand asks for."""
        limit: FloatArray = _limit_of_demand(
            self._loads.numbers, demand.steer_angle, demand.inertia, demand.wrench,
            *self._loads.known(measurement.friction, measurement.normal_force),
        )  # fmt: skip
        return limit


@compiled
def _follow_twist_on_ground(  # type: ignore[no-untyped-def]
    approach, follow, loads, position, velocity, reference, target, integral, hold, dt, share, friction, normal_force
):
    """As `_follow_twist` of computed torque, with share / use of a change that needs more of the friction than the share."""
    V, steer_angle, A, normal_inverse, V_d, V_dot_d = approach_kernel(approach, position, velocity, reference, target, dt)
    use = _use_of_change(follow[0], follow[1], loads, A, steer_angle, V_d, V_dot_d, friction, normal_force)
    part = min(share / max(use, 1e-12), 1.0)
    V_d, e, F, inertia, bias = follow_twist_kernel(
        follow, steer_angle, V, reference, V_d, V_dot_d, part, integral, hold, dt
    )
    return V_d, e, F, V, steer_angle, A, normal_inverse, inertia, bias


@compiled
def _use_of_change(  # type: ignore[no-untyped-def]
    chassis, modules, loads, A, steer_angle, V, V_dot, friction, normal_force
):
    """Return how much of the friction Lambda V_dot needs, by the weighted forces [1]."""
    load_chassis, load_module, steer_axis, caster_offset, mu = loads
    inertia, _ = augmented_object_kernel(chassis, modules, steer_axis, caster_offset, steer_angle, V)
    wrench = np.zeros(3)
    for i in range(3):
        for j in range(3):
            wrench[i] += inertia[i, j] * V_dot[j]
    limit = traction_limit_kernel(
        load_chassis, load_module, steer_axis, caster_offset, mu, steer_angle, V_dot, friction, normal_force
    )
    return _use_by_weights(A, wrench, limit)


@compiled
def _limit_of_demand(  # type: ignore[no-untyped-def]
    loads, steer_angle, inertia, wrench, friction, normal_force
):
    """Return mu F_z (n, 2) at the acceleration Lambda^-1 F."""
    chassis, module, steer_axis, caster_offset, mu = loads
    acceleration = solve_kernel(inertia, wrench)
    return traction_limit_kernel(
        chassis, module, steer_axis, caster_offset, mu, steer_angle, acceleration, friction, normal_force
    )


@compiled
def _use_by_weights(A, wrench, limit):  # type: ignore[no-untyped-def]
    """Return the largest |F_i| / limit_i of the weighted forces, at most 11 % above the least there is; in every cycle."""
    force = forces_by_limit_kernel(A, wrench, limit)
    largest = 0.0
    for i in range(len(limit)):
        along, across = force[i, 0] / max(limit[i, 0], LEAST_LIMIT), force[i, 1] / max(limit[i, 1], LEAST_LIMIT)
        largest = max(largest, math.hypot(along, across))
    return largest


@compiled
def _least_of(limit, bound, share):  # type: ignore[no-untyped-def]
    least = np.empty(limit.shape)
    for i in range(len(limit)):
        for j in range(2):
            least[i, j] = share * min(limit[i, j], bound[i, j])
    return least


class WeightedPseudoInverse(_OnGround):
    """Computed torque with weights (mu F_z)^2."""

    def _distribute(
        self, state: ComputedTorqueState, demand: Demand, measurement: ControllerMeasurement, dt: float
    ) -> tuple[ComputedTorqueState, FloatArray]:
        return state, weighted_forces(demand.A, demand.wrench, self._traction_limit(demand, measurement))


class FrictionOptimal(_OnGround):
    """Computed torque with the least largest use of friction."""

    def _distribute(
        self, state: ComputedTorqueState, demand: Demand, measurement: ControllerMeasurement, dt: float
    ) -> tuple[ComputedTorqueState, FloatArray]:
        limit = self._traction_limit(demand, measurement)
        return state, friction_optimal_forces(demand.A, demand.wrench, limit).force


class TractionLimitAvoidance(_OnGround):
    """TLA, table 5.3: no wheel beyond `a` times its limits of traction and torque."""

    parameters: TractionLimitParameters

    def __init__(self, robot: RobotDescription, parameters: TractionLimitParameters | None = None) -> None:
        super().__init__(robot, parameters or TractionLimitParameters.of_robot(robot))
        # |r F_x| and |b_y F_x - b_x F_y| within the torque limits, as a box: across gets what the worst along leaves.
        along = robot.torque_limit[:, DRIVE] / robot.wheel_radius
        offset = np.abs(robot.caster_offset)
        along = np.where(
            offset[:, 1] > 0.0,
            np.minimum(along, 0.5 * robot.torque_limit[:, STEER] / np.maximum(offset[:, 1], 1e-12)), along,
        )
        across = (robot.torque_limit[:, STEER] - offset[:, 1] * along) / offset[:, 0]
        self._torque_bound = np.stack([along, across], axis=1)

    def _distribute(
        self, state: ComputedTorqueState, demand: Demand, measurement: ControllerMeasurement, dt: float
    ) -> tuple[ComputedTorqueState, FloatArray]:
        force: FloatArray = _forces_within_limits(
            self._loads.numbers, self._torque_bound, self.parameters.traction_share, demand.A, demand.steer_angle,
            demand.inertia, demand.wrench, *self._loads.known(measurement.friction, measurement.normal_force),
        )  # fmt: skip
        return state, force


@compiled
def _forces_within_limits(  # type: ignore[no-untyped-def]
    loads, bound, share, A, steer_angle, inertia, wrench, friction, normal_force
):
    """Return the least forces (n, 2) within a f_m, a box within both the friction ellipse's axes and the torque limits."""
    limit = _limit_of_demand(loads, steer_angle, inertia, wrench, friction, normal_force)
    force, _ = limited_forces_kernel(A, wrench, _least_of(limit, bound, share))
    return force
