"""What carries frames between the computer and the drives: python-can (`python_can`), or an emulator in simulated time."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

from .errors import CanError
from .frame import Arrived, Frame


class TransmitBufferFull(CanError):
    """A frame that could not be sent, as the buffer was full."""


class BusOff(CanError):
    """A bus that the interface has left after too many errors."""


class Transport(Protocol):
    """All buses of a robot."""

    def now(self) -> float:
        """Return the time [s], of a clock that never goes back."""

    def send(self, bus: str, frame: Frame) -> None:
        """Send a frame without waiting.

        Raises:
            TransmitBufferFull: it could not be sent; it is gone, and not kept for later.
            BusOff: the interface is off the bus.
        """

    def receive(self, timeout: float) -> Sequence[Arrived]:
        """Return what has come; wait for at most `timeout` [s] for the first frame."""

    def close(self) -> None:
        """Close the buses."""
