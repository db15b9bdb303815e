"""Two streams of messages, of which those with the same stamp belong together."""

from __future__ import annotations

from typing import Any

# Messages kept that wait for their partner: two seconds of them at 500 Hz.
KEPT = 1000


class SameStamp:
    """Pairs messages by stamp, in whichever order they come; those without a partner are left out.

    A pair makes everything older useless, so that pairs come in the order of time.
    """

    def __init__(self) -> None:
        self._waiting: tuple[dict[int, Any], dict[int, Any]] = ({}, {})
        self._newest = -1

    def first(self, stamp_ns: int, message: Any) -> tuple[Any, Any] | None:
        """Take a message of the first stream; return the pair that it completes."""
        other = self._match(0, stamp_ns, message)
        return None if other is None else (message, other)

    def second(self, stamp_ns: int, message: Any) -> tuple[Any, Any] | None:
        """Take a message of the second stream; return the pair that it completes."""
        other = self._match(1, stamp_ns, message)
        return None if other is None else (other, message)

    def _match(self, stream: int, stamp_ns: int, message: Any) -> Any | None:
        if stamp_ns <= self._newest:
            return None
        own, other = self._waiting[stream], self._waiting[1 - stream]
        partner = other.get(stamp_ns)
        if partner is None:
            own[stamp_ns] = message
            if len(own) > KEPT:
                del own[next(iter(own))]
            return None
        self._newest = stamp_ns
        for waiting in self._waiting:
            for stamp in [stamp for stamp in waiting if stamp <= stamp_ns]:
                del waiting[stamp]
        return partner
