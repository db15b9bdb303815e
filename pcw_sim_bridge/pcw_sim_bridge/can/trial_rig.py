"""What the trials of the CAN part have in common: a driver's core on emulated drives, in simulated time."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np

from pcw_description.robot_description import FloatArray, RobotDescription

from ..plants.factory import make_plant
from ..run_controllers import RunController, make_controller
from ..sensors import JointReading
from ..simulated_robot import JointCommand
from .can_file import CanFile
from .can_robot import CanRobot, TimedReading
from .drive_emulator import FaultTimer
from .emulated_robot import EmulatedRobot, EmulatedTransport
from .frame import Arrived, Frame
from .steer_zero import calibration_twist
from .transport import TransmitBufferFull

FILES = ("thesis_cia402", "thesis_odrive")
ALLOWED_MS = 50.0
LONG = 1e4  # a motion that does not end [s]


class Rig:
    """A driver's core on emulated drives, with a timer and a bus that can be full.

    Args:
        robot: as it is.
        file: its drives.
        seed: of the sensors' noise.
        believed: as driver and controller know it; default: without its `physics`.
    """

    def __init__(
        self, robot: RobotDescription, file: CanFile, seed: int = 0, believed: RobotDescription | None = None
    ) -> None:
        self.robot = robot
        self.emulated = EmulatedRobot(make_plant("reduced", robot), file, seed)
        self.timer = FaultTimer(self.emulated)
        self.transport = ClosableTransport(self.emulated, self.timer.on_step)
        believed = believed or dataclasses.replace(robot, physics=())
        self.can = CanRobot(believed, file, self.transport)
        self.torque = np.zeros((robot.n, 2))
        self.twist: Callable[[float], FloatArray | None] | None = None
        self._controller: RunController = make_controller("computed_torque", believed)
        self._last = 0.0

    def wander(self, phase: float) -> None:
        """From now on drive to and fro and round and round, with a controller; `phase` [s] is where in it to begin."""
        begun = self.emulated.time
        self.twist = lambda time: calibration_twist(phase + time - begun, LONG)
        self._controller.command(self._joints(), None, 0.01)

    def _joints(self) -> JointReading:
        assert self.can.reading is not None
        return self.can.reading.joints

    def answer(self, reading: TimedReading) -> None:
        """Command what drives along `twist`; without one the torque, gently braked so that speeds stay low."""
        if self.twist is not None:
            dt, self._last = max(reading.time - self._last, 1e-4), reading.time
            self.can.command(self._controller.command(reading.joints, self.twist(reading.time), min(dt, 0.02)), reading.time)
            return
        effort = self.torque - 0.05 * reading.joints.velocity * (self.torque != 0.0)
        self.can.command(JointCommand(effort=effort), reading.time)

    def cycles(self, count: int, answered: bool = True) -> None:
        """Do periods."""
        for _ in range(count):
            self.can.cycle(self.answer if answered else None)


class ClosableTransport(EmulatedTransport):
    """An emulated bus whose transmit buffer can be full, and on which other frames can come too."""

    def __init__(self, emulated: EmulatedRobot, on_step: Callable[[float], object] | None = None) -> None:
        super().__init__(emulated, on_step)
        self.full = False
        self.sent: list[tuple[str, Frame]] | None = None
        self.others: list[Arrived] = []

    def send(self, bus: str, frame: Frame) -> None:
        """Give a frame to the drives, or be full."""
        if self.full:
            raise TransmitBufferFull(f"{bus}: transmit buffer full")
        if self.sent is not None:
            self.sent.append((bus, frame))
        super().send(bus, frame)

    def receive(self, timeout: float) -> list[Arrived]:
        """Return what the drives and the others say."""
        others, self.others = self.others, []
        return [one._replace(time=self.now()) for one in others] or super().receive(timeout)
