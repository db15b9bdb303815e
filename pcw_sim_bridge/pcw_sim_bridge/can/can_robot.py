"""The robot behind its drives: what the CAN driver does in each period, without ROS and without a clock of its own.

A period begins with the torques that are due, SYNC and heartbeats. Then frames are taken as they come; when every drive has
said position and speed, the reading goes to whoever controls, and the command that comes back goes out at once. At most one
command a period goes out at once; a later one waits for the next period, and only the newest does. When the period is over
everything is looked at (`supervisor`).

States, besides what the drives say of themselves:

    not configured --configure()--> off --request_enable()--> enabling --all drives have torque--> armed
    armed --request_disable()--> off;    any state --fault--> off, until clear_faults()

Torque leaves only while armed, through `OutputGate`. A fault takes the torque from all drives, and stays.
"""

from __future__ import annotations

import dataclasses
import threading
from collections.abc import Callable, Iterable, Sequence

import numpy as np

from pcw_description.robot_description import DRIVE, STEER, FloatArray, RobotDescription

from ..sensors import JointReading
from ..simulated_robot import JointCommand
from .bus_load import BusLoad, check_loads
from .can_file import CanFile, Homing, counts_per_turn, joint_place
from .cia402 import HEARTBEAT, NMT, STATE_OPERATIONAL, SYNC
from .drive import OFF, Ask, Drive, DriveState, Mode, Procedure, Want, newer_than
from .drive_set import bus_loads, make_drives, master_heartbeat
from .encoder_watch import EncoderWatch
from .errors import CanError, DriveError
from .frame import ERROR_BUS_OFF, Arrived, Frame
from .motor_map import MotorMap
from .output_gate import OutputGate
from .sdo import REQUEST
from .supervisor import HEARTBEATS_MISSED, STILL, DriveWatch, Fault
from .transport import BusOff, TransmitBufferFull, Transport

ENABLE_TIME = 1.0  # in which all drives must have torque, or none keeps it [s]
# Of periods, to follow drives that speak by their own clocks: where sets should be whole, and what of an error is made good.
MIDDLE, FOLLOWED, LARGEST_SHIFT = 0.5, 0.05, 0.02
# Behind by so many periods the missed ones are given up, not made up for.
MOST_BEHIND = 3
MOST_FOREIGN = 100
FOREIGN_TOLD = 3.0  # so long after its newest frame a foreign identifier is told [s]; heartbeats come about once a second
# Ages of commands that are kept for their quantiles.
AGES_KEPT = 8192
OLD_FRAMES = 0.2  # for so long frames of another time are thrown away, and no longer on a bus that never falls silent [s]


@dataclasses.dataclass(frozen=True)
class TimedReading:
    """What the joints read at one time.

    Attributes:
        time: of the transport [s].
        joints: positions, speeds and torques (n, 2), joint side.
        complete: every drive has spoken in this period; else some numbers are a period old.
    """

    time: float
    joints: JointReading
    complete: bool


@dataclasses.dataclass
class Counters:
    """What has happened so far."""

    cycles: int = 0
    late_cycles: int = 0  # begun more than a period late
    incomplete: int = 0  # periods in which a drive did not speak
    commands: int = 0
    refused_commands: int = 0
    held_back: int = 0  # commands that were replaced by a newer one before they left
    stale_commands: int = 0  # that answer a reading older than `timeouts.command`; not used
    limited: int = 0  # commands that the gate has cut
    transmit_full: int = 0
    error_frames: int = 0
    foreign_frames: int = 0
    refused_frames: int = 0


OnReading = Callable[[TimedReading], object]


class CanRobot:
    """A robot on CAN.

    Args:
        robot: the robot.
        file: its drives.
        transport: its buses, open.
        encoders_agree: hold the encoders against each other (`encoder_watch`); not while the headings are not known yet.

    Attributes:
        faults: why there is no torque; empty in health.
        foreign: identifiers that belong to nobody, by bus and identifier, with their number.

    Raises:
        CanError: more axes than a bus can carry, with the arithmetic.
    """

    def __init__(
        self, robot: RobotDescription, file: CanFile, transport: Transport, encoders_agree: bool = True
    ) -> None:
        self.robot, self.file, self.transport = robot, file, transport
        self.period = 1.0 / file.rate
        self.drives: tuple[Drive, ...] = make_drives(robot, file)
        self.loads: dict[str, BusLoad] = bus_loads(file, self.drives)
        check_loads(self.loads)
        self.map = MotorMap(robot, file)
        self.gate = OutputGate(robot, file, self.map)
        self._watches = []
        allowed, resolution = np.zeros((robot.n, 2)), np.zeros((robot.n, 2))
        for drive in self.drives:
            place = joint_place(robot, drive.name)
            gear, count = robot.gear_matrix[place][place[1]], 2.0 * np.pi / counts_per_turn(drive.joint, robot)
            allowed[place], resolution[place] = drive.joint.encoder_still, count / abs(gear)
            torque = self.gate.joint_torque[place]
            self._watches.append(DriveWatch(drive, gear, torque, file.timeouts.feedback, count))
        self._encoder_watch = EncoderWatch(robot, allowed, resolution) if encoders_agree else None
        self._standing: list[Fault] = []
        self._owners = {(drive.joint.bus, i): drive for drive in self.drives for i in drive.identifiers}
        self._command_ids = {(drive.joint.bus, i) for drive in self.drives for i in drive.command_identifiers}
        self._canopen_buses = sorted({drive.joint.bus for drive in self.drives if drive.joint.protocol == "cia402"})
        # What only a computer sends: where it comes in, another one commands these drives.
        self._computer_ids = self._command_ids | {
            (drive.joint.bus, i)
            for drive in self.drives if drive.joint.protocol == "cia402"
            for i in (NMT, SYNC, HEARTBEAT + int(file.master_id), REQUEST + drive.node_id)
        }  # fmt: skip
        self._lock = threading.RLock()
        self._asks: dict[str, tuple[Drive, Ask]] = {}
        self._answers: dict[str, Frame] = {}
        self.counters = Counters()
        self.faults: list[Fault] = []
        self.foreign: dict[tuple[str, int], int] = {}
        self._foreign_heard: dict[tuple[str, int], float] = {}
        self.command_ages: list[float] = []
        self.armed = self.configured = False
        self._enabling_since: float | None = None
        self._homing: dict[str, Homing] = {}
        self._homing_since = 0.0
        self.homing_results: dict[str, str] = {}
        self._command: JointCommand | None = None
        self._command_time: float | None = None
        self._stale_in_row = 0  # since the newest command that was of use
        self._sent_in_cycle = self._waiting = False  # a command has gone out in this period; a newer one waits for the next
        self._next_tick: float | None = None
        self._next_heartbeat = -np.inf
        self._published_time = -np.inf
        self._sync_time = 0.0
        self._reading: TimedReading | None = None
        self._stopping = False

    # --- Set-up ------------------------------------------------------------------------------------------

    def configure(self) -> None:
        """Check every drive and set it up, without torque; then see that all of them speak.

        Raises:
            CanError: names every drive that is not as it must be.
        """
        self.armed, self.configured, self._enabling_since = False, False, None
        self._command, self._homing, self._next_tick = None, {}, None
        self._foreign_heard = {}
        end = self.transport.now() + OLD_FRAMES
        while self.transport.receive(0.0) and self.transport.now() < end:
            pass  # what came before is of another time
        self._run([(drive, drive.configure()) for drive in self.drives])
        self.faults, self._standing = [], []
        begun = self.transport.now()
        while self.transport.now() < begun + 0.5 and not self.faults:
            self._cycle_once(None)
            if self._reading is not None and not any(_not_said(drive, begun) for drive in self.drives):
                break
        if self.faults:  # of a bus; the drives are looked at from now on
            raise CanError("; ".join(map(str, self.faults)))
        silent = [f"{drive.name}: no {what} comes; allowed: every period"
                  for drive in self.drives if (what := _not_said(drive, begun))]  # fmt: skip
        if silent:
            raise CanError("\n".join(silent))
        self._forget()
        self.configured = True

    def _forget(self) -> None:
        for watch in self._watches:
            watch.forget()
        if self._encoder_watch is not None:
            self._encoder_watch.forget()
        self._standing = []

    def clear_faults(self) -> None:
        """Set every drive up anew and forget the faults; gives no torque.

        Raises:
            CanError: a fault that stays; of drives that cannot be set up one is left, which the next `clear_faults` may clear.
        """
        try:
            self.configure()
        except CanError as error:
            self.faults = self.faults or [Fault("not_set_up", "the drives", "; ".join(str(error).splitlines()))]
            raise

    def _run(self, procedures: Sequence[tuple[Drive, Procedure]]) -> None:
        """Run procedures of several drives at once; each asks one question at a time.

        Raises:
            CanError: the problems of all drives, line by line.
        """
        waiting: dict[str, tuple[Drive, Procedure, Ask, float, int]] = {}
        problems: list[str] = []

        def go_on(drive: Drive, procedure: Procedure, answer: Frame | None, first: bool = False) -> None:
            try:
                ask = next(procedure) if first else procedure.send(answer)
            except StopIteration:
                waiting.pop(drive.name, None)
            except DriveError as error:
                problems.append(str(error))
                waiting.pop(drive.name, None)
            else:
                self._put_question(drive, ask)
                waiting[drive.name] = (drive, procedure, ask, self.transport.now() + ask.timeout, ask.tries - 1)

        for drive, procedure in procedures:
            go_on(drive, procedure, None, first=True)
        while waiting:
            self._beat(self.transport.now())
            soonest = min(deadline for _, _, _, deadline, _ in waiting.values())
            wait = min(max(soonest - self.transport.now(), 0.0), master_heartbeat(self.file))
            for arrived in self.transport.receive(wait):
                owner = self._handle(arrived)
                if owner is not None and owner.name in waiting and waiting[owner.name][2].accept(arrived.frame):
                    go_on(owner, waiting[owner.name][1], arrived.frame)
            now = self.transport.now()
            for name, (drive, procedure, ask, deadline, tries) in list(waiting.items()):
                if now < deadline or waiting[name][2] is not ask:
                    continue
                if tries > 0:
                    self._put_question(drive, ask)
                    waiting[name] = (drive, procedure, ask, now + ask.timeout, tries - 1)
                else:
                    go_on(drive, procedure, None)
        if problems:
            raise CanError("\n".join(problems))

    def _put_question(self, drive: Drive, ask: Ask) -> None:
        if ask.frame is not None:
            self._send(drive.joint.bus, ask.frame)

    # --- Torque on and off -------------------------------------------------------------------------------

    def request_enable(self) -> None:
        """Begin to give the drives torque, at first zero; `armed` once all have it.

        Raises:
            CanError: not configured, a fault that has not been cleared, homing under way, or another computer that commands.
        """
        with self._lock:
            if self.faults:
                raise CanError(f"torque is not allowed after {'; '.join(map(str, self.faults))}; allowed: clear_faults first")
            if not self.configured:
                raise CanError("torque is not allowed before the drives are configured; allowed: configure first")
            if self._homing:
                raise CanError(
                    f"torque is not allowed while {', '.join(self._homing)} look for their marks; allowed: afterwards"
                )
            if others := [f"0x{i:03X} on {bus}" for bus, i in self._heard_lately() if (bus, i) in self._command_ids]:
                raise CanError(  # the drives would do what either says, by turns
                    f"torque is not allowed while another computer or program commands these drives ({', '.join(others)}); "
                    f"allowed: {FOREIGN_TOLD:g} s after it has ended"
                )
            self._command, self._command_time, self._stale_in_row, self._sent_in_cycle = None, None, 0, False
            for drive in self.drives:
                if drive.feedback.state is DriveState.ENABLED:
                    drive.feedback.state = DriveState.DISABLED  # said before it was told to be; it has to say so anew
            if self._encoder_watch is not None:
                self._encoder_watch.forget()
            self._standing = []
            self._enabling_since = self.transport.now()

    def request_disable(self) -> None:
        """Zero torque, then none at all."""
        with self._lock:
            self._command, self._enabling_since = None, None
            if self.armed:
                self._send_outputs(self.transport.now())  # zero, with the drives still on
            self.armed = False
            self._homing = {}
            self._send_outputs(self.transport.now())

    def enable(self) -> None:
        """Give the drives torque and run periods until all have it; for callers without a thread.

        Raises:
            CanError: see `request_enable`, or a drive that does not take it.
        """
        self.request_enable()
        while not self.armed:
            self.cycle(None)
            if not self.armed and (self.faults or self._enabling_since is None):
                raise CanError("; ".join(map(str, self.faults)) or "the drives did not take torque")

    def stop(self, faults: Iterable[Fault]) -> None:
        """Take the torque from all drives; it stays off until `clear_faults`."""
        with self._lock:
            known = {(fault.name, fault.where) for fault in self.faults}
            self.faults += [fault for fault in faults if (fault.name, fault.where) not in known]
            if self._stopping:
                return
            self._stopping = True
            try:
                was_on = self.armed or self._enabling_since is not None or bool(self._homing)
                self.armed, self._enabling_since, self._command = False, None, None
                for name in self._homing:
                    self.homing_results[name] = "stopped by a fault"
                self._homing = {}
                if was_on:
                    self._send_outputs(self.transport.now())
            finally:
                self._stopping = False

    def still_on_without_computer(self) -> list[str]:
        """Give the drives torque, of zero, fall silent for longer than their watchdog, and return whose drive has it still.

        Torque is off afterwards, and the faults that drives rightly have are cleared.

        Raises:
            CanError: see `enable` and `clear_faults`.
        """
        self.enable()
        with self._lock:
            self.armed = False  # nothing is sent from here on
        end = self.transport.now() + 2.0 * self.file.timeouts.watchdog + self.period
        while (now := self.transport.now()) < end:
            for arrived in self.transport.receive(end - now):
                self._handle(arrived)
        asked = self.transport.now()
        for bus in self._canopen_buses:
            self._send(bus, Frame(SYNC))  # a CANopen drive says its state when it is asked; it is no heartbeat
        end = asked + max(self.period, HEARTBEATS_MISSED * self.file.heartbeat)
        while (now := self.transport.now()) < end:
            for arrived in self.transport.receive(end - now):
                self._handle(arrived)
        on = [drive.name for drive in self.drives
              if drive.feedback.state is DriveState.ENABLED and drive.feedback.state_time >= asked]  # fmt: skip
        self.request_disable()
        self.clear_faults()
        return on

    # --- Commands ----------------------------------------------------------------------------------------

    def command(self, command: JointCommand | None, answers: float | None = None) -> None:
        """Take a command; the newest counts. None, NaN and infinity are zero torque.

        Without torque it is not kept: what was wanted before must not act when torque comes. One that answers a reading older
        than `timeouts.command` has been somewhere for too long: it is counted, and as good as none.

        Args:
            command: joint torques or speeds.
            answers: time of the reading that it was computed from [s], where known.
        """
        with self._lock:
            now = self.transport.now()
            self.counters.commands += 1
            if not self.armed:
                return
            if answers is not None and now - answers > self.file.timeouts.command:
                self.counters.stale_commands += 1
                self._stale_in_row += 1
                return
            if command is None:
                self.counters.refused_commands += 1
            if self._waiting:
                self.counters.held_back += 1
            self._command, self._command_time, self._stale_in_row = command, now, 0
            self._waiting = self._sent_in_cycle
            if not self._sent_in_cycle:
                self._send_outputs(now)
                self._sent_in_cycle = True
                if answers is not None:
                    self.command_ages.append(self.transport.now() - answers)
                    if len(self.command_ages) > 2 * AGES_KEPT:
                        del self.command_ages[:AGES_KEPT]

    def _wants(self, now: float) -> list[Want]:
        """Return what each drive shall do now; everything that moves a motor comes from here."""
        if self._homing:
            return [Want(True, Mode.HOMING) if drive.name in self._homing else OFF for drive in self.drives]
        if not self.armed and self._enabling_since is None:
            return [OFF] * len(self.drives)
        command = self._command
        if command is not None and command.velocity is not None:
            mode, gated = Mode.VELOCITY, self.gate.velocity(command.velocity, self.armed)
        else:
            mode, gated = Mode.TORQUE, self.gate.torque(None if command is None else command.effort, self.armed)
        if gated.fault:
            mode = Mode.TORQUE
        self.counters.limited += gated.limited
        return [Want(True, mode, value) for value in gated.motor.ravel().tolist()]

    def _send_outputs(self, now: float) -> None:
        failed = False
        for drive, want in zip(self.drives, self._wants(now), strict=True):
            for frame in drive.output(want, now):
                if not self._send(drive.joint.bus, frame) and want.enabled:
                    failed = True
            if failed:
                return  # `_send` has stopped the robot, which sent everything anew

    def _send(self, bus: str, frame: Frame) -> bool:
        """Send a frame; a bus that does not take it stops the robot."""
        try:
            self.transport.send(bus, frame)
        except TransmitBufferFull as error:
            self.counters.transmit_full += 1
            self.stop([Fault("transmit_buffer_full", bus, str(error))])
        except BusOff as error:
            self.stop([Fault("bus_off", bus, str(error))])
        except Exception as error:  # whatever an interface may raise: the other drives must still be told to stop
            self.stop([Fault("bus_error", bus, f"{type(error).__name__}: {error}")])
        else:
            return True
        return False

    # --- A period ----------------------------------------------------------------------------------------

    def cycle(self, on_reading: OnReading | None) -> None:
        """Do one period; returns at its end.

        Args:
            on_reading: called once, with the reading of this period; it may call `command`.
        """
        self._cycle_once(on_reading)
        with self._lock:
            self._supervise(self.transport.now())

    def _cycle_once(self, on_reading: OnReading | None) -> None:
        now = self.transport.now()
        if self._next_tick is None or now - self._next_tick > MOST_BEHIND * self.period:
            self.counters.late_cycles += self._next_tick is not None
            self._next_tick = now
        self.counters.cycles += 1
        with self._lock:
            if self.configured and (self._waiting or not self._sent_in_cycle):
                self._send_outputs(now)
            self._sent_in_cycle = self._waiting = False
            for bus in self._canopen_buses:
                self._send(bus, Frame(SYNC))
            self._sync_time = now
            self._beat(now)
        self._next_tick += self.period
        published = False
        while True:
            remaining = self._next_tick - self.transport.now()
            arrived = self.transport.receive(max(remaining, 0.0))
            with self._lock:
                for one in arrived:
                    self._handle(one)
                complete = not published and self._is_complete()
            if complete:
                published = True
                self._follow(1.0 - (self._next_tick - self.transport.now()) / self.period - MIDDLE)
                self._publish(on_reading, complete=True)
            if remaining <= 0.0 and not arrived:
                break
            if self.transport.now() - self._next_tick > MOST_BEHIND * self.period:
                break  # a flood of frames: the watch must not wait for its end
        if not published and self._reading is not None:
            self.counters.incomplete += 1
            self._follow(1.0)  # away from the end of the period, on one side of which the last of the set must be
            if not self._is_silent():
                self._publish(on_reading, complete=False)

    def _follow(self, late: float) -> None:
        """Shift the next period so that sets are whole in its middle; late: of this one, in periods.

        Drives without SYNC speak by their own clocks. Where their period ends with ours, a set is whole now before, now after
        that end, and every other command a period late.
        """
        if self._next_tick is not None and len(self._canopen_buses) < len(self.file.buses):
            self._next_tick += min(max(FOLLOWED * late, -LARGEST_SHIFT), LARGEST_SHIFT) * self.period

    def _beat(self, now: float) -> None:
        if now >= self._next_heartbeat:
            self._next_heartbeat = now + master_heartbeat(self.file) * 0.999
            if not self.configured:
                for drive in self.drives:
                    for frame in drive.feed():
                        self._send(drive.joint.bus, frame)
            for bus in self._canopen_buses:
                self._send(bus, Frame(HEARTBEAT + int(self.file.master_id), bytes((STATE_OPERATIONAL,))))

    def _is_complete(self) -> bool:
        since, now = self._published_time, self.transport.now()
        return all(newer_than(drive.feedback, since, now, self.period) for drive in self.drives)

    def _is_silent(self) -> bool:
        """Whether a drive has said nothing for so long that it is missing: what it said before is no reading of now."""
        newest = (min(f.position_time, f.velocity_time, f.torque_time) for f in (drive.feedback for drive in self.drives))
        return self.transport.now() - min(newest) > self.file.timeouts.feedback

    def _publish(self, on_reading: OnReading | None, complete: bool) -> None:
        with self._lock:
            oldest = min(drive.feedback.position_time for drive in self.drives)
            newest = max(
                max(f.position_time, f.velocity_time, f.torque_time) for f in (drive.feedback for drive in self.drives)
            )
            joints = self._joint_reading()
            if not (np.isfinite(joints.position).all() and np.isfinite(joints.velocity).all()):
                return
            # With SYNC all drives have read at that time; without it at about when the first of the set came.
            time = self._sync_time if len(self._canopen_buses) == len(self.file.buses) and complete else oldest
            if complete:
                self._published_time = newest
            if self._reading is not None and time <= self._reading.time:
                time = np.nextafter(self._reading.time, np.inf)
            reading = self._reading = TimedReading(float(time), joints, complete)
            if complete and self.armed and self._encoder_watch is not None:
                for k, turn in self._encoder_watch.look(joints.position):
                    detail = f"its count stands and by the other joints it turned by {turn:.3f} rad: encoder, brake, or slip"
                    self._standing.append(Fault("encoder_stuck", self.drives[k].name, detail))
        if on_reading is not None:
            on_reading(reading)

    def _joint_reading(self) -> JointReading:
        shape = (self.robot.n, 2)
        motor = np.array([[d.feedback.position, d.feedback.velocity, d.feedback.torque] for d in self.drives])
        position = self.map.joint_position(motor[:, 0].reshape(shape))
        velocity = self.map.joint_velocity(motor[:, 1].reshape(shape))
        effort = self.map.joint_torque(motor[:, 2].reshape(shape))
        return JointReading(position, velocity, np.where(np.isfinite(effort), effort, 0.0))

    @property
    def reading(self) -> TimedReading | None:
        """The newest reading."""
        return self._reading

    def _handle(self, arrived: Arrived) -> Drive | None:
        bus, frame, time = arrived
        if frame.error:
            self.counters.error_frames += 1
            if frame.id & ERROR_BUS_OFF:
                self.stop([Fault("bus_off", bus, "the interface has left the bus")])
            return None
        drive = None if frame.extended or (bus, frame.id) in self._command_ids else self._owners.get((bus, frame.id))
        if drive is None:
            self.counters.foreign_frames += 1
            if (bus, frame.id) in self.foreign or len(self.foreign) < MOST_FOREIGN:
                self.foreign[bus, frame.id] = self.foreign.get((bus, frame.id), 0) + 1
                self._foreign_heard[bus, frame.id] = time
            return None
        before = drive.refused_frames
        drive.receive(frame, time)
        self.counters.refused_frames += drive.refused_frames - before
        return drive

    # --- Watching ----------------------------------------------------------------------------------------

    def _supervise(self, now: float) -> None:
        if not self.configured:
            return
        reading = self._reading
        effort = np.zeros((self.robot.n, 2)) if reading is None else reading.joints.effort
        found: list[Fault] = []
        for watch, torque in zip(self._watches, effort.ravel().tolist(), strict=True):
            looking = watch.drive.name in self._homing
            found += watch.look(now, self.armed, torque, watch_encoder=not looking)
        if self.armed and self._command_time is not None and now - self._command_time > self.file.timeouts.command:
            age, allowed = (now - self._command_time) * 1000, self.file.timeouts.command * 1000
            said = "none"
            if self._stale_in_row:  # they come: nobody shall look for a controller that is silent
                said = f"{self._stale_in_row} came, but by their stamps too old, and none of use"
            found.append(Fault("command_timeout", "joint_commands", f"{said} for {age:.0f} ms, allowed {allowed:.0f} ms"))
        found += self._standing
        self._standing = []
        if found:
            self.stop(found)
            return
        if self._enabling_since is not None:
            self._look_at_enabling(now)
        if self._homing:
            self._look_at_homing(now)

    def _look_at_enabling(self, now: float) -> None:
        assert self._enabling_since is not None
        missing = [drive for drive in self.drives if drive.feedback.state is not DriveState.ENABLED]
        if now - self._enabling_since < 1.5 * self.period:
            return  # what comes now was sent before the drives were told
        if not missing:
            self._enabling_since, self.armed = None, True
        elif now - self._enabling_since > ENABLE_TIME:
            states = ", ".join(f"{drive.name} is {drive.feedback.state.value}" for drive in missing)
            self.stop([Fault("drive_disabled", missing[0].name, f"no torque within {ENABLE_TIME:g} s: {states}")])

    # --- Homing ------------------------------------------------------------------------------------------

    def start_homing(self, names: Sequence[str] | None = None) -> None:
        """Let steering axes look for their marks, as their `homing` says; the periods do the rest.

        `homing_results` then says how it ended: "attained", or why not. An absolute encoder has nothing to look for.

        Raises:
            CanError: refused while torque is on, after a fault, or while anything moves; or an axis that has no homing.
        """
        steering = {d.name: d for d in self.drives if joint_place(self.robot, d.name)[1] == STEER}
        chosen = list(steering) if names is None else list(names)
        for name in chosen:
            if name not in steering:
                raise CanError(f"homing of {name!r} is not allowed; allowed: {', '.join(steering)}")
        if not self.configured or self.faults:
            raise CanError("homing is not allowed before configure or after a fault; allowed: configured, faults cleared")
        if self.armed or self._enabling_since is not None or self._homing:
            raise CanError("homing is not allowed while torque is on; allowed: deactivate first")
        reading = self._reading
        if reading is None or np.abs(reading.joints.velocity).max() > STILL:
            fastest = np.inf if reading is None else float(np.abs(reading.joints.velocity).max())
            raise CanError(
                f"homing at {fastest:.3g} rad/s is not allowed while moving; allowed: all joints below {STILL:g} rad/s"
            )
        self.homing_results = {}
        looking: dict[str, Homing] = {}
        procedures = []
        for name in chosen:
            drive, homing = steering[name], steering[name].joint.homing
            if homing is None or homing.method == "absolute":
                self.homing_results[name] = "attained"  # the encoder knows, and the zero is in the file
                continue
            place = joint_place(self.robot, name)
            gear = self.robot.gear_matrix[place][STEER]
            way = homing.direction * np.sign(gear) * self.map.sign[place]
            procedures.append((drive, drive.prepare_homing(homing.method, homing.speed * abs(gear), way)))
            looking[name] = homing
        self._run(procedures)
        with self._lock:
            self._homing, self._homing_since = looking, self.transport.now()

    @property
    def homing(self) -> tuple[str, ...]:
        """Axes that look for their marks now."""
        return tuple(self._homing)

    def home(self, names: Sequence[str] | None = None) -> dict[str, str]:
        """Look for the marks and run periods until it is done; for callers without a thread. Returns `homing_results`."""
        self.start_homing(names)
        while self._homing:
            self.cycle(None)
        return self.homing_results

    def _look_at_homing(self, now: float) -> None:
        for name, homing in list(self._homing.items()):
            drive = next(drive for drive in self.drives if drive.name == name)
            if drive.feedback.homing == "attained":
                self._adopt_mark(name, homing)
                result = "attained"
            elif drive.feedback.homing == "failed":
                result = "the drive found no mark"
            elif now - self._homing_since > homing.timeout:
                result = f"no mark within {homing.timeout:g} s"
            else:
                continue
            self.homing_results[name] = result
            del self._homing[name]
            drive.feedback.homing = None

    def _adopt_mark(self, name: str, homing: Homing) -> None:
        """Take the drive's new count, which is zero at the mark; what the wheel reads does not jump."""
        place = joint_place(self.robot, name)
        drive_zero = next(drive.joint.zero for drive in self.drives if drive.name == name)
        before = None if self._reading is None else float(self._reading.joints.position[place[0], DRIVE])
        self.map.zero[place] = drive_zero - homing.position
        after = self._joint_reading().position[place[0], DRIVE]
        if before is not None:
            self.map.zero[place[0], DRIVE] += after - before
        for watch in self._watches:
            if watch.drive.name.rpartition("_")[0] == name.rpartition("_")[0]:
                watch.forget()
        if self._encoder_watch is not None:
            self._encoder_watch.forget()

    def shift_steer_zeros(self, offset: FloatArray) -> None:
        """Take offsets (n,) [rad] off what the steering axes read from now on; a wheel's reading does not jump.

        Raises:
            CanError: while torque is on.
        """
        if self.armed or self._enabling_since is not None:
            raise CanError("new zeros are not allowed while torque is on; allowed: without torque")
        with self._lock:
            self.map.zero[:, STEER] += offset

    # --- For people --------------------------------------------------------------------------------------

    @property
    def state(self) -> str:
        """What the robot is doing, in a word."""
        if self.faults:
            return "fault"
        if self._homing:
            return "homing"
        if self.armed:
            return "armed"
        return "enabling" if self._enabling_since is not None else "off" if self.configured else "not configured"

    def others(self) -> str:
        """Say who else was on the buses of late; "" if nobody. Who has gone is no longer told: `foreign` keeps the numbers."""
        lately = self._heard_lately()
        found = []
        for what, keys in (
            ("another computer or program commands these drives", [key for key in lately if key in self._computer_ids]),
            ("frames of nobody in the file", [key for key in lately if key not in self._computer_ids]),
        ):
            told = ", ".join(f"0x{identifier:03X} on {bus}" for bus, identifier in keys[:8])
            if keys:
                found.append(f"{what}: {told}" + (f" and {len(keys) - 8} more" if len(keys) > 8 else ""))
        return "; ".join(found)

    def _heard_lately(self) -> list[tuple[str, int]]:
        now = self.transport.now()
        return [key for key, heard in list(self._foreign_heard.items()) if now - heard < FOREIGN_TOLD]

    def commanded_by_another(self, bus: str, identifier: int) -> bool:
        """Whether a foreign identifier is one that only a computer sends to these drives."""
        return (bus, identifier) in self._computer_ids

    def age_quantiles(self) -> FloatArray:
        """Return the median, p99, p99.9 and largest age of commands when they left, from the reading they answer [s]."""
        ages = self.command_ages[-AGES_KEPT:]
        return np.quantile(ages, [0.5, 0.99, 0.999, 1.0]) if ages else np.zeros(4)

    def close(self) -> None:
        """Take the torque away and close the buses."""
        try:
            if self.configured:
                self.request_disable()
        finally:
            self.transport.close()


def _not_said(drive: Drive, since: float) -> str:
    """Return what a drive has not said since a time [s]; "" if nothing."""
    feedback = drive.feedback
    times = {"position": feedback.position_time, "speed": feedback.velocity_time, "torque": feedback.torque_time,
             "word of its state": feedback.state_time}  # fmt: skip
    return next((what for what, time in times.items() if time <= since), "")
