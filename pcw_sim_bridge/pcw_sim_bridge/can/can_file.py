"""The format `pcw_can/1`: which drive on which bus moves which joint.

Masses, gears and couplings are the robot's and stand in the robot file; here is what belongs to the wiring and the drives. The
file is checked against the robot: each joint once, and a `gear` that is repeated here must agree.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np

from pcw_description.description_fields import parsed_file, quantity, read_section, section, text
from pcw_description.errors import DescriptionError, nearest_name
from pcw_description.robot_description import AXIS_NAMES, FloatArray, RobotDescription

from .errors import CanError

FORMAT = "pcw_can/1"
PROTOCOLS = ("cia402", "odrive")
HOMING_METHODS = ("absolute", "index", "switch")
TORQUE_MODES = ("auto", "cyclic_synchronous", "profile")
VELOCITY_UNITS = ("counts/s", "rpm")
LARGEST_NODE_ID = {"cia402": 127, "odrive": 63}
PERIODS_IN_TIMEOUT = 1.5
# A gear that is said twice may differ by rounding alone.
GEAR_TOLERANCE = 1e-3


@dataclasses.dataclass(frozen=True)
class Bus:
    """One CAN bus, opened by python-can."""

    name: str = text("name of the bus in this file")
    interface: str = text("interface of python-can, such as socketcan, slcan, udp_multicast or virtual")
    channel: str = text("channel of that interface, such as can0")
    bitrate: float = quantity("bit/s", "bit rate", default=1e6, minimum=1e4, maximum=1e6)
    options: dict[str, Any] = section("further arguments of the interface", default_factory=dict)


@dataclasses.dataclass(frozen=True)
class Timeouts:
    """How long silence may last. Torque is zero one period later at most."""

    command: float = quantity("s", "newest joint_commands; then the robot stops", default=0.04, minimum=0.005, maximum=1.0)
    feedback: float = quantity(
        "s", "newest position of a drive; then the robot stops", default=0.04, minimum=0.005, maximum=1.0
    )
    watchdog: float = quantity("s", "of the drives: without the computer for so long they stop", default=0.04, minimum=0.005,
                               maximum=1.0)  # fmt: skip


@dataclasses.dataclass(frozen=True)
class Homing:
    """How a steering axis finds its zero."""

    method: str = text("absolute: encoder and stored zero; index, switch: the drive looks for a mark", choices=HOMING_METHODS)
    position: float = quantity("rad", "heading of the wheel at the mark", default=0.0, minimum=-math.tau, maximum=math.tau)
    speed: float = quantity("rad/s", "of the steering axis while it looks", default=1.0, above=0.0, maximum=10.0)
    direction: float = quantity("1", "+1 or -1: which way it turns first", default=1.0, minimum=-1.0, maximum=1.0)
    timeout: float = quantity("s", "it stops without a mark after so long", default=15.0, above=0.0, maximum=300.0)


@dataclasses.dataclass(frozen=True)
class DriveJoint:
    """One joint and its drive."""

    name: str = text("joint of the robot: CASTER_drive or CASTER_steer")
    bus: str = text("bus that the drive is on")
    node_id: float = quantity("1", "node id of the drive", minimum=0, maximum=127)
    protocol: str = text("what the drive speaks", choices=PROTOCOLS)
    torque_constant: float = quantity("N m/A", "torque of the motor per ampere", above=0.0, maximum=100.0)
    current_limit: float = quantity("A", "largest current of the motor", above=0.0, maximum=1e4)
    sign: float = quantity("1", "+1, or -1 where the drive counts against the motor of the robot file", default=1.0,
                           minimum=-1.0, maximum=1.0)  # fmt: skip
    gear: float | None = quantity("1", "turns of the motor per turn of the joint; as in the robot file", default=None,
                                  minimum=-1e4, maximum=1e4)  # fmt: skip
    counts: float | None = quantity("counts/rev", "of the drive per turn of the motor; default: robot file", default=None,
                                    above=0.0, maximum=1e9)  # fmt: skip
    zero: float = quantity("rad", "what the joint reads where it should read zero", default=0.0, minimum=-1e4, maximum=1e4)
    torque_limit: float | None = quantity("N m", "joint side; default and upper bound: robot file", default=None, above=0.0)
    rated_torque: float | None = quantity("N m", "cia402: motor side, what 1000 per mille are (object 0x6076)", default=None,
                                          above=0.0, maximum=1e4)  # fmt: skip
    torque_mode: str = text("cia402: operation mode for torque", default="auto", choices=TORQUE_MODES)
    velocity_unit: str = text("cia402: unit of 0x606C and 0x60FF", default="counts/s", choices=VELOCITY_UNITS)
    synchronous_commands: bool = dataclasses.field(
        default=False, metadata={"help": "cia402: a torque acts at the next SYNC, not on arrival"}
    )
    temperature_limit: float = quantity("degC", "largest temperature of motor or power stage", default=80.0, above=0.0,
                                        maximum=200.0)  # fmt: skip
    encoder_jump: float = quantity("rad", "joint side: largest step that the speed does not explain", default=0.1, above=0.0,
                                   maximum=10.0)  # fmt: skip
    encoder_still: float = quantity(
        "rad", "joint side: most that a count may stand while speed or the other joints say that the joint turns",
        default=0.01, above=0.0, maximum=10.0,
    )  # fmt: skip
    unwatched: bool = dataclasses.field(
        default=False, metadata={"help": "cia402: a drive that cannot watch this computer (object 0x1016) is allowed"}
    )
    homing: Homing | None = section("how a steering axis finds its zero; default: absolute", default=None)


@dataclasses.dataclass(frozen=True)
class CanFile:
    """All buses and drives of one robot."""

    format: str = text("format of this file", choices=(FORMAT,))
    name: str = text("name of the set of drives")
    buses: tuple[Bus, ...] = section("the buses")
    joints: tuple[DriveJoint, ...] = section("the drives, one for each joint")
    rate: float = quantity("Hz", "of torques out and positions in", default=250.0, minimum=10.0, maximum=2000.0)
    heartbeat: float = quantity("s", "between two heartbeats, either way", default=0.02, minimum=0.001, maximum=0.5)
    master_id: float = quantity("1", "CANopen node id of the computer", default=127, minimum=1, maximum=127)
    robot: str = text("name of the robot whose drives these are; another is refused", default="")
    largest_load: float = quantity("1", "share of a bus that may be in use", default=0.9, above=0.0, maximum=1.0)
    timeouts: Timeouts = section("how long silence may last", default_factory=Timeouts)


def read_can_file(path: str | Path, robot: RobotDescription) -> CanFile:
    """Read a file, or a shipped one by its name, and check it against the robot.

    Raises:
        DescriptionError: names the key, the value and what is allowed.
    """
    return parsed_file(find_can_file(path), lambda content: can_file_from(content, robot))


def find_can_file(path: str | Path) -> Path:
    """Return the path of a file, or of a shipped one by its name."""
    given = Path(path)
    if given.suffix or given.is_file():
        return given
    shipped = shipped_can_files()
    if str(path) not in shipped:
        raise DescriptionError("can_file", str(path), f"{nearest_name(str(path), shipped)}, or the path of a .yaml file")
    return shipped[str(path)]


def shipped_can_files() -> dict[str, Path]:
    """Return the files under config/can by name: of the sources, or of the installation."""
    folders = [Path(__file__).parents[2] / "config" / "can"]
    for parent in Path(str(resources.files("pcw_sim_bridge"))).parents:
        folders.append(parent / "share" / "pcw_sim_bridge" / "config" / "can")
    return {path.stem: path for folder in reversed(folders) for path in sorted(folder.glob("*.yaml"))}


def can_file_from(content: Mapping[str, Any], robot: RobotDescription) -> CanFile:
    """Make a CanFile of what a YAML file holds; see `read_can_file`."""
    content = dict(content)
    defaults = content.pop("joint_defaults", None) or {}
    if not isinstance(defaults, Mapping):
        raise DescriptionError("joint_defaults", defaults, "allowed: a mapping of keys of a joint to values")
    buses = _read_list(content.get("buses"), "buses", Bus, {})
    joints = _read_list(content.get("joints"), "joints", DriveJoint, defaults)
    read: CanFile = read_section(CanFile, content, "")
    read = dataclasses.replace(read, buses=buses, joints=joints)
    _check(read, robot)
    order = {name: i for i, name in enumerate(robot.joint_names)}
    return dataclasses.replace(read, joints=tuple(sorted(read.joints, key=lambda joint: order[joint.name])))


def _read_list(entries: Any, key: str, kind: type[Any], defaults: Mapping[str, Any]) -> tuple[Any, ...]:
    if not isinstance(entries, list) or not entries:
        raise DescriptionError(key, entries, "allowed: a list with at least one entry")
    read = []
    for index, entry in enumerate(entries):
        if not isinstance(entry, Mapping):
            raise DescriptionError(f"{key}[{index}]", entry, "allowed: a mapping of keys to values")
        read.append(read_section(kind, {**defaults, **entry}, f"{key}[{index}]"))
    return tuple(read)


def _check(read: CanFile, robot: RobotDescription) -> None:
    if read.robot not in ("", robot.name):  # joints of two robots may have the same names, and other gears and limits
        raise DescriptionError("robot", read.robot, f"the robot given is {robot.name}; allowed: the drives of this robot")
    if read.master_id != int(read.master_id):
        raise DescriptionError("master_id", read.master_id, "allowed: a whole number 1 to 127")
    bus_names = [bus.name for bus in read.buses]
    for i, name in enumerate(bus_names):
        if name in bus_names[:i]:
            raise DescriptionError(f"buses[{i}].name", name, "allowed: each name once")
        if not isinstance(read.buses[i].options, Mapping):
            raise DescriptionError(f"buses[{i}].options", read.buses[i].options, "allowed: a mapping of keys to values")
    if read.master_id != int(read.master_id):
        raise DescriptionError("master_id", read.master_id, "allowed: a whole number 1 to 127")
    names = [joint.name for joint in read.joints]
    for i, joint in enumerate(read.joints):
        where = f"joints[{i}]"
        if joint.name not in robot.joint_names:
            raise DescriptionError(f"{where}.name", joint.name, nearest_name(joint.name, robot.joint_names))
        if joint.name in names[:i]:
            raise DescriptionError(f"{where}.name", joint.name, "allowed: each joint once")
        if joint.bus not in bus_names:
            raise DescriptionError(f"{where}.bus", joint.bus, nearest_name(joint.bus, bus_names))
        _check_joint(joint, where, read, robot)
    missing = [name for name in robot.joint_names if name not in names]
    if missing:
        raise DescriptionError("joints", names, f"allowed: every joint of {robot.name}; missing: {', '.join(missing)}")
    _check_times(read)
    _check_ids(read)


def _check_times(read: CanFile) -> None:
    """Refuse timeouts that a robot in health would exceed, and heartbeats that come too late to be of use."""
    least = PERIODS_IN_TIMEOUT / read.rate
    for name in ("command", "feedback", "watchdog"):
        value = getattr(read.timeouts, name)
        if value < least:
            raise DescriptionError(
                f"timeouts.{name}", value, f"allowed at {read.rate:g} Hz: at least {least:g} s, {PERIODS_IN_TIMEOUT:g} periods"
            )
    if read.heartbeat > read.timeouts.feedback and any(joint.protocol == "odrive" for joint in read.joints):
        raise DescriptionError(
            "heartbeat", read.heartbeat,
            f"an ODrive says in its heartbeats alone that it has failed; allowed: at most timeouts.feedback = "
            f"{read.timeouts.feedback:g} s",
        )  # fmt: skip


def _check_joint(joint: DriveJoint, where: str, read: CanFile, robot: RobotDescription) -> None:
    least, most = (1 if joint.protocol == "cia402" else 0), LARGEST_NODE_ID[joint.protocol]
    if joint.node_id != int(joint.node_id) or not least <= joint.node_id <= most:
        raise DescriptionError(
            f"{where}.node_id", joint.node_id, f"allowed for {joint.protocol}: a whole number {least} to {most}"
        )
    if joint.protocol == "cia402" and joint.node_id == read.master_id:
        raise DescriptionError(f"{where}.node_id", joint.node_id, "it is the master_id; allowed: another one")
    if abs(joint.sign) != 1.0:
        raise DescriptionError(f"{where}.sign", joint.sign, "allowed: 1 or -1")
    caster, axis = joint_place(robot, joint.name)
    gear = robot.gear_matrix[caster, axis, axis]
    if joint.gear is not None and abs(joint.gear - gear) > GEAR_TOLERANCE * abs(gear):
        raise DescriptionError(f"{where}.gear", joint.gear, f"allowed: {gear:.6g}, which {robot.name} says (or leave it out)")
    limit = robot.torque_limit[caster, axis]
    if joint.torque_limit is not None and joint.torque_limit > limit:
        raise DescriptionError(
            f"{where}.torque_limit", joint.torque_limit, f"allowed: at most {limit:g} N m, of the robot file"
        )
    if joint.protocol == "cia402" and joint.rated_torque is None:
        raise DescriptionError(
            f"{where}.rated_torque", None, "cia402 torques are per mille of it; allowed: object 0x6076 in N m"
        )
    if joint.homing is not None:
        if axis != 1:
            raise DescriptionError(f"{where}.homing", joint.homing.method, "allowed: on steering axes alone")
        if abs(joint.homing.direction) != 1.0:
            raise DescriptionError(f"{where}.homing.direction", joint.homing.direction, "allowed: 1 or -1")
        coupling = robot.gear_matrix[caster, 1, 0]
        if joint.homing.method != "absolute" and coupling != 0.0:
            raise DescriptionError(
                f"{where}.homing.method", joint.homing.method,
                f"the steering motor turns with the wheel too (steer_per_drive = {coupling:g}), so that a mark says nothing "
                "of the heading alone; allowed: absolute",
            )  # fmt: skip


def _check_ids(read: CanFile) -> None:
    """Refuse two owners of one identifier on one bus."""
    for i, joint in enumerate(read.joints):
        reserved = {0x000: "NMT", 0x080: "SYNC", 0x700 + int(read.master_id): "the master's heartbeat"}
        if any(other.bus == joint.bus and other.protocol == "cia402" for other in read.joints):
            for identifier in identifiers(joint):
                if identifier in reserved:
                    raise DescriptionError(
                        f"joints[{i}].node_id", int(joint.node_id),
                        f"identifier 0x{identifier:03X} is {reserved[identifier]} of CANopen on the same bus; "
                        "allowed: a bus of its own",
                    )  # fmt: skip
    owners: dict[tuple[str, int], str] = {}
    for i, joint in enumerate(read.joints):
        for identifier in identifiers(joint):
            other = owners.setdefault((joint.bus, identifier), joint.name)
            if other != joint.name:
                raise DescriptionError(
                    f"joints[{i}].node_id", int(joint.node_id),
                    f"identifier 0x{identifier:03X} on {joint.bus} is that of {other} already; "
                    "allowed: identifiers that do not meet (put the protocols on buses of their own)",
                )  # fmt: skip


def identifiers(joint: DriveJoint) -> tuple[int, ...]:
    """Return all identifiers of a drive."""
    node = int(joint.node_id)
    if joint.protocol == "odrive":
        return tuple(range(node << 5, (node << 5) + 32))
    return tuple(base + node for base in (0x080, 0x180, 0x200, 0x280, 0x300, 0x380, 0x400, 0x480, 0x500, 0x580, 0x600, 0x700))


def joint_place(robot: RobotDescription, name: str) -> tuple[int, int]:
    """Return the indices (caster, axis) of a joint by its name."""
    caster, _, axis = name.rpartition("_")
    return robot.caster_index(caster), AXIS_NAMES.index(axis)


def torque_limits(read: CanFile, robot: RobotDescription) -> FloatArray:
    """Return the largest joint torques (n, 2) [N m]: of the robot, or less where the file says so."""
    limits = robot.torque_limit.copy()
    for joint in read.joints:
        if joint.torque_limit is not None:
            limits[joint_place(robot, joint.name)] = joint.torque_limit
    return limits


def counts_per_turn(joint: DriveJoint, robot: RobotDescription) -> float:
    """Return the counts that a drive makes of one turn of its motor."""
    if joint.counts is not None:
        return joint.counts
    encoders = robot.sensors.encoders
    return (encoders.drive_counts, encoders.steer_counts)[joint_place(robot, joint.name)[1]]


def zeros(read: CanFile, robot: RobotDescription) -> FloatArray:
    """Return what the joints read where they should read zero, (n, 2) [rad]."""
    values = np.zeros((robot.n, 2))
    for joint in read.joints:
        values[joint_place(robot, joint.name)] = joint.zero
    return values


# Where the emulated buses are when no other place is given: multicast on this computer alone. The port is below those that
# Linux hands out to any socket (32768 and above), where now and then it was taken, and none of DDS.
UDP_GROUP, UDP_PORT = "239.74.163.{}", 28850
# From the port of one bus to that of the next. Linux gives a socket what any group at its port gets, not its own alone.
NEXT_BUS = 10


def udp_port_beside(domain: int) -> int:
    """Return a port for the buses of trials in a ROS domain: one that DDS itself would not use before its 97th participant."""
    return 2600 + 250 * domain  # of DDS are 7400 + 250 domain and what follows: this is 200 on, in the range of an earlier one


def on_udp(read: CanFile, port: int = UDP_PORT) -> CanFile:
    """Return the file with every bus on python-can's udp_multicast, which stays on this computer.

    Raises:
        CanError: a port that is none, or of the last bus beyond the largest.
    """
    largest = 65535 - NEXT_BUS * (len(read.buses) - 1)
    if not 0 < port <= largest:
        raise CanError(
            f"udp port {port} is not allowed; allowed: at most {largest}, at least 1; each bus has one {NEXT_BUS} further on"
        )
    buses = [
        dataclasses.replace(
            bus,
            interface="udp_multicast",
            channel=UDP_GROUP.format(2 + i),
            options={"port": port + NEXT_BUS * i, "hop_limit": 0},
        )
        for i, bus in enumerate(read.buses)
    ]
    return dataclasses.replace(read, buses=tuple(buses))
