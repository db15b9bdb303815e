"""The part of long recordings that is used: as much as memory and patience allow, from all over them, where there is motion.

Some minutes tell all that an hour does of what is at work all the time, and memory grows with every one of them.
"""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Sequence
from typing import TypeVar

import numpy as np

from pcw_description.recording import Recording
from pcw_description.recording_series import Series
from pcw_description.robot_description import DRIVE

from ..regression.regression_problem import FloatArray
from .robot_channels import STILL_SPEED

LONGEST = 600.0  # [s] of all recordings together
STRETCH = 20.0  # [s]
LOOK = 0.5  # [s]; over which a joint is seen to turn, many times what its encoder resolves
MOVING = 0.5  # of the motion in the liveliest stretch, which others must hold to be taken before what is left

Kind = TypeVar("Kind", bound=Series)


def part_of(recordings: Sequence[Recording], use: str, longest: float = LONGEST) -> tuple[list[Recording], str]:
    """Return the recordings with so much of them as is used, and what there is to say of that, if anything.

    Args:
        recordings: of one robot; short ones are returned as they are.
        use: what is done with them, in a word for that sentence.
        longest: of all together [s]; more only where there are so many that a stretch of each is more.

    Returns:
        The recordings, from which readings of joints, IMU and tracker and commands between the stretches are gone; and a
        plain sentence, empty where nothing is.
    """
    total = sum(_length(recording) for recording in recordings)
    if total <= longest:
        return list(recordings), ""
    starts = [np.arange(0.0, max(_length(recording), STRETCH) - 0.5 * STRETCH, STRETCH) for recording in recordings]
    motions = [_motion(recording, own) for recording, own in zip(recordings, starts, strict=True)]
    motion = np.concatenate(motions)
    count = max(1, int(longest / STRETCH))
    lively = np.flatnonzero(motion >= MOVING * motion.max())
    among = lively if len(lively) >= count else np.sort(np.argsort(-motion, kind="stable")[:count])
    taken = among[np.unique(np.linspace(0, len(among) - 1, count).round().astype(int))]
    parts, first, stretches = [], 0, 0
    for recording, own, moving in zip(recordings, starts, motions, strict=True):
        mine = taken[(taken >= first) & (taken < first + len(own))] - first
        mine = mine if len(mine) else np.array([np.argmax(moving)])  # a recording without readings is none
        parts.append(_within(recording, own[mine]))
        first, stretches = first + len(own), stretches + len(mine)
    return parts, (
        f"Of {total:.0f} s of recordings {stretches * STRETCH:.0f} s were {use}: {stretches} stretches of {STRETCH:g} s in "
        "which the robot moves, from all over them. What happens only between them is not seen: give that part alone."
    )


def _length(recording: Recording) -> float:
    stamp = recording.joint_states.stamp
    return float(stamp[-1] - stamp[0]) if len(stamp) else 0.0


def _motion(recording: Recording, starts: FloatArray) -> FloatArray:
    """Part of each stretch in which some wheel turns."""
    joints = recording.joint_states
    if len(joints.stamp) < 2:
        return np.zeros(len(starts))
    at = np.arange(joints.stamp[0], joints.stamp[-1], LOOK)
    rows = np.searchsorted(joints.stamp, at)
    turned = np.abs(np.diff(joints.position[rows, :, DRIVE], axis=0))
    turns = np.max(np.where(np.isfinite(turned), turned, 0.0), axis=1) > STILL_SPEED * LOOK
    since = at[:-1] - joints.stamp[0]
    found = [turns[(since >= start) & (since < start + STRETCH)].sum() * LOOK / STRETCH for start in starts]
    return np.array(found)


def _within(recording: Recording, starts: FloatArray) -> Recording:
    """The recording with what lies within the stretches that start so long after its first joint state [s]."""
    begun = recording.joint_states.stamp[0] if len(recording.joint_states.stamp) else 0.0
    part = copy.copy(recording)
    part.joint_states = _cut(recording.joint_states, begun + starts)
    for name in ("joint_commands", "imu", "ground_truth"):
        series = getattr(recording, name)
        setattr(part, name, None if series is None else _cut(series, begun + starts))
    return part


def _cut(series: Kind, starts: FloatArray) -> Kind:
    place = np.searchsorted(starts, series.stamp, side="right") - 1
    kept = place >= 0
    kept[kept] = series.stamp[kept] < starts[place[kept]] + STRETCH
    values = {field.name: getattr(series, field.name) for field in dataclasses.fields(series)}
    rows = {name: value[kept] for name, value in values.items() if isinstance(value, np.ndarray)}
    return dataclasses.replace(series, **rows)
