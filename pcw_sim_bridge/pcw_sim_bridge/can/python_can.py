"""Frames over python-can: the one module that loads it."""

from __future__ import annotations

import contextlib
import errno
import selectors
import struct
import threading
import time
from collections import Counter, deque
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import can

from .can_file import Bus
from .errors import CanError
from .frame import ERROR_BUS_OFF, Arrived, Frame
from .transport import BusOff, TransmitBufferFull

# Frames that are taken from a bus at once, so that a flood on one leaves time for the others.
BURST = 64
FAILED_PAUSE = 1e-3  # [s]
LOG_SUFFIXES = (".log", ".asc", ".blf")
FULL = (errno.ENOBUFS, errno.EAGAIN, errno.EWOULDBLOCK)


def to_message(frame: Frame, channel: str | int | None = None, timestamp: float = 0.0) -> can.Message:
    """Return a frame as python-can has it."""
    return can.Message(
        timestamp=timestamp, arbitration_id=frame.id, is_extended_id=frame.extended, is_remote_frame=frame.remote,
        is_error_frame=frame.error, channel=channel, data=None if frame.remote else frame.data,
        dlc=8 if frame.remote else len(frame.data),
    )  # fmt: skip


def to_frame(message: can.Message) -> Frame:
    """Return a message of python-can as a frame."""
    return Frame(
        message.arbitration_id, bytes(message.data), message.is_remote_frame, message.is_error_frame, message.is_extended_id
    )


def check_interface(bus: Bus) -> None:
    """Refuse an interface that python-can does not have.

    Raises:
        CanError: names the bus, the interface and those that there are.
    """
    if bus.interface not in can.VALID_INTERFACES:
        known = ", ".join(sorted(can.VALID_INTERFACES))
        raise CanError(f"interface {bus.interface!r} of bus {bus.name} is not allowed; allowed, of python-can: {known}")


def open_bus(bus: Bus) -> can.BusABC:
    """Open a bus.

    Raises:
        CanError: names the bus and what python-can says.
    """
    check_interface(bus)
    try:
        opened: can.BusABC = can.Bus(
            interface=bus.interface, channel=bus.channel, **{"bitrate": int(bus.bitrate), **bus.options}
        )
    except Exception as error:  # each interface has its own
        raise CanError(
            f"bus {bus.name} ({bus.interface}, {bus.channel}) cannot be opened: {type(error).__name__}: {error}; "
            "allowed: an interface of python-can that is up"
        ) from error
    return opened


class PythonCanTransport:
    """Buses opened by python-can.

    Args:
        buses: of the CAN file.
        opened: buses that are open already, by name; for tests and for interfaces that need more than arguments.
        log: frames are written to this file too, candump (.log), ASC or BLF by its suffix.

    Attributes:
        sent, received: frames by bus.
        log_problem: why the log ended before its time; "" while it goes on. A full disk must not stop a robot.

    Raises:
        CanError: a bus that cannot be opened, or a log that cannot be written.
    """

    def __init__(
        self, buses: Sequence[Bus], opened: Mapping[str, can.BusABC] | None = None, log: str | Path | None = None
    ) -> None:
        self._buses: dict[str, can.BusABC] = {}
        self._log: FrameLogWriter | None = None
        if log is not None:
            check_log_suffix(Path(log))
        self._selector = selectors.DefaultSelector()
        self._polled: list[str] = []
        self._echoes = {bus.name: Echoes() for bus in buses if bus.interface == "udp_multicast"}
        self.sent = {bus.name: 0 for bus in buses}
        self.received = {bus.name: 0 for bus in buses}
        try:
            for bus in buses:
                self._buses[bus.name] = (opened or {}).get(bus.name) or open_bus(bus)
                self._watch(bus.name)
            if log is not None:  # last, so that a bus that cannot be opened leaves no empty log
                self._log = FrameLogWriter(log, [bus.name for bus in buses])
        except CanError:
            self.close()
            raise

    def _watch(self, name: str) -> None:
        try:
            self._selector.register(self._buses[name].fileno(), selectors.EVENT_READ, name)
        except (NotImplementedError, ValueError, OSError, AttributeError):
            self._polled.append(name)  # an interface without a file, such as `virtual`

    @property
    def log_problem(self) -> str:
        """Why the log ended before its time."""
        return "" if self._log is None else self._log.problem

    def now(self) -> float:
        """Return the monotonic time [s]."""
        return time.monotonic()

    def send(self, bus: str, frame: Frame) -> None:
        """Send a frame without waiting; see `Transport`."""
        message = to_message(frame)
        if bus in self._echoes:  # before it is sent: another thread may have its echo before this one goes on
            self._echoes[bus].sent(frame, time.monotonic())
        try:
            self._buses[bus].send(message, timeout=0.0)
        except can.CanError as error:
            code = getattr(error, "error_code", None)
            if code is None and isinstance(error.__cause__, OSError):
                code = error.__cause__.errno
            words = str(error).lower()
            if code in FULL or "buffer" in words or "full" in words or "timeout" in words:
                raise TransmitBufferFull(f"{bus}: {error}") from error
            raise BusOff(f"{bus}: {error}") from error
        except OSError as error:
            if error.errno in FULL:
                raise TransmitBufferFull(f"{bus}: {error}") from error
            raise BusOff(f"{bus}: {error}") from error
        self.sent[bus] += 1
        if self._log is not None:
            self._log.write(bus, frame, time.time(), sent=True)

    def receive(self, timeout: float) -> list[Arrived]:
        """Return what has come; see `Transport`."""
        arrived: list[Arrived] = []
        end = time.monotonic() + timeout
        while True:
            ready = self._selector.select(0.0 if self._polled or timeout <= 0.0 else max(end - time.monotonic(), 0.0))
            failed = [name for name in [key.data for key, _ in ready] + self._polled if not self._drain(name, arrived)]
            if failed and timeout > 0.0:
                time.sleep(min(timeout, FAILED_PAUSE))  # a bus that fails is always ready: others want the processor too
            if arrived or time.monotonic() >= end:
                return arrived
            if self._polled:
                time.sleep(2e-4)

    def _drain(self, name: str, arrived: list[Arrived]) -> bool:
        """Take what has come on a bus; False if it fails."""
        for _ in range(BURST):
            try:
                message = self._buses[name].recv(0.0)
            except Exception as error:  # each interface has its own: those of python-can, of pyserial, of usb
                if name in self._echoes and not isinstance(error, OSError):
                    continue  # a datagram that is no frame says nothing of the bus
                arrived.append(Arrived(name, Frame(ERROR_BUS_OFF, error=True), time.monotonic()))
                return False
            if message is None:
                return True
            if message.is_fd:
                continue
            frame = to_frame(message)
            if name in self._echoes and self._echoes[name].is_own(frame, time.monotonic()):
                continue
            self.received[name] += 1
            arrived.append(Arrived(name, frame, time.monotonic()))
            if self._log is not None:
                self._log.write(name, frame, time.time())
        return True

    def close(self) -> None:
        """Close the buses and the log."""
        self._selector.close()
        for bus in self._buses.values():
            with contextlib.suppress(can.CanError, OSError):
                bus.shutdown()
        if self._log is not None:
            self._log.close()


class Echoes:
    """Tells the frames that a bus gives back to who sent them: udp_multicast does, and says nothing of where they are from."""

    LONGEST = 2.0  # after which an echo that has not come is lost [s]

    def __init__(self) -> None:
        self._sent: deque[tuple[float, Frame]] = deque()
        self._expected: Counter[Frame] = Counter()
        self._lock = threading.Lock()

    def sent(self, frame: Frame, now: float) -> None:
        """Expect the echo of a frame."""
        with self._lock:
            self._expect(frame, now)

    def _expect(self, frame: Frame, now: float) -> None:
        while self._sent and now - self._sent[0][0] > self.LONGEST:
            old = self._sent.popleft()[1]
            if self._expected[old] > 1:
                self._expected[old] -= 1
            else:
                self._expected.pop(old, None)
        self._sent.append((now, frame))
        self._expected[frame] += 1

    def is_own(self, frame: Frame, now: float) -> bool:
        """Whether a frame is an echo that was expected; each is expected once."""
        with self._lock:
            if not self._expected.get(frame):
                return False
            self._expected[frame] -= 1
            if not self._expected[frame]:
                del self._expected[frame]
            # Echoes come in the order of sending, so its entry is near the front.
            for i, (_, sent) in enumerate(self._sent):
                if sent == frame:
                    del self._sent[i]
                    break
            return True


class FrameLogWriter:
    """A log of frames as candump (.log), ASC or BLF, by the suffix of its path; one that exists is left as it is.

    candump has names of buses; ASC and BLF have numbers, which are those in the order of `buses`. Threads may share it.

    Args:
        path: the file.
        buses: names of the buses, in the order of the CAN file.

    Attributes:
        problem: why it ended before its time; "" while it goes on.

    Raises:
        CanError: another suffix, or a file that exists or cannot be written.
    """

    def __init__(self, path: str | Path, buses: Sequence[str] = ()) -> None:
        path = Path(path)
        self.problem = ""
        self._lock = threading.Lock()
        self._channels: dict[str, str | int] = {
            name: name if path.suffix == ".log" else number for number, name in enumerate(buses)
        }
        check_log_suffix(path)
        if path.exists():
            raise CanError(f"log {path} exists already and is left as it is; allowed: a new file")
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._logger: Any = can.Logger(str(path))
        except OSError as error:
            raise CanError(f"log {path} cannot be written: {error.strerror}; allowed: a path that can") from error

    def write(self, bus: str, frame: Frame, timestamp: float, sent: bool = False) -> None:
        """Write a frame."""
        if self.problem:
            return
        message = to_message(frame, self._channels.get(bus, bus), timestamp)
        message.is_rx = not sent
        with self._lock:
            try:
                self._logger(message)
            except (OSError, ValueError, struct.error) as error:
                self.problem = f"the log ended: {error}"

    def close(self) -> None:
        """Close the file."""
        try:
            self._logger.stop()
        except (OSError, ValueError, struct.error) as error:
            self.problem = self.problem or f"the log ended: {error}"


def check_log_suffix(path: Path) -> None:
    """Refuse a log that is neither candump nor ASC nor BLF."""
    if path.suffix not in LOG_SUFFIXES:
        raise CanError(f"log {path}: the suffix {path.suffix!r} is not allowed; allowed: {', '.join(LOG_SUFFIXES)}")


def free_log_name(path: str | Path) -> Path:
    """Return the path, or NAME_2.SUFFIX, NAME_3.SUFFIX ... where it exists: each configure of a driver has its own log."""
    given = path = Path(path)
    number = 1
    while path.exists():
        number += 1
        path = given.with_stem(f"{given.stem}_{number}")
    return path


def read_log(path: str | Path) -> Iterator[tuple[str, Frame, float]]:
    """Yield channel, frame and time [s] of a log.

    Raises:
        CanError: not a log that can be read.
    """
    path = Path(path)
    check_log_suffix(path)
    try:
        # Of ASC the times of the day, not since its beginning, as the others have them.
        with can.LogReader(str(path), **({"relative_timestamp": False} if path.suffix == ".asc" else {})) as reader:
            for message in reader:
                if not message.is_fd:
                    yield str(message.channel), to_frame(message), message.timestamp
    except Exception as error:  # each format has its own
        raise CanError(f"log {path} cannot be read: {error}; allowed: candump, ASC or BLF") from error


def available_buses() -> list[dict[str, Any]]:
    """Return the buses that python-can finds on this computer, as it describes them."""
    found = []
    for config in can.detect_available_configs(interfaces=["socketcan", "slcan", "pcan", "kvaser", "gs_usb", "usb2can"]):
        found.append(dict(config))
    return found
