"""What can be wrong with recorded stamps and units, found from the numbers alone.

Every check is careful first: a healthy recording, noisy, quantised, jittered, at rest or with lost messages, must
pass without a word. The checks therefore look for agreement over many windows and for factors far from one.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from .differential_kinematics import forward_kinematics_kernel
from .robot_description import DRIVE, STEER, RobotDescription

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]

TURN = 2.0 * math.pi
DEGREE = math.radians(1.0)

# --- Stamps ---------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class StampOrder:
    """Which rows of a stream to keep so that its stamps increase strictly.

    Attributes:
        keep: (T,) the longest increasing subsequence of the stamps: a late message loses itself only, after a
            reset of the clock the longer part is kept.
        repeats: (T,) rows with the stamp of the row before.
        backward: (T,) rows with a smaller stamp than the row before.
        largest_jump: largest jump back [s], 0 without any.
    """

    keep: BoolArray
    repeats: BoolArray
    backward: BoolArray
    largest_jump: float


def order_stamps(stamp_ns: IntArray) -> StampOrder:
    """Judge the order of stamps (T,) [ns] in the order of arrival."""
    step = np.diff(stamp_ns)
    repeats = np.concatenate([[False], step == 0])
    backward = np.concatenate([[False], step < 0])
    if backward.any():
        keep = _longest_increasing(stamp_ns)
    else:
        keep = ~repeats
    return StampOrder(keep, repeats, backward, float(-step.min(initial=0)) * 1e-9)


def _longest_increasing(values: IntArray) -> BoolArray:
    """Mask (T,) of a longest strictly increasing subsequence (patience sorting)."""
    tails: list[int] = []  # smallest last value of an increasing subsequence of each length
    tail_rows: list[int] = []
    previous = np.full(len(values), -1)
    for row, value in enumerate(values.tolist()):
        place = bisect_left(tails, value)
        if place == len(tails):
            tails.append(value)
            tail_rows.append(row)
        else:
            tails[place] = value
            tail_rows[place] = row
        if place:
            previous[row] = tail_rows[place - 1]
    keep = np.zeros(len(values), dtype=bool)
    row = tail_rows[-1] if tail_rows else -1
    while row >= 0:
        keep[row] = True
        row = previous[row]
    return keep


def find_gaps(stamp: FloatArray) -> tuple[npt.NDArray[np.intp], float]:
    """Rows (G,) after which increasing stamps (T,) [s] pause, and the length [s] from which a pause is a gap.

    A gap is longer than eight typical periods and than three times the longest of the usual ones (95 %), so
    that single lost messages and messages in bursts are none.
    """
    if len(stamp) < 10:
        return np.zeros(0, dtype=np.intp), math.inf
    step = np.diff(stamp)
    limit = max(8.0 * float(np.median(step)), 3.0 * float(np.quantile(step, 0.95)))
    return np.flatnonzero(step > limit), limit


# --- Units of a joint -----------------------------------------------------------------------------------


# (unit of position, unit of velocity) by the factor between position differences and integrated velocity.
_UNIT_PAIRS: dict[tuple[str, str], float] = {
    ("rad", "rad/s"): 1.0,
    ("degrees", "rad/s"): 1.0 / DEGREE,
    ("rad", "degrees/s"): DEGREE,
    ("rad", "rpm"): TURN / 60.0,
    ("revolutions", "rad/s"): 1.0 / TURN,
    ("rad", "revolutions/s"): TURN,
    ("degrees", "rpm"): 6.0,
    ("revolutions", "rpm"): 1.0 / 60.0,
}
TO_SI = {
    "rad": 1.0,
    "rad/s": 1.0,
    "degrees": DEGREE,
    "degrees/s": DEGREE,
    "revolutions": TURN,
    "revolutions/s": TURN,
    "rpm": TURN / 60.0,
}
# A healthy joint may be filtered, late or badly calibrated, but not by this much.
_HEALTHY_FACTORS = (0.55, 1.8)
_UNIT_TOLERANCE = 0.08


def unwrap_turns(position: FloatArray) -> FloatArray:
    """Make an angle (T,) that its driver wraps at one turn, in rad or degrees, continuous; others are returned as is."""
    finite = np.isfinite(position)
    values = position[finite]
    if len(values) < 2:
        return position
    largest_step = np.abs(np.diff(values)).max()
    for period in (TURN, 360.0):
        if np.ptp(values) <= 1.001 * period and largest_step > 0.75 * period:
            unwrapped = position.copy()
            unwrapped[finite] = np.unwrap(values, period=period)
            return unwrapped
    return position


def position_scale(
    position_stamp: FloatArray, position: FloatArray, velocity_stamp: FloatArray, velocity: FloatArray
) -> float | None:
    """How many times as much position changes as the integral of velocity says: 1 when their units agree.

    Compared over windows of at least 0.1 s and ten samples. Arguments are (T,) and (S,), increasing stamps [s].
    None where the motion does not show it: at rest, too few windows, or when fewer than 70 % of the windows with
    motion agree on the factor within a quarter.
    """
    seen, moved = np.isfinite(position), np.isfinite(velocity)
    if seen.sum() < 60 or moved.sum() < 60:
        return None
    position_stamp, position = position_stamp[seen], position[seen]
    velocity_stamp, velocity = velocity_stamp[moved], velocity[moved]
    steps = 0.5 * (velocity[1:] + velocity[:-1]) * np.diff(velocity_stamp)
    integral = np.interp(position_stamp, velocity_stamp, np.concatenate([[0.0], np.cumsum(steps)]))

    period = float(np.median(np.diff(position_stamp)))
    window = max(10, round(0.1 / period)) if period > 0.0 else 10
    edges = np.arange(0, len(position), window)
    duration = np.diff(position_stamp[edges])
    expected, found = np.diff(integral[edges]), np.diff(position[edges])
    if len(expected) < 5:
        return None
    moving = (np.abs(expected) >= 0.3 * np.quantile(np.abs(expected), 0.95)) & (np.abs(expected) > 0.0)
    moving &= duration < 2.0 * np.median(duration)  # a window across a gap proves nothing
    if moving.sum() < 5:
        return None
    ratio = found[moving] / expected[moving]
    factor = float(np.median(ratio))
    if factor == 0.0 or np.mean(np.abs(ratio - factor) < 0.25 * abs(factor)) < 0.7:
        return None
    return factor


def units_of(factor: float) -> tuple[str, str] | None:
    """Name the units of position and velocity from their `position_scale`; None for no pair of common units.

    A pair of the same kind (degrees and degrees/s) has the factor one and is not told from SI here.
    """
    if _HEALTHY_FACTORS[0] <= factor <= _HEALTHY_FACTORS[1]:
        return ("rad", "rad/s")
    if factor <= 0.0:
        return None
    distance = {pair: abs(math.log(factor / known)) for pair, known in _UNIT_PAIRS.items() if known != 1.0}
    nearest = min(distance, key=lambda pair: distance[pair])
    return nearest if distance[nearest] < _UNIT_TOLERANCE else None


def is_counts(values: FloatArray) -> bool:
    """Whether values (T,) are whole numbers that move: raw encoder counts."""
    finite = values[np.isfinite(values)]
    if len(finite) < 60 or not np.array_equal(finite, np.round(finite)):
        return False
    return len(np.unique(finite)) >= 20


def top_speed(stamp: FloatArray, position: FloatArray, velocity: FloatArray) -> float:
    """Speed (99 % quantile) of one joint, (T,) each: of its velocity or, without one, of its position; 0 unknown."""
    speed = np.abs(velocity[np.isfinite(velocity)])
    if not len(speed):
        seen = np.isfinite(position)
        if seen.sum() < 60:
            return 0.0
        # over ten samples, so that the steps of an encoder do not count as speed
        speed = np.abs(np.diff(position[seen][::10]) / np.diff(stamp[seen][::10]))
    return float(np.quantile(speed, 0.99)) if len(speed) else 0.0


# --- Units of all joints together -----------------------------------------------------------------------


def axes_in_degrees(robot: RobotDescription, position: FloatArray, velocity: FloatArray) -> tuple[int, ...]:
    """Which axes (DRIVE, STEER) are in degrees and degrees per second throughout, judged by rolling.

    Position and velocity that are wrong by the same factor agree with each other. The wheels do not: read in the
    right unit, the n casters nearly agree on one motion of the base (the residual of (3.26) is small), read in the
    wrong one they contradict each other. So do wheels that slide a little while they hardly steer: only what is faster,
    read as rad, than the robot can be is taken for degrees. Arguments (T, n, 2); () unless the verdict is clear.
    """
    rated = {DRIVE: [c.limits.drive_speed for c in robot.casters], STEER: [c.limits.steer_speed for c in robot.casters]}
    too_fast = {axis for axis in rated if _beyond(velocity[:, :, axis], np.array(rated[axis]))}
    if not too_fast:
        return ()
    casters = np.flatnonzero(np.isfinite(position[:, :, STEER]).any(axis=0) & np.isfinite(velocity).any(axis=(0, 2)))
    if len(casters) < 2:
        return ()
    angle, rate = position[:, casters, STEER], velocity[:, casters]
    rows = np.flatnonzero(np.isfinite(angle).all(axis=1) & np.isfinite(rate).all(axis=(1, 2)))
    if len(rows) < 60:
        return ()
    # where the wheels turn, evenly over the recording: at rest any unit fits
    energy = np.sum(rate[rows] ** 2 / np.mean(rate[rows] ** 2, axis=0).clip(min=1e-12), axis=(1, 2))
    rows = rows[energy >= np.median(energy)]
    rows = rows[:: max(1, len(rows) // 300)]

    residual = {}
    for axes in ((), (DRIVE,), (STEER,), (DRIVE, STEER)):
        if not too_fast.issuperset(axes):
            continue
        scale = np.array([DEGREE if axis in axes else 1.0 for axis in (DRIVE, STEER)])
        residual[axes] = _rolling_residual(robot, casters, angle[rows] * scale[STEER], rate[rows] * scale)
    best = min(residual, key=lambda axes: residual[axes])
    clear = residual[()] > 0.02 and residual[best] < 0.05 and residual[()] > 5.0 * residual[best]
    return best if clear else ()


def _beyond(speed: FloatArray, limit: FloatArray) -> bool:
    """Whether the fastest (99 % quantile) of n joints (T, n) passes its limit (n,)."""
    relative = np.abs(speed) / limit
    known = relative[np.isfinite(relative)]
    return bool(len(known)) and float(np.quantile(known, 0.99)) > 1.0


def _rolling_residual(
    robot: RobotDescription, casters: npt.NDArray[np.intp], angle: FloatArray, rate: FloatArray
) -> float:
    """Wheel-centre velocities that no motion of the base explains, relative to those sensed, as mean squares.

    Along and across the wheels are weighed alike, so that fast rolling does not hide a contradiction with slow steering.
    Arguments: angle (T, n), rate (T, n, 2).
    """
    axis, offset = robot.steer_axis[casters], robot.caster_offset[casters]
    radius = robot.wheel_radius[casters]
    # velocity of each wheel centre in its own frame, B q_dot of (3.22)
    along = rate[:, :, DRIVE] * radius + rate[:, :, STEER] * offset[:, 1]
    across = -rate[:, :, STEER] * offset[:, 0]
    sensed = np.array([np.sum(along**2), np.sum(across**2)])
    if not sensed.any():
        return 1.0
    # a wheel without offset senses nothing across
    sensed = np.maximum(sensed, 1e-3 * sensed.max())
    slip = np.array([forward_kinematics_kernel(axis, offset, radius, angle[row], rate[row])[1] for row in range(len(angle))])
    return float(np.mean(np.sum(slip**2, axis=(0, 1)) / sensed))


def spans_text(stamp: FloatArray, rows: Sequence[int] | npt.NDArray[np.intp], most: int = 5) -> str:
    """`3.210 s to 3.710 s (0.500 s), ...` of the pauses after `rows`, the longest first beyond `most`."""
    ordered = sorted(rows, key=lambda row: stamp[row] - stamp[row + 1])[:most]
    spans = [
        f"{stamp[row]:.3f} s to {stamp[row + 1]:.3f} s ({stamp[row + 1] - stamp[row]:.3f} s)" for row in sorted(ordered)
    ]
    return ", ".join(spans) + (", ..." if len(rows) > most else "")
