"""The residual channels of a running robot, judged while it drives; ROS-free, and it only listens.

    live = LiveChannels(robot)
    live.receive("/joint_states", JOINT_STATE, cdr)      # every message, as it comes
    judgement = live.update()                            # a few times a second

First it learns: of `learning` seconds of motion of a healthy robot it takes the numbers of the description within their
tolerances and the noise that remains (`live_tuning`). From then on every channel is judged over the last `horizon`: the
rms of its residual after re-tuning over the deviation of a healthy one. What departs but little shows over longer: the same
is asked of the last LASTING horizons, with a lower threshold. Healthy motion goes on to be learned from, with a memory that
fades; what departs is not, nor what came shortly before.
"""

from __future__ import annotations

import dataclasses
import enum
import math
import struct
from collections import deque
from collections.abc import Sequence

import numpy as np

from pcw_description.errors import RecordingError
from pcw_description.recording import Recording
from pcw_description.recording_files import RawMessage
from pcw_description.robot_description import DRIVE, GRAVITY, RobotDescription
from pcw_description.ros_messages import imu, joint_state, odometry, serialise, type_name_of

from ..errors import MismatchError
from ..readings.even_stamps import EvenStamps
from ..readings.joint_glitches import without_glitches
from ..regression.noise_model import robust_deviation
from ..regression.regression_problem import FloatArray
from ..robot.robot_channels import STILL_SPEED, RobotProblemBuilder
from ..robot.robot_motion import SHORTEST_SEGMENT
from .live_rows import LONGEST_WINDOW, NANOSECONDS, RowReader, Rows, Window
from .live_suspects import Suspect, find_suspect
from .live_tuning import Tuning, digest
from .message_ring import MessageRing

# A channel is judged when at least this part of the horizon may be.
JUDGED_SHARE = 0.3
# It is healthy again below this part of the threshold that it had passed.
HYSTERESIS = 0.8
# A weak departure is looked for over so many horizons, with this part of the threshold. Rows wait as long before they are
# learned from, so that none of a beginning fault is.
LASTING, LASTING_SHARE = 8, 0.625
# The ring holds so many times the learning time, should the robot stand in between.
LEARNING_SPAN = 3.0
LARGEST_RING = 256 * 2**20  # [bytes]
# A stamp of joint_states so far behind the one before is another time: a simulation reset, a bag played again [ns].
CLOCK_RESTART = NANOSECONDS
RANGES = {
    "learning": (5.0, 600.0), "memory": (10.0, 1e6), "horizon": (0.2, 10.0), "warn": (1.0, 1e3), "error": (1.0, 1e6),
}  # fmt: skip


class Level(enum.IntEnum):
    """How far a channel departs; as on /diagnostics."""

    OK = 0
    WARN = 1
    ERROR = 2


@dataclasses.dataclass(frozen=True)
class LiveParameters:
    """What is asked of the watch.

    Attributes:
        learning: motion of a healthy robot to learn from [s].
        memory: time constant with which healthy motion is forgotten again [s].
        horizon: what is judged at once [s].
        warn, error: deviations from which a channel warns, and is an error; over LASTING horizons a channel warns from
            LASTING_SHARE of `warn` on.
    """

    learning: float = 20.0
    memory: float = 300.0
    horizon: float = 1.0
    warn: float = 4.0
    error: float = 8.0

    def __post_init__(self) -> None:
        """Check the numbers.

        Raises:
            MismatchError: one is out of its range, or `error` below `warn`.
        """
        for name, (low, high) in RANGES.items():
            value = getattr(self, name)
            if not low <= value <= high:
                raise MismatchError(f"{name} = {value!r} is not allowed; allowed: {low:g} to {high:g}")
        if self.error < self.warn:
            raise MismatchError(f"error = {self.error:g} is not allowed; allowed: at least warn = {self.warn:g}")


@dataclasses.dataclass(frozen=True)
class ChannelState:
    """One channel over the last horizon.

    Attributes:
        residual: rms after re-tuning, in `unit`; normalised: in deviations of a healthy robot, about 1 where nothing departs.
        lasting: the same over the last LASTING horizons.
        since: stamp from which it departs [s]; None where it does not.
    """

    name: str
    unit: str
    residual: float
    normalised: float
    lasting: float
    level: Level
    since: float | None


@dataclasses.dataclass(frozen=True)
class Judgement:
    """What one update found.

    Attributes:
        stamp: of the newest judged row, of the robot's clock [s]; None while learning, or when there was nothing to judge.
        channels: those that could be judged now.
        silent: channels that were learned and could not be judged now.
        learned: motion learned from [s]; ready: whether that is enough.
        suspect: what the departure looks most like; None without one.
        problems: what the reader found wrong, or why nothing could be judged.
    """

    stamp: float | None
    channels: tuple[ChannelState, ...]
    silent: tuple[str, ...]
    learned: float
    ready: bool
    suspect: Suspect | None
    problems: tuple[str, ...]

    @property
    def level(self) -> Level:
        """The worst of all channels."""
        return max((channel.level for channel in self.channels), default=Level.OK)


class LiveChannels:
    """Receives messages, judges channels; see the module.

    Args:
        robot: the nominal robot.
        parameters: what is asked.
        tuning: of a calibration file, instead of learning.
    """

    def __init__(
        self, robot: RobotDescription, parameters: LiveParameters | None = None, tuning: Tuning | None = None
    ) -> None:
        robot.require_casters_only("watching it live")
        self.robot = robot
        self.parameters = parameters or LiveParameters()
        self.tuning = tuning
        self.restarts = 0  # of the robot's clock
        self._ring = self._ring_for(LONGEST_WINDOW if tuning is not None else LEARNING_SPAN * self.parameters.learning)
        self._reader = RowReader(robot, tuning.cutoff) if tuning is not None else None
        self._moved: deque[tuple[int, float]] = deque()  # log time and length of the pieces with motion
        self._read_until: int | None = None  # log time
        self._now: int | None = None
        self._recent: Rows | None = None  # of the last LASTING horizons
        self._waiting: deque[Rows] = deque()  # to be learned from
        self._since: dict[str, float] = {}
        self._level: dict[str, Level] = {}
        self._suspect: Suspect | None = None
        self._looked = -np.inf  # when it was last looked for

    def receive(self, topic: str, type_name: str, cdr: bytes, judged: bool = True) -> RawMessage | None:
        """Take a message of one of the contract's topics, serialised; not `judged` it is only put in time.

        All are put in time by the stamp of the last joint_states: one clock, whatever its pace.

        Returns:
            The message in that time; None before the first joint_states.
        """
        if topic == "/joint_states":
            stamp = header_stamp(cdr)
            if self._now is not None and stamp < self._now - CLOCK_RESTART:
                self._restart()
            self._now = stamp if self._now is None else max(stamp, self._now)
        if self._now is None:
            return None
        message = RawMessage(topic, type_name, self._now, cdr)
        if judged:
            self._ring.append(message)
        return message

    @staticmethod
    def _ring_for(span: float) -> MessageRing:
        return MessageRing(span, LARGEST_RING)

    def _restart(self) -> None:
        """Begin a new time, with what was learned of the robot."""
        self.restarts += 1
        self._now = self._read_until = self._recent = None
        self._ring.clear()
        self._moved.clear()
        self._waiting.clear()
        self._since.clear()
        self._level.clear()
        if self._reader is not None:
            self._reader.restart()

    def warm_up(self) -> None:
        """Have everything compiled that learning and judging need, before anybody waits for it."""
        self._first_window(imagined_motion(self.robot))
        robust_deviation(np.ones(1))

    def learn_again(self) -> None:
        """Forget what was learned, and begin anew with the motion from now on."""
        self._restart()
        self.tuning = self._reader = None
        self._ring = self._ring_for(LEARNING_SPAN * self.parameters.learning)

    def update(self) -> Judgement:
        """Judge what has come since the last call."""
        try:
            if self._now is None:
                return self._nothing("nothing has been received")
            if self._now == self._read_until:
                still = f"all joint_states have the stamp {self._now / NANOSECONDS:.9f} s"
                return self._nothing(f"{still}; allowed: the time of each measurement")
            if self._reader is None or self.tuning is None:
                return self._learn()
            return self._judge(self._reader, self.tuning)
        except (RecordingError, MismatchError) as error:
            return self._nothing(str(error))

    def _nothing(self, *problems: str) -> Judgement:
        names = () if self.tuning is None else tuple(channel.name for channel in self.tuning.layout.channels)
        return Judgement(None, (), names, self._learned(), self.tuning is not None, None, problems)

    # --- Learning ---------------------------------------------------------------------------------------

    def _learned(self) -> float:
        return self.tuning.learned if self.tuning is not None else sum(length for _, length in self._moved)

    def _learn(self) -> Judgement:
        """Count motion; when there is enough of it, take numbers and noise from it."""
        assert self._now is not None
        messages = self._ring.since(self._read_until + 1 if self._read_until is not None else 0)
        self._read_until = self._now
        fresh = Recording.of_messages(messages, self.robot)
        self._moved.append((self._now, moving_time(fresh)))
        oldest = self._now - LEARNING_SPAN * self.parameters.learning * NANOSECONDS
        while self._moved[0][0] < oldest:
            self._moved.popleft()
        problems = tuple(str(warning) for warning in fresh.warnings)
        if self._learned() < self.parameters.learning:
            return self._nothing(*problems)
        try:
            reader, window, told = self._first_window(self._ring.since(0))
            rate = float(np.mean([f.decimated_rate for f in window.builder.filters]))
            layout = window.layout.without(window.builder.unmeasured)
            rows, _ = layout.arranged(window.layout, window.rows)
            self.tuning = Tuning.learn(digest(self.robot), reader.cutoff, layout, rows, rate)
        except (RecordingError, MismatchError) as error:
            return self._nothing(*problems, str(error))
        self._reader = reader
        self._moved.clear()
        self._ring = self._ring_for(LONGEST_WINDOW)
        return self._nothing(*problems, *told)

    def _first_window(self, messages: Sequence[RawMessage]) -> tuple[RowReader, Window, Sequence[str]]:
        """Read messages before which there was nothing; the reader goes on from there. Also what was wrong with them."""
        stamps = EvenStamps()
        recording, told = without_glitches(stamps.evenly_stamped(Recording.of_messages(messages, self.robot)))
        builder = RobotProblemBuilder(self.robot, [recording], live=True)
        reader = RowReader(self.robot, builder.cutoff, stamps)
        return reader, reader.go_on(recording, builder, told), told

    # --- Judging ----------------------------------------------------------------------------------------

    def _judge(self, reader: RowReader, tuning: Tuning) -> Judgement:
        assert self._now is not None
        elapsed = (self._now - self._read_until) / NANOSECONDS if self._read_until is not None else 0.0
        messages = self._ring.since(self._now - round(reader.span(elapsed) * NANOSECONDS))
        if not messages or self._now - messages[0].log_time_ns < SHORTEST_SEGMENT * NANOSECONDS:
            return self._nothing()  # it has just begun
        window = reader.read(messages)
        self._read_until = self._now
        rows, missing = tuning.layout.arranged(window.layout, window.rows)
        if not len(rows):
            return self._nothing(*window.warnings)
        if self._recent is not None and rows.time[0] > self._recent.time[-1]:
            rows_now = self._recent.followed_by(rows)
        else:
            rows_now = rows
        self._recent = rows_now[rows_now.time > rows.time[-1] - LASTING * self.parameters.horizon]
        channels, silent = self._states(tuning, self._recent)
        self._look_for_suspect(reader, tuning, float(rows.time[-1]))
        self._go_on_learning(tuning, rows, channels)
        problems = window.warnings + tuple(f"{name} has no sensor now" for name in missing)
        return Judgement(
            float(rows.time[-1]), channels, silent, tuning.learned, True, self._suspect, problems
        )

    def _states(self, tuning: Tuning, rows: Rows) -> tuple[tuple[ChannelState, ...], tuple[str, ...]]:
        residual = tuning.residual(rows)
        standard = residual / tuning.deviation(rows)
        now = rows.time > rows.time[-1] - self.parameters.horizon
        states, silent = [], []
        for c, channel in enumerate(tuning.layout.channels):
            valid = rows.valid[:, c]
            if valid[now].mean() < JUDGED_SHARE:
                silent.append(channel.name)
                continue
            normalised, lasting = _rms(standard[valid & now, c]), _rms(standard[valid, c])
            level = self._level_of(channel.name, normalised, lasting)
            if level is Level.OK:
                self._since.pop(channel.name, None)
            elif channel.name not in self._since:
                self._since[channel.name] = onset(rows.time[valid], standard[valid, c], max(normalised, lasting))
            since = self._since.get(channel.name)
            rms = _rms(residual[valid & now, c])
            states.append(ChannelState(channel.name, channel.unit, rms, normalised, lasting, level, since))
        return tuple(states), tuple(silent)

    def _level_of(self, name: str, normalised: float, lasting: float) -> Level:
        warn, error = self.parameters.warn, self.parameters.error
        before = self._level.get(name, Level.OK)
        level = Level.OK
        sizes = {Level.WARN: max(normalised / warn, lasting / (LASTING_SHARE * warn)), Level.ERROR: normalised / error}
        for candidate, size in sizes.items():
            if size > (HYSTERESIS if before >= candidate else 1.0):
                level = candidate
        self._level[name] = level
        return level

    def _go_on_learning(self, tuning: Tuning, rows: Rows, channels: tuple[ChannelState, ...]) -> None:
        if any(channel.level is not Level.OK for channel in channels):
            self._waiting.clear()
            return
        self._waiting.append(rows)
        due = rows.time[-1] - LASTING * self.parameters.horizon
        while self._waiting[0].time[-1] < due:
            learned = self._waiting.popleft()
            duration = float(learned.time[-1] - learned.time[0])
            tuning.forget(min(1.0, duration / self.parameters.memory))
            tuning.include(learned)
            tuning.learned += duration

    def _look_for_suspect(self, reader: RowReader, tuning: Tuning, now: float) -> None:
        """While something departs, look once a horizon where it sits, over what has come since."""
        if not self._since:
            self._suspect, self._looked = None, -np.inf
            return
        begun = min(self._since.values())
        if now < max(begun, self._looked) + self.parameters.horizon:
            return
        self._looked = now
        span = min(now - begun + reader.span(0.0), LONGEST_WINDOW)
        assert self._now is not None
        window = reader.read_again(self._ring.since(self._now - round(span * NANOSECONDS)))
        self._suspect = find_suspect(tuning, window, begun) or self._suspect


def onset(time: FloatArray, standard: FloatArray, size: float) -> float:
    """Estimate from when on standardised residuals (T,) of deviation 1 have the deviation `size`, at stamps (T,).

    The maximum over t0 of sum_{t >= t0} (z_t^2 - threshold), with the threshold midway and single values bounded.
    """
    threshold = 0.5 * (1.0 + size**2)
    excess = np.minimum(standard**2, 4.0 * threshold) - threshold
    return float(time[np.argmax(np.cumsum(excess[::-1])[::-1])])


def imagined_motion(robot: RobotDescription) -> list[RawMessage]:
    """What a robot would send that rolls straight on for two seconds, now faster, now slower."""
    messages = []
    for time in np.arange(0.0, 2.0, 0.01).tolist():
        stamp = NANOSECONDS + round(time * NANOSECONDS)
        wave, acceleration = math.sin(5.0 * time), math.cos(5.0 * time)
        way, speed = 0.5 * time - 0.02 * acceleration, 0.5 + 0.1 * wave
        turn, rate, torque = (np.outer(1.0 / robot.wheel_radius, (along, 0.0)) for along in (way, speed, acceleration))
        for topic, message in (
            ("/joint_states", joint_state(stamp, robot.joint_names, turn, rate, torque)),
            ("/imu/data", imu(stamp, (0.0, 0.0, 1e-3 * speed), (0.5 * acceleration, 0.0, GRAVITY))),
            ("/ground_truth/odom", odometry(stamp, (way, 0.0, 0.0), (speed, 0.0, 0.0))),
        ):
            messages.append(RawMessage(topic, type_name_of(message), stamp, serialise(message)))
    return messages


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def header_stamp(cdr: bytes) -> int:
    """Stamp of a serialised message that begins with a header [ns]."""
    seconds, nanoseconds = struct.unpack_from("<iI" if cdr[1] & 1 else ">iI", cdr, 4)
    return int(seconds) * NANOSECONDS + int(nanoseconds)


def moving_time(recording: Recording) -> float:
    """Time in which a wheel of a recording rolls [s]."""
    joints = recording.joint_states
    step = np.diff(joints.stamp)
    usable = (step > 0.0) & (step < 0.1)
    speed = np.abs(np.diff(joints.position[:, :, DRIVE], axis=0)).max(axis=1) / np.where(usable, step, 1.0)
    return float(step[usable & (speed > STILL_SPEED)].sum())
