"""Wheels that shake faster than the channels' filter lets pass: a drive's loop that is too stiff for its tyres does that.

Such a wheel slips to and fro, and what its tyre carries on average has little to do with its average slip: filtered, the
recording looks quiet and follows no model. The noise of an encoder looks the same in its angles, and a noisy measurement of
torque in the torques; what shakes a wheel is in both. So the speed is taken that the angles or the drive's own speeds show, or
that the torques give the rotors and wheels by themselves, whichever is less. A torque that changes its sign with every sample
brings the wheel back to where it was: its angles hardly show that, its speeds do.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from scipy import signal

from pcw_description.robot_description import DRIVE, STEER, RobotDescription

from .regression_problem import FloatArray
from .signal_filter import SignalFilter

SPECTRUM_SAMPLES = 512


@dataclasses.dataclass(frozen=True)
class Shaking:
    """How wheels shake.

    Attributes:
        speed: amplitude of the contact that shakes most (T,) [m/s].
        frequency: of the joint that shakes most [Hz]; 0 where none does.
    """

    speed: FloatArray
    frequency: float


def wheel_shaking(
    robot: RobotDescription, position: FloatArray, velocity: FloatArray, torque: FloatArray, low_pass: SignalFilter
) -> Shaking:
    """Return how wheels shake.

    Args:
        robot: its radii, offsets and inertias.
        position, velocity, torque: of the joints as measured, on a regular grid (T, n, 2) [rad, rad/s, N m]. Velocities may be
            NaN; with NaN torques nothing is said.
        low_pass: what is faster than it lets pass is looked at, amplitudes over its period.
    """
    rate, count = low_pass.rate, len(position)
    if not np.isfinite(torque).all() or low_pass.cutoff >= 0.45 * rate:
        return Shaking(np.zeros(count), 0.0)
    inertia = np.array([[c.rotors.drive + c.wheel.inertia_axle, c.rotors.steer + c.module.inertia_zz] for c in robot.casters])
    reach = np.stack([robot.wheel_radius, np.linalg.norm(robot.caster_offset, axis=1)], axis=1)

    def fast(values: FloatArray) -> FloatArray:
        return values - low_pass.smooth(values)

    # From sample to sample: a central difference sees nothing of what changes its sign with every sample.
    by_angle = fast(np.diff(position, axis=0, prepend=position[:1]) * rate)
    by_speed = fast(velocity) if np.isfinite(velocity).all() else by_angle
    by_torque = fast(np.cumsum(fast(torque), axis=0) / (rate * np.maximum(inertia, 1e-9)))
    angle, own, given = (np.maximum(low_pass.smooth(values**2), 0.0) for values in (by_angle, by_speed, by_torque))
    contact = reach * np.sqrt(2.0 * np.minimum(np.maximum(angle, own), given))
    speed = np.hypot(contact[:, :, DRIVE], contact[:, :, STEER]).max(axis=1)
    worst = int(np.argmax(np.mean(contact**2, axis=0)))
    seen = (by_speed if np.sum(own) > np.sum(angle) else by_angle).reshape(count, -1)[:, worst]
    frequencies, density = signal.welch(seen, rate, nperseg=min(SPECTRUM_SAMPLES, count))
    return Shaking(speed, float(frequencies[int(np.argmax(density))]))
