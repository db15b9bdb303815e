"""`can_doctor`: lists buses and drives, checks them, nudges one joint at a time, and says in words what is wrong.

ros2 run pcw_sim_bridge can_doctor --robot thesis --can-file my_drives.yaml --lifted

It opens the buses itself: no driver may run.
"""

from __future__ import annotations

import argparse
import logging
import shutil
import sys
from collections.abc import Sequence

from pcw_description.errors import PcwError
from pcw_description.robot_file import load_robot

from .can_file import on_udp, read_can_file
from .command_line import end_on_signals
from .doctor import NUDGE_SHARE, examine


def parser() -> argparse.ArgumentParser:
    """Return the command line."""
    options = argparse.ArgumentParser(
        prog="can_doctor",
        description="List buses and drives, check rates and latencies, and nudge one joint at a time at low torque to check "
        "signs and gears. No driver may run. Exit 0 when all is well, 1 when something is wrong, 2 on bad input.",
    )
    options.add_argument("--robot", default="thesis", help="robot file, or the name of a shipped robot (default: thesis)")
    options.add_argument("--can-file", default="thesis_cia402", help="file of the drives, or the name of a shipped one")
    options.add_argument("--udp-port", type=int, default=0, metavar="PORT", help="buses as UDP multicast (default: file's)")
    options.add_argument("--list", action="store_true", help="list the buses that python-can finds here, and end")
    options.add_argument("--no-nudge", action="store_true", help="move nothing")
    options.add_argument("--lifted", action="store_true", help="the wheels are off the ground: gears are judged too")
    options.add_argument("--share", type=float, default=NUDGE_SHARE, metavar="FRACTION",
                         help=f"of the torque limit to nudge with, 0.01 to 0.3 (default: {NUDGE_SHARE:g})")  # fmt: skip
    options.add_argument("--yes", action="store_true", help="do not ask before joints move")
    return options


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return the exit code."""
    command_line = parser()
    options = command_line.parse_args(arguments)
    if not 0.01 <= options.share <= 0.3:
        command_line.error(f"--share {options.share:g} is not allowed; allowed: 0.01 to 0.3")
    if options.list:
        return _list()
    end_on_signals()
    try:
        return _examine(options)
    except PcwError as error:
        print(f"can_doctor: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("can_doctor: ended before its time; no torque is left on", file=sys.stderr)
        return 130


def _list() -> int:
    from .python_can import available_buses

    logging.getLogger("can").setLevel(logging.CRITICAL)  # what it lacks for the interfaces that are not here
    found = available_buses()
    for bus in found:
        print(", ".join(f"{key} {value}" for key, value in bus.items()))
    if shutil.which("ip") is None:  # python-can asks it; containers often lack it
        print("interfaces of socketcan are not listed: `ip` (iproute2) is not installed; a bus may be there all the same")
    elif not found:
        print("python-can finds no bus here; `ip link` shows the interfaces of socketcan")
    return 0


def _may_nudge(options: argparse.Namespace) -> bool:
    if options.no_nudge or options.yes:
        return not options.no_nudge
    print("Every joint will move a little. Is the robot free to? [y/N] ", end="", flush=True)
    return sys.stdin.readline().strip().lower() in ("y", "yes")


def _examine(options: argparse.Namespace) -> int:
    from .python_can import PythonCanTransport

    robot = load_robot(options.robot)
    file = read_can_file(options.can_file, robot)
    if options.udp_port:
        file = on_udp(file, options.udp_port)
    transport = PythonCanTransport(file.buses)
    wrong = 0
    nudge = _may_nudge(options)
    try:
        for finding in examine(robot, file, transport, nudge, options.share, options.lifted):
            print(finding, flush=True)
            wrong += not finding.good
    finally:
        transport.close()
    print("all is well" if not wrong else f"{wrong} findings are wrong")
    return 0 if not wrong else 1


if __name__ == "__main__":
    sys.exit(main())
