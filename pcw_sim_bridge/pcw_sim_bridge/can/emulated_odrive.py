"""An emulated ODrive axis with CANSimple: cyclic messages, answers to remote frames, states, errors and the watchdog."""

from __future__ import annotations

import math

from .can_file import DriveJoint
from .drive import Mode
from .emulated_drive import AMBIENT, EmulatedDrive, first_due
from .frame import Frame
from .odrive import (
    CLOSED_LOOP,
    ENCODER_INDEX_SEARCH,
    HOMING,
    IDLE,
    SUCCESS,
    TEMPERATURE_RATE,
    TORQUE_CONTROL,
    VELOCITY_CONTROL,
    layout,
)

ERROR_BIT = {"over_temperature": 0x2000, "over_current": 0x1000, "drive_watchdog": 0x01000000, "encoder": 0x08}
CANCELLED, BUSY = 2, 1
VERSION = (2, 4, 4, 58, 0, 6, 9, 0)


class EmulatedODrive(EmulatedDrive):
    """One axis; see `EmulatedDrive`.

    Attributes:
        watches_when_idle: its watchdog wants to be fed in the idle state too, as with some firmware.
        unwatched: its watchdog is not enabled.
    """

    def __init__(self, joint: DriveJoint, rate: float, heartbeat: float, watchdog: float) -> None:
        super().__init__(joint, rate, heartbeat, watchdog)
        self._torque_constant = joint.torque_constant
        self.watches_when_idle = self.unwatched = False
        self.power_on(0.0)

    def power_on(self, now: float) -> list[Frame]:
        """Start anew; what is set in the drive is kept there."""
        self.state, self.errors, self.disarm_reason, self.result = IDLE, 0, 0, SUCCESS
        self.control_mode, self.failure = TORQUE_CONTROL, ""
        self.input_torque = self.input_velocity = 0.0
        self.velocity_limit = self.current_limit = math.inf
        self._fed = now
        self._next = {name: now for name in ("Heartbeat", "Get_Encoder_Estimates", "Get_Iq", "Get_Temperature")}
        self.mark_wanted = 0
        return []

    def want(self) -> tuple[Mode, float] | None:
        """Return what it does to the motor now."""
        if self.dead or self.errors:
            return None
        if self.state in (HOMING, ENCODER_INDEX_SEARCH):
            return Mode.VELOCITY, self.mark_wanted * self.homing_speed
        if self.state != CLOSED_LOOP:
            return None
        if self.control_mode == TORQUE_CONTROL:
            most = self.current_limit * self._torque_constant
            return Mode.TORQUE, max(-most, min(most, self.input_torque))
        return Mode.VELOCITY, max(-self.velocity_limit, min(self.velocity_limit, self.input_velocity))

    def _homed(self) -> None:
        self.state, self.result = IDLE, SUCCESS

    # --- Frames ------------------------------------------------------------------------------------------

    def receive(self, frame: Frame, now: float) -> list[Frame]:
        """Take a frame."""
        if self.dead or frame.extended or frame.error or frame.id >> 5 != self.node_id:
            return []
        command = frame.id & 0x1F
        if frame.remote:
            return [] if self.silent else self._answer(command)
        if command == layout("Set_Input_Torque").command:
            values = layout("Set_Input_Torque").unpack(frame.data)
            if values is not None and math.isfinite(values[0]):
                self._feed(now)
                self.input_torque = values[0]
        elif command == layout("Set_Input_Vel").command:
            values = layout("Set_Input_Vel").unpack(frame.data)
            if values is not None and math.isfinite(values[0]) and math.isfinite(values[1]):
                self._feed(now)
                self.input_velocity = values[0] * math.tau
                self.input_torque = values[1]  # in torque control it is the torque, else it is added
        elif command == layout("Set_Axis_State").command:
            values = layout("Set_Axis_State").unpack(frame.data)
            if values is not None:
                self._set_state(values[0], now)
        elif command == layout("Set_Controller_Mode").command:
            values = layout("Set_Controller_Mode").unpack(frame.data)
            if values is not None and values[0] in (TORQUE_CONTROL, VELOCITY_CONTROL):
                self.control_mode = values[0]  # the inputs stay as they are
        elif command == layout("Set_Limits").command:
            values = layout("Set_Limits").unpack(frame.data)
            if values is not None and values[0] > 0.0 and values[1] > 0.0:
                self.velocity_limit, self.current_limit = values[0] * math.tau, values[1]
        elif command == layout("Clear_Errors").command and len(frame.data) <= 1:
            self._fed = now
            self.errors = 0 if self.temperature <= 100.0 else ERROR_BIT["over_temperature"]
            self.failure = "" if not self.errors else "over_temperature"
        elif command == layout("Estop").command:
            self.trip_bits(0x02000000)
        return []

    def _feed(self, now: float) -> None:
        self._fed = self.command_time = now
        self.commands += 1

    def _set_state(self, state: int, now: float) -> None:
        if self.errors and state != IDLE:
            return
        if state == CLOSED_LOOP:
            self.state, self.result, self._fed = state, SUCCESS, now
        elif state in (HOMING, ENCODER_INDEX_SEARCH):
            self.state, self.result, self.mark_wanted = state, BUSY, self.homing_direction
        elif state == IDLE:
            if self.state in (HOMING, ENCODER_INDEX_SEARCH):
                self.result = CANCELLED
            self.state, self.mark_wanted = IDLE, 0

    def _answer(self, command: int) -> list[Frame]:
        for name in ("Get_Version", "Get_Encoder_Estimates", "Get_Iq", "Get_Temperature", "Get_Error",
                     "Get_Bus_Voltage_Current", "Get_Torques"):  # fmt: skip
            if layout(name).command == command:
                return [self._message(name)]
        return []

    def _message(self, name: str) -> Frame:
        iq = self.shown_torque / self._torque_constant
        values: dict[str, tuple[float, ...]] = {
            "Get_Version": VERSION,
            "Heartbeat": (self.errors, self.state, self.result, 0),
            "Get_Error": (self.errors, self.disarm_reason),
            "Get_Encoder_Estimates": (self.shown_position / math.tau, self.shown_velocity / math.tau),
            "Get_Iq": (iq, iq),
            "Get_Temperature": (self.temperature, self.temperature - 5.0 if self.temperature > AMBIENT else AMBIENT),
            "Get_Bus_Voltage_Current": (24.0, 1.0),
            "Get_Torques": (self.input_torque, self.shown_torque),
        }
        return layout(name).frame(self.node_id, *values[name])

    def tick(self, now: float) -> list[Frame]:
        """Send what is due; trip when nobody feeds the watchdog."""
        if self.dead:
            return []
        watching = not self.unwatched and not self.errors and (self.state == CLOSED_LOOP or self.watches_when_idle)
        if watching and now - self._fed > self.watchdog:
            self.trip("drive_watchdog", now)
        periods = {"Heartbeat": self.heartbeat, "Get_Encoder_Estimates": 1.0 / self.rate, "Get_Iq": 1.0 / self.rate,
                   "Get_Temperature": 1.0 / TEMPERATURE_RATE}  # fmt: skip
        frames = []
        for name, period in periods.items():
            if now >= self._next[name] - 1e-9:
                self._next[name] = first_due(self._next[name], period, now)
                if not self.silent:
                    frames.append(self._message(name))
        return frames

    def trip(self, name: str, now: float) -> list[Frame]:
        """Fail; an ODrive says so in its next heartbeat, which it sends at once."""
        self.trip_bits(ERROR_BIT[name])
        self.failure = name
        return [] if self.silent else [self._message("Heartbeat")]

    def trip_bits(self, bits: int) -> None:
        """Fail with these bits of Axis_Error."""
        self.errors, self.disarm_reason, self.state = self.errors | bits, bits, IDLE
        self.mark_wanted = 0
