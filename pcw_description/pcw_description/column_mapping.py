"""The format `pcw_columns/1`: how columns of text become the topics of a recording.

    joint angle = number * scale * unit + offset            and likewise for every other quantity

The numbers of a counter that begins anew at `wraps` are first put on end: between two rows it moved the shorter way round,
and it begins within half of `wraps` of zero.
"""

from __future__ import annotations

import dataclasses
import math
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from .description_fields import parsed_file, quantity, read_provenance, read_section, section, text
from .errors import DescriptionError
from .robot_description import GRAVITY

FORMAT = "pcw_columns/1"
DELIMITERS = {"whitespace": None, "comma": ",", "semicolon": ";", "tab": "\t"}
_TURN = 2.0 * math.pi
# Factor to SI of every unit that a quantity may have; the first is the default.
UNITS: Mapping[str, Mapping[str, float]] = {
    "time": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9},
    "angle": {"rad": 1.0, "deg": math.radians(1.0), "rev": _TURN},
    "angular speed": {"rad/s": 1.0, "deg/s": math.radians(1.0), "rev/s": _TURN, "rpm": _TURN / 60.0},
    "torque": {"N m": 1.0, "mN m": 1e-3},
    "length": {"m": 1.0, "cm": 1e-2, "mm": 1e-3},
    "acceleration": {"m/s^2": 1.0, "g": GRAVITY},
}
JOINT_QUANTITIES = {"position": "angle", "velocity": "angular speed", "effort": "torque"}
COMMAND_QUANTITIES = {"commanded_velocity": "angular speed", "commanded_effort": "torque"}
TRACKER_QUANTITIES = {"x": "length", "y": "length", "yaw": "angle"}
IMU_QUANTITIES = {"yaw_rate": "angular speed", "acceleration_x": "acceleration", "acceleration_y": "acceleration"}


@dataclasses.dataclass(frozen=True)
class ColumnSource:
    """Where the numbers of one quantity stand, and what they are."""

    column: Any = section("name in the header, or number counted from 0")
    unit: str = text("unit after multiplication by `scale`; SI by default", default="")
    scale: float = quantity(
        "", "unit per number in the file: rad per count; its sign turns it round", default=1.0, minimum=-1e12, maximum=1e12
    )
    offset: float = quantity("SI unit", "added after all", default=0.0, minimum=-1e12, maximum=1e12)
    wraps: float | None = quantity(
        "", "number at which a counter begins anew: 4294967296 of 32 bits", above=0.0, maximum=2.0**64, default=None
    )


@dataclasses.dataclass(frozen=True)
class JointColumns:
    """One joint in `joint_states`, and what it was commanded in `joint_commands`."""

    position: ColumnSource | None = section("angle", default=None)
    velocity: ColumnSource | None = section("speed", default=None)
    effort: ColumnSource | None = section("torque, on the joint side of the gears", default=None)
    commanded_velocity: ColumnSource | None = section("speed that it was told to have", default=None)
    commanded_effort: ColumnSource | None = section("torque that it was told to give", default=None)


@dataclasses.dataclass(frozen=True)
class TrackerColumns:
    """The pose in `ground_truth/odom`."""

    x: ColumnSource = section("along x")
    y: ColumnSource = section("along y")
    yaw: ColumnSource = section("heading, counter-clockwise")
    frame: str = text("frame of the pose", default="map")
    child_frame: str = text("what is tracked", default="base_link")


@dataclasses.dataclass(frozen=True)
class ImuColumns:
    """`imu/data`."""

    yaw_rate: ColumnSource = section("about z")
    acceleration_x: ColumnSource = section("along x")
    acceleration_y: ColumnSource = section("along y")


@dataclasses.dataclass(frozen=True)
class ColumnMapping:
    """How columns of text become a recording, validated when it is made."""

    format: str = text("format of this file", choices=(FORMAT,))
    name: str = text("name of what is mapped")
    provenance: dict[str, str] = section("where each number comes from")
    joints: dict[str, JointColumns] = section("the joints, by name: <caster>_steer and <caster>_drive")
    time: ColumnSource | None = section("stamps of the rows; without it, `rate`", default=None)
    rate: float | None = quantity("Hz", "rate of the rows, where there are no stamps", above=0.0, maximum=1e6, default=None)
    delimiter: str = text("what parts the columns; found by itself", choices=tuple(DELIMITERS), default="")
    tracker: TrackerColumns | None = section("a tracked pose", default=None)
    imu: ImuColumns | None = section("an inertial sensor", default=None)

    def __post_init__(self) -> None:
        """Check what no single field can see.

        Raises:
            DescriptionError: no joint, a joint without columns, no time base, a unit of another quantity, a scale of zero.
        """
        if not self.joints:
            raise DescriptionError("joints", {}, "allowed: at least one joint, such as front_drive: {position: {column: 4}}")
        for name, joint in self.joints.items():
            if not re.fullmatch(r"[A-Za-z][A-Za-z0-9_]*_(steer|drive)", name):
                raise DescriptionError(f"joints.{name}", name, "allowed: <caster>_steer or <caster>_drive")
            if all(getattr(joint, field) is None for field in JOINT_QUANTITIES):
                raise DescriptionError(f"joints.{name}", {}, f"allowed: at least one of {', '.join(JOINT_QUANTITIES)}")
        both = [field for field in COMMAND_QUANTITIES if any(getattr(joint, field) for joint in self.joints.values())]
        if len(both) > 1:
            raise DescriptionError("joints", " and ".join(both), "allowed: speeds or torques, never both")
        if (self.time is None) == (self.rate is None):
            found = None if self.time is None else "both"
            raise DescriptionError("time", found, "allowed: either a time column, or a rate in Hz")
        for where, kind, source in self.sources():
            if source.scale == 0.0:
                raise DescriptionError(f"{where}.scale", 0.0, "allowed: a number other than zero")
            if source.unit and source.unit not in UNITS[kind]:
                raise DescriptionError(f"{where}.unit", source.unit, f"allowed for {kind}: {', '.join(UNITS[kind])}")
            column = source.column
            if isinstance(column, bool) or not isinstance(column, (str, int)) or (isinstance(column, int) and column < 0):
                raise DescriptionError(f"{where}.column", column, "allowed: a name, or a number counted from 0")

    def sources(self) -> Iterator[tuple[str, str, ColumnSource]]:
        """Return every column that is mapped: its key in the file, its quantity in `UNITS`, and where it stands."""
        if self.time is not None:
            yield "time", "time", self.time
        for name, joint in self.joints.items():
            for field, kind in (JOINT_QUANTITIES | COMMAND_QUANTITIES).items():
                source = getattr(joint, field)
                if source is not None:
                    yield f"joints.{name}.{field}", kind, source
        for key, owner, kinds in (("tracker", self.tracker, TRACKER_QUANTITIES), ("imu", self.imu, IMU_QUANTITIES)):
            for field, kind in kinds.items() if owner is not None else ():
                yield f"{key}.{field}", kind, getattr(owner, field)


def factor(kind: str, source: ColumnSource) -> float:
    """Return what a number of a column is multiplied with, to be in SI."""
    return source.scale * (UNITS[kind][source.unit] if source.unit else 1.0)


def parse_column_mapping(data: Mapping[str, Any]) -> ColumnMapping:
    """Read a mapping as it comes from YAML; a column may be given as a plain name or number.

    Raises:
        DescriptionError: names the key, the value and what is allowed.
    """
    content = dict(data)
    if content.get("format") != FORMAT:
        raise DescriptionError("format", content.get("format"), f"allowed: {FORMAT}")
    content["provenance"] = read_provenance(content.get("provenance"))
    joints = content.get("joints")
    if not isinstance(joints, Mapping):
        raise DescriptionError("joints", joints, "allowed: a mapping of joints to their columns")
    content["joints"] = {
        str(name): read_section(JointColumns, _written_out(joint), f"joints.{name}") for name, joint in joints.items()
    }
    if "time" in content:
        content["time"] = _written_out({"time": content["time"]})["time"]
    for key in ("tracker", "imu"):
        if content.get(key) is not None:
            content[key] = _written_out(content[key])
    mapping: ColumnMapping = read_section(ColumnMapping, content, "")
    return mapping


def load_column_mapping(path: str | Path) -> ColumnMapping:
    """Load a mapping from a YAML file.

    Raises:
        DescriptionError: the file is absent or not valid.
    """
    return parsed_file(path, parse_column_mapping)


def _written_out(owner: Any) -> Any:
    """The same with `x: 3` written as `x: {column: 3}`."""
    if not isinstance(owner, Mapping):
        return owner
    plain = (*JOINT_QUANTITIES, *COMMAND_QUANTITIES, *TRACKER_QUANTITIES, *IMU_QUANTITIES, "time")
    return {
        key: {"column": value}
        if key in plain and isinstance(value, (str, int)) and not isinstance(value, bool)
        else value
        for key, value in owner.items()
    }
