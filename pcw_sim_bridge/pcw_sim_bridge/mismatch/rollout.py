"""Forward simulation over short windows, driven by recorded torques or forces: what a model predicts, not only explains.

A window begins at the measured motion and runs for the longest horizon. At every horizon what the simulated machine's own
sensors would say is held against what was recorded. All errors of one kind are put over one size, that of the changes over
a window: where a signal hardly moves, an error of a thousandth of the others must not pass for one of a thousand per cent.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np

from .regression.regression_problem import BoolArray, FloatArray, IntArray

HORIZONS = (0.1, 0.5, 2.0)  # [s]
MAIN_HORIZON = 1  # the one by which a patch is judged: most of the effects show in it, and chance does not yet
STRIDE = 1.0  # [s] from one window to the next
# An error so many times the size of the changes says that the simulation ran away, and no more.
RAN_AWAY = 10.0


@dataclasses.dataclass(frozen=True)
class Windows:
    """Windows of some recordings, as any model of their subject may be driven over them.

    Attributes:
        signals: names.
        recording: number of the recording of each (W,).
        begin: when each begins (W,) [s].
        change: how far each signal moves, squared and averaged over what it stands for, (W, H, S); NaN where a window is too
            short for a horizon, or where it cannot be judged.
        kinds: signals of one kind, as (position, factor to the kind's own unit): they share a size.
        parts: of the subject's own, one for each piece of a recording, with the first row of each window in `starts`.
    """

    signals: tuple[str, ...]
    recording: IntArray
    begin: FloatArray
    change: FloatArray
    kinds: tuple[tuple[tuple[int, float], ...], ...]
    parts: tuple[Any, ...]

    def take(self, wanted: BoolArray) -> Windows:
        """Return some of the windows (W,)."""
        parts, first = [], 0
        for part in self.parts:
            own = wanted[first : first + len(part.starts)]
            first += len(part.starts)
            if own.any():
                parts.append(dataclasses.replace(part, starts=part.starts[own]))
        return dataclasses.replace(
            self, recording=self.recording[wanted], begin=self.begin[wanted], change=self.change[wanted], parts=tuple(parts)
        )

    def without(self, recording: int, interval: tuple[float, float]) -> Windows:
        """Return the windows with nothing to judge in a time [s] of a recording."""
        ahead = self.begin[:, None] + np.array(HORIZONS)
        touched = (self.recording == recording)[:, None] & (self.begin[:, None] < interval[1]) & (ahead > interval[0])
        return dataclasses.replace(self, change=np.where(touched[:, :, None], np.nan, self.change))

    def size(self) -> FloatArray:
        """Root mean square change of each signal (H, S), that of all signals of its kind in its own unit."""
        mean = np.nansum(self.change, axis=0) / np.maximum(np.isfinite(self.change).sum(axis=0), 1)
        size = np.zeros_like(mean)
        for kind in self.kinds:
            members = np.array([position for position, _ in kind])
            factors = np.array([factor for _, factor in kind])
            common = np.sqrt(np.mean(mean[:, members] * factors**2, axis=1))
            size[:, members] = common[:, None] / factors
        return np.maximum(size, 1e-12)

    def relative(self, squares: FloatArray) -> FloatArray:
        """Squared errors (W, H, S) over the squared size, NaN where there is nothing to judge by, limited to `RAN_AWAY`."""
        limited = np.nan_to_num(squares, nan=np.inf) / self.size() ** 2
        return np.where(np.isfinite(self.change), np.minimum(limited, RAN_AWAY**2), np.nan)


def window_rows(rate: float, count: int, lead: int) -> tuple[IntArray, list[int]]:
    """First rows (W,) after the lead of the windows in a piece of `count` rows, and the rows of the horizons in a window."""
    marks = [max(1, round(horizon * rate)) for horizon in HORIZONS]
    shortest = marks[min(1, len(marks) - 1)]
    return np.arange(lead, count - shortest, max(1, round(STRIDE * rate)), dtype=np.int64), marks


def rows_of(starts: IntArray, offsets: Sequence[int] | IntArray, count: int) -> tuple[IntArray, FloatArray]:
    """Rows (W, K) at offsets from the starts, the last one where a piece ends before; and 1, or NaN there."""
    rows = starts[:, None] + np.asarray(offsets, dtype=np.int64)
    return np.minimum(rows, count - 1), np.where(rows < count, 1.0, np.nan)
