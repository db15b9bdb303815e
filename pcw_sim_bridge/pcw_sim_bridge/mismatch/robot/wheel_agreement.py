"""Whether the wheels of a recording move as those of the robot it is said to be of, and with what mistake they would.

Each caster says how fast the base moves where its wheel stands. Casters of one robot agree but for their slip. Where they do
not, one mistake in the set-up is tried after the other: a joint that counts the other way, a steering whose zero is elsewhere,
two casters whose names are exchanged. The one with which all agree is told.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Iterator

import numpy as np

from pcw_description.recording import Recording
from pcw_description.robot_description import DRIVE, STEER, RobotDescription

from ...plants.true_robot import as_it_really_is
from ..regression.regression_problem import FloatArray
from .robot_channels import STILL_SPEED
from .rolling_model import ModelNumbers, twists

CHECKED_ROWS = 300  # of a recording, to see whether it is of this robot at all
CONTRADICTORY = 0.15  # of their speed, by which wheels of one robot do not contradict each other most of the time
# With the mistake that it was they contradict each other by less than this, and by less than this part of what they did.
AGREEING, AGREEING_PART = 0.05, 0.25
TURNS = np.radians(np.arange(-175.0, 181.0, 5.0))  # of a steering's zero that are tried, and finer ones about the best
FINER_TURNS = np.radians(np.arange(-4.0, 5.0))
LEAST_TURN = math.radians(2.0)


@dataclasses.dataclass(frozen=True)
class _Moved:
    """Angles (T, n) and rates (T, n, 2) of joints while they moved, as a mistake would have them."""

    angle: FloatArray
    rate: FloatArray

    def reversed(self, casters: list[int], axis: int) -> _Moved:
        angle, rate = self.angle.copy(), self.rate.copy()
        rate[:, casters, axis] *= -1.0
        if axis == STEER:
            angle[:, casters] *= -1.0
        return _Moved(angle, rate)

    def turned(self, caster: int, by: float) -> _Moved:
        angle = self.angle.copy()
        angle[:, caster] += by
        return _Moved(angle, self.rate)

    def exchanged(self, one: int, other: int) -> _Moved:
        order = np.arange(self.angle.shape[1])
        order[[one, other]] = other, one
        return _Moved(np.ascontiguousarray(self.angle[:, order]), np.ascontiguousarray(self.rate[:, order]))


def contradictions(robot: RobotDescription, recording: Recording) -> list[str]:
    """Return a sentence on wheels that contradict each other, with the mistake that explains it; none where they agree."""
    moved = _moved(recording)
    if moved is None:
        return []
    numbers = ModelNumbers.of(as_it_really_is(robot))
    apart = _apart(numbers, moved)
    if apart <= CONTRADICTORY:
        return []
    share = f"{100 * apart:.0f} % of their speed most of the time"
    told = f"joint_states: by this description the wheels contradict each other by {share}"
    mistake, left = min(_mistakes(robot, numbers, moved), key=lambda tried: tried[1])
    if left < min(AGREEING, AGREEING_PART * apart):
        return [f"{told}; {mistake} they would agree to {100 * left:.1g} %"]
    return [f"{told}: it may be a recording of another robot, or in other units, or all of it slipping"]


def _moved(recording: Recording) -> _Moved | None:
    joints = recording.joint_states
    whole = np.isfinite(joints.position).all(axis=(1, 2)) & np.isfinite(joints.velocity).all(axis=(1, 2))
    moving = np.flatnonzero(whole & (np.abs(joints.velocity[:, :, DRIVE]).max(axis=1) > STILL_SPEED))
    rows = moving[:: max(1, len(moving) // CHECKED_ROWS)]
    if len(rows) < CHECKED_ROWS // 10:
        return None
    return _Moved(np.ascontiguousarray(joints.position[rows, :, STEER]), np.ascontiguousarray(joints.velocity[rows]))


def _apart(numbers: ModelNumbers, moved: _Moved) -> float:
    """Median of the largest slip that wheels show against each other over the fastest one's speed."""
    _, contradiction = twists(numbers, moved.angle, moved.rate)
    slip = np.max(np.linalg.norm(contradiction, axis=2), axis=1)
    along, across = numbers.radius * moved.rate[:, :, DRIVE], numbers.caster_offset[:, 0] * moved.rate[:, :, STEER]
    return float(np.median(slip / np.hypot(along, across).max(axis=1)))


def _mistakes(robot: RobotDescription, numbers: ModelNumbers, moved: _Moved) -> Iterator[tuple[str, float]]:
    """Single mistakes in words, and how far wheels contradict each other with each; the simplest first."""
    names = robot.caster_names
    yield "with all steerings counted the other way", _apart(numbers, moved.reversed(list(range(robot.n)), STEER))
    for i, name in enumerate(names):
        for axis, joint in ((DRIVE, "drive"), (STEER, "steer")):
            yield f"with {name}_{joint} counted the other way", _apart(numbers, moved.reversed([i], axis))
    for one, other in itertools.combinations(range(robot.n), 2):
        left = _apart(numbers, moved.exchanged(one, other))
        yield f"with the joints of {names[one]} and {names[other]} exchanged", left
    for i, name in enumerate(names):
        by = min(TURNS, key=lambda turn: _apart(numbers, moved.turned(i, turn)))
        by = float(by + min(FINER_TURNS, key=lambda turn: _apart(numbers, moved.turned(i, by + turn))))
        if abs(by) > LEAST_TURN:
            degrees = f"{math.degrees(by):.0f} degrees"
            yield f"with {degrees} added to the angle of {name}_steer", _apart(numbers, moved.turned(i, by))
