"""`mismatch`: compares recordings with a description and says what the model leaves out.

ros2 run pcw_sim_bridge mismatch analyze RECORDING... --robot ROBOT.yaml --out DIR [--holdout RECORDING...]
python -m pcw_sim_bridge.mismatch analyze ...
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from pcw_description.errors import PcwError


def parser() -> argparse.ArgumentParser:
    """Return the command line."""
    main_parser = argparse.ArgumentParser(prog="mismatch", description="Find what physics a model leaves out of recordings.")
    commands = main_parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    analyze = commands.add_parser(
        "analyze",
        help="analyse recordings of a robot or of a bench axis",
        description="Compare recordings with a description: where do they part, what was left out, how large is it, and does "
        "the patched model follow recordings it has not seen. Exit 0 when it ran, whatever it found; 2 on bad input.",
        epilog="example: mismatch analyze runs/today --robot thesis --out runs/today_report --holdout runs/yesterday",
    )
    analyze.add_argument("recordings", nargs="+", type=Path, metavar="RECORDING", help="rosbag2 folder, .mcap, .db3; "
                         "for a bench axis .csv, .npy, .npz or .mat")
    analyze.add_argument("--robot", required=True, metavar="ROBOT.yaml",
                         help="pcw_robot/1 or pcw_axis/1 description, or the name of a shipped robot")
    analyze.add_argument("--out", required=True, type=Path, metavar="DIR", help="folder for the report; must be new or empty")
    analyze.add_argument("--holdout", nargs="+", type=Path, default=[], metavar="RECORDING",
                         help="recordings to prove the result on; never used to find it")
    analyze.add_argument("--topic", action="append", default=[], metavar="NAME:=TOPIC",
                         help="where a topic of the contract has another name, e.g. joint_states:=/arm/joint_states")
    analyze.add_argument("--seed", type=int, default=0, help="of the surrogates; same seed, same report (default 0)")
    analyze.add_argument("--force", action="store_true", help="replace an earlier report in DIR")
    analyze.add_argument("--quiet", action="store_true", help="no progress on standard error")
    return main_parser


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return the exit code."""
    options = parser().parse_args(arguments)
    try:
        return run_analyze(options)
    except PcwError as error:
        print(f"mismatch: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("mismatch: interrupted; no report was written", file=sys.stderr)
        return 130


def run_analyze(options: argparse.Namespace) -> int:
    """Analyse, write the report, print its path and five lines."""
    # Imported here so that --help and bad input answer at once.
    from .analysis import analyse
    from .errors import MismatchError
    from .load_subject import load_subject
    from .report import check_output, write_report

    topics = {}
    for remap in options.topic:
        name, separator, topic = remap.partition(":=")
        if not separator or not name or not topic:
            raise MismatchError(f"--topic {remap!r} is not allowed; allowed: NAME:=TOPIC")
        topics[name] = topic
    for path in (*options.recordings, *options.holdout):
        if not path.exists():
            raise MismatchError(f"{path}: no such recording")
    check_output(options.out, options.force)
    begun = time.monotonic()

    def progress(message: str) -> None:
        if not options.quiet:
            print(f"[{time.monotonic() - begun:6.1f} s] {message}", file=sys.stderr, flush=True)

    subject = load_subject(options.robot)
    analysis = analyse(subject, options.recordings, options.holdout, topics, options.seed, progress)
    progress("writing the report")
    report = write_report(analysis.findings, analysis.patched.mapping(), options.out, options.force)
    print(report)
    for line in analysis.findings.summary():
        print(line)
    return 0


if __name__ == "__main__":
    sys.exit(main())
