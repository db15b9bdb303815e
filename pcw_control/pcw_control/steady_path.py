"""The path of a robot that keeps its twist: a circle, or a straight line where it does not turn.

With the pose x_0, y_0, phi_0 at time 0, the twist v_x, v_y, omega in base_link, phi = phi_0 + omega t, and R(.) the rotation,

    (x, y) = (x_0, y_0) + int_0^t R(phi) (v_x, v_y) dt,      the velocity R(phi) (v_x, v_y),      and omega x that.

Whoever follows a twist by its velocity alone is left where a push has moved it to; along such a path it is brought back.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from pcw_description.robot_description import FloatArray

from .errors import ControlError
from .quintic_trajectory import TrajectoryPoint


@dataclasses.dataclass(frozen=True)
class SteadyPath:
    """The path; see the module's docstring.

    Attributes:
        pose: of base_link in odom at time 0 (3,) [m, m, rad].
        twist: of base_link in base_link, all the time (3,) [m/s, m/s, rad/s].
    """

    pose: FloatArray
    twist: FloatArray

    def __post_init__(self) -> None:
        """Check the numbers.

        Raises:
            ControlError: a pose or a twist that is not finite or of a wrong shape.
        """
        for name in ("pose", "twist"):
            values = np.asarray(getattr(self, name), dtype=np.float64)
            if values.shape != (3,) or not np.isfinite(values).all():
                raise ControlError(f"{name} = {values.tolist()} is not allowed; allowed: finite numbers, shape (3,)")

    def sample(self, time: float) -> TrajectoryPoint:
        """Return the point at a time [s]."""
        omega, angle = float(self.twist[2]), float(self.twist[2]) * time
        # The mean of R over the way: a chord of sin(angle / 2) / (angle / 2) of it, turned by half the angle.
        chord = 1.0 - angle * angle / 24.0 if abs(angle) < 1e-4 else math.sin(0.5 * angle) / (0.5 * angle)
        x, y = _turned(self.pose[2] + 0.5 * angle, self.twist)
        u, v = _turned(self.pose[2] + angle, self.twist)
        return TrajectoryPoint(
            self.pose + np.array([chord * time * x, chord * time * y, angle]), np.array([u, v, omega]),
            np.array([-omega * v, omega * u, 0.0]),
        )  # fmt: skip


def _turned(yaw: float, twist: FloatArray) -> tuple[float, float]:
    """Return the velocity (x, y) in odom of a twist (3,) in base_link at a yaw."""
    c, s = math.cos(yaw), math.sin(yaw)
    return c * float(twist[0]) - s * float(twist[1]), s * float(twist[0]) + c * float(twist[1])
