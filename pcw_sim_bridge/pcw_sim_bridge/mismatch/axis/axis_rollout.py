"""Forward simulation of a bench axis over windows of its recordings, under the measured force."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from pcw_description.axis_recording import AxisDescription, AxisRecording
from pcw_description.compiled import compiled, joint_torque_list
from pcw_description.effects.kinds import JointTorqueEffect
from pcw_description.effects.registry import get

from ..regression.regression_problem import FloatArray, IntArray
from ..regression.signal_filter import SignalFilter, derivative, reading_noise_level, white_noise_level
from ..rollout import Windows, rows_of, window_rows
from .axis_channels import PREFILTER_RATIO, AxisMotion, axis_motion

SIGNALS = ("position", "velocity")


@dataclasses.dataclass(frozen=True)
class AxisPart:
    """Windows in one contiguous piece of a recording.

    Attributes:
        motion: the piece, at `rate` [Hz].
        starts: first row of each window (W,); marks: rows of the horizons in a window.
        noise: deviations of the white noise of position, speed and force as recorded, at `sampling_rate` [Hz].
        cutoff: of the filter that the piece has passed [Hz].
    """

    motion: AxisMotion
    rate: float
    starts: IntArray
    marks: list[int]
    noise: tuple[float, float, float]
    cutoff: float
    sampling_rate: float

    def signals(self) -> FloatArray:
        """Position and speed (T, 2)."""
        return np.stack([self.motion.position, self.motion.velocity], axis=1)

    def ends(self) -> IntArray:
        """Rows at the horizons (W, H)."""
        return rows_of(self.starts, self.marks, len(self.motion.time))[0]

    def with_noise(self, rng: np.random.Generator) -> AxisPart:
        """The piece with noise like its own on top, filtered like it."""
        motion = self.motion
        wide = SignalFilter(self.rate, min(self.cutoff, 0.4 * self.rate))
        density = np.sqrt(self.rate / self.sampling_rate)
        drawn = rng.standard_normal((3, len(motion.time))) * density
        position, velocity, force = (wide.smooth(level * noise) for level, noise in zip(self.noise, drawn, strict=True))
        velocity = velocity if self.noise[1] > 0.0 else derivative(position, self.rate)
        motion = dataclasses.replace(
            motion,
            position=motion.position + position,
            velocity=motion.velocity + velocity,
            force=motion.force + force,
        )
        return dataclasses.replace(self, motion=motion)


def axis_windows(axis: AxisDescription, recordings: Sequence[AxisRecording], cutoff: float) -> Windows | None:
    """Return the windows of recordings; None where no piece is long enough.

    Args:
        axis: the nominal axis.
        recordings: of it.
        cutoff: of the channel [Hz].
    """
    parts, change, numbers, begin = [], [], [], []
    for index, recording in enumerate(recordings):
        rate, motions = axis_motion(axis, recording, index, cutoff)
        noise, sampling_rate = _noise(recording), 1.0 / float(np.median(np.diff(recording.time)))
        for motion in motions:
            starts, marks = window_rows(rate, len(motion.time), 0)
            part = AxisPart(motion, rate, starts, marks, noise, PREFILTER_RATIO * cutoff, sampling_rate)
            ends, there = rows_of(starts, marks, len(motion.time))
            seen = part.signals()
            parts.append(part)
            change.append((seen[ends] - seen[starts][:, None]) ** 2 * there[:, :, None])
            numbers.append(np.full(len(starts), index))
            begin.append(motion.time[starts])
    if not parts:
        return None
    kinds = (((0, 1.0),), ((1, 1.0),))
    return Windows(SIGNALS, np.concatenate(numbers), np.concatenate(begin), np.concatenate(change), kinds, tuple(parts))


def rollout_squares(axis: AxisDescription, windows: Windows) -> FloatArray:
    """Squared errors of position and speed (W, H, 2)."""
    return np.concatenate([(_simulated(axis, part) - part.signals()[part.ends()]) ** 2 for part in windows.parts])


def rollout_floor(axis: AxisDescription, windows: Windows, rng: np.random.Generator) -> FloatArray:
    """Squared errors (W, H, 2) that noise like the recorded one makes in a model that is right."""
    found = []
    for part in windows.parts:
        noisy = part.with_noise(rng)
        moved = _simulated(axis, noisy) - _simulated(axis, part)
        found.append((moved - (noisy.signals() - part.signals())[part.ends()]) ** 2)
    return np.concatenate(found)


def _noise(recording: AxisRecording) -> tuple[float, float, float]:
    """Deviations of the white noise of position, speed (0 where it is differentiated) and force."""
    velocity = recording.velocity
    return (
        reading_noise_level(recording.position),
        0.0 if velocity is None else white_noise_level(velocity),
        white_noise_level(recording.force),
    )


def _simulated(axis: AxisDescription, part: AxisPart) -> FloatArray:
    """Position and speed at the horizons of every window (W, H, 2)."""
    kernels, values = [], []
    for instance in axis.physics:
        effect = get(instance.name)
        if isinstance(effect, JointTorqueEffect):
            kernels.append(effect.torque)
            values.append(effect.values(instance.parameters))
    numbers = np.zeros((len(values), max((len(row) for row in values), default=1)))
    for row, own in zip(numbers, values, strict=True):
        row[: len(own)] = own
    arm = axis.gravity_arm
    gravity = np.array([arm.moment, arm.hanging_position]) if arm is not None else np.zeros(2)
    motion = part.motion
    result = np.full((len(part.starts), len(part.marks), 2), np.nan)
    _roll_out(
        joint_torque_list(kernels), numbers, gravity, axis.inertia, 1.0 / part.rate, motion.position, motion.velocity,
        motion.force, part.starts, np.array(part.marks, dtype=np.int64), result,
    )  # fmt: skip
    return result


@compiled
def _roll_out(kernels, numbers, gravity, inertia, dt, position, velocity, force, starts, marks, result):  # type: ignore[no-untyped-def]
    """Fill result (W, K, 2) with position and speed at marks after each start; friction is taken implicitly."""
    last = len(force) - 1
    for w in range(len(starts)):
        q, v = position[starts[w]], velocity[starts[w]]
        mark = 0
        for row in range(marks[-1] + 1):
            if row == marks[mark]:
                result[w, mark, 0], result[w, mark, 1] = q, v
                mark += 1
            if mark == len(marks):
                break
            at = starts[w] + row
            applied = 0.5 * (force[min(at, last)] + force[min(at + 1, last)])
            total, slope = applied - gravity[0] * np.sin(q - gravity[1]), 0.0
            for k in range(len(kernels)):
                torque, steepness = kernels[k](q, v, applied, 0.0, numbers[k])
                total += torque
                slope += max(steepness, 0.0)
            step = dt * total / (inertia + dt * slope)
            q += dt * (v + 0.5 * step)
            v += step
