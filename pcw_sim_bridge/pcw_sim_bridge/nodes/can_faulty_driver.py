"""The CAN driver on buses that fail when they are told to: for trials, never on a robot.

SIGUSR1: from now on no frame can be sent, as the transmit buffer is full. SIGUSR2: frames can be sent again. Each prints when
it happened, by the monotonic clock.
"""

from __future__ import annotations

import signal
import time
from collections.abc import Sequence
from types import FrameType
from typing import Any

import can

from ..can import python_can
from ..can.can_file import Bus
from .can_driver import main as driver_main

FULL_AT, EMPTY_AT = "transmit buffer full at", "transmit buffer empty at"


class _Switch:
    full = False


def _on_signal(number: int, _: FrameType | None) -> None:
    _Switch.full = number == signal.SIGUSR1
    print(f"{FULL_AT if _Switch.full else EMPTY_AT} {time.monotonic():.6f}", flush=True)


def main(args: Sequence[str] | None = None) -> int:
    """Run the driver."""
    opened = python_can.open_bus

    def open_bus(bus: Bus) -> can.BusABC:
        made: Any = opened(bus)
        sends = made.send

        def send(message: can.Message, timeout: float | None = None) -> None:
            if _Switch.full:
                raise can.CanOperationError("Transmit buffer full")
            sends(message, timeout)

        made.send = send
        return made  # type: ignore[no-any-return]

    python_can.open_bus = open_bus
    for number in (signal.SIGUSR1, signal.SIGUSR2):
        signal.signal(number, _on_signal)
    return driver_main(args)


if __name__ == "__main__":
    raise SystemExit(main())
