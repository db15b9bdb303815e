"""Random runs of every controller on robots that are not as it believes: is anything unstable?

    python -m pcw_sim_bridge.controller_robustness [--runs 200] [--pybullet-runs 60] [--first 0] [--out FILE]

Every run draws from its seed a robot (six kinds, three to six casters), a controller, headings of the wheels, three twists to
follow, and errors of up to 20 % in every mass, inertia and friction coefficient. The plant has 1 ms of dead time in the
drives. A run is unstable when a number is not finite, when the robot is further than 50 mm/s or 50 mrad/s (or a tenth of what
is wanted) from its twist after 2 s of holding it, or when the torques then vary by more than a tenth of their limits.
"""

from __future__ import annotations

import argparse
import dataclasses
import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from pcw_control.controller_interface import ControllerMeasurement, ForceReference, Reference, TwistReference
from pcw_control.controllers import CONTROLLERS, make_controller
from pcw_description.effect_instance import EffectInstance
from pcw_description.robot_description import Caster, ContactDescription, FloatArray, RobotDescription
from pcw_description.robot_file import load_robot

from .closed_loop import run_closed_loop

SHIPPED = ("thesis", "tidybot2", "xr4000", "dyros_pcv", "flow_base")
RINGS = (3, 5, 6)  # casters of robots that are the thesis robot with its modules on a circle
ERROR = 0.2
DEAD_TIME = 0.001  # [s]
CHANGES = (0.0, 1.0, 2.0)  # when another twist is wanted [s]; the last one is held
DURATION, JUDGED_FROM = 4.5, 4.0  # [s]
SPEED_SHARE = 0.5  # of what the joints' speed limits allow a caster that turns round


@dataclasses.dataclass(frozen=True)
class Outcome:
    """One run.

    Attributes:
        plant, robot, controller: what was drawn, and where.
        casters: how many.
        error: RMS of the twist error at the end, over what is allowed.
        ripple: standard deviation of the torques at the end, over their limits, the largest.
        slip: RMS of the true slip at the end [m/s].
    """

    plant: str
    robot: str
    controller: str
    casters: int
    error: float
    ripple: float
    slip: float

    @property
    def unstable(self) -> bool:
        """Whether the run counts as unstable; a number that is not finite does."""
        return not (self.error <= 1.0 and self.ripple <= 0.1)


def on_a_circle(casters: int) -> RobotDescription:
    """Return the thesis robot with so many of its modules on a circle of 0.32 m."""
    base = load_robot("thesis")
    places = [math.tau * i / casters + 0.3 for i in range(casters)]
    made = tuple(
        dataclasses.replace(
            base.casters[0], name=f"caster_{i}", steer_axis=(0.32 * math.cos(angle), 0.32 * math.sin(angle))
        )
        for i, angle in enumerate(places)
    )
    return dataclasses.replace(base, name=f"ring_{casters}", casters=made)


def as_it_is(robot: RobotDescription, rng: np.random.Generator) -> RobotDescription:
    """Return the robot with errors of up to `ERROR` in masses, inertias and friction, and dead time in its drives."""

    def off() -> float:
        return float(1.0 + rng.uniform(-ERROR, ERROR))

    def module(caster: Caster) -> Caster:
        part = dataclasses.replace(caster.module, inertia_zz=caster.module.inertia_zz * off())
        rotors = dataclasses.replace(caster.rotors, drive=caster.rotors.drive * off(), steer=caster.rotors.steer * off())
        return dataclasses.replace(caster, module=part, rotors=rotors)

    def ground(contact: ContactDescription) -> ContactDescription:
        factor = off()
        lateral = dataclasses.replace(contact.lateral, mu_p=contact.lateral.mu_p * factor)
        return dataclasses.replace(contact, mu_p=contact.mu_p * factor, lateral=lateral)

    chassis = dataclasses.replace(
        robot.chassis, mass=robot.chassis.mass * off(), inertia_zz=robot.chassis.inertia_zz * off()
    )
    changed = dataclasses.replace(robot, chassis=chassis, contact=ground(robot.contact))
    changed = changed.with_casters(robot.caster_names, module)
    dead = tuple(
        EffectInstance("actuator_delay", robot.caster_names, {"delay": DEAD_TIME}, axis) for axis in ("drive", "steer")
    )
    return dataclasses.replace(changed, physics=dead)


def random_run(seed: int, plant: str = "reduced", names: Sequence[str] = tuple(CONTROLLERS)) -> Outcome:
    """Make one run, all of it drawn from the seed."""
    rng = np.random.default_rng([seed, 8])
    kind = int(rng.integers(len(SHIPPED) + len(RINGS)))
    robot = load_robot(SHIPPED[kind]) if kind < len(SHIPPED) else on_a_circle(RINGS[kind - len(SHIPPED)])
    name = names[seed % len(names)]
    uses = CONTROLLERS[name].parameters.uses
    steer_angle = rng.uniform(-math.pi, math.pi, robot.n)
    reach = float(np.max(np.hypot(*robot.steer_axis.T)))
    fastest = SPEED_SHARE * float(np.min(robot.speed_limit[:, 1] * np.abs(robot.caster_offset[:, 0])))
    twists = [np.array([*(0.5 * fastest * rng.uniform(-1.0, 1.0, 2)), 0.4 * fastest / reach * rng.uniform(-1.0, 1.0)])
              for _ in CHANGES]  # fmt: skip
    twists[-1] = twists[-1] * (1.0 if rng.random() < 0.7 else 0.0)  # or to a stop

    def wanted(time: float) -> FloatArray:
        return twists[max(i for i, at in enumerate(CHANGES) if time >= at)]

    def reference(time: float) -> Reference:
        # A force-guided robot is pushed as long as it is pushed, and then left alone.
        return ForceReference(np.zeros(3)) if "external_wrench" in uses else TwistReference(wanted(time))

    cycles = 0

    def measure(measurement: ControllerMeasurement) -> ControllerMeasurement:
        nonlocal cycles
        cycles += 1
        pushed = cycles < CHANGES[-1] * robot.sensors.encoders.rate
        wrench = np.array([15.0, -8.0, 2.0]) if pushed else np.zeros(3)
        return dataclasses.replace(measurement, external_wrench=wrench)

    controller = make_controller(name, robot)
    with np.errstate(all="ignore"):
        run = run_closed_loop(
            as_it_is(robot, rng), controller, reference, DURATION, plant, seed, steer_angle,
            measure=measure if "external_wrench" in uses else None,
        )
    end = run.time >= JUDGED_FROM
    target = np.zeros(3) if "external_wrench" in uses else twists[-1]
    if "external_wrench" in uses:
        target = run.twist[end].mean(axis=0)  # nothing says how soon it stops; it must only not swing
    error = np.sqrt(np.mean((run.twist[end] - target) ** 2, axis=0))
    allowed = np.maximum(0.05, 0.1 * np.abs(target))
    ripple = float(np.max(run.torque[end].std(axis=0) / robot.torque_limit))
    return Outcome(
        plant, robot.name, name, robot.n, float(np.max(error / allowed)), ripple, float(np.sqrt(np.mean(run.slip[end] ** 2)))
    )


def main(arguments: Sequence[str] | None = None) -> int:
    """Make the runs and write the document; exit code 1 where one of them is unstable."""
    parser = argparse.ArgumentParser(prog="controller_robustness", description="Random runs of every controller.")
    parser.add_argument("--runs", type=int, default=200, help="how many (default: %(default)s)")
    parser.add_argument("--first", type=int, default=0, help="first seed (default: %(default)s)")
    parser.add_argument(
        "--pybullet-runs", type=int, default=60, help="how many of these in PyBullet as well (default: %(default)s)"
    )
    parser.add_argument("--out", type=Path, default=Path("pcw_control/docs/controller_robustness.md"), help="file to write")
    options = parser.parse_args(arguments)
    if options.runs < 1:
        parser.error(f"argument --runs: {options.runs} is not allowed; allowed: at least 1")
    outcomes = []
    for plant, runs in (("reduced", options.runs), ("pybullet", min(options.pybullet_runs, options.runs))):
        for seed in range(options.first, options.first + runs):
            outcomes.append(random_run(seed, plant))
            print(seed, outcomes[-1], "UNSTABLE" if outcomes[-1].unstable else "", flush=True)
    lines = [
        "# Random runs of every controller", "",
        f"Written by `python -m pcw_sim_bridge.controller_robustness --runs {options.runs} --pybullet-runs "
        f"{options.pybullet_runs} --first {options.first}`; nothing here is typed in.", "",
        f"Masses, inertias and friction off by up to {ERROR:.0%}, {1e3 * DEAD_TIME:g} ms of dead time, robots of three to six "
        "casters from random headings. Error: of the twist at the end, over what is allowed. Ripple: of the torques at the "
        "end, over their limits. Slip: RMS at the end.", "",
        "| plant | controller | runs | unstable | largest error | largest ripple | slip, median |",
        "|---|---|---|---|---|---|---|",
    ]
    for plant, name in dict.fromkeys((outcome.plant, name) for outcome in outcomes for name in CONTROLLERS):
        of = [outcome for outcome in outcomes if (outcome.plant, outcome.controller) == (plant, name)]
        if of:
            lines.append(
                f"| {plant} | `{name}` | {len(of)} | {sum(o.unstable for o in of)} | {max(o.error for o in of):.2f} | "
                f"{max(o.ripple for o in of):.1%} | {1e3 * float(np.median([o.slip for o in of])):.1f} mm/s |"
            )
    unstable = [outcome for outcome in outcomes if outcome.unstable]
    casters = sorted({outcome.casters for outcome in outcomes})
    lines += ["", f"{len(unstable)} of {len(outcomes)} runs were unstable; robots of {casters} casters.", ""]
    lines += [f"- {outcome}" for outcome in unstable]
    options.out.parent.mkdir(parents=True, exist_ok=True)
    options.out.write_text("\n".join(lines).rstrip() + "\n", encoding="utf-8")
    return 1 if unstable else 0


if __name__ == "__main__":
    raise SystemExit(main())
