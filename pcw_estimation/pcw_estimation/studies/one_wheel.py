"""One wheel that carries its share of a robot along a line, as it really is, and what its motor and encoder show of it.

    I_rho rho_ddot = tau_rho - r F_x,      M v_x_dot = F_x,      (3.45), (3.46)

with the tyre of `contact_model`: relaxed slip, so that a wheel may start, stop and spin at any step.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from pcw_description.compiled import compiled
from pcw_description.contact.contact_model import LENGTH, tyre_step
from pcw_description.robot_description import FloatArray

from ..slip_estimate import WheelModel

SUBSTEP = 1e-4  # of the integration [s]


@compiled
def _drive(inertia, radius, mass, normal_force, tyre, torque, substeps, dt, motion):  # type: ignore[no-untyped-def]
    """Fill motion (T, 5) of rho, rho_dot, v, F_x and slip ratio, at the end of each interval of torque (T,)."""
    angle, rate, velocity = motion[0, 0], motion[0, 1], motion[0, 2]
    force = motion[0, 3]
    z = 0.0
    speed = max(abs(radius * rate), abs(velocity))
    if speed > 0.0:
        z = tyre[LENGTH] * (radius * rate - velocity) / speed
    for k in range(1, len(torque)):
        for _ in range(substeps):
            speed = max(abs(radius * rate), abs(velocity))
            z, _, force, _ = tyre_step(tyre, z, 0.0, radius * rate - velocity, 0.0, speed, normal_force, dt)
            rate += dt * (torque[k] - radius * force) / inertia
            velocity += dt * force / mass
            angle += dt * rate
        motion[k, 0], motion[k, 1], motion[k, 2], motion[k, 3], motion[k, 4] = angle, rate, velocity, force, z / tyre[LENGTH]


@dataclasses.dataclass(frozen=True)
class WheelRun:
    """A run of one wheel, arrays (T,): the truth, and what is measured of it.

    Attributes:
        time: [s].
        velocity, slip_ratio, force: the truth [m/s], [1], [N].
        rolling_speed: r rho_dot with the true radius [m/s].
        angle, rate, torque: measured [rad], [rad/s], [N m].
    """

    time: FloatArray
    velocity: FloatArray
    slip_ratio: FloatArray
    force: FloatArray
    rolling_speed: FloatArray
    angle: FloatArray
    rate: FloatArray
    torque: FloatArray


@dataclasses.dataclass(frozen=True)
class WheelSensors:
    """What measures the wheel.

    Attributes:
        rate: of the readings [Hz].
        counts: of the encoder per turn of the wheel, gear included.
        rate_noise: standard deviation of the measured speed [rad/s]; None: the difference of two angles instead.
        torque_noise: standard deviation [N m].
    """

    rate: float = 1000.0
    counts: float = 4096.0 * 20.0
    rate_noise: float | None = 0.005
    torque_noise: float = 0.02


def run_wheel(
    wheel: WheelModel, torque: FloatArray, velocity: float, slip: float, sensors: WheelSensors, rng: np.random.Generator
) -> WheelRun:
    """Drive a wheel.

    Args:
        wheel: as it really is.
        torque: of each interval between readings (T,) [N m]; the first one is not used.
        velocity: at the start [m/s].
        slip: slip ratio at the start [1].
        sensors: what measures it.
        rng: source of the noise.
    """
    period = 1.0 / sensors.rate
    substeps = max(1, round(period / SUBSTEP))
    motion = np.zeros((len(torque), 5))
    motion[0] = rng.uniform(0.0, math.tau), velocity / ((1.0 - slip) * wheel.radius), velocity, 0.0, slip
    _drive(
        wheel.inertia, wheel.radius, wheel.mass, wheel.normal_force, wheel.tyre(), torque, substeps, period / substeps, motion
    )
    motion[0, 3] = motion[1, 3]
    quantum = math.tau / sensors.counts
    angle = quantum * np.round(motion[:, 0] / quantum)
    if sensors.rate_noise is None:
        rate = np.diff(angle, prepend=angle[0] - period * motion[0, 1]) / period
    else:
        rate = motion[:, 1] + sensors.rate_noise * rng.standard_normal(len(torque))
    return WheelRun(
        time=period * np.arange(len(torque), dtype=float),
        velocity=motion[:, 2],
        slip_ratio=motion[:, 4],
        force=motion[:, 3],
        rolling_speed=wheel.radius * motion[:, 1],
        angle=angle,
        rate=rate,
        torque=torque + sensors.torque_noise * rng.standard_normal(len(torque)),
    )
