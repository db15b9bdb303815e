"""The typed streams a recording is read into: arrays in SI with strictly increasing stamps."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from .errors import RecordingError, nearest_name
from .recording_checks import find_gaps

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]


@dataclass(frozen=True)
class Series:
    """A stream with strictly increasing stamps.

    Attributes:
        stamp: (T,) [s] from the headers, relative to the recording's `t0_ns`.
        stamp_ns: (T,) [ns] the same, absolute.
    """

    stamp: FloatArray
    stamp_ns: IntArray

    def __len__(self) -> int:
        return len(self.stamp)

    def segments(self) -> list[slice]:
        """Slices of the rows between gaps, for whoever differentiates or filters."""
        after, _ = find_gaps(self.stamp)
        edges = [0, *(after + 1).tolist(), len(self.stamp)]
        return [slice(start, stop) for start, stop in zip(edges[:-1], edges[1:])]


@dataclass(frozen=True)
class JointTrace(Series):
    """One joint: position [rad], velocity [rad/s], effort [N m], (T,) each; NaN where not sent."""

    position: FloatArray
    velocity: FloatArray
    effort: FloatArray


@dataclass(frozen=True)
class JointSeries(Series):
    """All joints; `series["front_left_drive"]` gives one as a JointTrace.

    Attributes:
        joint_names: in the order of the columns.
        position, velocity, effort: [rad, rad/s, N m], (T, n, 2) in the order of the robot, or (T, m) in the order of
            the messages when the recording was opened without a robot. NaN where nothing was sent: a missing
            joint, a field left empty.
    """

    joint_names: tuple[str, ...]
    position: FloatArray
    velocity: FloatArray
    effort: FloatArray

    def __getitem__(self, joint: str) -> JointTrace:
        if joint not in self.joint_names:
            raise RecordingError(f"joint {joint!r} is not in the recording; {nearest_name(joint, self.joint_names)}")
        column = self.joint_names.index(joint)
        flat = [values.reshape(len(self), -1)[:, column] for values in (self.position, self.velocity, self.effort)]
        return JointTrace(self.stamp, self.stamp_ns, *flat)

    def __iter__(self) -> Iterator[str]:
        return iter(self.joint_names)


@dataclass(frozen=True)
class ImuSeries(Series):
    """Inertial sensor: gyro (T, 3) [rad/s] and acceleration, i.e. specific force, (T, 3) [m/s^2] in its own frame."""

    gyro: FloatArray
    acceleration: FloatArray


@dataclass(frozen=True)
class OdometrySeries(Series):
    """Planar motion: pose (T, 3) = x, y [m], yaw [rad] unwrapped; twist (T, 3) = v_x, v_y [m/s], omega [rad/s].

    The pose is that of `child_frame_id` in `frame_id`, the twist is given in `child_frame_id`.
    """

    pose: FloatArray
    twist: FloatArray
    frame_id: str
    child_frame_id: str


@dataclass(frozen=True)
class TwistSeries(Series):
    """Commanded twist (T, 3) = v_x, v_y [m/s], omega [rad/s]."""

    twist: FloatArray


@dataclass(frozen=True)
class WrenchSeries(Series):
    """Force (T, 3) [N] and torque (T, 3) [N m] in the frame named by the message."""

    force: FloatArray
    torque: FloatArray
    frame_id: str
