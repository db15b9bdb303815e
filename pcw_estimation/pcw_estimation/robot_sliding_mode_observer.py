"""Sliding-mode observer of a whole robot: n casters that share one chassis, (4.13)-(4.15) with (3.44) [Li2009].

Every joint has its sliding mode (`joint_sliding_mode`), whose equivalent injection gives the load d = tau - J q_ddot and with it
the force of the ground in the wheel frame, B^T F = d. The chassis follows from all forces together,

    Lambda V_dot + theta = A^T F                                                                          (3.44)

with the modules moving as masses in Lambda and the spinning parts (wheels, rotors) already taken off in d, and it is drawn to
what the lower roots of the friction curves say of the wheel-centre velocities,

    y_i = (B q_dot)_i - |v_i| (lambda_x, lambda_y)_i (F_i / F_zi),      V_hat += share (A^T W A)^-1 A^T W (y - A V_hat),

with a weight in W for every wheel by `low_root_trust`: a wheel that spins, or is near its peak, is left out, and those that grip
carry the chassis. While all spin the forces alone do. Loads F_z follow from the accelerations (`support_forces`). The force
across includes what the module's own mass takes of the steering torque.

Both versions are here: with joint speeds measured, and from joint angles alone.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from pcw_description.augmented_object_model import augmented_object_kernel, dynamic_parameters
from pcw_description.compiled import compiled
from pcw_description.contact.contact_model import (
    LAMBDA,
    LATERAL_MU,
    MU,
    TYRE_SIZE,
    friction_coefficient,
    scrub_torque,
    slip_of_force,
    tyre_parameters,
)
from pcw_description.differential_kinematics import wheel_jacobian_kernel
from pcw_description.robot_description import GRAVITY, FloatArray, RobotDescription
from pcw_description.support_forces import support_forces

from .low_root_trust import (
    EXPLAINED_FLOOR,
    EXPLAINED_SHARE,
    MASS_TOLERANCE,
    corrected_bound,
    grown_bound,
    root_error,
    share_corrected,
    trust_of_root,
    velocity_of_slip,
)
from .sliding_mode_observer import (
    LEARNING_MEMORY,
    SETTLED_TIME_CONSTANTS,
    SlidingModeParameters,
    follow_joint,
    learned_mass_ratio,
    mass_contradicted,
)
from .slip_estimate import JointMeasurement, SlipEstimate, ratios_and_angles, require_dt

# A wheel with less than this part of its even share of the weight says nothing.
LEAST_LOAD = 0.05
# Directions of motion that the trusted wheels do not determine are left alone by a ridge of this size.
RIDGE = 1e-3

# Columns of the numbers of a caster, of the state of a caster and of the state of the body.
_RADIUS, _J_RR, _J_RP, _J_PP, _MASS, _CX, _CY, _I_STEER, _TYRE = range(9)
_DRIVE, _STEER, _QUIET, _TRUST, _DRIVE_ERROR, _STEER_ERROR, _FX, _FY, _FZ = 0, 3, 6, 7, 8, 9, 10, 11, 12
_WHEEL_STATE = 13
_COUNT, _TIME, _V, _A, _BOUND, _LEARNED_MM, _LEARNED_MA = 0, 1, 2, 5, 8, 9, 10
_BODY_STATE = 11
_SPEED, _LOAD = 1, 2
_ROOT_X, _ROOT_Y, _SENSED_X, _SENSED_Y, _ERROR_OF_ROOT, _FADE, _SEEN, _MODELLED = range(8)


@compiled
def _solve(matrix, right):  # type: ignore[no-untyped-def]
    """Return the solution of a symmetric 3x3 system."""
    m00, m01, m02 = matrix[0, 0], matrix[0, 1], matrix[0, 2]
    m11, m12, m22 = matrix[1, 1], matrix[1, 2], matrix[2, 2]
    a00, a01, a02 = m11 * m22 - m12 * m12, m02 * m12 - m01 * m22, m01 * m12 - m02 * m11
    a11, a12, a22 = m00 * m22 - m02 * m02, m01 * m02 - m00 * m12, m00 * m11 - m01 * m01
    determinant = m00 * a00 + m01 * a01 + m02 * a02
    solution = np.empty(3)
    solution[0] = (a00 * right[0] + a01 * right[1] + a02 * right[2]) / determinant
    solution[1] = (a01 * right[0] + a11 * right[1] + a12 * right[2]) / determinant
    solution[2] = (a02 * right[0] + a12 * right[1] + a22 * right[2]) / determinant
    return solution


@compiled
def _loads(chassis, height, casters, steer_axis, caster_offset, steer_angle, body, gravity):  # type: ignore[no-untyped-def]
    """Return the normal forces (n,) [N] under the accelerations of the step before."""
    n = len(casters)
    ax = body[_A] - body[_V + 2] * body[_V + 1]
    ay = body[_A + 1] + body[_V + 2] * body[_V]
    mass, com_x, com_y, com_z = chassis[0], chassis[0] * chassis[1], chassis[0] * chassis[2], chassis[0] * height
    centre, flat, normal = np.empty((n, 2)), np.zeros(n), np.empty(n)
    for i in range(n):
        c, s = math.cos(steer_angle[i]), math.sin(steer_angle[i])
        bx, by, cx, cy = caster_offset[i, 0], caster_offset[i, 1], casters[i, _CX], casters[i, _CY]
        centre[i, 0] = steer_axis[i, 0] + bx * c - by * s
        centre[i, 1] = steer_axis[i, 1] + bx * s + by * c
        mass += casters[i, _MASS]
        com_x += casters[i, _MASS] * (steer_axis[i, 0] + cx * c - cy * s)
        com_y += casters[i, _MASS] * (steer_axis[i, 1] + cx * s + cy * c)
        com_z += casters[i, _MASS] * casters[i, _RADIUS]
    support_forces(mass * gravity, com_x * gravity - com_z * ax, com_y * gravity - com_z * ay, 1.0, centre, flat, normal)
    return normal, mass


@compiled
def _advance(  # type: ignore[no-untyped-def]
    chassis, height, modules, casters, steer_axis, caster_offset, gravity, numbers, body, wheels, position, velocity, effort, dt
):
    """Advance body (_BODY_STATE,) and wheels (n, _WHEEL_STATE) in place; returns B q_dot (n, 2) [m/s]."""
    n = len(casters)
    count = body[_COUNT]
    twist = body[_V : _V + 3]
    by_angle = numbers[12] > 0.0
    steer_angle = np.empty(n)
    part = np.zeros((n, 8))
    joint_acceleration = np.empty((n, 2))
    for i in range(n):
        wheel = wheels[i]
        j_rr, j_rp = casters[i, _J_RR], casters[i, _J_RP]
        j_ss = casters[i, _J_PP] + casters[i, _I_STEER]
        determinant = j_rr * j_ss - j_rp * j_rp
        by_torque_r = (j_ss * effort[i, 0] - j_rp * effort[i, 1]) / determinant
        by_torque_p = (j_rr * effort[i, 1] - j_rp * effort[i, 0]) / determinant
        wheel[_DRIVE_ERROR] = follow_joint(
            numbers, count, wheel[_DRIVE : _DRIVE + 3], by_torque_r, position[i, 0], velocity[i, 0], dt
        )
        wheel[_STEER_ERROR] = follow_joint(
            numbers, count, wheel[_STEER : _STEER + 3], by_torque_p, position[i, 1], velocity[i, 1], dt
        )
        joint_acceleration[i, 0] = by_torque_r - wheel[_DRIVE + _LOAD]
        joint_acceleration[i, 1] = by_torque_p - wheel[_STEER + _LOAD]
        steer_angle[i] = wheel[_STEER]
        rate_p = wheel[_STEER + _SPEED]
        part[i, _SENSED_X] = casters[i, _RADIUS] * wheel[_DRIVE + _SPEED] + caster_offset[i, 1] * rate_p
        part[i, _SENSED_Y] = -caster_offset[i, 0] * rate_p
    body[_COUNT] = count + 1.0
    body[_TIME] += dt
    jacobian = wheel_jacobian_kernel(steer_axis, caster_offset, steer_angle)
    if count == 0.0 or (by_angle and count == 1.0):
        fastest = 0.0
        for i in range(n):
            along = jacobian[2 * i, 0] * twist[0] + jacobian[2 * i, 1] * twist[1] + jacobian[2 * i, 2] * twist[2]
            across = jacobian[2 * i + 1, 0] * twist[0] + jacobian[2 * i + 1, 1] * twist[1] + jacobian[2 * i + 1, 2] * twist[2]
            sensed_x, sensed_y = part[i, _SENSED_X], part[i, _SENSED_Y]
            fastest = max(fastest, math.hypot(sensed_x, sensed_y), math.hypot(sensed_x - along, sensed_y - across))
        body[_BOUND] = fastest
    normal, mass = _loads(chassis, height, casters, steer_axis, caster_offset, steer_angle, body, gravity)
    # Forces of the ground, as they act on the chassis (f) and at the contacts.
    f = np.zeros(3)
    spent = 0.0
    for i in range(n):
        wheel = wheels[i]
        bx, by, radius = caster_offset[i, 0], caster_offset[i, 1], casters[i, _RADIUS]
        acceleration_r, acceleration_p = joint_acceleration[i, 0], joint_acceleration[i, 1]
        sigma = wheel[_STEER + _SPEED] + twist[2]
        rolling = radius * wheel[_DRIVE + _SPEED]
        spin = scrub_torque(casters[i, _TYRE:], sigma, math.hypot(rolling, part[i, _SENSED_Y]), normal[i])
        wheel_torque = casters[i, _J_RR] * acceleration_r + casters[i, _J_RP] * acceleration_p
        load_r = effort[i, 0] - wheel_torque
        load_p = effort[i, 1] + spin - casters[i, _J_RP] * acceleration_r - casters[i, _J_PP] * acceleration_p
        force_x = load_r / radius
        force_y = (by * force_x - load_p) / bx
        for k in range(3):
            f[k] += jacobian[2 * i, k] * force_x + jacobian[2 * i + 1, k] * force_y
        f[2] += spin
        spent += abs(wheel_torque) / radius
        # What the module itself takes of the steering torque, with the chassis's acceleration of the step before.
        c, s = math.cos(steer_angle[i]), math.sin(steer_angle[i])
        lever_x = casters[i, _CX] * c - casters[i, _CY] * s
        lever_y = casters[i, _CX] * s + casters[i, _CY] * c
        sx, sy = steer_axis[i, 0], steer_axis[i, 1]
        omega, omega_dot = twist[2], body[_A + 2]
        axis_x = body[_A] - omega * twist[1] - omega_dot * sy - omega * omega * sx
        axis_y = body[_A + 1] + omega * twist[0] + omega_dot * sx - omega * omega * sy
        module = casters[i, _I_STEER] * (acceleration_p + omega_dot)
        module += casters[i, _MASS] * (lever_x * axis_y - lever_y * axis_x)
        wheel[_FX], wheel[_FY], wheel[_FZ] = force_x, force_y + module / bx, normal[i]
    inertia, bias = augmented_object_kernel(chassis, modules, steer_axis, caster_offset, steer_angle, twist.copy())
    nominal = _solve(inertia, f - bias)
    ratio = learned_mass_ratio(numbers[MASS_TOLERANCE], body[_LEARNED_MM], body[_LEARNED_MA])
    change = _solve(inertia, f / ratio - bias)
    body[_A : _A + 3] = change
    if count == 0.0 or (by_angle and count == 1.0):
        sensed = part[:, _SENSED_X : _SENSED_Y + 1].copy()
        return sensed
    for k in range(3):
        twist[k] += dt * change[k]
    translation = math.hypot(change[0] - twist[2] * twist[1], change[1] + twist[2] * twist[0])
    bound = grown_bound(numbers, body[_BOUND], translation, spent / mass, dt)
    least_error, trusted = math.inf, 0
    for i in range(n):
        wheel, tyre = wheels[i], casters[i, _TYRE:]
        wheel[_TRUST] = 0.0
        rate_p = wheel[_STEER + _SPEED]
        along = jacobian[2 * i, 0] * twist[0] + jacobian[2 * i, 1] * twist[1] + jacobian[2 * i, 2] * twist[2]
        across = jacobian[2 * i + 1, 0] * twist[0] + jacobian[2 * i + 1, 1] * twist[1] + jacobian[2 * i + 1, 2] * twist[2]
        if normal[i] < LEAST_LOAD * mass * gravity / n:
            continue
        rolling = casters[i, _RADIUS] * wheel[_DRIVE + _SPEED]
        swing = caster_offset[i, 1] * rate_p
        reference = max(abs(rolling), math.hypot(along - swing, across), 1e-6)
        slip_x, slip_y = slip_of_force(tyre, wheel[_FX], wheel[_FY], normal[i])
        part[i, _ROOT_X] = velocity_of_slip(rolling, slip_x) + swing
        part[i, _ROOT_Y] = part[i, _SENSED_Y] - slip_y * reference
        c, s = math.cos(steer_angle[i]), math.sin(steer_angle[i])
        sx, sy = steer_axis[i, 0], steer_axis[i, 1]
        # d/dt of A V along and across: the fork turns its frame.
        turned_x = rate_p * (-s * twist[0] + c * twist[1] + (c * sx + s * sy) * twist[2])
        turned_y = rate_p * (-c * twist[0] - s * twist[1] + (c * sy - s * sx) * twist[2])
        ground_x = jacobian[2 * i, 0] * change[0] + jacobian[2 * i, 1] * change[1] + jacobian[2 * i, 2] * change[2] + turned_x
        ground_y = jacobian[2 * i + 1, 0] * change[0] + jacobian[2 * i + 1, 1] * change[1] + jacobian[2 * i + 1, 2] * change[2]
        ground_y += turned_y
        rolled_x = casters[i, _RADIUS] * joint_acceleration[i, 0] + caster_offset[i, 1] * joint_acceleration[i, 1]
        rolled_y = -caster_offset[i, 0] * joint_acceleration[i, 1]
        peak_x, peak_y = tyre[MU] * normal[i], tyre[LATERAL_MU] * normal[i]
        use = math.hypot(wheel[_FX] / peak_x, wheel[_FY] / peak_y)
        carried_x, carried_y = friction_coefficient(
            tyre, (part[i, _SENSED_X] - along) / reference, (part[i, _SENSED_Y] - across) / reference
        )
        force = math.hypot(wheel[_FX], wheel[_FY])
        missed = math.hypot(carried_x * normal[i] - wheel[_FX], carried_y * normal[i] - wheel[_FY])
        error_of_root, fade = root_error(numbers, use, tyre[LAMBDA], reference)
        trust, wheel[_QUIET] = trust_of_root(
            numbers,
            fade,
            error_of_root,
            math.hypot(rolled_x - ground_x, rolled_y - ground_y),
            math.hypot(ground_x, ground_y),
            math.hypot(part[i, _ROOT_X] - along, part[i, _ROOT_Y] - across),
            bound,
            missed <= EXPLAINED_SHARE * force + EXPLAINED_FLOOR * peak_x,
            wheel[_QUIET],
            dt,
        )
        wheel[_TRUST] = trust
        part[i, _ERROR_OF_ROOT], part[i, _FADE] = error_of_root, fade
        part[i, _SEEN] = rolled_x - abs(slip_x) * casters[i, _RADIUS] * joint_acceleration[i, 0]
        part[i, _MODELLED] = turned_x
        for k in range(3):
            part[i, _MODELLED] += jacobian[2 * i, k] * nominal[k]
        if trust > 0.0:
            least_error = min(least_error, error_of_root)
            trusted += 1
    body[_LEARNED_MM] *= math.exp(-dt / LEARNING_MEMORY)
    body[_LEARNED_MA] *= math.exp(-dt / LEARNING_MEMORY)
    if trusted > 0:
        matrix, right = np.zeros((3, 3)), np.zeros(3)
        most, mean_error, conflict, gripping, mm, ma = 0.0, 0.0, 0.0, 0, 0.0, 0.0
        for i in range(n):
            trust = wheels[i, _TRUST]
            weight = trust * (least_error / part[i, _ERROR_OF_ROOT]) ** 2 if trust > 0.0 else 0.0
            most = max(most, trust)
            for row in range(2):
                a = jacobian[2 * i + row]
                innovation = part[i, _ROOT_X + row] - a[0] * twist[0] - a[1] * twist[1] - a[2] * twist[2]
                for k in range(3):
                    right[k] += weight * a[k] * innovation
                    for m in range(3):
                        matrix[k, m] += (weight + RIDGE / n) * a[k] * a[m]
                if trust > 0.0:
                    conflict = max(conflict, abs(innovation))
            if trust > 0.0:
                mean_error += part[i, _ERROR_OF_ROOT] / trusted
            if trust == 1.0 and part[i, _FADE] == 1.0:
                gripping += 1
                mm += part[i, _MODELLED] ** 2
                ma += part[i, _MODELLED] * part[i, _SEEN]
        correction = _solve(matrix, right)
        share = share_corrected(numbers, most, dt)
        for k in range(3):
            twist[k] += share * correction[k]
        if trusted >= 2:  # one wheel leaves the turning open
            bound = corrected_bound(max(bound, conflict), share, mean_error)
        if gripping == n and bound <= 2.0 * mean_error:
            body[_LEARNED_MM] += dt * mm / n
            body[_LEARNED_MA] += dt * ma / n
    body[_BOUND] = bound
    sensed = part[:, _SENSED_X : _SENSED_Y + 1].copy()
    return sensed


@dataclasses.dataclass(frozen=True)
class RobotObserverState:
    """State of the observer; what its numbers are is the observer's own matter.

    Attributes:
        body: shared by all casters.
        wheels: one row per caster.
    """

    body: FloatArray
    wheels: FloatArray


class RobotSlidingModeObserver:
    """The observer of a whole robot; see the module's docstring.

    Args:
        robot: the robot.
        parameters: gains and tolerances; `measured` says which version it is.
        gravity: [m/s^2].

    Raises:
        KinematicsError: a caster without offset, of whose side force the steering torque says nothing.
    """

    def __init__(
        self, robot: RobotDescription, parameters: SlidingModeParameters | None = None, gravity: float = GRAVITY
    ) -> None:
        robot.require_torque_control()
        self.robot, self.parameters = robot, parameters or SlidingModeParameters()
        chassis, modules = dynamic_parameters(robot)
        casters = np.empty((robot.n, _TYRE + TYRE_SIZE))
        casters[:, _RADIUS] = robot.wheel_radius
        casters[:, _J_RR] = modules[:, 4] + modules[:, 5]
        casters[:, [_J_RP, _J_PP]] = modules[:, [6, 7]]
        casters[:, [_MASS, _CX, _CY]] = modules[:, :3]
        casters[:, _I_STEER] = modules[:, 3] + modules[:, 0] * np.sum(modules[:, 1:3] ** 2, axis=1)
        casters[:, _TYRE:] = [tyre_parameters(tyre) for tyre in robot.tyres]
        translating = modules.copy()
        translating[:, 4:8] = 0.0  # what spins is taken off the torques instead
        self._numbers = self.parameters.numbers()
        self._constants = (
            chassis, robot.chassis.com[2], translating, casters, robot.steer_axis, robot.caster_offset, gravity, self._numbers
        )  # fmt: skip
        self._needed = ("position", "effort") if self.parameters.measured == "angle" else ("position", "velocity", "effort")

    def initial_state(self, twist: FloatArray | None = None) -> RobotObserverState:
        """Return the state before the first reading, with a guess of the twist (3,)."""
        body = np.zeros(_BODY_STATE)
        if twist is not None:
            body[_V : _V + 3] = twist
        return RobotObserverState(body, np.zeros((self.robot.n, _WHEEL_STATE)))

    def contradicted(self, state: RobotObserverState) -> bool:
        """Whether forces and accelerations contradict each other: the description does not match, or all wheels spin."""
        body = state.body
        return bool(mass_contradicted(self._numbers[MASS_TOLERANCE], body[_LEARNED_MM], body[_LEARNED_MA]))

    def trust(self, state: RobotObserverState) -> FloatArray:
        """Return how far each wheel was trusted to grip at the last reading (n,), in [0, 1]."""
        return state.wheels[:, _TRUST].copy()

    def step(
        self, state: RobotObserverState, measurement: JointMeasurement, dt: float
    ) -> tuple[RobotObserverState, SlipEstimate]:
        """Take one reading.

        Args:
            state: after the reading before; it is not changed.
            measurement: joint readings; velocities are not looked at by the version that measures angles.
            dt: measured time since the reading before [s]; of the first one any.

        Returns:
            New state and estimate.

        Raises:
            EstimationError: a reading that is needed is not finite, or dt is not positive; the caller keeps its state.
        """
        require_dt(dt)
        measurement.check(self.robot.n, self._needed)
        body, wheels = state.body.copy(), state.wheels.copy()
        sensed = _advance(
            *self._constants, body, wheels, measurement.position, measurement.velocity, measurement.effort, dt
        )
        new_state = RobotObserverState(body, wheels)
        return new_state, self._estimate(new_state, sensed)

    def _estimate(self, state: RobotObserverState, sensed: FloatArray) -> SlipEstimate:
        body, wheels, numbers = state.body, state.wheels, self._numbers
        twist = body[_V : _V + 3].copy()
        steer_angle = np.ascontiguousarray(wheels[:, _STEER])
        jacobian = wheel_jacobian_kernel(self.robot.steer_axis, self.robot.caster_offset, steer_angle)
        velocity = (jacobian @ twist).reshape(-1, 2)
        settled = body[_TIME] > SETTLED_TIME_CONSTANTS / numbers[9]
        force_valid = settled & (np.abs(wheels[:, _DRIVE_ERROR : _STEER_ERROR + 1]) <= numbers[10])
        speed = np.maximum(np.hypot(velocity[:, 0], velocity[:, 1]), np.hypot(sensed[:, 0], sensed[:, 1]))
        known = body[_BOUND] <= numbers[13] * speed + numbers[14]
        valid = np.repeat((known & settled & (not self.contradicted(state)))[:, None], 2, axis=1)
        return SlipEstimate(
            twist=twist,
            wheel_velocity=velocity,
            slip_velocity=sensed - velocity,
            slip_ratio=ratios_and_angles(sensed, velocity),
            force=wheels[:, _FX : _FY + 1].copy(),
            velocity_bound=float(body[_BOUND]),
            velocity_valid=valid,
            slip_valid=valid.copy(),
            force_valid=force_valid,
        )
