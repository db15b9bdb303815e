"""Traction and brake control of a whole robot: no wheel beyond a slip ratio, whatever else is wanted; section 5.3.1 [Li2009].

SCFC holds the slip that wheels do not have in common. What they have in common, encoders do not see; an estimate of it
(`slip`, of an observer or from outside) does. With it, every drive torque is kept between those that
`slip_ratio_control` would give to reach the slip ratios -lambda_d and +lambda_d:

    (k (-lambda_d - lambda) - f) / g - w_av  <=  tau_rho  <=  (k (lambda_d - lambda) - f) / g - w_av

so that lambda is drawn into the band, and within it approaches its edges no faster than at the rate k. lambda_d is a
part of the critical slip ratio under the wheel (`critical_slip`, of the ground where nobody says). The force on the
wheel need not be known: the sliding mode finds it. Where the slip is not known, or the estimator does not vouch for it,
the torque stays as it was. While wheels are kept in their band the integral behind the wrench that they do not make holds.
"""

from __future__ import annotations

import dataclasses
from typing import Any, ClassVar

import numpy as np

from pcw_description.compiled import compiled
from pcw_description.robot_description import DRIVE, FloatArray, RobotDescription

from .computed_torque import ComputedTorqueState, Demand
from .controller_interface import (
    ControllerMeasurement,
    ControllerParameters,
    Reference,
    joint_torque_kernel,
    parameter,
    replaced,
)
from .slip_constraint_force import (
    SlipConstraintForce,
    SlipConstraintForceParameters,
    SlipConstraintForceState,
)
from .slip_ratio_control import SlidingWheel, SlipRatioParameters, slip_ratio_dynamics

# Part of a wrench that has to be made for the integral behind it to grow.
GIVEN = 0.9


@dataclasses.dataclass(frozen=True)
class SlipRatioBandParameters(ControllerParameters):
    """Which slip ratios are allowed.

    Attributes:
        share: lambda_d as part of the critical slip ratio [1].
        least: smallest lambda_d, whatever the ground [1].
        control: gains of the slip ratio's control.
    """

    share: float = parameter(0.8, "1", "largest slip ratio as part of the critical one", above=0.0, maximum=5.0)
    least: float = parameter(0.02, "1", "smallest slip ratio that is allowed on any ground", above=0.0, maximum=0.5)
    control: SlipRatioParameters = dataclasses.field(default_factory=lambda: SlipRatioParameters(least_speed=0.3))


@dataclasses.dataclass(frozen=True)
class SlipRatioLimitParameters(SlipConstraintForceParameters):
    """Those of SCFC, and the band of slip ratios.

    Attributes:
        ratio: the band.
    """

    uses: ClassVar[frozenset[str]] = frozenset({"slip", "friction"})

    ratio: SlipRatioBandParameters = dataclasses.field(default_factory=SlipRatioBandParameters)


@dataclasses.dataclass(frozen=True)
class SlipRatioLimitState(SlipConstraintForceState):
    """What SCFC remembers, the sliding mode of every wheel (n, 4), and the error's integral before this cycle (3,)."""

    ratio: FloatArray
    integral_before: FloatArray


class SlipRatioLimit(SlipConstraintForce):
    """SCFC with every wheel's slip ratio kept in its band."""

    parameters: SlipRatioLimitParameters

    def __init__(self, robot: RobotDescription, parameters: SlipRatioLimitParameters | None = None) -> None:
        p = parameters or SlipRatioLimitParameters.of_robot(robot)
        super().__init__(robot, p)
        self._wheels = np.array([SlidingWheel.of_robot(robot, i).numbers() for i in range(robot.n)])
        control = p.ratio.control
        self._ratio_numbers = np.array(
            [control.gain, control.sliding_gain, control.layer, control.filter_time, control.least_speed]
        )
        self._critical = np.array([tyre.lambda_p for tyre in robot.tyres])
        self._vouched = np.ones((robot.n, 2), dtype=bool)

    def initial_state(self, twist: FloatArray | None = None) -> Any:
        """Return the state of a controller that takes over at a twist (3,), or at rest."""
        return SlipRatioLimitState(
            **vars(super().initial_state(twist)), ratio=np.zeros((self._n, 4)), integral_before=np.zeros(3)
        )

    def _demand(
        self, state: ComputedTorqueState, measurement: ControllerMeasurement, reference: Reference, dt: float
    ) -> tuple[ComputedTorqueState, Demand]:
        """As of SCFC; what the integral was is kept until it is known how much of its wrench is made."""
        after, demand = super()._demand(state, measurement, reference, dt)
        known: Any = after
        return replaced(known, integral_before=state.error_integral), demand

    def _distribute(
        self, state: ComputedTorqueState, demand: Demand, measurement: ControllerMeasurement, dt: float
    ) -> tuple[ComputedTorqueState, FloatArray]:
        """Return the contact forces (n, 2) of SCFC, or those of the drive torques that keep the slip ratios in their band."""
        state, F_con = super()._distribute(state, demand, measurement, dt)
        before: Any = state
        if measurement.slip is None:
            return replaced(before, ratio=np.zeros((self._n, 4))), F_con
        p = self.parameters.ratio
        ratio, F_con = _kept_in_band(
            self._wheels, self._ratio_numbers, before.ratio, self._B,
            np.ascontiguousarray(measurement.joint_velocity, dtype=np.float64),
            np.ascontiguousarray(measurement.slip, dtype=np.float64),
            self._vouched if measurement.slip_valid is None else np.ascontiguousarray(measurement.slip_valid, dtype=bool),
            self._critical if measurement.critical_slip is None else measurement.critical_slip, p.share, p.least, F_con, dt,
        )  # fmt: skip
        integral = _held_where_less_is_given(before.integral_before, before.error_integral, demand.A, demand.wrench, F_con)
        return replaced(before, ratio=ratio, error_integral=integral), F_con


@compiled
def _held_where_less_is_given(before, integral, A, wrench, force):  # type: ignore[no-untyped-def]
    """Return an integral (3,) as it was before where it grows and forces (n, 2) make too little of the wrench (3,).

    Else what the ground did not give is asked for afterwards: a robot that stands at last drives on backwards.
    """
    held = integral.copy()
    for i in range(3):
        made = 0.0
        for k in range(len(force)):
            made += A[2 * k, i] * force[k, 0] + A[2 * k + 1, i] * force[k, 1]
        grows = abs(integral[i]) > abs(before[i]) and integral[i] * wrench[i] > 0.0
        if grows and made / wrench[i] < GIVEN:
            held[i] = before[i]
    return held


@compiled
def _kept_in_band(  # type: ignore[no-untyped-def]
    wheels, numbers, before, B, joint_velocity, slip, vouched, critical, share, least, force, dt
):
    """Return the sliding modes (n, 4), and the forces (n, 2) that make the drive torques which lie within their bounds."""
    gain, sliding, layer, filter_time, least_speed = numbers[0], numbers[1], numbers[2], numbers[3], numbers[4]
    n = len(wheels)
    torque, kept, after = joint_torque_kernel(B, force), force.copy(), np.zeros((n, 4))
    for i in range(n):
        if not vouched[i, 0]:
            continue  # and what the sliding mode had found is forgotten
        band, drive = max(share * critical[i], least), torque[i, DRIVE]
        inertia, radius, mass, limit = wheels[i, 0], wheels[i, 1], wheels[i, 2], wheels[i, 3]
        # With a lateral offset the turning fork rolls the wheel centre along as well.
        sensed = B[i, 0, 0] * joint_velocity[i, 0] + B[i, 0, 1] * joint_velocity[i, 1]
        ratio, f, g = slip_ratio_dynamics(
            inertia, radius, mass, sensed / radius, sensed - slip[i, 0], 0.0, least_speed
        )
        g = max(g, 0.05 * radius / (inertia * max(abs(sensed), least_speed)))
        predicted = before[i, 1] + dt * before[i, 3] if before[i, 0] > 0.0 else ratio
        K = sliding * limit
        w = K * min(max((ratio - predicted) / (layer * K * g * dt), -1.0), 1.0)
        average = before[i, 2] + (w - before[i, 2]) * dt / (filter_time + dt)
        if before[i, 0] > 0.0:
            high = max((gain * (band - ratio) - f) / g - average, -limit)
            low = min((gain * (-band - ratio) - f) / g - average, limit)
            change = min(max(drive, low), high) - drive
            drive += change
            # The force along the wheel alone, and with it what the steering needs to hold it where it acts beside its axis.
            kept[i, 0] += change / B[i, 0, 0]
        held = min(max(drive, -limit), limit)
        after[i, 0], after[i, 1], after[i, 2], after[i, 3] = 1.0, predicted, average, f + g * (held + w)
    return after, kept
