"""Slip constraint force: internal forces that take slip away, table 5.4 [Li2009], with gains from the robot's inertia.

The thesis drives the slip eps = B q_dot - A V to zero by forces that leave the robot's motion alone, A^T f = 0:

    F_p = (A^T)^+ F + (I - A A^+) f_eps,      f_eps = -k_p eps - k_i int eps dt                                  (5.7)

One number k_p suits no robot: a wheel that has broken loose is held by its own inertia only, that of rotor, wheel and fork
seen at the contact, M = B^-T diag(...) B^-1, and steering has several times more of it than rolling. Here

    f = -K (e + w_i int e dt),      K = w_s M,      e = (I - Q) B q_dot,      Q = A (A^T K A)^-1 A^T K

so that e_dot = -w_s e of a wheel without grip, for every robot and in every direction of e; w_s follows from the delay of
the loop, w_s = PHASE / delay, and w_i is a part of it. With K = k_p I it is the thesis's law, as then Q = A A^+.

* (I - Q) A = 0, so e = (I - Q) eps whatever V is: encoders see e, and nothing else is needed. What they do not see is slip
  that all wheels have in common, as a rigid motion.
* A^T f = 0: the force is internal. Its power is (B q_dot) . f = -e . K e <= 0 without the integral: it only ever brakes.
* The integral leaks, and what it may ask for is limited: wrong wheel radii look like slip that never ends. While a motor is
  at its limit it only leaks.

What the wheels must hold then is no longer what a distribution asked for, so a distribution by friction and this force go
together well: the one knows before, the other finds out.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np

from pcw_description.compiled import compiled
from pcw_description.differential_kinematics import joint_matrix_blocks
from pcw_description.robot_description import DRIVE, STEER, FloatArray, RobotDescription

from .computed_torque import ComputedTorque, ComputedTorqueParameters, ComputedTorqueState, Demand
from .controller_interface import ControllerMeasurement, ControllerParameters, parameter, replaced
from .force_distribution import solve_kernel
from .friction_sharing import FrictionOptimal, FrictionParameters

# Phase that the delay may take from the loop of a wheel without grip [rad]; pi/2 is where it would swing on its own. With the
# 14 degrees of an integral a quarter as fast it leaves a margin of 50 degrees, and k_p = 400 N s/m along for the thesis's
# robot of 90 kg at 500 Hz.
PHASE = 0.45


@dataclasses.dataclass(frozen=True)
class SlipConstraintParameters(ControllerParameters):
    """How slip is held.

    Attributes:
        loop_delay: from a motion of the wheel to the torque that answers it, beyond the control period [s].
        proportional_gain: k_p, the same in all directions as the thesis has it [N s/m]; 0: from inertia and delay.
        integral_ratio: w_i / w_s, with w_i = k_i / k_p [1]; 0: proportional only.
        integral_memory: time constant after which the integral has forgotten [s].
        integral_share: what the integral may ask for, as part of the force that the motors' torque limits give [1].
    """

    loop_delay: float = parameter(0.002, "s", "delay of the loop beyond the control period", maximum=0.1)
    proportional_gain: float = parameter(0.0, "N s/m", "force per slip velocity; 0: derived from inertia and delay")
    integral_ratio: float = parameter(0.25, "1", "rate of the integral relative to that of the loop; 0: none", maximum=1.0)
    integral_memory: float = parameter(0.5, "s", "time constant after which the integral forgets", above=0.0)
    integral_share: float = parameter(0.5, "1", "largest integral force relative to the motors' limits", maximum=1.0)


def contact_inertia(robot: RobotDescription) -> FloatArray:
    """Return the inertia M of every wheel's own drives seen at its contact, chassis at rest, (n, 2, 2) [kg].

    M = B^-T M_q B^-1, with M_q of rotors and wheel about the axle and of rotors and fork about the steering axis.

    Raises:
        KinematicsError: a caster without offset, which cannot push sideways.
    """
    robot.require_torque_control()
    inertia = robot.armature.copy()
    for i, caster in enumerate(robot.casters):
        module = caster.module
        inertia[i, DRIVE, DRIVE] += caster.wheel.inertia_axle
        inertia[i, STEER, STEER] += module.inertia_zz + module.mass * (module.com[0] ** 2 + module.com[1] ** 2)
    B_inverse = np.linalg.inv(joint_matrix_blocks(robot))
    seen: FloatArray = np.einsum("nji,njk,nkl->nil", B_inverse, inertia, B_inverse)
    return seen


def loop_rate(robot: RobotDescription, parameters: SlipConstraintParameters) -> float:
    """Return w_s = PHASE / delay [1/s], the control period being a part of the delay."""
    return PHASE / (parameters.loop_delay + 1.0 / robot.sensors.encoders.rate)


def slip_gains(robot: RobotDescription, parameters: SlipConstraintParameters) -> FloatArray:
    """Return K, force per slip velocity of every wheel, (n, 2, 2) [N s/m].

    Raises:
        KinematicsError: see `contact_inertia`.
    """
    if parameters.proportional_gain > 0.0:
        robot.require_torque_control()
        return np.tile(parameters.proportional_gain * np.eye(2), (robot.n, 1, 1))
    return contact_inertia(robot) * loop_rate(robot, parameters)


@dataclasses.dataclass(frozen=True)
class InternalSlipForce:
    """What one step of the law gives.

    Attributes:
        force: internal contact forces f in the wheel frames (n, 2) [N].
        slip: slip e that contradicts a rigid motion (n, 2) [m/s].
    """

    force: FloatArray
    slip: FloatArray


class SlipConstraintLaw:
    """The law of one robot; see the module's docstring.

    Args:
        robot: the robot.
        parameters: how slip is held.

    Raises:
        KinematicsError: a caster without offset.
    """

    def __init__(self, robot: RobotDescription, parameters: SlipConstraintParameters | None = None) -> None:
        self.parameters = p = parameters or SlipConstraintParameters()
        self.gain = slip_gains(robot, p)
        self._n = robot.n
        self._B = joint_matrix_blocks(robot)
        strongest = np.einsum("nji,nj->ni", np.abs(np.linalg.inv(self._B)), robot.torque_limit)
        self._largest = p.integral_share * strongest
        self._numbers = np.array([p.integral_ratio * loop_rate(robot, p), p.integral_memory])

    def initial_state(self) -> FloatArray:
        """Return the state at the start: nothing has slipped."""
        return np.zeros((self._n, 2))

    def step(
        self, state: FloatArray, A: FloatArray, joint_velocity: FloatArray, saturated: bool, dt: float
    ) -> tuple[FloatArray, InternalSlipForce]:
        """Return the internal force of one cycle.

        Args:
            state: integral of the slip (n, 2) [m]; it is not changed.
            A: wheel Jacobian (2n, 3).
            joint_velocity: joint rates (n, 2) [rad/s].
            saturated: a motor was at its limit in the cycle before.
            dt: measured time since the cycle before, above 0 [s].
        """
        integral, force, slip = _slip_force(
            A, self._B, self.gain, self._largest, self._numbers, state, joint_velocity, saturated, dt
        )
        return integral, InternalSlipForce(force, slip)

    def added(
        self, state: FloatArray, A: FloatArray, joint_velocity: FloatArray, saturated: bool, dt: float, force: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """As `step`, of which it returns the state, and the internal force added to contact forces (n, 2) [N]."""
        integral, total = _added(
            A, self._B, self.gain, self._largest, self._numbers, state, joint_velocity, saturated, dt, force
        )
        return integral, total


@compiled
def internal_part(A, K, w):  # type: ignore[no-untyped-def]
    """Return (I - A (A^T K A)^-1 A^T K) w, shape (n, 2), for A (2n, 3) and blocks K (n, 2, 2)."""
    n = len(K)
    normal, moment = np.zeros((3, 3)), np.zeros(3)
    weighted = np.empty((2, 3))
    for i in range(n):
        for j in range(3):
            weighted[0, j] = K[i, 0, 0] * A[2 * i, j] + K[i, 0, 1] * A[2 * i + 1, j]
            weighted[1, j] = K[i, 1, 0] * A[2 * i, j] + K[i, 1, 1] * A[2 * i + 1, j]
        for j in range(3):
            moment[j] += weighted[0, j] * w[i, 0] + weighted[1, j] * w[i, 1]  # K is symmetric
            for k in range(3):
                normal[j, k] += A[2 * i, j] * weighted[0, k] + A[2 * i + 1, j] * weighted[1, k]
    V = solve_kernel(normal, moment)
    internal = np.empty((n, 2))
    for i in range(n):
        for j in range(2):
            row = 2 * i + j
            internal[i, j] = w[i, j] - (A[row, 0] * V[0] + A[row, 1] * V[1] + A[row, 2] * V[2])
    return internal


@compiled
def _slip_force(A, B, K, largest, numbers, integral, joint_velocity, saturated, dt):  # type: ignore[no-untyped-def]
    """Return the new integral, the force and the slip, each (n, 2)."""
    n = len(K)
    rate, memory = numbers[0], numbers[1]
    w = np.empty((n, 2))
    for i in range(n):
        for j in range(2):
            w[i, j] = B[i, j, 0] * joint_velocity[i, 0] + B[i, j, 1] * joint_velocity[i, 1]
    slip = internal_part(A, K, w)
    grown = integral * math.exp(-dt / memory)
    if not saturated:
        grown = grown + dt * slip
    # Wheels have turned since: what of the integral is a rigid motion by now is no slip.
    grown = internal_part(A, K, grown)
    ratio = 1.0
    for i in range(n):
        for j in range(2):
            wanted = rate * abs(K[i, j, 0] * grown[i, 0] + K[i, j, 1] * grown[i, 1])
            ratio = max(ratio, wanted / max(largest[i, j], 1e-12))
    # One factor for all wheels, so that the force stays internal.
    grown = grown / ratio
    force = np.empty((n, 2))
    for i in range(n):
        ex, ey = slip[i, 0] + rate * grown[i, 0], slip[i, 1] + rate * grown[i, 1]
        force[i, 0] = -(K[i, 0, 0] * ex + K[i, 0, 1] * ey)
        force[i, 1] = -(K[i, 1, 0] * ex + K[i, 1, 1] * ey)
    return grown, force, slip


@compiled
def _added(A, B, K, largest, numbers, integral, joint_velocity, saturated, dt, force):  # type: ignore[no-untyped-def]
    grown, internal, _ = _slip_force(A, B, K, largest, numbers, integral, joint_velocity, saturated, dt)
    return grown, force + internal


@dataclasses.dataclass(frozen=True)
class SlipConstraintForceParameters(ComputedTorqueParameters):
    """Those of computed torque, and how slip is held.

    Attributes:
        slip: how slip is held.
    """

    slip: SlipConstraintParameters = dataclasses.field(default_factory=SlipConstraintParameters)


@dataclasses.dataclass(frozen=True)
class SlipConstraintForceState(ComputedTorqueState):
    """What computed torque remembers, and the integral of the slip (n, 2) [m]."""

    slip_integral: FloatArray


class SlipConstraintForce(ComputedTorque):
    """SCFC, table 5.4: computed torque, its forces without internal ones, and the internal forces that hold slip.

    It needs encoders only; `slip` of the measurement is not looked at, because what it could add is taken away by I - Q.
    Mixed with another controller it adds these internal forces to that one's distribution; `parameters` then has a field
    `slip` and `_state_type` a field `slip_integral`.
    """

    _state_type: type[Any] = SlipConstraintForceState

    def __init__(self, robot: RobotDescription, parameters: SlipConstraintForceParameters | None = None) -> None:
        p = parameters or SlipConstraintForceParameters.of_robot(robot)
        super().__init__(robot, p)
        self.law = SlipConstraintLaw(robot, p.slip)

    def initial_state(self, twist: FloatArray | None = None) -> Any:
        """Return the state of a controller that takes over at a twist (3,), or at rest."""
        plain = super().initial_state(twist)
        return self._state_type(**vars(plain), slip_integral=self.law.initial_state())

    def _distribute(
        self, state: ComputedTorqueState, demand: Demand, measurement: ControllerMeasurement, dt: float
    ) -> tuple[ComputedTorqueState, FloatArray]:
        """Return the contact forces (n, 2) of the distribution below and the internal ones that hold slip."""
        state, F_con = super()._distribute(state, demand, measurement, dt)
        held: Any = state
        velocity = np.ascontiguousarray(measurement.joint_velocity, dtype=np.float64)
        integral, F_con = self.law.added(held.slip_integral, demand.A, velocity, measurement.saturated, dt, F_con)
        return replaced(held, slip_integral=integral), F_con


@dataclasses.dataclass(frozen=True)
class FrictionOptimalSlipConstraintParameters(FrictionParameters, SlipConstraintForceParameters):
    """Those of both: what is known of the ground, and how slip is held."""


class FrictionOptimalSlipConstraint(SlipConstraintForce, FrictionOptimal):
    """QP + SCFC: the distribution that uses friction least, and the internal forces that hold slip.

    The first needs the friction under each wheel (`friction`, of the nominal ground where it is not measured), the second
    finds out where that was wrong.
    """

    def __init__(
        self, robot: RobotDescription, parameters: FrictionOptimalSlipConstraintParameters | None = None
    ) -> None:
        super().__init__(robot, parameters or FrictionOptimalSlipConstraintParameters.of_robot(robot))
