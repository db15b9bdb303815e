"""What a chassis on its springs makes of accelerations: what a resonator of its `sway_numbers` does."""

from __future__ import annotations

import dataclasses
import functools
import math

import numpy as np
from scipy import signal

from pcw_description.chassis_sway import sway_numbers
from pcw_description.robot_description import RobotDescription

from ..regression.regression_problem import FloatArray

# A resonance above this part of half the sampling rate follows at once.
HIGHEST_PART = 0.8
DETUNING = 0.05  # relative change of the frequency over which the derivative is taken


@dataclasses.dataclass(frozen=True)
class ChassisSway:
    """Along x and along y of base_link (2,) each.

    Attributes:
        lean: how far the centre of mass stays behind, per slow acceleration [s^2]; zero where nothing gives way.
        frequency: natural, undamped [rad/s]; damping: ratio.
    """

    lean: FloatArray
    frequency: FloatArray
    damping: FloatArray

    @classmethod
    def of(cls, robot: RobotDescription) -> ChassisSway:
        """Take it from a description; a robot that its springs would not hold upright does not sway here."""
        return cls(*sway_numbers(robot))

    def response(self, acceleration: FloatArray, rate: float, detuning: float = 0.0) -> FloatArray:
        """What the resonators make of accelerations (T, 2) at `rate` [Hz], their frequencies changed by a part."""
        return np.column_stack([
            _resonated(acceleration[:, k], rate, float(self.frequency[k]) * (1.0 + detuning), float(self.damping[k]))
            for k in range(2)
        ])

    def detuned(self, acceleration: FloatArray, rate: float) -> FloatArray:
        """Derivative (T, 2) of the response by the relative change of the frequencies."""
        more, less = (self.response(acceleration, rate, sign * DETUNING) for sign in (1.0, -1.0))
        derivative: FloatArray = (more - less) / (2.0 * DETUNING)
        return derivative


def _resonated(values: FloatArray, rate: float, frequency: float, damping: float) -> FloatArray:
    if len(values) == 0 or frequency > HIGHEST_PART * math.pi * rate:
        return values
    above, below, start = _resonator(rate, frequency, damping)
    found: FloatArray = signal.lfilter(above, below, values, zi=start * values[0])[0]
    return found


@functools.lru_cache(maxsize=64)
def _resonator(rate: float, frequency: float, damping: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Filter coefficients, and the state of the filter that has always seen a one."""
    # Bilinear, such that the resonance stays where it is.
    warped = frequency / math.tan(frequency / (2.0 * rate))
    above, below = signal.bilinear([frequency**2], [1.0, 2.0 * damping * frequency, frequency**2], 0.5 * warped)
    return above, below, signal.lfilter_zi(above, below)
