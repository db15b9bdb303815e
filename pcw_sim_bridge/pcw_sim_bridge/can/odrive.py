"""ODrive drives with the protocol CANSimple (firmware 0.6).

An identifier is the node id times 32 plus a command; `cansimple.dbc` describes the frames that are used here. It is read by
`cantools`; since decoding a frame there takes some 20 us, the layouts of the frames that come and go in each period are taken
from it once (`Layout`). Positions and currents come by themselves, at periods that are set in the drive
(`encoder_msg_rate_ms`, `iq_msg_rate_ms`, `heartbeat_msg_rate_ms`, `temperature_msg_rate_ms`); its watchdog
(`watchdog_timeout`) is fed by the torques and velocities it is sent.
"""

from __future__ import annotations

import functools
import math
import struct
from collections.abc import Sequence
from importlib import resources
from typing import Any

from .can_file import DriveJoint
from .drive import Ask, Drive, DriveState, Mode, Procedure, Want
from .errors import CanError, DriveError
from .frame import Frame, PeriodicFrame

DBC = "cansimple.dbc"
IDLE, ENCODER_INDEX_SEARCH, CLOSED_LOOP, HOMING = 1, 6, 8, 11
TORQUE_CONTROL, VELOCITY_CONTROL = 1, 2
PASSTHROUGH = 1
SUCCESS, BUSY = 0, 1
# Bits of Axis_Error.
ERRORS = {
    0x00000001: "initializing", 0x00000002: "system_level", 0x00000004: "timing", 0x00000008: "encoder",
    0x00000010: "bad_config", 0x00000020: "power_stage", 0x00000040: "missing_input", 0x00000100: "over_voltage",
    0x00000200: "under_voltage", 0x00000400: "over_current", 0x00000800: "over_current", 0x00001000: "over_current",
    0x00002000: "over_temperature", 0x00004000: "over_temperature", 0x00008000: "velocity_limit", 0x00010000: "position_limit",
    0x01000000: "drive_watchdog", 0x02000000: "estop", 0x04000000: "spinout", 0x08000000: "brake_resistor",
    0x10000000: "thermistor", 0x40000000: "calibration",
}  # fmt: skip
# Silence after which a message that should come by itself is missed [s].
CYCLIC_WAIT = 0.5
STATE_REPEAT = 0.05  # between two requests for a state [s]
HEARTBEATS_TO_CLEAR = 5  # until which errors that were cleared must be gone
TEMPERATURE_RATE = 25.0  # that is expected of the drive, so that heat is seen within the timeout [Hz]


@functools.cache
def database() -> Any:
    """Return the DBC as `cantools` reads it."""
    import cantools  # a second to load, and decoding alone needs it

    return cantools.database.load_string((resources.files(__package__) / DBC).read_text(), "dbc")


class Layout:
    """The layout of one message of the DBC as a `struct`.

    Raises:
        CanError: the DBC has no such message, or one that is not made of whole bytes in a row.
    """

    def __init__(self, message: str) -> None:
        try:
            found = database().get_message_by_name(message)
        except KeyError:
            raise CanError(f"message {message!r} is not allowed; allowed: those of {DBC}") from None
        self.command, self.size, self.names = found.frame_id, found.length, []
        code, at = "<", 0
        for signal in sorted(found.signals, key=lambda signal: signal.start):
            letter = "f" if signal.is_float and signal.length == 32 else {8: "B", 16: "H", 32: "I"}.get(signal.length, "")
            if not letter or signal.start != at or signal.byte_order != "little_endian" or signal.scale != 1:
                raise CanError(f"signal {message}.{signal.name} is not allowed; allowed: whole little-endian bytes in a row")
            code, at = code + letter, at + signal.length
            self.names.append(signal.name)
        self._struct = struct.Struct(code + "x" * (self.size - at // 8))

    def unpack(self, data: bytes) -> tuple[Any, ...] | None:
        """Return the values in the order of `names`; None for data of another length."""
        return self._struct.unpack(data) if len(data) == self.size else None

    def frame(self, node: int, *values: float) -> Frame:
        """Return the frame for a node."""
        return Frame(node << 5 | self.command, self._struct.pack(*values))


@functools.cache
def layout(message: str) -> Layout:
    """Return the layout of a message, made once."""
    return Layout(message)


def error_names(bits: int) -> tuple[str, ...]:
    """Return what Axis_Error says, each name once; bits that are not known as "drive_fault"."""
    names = dict.fromkeys(name for bit, name in ERRORS.items() if bits & bit)
    if bits and not names:
        names["drive_fault"] = None
    return tuple(names)


class ODriveDrive(Drive):
    """One axis of an ODrive; see the module.

    Args:
        joint, rate, heartbeat, watchdog: see `Drive`.
        largest_speed: of the motor, for the drive's own limit [rad/s].
    """

    def __init__(self, joint: DriveJoint, rate: float, heartbeat: float, watchdog: float, largest_speed: float) -> None:
        super().__init__(joint, rate, heartbeat, watchdog)
        self._largest_speed = largest_speed
        self._heartbeat, self._estimates, self._iq = layout("Heartbeat"), layout("Get_Encoder_Estimates"), layout("Get_Iq")
        self._temperature, self._torque, self._velocity = (
            layout("Get_Temperature"), layout("Set_Input_Torque"), layout("Set_Input_Vel"),
        )  # fmt: skip
        self._state, self._mode_layout = layout("Set_Axis_State"), layout("Set_Controller_Mode")
        self._by_command = {
            self._estimates.command: self._take_estimates, self._iq.command: self._take_iq,
            self._heartbeat.command: self._take_heartbeat, self._temperature.command: self._take_temperature,
            layout("Get_Error").command: self._take_errors,
        }  # fmt: skip
        self.axis_state = 0
        self._control_mode = 0
        self._asked_state, self._asked_time = 0, -math.inf
        self._homing_state = HOMING
        self._homing_asked = self._homing_began = False

    @property
    def identifiers(self) -> Sequence[int]:
        """All of the node: answers have the identifiers of the questions."""
        return range(self.node_id << 5, (self.node_id << 5) + 32)

    @property
    def spoken_identifiers(self) -> Sequence[int]:
        """What the DBC says is sent by an axis."""
        return [self.node_id << 5 | message.frame_id for message in database().messages if message.senders == ["Axis"]]

    @property
    def command_identifiers(self) -> Sequence[int]:
        """Torques and velocities."""
        return (self.node_id << 5 | self._torque.command, self.node_id << 5 | self._velocity.command)

    # --- What it says ------------------------------------------------------------------------------------

    def receive(self, frame: Frame, now: float) -> None:
        """Take a frame."""
        take = self._by_command.get(frame.id & 0x1F)
        if frame.remote or frame.extended:
            self.refused_frames += 1
        elif take is None:
            # An answer to a question, which its procedure looks at; or what only a computer sends, and nobody should here.
            self.feedback.heard_time = now
        elif take(frame.data, now):
            self.feedback.heard_time = now
        else:
            self.refused_frames += 1

    def _take_estimates(self, data: bytes, now: float) -> bool:
        values = self._estimates.unpack(data)
        if values is None or not (math.isfinite(values[0]) and math.isfinite(values[1])):
            return False
        self.feedback.position, self.feedback.position_time = values[0] * math.tau, now
        self.feedback.velocity, self.feedback.velocity_time = values[1] * math.tau, now
        return True

    def _take_iq(self, data: bytes, now: float) -> bool:
        values = self._iq.unpack(data)
        if values is None or not math.isfinite(values[1]):
            return False
        self.feedback.torque, self.feedback.torque_time = values[1] * self.joint.torque_constant, now
        return True

    def _take_temperature(self, data: bytes, now: float) -> bool:
        values = self._temperature.unpack(data)
        if values is None:
            return False
        known = [value for value in values if math.isfinite(value)]
        if known:
            self.feedback.temperature, self.feedback.temperature_time = max(known), now
        return True

    def _take_errors(self, data: bytes, now: float) -> bool:
        values = layout("Get_Error").unpack(data)
        if values is None:
            return False
        self._set_errors(values[0] | (values[1] if self.axis_state == IDLE else 0))
        return True

    def _take_heartbeat(self, data: bytes, now: float) -> bool:
        values = self._heartbeat.unpack(data)
        if values is None:
            return False
        errors, state, result, _ = values
        self.axis_state, self.feedback.state_time = state, now
        if errors:
            self._set_errors(errors)
            self.feedback.state = DriveState.FAULT
        else:
            self.feedback.error_names = ()
            self.feedback.state = (
                DriveState.ENABLED if state in (CLOSED_LOOP, HOMING, ENCODER_INDEX_SEARCH) else DriveState.DISABLED
            )
        if self._homing_asked and self.feedback.homing == "busy":
            if state == self._homing_state:
                self._homing_began = True
            elif self._homing_began and state in (IDLE, CLOSED_LOOP):
                self.feedback.homing = "attained" if result == SUCCESS else "failed"
        return True

    def _set_errors(self, bits: int) -> None:
        if bits:
            self.feedback.error_names = error_names(bits)

    # --- What it is told ---------------------------------------------------------------------------------

    def output(self, want: Want, now: float) -> list[Frame]:
        """Return the torque or velocity, and before it a change of state or mode where one is needed."""
        node, frames = self.node_id, []
        if self._begins(want):
            self.axis_state, self._asked_state = IDLE, IDLE
        if not want.enabled:
            self._homing_asked = False
            frames.append(self._torque.frame(node, 0.0))
            if self.axis_state != IDLE and self._may_ask(IDLE, now):
                frames.append(self._state.frame(node, IDLE))
            return frames
        if want.mode is Mode.HOMING:
            if not self._homing_asked:
                self._homing_asked, self._homing_began, self.feedback.homing = True, False, "busy"
                return [self._state.frame(node, self._homing_state)]
            return []
        self._homing_asked = False
        velocity = want.mode is Mode.VELOCITY
        control = VELOCITY_CONTROL if velocity else TORQUE_CONTROL
        value = want.value if self.axis_state == CLOSED_LOOP and math.isfinite(want.value) else 0.0
        wanted = self._velocity.frame(node, value / math.tau, 0.0) if velocity else self._torque.frame(node, value)
        if self._control_mode != control:
            # The drive keeps both inputs over a change of mode: none of before may act. That of speed comes with a torque of
            # zero, and before the mode; that of torque would be added to a speed that is held, and comes after it.
            self._control_mode = control
            frames += [wanted] if velocity else []
            frames.append(self._mode_layout.frame(node, control, PASSTHROUGH))
        if self.axis_state != CLOSED_LOOP and not self.feedback.error_names and self._may_ask(CLOSED_LOOP, now):
            frames.append(self._velocity.frame(node, 0.0, 0.0))  # sets the input of torque to zero as well
            frames.append(self._state.frame(node, CLOSED_LOOP))
        frames.append(wanted)
        return frames

    def _may_ask(self, state: int, now: float) -> bool:
        """Whether a state may be asked for: at once when it is another than the last one, else not too often."""
        if state == self._asked_state and now - self._asked_time < STATE_REPEAT:
            return False
        self._asked_state, self._asked_time = state, now
        return True

    def decode_command(self, frame: Frame) -> Want | None:
        """Return what a torque or velocity frame asks."""
        command = frame.id & 0x1F
        if frame.id >> 5 != self.node_id:
            return None
        if command == self._torque.command and (values := self._torque.unpack(frame.data)) is not None:
            return Want(True, Mode.TORQUE, values[0])
        if command == self._velocity.command and (values := self._velocity.unpack(frame.data)) is not None:
            return Want(True, Mode.VELOCITY, values[0] * math.tau)
        return None

    # --- Procedures --------------------------------------------------------------------------------------

    def configure(self) -> Procedure:
        """Check firmware and the messages that come by themselves, set limits and torque control; leave the axis idle."""
        node = self.node_id
        self.notes.clear()
        self._control_mode = 0
        yield from self._let_go()  # whatever another computer has left on
        answer = yield self._ask("Get_Version")
        values = None if answer is None else layout("Get_Version").unpack(answer.data)
        if values is None:
            raise DriveError(
                f"{self.name}: Get_Version has no answer; allowed: a drive that is on, on this bus, with this node id"
            )
        self.identity = f"hardware {values[1]}.{values[2]} variant {values[3]}"
        self.firmware = f"{values[4]}.{values[5]}.{values[6]}"
        if values[4] == 0 and values[5] < 6:
            raise DriveError(f"{self.name}: firmware {self.firmware} is not allowed; allowed: 0.6 and later")
        for message, what in (("Heartbeat", "heartbeat_msg_rate_ms"), ("Get_Encoder_Estimates", "encoder_msg_rate_ms"),
                              ("Get_Iq", "iq_msg_rate_ms")):  # fmt: skip
            command = layout(message).command
            if (yield self._wait(command, message, CYCLIC_WAIT)) is None:
                raise DriveError(f"{self.name}: {message} does not come by itself; allowed: {what} set in the drive")
        yield from self._let_go()
        yield from self._send(layout("Set_Limits").frame(node, self._largest_speed / math.tau, self.joint.current_limit))
        yield from self._send(self._mode_layout.frame(node, TORQUE_CONTROL, PASSTHROUGH))
        self._control_mode = TORQUE_CONTROL
        yield from self.clear()

    def clear(self) -> Procedure:
        """Clear the errors and see that they stay away."""
        yield from self._send(layout("Clear_Errors").frame(self.node_id, 0))
        self.feedback.error_names, self.feedback.homing = (), None
        errors = 0
        for count in range(HEARTBEATS_TO_CLEAR):
            answer = yield self._wait(self._heartbeat.command, "Heartbeat", CYCLIC_WAIT)
            if answer is None:
                raise DriveError(f"{self.name}: Heartbeat does not come; allowed: heartbeat_msg_rate_ms set in the drive")
            errors = struct.unpack_from("<I", answer.data)[0] if len(answer.data) == 8 else 0
            if count and not errors:  # the first may have been under way
                break
        if errors:
            raise DriveError(f"{self.name}: the faults {', '.join(error_names(errors))} stay after a reset; allowed: none")

    def feed(self) -> list[Frame]:
        """Return a torque of zero: some firmware wants its watchdog fed in the idle state too."""
        return [self._torque.frame(self.node_id, 0.0)]

    def _let_go(self) -> Procedure:
        yield from self._send(self._velocity.frame(self.node_id, 0.0, 0.0))
        yield from self._send(self._torque.frame(self.node_id, 0.0))
        yield from self._send(self._state.frame(self.node_id, IDLE))

    def prepare_homing(self, method: str, speed: float, direction: float) -> Procedure:
        """Choose index search or homing on the endstop; speed and direction of both are set in the drive."""
        self.feedback.homing, self._homing_asked, self._homing_began = None, False, False
        self._homing_state = ENCODER_INDEX_SEARCH if method == "index" else HOMING
        yield from self._send(self._mode_layout.frame(self.node_id, VELOCITY_CONTROL, PASSTHROUGH))
        self._control_mode = VELOCITY_CONTROL

    def _ask(self, message: str) -> Ask:
        identifier = self.node_id << 5 | layout(message).command
        return Ask(Frame(identifier, b"", remote=True), lambda frame: frame.id == identifier and len(frame.data) == 8, message)

    def _wait(self, command: int, what: str, timeout: float) -> Ask:
        identifier = self.node_id << 5 | command
        return Ask(None, lambda frame: frame.id == identifier and not frame.remote, what, timeout, tries=1)

    def _send(self, frame: Frame) -> Procedure:
        yield Ask(frame, lambda _: False, "", timeout=0.002, tries=1)

    def periodic_frames(self) -> list[PeriodicFrame]:
        """Torque or velocity out; estimates, current, heartbeat and temperature in."""
        return [
            PeriodicFrame("torque or velocity", 8, self.rate),
            PeriodicFrame("position and velocity", 8, self.rate),
            PeriodicFrame("current", 8, self.rate),
            PeriodicFrame("heartbeat of a drive", 8, 1.0 / self.heartbeat),
            PeriodicFrame("temperature", 8, TEMPERATURE_RATE),
        ]
