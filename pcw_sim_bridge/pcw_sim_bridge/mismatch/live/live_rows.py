"""Residual rows of a running robot: the newest messages through the same reader and channel model as a recording.

A short window of messages ends now. Its undisturbed middle gives new rows; its ends, within the settling time of the
channel's filter, are left to the window after. So what is judged lags behind by that time (a few tenths of a second).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Sequence

import numpy as np

from pcw_description.recording import Recording
from pcw_description.recording_files import RawMessage
from pcw_description.robot_description import RobotDescription

from ..readings.even_stamps import EvenStamps
from ..readings.joint_glitches import without_glitches
from ..regression.regression_problem import BoolArray, Channel, FloatArray
from ..regression.signal_filter import SignalFilter
from ..robot.robot_channels import RobotProblemBuilder
from ..robot.robot_motion import SHORTEST_SEGMENT, RobotMotion

NANOSECONDS = 1_000_000_000
# Longest window: after a longer pause of the computation the rows between are given up [s].
LONGEST_WINDOW = 6.0
# Of what does not come out of whole samples: jitter, and the filters' grids that begin anew in each window [s].
MARGIN = 0.15


@dataclasses.dataclass(frozen=True)
class Rows:
    """Consecutive rows of the regression problem, T of them.

    Attributes:
        time: stamps [s], of the robot's clock.
        residual, measured, valid: (T, C), see `RegressionProblem`.
        columns: per unit of each nuisance (T, C, K).
    """

    time: FloatArray
    residual: FloatArray
    measured: FloatArray
    valid: BoolArray
    columns: FloatArray

    def __len__(self) -> int:
        return len(self.time)

    def __getitem__(self, rows: slice | BoolArray) -> Rows:
        return Rows(*(getattr(self, field.name)[rows] for field in dataclasses.fields(self)))

    def followed_by(self, other: Rows) -> Rows:
        """Return these rows and the other's after them."""
        return Rows(
            *(
                np.concatenate([getattr(self, field.name), getattr(other, field.name)])
                for field in dataclasses.fields(self)
            )
        )


@dataclasses.dataclass(frozen=True)
class Layout:
    """What the rows' axes are.

    Attributes:
        channels: C of them.
        nuisances: names, K of them; deviations: their tolerances (K,), nominal: their nominal values (K,), units.
        scale_deviation: see `RegressionProblem`.
    """

    channels: tuple[Channel, ...]
    nuisances: tuple[str, ...]
    units: tuple[str, ...]
    nominal: FloatArray
    deviations: FloatArray
    scale_deviation: float

    def arranged(self, layout: Layout, rows: Rows) -> tuple[Rows, tuple[str, ...]]:
        """Put rows of another layout into this one.

        Returns:
            The rows, channels that are not there not valid, and the names of these.
        """
        if layout.channel_names == self.channel_names and layout.nuisances == self.nuisances:
            return rows, ()
        place = {name: i for i, name in enumerate(self.channel_names)}
        pairs = [(place[name], i) for i, name in enumerate(layout.channel_names) if name in place]
        number = {name: k for k, name in enumerate(self.nuisances)}
        numbers = [(number[name], k) for k, name in enumerate(layout.nuisances) if name in number]
        count, width = len(rows), len(self.channels)
        arranged = Rows(
            rows.time, np.zeros((count, width)), np.zeros((count, width)), np.zeros((count, width), dtype=bool),
            np.zeros((count, width, len(self.nuisances))),
        )  # fmt: skip
        for to, source in pairs:
            for name in ("residual", "measured", "valid"):
                getattr(arranged, name)[:, to] = getattr(rows, name)[:, source]
            for number_to, number_from in numbers:
                arranged.columns[:, to, number_to] = rows.columns[:, source, number_from]
        return arranged, tuple(name for name in self.channel_names if name not in layout.channel_names)

    def without(self, names: Collection[str]) -> Layout:
        """The same without channels of these names."""
        return dataclasses.replace(self, channels=tuple(channel for channel in self.channels if channel.name not in names))

    @property
    def channel_names(self) -> tuple[str, ...]:
        """Names of the channels."""
        return tuple(channel.name for channel in self.channels)


@dataclasses.dataclass(frozen=True)
class Window:
    """One reading of the newest messages.

    Attributes:
        half_step: half the interval between rows [s]; warnings: what the reader found wrong.
    """

    builder: RobotProblemBuilder
    layout: Layout
    rows: Rows
    half_step: float
    warnings: tuple[str, ...]


class RowReader:
    """Turns messages into rows, window after window.

    Args:
        robot: the nominal robot.
        cutoff: of the channels' filter [Hz].
        stamps: what readings said of their times before.
    """

    def __init__(self, robot: RobotDescription, cutoff: float, stamps: EvenStamps | None = None) -> None:
        self.robot, self.cutoff = robot, cutoff
        self._last_row: float | None = None
        self._yaw: tuple[FloatArray, FloatArray] | None = None  # stamps and yaw of the window before
        self._stamps = stamps or EvenStamps()

    def restart(self) -> None:
        """Take what comes next for another time or place: nothing goes on from the windows before."""
        self._last_row = self._yaw = None

    def span(self, elapsed: float) -> float:
        """Length of the window to read when the one before was read `elapsed` seconds ago [s]."""
        settling = 2.0 * SignalFilter(1e3 * self.cutoff, self.cutoff).settling / (1e3 * self.cutoff)
        return min(max(settling + elapsed + MARGIN, SHORTEST_SEGMENT + MARGIN), LONGEST_WINDOW)

    def read(self, messages: Sequence[RawMessage]) -> Window:
        """Return what is new in the newest messages, and go on from there.

        Raises:
            RecordingError, MismatchError: there is nothing that can be judged; the text says why.
        """
        return self.go_on(*self._opened(messages))

    def read_again(self, messages: Sequence[RawMessage]) -> Window:
        """Return all rows of messages that were read before; raises as `read`."""
        return self._window(*self._opened(messages))

    def _opened(self, messages: Sequence[RawMessage]) -> tuple[Recording, RobotProblemBuilder, Sequence[str]]:
        recording, told = without_glitches(self._stamps.evenly_stamped(Recording.of_messages(messages, self.robot)))
        return recording, RobotProblemBuilder(self.robot, [recording], self.cutoff, live=True), told

    def go_on(self, recording: Recording, builder: RobotProblemBuilder, told: Sequence[str]) -> Window:
        """Return what is new in a recording with its builder, and go on from there; told: what was wrong with it."""
        window = self._window(recording, builder, told)
        start = recording.t0_ns / NANOSECONDS
        self._yaw = (
            np.concatenate([start + motion.time for motion in builder.motions]),
            np.concatenate([motion.yaw for motion in builder.motions]),
        )
        if self._last_row is not None:
            window = dataclasses.replace(window, rows=window.rows[window.rows.time > self._last_row + window.half_step])
        if len(window.rows):
            self._last_row = float(window.rows.time[-1])
        return window

    def _window(self, recording: Recording, builder: RobotProblemBuilder, told: Sequence[str]) -> Window:
        start = recording.t0_ns / NANOSECONDS
        builder.motions = [self._aligned(motion, start) for motion in builder.motions]
        problem = builder.build(with_terms=False)
        rows = Rows(
            start + problem.time, problem.residual, problem.measured, problem.valid, problem.nuisance_columns()
        )
        layout = Layout(
            problem.channels,
            tuple(nuisance.name for nuisance in problem.nuisances),
            tuple(nuisance.unit for nuisance in problem.nuisances),
            np.array([nuisance.nominal for nuisance in problem.nuisances]),
            problem.nuisance_deviations(),
            problem.scale_deviation,
        )
        warnings = (*(str(warning) for warning in recording.warnings), *told)
        return Window(builder, layout, rows, 0.5 / problem.rate, warnings)

    def _aligned(self, motion: RobotMotion, start: float) -> RobotMotion:
        """Return the motion with a yaw that goes on from the window before: the floor does not turn between two."""
        if self._yaw is None:
            return motion
        stamps, (known_stamps, known) = start + motion.time, self._yaw
        common = (stamps >= known_stamps[0]) & (stamps <= known_stamps[-1])
        if common.any():
            shift = float(np.mean(np.interp(stamps[common], known_stamps, known) - motion.yaw[common]))
        else:
            shift = float(known[-1] - motion.yaw[0])
        return dataclasses.replace(motion, pose=motion.pose + [0.0, 0.0, shift])
