"""Clocks that are ahead by more than first orders tell of: found, however far, and nothing beside them."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest

from pcw_description import load_robot
from pcw_description.effects.registry import read_physics
from pcw_description.recording import Recording
from pcw_sim_bridge.mismatch.__main__ import main
from pcw_sim_bridge.mismatch.robot.clock_leads import FIRST_ORDER, clock_leads
from pcw_sim_bridge.mismatch.robot.robot_channels import RobotProblemBuilder, wheels_slide
from pcw_sim_bridge.mismatch.subjects.robot_subject import RobotSubject
from pcw_sim_bridge.simulate import main as simulate
from pcw_sim_bridge.simulated_run import record_run

THESIS = load_robot("thesis")


def wandering(time: float) -> np.ndarray:
    """Return a twist that moves all three axes at speeds of no common period."""
    return min(time, 1.0) * np.array([0.5 * np.sin(1.3 * time), 0.4 * np.sin(0.9 * time + 1.0), 0.7 * np.sin(0.7 * time)])


def recorded(path: Path, inertial: float, tracked: float, seed: int, duration: float, *more: dict[str, object]) -> Path:
    """Record the thesis robot with an IMU and a tracker whose stamps are so far ahead [s]."""
    clocks = {"name": "clock_offset", "target": ["clock"], "offset": inertial, "tracker_offset": tracked}
    true = dataclasses.replace(THESIS, physics=read_physics([clocks, *more], THESIS.caster_names))
    record_run(true, wandering, duration, seed, path, controlled_as=THESIS)
    return path


@pytest.mark.parametrize(("inertial", "tracked"), [
    (-0.3, 0.4),
    (0.0, 0.0),
    pytest.param(0.15, 0.0, marks=pytest.mark.nightly),
    pytest.param(0.004, 0.0, marks=pytest.mark.nightly),
])
def test_leads_are_found_where_first_orders_say_nothing_of_them(tmp_path: Path, inertial: float, tracked: float) -> None:
    """To within the steps of the motion; what first orders tell is left to them."""
    recording = Recording.open(recorded(tmp_path / "run", inertial, tracked, 3, 16.0), THESIS)
    builder = RobotProblemBuilder(THESIS, [recording])
    leads = clock_leads(builder.motions, builder.numbers, [np.zeros(len(m.time), dtype=bool) for m in builder.motions])
    least = FIRST_ORDER / max(motion.cutoff for motion in builder.motions)
    wanted = [lead if abs(lead) > least else 0.0 for lead in (inertial, tracked)]
    assert 0.01 < least < 0.1
    assert leads == pytest.approx(wanted, abs=0.015)
    assert [lead == 0.0 for lead in leads] == [lead == 0.0 for lead in wanted]


@pytest.mark.parametrize("late", [0.06, 0.0])
def test_a_slow_and_coarse_tracker_is_found_late(tmp_path: Path, late: float) -> None:
    """The velocity of a camera is mostly noise: 60 ms came out at 2 to 20 ms, with intervals of a few."""
    recording = Recording.open(recorded(tmp_path / "run", 0.0, 0.0, 4, 30.0), THESIS)
    truth = recording.ground_truth
    assert truth is not None
    rng = np.random.default_rng(5)
    pose = truth.pose[::3] + np.array([2e-3, 2e-3, 4e-3]) * rng.standard_normal((len(truth.pose[::3]), 3))
    stamp = truth.stamp[::3] + late + 2e-3 * rng.standard_normal(len(pose))
    recording.ground_truth = dataclasses.replace(
        truth, **{f.name: getattr(truth, f.name)[::3] for f in dataclasses.fields(truth) if f.name not in ("stamp", "pose")},
        stamp=stamp, pose=pose,
    )  # fmt: skip
    builder = RobotProblemBuilder(THESIS, [recording])
    leads = clock_leads(builder.motions, builder.numbers, [np.zeros(len(m.time), dtype=bool) for m in builder.motions])
    assert leads == pytest.approx([0.0, late], abs=0.015)


def test_what_the_fitted_recordings_say_of_the_clocks_holds_for_held_out_ones(tmp_path: Path) -> None:
    """Too slow a motion to show it was taken to have no lead, and its columns, all noise, spoke against it."""
    subject = RobotSubject(THESIS)
    fit, other = (
        [subject.open(recorded(tmp_path / name, 0.0, lead, seed, 16.0), role, {})]
        for name, lead, seed, role in (("fit", 0.3, 6, "fit"), ("other", 0.0, 7, "holdout"))
    )
    subject.problem(fit)
    held_out = subject.problem_with(other)(["clock_offset/clock"])
    (clock,) = (term for term in held_out.terms if term.effect == "clock_offset")
    assert clock.is_exact


def test_a_robot_behind_wheels_that_spin_has_no_late_tracker(tmp_path: Path) -> None:
    """Its velocity loops ask for steps: the wheels are there at once, and the robot comes after as friction lets it."""
    path = tmp_path / "run"
    steps = ["--excite", "steps", "--duration", "20", "--controller", "velocity_loops", "--seed", "1"]
    assert simulate(["--robot", "xr4000", *steps, "--out", str(path)]) == 0
    xr4000 = load_robot("xr4000")
    builder = RobotProblemBuilder(xr4000, [Recording.open(path, xr4000)])
    slides = [wheels_slide(builder.numbers, motion, builder.layout) for motion in builder.motions]
    assert clock_leads(builder.motions, builder.numbers, [np.zeros_like(rows) for rows in slides])[1] > 0.02
    assert not clock_leads(builder.motions, builder.numbers, slides).any()


@pytest.mark.nightly  # a whole analysis, like that of others here
@pytest.mark.parametrize(
    ("inertial", "tracked", "more"),
    [
        (0.15, 0.0, ()),
        (0.0, -0.2, ({"name": "drive_coulomb_friction", "target": ["front_left"], "coulomb": 0.5},)),
    ],
)
def test_a_clock_far_off_is_named_with_its_lead_and_explains_all(
    tmp_path: Path, inertial: float, tracked: float, more: tuple[dict[str, object], ...]
) -> None:
    """By first orders it came out at two thirds of that, and what they leave was an unknown by a wheel's torque."""
    fit = recorded(tmp_path / "fit", inertial, tracked, 1, 25.0, *more)
    other = recorded(tmp_path / "other", inertial, tracked, 2, 12.0, *more)
    out = tmp_path / "report"
    assert main(["analyze", str(fit), "--robot", "thesis", "--holdout", str(other), "--out", str(out), "--quiet"]) == 0
    report = json.loads((out / "report.json").read_text())
    found = {effect["name"]: effect["parameters"] for effect in report["effects"]}
    assert set(found) == {"clock_offset", *(str(effect["name"]) for effect in more)}
    values = {name: value["value"] for name, value in found["clock_offset"].items()}
    assert values["offset"] == pytest.approx(inertial, abs=2e-3)
    assert values["tracker_offset"] == pytest.approx(tracked, abs=2e-3)
    assert report["verdict"] == "explained"
    assert report["fit"]["holdout"]["gap_closed"] > 0.98
