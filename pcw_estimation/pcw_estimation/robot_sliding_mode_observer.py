"""Sliding-mode observer of a whole robot: n casters that share one chassis, (4.13)-(4.15) with (3.44) [Li2009].

Every joint has its sliding mode (`joint_sliding_mode`), whose equivalent injection gives the load of the ground on it, and
with the inertia of the module that turns with it the force in the wheel frame, B^T F = load. The chassis follows from all,

    Lambda V_dot + theta = A^T F                                                                          (3.44)

(`slipping_robot_dynamics`). The velocity is drawn to what the lower roots of the friction curves say of each wheel centre,

    y_i = (B q_dot)_i - |v_i| (lambda_x, lambda_y)_i (F_i / F_zi),      V_hat += share (A^T W A)^-1 A^T W (y - A V_hat),

with a weight in W for every wheel by `low_root_trust`: a wheel that spins, or is near its peak, is left out, and those that
grip carry the chassis. While all spin the forces alone do. Loads F_z follow from the accelerations (`support_forces`).

Both versions are here: with joint speeds measured, and from joint angles alone.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from pcw_description.augmented_object_model import dynamic_parameters
from pcw_description.compiled import compiled
from pcw_description.contact.contact_model import (
    LAMBDA,
    LATERAL_MU,
    MU,
    friction_coefficient,
    scrub_torque,
    slip_of_force,
)
from pcw_description.differential_kinematics import wheel_jacobian_kernel
from pcw_description.robot_description import GRAVITY, FloatArray, RobotDescription

from .errors import require_dt
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
    ACCURACY,
    ACCURACY_FLOOR,
    ANGLE_ONLY,
    BANDWIDTH,
    CONTRADICTION_FLOOR,
    LAYER,
    LEARNING_MEMORY,
    SETTLED_TIME_CONSTANTS,
    SLIP_ACCELERATION_MEMORY,
    SlidingModeParameters,
    follow_joint,
    forces_found,
    late_load,
    learned_mass_ratio,
    load_share,
    load_that_follows,
    mass_contradicted,
)
from .slip_estimate import RATIO_SPEED, JointMeasurement, SlipEstimate
from .slipping_robot_dynamics import (
    CX,
    CY,
    I_STEER,
    J_PP,
    J_RP,
    J_RR,
    MASS,
    RADIUS,
    TYRE,
    add_turning_module,
    body_dynamics,
    caster_numbers,
    composite_body,
    solve_symmetric,
    wheel_loads,
)

# A wheel with less than this part of its even share of the weight says nothing.
LEAST_LOAD = 0.05
# Directions of motion that the trusted wheels do not determine are left alone by a ridge of this size.
RIDGE = 1e-3

# Forces and accelerations are compared over a time, where the robot accelerates by at least so much [s], [m/s^2]. Where they
# part for most of a longer time [s] it is no wheel that spins.
COMPARED_TIME, LEAST_ACCELERATION = 0.05, 0.1
MISMATCH_TIME, MISMATCH_SHARE = 3.0, 0.7

# No robot on casters is faster, or turns faster [m/s], [rad/s].
FASTEST, FASTEST_TURNING = 100.0, 300.0

# Columns of the state of a caster and of the state of the body.
_DRIVE, _STEER, _QUIET, _TRUST, _DRIVE_ERROR, _STEER_ERROR, _FX, _FY, _FZ = 0, 3, 6, 7, 8, 9, 10, 11, 12
_RUNS_X, _RUNS_Y, _TORQUE = 13, 14, 15
_WHEEL_STATE = 16
_COUNT, _TIME, _V, _A, _BOUND, _LEARNED_MM, _LEARNED_MA, _LATE = 0, 1, 2, 5, 8, 9, 10, 11
_COMPARED_MM, _COMPARED_MA, _MISMATCH = 12, 13, 14
_BODY_STATE = 15
_SPEED, _LOAD = 1, 2
_ROOT_X, _ROOT_Y, _SENSED_X, _SENSED_Y, _ERROR_OF_ROOT, _FADE, _SEEN, _MODELLED = range(8)


@compiled
def _advance(  # type: ignore[no-untyped-def]
    chassis, mass_height, casters, steer_axis, caster_offset, gravity, numbers, body_before, wheels_before, position, velocity,
    effort, dt,
):
    """Return the new body (_BODY_STATE,) and wheels (n, _WHEEL_STATE), B q_dot (n, 2) [m/s] and A (2n, 3)."""
    body, wheels = body_before.copy(), wheels_before.copy()
    n = len(casters)
    count = body[_COUNT]
    twist = body[_V : _V + 3]
    by_angle = numbers[ANGLE_ONLY] > 0.0
    steer_angle = np.empty(n)
    part = np.zeros((n, 8))
    joint_acceleration = np.empty((n, 2))
    late, mass_share = 0.0, chassis[0] / n
    for i in range(n):
        wheel = wheels[i]
        j_rr, j_rp = casters[i, J_RR], casters[i, J_RP]
        j_ss = casters[i, J_PP] + casters[i, I_STEER]
        determinant = j_rr * j_ss - j_rp * j_rp
        by_torque_r = (j_ss * effort[i, 0] - j_rp * effort[i, 1]) / determinant
        by_torque_p = (j_rr * effort[i, 1] - j_rp * effort[i, 0]) / determinant
        # While a wheel grips its load follows its torque at once; what is left for the injection to find is slow.
        follows = load_share(j_rr, casters[i, RADIUS], mass_share) * wheel[_TRUST] * (by_torque_r - wheel[_TORQUE])
        wheel[_TORQUE] = by_torque_r
        most = casters[i, RADIUS] * casters[i, TYRE + MU] * wheel[_FZ] / j_rr
        wheel[_DRIVE + _LOAD] = load_that_follows(wheel[_DRIVE + _LOAD], follows, most)
        load_before = wheel[_DRIVE + _LOAD]
        wheel[_DRIVE_ERROR] = follow_joint(
            numbers, count, wheel[_DRIVE : _DRIVE + 3], by_torque_r, position[i, 0], velocity[i, 0], dt
        )
        wheel[_STEER_ERROR] = follow_joint(
            numbers, count, wheel[_STEER : _STEER + 3], by_torque_p, position[i, 1], velocity[i, 1], dt
        )
        joint_acceleration[i, 0] = by_torque_r - wheel[_DRIVE + _LOAD]
        joint_acceleration[i, 1] = by_torque_p - wheel[_STEER + _LOAD]
        late += j_rr / casters[i, RADIUS] * late_load(numbers, load_before, wheel[_DRIVE + _LOAD], dt)
        steer_angle[i] = wheel[_STEER]
        rate_p = wheel[_STEER + _SPEED]
        part[i, _SENSED_X] = casters[i, RADIUS] * wheel[_DRIVE + _SPEED] + caster_offset[i, 1] * rate_p
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
    composite = composite_body(chassis, casters, steer_axis, steer_angle)
    mass = composite[0]
    normal = wheel_loads(
        composite, mass_height, casters, steer_axis, caster_offset, steer_angle, twist, body[_A : _A + 3], gravity
    )
    # Forces of the ground (f), and what modules take that turn under the chassis (turning).
    f, turning = np.zeros(3), np.zeros(3)
    spent = 0.0
    for i in range(n):
        wheel = wheels[i]
        bx, by, radius = caster_offset[i, 0], caster_offset[i, 1], casters[i, RADIUS]
        acceleration_r, acceleration_p = joint_acceleration[i, 0], joint_acceleration[i, 1]
        sigma = wheel[_STEER + _SPEED] + twist[2]
        rolling = radius * wheel[_DRIVE + _SPEED]
        spin = scrub_torque(casters[i, TYRE:], sigma, math.hypot(rolling, part[i, _SENSED_Y]), normal[i])
        wheel_torque = casters[i, J_RR] * acceleration_r + casters[i, J_RP] * acceleration_p
        load_r = effort[i, 0] - wheel_torque
        load_p = effort[i, 1] + spin - casters[i, J_RP] * acceleration_r - casters[i, J_PP] * acceleration_p
        force_x = load_r / radius
        force_y = (by * force_x - load_p) / bx
        spent += abs(wheel_torque) / radius
        # What the module itself takes of the steering torque, with the chassis's acceleration of the step before.
        c, s = math.cos(steer_angle[i]), math.sin(steer_angle[i])
        lever_x = casters[i, CX] * c - casters[i, CY] * s
        lever_y = casters[i, CX] * s + casters[i, CY] * c
        sx, sy = steer_axis[i, 0], steer_axis[i, 1]
        omega, omega_dot = twist[2], body[_A + 2]
        axis_x = body[_A] - omega * twist[1] - omega_dot * sy - omega * omega * sx
        axis_y = body[_A + 1] + omega * twist[0] + omega_dot * sx - omega * omega * sy
        m = casters[i, MASS]
        module = casters[i, I_STEER] * (acceleration_p + omega_dot) + m * (lever_x * axis_y - lever_y * axis_x)
        force_y += module / bx
        wheel[_FX], wheel[_FY], wheel[_FZ] = force_x, force_y, normal[i]
        for k in range(3):
            f[k] += jacobian[2 * i, k] * force_x + jacobian[2 * i + 1, k] * force_y
        f[2] += spin
        add_turning_module(
            turning, casters[i], steer_axis[i], lever_x, lever_y, wheel[_STEER + _SPEED], acceleration_p, omega
        )
    inertia, bias = body_dynamics(composite, casters, steer_axis, caster_offset, steer_angle, twist.copy())
    bias += turning
    nominal = solve_symmetric(inertia, f - bias)
    ratio = learned_mass_ratio(numbers[MASS_TOLERANCE], body[_LEARNED_MM], body[_LEARNED_MA])
    change = solve_symmetric(inertia, f / ratio - bias)
    body[_A : _A + 3] = change
    if count == 0.0 or (by_angle and count == 1.0):
        return body, wheels, part[:, _SENSED_X : _SENSED_Y + 1].copy(), jacobian
    for k in range(3):
        twist[k] += dt * change[k]
    translation = math.hypot(change[0] - twist[2] * twist[1], change[1] + twist[2] * twist[0])
    bound = grown_bound(numbers, body[_BOUND], translation, spent / mass, dt)
    # Forces that change are found late. That is told, but is no reason to believe another root.
    body[_LATE] += dt * late / mass
    least_error, trusted = math.inf, 0
    # Forces that are not found yet say nothing of grip: until then every reading begins anew.
    found = forces_found(numbers, body[_TIME])
    averaged = 1.0 - math.exp(-dt / SLIP_ACCELERATION_MEMORY) if found else 1.0
    for i in range(n):
        wheel, tyre = wheels[i], casters[i, TYRE:]
        wheel[_TRUST] = 0.0
        rate_p = wheel[_STEER + _SPEED]
        along = jacobian[2 * i, 0] * twist[0] + jacobian[2 * i, 1] * twist[1] + jacobian[2 * i, 2] * twist[2]
        across = jacobian[2 * i + 1, 0] * twist[0] + jacobian[2 * i + 1, 1] * twist[1] + jacobian[2 * i + 1, 2] * twist[2]
        if normal[i] < LEAST_LOAD * mass * gravity / n:
            continue
        rolling = casters[i, RADIUS] * wheel[_DRIVE + _SPEED]
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
        rolled_x = casters[i, RADIUS] * joint_acceleration[i, 0] + caster_offset[i, 1] * joint_acceleration[i, 1]
        rolled_y = -caster_offset[i, 0] * joint_acceleration[i, 1]
        wheel[_RUNS_X] += averaged * (rolled_x - ground_x - wheel[_RUNS_X])
        wheel[_RUNS_Y] += averaged * (rolled_y - ground_y - wheel[_RUNS_Y])
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
            math.hypot(wheel[_RUNS_X], wheel[_RUNS_Y]),
            math.hypot(ground_x, ground_y),
            math.hypot(part[i, _ROOT_X] - along, part[i, _ROOT_Y] - across),
            bound,
            missed <= EXPLAINED_SHARE * force + EXPLAINED_FLOOR * peak_x,
            wheel[_QUIET],
            dt,
        )
        trust = trust if found else 0.0
        wheel[_TRUST] = trust
        part[i, _ERROR_OF_ROOT], part[i, _FADE] = error_of_root, fade
        part[i, _SEEN] = rolled_x - abs(slip_x) * casters[i, RADIUS] * joint_acceleration[i, 0]
        part[i, _MODELLED] = turned_x
        for k in range(3):
            part[i, _MODELLED] += jacobian[2 * i, k] * nominal[k]
        if trust > 0.0:
            least_error = min(least_error, error_of_root)
            trusted += 1
    _compare(numbers, body, part, dt)
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
        correction = solve_symmetric(matrix, right)
        share = share_corrected(numbers, most, dt)
        for k in range(3):
            twist[k] += share * correction[k]
        if trusted >= 2:  # one wheel leaves the turning open
            bound = corrected_bound(max(bound, conflict), share, mean_error)
            body[_LATE] *= 1.0 - share
        if gripping == n and bound <= 2.0 * mean_error:
            body[_LEARNED_MM] += dt * mm / n
            body[_LEARNED_MA] += dt * ma / n
    body[_BOUND] = bound
    # Readings that belong to no robot can drive it anywhere: it then begins anew.
    if not (abs(twist[0]) + abs(twist[1]) < FASTEST and abs(twist[2]) < FASTEST_TURNING):
        body[:] = 0.0
        wheels[:] = 0.0
    return body, wheels, part[:, _SENSED_X : _SENSED_Y + 1].copy(), jacobian


@compiled
def _compare(numbers, body, part, dt):  # type: ignore[no-untyped-def]
    """Follow in place for which part of the time the wheels accelerate more (or less) than the forces explain."""
    fade = math.exp(-dt / COMPARED_TIME)
    mm, ma = 0.0, 0.0
    for i in range(len(part)):
        mm += part[i, _MODELLED] ** 2 / len(part)
        ma += part[i, _MODELLED] * part[i, _SEEN] / len(part)
    body[_COMPARED_MM] += (1.0 - fade) * (mm - body[_COMPARED_MM])
    body[_COMPARED_MA] += (1.0 - fade) * (ma - body[_COMPARED_MA])
    if body[_COMPARED_MM] > LEAST_ACCELERATION**2:
        parted = math.log(max(body[_COMPARED_MA], 1e-9) / body[_COMPARED_MM])
        side = math.copysign(1.0, parted) if abs(parted) > 2.0 * numbers[MASS_TOLERANCE] + CONTRADICTION_FLOOR else 0.0
        body[_MISMATCH] += (1.0 - math.exp(-dt / MISMATCH_TIME)) * (side - body[_MISMATCH])


@compiled
def _contradicted(numbers, body):  # type: ignore[no-untyped-def]
    """Return whether no mass within its tolerance makes accelerations of forces, while the wheels grip or for long."""
    return (
        mass_contradicted(numbers[MASS_TOLERANCE], body[_LEARNED_MM], body[_LEARNED_MA])
        or abs(body[_MISMATCH]) > MISMATCH_SHARE
    )


@compiled
def _estimate(numbers, body, wheels, sensed, jacobian):  # type: ignore[no-untyped-def]
    """Return what `SlipEstimate` holds: numbers (4, n, 2), the bound, and flags (3, n, 2)."""
    n = len(wheels)
    result, valid = np.empty((4, n, 2)), np.empty((3, n, 2), dtype=np.bool_)
    settled = body[_TIME] > SETTLED_TIME_CONSTANTS / numbers[BANDWIDTH]
    contradicted = _contradicted(numbers, body)
    bound = body[_BOUND] + body[_LATE]
    for i in range(n):
        for row in range(2):
            a = jacobian[2 * i + row]
            result[0, i, row] = a[0] * body[_V] + a[1] * body[_V + 1] + a[2] * body[_V + 2]
            result[1, i, row] = sensed[i, row] - result[0, i, row]
            valid[2, i, row] = settled and abs(wheels[i, _DRIVE_ERROR + row]) <= numbers[LAYER]
        reference = max(abs(sensed[i, 0]), abs(result[0, i, 0]), RATIO_SPEED)
        result[2, i, 0], result[2, i, 1] = result[1, i, 0] / reference, math.atan2(result[1, i, 1], reference)
        result[3, i, 0], result[3, i, 1] = wheels[i, _FX], wheels[i, _FY]
        speed = max(math.hypot(sensed[i, 0], sensed[i, 1]), math.hypot(result[0, i, 0], result[0, i, 1]))
        known = settled and not contradicted and bound <= numbers[ACCURACY] * speed + numbers[ACCURACY_FLOOR]
        valid[0, i, :], valid[1, i, :] = known, known
    return result, bound, valid


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
        chassis, _ = dynamic_parameters(robot)
        mass_height = robot.chassis.mass * robot.chassis.com[2]
        self._numbers = self.parameters.numbers()
        self._constants = (
            chassis, mass_height, caster_numbers(robot), robot.steer_axis, robot.caster_offset, gravity, self._numbers
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
        return bool(_contradicted(self._numbers, state.body))

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
        body, wheels, sensed, jacobian = _advance(
            *self._constants, state.body, state.wheels, measurement.position, measurement.velocity, measurement.effort, dt
        )
        result, bound, valid = _estimate(self._numbers, body, wheels, sensed, jacobian)
        estimate = SlipEstimate(
            body[_V : _V + 3].copy(), result[0], result[1], result[2], result[3], bound, valid[0], valid[1], valid[2]
        )
        return RobotObserverState(body, wheels), estimate
