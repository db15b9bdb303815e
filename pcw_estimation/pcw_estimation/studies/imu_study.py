"""What encoders and IMU find together: Fig. 4.2 of the thesis, where all wheels slip, and the odometry on 100 m."""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from pcw_description import odometry
from pcw_description.compiled import compiled
from pcw_description.robot_description import RobotDescription
from pcw_description.robot_file import load_robot

from .. import imu_slip
from ..imu_slip import ImuSlip
from .drawn_drives import STEP, Drive, DriveStyle, FloatArray, drive
from .encoder_study import with_imu_at_1_khz

_predict, _correct, _covariance = imu_slip.predict_kernel, imu_slip.correct_kernel, imu_slip.covariance_of


@dataclasses.dataclass(frozen=True)
class Followed:
    """What the filter says along a drive.

    Attributes:
        flagged: (T, n, 2).
        all_slip: (T,).
        slip: (T, n, 2) [m/s].
        twist: (T, 3).
        pose: (T, 3).
        pose_covariance: (T, 3, 3).
    """

    flagged: np.ndarray
    all_slip: np.ndarray
    slip: FloatArray
    twist: FloatArray
    pose: FloatArray
    pose_covariance: FloatArray


def follow(driven: Drive) -> Followed:
    """Run the filter along a drive; compiled, and the same as `predict` and `correct` in a loop."""
    slip_filter = ImuSlip(driven.robot)
    every = round(float(driven.stamp[1] - driven.stamp[0]) / STEP)
    return Followed(
        *_along(
            slip_filter._geometry, driven.position, driven.velocity, every, driven.gyro, driven.accelerometer,
            slip_filter._numbers, slip_filter.initial_state(),
        )
    )  # fmt: skip


@compiled
def _along(geometry, position, velocity, every, gyro, accelerometer, numbers, state):  # type: ignore[no-untyped-def]
    flagged, all_slips = np.zeros(position.shape, dtype=np.bool_), np.zeros(len(position), dtype=np.bool_)
    slips, twists = np.empty(position.shape), np.empty((len(position), 3))
    poses, covariances = np.empty((len(position), 3)), np.empty((len(position), 3, 3))
    sample = 0
    for k in range(len(position)):
        while sample <= k * every:
            state = _predict(numbers, state, gyro[sample], accelerometer[sample, 0], accelerometer[sample, 1], STEP)
            sample += 1
        state, fitted, arrays, masks, _, all_slips[k], _, _ = _correct(
            geometry, position[k], velocity[k], every * STEP if k else 0.0, 0.0, numbers, state
        )
        flagged[k], slips[k], twists[k] = masks[1] | masks[2], arrays[0], fitted[0]
        poses[k] = state[:3]
        covariances[k] = _covariance(state)[:3, :3]
    return flagged, all_slips, slips, twists, poses, covariances


# --- Fig. 4.2 -------------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class AllSlip:
    """A drive on which all wheels slip between two times [s]."""

    driven: Drive
    start: float
    end: float


def all_wheels_slip(seed: int, robot: RobotDescription | None = None) -> AllSlip:
    """Return a drive as in Fig. 4.2: all wheels of the thesis robot slip together, drawn in size, kind and onset.

    One in three: all run ahead or lag by the same share of their speed; one in three: all by the same velocity in the
    direction of travel; one in three: each by a share of its own.
    """
    rng = np.random.default_rng(seed)
    robot = robot or with_imu_at_1_khz(load_robot("thesis"))
    start = rng.uniform(3.0, 4.0)
    end = start + rng.uniform(0.5, 1.5)
    steps = round(6.0 / STEP)
    time = STEP * np.arange(steps)
    direction, speed = rng.uniform(-math.pi, math.pi), rng.uniform(0.3, 1.0)
    wanted = np.array([speed * math.cos(direction), speed * math.sin(direction), rng.uniform(-0.6, 0.6)])
    twist = wanted * np.clip((time - 1.0) / rng.uniform(0.8, 1.6), 0.0, 1.0)[:, None]
    ramp = np.clip(np.minimum((time - start) / rng.uniform(0.01, 0.05), (end - time) / 0.03), 0.0, 1.0)
    kind = seed % 3
    if kind == 2:
        share = rng.uniform(0.15, 0.6, robot.n) * rng.choice([-1.0, 1.0])
    else:
        share = np.full(robot.n, rng.uniform(0.15, 0.6) * rng.choice([-1.0, 1.0]))
    # Rolling wheels that trail: their velocity is the chassis's at their place, and they slip along it.
    rolled = drive(robot, twist, np.zeros((steps, robot.n, 2)), np.random.default_rng(seed), imu_bias=True)
    every = round(float(rolled.stamp[1] - rolled.stamp[0]) / STEP)
    heading = np.repeat(rolled.position[:, :, 1], every, axis=0)[:steps]
    axis = robot.steer_axis
    vx, vy = twist[:, None, 0] - twist[:, None, 2] * axis[:, 1], twist[:, None, 1] + twist[:, None, 2] * axis[:, 0]
    along = np.cos(heading) * vx + np.sin(heading) * vy
    slip = np.zeros((steps, robot.n, 2))
    if kind == 1:
        slip[:, :, 0] = share * speed * np.sign(along) * ramp[:, None]
    else:
        slip[:, :, 0] = share * along * ramp[:, None]
    return AllSlip(drive(robot, twist, slip, np.random.default_rng(seed)), start, end)


def found_after(case: AllSlip) -> float:
    """Return after which time [s] the filter says that all wheels slip; infinity if never, -1 if before."""
    followed = follow(case.driven)
    stamp = case.driven.stamp
    all_flagged = np.all(np.any(followed.flagged, axis=2), axis=1)
    if all_flagged[stamp < case.start].any():
        return -1.0
    during = np.flatnonzero(all_flagged & (stamp < case.end))
    return float(stamp[during[0]] - case.start) if len(during) else math.inf


# --- 100 m ----------------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class LongDrive:
    """End errors of one drive of 100 m.

    Attributes:
        plain: distance from the true place, pseudo-inverse odometry [m].
        fused: the same with the wheels that slip left out and the IMU [m].
        nees: normalised squared error of the fused pose at the end, 3 degrees of freedom.
        on_patches: share of the path on slippery ground.
    """

    plain: float
    fused: float
    nees: float
    on_patches: float


def hundred_metres(seed: int, distance: float = 100.0) -> LongDrive:
    """Drive a path of 100 m over slippery patches and compare both odometries with the truth at its end.

    About an eighth of the path is slippery, in patches of 0.3 to 1.5 m on which a wheel runs ahead or lags by 10 to 60 %; of
    the longer ones all wheels are on at once.
    """
    rng = np.random.default_rng(seed)
    robot = with_imu_at_1_khz(load_robot("thesis"))
    twist = drawn_path(rng, distance)
    driven_length = STEP * np.cumsum(np.hypot(twist[:, 0], twist[:, 1]))
    slip, share = _patches(rng, robot, twist, driven_length, distance)
    driven = drive(robot, twist, slip, rng)
    followed = follow(driven)
    state, parameters = odometry.initial_state(), odometry.OdometryParameters()
    dt = float(driven.stamp[1] - driven.stamp[0])
    for position in driven.position:
        state, _ = odometry.update(robot, parameters, state, position, dt)
    error = followed.pose[-1] - driven.pose[-1]
    error[2] = math.remainder(error[2], math.tau)
    nees = float(error @ np.linalg.solve(followed.pose_covariance[-1], error))
    plain = float(np.hypot(*(state.pose - driven.pose[-1])[:2]))
    return LongDrive(plain, float(np.hypot(*error[:2])), nees, share)


def drawn_path(rng: np.random.Generator, distance: float) -> FloatArray:
    """Return a drawn twist (S, 3) that covers a distance [m], with two seconds of standstill first."""
    from .drawn_drives import drawn_twist

    style = DriveStyle(speed=1.0, turning=0.5, acceleration=0.8, hold=(2.0, 6.0), rest=2.0)
    twist = drawn_twist(rng, 6.0 * distance, style)
    length = STEP * np.cumsum(np.hypot(twist[:, 0], twist[:, 1]))
    return twist[: int(np.searchsorted(length, distance))]


def _patches(
    rng: np.random.Generator, robot: RobotDescription, twist: FloatArray, length: FloatArray, distance: float
) -> tuple[FloatArray, float]:
    """Return the slip (S, n, 2) of wheels on slippery bands across the path, and the share of the path that they make."""
    speed = np.maximum(np.hypot(twist[:, 0], twist[:, 1]), 1e-6)
    slip, covered, place = np.zeros((len(twist), robot.n, 2)), 0.0, 3.0
    centre = (twist[:, :2] / speed[:, None]) @ robot.steer_axis.T  # of each wheel ahead of the robot's centre
    reached = length[:, None] + centre
    while place < distance - 3.0:
        size, share = rng.uniform(0.3, 1.5), rng.uniform(0.1, 0.6) * rng.choice([-1.0, 1.0])
        depth = np.minimum(reached - place, place + size - reached)
        slip[:, :, 0] += share * np.clip(depth / 0.02, 0.0, 1.0) * speed[:, None] * (speed[:, None] > 0.05)
        covered += size
        place += size + rng.uniform(2.0, 10.0)
    return slip, covered / distance
