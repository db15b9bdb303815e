"""CANopen drives with the profile CiA 402 (IEC 61800-7-201).

A torque goes out in RPDO 1 with the controlword, a velocity in RPDO 2; both carry the operation mode, so that changing between
them needs no other message. Positions and torques come in TPDO 1, velocities and error codes in TPDO 2, both at each SYNC, so
that all joints are read at one instant:

    RPDO 1  0x200 + id   controlword 0x6040, target torque 0x6071, mode 0x6060            5 bytes
    RPDO 2  0x300 + id   controlword 0x6040, target velocity 0x60FF, mode 0x6060          7 bytes
    TPDO 1  0x180 + id   statusword 0x6041, position 0x6064, torque 0x6077                8 bytes
    TPDO 2  0x280 + id   velocity 0x606C, mode 0x6061, error code 0x603F                  7 bytes

Torques are per mille of the rated torque 0x6076 [mN m]. The drive watches the computer by its heartbeat (0x1016); the computer
watches the drive by its TPDOs and its heartbeat (0x1017). The error code 0x603F is that of the last error, which many drives
keep after a reset: what stood there when the faults were cleared is an error again only with a fault.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Generator, Iterator, Sequence
from typing import Any

from . import sdo
from .can_file import DriveJoint
from .drive import Ask, Drive, DriveState, Mode, Procedure, Want, shorter_angle
from .errors import DriveError
from .frame import Frame, PeriodicFrame

NMT, SYNC, EMERGENCY, HEARTBEAT = 0x000, 0x080, 0x080, 0x700
TPDO1, RPDO1, TPDO2, RPDO2 = 0x180, 0x200, 0x280, 0x300
NMT_OPERATIONAL, NMT_STOPPED, NMT_PRE_OPERATIONAL, NMT_RESET = 0x01, 0x02, 0x80, 0x81
STATE_BOOT_UP, STATE_STOPPED, STATE_OPERATIONAL, STATE_PRE_OPERATIONAL = 0x00, 0x04, 0x05, 0x7F
# Operation modes, object 0x6060, and their bits in 0x6502.
PROFILE_VELOCITY, PROFILE_TORQUE, HOMING, CYCLIC_SYNCHRONOUS_TORQUE = 3, 4, 6, 10
MODE_BIT = {PROFILE_VELOCITY: 2, PROFILE_TORQUE: 3, HOMING: 5, CYCLIC_SYNCHRONOUS_TORQUE: 9}
# Controlwords.
DISABLE_VOLTAGE, SHUTDOWN, SWITCH_ON, ENABLE, QUICK_STOP, FAULT_RESET = 0x00, 0x06, 0x07, 0x0F, 0x02, 0x80
START_HOMING = 0x1F
SWITCH_ON_DISABLED = 0x0040  # of the statusword
HOMING_ATTAINED, HOMING_ERROR = 1 << 12, 1 << 13
RESET_TRIES, RESET_WAIT = 25, 0.02  # a drive may take its time to leave the fault [s]
# Homing methods 0x6098 by ours and the direction: on the index pulse 34 and 33, on a home switch 24 and 28.
HOMING_METHOD = {("index", 1): 34, ("index", -1): 33, ("switch", 1): 24, ("switch", -1): 28}
# Object, sub-index and bits of what is mapped.
MAPPED = {
    (0x1600, RPDO1): ((0x6040, 0, 16), (0x6071, 0, 16), (0x6060, 0, 8)),
    (0x1601, RPDO2): ((0x6040, 0, 16), (0x60FF, 0, 32), (0x6060, 0, 8)),
    (0x1A00, TPDO1): ((0x6041, 0, 16), (0x6064, 0, 32), (0x6077, 0, 16)),
    (0x1A01, TPDO2): ((0x606C, 0, 32), (0x6061, 0, 8), (0x603F, 0, 16)),
}
COB_INVALID = 1 << 31
# Error codes by their class (CiA 301 and CiA 402), the most particular first.
ERROR_CODES = {
    0x2310: "over_current", 0x2311: "over_current", 0x2312: "over_current", 0x2300: "over_current", 0x2200: "over_current",
    0x3210: "over_voltage", 0x3220: "under_voltage", 0x4210: "over_temperature", 0x4310: "over_temperature",
    0x4200: "over_temperature", 0x4300: "over_temperature", 0x5300: "operating_unit", 0x7305: "encoder", 0x7300: "encoder",
    0x8110: "can_overrun", 0x8120: "can_error_passive", 0x8130: "drive_watchdog", 0x8140: "bus_off", 0x8250: "drive_watchdog",
    0x8400: "velocity_control", 0x8611: "following_error",
}  # fmt: skip
ERROR_CLASSES = {
    0x20: "over_current", 0x21: "over_current", 0x22: "over_current", 0x23: "over_current", 0x30: "voltage", 0x31: "voltage",
    0x32: "voltage", 0x40: "over_temperature", 0x41: "over_temperature", 0x42: "over_temperature", 0x43: "over_temperature",
    0x73: "encoder", 0x81: "communication",
}  # fmt: skip


def error_name(code: int) -> str:
    """Return the name of an error code, "" for none."""
    if code == 0:
        return ""
    return ERROR_CODES.get(code) or ERROR_CLASSES.get(code >> 8) or "drive_fault"


def status_name(statusword: int) -> str:
    """Return the state of the drive's state machine (CiA 402-2, table of the statusword)."""
    low4, low6 = statusword & 0x4F, statusword & 0x6F
    if low4 == 0x00:
        return "not ready to switch on"
    if low4 == 0x40:
        return "switch on disabled"
    if low4 == 0x0F:
        return "fault reaction active"
    if low4 == 0x08:
        return "fault"
    return {0x21: "ready to switch on", 0x23: "switched on", 0x27: "operation enabled", 0x07: "quick stop active"}.get(
        low6, "unknown"
    )


# What to say in which state to come nearer to "operation enabled". A fault is never reset on the way.
TOWARDS_ENABLED = {
    "switch on disabled": SHUTDOWN, "ready to switch on": SWITCH_ON, "switched on": ENABLE, "operation enabled": ENABLE,
    "quick stop active": DISABLE_VOLTAGE,
}  # fmt: skip


class Cia402Drive(Drive):
    """One CANopen drive; see the module.

    Args:
        joint, rate, heartbeat, watchdog: see `Drive`.
        counts: of the drive per turn of the motor.
        master_id: node id of the computer.
        largest_torque: of the motor, for the drive's own limit [N m].
        largest_speed: of the motor, likewise [rad/s].
    """

    def __init__(
        self, joint: DriveJoint, rate: float, heartbeat: float, watchdog: float, counts: float, master_id: int,
        largest_torque: float, largest_speed: float,
    ) -> None:  # fmt: skip
        super().__init__(joint, rate, heartbeat, watchdog)
        assert joint.rated_torque is not None
        self._per_count = math.tau / counts
        self._torque_unit = joint.rated_torque / 1000.0
        self._velocity_unit = self._per_count if joint.velocity_unit == "counts/s" else math.tau / 60.0
        self._master_id = master_id
        self._largest_torque, self._largest_speed = largest_torque, largest_speed
        self._torque_mode = PROFILE_TORQUE if joint.torque_mode == "profile" else CYCLIC_SYNCHRONOUS_TORQUE
        self._count: int | None = None
        self._turns_counts = 0
        self.statusword = 0
        self.nmt_state: int | None = None
        self._homing_asked = False
        self._old_code = 0  # of an error that was cleared

    @property
    def identifiers(self) -> Sequence[int]:
        """TPDOs, emergency, SDO answers and heartbeat."""
        node = self.node_id
        return (TPDO1 + node, TPDO2 + node, EMERGENCY + node, sdo.RESPONSE + node, HEARTBEAT + node)

    @property
    def command_identifiers(self) -> Sequence[int]:
        """Both RPDOs."""
        return (RPDO1 + self.node_id, RPDO2 + self.node_id)

    # --- What it says ------------------------------------------------------------------------------------

    def receive(self, frame: Frame, now: float) -> None:
        """Take a frame."""
        kind, data = frame.id - self.node_id, frame.data
        if frame.remote or frame.extended:
            self.refused_frames += 1
        elif kind == TPDO1 and len(data) == 8:
            status, count, torque = struct.unpack("<Hih", data)
            self._take_status(status)
            if self._count is not None:
                self._turns_counts += shorter_angle(count, self._count)
            else:
                self._turns_counts = count
            self._count = count
            self.feedback.torque, self.feedback.torque_time = torque * self._torque_unit, now
            self.feedback.state_time = now
            self.feedback.position, self.feedback.position_time = self._turns_counts * self._per_count, now
        elif kind == TPDO2 and len(data) == 7:
            velocity, _, code = struct.unpack("<ibH", data)
            self.feedback.velocity, self.feedback.velocity_time = velocity * self._velocity_unit, now
            if code != self._old_code:
                self._old_code = 0
                self._take_error(code)
            elif self.feedback.state is DriveState.FAULT:
                self._take_error(code)
        elif kind == EMERGENCY and len(data) == 8:
            self._take_error(struct.unpack_from("<H", data)[0])
        elif kind == HEARTBEAT and len(data) == 1:
            if data[0] == STATE_BOOT_UP or (self.nmt_state == STATE_OPERATIONAL and data[0] & 0x7F != STATE_OPERATIONAL):
                self.feedback.restarted = True
                self._count = None
                self.feedback.state = DriveState.UNKNOWN
            self.nmt_state = data[0] & 0x7F
        elif kind == sdo.RESPONSE and len(data) == 8:
            pass
        else:
            self.refused_frames += 1
            return
        self.feedback.heard_time = now

    def _take_error(self, code: int) -> None:
        name = error_name(code)
        if name:
            if name not in self.feedback.error_names:
                self.feedback.error_names = (*self.feedback.error_names, name)
        elif self.feedback.state is not DriveState.FAULT:
            self.feedback.error_names = ()

    def _take_status(self, status: int) -> None:
        self.statusword = status
        name = status_name(status)
        if name in ("fault", "fault reaction active"):
            self.feedback.state = DriveState.FAULT
        else:
            self.feedback.state = DriveState.ENABLED if name == "operation enabled" else DriveState.DISABLED
        if self._homing_asked and self.feedback.homing == "busy":
            if status & HOMING_ERROR:
                self.feedback.homing = "failed"
            elif status & HOMING_ATTAINED and status & (1 << 10):
                self.feedback.homing = "attained"

    # --- What it is told ---------------------------------------------------------------------------------

    def output(self, want: Want, now: float) -> list[Frame]:
        """Return one RPDO: that of torque, or of velocity when that is wanted."""
        if self._begins(want) and self.feedback.state is not DriveState.FAULT:
            self.statusword = SWITCH_ON_DISABLED
        if not want.enabled:
            self._homing_asked = False
            return [self._torque_frame(DISABLE_VOLTAGE, 0.0, self._torque_mode)]
        word = TOWARDS_ENABLED.get(status_name(self.statusword), DISABLE_VOLTAGE)
        enabled = word == ENABLE and self.feedback.state is DriveState.ENABLED
        if want.mode is Mode.HOMING:
            if enabled and not self._homing_asked:
                self._homing_asked, self.feedback.homing = True, "busy"
                word = ENABLE  # an edge of the start bit is wanted: first without it
            elif enabled:
                word = START_HOMING
            return [self._torque_frame(word, 0.0, HOMING)]
        self._homing_asked = False
        value = want.value if enabled and math.isfinite(want.value) else 0.0
        if want.mode is Mode.VELOCITY:
            units = _whole(value / self._velocity_unit, 32)
            return [Frame(RPDO2 + self.node_id, struct.pack("<Hib", word, units, PROFILE_VELOCITY))]
        return [self._torque_frame(word, value, self._torque_mode)]

    def _torque_frame(self, word: int, torque: float, mode: int) -> Frame:
        return Frame(RPDO1 + self.node_id, struct.pack("<Hhb", word, _whole(torque / self._torque_unit, 16), mode))

    def decode_command(self, frame: Frame) -> Want | None:
        """Return what an RPDO asks."""
        kind, data = frame.id - self.node_id, frame.data
        if kind == RPDO1 and len(data) == 5:
            word, torque, _ = struct.unpack("<Hhb", data)
            return Want(word & 0x0F == ENABLE, Mode.TORQUE, torque * self._torque_unit)
        if kind == RPDO2 and len(data) == 7:
            word, velocity, _ = struct.unpack("<Hib", data)
            return Want(word & 0x0F == ENABLE, Mode.VELOCITY, velocity * self._velocity_unit)
        return None

    # --- Procedures --------------------------------------------------------------------------------------

    def configure(self) -> Procedure:
        """Check profile, firmware, modes and rated torque; set heartbeats, limits and PDOs; start the node."""
        self.feedback.restarted, self._count = False, None
        self.notes.clear()
        yield from self._nmt(NMT_PRE_OPERATIONAL)
        device = yield from self._read(0x1000)
        if device & 0xFFFF != 402:
            raise DriveError(
                f"{self.name}: device type 0x1000 = {device & 0xFFFF} is not allowed; allowed: 402, a CiA 402 drive"
            )
        yield from self._write(0x6040, 0, DISABLE_VOLTAGE, 2)  # whatever another computer has left on
        vendor = yield from self._read(0x1018, 1)
        product = yield from self._read(0x1018, 2)
        self.identity = f"vendor 0x{vendor:X}, product 0x{product:X}"
        try:
            version = yield from sdo.upload(self.name, self.node_id, 0x100A)
            self.firmware = version.split(b"\0")[0].decode("ascii", errors="replace")
        except sdo.SdoAbort:
            self.firmware = f"revision 0x{(yield from self._read(0x1018, 3)):X}"
        yield from self._check_motor()
        yield from self._choose_mode()
        yield from self._write(0x1017, 0, round(self.heartbeat * 1000), 2)
        yield from self._watch_this_computer()
        yield from self._write(0x6007, 0, 1, 2, "it does not say what it does without this computer")
        yield from self._write(
            0x6072, 0, _whole(self._largest_torque / self._torque_unit, 16), 2, "its torque limit is its own"
        )
        yield from self._write(0x6080, 0, math.ceil(self._largest_speed * 60.0 / math.tau), 4, "its speed limit is its own")
        for (mapping, base), objects in MAPPED.items():
            yield from self._map(mapping, base, objects)
        yield from self._nmt(NMT_OPERATIONAL)
        yield from self.clear()

    def _check_motor(self) -> Generator[Ask, Frame | None, None]:
        rated = (yield from self._read(0x6076)) / 1000.0
        stated = self._torque_unit * 1000.0
        if abs(rated - stated) > 0.005 * stated:
            raise DriveError(
                f"{self.name}: rated_torque = {stated:g} N m is not allowed; allowed: {rated:g}, which the drive says (0x6076)"
            )
        try:
            current = (yield from self._read(0x6075)) / 1000.0
        except sdo.SdoAbort:
            return
        implied = rated / current if current else math.inf
        if abs(implied - self.joint.torque_constant) > 0.05 * self.joint.torque_constant:
            self.notes.append(
                f"torque_constant is {self.joint.torque_constant:g} N m/A, rated torque over rated current {implied:.4g}"
            )

    def _watch_this_computer(self) -> Generator[Ask, Frame | None, None]:
        entry = (self._master_id << 16) | round(self.watchdog * 1000)
        if self.joint.unwatched:
            yield from self._write(0x1016, 1, entry, 4, "it does not watch this computer")
            return
        try:
            yield from self._write(0x1016, 1, entry, 4)
        except sdo.SdoAbort as error:
            raise DriveError(
                f"{error}; nothing would stop it without this computer; allowed: a drive that watches heartbeats, or "
                "unwatched: true in the file"
            ) from error

    def _choose_mode(self) -> Generator[Ask, Frame | None, None]:
        supported = yield from self._read(0x6502)
        choices = {"auto": (CYCLIC_SYNCHRONOUS_TORQUE, PROFILE_TORQUE), "cyclic_synchronous": (CYCLIC_SYNCHRONOUS_TORQUE,),
                   "profile": (PROFILE_TORQUE,)}[self.joint.torque_mode]  # fmt: skip
        fitting = [mode for mode in choices if supported >> MODE_BIT[mode] & 1]
        if not fitting:
            raise DriveError(
                f"{self.name}: torque_mode {self.joint.torque_mode!r} is not allowed; allowed: 0x6502 = 0x{supported:X}"
            )
        self._torque_mode = fitting[0]
        if not supported >> MODE_BIT[PROFILE_VELOCITY] & 1:
            self.notes.append("it has no profile velocity mode: velocity commands will not move it")

    def _map(self, mapping: int, base: int, objects: Sequence[tuple[int, int, int]]) -> Generator[Ask, Frame | None, None]:
        communication, cob = mapping - 0x200, base + self.node_id
        yield from self._write(communication, 1, cob | COB_INVALID, 4)
        receiving = base in (RPDO1, RPDO2)
        kind = 255 if receiving and not self.joint.synchronous_commands else 1
        yield from self._write(communication, 2, kind, 1)
        yield from self._write(mapping, 0, 0, 1)
        for i, (index, sub, bits) in enumerate(objects):
            yield from self._write(mapping, i + 1, index << 16 | sub << 8 | bits, 4)
        yield from self._write(mapping, 0, len(objects), 1)
        yield from self._write(communication, 1, cob, 4)

    def clear(self) -> Procedure:
        """Give an edge of the fault reset bit."""
        self.feedback.error_names, self.feedback.homing, self.feedback.restarted = (), None, False
        for word in (DISABLE_VOLTAGE, FAULT_RESET, DISABLE_VOLTAGE):
            yield from self._write(0x6040, 0, word, 2)
        for _ in range(RESET_TRIES):
            self._take_status((yield from self._read(0x6041)))
            if self.feedback.state is not DriveState.FAULT:
                break
            yield Ask(None, lambda _: False, "fault reset", RESET_WAIT, tries=1)
        code = self._old_code = yield from self._read(0x603F)
        self.feedback.error_names = ()
        if self.feedback.state is DriveState.FAULT:
            said = error_name(code) or "drive_fault"
            self.feedback.error_names = (said,)
            raise DriveError(f"{self.name}: the fault {said} (0x{code:04X}) stays after a reset; allowed: none")

    def prepare_homing(self, method: str, speed: float, direction: float) -> Procedure:
        """Set the homing method and its speeds."""
        self.feedback.homing, self._homing_asked = None, False
        units = max(_whole(speed / self._velocity_unit, 32), 1)
        yield from self._write(0x6098, 0, HOMING_METHOD[method, 1 if direction > 0 else -1], 1)
        yield from self._write(0x6099, 1, units, 4)
        yield from self._write(0x6099, 2, units, 4)
        yield from self._write(0x607C, 0, 0, 4, "it has no home offset")

    def _nmt(self, command: int) -> Iterator[Ask]:
        """Send an NMT command and leave the drive a moment for it: nothing answers it."""
        yield Ask(Frame(NMT, bytes((command, self.node_id))), lambda _: False, "NMT", timeout=0.01, tries=1)

    def _read(self, index: int, sub: int = 0) -> Generator[Ask, Frame | None, int]:
        return int.from_bytes((yield from sdo.upload(self.name, self.node_id, index, sub)), "little")

    def _write(self, index: int, sub: int, value: int, size: int, otherwise: str = "") -> Generator[Ask, Any, None]:
        """Write; where `otherwise` is given, a refusal is only noted."""
        try:
            yield from sdo.download(self.name, self.node_id, index, sub, value, size)
        except sdo.SdoAbort as error:
            if not otherwise:
                raise
            self.notes.append(f"{otherwise} ({error})")

    def periodic_frames(self) -> list[PeriodicFrame]:
        """Both TPDOs and one RPDO at the rate, and the heartbeat."""
        return [
            PeriodicFrame("torque or velocity (RPDO)", 7, self.rate),
            PeriodicFrame("status, position, torque (TPDO 1)", 8, self.rate),
            PeriodicFrame("velocity, error (TPDO 2)", 7, self.rate),
            PeriodicFrame("heartbeat of a drive", 1, 1.0 / self.heartbeat),
        ]


def _whole(value: float, bits: int) -> int:
    """Round towards zero, so that a limit holds after rounding too, and stay within a signed integer."""
    most = (1 << (bits - 1)) - 1
    return max(-most, min(most, math.trunc(value)))
