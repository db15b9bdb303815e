"""JointState messages as arrays in the robot's order, whatever order, company or number of messages they came in."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
import numpy.typing as npt

from .cdr_columns import CdrColumns
from .errors import RecordingError
from .recording_joint_units import correct_units
from .recording_series import JointSeries
from .recording_table import FloatArray, IntArray, MessageTable, RowArray
from .robot_description import AXIS_NAMES, RobotDescription

FIELDS = ("position", "velocity", "effort")
POSITION, VELOCITY, EFFORT = range(3)
# A field that is NaN more often than this was not measured; less often, the messages are bad.
UNMEASURED_SHARE = 0.5
# So few messages without some joints are dropped; more of them are used as they are.
FEW = 0.05
# A joint whose position has changed by more has moved [rad].
MOVED = 0.1
COASTING = 5.0  # [s] for which a robot may roll without any torque


def read_joint_series(
    table: MessageTable, robot: RobotDescription | None, measured: bool, t0_ns: int | None = None
) -> JointSeries | None:
    """Read a topic of JointStates; None if no message is usable.

    Args:
        table: its messages.
        robot: gives the joints, their order and the shape (T, n, 2); without one, the joints are those of the
            messages and the shape is (T, m).
        measured: whether these are measurements, with position, velocity and effort in every message, or commands.
        t0_ns: start of relative time [ns]; the first usable message if None.

    Raises:
        RecordingError: none of the robot's joints is in any message.
    """
    names = robot.joint_names if robot is not None else _names_in(table.groups)
    joints = _JointTable(table, names)
    if not joints.ever_present.any():
        found = list_names(_names_in(table.groups)) or "no name at all"
        raise RecordingError(f"none of the joints {list_names(names)} is in it but {found}")
    if robot is not None:
        _warn_of_missing_joints(table, joints, robot)
    stamp_ns, values = _merged(table, joints, t0_ns)
    if not len(stamp_ns):
        return None
    stamp = (stamp_ns - (stamp_ns[0] if t0_ns is None else t0_ns)) * 1e-9
    table.warn_of_gaps(stamp)
    if measured:
        _leave_out_idle_fields(table, joints, values, stamp)
        _warn_of_missing_fields(table, joints, values)
        correct_units(stamp, names, robot, values[POSITION], values[VELOCITY], table.warn)
    else:
        both = (np.isfinite(values[VELOCITY]) & np.isfinite(values[EFFORT])).any(axis=1)
        if count := int(both.sum()):
            table.warn("both_commands", f"{count} messages set velocity and effort of one joint; only one may be set", count)
    shape = (len(stamp), -1, len(AXIS_NAMES)) if robot is not None else (len(stamp), len(names))
    return JointSeries(stamp, stamp_ns, tuple(names), *(column.reshape(shape) for column in values))


class _JointTable:
    """JointStates as arrays over joints, m of them.

    Attributes:
        values: (3, T, m) position, velocity, effort.
        sent: (3, T, m) whether the message had a value there.
        present: (T, m) whether the message named the joint; `ever_present` (m,) whether any did.
    """

    def __init__(self, table: MessageTable, names: Sequence[str]) -> None:
        self.names = tuple(names)
        length, width = len(table.stamp_ns), len(self.names)
        self.values: FloatArray = np.full((len(FIELDS), length, width), np.nan)
        self.sent = np.zeros((len(FIELDS), length, width), dtype=bool)
        self.present = np.zeros((length, width), dtype=bool)
        place = {name: column for column, name in enumerate(self.names)}
        unequal = 0
        for group in table.groups:
            own = group.strings["name"]
            if any(group.numbers[name].shape[1] not in (0, len(own)) for name in FIELDS):
                unequal += len(group.rows)
                table.usable[group.rows] = False
                continue
            pairs = [(index, place[name]) for index, name in enumerate(own) if name in place]
            if not pairs:
                continue
            source, target = (np.array(side) for side in zip(*pairs))
            cells = np.ix_(group.rows, target)
            self.present[cells] = True
            for kind, name in enumerate(FIELDS):
                if group.numbers[name].shape[1]:
                    self.values[kind][cells] = group.numbers[name][:, source]
                    self.sent[kind][cells] = True
        if unequal:
            text = f"{unequal} messages have arrays of another length than their names; left out"
            table.warn("damaged_message", text, unequal)
        self.ever_present: npt.NDArray[np.bool_] = np.asarray(self.present.any(axis=0))


# --- Joints that are missing ----------------------------------------------------------------------------


def _warn_of_missing_joints(table: MessageTable, joints: _JointTable, robot: RobotDescription) -> None:
    missing = {name for name, there in zip(joints.names, joints.ever_present) if not there}
    for caster in robot.caster_names:
        gone = [name for name in (f"{caster}_{axis}" for axis in AXIS_NAMES) if name in missing]
        if len(gone) == len(AXIS_NAMES):
            text = f"caster {caster} is missing: {' and '.join(gone)} are in no message; their values are NaN"
            table.warn("missing_caster", text)
        elif gone:
            table.warn("missing_joint", f"joint {gone[0]} is in no message; its values are NaN")


def _warn_of_missing_fields(table: MessageTable, joints: _JointTable, values: FloatArray) -> None:
    for kind, name in enumerate(FIELDS):
        absent = joints.ever_present & ~np.isfinite(joints.values[kind]).any(axis=0)
        if count := int(absent.sum()):
            everywhere = count == joints.ever_present.sum()
            which = "any joint" if everywhere else list_names(np.array(joints.names)[absent])
            table.warn("missing_field", f"no {name} of {which} was measured; it is NaN", count)


def _leave_out_idle_fields(table: MessageTable, joints: _JointTable, values: FloatArray, stamp: FloatArray) -> None:
    """Some drivers send zeros for what they do not measure; in place, on values (3, T, m) at stamps (T,) [s].

    A joint that moves has a velocity. It may have no torque, and a robot that coasts may have none for a while; that none of
    several joints ever has any is no measurement.
    """
    there = np.flatnonzero(joints.ever_present)
    moving = there[np.ptp(values[POSITION][:, there], axis=0) > MOVED]
    still = moving[~values[VELOCITY][:, moving].any(axis=0)]
    _leave_out(table, joints, values, VELOCITY, still)
    if len(moving) > 1 and stamp[-1] - stamp[0] > COASTING and not values[EFFORT][:, there].any():
        _leave_out(table, joints, values, EFFORT, there)


def _leave_out(table: MessageTable, joints: _JointTable, values: FloatArray, kind: int, columns: IntArray) -> None:
    if len(columns):
        values[kind][:, columns] = np.nan
        which = "every joint" if len(columns) == joints.ever_present.sum() else list_names(np.array(joints.names)[columns])
        text = f"the {FIELDS[kind]} of {which} is 0 throughout although the position moves: not measured; it is left out (NaN)"
        table.warn("missing_field", text, len(columns))


# --- From messages to one stream ------------------------------------------------------------------------


def _merged(table: MessageTable, joints: _JointTable, t0_ns: int | None) -> tuple[IntArray, FloatArray]:
    """Stamps (T,) and values (3, T, m) of one stream, whether joints come together or in separate messages."""
    streams = [_cleaned(table, joints, rows, t0_ns) for rows in _streams(table, joints)]
    main = max(streams, key=len)
    stamp_ns, values = table.stamp_ns[main], joints.values[:, main]
    stamp = (stamp_ns - stamp_ns[:1]) * 1e-9
    for rows in streams:
        if rows is main or not len(rows):
            continue
        own_stamp = (table.stamp_ns[rows] - stamp_ns[0]) * 1e-9
        nearest = np.searchsorted(0.5 * (own_stamp[1:] + own_stamp[:-1]), stamp)
        for column in np.flatnonzero(joints.present[rows].any(axis=0)):
            for kind in (POSITION, VELOCITY):
                values[kind, :, column] = np.interp(stamp, own_stamp, joints.values[kind, rows, column])
            # A motor holds its torque from one command to the next: between two readings there is none like either.
            values[EFFORT, :, column] = joints.values[EFFORT, rows[nearest], column]
    return stamp_ns, values


def _streams(table: MessageTable, joints: _JointTable) -> list[RowArray]:
    """Rows of each stream: one, or several when drivers send their joints in messages of their own."""
    rows = np.flatnonzero(table.usable & joints.present.any(axis=1))
    names = np.array(joints.names)[joints.ever_present]
    present = joints.present[np.ix_(rows, np.flatnonzero(joints.ever_present))]
    complete = present.all(axis=1)
    incomplete = int((~complete).sum())
    if not incomplete:
        return [rows]
    if incomplete < FEW * len(rows):
        lacking = list_names(names[~present[~complete].all(axis=0)])
        table.warn("incomplete_message", f"{incomplete} messages lack some joints ({lacking}); left out", incomplete)
        return [rows[complete]]
    patterns, pattern_of = np.unique(present, axis=0, return_inverse=True)
    if (patterns.sum(axis=0) == 1).all():
        text = (
            f"the joints come in {len(patterns)} separate messages; brought to the stamps of one of them, efforts those of "
            "the nearest and the rest by linear interpolation"
        )
        table.warn("split_message", text, len(patterns))
        # numpy 2.0 alone gives the inverse two dimensions
        return [rows[pattern_of.ravel() == pattern] for pattern in range(len(patterns))]
    lacking = list_names(names[~present.all(axis=0)])
    text = f"{incomplete} of {len(rows)} messages lack some joints ({lacking}); their values are NaN there"
    table.warn("incomplete_message", text, incomplete)
    return [rows]


def _cleaned(table: MessageTable, joints: _JointTable, rows: RowArray, t0_ns: int | None) -> RowArray:
    """Rows without NaN, in order; a field that is mostly NaN is not measured and stays NaN in all rows."""
    broken = joints.sent[:, rows] & ~np.isfinite(joints.values[:, rows])
    if broken.any():
        sent = np.maximum(joints.sent[:, rows].sum(axis=1), 1)
        unmeasured = broken.sum(axis=1) > UNMEASURED_SHARE * sent  # (3, m)
        for kind, column in np.argwhere(unmeasured):
            joints.values[kind, rows, column] = np.nan
        broken &= ~unmeasured[:, None, :]
        bad = broken.any(axis=(0, 2))
        if count := int(bad.sum()):
            which = [f"{FIELDS[kind]} of {joints.names[column]}" for kind, column in np.argwhere(broken.any(axis=1))]
            table.warn("non_finite", f"NaN or infinite values in {count} messages ({list_names(which)}); left out", count)
        rows = rows[~bad]
    return table.in_order(rows, t0_ns)


def _names_in(groups: Sequence[CdrColumns]) -> tuple[str, ...]:
    """All joint names, in the order in which they first come."""
    names: dict[str, None] = {}
    for group in sorted(groups, key=lambda group: int(group.rows[0])):
        names.update(dict.fromkeys(group.strings["name"]))
    return tuple(names)


def list_names(names: Iterable[str], most: int = 8) -> str:
    """Names for a sentence, cut off after `most`."""
    listed = list(names)
    return ", ".join(listed[:most]) + (f" and {len(listed) - most} more" if len(listed) > most else "")
