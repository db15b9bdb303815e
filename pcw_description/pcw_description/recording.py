"""One way to read a recording of a robot: typed, in SI, in the robot's order, and honest about what is wrong with it.

    recording = Recording.open("runs/demo", robot)
    recording.joint_states.position            # (T, n, 2) [rad]
    recording.imu.gyro                         # (S, 3) [rad/s], or `recording.imu is None`
    for warning in recording.warnings: print(warning)

Codes of the warnings:

    unfinished         no footer, no metadata.yaml: the recorder was stopped; everything whole was read
    stale_metadata     metadata.yaml counts other messages than the files hold
    missing_file       metadata.yaml lists a file that is not there
    damaged_file       a chunk or a database page cannot be read
    damaged_message    bytes that are no message of their type, or arrays of unequal length
    wrong_type         a topic of the contract with another type
    other_namespace    a topic found under another prefix than joint_states
    unstamped          headers without a stamp; the time of recording is used instead
    gap                a pause in a stream
    repeated_stamp     messages with the stamp of the one before
    backward_jump      stamps that go back in time
    non_finite         NaN or infinite values
    missing_caster     a caster of the robot without both joints
    missing_joint      a joint of the robot
    missing_field      a joint's position, velocity or effort, or a quantity of the IMU, is never sent, or always 0
    incomplete_message messages without some of the joints that others have
    split_message      joints that come in separate messages
    wrong_unit         degrees, rpm, counts, g: from values that contradict each other
    implausible_speed  faster than the joint can be: a unit is probably wrong
    both_commands      torque and velocity commanded at once
"""

from __future__ import annotations

import copy
import os
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np

from .cdr_columns import CdrColumns, decode_columns
from .errors import RecordingError, nearest_name
from .recording_checks import DEGREE, order_stamps, position_scale, units_of
from .recording_files import MessagesInMemory, RawMessage, RecordingFiles, RecordingWarning, WarningLog
from .recording_joints import MOVED, read_joint_series
from .recording_series import ImuSeries, JointSeries, JointTrace, OdometrySeries, TwistSeries, WrenchSeries
from .recording_table import FloatArray, IntArray, MessageTable, RowArray
from .robot_description import GRAVITY, RobotDescription
from .ros_messages import IMU, JOINT_STATE, ODOMETRY, TWIST, TWIST_STAMPED, WRENCH_STAMPED

__all__ = [
    "CONTRACT_TOPICS",
    "ImuSeries",
    "JointSeries",
    "JointTrace",
    "OdometrySeries",
    "Recording",
    "RecordingWarning",
    "TopicInfo",
    "TwistSeries",
    "WrenchSeries",
]

CONTRACT_TOPICS: Mapping[str, tuple[str, ...]] = {
    "joint_states": (JOINT_STATE,),
    "joint_commands": (JOINT_STATE,),
    "imu/data": (IMU,),
    "ground_truth/odom": (ODOMETRY,),
    "odom": (ODOMETRY,),
    "cmd_vel": (TWIST_STAMPED, TWIST),
}
"""Topics that have a series of their own, and the types they may have; `contact/<caster>/wrench` besides."""

_CONTACT = re.compile(r"^contact/([^/]+)/wrench$")
_KEPT_TYPES = frozenset(name for names in CONTRACT_TOPICS.values() for name in names) | {WRENCH_STAMPED}
# No such robot turns faster [rad/s].
FASTEST_GYRO = 35.0


@dataclass
class TopicInfo:
    """A topic as the files have it."""

    type_name: str
    count: int = 0


@dataclass
class _RawTopic:
    log_time_ns: list[int] = field(default_factory=list)
    messages: list[bytes] = field(default_factory=list)


# --- The recording --------------------------------------------------------------------------------------


class Recording:
    """A recording, opened with `Recording.open`. Series are decoded when first asked for."""

    def __init__(
        self,
        path: Path,
        robot: RobotDescription | None,
        topics: Mapping[str, str],
        messages: Sequence[RawMessage] | None = None,
    ) -> None:
        self.path = path
        self.robot = robot
        self._log = WarningLog()
        self._files = RecordingFiles(path, self._log) if messages is None else MessagesInMemory(messages)
        self._raw: dict[str, _RawTopic] = {}
        self.topics: dict[str, TopicInfo] = {}
        try:
            self._read()
        except OSError as error:
            raise RecordingError(f"{path} cannot be read: {error.strerror}; check its permissions") from error
        self.topic_names = self._resolve_topics(topics)

    @classmethod
    def open(
        cls,
        path: str | os.PathLike[str],
        robot: RobotDescription | None = None,
        topics: Mapping[str, str] | None = None,
    ) -> Recording:
        """Read a rosbag2 folder, an .mcap or a .db3, finished or not.

        Args:
            path: the folder or file.
            robot: whose joints are meant; gives arrays (T, n, 2) in its order and better checks.
            topics: contract topic -> topic in the files, where they differ, e.g. {"joint_states": "/arm/joints"}.
                A prefix in front of all topics (a namespace) is found without.

        Raises:
            RecordingError: no recording there, no messages, no joint_states or none of the robot's joints in
                them, or a topic that could be one of several.
        """
        recording = cls(Path(path), robot, topics or {})
        _ = recording.joint_states  # nothing can be said without them, so fail here
        return recording

    @classmethod
    def of_messages(
        cls, messages: Sequence[RawMessage], robot: RobotDescription | None = None, name: str = "live"
    ) -> Recording:
        """Read messages that are in memory, in the order they came, as if they had been recorded.

        Args:
            messages: at least those of joint_states.
            robot: as in `open`.
            name: stands for the path in errors.

        Raises:
            RecordingError: as in `open`.
        """
        recording = cls(Path(name), robot, {}, messages)
        _ = recording.joint_states
        return recording

    def decoded(self) -> Recording:
        """Return a copy with all series, and without most of what they came from; `columns` reads the files again."""
        _ = self.warnings, self.sha256
        light = copy.copy(self)
        light._raw = {}
        return light

    # --- What is there ----------------------------------------------------------------------------------

    @property
    def warnings(self) -> list[RecordingWarning]:
        """All that was found wrong; decodes every series for it."""
        _ = self.joint_states, self.joint_commands, self.imu, self.ground_truth, self.odom, self.cmd_vel, self.contact
        return list(self._log.entries)

    @cached_property
    def sha256(self) -> str:
        """SHA-256 of the data file; of several files, of their bytes one after the other."""
        return self._files.sha256

    @property
    def t0_ns(self) -> int:
        """Header stamp of the first joint state used, where all relative stamps start [ns]."""
        return int(self.joint_states.stamp_ns[0])

    @property
    def duration(self) -> float:
        """From the first joint state to the last [s]."""
        return float(self.joint_states.stamp[-1])

    def messages(self, topics: Iterable[str] | None = None) -> Iterator[RawMessage]:
        """Raw messages of the given topics (names as in the files), or all, in the order they were written."""
        wanted = None if topics is None else set(topics)
        for message in self._files.messages():
            if wanted is None or message.topic in wanted:
                yield message._replace(cdr=bytes(message.cdr))

    def columns(self, topic: str) -> list[CdrColumns]:
        """Decoded fields of any topic, by contract name or name in the files; one entry per layout of its messages."""
        name = self.topic_names.get(topic, topic)
        if name not in self.topics:
            raise RecordingError(f"{self.path} has no topic {topic!r}; {self._topics_text()}")
        raw = self._raw.get(name)
        messages = raw.messages if raw is not None else [bytes(message.cdr) for message in self.messages([name])]
        return decode_columns(self.topics[name].type_name, messages)[0]

    # --- Series -----------------------------------------------------------------------------------------

    @cached_property
    def joint_states(self) -> JointSeries:
        """Measured joints."""
        try:
            series = read_joint_series(self._joint_state_table, self.robot, measured=True)
        except RecordingError as error:
            raise RecordingError(
                f"{self.path}: joint_states is not of this robot: {error}; give the robot that was recorded or "
                "another topic (joint_states:=<topic>)"
            ) from None
        if series is None:
            found = "; ".join(warning.text for warning in self._log.entries)
            raise RecordingError(f"{self.path}: joint_states holds no usable message: {found}; record it again")
        return series

    @cached_property
    def joint_commands(self) -> JointSeries | None:
        """Commanded joints: effort or velocity; None if not recorded."""
        table = self._table("joint_commands")
        if table is None:
            return None
        try:
            return read_joint_series(table, self.robot, measured=False, t0_ns=self.t0_ns)
        except RecordingError as error:
            table.warn("missing_joint", f"{error}; not used")
            return None

    @cached_property
    def imu(self) -> ImuSeries | None:
        """Inertial sensor; None if not recorded."""
        table = self._table("imu/data")
        if table is None:
            return None
        quantities = ("angular_velocity", "linear_acceleration")
        values = table.matrix([f"{quantity}.{axis}" for quantity in quantities for axis in "xyz"])
        rows = table.clean(values, self.t0_ns)
        if not len(rows):
            return None
        stamp, stamp_ns = self._stamps(table, rows)
        table.warn_of_gaps(stamp)
        gyro, acceleration = self._imu_in_si(table, stamp, values[rows, :3], values[rows, 3:])
        for name, sensed, moved in (("gyro", gyro, self._turns()), ("acceleration", acceleration, True)):
            if moved and not sensed.any():
                table.warn("missing_field", f"the {name} is 0 throughout: not measured; it is NaN")
                sensed[:] = np.nan
        return ImuSeries(stamp, stamp_ns, gyro, acceleration) if np.isfinite([gyro, acceleration]).any() else None

    def _turns(self) -> bool:
        """Whether the robot turned, by what else was recorded of its motion, or joints, where that is nothing."""
        motion = self.ground_truth or self.odom
        angles = self.joint_states.position.reshape(len(self.joint_states), -1) if motion is None else motion.pose[:, 2:]
        known = angles[:, np.isfinite(angles).any(axis=0)]
        return bool((np.nanmax(known, axis=0) - np.nanmin(known, axis=0) > MOVED).any())

    @cached_property
    def ground_truth(self) -> OdometrySeries | None:
        """True motion by the simulator or a tracker; None if not recorded."""
        return self._odometry_series("ground_truth/odom")

    @cached_property
    def odom(self) -> OdometrySeries | None:
        """Motion as the robot estimated it; None if not recorded."""
        return self._odometry_series("odom")

    @cached_property
    def cmd_vel(self) -> TwistSeries | None:
        """Commanded motion, stamped or not; None if not recorded."""
        table = self._table("cmd_vel")
        if table is None:
            return None
        prefix = "" if self.topics[self.topic_names["cmd_vel"]].type_name == TWIST else "twist."
        values = table.matrix([prefix + name for name in ("linear.x", "linear.y", "angular.z")])
        rows = table.clean(values, self.t0_ns)
        # no gaps here: a command is sent when somebody commands
        return TwistSeries(*self._stamps(table, rows), values[rows]) if len(rows) else None

    @cached_property
    def contact(self) -> dict[str, WrenchSeries]:
        """Contact force by caster, in the wheel frame; those that were recorded."""
        series = {}
        for topic in self.topic_names:
            match = _CONTACT.match(topic)
            table = self._table(topic) if match else None
            if match is None or table is None:
                continue
            values = table.matrix([f"wrench.{quantity}.{axis}" for quantity in ("force", "torque") for axis in "xyz"])
            rows = table.clean(values, self.t0_ns)
            if len(rows):
                force, torque = values[rows, :3], values[rows, 3:]
                frame_id = table.text("header.frame_id")
                series[match[1]] = WrenchSeries(*self._stamps(table, rows), force, torque, frame_id)
        return series

    def _odometry_series(self, topic: str) -> OdometrySeries | None:
        table = self._table(topic)
        if table is None:
            return None
        position = table.matrix(["pose.pose.position.x", "pose.pose.position.y"])
        x, y, z, w = table.matrix([f"pose.pose.orientation.{axis}" for axis in "xyzw"]).T
        yaw = np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
        yaw[x * x + y * y + z * z + w * w < 0.5] = np.nan  # no rotation: a driver that never set it
        twist = table.matrix([f"twist.twist.{name}" for name in ("linear.x", "linear.y", "angular.z")])
        values = np.column_stack([position, yaw, twist])
        rows = table.clean(values, self.t0_ns)
        if not len(rows):
            return None
        stamp, stamp_ns = self._stamps(table, rows)
        table.warn_of_gaps(stamp)
        pose = values[rows, :3]
        pose[:, 2] = np.unwrap(pose[:, 2])
        frames = table.text("header.frame_id"), table.text("child_frame_id")
        return OdometrySeries(stamp, stamp_ns, pose, values[rows, 3:], *frames)

    def _imu_in_si(
        self, table: MessageTable, stamp: FloatArray, gyro: FloatArray, acceleration: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Find degrees/s and g in gyro and acceleration (T, 3) and convert them."""
        motion = self.ground_truth or self.odom
        if motion is not None:
            factor = position_scale(motion.stamp, motion.pose[:, 2], stamp, gyro[:, 2])
            if factor is not None and units_of(factor) == ("rad", "degrees/s"):
                text = f"the gyro is in degrees/s: it turns {1.0 / factor:.1f} times as far as the yaw; converted to rad/s"
                table.warn("wrong_unit", text)
                gyro = gyro * DEGREE
        fastest = float(np.quantile(np.abs(gyro), 0.99))
        if fastest > FASTEST_GYRO:
            text = f"the gyro reaches {fastest:.0f} rad/s, which no such robot does; it may be in degrees/s; left as it is"
            table.warn("implausible_speed", text)
        vertical = float(np.median(acceleration[:, 2]))
        if 0.9 < abs(vertical) < 1.1 and 0.9 < float(np.median(np.linalg.norm(acceleration, axis=1))) < 1.1:
            text = f"the acceleration is in g: its vertical part is {vertical:.3f}; converted to m/s^2"
            table.warn("wrong_unit", text)
            acceleration = acceleration * GRAVITY
        return gyro, acceleration

    # --- Tables and time --------------------------------------------------------------------------------

    @cached_property
    def _joint_state_table(self) -> MessageTable:
        table = self._table("joint_states")
        assert table is not None  # without it the recording is not opened
        return table

    def _table(self, topic: str) -> MessageTable | None:
        """Decode a topic; None if it is not in the recording."""
        name = self.topic_names.get(topic)
        if name is None:
            return None
        raw = self._raw[name]
        table = MessageTable(topic, self.topics[name].type_name, raw.messages, raw.log_time_ns, self._log)
        if table.unstamped and topic != "joint_states":
            table.stamp_ns = self._header_time(table.log_time_ns)
        return table

    def _stamps(self, table: MessageTable, rows: RowArray) -> tuple[FloatArray, IntArray]:
        stamp_ns = table.stamp_ns[rows]
        return ((stamp_ns - self.t0_ns) * 1e-9).astype(np.float64), stamp_ns

    def _header_time(self, log_time_ns: IntArray) -> IntArray:
        """What the stamps of joint_states say at times of recording (T,): for messages without a header."""
        table = self._joint_state_table
        rows = np.flatnonzero(table.usable)
        rows = rows[order_stamps(table.stamp_ns[rows]).keep]
        rows = rows[order_stamps(table.log_time_ns[rows]).keep]
        logged, stamped = table.log_time_ns[rows], table.stamp_ns[rows]
        # differences first: nanoseconds since 1970 do not fit into a float
        lag = stamped - logged
        change = np.interp(log_time_ns - logged[0], logged - logged[0], lag - lag[0])
        header_time_ns: IntArray = log_time_ns + lag[0] + np.rint(change).astype(np.int64)
        return header_time_ns

    # --- Reading the files ------------------------------------------------------------------------------

    def _read(self) -> None:
        other_types: dict[str, int] = {}
        for topic, type_name, log_time_ns, cdr in self._files.messages():
            info = self.topics.get(topic)
            if info is None:
                info = self.topics[topic] = TopicInfo(type_name)
                if type_name in _KEPT_TYPES:
                    self._raw[topic] = _RawTopic()
            if type_name != info.type_name:
                other_types[topic] = other_types.get(topic, 0) + 1
                continue
            info.count += 1
            raw = self._raw.get(topic)
            if raw is not None:
                raw.log_time_ns.append(log_time_ns)
                raw.messages.append(bytes(cdr))
        for topic, count in other_types.items():
            self._log.warn("wrong_type", f"{count} messages are not {self.topics[topic].type_name}; left out", topic, count)
        total = sum(info.count for info in self.topics.values())
        if not total:
            found = "; ".join(warning.text for warning in self._log.entries)
            raise RecordingError(f"{self.path} holds no messages{': ' + found if found else ''}; record it again")
        counted = (self._files.metadata or {}).get("message_count")
        if isinstance(counted, int) and counted != total + sum(other_types.values()):
            text = f"metadata.yaml counts {counted} messages, the files hold {total}; the files count"
            self._log.warn("stale_metadata", text)

    def _resolve_topics(self, mapping: Mapping[str, str]) -> dict[str, str]:
        """Contract topic -> topic in the files, for those that are there."""
        for contract, name in mapping.items():
            if contract not in CONTRACT_TOPICS and not _CONTACT.match(contract):
                known = [*CONTRACT_TOPICS, "contact/<caster>/wrench"]
                raise RecordingError(f"{contract!r} is not a topic of a recording; {nearest_name(contract, known)}")
            if _find(self.topics, name) is None:
                raise RecordingError(
                    f"{self.path} has no topic {name!r} to read as {contract}; {self._topics_text()}"
                )
        names: dict[str, str] = {}
        joint_states = self._resolve("joint_states", mapping, None)
        if joint_states is None:
            raise RecordingError(
                f"{self.path} has no joint_states, without which nothing can be said; name the topic that holds them "
                f"(joint_states:=<topic>). {self._topics_text()}"
            )
        names["joint_states"] = joint_states
        bare = joint_states.lstrip("/")
        prefix = bare.removesuffix("joint_states") if bare.endswith("joint_states") else ""
        contacts = {match[1] for topic in self.topics if (match := re.search(r"(contact/[^/]+/wrench)$", topic))}
        for contract in [*list(CONTRACT_TOPICS)[1:], *sorted(contacts | (set(mapping) - set(CONTRACT_TOPICS)))]:
            name_there = self._resolve(contract, mapping, prefix)
            if name_there is not None:
                names[contract] = name_there
        return {contract: name for contract, name in names.items() if self._has_right_type(contract, name)}

    def _resolve(self, contract: str, mapping: Mapping[str, str], prefix: str | None) -> str | None:
        """Name in the files: as mapped, else with the prefix of joint_states, else bare, else the only one that ends so."""
        if contract in mapping:
            return _find(self.topics, mapping[contract])
        for candidate in (prefix + contract, contract) if prefix else (contract,):
            name = _find(self.topics, candidate)
            if name is not None:
                return name
        allowed = CONTRACT_TOPICS.get(contract, (WRENCH_STAMPED,))
        found = [name for name, info in self.topics.items() if info.type_name in allowed and name.endswith("/" + contract)]
        # `/ground_truth/odom` is a topic of its own and not an `odom` under a prefix
        longer = [other for other in CONTRACT_TOPICS if other.endswith("/" + contract)]
        found = [topic for topic in found if not any(("/" + topic).endswith("/" + other) for other in longer)]
        if len(found) > 1:
            raise RecordingError(
                f"{self.path}: {contract} could be any of {', '.join(sorted(found))}; name one ({contract}:=<topic>)"
            )
        if found and prefix is not None:
            self._log.warn("other_namespace", f"read from {found[0]}, the only topic that ends so", contract)
        return found[0] if found else None

    def _has_right_type(self, contract: str, name: str) -> bool:
        allowed = CONTRACT_TOPICS.get(contract, (WRENCH_STAMPED,))
        found = self.topics[name].type_name
        if found in allowed:
            return True
        text = f"{name} is a {found} and not a {' or '.join(allowed)}"
        if contract == "joint_states":
            raise RecordingError(f"{self.path}: {text}; name another topic (joint_states:=<topic>). {self._topics_text()}")
        self._log.warn("wrong_type", f"{text}; not used", contract)
        return False

    def _topics_text(self) -> str:
        listed = ", ".join(f"{name} ({info.type_name}, {info.count})" for name, info in sorted(self.topics.items()))
        return f"topics there: {listed}"


def _find(topics: Iterable[str], name: str) -> str | None:
    """The topic of this name, with or without the leading slash."""
    bare = name.strip("/")
    return next((topic for topic in topics if topic.strip("/") == bare), None)
