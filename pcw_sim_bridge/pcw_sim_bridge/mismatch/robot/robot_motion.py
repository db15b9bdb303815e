"""The motion in a robot's recording: cut at gaps, on a regular grid, filtered wide and differentiated."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import numpy as np
from scipy import signal

from pcw_description.recording import Recording
from pcw_description.robot_description import DRIVE, GRAVITY, RobotDescription

from ..readings.held_commands import held_speeds, quiet_torque
from ..readings.unresolved_motion import resolution
from ..regression.regression_problem import BoolArray, FloatArray
from ..regression.signal_filter import (
    SignalFilter,
    derivative,
    interpolated,
    uniform_segments,
    white_noise_level,
)
from .wheel_shaking import wheel_shaking

LARGEST_CUTOFF = 20.0  # [Hz]; above it structure and suspension answer
SMALLEST_CUTOFF = 3.0
# Of a recording without a balance of forces: it has what is slow to tell, and below this no manoeuvre is seen.
SMALLEST_KINEMATIC_CUTOFF = 0.5
# Effects are evaluated on signals filtered this much wider than the channels, so that they see sharp reversals.
PREFILTER_RATIO = 2.5
# Rate of the motions that the model is evaluated on, per cut-off of the wide filter: derivatives stay exact to a percent.
MOTION_OVERSAMPLING = 4.0
# The channels end at this part of the resonance of the robot on its tyres.
TYRE_MARGIN = 0.5
ALLOWED_DERIVATIVE_NOISE = 0.05
# Torques tell something where they hold so many times the power that they have in a band where there is noise only [Hz].
TORQUE_OVER_NOISE, TORQUE_NOISE_BAND = 3.0, (12.0, 40.0)
PIECE, LEAST_PIECES = 2.0, 4  # [s]; of a spectrum
LARGEST_GAP = 0.05  # [s]; of joints and IMU
LARGEST_TRACKER_GAP = 0.1  # [s]
# What a robot does between two poses so far apart [s] no curve through them tells.
SLOWEST_TRACKER = 0.6
SLOWEST_TORQUES = 15.0  # [Hz]; a force that changes faster than torques are read is balanced by none of them
SHORTEST_SEGMENT = 1.0  # [s]


@dataclasses.dataclass(frozen=True)
class LostTorque:
    """What joints lose along a motion before it reaches the ground, see `lost_torques`.

    Attributes:
        torque: that is added to theirs (T, n, 2) [N m].
        doubt: by how much it may be wrong where dry friction reverses (T, n, 2) [N m].
    """

    torque: FloatArray
    doubt: FloatArray


@dataclasses.dataclass(frozen=True)
class TorqueError:
    """What is wrong with the torques of a motion, see `torque_errors`; no lever multiplies it.

    Attributes:
        torque: the part of those reported (T, n, 2) [N m].
        wrench: on the base, by the described geometry (T, 3) [N, N, N m].
    """

    torque: FloatArray
    wrench: FloatArray


@dataclasses.dataclass(frozen=True)
class RobotMotion:
    """One contiguous piece on a regular grid after the wide filter; arrays along T.

    Attributes:
        rate: [Hz]; cutoff: of the wide filter [Hz].
        sampling: interval of joint_states [s]; resolution: of the joints' encoders (n, 2) [rad].
        position, velocity, acceleration, torque: joints (T, n, 2).
        quiet_torque: the torque without the noise of its measurement, as far as that can be had (T, n, 2); torque_rate: its
            rate.
        reported: joints of which that is a measured torque (n, 2).
        balanced_torque: the quiet torque that fits the motion as it was measured (T, n, 2), see `torque_errors`: what
            effects are functions of. What makes wheels slip is the quiet one: no balance tells which wheel a force acts at.
        loops: of drives that hold commanded speeds by loops of their own (T, n, 2, 2): what accelerates their joints [N m],
            and what would within a second if they were behind their speeds [N m s]; zero elsewhere. Where no commands were
            recorded they may be such drives, behind nobody knows what.
        imu: yaw rate and acceleration x, y (T, 3); NaN where not recorded.
        pose: of base_link by a tracker (T, 3); NaN where not recorded.
        tracked_twist: velocity of what is tracked, in its own axes (T, 3); NaN where not recorded.
        shaking: speed at which the contacts of wheels shake that the filter smooths away (T,) [m/s]; its frequency [Hz].
        swing: amplitude by which a steering swings that the filter smooths away (T,) [rad].
        lost: what joints seem to lose; None where that matters little, or nobody has looked.
        error: of the torques; None where nobody has looked.
    """

    recording: int
    rate: float
    cutoff: float
    sampling: float
    resolution: FloatArray
    time: FloatArray
    position: FloatArray
    velocity: FloatArray
    acceleration: FloatArray
    torque: FloatArray
    quiet_torque: FloatArray
    reported: BoolArray
    balanced_torque: FloatArray
    torque_rate: FloatArray
    loops: FloatArray
    imu: FloatArray
    pose: FloatArray
    tracked_twist: FloatArray
    shaking: FloatArray
    shaking_frequency: float
    swing: FloatArray
    lost: LostTorque | None = None
    error: TorqueError | None = None

    def without_lost(self) -> RobotMotion:
        """Return the motion with the torques that reach the ground."""
        if self.lost is None:
            return self
        torque, quiet = (values + self.lost.torque for values in (self.torque, self.quiet_torque))
        return dataclasses.replace(self, torque=torque, quiet_torque=quiet, lost=None)

    @property
    def yaw(self) -> FloatArray:
        """Yaw of base_link (T,) [rad]."""
        return self.pose[:, 2]


def read_motions(
    robot: RobotDescription, recording: Recording, index: int, cutoff: float, with_torque: bool, live: bool = False
) -> list[RobotMotion]:
    """Return the pieces of a recording that are long enough and whole.

    Args:
        robot: the robot that the recording was opened with.
        recording: the recording; `index` is its number.
        cutoff: of the channels' filter [Hz]; motions are filtered `PREFILTER_RATIO` times wider.
        with_torque: samples without motor torque are left out.
        live: see `quiet_torque`.
    """
    motions = []
    joints = recording.joint_states
    n = robot.n
    torque = joints.effort if joints.effort is not None else np.full_like(joints.position, np.nan)
    signals = np.concatenate([joints.position.reshape(-1, 2 * n), torque.reshape(-1, 2 * n)], axis=1)
    quiet, reported = quiet_torque(robot, recording, live) or (torque, np.ones((n, 2), dtype=bool))
    wanted, commands = held_speeds(recording), recording.joint_commands
    unknown = commands is None or (commands.effort is None and commands.velocity is None)
    speed = joints.velocity if joints.velocity is not None else np.full_like(joints.position, np.nan)
    signals = np.concatenate([signals, quiet.reshape(-1, 2 * n), speed.reshape(-1, 2 * n), wanted.reshape(-1, 2 * n)], axis=1)
    rate, pieces = uniform_segments(joints.stamp, signals, LARGEST_GAP)
    wide, steps = SignalFilter(rate, PREFILTER_RATIO * cutoff), resolution(robot, joints.position)
    step = max(1, int(rate / (MOTION_OVERSAMPLING * wide.cutoff)))
    for stamps, values in pieces:
        needed = 4 * n if with_torque else 2 * n
        finite = np.isfinite(values[:, :needed]).all(axis=1)
        for start, stop in _runs(np.asarray(finite, dtype=bool)):
            if stamps[stop - 1] - stamps[start] < SHORTEST_SEGMENT:
                continue
            sensed_there = [_measured_motion(recording, stamps[start:stop]), _tracked_pose(recording, stamps[start:stop])]
            block = np.concatenate([values[start:stop, : 4 * n], *sensed_there, values[start:stop, 4 * n :]], axis=1)
            smooth = wide.smooth(_bridged(block))
            position = smooth[:, : 2 * n].reshape(-1, n, 2)
            velocity = derivative(position, rate)
            acceleration = derivative(velocity, rate)
            loops = np.zeros((*velocity.shape, 2))
            if unknown or np.isfinite(block[:, -2 * n :]).any():
                behind = np.zeros_like(velocity) if unknown else smooth[:, -2 * n :].reshape(velocity.shape) - velocity
                loops = robot.felt_inertia[:, :, None] * np.stack([acceleration, behind], axis=3)
            torque = smooth[:, 2 * n : 4 * n].reshape(-1, n, 2)
            quiet = smooth[:, 4 * n + 6 : 6 * n + 6].reshape(-1, n, 2)
            keep = slice(None, None, step)
            others = slice(4 * n, 4 * n + 6)
            sensed = np.where(np.isfinite(block[:, others]), smooth[:, others], np.nan)
            pose = sensed[:, 3:]
            measured_torque = block[:, 2 * n : 4 * n].reshape(-1, n, 2)
            shaking = wheel_shaking(
                robot, block[:, : 2 * n].reshape(-1, n, 2), block[:, -4 * n : -2 * n].reshape(-1, n, 2), measured_torque, wide
            )
            motions.append(
                RobotMotion(
                    recording=index,
                    rate=rate / step,
                    cutoff=wide.cutoff,
                    sampling=1.0 / rate,
                    resolution=steps,
                    time=stamps[start:stop][keep].copy(),
                    position=position[keep].copy(),
                    velocity=velocity[keep].copy(),
                    acceleration=acceleration[keep].copy(),
                    torque=torque[keep].copy(),
                    quiet_torque=quiet[keep].copy(),
                    reported=reported,
                    balanced_torque=quiet[keep].copy(),
                    torque_rate=derivative(quiet, rate)[keep].copy(),
                    loops=loops[keep].copy(),
                    imu=sensed[keep, :3],
                    pose=base_pose(robot, pose[keep]),
                    tracked_twist=in_body(derivative(pose, rate), pose[:, 2])[keep].copy(),
                    shaking=shaking.speed[keep].copy(),
                    shaking_frequency=shaking.frequency,
                    swing=shaking.swing[keep].copy(),
                )
            )
    return motions


def _bridged(values: FloatArray) -> FloatArray:
    """Values (T, S) with lines over what is not finite, so that a filter does not ring at its ends; zeros where nothing is."""
    bridged = values.copy()
    rows = np.arange(len(values))
    for column in bridged.T:
        known = np.isfinite(column)
        if not known.all():
            column[:] = np.interp(rows, rows[known], column[known]) if known.any() else 0.0
    return bridged


def _measured_motion(recording: Recording, stamps: FloatArray) -> FloatArray:
    """Yaw rate and acceleration x, y of the IMU (T, 3) at stamps; NaN where none were recorded."""
    imu = recording.imu
    if imu is None or len(imu.stamp) < 2:
        return np.full((len(stamps), 3), np.nan)
    measured = np.column_stack([imu.gyro[:, 2], imu.acceleration[:, :2]])
    return interpolated(stamps, imu.stamp, measured, LARGEST_GAP)


def _tracked_pose(recording: Recording, stamps: FloatArray) -> FloatArray:
    """Tracked pose (T, 3) at stamps, its yaw without jumps; NaN where it was not recorded."""
    truth = recording.ground_truth
    if truth is None or len(truth.stamp) < 2 or seldom_tracked(recording):
        return np.full((len(stamps), 3), np.nan)
    tracked = truth.pose.copy()
    tracked[:, 2] = np.unwrap(tracked[:, 2])
    return interpolated(stamps, truth.stamp, tracked, LARGEST_TRACKER_GAP)


def seldom_tracked(recording: Recording) -> str:
    """Say that poses were recorded too seldom to be held against the wheels; "" where they were not."""
    truth = recording.ground_truth
    period = float(np.median(np.diff(truth.stamp))) if truth is not None and len(truth.stamp) > 1 else 0.0
    if period < SLOWEST_TRACKER:
        return ""
    return f"ground_truth/odom: a pose every {period:.1f} s says too little of the motion between; its channels are left out"


def seldom_read(recording: Recording) -> str:
    """Say that torques were recorded too seldom to balance what joints and chassis do between; "" where they were not."""
    stamp = recording.joint_states.stamp
    rate = 1.0 / max(float(np.median(np.diff(stamp))), 1e-9) if len(stamp) > 1 else math.inf
    if rate > SLOWEST_TORQUES or not has_torques([recording]):
        return ""
    return (
        f"joint_states: at {rate:.2g} Hz torques change unseen between readings, and what is found of forces may be that; "
        "record them at 20 Hz or more"
    )


def tracked_place(robot: RobotDescription) -> FloatArray:
    """Where what is tracked stands in base_link: x, y [m], yaw [rad]; zeros where the description does not say."""
    tracker = robot.sensors.tracker
    return np.zeros(3) if tracker is None else np.array(tracker.place)


def base_pose(robot: RobotDescription, pose: FloatArray) -> FloatArray:
    """Pose (T, 3) of base_link by that of what is tracked."""
    x, y, turned = tracked_place(robot)
    yaw = pose[:, 2] - turned
    c, s = np.cos(yaw), np.sin(yaw)
    return np.stack([pose[:, 0] - c * x + s * y, pose[:, 1] - s * x - c * y, yaw], axis=1)


def in_body(velocity: FloatArray, yaw: FloatArray) -> FloatArray:
    """Turn a velocity (T, 3) in the world into base_link."""
    c, s = np.cos(yaw), np.sin(yaw)
    along, across = c * velocity[:, 0] + s * velocity[:, 1], c * velocity[:, 1] - s * velocity[:, 0]
    return np.stack([along, across, velocity[:, 2]], axis=1)


def choose_cutoff(robot: RobotDescription, recordings: Sequence[Recording], lifted: bool = False) -> float:
    """Return the largest cut-off at which differentiated encoder noise stays small against the motion [Hz].

    White noise s of a joint angle at the rate f_s, differentiated twice and cut at f_c, has the variance
    2 s^2 (2 pi)^4 f_c^5 / (5 f_s); it may reach a part of the largest accelerations recorded.

    Nor does it reach beyond what torques tell in any of the recordings. A controller answers the noise of its encoders with
    torques, so that noise is on both sides of a balance, and where there is nothing else masses come out of it. Of wheels
    that are `lifted` off the ground no tyre gives way.
    """
    contact = robot.contact
    # Slip stiffness 2 mu_p F_z / lambda_p over the relaxation length: the spring between wheel and ground, per unit mass.
    stiffness = 2.0 * contact.mu_p * GRAVITY / (contact.lambda_p * contact.relaxation_length)
    cutoffs = [LARGEST_CUTOFF]
    if not lifted:
        cutoffs.append(TYRE_MARGIN * float(np.sqrt(stiffness)) / (2.0 * np.pi))
    for recording in recordings:
        joints = recording.joint_states
        rate = 1.0 / float(np.median(np.diff(joints.stamp)))
        cutoffs += [rate / 8.0, _torque_band(joints.effort, rate)]
        slow = SignalFilter(rate, min(5.0, rate / 8.0))
        for i in range(robot.n):
            angle = joints.position[:, i, DRIVE]
            usable = np.isfinite(angle)
            if usable.sum() < 4 * slow.settling:
                continue
            angle = angle[usable]
            noise = white_noise_level(angle)
            acceleration = derivative(derivative(slow.smooth(angle), rate), rate)[
                slow.settling : -slow.settling
            ]
            allowed = ALLOWED_DERIVATIVE_NOISE * max(float(np.std(acceleration)), 1e-3)
            if noise > 0.0:
                cutoffs.append((allowed**2 * 5.0 * rate / (2.0 * noise**2 * (2.0 * np.pi) ** 4)) ** 0.2)
    return max(min(cutoffs), SMALLEST_CUTOFF if has_balance(robot, recordings) else SMALLEST_KINEMATIC_CUTOFF)


def _torque_band(torque: FloatArray | None, rate: float) -> float:
    """Highest frequency at which some joint's torque (T, n, 2) holds more than its noise [Hz]; without bound where none tells.

    Noise is what it holds between frequencies that a robot on casters hardly moves at. By medians of short pieces: a caster
    that flips now and then makes no band.
    """
    low, high = TORQUE_NOISE_BAND
    if torque is None or rate < 4.0 * low:
        return math.inf
    found = []
    for values in torque.reshape(len(torque), -1).T:
        values = values[np.isfinite(values)]
        if len(values) < LEAST_PIECES * PIECE * rate or np.ptp(values) == 0.0:
            continue
        frequency, power = signal.welch(values, rate, nperseg=round(PIECE * rate), average="median")
        noise = float(np.median(power[(frequency >= low) & (frequency <= min(high, 0.4 * rate))]))
        above = power > TORQUE_OVER_NOISE * noise
        told = frequency[:-1][above[:-1] & above[1:] & (frequency[1:] < low)]
        highest = float(told.max(initial=0.0))
        found.append(math.inf if highest >= low - 2.0 / PIECE else highest)
    return max(found, default=math.inf)


def has_torques(recordings: Sequence[Recording]) -> bool:
    """Whether torques were recorded, of all joints and in all of them: with one unknown no forces balance."""
    return all(bool(np.isfinite(recording.joint_states.effort).any(axis=0).all()) for recording in recordings)


def has_balance(robot: RobotDescription, recordings: Sequence[Recording]) -> bool:
    """Whether forces can be balanced: torques were recorded, all casters have an offset, and no fixed wheel carries a part."""
    return has_torques(recordings) and not robot.fixed_wheels and bool(np.all(np.abs(robot.caster_offset[:, 0]) > 1e-3))


def _runs(flags: BoolArray) -> list[tuple[int, int]]:
    """Start and stop of every run of true values."""
    edges = np.flatnonzero(np.diff(np.r_[False, flags, False].astype(np.int8)))
    return [(int(a), int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True)]
