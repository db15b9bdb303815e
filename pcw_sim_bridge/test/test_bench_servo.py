"""Servos as people have them: read in coarse steps, without a speed, commanded late; simulated by laws written out here."""

import dataclasses
import math
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy import signal

from pcw_description.axis_recording import AxisDescription, AxisRecording, Column, parse_axis_description
from pcw_description.compiled import compiled
from pcw_description.effect_instance import EffectInstance
from pcw_sim_bridge.mismatch.axis.axis_channels import AxisProblemBuilder
from pcw_sim_bridge.mismatch.axis.late_speed import lateness
from pcw_sim_bridge.mismatch.errors import MismatchError
from pcw_sim_bridge.mismatch.findings.explanation import Explanation, explain, strained_of_the_balance
from pcw_sim_bridge.mismatch.findings.findings import InputFinding
from pcw_sim_bridge.mismatch.proof.held_out import HeldOut
from pcw_sim_bridge.mismatch.proof.proof import Prover
from pcw_sim_bridge.mismatch.regression.signal_filter import reading_noise_level
from pcw_sim_bridge.mismatch.regression.whitened_regression import Instance
from pcw_sim_bridge.mismatch.search import open_set
from pcw_sim_bridge.mismatch.subjects.axis_subject import AxisSubject
from pcw_sim_bridge.mismatch.subjects.subject import Opened

VISCOUS, COULOMB, GEAR = "drive_viscous_friction", "drive_coulomb_friction", "load_dependent_friction"
INERTIA, MOMENT, RATE, SUBSTEPS = 0.02, 0.6, 200.0, 50
READ = 2.0 * np.pi / 4096.0


@compiled
def servo(goal, speed, arm, coulomb, forwards, backwards, gear, motor, gain, lag, stop):  # type: ignore[no-untyped-def]
    """Angle and commanded torque at every sample of a servo that follows a goal."""
    step = 1.0 / RATE / SUBSTEPS
    angles, torques = np.empty(len(goal)), np.empty(len(goal))
    angle, rate, given = goal[0], 0.0, 0.0
    for k in range(len(goal)):
        torque = 12.0 * (goal[k] - angle) + 0.6 * (speed[k] - rate)
        angles[k], torques[k] = angle, torque
        for _ in range(SUBSTEPS):
            given = torque if lag == 0.0 else given + (torque - given) * step / lag
            weight = arm * math.sin(angle)
            level = coulomb + gear * (motor * abs(gain * given) + (1.0 - motor) * abs(weight))
            friction = level * math.tanh(rate / 1e-3) + (forwards if rate > 0.0 else backwards) * rate
            friction += stop * max(0.0, angle - 0.5)
            rate += step * (gain * given - weight - friction) / INERTIA
            angle += step * rate
    return angles, torques


def goal(kind: str, rng: np.random.Generator) -> np.ndarray:
    """Angle over a minute: moves with pauses, sines, or turning at changing speeds."""
    time = np.arange(round(60.0 * RATE)) / RATE
    if kind == "moves":
        places = rng.uniform(-1.6, 1.6, 52)
        number, within = np.divmod(time, 1.2)
        part = np.clip(within / 0.9, 0.0, 1.0)
        smooth = 10.0 * part**3 - 15.0 * part**4 + 6.0 * part**5
        at = number.astype(int)
        return np.asarray(places[at] + (places[at + 1] - places[at]) * smooth - places[0])
    if kind == "turning":
        return np.asarray(np.cumsum(np.interp(time, np.linspace(0.0, 60.0, 30), rng.uniform(-8.0, 8.0, 30))) / RATE)
    waves = zip((0.9, 0.5, 0.25, 0.1), (0.13, 0.31, 0.77, 1.9), rng.uniform(0.0, 6.28, 4), strict=True)
    return np.asarray(sum(size * (np.sin(2.0 * np.pi * f * time + phase) - np.sin(phase)) for size, f, phase in waves))


def recorded(
    kind: str, coulomb: float = 0.0, forwards: float = 0.0, backwards: float | None = None, gear: float = 0.0,
    motor: float = 0.5, gain: float = 1.0, lag: float = 0.0, stop: float = 0.0, turned: float = 1.0,
    inertia: float = 0.98 * INERTIA, moment: float | None = 1.015 * MOMENT,
) -> tuple[AxisDescription, AxisRecording]:  # fmt: skip
    """The description and a recording; there is an arm unless it turns."""
    rng = np.random.default_rng(5)
    wanted, arm = goal(kind, rng), 0.0 if kind == "turning" else MOMENT
    given = (arm, coulomb, forwards, forwards if backwards is None else backwards, gear, motor, gain, lag, stop)
    angle, torque = servo(wanted, np.gradient(wanted, 1.0 / RATE), *given)
    recording = AxisRecording(
        path=Path("servo"), time=np.arange(len(angle)) / RATE, position=turned * np.round(angle / READ) * READ, velocity=None,
        force=np.round((torque + 0.002 * rng.standard_normal(len(torque))) / 0.002) * 0.002,
        external_force=np.zeros(len(angle)), warnings=(),
    )  # fmt: skip
    description = {
        "format": "pcw_axis/1", "name": "servo", "kind": "rotary", "provenance": {"all": "made up"},
        "columns": {"time": "t", "position": "q", "force": "tau"}, "inertia": inertia, "tolerances": {"inertia": "5 %"},
    }  # fmt: skip
    if arm and moment is not None:
        description["gravity_arm"] = {"moment": moment, "hanging_position": 0.0}
    return parse_axis_description(description), recording


def explained(kind: str, **truth: float | None) -> tuple[dict[str, dict[str, float]], Explanation]:
    """Names with their numbers, and all that was found."""
    axis, recording = recorded(kind, **truth)  # type: ignore[arg-type]
    subject, opened = AxisSubject(axis), [Opened(recording, InputFinding("servo", "", 60.0, "fit", ()))]
    problem = subject.problem(opened)
    right = subject.put_right(problem, opened)
    found = explain(problem if right is opened else subject.problem(right), np.random.default_rng(0))
    return {n.term.effect: {k: e.value for k, e in n.estimates.items()} for n in found.named}, found


@pytest.mark.parametrize("kind", ["moves", "sines", "turning"])
def test_a_healthy_servo_has_nothing_more(kind: str) -> None:
    names, found = explained(kind)
    assert names == {} and found.leftovers == ()


def test_what_is_read_in_steps_is_as_noisy_as_it_is_where_it_moves() -> None:
    """Standing still it reads the same all the time, which is no precision."""
    read = np.round(goal("moves", np.random.default_rng(0)) / READ) * READ
    assert np.mean(np.diff(read) == 0.0) > 0.3
    assert reading_noise_level(read) == pytest.approx(READ / math.sqrt(12.0), rel=0.25)
    assert reading_noise_level(np.zeros(1000)) == 0.0


def test_frictions_of_a_servo_that_pauses() -> None:
    """With the noise of its pauses the speed would be taken for far more precise than it is, and friction for hysteresis."""
    names, found = explained("moves", coulomb=0.04, forwards=0.02, gear=0.15)
    assert set(names) == {VISCOUS, COULOMB, GEAR} and found.leftovers == ()
    # The gear here rubs by the mean of what both its sides bear, that of the library by what the motor gives.
    assert names[GEAR]["fraction"] == pytest.approx(0.15, rel=0.15)
    assert names[COULOMB]["coulomb"] == pytest.approx(0.04, rel=0.3)
    assert names[VISCOUS]["viscous"] == pytest.approx(0.02, rel=0.1)


def test_a_gear_that_rubs_by_what_its_motor_gives() -> None:
    """Of noisy accelerations the force seemed never small: the gear came out too large, and Coulomb friction as unknown."""
    for kind in ("moves", "sines"):
        names, found = explained(kind, coulomb=0.04, gear=0.15, motor=1.0)
        assert set(names) == {GEAR, COULOMB} and found.leftovers == ()
        assert names[GEAR]["fraction"] == pytest.approx(0.15, rel=0.02)
        assert names[COULOMB]["coulomb"] == pytest.approx(0.04, rel=0.05)


def test_frictions_that_are_found_only_together() -> None:
    """Beside one of them alone the other, and what differs by direction, look like slow noise."""
    names, found = explained("turning", coulomb=0.03, forwards=0.02, backwards=0.035)
    assert set(names) == {VISCOUS, COULOMB} and found.leftovers == ()
    assert names[VISCOUS]["viscous"] == pytest.approx(0.0275, rel=0.05)
    assert names[VISCOUS]["asymmetry"] == pytest.approx(-0.0075, rel=0.1)
    assert names[COULOMB]["coulomb"] == pytest.approx(0.03, rel=0.05)


def test_a_motor_that_is_late_by_samples() -> None:
    """Where friction changes its sign a delay is nothing that a slope tells of."""
    names, found = explained("sines", coulomb=0.04, lag=0.02)
    assert set(names) == {COULOMB} and names[COULOMB]["coulomb"] == pytest.approx(0.04, rel=0.1)
    offset = [n.name for n in found.search.problem.nuisances].index("clock_offset")
    # What is left of it where the force was put back by 20 ms; a command is held for half a sample, besides.
    assert found.fit.mean[offset] == pytest.approx(-0.0025, abs=0.003)


def test_a_force_that_acts_much_later_is_put_back() -> None:
    """From far off no slope leads there. Said of every recording of the analysis."""
    for kind, gear, lag, late in (("sines", 0.0, 0.0, None), ("turning", 0.2, 0.0, None), ("sines", 0.0, 0.04, 35.0)):
        axis, recording = recorded(kind, coulomb=0.05, forwards=0.02, gear=gear, lag=lag)
        subject = AxisSubject(axis)
        opened = [Opened(recording, InputFinding("servo", "", 60.0, role, ())) for role in ("fit", "holdout")]
        right = subject.put_right(subject.problem(opened[:1]), opened)
        if late is None:
            assert right is opened
            continue
        for one in right:
            assert one.finding.warnings[-1].startswith(f"the force acts about {late:.0f} ms later than recorded")
            expected = np.interp(recording.time - 1e-3 * late, recording.time, recording.force)
            np.testing.assert_allclose(one.recording.force, expected, atol=1e-12)


def test_a_motor_that_gives_less_than_it_is_told() -> None:
    """The acceleration is mostly noise in the wide band; how much torque it takes is fitted in the channel's."""
    names, found = explained("sines", gain=0.7)
    assert set(names) == {"torque_constant_error"} and found.leftovers == ()
    # Inertia and moment are known to 5 % each, and share what their description is off.
    assert names["torque_constant_error"]["error"] == pytest.approx(-0.3, abs=0.02)


def test_frictions_beside_an_error_of_the_torque_constant_are_those_at_the_joint() -> None:
    """They came out as large as they are reported, 1.4 times too large, and not within their intervals."""
    truth = {COULOMB: ("coulomb", 0.05), VISCOUS: ("viscous", 0.03)}
    _, found = explained("sines", coulomb=0.05, forwards=0.03, gain=0.7)
    assert {named.term.effect for named in found.named} == {*truth, "torque_constant_error"} and found.leftovers == ()
    axis, recording = recorded("sines", coulomb=0.05, forwards=0.03, gain=0.7)
    for named in found.named:
        parameter, value = truth.get(named.term.effect, ("error", -0.3))
        estimate = named.estimates[parameter]
        assert estimate.low < value < estimate.high and estimate.value == pytest.approx(value, rel=0.05)
    # Of the simulated robot the same, and with all of them at work nothing is left of the recording.
    folds = SimpleNamespace(proposed=range(3), instances=found.fit.instances, nuisances=len(found.search.problem.nuisances))
    folds.span = lambda index: HeldOut.span(folds, index)  # type: ignore[arg-type]
    prover = SimpleNamespace(laws=SimpleNamespace(laws={}), subject=AxisSubject(axis))
    numbers = {"inertia": 0.0, "gravity_moment": 0.0, "hanging_position": 0.0}
    patched = Prover._patched(prover, found.search.problem, folds, found.fit.mean, numbers, None).axis  # type: ignore
    for named in found.named:
        assert {e.name: e.parameters for e in patched.physics}[named.term.effect] == pytest.approx(named.effect.parameters)
    left = [AxisProblemBuilder(one, [recording]).build(0.01) for one in (patched, axis)]
    sizes = [float(np.std(problem.residual[problem.valid])) for problem in left]
    assert sizes[0] < 0.15 * sizes[1]


def test_an_error_of_the_torque_constant_beside_a_described_friction() -> None:
    """What is described of the joint is reported in another size, too; it was an unknown law, or a Stribeck friction."""
    for kind, gain in (("sines", 0.7), ("moves", 1.2)):
        axis, recording = recorded(kind, coulomb=0.05, forwards=0.03, gain=gain)
        known = (
            EffectInstance(COULOMB, ("axis",), {"coulomb": 0.05, "asymmetry": 0.0, "smoothing_speed": 1e-3}),
            EffectInstance(VISCOUS, ("axis",), {"viscous": 0.03, "asymmetry": 0.0}),
        )
        builder = AxisProblemBuilder(dataclasses.replace(axis, physics=known), [recording])
        found = explain(builder.build(builder.choose_smoothing()), np.random.default_rng(0))
        [named] = found.named
        error = named.estimates["error"]
        assert named.term.effect == "torque_constant_error" and found.leftovers == ()
        assert error.low < gain - 1.0 < error.high and error.value == pytest.approx(gain - 1.0, abs=0.01)


def test_an_error_of_the_torque_constant_may_be_a_load() -> None:
    """Inertia and arm of an axis that are heavier by one factor are a motor that gives less by it; it was certain."""
    _, found = explained("sines", gain=0.7)
    [named] = found.named
    assert named.ambiguous_with == ("payload_mass",) and named.probability <= 0.5


def test_numbers_of_an_axis_that_no_healthy_one_has_are_of_the_balance() -> None:
    """An arm that is too heavy was a certain error of the torque constant, which shares it out with the inertia."""
    numbers = [
        SimpleNamespace(name=name, narrowed=1.0, loose=False, deviation=1.0)
        for name in ("inertia", "gravity_moment", "hanging_position", "clock_offset")
    ]
    strained = strained_of_the_balance(SimpleNamespace(nuisances=numbers), SimpleNamespace(mean=[-5.0, 5.0, 5.0, 5.0]))  # type: ignore[arg-type]
    assert strained == ["inertia", "gravity_moment"]


@pytest.mark.parametrize("kind", ["moves", "sines"])
def test_half_a_sample_of_a_held_command_is_no_friction(kind: str) -> None:
    """Its column was too small where an acceleration takes it: the delay came out too long, and the friction too small."""
    names, found = explained(kind, coulomb=0.04, forwards=0.02)
    assert set(names) == {COULOMB, VISCOUS}
    assert names[VISCOUS]["viscous"] == pytest.approx(0.02, rel=0.004)
    offset = [n.name for n in found.search.problem.nuisances].index("clock_offset")
    assert found.fit.mean[offset] == pytest.approx(-0.5 / RATE, abs=0.0003)


def test_how_fast_a_described_friction_reverses_is_nothing_that_is_missing() -> None:
    """With a smoothing of another size than the drive's own, a Stribeck friction of nearly that speed mended it."""
    axis, recording = recorded("sines", coulomb=0.12)
    for smoothing in (1e-3, 0.3):
        known = EffectInstance(COULOMB, ("axis",), {"coulomb": 0.12, "asymmetry": 0.0, "smoothing_speed": smoothing})
        builder = AxisProblemBuilder(dataclasses.replace(axis, physics=(known,)), [recording])
        found = explain(builder.build(builder.choose_smoothing()), np.random.default_rng(0))
        assert found.named == () and found.leftovers == ()


def test_a_speed_that_is_later_than_the_position_is_not_used(tmp_path: Path) -> None:
    """Behind the filter of a servo's firmware its acceleration is late, and a viscous friction was none any more."""
    axis, recording = recorded("sines", coulomb=0.04, forwards=0.02)
    axis = dataclasses.replace(axis, columns=axis.columns | {"velocity": Column("qd", "rad/s")})
    speed = np.convolve(np.gradient(recording.position, 1.0 / RATE), np.ones(9) / 9.0, "same")
    for lag, used in ((0.0, True), (0.03, False)):
        pole = math.exp(-1.0 / (lag * RATE)) if lag else 0.0
        read = signal.lfilter([1.0 - pole], [1.0, -pole], speed)
        rows = np.stack([recording.time, recording.position, recording.force, read], axis=1)
        np.savetxt(tmp_path / "servo.csv", rows, delimiter=",", header="t,q,tau,qd", comments="")
        opened = AxisSubject(axis).open(tmp_path / "servo.csv", "fit", {})
        assert (opened.recording.velocity is not None) == used
        assert any("later than position" in warning for warning in opened.finding.warnings) != used
    assert lateness(dataclasses.replace(recording, velocity=np.zeros(len(read)))) == 0.0  # that says nothing


def test_an_inertia_that_is_half_of_the_described_one_is_no_error_of_the_torque_constant() -> None:
    """Which would relieve the inertia, and strain the arm's moment instead."""
    names, found = explained("sines", coulomb=0.04, forwards=0.02, inertia=2.0 * INERTIA)
    assert set(names) == {COULOMB, VISCOUS} and found.leftovers == ()
    assert found.search.problem.remarks == ()
    assert found.fit.mean[0] == pytest.approx(-INERTIA, rel=0.02)


def test_frictions_show_beside_what_the_library_does_not_hold() -> None:
    """Under the noise that an arm nobody described looks like, no friction is found."""
    names, found = explained("sines", coulomb=0.04, forwards=0.02, moment=None)
    assert set(names) == {COULOMB, VISCOUS} and [left.depends_on for left in found.leftovers] == [("position",)]
    assert names[COULOMB]["coulomb"] == pytest.approx(0.04, rel=0.1)
    assert names[VISCOUS]["viscous"] == pytest.approx(0.02, rel=0.1)


def test_what_only_relieves_numbers_beside_a_law_is_not_named() -> None:
    """A stop on one side: numbers that mend its curve are strained, and a torque constant would take that from them."""
    names, found = explained("sines", coulomb=0.03, stop=0.4)
    assert set(names) == {COULOMB} and found.leftovers[0].depends_on == ("position",)
    assert names[COULOMB]["coulomb"] == pytest.approx(0.03, rel=0.15)


def test_signs_and_units_that_are_wrong_are_told() -> None:
    """By the inertia that the force asks for."""
    for turned, told in ((-1.0, "points the other way"), (180.0 / math.pi, "degrees for rad")):
        _, found = explained("sines", coulomb=0.04, turned=turned)
        [remark] = found.search.problem.remarks
        assert told in remark and "inertia of 0.0196" not in remark.split(",")[0]


def test_a_time_in_another_unit_is_refused() -> None:
    """Milliseconds read as seconds are a sample every five seconds."""
    rng = np.random.default_rng(0)
    time, read = 5.0 * np.arange(2000.0), rng.standard_normal((2, 2000))
    slow = AxisRecording(Path("slow.csv"), time, read[0], None, read[1], np.zeros(2000), ())
    axis = parse_axis_description({
        "format": "pcw_axis/1", "name": "servo", "kind": "rotary", "provenance": {"all": "made up"},
        "columns": {"time": "t", "position": "q", "force": "tau"}, "inertia": INERTIA,
    })  # fmt: skip
    with pytest.raises(MismatchError, match=r"slow\.csv: 0\.2 samples a second by columns\.time"):
        AxisProblemBuilder(axis, [slow])


def test_a_speed_that_is_recorded_is_judged_by_its_own_noise() -> None:
    """Not by the steps of the position beside it, by which the axis would seem to stand still all the time."""
    axis, recording = recorded("sines", coulomb=0.04, forwards=0.02)
    rng = np.random.default_rng(1)
    speed = np.gradient(recording.position, 1.0 / RATE)
    smooth = np.convolve(speed, np.ones(9) / 9.0, "same") + 1e-3 * rng.standard_normal(len(speed))
    coarse = np.round(recording.position / (4.0 * READ)) * 4.0 * READ
    builder = AxisProblemBuilder(axis, [dataclasses.replace(recording, position=coarse, velocity=smooth)])
    problem = builder.build(builder.choose_smoothing())
    assert problem.valid.mean() > 0.9


def test_what_is_a_function_of_a_law_s_own_arguments_is_not_named_beside_it() -> None:
    """A gear that rubs by the weight on its far side is a law of angle and speed, which holds all frictions by the speed."""
    problem = SimpleNamespace(terms=[
        SimpleNamespace(effect="load_dependent_friction", arguments=("velocity", "force")),
        SimpleNamespace(effect="unknown", arguments=("position", "velocity")),
        SimpleNamespace(effect="drive_stribeck_friction", arguments=("velocity",)),
        SimpleNamespace(effect="constant_load", arguments=()),
    ])  # fmt: skip
    name, law, mends, another = (Instance(k, (), (0,)) for k in range(4))
    fitted: list[tuple[Instance, ...]] = []

    def chosen(instances: tuple[Instance, ...]) -> SimpleNamespace:
        fitted.append(instances)
        fit = SimpleNamespace(instances=instances, log_evidence=10.0 * len(instances))
        return SimpleNamespace(
            fit=fit, threshold=3.0, regression=SimpleNamespace(fit=lambda own: SimpleNamespace(log_evidence=10.0 * len(own)))
        )

    for grown, wanted in (((name, law, mends), (name, law)), ((name, law, mends, another), (name, law, another))):
        search = SimpleNamespace(
            problem=problem, grow=lambda regression, instances, least, grown=grown: grown,
            improve=lambda regression, instances: instances, whiten_beside=lambda instances: None,
            prune=lambda regression, instances, threshold: chosen(instances),
            made_exact=lambda instances: instances, conclude=lambda instances, threshold: chosen(instances),
        )  # fmt: skip
        found = open_set._with_names_beside(search, chosen((name, law)))  # type: ignore[arg-type]
        assert found.fit.instances == wanted
