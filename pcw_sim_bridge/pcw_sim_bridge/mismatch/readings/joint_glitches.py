"""Readings of a joint that jump away for one message and back: a bit lost on a bus, not a motion.

Where a reading at t is off by s, what it departs by from the line between its neighbours is s there and -s/2 at either of
them. No motion does that: a joint that is accelerated departs to one side for as long as it is.
"""

from __future__ import annotations

import copy
import dataclasses

import numpy as np

from pcw_description.recording import Recording

from ..regression.regression_problem import BoolArray, FloatArray

USUAL = 0.9  # of all readings depart by no more than usual
LARGE = 20.0  # times that; motion that suddenly begins departs by less, and noise never by so much
ROUNDING = 1e-9  # of the way of a joint; what its readings differ by less is no step of an encoder
ALIKE = 0.25  # of a departure, by which those of its neighbours may differ from half of it
MOST = 0.02  # of the readings; what jumps more often is no accident


def glitches(stamp: FloatArray, position: FloatArray) -> BoolArray:
    """Return which readings (T,) of a joint are such jumps.

    Args:
        stamp: increasing (T,) [s].
        position: (T,) [rad].
    """
    found = np.zeros(len(stamp), dtype=bool)
    if len(stamp) < 5 or not np.isfinite(position).all():
        return found
    before, after = np.diff(stamp)[:-1], np.diff(stamp)[1:]
    line = position[:-2] + (position[2:] - position[:-2]) * before / (before + after)
    departure = position[1:-1] - line
    # An encoder's least step, which most readings of a joint at rest do not depart by.
    moved = np.abs(np.diff(position))
    least = float(np.min(moved[moved > ROUNDING * np.ptp(position)], initial=np.inf))
    usual = max(float(np.quantile(np.abs(departure), USUAL)), least)
    middle = departure[1:-1]
    large = np.abs(middle) > LARGE * usual
    for neighbour in (departure[:-2], departure[2:]):
        large &= np.abs(neighbour + 0.5 * middle) < ALIKE * np.abs(middle)
    found[2:-2] = large
    return found if found.mean() <= MOST else np.zeros_like(found)


def without_glitches(recording: Recording) -> tuple[Recording, list[str]]:
    """Return the recording without the joint states in which a reading is one, and a sentence on them if there are any."""
    joints = recording.joint_states
    position = joints.position.reshape(len(joints), -1)
    bad = np.stack([glitches(joints.stamp, column) for column in position.T], axis=1)
    kept: BoolArray = ~np.any(bad, axis=1)
    if kept.all():
        return recording, []
    left = copy.copy(recording)
    left.joint_states = dataclasses.replace(
        joints, stamp=joints.stamp[kept], stamp_ns=joints.stamp_ns[kept], position=joints.position[kept],
        velocity=joints.velocity[kept], effort=joints.effort[kept],
    )  # fmt: skip
    names = [joints.joint_names[k] for k in np.flatnonzero(bad.any(axis=0))]
    told = f"positions of {', '.join(names)} jump away for one message and back in {np.sum(~kept)} messages; left out"
    return left, [f"joint_states: {told}"]
