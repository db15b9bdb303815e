"""Bench axes: published recordings of real drives, friction that differs between directions, arms under gravity."""

import dataclasses
import os
import re
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
import pytest

from pcw_description.axis_recording import AxisDescription, load_axis_description
from pcw_description.effect_instance import EffectInstance
from pcw_sim_bridge.mismatch.analysis import analyse
from pcw_sim_bridge.mismatch.axis.axis_channels import AxisProblemBuilder
from pcw_sim_bridge.mismatch.axis.bench_cases import BenchCase, draw_bench_case
from pcw_sim_bridge.mismatch.errors import MismatchError
from pcw_sim_bridge.mismatch.findings.explanation import Explanation, explain
from pcw_sim_bridge.mismatch.findings.findings import Findings
from pcw_sim_bridge.mismatch.subjects.axis_subject import AxisSubject

VISCOUS, COULOMB, LOAD = "drive_viscous_friction", "drive_coulomb_friction", "constant_load"
LEADING_ORDERS = {7.0, 28.0, 14.0, 12.0}


def recording(name: str) -> Path:
    """Return a public recording by its path in the data folder, or skip."""
    places = [Path(os.environ["PCW_DATA"])] if "PCW_DATA" in os.environ else []
    places += [parent / "shared" / "data" for parent in (*Path.cwd().parents, *Path(__file__).parents)]
    for place in places:
        if (place / name).exists():
            return place / name
    pytest.skip(f"the public recording {name} is not here; set PCW_DATA to the folder that holds it")


def shipped(name: str) -> AxisDescription:
    """Return a shipped axis description, in the source tree or in an installation."""
    import pcw_sim_bridge

    module = Path(pcw_sim_bridge.__file__).resolve()
    places = [module.parents[1] / "config", module.parents[4] / "share" / "pcw_sim_bridge" / "config"]
    return load_axis_description(next(p / "axes" / name for p in places if (p / "axes" / name).exists()))


def found(axis: AxisDescription, fit: Path, holdout: Path) -> Findings:
    """Analyse one recording and prove it on another."""
    return analyse(AxisSubject(axis), [fit], [holdout], {}, 0, lambda message: None).findings


def explained(case: BenchCase) -> Explanation:
    """Explain a synthetic case."""
    builder = AxisProblemBuilder(case.axis, case.recordings)
    return explain(builder.build(builder.choose_smoothing()), np.random.default_rng(0))


def effect(name: str, **parameters: float) -> EffectInstance:
    """Return an effect of a bench axis."""
    return EffectInstance(name, ("axis",), parameters)


@pytest.fixture(scope="module")
def emps() -> Findings:
    """EMPS with the mass alone known, held out on the experiment with force pulses."""
    return found(shipped("emps.yaml"), recording("emps/DATA_EMPS.mat"), recording("emps/DATA_EMPS_PULSES.mat"))


def test_friction_of_emps_is_asymmetric(emps: Findings) -> None:
    """Its authors: "friction first assumed symmetric is, in fact, asymmetric"; 167 N s/m forwards and 240 backwards.

    With that the offset that a symmetric law needs (-3.2 N) is no longer decided, and the report says so.
    """
    by_name = {e.name: e for e in emps.effects}
    assert set(by_name) == {VISCOUS, COULOMB, LOAD}
    viscous = by_name[VISCOUS].parameters
    assert viscous["asymmetry"].low < -36.5 < viscous["asymmetry"].high < 0.0
    assert viscous["viscous"].value == pytest.approx(203.5, rel=0.02)
    assert "asymmetric" in by_name[VISCOUS].statement and "N s/m" in by_name[VISCOUS].statement
    load = by_name[LOAD]
    assert load.parameters["load"].low < 0.0 < load.parameters["load"].high
    assert load.ambiguous_with == (VISCOUS,) and load.probability < 0.5 and load.experiment
    assert any("load = -3.18 N" in note for note in emps.notes)
    assert emps.verdict == "explained"
    assert emps.fit is not None and emps.fit.inverse_nrmse[1] <= 0.054


@pytest.mark.parametrize(("asymmetry", "load"), [(0.0, -3.165), (-36.5, -0.29)], ids=["symmetric", "asymmetric"])
def test_emps_with_its_friction_in_the_description_names_nothing(asymmetry: float, load: float) -> None:
    """Nothing beyond what is published; the asymmetry, where it is left out, shows as a dependence on velocity."""
    known = (
        effect(VISCOUS, viscous=203.5, asymmetry=asymmetry),
        effect(COULOMB, coulomb=20.39, asymmetry=0.0, smoothing_speed=1e-4),
        effect(LOAD, load=load),
    )
    axis = dataclasses.replace(shipped("emps.yaml"), physics=known)
    findings = found(axis, recording("emps/DATA_EMPS.mat"), recording("emps/DATA_EMPS_PULSES.mat"))
    assert findings.effects == ()
    assert [left.depends_on for left in findings.unknown] == ([] if asymmetry else [("velocity",)])


@pytest.fixture(scope="module")
def odrive() -> Findings:
    """A brushless motor turned once, slowly, with a recording of another run to prove it on."""
    return found(
        shipped("odrive_bldc.yaml"),
        recording("odrive_cogging/slow2_slower/nocomp_0.npy"),
        recording("odrive_cogging/slow2_slower/comp_0.npy"),
    )


def test_cogging_of_a_brushless_motor_has_its_orders(odrive: Findings) -> None:
    """12 slots and 7 pole pairs: orders 7, 28, 14 and 12 lead, about 0.88, 0.49, 0.29 and 0.26 A of 7.5 mN m."""
    coggings = {
        e.parameters["order"].value: np.hypot(e.parameters["cosine"].value, e.parameters["sine"].value) / 7.5e-3
        for e in odrive.effects
        if e.name == "motor_cogging"
    }
    assert set(coggings) >= LEADING_ORDERS
    assert [coggings[order] for order in (7.0, 28.0, 14.0, 12.0)] == pytest.approx([0.88, 0.49, 0.30, 0.26], rel=0.1)
    # It turned one way only: what it takes to keep it turning is a load or a friction.
    assert {e.name for e in odrive.effects} - {"motor_cogging"} <= {LOAD, COULOMB}
    assert odrive.fit is not None and odrive.fit.inverse_nrmse[1] < 0.25
    assert all(low < 0.3 * high for high, low in [odrive.fit.inverse_nrmse])


@pytest.mark.nightly  # a whole analysis, like that of others here
def test_a_motor_with_its_cogging_in_the_description_has_nothing_more(odrive: Findings) -> None:
    """What was found on one recording, put under `physics`, leaves nothing to name."""
    known = tuple(
        effect(e.name, **{name: parameter.value for name, parameter in e.parameters.items()}) for e in odrive.effects
    )
    axis = dataclasses.replace(shipped("odrive_bldc.yaml"), physics=known)
    path = recording("odrive_cogging/slow2_slower/nocomp_0.npy")
    findings = found(axis, path, path)
    assert findings.effects == ()


@pytest.mark.parametrize(
    ("effects", "asymmetric"),
    [((VISCOUS,), VISCOUS), ((VISCOUS, LOAD), VISCOUS), ((COULOMB,), COULOMB), ((VISCOUS, COULOMB, LOAD), None)],
)
def test_asymmetry_is_named_where_it_is(effects: tuple[str, ...], asymmetric: str | None) -> None:
    """The asymmetry within its interval; an offset that it stands for is never a sure name."""
    overrides = {asymmetric: {"asymmetry": -0.3}} if asymmetric else {}
    rng = np.random.default_rng([7, len(effects)])
    case = draw_bench_case(rng, effects, 0.5, motion="sines", overrides=overrides, noise=0.01)
    explanation = explained(case)
    named = {entry.term.effect: entry for entry in explanation.named}
    sure = {name for name, entry in named.items() if not entry.ambiguous_with or name in effects}
    assert sure == set(effects)
    assert {name for name, entry in named.items() if "asymmetry" in entry.estimates} == ({asymmetric} if asymmetric else set())
    if asymmetric:
        truth = next(instance for instance in case.truth if instance.name == asymmetric).parameters["asymmetry"]
        assert named[asymmetric].estimates["asymmetry"].value == pytest.approx(truth, rel=0.1)
    assert explanation.complete


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.nightly) for seed in (1, 2, 3))])
@pytest.mark.parametrize("asymmetric", [True, False], ids=["a friction by direction", "a load"])
def test_a_load_and_a_friction_by_direction_are_one_or_the_other(asymmetric: bool, seed: int) -> None:
    """They differ at rest only. The friction by direction was a symmetric one and a load, both named as sure."""
    effects = (VISCOUS, COULOMB) if asymmetric else (VISCOUS, COULOMB, LOAD)
    overrides = {COULOMB: {"asymmetry": -0.3 if asymmetric else 0.0}}
    case = draw_bench_case(np.random.default_rng([seed, 2]), effects, 0.5, motion="sines", overrides=overrides, noise=0.05)
    named = {entry.term.effect: entry for entry in explained(case).named}
    truth = next(instance for instance in case.truth if instance.name == COULOMB).parameters
    if asymmetric:
        assert set(named) == set(effects)
        estimate = named[COULOMB].estimates["asymmetry"]
        assert estimate.low < truth["asymmetry"] < estimate.high
    elif set(named) != set(effects):
        assert set(named) == {VISCOUS, COULOMB} and named[COULOMB].ambiguous_with == (LOAD,)


ARM = {"right": {}, "heavy": {"moment": 1.3}}


@pytest.mark.parametrize("described", ["right", "heavy"])
@pytest.mark.parametrize("effects", [(), ("load_dependent_friction",), ("drive_stribeck_friction",)])
def test_a_servo_with_an_arm(described: str, effects: tuple[str, ...]) -> None:
    """Gear friction and Stribeck friction are told under a load that changes with the angle; a wrong moment is re-tuned."""
    case = draw_bench_case(
        np.random.default_rng(3), effects, 0.4, motion="sines", kind="rotary", travel=2.0, gravity=2.0, noise=0.01,
        described_arm=ARM[described],
    )
    explanation = explained(case)
    assert [entry.term.effect for entry in explanation.named] == list(effects)
    names = [nuisance.name for nuisance in explanation.search.problem.nuisances]
    moved = explanation.fit.mean[names.index("gravity_moment")] / case.axis.gravity_arm.moment
    assert moved == pytest.approx({"right": 0.0, "heavy": 1.0 / 1.3 - 1.0}[described], abs=0.01)


@pytest.mark.parametrize("described", [None, {"hanging_position": 0.3}])
def test_an_arm_that_the_description_lacks_or_has_wrong_depends_on_the_angle(described: Mapping[str, float] | None) -> None:
    """The one name with the period of a turn is that of the library's cogging; the sentence says what else it may be."""
    case = draw_bench_case(
        np.random.default_rng(5), (), motion="sines", kind="rotary", travel=12.0, gravity=2.0, described_arm=described,
        noise=0.01,
    )
    [entry] = explained(case).named
    assert entry.term.effect == "motor_cogging"
    assert entry.estimates["order"].value == 1.0
    values = {name: estimate.value for name, estimate in entry.estimates.items()}
    assert "gravity on an arm of" in AxisSubject(case.axis).statement(effect("motor_cogging", **values))


TURNED = np.arange(0.0, 20.0, 0.002)  # [s]
INERTIA, FIRM = 0.01, 0.05  # [kg m^2]; [rad] over which friction builds up
Torque = Callable[[np.ndarray, np.ndarray], np.ndarray]  # of angle and speed


def presliding(angle: np.ndarray, speed: np.ndarray) -> np.ndarray:
    """Friction of 0.1 N m that builds up over a way, as of seals and balls (Dahl)."""
    state, torque = 0.0, np.empty_like(angle)
    for k, way in enumerate(np.diff(angle, prepend=angle[0])):
        state += way - abs(way) * state / FIRM
        torque[k] = 0.1 * state / FIRM
    return torque


def found_beyond(torque: Torque) -> Explanation:
    """Explain a rotary axis that is turned to and fro, with a torque that no effect of the library makes."""
    rng = np.random.default_rng(4)
    waves = [(2.0, 0.9, 0.3), (1.2, 1.7, 1.0), (0.5, 4.1, 2.0)]  # [rad], [rad/s], [rad]
    angle = sum(size * np.sin(rate * TURNED + phase) for size, rate, phase in waves)
    speed = sum(size * rate * np.cos(rate * TURNED + phase) for size, rate, phase in waves)
    acceleration = -sum(size * rate**2 * np.sin(rate * TURNED + phase) for size, rate, phase in waves)
    force = INERTIA * acceleration + torque(angle, speed) + 2e-3 * rng.standard_normal(len(TURNED))
    case = draw_bench_case(rng, kind="rotary")
    recording = dataclasses.replace(
        case.recordings[0], time=TURNED, position=angle + 1e-5 * rng.standard_normal(len(TURNED)), velocity=None,
        force=force, external_force=np.zeros_like(force),
    )  # fmt: skip
    builder = AxisProblemBuilder(dataclasses.replace(case.axis, inertia=INERTIA, gravity_arm=None), [recording])
    return explain(builder.build(builder.choose_smoothing()), np.random.default_rng(0))


def test_friction_that_builds_up_over_a_way_is_no_viscous_friction() -> None:
    """Half of it was named Coulomb friction, and with certainty a viscous one that was not there."""
    explanation = found_beyond(presliding)
    assert explanation.named == ()
    [left] = explanation.leftovers
    assert left.depends_on == ("travel_since_reversal", "velocity")
    assert left.expression is not None
    size, twice, way = map(float, re.findall(r"\d+\.\d+", left.expression))
    assert (size, twice, way) == (pytest.approx(0.1, rel=0.1), pytest.approx(0.2, rel=0.1), pytest.approx(FIRM, rel=0.2))


def test_a_spring_is_no_row_of_waves_that_are_longer_than_its_travel() -> None:
    """Four coggings, two of them of a fifth and half a period per turn, each with p = 1."""
    explanation = found_beyond(lambda angle, speed: 0.01 * angle**3)
    assert explanation.named == ()
    [left] = explanation.leftovers
    assert left.depends_on == ("position",)
    assert left.expression is not None and left.expression.endswith("position**3")


def test_a_slow_spring_and_a_friction_do_not_hide_each_other() -> None:
    """To either alone the other was slow noise, and nothing was named; together they explain nearly everything."""
    explanation = found_beyond(lambda angle, speed: 0.01 * angle + 0.005 * speed)
    [named], [left] = explanation.named, explanation.leftovers
    assert named.term.effect == VISCOUS
    assert named.estimates["viscous"].value == pytest.approx(0.005, rel=0.02)
    assert left.depends_on == ("position",) and left.expression is not None
    size = re.fullmatch(r"axis_force = (-[\d.]+) position", left.expression)
    assert size is not None and float(size[1]) == pytest.approx(-0.01, rel=0.02)


def with_signals(case: BenchCase, position: np.ndarray, force: np.ndarray) -> AxisProblemBuilder:
    """Return the builder of a case with other signals in its recording."""
    recordings = [dataclasses.replace(case.recordings[0], position=position, force=force)]
    return AxisProblemBuilder(case.axis, recordings)


def test_an_axis_that_stands_still_has_nothing_to_judge() -> None:
    """Noise on a position that does not change is no motion, and a force that is always the same is no drive's."""
    rng = np.random.default_rng(0)
    case = draw_bench_case(rng, kind="rotary")
    size = len(case.recordings[0].time)
    force = 0.01 * rng.standard_normal(size)
    for position in (np.ones(size), 1.0 + 1e-4 * rng.standard_normal(size)):
        builder = with_signals(case, position, force)
        assert not builder.build(builder.choose_smoothing()).valid.any()
    for always in (0.0, 1.3):
        with pytest.raises(MismatchError, match=f"the force is {always:.3g} throughout"):
            with_signals(case, case.recordings[0].position, np.full(size, always))
