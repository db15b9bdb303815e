"""Both odometries of section 3.2.3: by the displacement model (3.31)-(3.32) and by the differential model (3.33).

The covariance follows from the redundant residual e = (I - A A^+) B dq of the wheels, 2n - 3 numbers per update. A joint
angle read with an error puts that error into one increment and takes it out of the next, so it never adds up; slip does:

    e_k = (w_k - w_(k-1)) + s_k        w: measurement, s: slip, both per wheel-centre component [m]

The mean of e^2 cannot tell them apart. Its spectral density at zero frequency can, since differences have none there: e
smoothed over `drift_memory` updates gives the variance q of slip per update, correlated slip included, and what is left of
the mean of e^2 is twice the variance of the measurement. With N = (A^T A)^-1, turned into odom,

    pose covariance = sum q N  +  var(w) (N at the start + N now).

Only slip on which the wheels disagree is seen; a scale error common to all wheels is not. One steered wheel and one fixed
axle cannot disagree: the covariance is then that of the encoders' counts alone, and no slip is in it.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from .compiled import compiled
from .differential_kinematics import forward_kinematics_kernel, guided_kinematics_kernel
from .displacement_kinematics import forward_displacement_kernel
from .errors import KinematicsError
from .robot_description import STEER, FloatArray, RobotDescription

METHODS = ("differential", "displacement")
# Updates until slip can be told from measurement noise: smoothing over fewer leaves a tenth of the noise and more.
WARM_UP = 50

# Layout of the state of the noise, one array because a control loop passes it on every cycle:
# number of updates in which a joint moved; averaged squared residual and averaged variance of slip per component, of one
# update [m^2]; variances (once, both, twice) of the smoothed residuals that white slip of unit variance would have;
# part of the pose covariance that slip has added up (3, 3); covariance of the pose for a unit variance of the first
# measurement (3, 3); then the residual smoothed once (n, 2) and twice (n, 2) [m].
UPDATES, RESIDUAL_VARIANCE, SLIP_VARIANCE, ONCE, BOTH, TWICE, SLIP_COVARIANCE, START_COVARIANCE = 0, 1, 2, 3, 4, 5, 6, 15
NOISE_SIZE = 24


@dataclasses.dataclass(frozen=True)
class OdometryParameters:
    """How odometry is computed.

    Attributes:
        method: "differential" (3.33) or "displacement" (3.31).
        residual_memory: number of updates over which the squared residual is averaged.
        drift_memory: number of updates over which the residual is smoothed to tell slip from measurement noise. Slip that
            stays alike for longer is taken for less than it is.
    """

    method: str = "differential"
    residual_memory: float = 50.0
    drift_memory: float = 250.0

    def __post_init__(self) -> None:
        """Check the parameters.

        Raises:
            KinematicsError: unknown method, or a memory that is too short or infinite.
        """
        if self.method not in METHODS:
            raise KinematicsError(f"odometry method {self.method!r} is not allowed; allowed: {', '.join(METHODS)}")
        for name, memory, least in (("residual_memory", self.residual_memory, 1), ("drift_memory", self.drift_memory, 2)):
            if not least <= memory < math.inf:
                allowed = f"a finite number of updates, at least {least}"
                raise KinematicsError(f"{name} {memory!r} is not allowed; allowed: {allowed}")


@dataclasses.dataclass(frozen=True)
class OdometryState:
    """State of the odometry.

    Attributes:
        joint_position: last joint angles (n, 2) [rad]; None before the first measurement.
        pose: pose of base_link in odom (x, y, yaw) [m, m, rad].
        pose_covariance: covariance of the pose in odom (3, 3).
        noise: what is known of the noise, (NOISE_SIZE + 4n,); see the layout above.
        origin: pose (3,) and its covariance (3, 3) where this run of measurements began; None for a sure one.
    """

    joint_position: FloatArray | None
    pose: FloatArray
    pose_covariance: FloatArray
    noise: FloatArray
    origin: tuple[FloatArray, FloatArray] | None = None


@dataclasses.dataclass(frozen=True)
class OdometryOutput:
    """What one update gives.

    Attributes:
        twist: twist of base_link in base_link (3,), mean over the sample.
        twist_covariance: its covariance (3, 3), from the redundant residual.
        slip: joint-consistency residual of the sample (n, 2) [m/s].
    """

    twist: FloatArray
    twist_covariance: FloatArray
    slip: FloatArray


def initial_state(pose: FloatArray | None = None) -> OdometryState:
    """Return the state before the first measurement, at a known pose or the origin."""
    start = np.zeros(3) if pose is None else np.array(pose, dtype=float)
    return OdometryState(None, start, np.zeros((3, 3)), np.zeros(NOISE_SIZE))


def interrupted(state: OdometryState, unseen: FloatArray | None = None) -> OdometryState:
    """Return the state after measurements were missing: the pose is kept, and what is not known of it grows.

    Args:
        state: state after the last measurement.
        unseen: motion (3,) [m, m, rad] in base_link that may have happened unseen, as a standard deviation; None for none.
    """
    covariance = state.pose_covariance
    if unseen is not None:
        c, s = math.cos(state.pose[2]), math.sin(state.pose[2])
        covariance = covariance + _turned(np.diag(np.asarray(unseen, dtype=np.float64) ** 2), c, s)
    return OdometryState(None, state.pose, covariance, np.zeros(NOISE_SIZE))


@compiled
def _carried(covariance, dx, dy):  # type: ignore[no-untyped-def]
    """Return F P F^T, the covariance (3, 3) of a pose after a move by (dx, dy): F = [[1, 0, -dy], [0, 1, dx], [0, 0, 1]]."""
    xx, xy, xt = covariance[0, 0], covariance[0, 1], covariance[0, 2]
    yy, yt, tt = covariance[1, 1], covariance[1, 2], covariance[2, 2]
    carried = np.empty((3, 3))
    carried[0, 0] = xx - 2.0 * dy * xt + dy * dy * tt
    carried[1, 1] = yy + 2.0 * dx * yt + dx * dx * tt
    carried[2, 2] = tt
    carried[0, 1] = carried[1, 0] = xy + dx * xt - dy * yt - dx * dy * tt
    carried[0, 2] = carried[2, 0] = xt - dy * tt
    carried[1, 2] = carried[2, 1] = yt + dx * tt
    return carried


@compiled
def _turned(covariance, c, s):  # type: ignore[no-untyped-def]
    """Return the covariance (3, 3) of a body increment in a frame turned by the angle of cosine c and sine s."""
    xx, xy, xt = covariance[0, 0], covariance[0, 1], covariance[0, 2]
    yy, yt = covariance[1, 1], covariance[1, 2]
    turned = np.empty((3, 3))
    turned[0, 0] = c * c * xx - 2.0 * c * s * xy + s * s * yy
    turned[1, 1] = s * s * xx + 2.0 * c * s * xy + c * c * yy
    turned[2, 2] = covariance[2, 2]
    turned[0, 1] = turned[1, 0] = c * s * (xx - yy) + (c * c - s * s) * xy
    turned[0, 2] = turned[2, 0] = c * xt - s * yt
    turned[1, 2] = turned[2, 1] = s * xt + c * yt
    return turned


@compiled
def _differential_update(steer_axis, caster_offset, wheel_radius, before, after, pose, residual_memory, drift_memory, noise):  # type: ignore[no-untyped-def]
    """One update by (3.33), in one compiled call because a control loop runs it every cycle."""
    step = after - before
    increment, residual, normal_inverse = forward_kinematics_kernel(
        steer_axis, caster_offset, wheel_radius, before[:, STEER] + 0.5 * step[:, STEER], step
    )
    return _finish_update(increment, residual, normal_inverse, step, pose, residual_memory, drift_memory, noise)


@compiled
def _guided_update(  # type: ignore[no-untyped-def]
    steer_axis, caster_offset, wheel_radius, axle, before, after, pose, residual_memory, drift_memory, noise, least_variance
):
    """One update by (3.33) of a robot with fixed axles (k, 3).

    Where nothing is redundant, `least_variance` stands for that of a wheel-centre component [m^2].
    """
    step = after - before
    increment, residual, normal_inverse = guided_kinematics_kernel(
        steer_axis, caster_offset, wheel_radius, axle, before[:, STEER] + 0.5 * step[:, STEER], step
    )
    if 2 * len(step) + len(axle) <= 3:
        noise = noise.copy()
        noise[RESIDUAL_VARIANCE] = 2.0 * least_variance
    increment, covariance, residual, moved, pose_covariance, noise = _finish_update(
        increment, residual, normal_inverse, step, pose, residual_memory, drift_memory, noise
    )
    return increment, covariance, residual[: len(step)].copy(), moved, pose_covariance, noise


@compiled
def _displacement_one_way(steer_axis, caster_offset, wheel_radius, steer_angle, step):  # type: ignore[no-untyped-def]
    """Return the body increment (3,) of (3.31) and its residual in the wheel frames; the logarithm of the displacement."""
    end, residual = forward_displacement_kernel(steer_axis, caster_offset, wheel_radius, steer_angle, step)
    angle = end[2]
    half = 0.5 * angle
    scale = 1.0 - half * half / 3.0 if abs(angle) < 1e-4 else half / math.tan(half)
    increment = np.empty(3)
    increment[0] = scale * end[0] + half * end[1]
    increment[1] = -half * end[0] + scale * end[1]
    increment[2] = angle
    for i in range(len(steer_angle)):
        c, s = math.cos(steer_angle[i]), math.sin(steer_angle[i])
        x, y = residual[i, 0], residual[i, 1]
        residual[i, 0], residual[i, 1] = c * x + s * y, -s * x + c * y
    return increment, residual


@compiled
def _displacement_update(steer_axis, caster_offset, wheel_radius, before, after, pose, residual_memory, drift_memory, noise):  # type: ignore[no-untyped-def]
    """One update by (3.31), from the beginning to the end of the sample and back.

    In (3.7) a wheel first turns over ground and then rolls, all along its last heading; one way alone is of first order.
    The way back rolls along the first heading, and the mean of both is of second order.
    """
    step = after - before
    there, residual = _displacement_one_way(steer_axis, caster_offset, wheel_radius, before[:, STEER].copy(), step)
    back, residual_back = _displacement_one_way(steer_axis, caster_offset, wheel_radius, after[:, STEER].copy(), -step)
    _, _, normal_inverse = forward_kinematics_kernel(
        steer_axis, caster_offset, wheel_radius, before[:, STEER] + 0.5 * step[:, STEER], step
    )
    increment, residual = 0.5 * (there - back), 0.5 * (residual - residual_back)
    return _finish_update(increment, residual, normal_inverse, step, pose, residual_memory, drift_memory, noise)


@compiled
def _finish_update(increment, residual, normal_inverse, step, pose, residual_memory, drift_memory, noise):  # type: ignore[no-untyped-def]
    """Return the increment, its covariance, the residual, the new pose, its covariance, and the new state of the noise."""
    angle = increment[2]
    # The exponential map of SE(2): a chord of length sinc(angle / 2) |increment|, turned by half the angle.
    sinc = 1.0 - angle * angle / 24.0 if abs(angle) < 1e-4 else math.sin(0.5 * angle) / (0.5 * angle)
    c, s = math.cos(pose[2] + 0.5 * angle), math.sin(pose[2] + 0.5 * angle)
    dx, dy = sinc * (c * increment[0] - s * increment[1]), sinc * (s * increment[0] + c * increment[1])
    moved = np.array([pose[0] + dx, pose[1] + dy, pose[2] + angle])
    now = _turned(normal_inverse, c, s)
    noise = noise.copy()
    any_moved = False
    for i in range(len(step)):
        any_moved = any_moved or step[i, 0] != 0.0 or step[i, 1] != 0.0
    # A sample in which no joint moved tells nothing about noise.
    if any_moved:
        _learn_noise(residual, len(step), now, dx, dy, residual_memory, drift_memory, noise)
    slip_covariance = noise[SLIP_COVARIANCE : SLIP_COVARIANCE + 9].reshape((3, 3))
    if noise[UPDATES] < WARM_UP:
        covariance = noise[RESIDUAL_VARIANCE] * slip_covariance  # the careful assumption: all of it is slip
    else:
        start_covariance = noise[START_COVARIANCE : START_COVARIANCE + 9].reshape((3, 3))
        measurement_variance = 0.5 * max(noise[RESIDUAL_VARIANCE] - noise[SLIP_VARIANCE], 0.0)
        covariance = slip_covariance + measurement_variance * (start_covariance + now)
    return increment, noise[RESIDUAL_VARIANCE] * normal_inverse, residual, moved, covariance, noise


@compiled
def _learn_noise(residual, casters, now, dx, dy, residual_memory, drift_memory, noise):  # type: ignore[no-untyped-def]
    """Advance the state of the noise in place by one update that moved base_link by (dx, dy) in odom.

    residual: of the casters, then of fixed axles, each of which has a lateral part alone.
    """
    n = len(residual)
    noise[UPDATES] += 1.0
    updates = noise[UPDATES]
    once = noise[NOISE_SIZE : NOISE_SIZE + 2 * n]
    twice = noise[NOISE_SIZE + 2 * n : NOISE_SIZE + 4 * n]
    # The first updates are weighted alike; then the gain of one over the memory forgets them.
    gain = max(1.0 / updates, 1.0 / drift_memory)
    keep = 1.0 - gain
    unit_once, unit_both = noise[ONCE] + 1.0, noise[BOTH]
    noise[TWICE] = keep * keep * (noise[TWICE] + 2.0 * gain * unit_both + gain * gain * unit_once)
    noise[BOTH] = keep * keep * (unit_both + gain * unit_once)
    noise[ONCE] = keep * keep * unit_once
    squared, squared_twice = 0.0, 0.0
    for i in range(n):
        for j in range(2):
            level = once[2 * i + j] + residual[i, j]
            twice[2 * i + j] = keep * (twice[2 * i + j] + gain * level)
            once[2 * i + j] = keep * level
            squared += residual[i, j] * residual[i, j]
            squared_twice += twice[2 * i + j] * twice[2 * i + j]
    # 2 velocities of every caster, one of every axle, 3 estimated: the rest of the freedom tells the noise.
    freedom = n + casters - 3
    fresh = 0.0
    if freedom > 0:
        fresh = squared_twice / (freedom * noise[TWICE]) if updates > 1.0 else 0.0
        weight = max(1.0 / updates, 1.0 / residual_memory)
        noise[RESIDUAL_VARIANCE] += weight * (squared / freedom - noise[RESIDUAL_VARIANCE])
        noise[SLIP_VARIANCE] += weight * (fresh - noise[SLIP_VARIANCE])
    slip_covariance = noise[SLIP_COVARIANCE : SLIP_COVARIANCE + 9].reshape((3, 3))
    start_covariance = noise[START_COVARIANCE : START_COVARIANCE + 9].reshape((3, 3))
    grown = _carried(slip_covariance, dx, dy)
    if updates < WARM_UP:
        slip_covariance[:] = grown + now  # of unit variance, until there is an estimate of it
    elif updates == WARM_UP:
        slip_covariance[:] = fresh * (grown + now)
    else:
        slip_covariance[:] = grown + fresh * now
    start_covariance[:] = now if updates == 1.0 else _carried(start_covariance, dx, dy)


def update(
    robot: RobotDescription,
    parameters: OdometryParameters,
    state: OdometryState,
    joint_position: FloatArray,
    dt: float,
) -> tuple[OdometryState, OdometryOutput]:
    """Advance the odometry by one measurement, (3.29)-(3.33).

    The differential model is taken at the middle of the sample and the displacement model both ways, which makes either
    second-order accurate. The covariances
    follow from the redundant residual (see the module's docstring): nothing is typed in.

    Args:
        robot: the robot.
        parameters: method and averaging.
        state: state after the previous measurement.
        joint_position: joint angles (n, 2) [rad], continuous (not wrapped).
        dt: measured time since the previous measurement [s].

    Returns:
        New state and output. The first measurement only stores the angles and gives a zero twist.

    Raises:
        KinematicsError: dt is not positive, the angles are not finite or not of shape (n, 2), or the displacement method is
            asked for with fixed wheels; the caller keeps its state.
    """
    # One memory layout: another one would compile the kernels anew in the middle of a run.
    joint_position = np.array(joint_position, dtype=np.float64, order="C")
    if joint_position.shape != (robot.n, 2):
        raise KinematicsError(
            f"joint_position has the shape {joint_position.shape}; allowed: ({robot.n}, 2), drive and steer per caster"
        )
    if not np.isfinite(joint_position).all():
        raise KinematicsError("joint_position holds NaN or infinity; allowed: finite angles in rad")
    if state.joint_position is None:
        origin = (state.pose, state.pose_covariance) if state.pose_covariance.any() else None
        noise = np.zeros(NOISE_SIZE + 4 * (robot.n + len(robot.fixed_axle)))
        first = OdometryState(joint_position, state.pose, state.pose_covariance, noise, origin)
        return first, OdometryOutput(np.zeros(3), np.zeros((3, 3)), np.zeros((robot.n, 2)))
    if not 0.0 < dt < math.inf:
        raise KinematicsError(f"dt = {dt!r} s is not allowed; allowed: above 0 and finite, measured from stamps")
    memories = float(parameters.residual_memory), float(parameters.drift_memory)
    if robot.fixed_wheels:
        if parameters.method != "differential":
            robot.require_casters_only(f"odometry by the {parameters.method} model")
        increment, increment_covariance, residual, pose, covariance, noise = _guided_update(
            robot.steer_axis, robot.caster_offset, robot.wheel_radius, robot.fixed_axle, state.joint_position, joint_position,
            state.pose, *memories, state.noise, _resolution(robot),
        )
    else:
        advance = _differential_update if parameters.method == "differential" else _displacement_update
        increment, increment_covariance, residual, pose, covariance, noise = advance(
            robot.steer_axis, robot.caster_offset, robot.wheel_radius, state.joint_position, joint_position, state.pose,
            *memories, state.noise,
        )
    output = OdometryOutput(increment / dt, increment_covariance / dt**2, residual / dt)
    if state.origin is not None:
        start, start_covariance = state.origin
        covariance = covariance + _carried(start_covariance, pose[0] - start[0], pose[1] - start[1])
    return OdometryState(joint_position, pose, covariance, noise, state.origin), output


def _resolution(robot: RobotDescription) -> float:
    """Variance of the way that a wheel rolled, as its encoder's counts give it; the largest of all wheels [m^2]."""
    counts = robot.sensors.encoders.drive_counts * np.abs([caster.gears.drive for caster in robot.casters])
    return float(np.max((math.tau * robot.wheel_radius / np.maximum(counts, 1.0)) ** 2)) / 12.0
