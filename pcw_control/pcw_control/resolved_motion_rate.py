"""Resolved motion rate control of each wheel on its own, and enhanced by sliding mode: RMRC and SME-RMRC, table 5.1 [Li2009].

    e = A V_d - (B q_dot - kappa slip)                       (5.1)
    u_c = k_p e + k_i int e dt                               RMRC
    u = u_c + u_dis                                          SME-RMRC, see `sliding_mode`
    tau = B^T u

V_d is the reference twist, A V_d what it asks of the wheel centres. No dynamics is known to RMRC: it acts as a
disturbance, which the sliding mode finds and makes up for. The gains follow from the robot: with the effective mass m of
a wheel centre, along and across, and one bandwidth w,

    m_x = M / n + I_rho / r^2,   m_y = M / n + J_phi / b^2,   k_p = 2 w m,   k_i = w^2 m,   K = a m

and a the acceleration of a disturbance that the sliding mode can still make up for.

The slip of any estimator enters (5.1) with the share kappa: at 1 the wheel centre itself follows its path. That closes
the loop over the tyre, and past the limit of traction it spins a wheel up that slips; so kappa is 0 unless asked for, and
slip that the estimator does not vouch for is left out.
"""

from __future__ import annotations

import dataclasses
import math
from typing import ClassVar

import numpy as np

from pcw_description.compiled import compiled
from pcw_description.differential_kinematics import joint_matrix_blocks
from pcw_description.robot_description import FloatArray, RobotDescription

from . import sliding_mode
from .computed_torque import kinematics_kernel
from .controller_interface import (
    ControllerMeasurement,
    ControllerOutput,
    ForceReference,
    Reference,
    TwistReference,
    check_step,
    choice,
    output_kernel,
    parameter,
)
from .delay_margin import BANDWIDTH, derived_bandwidth, effective_mass, own_mass, tyre_resonance
from .errors import ControlError
from .reference_motion import MotionParameters, ReferenceMotion
from .slip_constraint_force import internal_part


@dataclasses.dataclass(frozen=True)
class ResolvedMotionRateParameters(MotionParameters):
    """Gains of RMRC, of a unit mass: the effective mass of each wheel centre scales them.

    Attributes:
        bandwidth: w, both poles of a wheel's velocity loop [rad/s]; 0 derives it: 10 rad/s, or what bears 1 ms of delay.
        pose_bandwidth: how fast a pose error of a trajectory is taken back [1/s].
        slip_share: kappa, how much of the estimated slip is fed back (5.1) [1].
    """

    uses: ClassVar[frozenset[str]] = frozenset({"slip"})

    bandwidth: float = parameter(
        0.0, "rad/s", "both poles of a wheel's velocity loop; 0 is 10 rad/s, or less where delay asks for it", maximum=200.0
    )
    pose_bandwidth: float = parameter(3.0, "1/s", "how fast a pose error of a trajectory is taken back", maximum=50.0)
    slip_share: float = parameter(0.0, "1", "how much of the estimated slip is fed back, (5.1)", maximum=1.0)


@dataclasses.dataclass(frozen=True)
class SlidingModeRateParameters(ResolvedMotionRateParameters):
    """Gains of SME-RMRC.

    Attributes:
        disturbance: a, acceleration of a disturbance that can be made up for; K = a m, at most half of the torque limit
            [m/s^2].
        filter_time: eps of the low-pass filter [s].
        boundary: phi, half the width of the boundary layer [m/s].
        law: one of `sliding_mode.SLIDING_LAWS`.
    """

    disturbance: float = parameter(3.0, "m/s^2", "acceleration of a disturbance that can be made up for", maximum=100.0)
    filter_time: float = parameter(0.05, "s", "of the low-pass filter", above=0.0, maximum=1.0)
    boundary: float = parameter(0.05, "m/s", "half the width of the boundary layer", above=0.0, maximum=1.0)
    law: str = choice("low_pass_integral", sliding_mode.SLIDING_LAWS, "the sliding law")


@dataclasses.dataclass(frozen=True)
class ResolvedMotionRateState:
    """What the controller remembers.

    Attributes:
        reference_twist: rate-limited twist followed now, in base_link (3,).
        error_integral: integral of e (n, 2) [m].
        sliding: of the sliding mode; at rest in RMRC.
    """

    reference_twist: FloatArray
    error_integral: FloatArray
    sliding: sliding_mode.SlidingModeState


def settling_time(robot: RobotDescription, bandwidth: float, filter_time: float) -> FloatArray:
    """Return T (n, 2) [s] of the sliding mode, at most eps; see `sliding_mode`."""
    own, w_t = own_mass(robot), tyre_resonance(robot)
    share = robot.total_mass / robot.n
    by_mass = 4.0 * share / own / (filter_time * w_t**2)
    by_gain = 2.0 / (bandwidth * filter_time * w_t)
    settling: FloatArray = np.minimum(np.maximum(by_mass, by_gain), filter_time)
    return settling


class ResolvedMotionRate:
    """RMRC of one robot.

    Raises:
        KinematicsError: a caster without offset, whose steering torque makes no side force.
    """

    parameters: ResolvedMotionRateParameters

    def __init__(self, robot: RobotDescription, parameters: ResolvedMotionRateParameters | None = None) -> None:
        robot.require_torque_control()
        self.parameters = parameters or ResolvedMotionRateParameters()
        self.robot = robot
        self._n = robot.n
        self._geometry = (robot.steer_axis, robot.caster_offset)
        self._radius = robot.wheel_radius
        self._B = joint_matrix_blocks(robot)
        # How much stronger the difference between wheels is controlled; see `cross_coupling`.
        self.coupling = 0.0
        self._unit = np.tile(np.eye(2), (robot.n, 1, 1))
        self._reference_motion = ReferenceMotion(robot, self.parameters)
        self._mass = effective_mass(robot)
        w = self.bandwidth = self.parameters.bandwidth or derived_bandwidth(robot, BANDWIDTH)
        self._k_p, self._k_i = 2.0 * w * self._mass, w * w * self._mass
        force_limit = robot.torque_limit / np.stack([robot.wheel_radius, np.abs(robot.caster_offset[:, 0])], axis=1)
        self._force_limit = force_limit
        self._largest_integral = force_limit / self._k_i

    def initial_state(self, twist: FloatArray | None = None) -> ResolvedMotionRateState:
        """Return the state of a controller that takes over at a twist (3,), or at rest."""
        V = np.zeros(3) if twist is None else np.array(twist, dtype=float)
        return ResolvedMotionRateState(V, np.zeros((self._n, 2)), sliding_mode.initial_state(self._n))

    def step(
        self, state: ResolvedMotionRateState, measurement: ControllerMeasurement, reference: Reference, dt: float
    ) -> tuple[ResolvedMotionRateState, ControllerOutput]:
        """Compute the torques of one cycle.

        Args:
            state: state after the cycle before.
            measurement: joints and pose now, and slip where there is an estimator.
            reference: a twist, or a point of a trajectory in odom.
            dt: measured time since the cycle before [s].

        Returns:
            New state and output; its `wrench` is what the forces at the wheels add up to.

        Raises:
            ControlError: dt is not positive, or a measurement or the reference is not finite; the state stays as it was.
        """
        check_step(measurement, reference, dt, self._n)
        joint_velocity = np.ascontiguousarray(measurement.joint_velocity, dtype=np.float64)
        steer_angle, A, V, _, _ = kinematics_kernel(
            *self._geometry, self._radius, np.ascontiguousarray(measurement.joint_position, dtype=np.float64), joint_velocity
        )
        V_d, wanted = self._wanted(state, measurement, reference, A, dt)
        share, slip = 0.0, joint_velocity
        if self.parameters.slip_share > 0.0 and measurement.slip is not None:
            share, slip = self.parameters.slip_share, measurement.slip
            slip = np.ascontiguousarray(slip if measurement.slip_valid is None else slip * measurement.slip_valid)
        e, integral, u_c = _continuous(
            A, wanted, self._B, joint_velocity, share, slip, state.error_integral, measurement.saturated,
            self._largest_integral, self._k_p, self._k_i, self.coupling, self._unit, dt,
        )  # fmt: skip
        sliding, u = self._discontinuous(state.sliding, e, u_c, measurement.saturated, dt)
        tau, internal, wrench = _forces(self._B, *self._geometry, steer_angle, A, u)
        state = ResolvedMotionRateState(V_d, integral, sliding)
        return state, ControllerOutput(tau, u, wrench, V, V_d, internal)

    def _wanted(
        self, state: ResolvedMotionRateState, measurement: ControllerMeasurement, reference: Reference, A: FloatArray,
        dt: float,
    ) -> tuple[FloatArray, FloatArray]:
        """Return the reference twist (3,), and the twist to drive at (3,), which takes back the error of pose as well."""
        if isinstance(reference, ForceReference):
            raise ControlError(
                f"a ForceReference is not allowed for {type(self).__name__}; allowed: TwistReference, TrajectoryPoint"
            )
        if isinstance(reference, TwistReference):
            V_d, _ = self._reference_motion.towards(state.reference_twist, reference.twist, A, dt)
            return V_d, V_d
        e = reference.pose - measurement.pose
        e[2] = math.remainder(e[2], math.tau)
        c, s = math.cos(measurement.pose[2]), math.sin(measurement.pose[2])
        R_T = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
        V_d = R_T @ reference.velocity
        return V_d, V_d + self.parameters.pose_bandwidth * (R_T @ e)

    def _discontinuous(
        self, state: sliding_mode.SlidingModeState, error: FloatArray, u_c: FloatArray, saturated: bool, dt: float
    ) -> tuple[sliding_mode.SlidingModeState, FloatArray]:
        """Return the state of the sliding mode and u; RMRC has none."""
        return state, u_c


@compiled
def _continuous(  # type: ignore[no-untyped-def]
    A, wanted, B, joint_velocity, slip_share, slip, integral, hold, largest, k_p, k_i, coupling, unit, dt
):
    """Return e (5.1), its integral and u_c, each (n, 2), with the coupling c of `cross_coupling`."""
    n = len(B)
    e, grown, u = np.empty((n, 2)), integral.copy(), np.empty((n, 2))
    for i in range(n):
        for j in range(2):
            k = 2 * i + j
            moved = B[i, j, 0] * joint_velocity[i, 0] + B[i, j, 1] * joint_velocity[i, 1] - slip_share * slip[i, j]
            e[i, j] = A[k, 0] * wanted[0] + A[k, 1] * wanted[1] + A[k, 2] * wanted[2] - moved
            if not hold:
                grown[i, j] = min(max(integral[i, j] + dt * e[i, j], -largest[i, j]), largest[i, j])
            u[i, j] = k_p[i, j] * e[i, j] + k_i[i, j] * grown[i, j]
    if coupling > 0.0:
        u += coupling * (k_p * internal_part(A, unit, e) + k_i * internal_part(A, unit, grown))
    return e, grown, u


@compiled
def _forces(B, steer_axis, caster_offset, steer_angle, A, u):  # type: ignore[no-untyped-def]
    """Return torques (n, 2), internal forces and the wrench A^T u (3,) of forces u (n, 2)."""
    torque, internal = output_kernel(B, steer_axis, caster_offset, steer_angle, u)
    wrench = np.zeros(3)
    for k in range(len(A)):
        for i in range(3):
            wrench[i] += A[k, i] * u[k // 2, k % 2]
    return torque, internal, wrench


class SlidingModeRate(ResolvedMotionRate):
    """SME-RMRC of one robot: RMRC and sliding mode on top."""

    parameters: SlidingModeRateParameters

    def __init__(self, robot: RobotDescription, parameters: SlidingModeRateParameters | None = None) -> None:
        super().__init__(robot, parameters or SlidingModeRateParameters())
        self._settling = settling_time(robot, self.bandwidth, self.parameters.filter_time)
        self._gain = np.minimum(self.parameters.disturbance * self._mass, 0.5 * self._force_limit)

    def _discontinuous(
        self, state: sliding_mode.SlidingModeState, error: FloatArray, u_c: FloatArray, saturated: bool, dt: float
    ) -> tuple[sliding_mode.SlidingModeState, FloatArray]:
        p = self.parameters
        return sliding_mode.step(
            p.law, state, error, u_c, self._mass, self._gain, p.filter_time, self._settling, p.boundary, saturated, dt
        )

    def sliding_bound(self, dt: float) -> FloatArray:
        """Return K T / m (n, 2) [m/s], within which s stays under the filtered law in steps of dt [s]."""
        bound: FloatArray = self._gain * np.maximum(self._settling, dt) / self._mass
        return bound
