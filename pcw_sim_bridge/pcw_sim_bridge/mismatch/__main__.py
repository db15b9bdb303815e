"""`mismatch`: compares recordings with a description and says what the model leaves out.

ros2 run pcw_sim_bridge mismatch analyze RECORDING... --robot ROBOT.yaml --out DIR [--holdout RECORDING...]
python -m pcw_sim_bridge.mismatch analyze ...
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence

from pcw_description.errors import PcwError
from pcw_description.stop_requests import interrupts

from .commands import analyze, challenge, fleet, suggest

COMMANDS = (analyze, challenge, fleet, suggest)


def parser() -> argparse.ArgumentParser:
    """Return the command line."""
    main_parser = argparse.ArgumentParser(prog="mismatch", description="Find what physics a model leaves out of recordings.")
    commands = main_parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for command in COMMANDS:
        command.add_parser(commands)
    return main_parser


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return the exit code."""
    options = parser().parse_args(arguments)
    try:
        # A terminated run leaves no workers and no half of a report, as an interrupted one; a shell may have SIGINT ignored.
        with interrupts():
            return int(options.run(options))
    except PcwError as error:
        print(f"mismatch: {error}", file=sys.stderr)
        return 2
    except (KeyboardInterrupt, SystemError) as error:
        if not _interrupted(error):
            raise
        # What was cut off while it was made cannot be taken down in order, which is of no interest any more.
        sys.unraisablehook = lambda _: None
        print(f"mismatch: interrupted; {options.interrupted}", file=sys.stderr)
        return 130


def _interrupted(error: BaseException | None) -> bool:
    """Whether an error is Ctrl-C; one that falls into compiled code comes out as a SystemError with Ctrl-C as its cause."""
    while error is not None and not isinstance(error, KeyboardInterrupt):
        error = error.__cause__
    return error is not None


if __name__ == "__main__":
    sys.exit(main())
