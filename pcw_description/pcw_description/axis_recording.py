"""The format `pcw_axis/1`: one drive on a bench, and how to read its recordings.

A bench axis is one motor with a measured position and a measured (or commanded) force. Its nominal model is

    force + external_force = inertia * acceleration + gravity_moment * sin(position - hanging_position)

(the gravity arm only where the description gives one). Everything else the axis does is a mismatch with that model, and
has a name under `physics:` as on a robot; the target of every effect of a bench axis is `axis`.

The same names serve both kinds of axis: `force` is in N on a linear axis and in N m on a rotary one, `inertia` in kg
or kg m^2, `position` in m or rad. `AxisDescription.unit` turns the units of the vocabulary into those of the axis.
"""

from __future__ import annotations

import csv
import dataclasses
import gzip
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from .description_fields import parsed_file, quantity, read_provenance, read_section, section, text
from .effect_instance import EffectInstance
from .effects.registry import read_physics
from .errors import DescriptionError, PcwError, nearest_name
from .robot_description import Tolerance
from .robot_file import read_tolerances

FORMAT = "pcw_axis/1"
TARGET = "axis"
KINDS = ("linear", "rotary")
SIGNALS = ("time", "position", "velocity", "force", "external_force")
SUFFIXES = (".csv", ".txt", ".tsv", ".csv.gz", ".npy", ".npz", ".mat")

FloatArray = npt.NDArray[np.float64]

# Factor to SI of every unit a column may have, by kind of axis and signal.
_TIME_UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
_TURN = 2.0 * math.pi
UNITS: Mapping[str, Mapping[str, Mapping[str, float]]] = {
    "linear": {
        "time": _TIME_UNITS,
        "position": {"m": 1.0, "mm": 1e-3, "um": 1e-6},
        "velocity": {"m/s": 1.0, "mm/s": 1e-3},
        "force": {"N": 1.0, "mN": 1e-3, "kN": 1e3},
        "external_force": {"N": 1.0, "mN": 1e-3, "kN": 1e3},
    },
    "rotary": {
        "time": _TIME_UNITS,
        "position": {"rad": 1.0, "deg": math.radians(1.0), "rev": _TURN},
        "velocity": {"rad/s": 1.0, "deg/s": math.radians(1.0), "rev/s": _TURN, "rpm": _TURN / 60.0},
        "force": {"N m": 1.0, "mN m": 1e-3},
        "external_force": {"N m": 1.0, "mN m": 1e-3},
    },
}
# The vocabulary of effects is that of a wheel; these are its units on a linear axis.
_LINEAR_UNITS = {
    "N m": "N",
    "N m s/rad": "N s/m",
    "rad/s": "m/s",
    "1/rad": "1/m",
    "rad": "m",
    "kg m^2": "kg",
    "N m s^2/rad^2": "N s^2/m^2",
}
# A force that is held between samples acts half a sample late on average: no recording is aligned better than that.
_CLOCK = Tolerance(0.5, "samples", False)
DEFAULT_TOLERANCES: Mapping[str, Mapping[str, Tolerance]] = {
    "linear": {"inertia": Tolerance(0.05, "kg", True), "clock_offset": _CLOCK},
    "rotary": {
        "inertia": Tolerance(0.05, "kg m^2", True),
        "gravity_moment": Tolerance(0.05, "N m", True),
        "hanging_position": Tolerance(0.02, "rad", False),
        "clock_offset": _CLOCK,
    },
}


class AxisRecordingError(PcwError):
    """A recording of a bench axis that cannot be read; the message names the file and what was expected."""


@dataclasses.dataclass(frozen=True)
class Column:
    """Where one signal stands in the file. Value in SI = value in the file * scale * factor of the unit."""

    column: Any = section("name (CSV header, MAT variable, NPZ key) or number counted from 0 (CSV, NPY)")
    unit: str = text("unit after multiplication by `scale`", default="")
    scale: float = quantity(
        "",
        "unit per number in the file: N per V, rad per count; its sign turns the axis round",
        default=1.0,
        minimum=-1e12,
        maximum=1e12,
    )


@dataclasses.dataclass(frozen=True)
class GravityArm:
    """An arm or an unbalanced load that gravity pulls towards its hanging position."""

    moment: float = quantity("N m", "largest torque of gravity: mass * g * lever", above=0.0, maximum=1e6)
    hanging_position: float = quantity(
        "rad", "position at which the arm hangs at rest", default=0.0, minimum=-1e4, maximum=1e4
    )


@dataclasses.dataclass(frozen=True)
class AxisDescription:
    """A bench axis, validated when it is made."""

    format: str = text("format of this file", choices=(FORMAT,))
    name: str = text("name of the axis")
    kind: str = text("linear (m, N) or rotary (rad, N m)", choices=KINDS)
    provenance: dict[str, str] = section("where each number comes from")
    columns: dict[str, Column] = section("where each signal stands: " + ", ".join(SIGNALS))
    inertia: float = quantity(
        "kg or kg m^2", "moving mass or inertia seen at the measured position", above=0.0, maximum=1e6
    )
    rate: float | None = quantity(
        "Hz", "sampling rate, where there is no time column", above=0.0, maximum=1e6, default=None
    )
    gravity_arm: GravityArm | None = section("gravity on an unbalanced rotary axis", default=None)
    tolerances: dict[str, Tolerance] = section("how far a healthy axis may differ", default_factory=dict)
    physics: tuple[EffectInstance, ...] = section("effects beyond the nominal model", default=())

    def __post_init__(self) -> None:
        """Check what no single field can see.

        Raises:
            DescriptionError: no force, no motion, no time base, a unit of another kind, gravity on a linear axis.
        """
        known = UNITS[self.kind]
        for signal, column in self.columns.items():
            if column.scale == 0.0:
                raise DescriptionError(f"columns.{signal}.scale", 0.0, "allowed: a number other than zero")
            if column.unit not in known[signal]:
                units = ", ".join(known[signal])
                raise DescriptionError(
                    f"columns.{signal}.unit", column.unit, f"allowed on a {self.kind} axis: {units}"
                )
        if "force" not in self.columns:
            raise DescriptionError(
                "columns.force", None, "required key is missing; the measured or commanded force or torque"
            )
        if not {"position", "velocity"} & set(self.columns):
            raise DescriptionError(
                "columns.position", None, "required key is missing; the position, or at least the velocity"
            )
        if ("time" in self.columns) == (self.rate is not None):
            found = "both" if self.rate is not None else None
            raise DescriptionError("rate", found, "allowed: either a time column or a rate in Hz")
        if self.gravity_arm is not None and self.kind != "rotary":
            raise DescriptionError(
                "gravity_arm", "linear axis", "allowed on a rotary axis only; a slope is a constant_load"
            )

    def unit(self, unit: str) -> str:
        """Return a unit of the vocabulary of effects as it is on this axis."""
        return _LINEAR_UNITS.get(unit, unit) if self.kind == "linear" else unit

    def tolerance(self, name: str) -> Tolerance:
        """Return the tolerance of this file, or the documented default."""
        return self.tolerances.get(name, DEFAULT_TOLERANCES[self.kind][name])


@dataclasses.dataclass(frozen=True)
class AxisRecording:
    """One recording of a bench axis in SI units; arrays (T,), stamps strictly increasing, no NaN.

    Gaps stay in `time`: whoever differentiates must look at the steps.
    """

    path: Path
    time: FloatArray
    position: FloatArray
    velocity: FloatArray | None
    force: FloatArray
    external_force: FloatArray
    warnings: tuple[str, ...]

    @property
    def duration(self) -> float:
        """Time from the first to the last sample [s]."""
        return float(self.time[-1] - self.time[0])


def parse_axis_description(data: Mapping[str, Any]) -> AxisDescription:
    """Read an axis description from a mapping, as it comes from YAML.

    Raises:
        DescriptionError: names the key, the value and what is allowed.
    """
    content = dict(data)
    if content.get("format") != FORMAT:
        raise DescriptionError("format", content.get("format"), f"allowed: {FORMAT}")
    kind = content.get("kind")
    if kind not in KINDS:
        raise DescriptionError("kind", kind, f"allowed: {', '.join(KINDS)}")
    content["columns"] = _read_columns(content.get("columns"), kind)
    content["provenance"] = read_provenance(content.get("provenance"))
    content["tolerances"] = read_tolerances(content.get("tolerances") or {}, DEFAULT_TOLERANCES[kind])
    content["physics"] = read_physics(content.get("physics") or [], (TARGET,))
    axis: AxisDescription = read_section(AxisDescription, content, "")
    return axis


def load_axis_description(path: str | Path) -> AxisDescription:
    """Load an axis description from a YAML file.

    Raises:
        DescriptionError: the file is absent or not valid.
    """
    return parsed_file(path, parse_axis_description)


def axis_to_mapping(axis: AxisDescription) -> dict[str, Any]:
    """Return the mapping that `parse_axis_description` reads back to an equal axis."""
    data: dict[str, Any] = {
        "format": axis.format,
        "name": axis.name,
        "kind": axis.kind,
        "provenance": dict(axis.provenance),
    }
    data["columns"] = {name: dataclasses.asdict(column) for name, column in axis.columns.items()}
    if axis.rate is not None:
        data["rate"] = axis.rate
    data["inertia"] = axis.inertia
    if axis.gravity_arm is not None:
        data["gravity_arm"] = dataclasses.asdict(axis.gravity_arm)
    if axis.tolerances:
        data["tolerances"] = {name: str(tolerance) for name, tolerance in axis.tolerances.items()}
    data["physics"] = [effect.to_mapping() for effect in axis.physics]
    return data


def _read_columns(data: object, kind: str) -> dict[str, Column]:
    if not isinstance(data, Mapping):
        raise DescriptionError(
            "columns", data, f"allowed: a mapping of signals ({', '.join(SIGNALS)}) to columns"
        )
    columns = {}
    for signal, value in data.items():
        where = f"columns.{signal}"
        if signal not in SIGNALS:
            raise DescriptionError(where, value, f"unknown key; {nearest_name(str(signal), SIGNALS)}")
        entry = {"column": value} if isinstance(value, (str, int)) and not isinstance(value, bool) else value
        column: Column = read_section(Column, entry, where)
        name = column.column
        if isinstance(name, bool) or not isinstance(name, (str, int)) or (isinstance(name, int) and name < 0):
            raise DescriptionError(f"{where}.column", name, "allowed: a name, or a number counted from 0")
        si_unit = next(iter(UNITS[kind][signal]))
        columns[str(signal)] = column if column.unit else dataclasses.replace(column, unit=si_unit)
    return columns


def read_axis_recording(path: str | Path, axis: AxisDescription) -> AxisRecording:
    """Read one recording through the columns of its description.

    Rows with NaN, repeated stamps and stamps that jump back are left out, and each kind is reported in `warnings`.

    Raises:
        AxisRecordingError: file absent or unreadable, column missing, columns of different length, too few usable rows.
    """
    path = Path(path)
    if not path.is_file():
        what = "it is a folder; allowed for a bench axis: a file" if path.is_dir() else "no such file"
        raise AxisRecordingError(f"{path}: {what}")
    table = _open_table(path)
    signals = {}
    for signal, column in axis.columns.items():
        factor = column.scale * UNITS[axis.kind][signal][column.unit]
        signals[signal] = factor * _column(table, column.column, signal, path)
    lengths = {signal: len(values) for signal, values in signals.items()}
    if len(set(lengths.values())) > 1:
        raise AxisRecordingError(f"{path}: columns of different length: {lengths}")
    warnings: list[str] = []
    rows = next(iter(lengths.values()))
    if axis.rate is not None:
        signals["time"] = np.arange(rows) / axis.rate

    usable = np.all([np.isfinite(values) for values in signals.values()], axis=0)
    if not usable.all():
        warnings.append(f"{rows - int(usable.sum())} of {rows} rows hold NaN or infinity and were left out")
        signals = {signal: values[usable] for signal, values in signals.items()}
    time = signals["time"]
    if len(time) > 1:
        latest = np.maximum.accumulate(time)
        ahead = np.r_[True, time[1:] > latest[:-1]]
        repeats, jumps = int(np.sum(np.diff(time) == 0.0)), int(np.sum(np.diff(time) < 0.0))
        if repeats:
            warnings.append(f"{repeats} repeated time stamps were left out")
        if jumps:
            warnings.append(
                f"time jumps back {jumps} times; {int(np.sum(~ahead)) - repeats} samples of the past were left out"
            )
        signals = {signal: values[ahead] for signal, values in signals.items()}
        time = signals["time"]
    if len(time) < 10:
        raise AxisRecordingError(f"{path}: {len(time)} usable rows; at least 10 are needed")
    step = float(np.median(np.diff(time)))
    gaps = np.diff(time) > max(5.0 * step, 0.02)
    if gaps.any():
        lost = float(np.sum(np.diff(time)[gaps]))
        warnings.append(f"{int(gaps.sum())} gaps in time, together {lost:.3g} s")

    velocity = signals.get("velocity")
    if "position" in signals:
        position = signals["position"]
        if velocity is not None:
            warnings.extend(_unit_warnings(time, position, velocity))
    else:
        assert velocity is not None  # checked by the description
        position = np.r_[0.0, np.cumsum(0.5 * (velocity[1:] + velocity[:-1]) * np.diff(time))]
        warnings.append("no position column: position is the integral of velocity, its zero is arbitrary")
    return AxisRecording(
        path=path,
        time=time,
        position=position,
        velocity=velocity,
        force=signals["force"],
        external_force=signals.get("external_force", np.zeros_like(time)),
        warnings=tuple(warnings),
    )


def _unit_warnings(time: FloatArray, position: FloatArray, velocity: FloatArray) -> list[str]:
    """Compare the velocity column with the derivative of the position column: a wrong unit shows as a factor."""
    travelled = float(np.sum(np.abs(np.diff(position))))
    integrated = float(np.sum(0.5 * np.abs(velocity[1:] + velocity[:-1]) * np.diff(time)))
    if travelled <= 0.0 or integrated <= 0.0:
        return []
    ratio = travelled / integrated
    for name, factor in (
        ("degrees", 180.0 / math.pi),
        ("turns", 1.0 / _TURN),
        ("rpm", 30.0 / math.pi),
        ("mm", 1e3),
    ):
        for seen, what in ((ratio * factor, "velocity"), (ratio / factor, "position")):
            if abs(seen - 1.0) < 0.05:
                return [
                    f"{what} looks as if it were in {name}: position changes {ratio:.4g} times what velocity says"
                ]
    return []


def _open_table(path: Path) -> Mapping[str, Any] | FloatArray:
    """Return the file as an array (rows, columns), or as a mapping of names to arrays."""
    name = path.name.lower()
    if not name.endswith(SUFFIXES):
        raise AxisRecordingError(f"{path}: unknown kind of file; allowed: {', '.join(SUFFIXES)}")
    try:
        if name.endswith(".mat"):
            from scipy.io import loadmat

            return {key: value for key, value in loadmat(path).items() if not key.startswith("__")}
        if name.endswith(".npz"):
            with np.load(path, allow_pickle=False) as archive:
                return {key: archive[key] for key in archive.files}
        if name.endswith(".npy"):
            array = np.load(path, allow_pickle=False)
            if array.dtype.names:
                return {key: array[key] for key in array.dtype.names}
            array = np.atleast_2d(np.asarray(array, dtype=float))
            if array.ndim != 2:
                raise AxisRecordingError(
                    f"{path}: array of shape {array.shape}; allowed: (columns, samples) or (samples, columns)"
                )
            # Recordings are longer than they have columns, whichever way the array lies.
            return array.T if array.shape[0] < array.shape[1] else array
        return _read_csv(path)
    except AxisRecordingError:
        raise
    except NotImplementedError:
        raise AxisRecordingError(f"{path}: MAT file of version 7.3; save it with '-v7' or as CSV") from None
    except (
        Exception
    ) as error:  # the readers of others raise whatever they like; the user needs the file's name
        raise AxisRecordingError(
            f"{path}: cannot be read ({' '.join(str(error).split()) or type(error).__name__})"
        ) from None


def _read_csv(path: Path) -> Mapping[str, Any] | FloatArray:
    if path.name.lower().endswith(".gz"):
        with gzip.open(path, "rt", encoding="utf-8", newline="") as compressed:
            content = compressed.read()
    else:
        content = path.read_text(encoding="utf-8-sig")
    lines = [line for line in content.splitlines() if line.strip() and not line.lstrip().startswith("#")]
    if not lines:
        raise AxisRecordingError(f"{path}: no rows")
    try:
        delimiter = csv.Sniffer().sniff("\n".join(lines[:20]), delimiters=",;\t ").delimiter
    except csv.Error:
        delimiter = ","
    rows = [
        [cell.strip() for cell in row]
        for row in csv.reader(lines, delimiter=delimiter, skipinitialspace=True)
    ]
    header = None if all(_is_number(cell) for cell in rows[0]) else rows.pop(0)
    width = len(header) if header is not None else len(rows[0])
    if any(len(row) != width for row in rows):
        number = next(index for index, row in enumerate(rows) if len(row) != width)
        raise AxisRecordingError(
            f"{path}: data row {number + 1} has {len(rows[number])} columns instead of {width}"
        )
    array = np.array([[_number(cell) for cell in row] for row in rows], dtype=float).reshape(len(rows), width)
    if header is None:
        return array
    return {name: array[:, index] for index, name in enumerate(header)}


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return cell == ""
    return True


def _number(cell: str) -> float:
    try:
        return float(cell)
    except ValueError:
        return math.nan  # counted and left out by the caller


def _column(table: Mapping[str, Any] | FloatArray, name: str | int, signal: str, path: Path) -> FloatArray:
    if isinstance(table, np.ndarray):
        if not isinstance(name, int):
            raise AxisRecordingError(
                f"{path}: columns.{signal} is {name!r}, but the file has no names; use a number counted from 0"
            )
        if name >= table.shape[1]:
            raise AxisRecordingError(
                f"{path}: columns.{signal} is {name}, but the file has {table.shape[1]} columns"
            )
        return np.asarray(table[:, name], dtype=float)
    names: Sequence[str] = list(table)
    if isinstance(name, int):
        if name >= len(names):
            raise AxisRecordingError(
                f"{path}: columns.{signal} is {name}, but the file has {len(names)} columns"
            )
        name = names[name]
    if name not in table:
        raise AxisRecordingError(f"{path}: no column {name!r} for {signal}; {nearest_name(name, names)}")
    try:
        return np.asarray(table[name], dtype=float).ravel()
    except (TypeError, ValueError):
        raise AxisRecordingError(f"{path}: column {name!r} for {signal} does not hold numbers") from None
