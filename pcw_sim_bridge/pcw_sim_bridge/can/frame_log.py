"""Frames as a recording (INTERFACES, section 4): what the drives and the computer said to one another, as joint_states and
joint_commands.

A joint_states is written when every drive has said position and speed since the one before, stamped with the SYNC before it
or, without SYNC, with the time of the oldest position. A joint_commands is written when every drive has been told something
since the one before; it bears the stamp of the newest joint_states, as a controller's do.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Iterator

import numpy as np

from pcw_description.recording_writer import RecordingWriter
from pcw_description.robot_description import FloatArray, RobotDescription
from pcw_description.ros_messages import joint_state

from .can_file import CanFile
from .cia402 import SYNC
from .drive import Drive, Mode, Want, newer_than
from .drive_set import make_drives
from .frame import Frame
from .motor_map import MotorMap


@dataclasses.dataclass(frozen=True)
class DecodedStates:
    """What the joints read: time [s], position, velocity and effort (n, 2)."""

    time: float
    position: FloatArray
    velocity: FloatArray
    effort: FloatArray


@dataclasses.dataclass(frozen=True)
class DecodedCommand:
    """What the joints were told: time and time of the reading before it [s]; efforts or velocities (n, 2)."""

    time: float
    answers: float
    effort: FloatArray | None
    velocity: FloatArray | None


class FrameDecoder:
    """Makes joint readings and commands of frames, in the order of time.

    Args:
        robot, file: the robot and its drives.

    Attributes:
        foreign: frames that belong to nobody in the file.
    """

    def __init__(self, robot: RobotDescription, file: CanFile) -> None:
        self._shape, self._period = (robot.n, 2), 1.0 / file.rate
        self.drives: tuple[Drive, ...] = make_drives(robot, file)
        self._map = MotorMap(robot, file)
        self._owners = {(drive.joint.bus, i): drive for drive in self.drives for i in drive.identifiers}
        self._told = {(drive.joint.bus, i): k for k, drive in enumerate(self.drives) for i in drive.command_identifiers}
        self._wants: list[Want | None] = [None] * len(self.drives)
        self._synchronous = all(drive.joint.protocol == "cia402" for drive in self.drives)
        self._sync_time = self._since = self._stated = -np.inf
        self.foreign = 0

    def take(self, bus: str, frame: Frame, time: float) -> DecodedStates | DecodedCommand | None:
        """Take a frame; returns what it completes, if anything."""
        if frame.error:
            return None
        place = self._told.get((bus, frame.id))
        if place is not None and not frame.remote:
            return self._take_command(place, frame, time)
        if frame.id == SYNC and not frame.data:
            self._sync_time = time
            return None
        drive = self._owners.get((bus, frame.id))
        if drive is None:
            self.foreign += frame.id != 0 and not 0x600 < frame.id < 0x780  # NMT, SDO and heartbeats belong to CANopen
            return None
        drive.receive(frame, time)
        return self._states(time)

    def _take_command(self, place: int, frame: Frame, time: float) -> DecodedCommand | None:
        want = self.drives[place].decode_command(frame)
        if want is None:
            return None
        self._wants[place] = want
        wants = [w for w in self._wants if w is not None]
        if len(wants) < len(self._wants):
            return None
        self._wants = [None] * len(self._wants)
        if not all(w.enabled for w in wants) or self._stated == -np.inf:
            return None
        values = np.array([w.value for w in wants]).reshape(self._shape)
        if all(w.mode is Mode.VELOCITY for w in wants):
            return DecodedCommand(time, self._stated, None, self._map.joint_velocity(values))
        return DecodedCommand(time, self._stated, self._map.joint_torque(values), None)

    def _states(self, now: float) -> DecodedStates | None:
        feedback = [drive.feedback for drive in self.drives]
        if not all(newer_than(f, self._since, now, self._period) for f in feedback):
            return None
        motor = np.array([[f.position, f.velocity, f.torque] for f in feedback])
        if not np.isfinite(motor).all():
            return None
        self._since = max(max(f.position_time, f.velocity_time, f.torque_time) for f in feedback)
        time = self._sync_time if self._synchronous else min(f.position_time for f in feedback)
        if time <= self._stated:
            return None
        self._stated = time
        position, velocity, torque = (motor[:, i].reshape(self._shape) for i in range(3))
        return DecodedStates(
            time, self._map.joint_position(position), self._map.joint_velocity(velocity), self._map.joint_torque(torque)
        )


def write_joint_topics(
    writer: RecordingWriter,
    robot: RobotDescription,
    decoder: FrameDecoder,
    frames: Iterable[tuple[str, Frame, float]],
    offset_ns: int = 0,
) -> None:
    """Write the joint topics of frames to an open recording; `offset_ns` is added to all times [ns]."""
    for bus, frame, time in frames:
        found = decoder.take(bus, frame, time)
        if isinstance(found, DecodedStates):
            stamp = round(found.time * 1e9) + offset_ns
            message = joint_state(stamp, robot.joint_names, found.position, found.velocity, found.effort)
            writer.write("/joint_states", message, round(time * 1e9) + offset_ns)
        elif isinstance(found, DecodedCommand):
            stamp = round(found.answers * 1e9) + offset_ns
            message = joint_state(stamp, robot.joint_names, velocity=found.velocity, effort=found.effort)
            writer.write("/joint_commands", message, round(time * 1e9) + offset_ns)


def frames_of_file(frames: Iterable[tuple[str, Frame, float]], file: CanFile) -> Iterator[tuple[str, Frame, float]]:
    """Give every frame of a log the name that its bus has in the file.

    Logs know buses by number or by the name of an interface: the name, the channel, or the only bus there is; else by number
    in the order of the file.
    """
    names = {bus.name: bus.name for bus in file.buses} | {bus.channel: bus.name for bus in file.buses}
    seen: dict[str, str] = {}
    for channel, frame, time in frames:
        if channel not in seen:
            digits = "".join(character for character in channel if character.isdigit())
            index = int(digits) if digits else 0
            seen[channel] = names.get(channel) or file.buses[index if index < len(file.buses) else 0].name
        yield seen[channel], frame, time
