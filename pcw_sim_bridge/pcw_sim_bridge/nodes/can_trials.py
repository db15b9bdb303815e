"""The whole stack in real time: emulator, driver and controller in processes of their own, frames over UDP multicast, DDS.

    python -m pcw_sim_bridge.nodes.can_trials closed_loop [--can-file FILE] [--rate 250] [--duration 600] [--into PAGE]
    python -m pcw_sim_bridge.nodes.can_trials faults [--times 20] [--into PAGE]
    python -m pcw_sim_bridge.nodes.can_trials kill [--times 5] [--into PAGE]

Reported as measured, with the load of the computer: one that is busy with other work is late, and drives rightly stop then.
`--timeouts` sets all three timeouts of the file, so that ages can be measured where the file's own would end the run.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

from pcw_description.nodes.node_testing import NodeProcess, RosTest

from ..can.trials import write_into
from .can_fault_trials import FAULTS, faults, kill
from .can_stack import Stack
from .late_wakes import LATE, LateWakes

BOUND_MS = 8.0


def closed_loop(options: argparse.Namespace) -> int:
    """Drive for the duration and print the ages of commands and the frames that were lost."""
    with tempfile.TemporaryDirectory() as folder, RosTest() as ros:
        before, wakes = os.getloadavg()[0], LateWakes(options.priority)
        stack = Stack(ros, Path(folder), options)
        stack.drive_for(2.0)
        seconds = {name: -_processor_time(getattr(stack, name)) for name in ("emulator", "driver", "controller")}
        with wakes:
            stack.drive_for(options.duration)
        message, values = stack.drives
        for name in seconds:
            seconds[name] += _processor_time(getattr(stack, name))
        stack.controller.interrupt()
        stack.driver.interrupt()
        stack.emulator.interrupt()
        measured = json.loads(stack.stats.read_text(encoding="utf-8"))
        said = next((line for line in stack.driver.log.splitlines() if "frames sent" in line), "")
    ages = measured["command_age_ms"]
    sent, received = (
        int(said.split(word)[1].split()[0].strip(",;")) if said else -1 for word in ("frames sent ", "received ")
    )
    to_drives, from_drives = measured["transport"]["received"], measured["transport"]["sent"]
    at_driver = {key.removeprefix("command_age_ms_"): float(value) for key, value in values.items() if "command_age" in key}
    priority = f", priority {options.priority} (chrt -f)" if options.priority else ""
    fine = message.startswith("armed") and ages["p99.9"] <= BOUND_MS and sent == sum(to_drives.values())
    lines = [
        f"{options.can_file} at {options.rate:g} Hz for {options.duration:g} s{priority}; load of the computer {before:.1f} "
        f"before, {os.getloadavg()[0]:.1f} after, on {os.cpu_count()} cores",
        f"state of the driver at the end: {_shortened(message)}",
        f"age of the command at the drives: p50 {ages['p50']:.1f}, p99 {ages['p99']:.1f}, p99.9 {ages['p99.9']:.1f}, "
        f"largest {ages['largest']:.1f} ms",
        "from reading to command, at the driver: " + ", ".join(f"{key} {age:.2f} ms" for key, age in at_driver.items()),
        f"frames to the drives: {sent} sent, {sum(to_drives.values())} received",
        f"frames from the drives: {sum(from_drives.values())} sent, {received} received (the emulator begins first)",
        f"cycles {values.get('cycles')}, late {values.get('late_cycles')}, incomplete {values.get('incomplete')}",
        f"a process that only sleeps, at this priority, was woken up to {1e3 * wakes.largest:.1f} ms late, "
        f"{wakes.count} times more than {1e3 * LATE:g} ms",
        f"processor time: {', '.join(f'{name} {used / options.duration:.0%}' for name, used in seconds.items())} of a core",
        "met" if fine else "NOT MET on this computer at this load",
    ]
    print("\n".join(lines))
    if options.into is not None:
        write_into(options.into, f"closed_loop {options.can_file} {options.rate:g}", "\n".join(lines))
    return 0 if fine else 1


def _shortened(message: str) -> str:
    """Say the first of many faults and how many more there are."""
    first, *others = message.split("; ")
    return f"{first}; and {len(others)} more" if others else first


def _processor_time(process: NodeProcess) -> float:
    """Return the processor time that a process has used [s]."""
    fields = Path(f"/proc/{process.process.pid}/stat").read_text(encoding="utf-8").rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line: exit 0 when all is as it must be."""
    options = argparse.ArgumentParser(prog="can_trials", description="The CAN stack in real time.")
    actions = options.add_subparsers(dest="action", required=True)
    for action, what in (("closed_loop", "ages of commands and lost frames"), ("faults", "every fault while driving"),
                         ("kill", "kill -9 of each process while driving")):  # fmt: skip
        sub = actions.add_parser(action, help=what, description=what)
        sub.add_argument("--rate", type=float, default=250.0, help="[Hz] (default: 250)")
        sub.add_argument("--timeouts", type=float, help="instead of those of the file [s]")
        sub.add_argument("--priority", type=int, default=0, metavar="1..99",
                         help="real-time priority of the three processes (chrt -f); needs the right to")  # fmt: skip
        if action == "closed_loop":
            sub.add_argument("--can-file", default="thesis_cia402", help="default: thesis_cia402")
            sub.add_argument("--duration", type=float, default=600.0, help="[s] (default: 600)")
        else:
            sub.add_argument("--can-file", nargs="+", default=["thesis_cia402", "thesis_odrive"], help="default: both shipped")
            sub.add_argument("--times", type=int, default=20 if action == "faults" else 5, help="each (default: %(default)s)")
            sub.add_argument("--seed", type=int, default=0, help="of when and where (default: 0)")
        sub.add_argument("--into", type=Path, metavar="PAGE", help="write the table into a page, between its marks")
        if action == "faults":
            sub.add_argument("--only", nargs="+", metavar="FAULT", choices=FAULTS, help=f"of {', '.join(FAULTS)}")
    given = options.parse_args(arguments)
    return {"closed_loop": closed_loop, "faults": faults, "kill": kill}[given.action](given)


if __name__ == "__main__":
    sys.exit(main())
