"""`mismatch suggest`: the manoeuvre that would tell look-alikes apart, as a file that the robot can drive."""

from __future__ import annotations

import argparse
import json
import math
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..errors import MismatchError

if TYPE_CHECKING:
    from pcw_description import RobotDescription
    from pcw_description.effect_instance import EffectInstance

    from ..separating_experiment import Doubt, Outcome, Remedy

MOST_ODDS = 1e6  # above, a number says nothing more
SHOWN = 5  # manoeuvres in the ranking
REMEDY_TRIALS = 3  # manoeuvres tried with each addition to a robot


def add_parser(commands: Any) -> None:
    """Add the command line of `suggest`."""
    parser = commands.add_parser(
        "suggest",
        help="find the manoeuvre that tells look-alikes apart",
        description="Find the manoeuvre that would tell the effects apart that a report calls ambiguous, or two effects, by "
        "driving every excitation in simulation and weighing what it would show; write it as an excitation that `manoeuvre` "
        "and `simulate` take. Exit 0 when it ran, whether there is one or not; 2 on bad input.",
        epilog="example: mismatch suggest --robot thesis --between drive_viscous_friction/front_left drive_coulomb_friction",
    )
    parser.add_argument("report", nargs="?", type=Path, metavar="REPORT_DIR", help="folder that mismatch analyze has written")
    parser.add_argument(
        "--between", nargs=2, metavar=("A", "B"),
        help="two effects instead: NAME, NAME/CASTER, NAME/CASTER+CASTER (default: all casters), or with its size as under "
        "physics: '{name: ..., target: [...], ...}'; without, A is of typical size and B as large as makes it most alike",
    )
    parser.add_argument("--robot", required=True, metavar="ROBOT.yaml", help="description, or the name of a shipped robot")
    parser.add_argument("--out", type=Path, default=Path("excitation.yaml"), metavar="FILE.yaml",
                        help="excitation to write (default excitation.yaml)")
    parser.add_argument("--force", action="store_true", help="replace FILE.yaml")
    parser.add_argument("--quiet", action="store_true", help="no progress on standard error")
    parser.set_defaults(run=run, interrupted="no excitation was written")


def run(options: argparse.Namespace) -> int:
    """Rank the manoeuvres, say what they would give and write the best one."""
    from ..separating_experiment import find_remedy, rank, trial_excitations
    from ..subjects.load_subject import load_subject
    from ..subjects.robot_subject import RobotSubject

    if (options.report is None) == (options.between is None):
        raise MismatchError("REPORT_DIR or --between A B is wanted; allowed: one of them")
    check_file(options.out, options.force)
    subject = load_subject(options.robot)
    if not isinstance(subject, RobotSubject):
        raise MismatchError(f"--robot {options.robot}: is a bench axis; allowed: a robot, which can drive manoeuvres")
    robot = subject.robot
    robot.require_torque_control()
    others: list[EffectInstance] = []
    noise_floor: dict[str, float] = {}
    if options.between is not None:
        doubts = [between(options.between[0], options.between[1], robot)]
    else:
        robot, doubts, others, noise_floor = read_report(options.report, robot)
    if not doubts:
        print("Nothing in this report is ambiguous.")
        return 0
    progress = _progress(options.quiet)
    outcomes = rank(robot, doubts, others, noise_floor, None, progress)
    for line in ranking_text(doubts, outcomes):
        print(line)
    if outcomes[0].separates:
        write_excitation(options.out, doubts, outcomes[0], "")
        print(driving_text(options.out, options.robot))
        return 0
    names = [outcome.excitation for outcome in outcomes[:REMEDY_TRIALS]]
    again = [excitation for excitation in trial_excitations(robot) if excitation.name in names]
    remedy = find_remedy(robot, doubts, others, noise_floor, again, progress)
    if remedy is None:
        print(f"Neither would another sensor or a load on one corner. What the effects ask for: {_asked(doubts)}.")
        return 0
    print(f"With {remedy.words}: {outcome_text(remedy.outcome)}.")
    write_excitation(options.out, doubts, remedy.outcome, f", with {remedy.words}")
    print(driving_text(options.out, str(_write_robot(options.out, remedy, options.force))))
    return 0


def _progress(quiet: bool) -> Callable[[str], None]:
    begun = time.monotonic()

    def progress(message: str) -> None:
        if not quiet:
            print(f"[{time.monotonic() - begun:6.1f} s] {message}", file=sys.stderr, flush=True)

    return progress


def check_file(path: Path, force: bool) -> None:
    """Make sure that a file can be written.

    Raises:
        MismatchError: it is there already, is no .yaml file, or its folder is not there.
    """
    if path.suffix not in (".yaml", ".yml"):
        raise MismatchError(f"--out {path} is not allowed; allowed: a .yaml file")
    if path.exists() and not (force and path.is_file()):
        raise MismatchError(f"--out {path}: exists already; replace it with --force or name another one")
    if not path.resolve().parent.is_dir():
        raise MismatchError(f"--out {path}: there is no folder {path.resolve().parent}")


# -- what is in doubt ------------------------------------------------------------------------------------------------


def between(first: str, second: str, robot: RobotDescription) -> Doubt:
    """Return the doubt between two effects as the command line names them.

    Raises:
        PcwError: an effect that is not allowed.
    """
    from ..separating_experiment import Doubt

    one, _ = read_effect(first, robot)
    other, sized = read_effect(second, robot)
    if (one.name, one.target) == (other.name, other.target):
        raise MismatchError(f"--between {first} {second}: is the same effect twice; allowed: two effects")
    return Doubt(one, other.name, other.target, other.parameters if sized else None)


def read_effect(given: str, robot: RobotDescription) -> tuple[EffectInstance, bool]:
    """Return an effect given as NAME, NAME/TARGET or YAML, and whether its size was given; else it is of typical size."""
    from pcw_description.description_fields import parse_yaml
    from pcw_description.effects.registry import get, read_physics

    if given.lstrip().startswith("{"):
        return read_physics([parse_yaml(given, "--between", given)], robot.caster_names)[0], True
    name, _, target = given.partition("/")
    searched = get(name).searched_parameters
    entry: dict[str, Any] = {"name": name}
    sized = (p for p in get(name).parameters if p.default is None or (p in searched and p.name != "asymmetry"))
    entry |= {p.name: p.typical for p in sized}
    if target:
        entry["target"] = target.split("+")
    return read_physics([entry], robot.caster_names)[0], False


def read_report(
    folder: Path, robot: RobotDescription
) -> tuple[RobotDescription, list[Doubt], list[EffectInstance], dict[str, float]]:
    """Return from a report: the robot with the sensors that were recorded, doubts, other effects, noise by channel.

    Raises:
        MismatchError: no report of a robot is there.
    """
    import dataclasses

    from ..separating_experiment import Doubt

    path = folder / "report.json"
    try:
        report = json.loads(path.read_text(encoding="utf-8"))
        named = [(_instance(effect), effect["ambiguous_with"]) for effect in report["effects"]]
        noise_floor = {channel["name"]: float(channel["noise_floor"]) for channel in report["channels"]}
    except OSError as error:
        raise MismatchError(f"{path}: {error.strerror or error}; allowed: a folder of mismatch analyze") from None
    except (ValueError, KeyError, TypeError):
        raise MismatchError(f"{path}: is no report of mismatch analyze") from None
    if noise_floor and "gyro" not in noise_floor:
        robot = dataclasses.replace(robot, sensors=dataclasses.replace(robot.sensors, imu=None))
    doubts: list[Doubt] = []
    for effect, rivals in named:
        for rival in rivals:
            name, _, target = rival.partition("/")
            doubt = Doubt(effect, name, tuple(target.split("+")) if target else None)
            mirrored = any(d.second == effect.name and d.first.name == name and not target for d in doubts)
            if not mirrored:
                doubts.append(doubt)
    in_doubt = [doubt.first for doubt in doubts]
    return robot, doubts, [effect for effect, _ in named if effect not in in_doubt], noise_floor


def _instance(effect: dict[str, Any]) -> EffectInstance:
    """An effect of report.json, what it does not say at its default."""
    from pcw_description.effect_instance import EffectInstance
    from pcw_description.effects.registry import get

    values = {p.name: float(p.default or 0.0) for p in get(effect["name"]).parameters}
    found = {name: float(parameter["value"]) for name, parameter in effect["parameters"].items()}
    declared = {p.name: p for p in get(effect["name"]).parameters}
    bounded = {name: min(max(v, declared[name].lower), declared[name].upper) for name, v in (values | found).items()}
    return EffectInstance(effect["name"], tuple(effect["target"]), bounded)


# -- what is said and written ----------------------------------------------------------------------------------------


def ranking_text(doubts: Sequence[Doubt], outcomes: Sequence[Outcome]) -> list[str]:
    """Say what every manoeuvre would give, the best first."""
    best = outcomes[0]
    said = [f"To tell {doubt.words()}" for doubt in doubts]
    if best.separates:
        said[-1] += f", drive {outcome_text(best)}."
    else:
        said[-1] += ": no manoeuvre does, with these sensors."
    return said + [f"  {outcome_text(outcome)}" for outcome in outcomes[:SHOWN]]


def outcome_text(outcome: Outcome) -> str:
    """Say how many seconds of a manoeuvre give which odds."""
    if outcome.nats <= 0.0:
        return f"{outcome.excitation}: nothing"
    if not outcome.separates:
        return f"{outcome.duration:g} s of {outcome.excitation}: {odds(outcome.nats)}, and too little in ten minutes"
    nats = outcome.nats * outcome.needed / outcome.duration
    return f"{driven(outcome):g} s of {outcome.excitation}: {odds(nats)}"


def driven(outcome: Outcome) -> float:
    """Length to drive: what is needed, in whole 5 s if it is more than was tried [s]."""
    if outcome.needed <= outcome.duration:
        return outcome.duration
    return 5.0 * math.ceil(outcome.needed / 5.0)


def odds(nats: float) -> str:
    """Say evidence as odds."""
    if nats > math.log(MOST_ODDS):
        return "odds of more than a million to 1"
    ratio = math.exp(nats)
    return f"odds of {ratio:.2g} to 1" if ratio < 100.0 else f"odds of {float(f'{ratio:.1g}'):.0f} to 1"


def write_excitation(path: Path, doubts: Sequence[Doubt], outcome: Outcome, addition: str) -> None:
    """Write the file that `manoeuvre` and `simulate` take.

    Raises:
        MismatchError: it cannot be written.
    """
    import yaml

    from pcw_control.excitation import FORMAT

    purpose = f"tells {'; '.join(doubt.words() for doubt in doubts)}{addition}"
    content = {"format": FORMAT, "name": outcome.excitation, "duration": driven(outcome), "seed": 0, "purpose": purpose}
    try:
        partial = path.with_name(f".{path.name}.partial")
        partial.write_text(yaml.safe_dump(content, sort_keys=False, width=110), encoding="utf-8")
        partial.replace(path)
    except OSError as error:
        raise MismatchError(f"--out {path}: cannot be written: {error.strerror or error}") from error


def _write_robot(excitation: Path, remedy: Remedy, force: bool) -> Path:
    """Write the robot with what was added to it, beside the excitation."""
    from pcw_description.robot_file import save_robot

    path = excitation.with_name(f"{excitation.stem}_robot.yaml")
    check_file(path, force)
    save_robot(remedy.robot, path)
    return path


def driving_text(path: Path, robot: str) -> str:
    """Say how to drive it."""
    return (
        f"{path}: drive it with\n"
        f"  ros2 run pcw_bringup_scripts manoeuvre --ros-args -p manoeuvre:={path} -p robot:={robot}\n"
        f"  ros2 run pcw_sim_bridge simulate --robot {robot} --excite {path} --out BAG    (simulated)\n"
        f"and analyse the recording with\n"
        f"  ros2 run pcw_sim_bridge mismatch analyze BAG --robot {robot} --out DIR"
    )


def _asked(doubts: Sequence[Doubt]) -> str:
    from pcw_description.effects.registry import get

    names = [name for doubt in doubts for name in (doubt.first.name, doubt.second)]
    return "; ".join(dict.fromkeys(get(name).separating_experiment for name in names if get(name).separating_experiment))
