"""The last messages of a running robot, not decoded, bounded in time and in memory."""

from __future__ import annotations

from collections import deque

from pcw_description.recording_files import RawMessage

# A message that waits costs more than its bytes: the tuple, its numbers and the object of the bytes.
OVERHEAD = 200


class MessageRing:
    """Keeps messages in the order they came, the oldest leave first.

    Args:
        span: how long a message is kept [s].
        largest_size: of all messages together [bytes]; what is older than that allows leaves early.
    """

    def __init__(self, span: float, largest_size: int) -> None:
        self._span_ns = round(span * 1e9)
        self._largest_size = largest_size
        self._messages: deque[RawMessage] = deque()
        self.size = 0

    def __len__(self) -> int:
        return len(self._messages)

    def append(self, message: RawMessage) -> None:
        """Take one message, not older than the one before."""
        messages = self._messages
        messages.append(message)
        self.size += len(message.cdr) + OVERHEAD
        oldest = message.log_time_ns - self._span_ns
        while messages[0].log_time_ns < oldest or (self.size > self._largest_size and len(messages) > 1):
            self.size -= len(messages.popleft().cdr) + OVERHEAD

    def since(self, log_time_ns: int) -> list[RawMessage]:
        """Return the messages that came at a time or later, in the order they came."""
        found: list[RawMessage] = []
        for message in reversed(self._messages):
            if message.log_time_ns < log_time_ns:
                break
            found.append(message)
        found.reverse()
        return found

    def clear(self) -> None:
        """Forget everything."""
        self._messages.clear()
        self.size = 0
