"""Looks at buses and drives and says in words what is wrong: rates, latencies, signs and gears.

Each joint is nudged on its own, at a small share of its torque, to and fro, and what its motor does is held against what the
robot file and the CAN file say. The other joints have no torque. With the robot on the ground a nudged wheel moves the robot a
little; on a jack everything shows more clearly, and that is how it should be done the first time.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

import numpy as np

from pcw_description.robot_description import FloatArray, RobotDescription

from ..simulated_robot import JointCommand
from .can_file import CanFile, joint_place
from .can_robot import CanRobot, TimedReading
from .errors import CanError
from .transport import Transport

LISTEN = 1.0  # [s]
NUDGE_SHARE = 0.05  # of the joint's torque limit
NUDGE_TIME = 0.2  # each way [s]
STILL_TIME = 0.6  # for rolling out before the next joint [s]
LEAST_STEP = 2e-3  # a joint that turns less has not moved [rad]
INERTIA_FACTOR = 2.5  # that the speed gained may differ by: friction, and inertias that are hardly known
RATE_TOLERANCE = 0.1
LATE_SHARE = 0.01  # of the periods


@dataclasses.dataclass(frozen=True)
class Finding:
    """One thing that was looked at.

    Attributes:
        good: it is as it must be.
        what: bus or joint.
        text: one sentence.
    """

    good: bool
    what: str
    text: str

    def __str__(self) -> str:
        return f"{'ok   ' if self.good else 'WRONG'} {self.what}: {self.text}"


def examine(
    robot: RobotDescription,
    file: CanFile,
    transport: Transport,
    nudge: bool = True,
    share: float = NUDGE_SHARE,
    lifted: bool = False,
) -> Iterator[Finding]:
    """Look at everything, and yield what is found as it is found; no torque is left on.

    Args:
        robot, file: the robot and its drives.
        transport: its buses, open.
        nudge: move the joints; without it only what can be seen at rest.
        share: of the joint's torque limit that it is nudged with.
        lifted: the wheels are off the ground, so that gears can be judged by the speed that is gained.
    """
    can = CanRobot(robot, file, transport, encoders_agree=False)
    for load in can.loads.values():
        yield Finding(load.load <= load.allowed, load.bus, f"{load.load:.0%} of {load.bitrate / 1000:g} kbit/s will be in use")
    try:
        can.configure()
    except CanError as error:
        for line in str(error).splitlines():
            name, _, text = line.partition(": ")
            yield Finding(False, name, text or line)
        return
    for drive in can.drives:
        yield Finding(True, drive.name, f"{drive.joint.protocol} node {drive.node_id} on {drive.joint.bus}, {drive.identity}, "
                      f"firmware {drive.firmware}")  # fmt: skip
        for note in drive.notes:
            yield Finding(False, drive.name, note)
    yield from _listen(can)
    if nudge and not can.faults:
        try:
            yield from _fall_silent(can)
            for name in robot.joint_names:
                yield from _nudge(can, name, share, lifted)
                if can.faults:
                    break
        except CanError as error:
            yield Finding(False, "nudge", str(error))
        finally:
            can.request_disable()
    for fault in can.faults:
        yield Finding(False, fault.where, f"{fault.name}: {fault.detail}")
    for bus, identifier in can.foreign:
        count, whose = can.foreign[bus, identifier], f"of nobody in {file.name}"
        if can.commanded_by_another(bus, identifier):
            whose = "what a computer sends to these drives: another one, or a driver, is at work"
        yield Finding(False, bus, f"identifier 0x{identifier:X} is {whose}; it came {count} times")


def _listen(can: CanRobot) -> Iterator[Finding]:
    """Listen for a while without torque: rates and latencies."""
    times: list[float] = []
    latencies: list[float] = []
    incomplete, late = can.counters.incomplete, can.counters.late_cycles

    def note(reading: TimedReading) -> None:
        times.append(reading.time)
        latencies.append(can.transport.now() - reading.time)

    cycles = max(round(LISTEN / can.period), 10)
    for _ in range(cycles):
        can.cycle(note)
    incomplete, late = can.counters.incomplete - incomplete, can.counters.late_cycles - late
    rate = (len(times) - 1) / (times[-1] - times[0]) if len(times) > 1 else 0.0
    good = abs(rate - can.file.rate) < RATE_TOLERANCE * can.file.rate
    yield Finding(good, "rate", f"{rate:.1f} readings a second, {can.file.rate:g} wanted")
    yield Finding(
        incomplete <= LATE_SHARE * cycles, "rate",
        f"in {incomplete} of {cycles} periods not every drive spoke; this computer was late by a few periods {late} times",
    )  # fmt: skip
    if latencies:
        median, most = 1000.0 * float(np.median(latencies)), 1000.0 * float(np.max(latencies))
        good = most < 1000.0 * can.file.timeouts.feedback
        yield Finding(good, "latency", f"from the reading to all frames of it {median:.2f} ms, {most:.2f} ms at most")


def _fall_silent(can: CanRobot) -> Iterator[Finding]:
    """Say nothing to drives that have torque, of zero: each must take it away by itself."""
    try:
        on = can.still_on_without_computer()
    except CanError as error:
        for line in str(error).splitlines():
            yield Finding(False, "watchdog", line)
        return
    allowed = 2000.0 * can.file.timeouts.watchdog
    for name in on:
        remedy = "enable_watchdog and watchdog_timeout" if _protocol(can, name) == "odrive" else "objects 0x1016 and 0x6007"
        yield Finding(False, name, f"it still has torque {allowed:.0f} ms after this computer fell silent: see its {remedy}")
    if not on:
        yield Finding(True, "watchdog", f"every drive takes its torque away within {allowed:.0f} ms without this computer")


def _protocol(can: CanRobot, name: str) -> str:
    return next(drive.joint.protocol for drive in can.drives if drive.name == name)


def _nudge(can: CanRobot, name: str, share: float, lifted: bool) -> Iterator[Finding]:
    """Nudge one joint to and fro and judge what it does."""
    place = joint_place(can.robot, name)
    torque = np.zeros((can.robot.n, 2))
    moved = np.zeros(2)
    turned: list[FloatArray] = []
    can.enable()
    for way, sign in enumerate((1.0, -1.0)):
        torque[place] = sign * share * can.gate.joint_torque[place]
        command = JointCommand(effort=torque.copy())
        readings: list[TimedReading] = []

        def answer(reading: TimedReading, command: JointCommand = command, readings: list[TimedReading] = readings) -> None:
            readings.append(reading)
            can.command(command, reading.time)

        for _ in range(round(NUDGE_TIME / can.period)):
            can.cycle(answer)
        if can.faults or len(readings) < 3:
            return
        # What speed was gained in this way: of coming back, the loss of the speed before counts too.
        moved[way] = readings[-1].joints.velocity[place] - readings[0].joints.velocity[place]
        turned.append(np.array([r.joints.position for r in readings]))
    yield from _judge(can, name, moved, turned, share, lifted)
    can.request_disable()
    for _ in range(round(STILL_TIME / can.period)):
        can.cycle(None)


def _judge(
    can: CanRobot, name: str, moved: FloatArray, turned: list[FloatArray], share: float, lifted: bool
) -> Iterator[Finding]:
    place = joint_place(can.robot, name)
    whole = np.concatenate(turned)
    step = float(np.ptp(whole[:, place[0], place[1]]))
    gained = 0.5 * (moved[0] - moved[1])
    told = f"{share:.0%} of its torque"
    if step < LEAST_STEP:
        others = np.ptp(whole.reshape(len(whole), -1), axis=0)
        most = int(np.argmax(others))
        if others[most] > 5.0 * LEAST_STEP:
            yield Finding(
                False, name, f"it stood still at {told}, and {can.robot.joint_names[most]} turned by {others[most]:.3f} rad "
                "instead: two node ids may be exchanged",
            )  # fmt: skip
        else:
            yield Finding(False, name, f"it stood still at {told}: a brake, a loose motor, or friction")
        return
    if gained < 0.0:
        yield Finding(
            False, name, f"it turned against its torque, by {step:.3f} rad: the sign of its encoder or of its motor is wrong"
        )
        return
    yield Finding(True, name, f"it turned with its torque, by {step:.3f} rad at {told}")
    yield from _judge_gear(can, name, gained, share, lifted)


def free_acceleration(robot: RobotDescription, place: tuple[int, int], torque: float) -> float:
    """Return the acceleration [rad/s^2] that a torque [N m] gives a joint with its wheel off the ground, without friction."""
    caster = robot.casters[place[0]]
    steered = caster.module.inertia_zz + caster.module.mass * float(np.dot(caster.module.com, caster.module.com))
    inertia = robot.armature[place[0]] + np.diag([caster.wheel.inertia_axle, steered])
    return float(np.linalg.inv(inertia)[place[1], place[1]] * torque)


def _judge_gear(can: CanRobot, name: str, gained: float, share: float, lifted: bool) -> Iterator[Finding]:
    """Hold the speed that was gained against the inertia: a wrong gear, count or torque constant enters it by its square.

    On the ground the robot is moved too, so that the speed with the wheels free is only the most there can be.
    """
    place = joint_place(can.robot, name)
    free = free_acceleration(can.robot, place, share * float(can.gate.joint_torque[place])) * NUDGE_TIME
    ratio = gained / free
    if ratio > INERTIA_FACTOR or (lifted and ratio < 1.0 / INERTIA_FACTOR):
        way = "more" if ratio > 1.0 else "less"
        yield Finding(
            False, name, f"it gained {gained:.2f} rad/s where {free:.2f} rad/s are expected with the wheel off the ground, "
            f"far {way}: gear, counts or torque constant are wrong",
        )  # fmt: skip
    elif lifted:
        yield Finding(
            True, name, f"it gained {gained:.2f} rad/s, {free:.2f} rad/s expected: gear, counts and torque constant fit"
        )
