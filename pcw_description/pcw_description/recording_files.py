"""The files of a recording, message by message: rosbag2 folders, .mcap and .db3, finished or not, ROS-free.

Nothing here trusts an index, a footer or a metadata.yaml: files are read from the start for as long as they are whole,
so that a recording whose recorder was killed is read like any other, with a warning.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
import re
import sqlite3
import struct
import tempfile
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import lz4.frame
import yaml
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, Schema

from .errors import RecordingError

MCAP_MAGIC = b"\x89MCAP0\r\n"
SQLITE_MAGIC = b"SQLite format 3\0"
ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
DATA_SUFFIXES = (".mcap", ".db3", ".mcap.zstd", ".db3.zstd")
METADATA_NAME = "metadata.yaml"
NANOSECONDS = 1_000_000_000

_RECORD_HEAD = struct.Struct("<BQ")
_MESSAGE_HEAD = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time


@dataclass(frozen=True)
class RecordingWarning:
    """Something wrong with a recording that did not keep it from being read.

    Attributes:
        code: kind of trouble, one word per kind, e.g. "gap"; see `recording.py` for all of them.
        text: one sentence for a person: what, where, how much, and what was done about it.
        topic: the contract's topic it belongs to; "" for the recording as a whole.
        count: how often.
    """

    code: str
    text: str
    topic: str = ""
    count: int = 1

    def __str__(self) -> str:
        return f"{self.topic}: {self.text}" if self.topic else self.text


class WarningLog:
    """Collects warnings, each once."""

    def __init__(self) -> None:
        self.entries: list[RecordingWarning] = []

    def warn(self, code: str, text: str, topic: str = "", count: int = 1) -> None:
        """Add one, unless it is there already: files and topics may be read more than once."""
        warning = RecordingWarning(code, text, topic, count)
        if warning not in self.entries:
            self.entries.append(warning)


class RawMessage(NamedTuple):
    """One recorded message, not decoded."""

    topic: str
    type_name: str
    log_time_ns: int
    cdr: bytes | memoryview


class MessagesInMemory:
    """Messages that are in memory, where `RecordingFiles` has those of files."""

    metadata: dict[str, Any] | None = None

    def __init__(self, messages: Sequence[RawMessage]) -> None:
        self._messages = messages

    @property
    def sha256(self) -> str:
        """SHA-256 of the messages, one after the other."""
        digest = hashlib.sha256()
        for message in self._messages:
            digest.update(message.cdr)
        return digest.hexdigest()

    def messages(self) -> Iterator[RawMessage]:
        """All messages in their order."""
        return iter(self._messages)


class RecordingFiles:
    """The data files behind a path, found when made, read by `messages()`.

    Raises:
        RecordingError: there is no recording at the path.
    """

    def __init__(self, path: str | Path, log: WarningLog) -> None:
        self.path = Path(path)
        self._warn = log.warn
        self.metadata: dict[str, Any] | None = None
        self.files = self._find_files()

    @property
    def sha256(self) -> str:
        """SHA-256 of the data file; of several files, of their bytes one after the other."""
        digest = hashlib.sha256()
        for file in self.files:
            with file.open("rb") as stream:
                while block := stream.read(1 << 20):
                    digest.update(block)
        return digest.hexdigest()

    def messages(self) -> Iterator[RawMessage]:
        """All whole messages, file after file, in the order they were written; damage goes to the log."""
        for file in self.files:
            with _open_file(file) as stream:
                magic = stream.read(len(SQLITE_MAGIC))
                stream.seek(0)
                if magic.startswith(MCAP_MAGIC):
                    yield from self._mcap_messages(file, stream)
                elif magic == SQLITE_MAGIC:
                    yield from self._sqlite_messages(file)
                elif not magic:
                    self._warn("unfinished", f"{file.name} is empty")
                else:
                    raise RecordingError(
                        f"{file} is neither MCAP nor a rosbag2 database; give a rosbag2 folder, an .mcap or a .db3"
                    )

    # --- Finding ----------------------------------------------------------------------------------------

    def _find_files(self) -> list[Path]:
        if not self.path.exists():
            raise RecordingError(f"{self.path} does not exist; give a rosbag2 folder, an .mcap or a .db3")
        if not self.path.is_dir():
            return [self.path]
        present = sorted((p for p in self.path.iterdir() if p.name.endswith(DATA_SUFFIXES)), key=_natural_order)
        self.metadata = self._read_metadata()
        if self.metadata is not None:
            listed = [self.path / Path(name).name for name in self.metadata.get("relative_file_paths") or []]
            missing = [p.name for p in listed if not p.exists()]
            if missing and present:
                self._warn(
                    "missing_file", f"{METADATA_NAME} lists {', '.join(missing)}, not there; the rest is read"
                )
            present = [p for p in listed if p.exists()] or present
        if not present:
            raise RecordingError(
                f"{self.path} holds no recording: no .mcap or .db3 file in it; give a rosbag2 folder, an .mcap or a .db3"
            )
        return present

    def _read_metadata(self) -> dict[str, Any] | None:
        file = self.path / METADATA_NAME
        try:
            metadata = yaml.safe_load(file.read_text(encoding="utf-8"))["rosbag2_bagfile_information"]
            if isinstance(metadata, dict):
                return metadata
        except FileNotFoundError:
            self._warn("unfinished", f"there is no {METADATA_NAME}: the recording was not finished; the data is read")
            return None
        except (OSError, UnicodeDecodeError, yaml.YAMLError, KeyError, TypeError):
            pass
        self._warn("unfinished", f"{METADATA_NAME} cannot be read; the data files are read without it")
        return None

    # --- MCAP -------------------------------------------------------------------------------------------

    def _mcap_messages(self, file: Path, stream: BinaryIO) -> Iterator[RawMessage]:
        """Read records from the start until the footer, the end, or something that is not MCAP."""
        stream.seek(len(MCAP_MAGIC))
        parser = _McapRecords()
        whole_until = len(MCAP_MAGIC)
        damaged_chunks = 0
        finished = False
        while len(head := stream.read(_RECORD_HEAD.size)) == _RECORD_HEAD.size:
            opcode, length = _RECORD_HEAD.unpack(head)
            if opcode == 0:  # not a record: what a crash of the machine leaves at the end of a file
                break
            content = _read_at_most(stream, length)
            if len(content) < length:
                break
            whole_until += _RECORD_HEAD.size + length
            if opcode == Opcode.FOOTER:
                finished = True
                break
            try:
                yield from parser.messages(opcode, content)
            except (_DamagedChunk, McapError, struct.error, UnicodeDecodeError):
                damaged_chunks += 1
        if not finished:
            rest = stream.seek(0, io.SEEK_END) - whole_until
            text = f"{file.name} has no footer: its recorder was stopped while writing; {parser.count} whole messages"
            if parser.count:
                text += f" over {(parser.last_time - parser.first_time) / NANOSECONDS:.3f} s"
            self._warn("unfinished", f"{text} were read, {rest} bytes of an incomplete one at the end were not")
        if damaged_chunks:
            self._warn(
                "damaged_file", f"{file.name}: {damaged_chunks} damaged chunks of messages were left out", count=damaged_chunks
            )

    # --- SQLite -----------------------------------------------------------------------------------------

    def _sqlite_messages(self, file: Path) -> Iterator[RawMessage]:
        with contextlib.ExitStack() as stack:
            database = stack.enter_context(_plain_copy(file))
            try:
                connection, topics = _open_database(database)
                stack.callback(connection.close)
                rows = connection.execute("SELECT topic_id, timestamp, data FROM messages ORDER BY id")
                for topic_id, timestamp, data in rows:
                    if topic_id in topics:
                        name, type_name = topics[topic_id]
                        yield RawMessage(name, type_name, timestamp, _plain_message(data))
            except sqlite3.Error as error:
                self._warn("damaged_file", f"{file.name}: {error}; what comes after it in the file was not read")


def _open_database(file: Path) -> tuple[sqlite3.Connection, dict[int, tuple[str, str]]]:
    """Open a rosbag2 database and read its topics: id -> (name, type)."""
    uri = file.resolve().as_uri()
    # a journal left behind by a kill may not be played back in a folder that is read-only: then without it
    for options in ("mode=ro", "immutable=1"):
        connection = sqlite3.connect(f"{uri}?{options}", uri=True)
        try:
            topics = {row[0]: (row[1], row[2]) for row in connection.execute("SELECT id, name, type FROM topics")}
            return connection, topics
        except sqlite3.Error as error:
            connection.close()
            failure = error
    raise failure


class _DamagedChunk(Exception):
    """A chunk that cannot be unpacked or whose checksum is wrong."""


class _McapRecords:
    """Turns MCAP records into messages; remembers schemas and channels, which may stand in any chunk before."""

    def __init__(self) -> None:
        self._schemas: dict[int, str] = {}
        self._channels: dict[int, tuple[str, str]] = {}
        self.count = 0
        self.first_time = 0
        self.last_time = 0

    def messages(self, opcode: int, content: bytes) -> Iterator[RawMessage]:
        """Messages of one record: none, one, or those of a chunk."""
        if opcode == Opcode.CHUNK:
            data = _unpack_chunk(content)
            position = 0
            while position + _RECORD_HEAD.size <= len(data):
                inner_opcode, length = _RECORD_HEAD.unpack_from(data, position)
                position += _RECORD_HEAD.size
                if inner_opcode == Opcode.MESSAGE:
                    yield self._message(data, position, length)
                else:
                    self._remember(inner_opcode, bytes(data[position : position + length]))
                position += length
        elif opcode == Opcode.MESSAGE:
            yield self._message(memoryview(content), 0, len(content))
        else:
            self._remember(opcode, content)

    def _message(self, data: memoryview, position: int, length: int) -> RawMessage:
        channel_id, _, log_time, _ = _MESSAGE_HEAD.unpack_from(data, position)
        if channel_id not in self._channels:
            raise _DamagedChunk
        topic, type_name = self._channels[channel_id]
        if not self.count:
            self.first_time = log_time
        self.count += 1
        self.last_time = max(self.last_time, log_time)
        cdr = data[position + _MESSAGE_HEAD.size : position + length]
        if cdr[:4] == ZSTD_MAGIC:
            cdr = memoryview(_plain_message(bytes(cdr)))
        return RawMessage(topic, type_name, log_time, cdr)

    def _remember(self, opcode: int, content: bytes) -> None:
        if opcode == Opcode.SCHEMA:
            schema = Schema.read(ReadDataStream(io.BytesIO(content)))
            self._schemas[schema.id] = schema.name
        elif opcode == Opcode.CHANNEL:
            channel = Channel.read(ReadDataStream(io.BytesIO(content)))
            self._channels[channel.id] = (channel.topic, self._schemas.get(channel.schema_id, ""))


def _unpack_chunk(content: bytes) -> memoryview:
    try:
        chunk = Chunk.read(ReadDataStream(io.BytesIO(content)))
        if chunk.compression == "zstd":
            data = zstandard.ZstdDecompressor().decompress(chunk.data, max_output_size=chunk.uncompressed_size)
        elif chunk.compression == "lz4":
            data = lz4.frame.decompress(chunk.data)
        elif chunk.compression == "":
            data = chunk.data
        else:
            raise _DamagedChunk
    except (zstandard.ZstdError, RuntimeError, ValueError, struct.error, EOFError, McapError) as error:
        raise _DamagedChunk from error
    if chunk.uncompressed_crc and zlib.crc32(data) != chunk.uncompressed_crc:
        raise _DamagedChunk
    return memoryview(data)


def _read_at_most(stream: BinaryIO, length: int) -> bytes:
    """Read `length` bytes or what there is, never reserving memory for a length that a damaged file claims."""
    if length < 1 << 26:
        return stream.read(length)
    blocks = []
    while length and (block := stream.read(min(length, 1 << 26))):
        blocks.append(block)
        length -= len(block)
    return b"".join(blocks)


# --- Compression of files and messages ------------------------------------------------------------------


@contextlib.contextmanager
def _open_file(file: Path) -> Iterator[BinaryIO]:
    """A data file as a plain stream, unpacked if rosbag2 compressed it."""
    with _plain_copy(file) as plain, plain.open("rb") as stream:
        yield stream


@contextlib.contextmanager
def _plain_copy(file: Path) -> Iterator[Path]:
    """The file itself, or an unpacked temporary copy of a .zstd file."""
    with file.open("rb") as stream:
        if stream.read(4) != ZSTD_MAGIC:
            yield file
            return
        stream.seek(0)
        with tempfile.TemporaryDirectory() as folder:
            plain = Path(folder) / file.stem
            with plain.open("wb") as target:
                # a cut-off archive ends early here and is then reported as an unfinished file
                with contextlib.suppress(zstandard.ZstdError):
                    zstandard.ZstdDecompressor().copy_stream(stream, target)
            yield plain


def _plain_message(data: bytes) -> bytes:
    """A message, unpacked if rosbag2 compressed it one by one; CDR never starts like zstd."""
    if data[:4] != ZSTD_MAGIC:
        return data
    return zstandard.ZstdDecompressor().decompressobj().decompress(data)


def _natural_order(path: Path) -> list[int | str]:
    """`bag_2` before `bag_10`."""
    return [int(part) if part.isdigit() else part for part in re.split(r"(\d+)", path.name)]
