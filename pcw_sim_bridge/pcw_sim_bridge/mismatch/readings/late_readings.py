"""Whose turn readings are that were stamped when they arrived: late, several at once, or after a computer was held up.

Arrival is never before its time, and who is late keeps those behind waiting, but it is over soon; after a loss all that come
are later. So a loss counts by how much later than before the earliest of the readings ahead are, and the middle one: the
smaller of the two, as the earliest scatter where stamps tremble to both sides, and the middle ones where some are late.

    rest_k = t_k - k step
    lost at k:  min(early(rest ahead) - early(rest before), median(rest ahead) - median(rest before)) > 0.7 step
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np
from scipy import ndimage

from ..regression.regression_problem import FloatArray, IntArray

AHEAD = 50  # readings by which a loss is told from one that was late
BUT = 1  # of them, the earliest, that do not count: they may be early, or counted wrong
ONE_MORE = 0.7  # part of a step later by which one more was lost
# The fewest in a row that count as lost, and part of a step by which early and middle ones may leave even times afterwards.
# Where stamps come in bunches, a bunch may take one more than the last did, and what comes after looks as if one was lost:
# there only two count.
WAYS = ((1, 0.4), (2, 1.0))
LEAST_SHARE = 0.99  # of the readings that do not leave them further


@dataclasses.dataclass(frozen=True)
class Turns:
    """Which turn each reading is (T,), and the step between turns [s]."""

    turn: IntArray
    step: float

    def rest(self, stamp: FloatArray) -> FloatArray:
        """What stamps (T,) differ by from turns that follow each other in even steps [s]."""
        return stamp - np.asarray(np.polyval(np.polyfit(self.turn, stamp, 1), self.turn), dtype=np.float64)


def late_turns(stamp: FloatArray, slow: float) -> Turns | None:
    """Return whose turn readings (T,) are that arrived at these times [s]; None where that would be a guess.

    Args:
        stamp: of one piece without a pause, T at least `AHEAD`.
        slow: time over which their clock may drift [s].
    """
    for fewest, allowed in WAYS:
        # The mean step is right where little was lost.
        step = float(stamp[-1] - stamp[0]) / (len(stamp) - 1)
        for _ in range(2):
            turn = _counted(stamp, step, fewest)
            step = float(np.polyfit(turn, stamp, 1)[0])
        found = Turns(turn, step)
        if np.mean(_away(found.rest(stamp), max(3, round(slow / step))) < allowed * step) > LEAST_SHARE:
            return found
    return None


def _counted(stamp: FloatArray, step: float, fewest: int) -> IntArray:
    """Which turn each reading is (T,), by a step that is nearly right [s]."""
    rest = stamp - step * np.arange(len(stamp))
    after = ndimage.rank_filter(rest, BUT, size=AHEAD, origin=-(AHEAD // 2), mode="nearest")
    before = np.concatenate([rest[:1], np.minimum.accumulate(rest)[: AHEAD - 1], after[:-AHEAD]])
    lost = np.zeros(len(stamp), dtype=np.int64)
    # Of the last ones nobody knows whether all that come are later.
    for k in (1 + np.flatnonzero(after[1:-AHEAD] - before[1:-AHEAD] > 0.5 * step)).tolist():
        past, coming = (rest[i] - step * lost[i] for i in (slice(max(0, k - AHEAD), k), slice(k, k + AHEAD)))
        later = min(_early(coming) - _early(past), float(np.median(coming) - np.median(past)))
        more = math.floor(later / step + 1.0 - ONE_MORE)
        if more >= fewest:
            # As some do not count, the last before a loss seem late as well: the widest step is it.
            lost[k + int(np.argmax(np.diff([past[-1], *coming[: BUT + 2]]))) :] += more
    turns: IntArray = np.arange(len(stamp)) + lost
    return turns


def _early(values: FloatArray) -> float:
    rank = min(BUT, len(values) - 1)
    return float(np.partition(values, rank)[rank])


def _away(rest: FloatArray, width: int) -> FloatArray:
    """How far early and middle ones are from their mean over so many (T,): one counted wrong moves all that come after."""
    found = []
    for rank in (BUT, AHEAD // 2):
        level = ndimage.rank_filter(rest, rank, size=AHEAD, mode="reflect")
        found.append(np.abs(level - ndimage.uniform_filter1d(level, width, mode="reflect")))
    return np.minimum(*found)
