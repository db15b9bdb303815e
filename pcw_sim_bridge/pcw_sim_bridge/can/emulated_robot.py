"""A robot of emulated drives with a plant behind them: frames in, frames out, in any time.

Sensors are those of the bridge (`sensors.Encoders`): the same counts, the same noise, the same effects of `physics`.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable

import numpy as np

from pcw_description.robot_description import STEER, FloatArray

from ..plants.plant import Plant, PlantState
from ..sensors import Encoders
from ..simulated_robot import VelocityLoops
from .can_file import CanFile, counts_per_turn, joint_place
from .drive import Mode
from .emulated_cia402 import EmulatedCia402
from .emulated_drive import FAULTS, EmulatedDrive
from .emulated_odrive import EmulatedODrive
from .errors import CanError
from .frame import ERROR_BUS_OFF, Arrived, Frame

BUS_FAULTS = {
    "bus_off": "the drives are cut off, and the computer's interface says bus-off",
    "foreign": "a node that nobody knows speaks",
    "bus_heal": "the bus is whole again",
}
# Behind by more than this the emulator lets the time go: the drives would otherwise see a computer that is late [s].
MOST_BEHIND = 0.1
OnStep = Callable[[float], object]


@dataclasses.dataclass
class CommandAges:
    """How old the newest torque or velocity at the drives was, looked at each millisecond while they have torque.

    Attributes:
        counts: by whole tenths of a millisecond, the last for all that is older.
    """

    counts: FloatArray = dataclasses.field(default_factory=lambda: np.zeros(2001))
    largest: float = 0.0

    def add(self, age: float) -> None:
        """Count one."""
        self.counts[min(int(age * 1e4), 2000)] += 1
        self.largest = max(self.largest, age)

    def quantile(self, share: float) -> float:
        """Return the age [s] that this share is not older than, to 0.1 ms upwards; 0 without any."""
        total = self.counts.sum()
        if total == 0:
            return 0.0
        return (int(np.searchsorted(np.cumsum(self.counts), share * total)) + 1) * 1e-4


class EmulatedRobot:
    """The drives of a CAN file on a plant.

    Args:
        plant: of the robot, at its reset state.
        file: its drives.
        seed: of the sensors' noise.
        watchdog: of the drives that have one set in themselves [s]; default: that of the file.

    Attributes:
        time: [s]; it begins at `start`.
        off_buses: buses that are cut.
    """

    def __init__(self, plant: Plant, file: CanFile, seed: int = 0, start: float = 0.0, watchdog: float | None = None) -> None:
        robot = plant.robot
        self.plant, self.robot, self.file = plant, robot, file
        self.start = self.time = start
        self._steps = 0
        self._rng = np.random.default_rng(seed)
        self._encoders = Encoders(robot)
        self._loops = VelocityLoops(robot, 30.0, plant.dt)
        watch = file.timeouts.watchdog if watchdog is None else watchdog
        self.drives: list[EmulatedDrive] = []
        self.sign = np.ones((robot.n, 2))
        self.zero = np.zeros((robot.n, 2))
        for joint in file.joints:
            place = joint_place(robot, joint.name)
            self.sign[place], self.zero[place] = joint.sign, joint.zero
            common = (joint, file.rate, file.heartbeat, watch)
            drive: EmulatedDrive
            if joint.protocol == "odrive":
                drive = EmulatedODrive(*common)
            else:
                drive = EmulatedCia402(*common, counts_per_turn(joint, robot))
            self.drives.append(drive)
            if joint.homing is not None:
                gear = robot.gear_matrix[place[0], STEER, STEER]
                drive.homing_speed = joint.homing.speed * abs(gear)
                drive.homing_direction = int(joint.homing.direction * np.sign(gear) * joint.sign)
        self._by_name = {drive.name: drive for drive in self.drives}
        self._of_bus = {bus.name: [d for d in self.drives if d.joint.bus == bus.name] for bus in file.buses}
        self._gear = robot.gear_matrix
        self._inverse_transposed = np.transpose(np.linalg.inv(robot.gear_matrix), (0, 2, 1)).copy()
        self._inverse = np.linalg.inv(robot.gear_matrix)
        self.off_buses: set[str] = set()
        self._foreign: set[str] = set()
        self.ages = CommandAges()
        self.frames_in = {bus.name: 0 for bus in file.buses}
        self.frames_out = {bus.name: 0 for bus in file.buses}
        self._out: list[Arrived] = []
        self._heading = self._headings(plant.state())
        self._sampled = -1
        self._sample()
        for drive in self.drives:
            if drive.joint.homing is not None and drive.joint.homing.method != "absolute":
                drive.offset = drive.position  # it counts from where it was switched on
            for frame in drive.power_on(self.time):
                self._put(drive.joint.bus, frame)

    # --- Frames ------------------------------------------------------------------------------------------

    def receive(self, bus: str, frame: Frame) -> None:
        """Take a frame from the computer, at the time that it is now."""
        self.frames_in[bus] += 1
        if bus in self.off_buses:
            return
        if frame.id == 0x080:
            self._sample()
        for drive in self._of_bus[bus]:
            for answer in drive.receive(frame, self.time):
                self._put(bus, answer)

    def take(self) -> list[Arrived]:
        """Return what the drives have sent since the last call."""
        out, self._out = self._out, []
        return out

    @property
    def has_frames(self) -> bool:
        """Whether the drives have sent something that was not taken."""
        return bool(self._out)

    def _put(self, bus: str, frame: Frame) -> None:
        if bus not in self.off_buses:
            self.frames_out[bus] += 1
            self._out.append(Arrived(bus, frame, self.time))

    # --- Time --------------------------------------------------------------------------------------------

    def let_go(self, time: float) -> None:
        """Leave out what is too long ago to be made up for at a time [s]."""
        if time - self.time > MOST_BEHIND:
            self.start += time - self.time - MOST_BEHIND
            self.time = self.start + self._steps * self.plant.dt

    def advance(self, time: float, on_step: OnStep | None = None) -> None:
        """Advance plant and drives to a time [s]; what is left of a step waits for the next call."""
        self.let_go(time)
        target = int(math.floor((time - self.start) / self.plant.dt + 1e-6))
        while self._steps < target:
            self.plant.step(self._joint_torque())
            self._steps += 1
            self.time = self.start + self._steps * self.plant.dt
            if any(drive.mark_wanted for drive in self.drives):
                self._look_for_marks()
            if self._due():
                self._sample()
            self._tick()
            if on_step is not None:
                on_step(self.time)

    def _due(self) -> bool:
        """Whether some drive may send its position by itself in this step."""
        return any(isinstance(drive, EmulatedODrive) and self.time >= drive._next["Get_Encoder_Estimates"] - 1e-9
                   for drive in self.drives)  # fmt: skip

    def _tick(self) -> None:
        now = self.time
        for drive in self.drives:
            for frame in drive.tick(now):
                self._put(drive.joint.bus, frame)
            if drive.want() is not None and drive.commands:
                self.ages.add(now - drive.command_time)
        if self._foreign and self._steps % 20 == 0:
            for bus in self._foreign:
                self._put(bus, Frame(0x7FE, b"\x01\x02\x03"))

    def motor_torques(self) -> FloatArray:
        """Return the torques that the drives give now, of the motors, in the joints' order (2n,) [N m]."""
        return self._motor_torque().ravel()

    def _motor_torque(self) -> FloatArray:
        """Return motor torques (n, 2), signs of the robot file."""
        wants = [drive.want() for drive in self.drives]
        shape = (self.robot.n, 2)
        torque = np.array([w[1] if w is not None and w[0] is Mode.TORQUE else 0.0 for w in wants]).reshape(shape) * self.sign
        holding = np.array([w is not None and w[0] is Mode.VELOCITY for w in wants]).reshape(shape)
        if not holding.any():
            self._loops.reset()
            return torque
        truth = self.plant.state()
        measured = np.matmul(self._gear, truth.motor_velocity[:, :, None])[:, :, 0]
        speeds = np.array([w[1] if w is not None and w[0] is Mode.VELOCITY else 0.0 for w in wants]).reshape(shape) * self.sign
        joint = np.matmul(self._inverse, np.where(holding, speeds, measured)[:, :, None])[:, :, 0]
        loops = self._loops.torque(joint, truth.motor_velocity, self.plant.dt)
        held = np.matmul(self._inverse_transposed, loops[:, :, None])[:, :, 0]
        return np.where(holding, held, torque)

    def _joint_torque(self) -> FloatArray:
        motor = self._motor_torque()
        return np.matmul(np.transpose(self._gear, (0, 2, 1)), motor[:, :, None])[:, :, 0]

    def _sample(self) -> None:
        """Let the drives' sensors see the motors as they are now."""
        if self._sampled == self._steps:
            return
        self._sampled = self._steps
        reading = self._encoders.read(self.plant.state(), None, 0.0, self._rng)
        position = self.sign * np.matmul(self._gear, (reading.position + self.zero)[:, :, None])[:, :, 0]
        velocity = self.sign * np.matmul(self._gear, reading.velocity[:, :, None])[:, :, 0]
        torque = self.sign * np.matmul(self._inverse_transposed, reading.effort[:, :, None])[:, :, 0]
        for drive, p, v, t in zip(
            self.drives, position.ravel().tolist(), velocity.ravel().tolist(), torque.ravel().tolist(), strict=True
        ):
            drive.position, drive.velocity, drive.torque = p, v, t

    def _headings(self, truth: PlantState) -> FloatArray:
        return truth.joint_position[:, STEER].copy()

    def _look_for_marks(self) -> None:
        """Tell a drive that turned past its mark, once each turn of the steering axis, where it was."""
        heading = self._headings(self.plant.state())
        for drive in self.drives:
            place = joint_place(self.robot, drive.name)
            if not drive.mark_wanted or place[1] != STEER or drive.joint.homing is None:
                continue
            mark = drive.joint.homing.position
            before, after = (self._heading[place[0]] - mark) / math.tau, (heading[place[0]] - mark) / math.tau
            turns = math.floor(max(before, after))
            if math.floor(before) != math.floor(after):
                at = mark + turns * math.tau
                gear = self._gear[place[0], STEER, STEER]
                # The count at the mark itself, as the drive latches it; the whole turns passed are no part of the heading.
                drive.mark_passed(self.sign[place] * gear * (at + self.zero[place]))
        self._heading = heading

    # --- Faults ------------------------------------------------------------------------------------------

    def inject(self, fault: str, where: str) -> None:
        """Do a fault of `FAULTS` at a joint ("all" is every one), or of `BUS_FAULTS` at a bus.

        Raises:
            CanError: no such fault or place.
        """
        check_fault(fault, where, self.file)
        if fault in BUS_FAULTS:
            if fault == "bus_off":
                self._put(where, Frame(ERROR_BUS_OFF, bytes(8), error=True))
                self.off_buses.add(where)
            elif fault == "foreign":
                self._foreign.add(where)
            else:
                self.off_buses.discard(where)
                self._foreign.discard(where)
            return
        self._sample()
        for drive in self.drives if where == "all" else [self._by_name[where]]:
            for frame in drive.inject(fault, self.time):
                self._put(drive.joint.bus, frame)

    def close(self) -> None:
        """Free the plant."""
        self.plant.close()


def check_fault(fault: str, where: str, file: CanFile) -> None:
    """Refuse what is no fault, or cannot be done there.

    Raises:
        CanError: names it, and what is allowed.
    """
    if fault not in FAULTS and fault not in BUS_FAULTS:
        raise CanError(f"fault {fault!r} is not allowed; allowed: {', '.join([*FAULTS, *BUS_FAULTS])}")
    places = [bus.name for bus in file.buses] if fault in BUS_FAULTS else ["all", *(joint.name for joint in file.joints)]
    if where not in places:
        raise CanError(f"fault {fault} at {where!r} is not allowed; allowed: {', '.join(places)}")


class EmulatedTransport:
    """The buses of an emulated robot in simulated time: nothing takes time but waiting.

    Args:
        emulated: the robot.
        on_step: called with the time after each step of the plant.
    """

    def __init__(self, emulated: EmulatedRobot, on_step: OnStep | None = None) -> None:
        self.emulated, self._on_step = emulated, on_step
        self._now = emulated.time
        self.frames: list[tuple[str, Frame, float, bool]] | None = None

    def log(self) -> list[tuple[str, Frame, float, bool]]:
        """Keep all frames from now on in the list that is returned: bus, frame, time, sent by the computer."""
        self.frames = []
        return self.frames

    def now(self) -> float:
        """Return the simulated time [s]."""
        return self._now

    def send(self, bus: str, frame: Frame) -> None:
        """Give a frame to the drives."""
        if self.frames is not None:
            self.frames.append((bus, frame, self._now, True))
        self.emulated.receive(bus, frame)

    def receive(self, timeout: float) -> list[Arrived]:
        """Let time pass until something comes, for at most `timeout` [s]."""
        end = self._now + max(timeout, 0.0)
        while not self.emulated.has_frames and self._now < end:
            self._now = min(end, self._now + self.emulated.plant.dt)
            self.emulated.advance(self._now, self._on_step)
        arrived = [Arrived(bus, frame, self._now) for bus, frame, _ in self.emulated.take()]
        if self.frames is not None:
            self.frames += [(bus, frame, self._now, False) for bus, frame, _ in arrived]
        return arrived

    def close(self) -> None:
        """Nothing to close."""
