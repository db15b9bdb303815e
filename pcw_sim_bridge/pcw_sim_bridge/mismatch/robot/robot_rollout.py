"""Forward simulation of a robot over windows of its recordings, by the reduced plant under the measured torques."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np

from pcw_description.contact.contact_model import LENGTH
from pcw_description.effects.kinds import ActuatorEffect, EncoderEffect
from pcw_description.effects.registry import get
from pcw_description.recording import Recording
from pcw_description.robot_description import AXIS_NAMES, DRIVE, STEER, RobotDescription

from ...plants.reduced import ReducedPlant, WindowStarts
from ...plants.true_robot import as_it_really_is
from ..all_cores import on_all_cores
from ..regression.regression_problem import FloatArray, IntArray
from ..regression.signal_filter import SignalFilter, derivative, white_noise_level
from ..rollout import HORIZONS, Windows, rows_of, window_rows
from .robot_channels import STILL_SPEED, sliding
from .robot_effects import ChannelModel, true_motion, with_pose
from .robot_motion import LARGEST_CUTOFF, RobotMotion, read_motions
from .rolling_model import (
    ChannelLayout,
    ModelNumbers,
    rigid_motions,
    rolling_state,
    slip_ratios,
    slips_of_ratios,
    twists,
    weights_on_steerings,
)

SIGNALS = ("v_x", "v_y", "omega", "drive_velocity", "steer_velocity", "x", "y", "yaw")
STEP = 1e-3  # [s], at most
# Before a window begins, gears wind up and actuators fill their memories for so long [s]. By then joints would be elsewhere
# than they were measured.
LEAD = 0.5
SETTINGS = 5  # times in the lead that the motion is set as it was measured
FASTEST_SLIP = 15.0  # [Hz]; what forces do faster is more noise of torques and accelerations than slip of tyres
CUTOFF_SHARE = 8.0  # sampling rate over the largest cut-off; motions and torques shall be as sharp as they can be
NOISE_SAMPLES = 8000  # of a signal that its noise is taken from


@dataclasses.dataclass(frozen=True)
class RobotPart:
    """Windows in one contiguous piece of a recording.

    Attributes:
        numbers: of the nominal robot, by which joint rates are put together to a twist, measured and simulated ones alike.
        motion: the piece; path: pose of base_link along it (T, 3), tracked, or dead reckoned by the wheels.
        starts: first row of each window after its lead (W,); marks: rows of the horizons in a window.
        tracked: whether the path is measured.
        noise: deviations of the white noise of joint angles and torques as recorded (n, 2) each, and of the path (3,).
        lifted: the wheels are off the ground: joints move, and nothing else.
    """

    numbers: ModelNumbers
    motion: RobotMotion
    path: FloatArray
    starts: IntArray
    marks: list[int]
    tracked: bool
    noise: tuple[FloatArray, FloatArray, FloatArray]
    lifted: bool = False

    @property
    def lead(self) -> int:
        """Rows of the lead."""
        return max(1, round(LEAD * self.motion.rate))

    def ends(self) -> tuple[IntArray, FloatArray]:
        """Rows at the horizons (W, H), and 1, or NaN where the piece ends before."""
        return rows_of(self.starts, self.marks, len(self.motion.time))


@dataclasses.dataclass(frozen=True)
class Undescribed:
    """Re-tuned numbers that no description holds; see `ModelNumbers`.

    Attributes:
        unreported: of the torques of all joints (n, 2, 2), or of those of all drives and all steerings (2, 2).
        torque_lag: [s].
        lean, detuning: of the chassis on its springs (2,) [s^2].
    """

    unreported: FloatArray = dataclasses.field(default_factory=lambda: np.zeros((2, 2)))
    torque_lag: float = 0.0
    lean: FloatArray = dataclasses.field(default_factory=lambda: np.zeros(2))
    detuning: FloatArray = dataclasses.field(default_factory=lambda: np.zeros(2))

    @classmethod
    def of(cls, retuned: Mapping[str, float], casters: Sequence[str]) -> Undescribed:
        """Take them from all that were re-tuned, by name, of a robot with such casters."""
        lean, detuning = ([retuned.get(f"suspension.{kind}.{axis}", 0.0) for axis in "xy"] for kind in ("lean", "detuning"))

        def reported(name: str, axis: str, kind: str) -> float:
            return sum(retuned.get(f"torque_report.{axis}{kind}{of}", 0.0) for of in ("", f"/{name}"))

        unreported = [
            [[reported(name, axis, kind) for kind in ("", "_behind")] for axis in AXIS_NAMES] for name in casters
        ]  # fmt: skip
        return cls(np.array(unreported), retuned.get("torque_lag", 0.0), np.array(lean), np.array(detuning))

    def among(self, numbers: ModelNumbers) -> ModelNumbers:
        """All numbers of a model, these and those of its description."""
        return dataclasses.replace(
            numbers, unreported=np.broadcast_to(self.unreported, numbers.unreported.shape), torque_lag=self.torque_lag,
            lean=self.lean, detuning=self.detuning,
        )

    def torque(self, motion: RobotMotion, numbers: ModelNumbers) -> FloatArray:
        """Torques (T, n, 2) that acted on a robot whose chassis does not lean [N m]."""
        given = motion.torque + self.torque_lag * motion.torque_rate + np.sum(self.unreported * motion.loops, axis=3)
        if self.lean.any() or self.detuning.any():
            given[:, :, STEER] += weights_on_steerings(motion, self.among(numbers))
        return given


def robot_windows(robot: RobotDescription, recordings: Sequence[Recording], lifted: bool = False) -> Windows:
    """Return the windows of recordings with torques in which the wheels do not slide, of pieces that are long enough.

    Where the wheels are `lifted` off the ground they cannot.
    """
    numbers = ModelNumbers.of(as_it_really_is(robot))
    parts, change, recording, begin = [], [], [], []
    for index, item in enumerate(recordings):
        rate = 1.0 / float(np.median(np.diff(item.joint_states.stamp)))
        cutoff = min(LARGEST_CUTOFF, rate / CUTOFF_SHARE)
        motions = with_pose(read_motions(robot, item, index, cutoff, with_torque=True), numbers)
        for motion, (path, tracked) in zip(motions, paths(item, motions), strict=True):
            starts, marks = window_rows(motion.rate, len(motion.time), max(1, round(LEAD * motion.rate)))
            part = RobotPart(numbers, motion, path, starts, marks, tracked, _noise(item), lifted)
            parts.append(part)
            change.append(_changes(part))
            recording.append(np.full(len(starts), index))
            begin.append(motion.time[starts])
    lever = float(np.mean(np.linalg.norm(numbers.steer_axis, axis=1)))
    radius, offset = float(np.mean(numbers.radius)), float(np.mean(np.abs(numbers.caster_offset[:, 0])))
    return Windows(
        signals=SIGNALS,
        recording=np.concatenate(recording) if recording else np.zeros(0, dtype=np.int64),
        begin=np.concatenate(begin) if begin else np.zeros(0),
        change=np.concatenate(change) if change else np.zeros((0, len(HORIZONS), len(SIGNALS))),
        kinds=(((0, 1.0), (1, 1.0), (2, lever)), ((3, radius), (4, offset)), ((5, 1.0), (6, 1.0), (7, lever))),
        parts=tuple(parts),
    )


def paths(recording: Recording, motions: Sequence[RobotMotion]) -> list[tuple[FloatArray, bool]]:
    """Pose (T, 3) of base_link along each motion, and whether it is that of a tracker.

    By `ground_truth/odom`, else `odom`, else that of the wheels.
    """
    for series, tracked in ((recording.ground_truth, True), (recording.odom, False)):
        if series is not None and len(series.stamp) > 1:
            columns = [[np.interp(m.time, series.stamp, series.pose[:, k]) for k in range(3)] for m in motions]
            return [(np.stack(values, axis=1), tracked) for values in columns]
    return [(motion.pose, False) for motion in motions]


def wheel_twist(numbers: ModelNumbers, steer_angle: FloatArray, velocity: FloatArray) -> FloatArray:
    """Twist (..., 3) that wheels at headings (..., n) with joint rates (..., n, 2) have together, slip left in."""
    n = velocity.shape[-2]
    angle = np.ascontiguousarray(steer_angle.reshape(-1, n))
    rate = np.ascontiguousarray(velocity.reshape(-1, n, 2))
    twist, _ = twists(numbers, angle, rate)
    return np.asarray(twist).reshape(*velocity.shape[:-2], 3)


def _noise(recording: Recording) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Deviations of the white noise of joint angles and torques (n, 2) each, and of the tracked pose (3,)."""

    def level(values: FloatArray) -> float:
        finite = values[np.isfinite(values)]
        return white_noise_level(finite[:NOISE_SAMPLES])

    joints = recording.joint_states
    sides = []
    for values in (joints.position, joints.effort):
        levels = [level(column) for column in values.reshape(len(values), -1).T]
        sides.append(np.array(levels).reshape(values.shape[1:]))
    truth = recording.ground_truth
    pose = np.zeros(3) if truth is None else np.array([level(column) for column in truth.pose.T])
    return sides[0], sides[1], pose


def _changes(part: RobotPart) -> FloatArray:
    """Squared changes of all signals from the start of each window to its horizons (W, H, S), NaN where not to be judged."""
    motion = part.motion
    ends, there = part.ends()
    seen = _signals(part, motion.position, motion.velocity, part.path)
    change = _squares(seen[ends] - seen[part.starts][:, None])
    casters = tuple(map(str, range(motion.position.shape[1])))
    layout = ChannelLayout(casters, balanced=True, imu=False, pose=False)
    usable = np.ones(len(motion.time), dtype=bool) if part.lifted else ~sliding(part.numbers, motion, layout)
    # A window can be judged as long as nothing slid since it began, its lead included, and something moved.
    slid = np.concatenate([[0], np.cumsum(~usable)])
    still = np.concatenate([[0], np.cumsum(np.any(np.abs(motion.velocity[:, :, DRIVE]) > STILL_SPEED, axis=1))])
    first = part.starts[:, None] - part.lead
    fit = (slid[ends + 1] == slid[first]) & (still[ends + 1] > still[part.starts[:, None]])
    return change * np.where(fit, there, np.nan)[:, :, None]


def _signals(part: RobotPart, position: FloatArray, velocity: FloatArray, path: FloatArray) -> FloatArray:
    """All signals (..., 2n + 6): twist of the wheels, drive rates, steering rates, pose; NaN without a tracker.

    Off the ground wheels make no twist.
    """
    twist = np.full_like(path, np.nan) if part.lifted else wheel_twist(part.numbers, position[..., STEER], velocity)
    pose = path if part.tracked and not part.lifted else np.full_like(path, np.nan)
    return np.concatenate([twist, velocity[..., DRIVE], velocity[..., STEER], pose], axis=-1)


def _squares(difference: FloatArray) -> FloatArray:
    """Squares (..., S) of differences (..., 2n + 6), those of the joints averaged over the casters."""
    square = difference**2
    n = (square.shape[-1] - 6) // 2
    drive, steer = square[..., 3 : 3 + n].mean(axis=-1), square[..., 3 + n : 3 + 2 * n].mean(axis=-1)
    return np.concatenate([square[..., :3], drive[..., None], steer[..., None], square[..., -3:]], axis=-1)


# -- simulating -----------------------------------------------------------------------------------------------------


def rollout_squares(robot: RobotDescription, windows: Windows, undescribed: Undescribed) -> FloatArray:
    """Squared errors (W, H, S) of a robot's model over windows.

    Args:
        robot: the model.
        windows: of its recordings.
        undescribed: numbers that it does not hold.
    """

    def squares(part: RobotPart) -> FloatArray:
        ends, _ = part.ends()
        seen = _signals(part, part.motion.position, part.motion.velocity, part.path)[ends]
        return _squares(_simulated(robot, part, undescribed) - seen)

    found = on_all_cores(squares, windows.parts)
    return np.concatenate(found) if found else np.zeros((0, len(HORIZONS), len(SIGNALS)))


def rollout_floor(
    robot: RobotDescription, windows: Windows, undescribed: Undescribed, rng: np.random.Generator
) -> FloatArray:
    """Squared errors (W, H, S) that the noise of the sensors makes in a model that is right.

    Noise as the recordings have it, drawn anew, is put on the start of every window, on its torques and on its ends.
    """
    found = []
    for part in windows.parts:
        ends, _ = part.ends()
        noisy, path = _with_noise(part, rng), part.path + rng.standard_normal(part.path.shape) * part.noise[2]
        seen = _signals(part, part.motion.position, part.motion.velocity, part.path)[ends]
        seen_again = _signals(part, noisy.position, noisy.velocity, path)[ends]
        shifted = dataclasses.replace(part, motion=noisy, path=path)
        moved, plain = on_all_cores(lambda one: _simulated(robot, one, undescribed), (shifted, part))
        found.append(_squares(moved - plain - (seen_again - seen)))
    return np.concatenate(found) if found else np.zeros((0, len(HORIZONS), len(SIGNALS)))


def _with_noise(part: RobotPart, rng: np.random.Generator) -> RobotMotion:
    """The motion with noise like its own on top, filtered like it."""
    motion, (angle, torque, _) = part.motion, part.noise
    # As dense as the recorded noise, at the lower rate of the motion.
    density = np.sqrt(motion.rate * motion.sampling)
    wide = SignalFilter(motion.rate, motion.rate / 5.0)
    drawn = rng.standard_normal((2, *motion.position.shape)) * density
    position, effort = wide.smooth(angle * drawn[0]), wide.smooth(torque * drawn[1])
    return dataclasses.replace(
        motion,
        position=motion.position + position,
        velocity=motion.velocity + derivative(position, motion.rate),
        torque=motion.torque + effort,
    )


def _simulated(robot: RobotDescription, part: RobotPart, undescribed: Undescribed) -> FloatArray:
    """Signals (W, H, 2n + 6) that the robot's own sensors would give at the horizons."""
    motion = true_motion(robot, part.motion)
    own = ModelNumbers.of(as_it_really_is(robot))
    substeps = int(np.ceil(1.0 / (motion.rate * STEP) - 1e-6))
    # The torques were measured behind whatever happens to the commands.
    behind = tuple(i for i in robot.physics if not isinstance(get(i.name), ActuatorEffect))
    plant = ReducedPlant(dataclasses.replace(robot, physics=behind), 1.0 / (motion.rate * substeps), part.lifted)
    lead, last = part.lead, part.marks[-1]
    rows, _ = rows_of(part.starts - lead, np.arange(lead + last), len(motion.time))
    set_at = np.round(np.linspace(0, lead, SETTINGS + 1)).astype(np.int64)
    first = part.starts[:, None] - lead + set_at
    twist, relaxed_slip = np.zeros_like(part.path), np.zeros_like(motion.position)
    if not part.lifted:
        twist, relaxed_slip = _rolling(robot, undescribed.among(own), motion)
    starts = WindowStarts(
        set_at, motion.time[first[:, 0]], part.path[first], twist[first], motion.position[first], motion.velocity[first],
        relaxed_slip[first],
    )  # fmt: skip
    # A row is held until the next: what acts meanwhile is the mean of both.
    given = undescribed.torque(motion, own)
    torque = 0.5 * (given[rows] + given[np.minimum(rows + 1, len(motion.time) - 1)])
    bodies, joints = plant.roll_out(torque, substeps, starts, [lead + mark for mark in part.marks])
    position, velocity = _read(robot, joints[..., 0, :], joints[..., 1, :])
    return _signals(part, position, velocity, bodies[..., :3])


def _rolling(robot: RobotDescription, numbers: ModelNumbers, motion: RobotMotion) -> tuple[FloatArray, FloatArray]:
    """Twist of base_link (T, 3), slip of the wheels left out, and relaxed slip of the tyres (T, n, 2) [m] along a motion.

    By the forces that the motion and its torques ask for. Left to a simulation, tyres that have to roll for their forces
    would take up those of long ago: a robot at walking pace takes seconds for the relaxation length of a soft one.
    """
    layout = ChannelLayout(robot.caster_names, balanced=True, imu=False, pose=False)
    state = rolling_state(motion, numbers, layout, ChannelModel(robot, numbers, layout).around(motion))
    wheels, slow = state.wheels, SignalFilter(motion.rate, FASTEST_SLIP)
    ratio = slip_ratios(numbers.tyres, state.force, state.grip)
    slip = slips_of_ratios(numbers, motion.rate, wheels, ratio)
    slip_twist, _ = rigid_motions(numbers, wheels.steer_angle, wheels.direction, slip, wheels.offset)
    relaxed = numbers.tyres[:, LENGTH, None] * ratio
    return wheels.twist - slow.smooth(slip_twist), slow.smooth(relaxed)


def _read(robot: RobotDescription, position: FloatArray, velocity: FloatArray) -> tuple[FloatArray, FloatArray]:
    """What the encoders report of joint angles and rates (..., n, 2)."""
    position, velocity = position.copy(), velocity.copy()
    for instance in robot.physics:
        effect = get(instance.name)
        if isinstance(effect, EncoderEffect):
            axis = AXIS_NAMES.index(instance.axis or effect.axis)
            for i in map(robot.caster_index, instance.target):
                position[..., i, axis], velocity[..., i, axis] = effect.measure(
                    position[..., i, axis], velocity[..., i, axis], instance.parameters
                )
    return position, velocity
