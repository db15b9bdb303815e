"""`can_log`: writes frames to a file, puts them on a bus again, and makes a recording of them.

ros2 run pcw_sim_bridge can_log record LOG --can-file FILE
ros2 run pcw_sim_bridge can_log replay LOG --can-file FILE
ros2 run pcw_sim_bridge can_log recording LOG --can-file FILE --out BAG
"""

from __future__ import annotations

import argparse
import itertools
import math
import sys
import time
from collections.abc import Iterable, Sequence
from pathlib import Path

from pcw_description.errors import PcwError
from pcw_description.recording_writer import RecordingWriter
from pcw_description.robot_description import RobotDescription
from pcw_description.robot_file import load_robot

from .can_file import CanFile, on_udp, read_can_file
from .command_line import end_on_signals
from .drive_set import make_drives
from .errors import CanError
from .frame import Frame
from .frame_log import DecodedStates, FrameDecoder, frames_of_file, write_joint_topics
from .transport import TransmitBufferFull, Transport

SENDERS = ("all", "drives", "computer")
ROOM_WITHIN = 0.5  # that a full transmit buffer is waited for [s]


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
        if action == "replay":
            sub.add_argument("--sent-by", choices=SENDERS, default="all",
                             help="only frames of the drives, or of the computer (default: all)")  # fmt: skip
            sub.add_argument("--yes", action="store_true", help="do not ask before commands go to drives")
    return options


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return the exit code."""
    options = parser().parse_args(arguments)
    end_on_signals()
    try:
        robot = load_robot(options.robot)
        file = read_can_file(options.can_file, robot)
        if options.action == "recording":
            print(make_recording(options.log, robot, file, options.out))
            return 0
        if options.udp_port:
            file = on_udp(file, options.udp_port)
        if options.action == "record":
            print(_record(options.log, file, options.duration))
            return 0
        if options.sent_by != "drives" and not options.yes and not _agreed():
            return 1
        print(_replay(options.log, robot, file, options.sent_by))
    except PcwError as error:
        print(f"can_log: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        return 130
    return 0


def _agreed() -> bool:
    print("Logged commands go to whatever drives are on the buses, which may move. Go on? [y/N] ", end="", flush=True)
    return sys.stdin.readline().strip().lower() in ("y", "yes")


def make_recording(log: Path, robot: RobotDescription, file: CanFile, out: Path) -> str:
    """Make a recording of a log; returns a line on what was written.

    Raises:
        CanError, RecordingError: a log that cannot be read or says nothing of the joints, or a folder that exists.
    """
    from .python_can import read_log

    _look_for_joints(frames_of_file(read_log(log), file), log, FrameDecoder(robot, file), file)
    decoder = FrameDecoder(robot, file)
    with RecordingWriter(out, flush_interval=None) as writer:
        write_joint_topics(writer, robot, decoder, frames_of_file(read_log(log), file))
        counts = dict(writer.counts)
    said = ", ".join(f"{count} {topic.strip('/')}" for topic, count in counts.items())
    return f"{out}: {said}; {decoder.foreign} frames of nobody in {file.name}"


def _look_for_joints(frames: Iterable[tuple[str, Frame, float]], log: Path, decoder: FrameDecoder, file: CanFile) -> None:
    """Refuse a log without one whole set of joints, before a folder is made: it is mostly that of another CAN file."""
    count = 0
    for bus, frame, at in frames:
        count += 1
        if isinstance(decoder.take(bus, frame, at), DecodedStates):
            return
    raise CanError(
        f"log {log} holds no whole set of joints: of {count} frames {decoder.foreign} are of nobody in {file.name}; "
        "allowed: a log that was made with this CAN file"
    )


def _record(log: Path, file: CanFile, duration: float | None) -> str:
    from .python_can import PythonCanTransport

    if duration is not None and not 0.0 < duration < math.inf:
        raise CanError(f"--duration {duration:g} is not allowed; allowed: above 0 s")
    transport = PythonCanTransport(file.buses, log=log)
    end = None if duration is None else time.monotonic() + duration
    print(f"recording {', '.join(transport.received)} to {log}", flush=True)
    try:
        while (end is None or time.monotonic() < end) and not transport.log_problem:
            transport.receive(0.1)
    except KeyboardInterrupt:
        pass  # how a recording ends
    finally:
        transport.close()
    if transport.log_problem:
        raise CanError(f"{log}: {transport.log_problem}; allowed: a disk with room")
    return f"{log}: {', '.join(f'{count} frames of {bus}' for bus, count in transport.received.items())}"


def _replay(log: Path, robot: RobotDescription, file: CanFile, sent_by: str) -> str:
    from .python_can import PythonCanTransport, read_log

    frames = frames_of_file(read_log(log), file)
    spoken = {(drive.joint.bus, i) for drive in make_drives(robot, file) for i in drive.spoken_identifiers}
    beginning = next(frames, None)  # a log that cannot be read is refused before a bus is opened
    transport = PythonCanTransport(file.buses)
    begun, first, count, lost = time.monotonic(), None, 0, 0
    try:
        for bus, frame, at in [] if beginning is None else itertools.chain([beginning], frames):
            first = at if first is None else first
            wait = begun + at - first - time.monotonic()
            if wait > 0.0:
                time.sleep(wait)
            by_drive = (bus, frame.id) in spoken and not frame.remote
            if frame.error or sent_by != "all" and (sent_by == "drives") != by_drive:
                continue
            if _sent(transport, bus, frame):
                count += 1
            else:
                lost += 1
            transport.receive(0.0)  # what comes meanwhile is nobody's here
    finally:
        transport.close()
    return f"{log}: {count} frames sent in {time.monotonic() - begun:.1f} s" + (f", {lost} lost" if lost else "")


def _sent(transport: Transport, bus: str, frame: Frame) -> bool:
    """Send a frame, waiting for room for a while; False if there was none."""
    end = time.monotonic() + ROOM_WITHIN
    while True:
        try:
            transport.send(bus, frame)
            return True
        except TransmitBufferFull:
            if time.monotonic() > end:
                return False
            time.sleep(1e-3)


if __name__ == "__main__":
    sys.exit(main())
