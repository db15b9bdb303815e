"""Turns columns of text into a recording: public data sets, and logs of robots without ROS.

    import_columns log.txt --mapping mapping.yaml --out runs/imported

Rows with no stamp that can be read are left out and told; an empty cell, or `nan`, is a quantity that was not measured in
that row. Lines that begin with # are skipped.
"""

from __future__ import annotations

import argparse
import csv
import gzip
import math
import shutil
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt

from .column_mapping import (
    COMMAND_QUANTITIES,
    DELIMITERS,
    IMU_QUANTITIES,
    JOINT_QUANTITIES,
    TRACKER_QUANTITIES,
    ColumnMapping,
    ColumnSource,
    factor,
    load_column_mapping,
)
from .errors import PcwError, RecordingError, nearest_name
from .recording_writer import RecordingWriter
from .robot_description import GRAVITY
from .ros_messages import imu, joint_state, odometry

FloatArray = npt.NDArray[np.float64]

ABSENT = ("", "nan", "none", "null", "na", "-")  # of a cell, in any case
# A stamp of zero means "no stamp" in ROS: what begins before one second is moved to begin there.
FIRST_STAMP = 1.0  # [s]
SNIFFED_LINES = 20


class ColumnTable:
    """The rows of a text file, whose columns are read as numbers when they are asked for."""

    def __init__(self, path: Path, mapping: ColumnMapping) -> None:
        """Read a file.

        Raises:
            RecordingError: absent, not text, or without rows.
        """
        self.path = path
        self.unreadable = 0
        lines = [line for line in _text(path).splitlines() if line.strip() and not line.lstrip().startswith("#")]
        delimiter = DELIMITERS[mapping.delimiter] if mapping.delimiter else _delimiter(lines[:SNIFFED_LINES])
        self._rows = [_cells(line, delimiter) for line in lines]
        columns = [source.column for _, _, source in mapping.sources()]
        named = any(isinstance(column, str) for column in columns)
        numbers = [column for column in columns if isinstance(column, int)]
        # A first row with words in the columns of numbers is a header, and so is that of columns with names.
        is_header = named or any(_number(_cell(self._rows[0], column)) is None for column in numbers) if lines else False
        self.header = self._rows.pop(0) if is_header else []
        if not self._rows:
            raise RecordingError(f"{path}: no rows; allowed: lines of numbers")

    def __len__(self) -> int:
        return len(self._rows)

    def column(self, source: ColumnSource, where: str) -> FloatArray:
        """Return the numbers of a column (T,); NaN where there is none.

        Raises:
            RecordingError: no such column, or nothing in it that is a number.
        """
        index = source.column
        if isinstance(index, str):
            if index not in self.header:
                raise RecordingError(f"{self.path}: {where}.column: no column {index!r}; {nearest_name(index, self.header)}")
            index = self.header.index(index)
        widest = max(len(row) for row in self._rows)
        if index >= widest:
            raise RecordingError(f"{self.path}: {where}.column: {index} is not allowed; allowed: 0 to {widest - 1}")
        numbers = [_number(_cell(row, index)) for row in self._rows]
        wrong = [row for row, number in enumerate(numbers) if number is None]
        values = np.array([math.nan if number is None else number for number in numbers])
        if not np.isfinite(values).any():
            cell = _cell(self._rows[0], index)
            raise RecordingError(f"{self.path}: {where}.column: column {index} holds no number but {cell!r}; allowed: numbers")
        self.unreadable += len(wrong)
        return values


def put_on_end(values: FloatArray, wraps: float) -> FloatArray:
    """Return the numbers (T,) of a counter without its turns: between two it moved by less than half of `wraps`."""
    known = np.flatnonzero(np.isfinite(values))
    steps = np.diff(values[known])
    steps -= wraps * np.round(steps / wraps)
    first = values[known[0]] - wraps * np.round(values[known[0]] / wraps)
    whole = values.copy()
    whole[known] = first + np.concatenate([[0.0], np.cumsum(steps)])
    return whole


def import_columns(path: Path, mapping: ColumnMapping, out: Path) -> tuple[dict[str, int], list[str]]:
    """Write the recording that a text file holds.

    Args:
        path: of the text file, or of a .gz of it.
        mapping: what stands where.
        out: folder to make.

    Returns:
        Number of messages by topic, and what was wrong, in words.

    Raises:
        RecordingError: the file cannot be read, a column is not there, or `out` exists.
    """
    table = ColumnTable(path, mapping)
    signals = {}
    for where, kind, source in mapping.sources():
        numbers = table.column(source, where)
        if source.wraps is not None:
            numbers = put_on_end(numbers, source.wraps)
        signals[where] = numbers * factor(kind, source) + source.offset
    warnings = _partly_mapped(mapping)
    warnings += [f"{table.unreadable} cells are no numbers and are taken for absent"] if table.unreadable else []
    time = signals["time"] if mapping.time is not None else np.arange(len(table)) / (mapping.rate or 1.0)
    stamped = np.isfinite(time)
    if not stamped.all():
        warnings.append(f"{int(np.sum(~stamped))} of {len(time)} rows have no stamp and are left out")
    if float(time[stamped].min()) < FIRST_STAMP:
        moved = FIRST_STAMP - float(time[stamped].min())
        time = time + moved
        warnings.append(f"stamps are moved by {moved:g} s: in ROS a stamp of zero is none")
    stamps = [int(round(value * 1e9)) for value in np.where(stamped, time, 0.0)]
    writer = RecordingWriter(out, flush_interval=None)
    try:
        with writer:
            _write(writer, mapping, signals, stamps, stamped)
    except BaseException:
        shutil.rmtree(writer.path)
        raise
    return writer.counts, warnings


def _write(
    writer: RecordingWriter,
    mapping: ColumnMapping,
    signals: dict[str, FloatArray],
    stamps: Sequence[int],
    stamped: npt.NDArray[np.bool_],
) -> None:
    """Write every row, as far as what belongs together in it was measured: a field of all joints, a pose, an IMU's reading."""
    names = list(mapping.joints)
    joints = [_together(signals, [f"joints.{name}.{field}" for name in names]) for field in JOINT_QUANTITIES]
    # Not every joint is commanded: a message is about those that are.
    told = {field: [name for name in names if f"joints.{name}.{field}" in signals] for field in COMMAND_QUANTITIES}
    speeds, torques = (_together(signals, [f"joints.{name}.{field}" for name in own]) for field, own in told.items())
    pose = _together(signals, [f"tracker.{key}" for key in TRACKER_QUANTITIES])
    inertial = _together(signals, [f"imu.{key}" for key in IMU_QUANTITIES])
    for row in map(int, np.flatnonzero(stamped)):
        stamp = stamps[row]
        position, velocity, effort = (_measured(values, row) for values in joints)
        if position is not None or velocity is not None or effort is not None:
            writer.write("/joint_states", joint_state(stamp, names, position, velocity, effort))
        if (wanted := _measured(speeds, row)) is not None:
            writer.write("/joint_commands", joint_state(stamp, told["commanded_velocity"], velocity=wanted))
        if (wanted := _measured(torques, row)) is not None:
            writer.write("/joint_commands", joint_state(stamp, told["commanded_effort"], effort=wanted))
        place, sensed = _measured(pose, row), _measured(inertial, row)
        if place is not None and mapping.tracker is not None:
            frames = {"frame_id": mapping.tracker.frame, "child_frame_id": mapping.tracker.child_frame}
            writer.write("/ground_truth/odom", odometry(stamp, place, np.zeros(3), **frames))
        if sensed is not None:
            rate, along, across = sensed
            writer.write("/imu/data", imu(stamp, (0.0, 0.0, rate), (along, across, GRAVITY)))


def _together(signals: dict[str, FloatArray], keys: Sequence[str]) -> FloatArray | None:
    """Signals (T, K) that make sense together alone; None if one of them is not mapped, or there are none."""
    return np.stack([signals[key] for key in keys], axis=1) if keys and all(key in signals for key in keys) else None


def _measured(values: FloatArray | None, row: int) -> FloatArray | None:
    return values[row] if values is not None and np.isfinite(values[row]).all() else None


def _partly_mapped(mapping: ColumnMapping) -> list[str]:
    """Say which fields are left out since not every joint has them: a message has a field of all its joints, or of none."""
    found = []
    for field in JOINT_QUANTITIES:
        lacking = [name for name, joint in mapping.joints.items() if getattr(joint, field) is None]
        if lacking and len(lacking) < len(mapping.joints):
            found.append(f"{field} is left out: {', '.join(lacking)} have none, and a message has it for all joints or none")
    return found


def _text(path: Path) -> str:
    try:
        if path.name.lower().endswith(".gz"):
            with gzip.open(path, "rt", encoding="utf-8-sig") as compressed:
                return compressed.read()
        return path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError:
        raise RecordingError(f"{path}: it is not text; allowed: columns of text, or a .gz of them") from None
    except (OSError, EOFError) as error:
        raise RecordingError(f"{path}: cannot be read ({getattr(error, 'strerror', None) or error})") from None


def _delimiter(lines: Sequence[str]) -> str | None:
    """What parts the columns: the first of semicolon, tab and comma that every line has, else white space."""
    return next((mark for mark in ";\t," if lines and all(mark in line for line in lines)), None)


def _cells(line: str, delimiter: str | None) -> list[str]:
    if delimiter is None:
        return line.split()
    return [cell.strip() for cell in next(csv.reader([line], delimiter=delimiter, skipinitialspace=True))]


def _cell(row: Sequence[str], index: int) -> str:
    return row[index] if index < len(row) else ""


def _number(cell: str) -> float | None:
    """The number of a cell; NaN for an empty one, None for what is no number."""
    if cell.lower() in ABSENT:
        return math.nan
    try:
        return float(cell)
    except ValueError:
        return None


def main(arguments: Sequence[str] | None = None) -> int:
    """Import a text file; exit 0, or 2 with one line that says what is wrong."""
    parser = argparse.ArgumentParser(prog="import_columns", description="Turn columns of text into a recording.")
    parser.add_argument("file", type=Path, metavar="FILE", help="columns of text, or a .gz of them")
    parser.add_argument("--mapping", type=Path, required=True, help="what stands where: a file of the format pcw_columns/1")
    parser.add_argument("--out", type=Path, required=True, metavar="BAG", help="folder to make; one that exists is left alone")
    options = parser.parse_args(arguments)
    try:
        counts, warnings = import_columns(options.file, load_column_mapping(options.mapping), options.out)
    except PcwError as error:
        print(f"import_columns: {error}", file=sys.stderr)
        return 2
    for warning in warnings:
        print(f"import_columns: {options.file}: {warning}", file=sys.stderr)
    print(f"{options.out}: " + ", ".join(f"{count} {topic.lstrip('/')}" for topic, count in sorted(counts.items())))
    return 0


if __name__ == "__main__":
    sys.exit(main())
