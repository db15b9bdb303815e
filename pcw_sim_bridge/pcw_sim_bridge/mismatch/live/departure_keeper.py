"""Keeps the last minutes as a recording when something departs: a ring of messages before, and a while after."""

from __future__ import annotations

import dataclasses
import time
from collections import deque
from pathlib import Path

from pcw_description.errors import RecordingError
from pcw_description.recording_files import RawMessage
from pcw_description.recording_writer import RecordingWriter

from ..errors import MismatchError
from .message_ring import MessageRing

NANOSECONDS = 1_000_000_000
LARGEST_RING = 512 * 2**20  # [bytes]
# So many folders of the same second are numbered.
SAME_NAME = 100
RANGES = {"pre_roll": (1.0, 600.0), "post_roll": (0.0, 600.0), "pause": (0.0, 1e6), "most": (1, 10000)}


@dataclasses.dataclass(frozen=True)
class KeepParameters:
    """What is kept.

    Attributes:
        folder: where the recordings are made, each in a folder of its own.
        pre_roll, post_roll: how much before and after the departure is seen belongs to it [s].
        pause: at least so long from the end of one recording to the next departure that is kept [s].
        most: number of recordings after which no more are made.
    """

    folder: str
    pre_roll: float = 60.0
    post_roll: float = 10.0
    pause: float = 300.0
    most: int = 20

    def __post_init__(self) -> None:
        """Check the numbers.

        Raises:
            MismatchError: one is out of its range.
        """
        for name, (low, high) in RANGES.items():
            value = getattr(self, name)
            if not low <= value <= high:
                raise MismatchError(f"{name} = {value!r} is not allowed; allowed: {low:g} to {high:g}")


class DepartureKeeper:
    """Receives every message; writes only between a departure and the end of its post-roll.

    All times are those of the messages. Writing is done in portions by `work`, so that whoever calls it is not held up.
    """

    def __init__(self, parameters: KeepParameters) -> None:
        self.parameters = parameters
        self.kept: list[Path] = []
        self._ring = MessageRing(parameters.pre_roll, LARGEST_RING)
        self._writer: RecordingWriter | None = None
        self._pending: deque[RawMessage] = deque()
        self._now = self._until = 0
        self._not_before: int | None = None

    @property
    def writing(self) -> Path | None:
        """The recording in progress."""
        return None if self._writer is None else self._writer.path

    def receive(self, message: RawMessage) -> None:
        """Take a message, not older than the one before unless the clock began anew."""
        if message.log_time_ns < self._now:
            self._restart()
        self._now = message.log_time_ns
        self._ring.append(message)
        if self._writer is not None and self._now <= self._until:
            self._pending.append(message)

    def _restart(self) -> None:
        """The clock began anew: what is being written ends here."""
        self.close()
        self._ring.clear()
        self._not_before = None

    def departs(self) -> Path | None:
        """Begin a recording, unless one is being written, the pause is not over, or there are enough.

        Returns:
            Its folder; None where none was begun.

        Raises:
            RecordingError: it cannot be made.
        """
        waiting = self._not_before is not None and self._now < self._not_before
        if self._writer is not None or waiting or len(self.kept) >= self.parameters.most or not len(self._ring):
            return None
        self._writer = self._new_writer()
        self.kept.append(self._writer.path)
        self._pending.extend(self._ring.since(0))
        self._until = self._now + round(self.parameters.post_roll * NANOSECONDS)
        return self._writer.path

    def _new_writer(self) -> RecordingWriter:
        name = time.strftime("departure_%Y%m%d_%H%M%S")
        for number in range(1, SAME_NAME):
            path = Path(self.parameters.folder) / (name if number == 1 else f"{name}_{number}")
            if not path.exists():
                return RecordingWriter(path)
        raise RecordingError(f"{self.parameters.folder} holds {SAME_NAME} recordings named {name}; move them away")

    def work(self, portion: int = 5000) -> Path | None:
        """Write at most `portion` messages of what waits; returns the folder when its recording is complete.

        Raises:
            RecordingError: it cannot be written; what was written stays, and nothing more is.
        """
        if self._writer is None:
            return None
        try:
            for _ in range(min(portion, len(self._pending))):
                message = self._pending.popleft()
                self._writer.write_raw(message.topic, message.type_name, bytes(message.cdr), message.log_time_ns)
        except RecordingError:
            self._end()
            raise
        return self._end() if not self._pending and self._now >= self._until else None

    def close(self) -> Path | None:
        """Write what waits and finish; returns the folder of the recording, if one was in progress."""
        if self._writer is None:
            return None
        self.work(len(self._pending))
        return self._end()

    def _end(self) -> Path | None:
        """Finish the file and begin the pause."""
        writer, self._writer = self._writer, None
        self._pending.clear()
        self._not_before = self._now + round(self.parameters.pause * NANOSECONDS)
        if writer is None:
            return None
        writer.close()
        return writer.path
