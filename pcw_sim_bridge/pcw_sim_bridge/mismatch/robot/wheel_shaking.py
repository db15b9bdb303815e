"""Wheels that shake faster than the channels' filter lets pass: a drive's loop that is too stiff for its tyres does that.

Such a wheel slips to and fro, and what its tyre carries on average has little to do with its average slip: filtered, the
recording looks quiet and follows no model. The noise of an encoder looks the same in its angles, and a noisy measurement of
torque in the torques; what shakes a wheel is in both. So the speed is taken that the angles or the drive's own speeds show, or
that the torques give the rotors and wheels by themselves, whichever is less. A torque that changes its sign with every sample
brings the wheel back to where it was: its angles hardly show that, its speeds do.

One that shakes once with every sample, or several times, is always read at the same place of its swing: at a speed with which
its angle does not move, and with a torque that has as little to do with the mean one.

Casters that roll freely swing about their steering axes by themselves, too, as those of a trolley do (shimmy). No torque is in
that, and it brings a robot to a stop. Angles alone say so, where they swing by far more than the noise of their encoders.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from scipy import ndimage, signal

from pcw_description.robot_description import DRIVE, STEER, RobotDescription

from ..regression.regression_problem import FloatArray
from ..regression.signal_filter import SignalFilter, white_noise_level

SPECTRUM_SAMPLES = 512
# Angles alone are believed up to so many times the frequency that is filtered away, and where they swing by a power that is so
# many times that of their noise.
BELIEVED, BEYOND_NOISE = 4.0, 9.0
# A joint is read in step with how it shakes where its speed, averaged over this time [s], is so many times that of its angle
# and more than its noise makes by chance, by so many standard deviations. That has to be this part of the squares of all that
# is read: what a filter that lags reads where a joint turns back is not.
STANDING_TIME, STANDING, BEYOND_CHANCE, STANDING_PART = 1.0, 2.0, 5.0, 0.25


@dataclasses.dataclass(frozen=True)
class Shaking:
    """How wheels shake.

    Attributes:
        speed: amplitude of the contact that shakes most (T,) [m/s].
        frequency: of the joint that shakes most [Hz]; 0 where none does.
        swing: amplitude of the steering that swings most (T,) [rad], 0 where noise may do the same.
    """

    speed: FloatArray
    frequency: float
    swing: FloatArray


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
    if low_pass.cutoff >= 0.45 * rate:
        return Shaking(np.zeros(count), 0.0, np.zeros(count))
    swing = _swing(position[:, :, STEER], low_pass)
    if not np.isfinite(torque).all():
        return Shaking(np.zeros(count), 0.0, swing)
    inertia = np.array([[c.rotors.drive + c.wheel.inertia_axle, c.rotors.steer + c.module.inertia_zz] for c in robot.casters])
    reach = np.stack([robot.wheel_radius, np.linalg.norm(robot.caster_offset, axis=1)], axis=1)

    def fast(values: FloatArray) -> FloatArray:
        return values - low_pass.smooth(values)

    # From sample to sample: a central difference sees nothing of what changes its sign with every sample.
    by_angle = fast(np.diff(position, axis=0, prepend=position[:1]) * rate)
    by_speed = fast(velocity) if np.isfinite(velocity).all() else by_angle
    in_step = np.zeros_like(position)
    if np.isfinite(velocity).all():
        in_step = reach * _in_step(velocity, position, low_pass)
    by_torque = fast(np.cumsum(fast(torque), axis=0) / (rate * np.maximum(inertia, 1e-9)))
    angle, own, given = (np.maximum(low_pass.smooth(values**2), 0.0) for values in (by_angle, by_speed, by_torque))
    contact = reach * np.sqrt(2.0 * np.minimum(np.maximum(angle, own), given))
    if np.mean(in_step**2) > np.mean(contact**2):
        return Shaking(np.hypot(in_step[:, :, DRIVE], in_step[:, :, STEER]).max(axis=1), rate, swing)
    speed = np.hypot(contact[:, :, DRIVE], contact[:, :, STEER]).max(axis=1)
    worst = int(np.argmax(np.mean(contact**2, axis=0)))
    seen = (by_speed if np.sum(own) > np.sum(angle) else by_angle).reshape(count, -1)[:, worst]
    frequencies, density = signal.welch(seen, rate, nperseg=min(SPECTRUM_SAMPLES, count))
    return Shaking(speed, float(frequencies[int(np.argmax(density))]), swing)


def _in_step(velocity: FloatArray, position: FloatArray, low_pass: SignalFilter) -> FloatArray:
    """Speeds (T, n, 2) at which joints are read on average and their angles do not move; zero of a joint that is read rightly.

    Speeds that are always the same times those of the angles, as of a motor before its gear, are only in other units.
    """
    rate, count = low_pass.rate, max(round(STANDING_TIME * low_pass.rate), 2)
    read = ndimage.uniform_filter1d(velocity, count, axis=0)
    moves = ndimage.uniform_filter1d(np.diff(position, axis=0, prepend=position[:1]) * rate, count, axis=0)
    units = np.sum(read * moves, axis=0) / np.maximum(np.sum(moves**2, axis=0), 1e-300)
    noise = BEYOND_CHANCE * np.std(velocity - low_pass.smooth(velocity), axis=0) / np.sqrt(count)
    beyond = np.minimum(np.abs(read) - STANDING * np.abs(moves), np.abs(read - units * moves)) - noise
    found = np.maximum(beyond, 0.0)
    most = np.sum(found**2, axis=0) >= STANDING_PART * np.sum(read**2, axis=0)
    return np.where(most, found, 0.0)


def _swing(angle: FloatArray, low_pass: SignalFilter) -> FloatArray:
    """Amplitude (T,) by which the one of some angles (T, n) that does so most swings faster than what is let pass."""
    rate, lowest = low_pass.rate, low_pass.cutoff
    highest = min(BELIEVED * lowest, 0.45 * rate)
    within = SignalFilter(rate, highest).smooth(angle) - low_pass.smooth(angle)
    power = np.maximum(low_pass.smooth(within**2), 0.0)
    # The part of white noise that is in such a band.
    noise = np.array([white_noise_level(column) for column in angle.T]) ** 2 * 2.0 * (highest - lowest) / rate
    return np.asarray(np.sqrt(2.0 * np.where(power > BEYOND_NOISE * noise, power, 0.0)).max(axis=1))
