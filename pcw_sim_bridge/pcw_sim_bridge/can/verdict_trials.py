"""Whether the analyser says the same of a recording made over CAN and of one made through the bridge.

    python -m pcw_sim_bridge.can.trials verdict --out DIR

Each case is driven twice, with the same robot, motion and seed: once by frames to emulated drives, logged to a file and read
from it again, as `can_log recording` does, and once with the robot of the bridge. Truth and IMU are recorded alike.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from pcw_control.excitation import make_excitation
from pcw_description.robot_file import load_robot

from ..simulate import added_physics
from ..simulated_run import record_run
from .can_file import can_file_from, read_can_file
from .simulated_can_run import record_run_over_can
from .starting_file import starting_content


class Case(NamedTuple):
    """One robot, its drives, how it is logged, and what is wrong with it."""

    robot: str
    protocol: str
    log: str
    physics: str
    duration: float = 30.0


CASES = (
    Case("thesis", "odrive", ".asc", "{name: drive_coulomb_friction, target: [front_left], coulomb: 0.8}"),
    Case("tidybot2", "odrive", ".blf", ""),
    Case("thesis", "cia402", ".log", ""),
    Case("thesis", "cia402", ".blf", "{name: payload_mass, target: [chassis], mass: 15.0}"),
)


def run_verdict(out: Path, seed: int, cases: tuple[Case, ...] = CASES) -> tuple[str, bool]:
    """Analyse recordings over CAN and of the bridge's robot; returns a table and whether they agree."""
    lines, fine = [], True
    for number, case in enumerate(cases):
        says = {way: _verdict(case, way, out / f"{number:02d}_{way}", seed) for way in ("can", "bridge")}
        agree = _gist(says["can"]) == _gist(says["bridge"])
        fine = fine and agree
        lines.append(f"{case.robot}, {case.protocol}, {case.log}: {case.physics or 'healthy'}")
        for way, found in says.items():
            effects = "; ".join(
                f"{e['name']} {' '.join(e['target'])} "
                + ", ".join(f"{key} = {value['value']:.4g}" for key, value in e["parameters"].items())
                for e in found["effects"]
            )
            lines.append(f"    {way:7} {found['verdict']:13} {effects}".rstrip())
        if not agree:
            lines.append("    NOT THE SAME")
        print("\n".join(lines[-3 if agree else -4 :]), flush=True)
    return "\n".join(lines), fine


def _gist(report: Mapping[str, Any]) -> tuple[str, list[tuple[str, ...]]]:
    return report["verdict"], sorted((effect["name"], *effect["target"]) for effect in report["effects"])


def _verdict(case: Case, way: str, path: Path, seed: int) -> dict[str, Any]:
    """Drive, record and analyse one way; returns the report."""
    from ..mismatch.__main__ import main as mismatch

    believed = load_robot(case.robot)
    effects = added_physics(case.physics, believed.caster_names) if case.physics else ()
    robot = dataclasses.replace(believed, physics=effects)
    twist = make_excitation("figure8", believed, case.duration, seed).twist
    if way == "can":
        shipped = case.robot == "thesis"
        file = (read_can_file(f"thesis_{case.protocol}", believed) if shipped
                else can_file_from(starting_content(believed, case.protocol), believed))  # fmt: skip
        path.parent.mkdir(parents=True, exist_ok=True)
        log = path.parent / f"{path.name}_frames{case.log}"
        record_run_over_can(robot, file, twist, case.duration, seed, path, believed, log=log)
    else:
        record_run(robot, twist, case.duration, seed, path, controlled_as=believed)
    report = path.parent / f"{path.name}_report"
    exit_code = mismatch(["analyze", str(path), "--robot", case.robot, "--out", str(report), "--quiet"])
    if exit_code != 0:
        return {"verdict": f"not analysed ({exit_code}, {way})", "effects": []}
    found: dict[str, Any] = json.loads((report / "report.json").read_text(encoding="utf-8"))
    return found
