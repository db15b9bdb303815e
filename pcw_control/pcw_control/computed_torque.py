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
from typing import NamedTuple, Self

import numpy as np

from pcw_description.augmented_object_model import AugmentedObjectModel, augmented_object_kernel
from pcw_description.compiled import compiled
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
    output_kernel,
    parameter,
    replaced,
)
from .delay_margin import BANDWIDTH, DELAY, derived_bandwidth
from .errors import ControlError
from .reference_motion import MotionParameters, ReferenceMotion, towards_kernel


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


class Demand(NamedTuple):
    """What the wheels shall do together in this cycle, and the geometry of it.

    A named tuple because one is made on every cycle, and a frozen dataclass of as many fields takes four times as long.

    Attributes:
        wrench: operational force F (3,) [N, N, N m] in base_link.
        twist: odometric twist V = A^+ B q_dot (3,).
        steer_angle: headings (n,) [rad].
        A: wheel Jacobian (2n, 3).
        normal_inverse: (A^T A)^-1 (3, 3).
        inertia, bias: Lambda (3, 3) and theta (3,).
    """

    wrench: FloatArray
    twist: FloatArray
    steer_angle: FloatArray
    A: FloatArray
    normal_inverse: FloatArray
    inertia: FloatArray
    bias: FloatArray


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
        largest = np.array(self.parameters.integral_limit) / gain if gain > 0.0 else np.zeros(3)
        # What `approach_kernel` and `follow_twist_kernel` take first.
        self._approach_numbers = (*self._geometry, self._radius, *self._reference_motion.numbers)
        self._follow_numbers = (*self._model.numbers, largest, gain, self.parameters.velocity_gain)

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
        """Return the state, and the operational force F that the reference asks for."""
        V_d, e, demand = self._motion_demand(state, measurement, reference, dt)
        return replaced(state, reference_twist=V_d, error_integral=e), demand

    def _motion_demand(
        self, state: ComputedTorqueState, measurement: ControllerMeasurement, reference: Reference, dt: float
    ) -> tuple[FloatArray, FloatArray, Demand]:
        """Return the twist that is followed (3,), the integral of its error (3,), and the operational force F."""
        if isinstance(reference, ForceReference):
            raise ControlError(
                f"a ForceReference is not allowed for {type(self).__name__}; allowed: TwistReference, TrajectoryPoint"
            )
        p = self.parameters
        position = np.ascontiguousarray(measurement.joint_position, dtype=np.float64)
        velocity = np.ascontiguousarray(measurement.joint_velocity, dtype=np.float64)
        if isinstance(reference, TwistReference):
            return self._twist_demand(state, measurement, position, velocity, reference.twist, dt)
        steer_angle, A, V, _, normal_inverse = kinematics_kernel(*self._geometry, self._radius, position, velocity)
        V_d, inertia, bias, F = _follow_point(
            *self._model.numbers, steer_angle, V, measurement.pose, reference.pose, reference.velocity,
            reference.acceleration, p.position_gain, p.velocity_gain,
        )  # fmt: skip
        # The integral belongs to the other kind of reference; the twist is handed over for a smooth change to it.
        return V_d, np.zeros(3), Demand(F, V, steer_angle, A, normal_inverse, inertia, bias)

    def _twist_demand(
        self, state: ComputedTorqueState, measurement: ControllerMeasurement, position: FloatArray, velocity: FloatArray,
        target: FloatArray, dt: float,
    ) -> tuple[FloatArray, FloatArray, Demand]:
        """As `_motion_demand`, on the way to a twist (3,); of the ground all of the wanted change is asked."""
        V_d, e, *demand = _follow_twist(
            self._approach_numbers, self._follow_numbers, position, velocity, state.reference_twist, target,
            state.error_integral, measurement.saturated, dt,
        )  # fmt: skip
        return V_d, e, Demand(*demand)

    def _distribute(
        self, state: ComputedTorqueState, demand: Demand, measurement: ControllerMeasurement, dt: float
    ) -> tuple[ComputedTorqueState, FloatArray]:
        """Return contact forces (n, 2) in the wheel frames that make the wrench: (5.6), without internal force."""
        return state, _least_forces(demand.A, demand.normal_inverse, demand.wrench)

    def _output(self, state: ComputedTorqueState, demand: Demand, F_con: FloatArray) -> ControllerOutput:
        tau, internal = output_kernel(self._B, *self._geometry, demand.steer_angle, F_con)
        return ControllerOutput(tau, F_con, demand.wrench, demand.twist, state.reference_twist, internal)


@compiled
def kinematics_kernel(steer_axis, caster_offset, radius, position, velocity):  # type: ignore[no-untyped-def]
    """Return headings (n,), A (2n, 3), V (3,), (I - A A^+) B q_dot (n, 2) and (A^T A)^-1 (3, 3)."""
    steer_angle = np.empty(len(position))
    for i in range(len(position)):
        steer_angle[i] = position[i, STEER]
    A = wheel_jacobian_kernel(steer_axis, caster_offset, steer_angle)
    V, incompatibility, normal_inverse = forward_kinematics_kernel(steer_axis, caster_offset, radius, steer_angle, velocity)
    return steer_angle, A, V, incompatibility, normal_inverse


@compiled
def approach_kernel(numbers, position, velocity, reference, target, dt):  # type: ignore[no-untyped-def]
    """Return V (3,), headings (n,), A (2n, 3), (A^T A)^-1 (3, 3), the next reference twist V_d (3,) and its derivative."""
    steer_axis, caster_offset, radius, B_inverse, speed_limit, offset, limits = numbers
    steer_angle, A, V, _, normal_inverse = kinematics_kernel(steer_axis, caster_offset, radius, position, velocity)
    V_d, V_dot_d = towards_kernel(reference, target, A, dt, B_inverse, speed_limit, offset, limits)
    return V, steer_angle, A, normal_inverse, V_d, V_dot_d


@compiled
def _follow_twist(  # type: ignore[no-untyped-def]
    approach, follow, position, velocity, reference, target, integral, hold, dt
):
    """Return V_d, e and the fields of a `Demand` on the way to a target (3,)."""
    V, steer_angle, A, normal_inverse, V_d, V_dot_d = approach_kernel(approach, position, velocity, reference, target, dt)
    V_d, e, F, inertia, bias = follow_twist_kernel(
        follow, steer_angle, V, reference, V_d, V_dot_d, 1.0, integral, hold, dt
    )
    return V_d, e, F, V, steer_angle, A, normal_inverse, inertia, bias


@compiled
def follow_twist_kernel(  # type: ignore[no-untyped-def]
    numbers, steer_angle, V, before, V_d, V_dot_d, part, integral, hold, dt
):
    """Return V_d, e (3,), F = Lambda (V_dot_d + k_p e + k_d e_dot) + theta for e_dot = V_d - V, Lambda and theta.

    The ground is asked for `part` of the change from the twist `before` to V_d.
    """
    chassis, modules, steer_axis, caster_offset, largest, integral_gain, velocity_gain = numbers
    wanted, e, V_dot = np.empty(3), integral.copy(), np.empty(3)
    for i in range(3):
        # Where the ground carries only a part of the change.
        wanted[i] = V_d[i] if part >= 1.0 else before[i] + part * (V_d[i] - before[i])
        e_dot = wanted[i] - V[i]
        if not hold and integral_gain > 0.0:
            e[i] = min(max(integral[i] + e_dot * dt, -largest[i]), largest[i])
        V_dot[i] = min(part, 1.0) * V_dot_d[i] + integral_gain * e[i] + velocity_gain * e_dot
    inertia, bias = augmented_object_kernel(chassis, modules, steer_axis, caster_offset, steer_angle, V)
    return wanted, e, _wrench(inertia, V_dot, bias), inertia, bias


@compiled
def _follow_point(  # type: ignore[no-untyped-def]
    chassis, modules, steer_axis, caster_offset, steer_angle, V, pose, pose_d, velocity_d, acceleration_d, position_gain,
    velocity_gain,
):
    """Return V_d (3,), Lambda, theta and F of a point of a trajectory in odom; see the module's docstring."""
    c, s = math.cos(pose[2]), math.sin(pose[2])
    e = pose_d - pose
    e[2] -= math.tau * math.floor(e[2] / math.tau + 0.5)
    V_d, V_dot = _turned(c, s, velocity_d), _turned(c, s, acceleration_d + position_gain * e)
    V_dot += velocity_gain * (V_d - V)
    V_dot[0] += V[2] * V[1]
    V_dot[1] -= V[2] * V[0]
    inertia, bias = augmented_object_kernel(chassis, modules, steer_axis, caster_offset, steer_angle, V)
    return V_d, inertia, bias, _wrench(inertia, V_dot, bias)


@compiled
def _turned(c, s, vector):  # type: ignore[no-untyped-def]
    """Return a vector (3,) of odom in base_link, whose heading has cosine c and sine s."""
    turned = vector.copy()
    turned[0], turned[1] = c * vector[0] + s * vector[1], c * vector[1] - s * vector[0]
    return turned


@compiled
def _wrench(inertia, V_dot, bias):  # type: ignore[no-untyped-def]
    F = bias.copy()
    for i in range(3):
        for j in range(3):
            F[i] += inertia[i, j] * V_dot[j]
    return F


@compiled
def _least_forces(A, normal_inverse, wrench):  # type: ignore[no-untyped-def]
    """Return A (A^T A)^-1 F (n, 2)."""
    force = np.empty((len(A) // 2, 2))
    x = np.zeros(3)
    for i in range(3):
        for j in range(3):
            x[i] += normal_inverse[i, j] * wrench[j]
    for k in range(len(A)):
        force[k // 2, k % 2] = A[k, 0] * x[0] + A[k, 1] * x[1] + A[k, 2] * x[2]
    return force
