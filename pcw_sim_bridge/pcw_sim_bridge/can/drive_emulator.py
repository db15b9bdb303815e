"""`drive_emulator`: a set of CAN drives on a bus, with a plant behind them, for the whole stack without a robot.

ros2 run pcw_sim_bridge drive_emulator --robot thesis --can-file thesis_cia402
python -m pcw_sim_bridge.can.drive_emulator ...

Faults come from the command line, a file, or standard input while it runs, one a line: `over_temperature front_left_drive`.
"""

from __future__ import annotations

import argparse
import json
import math
import queue
import signal
import sys
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import Any, TextIO

import numpy as np

from pcw_description.errors import PcwError
from pcw_description.one_thread import one_thread
from pcw_description.robot_file import load_robot
from pcw_description.short_collections import short_collections

from ..plants.factory import make_plant
from ..plants.plant import PLANT_NAMES
from .can_file import UDP_PORT, on_udp, read_can_file
from .emulated_drive import FAULTS
from .emulated_robot import BUS_FAULTS, EmulatedRobot, check_fault
from .errors import CanError
from .transport import BusOff, TransmitBufferFull, Transport

ZERO_TORQUE = 1e-9  # [N m]
MOST_WAITING = 1024  # frames that are taken before the drives answer; a flood must not keep them silent


def parser() -> argparse.ArgumentParser:
    """Return the command line."""
    faults = "\n".join(f"  {name:17} {what}" for name, what in {**FAULTS, **BUS_FAULTS}.items())
    options = argparse.ArgumentParser(
        prog="drive_emulator", formatter_class=argparse.RawDescriptionHelpFormatter,
        description="Emulate the drives of a CAN file on a bus, with a plant behind them. On standard input: a fault and "
        "where, `stats`, or `quit`.",
        epilog=f"faults:\n{faults}\nexample: drive_emulator --fault 'dead rear_left_steer 12.5'",
    )  # fmt: skip
    options.add_argument("--robot", default="thesis", help="robot file, or the name of a shipped robot (default: thesis)")
    options.add_argument("--can-file", default="thesis_cia402", help="file of the drives, or the name of a shipped one")
    options.add_argument("--plant", default="reduced", choices=PLANT_NAMES, help="what computes the motion (default: reduced)")
    options.add_argument(
        "--udp-port", type=int, default=UDP_PORT, metavar="PORT",
        help=f"buses as UDP multicast on this computer, at this port (default: {UDP_PORT}); 0: the buses of the file",
    )  # fmt: skip
    options.add_argument("--seed", type=int, default=0, help="of the sensors' noise (default: 0)")
    options.add_argument("--watchdog", type=float, metavar="SECONDS", help="set in the drives (default: that of the file)")
    options.add_argument("--lifted", action="store_true", help="the wheels are off the ground")
    options.add_argument(
        "--fault",
        action="append",
        default=[],
        metavar="'NAME WHERE SECONDS'",
        help="a fault so long after the start; repeatable",
    )
    options.add_argument("--faults", type=Path, metavar="FILE", help="a file of such lines")
    options.add_argument("--duration", type=float, metavar="SECONDS", help="end after so long (default: never)")
    options.add_argument("--stats", type=Path, metavar="FILE", help="write what was measured, as JSON, at the end")
    return options


class FaultTimer:
    """Times from a fault, or from the last command, to zero torque at every drive.

    Attributes:
        reactions: one entry for each fault: name, place, when, whether a drive had torque then, and milliseconds to zero
            torque (None until then).
    """

    def __init__(self, emulated: EmulatedRobot) -> None:
        self._emulated = emulated
        self.reactions: list[dict[str, Any]] = []
        self._open: list[dict[str, Any]] = []
        self.had_torque = False
        self.stopped_after: list[float] = []  # from the last command to zero torque, each time that torque ended [ms]
        self.stopped_at: list[float] = []  # when it ended [s]

    def begin(self, name: str, where: str) -> None:
        """Inject a fault and start timing it."""
        self._emulated.inject(name, where)
        if name.endswith("heal"):
            return
        self._open.append({"fault": name, "where": where, "at": round(self._emulated.time - self._emulated.start, 4),
                           "driving": self.had_torque, "zero_after_ms": None})  # fmt: skip
        self.reactions.append(self._open[-1])

    def on_step(self, time: float) -> None:
        """Look at the torques after a step of the plant."""
        any_torque = bool(np.abs(self._emulated.motor_torques()).max() > ZERO_TORQUE)
        if any_torque:
            self.had_torque = True
            return
        if self.had_torque:
            self.had_torque = False
            self.stopped_at.append(time)
            last = max(drive.command_time for drive in self._emulated.drives)
            self.stopped_after.append(round((time - last) * 1000, 2))
        begun = self._emulated.start
        for reaction in self._open:
            reaction["zero_after_ms"] = round((time - begun - reaction["at"]) * 1000, 2)
        self._open = []


def statistics(emulated: EmulatedRobot, timer: FaultTimer) -> dict[str, Any]:
    """Return what was measured."""
    ages = emulated.ages
    return {
        "format": "pcw_drive_emulator/1",
        "seconds": round(emulated.time - emulated.start, 3),
        "frames_in": emulated.frames_in,
        "frames_out": emulated.frames_out,
        "commands": {drive.name: drive.commands for drive in emulated.drives},
        "command_age_ms": {name: round(1000 * ages.quantile(share), 3)
                           for name, share in (("p50", 0.5), ("p99", 0.99), ("p99.9", 0.999))} | {
            "largest": round(1000 * ages.largest, 3)},
        "torque": [round(value, 6) for value in emulated.motor_torques().tolist()],
        "pose": [round(value, 5) for value in emulated.plant.state().pose.tolist()],
        "reactions": timer.reactions,
        "stopped_after_ms": timer.stopped_after,
        "stopped_at": [round(time, 6) for time in timer.stopped_at],
        "failures": {drive.name: drive.failure for drive in emulated.drives if drive.failure},
    }  # fmt: skip


def read_faults(lines: Sequence[str]) -> list[tuple[float, str, str]]:
    """Return time, name and place of faults from lines `NAME WHERE SECONDS`, in order of time.

    Raises:
        CanError: another form.
    """
    faults = []
    for line in lines:
        words = line.split("#")[0].split()
        if not words:
            continue
        try:
            name, where, seconds = words
            if not 0.0 <= float(seconds) < math.inf:
                raise ValueError
            faults.append((float(seconds), name, where))
        except ValueError:
            raise CanError(f"fault {line!r} is not allowed; allowed: 'NAME WHERE SECONDS'") from None
    return sorted(faults)


def _fault_lines(path: Path) -> list[str]:
    try:
        return path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise CanError(f"--faults {path} cannot be read: {error}; allowed: a file of lines 'NAME WHERE SECONDS'") from None


def _check_options(options: argparse.Namespace) -> None:
    """Refuse numbers that are no durations, before anything is opened.

    Raises:
        CanError: names the option, the value and what is allowed.
    """
    for name, least, most in (("duration", 0.0, 1e9), ("watchdog", 0.005, 10.0)):
        value = getattr(options, name)
        if value is not None and not least < value <= most:
            raise CanError(f"--{name} {value:g} is not allowed; allowed: above {least:g} to {most:g} s")
    if not 0 <= options.udp_port <= 65535:
        raise CanError(f"--udp-port {options.udp_port} is not allowed; allowed: 1 to 65535, or 0 for the buses of the file")
    if options.seed < 0:
        raise CanError(f"--seed {options.seed} is not allowed; allowed: 0 and above")
    if options.stats is not None and not options.stats.resolve().parent.is_dir():
        raise CanError(f"--stats {options.stats} is not allowed; allowed: a file in a folder that exists")


def serve(
    emulated: EmulatedRobot,
    transport: Transport,
    timer: FaultTimer,
    planned: list[tuple[float, str, str]],
    asked: queue.Queue[str],
    duration: float | None,
    stopped: threading.Event,
) -> None:
    """Be the drives until `quit`, the end of the duration, or `stopped`."""
    dt = emulated.plant.dt
    planned = list(planned)
    while not stopped.is_set():
        arrived = list(transport.receive(max(emulated.time + dt - transport.now(), 0.0)))
        while 0 < len(arrived) < MOST_WAITING and (waited := transport.receive(0.0)):
            arrived += waited
        now = transport.now()
        emulated.let_go(now)
        begun = emulated.time
        # Where this process had to wait, frames have waited too. Drives in hardware would have taken each as it came. If all
        # come at the end, drives are without a computer for so long, and say one position to several SYNCs.
        for place, one in enumerate(arrived, start=1):
            emulated.advance(begun + (now - begun) * place / len(arrived), timer.on_step)
            if not one.frame.error:
                emulated.receive(one.bus, one.frame)
        emulated.advance(now, timer.on_step)
        for out in emulated.take():
            try:
                transport.send(out.bus, out.frame)
            except (TransmitBufferFull, BusOff) as error:
                print(f"drive_emulator: {error}", file=sys.stderr)
        elapsed = emulated.time - emulated.start
        while planned and planned[0][0] <= elapsed:
            _, name, where = planned.pop(0)
            timer.begin(name, where)
        while not asked.empty():
            if not _do(asked.get().split(), emulated, timer):
                return
        if duration is not None and elapsed >= duration:
            return


def _do(words: list[str], emulated: EmulatedRobot, timer: FaultTimer) -> bool:
    """Do what a line of standard input asks; False ends."""
    if words == ["quit"]:
        return False
    if words == ["stats"]:
        print(json.dumps(statistics(emulated, timer)), flush=True)
    elif len(words) == 2:
        try:
            timer.begin(*words)
            print(f"fault {words[0]} at {words[1]}", flush=True)
        except CanError as error:
            print(f"drive_emulator: {error}", file=sys.stderr)
    elif words:
        print(f"drive_emulator: {' '.join(words)!r} is not allowed; allowed: NAME WHERE, stats, quit", file=sys.stderr)
    return True


def _read_lines(source: TextIO, asked: queue.Queue[str]) -> None:
    for line in source:
        asked.put(line)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return the exit code."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    if "--ros-args" in given:  # from a launch file; there is no node here
        given = given[: given.index("--ros-args")]
    options = parser().parse_args(given)
    stopped = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stopped.set())
    try:
        _run(options, stopped)
    except PcwError as error:
        print(f"drive_emulator: {error}", file=sys.stderr)
        return 2
    return 0


def _run(options: argparse.Namespace, stopped: threading.Event) -> None:
    from .python_can import PythonCanTransport

    _check_options(options)
    one_thread()
    robot = load_robot(options.robot)
    file = read_can_file(options.can_file, robot)
    if options.udp_port:
        file = on_udp(file, options.udp_port)
    planned = read_faults(options.fault + (_fault_lines(options.faults) if options.faults else []))
    for _, name, where in planned:
        check_fault(name, where, file)
    plant = make_plant(options.plant, robot, lifted=options.lifted)
    plant.step(np.zeros((robot.n, 2)))  # compiled before anybody waits
    plant.reset()
    transport = PythonCanTransport(file.buses)
    emulated = EmulatedRobot(plant, file, options.seed, transport.now(), options.watchdog)
    timer = FaultTimer(emulated)
    asked: queue.Queue[str] = queue.Queue()
    threading.Thread(target=_read_lines, args=(sys.stdin, asked), daemon=True).start()
    try:
        short_collections()
        print(f"{len(emulated.drives)} drives of {file.name} on {', '.join(f'{b.interface} {b.channel}' for b in file.buses)}",
              flush=True)  # fmt: skip
        serve(emulated, transport, timer, planned, asked, options.duration, stopped)
    finally:
        found = statistics(emulated, timer)
        found["transport"] = {"sent": transport.sent, "received": transport.received}
        if options.stats is not None:
            options.stats.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
        transport.close()
        emulated.close()


if __name__ == "__main__":
    sys.exit(main())
