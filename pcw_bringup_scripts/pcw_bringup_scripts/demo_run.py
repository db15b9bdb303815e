"""The demonstration: a simulated robot with a concealed defect drives, is recorded and is analysed.

A caster and a size of Coulomb friction in its drive are drawn from the seed. Only the simulator is told. The nodes of the
robot run as processes of their own over DDS (--composed: as one); two recordings of different manoeuvres are made; the
analyser gets the recordings and the nominal robot file, and says what the model left out. At the end the concealed truth
is revealed and compared.

Exit code: 0 if the analyser found what was concealed, 1 if not, 2 if something could not be done, 130 after Ctrl-C.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
import random
import secrets
import shutil
import signal
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pcw_control import (
    ComputedTorque,
    ControllerMeasurement,
    TorqueLimits,
    TwistReference,
    limit_torque,
)
from pcw_control.excitation import SHORTEST
from pcw_description import AugmentedObjectModel, RobotDescription, load_robot, odometry, save_robot
from pcw_description.effect_instance import EffectInstance
from pcw_description.errors import PcwError
from pcw_estimation import FaultIsolation, SlipConsensus
from pcw_sim_bridge.plants.factory import make_plant

from .supervised_processes import Child, Children, ProcessError

EFFECT = "drive_coulomb_friction"
# Of the drive's torque limit: from what is hard to see in a drive's noise to what anybody would hear.
FRICTION_RANGE = (0.02, 0.08)
# The hold-out recording may be shorter: it only tests.
HOLDOUT_SHARE = 0.6
RECORDED = (
    "cmd_vel", "joint_commands", "joint_states", "imu/data", "odom", "ground_truth/odom", "slip/encoder", "/diagnostics",
)
ANALYSIS_DEADLINE = 600.0  # [s]
LONGEST_LINE = 150  # characters of its progress that are shown


@dataclasses.dataclass(frozen=True)
class Concealed:
    """What only the simulator is told.

    Attributes:
        seed: where it comes from.
        caster: name of the caster with friction in its drive.
        coulomb: size of the friction [N m].
    """

    seed: int
    caster: str
    coulomb: float

    @classmethod
    def drawn(cls, robot: RobotDescription, seed: int) -> Concealed:
        """Draw a caster and a size; rounded, so that the number printed is the number used."""
        source = random.Random(seed)
        index = source.randrange(robot.n)
        fraction = FRICTION_RANGE[0] * (FRICTION_RANGE[1] / FRICTION_RANGE[0]) ** source.random()
        coulomb = float(f"{fraction * robot.torque_limit[index, 0]:.3g}")
        return cls(seed, robot.caster_names[index], coulomb)

    def robot(self, nominal: RobotDescription) -> RobotDescription:
        """Return the robot as it really is."""
        effect = EffectInstance(EFFECT, (self.caster,), {"coulomb": self.coulomb})
        return dataclasses.replace(nominal, physics=(*nominal.physics, effect))

    def __str__(self) -> str:
        return f"{EFFECT} of {self.coulomb:g} N m on {self.caster} (seed {self.seed})"


def say(text: str) -> None:
    """Tell the progress."""
    print(f"[demo] {text}", file=sys.stderr, flush=True)


def parse_arguments(args: Sequence[str] | None) -> argparse.Namespace:
    """Read the command line; exits with 2 and one line on bad input."""
    summary, _, rest = (__doc__ or "").partition("\n\n")
    parser = argparse.ArgumentParser(
        prog="demo_run", description=summary, epilog=rest, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, help="folder to make for everything (default: ./pcw_demo_<time>)")
    parser.add_argument("--seed", type=int, help="draws the concealed defect (default: random, revealed at the end)")
    parser.add_argument("--duration", type=float, default=40.0, help="length of the manoeuvre, simulated [s] (default: 40)")
    parser.add_argument("--plant", choices=("pybullet", "reduced"), default="pybullet", help="simulator (default: pybullet)")
    parser.add_argument("--robot", default="thesis", help="robot file, or the name of a shipped robot (default: thesis)")
    parser.add_argument("--composed", action="store_true", help="run the robot's nodes in one process")
    arguments = parser.parse_args(args)
    if not SHORTEST / HOLDOUT_SHARE <= arguments.duration <= 3600.0:
        parser.error(f"--duration {arguments.duration:g}: allowed: {SHORTEST / HOLDOUT_SHARE:.3g} to 3600 s")
    if arguments.seed is not None and arguments.seed < 0:
        parser.error(f"--seed {arguments.seed}: allowed: 0 and above")
    if arguments.out is None:
        arguments.out = Path(time.strftime("pcw_demo_%Y%m%d_%H%M%S"))
    if arguments.out.exists():
        parser.error(f"--out {arguments.out}: exists already; allowed: a new folder")
    return arguments


def compile_inner_loops(nominal: RobotDescription, plant_name: str) -> None:
    """Call once what the nodes will call: compiled code is cached on disk, and four nodes would compile it four times."""
    at_rest, steer_angle = np.zeros((nominal.n, 2)), np.zeros(nominal.n)
    plant = make_plant(plant_name, nominal)
    plant.step(at_rest)
    plant.close()
    state, _ = odometry.update(nominal, odometry.OdometryParameters(), odometry.initial_state(), at_rest, 1.0)
    odometry.update(nominal, odometry.OdometryParameters(), state, at_rest, 1.0)
    detector = SlipConsensus(nominal)
    _, finding = detector.step(detector.initial_state(), at_rest, at_rest, 0.0)
    FaultIsolation(nominal).update(at_rest, at_rest, finding, 0.001, at_rest, at_rest)
    measurement = ControllerMeasurement(at_rest, at_rest, np.zeros(3))
    controller = ComputedTorque(nominal)
    controller.step(controller.initial_state(), measurement, TwistReference(np.zeros(3)), 1.0)
    limit_torque(TorqueLimits.of_robot(nominal), at_rest, at_rest, at_rest, 1.0)
    AugmentedObjectModel(nominal).evaluate(steer_angle, np.zeros(3))


def environment() -> dict[str, str]:
    """The environment of the children: a ROS domain of our own on this machine only, one thread for each of them."""
    own = dict(os.environ)
    for name in ("ROS_STATIC_PEERS", "ROS_LOCALHOST_ONLY"):
        own.pop(name, None)
    own |= {
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST", "ROS_DOMAIN_ID": str(1 + os.getpid() % 101),
        "RCUTILS_COLORIZED_OUTPUT": "0", "PYTHONUNBUFFERED": "1",
        # Small matrices only: threads of a linear-algebra library would fight for the cores the nodes need.
        "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1",
    }
    return own


def commands(
    recording: Path, robot: Path, true_robot: Path, plant: str, seed: int, composed: bool
) -> list[tuple[str, list[str]]]:
    """Return name and command of each process of the robot."""
    nominal = {"robot": str(robot)}
    parameters: dict[str, dict[str, Any]] = {
        "bridge": {
            "robot": str(true_robot), "plant": plant, "seed": seed, "lockstep": True, "real_time_factor": 0.0,
            "start_paused": True, "lockstep_timeout": 10.0,
        },
        # Simulated time runs faster than real time, so time-outs that are right for a robot are too short here.
        "computed_torque": {
            **nominal, "cmd_vel_timeout": 2.0, "joint_states_timeout": 20.0, "cmd_vel_acceleration": 1.0,
            "cmd_vel_yaw_acceleration": 3.0,
        },
        "odometry": nominal,
        "encoder_slip": nominal,
        # What a real robot would leave behind, and the pose: contact forces and /clock stay with the simulator.
        "recorder": {"output": str(recording), "topics": list(RECORDED)},
    }
    modules = {
        "bridge": "pcw_sim_bridge.nodes.bridge", "computed_torque": "pcw_control.nodes.computed_torque",
        "odometry": "pcw_estimation.nodes.odometry", "encoder_slip": "pcw_estimation.nodes.encoder_slip",
        "recorder": "pcw_sim_bridge.nodes.recorder",
    }
    python = [sys.executable, "-m"]
    if not composed:
        return [
            (name, [*python, modules[name], "--ros-args", *_parameter_arguments(values)])
            for name, values in parameters.items()
        ]
    arguments = [argument for name, values in parameters.items() for argument in _parameter_arguments(values, f"{name}:")]
    return [("compose", [*python, "pcw_bringup_scripts.compose", *parameters, "--ros-args", *arguments])]


def _parameter_arguments(values: dict[str, Any], prefix: str = "") -> list[str]:
    arguments = []
    for name, value in values.items():
        text = str(value).lower() if isinstance(value, bool) else json.dumps(value)
        arguments += ["-p", f"{prefix}{name}:={text}"]
    return arguments


def record(name: str, duration: float, out: Path, robot_commands: Sequence[tuple[str, list[str]]]) -> float:
    """Drive and record one manoeuvre; returns the real time that it took [s]."""
    logs = out / "logs" / name
    logs.mkdir(parents=True)
    begun = time.monotonic()
    with Children(logs, environment()) as children:
        for node, command in robot_commands:
            children.start(node, command)
        manoeuvre = children.start(
            "manoeuvre",
            [
                sys.executable, "-m", "pcw_bringup_scripts.nodes.manoeuvre", "--ros-args",
                *_parameter_arguments(
                    {
                        "manoeuvre": name, "robot": str(out / "robot.yaml"), "duration": duration,
                        "wait_for": ["computed_torque", "odometry", "encoder_slip", "recorder"],
                    }
                ),
            ],
        )
        _follow(name, children, manoeuvre, deadline=120.0 + 20.0 * duration)
    return time.monotonic() - begun


def _follow(name: str, children: Children, manoeuvre: Child, deadline: float) -> None:
    """Wait for the end of the manoeuvre and say how far it is."""
    begun, told = time.monotonic(), ""
    while manoeuvre.process.poll() is None:
        children.check()
        if time.monotonic() - begun > deadline:
            raise ProcessError(f"{name} is not driven after {deadline:g} s; {manoeuvre.log}:\n{manoeuvre.last_lines()}")
        progress = [line.partition("progress ")[2] for line in manoeuvre.last_lines(3).splitlines() if "progress " in line]
        if progress and progress[-1] != told:
            told = progress[-1]
            say(f"{name}: {told}")
        time.sleep(0.1)
    children.check()


def analyse(out: Path, robot: Path, recording: Path, holdout: Path) -> dict[str, Any]:
    """Run the analyser as anybody would and return its report."""
    report = out / "report"
    with Children(out / "logs", environment()) as children:
        analyser = children.start(
            "mismatch",
            [
                sys.executable, "-m", "pcw_sim_bridge.mismatch", "analyze", str(recording), "--robot", str(robot),
                "--out", str(report), "--holdout", str(holdout),
            ],
        )
        begun, told = time.monotonic(), 0
        while (code := analyser.process.poll()) is None:
            if time.monotonic() - begun > ANALYSIS_DEADLINE:
                raise ProcessError(f"the analyser still runs after {ANALYSIS_DEADLINE:g} s ({analyser.log})")
            lines = [line for line in analyser.log.read_text(errors="replace").splitlines() if line.startswith("[")]
            for line in lines[told:]:
                say(f"analysis: {line[:LONGEST_LINE]}")
            told = len(lines)
            time.sleep(0.2)
        if code != 0:
            raise ProcessError(f"the analyser ended with code {code} ({analyser.log}):\n{analyser.last_lines()}")
    content: dict[str, Any] = json.loads((report / "report.json").read_text(encoding="utf-8"))
    return content


def judge(report: dict[str, Any], concealed: Concealed) -> tuple[bool, str]:
    """Return whether the report names the concealed effect, there and nothing else, and one line that says so."""
    named = [f"{e['name']} on {' and '.join(e['target'])}{_size(e)}" for e in report.get("effects", [])]
    found = [e for e in report.get("effects", []) if e["name"] == EFFECT and list(e["target"]) == [concealed.caster]]
    if not found:
        return False, f"Found:      {'; '.join(named) or 'nothing'}: NOT what was concealed"
    line = f"Found:      {EFFECT} on {concealed.caster}{_size(found[0])}: as concealed"
    others = len(named) - 1
    if others:
        return False, f"{line}, but with {others} more that is not there: {'; '.join(named)}"
    return True, line


def _size(effect: dict[str, Any]) -> str:
    value = effect.get("parameters", {}).get("coulomb")
    if value is None:
        return ""
    low, high = value["ci95"]
    return f", {value['value']:.3g} {value['unit']} (95 %: {low:.3g} to {high:.3g})"


def summary(report: dict[str, Any], concealed: Concealed, recorded: str) -> tuple[bool, list[str]]:
    """Return whether the truth was found, and five lines."""
    found, line = judge(report, concealed)
    statements = [effect["statement"] for effect in report.get("effects", [])]
    holdout = report.get("fit", {}).get("holdout", {})
    nrmse, gap = holdout.get("inverse_nrmse"), holdout.get("gap_closed")
    held = f"torque error {nrmse[0]:.3g} -> {nrmse[1]:.3g}" if nrmse else "not evaluated"
    if gap is not None:
        held += f", {100 * gap:.0f} % of the gap closed"
    return found, [
        f"Recorded:   {recorded}",
        f"Verdict:    {report['verdict']}" + (f": {' '.join(statements)}" if statements else ""),
        f"Held out:   {held}",
        f"Concealed:  {concealed}",
        line,
    ]


def run(arguments: argparse.Namespace) -> int:
    """Run the demonstration."""
    begun = time.monotonic()
    nominal = load_robot(arguments.robot)
    nominal.require_torque_control()
    seed = arguments.seed if arguments.seed is not None else secrets.randbelow(1_000_000)
    concealed = Concealed.drawn(nominal, seed)
    out: Path = arguments.out.resolve()
    out.mkdir(parents=True)
    robot = out / "robot.yaml"
    save_robot(nominal, robot)
    say(f"everything goes to {out}")
    compiling = time.monotonic()
    say("compiling what is not compiled yet")
    compile_inner_loops(nominal, arguments.plant)
    say(f"compiled in {time.monotonic() - compiling:.1f} s")
    durations = {"identification": arguments.duration, "holdout": HOLDOUT_SHARE * arguments.duration}
    wall = 0.0
    # Until the analysis is done, the truth is in a folder that only the simulator is told.
    with tempfile.TemporaryDirectory(prefix="pcw_demo_") as private:
        true_robot = Path(private) / "robot.yaml"
        save_robot(concealed.robot(nominal), true_robot)
        for number, (name, duration) in enumerate(durations.items()):
            way = "in one process" if arguments.composed else "as five processes over DDS"
            say(f"{name}: driving {nominal.name} for {duration:g} s ({arguments.plant}), its nodes {way}")
            recording = out / name
            wall += record(
                name, duration, out,
                commands(recording, robot, true_robot, arguments.plant, 2 * seed % 2**30 + number, arguments.composed),
            )
        say("analysing the recordings")
        report = analyse(out, robot, out / "identification", out / "holdout")
        shutil.copy(true_robot, out / "robot_with_the_concealed_defect.yaml")
    recorded = (
        f"{durations['identification']:g} s and {durations['holdout']:g} s ({arguments.plant}) in {wall:.0f} s; "
        f"with the analysis {time.monotonic() - begun:.0f} s"
    )
    found, lines = summary(report, concealed, recorded)
    print(f"Report:     {out / 'report' / 'report.html'}")
    print("\n".join(lines), flush=True)
    return 0 if found else 1


def main(args: Sequence[str] | None = None) -> int:
    """Entry point."""
    arguments = parse_arguments(args)
    # A terminated demonstration ends its children as an interrupted one does, also where a shell started it with SIGINT
    # ignored.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.signal(signal.SIGTERM, lambda *_: signal.raise_signal(signal.SIGINT))
    try:
        return run(arguments)
    except KeyboardInterrupt:
        say("interrupted; every process that was started has ended")
        return 130
    except PcwError as error:
        print(f"demo_run: {error}", file=sys.stderr)
        return 2
    except OSError as error:  # no folder can be made there, or the disk is full
        print(f"demo_run: --out {arguments.out}: {error}", file=sys.stderr)
        return 2


if __name__ == "__main__":
    raise SystemExit(main())
