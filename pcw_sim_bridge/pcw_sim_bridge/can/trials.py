"""What the CAN part is worth, in simulated time: faults, random frames, the analyser's verdict, and the load of buses.

    python -m pcw_sim_bridge.can.trials faults [--times 20] [--seed 0]
    python -m pcw_sim_bridge.can.trials encoders [--times 20] [--seed 0]
    python -m pcw_sim_bridge.can.trials fuzz [--frames 100000] [--seed 0]
    python -m pcw_sim_bridge.can.trials verdict --out DIR
    python -m pcw_sim_bridge.can.trials loads

Every torque and every reading is a frame on the way between the driver's core and emulated drives. Time is simulated, so that
the times to zero torque are those of the design, and not of the computer that this runs on; `nodes.can_trials` has the same
stack in real time.
"""

from __future__ import annotations

import argparse
import dataclasses
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pcw_description.errors import PcwError
from pcw_description.robot_description import DRIVE, RobotDescription
from pcw_description.robot_file import load_robot

from .can_file import CanFile, read_can_file
from .drive_set import bus_loads, make_drives
from .encoder_trials import run_encoders
from .errors import CanError
from .frame import Arrived, Frame
from .trial_rig import ALLOWED_MS, FILES, Rig

# What is done, where, and the names by which the driver may say it. "computer" is done to the driver's end.
FAULT_TRIALS = (
    ("dead", "joint", ("missing_node",)),
    ("silent", "joint", ("missing_node",)),
    ("over_temperature", "joint", ("over_temperature",)),
    ("hot", "joint", ("over_temperature",)),
    ("over_current", "joint", ("over_current",)),
    ("encoder_jump", "joint", ("encoder_jump",)),
    ("encoder_stuck", "turning joint", ("encoder_stuck", "encoder_jump")),
    ("encoder_dead", "turning joint", ("encoder_stuck", "encoder_jump")),
    ("over_torque", "joint", ("over_current", "torque_limit")),
    ("restart", "joint", ("node_reset", "drive_disabled")),
    ("bus_off", "bus", ("bus_off",)),
    ("command_timeout", "computer", ("command_timeout",)),
    ("transmit_buffer_full", "computer", ("transmit_buffer_full",)),
    ("driver_killed", "computer", ()),
)
# An encoder that stands shows in motion alone, and the faster the sooner (`encoder_trials`): at this speed it must [rad/s].
STUCK_SPEED = 1.0
DETECTED_BY_DRIVE_ALONE = {("hot", "cia402")}  # the profile has no object for a temperature


def fault_trial(rig: Rig, fault: str, kind: str, names: Sequence[str], rng: np.random.Generator) -> dict[str, Any]:
    """Do one fault while driving; returns when the torque was zero, by what name, and whether it stayed off."""
    can, emulated, timer = rig.can, rig.emulated, rig.timer
    where = str(rng.choice([d.name for d in can.drives])) if "joint" in kind else can.file.buses[0].name
    can.enable()
    rig.wander(float(rng.uniform(2.0, 40.0)))
    rig.cycles(int(rng.integers(20, 250)))
    assert can.armed and np.abs(emulated.motor_torques()).max() > 0.0
    if kind == "turning joint":
        while can.reading is None or np.abs(can.reading.joints.velocity).max() < STUCK_SPEED:
            rig.cycles(1)
        turning = np.abs(can.reading.joints.velocity).ravel() >= STUCK_SPEED
        where = str(rng.choice(np.array(rig.robot.joint_names)[turning]))
    rig.transport.receive(float(rng.uniform(0.0, can.period)))  # at any time within a period
    begun = emulated.time
    if kind == "computer":
        before = len(timer.stopped_at)
        if fault == "transmit_buffer_full":
            rig.transport.full = True
        if fault == "driver_killed":
            for _ in range(30):
                rig.transport.receive(can.period)
        else:
            rig.cycles(30, answered=fault != "command_timeout")
        stopped = timer.stopped_at[before:]
        zero = round((stopped[-1] - begun) * 1000, 2) if stopped else None
        rig.transport.full = False
    else:
        timer.begin(fault, where)
        rig.cycles(30)
        zero = timer.reactions[-1]["zero_after_ms"]
    named = [f.name for f in can.faults]
    rig.cycles(25)
    stays = float(np.abs(emulated.motor_torques()).max()) == 0.0 and not can.armed or fault == "driver_killed"
    emulated.inject("heal", "all")
    emulated.inject("bus_heal", can.file.buses[0].name)
    rig.cycles(25)
    stays = stays and float(np.abs(emulated.motor_torques()).max()) == 0.0
    can.clear_faults()
    return {"fault": fault, "where": where, "zero_after_ms": zero, "named": named, "stays_off": stays,
            "right_name": not names or named[:1] != [] and bool(set(names) & set(named))}  # fmt: skip


def run_faults(times: int, seed: int) -> tuple[str, bool]:
    """Do every fault so many times with both protocols; returns a table and whether all was as it must be."""
    robot, lines, fine = load_robot("thesis"), [], True
    lines.append(f"{'drives':14} {'fault':21} {'times':>5} {'mean':>8} {'largest':>8}  named  stays off")
    for name in FILES:
        rig = Rig(robot, read_can_file(name, robot), seed)
        rng = np.random.default_rng(seed)
        rig.can.configure()
        for fault, kind, names in FAULT_TRIALS:
            if (fault, rig.can.file.joints[0].protocol) in DETECTED_BY_DRIVE_ALONE:
                continue
            results = [fault_trial(rig, fault, kind, names, rng) for _ in range(times)]
            zeros = [r["zero_after_ms"] for r in results]
            named, stays = sum(r["right_name"] for r in results), sum(r["stays_off"] for r in results)
            good = None not in zeros and max(zeros) <= ALLOWED_MS and named == stays == times
            fine = fine and good
            worst = "never" if None in zeros else f"{max(zeros):5.1f} ms"
            mean = "" if None in zeros else f"{np.mean(zeros):5.1f} ms"
            lines.append(
                f"{name:14} {fault:21} {times:5} {mean:>8} {worst:>8}  {named:5}  {stays:9}{'' if good else '  NOT MET'}"
            )
    return "\n".join(lines), fine


# --- Random frames ---------------------------------------------------------------------------------------


def random_frame(rng: np.random.Generator, seen: Sequence[Frame]) -> Frame:
    """Return a frame that is random throughout, or one that was seen with some of it changed."""
    if seen and rng.random() < 0.6:
        base = seen[int(rng.integers(len(seen)))]
        data = bytearray(base.data)
        for _ in range(int(rng.integers(1, 4))):
            change = rng.integers(4)
            if change == 0 and data:
                data[int(rng.integers(len(data)))] ^= 1 << int(rng.integers(8))
            elif change == 1 and data:
                data[int(rng.integers(len(data)))] = int(rng.integers(256))
            elif change == 2:
                data = data[: int(rng.integers(0, 9))]
            else:
                data = (data + bytes(rng.integers(0, 256, 8, dtype=np.uint8)))[: int(rng.integers(0, 9))]
        identifier = base.id ^ (1 << int(rng.integers(11)) if rng.random() < 0.2 else 0)
        return base._replace(id=identifier, data=bytes(data), remote=bool(rng.random() < 0.05))
    anything = bytes(rng.integers(0, 256, int(rng.integers(0, 9)), dtype=np.uint8))
    extended = bool(rng.random() < 0.05)
    return Frame(int(rng.integers(1 << (29 if extended else 11))), anything, bool(rng.random() < 0.05), False, extended)


def run_fuzz(count: int, seed: int) -> tuple[str, bool]:
    """Throw frames at the driver's core, without torque and with it, and at drives; returns a table and whether all held."""
    robot, lines, fine = load_robot("thesis"), [], True
    for name in FILES:
        rng = np.random.default_rng(seed)
        file = read_can_file(name, robot)
        outcome = fuzz(robot, file, count // (2 * len(FILES)), rng)
        fine = (
            fine and outcome["torque_without_command"] == 0 and outcome["beyond_limits"] == 0 and outcome["works_afterwards"]
        )
        lines.append(f"{name:14} " + ", ".join(f"{key} {value}" for key, value in outcome.items()))
    return "\n".join(lines), fine


def fuzz(robot: RobotDescription, file: CanFile, count: int, rng: np.random.Generator) -> dict[str, Any]:
    """Throw `count` frames at a driver without torque, and as many at one with torque and at the drives.

    Returns:
        How many frames there were; frames with torque that nobody commanded; torques beyond the limits; stops; and whether
        the robot drives as before when it is cleared.
    """
    rig = Rig(robot, file)
    can, transport = rig.can, rig.transport
    bus = file.buses[0].name
    can.configure()
    seen = [frame for _, frame, _, _ in _some_frames(rig)]
    limits = can.gate.motor_torque.ravel()
    wrong = beyond = stops = thrown = 0

    def look(allowed: bool) -> None:
        nonlocal wrong, beyond
        assert transport.sent is not None
        for _, frame in transport.sent:
            for k, drive in enumerate(can.drives):
                want = drive.decode_command(frame)
                if want is not None:
                    wrong += not allowed and want.value != 0.0
                    beyond += not abs(want.value) <= limits[k] * (1.0 + 1e-6)
        transport.sent = []

    transport.sent = []
    while thrown < count:  # without torque
        transport.others = [Arrived(bus, random_frame(rng, seen), 0.0) for _ in range(20)]
        thrown += 20
        can.cycle(rig.answer)
        look(allowed=False)
        assert not can.armed
    again = 0
    while again < count:  # with torque; when that ends by a fault it is told to begin again
        if not can.armed:
            stops += bool(can.faults)
            transport.others = []
            for drive in rig.emulated.drives:
                drive.power_on(rig.emulated.time)  # whatever the frames have set in it is gone
            can.clear_faults()
            can.enable()
        rig.torque[:, DRIVE] = rng.uniform(-30.0, 30.0)  # beyond the limits now and then
        transport.sent = []
        transport.others = [Arrived(bus, random_frame(rng, seen), 0.0) for _ in range(5)]
        for _ in range(5):
            frame = random_frame(rng, seen)
            if frame.id != 0:  # NMT may rightly switch a drive off
                rig.emulated.receive(bus, frame)
        again += 10
        can.cycle(rig.answer)
        look(allowed=True)
        rig.emulated.plant.reset()  # it shall not run away over thousands of random torques
    rig.torque[:] = 0.0
    for drive in rig.emulated.drives:
        drive.power_on(rig.emulated.time)
    can.clear_faults()
    can.enable()
    rig.torque[:, DRIVE] = 1.0
    rig.cycles(100)
    speed = float(rig.emulated.plant.state().twist[0])
    return {"frames": thrown + again, "torque_without_command": wrong, "beyond_limits": beyond, "stops": stops,
            "refused_by_driver": can.counters.refused_frames, "foreign_counted": can.counters.foreign_frames,
            "works_afterwards": bool(can.armed and speed > 0.05)}  # fmt: skip


def _some_frames(rig: Rig) -> list[tuple[str, Frame, float, bool]]:
    """Return what an undisturbed drive looks like on the bus."""
    frames = rig.transport.log()
    rig.torque[:, DRIVE] = 1.0
    rig.can.enable()
    rig.cycles(10)
    rig.can.request_disable()
    rig.cycles(10, answered=False)
    rig.transport.frames = None
    return frames


# --- Loads -----------------------------------------------------------------------------------------------


def run_loads() -> str:
    """Return the load of the shipped files, and at which number of axes a bus is full at 250 and 500 Hz."""
    robot, texts = load_robot("thesis"), []
    for name in FILES:
        for rate in (250.0, 500.0):
            file = dataclasses.replace(read_can_file(name, robot), rate=rate)
            [load] = bus_loads(file, make_drives(robot, file)).values()
            verdict = "allowed" if load.load <= load.allowed else "refused"
            texts.append(f"{name} at {rate:g} Hz, {verdict}\n{load.arithmetic()}")
    return "\n\n".join(texts)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line: exit 0 when all is as it must be, 1 when not, 2 on bad input."""
    options = argparse.ArgumentParser(prog="can.trials", description="Faults, random frames, verdicts and loads over CAN.")
    actions = options.add_subparsers(dest="action", required=True)
    for action, what in (("faults", "every fault while driving, in simulated time"),
                         ("encoders", "how soon an encoder that stands is found, and false alarms"),
                         ("fuzz", "random and mutated frames"), ("verdict", "the analyser over CAN and over the bridge"),
                         ("loads", "the load of the shipped files")):  # fmt: skip
        sub = actions.add_parser(action, help=what, description=what)
        sub.add_argument("--seed", type=int, default=0, help="of everything that is drawn (default: 0)")
        sub.add_argument("--into", type=Path, metavar="PAGE", help="write the table into a page, between its marks")
        if action in ("faults", "encoders"):
            sub.add_argument("--times", type=int, default=20, help="each, with each protocol (default: 20)")
        elif action == "fuzz":
            sub.add_argument("--frames", type=int, default=100_000, help="in all (default: 100000)")
        elif action == "verdict":
            sub.add_argument("--out", type=Path, required=True, help="folder for recordings and reports")
    given = options.parse_args(arguments)
    try:
        if given.action == "loads":
            said, fine = run_loads(), True
        elif given.action == "faults":
            said, fine = run_faults(given.times, given.seed)
        elif given.action == "encoders":
            said, fine = run_encoders(given.times, given.seed)
        elif given.action == "fuzz":
            said, fine = run_fuzz(given.frames, given.seed)
        else:
            from .verdict_trials import run_verdict

            said, fine = run_verdict(given.out, given.seed)
    except PcwError as error:
        print(f"can.trials: {error}", file=sys.stderr)
        return 2
    print(said)
    if given.into is not None:
        write_into(given.into, given.action, said)
    return 0 if fine else 1


def write_into(page: Path, mark: str, table: str) -> None:
    """Replace what stands between `<!-- MARK -->` and `<!-- /MARK -->` of a page."""
    head, opening, rest = page.read_text(encoding="utf-8").partition(f"<!-- {mark} -->\n")
    _, closing, tail = rest.partition(f"<!-- /{mark} -->")
    if not opening or not closing:
        raise CanError(f"--into {page} is not allowed; allowed: a page with the marks <!-- {mark} --> and <!-- /{mark} -->")
    indented = "\n".join(f"    {line}".rstrip() for line in table.splitlines())
    page.write_text(f"{head}{opening}{indented}\n{closing}{tail}", encoding="utf-8")


if __name__ == "__main__":
    sys.exit(main())
