"""The load of a CAN bus, computed before anything is sent.

A classic frame with an identifier of 11 bits and s bytes of data has (ISO 11898-1; K. Tindell, A. Burns and A. J. Wellings,
Control Engineering Practice 3, 1995; R. I. Davis et al., Real-Time Systems 35, 2007)

    g + 8 s + 13 + floor((g + 8 s - 1) / 4)  bits,   g = 34,

the last term being the stuff bits at their worst. The load of a bus is the sum of bits times rate over the bit rate.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence

from .errors import CanError
from .frame import PeriodicFrame

STUFFED_OVERHEAD = 34  # bits of the frame that bit stuffing works on, data left out
UNSTUFFED = 13  # delimiters, acknowledge, end of frame and interframe space


def frame_bits(size: int) -> int:
    """Return the bits of a frame with `size` bytes of data, stuff bits at their worst.

    Raises:
        CanError: more than 8 bytes.
    """
    if not 0 <= size <= 8:
        raise CanError(f"size = {size} bytes is not allowed; allowed: 0 to 8 in a classic CAN frame")
    stuffed = STUFFED_OVERHEAD + 8 * size
    return stuffed + UNSTUFFED + (stuffed - 1) // 4


@dataclasses.dataclass(frozen=True)
class BusLoad:
    """The load of one bus.

    Attributes:
        bus: its name.
        bitrate: [bit/s].
        frames: what is on it.
        allowed: share that may be in use.
    """

    bus: str
    bitrate: float
    frames: tuple[PeriodicFrame, ...]
    allowed: float

    @property
    def bits(self) -> float:
        """Bits a second."""
        return sum(frame_bits(frame.size) * frame.rate for frame in self.frames)

    @property
    def load(self) -> float:
        """Share of the bus in use."""
        return self.bits / self.bitrate

    def arithmetic(self) -> str:
        """Return the sum, line by line."""
        groups: dict[tuple[str, int, float], int] = {}
        for frame in self.frames:
            key = (frame.what, frame.size, frame.rate)
            groups[key] = groups.get(key, 0) + 1
        lines = [f"{self.bus}: {self.load:.1%} of {self.bitrate / 1000:g} kbit/s, stuff bits at their worst"]
        for (what, size, rate), count in groups.items():
            total = count * rate * frame_bits(size)
            lines.append(
                f"  {count:3} x {rate:7.1f} Hz x {frame_bits(size):3} bit ({size} byte) = {total / 1000:7.1f} kbit/s  {what}"
            )
        lines.append(
            f"  sum {self.bits / 1000:.1f} kbit/s; allowed {self.allowed:.0%} = {self.allowed * self.bitrate / 1000:.1f}"
        )
        return "\n".join(lines)


def check_loads(loads: Mapping[str, BusLoad] | Sequence[BusLoad]) -> None:
    """Refuse buses that cannot carry what is asked of them.

    Raises:
        CanError: with the arithmetic of each bus that is too full.
    """
    values = loads.values() if isinstance(loads, Mapping) else loads
    full = [load for load in values if load.load > load.allowed]
    if full:
        raise CanError(
            f"bus load of {', '.join(load.bus for load in full)} is not allowed; allowed: at most {full[0].allowed:.0%} "
            "(fewer axes a bus, or a lower rate)\n" + "\n".join(load.arithmetic() for load in full)
        )
