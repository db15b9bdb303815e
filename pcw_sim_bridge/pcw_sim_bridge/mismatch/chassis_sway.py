"""How a chassis sways on the springs over its wheels: an inverted pendulum whose foot is accelerated.

About the line on the floor around which it leans, with mass m, height h, inertia I + m h^2, and springs k and dampers c at
the distances x from that line,

    (I + m h^2) theta'' + c sum(x^2) theta' + (k sum(x^2) - m g h) theta = m h a,

so the centre of mass stays behind where a rigid body would have it by h theta: by `lean` times the acceleration a that a
resonator at `frequency`, with `damping`, makes of a.
"""

from __future__ import annotations

import dataclasses
import functools
import math

import numpy as np
from scipy import signal

from pcw_description.robot_description import GRAVITY, RobotDescription

from .regression_problem import FloatArray

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
        chassis, springs = robot.chassis, robot.wheel_suspension
        lean, frequency, damping = np.zeros(2), np.ones(2), np.ones(2)
        mass = robot.total_mass
        masses = np.array([chassis.mass, *(c.module.mass for c in robot.casters)])
        heights = np.array([chassis.com[2], *robot.wheel_radius])
        height = float(masses @ heights) / mass
        about_x, about_y, _ = chassis.principal_inertias()
        for k, own in enumerate((about_y, about_x)):
            arms = robot.steer_axis[:, k] - robot.steer_axis[:, k].mean()
            inertia = own + float(masses @ heights**2)
            stiffness = springs.stiffness * float(arms @ arms) - mass * GRAVITY * height
            if stiffness > 0.0:
                lean[k] = mass * height**2 / stiffness
                frequency[k] = math.sqrt(stiffness / inertia)
                damping[k] = springs.damping * float(arms @ arms) / (2.0 * math.sqrt(stiffness * inertia))
        return cls(lean, frequency, damping)

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
