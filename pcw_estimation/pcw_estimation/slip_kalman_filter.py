"""Extended Kalman filters of one wheel and of a whole robot: what the sliding-mode observers are compared with.

The same model as (4.13) [Li2009], with the friction curve in it:

    I_rho rho_ddot = tau_rho - r mu(lambda) F_z,      M v_x_dot = mu(lambda) F_z,      y = rho_dot + noise,

and for a robot (3.44) with the forces of all contacts. The curve makes the model stiff, so a step is linearly implicit,

    x+ = x + (1 - dt J)^-1 dt f(x),      Phi = (1 - dt J)^-1,      J = df/dx by differences,

and the covariance goes by Phi. Its linearisation has no knowledge of a second root: past the peak it believes what the slope
there says. Both filters measure joint speeds.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from pcw_description.augmented_object_model import dynamic_parameters
from pcw_description.compiled import compiled
from pcw_description.contact.contact_model import friction_coefficient
from pcw_description.differential_kinematics import forward_kinematics_kernel, wheel_jacobian_kernel
from pcw_description.robot_description import GRAVITY, FloatArray, RobotDescription

from .errors import require, require_dt
from .slip_estimate import (
    RATIO_SPEED,
    JointMeasurement,
    SlipEstimate,
    WheelEstimate,
    WheelMeasurement,
    WheelModel,
    ratio_of,
    ratios_and_angles,
)
from .slipping_robot_dynamics import (
    CX,
    CY,
    I_STEER,
    J_PP,
    J_RP,
    J_RR,
    RADIUS,
    TYRE,
    add_turning_module,
    body_dynamics,
    caster_numbers,
    composite_body,
    solve_symmetric,
    wheel_loads,
)

# A prediction goes in parts of at most this [s]: the friction curve bends within longer ones.
LONGEST_PART = 1e-3
# Differences for J [m/s or rad/s].
DIFFERENCE = 1e-4


@dataclasses.dataclass(frozen=True)
class SlipKalmanParameters:
    """Noise of the filters.

    Attributes:
        force_error: of all contacts together, per sqrt of time, as an acceleration [m/s^2 sqrt(s)].
        joint_error: likewise of a joint [rad/s^2 sqrt(s)].
        speed_noise: standard deviation of a measured joint speed [rad/s].
        initial_error: standard deviation of the velocity at the start [m/s].
        accuracy, accuracy_floor: a velocity is valid while two standard deviations are below accuracy times speed plus floor.
    """

    force_error: float = 0.05
    joint_error: float = 60.0
    speed_noise: float = 0.01
    initial_error: float = 1.0
    accuracy: float = 0.1
    accuracy_floor: float = 0.03

    def __post_init__(self) -> None:
        """Check the parameters.

        Raises:
            EstimationError: names the field, its value and what is allowed.
        """
        for field in dataclasses.fields(self):
            require(field.name, getattr(self, field.name), above=0.0)

    def numbers(self) -> FloatArray:
        """Return the parameters as the kernels take them."""
        return np.array([self.force_error, self.joint_error, self.speed_noise, self.initial_error])


@compiled
def _update(x, covariance, index, measured, variance):  # type: ignore[no-untyped-def]
    """Take one measured entry of the state into x and the covariance, in place."""
    innovation = measured - x[index]
    gain = covariance[:, index] / (covariance[index, index] + variance)
    row = covariance[index, :].copy()
    for i in range(len(x)):
        x[i] += gain[i] * innovation
        for j in range(len(x)):
            covariance[i, j] -= gain[i] * row[j]


@compiled
def _wheel_rates(wheel, tyre, x, torque):  # type: ignore[no-untyped-def]
    """Return f(x) (2,) of x = (rho_dot, v_x), and F_x [N]; wheel holds I, r, M, F_z."""
    rolling = wheel[1] * x[0]
    reference = max(abs(rolling), abs(x[1]), RATIO_SPEED)
    along, _ = friction_coefficient(tyre, (rolling - x[1]) / reference, 0.0)
    force = along * wheel[3]
    rates = np.empty(2)
    rates[0], rates[1] = (torque - wheel[1] * force) / wheel[0], force / wheel[2]
    return rates, force


@compiled
def _wheel_step(wheel, tyre, numbers, x, covariance, speed, torque, dt, first):  # type: ignore[no-untyped-def]
    """Advance x (2,) and its covariance (2, 2) in place; returns F_x [N]."""
    if first:
        x[0] = speed
        if math.isnan(x[1]):
            x[1] = wheel[1] * speed
        covariance[:, :] = 0.0
        covariance[0, 0], covariance[1, 1] = numbers[2] ** 2, numbers[3] ** 2
    else:
        parts = math.ceil(dt / LONGEST_PART - 1e-9)
        for _ in range(parts):
            rates, _ = _wheel_rates(wheel, tyre, x, torque)
            implicit = np.eye(2)
            for k in range(2):
                moved = x.copy()
                moved[k] += DIFFERENCE
                other, _ = _wheel_rates(wheel, tyre, moved, torque)
                implicit[:, k] -= dt / parts * (other - rates) / DIFFERENCE
            phi = np.linalg.inv(implicit)
            x += phi @ (dt / parts * rates)
            covariance[:, :] = phi @ covariance @ phi.T
            covariance[0, 0] += dt / parts * numbers[1] ** 2
            covariance[1, 1] += dt / parts * numbers[0] ** 2
        _update(x, covariance, 0, speed, numbers[2] ** 2)
    _, force = _wheel_rates(wheel, tyre, x, torque)
    return force


@compiled
def _run(wheel, tyre, numbers, x, covariance, speed, torque, dt, velocity, force, bound):  # type: ignore[no-untyped-def]
    for k in range(len(speed)):
        force[k] = _wheel_step(wheel, tyre, numbers, x, covariance, speed[k], torque[k], dt, k == 0)
        velocity[k], bound[k] = x[1], 2.0 * math.sqrt(max(covariance[1, 1], 0.0))


@dataclasses.dataclass(frozen=True)
class KalmanState:
    """Mean and covariance of a filter; `started` is false before the first reading."""

    mean: FloatArray
    covariance: FloatArray
    started: bool = False


class WheelKalmanFilter:
    """The filter of one wheel.

    Args:
        wheel: the wheel.
        parameters: its noise.
    """

    def __init__(self, wheel: WheelModel, parameters: SlipKalmanParameters | None = None) -> None:
        self.wheel, self.parameters = wheel, parameters or SlipKalmanParameters()
        self._wheel = np.array([wheel.inertia, wheel.radius, wheel.mass, wheel.normal_force])
        self._tyre, self._numbers = wheel.tyre(), self.parameters.numbers()

    def initial_state(self, velocity: float | None = None) -> KalmanState:
        """Return the state before the first reading, with a guess of the velocity [m/s]; None: as the wheel rolls then."""
        return KalmanState(np.array([0.0, math.nan if velocity is None else velocity]), np.zeros((2, 2)))

    def step(self, state: KalmanState, measurement: WheelMeasurement, dt: float) -> tuple[KalmanState, WheelEstimate]:
        """Take one reading; as `SlidingModeObserver.step`.

        Raises:
            EstimationError: speed or torque is not finite, or dt is not positive; the caller keeps its state.
        """
        require_dt(dt)
        require("roll_rate", measurement.roll_rate)
        require("drive_torque", measurement.drive_torque)
        mean, covariance = state.mean.copy(), state.covariance.copy()
        force = _wheel_step(
            self._wheel, self._tyre, self._numbers, mean, covariance, measurement.roll_rate, measurement.drive_torque, dt,
            not state.started,
        )  # fmt: skip
        rolling, velocity = self.wheel.radius * float(mean[0]), float(mean[1])
        bound = 2.0 * math.sqrt(max(float(covariance[1, 1]), 0.0))
        limit = self.parameters.accuracy * max(abs(rolling), abs(velocity)) + self.parameters.accuracy_floor
        valid = state.started and bound <= limit
        estimate = WheelEstimate(
            velocity, float(mean[0]), ratio_of(rolling, velocity), float(force), bound, valid, valid, valid
        )
        return KalmanState(mean, covariance, True), estimate

    def run(
        self, roll_angle: FloatArray, roll_rate: FloatArray, drive_torque: FloatArray, dt: float, velocity: float | None = None
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Take a whole record (T,) at a constant step; returns velocity, force and bound, as `SlidingModeObserver.run`."""
        require_dt(dt)
        results = np.empty((3, len(roll_rate)))
        start = self.initial_state(velocity)
        _run(
            self._wheel, self._tyre, self._numbers, start.mean, start.covariance, roll_rate, drive_torque, dt, results[0],
            results[1], results[2],
        )  # fmt: skip
        return results[0], results[1], results[2]


@compiled
def _robot_rates(  # type: ignore[no-untyped-def]
    casters, steer_axis, caster_offset, composite, normal, jacobian, steer_angle, x, effort
):
    """Return f(x) (3 + 2n,) of x = (V, rho_dot_1, phi_dot_1, ...), and the forces (n, 2) [N]."""
    n = len(casters)
    twist = x[:3].copy()
    rates, force = np.empty(3 + 2 * n), np.empty((n, 2))
    f, turning = np.zeros(3), np.zeros(3)
    for i in range(n):
        caster = casters[i]
        bx, by = caster_offset[i, 0], caster_offset[i, 1]
        rho_dot, phi_dot = x[3 + 2 * i], x[4 + 2 * i]
        along = jacobian[2 * i, 0] * twist[0] + jacobian[2 * i, 1] * twist[1] + jacobian[2 * i, 2] * twist[2]
        across = jacobian[2 * i + 1, 0] * twist[0] + jacobian[2 * i + 1, 1] * twist[1] + jacobian[2 * i + 1, 2] * twist[2]
        rolling, slip_y = caster[RADIUS] * rho_dot, -bx * phi_dot - across
        slip_x = rolling + by * phi_dot - along
        reference = max(abs(rolling), math.hypot(along - by * phi_dot, slip_y), RATIO_SPEED)
        mu_x, mu_y = friction_coefficient(caster[TYRE:], slip_x / reference, slip_y / reference)
        force[i, 0], force[i, 1] = mu_x * normal[i], mu_y * normal[i]
        on_r = effort[i, 0] - caster[RADIUS] * force[i, 0]
        on_p = effort[i, 1] + bx * force[i, 1] - by * force[i, 0]
        j_rr, j_rp, j_ss = caster[J_RR], caster[J_RP], caster[J_PP] + caster[I_STEER]
        determinant = j_rr * j_ss - j_rp * j_rp
        rates[3 + 2 * i] = (j_ss * on_r - j_rp * on_p) / determinant
        rates[4 + 2 * i] = (j_rr * on_p - j_rp * on_r) / determinant
        for k in range(3):
            f[k] += jacobian[2 * i, k] * force[i, 0] + jacobian[2 * i + 1, k] * force[i, 1]
        c, s = math.cos(steer_angle[i]), math.sin(steer_angle[i])
        lever_x, lever_y = caster[CX] * c - caster[CY] * s, caster[CX] * s + caster[CY] * c
        add_turning_module(turning, caster, steer_axis[i], lever_x, lever_y, phi_dot, rates[4 + 2 * i], twist[2])
    inertia, bias = body_dynamics(composite, casters, steer_axis, caster_offset, steer_angle, twist)
    rates[:3] = solve_symmetric(inertia, f - bias - turning)
    return rates, force


@compiled
def _robot_step(  # type: ignore[no-untyped-def]
    chassis, mass_height, casters, steer_axis, caster_offset, gravity, numbers, x, covariance, position, velocity, effort, dt,
    first,
):
    """Advance x (3 + 2n,) and its covariance in place; returns the forces (n, 2) [N] and A (2n, 3)."""
    n = len(casters)
    steer_angle = position[:, 1].copy()
    jacobian = wheel_jacobian_kernel(steer_axis, caster_offset, steer_angle)
    composite = composite_body(chassis, casters, steer_axis, steer_angle)
    # At rest: accelerations are no state of the filter.
    normal = wheel_loads(
        composite, mass_height, casters, steer_axis, caster_offset, steer_angle, np.zeros(3), np.zeros(3), gravity
    )
    size = 3 + 2 * n
    if first:
        if math.isnan(x[0]):
            radius = casters[:, RADIUS].copy()
            x[:3], _, _ = forward_kinematics_kernel(steer_axis, caster_offset, radius, steer_angle, velocity)
        covariance[:, :] = 0.0
        for k in range(3):
            covariance[k, k] = numbers[3] ** 2
        for i in range(n):
            for axis in range(2):
                x[3 + 2 * i + axis] = velocity[i, axis]
                covariance[3 + 2 * i + axis, 3 + 2 * i + axis] = numbers[2] ** 2
    else:
        parts = math.ceil(dt / LONGEST_PART - 1e-9)
        for _ in range(parts):
            rates, _ = _robot_rates(casters, steer_axis, caster_offset, composite, normal, jacobian, steer_angle, x, effort)
            implicit = np.eye(size)
            for k in range(size):
                moved = x.copy()
                moved[k] += DIFFERENCE
                other, _ = _robot_rates(
                    casters, steer_axis, caster_offset, composite, normal, jacobian, steer_angle, moved, effort
                )
                implicit[:, k] -= dt / parts * (other - rates) / DIFFERENCE
            phi = np.linalg.inv(implicit)
            x += phi @ (dt / parts * rates)
            covariance[:, :] = phi @ covariance @ phi.T
            for k in range(size):
                covariance[k, k] += dt / parts * numbers[0 if k < 3 else 1] ** 2
        for i in range(n):
            for axis in range(2):
                _update(x, covariance, 3 + 2 * i + axis, velocity[i, axis], numbers[2] ** 2)
    _, force = _robot_rates(casters, steer_axis, caster_offset, composite, normal, jacobian, steer_angle, x, effort)
    return force, jacobian


class RobotKalmanFilter:
    """The filter of a whole robot; its state is the twist and all joint speeds.

    Args:
        robot: the robot.
        parameters: its noise.
        gravity: [m/s^2].

    Raises:
        KinematicsError: a caster without offset.
    """

    def __init__(
        self, robot: RobotDescription, parameters: SlipKalmanParameters | None = None, gravity: float = GRAVITY
    ) -> None:
        robot.require_torque_control()
        self.robot, self.parameters = robot, parameters or SlipKalmanParameters()
        chassis, _ = dynamic_parameters(robot)
        mass_height = robot.chassis.mass * robot.chassis.com[2]
        self._constants = (
            chassis, mass_height, caster_numbers(robot), robot.steer_axis, robot.caster_offset, gravity,
            self.parameters.numbers(),
        )  # fmt: skip

    def initial_state(self, twist: FloatArray | None = None) -> KalmanState:
        """Return the state before the first reading, with a guess of the twist (3,); None: as the wheels roll then."""
        size = 3 + 2 * self.robot.n
        mean = np.full(size, math.nan)
        if twist is not None:
            mean[:3] = twist
        return KalmanState(mean, np.zeros((size, size)))

    def step(self, state: KalmanState, measurement: JointMeasurement, dt: float) -> tuple[KalmanState, SlipEstimate]:
        """Take one reading; as `RobotSlidingModeObserver.step`.

        Raises:
            EstimationError: a reading is not finite, or dt is not positive; the caller keeps its state.
        """
        require_dt(dt)
        n = self.robot.n
        measurement.check(n)
        mean, covariance = state.mean.copy(), state.covariance.copy()
        force, jacobian = _robot_step(
            *self._constants, mean, covariance, measurement.position, measurement.velocity, measurement.effort, dt,
            not state.started,
        )  # fmt: skip
        velocity = (jacobian @ mean[:3]).reshape(n, 2)
        rates, offset = mean[3:].reshape(n, 2), self.robot.caster_offset
        sensed = np.stack(
            [self.robot.wheel_radius * rates[:, 0] + offset[:, 1] * rates[:, 1], -offset[:, 0] * rates[:, 1]], axis=1
        )
        variance = np.einsum("ij,jk,ik->i", jacobian, covariance[:3, :3], jacobian)
        bound = 2.0 * math.sqrt(max(float(variance.max()), 0.0))
        speed = np.maximum(np.linalg.norm(velocity, axis=1), np.linalg.norm(sensed, axis=1))
        limit = self.parameters.accuracy * speed + self.parameters.accuracy_floor
        valid = np.repeat((state.started & (bound <= limit))[:, None], 2, axis=1)
        estimate = SlipEstimate(
            mean[:3].copy(), velocity, sensed - velocity, ratios_and_angles(sensed, velocity), force, bound, valid,
            valid.copy(), valid.copy(),
        )  # fmt: skip
        return KalmanState(mean, covariance, True), estimate
