"""`mismatch suggest`: what it foretells of a manoeuvre comes true, and what it suggests tells look-alikes apart."""

import dataclasses
import json
import re
from pathlib import Path

import numpy as np
import pytest
import yaml

from pcw_control.excitation import Excitation, make_excitation, read_excitation
from pcw_description import load_robot, save_robot
from pcw_description.effect_instance import EffectInstance
from pcw_description.effects.registry import read_physics
from pcw_sim_bridge.mismatch import separating_experiment
from pcw_sim_bridge.mismatch.__main__ import main
from pcw_sim_bridge.mismatch.analysis import analyse
from pcw_sim_bridge.mismatch.commands.suggest import odds, read_effect
from pcw_sim_bridge.mismatch.findings.findings import Findings
from pcw_sim_bridge.mismatch.regression.whitened_regression import Instance
from pcw_sim_bridge.mismatch.report.report import write_report
from pcw_sim_bridge.mismatch.search.evidence_selection import EffectSearch
from pcw_sim_bridge.mismatch.separating_experiment import (
    WANTED,
    Doubt,
    Outcome,
    find_remedy,
    rank,
    remedies,
    simulated_problem,
    trial_excitations,
)
from pcw_sim_bridge.mismatch.subjects.robot_subject import RobotSubject
from pcw_sim_bridge.simulated_run import record_run

THESIS = load_robot("thesis")
ALL = list(THESIS.caster_names)


def effect(**entry: object) -> EffectInstance:
    """Return an effect on the thesis robot."""
    return read_physics([entry], THESIS.caster_names)[0]


# Small enough that jumping about leaves it open what it is.
RESISTANCE = effect(name="rolling_resistance", target=ALL, arm=5e-4)
FAINT = effect(name="rolling_resistance", target=ALL, arm=1.2e-4)
FRICTION_INSTEAD = Doubt(RESISTANCE, "drive_coulomb_friction", THESIS.caster_names)


def analysed(excitation: Excitation, true: EffectInstance, folder: Path) -> Findings:
    """Drive the thesis robot with an effect that its description does not hold, and analyse the recording."""
    robot = dataclasses.replace(THESIS, physics=(true,))
    path = folder / excitation.name
    record_run(robot, excitation.twist, excitation.duration, 3, path, "reduced", controlled_as=THESIS)
    return analyse(RobotSubject(THESIS), [path], [], {}, 0, lambda message: None).findings


def few(*names: str) -> list[Excitation]:
    """Return some of the trial excitations."""
    return [make_excitation(name, THESIS, 20.0) for name in names]


@pytest.mark.nightly
def test_a_doubt_is_settled_by_what_the_report_leads_to(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A faint rolling resistance and friction of all drives look alike in a few steps; what is suggested tells them apart."""
    findings = analysed(make_excitation("steps", THESIS, 10.0), FAINT, tmp_path)
    [named] = findings.effects
    assert {named.name, *named.ambiguous_with} == {"rolling_resistance", "drive_coulomb_friction"}
    write_report(findings, None, tmp_path / "report")
    monkeypatch.setattr(separating_experiment, "trial_excitations", lambda robot: few("steps", "creep", "strafe"))
    monkeypatch.chdir(tmp_path)
    assert main(["suggest", "report", "--robot", "thesis", "--quiet"]) == 0
    said = capsys.readouterr().out
    assert said.splitlines()[0].startswith(f"To tell {named.name} on ")
    assert "-p manoeuvre:=excitation.yaml -p robot:=thesis" in said
    content = yaml.safe_load(Path("excitation.yaml").read_text())
    assert content["format"] == "pcw_excitation/1"
    assert f"drive {content['duration']:g} s of {content['name']}: odds of more than a million to 1." in said
    for true in (FAINT, RESISTANCE):
        settled = analysed(read_excitation("excitation.yaml", THESIS), true, tmp_path / f"{true.parameters['arm']}")
        assert [(e.name, e.ambiguous_with) for e in settled.effects] == [("rolling_resistance", ())]
    assert settled.effects[0].probability > 0.999
    # What was suggested is not overwritten.
    assert main(["suggest", "report", "--robot", "thesis", "--quiet"]) == 2
    assert "excitation.yaml: exists already" in capsys.readouterr().err


@pytest.mark.nightly  # a whole analysis, like that of others here
@pytest.mark.parametrize(
    ("first", "second"),
    [
        (effect(name="drive_viscous_friction", target=ALL, viscous=0.03), "drive_coulomb_friction"),
        (effect(name="ground_slope", target=["chassis"], angle=0.02, direction=0.5), "constant_load"),
    ],
    ids=lambda value: value if isinstance(value, str) else value.name,
)
def test_after_the_suggested_manoeuvre_one_is_named_without_the_other(
    first: EffectInstance, second: str, tmp_path: Path
) -> None:
    """Whatever the analyser needs to see, wherever the other effect may be."""
    best = rank(THESIS, [Doubt(first, second)], excitations=few("chirp_x", "spin", "identification"))[0]
    assert best.separates
    findings = analysed(make_excitation(best.excitation, THESIS, max(best.needed, best.duration)), first, tmp_path)
    assert [e.name for e in findings.effects] == [first.name]
    assert second not in findings.effects[0].ambiguous_with


@pytest.mark.nightly
@pytest.mark.parametrize(("name", "arm"), [("steps", 2e-3), ("chirp_x", 2e-3), ("strafe", 5e-4)])
def test_what_is_foretold_is_about_what_a_recording_gives(name: str, arm: float) -> None:
    """The evidence between the two sets in a simulated recording, against its expectation: within a factor of two.

    The expectation knows nothing of the robust weights, and one recording scatters by sqrt(2 times its expectation).
    """
    resistance = effect(name="rolling_resistance", target=ALL, arm=arm)
    [excitation] = few(name)
    [outcome] = rank(THESIS, [Doubt(resistance, "drive_coulomb_friction", THESIS.caster_names)], excitations=[excitation])
    problem = simulated_problem(THESIS, [resistance], excitation)
    assert problem is not None
    search = EffectSearch(problem, np.random.default_rng(0))
    sets = [
        [Instance(k, tuple(sorted(term.shapes[0].items())), term.base_indices())]
        for effect_name in ("rolling_resistance", "drive_coulomb_friction")
        for k, term in enumerate(problem.terms)
        if (term.effect, term.target) == (effect_name, THESIS.caster_names)
    ]
    regression = search.whiten_at(search.residual_of(sets[0]))
    given = regression.fit(sets[0]).log_evidence - regression.fit(sets[1]).log_evidence
    print(f"{name}: foretold {outcome.nats:.1f} nats, given {given:.1f}")
    assert 0.5 * outcome.nats - 5.0 < given < 2.0 * outcome.nats + 5.0


@pytest.mark.nightly  # a whole analysis, like that of others here
def test_more_noise_in_the_report_asks_for_more_seconds() -> None:
    """The noise of the real recordings counts where the simulated one is quieter."""
    quiet, loud = (
        rank(THESIS, [FRICTION_INSTEAD], noise_floor=floor, excitations=few("creep"))[0]
        for floor in ({}, {"chassis_force/x": 3.0, "chassis_force/y": 3.0, "chassis_torque/z": 1.0})
    )
    assert loud.nats < 0.5 * quiet.nats


@pytest.mark.nightly
def test_a_load_on_a_corner_helps_where_no_manoeuvre_does() -> None:
    """Of what even load leaves open, a known load on one corner tells more in the same manoeuvre."""
    [steps] = few("steps")
    before = rank(THESIS, [FRICTION_INSTEAD], excitations=[steps])[0]
    offered = [words for words, _ in remedies(THESIS)]
    assert len(offered) == 1, "this robot has every sensor"
    remedy = find_remedy(THESIS, [FRICTION_INSTEAD], [], {}, [steps], lambda message: None)
    assert remedy is not None
    assert remedy.words.startswith("a known load of")
    assert remedy.outcome.nats > 3.0 * before.nats
    bare = dataclasses.replace(THESIS, sensors=dataclasses.replace(THESIS.sensors, imu=None, tracker=None))
    assert [words.split(" (")[0] for words, _ in remedies(bare)][:2] == ["an inertial measurement unit", "a tracked pose"]


def test_candidates_are_on_the_ground_and_the_proof_is_left_alone() -> None:
    """No channels of forces are there without the ground, and what is held out is not learnt from."""
    names = {excitation.name for excitation in trial_excitations(THESIS)}
    assert "identification" in names
    assert not names & {"wheels_off_ground", "holdout"}


def test_seconds_and_odds() -> None:
    """What is known of 20 s is said of as many seconds as are needed."""
    weak, strong, none = (Outcome("spin", 20.0, nats, 18.0) for nats in (0.5 * WANTED, 10.0 * WANTED, -0.2))
    assert (weak.needed, strong.needed) == (40.0, 20.0)
    assert np.isinf(none.needed)
    assert (weak.separates, none.separates) == (True, False)
    assert (odds(np.log(2.0)), odds(np.log(3210.0)), odds(50.0)) == (
        "odds of 2 to 1", "odds of 3000 to 1", "odds of more than a million to 1",
    )


def test_effects_are_given_by_name_place_or_in_full() -> None:
    """Without a size it is a typical one, without a place it is all casters."""
    friction, sized = read_effect("drive_coulomb_friction", THESIS)
    assert (friction.target, sized) == (THESIS.caster_names, False)
    assert friction.parameters["coulomb"] > 0.0
    assert friction.parameters["asymmetry"] == 0.0
    assert read_effect("drive_coulomb_friction/front_left+rear_right", THESIS)[0].target == ("front_left", "rear_right")
    given, sized = read_effect("{name: payload_mass, mass: 7}", THESIS)
    assert (given.parameters["mass"], sized) == (7.0, True)


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ([], "REPORT_DIR or --between A B is wanted"),
        (["report", "--between", "payload_mass", "ground_slope"], "allowed: one of them"),
        (["gone"], "report.json: No such file"),
        (["report"], "is no report of mismatch analyze"),
        (["--between", "payload_mas", "ground_slope"], "did you mean 'payload_mass'?"),
        (["--between", "payload_mass", "payload_mass"], "is the same effect twice"),
        (["--between", "drive_coulomb_friction/front", "ground_slope"], "front_left"),
        (["--between", "payload_mass", "ground_slope", "--out", "run.txt"], "allowed: a .yaml file"),
        (["--between", "payload_mass", "ground_slope", "--out", "gone/run.yaml"], "there is no folder"),
        (["--between", "imu_bias", "ground_slope", "--robot", "blind.yaml"], "imu_bias on imu is not searched for.*imu/data"),
        (["--between", "payload_mass", "ground_slope", "--robot", "axis.yaml"], "is a bench axis"),
        (["--between", "payload_mass", "ground_slope", "--robot", "mpo700"], "torque control needs"),
    ],
)
def test_bad_input_is_one_line_and_exit_code_2(
    arguments: list[str], says: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """What is wrong is named, and nothing is written."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(separating_experiment, "trial_excitations", lambda robot: [make_excitation("spin", robot, 10.0)])
    Path("report").mkdir()
    Path("report/report.json").write_text(json.dumps({"years": "of work"}))
    Path("axis.yaml").write_text(
        "{format: pcw_axis/1, name: sled, kind: linear, provenance: {all: test}, inertia: 20.0, physics: [], columns: {time: "
        "{column: t, unit: s}, position: {column: x, unit: m}, force: {column: f, unit: N}}}"
    )
    save_robot(dataclasses.replace(THESIS, sensors=dataclasses.replace(THESIS.sensors, imu=None)), "blind.yaml")
    assert main(["suggest", "--robot", "thesis", "--quiet", *arguments]) == 2
    said = capsys.readouterr().err
    assert len(said.splitlines()) == 1
    assert re.search(says, said)
    assert not list(Path().glob("**/excitation*.yaml"))
