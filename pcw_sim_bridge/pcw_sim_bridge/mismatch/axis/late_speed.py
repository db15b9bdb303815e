"""Whether the speed that an axis reads comes later than its position, as behind the filter of a servo's firmware.

    v(t) = q_dot(t - d) = q_dot(t) - d q_ddot(t) + ...

Of such a speed an acceleration is late, too, and friction seems to reverse after the axis has.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from pcw_description.axis_recording import AxisRecording

from ..regression.signal_filter import SignalFilter, derivative, uniform_segments

# Both are compared in this band [Hz], or up to this part of the rate: a position in coarse steps has no more of q_ddot.
BAND, PART_OF_RATE = 5.0, 0.1
SHORTEST = 1.0  # [s] of a piece that is looked at
# A speed that is late by more samples than its own difference quotient is, and of whose error that explains such a part.
LATE_SAMPLES, LATE_PART = 1.5, 0.5


def lateness(recording: AxisRecording) -> float:
    """Return by how much the speed is recorded later than the position [s]; 0 where that is little of what they differ by."""
    if recording.velocity is None:
        return 0.0
    rate, pieces = uniform_segments(
        recording.time, np.stack([recording.position, recording.velocity], axis=1), largest_gap=0.02
    )
    band = SignalFilter(rate, min(BAND, PART_OF_RATE * rate))
    speeds, columns = [], []
    for stamps, values in pieces:
        if stamps[-1] - stamps[0] < SHORTEST:
            continue
        smooth = band.smooth(values)
        speed = derivative(smooth[:, 0], rate)
        inner = slice(band.settling, len(stamps) - band.settling)
        speeds.append(smooth[inner, 1])
        columns.append(np.stack([speed, derivative(speed, rate)], axis=1)[inner])
    if not speeds or not len(read := np.concatenate(speeds)):
        return 0.0
    moved = np.concatenate(columns)
    size = np.maximum(np.sqrt(np.mean(moved**2, axis=0)), 1e-300)
    factor, late = np.linalg.lstsq(moved / size, read, rcond=1e-9)[0] / size
    left = [float(np.sum((read - moved[:, :count] @ (factor, late)[:count]) ** 2)) for count in (1, 2)]
    return -late / factor if factor > 0.0 and left[1] < LATE_PART * left[0] else 0.0


def with_timely_speed(recording: AxisRecording) -> AxisRecording:
    """Return the recording without a speed that is late, with a warning: the position says it in time."""
    late = lateness(recording)
    if late * (len(recording.time) - 1) <= LATE_SAMPLES * recording.duration:
        return recording
    warning = f"velocity is about {1e3 * late:.0f} ms later than position, as behind a filter; position stands in for it"
    return dataclasses.replace(recording, velocity=None, warnings=(*recording.warnings, warning))
