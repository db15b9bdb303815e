"""How drives with velocity loops of their own follow the speeds that they are commanded: what a simulator has to do like them.

    time_constant * d(speed)/dt = gain * command(t - dead_time) - speed

fitted to what every joint did, with the bandwidth w at which a loop as that of the bridge, (2 w s + w^2) / (s + w)^2, comes
nearest to it. No effect of the library stands for this: how fast a drive should follow, no description says.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from scipy import optimize, signal

from pcw_description.recording import Recording
from pcw_description.robot_description import AXIS_NAMES, RobotDescription

from ..regression.regression_problem import FloatArray

LARGEST_STEP = 2e-3  # [s] at which commands are held and filtered
SHORTEST_PIECE, LEAST_TIME = 1.0, 5.0  # [s] on end, and in all
# A pause of so many intervals, or of so long [s], ends a piece; so long a command is held.
PAUSE_INTERVALS, PAUSE = 5.0, 0.1
TIME_CONSTANTS = (0.0, *np.geomspace(2e-3, 2.0, 16).tolist())  # [s]
DEAD_TIMES = (0.0, *np.geomspace(5e-3, 0.5, 12).tolist())  # [s]
BANDWIDTHS = tuple(np.geomspace(1.0, 300.0, 24).tolist())  # [rad/s], those of the bridge
LEAST_EXPLAINED = 0.5  # of the square of the speed; below it nobody follows
NEAR = 4.0  # times the square that a lag leaves; a loop that leaves more is none of those
BLOCKS = 20  # of which the scatter says how sure the numbers are
ALIKE = 3.0  # deviations by which joints may differ and be told in one sentence


class _Piece(NamedTuple):
    """One contiguous piece of one joint: commands on a fine even grid (F,), and the speeds measured at some times (T,)."""

    step: float
    command: FloatArray
    time: FloatArray
    speed: FloatArray


@dataclasses.dataclass(frozen=True)
class SpeedResponse:
    """How one joint follows.

    Attributes:
        joint: name; axis: "drive" or "steer".
        values: gain [1], dead time [s], time constant [s]; deviations: standard deviations of these, (3,) each.
        bandwidth: of the loop of the bridge that comes nearest [rad/s]; None where that is not near.
        left: part of the rms of the speed that the response leaves.
    """

    joint: str
    axis: str
    values: FloatArray
    deviations: FloatArray
    bandwidth: float | None
    left: float


def speed_responses(robot: RobotDescription, recordings: Sequence[Recording]) -> list[SpeedResponse]:
    """Return how every joint follows that was commanded speeds, and does follow.

    Args:
        robot: the robot; recordings: opened with it.
    """
    found = []
    for (i, caster), (k, axis) in itertools.product(enumerate(robot.caster_names), enumerate(AXIS_NAMES)):
        pieces = [piece for recording in recordings for piece in _pieces(recording, i, k)]
        response = _fitted(pieces)
        if response is not None:
            values, deviations, bandwidth, left = response
            found.append(SpeedResponse(f"{caster}_{axis}", axis, values, deviations, bandwidth, left))
    return found


def responses_in_words(responses: Sequence[SpeedResponse]) -> tuple[str, ...]:
    """Return the responses in words: joints of one kind in one sentence where they follow alike."""
    told = []
    for axis in AXIS_NAMES:
        own = [response for response in responses if response.axis == axis]
        if not own:
            continue
        groups = [own] if _alike(own) else [[response] for response in own]
        if len(groups) > 1:
            told.append(f"The {axis} joints do not follow their commanded speeds alike.")
        for group in groups:
            values = np.median([response.values for response in group], axis=0)
            scatter = np.max([1.96 * response.deviations for response in group], axis=0)
            dead, constant = (f"{values[k]:.3f} s (+-{scatter[k]:.3f})" for k in (1, 2))
            left = max(response.left for response in group)
            names = ", ".join(response.joint for response in group)
            told.append(
                f"{names}: commanded speeds are followed after a dead time of {dead}, with a time constant of {constant} and "
                f"a gain of {values[0]:.3f}; {100.0 * left:.0f} % is left."
            )
            bandwidths = [response.bandwidth for response in group if response.bandwidth is not None]
            if len(bandwidths) == len(group):
                told[-1] += f" Nearest to it in simulation: velocity_bandwidth of {np.median(bandwidths):.2g} rad/s."
    return tuple(told)


def _alike(responses: Sequence[SpeedResponse]) -> bool:
    values = np.array([response.values for response in responses])
    deviations = np.array([response.deviations for response in responses])
    # Two numbers that do the same work differ where their sum does not.
    total = np.column_stack([values[:, 0], values[:, 1] + values[:, 2]])
    spread = np.column_stack([deviations[:, 0], np.hypot(deviations[:, 1], deviations[:, 2])])
    return bool(np.all(np.ptp(total, axis=0) <= ALIKE * np.max(spread, axis=0)))


def _pieces(recording: Recording, i: int, k: int) -> list[_Piece]:
    """Pieces of a joint in which it was commanded speeds and its own was measured."""
    commands, joints = recording.joint_commands, recording.joint_states
    if commands is None:
        return []
    given = np.isfinite(commands.velocity[:, i, k])
    seen = np.isfinite(joints.velocity[:, i, k])
    if given.sum() < 2 or seen.sum() < 2:
        return []
    stamp, wanted = commands.stamp[given], commands.velocity[given, i, k]
    time, speed = joints.stamp[seen], joints.velocity[seen, i, k]
    intervals = [float(np.median(np.diff(series))) for series in (stamp, time)]
    pause = max(PAUSE, PAUSE_INTERVALS * max(intervals))
    last = np.searchsorted(stamp, time, side="right") - 1
    held = (last >= 0) & (time - stamp[np.maximum(last, 0)] < pause)
    broken = np.r_[True, (np.diff(time) > pause) | (held[1:] != held[:-1])]
    step = intervals[1] / max(1, int(np.ceil(intervals[1] / LARGEST_STEP)))
    found = []
    for rows in np.split(np.arange(len(time)), np.flatnonzero(broken)[1:]):
        if not held[rows[0]] or time[rows[-1]] - time[rows[0]] < SHORTEST_PIECE:
            continue
        grid = np.arange(time[rows[0]], time[rows[-1]] + step, step)
        now = np.maximum(np.searchsorted(stamp, grid, side="right") - 1, 0)
        found.append(_Piece(step, wanted[now], time[rows] - grid[0], speed[rows]))
    return found


def _fitted(pieces: Sequence[_Piece]) -> tuple[FloatArray, FloatArray, float | None, float] | None:
    """Values and deviations (3,), bandwidth and what is left; None where nothing follows."""
    if sum(piece.time[-1] for piece in pieces) < LEAST_TIME:
        return None
    speed = np.concatenate([piece.speed for piece in pieces])
    total = float(speed @ speed)
    if total <= 0.0 or not any(np.ptp(piece.command) > 0.0 for piece in pieces):
        return None

    def lagged(constant: float) -> list[FloatArray]:
        return [_lag(piece, constant) for piece in pieces]

    def left(answer: FloatArray) -> float:
        return total - float(speed @ answer) ** 2 / max(float(answer @ answer), 1e-300)

    def at(answers: Sequence[FloatArray], dead: float) -> FloatArray:
        late = [np.interp(p.time - dead, np.arange(len(a)) * p.step, a) for p, a in zip(pieces, answers, strict=True)]
        return np.concatenate(late)

    tried = {
        (constant, dead): left(at(answers, dead))
        for constant in TIME_CONSTANTS for answers in [lagged(constant)] for dead in DEAD_TIMES
    }  # fmt: skip
    start = min(tried, key=lambda pair: tried[pair])

    def cost(point: FloatArray) -> float:
        constant, dead = np.abs(point)
        return left(at(lagged(constant), dead))

    simplex = [start, (1.3 * start[0] + 1e-3, start[1]), (start[0], 1.3 * start[1] + 1e-3)]
    found = optimize.minimize(
        cost, start, method="Nelder-Mead", options={"initial_simplex": simplex, "maxfev": 80, "xatol": 1e-5}
    )
    constant, dead = (float(value) for value in np.abs(found.x))
    answer = at(lagged(constant), dead)
    gain = float(speed @ answer) / float(answer @ answer)
    rest = speed - gain * answer
    if float(rest @ rest) > (1.0 - LEAST_EXPLAINED) * total:
        return None
    values = np.array([gain, dead, constant])

    def predicted(point: FloatArray) -> FloatArray:
        return float(point[0]) * at(lagged(max(float(point[2]), 0.0)), float(point[1]))

    loops = [left(np.concatenate([_looped(p, w) for p in pieces])) for w in BANDWIDTHS]
    best = int(np.argmin(loops))
    near = best > 0 and loops[best] < NEAR * float(rest @ rest)
    # Between two speeds nobody sees how late a command is that is held.
    apart = float(np.median(np.concatenate([np.diff(piece.time) for piece in pieces])))
    scatter = _scatter(predicted, values, rest, apart)
    return values, scatter, BANDWIDTHS[best] if near else None, float(np.sqrt(rest @ rest / total))


def _lag(piece: _Piece, constant: float) -> FloatArray:
    """The command after a lag (F,), the first one having been held for long."""
    if constant <= 0.0:
        return piece.command
    kept = float(np.exp(-piece.step / constant))
    start = np.array([kept * piece.command[0]])
    return np.asarray(signal.lfilter([1.0 - kept], [1.0, -kept], piece.command, zi=start)[0], dtype=np.float64)


def _looped(piece: _Piece, bandwidth: float) -> FloatArray:
    """The command after a loop with both poles at a bandwidth, likewise, at the times of the speeds (T,)."""
    above, below = signal.bilinear([2.0 * bandwidth, bandwidth**2], [1.0, 2.0 * bandwidth, bandwidth**2], 1.0 / piece.step)
    start = signal.lfilter_zi(above, below) * piece.command[0]
    answer = signal.lfilter(above, below, piece.command, zi=start)[0]
    return np.asarray(np.interp(piece.time, np.arange(len(answer)) * piece.step, answer), dtype=np.float64)


def _scatter(
    predicted: Callable[[FloatArray], FloatArray], values: FloatArray, rest: FloatArray, apart: float
) -> FloatArray:
    """Standard deviations (3,) by what blocks of the recording say on their own, which holds for a rest of any colour.

    Args:
        apart: time between two speeds [s], the least by which an answer that is later looks otherwise.
    """
    steps = np.array([1e-3 * abs(values[0]) + 1e-9, apart, apart])
    plain = predicted(values)
    slopes = np.stack([(predicted(values + step) - plain) / step.max() for step in np.diag(steps)], axis=1)
    inverse = np.linalg.pinv(slopes.T @ slopes)
    blocks = np.array_split(np.arange(len(rest)), BLOCKS)
    scores = np.stack([slopes[rows].T @ rest[rows] for rows in blocks])
    return np.asarray(np.sqrt(np.diag(inverse @ (scores.T @ scores) @ inverse)), dtype=np.float64)
