"""Reads many CDR messages of one type at once: numpy columns instead of one Python object per message.

Messages of one topic nearly always have one layout: the same frame names, the same joint names, arrays of the same
length. The layout is worked out on the first message; every message whose strings and lengths stand at the same bytes
with the same values then shares it, and its numbers are cut out of one big byte array. Messages that differ start a
layout of their own, so any mixture is read right, only slower.

CDR version 1 in either byte order, as every ROS 2 middleware writes it; types from ROS 2 Jazzy.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt
from rosbags.interfaces import Nodetype

from .ros_messages import typestore

ENCAPSULATION_SIZE = 4
# Beyond so many layouts among messages of one length they are read one by one instead of being compared again.
MOST_LAYOUTS = 64

_DTYPES = {
    "bool": "u1",
    "byte": "u1",
    "char": "u1",
    "octet": "u1",
    "int8": "i1",
    "uint8": "u1",
    "int16": "i2",
    "uint16": "u2",
    "int32": "i4",
    "uint32": "u4",
    "int64": "i8",
    "uint64": "u8",
    "float32": "f4",
    "float64": "f8",
}


@dataclass(frozen=True)
class CdrColumns:
    """Messages of one layout.

    Attributes:
        rows: (T,) where these messages stand in the sequence given to `decode_columns`.
        numbers: column by field path: "header.stamp.sec" (T,), "position" (T, length).
        strings: text by field path, the same in all T messages; a tuple for a sequence of strings.
    """

    rows: npt.NDArray[np.intp]
    numbers: dict[str, npt.NDArray[Any]]
    strings: dict[str, str | tuple[str, ...]]


@dataclass
class _Layout:
    """Where the fields of a message stand. Offsets count from the start of the message, encapsulation included."""

    numbers: list[tuple[str, str, int, int | None]] = field(default_factory=list)  # path, dtype, offset, length
    strings: dict[str, str | tuple[str, ...]] = field(default_factory=dict)
    fixed: list[tuple[int, int]] = field(default_factory=list)  # byte ranges that decide the layout


class _Malformed(Exception):
    """The bytes are not a message of the type."""


def decode_columns(type_name: str, messages: Sequence[bytes]) -> tuple[list[CdrColumns], npt.NDArray[np.intp]]:
    """Decode messages of one type; also returns the rows (M,) of those that are not whole messages of the type."""
    lengths = np.fromiter((len(message) for message in messages), dtype=np.int64, count=len(messages))
    groups: list[CdrColumns] = []
    malformed: list[npt.NDArray[np.intp]] = []
    for length in np.unique(lengths):
        rows = np.flatnonzero(lengths == length)
        block = np.frombuffer(b"".join(messages[int(row)] for row in rows), dtype=np.uint8).reshape(len(rows), length)
        _decode_block(type_name, rows, block, groups, malformed)
    return groups, np.sort(np.concatenate(malformed)) if malformed else np.zeros(0, dtype=np.intp)


def _decode_block(
    type_name: str,
    rows: npt.NDArray[np.intp],
    block: npt.NDArray[np.uint8],
    groups: list[CdrColumns],
    malformed: list[npt.NDArray[np.intp]],
) -> None:
    """Split messages of one length (T, length) into layouts."""
    layouts = 0
    while len(rows):
        alone = layouts >= MOST_LAYOUTS
        same = np.zeros(len(rows), dtype=bool)
        same[0] = True
        try:
            layout = _Walker(block[0].tobytes()).walk(type_name)
        except (_Malformed, struct.error, UnicodeDecodeError):
            same |= (block == block[0]).all(axis=1)
            malformed.append(rows[same])
        else:
            if not alone:
                fixed = np.concatenate([np.arange(start, stop) for start, stop in layout.fixed])
                same = (block[:, fixed] == block[0, fixed]).all(axis=1)
            groups.append(_columns(layout, rows[same], block[same]))
        layouts += 1
        rows, block = rows[~same], block[~same]


def _columns(layout: _Layout, rows: npt.NDArray[np.intp], block: npt.NDArray[np.uint8]) -> CdrColumns:
    numbers: dict[str, npt.NDArray[Any]] = {}
    for path, dtype, offset, length in layout.numbers:
        size = np.dtype(dtype).itemsize * (1 if length is None else length)
        values = np.ascontiguousarray(block[:, offset : offset + size]).view(dtype)
        values = values.astype(values.dtype.newbyteorder("="), copy=False)
        numbers[path] = values[:, 0] if length is None else values.reshape(len(rows), length)
    return CdrColumns(rows, numbers, layout.strings)


class _Walker:
    """Walks through one message by the definition of its type and notes where everything is."""

    def __init__(self, message: bytes) -> None:
        if len(message) < ENCAPSULATION_SIZE or message[0] != 0 or message[1] not in (0, 1):
            raise _Malformed
        self.message = message
        self.byte_order = "<" if message[1] == 1 else ">"
        self.offset = ENCAPSULATION_SIZE
        self.layout = _Layout(fixed=[(0, 2)])

    def walk(self, type_name: str) -> _Layout:
        self._message(type_name, "")
        return self.layout

    def _message(self, type_name: str, prefix: str) -> None:
        for name, description in typestore().fielddefs[type_name][1]:
            self._field(prefix + name, description)

    def _field(self, path: str, description: Any) -> None:
        kind, detail = description
        if kind == Nodetype.NAME:
            self._message(detail, path + ".")
        elif kind == Nodetype.BASE:
            self._elements(path, description, None)
        elif kind == Nodetype.ARRAY:
            self._elements(path, detail[0], detail[1])
        else:
            self._elements(path, detail[0], self._length())

    def _elements(self, path: str, description: Any, length: int | None) -> None:
        """One value (length None) or `length` values of a type, base or not."""
        kind, detail = description
        if kind == Nodetype.NAME:
            for index in range(length or 0):
                self._message(detail, f"{path}.{index}.")
        elif detail[0] == "string":
            texts = tuple(self._string() for _ in range(1 if length is None else length))
            self.layout.strings[path] = texts[0] if length is None else texts
        elif detail[0] in _DTYPES:
            self._numbers(path, _DTYPES[detail[0]], length)
        else:
            raise _Malformed

    def _numbers(self, path: str, dtype: str, length: int | None) -> None:
        size = int(dtype[1:])
        count = 1 if length is None else length
        if count:  # an empty sequence has no element that would need aligning
            self._align(size)
        self._require(size * count)
        self.layout.numbers.append((path, self.byte_order + dtype, self.offset, length))
        self.offset += size * count

    def _length(self) -> int:
        self._align(4)
        self._require(4)
        (length,) = struct.unpack_from(self.byte_order + "I", self.message, self.offset)
        self.layout.fixed.append((self.offset, self.offset + 4))
        self.offset += 4
        if length > len(self.message):  # no element is smaller than a byte
            raise _Malformed
        return int(length)

    def _string(self) -> str:
        length = self._length()
        self._require(length)
        raw = self.message[self.offset : self.offset + length]
        self.layout.fixed.append((self.offset, self.offset + length))
        self.offset += length
        return raw.rstrip(b"\0").decode()

    def _align(self, size: int) -> None:
        self.offset += -(self.offset - ENCAPSULATION_SIZE) % size

    def _require(self, size: int) -> None:
        if self.offset + size > len(self.message):
            raise _Malformed
