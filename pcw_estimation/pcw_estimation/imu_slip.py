"""Slip from encoders and IMU together, (4.9)-(4.12), and the motion of the robot without the wheels that slip.

    eps_hat = B q_dot - A V_ext                                                                          (4.11)

V_ext is no integral of the accelerometer alone, which drifts. It is the state of a filter that an IMU carries on and that
wheels which agree with it correct. With the velocity u of the place r of the IMU, in axes of base_link,

    omega = (gyro - b_g) (1 - s_g)      u_dot = a - b_a - R(yaw)^T t - omega x u      v = u - omega x r
    pose_dot = R(yaw) v, omega          V_ext = (v, omega)

with the biases b and what a floor that is not quite level leaves of gravity, t, which needs no derivative of the gyro. State:
pose (3), u (2), b_g, b_a (2), t (2), s_g; and errors that stay what they are and are never learned, only kept in the
covariance (a Schmidt filter): of the common wheel radius, of the mean steering zero, of the scales of both accelerometers, of
the place of the IMU and of its clock. As noise they would be averaged out in a long turn, and V_ext be thought to know the
turning rate from the centripetal acceleration better than any scale allows.

The turning rate of wheels with errors of radius, heading and place is wrong in proportion to the motion,

    omega_wheels = omega + k_x v_x + k_y v_y + k_omega omega,

and the three k are such errors as well. Where wheels slip and are left out, those that remain have other k; their turning rate
then counts as one measurement per `MOTION_MEMORY`.

A correction looks for the set of components that slips as `slip_consensus` does, with V_ext and its covariance as what is
known before, and without a limit to what that may cost: if V_ext says so all wheels slip. What does not slip corrects v. A
robot whose joints stand still does not turn, and that counts in full (b_g and b_a are learned at standstill). A tyre that
accelerates the robot creeps, by lambda_p / (2 mu_p g) of speed and acceleration; that error lasts as long as an acceleration
and is weighted accordingly.

Where the wheels agree with each other for `yield_time`, but not with V_ext, they are believed: a ramp tilts gravity into the
accelerometer, and no IMU of this kind can hold a velocity for long.

Without an IMU, or while it is silent, the twist of the wheels (`slip_consensus`) carries the state on; slip of all wheels is
then invisible.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from pcw_description.compiled import compiled
from pcw_description.differential_kinematics import wheel_jacobian_kernel
from pcw_description.robot_description import GRAVITY, STEER, FloatArray, RobotDescription

from .errors import EstimationError
from .normal_equations import full_inverse, is_determined, parts_of_rows, solve, sum_of, upper_inverse
from .slip_consensus import CLEAR_LEAD, LEAP_SHARE, best_set
from .slip_noise import LEAST_FLOOR, SlipNoise, sensed_kernel, variance_kernel
from .slip_verdict import (
    ConfirmParameters,
    SlipFinding,
    Verdict,
    check_measurement,
    confirm_kernel,
    describe_kernel,
    finding_of,
)

# How long an error of the geometry of a few wheels stays the same before the motion is another one [s].
MOTION_MEMORY = 10.0
# Joints that stand are those of a robot that stands, or slides with blocked wheels; not for longer than this [s].
STANDING_YIELD = 1.0
# While the IMU alone holds the speed, a wheel that slipped must come closer than the gate by this factor to be trusted again.
RETURN_SHARE = 0.5
# Variance of a velocity over that with all wheels: above the first the errors of geometry that it holds are other ones than
# those of all wheels, above the second the wheels do not tell that velocity.
AMPLIFIED, TOLD = 6.0, 25.0
# How long an acceleration lasts, and the creep of a tyre with it, and slip that is too small to be told [s].
CREEP_MEMORY = 0.3
# A robot stands when no encoder has moved by more than this for so long [counts], [s].
STANDING_COUNTS, STANDING_TIME = 1.5, 0.1
# Random walk of the biases, in a second [rad/s], [m/s^2]: in an hour 25 degrees an hour and 0.6 mg, as small industrial IMUs.
GYRO_WALK, ACCELEROMETER_WALK = 2e-6, 1e-4
# Of its tolerance, by so much the slope of a floor changes in a metre [1/sqrt(m)].
TILT_WALK = 0.1
# A robot file without an IMU that is given one all the same: of a small industrial one [rad/s], [m/s^2], [Hz].
GYRO_NOISE, ACCELEROMETER_NOISE, IMU_RATE = 0.002, 0.02, 200.0

X, Y, YAW, UX, UY, GYRO_BIAS, BIAS_X, BIAS_Y, TILT_X, TILT_Y = range(10)
GYRO_SCALE, RADIUS, HEADING, SCALE_X, SCALE_Y, PLACE_X, PLACE_Y, LATENESS = range(10, 18)
SPIN_X, SPIN_Y, SPIN_TURN = range(18, 21)  # k_x, k_y [1/m], k_omega [1]
_STATES, _LEARNED = 21, 11
# Layout of the state, one array because two control loops pass it on: state of the filter (21) and its covariance (441); sums
# of the gyro and of the accelerometer's axes since the last correction and their number; the last sample (3); its age [s];
# last turning rate [rad/s]; time since any joint moved, time for which the wheels have agreed against V_ext [s]; set of
# slipping components, measurements since it was searched for, its lead; whether a velocity is known, and whether the wheels
# told it last; then by caster where the joints stood, flags, and for how long they have been contradicted.
_P = _STATES
_SUMS = _P + _STATES**2
_SAMPLES, _LAST, _IMU_AGE, _OMEGA, _STANDING, _AGAINST = _SUMS + 3, _SUMS + 4, _SUMS + 7, _SUMS + 8, _SUMS + 9, _SUMS + 10
_CHOSEN, _SINCE_SEARCH, _LEAD, _STARTED, _TOLD, _JOINTS = (_SUMS + k for k in range(11, 17))
_CONSISTENT, _SLIP, _CANNOT_KNOW = int(Verdict.CONSISTENT), int(Verdict.SLIP), int(Verdict.CANNOT_KNOW)


@dataclasses.dataclass(frozen=True)
class ImuSlipParameters:
    """How far IMU and wheels are believed.

    Attributes:
        imu_timeout: without a sample for so long the wheels carry on alone [s].
        yield_time: wheels that have agreed with each other against the IMU for so long are believed [s].
        slope: of the ground, one standard deviation; None: the tolerance `ground.slope` of the robot file [rad].
    """

    imu_timeout: float = 0.05
    yield_time: float = 5.0
    slope: float | None = None

    def __post_init__(self) -> None:
        """Check the parameters.

        Raises:
            EstimationError: names the field, its value and what is allowed.
        """
        for name in ("imu_timeout", "yield_time"):
            value = getattr(self, name)
            if not math.isfinite(value) or value <= 0.0:
                raise EstimationError(f"{name} = {value!r} is not allowed; allowed: a positive number")
        if self.slope is not None and not (math.isfinite(self.slope) and self.slope >= 0.0):
            raise EstimationError(f"slope = {self.slope!r} is not allowed; allowed: a finite number, at least 0")


@dataclasses.dataclass(frozen=True)
class Motion:
    """What is known of the motion after a correction.

    Attributes:
        finding: slip of every wheel against V_ext; `finding.twist` and its covariance are V_ext with what the wheels added.
        pose: of base_link in odom (3,).
        pose_covariance: (3, 3).
        all_slip: there is no wheel that does not slip along or across.
        told: the wheels still tell how fast the robot is, by what of them does not slip; else the IMU alone does.
        inertial: the IMU took part.
        gyro_bias: [rad/s].
    """

    finding: SlipFinding
    pose: FloatArray
    pose_covariance: FloatArray
    all_slip: bool
    told: bool
    inertial: bool
    gyro_bias: float


class ImuSlip:
    """The filter for one robot: its numbers as arrays, `predict` for each IMU sample, `correct` for each one of the joints.

    Args:
        robot: the robot.
        noise: of the encoders of a healthy one; default: what the robot file says.
        confirm: how long slip must last to be said.
        parameters: see there.
    """

    def __init__(
        self, robot: RobotDescription, noise: SlipNoise | None = None, confirm: ConfirmParameters | None = None,
        parameters: ImuSlipParameters | None = None,
    ) -> None:  # fmt: skip
        self.robot = robot
        self.noise = noise or SlipNoise.of_robot(robot)
        self.confirm = confirm or ConfirmParameters()
        self.parameters = parameters or ImuSlipParameters()
        imu, n = robot.sensors.imu, robot.n
        tolerance = {name: robot.tolerance(name).value for name in _TOLERANCES}
        if not robot.tolerance("wheel_radius").relative:
            tolerance["wheel_radius"] /= float(robot.wheel_radius.min())
        slope = tolerance["ground.slope"] if self.parameters.slope is None else self.parameters.slope
        mu_p = max(tyre.mu_p for tyre in robot.tyres)
        creep = max(tyre.lambda_p for tyre in robot.tyres) / (2.0 * mu_p * GRAVITY)
        reach = math.sqrt(float(np.mean(np.sum(robot.steer_axis**2, axis=1))))
        self._start_variance = np.array(
            [
                0.0, 0.0, 0.0, 1.0, 1.0, tolerance["imu.gyro_bias"] ** 2,
                *2 * [tolerance["imu.accelerometer_bias"] ** 2], *2 * [(GRAVITY * slope) ** 2],
                tolerance["imu.scale"] ** 2, tolerance["wheel_radius"] ** 2 / n, tolerance["steer_zero"] ** 2 / n,
                *2 * [tolerance["imu.scale"] ** 2], *2 * [tolerance["imu.position"] ** 2], tolerance["clock.offset"] ** 2,
                *spin_factor_variance(robot),
            ]
        )  # fmt: skip
        self._imu_numbers = np.array(
            [
                *(imu.position[:2] if imu else (0.0, 0.0)),
                imu.gyro_noise if imu else GYRO_NOISE,
                imu.accelerometer_noise if imu else ACCELEROMETER_NOISE,
                1.0 / (imu.rate if imu else IMU_RATE),
                GRAVITY * slope, tolerance["clock.offset"],
            ]
        )
        encoders = robot.sensors.encoders
        counts = np.array([encoders.drive_counts, encoders.steer_counts])
        per_count = math.tau * np.sum(np.abs(np.linalg.inv(robot.gear_matrix)) / counts, axis=2)
        self._standing = np.ascontiguousarray(STANDING_COUNTS * per_count)
        self._numbers = np.concatenate(
            [
                self.noise.array(),
                [
                    reach, GRAVITY * mu_p / 3.0, self.confirm.confirm_time, self.confirm.release_time,
                    self.confirm.ratio_speed, creep, self.parameters.imu_timeout, self.parameters.yield_time,
                ],
                self._imu_numbers,
                self._start_variance[[UX, GYRO_BIAS, BIAS_X]],
            ]
        )
        self._geometry = np.column_stack([robot.steer_axis, robot.caster_offset, robot.wheel_radius, self._standing])

    def initial_state(self) -> FloatArray:
        """Return the state before the first measurement."""
        state = np.zeros(_JOINTS + 6 * self.robot.n)
        state[_P:_SUMS] = np.diag(self._start_variance).ravel()
        state[_IMU_AGE] = 1e9
        return state

    def interrupted(self, state: FloatArray, gap: float) -> FloatArray:
        """Return the state after a gap [s] in everything: the pose is kept, the velocity is not known any more.

        The robot may have gone on as it went before; the motion it would have made is added to the covariance.
        """
        after = self.initial_state()
        after[: _P] = state[: _P]
        after[UX] = after[UY] = 0.0
        covariance = state[_P:_SUMS].reshape(_STATES, _STATES).copy()
        c, s = math.cos(state[YAW]), math.sin(state[YAW])
        moved = gap * np.array([c * state[UX] - s * state[UY], s * state[UX] + c * state[UY]])
        covariance[:2, :2] += np.outer(moved, moved)
        for k in (UX, UY):
            covariance[k, :] = covariance[:, k] = 0.0
            covariance[k, k] = self._start_variance[k]
        after[_P:_SUMS] = covariance.ravel()
        return after

    def without_imu(self, state: FloatArray) -> FloatArray:
        """Return the state with the pose, and nothing else of what an IMU has said that turned out to be wrong."""
        after = self.initial_state()
        after[:UX] = state[:UX]
        covariances = (after[_P:_SUMS].reshape(_STATES, _STATES), state[_P:_SUMS].reshape(_STATES, _STATES))
        covariances[0][:UX, :UX] = covariances[1][:UX, :UX]
        return after

    def predict(self, state: FloatArray, gyro: float, acceleration_x: float, acceleration_y: float, dt: float) -> FloatArray:
        """Carry the state on by one sample of the IMU.

        Args:
            state: state before.
            gyro: turning rate about z [rad/s].
            acceleration_x, acceleration_y: of the IMU, in axes of base_link [m/s^2].
            dt: measured time since the sample before [s].

        Raises:
            EstimationError: a number is not finite or dt is not positive; the caller keeps its state.
        """
        if not 0.0 < dt < math.inf:
            raise EstimationError(f"dt = {dt!r} s is not allowed; allowed: above 0 and finite, measured from stamps")
        if not math.isfinite(gyro + acceleration_x + acceleration_y):
            raise EstimationError(
                f"gyro, acceleration = {gyro!r}, {acceleration_x!r}, {acceleration_y!r} is not allowed; "
                "allowed: finite numbers"
            )
        after: FloatArray = predict_kernel(self._numbers, state, gyro, acceleration_x, acceleration_y, dt)
        return after

    def correct(
        self, state: FloatArray, joint_position: FloatArray, joint_velocity: FloatArray, dt: float, ahead: float = 0.0
    ) -> tuple[FloatArray, Motion]:
        """Compare wheels and IMU, and correct the state by the wheels that do not slip.

        Args:
            state: state before.
            joint_position: (n, 2) [rad].
            joint_velocity: (n, 2) [rad/s].
            dt: measured time since the measurement of the joints before [s]; 0 for the first one.
            ahead: time by which this measurement is later than the last IMU sample or correction, whichever is later [s]; the
                last sample is held over it.

        Raises:
            EstimationError: a measurement is not finite, or dt or ahead is negative; the caller keeps its state.
        """
        check_measurement(self.robot, joint_position, joint_velocity, dt)
        if not 0.0 <= ahead < math.inf:
            raise EstimationError(f"ahead = {ahead!r} s is not allowed; allowed: at least 0, measured from stamps")
        state, fitted, arrays, masks, verdict, all_slip, told, inertial = correct_kernel(
            self._geometry, np.ascontiguousarray(joint_position, dtype=np.float64),
            np.ascontiguousarray(joint_velocity, dtype=np.float64), float(dt), float(ahead), self._numbers, state,
        )
        covariance = state[_P:_SUMS].reshape(_STATES, _STATES)
        finding = finding_of(fitted, arrays, masks, verdict)
        return state, Motion(finding, state[:3], covariance[:3, :3], all_slip, told, inertial, float(state[GYRO_BIAS]))


def spin_factor_variance(robot: RobotDescription) -> FloatArray:
    """Return the variances of k_x, k_y and k_omega (3,) [1/m^2], [1/m^2], [1] that the robot's tolerances leave.

    With the places p_i of the wheels about their centre, off by d_i, radii off by shares rho_i, steering zeros by zeta_i, and
    all wheels of one weight:

        omega_wheels - omega = sum p_i x ((rho_i + zeta_i J) (v + omega J p_i) + omega J d_i) / sum |p_i|^2
    """
    place = robot.steer_axis - robot.steer_axis.mean(axis=0)
    square = np.sum(place**2, axis=1)
    total = float(square.sum())
    length = {name: robot.tolerance(name) for name in ("wheel_radius", "steer_axis", "caster_offset")}
    radius = length["wheel_radius"].value / (1.0 if length["wheel_radius"].relative else float(robot.wheel_radius.min()))
    axis = length["steer_axis"].value * (math.sqrt(total / robot.n) if length["steer_axis"].relative else 1.0)
    offset = length["caster_offset"].value
    offset *= float(np.abs(robot.caster_offset).max()) if length["caster_offset"].relative else 1.0
    zero = robot.tolerance("steer_zero").value
    spin: FloatArray = np.array(
        [
            np.sum((radius * place[:, 1]) ** 2 + (zero * place[:, 0]) ** 2) / total**2,
            np.sum((radius * place[:, 0]) ** 2 + (zero * place[:, 1]) ** 2) / total**2,
            radius**2 * np.sum(square**2) / total**2 + (axis**2 + offset**2) / total,
        ]
    )
    return spin


_TOLERANCES = (
    "wheel_radius", "steer_zero", "imu.gyro_bias", "imu.accelerometer_bias", "imu.scale", "imu.position", "clock.offset",
    "ground.slope",
)  # fmt: skip


# Places of the numbers that the kernels take, after the eight of the noise.
_REACH, _TRACTION, _CONFIRM, _RELEASE, _RATIO_SPEED, _CREEP, _TIMEOUT, _YIELD = 8, 9, 10, 11, 12, 13, 14, 15
_RX, _RY, _GYRO_NOISE, _ACCELEROMETER_NOISE, _PERIOD, _TILT, _LATE = 16, 17, 18, 19, 20, 21, 22
_START_SPEED, _START_GYRO, _START_BIAS = 23, 24, 25


@compiled
def covariance_of(state):  # type: ignore[no-untyped-def]
    """Return the covariance (21, 21) of the state of the filter."""
    return state[_P:_SUMS].copy().reshape((_STATES, _STATES))


@compiled
def _turning_rate(state, gyro):  # type: ignore[no-untyped-def]
    """Return the turning rate [rad/s] behind a reading of the gyro."""
    return (gyro - state[GYRO_BIAS]) * (1.0 - state[GYRO_SCALE])


@compiled
def predict_kernel(numbers, state, gyro, acceleration_x, acceleration_y, dt):  # type: ignore[no-untyped-def]
    """Return the state after a sample of the IMU."""
    after = state.copy()
    after[_LAST], after[_LAST + 1], after[_LAST + 2] = gyro, acceleration_x, acceleration_y
    # Until the wheels have said how fast the robot is there is no velocity to carry on.
    if state[_STARTED] > 0.0:
        _carry_on_by_imu(after, numbers, dt)
    for i in range(3):
        after[_SUMS + i] += after[_LAST + i]
    after[_SAMPLES] += 1.0
    after[_IMU_AGE] = 0.0
    return after


@compiled
def _carry_on_by_imu(state, numbers, dt):  # type: ignore[no-untyped-def]
    """Carry the state on in place by the last sample, which stands for the time between two of them."""
    gyro, ax, ay = state[_LAST], state[_LAST + 1], state[_LAST + 2]
    _carry_on(
        state, gyro, ax, ay, dt, numbers[_RX], numbers[_RY], numbers[_GYRO_NOISE] ** 2 * numbers[_PERIOD] * dt,
        numbers[_ACCELEROMETER_NOISE] ** 2 * numbers[_PERIOD] * dt, numbers[_TILT], True, np.zeros(3),
    )


@compiled
def _carry_on(state, gyro, ax, ay, dt, rx, ry, yaw_variance, speed_variance, tilt, by_imu, spun):  # type: ignore[no-untyped-def]
    """Carry state and covariance on by dt in place; P <- F P F^T + Q with the few entries of F that are not the identity's.

    `spun` (3,) is what a turning rate of the wheels is wrong by per k_x, k_y and k_omega.
    """
    yaw, ux, uy = state[YAW], state[UX], state[UY]
    omega = _turning_rate(state, gyro)
    vx, vy = ux + omega * ry, uy - omega * rx
    middle = yaw + 0.5 * omega * dt
    c, s = math.cos(middle), math.sin(middle)
    dx, dy = (c * vx - s * vy) * dt, (s * vx + c * vy) * dt
    state[X] += dx
    state[Y] += dy
    state[YAW] = yaw + omega * dt
    matrix = state[_P:_SUMS].reshape((_STATES, _STATES))
    f = np.zeros((5, _STATES))
    f[X, YAW], f[X, UX], f[X, UY] = -dy, c * dt, -s * dt
    f[Y, YAW], f[Y, UX], f[Y, UY] = dx, s * dt, c * dt
    if by_imu:
        tx, ty = c * state[TILT_X] + s * state[TILT_Y], c * state[TILT_Y] - s * state[TILT_X]
        state[UX] = ux + (ax - state[BIAS_X] - tx + omega * uy) * dt
        state[UY] = uy + (ay - state[BIAS_Y] - ty - omega * ux) * dt
        f[UX, YAW], f[UX, TILT_X], f[UX, TILT_Y] = -ty * dt, -c * dt, -s * dt
        f[UY, YAW], f[UY, TILT_X], f[UY, TILT_Y] = tx * dt, s * dt, -c * dt
        # A bias of the gyro moves base_link about the IMU.
        f[X, GYRO_BIAS], f[Y, GYRO_BIAS] = -(c * ry + s * rx) * dt, -(s * ry - c * rx) * dt
        # Another place of it likewise: v = u - omega x r.
        f[X, PLACE_X], f[X, PLACE_Y] = s * omega * dt, c * omega * dt
        f[Y, PLACE_X], f[Y, PLACE_Y] = -c * omega * dt, s * omega * dt
        f[UX, SCALE_X], f[UY, SCALE_Y] = -(ax - state[BIAS_X]) * dt, -(ay - state[BIAS_Y]) * dt
        f[YAW, GYRO_BIAS], f[YAW, GYRO_SCALE] = -dt, -omega * dt
        f[UX, UY], f[UX, GYRO_BIAS], f[UX, GYRO_SCALE], f[UX, BIAS_X] = omega * dt, -uy * dt, -omega * uy * dt, -dt
        f[UY, UX], f[UY, GYRO_BIAS], f[UY, GYRO_SCALE], f[UY, BIAS_Y] = -omega * dt, ux * dt, omega * ux * dt, -dt
    for i in range(3):
        f[YAW, SPIN_X + i] = -spun[i] * dt
    half = np.empty((5, _STATES))
    for i in range(5):
        for j in range(_STATES):
            total = matrix[i, j]
            for k in range(2, _STATES):
                if f[i, k] != 0.0:
                    total += f[i, k] * matrix[k, j]
            half[i, j] = total
    for i in range(5):
        for j in range(5, _STATES):
            matrix[i, j] = matrix[j, i] = half[i, j]
    for i in range(5):
        for j in range(i, 5):
            total = half[i, j]
            for k in range(2, _STATES):
                if f[j, k] != 0.0:
                    total += f[j, k] * half[i, k]
            matrix[i, j] = matrix[j, i] = total
    matrix[YAW, YAW] += yaw_variance
    matrix[UX, UX] += speed_variance
    matrix[UY, UY] += speed_variance
    matrix[GYRO_BIAS, GYRO_BIAS] += GYRO_WALK**2 * dt
    matrix[BIAS_X, BIAS_X] += ACCELEROMETER_WALK**2 * dt
    matrix[BIAS_Y, BIAS_Y] += ACCELEROMETER_WALK**2 * dt
    # Another place is tilted otherwise.
    walk = (TILT_WALK * tilt) ** 2 * math.hypot(dx, dy)
    matrix[TILT_X, TILT_X] += walk
    matrix[TILT_Y, TILT_Y] += walk


@compiled
def _learn(state, row, difference, variance):  # type: ignore[no-untyped-def]
    """Correct state and covariance in place by one number; what is not learned keeps its own variance."""
    matrix = state[_P:_SUMS].reshape((_STATES, _STATES))
    seen, gain, expected = np.zeros(_STATES), np.zeros(_STATES), variance
    for j in range(_STATES):
        if row[j] != 0.0:
            for i in range(_STATES):
                seen[i] += matrix[i, j] * row[j]
    for i in range(_STATES):
        expected += row[i] * seen[i]
    for i in range(_LEARNED):
        gain[i] = seen[i] / expected
        state[i] += gain[i] * difference
    for i in range(_STATES):
        for j in range(i, _STATES):
            matrix[i, j] += gain[i] * expected * gain[j] - gain[i] * seen[j] - seen[i] * gain[j]
            matrix[j, i] = matrix[i, j]


@compiled
def _form(matrix, left, right):  # type: ignore[no-untyped-def]
    """Return left^T P right."""
    total = 0.0
    for i in range(_STATES):
        if left[i] != 0.0:
            for j in range(_STATES):
                if right[j] != 0.0:
                    total += left[i] * matrix[i, j] * right[j]
    return total


@compiled
def _forget(matrix, k, variance):  # type: ignore[no-untyped-def]
    """Give one state a variance of its own again, in place."""
    matrix[k, :] = 0.0
    matrix[:, k] = 0.0
    matrix[k, k] = variance


@compiled
def _stands(state, geometry, position, dt):  # type: ignore[no-untyped-def]
    """Return whether the robot stands; keeps in place where its joints stood and for how long."""
    n, moved = len(geometry), state[_STARTED] == 0.0
    for i in range(n):
        for j in range(2):
            if abs(position[i, j] - state[_JOINTS + 2 * i + j]) > geometry[i, 5 + j]:
                moved = True
    state[_STANDING] = 0.0 if moved else state[_STANDING] + dt
    if moved:
        for i in range(n):
            for j in range(2):
                state[_JOINTS + 2 * i + j] = position[i, j]
    return state[_STANDING] >= STANDING_TIME


@compiled
def _principal_axes(of_good, of_all):  # type: ignore[no-untyped-def]
    """Return for both principal axes of a velocity's covariance: direction (2), variance over that of all wheels, variance."""
    a, b, d = of_good[0, 0], of_good[0, 1], of_good[1, 1]
    angle = 0.5 * math.atan2(2.0 * b, a - d)
    axes = np.empty((2, 4))
    for k in range(2):
        c, s = math.cos(angle + 0.5 * math.pi * k), math.sin(angle + 0.5 * math.pi * k)
        variance = c * c * a + 2.0 * c * s * b + s * s * d
        nominal = c * c * of_all[0, 0] + 2.0 * c * s * of_all[0, 1] + s * s * of_all[1, 1]
        axes[k, 0], axes[k, 1], axes[k, 2], axes[k, 3] = c, s, variance / nominal, variance
    return axes


@compiled
def _known_before(state, numbers, dt, inertial, gyro_variance, omega, row_x, row_y):  # type: ignore[no-untyped-def]
    """Return the information (6,) on (v_x, v_y, reach omega) before the wheels are asked."""
    matrix = state[_P:_SUMS].reshape((_STATES, _STATES))
    reach, traction = numbers[_REACH], numbers[_TRACTION]
    spread = np.zeros((3, 3))
    spread[0, 0] = _form(matrix, row_x, row_x) + LEAST_FLOOR**2
    spread[1, 1] = _form(matrix, row_y, row_y) + LEAST_FLOOR**2
    spread[0, 1] = spread[1, 0] = _form(matrix, row_x, row_y)
    if inertial:
        turning = matrix[GYRO_BIAS, GYRO_BIAS] + gyro_variance + matrix[GYRO_SCALE, GYRO_SCALE] * omega * omega
        spread[2, 2] = reach * reach * turning + (numbers[_LATE] * traction) ** 2
    else:
        missing = (traction * min(dt, 1.0)) ** 2 + LEAST_FLOOR**2
        spread[0, 0] += missing
        spread[1, 1] += missing
        spread[2, 2] = missing
    return upper_inverse(spread)


@compiled
def correct_kernel(geometry, position, velocity, dt, ahead, numbers, before):  # type: ignore[no-untyped-def]
    """Return the state after a measurement of the joints and what it says; see `ImuSlip.correct`."""
    state, n = before.copy(), len(geometry)
    noise, reach, rx, ry = numbers[:8], numbers[_REACH], numbers[_RX], numbers[_RY]
    caster_offset, wheel_radius = geometry[:, 2:4], geometry[:, 4]
    sensed = sensed_kernel(caster_offset, wheel_radius, velocity)
    jacobian = wheel_jacobian_kernel(geometry[:, 0:2], caster_offset, position[:, STEER])
    standing = _stands(state, geometry, position, dt)
    started = state[_STARTED] > 0.0
    state[_IMU_AGE] += ahead
    inertial = state[_IMU_AGE] <= numbers[_TIMEOUT]
    if inertial and started and ahead > 0.0:
        _carry_on_by_imu(state, numbers, ahead)
    # Between two corrections the samples are averaged; a single one is noisier.
    gyro, along, across, samples = state[_LAST], state[_LAST + 1], state[_LAST + 2], state[_SAMPLES]
    if samples > 0.0:
        gyro, along, across = state[_SUMS] / samples, state[_SUMS + 1] / samples, state[_SUMS + 2] / samples
    gyro_variance = numbers[_GYRO_NOISE] ** 2 / max(samples, 1.0)
    reference = np.zeros(3)
    if started:
        reference[2] = _turning_rate(state, gyro) if inertial else state[_OMEGA]
        reference[0], reference[1] = state[UX] + reference[2] * ry, state[UY] - reference[2] * rx
    variance, white = variance_kernel(caster_offset, wheel_radius, velocity, sensed, reference[2], noise)
    offset = np.empty(2 * n)
    for k in range(2 * n):
        offset[k] = sensed[k // 2, k % 2] - (
            jacobian[k, 0] * reference[0] + jacobian[k, 1] * reference[1] + jacobian[k, 2] * reference[2]
        )
    rows = jacobian.copy()
    rows[:, 2] /= reach
    parts = parts_of_rows(rows, offset, variance)
    row_x, row_y = np.zeros(_STATES), np.zeros(_STATES)
    row_x[UX], row_x[RADIUS], row_x[HEADING] = 1.0, reference[0], -reference[1]
    row_y[UY], row_y[RADIUS], row_y[HEADING] = 1.0, reference[1], reference[0]
    if inertial:
        row_x[GYRO_BIAS], row_y[GYRO_BIAS] = -ry, rx
        # A lever arm and two clocks: what they leave between IMU and wheels while the robot turns and accelerates.
        row_x[PLACE_Y], row_y[PLACE_X] = reference[2], -reference[2]
        row_x[LATENESS], row_y[LATENESS] = along - state[BIAS_X], across - state[BIAS_Y]
    prior, cap = np.zeros(6), 1e30
    slip_cost = 0.5 * noise[7] * noise[7]
    if started:
        prior = _known_before(
            state, numbers, dt, inertial, gyro_variance, reference[2], row_x, row_y
        )
        if not inertial:
            cap = LEAP_SHARE * slip_cost
    slip_costs = np.full(2 * n, slip_cost)
    if inertial and state[_TOLD] == 0.0:
        # Nothing has held V_ext for a while, and slip that lasts comes within its gate by itself.
        for k in range(2 * n):
            if int(state[_CHOSEN]) >> k & 1:
                slip_costs[k] *= RETURN_SHARE * RETURN_SHARE
    second = 1.0  # as dear as the first: here an IMU tells the motion, too
    chosen, lead, searched, leapt = best_set(
        parts, prior, started, slip_costs, second, cap, int(state[_CHOSEN]), state[_SINCE_SEARCH], state[_LEAD]
    )
    total = sum_of(parts, chosen)
    # The gyro helps where too few wheels roll to tell the turning rate.
    spin_information = 1.0 / (reach * reach * gyro_variance + LEAST_FLOOR**2) if inertial and started else 0.0
    joined, every = total.copy(), parts[2 * n].copy()
    joined[5] += spin_information
    every[5] += spin_information
    usable, rank = is_determined(joined), is_determined(total)
    axes, told = np.zeros((2, 4)), False
    if usable:
        axes = _principal_axes(full_inverse(joined), full_inverse(every))
        told = axes[0, 2] < TOLD and axes[1, 2] < TOLD and (rank or inertial)
    all_slip = True
    for i in range(n):
        all_slip = all_slip and chosen >> 2 * i & 3 != 0
    verdict = _SLIP if chosen else _CONSISTENT
    if not inertial and (not rank or not told or leapt or lead < CLEAR_LEAD):
        verdict = _CANNOT_KNOW
    wheels = reference.copy()
    if usable:
        _, x, y, z = solve(joined, np.zeros(6), False)
        wheels += np.array([x, y, z / reach])
    if rank:
        wheels[2] = reference[2] + solve(total, np.zeros(6), False)[3] / reach
    spin_variance = full_inverse(total)[2, 2] / reach**2 if rank else (numbers[_TRACTION] / reach) ** 2
    # All wheels: what their geometry does to the turning rate is in the state; what slip is too small to be told is not.
    spun, passing = np.zeros(3), spin_variance * 2.0 * MOTION_MEMORY / max(dt, 1e-9)
    if chosen == 0 and rank and dt > 0.0:
        spun[:] = wheels
        brief = white.copy()
        for i in range(n):
            for j in range(2):
                brief[i, j] += (variance[i, j] - white[i, j]) * 2.0 * CREEP_MEMORY / dt
        passing = full_inverse(sum_of(parts_of_rows(rows, offset, brief), 0))[2, 2] / reach**2
    if not inertial and started:
        _carry_on(
            state, wheels[2] / (1.0 - state[GYRO_SCALE]) + state[GYRO_BIAS], 0.0, 0.0, dt, rx, ry, passing * dt * dt,
            (numbers[_TRACTION] * dt) ** 2, numbers[_TILT], False, spun,
        )  # fmt: skip
    if usable:
        quiet = sum_of(parts_of_rows(rows, offset, white), chosen)
        quiet[5] += spin_information
        exact, slow = full_inverse(quiet), 0.0
        if dt > 0.0 and inertial:
            crept = numbers[_CREEP] * math.hypot(along - state[BIAS_X], across - state[BIAS_Y])
            crept *= math.hypot(wheels[0], wheels[1])
            slow = 2.0 * CREEP_MEMORY / dt * crept * crept
        for k in range(2):
            c, s = axes[k, 0], axes[k, 1]
            omega = _turning_rate(state, gyro) if inertial else wheels[2]
            difference = c * (wheels[0] - state[UX] - omega * ry) + s * (wheels[1] - state[UY] + omega * rx)
            known = c * c * exact[0, 0] + 2.0 * c * s * exact[0, 1] + s * s * exact[1, 1] + slow
            if dt > 0.0:
                # Few rows, nearly alike: their errors of geometry are enlarged, and stay what they are. Else what the wheels
                # contradict changes with the motion; and a wheel that begins to slip is found before it is followed.
                known += axes[k, 3] * 2.0 * (MOTION_MEMORY if axes[k, 2] > AMPLIFIED else CREEP_MEMORY) / dt
            _learn(state, c * row_x + s * row_y, difference, known)
    if inertial and samples > 0.0 and dt > 0.0 and started:
        row = np.zeros(_STATES)
        row[GYRO_BIAS] = -1.0
        if standing and chosen == 0:
            _learn(state, row, state[GYRO_BIAS] - gyro, gyro_variance)
        elif rank:
            row[GYRO_SCALE] = -reference[2]
            row[SPIN_X : SPIN_TURN + 1] = spun
            _learn(state, row, wheels[2] - _turning_rate(state, gyro), gyro_variance + passing)
    if rank and told:
        state[_STARTED] = 1.0
    omega = _turning_rate(state, gyro) if inertial else wheels[2]
    reference[0], reference[1], reference[2] = state[UX] + omega * ry, state[UY] - omega * rx, omega
    state[_OMEGA] = omega
    matrix = state[_P:_SUMS].reshape((_STATES, _STATES))
    # Wheels that have agreed with each other for long are right.
    against = inertial and started and all_slip and solve(parts[2 * n], np.zeros(6), False)[0] < slip_cost
    state[_AGAINST] = state[_AGAINST] + dt if against else 0.0
    if state[_AGAINST] >= (min(numbers[_YIELD], STANDING_YIELD) if standing else numbers[_YIELD]):
        state[_AGAINST] = 0.0
        _forget(matrix, UX, numbers[_START_SPEED])
        _forget(matrix, UY, numbers[_START_SPEED])
        _forget(matrix, GYRO_BIAS, numbers[_START_GYRO])
        _forget(matrix, BIAS_X, numbers[_START_BIAS])
        _forget(matrix, BIAS_Y, numbers[_START_BIAS])
        _forget(matrix, TILT_X, numbers[_TILT] ** 2)
        _forget(matrix, TILT_Y, numbers[_TILT] ** 2)
    arrays, masks = np.empty((3, n, 2)), np.zeros((3, n, 2), dtype=np.bool_)
    slip, threshold = arrays[0], arrays[2]
    for k in range(2 * n):
        i, j = k // 2, k % 2
        slip[i, j] = sensed[i, j] - (
            jacobian[k, 0] * reference[0] + jacobian[k, 1] * reference[1] + jacobian[k, 2] * reference[2]
        )
        threshold[i, j] = noise[7] * math.sqrt(variance[i, j])
        masks[0, i, j] = chosen >> k & 1
    flagged = state[_JOINTS + 2 * n : _JOINTS + 4 * n].copy().reshape((n, 2))
    elapsed = state[_JOINTS + 4 * n :].copy().reshape((n, 2))
    confirm_kernel(masks[0], flagged, elapsed, dt, numbers[_CONFIRM], numbers[_RELEASE])
    describe_kernel(sensed, slip, threshold, flagged, numbers[_RATIO_SPEED], arrays[1], masks[1], masks[2])
    state[_JOINTS + 2 * n : _JOINTS + 4 * n] = flagged.ravel()
    state[_JOINTS + 4 * n :] = elapsed.ravel()
    state[_CHOSEN], state[_LEAD], state[_TOLD] = chosen, lead, 1.0 if told else 0.0
    state[_SINCE_SEARCH] = 0.0 if searched else state[_SINCE_SEARCH] + 1.0
    state[_SUMS : _SUMS + 4] = 0.0
    fitted = np.zeros((4, 3))
    fitted[0] = reference
    turning = gyro_variance + matrix[GYRO_BIAS, GYRO_BIAS] + matrix[GYRO_SCALE, GYRO_SCALE] * omega * omega
    if not inertial:
        turning = spin_variance
    # v = u - omega x r: what is wrong with omega is wrong with v.
    fitted[1, 0], fitted[2, 1] = matrix[UX, UX] + ry * ry * turning, matrix[UY, UY] + rx * rx * turning
    fitted[1, 1] = fitted[2, 0] = matrix[UX, UY] - rx * ry * turning
    fitted[1, 2] = fitted[3, 0] = ry * turning
    fitted[2, 2] = fitted[3, 1] = -rx * turning
    fitted[3, 2] = turning
    return state, fitted, arrays, masks, verdict, all_slip, told, inertial
