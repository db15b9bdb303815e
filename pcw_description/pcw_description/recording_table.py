"""The messages of one topic as a table: numbers by field path, stamps, and which rows are fit to use."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from .cdr_columns import decode_columns
from .recording_checks import find_gaps, order_stamps, spans_text
from .recording_files import NANOSECONDS, WarningLog

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
RowArray = npt.NDArray[np.intp]


class MessageTable:
    """All messages of one topic in the order of arrival, T of them.

    Attributes:
        topic: the contract's name.
        groups: the decoded fields, one entry per layout.
        log_time_ns: (T,) when they were recorded [ns].
        stamp_ns: (T,) header stamps [ns]; the times of recording where the headers carry none.
        unstamped: whether they carry none, or there are no headers.
        usable: (T,) those still good.
    """

    def __init__(
        self, topic: str, type_name: str, messages: Sequence[bytes], log_time_ns: Sequence[int], log: WarningLog
    ) -> None:
        self.topic = topic
        self._log = log
        self.groups, damaged = decode_columns(type_name, messages)
        self.log_time_ns: IntArray = np.array(log_time_ns, dtype=np.int64)
        self.usable: npt.NDArray[np.bool_] = np.ones(len(messages), dtype=bool)
        self.usable[damaged] = False
        if len(damaged):
            self.warn("damaged_message", f"{len(damaged)} messages are damaged; left out", len(damaged))
        self.stamp_ns = self._header_stamps()

    def warn(self, code: str, text: str, count: int = 1) -> None:
        """Log a warning about this topic."""
        self._log.warn(code, text, self.topic, count)

    def _header_stamps(self) -> IntArray:
        stamp_ns = self.log_time_ns.copy()
        self.unstamped = True
        if not any("header.stamp.sec" in group.numbers for group in self.groups):
            return stamp_ns  # a type without a header
        for group in self.groups:
            seconds = group.numbers["header.stamp.sec"].astype(np.int64)
            stamp_ns[group.rows] = seconds * NANOSECONDS + group.numbers["header.stamp.nanosec"]
        if np.mean(stamp_ns[self.usable] == 0) > 0.5:
            self.warn("unstamped", "the headers carry no stamps; the times of recording are used")
            return self.log_time_ns.copy()
        self.unstamped = False
        return stamp_ns

    def matrix(self, paths: Sequence[str]) -> FloatArray:
        """Scalar fields as columns (T, len(paths)), NaN in damaged rows."""
        values = np.full((len(self.stamp_ns), len(paths)), np.nan)
        for group in self.groups:
            for column, path in enumerate(paths):
                values[group.rows, column] = group.numbers[path]
        return values

    def text(self, path: str) -> str:
        """A text field, as most messages have it."""
        return str(max(self.groups, key=lambda group: len(group.rows)).strings[path]) if self.groups else ""

    def clean(self, values: FloatArray, t0_ns: int) -> RowArray:
        """The rows of `values` (T, k) that are whole, finite and in order; says what the others were."""
        rows = np.flatnonzero(self.usable)
        finite = np.isfinite(values[rows]).all(axis=1)
        if count := int((~finite).sum()):
            self.warn("non_finite", f"NaN or infinite values in {count} messages; left out", count)
        return self.in_order(rows[finite], t0_ns)

    def in_order(self, rows: RowArray, t0_ns: int | None = None) -> RowArray:
        """The rows whose stamps increase strictly; warnings give times from `t0_ns`, or from the first row."""
        stamp_ns = self.stamp_ns[rows]
        order = order_stamps(stamp_ns)
        if order.keep.all():
            return rows
        if t0_ns is None:
            t0_ns = int(stamp_ns[order.keep][0])
        stamp = (stamp_ns - t0_ns) * 1e-9
        if repeats := int(order.repeats.sum()):
            first = stamp[np.flatnonzero(order.repeats)[0]]
            text = f"{repeats} messages repeat the stamp of the one before, first at {first:.3f} s; left out"
            self.warn("repeated_stamp", text, repeats)
        if jumps := int(order.backward.sum()):
            first = stamp[np.flatnonzero(order.backward)[0] - 1]
            dropped = max(0, int((~order.keep).sum()) - repeats)
            text = (
                f"the stamps jump back in time {'once' if jumps == 1 else f'{jumps} times'}, by up to "
                f"{order.largest_jump:.3f} s, first after {first:.3f} s; {dropped} messages that do not fit into one "
                "increasing time were left out"
            )
            self.warn("backward_jump", text, jumps)
        return rows[order.keep]

    def warn_of_gaps(self, stamp: FloatArray) -> None:
        """Name the gaps between stamps (T,) [s]."""
        after, limit = find_gaps(stamp)
        if len(after):
            text = (
                f"{len(after)} {'gap' if len(after) == 1 else 'gaps'} longer than {limit:.3f} s (typical period "
                f"{np.median(np.diff(stamp)):.4f} s): {spans_text(stamp, after)}"
            )
            self.warn("gap", text, len(after))
