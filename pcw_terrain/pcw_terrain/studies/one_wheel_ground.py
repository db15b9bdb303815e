"""One wheel that carries its share of a robot along a line over changing ground, and what is measured of it.

    I_rho rho_ddot = tau_rho - r F_x,      M v_x_dot = F_x - c,      (3.45), (3.46) [Li2009]

with the relaxed tyre of `contact_model`. It is driven by a torque, as in section 5.3.2 [Li2009], or held at a slip ratio.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from pcw_description.compiled import compiled
from pcw_description.contact.contact_model import (
    LAMBDA,
    LATERAL_LAMBDA,
    LATERAL_MU,
    LENGTH,
    MU,
    tyre_parameters,
    tyre_step,
)
from pcw_description.robot_description import ContactDescription, FloatArray

SUBSTEP = 1e-4  # of the integration [s]


@dataclasses.dataclass(frozen=True)
class GroundWheel:
    """The wheel.

    Attributes:
        inertia: I_rho [kg m^2].
        radius: r [m].
        mass: M [kg].
        normal_force: F_z [N].
        contact: tyre and ground.
    """

    inertia: float = 0.02
    radius: float = 0.075
    mass: float = 22.5
    normal_force: float = 220.0
    contact: ContactDescription | None = None


@compiled
def _drive(inertia, radius, mass, normal_force, tyre, mu, critical, torque, slip, travel, substeps, dt, motion):  # type: ignore[no-untyped-def]
    """Fill motion (T, 4) of rho_dot, v, F_x and slip ratio.

    Where slip (T,) is finite, the wheel turns at that slip ratio and travels at travel (T,); else torque (T,) drives it.
    """
    rate, velocity = motion[0, 0], motion[0, 1]
    tyre = tyre.copy()
    z = tyre[LENGTH] * motion[0, 3]
    force = 0.0
    for k in range(1, len(torque)):
        tyre[MU] = tyre[LATERAL_MU] = mu[k]
        tyre[LAMBDA] = tyre[LATERAL_LAMBDA] = critical[k]
        held = math.isfinite(slip[k])
        for _ in range(substeps):
            if held:
                velocity = travel[k]
                rate = (velocity / (1.0 - slip[k]) if slip[k] * velocity >= 0.0 else velocity * (1.0 + abs(slip[k]))) / radius
                if slip[k] < 0.0:
                    rate = velocity * (1.0 + slip[k]) / radius
            speed = max(abs(radius * rate), abs(velocity))
            z, _, force, _ = tyre_step(tyre, z, 0.0, radius * rate - velocity, 0.0, speed, normal_force, dt)
            if not held:
                rate += dt * (torque[k] - radius * force) / inertia
                velocity += dt * force / mass
        motion[k, 0], motion[k, 1], motion[k, 2], motion[k, 3] = rate, velocity, force, z / tyre[LENGTH]


@dataclasses.dataclass(frozen=True)
class GroundRun:
    """A run, arrays (T,): the truth, and what is measured of it.

    Attributes:
        time: [s].
        rolling_speed, velocity, force, slip_ratio: the truth [m/s], [m/s], [N], [1].
        measured_rolling_speed, measured_velocity: with noise [m/s].
        measured_torque: tau_rho with noise [N m].
    """

    time: FloatArray
    rolling_speed: FloatArray
    velocity: FloatArray
    force: FloatArray
    slip_ratio: FloatArray
    measured_rolling_speed: FloatArray
    measured_velocity: FloatArray
    measured_torque: FloatArray


def run_wheel(
    wheel: GroundWheel,
    rate: float,
    duration: float,
    velocity: float,
    rng: np.random.Generator,
    torque: FloatArray | None = None,
    slip: FloatArray | None = None,
    mu_p: FloatArray | float | None = None,
    lambda_p: FloatArray | float | None = None,
    noise: float = 0.1,
    harmonics: float = 0.02,
) -> GroundRun:
    """Drive a wheel by torque (T,) [N m], or at slip ratios (T,) at a steady velocity.

    Args:
        wheel: the wheel.
        rate: of the readings [Hz].
        duration: [s].
        velocity: at the start, or all the time [m/s].
        rng: source of all noise.
        torque, slip: one of the two.
        mu_p, lambda_p: of the ground under way (T,); None: the contact's.
        noise: velocities are measured with a uniform error of up to this part [1].
        harmonics: amplitude of the high harmonics of the measured torque, as part of its greatest value [1].
    """
    assert wheel.contact is not None and (torque is None) != (slip is None)
    count = round(duration * rate)
    tyre, period = tyre_parameters(wheel.contact), 1.0 / rate
    substeps = max(1, round(period / SUBSTEP))
    motion = np.zeros((count, 4))
    motion[0] = velocity / wheel.radius, velocity, 0.0, 0.0
    held = np.full(count, np.nan) if slip is None else slip
    given = np.zeros(count) if torque is None else torque
    _drive(
        wheel.inertia, wheel.radius, wheel.mass, wheel.normal_force, tyre,
        np.broadcast_to(wheel.contact.mu_p if mu_p is None else mu_p, (count,)).astype(float),
        np.broadcast_to(wheel.contact.lambda_p if lambda_p is None else lambda_p, (count,)).astype(float),
        given, held, np.full(count, velocity), substeps, period / substeps, motion,
    )  # fmt: skip
    motion[0, 2:] = motion[1, 2:]
    time: FloatArray = period * np.arange(count, dtype=float)
    if torque is None:
        given = wheel.inertia * np.gradient(motion[:, 0], period) + wheel.radius * motion[:, 2]
    high = sum(np.sin(math.tau * f * time + rng.uniform(0.0, math.tau)) for f in (110.0, 170.0, 230.0))
    measured_torque = given + harmonics * np.abs(given).max() * high
    rolling: FloatArray = wheel.radius * motion[:, 0]
    return GroundRun(
        time, rolling, motion[:, 1], motion[:, 2], motion[:, 3],
        rolling * (1.0 + noise * rng.uniform(-1.0, 1.0, count)),
        motion[:, 1] * (1.0 + noise * rng.uniform(-1.0, 1.0, count)),
        measured_torque,
    )  # fmt: skip
