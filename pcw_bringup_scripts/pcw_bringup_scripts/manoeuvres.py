"""Manoeuvres that make a robot show what it is made of, as twists of base_link over time.

`identification` excites each axis alone and all together, with reversals and at several speeds: chirps tell effects apart
best and circles worst. `holdout` shares nothing with it but the robot, so that what was learnt on the one can be tested
on the other.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from pcw_description.errors import PcwError

FloatArray = npt.NDArray[np.float64]
SHORTEST = 10.0  # [s], below which no segment says anything

TwistOverTime = Callable[[float, float], tuple[float, float, float]]
Segment = tuple[float, TwistOverTime]


@dataclasses.dataclass(frozen=True)
class Manoeuvre:
    """Segments driven one after the other.

    Attributes:
        segments: duration [s] and function (time in the segment, its duration) -> twist (v_x, v_y, omega).
    """

    segments: tuple[Segment, ...]

    @property
    def duration(self) -> float:
        """Length of all segments together [s]."""
        return sum(duration for duration, _ in self.segments)

    def lasting(self, duration: float) -> Manoeuvre:
        """Return the same manoeuvre with each segment longer or shorter in proportion.

        Raises:
            PcwError: shorter than `SHORTEST`, or not a number.
        """
        if not SHORTEST <= duration <= 3600.0:
            raise PcwError(f"duration = {duration!r} s is not allowed; allowed: {SHORTEST:g} to 3600 s")
        stretch = duration / self.duration
        return Manoeuvre(tuple((length * stretch, twist) for length, twist in self.segments))

    def twist(self, time: float) -> FloatArray:
        """Return the twist wanted at a time since the start [s]; zero before and after."""
        if time >= 0.0:
            for duration, twist in self.segments:
                if time < duration:
                    return np.array(twist(time, duration))
                time -= duration
        return np.zeros(3)


def _chirp(axis: int, amplitude: float, low: float = 0.2, high: float = 0.9) -> TwistOverTime:
    """Sweep one axis from a low to a high frequency [Hz]."""

    def twist(t: float, duration: float) -> tuple[float, float, float]:
        phase = math.tau * (low * t + 0.5 * (high - low) * t * t / duration)
        values = [0.0, 0.0, 0.0]
        values[axis] = amplitude * math.sin(phase)
        return values[0], values[1], values[2]

    return twist


def _steps(*twists: tuple[float, float, float]) -> TwistOverTime:
    """Hold each twist for an equal part of the segment."""
    return lambda t, duration: twists[min(int(t / duration * len(twists)), len(twists) - 1)]


MANOEUVRES: dict[str, Manoeuvre] = {
    "identification": Manoeuvre(
        (
            (6.0, _chirp(0, 0.45)),
            (6.0, _chirp(1, 0.45)),
            (5.0, _chirp(2, 1.2)),
            (4.0, lambda t, duration: (0.5, 0.0, 0.9)),
            (6.0, lambda t, duration: (0.5, 0.0, 1.2 * math.sin(math.tau * t / duration))),
            (5.0, _steps((0.0, 0.4, 0.0), (0.3, -0.3, 0.0), (-0.4, 0.0, 0.0), (0.3, 0.3, 0.0), (0.0, -0.4, 0.0))),
            (3.0, _steps((0.0, 0.0, 1.2), (0.0, 0.0, -1.2))),
            (4.0, _steps((0.6, 0.0, 0.0), (-0.6, 0.0, 0.0))),
            (1.0, _steps((0.0, 0.0, 0.0))),
        )
    ),
    "holdout": Manoeuvre(
        (
            (
                14.0,
                lambda t, duration: (
                    0.40 * math.sin(0.9 * t), 0.35 * math.sin(1.3 * t + 0.5), 0.6 * math.sin(0.7 * t + 1.0)
                ),
            ),
            (4.0, lambda t, duration: (0.35, 0.2, -0.7)),
            (4.0, _steps((0.25, 0.25, 0.6), (-0.3, 0.2, -0.6))),
            (2.0, _steps((0.0, 0.0, 0.0))),
        )
    ),
}
