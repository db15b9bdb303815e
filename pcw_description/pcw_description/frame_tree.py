"""Where the frames of a robot stand: those of the URDF from the joints, and map, odom and base_link from poses.

map -> odom -> base_link as in REP-105; base_link -> <caster>_fork -> <caster>_wheel and base_link -> imu_link as in `urdf`.
"""

from __future__ import annotations

import dataclasses
import math
from collections import deque

import numpy as np
import numpy.typing as npt

from .robot_description import DRIVE, STEER, FloatArray, RobotDescription


@dataclasses.dataclass(frozen=True)
class Frame:
    """A frame in its parent.

    Attributes:
        parent, child: names.
        position: origin of the child in the parent (3,) [m].
        quaternion: orientation of the child in the parent (4,) as x, y, z, w [1].
    """

    parent: str
    child: str
    position: FloatArray
    quaternion: FloatArray


def robot_frames(robot: RobotDescription, joint_position: FloatArray) -> list[Frame]:
    """Return the frames of all links below base_link, as the URDF has them.

    A joint that is not known, NaN, leaves its own frame out: it does not hide the other casters.

    Args:
        robot: the robot.
        joint_position: drive and steer of each caster (n, 2) [rad].
    """
    frames = []
    for caster, angles in zip(robot.casters, joint_position, strict=True):
        fork, wheel = f"{caster.name}_fork", f"{caster.name}_wheel"
        if math.isfinite(angles[STEER]):
            place = np.array([*caster.steer_axis, caster.wheel_radius])
            frames.append(Frame("base_link", fork, place, _turned(float(angles[STEER]), axis=2)))
        if math.isfinite(angles[DRIVE]):
            frames.append(Frame(fork, wheel, np.array([*caster.caster_offset, 0.0]), _turned(float(angles[DRIVE]), axis=1)))
    if robot.sensors.imu is not None:
        frames.append(Frame("base_link", "imu_link", np.array(robot.sensors.imu.position), _turned(0.0, axis=2)))
    return frames


def planar_frame(parent: str, child: str, pose: npt.ArrayLike) -> Frame:
    """Return the frame of a pose (x, y, yaw) (3,) [m, m, rad] of the child in the parent."""
    x, y, yaw = np.asarray(pose, dtype=float)
    return Frame(parent, child, np.array([x, y, 0.0]), _turned(float(yaw), axis=2))


def drift_of_odometry(base_in_map: FloatArray, base_in_odom: FloatArray) -> FloatArray:
    """Return the pose of odom in map, T_map_odom = T_map_base T_odom_base^-1; all (x, y, yaw) (3,) [m, m, rad]."""
    yaw = base_in_map[2] - base_in_odom[2]
    c, s = math.cos(yaw), math.sin(yaw)
    x, y = base_in_odom[:2]
    return np.array([base_in_map[0] - c * x + s * y, base_in_map[1] - s * x - c * y, yaw])


class PoseTrack:
    """The last poses of a stream, to be asked for the pose at a time between them.

    Two streams at one time must be compared at one time: at 1 m/s, 10 ms are 1 cm.
    """

    def __init__(self, length: int = 200) -> None:
        self._times: deque[int] = deque(maxlen=length)
        self._poses: deque[FloatArray] = deque(maxlen=length)

    def add(self, time_ns: int, pose: FloatArray) -> None:
        """Add a pose (x, y, yaw) (3,) [m, m, rad]; a time that is not later than the last forgets what was before."""
        if self._times and time_ns <= self._times[-1]:
            self._times.clear()
            self._poses.clear()
        self._times.append(time_ns)
        self._poses.append(np.asarray(pose, dtype=float))

    @property
    def newest(self) -> int | None:
        """Time of the last pose [ns]; None before the first."""
        return self._times[-1] if self._times else None

    def at(self, time_ns: int) -> FloatArray | None:
        """Return the pose at a time, linear between two; None outside of what is known."""
        if not self._times or not self._times[0] <= time_ns <= self._times[-1]:
            return None
        times = np.array(self._times, dtype=np.int64) - time_ns  # differences first: float64 does not hold a stamp
        x, y, yaw = np.array(self._poses).T
        return np.array([np.interp(0.0, times, column) for column in (x, y, np.unwrap(yaw))])


def _turned(angle: float, axis: int) -> FloatArray:
    """The quaternion (x, y, z, w) of a turn about one axis."""
    quaternion = np.zeros(4)
    quaternion[axis], quaternion[3] = math.sin(0.5 * angle), math.cos(0.5 * angle)
    return quaternion
