"""Physics outside the library: said so before a wrong name is given, with its leading variable, formula and effect file."""

from __future__ import annotations

import dataclasses
import functools
import importlib.util
import json
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest

from pcw_control.excitation import make_excitation
from pcw_description import load_robot
from pcw_description.effect_instance import EffectInstance
from pcw_description.effects import registry
from pcw_description.effects.effect import Effect
from pcw_description.effects.kinds import (
    FORCE_INPUTS,
    POSE_X,
    POSE_YAW,
    TWIST_X,
    TWIST_Y,
    ChassisForceEffect,
    JointTorqueEffect,
)
from pcw_sim_bridge import simulated_run
from pcw_sim_bridge.mismatch.analysis import Analysis, analyse
from pcw_sim_bridge.mismatch.challenge.outside_effects import OUTSIDE_EFFECTS
from pcw_sim_bridge.mismatch.findings import explanation
from pcw_sim_bridge.mismatch.findings.explanation import Estimate, NamedTerm
from pcw_sim_bridge.mismatch.laws.generated_effect import ROWS, GeneratedEffect, NoSuchKernelError, generate
from pcw_sim_bridge.mismatch.laws.leftover_expression import (
    closed_form,
    fourier,
    plain_expression,
    plain_forms,
)
from pcw_sim_bridge.mismatch.laws.unknown_law import Basis, Factor, Law, Place, hypotheses
from pcw_sim_bridge.mismatch.regression.regression_problem import UNKNOWN, LinearParameter, Sites, Term
from pcw_sim_bridge.mismatch.regression.whitened_regression import Instance
from pcw_sim_bridge.mismatch.report.report import write_report
from pcw_sim_bridge.mismatch.rollout import HORIZONS
from pcw_sim_bridge.mismatch.search import open_set
from pcw_sim_bridge.mismatch.search.law_search import _Screened
from pcw_sim_bridge.mismatch.subjects.robot_subject import RobotSubject
from pcw_sim_bridge.plants.factory import make_plant
from pcw_sim_bridge.plants.plant import Plant, PlantState

THESIS = load_robot("thesis")
ExtraTorque = Callable[[PlantState, np.ndarray], np.ndarray]


class PlantWithLaw:
    """A plant on whose joints a further torque acts that no motor reports."""

    def __init__(self, plant: Plant, law: ExtraTorque) -> None:
        self.plant, self.law = plant, law
        self.robot, self.dt = plant.robot, plant.dt
        self.extra = np.zeros((plant.robot.n, 2))

    def reset(self, *arguments: object, **named: object) -> None:
        self.plant.reset(*arguments, **named)  # type: ignore[arg-type]

    def step(self, motor_torque: np.ndarray, steps: int = 1) -> None:
        for _ in range(steps):
            self.extra = self.law(self.plant.state(), motor_torque)
            self.plant.step(motor_torque + self.extra)

    def state(self) -> PlantState:
        state = self.plant.state()
        return dataclasses.replace(state, motor_torque=state.motor_torque - self.extra)

    def close(self) -> None:
        self.plant.close()


def friction_by_steering(state: PlantState, motor: np.ndarray) -> np.ndarray:
    """Friction of one drive that the angle of its steering modulates; named Coulomb friction by who does not look."""
    torque = np.zeros((4, 2))
    angle, speed = state.joint_position[1, 1], state.joint_velocity[1, 0]
    torque[1, 0] = -0.6 * (1.0 + 0.7 * np.cos(angle + 0.4)) * np.tanh(speed / 0.05)
    return torque


def fading_torque(state: PlantState, motor: np.ndarray) -> np.ndarray:
    """A drive that gets warm and weak; named an error of the torque constant by who does not look."""
    torque = np.zeros((4, 2))
    torque[2, 0] = -0.2 * (1.0 - np.exp(-state.time / 10.0)) * motor[2, 0]
    return torque


def fading_a_little(state: PlantState, motor: np.ndarray) -> np.ndarray:
    """All drives get a little weaker as they get warm."""
    torque = np.zeros((4, 2))
    torque[:, 0] = -0.03 * (1.0 - np.exp(-state.time / 10.0)) * motor[:, 0]
    return torque


def coupling(state: PlantState, motor: np.ndarray) -> np.ndarray:
    """A torque between two drives by the difference of their speeds."""
    torque = np.zeros((4, 2))
    torque[0, 0] = -0.25 * (state.joint_velocity[0, 0] - state.joint_velocity[3, 0])
    torque[3, 0] = -torque[0, 0]
    return torque


def cubic(state: PlantState, motor: np.ndarray) -> np.ndarray:
    """A drag in one drive that grows with the cube of its speed."""
    torque = np.zeros((4, 2))
    torque[3, 0] = -0.025 * state.joint_velocity[3, 0] ** 3
    return torque


def quadratic(state: PlantState, motor: np.ndarray) -> np.ndarray:
    """A drag in one steering by the square of its speed; named viscous friction beside a law that ends too early."""
    torque = np.zeros((4, 2))
    torque[1, 1] = -0.03 * state.joint_velocity[1, 1] * abs(state.joint_velocity[1, 1])
    return torque


def hard_spot(state: PlantState, motor: np.ndarray, size: float = 0.5) -> np.ndarray:
    """Friction at one place of the turn of one wheel; named a row of coggings by who does not look."""
    torque = np.zeros((4, 2))
    from_spot = np.angle(np.exp(1j * (state.joint_position[2, 0] - 1.0)))
    torque[2, 0] = -size * np.exp(-0.5 * (from_spot / 0.3) ** 2) * np.tanh(state.joint_velocity[2, 0] / 0.05)
    return torque


def drag_of_steerings(size: float) -> ExtraTorque:
    """Return a drag of all steerings by the square of their speed, size [N m s^2/rad^2]."""

    def drag(state: PlantState, motor: np.ndarray) -> np.ndarray:
        speed = state.joint_velocity[:, 1]
        return np.stack([np.zeros(4), -size * abs(speed) * speed], axis=1)

    return drag


def uneven_gain(state: PlantState, motor: np.ndarray, part: float = 0.02) -> np.ndarray:
    """A motor a little stronger one way than the other; named a constant load by who does not look."""
    torque = np.zeros((4, 2))
    torque[0, 0] = -part * abs(motor[0, 0])
    return torque


def weak_one_way(state: PlantState, motor: np.ndarray) -> np.ndarray:
    """A motor that gives little of its torque one way, and more than all of it the other."""
    torque = np.zeros((4, 2))
    torque[0, 0] = -0.6 * abs(motor[0, 0])
    return torque


def record(path: Path, law: ExtraTorque | None, seed: int, monkeypatch: pytest.MonkeyPatch, excitation: str = "identification",
           duration: float = 25.0) -> Path:  # fmt: skip
    """A run of the thesis robot with a mass that is off within tolerance."""
    chassis = dataclasses.replace(THESIS.chassis, mass=THESIS.chassis.mass * 1.006)
    moves = make_excitation(excitation, THESIS, duration, seed)
    with monkeypatch.context() as patch:
        if law is not None:
            patch.setattr(simulated_run, "make_plant", lambda *a, **k: PlantWithLaw(make_plant(*a, **k), law))
        simulated_run.record_run(
            dataclasses.replace(THESIS, chassis=chassis), moves.twist, moves.duration, seed, path, controlled_as=THESIS
        )
    return path


def analysed(path: Path, *held_out: Path) -> Analysis:
    return analyse(RobotSubject(THESIS), [path], held_out, {}, 0, lambda message: None)


@pytest.mark.nightly  # a whole analysis, like that of others here
@pytest.mark.parametrize(
    ("law", "channel", "leading", "known"),
    [
        (friction_by_steering, "drive_torque/front_right", "steer_angle/front_right", "cos(steer_angle/front_right)"),
        (fading_torque, "drive_torque/rear_left", "time", "exp(-time /"),
        (coupling, "drive_torque/front_left", "drive_velocity/front_left", "front_left - drive_velocity/rear_right"),
    ],
)  # fmt: skip
def test_it_is_said_so_with_the_leading_variable_and_no_name(law, channel, leading, known, tmp_path, monkeypatch):
    findings = analysed(record(tmp_path / "run", law, 3, monkeypatch)).findings
    assert findings.verdict == "unexplained"
    assert findings.effects == ()
    [unknown] = findings.unknown
    assert (unknown.channel, unknown.depends_on[0]) == (channel, leading)
    assert unknown.expression is not None and known in unknown.expression
    assert unknown.share_explained > 0.3
    # No kernel of a joint sees another joint, or the time: the law is proved on the channels alone.
    assert unknown.effect is None and "kernel" in unknown.without_effect
    assert unknown.helps and findings.fit is not None and findings.fit.gap_closed > 0.8
    assert any(note.startswith(f"The simulation is without unknown/{channel}") for note in findings.notes)


@pytest.mark.nightly  # a whole analysis, like that of others here
def test_one_place_of_a_turn_is_no_row_of_coggings(tmp_path, monkeypatch):
    findings = analysed(record(tmp_path / "run", hard_spot, 3, monkeypatch)).findings
    assert (findings.verdict, findings.effects) == ("unexplained", ())
    [unknown] = findings.unknown
    assert unknown.depends_on == ("drive_angle/rear_left", "drive_velocity/rear_left")
    assert unknown.share_explained > 0.8


@pytest.mark.nightly  # a whole analysis, like that of others here
def test_a_small_torque_is_told_where_nothing_is_named_and_the_model_errs_otherwise(tmp_path, monkeypatch):
    """Less than a fiftieth of what is measured; nothing was said to be missing."""
    small = functools.partial(hard_spot, size=0.03)
    findings = analysed(record(tmp_path / "run", small, 3, monkeypatch)).findings
    assert (findings.verdict, findings.effects) == ("unexplained", ())
    assert findings.unknown[0].depends_on[0] == "drive_angle/rear_left"


@pytest.mark.nightly  # a whole analysis, like that of others here
def test_what_changes_with_the_time_is_told_where_it_is_a_small_part_of_what_is_measured(tmp_path, monkeypatch):
    """Less than three times what a scale may be off, it was taken for a detail of the model; but those do not fade."""
    findings = analysed(record(tmp_path / "run", fading_a_little, 3, monkeypatch)).findings
    assert (findings.verdict, findings.effects) == ("unexplained", ())
    [unknown] = findings.unknown
    assert unknown.depends_on[0] == "time"


@pytest.mark.nightly  # a whole analysis, like that of others here
def test_a_motor_that_is_much_weaker_one_way_is_no_gear_friction(tmp_path, monkeypatch):
    """So much of its torque no law was allowed to take away: a friction under load was named, surely, and an unknown rest."""
    findings = analysed(record(tmp_path / "run", weak_one_way, 3, monkeypatch, "random_goals", 40.0)).findings
    assert (findings.verdict, findings.effects) == ("unexplained", ())
    assert ("drive_torque/front_left", "drive_torque/front_left") in {(u.channel, u.depends_on[0]) for u in findings.unknown}


@pytest.mark.nightly  # a whole analysis, like that of others here
@pytest.mark.parametrize(
    ("part", "excitation", "duration", "seed"),
    [
        (0.02, "identification", 25.0, 3),
        (0.02, "identification", 25.0, 4),
        # Looked at sample by sample it is one of many laws that noise makes look better.
        (0.014, "chirps", 30.0, 6),
    ],
)
def test_a_law_as_small_as_the_name_that_it_replaces_is_told_of(part, excitation, duration, seed, tmp_path, monkeypatch):
    """It lies below the noise, as the name does, and is held to be as small; seed 3 was nothing, others a constant load."""
    law = functools.partial(uneven_gain, part=part)
    findings = analysed(record(tmp_path / "run", law, seed, monkeypatch, excitation, duration)).findings
    assert (findings.verdict, findings.effects) == ("unexplained", ())
    [unknown] = findings.unknown
    assert (unknown.channel, unknown.depends_on) == ("drive_torque/front_left", ("drive_torque/front_left",))


@pytest.mark.nightly  # a whole analysis, like that of others here
@pytest.mark.parametrize(("excitation", "seed"), [("identification", 3), ("random_goals", 4)])
def test_a_quadratic_drag_is_no_viscous_friction_beside_it(excitation, seed, tmp_path, monkeypatch):
    """Its formula goes to the ends of what was seen, where a drag is largest: nothing is left there for another name.

    Between goals a steering turns within the length of a filter, and nearly all its torque is that drag: still it is no
    function of the torque that overcomes it, nor of where the steering happened to turn.
    """
    findings = analysed(record(tmp_path / "run", quadratic, seed, monkeypatch, excitation)).findings
    assert (findings.verdict, findings.effects) == ("unexplained", ())
    [unknown] = findings.unknown
    assert unknown.depends_on == ("steer_velocity/front_right",)


@pytest.mark.nightly  # a whole analysis, like that of others here
@pytest.mark.parametrize("size", [0.005, 0.002])
def test_a_small_drag_of_all_steerings_is_no_viscous_friction(tmp_path, monkeypatch, size):
    """It is a fair part of the friction that looks most like it, though not of what is measured.

    What the smaller one leaves beside that friction is too little to be found; in its place it does better.
    """
    run = record(tmp_path / "run", drag_of_steerings(size), 3, monkeypatch, "random_goals", 40.0)
    findings = analysed(run).findings
    assert (findings.verdict, findings.effects) == ("unexplained", ())
    [unknown] = findings.unknown
    assert unknown.depends_on[0] == "steer_velocity/front_left"


def loaded(effect: GeneratedEffect, folder: Path) -> Effect:
    """Import the file as a user would."""
    folder.mkdir(exist_ok=True)
    (folder / f"{effect.name}.py").write_text(effect.source)
    return _module(folder / f"{effect.name}.py").EFFECT  # type: ignore[no-any-return]


def _module(path: Path) -> ModuleType:
    specification = importlib.util.spec_from_file_location(path.stem, path)
    assert specification is not None and specification.loader is not None
    module = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(module)
    return module


@pytest.mark.nightly  # two whole analyses, like those of others here
def test_the_generated_effect_brings_simulator_and_held_out_recording_together(tmp_path, monkeypatch, request):
    """Analysed, proved, written, given to another program: channels and rollout come nearer, and both plants feel it."""
    fit = record(tmp_path / "fit", cubic, 4, monkeypatch)
    other = record(tmp_path / "other", cubic, 5, monkeypatch, "holdout", 15.0)
    analysis = analysed(fit, other)
    write_report(analysis.findings, analysis.patched.mapping(), tmp_path / "report", with_laws=analysis.with_laws)
    report = json.loads((tmp_path / "report" / "report.json").read_text())
    [unknown], [entry] = report["unknown"], report["generated_effects"]
    assert unknown["depends_on"] == ["drive_velocity/rear_right"]
    proof = report["fit"]["holdout"]
    print(f"proof: gap {proof['gap_closed']}, rollout {proof['rollout_gap_closed']}, harm {proof['harm']}")
    assert entry["helps_held_out"]
    assert proof["gap_closed"] > 0.9 and proof["rollout_gap_closed"] > 0.8 and proof["harm"] < 0.02
    assert "robot_with_laws.yaml" in (tmp_path / "report" / "report.html").read_text()
    assert load_robot(tmp_path / "report" / "robot_patched.yaml").physics == ()  # what every simulator takes
    monkeypatch.setenv(registry.PATH_VARIABLE, str(tmp_path / "report" / "effects"))
    registry.all_effects.cache_clear()
    request.addfinalizer(registry.all_effects.cache_clear)
    nominal = RobotSubject(THESIS)
    patched = RobotSubject(load_robot(tmp_path / "report" / "effects" / "robot_with_laws.yaml"))
    assert entry["effect"]["name"] in {instance.name for instance in patched.robot.physics}
    errors, rollouts = [], []
    for subject in (nominal, patched):
        opened = [subject.open(other, "holdout", {})]
        problem = subject.problem(opened)
        errors.append(np.sqrt(np.mean(problem.residual[:, :3][problem.valid[:, :3]] ** 2)))
        windows = nominal.windows(opened)
        assert windows is not None
        squares = windows.relative(subject.rollout(windows))[:, HORIZONS.index(0.5), windows.signals.index("v_x")]
        rollouts.append(float(np.sqrt(np.nanmean(squares))))
    print(f"held-out rms {errors}, rollout {rollouts}")
    assert errors[1] < 0.5 * errors[0]
    assert rollouts[1] < 0.6 * rollouts[0]
    slowed = []
    for name in ("reduced", "pybullet"):
        ends = []
        for subject in (nominal, patched):
            plant = make_plant(name, subject.robot)
            plant.step(np.tile([2.0, 0.0], (4, 1)), 1000)
            ends.append(plant.state().joint_velocity[3, 0])
            plant.close()
        slowed.append(ends[1] / ends[0])
    assert slowed[0] < 0.99
    assert slowed[1] == pytest.approx(slowed[0], abs=0.02)


@pytest.mark.nightly  # a whole analysis, like that of others here
def test_a_law_that_is_not_there_in_other_recordings_is_in_no_patch(tmp_path, monkeypatch):
    """It is told of, since it was there; but nothing is claimed of a patch with it."""
    fit = record(tmp_path / "fit", friction_by_steering, 3, monkeypatch)
    other = record(tmp_path / "other", None, 5, monkeypatch, "holdout", 15.0)
    analysis = analysed(fit, other)
    findings = analysis.findings
    [unknown] = findings.unknown
    assert unknown.depends_on[0] == "steer_angle/front_right" and not unknown.helps
    assert analysis.with_laws is None
    assert findings.fit is not None and findings.fit.gap_closed == 0.0 and findings.fit.harm == 0.0
    assert any("was fitted but did not help held out" in note for note in findings.notes)


# -- files --------------------------------------------------------------------------------------------------------------

KNOTS = (tuple(np.linspace(-4.0, 6.0, 8)),)


def law_of(site: str, factor: Factor, variable: str, basis: Basis) -> Law:
    return Law((Place(site, factor, (((variable, 1.0),),)),), basis)


SITE = "drive_torque/front_left"
SPEED = "drive_velocity/front_left"
FILES = [
    law_of(SITE, Factor(), SPEED, Basis("speed", KNOTS, 0.05)),
    law_of(SITE, Factor("sign", SPEED, 0.05), "drive_normal_force/front_left", Basis("map", KNOTS)),
    law_of(SITE, Factor("value", SPEED), "drive_angle/front_left", fourier(Basis("periodic", ((-np.pi, np.pi),)))),
    law_of("steer_torque/front_left", Factor(), "steer_angle/front_left", Basis("map", KNOTS)),
    law_of(SITE, Factor("value", SITE), SPEED, Basis("speed", KNOTS, 0.05)),
    *plain_forms(law_of(SITE, Factor(), SITE, Basis("map", KNOTS))),
]


@pytest.mark.parametrize("law", FILES, ids=lambda law: f"{law.basis.kind}-{law.places[0].factor.kind}-{law.sites[0]}")
def test_a_file_says_what_the_law_says(law, tmp_path):
    """Torque and slope of the kernel against the law itself, also beyond the range of its curve."""
    rng = np.random.default_rng(0)
    q, v, tau, load = rng.uniform(-8.0, 8.0, (4, 300))
    axis = law.sites[0].partition("_torque")[0]
    variables = {
        f"{axis}_angle/front_left": q, f"{axis}_velocity/front_left": v, f"{axis}_torque/front_left": tau,
        "drive_normal_force/front_left": load,
    }  # fmt: skip
    place = law.places[0]
    weights = rng.standard_normal(law.basis.functions([np.zeros(2)]).shape[1])
    size = law.basis.functions([variables[place.arguments[0][0][0]]]) @ weights
    factor = {"one": 1.0, "sign": np.tanh(v / 0.05)}.get(place.factor.kind, variables.get(place.factor.variable))
    made = generate(law, weights, ["a_bag"])
    effect = loaded(made, tmp_path / "effects")
    assert isinstance(effect, JointTorqueEffect) and effect.axis == axis
    assert ("Beyond the range" in made.source) == getattr(law.basis, "clipped", True)
    np.testing.assert_allclose(effect.contribution(q, v, tau, load, made.parameters), factor * size, rtol=1e-4, atol=1e-4)
    step = 1e-5
    numbers = effect.values(made.parameters)
    for k in range(100):
        ends = [effect.torque(q[k], v[k] + d, tau[k], load[k], numbers)[0] for d in (-step, step)]
        slope = effect.torque(q[k], v[k], tau[k], load[k], numbers)[1]
        assert -slope == pytest.approx((ends[1] - ends[0]) / (2.0 * step), rel=1e-3, abs=1e-4)


def test_a_force_over_the_floor_is_a_file_too(tmp_path):
    floor = ((("x", 1.0),), (("y", 1.0),))
    knots = tuple(np.linspace(-1.0, 1.0, 5))
    law = Law(
        (Place("chassis_force/x", Factor("cos", "yaw"), floor), Place("chassis_force/y", Factor("sin", "yaw"), floor, -1.0)),
        Basis("map", (knots, knots)),
    )
    weights = np.random.default_rng(1).standard_normal(25)
    made = generate(law, weights, ["a_bag"])
    effect = loaded(made, tmp_path / "effects")
    assert isinstance(effect, ChassisForceEffect)
    at = np.zeros((50, FORCE_INPUTS))
    at[:, [POSE_X, POSE_X + 1, POSE_YAW]] = np.random.default_rng(2).uniform(-1.5, 1.5, (50, 3))
    size = law.basis.functions([at[:, POSE_X], at[:, POSE_X + 1]]) @ weights
    wrench = effect.contribution(at, made.parameters)
    np.testing.assert_allclose(wrench[:, 0], np.cos(at[:, POSE_YAW]) * size, atol=1e-4)
    np.testing.assert_allclose(wrench[:, 1], -np.sin(at[:, POSE_YAW]) * size, atol=1e-4)


def test_a_product_on_the_chassis_is_tried_and_is_a_file(tmp_path):
    """A keel's moment, v_x v_y, was among no hypotheses: a robot with one was said to miss nothing."""
    along = np.linspace(-0.5, 0.5, 60)
    variables = {name: along for name in ("time", "v_x", "v_y", "omega", "speed", "yaw")}
    casters = [f"{axis}_{what}/only" for axis in ("drive", "steer") for what in ("angle", "velocity", "torque")]
    variables |= {name: along for name in (*casters, "drive_normal_force/only")}
    sites = Sites(("drive_torque/only", "steer_torque/only", *ROWS), variables, 0.05, lambda torques: torques)
    keel = Place("chassis_torque/z", Factor("value", "v_y"), ((("v_x", 1.0),),))
    [law] = [law for law in hypotheses(sites) if law.places == (keel,)]
    law = dataclasses.replace(law, basis=Basis("speed", KNOTS, 0.05))
    weights = np.random.default_rng(1).standard_normal(9)
    made = generate(law, weights, ["a_bag"])
    effect = loaded(made, tmp_path / "effects")
    at = np.zeros((50, FORCE_INPUTS))
    at[:, [TWIST_X, TWIST_Y]] = np.random.default_rng(2).uniform(-5.0, 7.0, (50, 2))
    moment = at[:, TWIST_Y] * (law.basis.functions([at[:, TWIST_X]]) @ weights)
    wrench = effect.contribution(at, made.parameters)
    np.testing.assert_allclose(wrench[:, -1], moment, rtol=1e-4, atol=1e-4)
    assert not wrench[:, :2].any() and "v_x and v_y" in effect.summary


def test_a_moment_by_the_heading_is_tried_and_is_a_file(tmp_path):
    """A cable that winds up was among no hypotheses: its moment was said to depend on the time, which helped nothing."""
    along = np.linspace(-4.0, 4.0, 60)
    variables = {name: along for name in ("time", "x", "y", "v_x", "v_y", "omega", "speed", "yaw")}
    casters = [f"{axis}_{what}/only" for axis in ("drive", "steer") for what in ("angle", "velocity", "torque")]
    variables |= {name: along for name in (*casters, "drive_normal_force/only")}
    sites = Sites(("drive_torque/only", "steer_torque/only", *ROWS), variables, 0.05, lambda torques: torques)
    cable = Place("chassis_torque/z", Factor(), ((("yaw", 1.0),),))
    [law] = [law for law in hypotheses(sites) if law.places == (cable,)]
    assert law.depends_on == ("yaw",)
    weights, *_ = np.linalg.lstsq(law.basis.functions([along]), -1.5 * along, rcond=None)
    made = generate(law, weights, ["a_bag"])
    effect = loaded(made, tmp_path / "effects")
    at = np.zeros((50, FORCE_INPUTS))
    at[:, POSE_YAW] = np.linspace(-3.9, 3.9, 50)
    wrench = effect.contribution(at, made.parameters)
    np.testing.assert_allclose(wrench[:, -1], -1.5 * at[:, POSE_YAW], atol=0.3)  # over more than a turn, as a cable counts
    assert not wrench[:, :2].any()


def test_what_explains_one_channel_of_many_is_seen():
    """A keel's moment explained 99 % of one channel of 17, and was worth less than its numbers cost: no law was tried."""
    rng, samples, channels = np.random.default_rng(0), 200, 17
    law = rng.standard_normal((samples, 9)) * (np.arange(channels) == 2)[:, None, None]
    columns, weights = law.swapaxes(0, 1), np.ones(9) / 3.0
    noise = rng.standard_normal((samples, channels)) * np.where(np.arange(channels) == 2, 0.08, 1.0)
    target = columns @ weights + noise
    weight, total = np.ones_like(target), float(np.sum(target**2))
    screened = _Screened({}, weight, np.zeros((target.size, 1)), target.ravel(), total, target.size / 5.0)
    _, _, moment = screened.products_of(columns)
    together = -0.5 * screened.rows * np.log1p(-float(moment @ weights) / total)
    cost = 0.5 * len(weights) * np.log(screened.rows)
    assert together < cost < 0.5 * screened.gain_by_channel(columns, weights)
    assert screened.gain_by_channel(rng.standard_normal(columns.shape), 0.01 * weights) < 1.0


@pytest.mark.nightly  # a whole analysis, like that of others here
def test_a_keel_that_noise_of_other_channels_drowned_is_told(tmp_path, monkeypatch):
    """In half a minute between goals, at 8 samples a second: it was said to depend on the torque of a drive."""
    keel = OUTSIDE_EFFECTS["keel"].effect
    with registry.also_known([keel]):
        robot = dataclasses.replace(THESIS, physics=(EffectInstance("keel", ("chassis",), {"size": 60.0}),))
        moves = make_excitation("random_goals", THESIS, 32.0, 5)
        simulated_run.record_run(robot, moves.twist, moves.duration, 5, tmp_path / "run", controlled_as=THESIS)
    [unknown] = analysed(tmp_path / "run").findings.unknown
    assert unknown.channel == "chassis_torque/z" and set(unknown.depends_on) == {"v_x", "v_y"}


def test_two_laws_are_no_torque_constants_to_be_doubted():
    """With two laws found, the second analysis of their names asked the vocabulary for the effect `unknown`, and ended."""
    estimates = {"weight_0": Estimate(1.0, "N m", 0.9, 1.1)}
    terms = [Term(UNKNOWN, target, (), ({},), lambda shape: np.zeros((1, 1, 1))) for target in (("a",), ("b",), ("a",))]
    nothing = np.zeros((1, 1))
    laws = [NamedTerm(Instance(k, (), ()), term, estimates, 1.0, (), 9.0, 9.0, nothing) for k, term in enumerate(terms)]
    assert explanation._doubted_by_scale(laws) == tuple(laws)


@pytest.mark.parametrize(
    ("target", "axis", "active", "doubted"),
    [(("a",), None, (0,), True), (("a",), "steer", (0,), False), (("b",), None, (0,), False), (("a",), None, (0, 1), False)],
)
def test_a_constant_load_beside_dry_friction_may_be_a_friction_of_two_sizes(target, axis, active, doubted):
    """It is the same torque; an asymmetric friction was told as a friction and a load, both for sure."""
    size = [LinearParameter(name, "N m", -1.0, 1.0, 1.0) for name in ("coulomb", "asymmetry", "load")]
    nothing = np.zeros((1, 1))
    entries = [
        NamedTerm(Instance(k, (), on), term, {}, 1.0, (), 9.0, 9.0, nothing)
        for k, (on, term) in enumerate([
            (active, Term("drive_coulomb_friction", ("a",), tuple(size[:2]), ({},), lambda shape: nothing[None])),
            ((0,), Term("constant_load", target, (size[2],), ({},), lambda shape: nothing[None], axis=axis)),
            ((), Term(UNKNOWN, target, (), ({},), lambda shape: nothing[None])),
        ])
    ]
    rubbing, load, law = explanation._doubted_beside_friction(entries)
    assert (rubbing, law) == (entries[0], entries[2])
    assert (load.ambiguous_with, load.probability) == ((("drive_coulomb_friction",), 0.5) if doubted else ((), 1.0))


def test_a_file_passes_the_checks_of_the_house(tmp_path):
    """What every effect of the library is held to, and the linter."""
    made = generate(FILES[1], np.ones(8), ["a_bag"])
    effect = loaded(made, tmp_path / "effects")
    path = tmp_path / "effects" / f"{made.name}.py"
    assert "a_bag" in (_module(path).__doc__ or "")
    assert effect.summary.endswith(".") and effect.sentence.endswith(".")
    assert set(effect.look_alikes) <= set(registry.all_effects())
    assert effect.check({}, "physics[0]") == pytest.approx(dict(made.parameters), rel=1e-8)
    for parameter in effect.parameters:
        assert parameter.unit and parameter.help and parameter.lower < parameter.typical < parameter.upper
    statement = effect.statement(["front_left"], made.parameters)
    assert "front_left" in statement and statement.count(". ") == 0
    assert max(len(line) for line in path.read_text().splitlines()) <= 127
    command = [sys.executable, "-m", "ruff", "check", "--isolated", "--select", "E,F,W", "--line-length", "127", str(path)]
    ruff = subprocess.run(command, capture_output=True, text=True, check=False)
    if "No module named ruff" in ruff.stderr:
        pytest.skip("ruff is not installed")
    assert ruff.returncode == 0, ruff.stdout


@pytest.mark.parametrize(
    ("law", "reason"),
    [
        (law_of(SITE, Factor(), "time", Basis("map", KNOTS)), "time"),
        (law_of(SITE, Factor("sign", SPEED, 0.05), "steer_angle/front_left", Basis("map", KNOTS)), "steer_angle/front_left"),
        (law_of(SITE, Factor(), "drive_velocity/rear_left", Basis("map", KNOTS)), "drive_velocity/rear_left"),
    ],
)
def test_what_a_kernel_does_not_see_is_no_file(law, reason):
    with pytest.raises(NoSuchKernelError, match=reason):
        generate(law, np.ones(8), ["a_bag"])


# -- expressions --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("function", "basis", "text"),
    [
        (lambda z: -0.02 * z**3, Basis("speed", KNOTS, 0.05), ["z**3"]),
        (lambda z: 1.0 - np.exp(-z / 7.0), Basis("map", (tuple(np.linspace(0.0, 40.0, 8)),)), ["1.0", "exp(-z / "]),
        (lambda z: 0.5 * np.sin(2.0 * z), Basis("periodic", ((-np.pi, np.pi),)), ["sin(2 * z)"]),
        (lambda z: -0.6 * np.abs(z), Basis("map", (tuple(np.linspace(-1.5, 1.0, 8)),)), ["abs(z)"]),
    ],
)
def test_a_curve_that_has_a_closed_form_gets_it(function, basis, text):
    """From weights that a fit would give, with its doubt about them."""
    grid = np.linspace(basis.knots[0][0], basis.knots[0][-1], 400)
    functions = basis.functions([grid])
    noise = 0.003
    rng = np.random.default_rng(0)
    covariance = noise**2 * np.linalg.inv(functions.T @ functions + 1e-6 * np.eye(functions.shape[1]))
    values = function(grid) + noise * rng.standard_normal(len(grid))
    weights = covariance @ functions.T @ values / noise**2
    form = closed_form(basis, weights, covariance)
    assert form is not None
    written = [atom.written("z") for atom in form.atoms]
    for expected in text:
        assert any(w.startswith(expected) for w in written), written


@pytest.mark.parametrize(
    ("function", "periodic", "text"),
    [
        (lambda z: -1.2 * z, False, "-1.2 omega"),
        (lambda z: 0.3 * np.abs(z), False, "0.3 abs(omega)"),
        (lambda z: 0.5 * z**2 + 0.01 * np.sin(9.0 * z), False, "0.5 omega**2"),
        (lambda z: 0.2 * np.cos(z) - 0.1 * np.sin(z), True, "0.2 cos(omega) - 0.1 sin(omega)"),
        (lambda z: np.sin(6.0 * z), False, None),
        (np.zeros_like, False, None),
    ],
)
def test_a_channel_that_is_no_torque_gets_a_plain_function_where_one_does(
    function: Callable[[np.ndarray], np.ndarray], periodic: bool, text: str | None
) -> None:
    values = np.random.default_rng(0).uniform(-2.0, 2.0, 400)
    found = plain_expression("omega", values, 0.7 + function(values), periodic)
    if text is None:
        assert found is None
        return
    assert found is not None
    numbers = [re.findall(r"\d+\.?\d*", line) for line in (text, found)]
    assert re.sub(r"\d+\.?\d*", "#", found) == re.sub(r"\d+\.?\d*", "#", text)
    assert [float(number) for number in numbers[1]] == pytest.approx([float(number) for number in numbers[0]], rel=0.02)


def test_a_law_that_a_later_answer_does_without_is_not_told_and_gives_the_name_back(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two laws stood for a cogging that no candidate was; an effect in the second's place did without the first: an error."""

    def search_with(*effects: str) -> SimpleNamespace:
        terms = [SimpleNamespace(effect=effect, law=of_speed if effect == UNKNOWN else None) for effect in effects]
        problem = SimpleNamespace(sites=object(), terms=terms, nuisances=())
        return SimpleNamespace(problem=problem, label=lambda instance: effects[instance.term], progress=lambda said: None)

    def chosen(*instances: Instance) -> SimpleNamespace:
        fit = SimpleNamespace(instances=instances, mean=np.zeros(2), covariance=np.eye(2))
        return SimpleNamespace(fit=fit, threshold=3.0)

    name, other, law = (Instance(k, (), (0,)) for k in range(3))
    of_speed = SimpleNamespace(sites=("drive_torque/left",), depends_on=("speed",))
    plain, wider = search_with("friction", "cogging"), search_with("friction", "cogging", UNKNOWN)
    found = SimpleNamespace(law=of_speed, counts=True, withdrawn=(name,), names=())
    left = open_set.OpenSetResult((SimpleNamespace(),), (), np.zeros(1))  # type: ignore[arg-type]
    listed = iter([None, chosen(name, other), None])
    laws = iter([found, found, None])
    monkeypatch.setattr(open_set, "LawSearch", lambda search, selection: SimpleNamespace(run=lambda: next(laws)))
    monkeypatch.setattr(open_set, "_in_library", lambda search, selection, law: next(listed))
    monkeypatch.setattr(open_set, "_adopted", lambda search, selection, how: (wider, chosen(law), of_speed))
    monkeypatch.setattr(open_set, "_with_names_beside", lambda search, selection: selection)
    monkeypatch.setattr(open_set, "_without_mere_relief", lambda search, selection: selection)
    monkeypatch.setattr(open_set, "OpenSetTest", lambda search, i: SimpleNamespace(run=lambda threshold: left))
    monkeypatch.setattr(open_set, "shared_beliefs", lambda search, selection: {})
    judged = open_set.judge(plain, chosen(name), left)  # type: ignore[arg-type]
    assert judged.selection.fit.instances == (name, other)
    assert judged.result.leftovers == left.leftovers
    assert judged.withdrawn == ()


def test_a_name_that_is_less_sure_for_a_law_that_is_not_told_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    """It was half as sure, and nobody could see why."""
    name = Instance(0, (), (0,))
    terms = [SimpleNamespace(effect="friction", target=("drive_torque/left",), arguments=("speed",))]
    search = SimpleNamespace(
        problem=SimpleNamespace(sites=object(), terms=terms), label=lambda instance: "friction", progress=lambda said: None
    )
    selection = SimpleNamespace(fit=SimpleNamespace(instances=(name,)), threshold=3.0)
    law = SimpleNamespace(sites=("drive_torque/left",), depends_on=("steer_angle/left",))
    monkeypatch.setattr(open_set, "shared_beliefs", lambda search, selection: {})
    said = "friction may stand for a law outside the library, drive_torque/left by steer_angle/left: 50 % as sure for that."
    for belief, wanted in ((0.5, (said,)), (0.999, ())):
        found = SimpleNamespace(law=law, counts=False, withdrawn=(name,), names=(), belief=belief)
        monkeypatch.setattr(open_set, "LawSearch", lambda search, selection, found=found: SimpleNamespace(run=lambda: found))
        left = open_set.OpenSetResult((), (), np.zeros(1))
        judged = open_set.judge(search, selection, left)  # type: ignore[arg-type]
        assert judged.beliefs == {0: belief}
        assert judged.doubts == wanted


def test_what_a_law_or_a_dropped_effect_leaves_is_asked_where_the_problem_is_exact(monkeypatch: pytest.MonkeyPatch) -> None:
    """A drag that was told rightly cast shadows: numbers stood as without it, tyres were named, and two more laws without."""
    here, exact, asked = (Instance(0, (), (0,)),), (Instance(0, (), (1,)),), []
    nothing = SimpleNamespace(instances=())

    def concluded(instances: tuple[Instance, ...], threshold: float) -> SimpleNamespace:
        return SimpleNamespace(fit=SimpleNamespace(instances=tuple(instances)), threshold=threshold, regression=nothing)

    def same(selection: SimpleNamespace) -> SimpleNamespace:
        return selection

    search = SimpleNamespace(
        problem=SimpleNamespace(terms=[SimpleNamespace(effect=UNKNOWN, arguments=("speed",))]), conclude=concluded,
        made_exact=lambda instances: exact, retuned_away=same, bounded=same, balanced=same,
        improve=lambda regression, instances: instances, grow=lambda regression, instances, threshold: instances,
    )  # fmt: skip
    beside = open_set._with_names_beside(search, concluded(here, 3.0))  # type: ignore[arg-type]
    assert beside.fit.instances == exact

    def tested(search: object, instances: tuple[Instance, ...]) -> SimpleNamespace:
        asked.append(instances)
        return SimpleNamespace(run=lambda threshold: open_set.OpenSetResult((), (), np.zeros(1)))

    monkeypatch.setattr(explanation, "OpenSetTest", tested)
    monkeypatch.setattr(explanation, "named_terms", lambda search, selection: ())
    monkeypatch.setattr(explanation, "_p_values", lambda search, selection, result: ())
    before = explanation.Explanation(
        search, concluded(here, 3.0), (), (), (), None, (), np.zeros(1), np.zeros(1)  # type: ignore[arg-type]
    )
    for known in (False, True):
        explanation.explanation_by(before, here, known)
    assert asked == [exact, here]
