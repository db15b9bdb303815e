"""`simulate`: drives a simulated robot and writes the recording that a real one would have left.

ros2 run pcw_sim_bridge simulate --robot ROBOT --excite figure8 --duration 60 --seed 7 --out BAG
python -m pcw_sim_bridge.simulate ...
"""

from __future__ import annotations

import argparse
import dataclasses
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NoReturn

from pcw_control.excitation import EXCITATIONS, read_excitation
from pcw_description.description_fields import load_yaml_mapping, parse_yaml
from pcw_description.effect_instance import EffectInstance
from pcw_description.effects.registry import effects_text, read_physics
from pcw_description.errors import DescriptionError, PcwError, nearest_name
from pcw_description.robot_file import load_robot
from pcw_description.stop_requests import stop_requests

from .plants.plant import PLANT_NAMES
from .run_controllers import CONTROLLER_NAMES
from .simulated_run import record_run
from .stamping import HEALTHY, StampingParameters

PROGRESS_PERIOD = 0.5  # real time between two looks at the progress [s]


class _OneLineParser(argparse.ArgumentParser):
    """Says what is wrong in one line, without the usage in front."""

    def error(self, message: str) -> NoReturn:
        self.exit(2, f"{self.prog}: {message}\n")


def parser() -> argparse.ArgumentParser:
    """Return the command line."""
    options = _OneLineParser(
        prog="simulate",
        description="Drive a simulated robot along an excitation and record what a real one would have left: a rosbag2 folder "
        "with joint_states, joint_commands, imu/data (where the robot has an IMU), ground_truth/odom and cmd_vel. The same "
        "arguments give the same bytes of data. Exit 0; 2 on bad input, 130 when interrupted, and then there is no folder.",
        epilog="example: simulate --robot thesis --excite figure8 --duration 60 --seed 7 --out runs/figure8 "
        "--physics '{name: drive_coulomb_friction, target: [front_left], coulomb: 0.5}'",
    )
    options.add_argument("--robot", default="thesis", help="robot file, or the name of a shipped robot (default: thesis)")
    options.add_argument("--excite", metavar="NAME", help="excitation, see --list-excitations, or file of mismatch suggest")
    options.add_argument("--duration", type=float, metavar="SECONDS", help="length (default: that of the excitation)")
    options.add_argument("--seed", type=int, default=0, help="of all noise and of what the excitation draws (default: 0)")
    options.add_argument("--out", type=Path, metavar="BAG", help="folder to make; one that exists is left as it is")
    options.add_argument("--plant", default="reduced", metavar="NAME", help=f"{', '.join(PLANT_NAMES)} (default: reduced)")
    options.add_argument(
        "--controller", metavar="NAME",
        help="a controller of pcw_control, or velocity_loops: inverse kinematics and the drives' own velocity loops, a simple "
        "robot; none knows of the robot's physics: effects (default: computed_torque; with the wheels off the ground "
        "velocity_loops, as no twist moves a robot on a jack)",
    )
    options.add_argument(
        "--physics", action="append", default=[], metavar="FILE_OR_YAML",
        help="effects on top of the robot's: a .yaml file with a list physics:, or the list or one effect itself; repeatable",
    )
    options.add_argument(
        "--stamp-jitter", type=float, metavar="SECONDS",
        help=f"standard deviation of the stamps (default: {HEALTHY.stamp_jitter:g})",
    )
    options.add_argument(
        "--loss", type=float, metavar="FRACTION", help=f"of the messages, lost in short bursts (default: {HEALTHY.loss:g})"
    )
    options.add_argument("--ideal", action="store_true", help="exact stamps and no losses; the sensors keep their noise")
    options.add_argument("--list-effects", action="store_true", help="print what --physics knows")
    options.add_argument("--list-excitations", action="store_true", help="print what --excite knows")
    return options


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return the exit code."""
    command_line = parser()
    options = command_line.parse_args(arguments)
    if options.list_effects or options.list_excitations:
        print("\n\n".join([effects_text()] * options.list_effects + [excitations_text()] * options.list_excitations))
        return 0
    _check(command_line, options)
    try:
        with stop_requests() as stops:
            run(options, stops)
    except PcwError as error:
        print(f"simulate: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("simulate: interrupted; no recording was written", file=sys.stderr)
        return 130
    return 0


def _check(command_line: argparse.ArgumentParser, options: argparse.Namespace) -> None:
    """End with exit code 2 and one line on what no one else checks."""
    if options.excite is None:
        command_line.error(f"--excite is missing; allowed: {', '.join(EXCITATIONS)}")
    if options.out is None:
        command_line.error("--out is missing; allowed: a folder that does not exist")
    if options.out.exists():
        command_line.error(f"--out {options.out}: exists already and is left as it is; allowed: a new folder")
    if options.seed < 0:
        command_line.error(f"--seed {options.seed} is not allowed; allowed: 0 and above")
    for name, known in (("plant", PLANT_NAMES), ("controller", CONTROLLER_NAMES)):
        value = getattr(options, name)
        if value not in (None, *known):
            command_line.error(f"--{name} {value!r} is not allowed; {nearest_name(value, known)}")
    if options.ideal and (options.stamp_jitter, options.loss) != (None, None):
        command_line.error("--ideal with --stamp-jitter or --loss is not allowed; allowed: one or the other")


def run(options: argparse.Namespace, stops: Sequence[float]) -> None:
    """Simulate, and print a line on what was written.

    Args:
        options: of the command line.
        stops: the run ends when this is no longer empty.

    Raises:
        PcwError: an option that is not allowed, or a run that cannot be done; names the field, its value and what is.
        KeyboardInterrupt: it was stopped; nothing is left of the recording.
    """
    nominal = load_robot(options.robot)
    added = [effect for given in options.physics for effect in added_physics(given, nominal.caster_names)]
    robot = dataclasses.replace(nominal, physics=(*nominal.physics, *added))
    believed = dataclasses.replace(nominal, physics=())
    excitation = read_excitation(options.excite, believed, options.duration, options.seed)
    controller = options.controller or ("velocity_loops" if excitation.lifted else "computed_torque")
    if excitation.lifted and controller != "velocity_loops":
        raise DescriptionError("controller", controller, f"allowed: velocity_loops with {options.excite}, off the ground")
    if options.ideal:
        stamping = StampingParameters()
    else:
        stamping = StampingParameters(
            HEALTHY.stamp_jitter if options.stamp_jitter is None else options.stamp_jitter,
            HEALTHY.loss if options.loss is None else options.loss,
        )
    begun = time.monotonic()
    progress = _Progress(excitation.duration, stops)
    try:
        counts = record_run(
            robot, excitation.twist, excitation.duration, options.seed, options.out, options.plant,
            controlled_as=believed, controller_name=controller, stamping=stamping, lifted=excitation.lifted,
            progress=progress,
        )
    finally:
        progress.wipe()
    print(_said(options.out, excitation.duration, counts, time.monotonic() - begun))


def _said(path: Path, duration: float, counts: Mapping[str, int], seconds: float) -> str:
    speed = f"{duration / seconds:.3g} times as fast as real time"
    return f"{path}: {duration:g} s, {sum(counts.values())} messages on {len(counts)} topics; {speed}"


def added_physics(given: str, caster_names: Sequence[str]) -> tuple[EffectInstance, ...]:
    """Return the effects of one --physics: a .yaml file with a list `physics:`, or YAML itself, a list or one effect.

    Raises:
        DescriptionError: as for `physics:` in a robot file; names the field, its value and what is allowed.
    """
    if given.endswith((".yaml", ".yml")):
        content = load_yaml_mapping(given)
        if "physics" not in content:
            raise DescriptionError("physics", None, f"allowed: a list of effects in {given}")
        entries: object = content["physics"]
    else:
        entries = parse_yaml(given, "physics", given)
    return read_physics([entries] if isinstance(entries, Mapping) else entries, caster_names)


def excitations_text() -> str:
    """Return all excitations: name, length and sentence."""
    width = max(map(len, EXCITATIONS))
    return "\n".join(f"{name:{width}} {plan.duration:3g} s  {plan.summary}" for name, plan in EXCITATIONS.items())


class _Progress:
    """Ends a run that is to stop, and on a terminal rewrites one line on standard error, in real time."""

    def __init__(self, duration: float, stops: Sequence[float]) -> None:
        self._duration, self._stops = duration, stops
        self._tells, self._told, self._width = sys.stderr.isatty(), time.monotonic(), 0

    def __call__(self, simulated: float) -> None:
        if self._stops:
            raise KeyboardInterrupt
        now = time.monotonic()
        if not self._tells or now - self._told < PROGRESS_PERIOD:
            return
        self._told = now
        line = f"simulate: {simulated:.1f} of {self._duration:g} s"
        self._width = max(self._width, len(line))
        print(f"\r{line:{self._width}}", end="", file=sys.stderr, flush=True)

    def wipe(self) -> None:
        """Leave an empty line."""
        if self._width:
            print(f"\r{'':{self._width}}\r", end="", file=sys.stderr, flush=True)


if __name__ == "__main__":
    sys.exit(main())
