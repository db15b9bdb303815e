"""An emulated CANopen drive with the profile CiA 402: object dictionary, SDO server, PDOs as they are mapped, NMT, heartbeat
producer and consumer, emergency messages, and the state machine of the profile.
"""

from __future__ import annotations

import math
import struct

from . import cia402, sdo
from .can_file import DriveJoint
from .cia402 import (
    CYCLIC_SYNCHRONOUS_TORQUE,
    HOMING,
    HOMING_ATTAINED,
    MODE_BIT,
    PROFILE_TORQUE,
    PROFILE_VELOCITY,
    STATE_BOOT_UP,
    STATE_OPERATIONAL,
    STATE_PRE_OPERATIONAL,
    STATE_STOPPED,
)
from .drive import Mode
from .emulated_drive import EmulatedDrive, first_due
from .frame import Frame

ERROR_CODE = {"over_temperature": 0x4310, "over_current": 0x2310, "drive_watchdog": 0x8130, "encoder": 0x7305}
# Statusword of each state; bit 9 "remote" is set in all.
STATUS = {
    "switch on disabled": 0x0240, "ready to switch on": 0x0221, "switched on": 0x0223, "operation enabled": 0x0227,
    "quick stop active": 0x0207, "fault": 0x0208,
}  # fmt: skip
FIRMWARE = b"pcw-emulator 1.0"
VENDOR, PRODUCT = 0x00000FFF, 0x00000402
# index, sub-index: size in bytes, signed, writable. What is not here does not exist.
OBJECTS = {
    (0x1000, 0): (4, False, False), (0x1001, 0): (1, False, False), (0x1017, 0): (2, False, True),
    (0x1016, 0): (1, False, False), (0x1016, 1): (4, False, True), (0x1018, 0): (1, False, False),
    (0x1018, 1): (4, False, False), (0x1018, 2): (4, False, False), (0x1018, 3): (4, False, False),
    (0x1018, 4): (4, False, False), (0x603F, 0): (2, False, False), (0x6007, 0): (2, True, True),
    (0x6040, 0): (2, False, True), (0x6041, 0): (2, False, False), (0x6060, 0): (1, True, True),
    (0x6061, 0): (1, True, False), (0x6064, 0): (4, True, False), (0x606C, 0): (4, True, False),
    (0x6071, 0): (2, True, True), (0x6072, 0): (2, False, True), (0x6075, 0): (4, False, True),
    (0x6076, 0): (4, False, True), (0x6077, 0): (2, True, False), (0x607C, 0): (4, True, True),
    (0x6080, 0): (4, False, True), (0x6098, 0): (1, True, True), (0x6099, 0): (1, False, False),
    (0x6099, 1): (4, False, True), (0x6099, 2): (4, False, True), (0x60FF, 0): (4, True, True),
    (0x6502, 0): (4, False, False),
    **{(base + i, sub): (size, False, sub > 0) for base in (0x1400, 0x1800) for i in range(4)
       for sub, size in ((0, 1), (1, 4), (2, 1), (3, 2), (5, 2))},
    **{(base + i, sub): (4 if sub else 1, False, True) for base in (0x1600, 0x1A00) for i in range(4) for sub in range(9)},
}  # fmt: skip
STRINGS = {(0x1008, 0): b"PCW emulated CiA 402 drive", (0x1009, 0): b"1", (0x100A, 0): FIRMWARE}


class EmulatedCia402(EmulatedDrive):
    """One drive; see the module.

    Args:
        joint, rate, heartbeat, watchdog: see `EmulatedDrive`; a CANopen drive is told them by its master.
        counts: per turn of the motor.

    Attributes:
        keeps_error_code: 0x603F stays that of the last error after a reset, as in many drives.
        lacks: objects that it refuses.
    """

    def __init__(self, joint: DriveJoint, rate: float, heartbeat: float, watchdog: float, counts: float) -> None:
        super().__init__(joint, rate, heartbeat, watchdog)
        assert joint.rated_torque is not None
        self._per_count = math.tau / counts
        self._torque_unit = joint.rated_torque / 1000.0
        self._velocity_unit = self._per_count if joint.velocity_unit == "counts/s" else math.tau / 60.0
        self.keeps_error_code = False
        self.lacks: set[int] = set()
        self._last_error = 0
        self.power_on(0.0)

    def power_on(self, now: float) -> list[Frame]:
        """Start anew and say so."""
        rated = self.joint.rated_torque or 1.0
        self.objects: dict[tuple[int, int], int] = dict.fromkeys(OBJECTS, 0)
        self.objects.update(
            {
                (0x1000, 0): 0x00020192, (0x1016, 0): 1, (0x1018, 0): 4, (0x1018, 1): VENDOR, (0x1018, 2): PRODUCT,
                (0x1018, 3): 0x00010000, (0x1018, 4): self.node_id, (0x6041, 0): STATUS["switch on disabled"],
                (0x6072, 0): 1000, (0x6075, 0): round(rated / self.joint.torque_constant * 1000),
                (0x6076, 0): round(rated * 1000), (0x6099, 0): 2,
                (0x6502, 0): sum(1 << MODE_BIT[mode] for mode in (PROFILE_VELOCITY, PROFILE_TORQUE, HOMING,
                                                                  CYCLIC_SYNCHRONOUS_TORQUE)),
            }
        )  # fmt: skip
        for i, base in enumerate((0x200, 0x300, 0x400, 0x500)):
            self.objects[0x1400 + i, 0] = self.objects[0x1800 + i, 0] = 5
            self.objects[0x1400 + i, 1] = cia402.COB_INVALID | (base + self.node_id)
            self.objects[0x1800 + i, 1] = cia402.COB_INVALID | (base - 0x80 + self.node_id)
        self.nmt, self.state, self._error, self._homing_done = STATE_PRE_OPERATIONAL, "switch on disabled", 0, False
        self.failure = ""
        self._segments: bytes | None = None
        self._toggle = 0
        self._last_word = 0
        self._next_heartbeat, self._master_heard, self._syncs = now, math.inf, 0
        self._map_pdos()
        return [Frame(cia402.HEARTBEAT + self.node_id, bytes((STATE_BOOT_UP,)))]

    def _map_pdos(self) -> None:
        """Read which PDOs there are, from the objects."""
        self._rpdos: dict[int, tuple[list[tuple[int, int]], int]] = {}
        self._tpdos: list[tuple[int, list[tuple[int, int]], int]] = []
        self._waiting: dict[int, bytes] = {}
        for i in range(4):
            for base in (0x1400, 0x1800):
                cob, kind = self.objects[base + i, 1], self.objects[base + i, 2]
                if cob & cia402.COB_INVALID:
                    continue
                entries = [self.objects[base + 0x200 + i, sub + 1] for sub in range(min(self.objects[base + 0x200 + i, 0], 8))]
                mapped = [(entry >> 16, entry >> 8 & 0xFF) for entry in entries]
                if base == 0x1400:
                    self._rpdos[cob & 0x7FF] = (mapped, kind)
                else:
                    self._tpdos.append((cob & 0x7FF, mapped, kind))

    # --- What the robot sees -----------------------------------------------------------------------------

    @property
    def mode(self) -> int:
        """The operation mode."""
        return self.objects[0x6060, 0]

    def want(self) -> tuple[Mode, float] | None:
        """Return what it does to the motor now."""
        if self.dead or self.state != "operation enabled" or self.nmt != STATE_OPERATIONAL:
            return None
        if self.mode in (PROFILE_TORQUE, CYCLIC_SYNCHRONOUS_TORQUE):
            most = self.objects[0x6072, 0]
            return Mode.TORQUE, max(-most, min(most, self.objects[0x6071, 0])) * self._torque_unit
        if self.mode == PROFILE_VELOCITY:
            return Mode.VELOCITY, self.objects[0x60FF, 0] * self._velocity_unit
        if self.mode == HOMING:
            speed = self.objects[0x6099, 1] * self._velocity_unit
            return Mode.VELOCITY, self.mark_wanted * speed
        return Mode.TORQUE, 0.0

    def _homed(self) -> None:
        self._homing_done = True

    # --- Frames ------------------------------------------------------------------------------------------

    def receive(self, frame: Frame, now: float) -> list[Frame]:
        """Take a frame."""
        if self.dead or frame.remote or frame.extended or frame.error:
            return []
        identifier, data, node = frame.id, frame.data, self.node_id
        if identifier == cia402.SYNC and not data:
            return self._on_sync(now)
        if identifier in self._rpdos:
            return self._on_rpdo(identifier, data, now)
        if identifier == sdo.REQUEST + node and len(data) == 8 and self.nmt != STATE_STOPPED:
            answer = self._on_sdo(data, now)
            return [] if answer is None or self.silent else [Frame(sdo.RESPONSE + node, answer)]
        if identifier == cia402.NMT and len(data) == 2 and data[1] in (0, node):
            return self._on_nmt(data[0], now)
        consumer = self.objects[0x1016, 1]
        if consumer and identifier == cia402.HEARTBEAT + (consumer >> 16 & 0x7F) and len(data) == 1:
            self._master_heard = now
        return []

    def _on_nmt(self, command: int, now: float) -> list[Frame]:
        if command in (cia402.NMT_RESET, 0x82):
            return self.power_on(now)
        states = {cia402.NMT_OPERATIONAL: STATE_OPERATIONAL, cia402.NMT_STOPPED: STATE_STOPPED,
                  cia402.NMT_PRE_OPERATIONAL: STATE_PRE_OPERATIONAL}  # fmt: skip
        if command in states:
            self.nmt = states[command]
            if self.nmt != STATE_OPERATIONAL and self.state in ("operation enabled", "switched on"):
                self.state = "switch on disabled"
            self._map_pdos()
        return []

    def _on_rpdo(self, identifier: int, data: bytes, now: float) -> list[Frame]:
        mapped, kind = self._rpdos[identifier]
        if self.nmt != STATE_OPERATIONAL or len(data) < sum(OBJECTS[key][0] for key in mapped if key in OBJECTS):
            return []
        if kind <= 240:
            self._waiting[identifier] = data  # acts at the next SYNC; of several the newest
            return []
        return self._take_rpdo(mapped, data, now)

    def _take_rpdo(self, mapped: list[tuple[int, int]], data: bytes, now: float) -> list[Frame]:
        at, frames, word = 0, [], None
        self.commands += 1
        self.command_time = now
        for key in mapped:
            size, signed, _ = OBJECTS[key]
            value = int.from_bytes(data[at : at + size], "little", signed=signed)
            at += size
            if key == (0x6040, 0):
                word = value
            else:
                self.objects[key] = value
        if word is not None:
            frames = self._on_controlword(word, now)
        return frames

    def _on_controlword(self, word: int, now: float) -> list[Frame]:
        """Take one step of the state machine."""
        rising = word & ~self._last_word
        self._last_word = word
        self.objects[0x6040, 0] = word
        state = self.state
        if state == "fault":
            if rising & cia402.FAULT_RESET and not self._fault_lasts():
                self.state, self._error, self.failure = "switch on disabled", 0, ""
                return [Frame(cia402.EMERGENCY + self.node_id, bytes(8))]
        elif not word & 0x02:
            self.state = "switch on disabled"  # disable voltage
        elif not word & 0x04:
            self.state = "switch on disabled" if state != "operation enabled" else "quick stop active"
        elif word & 0x0F == 0x06:
            self.state = "ready to switch on"
        elif word & 0x0F == 0x07 and state in ("ready to switch on", "operation enabled", "switched on"):
            self.state = "switched on"
        elif word & 0x0F == 0x0F and state in ("switched on", "operation enabled"):
            self.state = "operation enabled"
        if self.state != "operation enabled":
            self.mark_wanted = 0
        elif self.mode == HOMING and rising & 0x10:
            method = self.objects[0x6098, 0]
            self._homing_done, self.mark_wanted = False, -1 if method in (33, 28) else 1
        return []

    def _fault_lasts(self) -> bool:
        return self.temperature > 100.0

    def _on_sync(self, now: float) -> list[Frame]:
        if self.nmt != STATE_OPERATIONAL:
            return []
        frames = []
        for identifier, data in self._waiting.items():
            frames += self._take_rpdo(self._rpdos[identifier][0], data, now)
        self._waiting = {}
        self._syncs += 1
        self._refresh()
        if self.silent:
            return []
        for identifier, mapped, kind in self._tpdos:
            if 0 < kind <= 240 and self._syncs % kind == 0:
                frames.append(Frame(identifier, b"".join([self._bytes(key) for key in mapped if key in OBJECTS])))
        return frames

    def _refresh(self) -> None:
        """Put what the sensors see into the objects."""
        count = round(self.shown_position / self._per_count)
        self.objects[0x6064, 0] = (count + (1 << 31)) % (1 << 32) - (1 << 31)
        self.objects[0x606C, 0] = _within(round(self.shown_velocity / self._velocity_unit), 32)
        self.objects[0x6077, 0] = _within(round(self.shown_torque / self._torque_unit), 16)
        status = STATUS[self.state]
        if self.state == "operation enabled" and self.mode == HOMING and self._homing_done:
            status |= HOMING_ATTAINED | 1 << 10
        self.objects[0x6041, 0] = status
        self.objects[0x6061, 0] = self.mode
        self.objects[0x603F, 0] = self._error or (self._last_error if self.keeps_error_code else 0)
        self.objects[0x1001, 0] = 1 if self._error else 0

    def _bytes(self, key: tuple[int, int]) -> bytes:
        size, signed, _ = OBJECTS[key]
        value = self.objects[key]
        return value.to_bytes(size, "little", signed=signed and value < 0)

    def tick(self, now: float) -> list[Frame]:
        """Send the heartbeat; trip without the computer's."""
        if self.dead:
            return []
        frames = []
        period = self.objects[0x1017, 0] * 1e-3
        if period > 0.0 and now >= self._next_heartbeat:
            self._next_heartbeat = first_due(self._next_heartbeat, period, now)
            if not self.silent:
                frames.append(Frame(cia402.HEARTBEAT + self.node_id, bytes((self.nmt,))))
        allowed = (self.objects[0x1016, 1] & 0xFFFF) * 1e-3
        if allowed > 0.0 and now - self._master_heard > allowed:
            self._master_heard = math.inf  # once; it listens again when the computer speaks again
            if self.objects[0x6007, 0] != 0:
                frames += self.trip("drive_watchdog", now)
        return frames

    def trip(self, name: str, now: float) -> list[Frame]:
        """Fail."""
        self.state, self._error, self.mark_wanted = "fault", ERROR_CODE[name], 0
        self._last_error, self.failure = self._error, name
        self.objects[0x6071, 0] = self.objects[0x60FF, 0] = 0
        if self.silent:
            return []
        return [Frame(cia402.EMERGENCY + self.node_id, struct.pack("<HB5x", self._error, 1))]

    # --- SDO server --------------------------------------------------------------------------------------

    def _on_sdo(self, data: bytes, now: float) -> bytes | None:
        command = data[0]
        index, sub = struct.unpack_from("<HB", data, 1)
        key, kind = (index, sub), command >> 5
        if kind == 2:  # begin an upload
            return self._begin_upload(key)
        if kind == 3:  # the next segment of one
            return self._next_segment(command)
        if kind == 1 and command & 0x02:  # an expedited download
            size = 4 - (command >> 2 & 3) if command & 0x01 else 4
            return self._download(key, data[4 : 4 + size], now)
        if command == sdo.ABORT:
            self._segments = None
            return None
        return _abort(key, 0x05040001)

    def _begin_upload(self, key: tuple[int, int]) -> bytes:
        head = struct.pack("<HB", *key)
        if key in STRINGS:
            self._segments, self._toggle = STRINGS[key], 0
            return bytes((0x41,)) + head + struct.pack("<I", len(self._segments))
        if key not in OBJECTS:
            known = any(index == key[0] for index, _ in OBJECTS)
            return _abort(key, 0x06090011 if known else 0x06020000)
        self._refresh()
        value = self._bytes(key)
        return bytes((0x43 | (4 - len(value)) << 2,)) + head + value.ljust(4, b"\0")

    def _next_segment(self, command: int) -> bytes:
        if self._segments is None or command & 0x10 != self._toggle:
            return _abort((0, 0), 0x05030000)
        part, rest = self._segments[:7], self._segments[7:]
        answer = bytes((self._toggle | (7 - len(part)) << 1 | (not rest),)) + part.ljust(7, b"\0")
        self._segments, self._toggle = rest or None, self._toggle ^ 0x10
        return answer

    def _download(self, key: tuple[int, int], value: bytes, now: float) -> bytes:
        if key not in OBJECTS or key[0] in self.lacks:
            known = any(index == key[0] for index, _ in OBJECTS if index not in self.lacks)
            return _abort(key, 0x06090011 if known else 0x06020000)
        size, signed, writable = OBJECTS[key]
        if not writable:
            return _abort(key, 0x06010002)
        if len(value) != size:
            return _abort(key, 0x06070010)
        number = int.from_bytes(value, "little", signed=signed)
        if key == (0x6040, 0):
            self._on_controlword(number, now)
        else:
            self.objects[key] = number
        if 0x1400 <= key[0] < 0x1C00:
            self._map_pdos()
        return bytes((0x60,)) + struct.pack("<HB4x", *key)


def _abort(key: tuple[int, int], code: int) -> bytes:
    return bytes((sdo.ABORT,)) + struct.pack("<HBI", *key, code)


def _within(value: int, bits: int) -> int:
    most = (1 << (bits - 1)) - 1
    return max(-most, min(most, value))
