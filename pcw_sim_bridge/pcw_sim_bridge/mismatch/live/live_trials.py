"""What the live watch is worth: false alarms on healthy robots, and how soon and where it sees a fault that begins mid-run.

    python -m pcw_sim_bridge.mismatch.live.live_trials [--robot ROBOT] [--plant PLANT] [--healthy 10] [--seed 0] [--json FILE]

Every trial drives a simulated robot that differs from its description within the tolerances, drawn from the seed, and hands
the serialised messages to `LiveChannels` as the node does, faster than real time. A fault begins at a time when the robot
has moved for longer than the learning takes. The processor time counted is that of the watch alone.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pcw_control.excitation import make_excitation
from pcw_description.effects.registry import read_physics
from pcw_description.errors import PcwError
from pcw_description.recording_files import RawMessage
from pcw_description.robot_description import DRIVE, STEER, FloatArray, RobotDescription
from pcw_description.robot_file import load_robot
from pcw_description.ros_messages import imu, joint_state, odometry, serialise, type_name_of

from ...plants.factory import make_plant
from ...plants.plant import PLANT_NAMES, PlantState
from ...run_controllers import make_controller
from ...sensors import ImuReading, JointReading
from ...simulated_robot import JointCommand, SimulatedRobot, TrackedPose
from ...stamping import HEALTHY, StampingParameters, TopicStamps
from .live_channels import Judgement, Level, LiveChannels, LiveParameters, header_stamp
from .live_rows import NANOSECONDS

Content = JointReading | JointCommand | ImuReading | TrackedPose
TOPICS: Mapping[type[Content], str] = {
    JointReading: "joint_states", JointCommand: "joint_commands", ImuReading: "imu/data", TrackedPose: "ground_truth/odom",
}  # fmt: skip
FORMAT = "pcw_live_trials/1"
START_NS = NANOSECONDS  # a stamp of zero means "no stamp"
HEALTHY_DURATION, FAULT_DURATION, FAULT_TIME = 60.0, 50.0, 33.0  # [s]
# The motions are taken in turn; a fault is looked for in one that never rests.
HEALTHY_MOTIONS = ("figure8", "random_goals", "chirps", "strafe", "spin", "circle", "steps", "identification")
FAULT_MOTION = "chirps"
UPDATE_PERIOD = 0.25  # [s]


@dataclasses.dataclass(frozen=True)
class Fault:
    """What begins mid-run.

    Attributes:
        name: as printed.
        physics: the effect, as under `physics:`.
        place: where the watch should see it, one of the words of `live_suspects`.
    """

    name: str
    physics: Mapping[str, Any]
    place: str


@dataclasses.dataclass(frozen=True)
class Outcome:
    """What the watch made of one trial.

    Attributes:
        false_alarm: first stamp before the fault at which a channel departed; None without one [s].
        delay: from the fault to the update at which a channel departs [s]; None where none does.
        channel: the one that departs most then.
        place: where it was seen to sit first, or "" where that was not told; told_after: how long after the fault [s].
        largest: largest normalised residual before the fault.
        share: processor time of the watch per time of the robot.
        longest: longest update [s], the one that ends learning left out; learning: that one [s].
    """

    name: str
    false_alarm: float | None
    delay: float | None
    channel: str
    place: str
    told_after: float | None
    largest: float
    share: float
    longest: float
    learning: float


def faults(robot: RobotDescription) -> tuple[Fault, ...]:
    """Faults of a size that somebody should hear of, in proportion to the robot."""
    first, last = robot.caster_names[0], robot.caster_names[-1]
    drive, steer = (float(robot.torque_limit[0, axis]) for axis in (DRIVE, STEER))
    found = [
        Fault("dry friction in a drive", _effect("drive_coulomb_friction", first, coulomb=0.03 * drive), first),
        Fault("dry friction in a steering", _effect("steer_coulomb_friction", last, coulomb=0.03 * steer), last),
        Fault("a push", _effect("external_push", "chassis", force_y=0.2 * robot.total_mass, force_x=0.0, start=0.0,
                                duration=FAULT_DURATION), "chassis"),
        Fault("a payload set down", _effect("payload_mass", "chassis", mass=0.25 * robot.total_mass, x=0.05), "chassis"),
        Fault("a weak drive motor", _effect("torque_constant_error", first, error=-0.25), first),
        Fault("a turned steering zero", _effect("steer_zero_offset", last, offset=0.03), last),
    ]  # fmt: skip
    if robot.sensors.imu is not None:
        found.append(Fault("a biased gyro", _effect("imu_bias", "imu", gyro=0.03), "imu"))
    return tuple(found)


def _effect(name: str, target: str, **parameters: float) -> dict[str, Any]:
    return {"name": name, "target": [target], **parameters}


def with_effects(robot: RobotDescription, physics: Sequence[Mapping[str, Any]]) -> RobotDescription:
    """Return the robot with further effects at work."""
    added = read_physics([dict(entry) for entry in physics], robot.caster_names)
    return dataclasses.replace(robot, physics=(*robot.physics, *added))


def within_tolerance(robot: RobotDescription, rng: np.random.Generator) -> RobotDescription:
    """Return a healthy robot: every number drawn from its tolerance as one standard deviation."""

    def drawn(tolerance: str, nominal: float = 1.0) -> float:
        known = robot.tolerance(tolerance)
        return float(known.value * (abs(nominal) if known.relative else 1.0) * rng.normal())

    chassis = robot.chassis
    x, y, z = (c + drawn("chassis.com") for c in chassis.com)
    changed = dataclasses.replace(
        chassis,
        mass=chassis.mass + drawn("chassis.mass", chassis.mass),
        inertia_zz=chassis.inertia_zz + drawn("chassis.inertia_zz", chassis.inertia_zz),
        com=(x, y, z),
    )
    physics = [
        _effect("ground_slope", "chassis", angle=abs(drawn("ground.slope")), direction=float(rng.uniform(-np.pi, np.pi)))
    ]
    for caster in robot.casters:
        physics += [
            _effect("wheel_radius_error", caster.name, error=drawn("wheel_radius", caster.wheel_radius)),
            _effect("steer_zero_offset", caster.name, offset=drawn("steer_zero")),
            _effect("caster_offset_error", caster.name, x=drawn("caster_offset")),
            _effect("torque_constant_error", caster.name, error=drawn("torque_constant")),
            {**_effect("torque_constant_error", caster.name, error=drawn("torque_constant")), "axis": "steer"},
        ]
    if robot.sensors.imu is not None:
        physics.append(
            _effect(
                "imu_bias", "imu", gyro=drawn("imu.gyro_bias"), accelerometer_x=drawn("imu.accelerometer_bias"),
                accelerometer_y=drawn("imu.accelerometer_bias"),
            )
        )  # fmt: skip
    return with_effects(dataclasses.replace(robot, chassis=changed), physics)


# --- Driving --------------------------------------------------------------------------------------------


def messages(
    nominal: RobotDescription,
    stages: Sequence[tuple[RobotDescription, float]],
    twist: Callable[[float], FloatArray | None],
    seed: int,
    plant: str = "reduced",
    stamping: StampingParameters = HEALTHY,
) -> Iterator[RawMessage]:
    """Drive a robot that becomes another one, and yield what arrives of what it sends.

    Args:
        nominal: what its controller believes in.
        stages: the robot as it is until a time [s], one after the other; each goes on from the motion of the one before.
        twist: time [s] -> twist (3,) wanted.
        seed: of the sensors' noise.
        plant: see `make_plant`.
        stamping: how the stamps tremble, and what is lost; the controller is on board and loses nothing.
    """
    stamps = TopicStamps(stamping, seed, nominal)
    controller = make_controller("computed_torque", nominal)
    before, command, begun = None, None, 0.0
    for robot, end in stages:
        simulated = SimulatedRobot(make_plant(plant, robot), seed + round(1e3 * begun))
        if before is not None:
            simulated.plant.reset(before.pose, before.joint_position[:, STEER])
            simulated.plant.set_motion(before.twist, before.joint_position, before.joint_velocity)
            list(simulated.advance())  # the readings of this instant came from the stage before
            simulated.command(command)
        offset = round(begun * 1e9)
        while simulated.time_ns + offset < end * 1e9:
            for sample in simulated.advance():
                now = sample.time_ns + offset
                sent: list[Content] = []
                if not isinstance(sample.reading, PlantState):
                    sent.append(sample.reading)
                if isinstance(sample.reading, JointReading):
                    command = controller.command(sample.reading, twist(now * 1e-9), simulated.control_period)
                    simulated.command(command)
                    sent.append(command)
                for content in sent:
                    topic = TOPICS[type(content)]
                    stamp, lost = stamps.stamp(topic, now + START_NS)
                    if not lost:
                        message = _message(content, stamp, robot.joint_names)
                        yield RawMessage(f"/{topic}", type_name_of(message), now + START_NS, serialise(message))
        before, begun = simulated.plant.state(), end
        simulated.close()


def _message(content: Content, stamp: int, names: tuple[str, ...]) -> object:
    if isinstance(content, JointReading):
        return joint_state(stamp, names, content.position, content.velocity, content.effort)
    if isinstance(content, JointCommand):
        return joint_state(stamp, names, velocity=content.velocity, effort=content.effort)
    if isinstance(content, ImuReading):
        return imu(stamp, content.angular_velocity, content.linear_acceleration)
    return odometry(stamp, content.pose, content.truth.twist)


# --- Watching -------------------------------------------------------------------------------------------


def judgements(
    live: LiveChannels, sent: Iterator[RawMessage], period: float = UPDATE_PERIOD
) -> Iterator[tuple[float, Judgement, float]]:
    """Hand messages to the watch; yield stamp [s], judgement and processor time [s] of every update."""
    due: float | None = None
    spent = 0.0
    for message in sent:
        before = time.process_time()
        live.receive(message.topic, message.type_name, bytes(message.cdr))
        spent += time.process_time() - before
        now = header_stamp(bytes(message.cdr)) / NANOSECONDS
        due = now + period if due is None else due
        if now >= due:
            due += period
            before = time.process_time()
            judgement = live.update()
            yield now, judgement, spent + time.process_time() - before
            spent = 0.0


def watch(name: str, live: LiveChannels, sent: Iterator[RawMessage], fault_time: float | None) -> Outcome:
    """Run one trial."""
    false_alarm = delay = told_after = None
    channel, place, largest, first, total, longest, learning = "", "", 0.0, None, 0.0, 0.0, 0.0
    begins = np.inf if fault_time is None else fault_time + START_NS / NANOSECONDS
    was_ready = live.tuning is not None
    now = 0.0
    for now, judgement, spent in judgements(live, sent):
        first = now if first is None else first
        total += spent
        if judgement.ready and not was_ready:
            was_ready, learning = True, spent
        else:
            longest = max(longest, spent)
        departs = judgement.level is not Level.OK
        if now < begins:
            largest = max([largest, *(state.normalised for state in judgement.channels)])
            if departs and false_alarm is None:
                false_alarm = now
        elif departs and delay is None:
            delay = now - begins
            channel = max(judgement.channels, key=lambda state: state.normalised).name
        if now >= begins and judgement.suspect is not None and judgement.suspect.told and not place:
            place, told_after = judgement.suspect.place, now - begins
    duration = now - (first or 0.0)
    return Outcome(name, false_alarm, delay, channel, place, told_after, largest, total / duration, longest, learning)


def healthy_trial(nominal: RobotDescription, index: int, seed: int, plant: str, parameters: LiveParameters) -> Outcome:
    """A minute of a healthy robot."""
    rng = np.random.default_rng([seed, index])
    motion = HEALTHY_MOTIONS[index % len(HEALTHY_MOTIONS)]
    twist = make_excitation(motion, nominal, HEALTHY_DURATION, seed + index).twist
    stages = [(within_tolerance(nominal, rng), HEALTHY_DURATION)]
    sent = messages(nominal, stages, twist, seed + index, plant)
    return watch(f"healthy, {motion}", LiveChannels(nominal, parameters), sent, None)


def fault_trial(
    nominal: RobotDescription, fault: Fault, seed: int, plant: str, parameters: LiveParameters
) -> Outcome:
    """A healthy robot on which a fault begins."""
    healthy = within_tolerance(nominal, np.random.default_rng([seed, 1000]))
    twist = make_excitation(FAULT_MOTION, nominal, FAULT_DURATION, seed).twist
    stages = [(healthy, FAULT_TIME), (with_effects(healthy, [fault.physics]), FAULT_DURATION)]
    sent = messages(nominal, stages, twist, seed, plant)
    return watch(fault.name, LiveChannels(nominal, parameters), sent, FAULT_TIME)


def table(outcomes: Sequence[Outcome], expected: Mapping[str, str]) -> str:
    """Print what came out."""
    lines = [
        f"{'trial':28} {'false alarm':>11} {'largest':>8} {'delay':>7} {'channel':18} {'seen at':14} {'after':>7} {'core':>6} "
        f"{'update':>8} {'learning':>8}"
    ]
    for o in outcomes:
        seen = o.place or ("not told" if o.name in expected else "")
        if o.name in expected and o.place:
            seen += "" if o.place == expected[o.name] else " (wrong)"
        lines.append(
            f"{o.name:28} {_seconds(o.false_alarm):>11} {o.largest:8.2f} {_seconds(o.delay):>7} {o.channel:18} {seen:14} "
            f"{_seconds(o.told_after):>7} {100.0 * o.share:5.1f}% {1e3 * o.longest:5.0f} ms {1e3 * o.learning:5.0f} ms"
        )
    return "\n".join(lines)


def _seconds(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f} s"


def main(args: Sequence[str] | None = None) -> int:
    """Run the trials and print the table; 0 when they ran, 2 on bad input."""
    parser = argparse.ArgumentParser(prog="live_trials", description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--robot", default="thesis", help="robot file, or the name of a shipped robot (default: thesis)")
    parser.add_argument("--plant", default="reduced", choices=PLANT_NAMES, help="simulator (default: reduced)")
    parser.add_argument("--healthy", type=int, default=10, help="healthy runs of a minute (default: 10)")
    parser.add_argument("--seed", type=int, default=0, help="of all that is drawn (default: 0)")
    parser.add_argument("--json", type=Path, help="file to write the figures to as well")
    arguments = parser.parse_args(args)
    try:
        nominal = load_robot(arguments.robot)
        known = faults(nominal)
        runs: list[Callable[[], Outcome]] = [
            lambda index=index: healthy_trial(nominal, index, arguments.seed, arguments.plant, LiveParameters())  # type: ignore[misc]
            for index in range(arguments.healthy)
        ]
        runs += [
            lambda fault=fault: fault_trial(nominal, fault, arguments.seed, arguments.plant, LiveParameters())  # type: ignore[misc]
            for fault in known
        ]
        outcomes = []
        for run in runs:
            outcomes.append(run())
            print(f"{len(outcomes)} of {len(runs)}: {outcomes[-1].name}", file=sys.stderr, flush=True)
    except PcwError as error:
        print(f"live_trials: {error}", file=sys.stderr)
        return 2
    print(table(outcomes, {fault.name: fault.place for fault in known}))
    if arguments.json is not None:
        content = {"format": FORMAT, "robot": nominal.name, "plant": arguments.plant, "seed": arguments.seed}
        content["trials"] = [dataclasses.asdict(outcome) for outcome in outcomes]
        arguments.json.write_text(json.dumps(content, indent=1), encoding="utf-8")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
