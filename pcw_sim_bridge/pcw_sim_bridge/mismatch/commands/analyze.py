"""`mismatch analyze`: one report from recordings and a description."""

from __future__ import annotations

import argparse
import gc
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..errors import MismatchError

if TYPE_CHECKING:
    from ..report.helper_processes import HelperProcesses


def add_parser(commands: Any) -> None:
    """Add the command line of `analyze`."""
    parser = commands.add_parser(
        "analyze",
        help="analyse recordings of a robot or of a bench axis",
        description="Compare recordings with a description: where do they part, what was left out, how large is it, and does "
        "the patched model follow recordings it has not seen. Exit 0 when it ran, whatever it found; 2 on bad input.",
        epilog="example: mismatch analyze runs/today --robot thesis --out runs/today_report --holdout runs/yesterday",
    )
    parser.add_argument("recordings", nargs="+", type=Path, metavar="RECORDING", help="rosbag2 folder, .mcap, .db3; "
                        "for a bench axis .csv, .npy, .npz or .mat")
    parser.add_argument("--robot", required=True, metavar="ROBOT.yaml",
                        help="pcw_robot/1 or pcw_axis/1 description, or the name of a shipped robot")
    parser.add_argument("--out", required=True, type=Path, metavar="DIR", help="folder for the report; must be new or empty")
    parser.add_argument("--holdout", nargs="+", type=Path, default=[], metavar="RECORDING",
                        help="recordings to prove the result on; never used to find it")
    parser.add_argument("--topic", action="append", default=[], metavar="NAME:=TOPIC",
                        help="where a topic of the contract has another name, e.g. joint_states:=/arm/joint_states")
    parser.add_argument("--seed", type=int, default=0, help="of the surrogates; same seed, same report (default 0)")
    parser.add_argument("--force", action="store_true", help="replace an earlier report in DIR")
    parser.add_argument("--quiet", action="store_true", help="no progress on standard error")
    parser.set_defaults(run=run, interrupted="no report was written")


def remapped_topics(remaps: Sequence[str]) -> dict[str, str]:
    """Return contract topic -> topic of `--topic NAME:=TOPIC` options.

    Raises:
        MismatchError: an option of another form.
    """
    topics = {}
    for remap in remaps:
        name, separator, topic = remap.partition(":=")
        if not separator or not name or not topic:
            raise MismatchError(f"--topic {remap!r} is not allowed; allowed: NAME:=TOPIC")
        topics[name] = topic
    return topics


def run(options: argparse.Namespace) -> int:
    """Analyse, write the report, print its path and five lines."""
    from pcw_description.one_heap import one_heap

    from ..report.helper_processes import HelperProcesses

    one_heap()
    topics = remapped_topics(options.topic)
    for path in (*options.recordings, *options.holdout):
        if not path.exists():
            raise MismatchError(f"{path}: no such recording")
    with HelperProcesses() as helpers:
        helpers.begin((*options.recordings, *options.holdout), options.robot, topics)
        return _analysed(options, topics, helpers)


def _analysed(options: argparse.Namespace, topics: Mapping[str, str], helpers: HelperProcesses) -> int:
    from pcw_description.one_thread import one_thread

    from ..analysis import analyse
    from ..report.report import check_output, write_report
    from ..subjects.load_subject import load_subject

    one_thread()  # the analysis has its own, see `all_cores`: those of linear algebra would take turns with them, and spin
    gc.freeze()  # what has been imported stays; to look through all of it for garbage at the end takes half a second
    check_output(options.out, options.force)
    begun = time.monotonic()

    def progress(message: str) -> None:
        if not options.quiet:
            print(f"[{time.monotonic() - begun:6.1f} s] {message}", file=sys.stderr, flush=True)

    subject = load_subject(options.robot, helpers.open)
    analysis = analyse(subject, options.recordings, options.holdout, topics, options.seed, progress)
    progress("writing the report")
    report = write_report(
        analysis.findings, analysis.patched.mapping(), options.out, options.force, analysis.with_laws, helpers.do
    )
    print(report)
    for line in analysis.findings.summary():
        print(line)
    return 0
