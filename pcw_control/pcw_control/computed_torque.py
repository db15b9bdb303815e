"""Computed torque with the least internal force: the IFM scheme of table 5.2 [Li2009].

    F = Lambda (V_dot_d + k_p e + k_d e_dot) + theta          table 5.2
    F_con = (A^T)^+ F = A (A^T A)^-1 F                        (5.6), the solution of F = A^T F_con (5.2)
    tau = B^T F_con                                           joint side

in base_link. The pseudo-inverse leaves no internal force (5.3): E F_con = 0. With a lateral offset b_y, B^T is not B: the
steering feels the driving force through that lever arm, and B^T is what conserves power, tau . q_dot = F_con . B q_dot.

The velocity fed back is the odometric one, V = A^+ B q_dot. The true velocity of the body would close the loop through the
tyre compliance between motor and body, which makes the steering oscillate at some 10 Hz.

Two kinds of reference:

* a twist to follow. The reference twist moves towards it within limits of acceleration; e_dot is the velocity error in
  base_link and e its integral, which takes up friction and slope. Where the robot is plays no part.
* a point of a trajectory in odom. e and e_dot are errors of pose and velocity in odom, turned into base_link. V_dot is the
  derivative of components in a turning frame, hence the - omega x V; the error then obeys e_ddot + k_d e_dot + k_p e = 0.

Every other way to share F among the wheels is a subclass with another `_distribute`.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Self

import numpy as np

from pcw_description.augmented_object_model import AugmentedObjectModel
from pcw_description.differential_kinematics import (
    forward_kinematics_kernel,
    joint_matrix_blocks,
    wheel_jacobian_kernel,
)
from pcw_description.robot_description import STEER, FloatArray, RobotDescription

from .controller_interface import (
    ControllerMeasurement,
    ControllerOutput,
    ForceReference,
    Reference,
    TwistReference,
    check_step,
    internal_force_kernel,
    joint_torque_kernel,
    parameter,
)
from .delay_margin import BANDWIDTH, DELAY, derived_bandwidth
from .errors import ControlError
from .quintic_trajectory import TrajectoryPoint
from .reference_motion import MotionParameters, ReferenceMotion


@dataclasses.dataclass(frozen=True)
class ComputedTorqueParameters(MotionParameters):
    """Gains, besides the limits of the reference.

    The gains are those of a unit mass: Lambda scales them to the robot. `of_robot` places both poles of the pose error at the
    bandwidth that the robot's tyres and delay allow, `delay_margin.derived_bandwidth`; the defaults are those at 10 rad/s.

    Attributes:
        velocity_gain: k_d [1/s].
        position_gain: k_p on the pose error [1/s^2].
        integral_gain: k_p on the integral of the velocity error, when a twist is followed [1/s^2].
        integral_limit: largest acceleration that this integral may ask for (x, y [m/s^2], yaw [rad/s^2]).
    """

    velocity_gain: float = parameter(20.0, "1/s", "gain on the velocity error, k_d", maximum=200.0)
    position_gain: float = parameter(100.0, "1/s^2", "gain on the pose error, k_p", maximum=1e4)
    integral_gain: float = parameter(50.0, "1/s^2", "gain on the integral of the velocity error", maximum=1e4)
    integral_limit: tuple[float, float, float] = parameter(
        (1.0, 1.0, 3.0), "m/s^2, m/s^2, rad/s^2", "largest acceleration along x, y, yaw that the integral may ask for",
        maximum=100.0,
    )

    @classmethod
    def of_robot(cls, robot: RobotDescription, delay: float = DELAY) -> Self:
        """Return the gains of a robot: both poles at w, so that its loops bear a delay [s].

        Raises:
            KinematicsError: a caster without offset, whose steering torque makes no side force.
        """
        robot.require_torque_control()
        w = derived_bandwidth(robot, BANDWIDTH, delay)
        return cls(velocity_gain=2.0 * w, position_gain=w * w, integral_gain=0.5 * w * w)


@dataclasses.dataclass(frozen=True)
class ComputedTorqueState:
    """What the controller remembers.

    Attributes:
        reference_twist: rate-limited twist followed now, in base_link (3,).
        error_integral: integral of the velocity error in base_link (3,) [m, m, rad].
    """

    reference_twist: FloatArray
    error_integral: FloatArray


@dataclasses.dataclass(frozen=True)
class Demand:
    """What the wheels shall do together in this cycle, and the geometry of it.

    Attributes:
        wrench: operational force F (3,) [N, N, N m] in base_link.
        twist: odometric twist V = A^+ B q_dot (3,).
        steer_angle: headings (n,) [rad].
        A: wheel Jacobian (2n, 3).
        normal_inverse: (A^T A)^-1 (3, 3).
        inertia, bias: Lambda (3, 3) and theta (3,).
        incompatibility: (I - A A^+) B q_dot (n, 2) [m/s], the part of the slip that encoders see.
    """

    wrench: FloatArray
    twist: FloatArray
    steer_angle: FloatArray
    A: FloatArray
    normal_inverse: FloatArray
    inertia: FloatArray
    bias: FloatArray
    incompatibility: FloatArray


class ComputedTorque:
    """The controller of one robot: numbers gathered once, and a pure step.

    Args:
        robot: the robot; its `physics` are not known to a controller and are left out.
        parameters: gains and limits; None is `ComputedTorqueParameters.of_robot`.

    Raises:
        KinematicsError: a caster without offset, whose steering torque makes no side force.
    """

    def __init__(self, robot: RobotDescription, parameters: ComputedTorqueParameters | None = None) -> None:
        self.parameters = parameters or ComputedTorqueParameters.of_robot(robot)
        self.robot = robot
        self._n = robot.n
        self._model = AugmentedObjectModel(robot)
        self._geometry = (robot.steer_axis, robot.caster_offset)
        self._radius = robot.wheel_radius
        self._B = joint_matrix_blocks(robot)
        self._B_inverse: FloatArray = np.linalg.inv(self._B).astype(np.float64)
        self._reference_motion = ReferenceMotion(robot, self.parameters)
        gain = self.parameters.integral_gain
        self._largest_integral = np.array(self.parameters.integral_limit) / gain if gain > 0.0 else np.zeros(3)

    def initial_state(self, twist: FloatArray | None = None) -> ComputedTorqueState:
        """Return the state of a controller that takes over at a twist (3,), or at rest."""
        return ComputedTorqueState(np.zeros(3) if twist is None else np.array(twist, dtype=float), np.zeros(3))

    def step(
        self, state: ComputedTorqueState, measurement: ControllerMeasurement, reference: Reference, dt: float
    ) -> tuple[ComputedTorqueState, ControllerOutput]:
        """Compute the torques of one cycle.

        Args:
            state: state after the cycle before.
            measurement: joints and pose now.
            reference: a twist, or a point of a trajectory in odom.
            dt: measured time since the cycle before [s].

        Returns:
            New state and output.

        Raises:
            ControlError: dt is not positive, or a measurement or the reference is not finite; the state stays as it was.
        """
        check_step(measurement, reference, dt, self._n)
        state, demand = self._demand(state, measurement, reference, dt)
        state, F_con = self._distribute(state, demand, measurement, dt)
        return state, self._output(state, demand, F_con)

    def _demand(
        self, state: ComputedTorqueState, measurement: ControllerMeasurement, reference: Reference, dt: float
    ) -> tuple[ComputedTorqueState, Demand]:
        """Return the operational force F that the reference asks for."""
        steer_angle = np.ascontiguousarray(measurement.joint_position[:, STEER])
        A = wheel_jacobian_kernel(*self._geometry, steer_angle)
        V, incompatibility, normal_inverse = forward_kinematics_kernel(
            *self._geometry, self._radius, steer_angle, np.ascontiguousarray(measurement.joint_velocity)
        )
        if isinstance(reference, ForceReference):
            raise ControlError(
                f"a ForceReference is not allowed for {type(self).__name__}; allowed: TwistReference, TrajectoryPoint"
            )
        if isinstance(reference, TwistReference):
            state, V_dot = self._towards_twist(state, reference.twist, V, A, steer_angle, measurement, dt)
        else:
            state, V_dot = self._towards_point(state, reference, measurement.pose, V)
        inertia, bias = self._model.evaluate(steer_angle, V)
        return state, Demand(inertia @ V_dot + bias, V, steer_angle, A, normal_inverse, inertia, bias, incompatibility)

    def _distribute(
        self, state: ComputedTorqueState, demand: Demand, measurement: ControllerMeasurement, dt: float
    ) -> tuple[ComputedTorqueState, FloatArray]:
        """Return contact forces (n, 2) in the wheel frames that make the wrench: (5.6), without internal force."""
        return state, (demand.A @ (demand.normal_inverse @ demand.wrench)).reshape(self._n, 2)

    def _output(self, state: ComputedTorqueState, demand: Demand, F_con: FloatArray) -> ControllerOutput:
        tau = joint_torque_kernel(self._B, F_con)
        internal = internal_force_kernel(*self._geometry, demand.steer_angle, F_con)
        return ControllerOutput(tau, F_con, demand.wrench, demand.twist, state.reference_twist, internal)

    def _towards_twist(
        self, state: ComputedTorqueState, target: FloatArray, V: FloatArray, A: FloatArray, steer_angle: FloatArray,
        measurement: ControllerMeasurement, dt: float,
    ) -> tuple[ComputedTorqueState, FloatArray]:
        p = self.parameters
        V_d, V_dot_d = self._reference_motion.towards(state.reference_twist, target, A, dt)
        part = self._carried(V_d, V_dot_d, A, steer_angle, measurement)
        if part < 1.0:
            V_d, V_dot_d = state.reference_twist + part * (V_d - state.reference_twist), part * V_dot_d
        e_dot = V_d - V
        e = state.error_integral
        if not measurement.saturated and p.integral_gain > 0.0:
            e = np.minimum(np.maximum(e + e_dot * dt, -self._largest_integral), self._largest_integral)
        state = dataclasses.replace(state, reference_twist=V_d, error_integral=e)
        return state, V_dot_d + p.integral_gain * e + p.velocity_gain * e_dot

    def _carried(
        self, V_d: FloatArray, V_dot_d: FloatArray, A: FloatArray, steer_angle: FloatArray, measurement: ControllerMeasurement
    ) -> float:
        """Return the part of the wanted change of the twist that the ground is asked for; here all of it."""
        return 1.0

    def _towards_point(
        self, state: ComputedTorqueState, point: TrajectoryPoint, pose: FloatArray, V: FloatArray
    ) -> tuple[ComputedTorqueState, FloatArray]:
        p = self.parameters
        R_T = _rotation(-pose[2])
        e = point.pose - pose
        e[2] = math.remainder(e[2], math.tau)
        V_d = R_T @ point.velocity
        omega_cross_V = np.array([-V[2] * V[1], V[2] * V[0], 0.0])
        V_dot = R_T @ (point.acceleration + p.position_gain * e) + p.velocity_gain * (V_d - V) - omega_cross_V
        # The integral belongs to the other kind of reference; the twist is handed over for a smooth change to it.
        return dataclasses.replace(state, reference_twist=V_d, error_integral=np.zeros(3)), V_dot


def _rotation(angle: float) -> FloatArray:
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
