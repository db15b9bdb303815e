"""A classic CAN frame, as every part here passes it on."""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

# Of socketcan's error frames: the bit of the identifier that says "bus-off".
ERROR_BUS_OFF = 0x40


class Frame(NamedTuple):
    """One frame with an identifier of 11 bits.

    Attributes:
        id: identifier.
        data: at most 8 bytes.
        remote: a request for data.
        error: an error frame of the interface, `id` being its class.
        extended: an identifier of 29 bits; no drive here uses them.
    """

    id: int
    data: bytes = b""
    remote: bool = False
    error: bool = False
    extended: bool = False


class Arrived(NamedTuple):
    """A frame that has come.

    Attributes:
        bus: name of the bus.
        frame: the frame.
        time: when it came, by the clock of the transport [s].
    """

    bus: str
    frame: Frame
    time: float


@dataclasses.dataclass(frozen=True)
class PeriodicFrame:
    """A frame that is on the bus so many times a second; what the load of a bus is computed from.

    Attributes:
        what: what it is, for people.
        size: bytes of data.
        rate: [Hz].
    """

    what: str
    size: int
    rate: float
