"""A gyro in another unit than rad/s, told from the wheels: it turns so many times as far as they do, whenever they turn."""

from __future__ import annotations

import math
from collections import deque

import numpy as np

from pcw_description.differential_kinematics import forward_kinematics
from pcw_description.recording_checks import position_scale, units_of
from pcw_description.robot_description import STEER, FloatArray, RobotDescription

# Readings are thinned to this period, as many kept of each sensor, and compared when so many new ones have come [s].
PERIOD, KEPT, NEW = 0.01, 1000, 50
# Biases of a gyro and errors of the geometry turn slowly: less than this of the wheels says nothing of units [rad].
LEAST_TURN = 0.3


class GyroUnit:
    """Holds the gyro against the wheels, as recordings are read.

        gyro_unit.add_joints(stamp_ns, position, velocity)
        gyro_unit.add_gyro(stamp_ns, gyro)
        if gyro_unit.fault:
            return                                     # says what is wrong

    Attributes:
        fault: what is wrong, in words; "" where the gyro is in rad/s, or nobody can know.
    """

    def __init__(self, robot: RobotDescription) -> None:
        self.fault = ""
        self._robot = robot
        self.clear()

    def clear(self) -> None:
        """Begin anew where the time does; what is known of the unit stays."""
        self._yaw, self._new = 0.0, 0
        self._wheels: deque[tuple[int, float]] = deque(maxlen=KEPT)  # stamp [ns], yaw by the wheels alone [rad]
        self._gyro: deque[tuple[int, float]] = deque(maxlen=KEPT)  # stamp [ns], what was read

    def add_joints(self, stamp_ns: int, position: FloatArray, velocity: FloatArray) -> None:
        """Take a measurement of the joints, (n, 2) each."""
        elapsed = self._elapsed(self._wheels, stamp_ns)
        if elapsed < PERIOD:
            return
        if math.isfinite(elapsed):
            self._yaw += elapsed * float(forward_kinematics(self._robot, position[:, STEER], velocity)[2])
        self._wheels.append((stamp_ns, self._yaw))
        self._new += 1
        if self._new >= NEW:
            self._new = 0
            self._compare()

    def add_gyro(self, stamp_ns: int, gyro: float) -> None:
        """Take what the gyro read about z; what is no number says nothing."""
        if math.isfinite(gyro) and self._elapsed(self._gyro, stamp_ns) >= PERIOD:
            self._gyro.append((stamp_ns, gyro))

    def _elapsed(self, readings: deque[tuple[int, float]], stamp_ns: int) -> float:
        """Time since the last of the readings [s]; infinite before the first."""
        return (stamp_ns - readings[-1][0]) * 1e-9 + 1e-6 if readings else math.inf

    def _compare(self) -> None:
        """Look at the readings of both in the time that they share."""
        if len(self._gyro) < 2:
            return
        start, end = (pick(self._wheels[k][0], self._gyro[k][0]) for k, pick in ((0, max), (-1, min)))
        stamps, values = [], []
        for readings in (self._wheels, self._gyro):
            shared = [(stamp, value) for stamp, value in readings if start <= stamp <= end]
            stamps.append(np.array([stamp - start for stamp, _ in shared]) * 1e-9)
            values.append(np.array([value for _, value in shared]))
        if not len(values[0]) or np.ptp(values[0]) < LEAST_TURN:
            return
        factor = position_scale(stamps[0], values[0], stamps[1], values[1])
        units = units_of(factor) if factor is not None else None
        if factor is None or units is None:
            return
        if units == ("rad", "rad/s"):
            self.fault = ""
        elif units in (("rad", "degrees/s"), ("degrees", "rad/s")):
            looks = "is in degrees/s" if units[0] == "rad" else "was taken from degrees/s to rad/s twice"
            turns = f"imu/data: angular_velocity.z turns {1.0 / factor:.3g} times as far as the wheels"
            self.fault = f"{turns}; it looks as if it {looks}; allowed: rad/s; left out"
