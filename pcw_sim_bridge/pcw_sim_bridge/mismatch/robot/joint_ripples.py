"""Ripples that turn with a joint, told at the full rate of its encoder.

The channels end at some hertz, where accelerations drown in noise. A ripple of a quickly turning motor passes faster than
that, and would be seen by nobody. But it keeps step with the angle of its motor whatever the speed, and with nothing else:

    P(k) = | sum_t y(t) exp(-i k q(t)) |^2 ,     y: torque or rate of the joint above the channels' band,
                                                 q: angle of its motor, joint side [rad]

has a line at its order k. A loop that rings has none as soon as the speed changes, and a wheel that shakes because another
motor ripples keeps step with that one's angle better than with its own. Orders below `LEAST_ORDER` are those of wheels and
encoders out of centre, which the channels see. How large a ripple is says `ripple_sizes`.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import numpy as np
from scipy import signal

from pcw_description.recording import Recording
from pcw_description.robot_description import AXIS_NAMES, RobotDescription

from ..readings.even_stamps import PAUSE
from ..regression.angle_spectrum import angle_spectrum
from ..regression.regression_problem import BoolArray, FloatArray

LEAST_ORDER, LARGEST_ORDER = 1.5, 150.0  # [1/rad]
HIGHEST = 60.0  # [Hz]; above it tyres and gears of most robots let nothing pass
NYQUIST_PART = 0.4  # of the sampling rate that a band ends at
LEAST_TURNS = 2.0
# A line stands out from the orders within this part of its own by this factor. Without a ripple none did by more than 90, in
# recordings of healthy and otherwise faulty robots on three plants; those of half a newton metre did by 400 to 100 000.
NEIGHBOURS, STANDS_OUT = 0.2, 300.0
PART = 0.05  # of all that the joint does in the band, at least
# Taken in ten parts of the time it keeps in step, speeds differ, and it is more than any tone of one frequency.
PARTS, IN_STEP, SPEEDS, OVER_TONE = 10, 0.7, 0.05, 4.0
LARGEST = 8.0  # robust deviations at which what happens once is cut off
# Another joint's angle that explains this part of what its own does: it shakes because that one does.
OF_ANOTHER = 0.8
COMPARABLE = 0.8  # of a ripple's size, which another wheel shakes by that does so of the same cause
SAME_ORDER = 0.02  # part by which orders of one ripple differ by the angles of two wheels
# So many orders besides, a tenth as strong and no multiples of it: a hard spot of the turn, and no ripple.
HARMONICS, TENTH = 3, 0.1
# Parts of the resolution, and of what is explained, within which an order is a whole number: phases that change with speed,
# like those of a wheel that swings on its tyre, displace a line.
WHOLE, AS_GOOD = 0.3, 0.85


@dataclasses.dataclass(frozen=True)
class JointRipple:
    """A ripple of one joint.

    Attributes:
        caster, axis: of the joint; order: [1/rad]; width: of its line, by how far the joint turned [1/rad].
        part: of what the joint does above the channels' band; peak: by which the line stands out.
    """

    caster: str
    axis: str
    order: float
    width: float
    part: float
    peak: float


@dataclasses.dataclass(frozen=True)
class _Band:
    """What a joint does above the channels' band: a signal, its motor's angle (T,), and its speed below it (T,) [rad/s]."""

    caster: str
    axis: str
    values: FloatArray
    angle: FloatArray
    speed: FloatArray
    lowest: float
    highest: float

    def usable(self, order: float) -> BoolArray:
        """Where waves of an order pass within the band (T,)."""
        fast = order * self.speed / math.tau
        return np.asarray((fast > self.lowest) & (fast < self.highest) & (self.values != 0.0))

    def wave(self, order: float, angle: FloatArray, use: BoolArray) -> tuple[complex, float]:
        """Amplitude of the wave over some angle that explains most where it is used, and the part that it explains."""
        columns = np.stack([np.cos(order * angle[use]), np.sin(order * angle[use])], axis=1)
        size, *_ = np.linalg.lstsq(columns, self.values[use], rcond=None)
        total = float(np.sum(self.values[use] ** 2))
        return complex(size[0], size[1]), float(np.sum((columns @ size) ** 2)) / max(total, 1e-300)


def joint_ripples(robot: RobotDescription, recordings: Sequence[Recording], lowest: float) -> tuple[JointRipple, ...]:
    """Return the ripples above a frequency [Hz], each in the recording that shows it best, the clearest first."""
    found: dict[tuple[str, str], JointRipple] = {}
    for recording in recordings:
        bands = _bands(robot, recording, lowest)
        for ripple in _apart(bands, [ripple for band in bands if (ripple := _ripple(band)) is not None]):
            key = ripple.caster, ripple.axis
            if key not in found or found[key].peak < ripple.peak:
                found[key] = ripple
    return tuple(sorted(found.values(), key=lambda ripple: -ripple.peak))


def even_series(recording: Recording) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Return even stamps (T,), angle, rate and torque of all joints at them (T, n, 2, 3), NaN where never measured, and where
    there is no gap (T,).
    """
    joints = recording.joint_states
    step = float(np.median(np.diff(joints.stamp))) if len(joints.stamp) > 1 else 0.0
    time = np.arange(joints.stamp[0], joints.stamp[-1], step) if step > 0.0 else np.zeros(0)
    values = np.full((len(time), *joints.position.shape[1:], 3), np.nan)
    for k, column in enumerate((joints.position, joints.velocity, joints.effort)):
        for i, axis in np.ndindex(*joints.position.shape[1:]):
            seen = np.isfinite(column[:, i, axis])
            if 2 * np.count_nonzero(seen) > len(seen):
                values[:, i, axis, k] = np.interp(time, joints.stamp[seen], column[seen, i, axis])
    after = np.minimum(np.searchsorted(joints.stamp, time), max(len(joints.stamp) - 1, 0))
    gap = joints.stamp[after] - joints.stamp[np.maximum(after - 1, 0)]
    return time, values, np.asarray(gap < PAUSE)


def _bands(robot: RobotDescription, recording: Recording, lowest: float) -> list[_Band]:
    """Rates and torques of all joints above a frequency."""
    time, values, whole = even_series(recording)
    if len(time) < 2:
        return []
    rate = 1.0 / float(time[1] - time[0])
    highest = min(NYQUIST_PART * rate, HIGHEST)
    if highest < 1.5 * lowest or len(time) < 10.0 * rate / lowest:
        return []
    every = max(1, int(rate / (2.5 * highest)))
    band = signal.butter(3, (lowest, highest), "bandpass", fs=rate, output="sos")
    slow = signal.butter(2, lowest, fs=rate, output="sos")
    found = []
    for i, k in np.ndindex(robot.n, 2):
        _, velocity, torque = values[:, i, k].T
        angle = values[:, i, :, 0] @ robot.gear_coupling[i, k]  # of the motor: it is what ripples
        if not (np.isfinite(angle).all() and np.isfinite(velocity).all()) or np.ptp(angle) < LEAST_TURNS * math.tau:
            continue
        speed = np.abs(signal.sosfiltfilt(slow, velocity))[::every]
        for fast in (velocity, torque):
            if not np.isfinite(fast).all():
                continue
            within = signal.sosfiltfilt(band, fast)[::every]
            most = LARGEST * float(np.median(np.abs(within))) / 0.6745
            within = np.where(whole[::every], np.clip(within, -most, most), 0.0)
            found.append(_Band(robot.caster_names[i], AXIS_NAMES[k], within, angle[::every], speed, lowest, highest))
    return found


def _ripple(band: _Band) -> JointRipple | None:
    """The clearest ripple of a joint, or None."""
    top, usual = (float(np.quantile(band.speed, part)) for part in (0.95, 0.5))
    least = max(LEAST_ORDER, math.tau * band.lowest / max(top, 1e-9))
    largest = min(math.tau * band.highest / max(usual, 0.2), LARGEST_ORDER)
    if least >= largest or not band.values.any():
        return None
    orders, power = angle_spectrum(band.values, band.angle, largest)
    among = np.flatnonzero((orders >= least) & (orders < largest))
    if len(among) < 20:
        return None
    best = among[int(np.argmax(power[among]))]
    near = among[np.abs(orders[among] / orders[best] - 1.0) < NEIGHBOURS]
    peak = float(power[best] / max(float(np.median(power[near])), 1e-300))
    if peak < STANDS_OUT or _is_a_spot(orders, power, float(orders[best])):
        return None
    width = math.tau / float(np.ptp(band.angle))
    use = band.usable(float(orders[best]))
    if np.count_nonzero(use) < 20 * PARTS:
        return None
    order, part = _refined(band, use, float(orders[best]), width)
    if part < PART or part < OVER_TONE * _tone(band.values, use) or not _keeps_step(band, use, order):
        return None
    return JointRipple(band.caster, band.axis, order, width, part, peak)


def _is_a_spot(orders: FloatArray, power: FloatArray, order: float) -> bool:
    """Whether many other whole orders are there, too, as of something at one place of the turn."""
    strong = 0
    for other in range(2, int(orders[-1])):
        multiple = max(other / order, order / other)
        if abs(multiple - round(multiple)) < 0.05:
            continue
        close = np.abs(orders - other) < 0.05
        strong += bool(close.any() and power[close].max() > TENTH * power[np.abs(orders - order) < 0.05].max())
    return strong >= HARMONICS


def _refined(band: _Band, use: BoolArray, order: float, width: float) -> tuple[float, float]:
    """The order near one that explains most, and how much; a whole one if that does as well."""
    tried = order + width * np.linspace(-1.0, 1.0, 81)
    explained = [band.wave(float(k), band.angle, use)[1] for k in tried]
    best = int(np.argmax(explained))
    whole = float(round(tried[best]))
    if abs(whole - tried[best]) < WHOLE * width and band.wave(whole, band.angle, use)[1] > AS_GOOD * explained[best]:
        return whole, explained[best]
    return float(tried[best]), explained[best]


def _tone(values: FloatArray, use: BoolArray) -> float:
    """The part that a tone of one frequency explains at most."""
    power = np.abs(np.fft.rfft(np.where(use, values, 0.0))) ** 2
    return float(2.0 * power.max() / np.count_nonzero(use) / max(float(np.sum(values[use] ** 2)), 1e-300))


def _keeps_step(band: _Band, use: BoolArray, order: float) -> bool:
    """Whether a wave has one phase in all parts of the time, and speeds differ between them."""
    waves, speeds = [], []
    for part in np.array_split(np.flatnonzero(use), PARTS):
        within = np.zeros_like(use)
        within[part] = True
        waves.append(band.wave(order, band.angle, within)[0])
        speeds.append(float(band.speed[part].mean()))
    together = abs(sum(waves)) / max(sum(map(abs, waves)), 1e-300)
    return together > IN_STEP and float(np.std(speeds)) > SPEEDS * float(np.mean(speeds))


def _apart(bands: Sequence[_Band], ripples: Sequence[JointRipple]) -> list[JointRipple]:
    """The ripples of single joints: one each, and none that is another joint's, or that of all wheels."""
    own: list[JointRipple] = []
    for ripple in sorted(ripples, key=lambda r: -r.peak):
        if any((r.caster, r.axis) == (ripple.caster, ripple.axis) for r in own):
            continue
        alike = [r for r in own if abs(r.order / ripple.order - 1.0) < SAME_ORDER]
        if not any(_is_of(bands, ripple, other) for other in alike):
            own.append(ripple)
    return [ripple for ripple in own if not _is_of_all(bands, ripple)]


def _is_of_all(bands: Sequence[_Band], ripple: JointRipple) -> bool:
    """Whether most wheels shake about as much in step with a joint: the floor does that, or the robot as a whole.

    Whose ripple it is nobody could tell then.
    """
    angle = next(b.angle for b in bands if (b.caster, b.axis) == (ripple.caster, ripple.axis))
    # Rates come first of every joint; a joint that stood has none.
    rates = {band.caster: band for band in reversed(bands) if band.axis == ripple.axis}
    sizes = {name: abs(band.wave(ripple.order, angle, band.usable(ripple.order))[0]) for name, band in rates.items()}
    comparable = [name for name, size in sizes.items() if size > COMPARABLE * sizes[ripple.caster]]
    return 2 * len(comparable) > len(sizes) > 1


def _is_of(bands: Sequence[_Band], ripple: JointRipple, other: JointRipple) -> bool:
    """Whether what a joint does keeps step with another joint's angle about as well as with its own."""
    angle = next(b.angle for b in bands if (b.caster, b.axis) == (other.caster, other.axis))
    for band in bands:
        if (band.caster, band.axis) == (ripple.caster, ripple.axis):
            use = band.usable(ripple.order)
            if band.wave(other.order, angle, use)[1] > OF_ANOTHER * band.wave(ripple.order, band.angle, use)[1]:
                return True
    return False
