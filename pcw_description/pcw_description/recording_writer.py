"""Writes a recording: a rosbag2 folder with one MCAP file that only ever grows.

    runs/demo/                 the folder, named by its user
        metadata.yaml          there from the start, so that the folder is recognisable; replaced when closed
        demo_0.mcap            profile ros2, schema encoding ros2msg, message encoding cdr, chunked and indexed

A chunk is closed and handed to the operating system at least every `flush_interval` seconds in which messages
arrive, so what a process had written a second before it was killed can be read (`Recording` does; `flush()` may be
called from a timer too, for topics that fall silent). Format: rosbag2 version 9, as ROS 2 Jazzy writes it.
"""

from __future__ import annotations

import os
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, BinaryIO

import yaml
from mcap.writer import CompressionType, Writer

from .errors import RecordingError, nearest_name
from .ros_messages import message_definition, serialise, stamp_of, type_hash, type_name_of

BAG_VERSION = 9
ROS_DISTRO = "jazzy"
COMPRESSIONS = {"zstd": CompressionType.ZSTD, "lz4": CompressionType.LZ4, "none": CompressionType.NONE}
# What rosbag2 writes as the start of a bag in which there is no message yet.
NO_START_TIME = 2**63 - 1
# rmw's "no limit" for a duration.
INFINITE = {"sec": 9223372036, "nsec": 854775807}


@dataclass(frozen=True)
class OfferedQos:
    """The quality of service a publisher offered, in rosbag2's words; `ros2 bag play` publishes with it."""

    history: str = "keep_last"
    depth: int = 10
    reliability: str = "reliable"
    durability: str = "volatile"


@dataclass
class _Topic:
    channel_id: int
    type_name: str
    qos: tuple[OfferedQos, ...]
    count: int = 0


class RecordingWriter:
    """Append-only writer of a rosbag2 folder, to be used in a `with` block or closed with `close()`.

    `flush_interval` [s of wall time] bounds what a kill can lose. None cuts chunks by size alone: for a simulator
    whose recording of the same run shall be the same file, byte by byte.

    Raises:
        RecordingError: `path` exists already, whatever it is, or cannot be made; unknown compression.
    """

    def __init__(
        self, path: str | os.PathLike[str], compression: str = "zstd", flush_interval: float | None = 0.5
    ) -> None:
        if compression not in COMPRESSIONS:
            raise RecordingError(f"compression {compression!r}: {nearest_name(compression, COMPRESSIONS)}")
        self.path = Path(path)
        self.flush_interval = flush_interval
        self._topics: dict[str, _Topic] = {}
        self._schemas: dict[str, int] = {}
        self._first_log_time = NO_START_TIME
        self._last_log_time = 0
        self._flushed_at = time.monotonic()
        self._closed = False

        self.data_path = self._make_folder()
        self._write_metadata_file()
        self._file: BinaryIO = open(self.data_path, "xb")  # noqa: SIM115 - closed in close()
        self._mcap = Writer(self._file, compression=COMPRESSIONS[compression])
        self._mcap.start(profile="ros2", library="pcw")
        self._file.flush()

    def _make_folder(self) -> Path:
        try:
            self.path.mkdir(parents=True)
        except FileExistsError:
            raise RecordingError(
                f"{self.path} exists already and is left as it is; give another path or move it away"
            ) from None
        except OSError as error:
            raise RecordingError(f"{self.path} cannot be made: {error.strerror}; give another path") from error
        return self.path / f"{self.path.resolve().name}_0.mcap"

    # --- Writing ----------------------------------------------------------------------------------------

    @property
    def counts(self) -> dict[str, int]:
        """Messages written so far, by topic."""
        return {name: topic.count for name, topic in self._topics.items()}

    def add_topic(
        self,
        name: str,
        type_name: str,
        qos: Sequence[OfferedQos] = (),
        definition: str | None = None,
    ) -> None:
        """Make a topic known before its first message, with the QoS its publishers offered.

        `definition`: the concatenated .msg text of a type that is not part of Jazzy. Adding a topic twice with
        the same type is allowed and keeps the first; another type raises RecordingError.
        """
        known = self._topics.get(name)
        if known is not None:
            if known.type_name != type_name:
                raise RecordingError(
                    f"{self.path}: topic {name} is recorded as {known.type_name} and cannot also be {type_name}; "
                    "record it in a bag of its own"
                )
            return
        offered = tuple(qos)
        channel_id = self._mcap.register_channel(
            topic=name,
            message_encoding="cdr",
            schema_id=self._schema_id(type_name, definition),
            metadata={
                "offered_qos_profiles": yaml.safe_dump(_qos_maps(offered), sort_keys=False).strip(),
                "topic_type_hash": type_hash(type_name),
            },
        )
        self._topics[name] = _Topic(channel_id, type_name, offered)

    def _schema_id(self, type_name: str, definition: str | None) -> int:
        if type_name not in self._schemas:
            text = definition if definition is not None else message_definition(type_name) or ""
            self._schemas[type_name] = self._mcap.register_schema(type_name, "ros2msg" if text else "", text.encode())
        return self._schemas[type_name]

    def write_raw(
        self, topic: str, type_name: str, cdr: bytes, log_time_ns: int, publish_time_ns: int | None = None
    ) -> None:
        """Append one serialised message. Times in nanoseconds; the publish time defaults to the log time."""
        if topic not in self._topics:
            self.add_topic(topic, type_name)
        entry = self._topics[topic]
        with self._disk_errors_named():
            self._mcap.add_message(
                channel_id=entry.channel_id,
                log_time=log_time_ns,
                data=cdr,
                publish_time=log_time_ns if publish_time_ns is None else publish_time_ns,
            )
        entry.count += 1
        self._first_log_time = min(self._first_log_time, log_time_ns)
        self._last_log_time = max(self._last_log_time, log_time_ns)
        if self.flush_interval is not None and time.monotonic() - self._flushed_at >= self.flush_interval:
            self.flush()

    def write(self, topic: str, message: Any, log_time_ns: int | None = None) -> None:
        """Append one message of `ros_messages`, logged at its own stamp unless another time is given."""
        if log_time_ns is None:
            log_time_ns = stamp_of(message)
            if log_time_ns is None:
                raise RecordingError(f"{topic}: a {type_name_of(message)} has no stamp of its own; give log_time_ns")
        self.write_raw(topic, type_name_of(message), serialise(message), log_time_ns)

    def flush(self) -> None:
        """Close the chunk in progress and hand it to the operating system, which keeps it after a kill."""
        if not self._closed:
            with self._disk_errors_named():
                self._mcap.flush()
        self._flushed_at = time.monotonic()

    # --- Closing ----------------------------------------------------------------------------------------

    def close(self) -> None:
        """Write index and footer, then put the final metadata.yaml in place of the first. Twice is allowed."""
        if self._closed:
            return
        self._closed = True
        # rosbag2 looks here for the version of the QoS text in the channels
        information = yaml.safe_dump(self._information(), sort_keys=False)
        with self._disk_errors_named():
            try:
                self._mcap.flush()
                self._mcap.add_metadata("rosbag2", {"serialized_metadata": information})
                self._mcap.finish()
            finally:
                self._file.close()
            self._write_metadata_file()

    @contextmanager
    def _disk_errors_named(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise RecordingError(
                f"{self.path} cannot be written: {error.strerror}; what was flushed before can be read"
            ) from error

    def __enter__(self) -> RecordingWriter:
        """Return the writer, which `__exit__` closes."""
        return self

    def __exit__(
        self,
        exception_type: type[BaseException] | None,
        exception: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Close the recording, also after an exception: what was written stays readable."""
        self.close()

    def _write_metadata_file(self) -> None:
        """Replace metadata.yaml in one step, so that a reader finds the old one or the new one, never half of it."""
        text = yaml.safe_dump({"rosbag2_bagfile_information": self._information()}, sort_keys=False)
        temporary = self.path / "metadata.yaml.part"
        temporary.write_text(text, encoding="utf-8")
        os.replace(temporary, self.path / "metadata.yaml")

    def _information(self) -> dict[str, Any]:
        duration = {"nanoseconds": max(0, self._last_log_time - self._first_log_time)}
        start = {"nanoseconds_since_epoch": self._first_log_time}
        count = sum(topic.count for topic in self._topics.values())
        return {
            "version": BAG_VERSION,
            "storage_identifier": "mcap",
            "duration": duration,
            "starting_time": start,
            "message_count": count,
            "topics_with_message_count": [
                {
                    "topic_metadata": {
                        "name": name,
                        "type": topic.type_name,
                        "serialization_format": "cdr",
                        "offered_qos_profiles": _qos_maps(topic.qos),
                        "type_description_hash": type_hash(topic.type_name),
                    },
                    "message_count": topic.count,
                }
                for name, topic in sorted(self._topics.items())
            ],
            "compression_format": "",
            "compression_mode": "",
            "relative_file_paths": [self.data_path.name],
            "files": [
                {
                    "path": self.data_path.name,
                    "starting_time": dict(start),
                    "duration": dict(duration),
                    "message_count": count,
                }
            ],
            "custom_data": None,
            "ros_distro": ROS_DISTRO,
        }


def _qos_maps(profiles: Sequence[OfferedQos]) -> list[dict[str, Any]]:
    return [
        {
            **asdict(profile),
            "deadline": dict(INFINITE),
            "lifespan": dict(INFINITE),
            "liveliness": "automatic",
            "liveliness_lease_duration": dict(INFINITE),
            "avoid_ros_namespace_conventions": False,
        }
        for profile in profiles
    ]
