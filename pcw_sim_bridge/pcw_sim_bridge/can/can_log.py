"""`can_log`: writes frames to a file, puts them on a bus again, and makes a recording of them.

ros2 run pcw_sim_bridge can_log record LOG --can-file FILE
ros2 run pcw_sim_bridge can_log replay LOG --can-file FILE
ros2 run pcw_sim_bridge can_log recording LOG --can-file FILE --out BAG
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from pcw_description.errors import PcwError
from pcw_description.recording_writer import RecordingWriter
from pcw_description.robot_description import RobotDescription
from pcw_description.robot_file import load_robot

from .can_file import CanFile, on_udp, read_can_file
from .frame_log import FrameDecoder, frames_of_file, write_joint_topics


def parser() -> argparse.ArgumentParser:
    """Return the command line."""
    options = argparse.ArgumentParser(
        prog="can_log", description="Log frames (candump .log, ASC, BLF), replay them, or make a recording of them."
    )
    actions = options.add_subparsers(dest="action", required=True)
    for action, what in (("record", "write what is on the buses to a new log"), ("replay", "send a log's frames at its pace"),
                         ("recording", "make a rosbag2 folder with joint_states and joint_commands")):  # fmt: skip
        sub = actions.add_parser(action, help=what, description=what)
        sub.add_argument("log", type=Path, metavar="LOG", help="its suffix says its format: .log, .asc or .blf")
        sub.add_argument("--robot", default="thesis", help="robot file, or the name of a shipped robot (default: thesis)")
        sub.add_argument("--can-file", default="thesis_cia402", help="file of the drives, or the name of a shipped one")
        if action == "recording":
            sub.add_argument("--out", type=Path, required=True, metavar="BAG", help="folder to make")
        else:
            sub.add_argument(
                "--udp-port", type=int, default=0, metavar="PORT", help="buses as UDP multicast (default: file's)"
            )
        if action == "record":
            sub.add_argument("--duration", type=float, metavar="SECONDS", help="default: until interrupted")
    return options


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return the exit code."""
    options = parser().parse_args(arguments)
    try:
        robot = load_robot(options.robot)
        file = read_can_file(options.can_file, robot)
        if options.action == "recording":
            print(make_recording(options.log, robot, file, options.out))
            return 0
        if options.udp_port:
            file = on_udp(file, options.udp_port)
        print(_record(options.log, file, options.duration) if options.action == "record" else _replay(options.log, file))
    except PcwError as error:
        print(f"can_log: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        return 0 if options.action == "record" else 130
    return 0


def make_recording(log: Path, robot: RobotDescription, file: CanFile, out: Path) -> str:
    """Make a recording of a log; returns a line on what was written.

    Raises:
        CanError, RecordingError: a log that cannot be read, or a folder that exists.
    """
    from .python_can import read_log

    decoder = FrameDecoder(robot, file)
    with RecordingWriter(out, flush_interval=None) as writer:
        write_joint_topics(writer, robot, decoder, frames_of_file(read_log(log), file))
        counts = dict(writer.counts)
    said = (
        ", ".join(f"{count} {topic.strip('/')}" for topic, count in counts.items()) or "nothing, as no set of joints was whole"
    )
    return f"{out}: {said}; {decoder.foreign} frames of nobody in {file.name}"


def _record(log: Path, file: CanFile, duration: float | None) -> str:
    from .python_can import PythonCanTransport

    transport = PythonCanTransport(file.buses, log=log)
    end = None if duration is None else time.monotonic() + duration
    try:
        while end is None or time.monotonic() < end:
            transport.receive(0.1)
    finally:
        transport.close()
    return f"{log}: {sum(transport.received.values())} frames"


def _replay(log: Path, file: CanFile) -> str:
    from .python_can import PythonCanTransport, read_log

    transport = PythonCanTransport(file.buses)
    begun, first, count = time.monotonic(), None, 0
    try:
        for bus, frame, at in frames_of_file(read_log(log), file):
            first = at if first is None else first
            wait = begun + at - first - time.monotonic()
            if wait > 0.0:
                time.sleep(wait)
            if not frame.error:
                transport.send(bus, frame)
                count += 1
    finally:
        transport.close()
    return f"{log}: {count} frames sent"


if __name__ == "__main__":
    sys.exit(main())
