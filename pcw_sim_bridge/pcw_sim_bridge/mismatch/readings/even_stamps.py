"""Stamps of readings that were taken at even times, though a driver on a busy computer stamped them a little early or late.

A joint that turns at 10 rad/s and is stamped 0.2 ms late seems to be off by 2 mrad, many times what its encoder resolves, and
differentiated that is the largest noise there is. Whether readings came at even times or when their stamps say, they tell
themselves: stamps that differ by e from even ones make, taken at their word, errors v e of signals that move at v. The fourth
differences of signals x, of which a motion leaves nothing, are regressed on those of v e:

    beta = sum d4(v e) d4(x) / sum d4(v e)^2        0: read at even times;  1: read when stamped
"""

from __future__ import annotations

import copy
import dataclasses

import numpy as np
from scipy import ndimage

from pcw_description.recording import Recording

from ..regression.regression_problem import FloatArray, IntArray
from .late_readings import Turns, late_turns

FOLLOWED = 0.05  # part of a difference by which the even time of the next reading is moved
# Where stamps differ from even ones by more than the first part of a step as a rule, or by more than the second now and then,
# they were not merely a little early or late.
USUAL_DIFFERENCE, LARGEST_DIFFERENCE = 0.35, 1.5
LEAST_SHARE = 0.999  # of the readings that are nearer than that
LEAST_STEP = 0.5  # of the mean one; where the middle one is less, several came at once
NEXT = 5  # readings of which all but one have to come later where one was lost; one alone was late itself
PAUSE = 0.1  # [s]; whoever was silent for longer may have begun anew, at times of another phase
SLOW = 2.0  # [s]; over which clocks that drift are followed
MOTION = 0.05  # [s]; over which speeds are averaged
SURE = 0.2  # largest deviation of beta that decides
LEAST_READINGS = 200
ANSWERED = 0.5  # of the stamps that commands share with the states that they answer
KEPT = 0.9  # of what earlier recordings of the same robot said; a driver may have been changed


class EvenStamps:
    """Gives recordings of one robot even stamps where its readings say that they came at even times.

    What they said is kept by sensor: of a second of motion alone few can tell.
    """

    def __init__(self) -> None:
        self._said: dict[str, tuple[float, float]] = {}  # by sensor: precision times beta, and precision

    def evenly_stamped(self, recording: Recording) -> Recording:
        """Return the recording with even stamps of all sensors of which the readings say so, up to this one.

        Commands that carry the stamps of the states they answer keep them.
        """
        joints, imu, truth = recording.joint_states, recording.imu, recording.ground_truth
        moved = copy.copy(recording)
        stamp = self.even("joints", joints.stamp, joints.position.reshape(len(joints.stamp), -1))
        if stamp is not joints.stamp:
            moved.joint_states = dataclasses.replace(joints, stamp=stamp)
            commands = recording.joint_commands
            # Either of the two may be recorded less often than the other.
            if commands is not None and np.isin(commands.stamp, joints.stamp).sum() > ANSWERED * min(
                len(commands.stamp), len(joints.stamp)
            ):
                nearest = np.clip(np.searchsorted(joints.stamp, commands.stamp), 0, len(stamp) - 1)
                later = np.interp(commands.stamp, joints.stamp, stamp - joints.stamp)
                answered = np.where(joints.stamp[nearest] == commands.stamp, stamp[nearest], commands.stamp + later)
                moved.joint_commands = dataclasses.replace(commands, stamp=np.maximum.accumulate(answered))
        if imu is not None:
            sensed = np.column_stack([imu.gyro[:, 2], imu.acceleration[:, :2]])
            if (stamp := self.even("imu", imu.stamp, sensed)) is not imu.stamp:
                moved.imu = dataclasses.replace(imu, stamp=stamp)
        if truth is not None:
            pose = truth.pose.copy()
            pose[:, 2] = np.unwrap(pose[:, 2])
            if (stamp := self.even("tracker", truth.stamp, pose)) is not truth.stamp:
                moved.ground_truth = dataclasses.replace(truth, stamp=stamp)
        return moved

    def even(self, sensor: str, stamp: FloatArray, signals: FloatArray) -> FloatArray:
        """Return the even times (T,) of readings (T, S), or their stamps (T,) where nobody can tell [s]."""
        pieces = np.split(np.arange(len(stamp)), np.flatnonzero(np.diff(stamp) > PAUSE) + 1)
        even = [_even(stamp[piece]) for piece in pieces]
        told, precision = (KEPT * value for value in self._said.get(sensor, (0.0, 0.0)))
        for piece, times in zip(pieces, even, strict=True):
            if times is not None:
                said = _reading_times(times, stamp[piece] - times.stamp, signals[piece])
                told, precision = told + said[0], precision + said[1]
        self._said[sensor] = told, precision
        if all(times is None for times in even) or precision <= SURE**-2 or told >= 0.5 * precision:
            return stamp
        return np.concatenate([stamp[p] if times is None else times.stamp for p, times in zip(pieces, even, strict=True)])


def late_stamps(recording: Recording, evened: Recording) -> list[str]:
    """Return a sentence on every topic with stamps of arrival: what they were, and what they are now."""
    found = []
    for topic, name in (("joint_states", "joint_states"), ("imu/data", "imu"), ("ground_truth/odom", "ground_truth")):
        was, now = getattr(recording, name), getattr(evened, name)
        if was is None or was is now:
            continue
        late, step = was.stamp - now.stamp, float(np.median(np.diff(now.stamp)))
        usual = float(np.std(late))
        if usual > USUAL_DIFFERENCE * step or np.abs(late).max() > LARGEST_DIFFERENCE * step:
            found.append(
                f"{topic}: stamped when it arrived, {1e3 * usual:.2g} ms off as a rule and "
                f"{1e3 * np.abs(late).max():.2g} ms at most; its readings say that they were taken every {1e3 * step:.3g} ms, "
                "and are analysed so"
            )
    return found


@dataclasses.dataclass(frozen=True)
class _EvenTimes:
    """Even stamps (T,) of a piece, which turn each is (T,), and the step between turns [s]."""

    stamp: FloatArray
    turn: IntArray
    step: float


def _even(stamp: FloatArray) -> _EvenTimes | None:
    """The even times of readings without a pause; None where whose turn each is would be a guess."""
    if len(stamp) < LEAST_READINGS:
        return None
    found = _trembling(stamp) or late_turns(stamp, SLOW)
    if found is None:
        return None
    rest = found.rest(stamp)
    mean = _slowly(rest, found.step)
    # What a computer that was held up stamped late says little of its clock.
    even = stamp - rest + _slowly(np.clip(rest, mean - found.step, mean + found.step), found.step)
    return None if np.any(np.diff(even) <= 0.0) else _EvenTimes(even, found.turn, found.step)


def _trembling(stamp: FloatArray) -> Turns | None:
    """Whose turn readings are that were stamped a little early or late; None where it was more than that."""
    step = float(np.median(np.diff(stamp)))
    if step < LEAST_STEP * (stamp[-1] - stamp[0]) / (len(stamp) - 1):
        return None
    for _ in range(2):  # a median of trembling steps is no more than nearly the step
        turn = _turns(stamp, step)
        step = float(np.polyfit(turn, stamp, 1)[0])
    found = Turns(turn, step)
    rest = found.rest(stamp)
    early = rest - _slowly(rest, step)
    near = np.abs(early) < LARGEST_DIFFERENCE * step
    usual = float(np.sqrt(np.mean(early[near] ** 2))) if near.any() else np.inf
    return found if np.mean(near) >= LEAST_SHARE and usual <= USUAL_DIFFERENCE * step else None


def _slowly(rest: FloatArray, step: float) -> FloatArray:
    return np.asarray(ndimage.uniform_filter1d(rest, max(3, round(SLOW / step)), mode="reflect"), dtype=np.float64)


def _turns(stamp: FloatArray, step: float) -> IntArray:
    """Which turn each reading is (T,): more than one step [s] further where readings were lost."""
    times = stamp.tolist()
    turns, even = [0], times[0]
    for k in range(1, len(times)):
        passed = 1
        if times[k] - even > 1.5 * step:
            late = [(time - even) / step - (j + 1) for j, time in enumerate(times[k : k + NEXT])]
            passed += max(0, min(round(late[0]), round(sorted(late)[min(1, len(late) - 1)])))
        turns.append(turns[-1] + passed)
        even += passed * step
        even += FOLLOWED * (times[k] - even)
    return np.array(turns)


def _reading_times(times: _EvenTimes, early: FloatArray, signals: FloatArray) -> tuple[float, float]:
    """Precision times beta of the module, and the precision, by all signals (T, S), each counted by how much it tells."""
    turn, step = times.turn, times.step
    whole = turn[4:] - turn[:-4] == 4
    width = max(3, round(MOTION / step))
    told, precision = 0.0, 0.0
    for values in signals.T:
        known = np.isfinite(values)
        if known.sum() < LEAST_READINGS:
            continue
        filled = np.interp(turn, turn[known], values[known])
        speed = ndimage.uniform_filter1d(np.gradient(filled, turn * step), width)
        used = whole & known[4:] & known[:-4]
        moved, seen = np.diff(speed * early, 4)[used], np.diff(filled, 4)[used]
        size = float(moved @ moved)
        if size == 0.0:
            continue
        beta = float(moved @ seen) / size
        noise = float(np.mean((seen - beta * moved) ** 2))
        # Fourth differences of one noise hang together: by so many there are fewer of them than there are samples.
        own = size / max(4.0 * noise, 1e-300)
        told, precision = told + own * beta, precision + own
    return told, precision
