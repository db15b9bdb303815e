"""Checks robot descriptions, and prints what the format pcw_robot/1 holds; both come from the same declarations."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterable, Sequence

from .description_fields import document
from .effects.registry import effects_text
from .errors import PcwError
from .robot_description import DEFAULT_TOLERANCES, RobotDescription
from .robot_file import load_robot, shipped_robots

CASTER_DEFAULTS = (
    "caster_defaults", "", "optional", "what all casters share, with the keys of a caster; each caster overrides it",
)


def keys_table() -> str:
    """Return the keys of pcw_robot/1 as a Markdown table, in the order of a file."""
    rows: list[Sequence[str]] = []
    for row in document(RobotDescription):
        if row[0] == "casters":
            rows.append(CASTER_DEFAULTS)
        rows.append(row)
    return _table(("key", "unit", "allowed", "meaning"), rows)


def tolerances_table() -> str:
    """Return the names under `tolerances:` with their defaults as a Markdown table."""
    return _table(("tolerance", "default"), [(name, str(value)) for name, value in DEFAULT_TOLERANCES.items()])


def _table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join("| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |" for line in lines)


def check(robots: Sequence[str]) -> int:
    """Print one line per robot, OK or the error; return 0, or 2 where one is not valid."""
    exit_code = 0
    for name in robots:
        try:
            robot = load_robot(name)
        except PcwError as error:
            print(error, file=sys.stderr)
            exit_code = 2
            continue
        remark = ""
        try:
            robot.require_torque_control()
        except PcwError:
            remark = f"; for kinematics and analysis only ({'fixed wheels' if robot.fixed_wheels else 'b_x = 0'})"
        wheels = f"{robot.n} caster{'s' if robot.n > 1 else ''}"
        if robot.fixed_wheels:
            wheels += f", {len(robot.fixed_wheels)} fixed wheel{'s' if len(robot.fixed_wheels) > 1 else ''}"
        print(f"{name}: OK ({wheels}, {robot.total_mass:g} kg{remark})")
    return exit_code


def main(arguments: Sequence[str] | None = None) -> int:
    """Check robot descriptions or print the format; exit 0, or 2 for a description that is not valid."""
    parser = argparse.ArgumentParser(prog="validate", description="Check robot descriptions (format pcw_robot/1).")
    parser.add_argument("robots", nargs="*", metavar="ROBOT", help=f"a .yaml file, or one of: {', '.join(shipped_robots())}")
    parser.add_argument("--keys", action="store_true", help="print the keys of the format and the default tolerances")
    parser.add_argument("--effects", action="store_true", help="print the effects known under physics:")
    options = parser.parse_args(arguments)
    if not (options.robots or options.keys or options.effects):
        parser.error("nothing to do: name a robot, or use --keys or --effects")
    tables = [keys_table(), tolerances_table()] if options.keys else []
    tables += [effects_text()] if options.effects else []
    if tables:
        print("\n\n".join(tables))
    return check(options.robots)


if __name__ == "__main__":
    sys.exit(main())
