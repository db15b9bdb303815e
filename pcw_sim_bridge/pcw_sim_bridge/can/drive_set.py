"""All drives of a robot, made of its CAN file, and the load that they are for their buses."""

from __future__ import annotations

import numpy as np

from pcw_description.robot_description import RobotDescription

from .bus_load import BusLoad
from .can_file import CanFile, counts_per_turn, joint_place, torque_limits
from .cia402 import Cia402Drive
from .drive import Drive
from .frame import PeriodicFrame
from .odrive import ODriveDrive

# A drive's own limit of speed is wider than the robot's, as it is there to catch what nothing else does.
SPEED_MARGIN = 1.2


def make_drives(robot: RobotDescription, file: CanFile) -> tuple[Drive, ...]:
    """Make the drives, in the order of `robot.joint_names`."""
    inverse_transposed = np.transpose(np.linalg.inv(robot.gear_matrix), (0, 2, 1))
    # The largest motor torques that torques within the joints' limits come to, and the speeds likewise.
    most_torque = np.abs(inverse_transposed) @ torque_limits(file, robot)[:, :, None]
    most_speed = np.abs(robot.gear_matrix) @ robot.speed_limit[:, :, None]
    drives: list[Drive] = []
    for joint in file.joints:
        place = joint_place(robot, joint.name)
        speed = float(most_speed[place][0]) * SPEED_MARGIN
        common = (joint, file.rate, file.heartbeat, file.timeouts.watchdog)
        if joint.protocol == "odrive":
            drives.append(ODriveDrive(*common, speed))
        else:
            torque = min(float(most_torque[place][0]), joint.torque_constant * joint.current_limit)
            drives.append(Cia402Drive(*common, counts_per_turn(joint, robot), int(file.master_id), torque, speed))
    return tuple(drives)


def bus_loads(file: CanFile, drives: tuple[Drive, ...]) -> dict[str, BusLoad]:
    """Return the load of every bus, as it is with the robot active."""
    loads = {}
    for bus in file.buses:
        here = [drive for drive in drives if drive.joint.bus == bus.name]
        frames = [frame for drive in here for frame in drive.periodic_frames()]
        if any(drive.joint.protocol == "cia402" for drive in here):
            frames.append(PeriodicFrame("SYNC", 0, file.rate))
            frames.append(PeriodicFrame("heartbeat of the computer", 1, 1.0 / master_heartbeat(file)))
        loads[bus.name] = BusLoad(bus.name, bus.bitrate, tuple(frames), file.largest_load)
    return loads


def master_heartbeat(file: CanFile) -> float:
    """Return the time between two heartbeats of the computer [s]: a few within the drives' watchdog."""
    return min(file.heartbeat, file.timeouts.watchdog / 4.0)
