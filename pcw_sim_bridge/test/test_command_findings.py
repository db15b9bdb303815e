"""Between command and torque: lags and dead times of single joints, and what all joints of an axis have alike."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest
from scipy import optimize

from pcw_description import load_robot
from pcw_description.effect_instance import EffectInstance
from pcw_sim_bridge.mismatch.challenge.simulated_case import Run, World, simulate
from pcw_sim_bridge.mismatch.findings.command_findings import _not_borne_out, command_findings, with_rivals
from pcw_sim_bridge.mismatch.findings.explanation import Explanation, NamedTerm
from pcw_sim_bridge.mismatch.findings.findings import REFUSED
from pcw_sim_bridge.mismatch.readings.held_commands import held_commands
from pcw_sim_bridge.mismatch.readings.reported_torques import (
    coarse_step,
    doubtful_reports,
    told_of,
    unlikely_factor,
)
from pcw_sim_bridge.mismatch.regression.whitened_regression import Instance
from pcw_sim_bridge.mismatch.robot.command_tracking import command_problems
from pcw_sim_bridge.mismatch.subjects.robot_subject import RobotSubject
from pcw_sim_bridge.plants.factory import make_plant

ROBOT = load_robot("dyros_pcv")


class UnevenWorld(World):
    """A loop that does not keep its time: in steps of 1 ms, commands at 300 Hz are held over 3, 3 and 4 ms in turn."""

    def make(self, robot, effects):
        return make_plant(self.plant, robot, 1e-3)


def found(*effects, robot=ROBOT):
    recording = simulate(UnevenWorld(robot, robot, "reduced"), Run("run", "identification", 15.0, 3), effects)
    return command_findings(command_problems(robot, [recording]), (), 0, None, lambda message: None)


@pytest.mark.parametrize(
    ("effect", "parameters", "other"),
    [("actuator_delay", {"delay": 0.0026}, "actuator_lag"), ("actuator_lag", {"time_constant": 0.008}, "actuator_delay")],
)
def test_what_all_steerings_have_alike_is_one_effect_with_its_name(effect, parameters, other):
    """A delay was named a lag of each steering, with certainty: intervals were taken to be as long as their median."""
    findings = found(EffectInstance(effect, ROBOT.caster_names, parameters, "steer"))
    [(named, instance)] = findings.named
    assert (instance.name, instance.target, instance.axis) == (effect, ROBOT.caster_names, "steer")
    [(name, true)] = parameters.items()
    estimate = named.estimates[name]
    assert estimate.low < true < estimate.high and estimate.value == pytest.approx(true, rel=0.2)
    [place] = findings.locations
    assert place.casters == ROBOT.caster_names and len(place.channels) == ROBOT.n
    assert other not in named.ambiguous_with


@pytest.mark.parametrize("delay", [0.0022, 0.0033, 0.0062])
def test_a_dead_time_that_reaches_a_little_into_a_cycle_is_one_and_as_long_as_it_is(delay):
    """One of 2.1 ms changes a tenth of a torque at 300 Hz, and only where a command was held over 3 ms. No time on the grid
    had less than twice of that: two drives were given a lag, another was silent as it lies near what noise hides.
    """
    [(named, instance)] = found(EffectInstance("actuator_delay", ROBOT.caster_names, {"delay": delay}, "drive")).named
    assert (instance.name, instance.target, instance.axis) == ("actuator_delay", ROBOT.caster_names, "drive")
    estimate = named.estimates["delay"]
    assert estimate.value == pytest.approx(delay, rel=0.02)
    assert 0.0 < estimate.high - estimate.low < 0.05 * delay


def test_a_dead_time_that_reaches_a_little_into_the_second_cycle_is_none_of_a_single_one():
    """At 250 Hz one of 7.1 ms is one of a cycle, 4 to 7 ms, and a tenth of another. With no time on the grid between 6.3 and
    8.2 ms it was said to be 3.864 ms, give or take 0.010.
    """
    robot = load_robot("tidybot2")
    concealed = EffectInstance("actuator_delay", robot.caster_names, {"delay": 0.0071}, "steer")
    [(named, instance)] = found(concealed, robot=robot).named
    assert (instance.name, instance.axis) == ("actuator_delay", "steer")
    estimate = named.estimates["delay"]
    assert estimate.low < 0.0071 < estimate.high and estimate.value == pytest.approx(0.0071, rel=0.02)


def test_a_dead_time_of_many_cycles_is_as_long_as_it_is():
    """At 500 Hz all of 10 to 11 ms are one; with no time on the grid beyond, one of 11.16 ms was 9.96, give or take 0.03."""
    robot = load_robot("thesis")
    concealed = EffectInstance("actuator_delay", robot.caster_names, {"delay": 0.01116}, "steer")
    [(named, instance)] = found(concealed, robot=robot).named
    assert (instance.name, instance.target, instance.axis) == ("actuator_delay", robot.caster_names, "steer")
    estimate = named.estimates["delay"]
    assert estimate.low < 0.01116 < estimate.high and estimate.value == pytest.approx(0.01116, rel=0.02)


@pytest.mark.parametrize("searched", [pytest.param(True, marks=pytest.mark.nightly), False])
def test_a_proof_needs_no_numbers_to_try(searched):
    """Those for the held-out joints were half of the work of this search."""
    effect = EffectInstance("actuator_delay", ROBOT.caster_names, {"delay": 0.011}, "steer")
    runs = [simulate(World(ROBOT, ROBOT, "reduced"), Run("run", "identification", 10.0, seed), [effect]) for seed in (3, 4)]
    others = command_problems(ROBOT, runs[1:], searched)
    assert all(len(term.shapes) > 1 if searched else not term.shapes for problem in others for term in problem.terms)
    findings = command_findings(command_problems(ROBOT, runs[:1]), others, 0, None, lambda message: None)
    proofs = {proof.name: proof for proof in findings.proofs}
    for name in ROBOT.caster_names:
        proof = proofs[f"command_tracking/{name}_steer"]
        assert proof.after < 1.1 * proof.floor < 0.5 * proof.before


@pytest.mark.parametrize("borne_out", [True, False])
def test_what_held_out_commands_do_not_bear_out_is_not_proposed(borne_out):
    """Of every twelfth message two limits of torque were named, with certainty; held out the error was larger with them."""
    lag = EffectInstance("actuator_lag", ROBOT.caster_names[:1], {"time_constant": 0.008}, "steer")
    runs = [
        simulate(World(ROBOT, ROBOT, "reduced"), Run("run", "identification", 12.0, seed), effects)
        for seed, effects in ((3, [lag]), (4, [lag] if borne_out else []))
    ]
    findings = command_findings(
        command_problems(ROBOT, runs[:1]), command_problems(ROBOT, runs[1:], False), 0, None, lambda message: None
    )
    assert [named.term.effect for named, _ in findings.named] == (["actuator_lag"] if borne_out else [])
    refused = [step for step in findings.ladder if step.outcome.startswith(REFUSED)]
    assert len(refused) == len(findings.notes) == (0 if borne_out else 1)
    assert all("actuator_lag" in step.description and step.gain < 0.0 for step in refused)


def test_joints_that_say_the_same_are_borne_out_together_or_not_at_all():
    """Of four drives with one dead time held-out data contradicted two; of the others they said next to nothing."""
    recording = simulate(World(ROBOT, ROBOT, "reduced"), Run("run", "identification", 12.0, 3), ())
    problems = [p for p in command_problems(ROBOT, [recording]) if p.channels[0].axis == "drive"]
    lag = next(k for k, term in enumerate(problems[0].terms) if term.effect == "actuator_lag")
    instance = Instance(lag, (("time_constant", 0.0014),), problems[0].terms[lag].base_indices())
    term = problems[0].terms[lag]

    def explained(part):
        named = NamedTerm(instance, term, {}, 1.0, (), 9.0, 9.0, np.zeros((1, 1)))
        mean = np.r_[np.zeros(len(problems[0].nuisances)), [part] * len(instance.active)]
        fit = SimpleNamespace(instances=(instance,), mean=mean)
        return SimpleNamespace(named=(named,), fit=fit)

    others = {p.channels[0].name: p for p in problems}
    against, hardly = explained(1.0), explained(0.0)
    names = [p.channels[0].name for p in problems]
    assert set(_not_borne_out(problems, others, [against, hardly, hardly, None])) == set(names[:3])
    assert _not_borne_out(problems, others, [hardly, hardly, hardly, None]) == {}


@pytest.mark.parametrize(("part_of_a_delay", "doubted"), [(90.0, True), (-2.0, True), (-20.0, False)])
def test_what_a_part_of_another_effect_explains_as_well_is_named_with_it(part_of_a_delay, doubted):
    """A dead time of 2.1 ms at 300 Hz shows in a part of the samples; two of four drives were given a lag, p = 1."""
    recording = simulate(World(ROBOT, ROBOT, "reduced"), Run("run", "identification", 15.0, 3), ())
    problem = command_problems(ROBOT, [recording])[0]
    lag, delay = ([term.effect for term in problem.terms].index(f"actuator_{kind}") for kind in ("lag", "delay"))
    instance = Instance(lag, (("time_constant", 0.0014),), problem.terms[lag].base_indices())
    best = problem.terms[delay].shapes[3]

    def fit(instances):
        found = [i for i in instances if i.term == delay and dict(i.shape) == best]
        return SimpleNamespace(log_evidence=100.0 + part_of_a_delay if found else 0.0)

    named = NamedTerm(instance, problem.terms[lag], {}, 0.98, (), 100.0, 100.0, np.zeros((1, 1)))
    selection = SimpleNamespace(
        fit=SimpleNamespace(instances=(instance,), log_evidence=100.0), regression=SimpleNamespace(fit=fit)
    )
    search, rest = SimpleNamespace(problem=problem), ((), (), None, (), np.zeros(1), np.ones(1))
    explanation = Explanation(search, selection, (named,), *rest)  # type: ignore[arg-type]
    [entry] = with_rivals(explanation).named
    assert entry.ambiguous_with == (("actuator_delay",) if doubted else ())
    assert entry.probability == pytest.approx(0.49 if doubted else 0.98)


LIMIT = {"torque": 1.16, "knee_speed": 1e4, "no_load_speed": 1e5}  # which all four drives reach, two for a few samples


@pytest.mark.parametrize("limited", [ROBOT.caster_names, ROBOT.caster_names[:2]])
def test_drives_that_hardly_reached_the_limit_of_the_others_have_it_unless_they_did_more(limited):
    """It was a limit of two drives, of all four."""
    limit = LIMIT if len(limited) == ROBOT.n else LIMIT | {"torque": 1.0}
    effect = EffectInstance("torque_saturation", limited, limit, "drive")
    recording = simulate(World(ROBOT, ROBOT, "reduced"), Run("run", "identification", 12.0, 1), [effect])
    findings = command_findings(command_problems(ROBOT, [recording]), (), 0, None, lambda message: None)
    assert {caster for _, instance in findings.named for caster in instance.target} == set(limited)
    for named, _ in findings.named:
        assert named.estimates["torque"].value == pytest.approx(limit["torque"], rel=0.01)
    assert len(findings.notes) == (1 if len(limited) == ROBOT.n else 0)


def test_a_limit_that_one_drive_seldom_reaches_is_its_own():
    """It moves less than a quarter of the noise, and was called a detail of that drive; so all four together were given it."""
    run = Run("run", "identification", 30.0, 1)
    healthy = simulate(World(ROBOT, ROBOT, "reduced"), run, ())
    asked, noise = np.abs(healthy.joint_commands.effort[:, 1, 0]), ROBOT.sensors.encoders.torque_noise
    beyond = optimize.brentq(lambda t: np.sqrt(np.mean(np.maximum(asked - t, 0.0) ** 2)) - 0.18 * noise, 0.0, asked.max())
    limit = EffectInstance("torque_saturation", ROBOT.caster_names[1:2], LIMIT | {"torque": float(beyond)}, "drive")
    recording = simulate(World(ROBOT, ROBOT, "reduced"), run, [limit])
    findings = command_findings(command_problems(ROBOT, [recording]), (), 0, None, lambda message: None)
    [(named, instance)] = findings.named
    assert (instance.name, instance.target) == ("torque_saturation", limit.target)
    assert named.estimates["torque"].low < beyond < named.estimates["torque"].high


def test_one_joint_at_fault_is_named_alone():
    effects = [EffectInstance("actuator_lag", (ROBOT.caster_names[k],), {"time_constant": t}, "drive")
               for k, t in ((0, 0.004), (2, 0.012))]  # fmt: skip
    findings = found(*effects)
    assert sorted(instance.target for _, instance in findings.named) == sorted(effect.target for effect in effects)
    assert {place.casters for place in findings.locations} == {effect.target for effect in effects}


@pytest.mark.parametrize("lagging", [pytest.param(slice(None), marks=pytest.mark.nightly), slice(0, 1)])
def test_what_no_joint_says_clearly_enough_all_of_them_may(lagging):
    """Of gentle motion each of four steerings had 3 nats for a lag, none was named, and nothing was missing."""
    robot = load_robot("tidybot2")
    effect = EffectInstance("actuator_lag", robot.caster_names[lagging], {"time_constant": 0.006}, "steer")
    recording = simulate(World(robot, robot, "reduced"), Run("run", "figure8", 21.0, 3), [effect])
    findings = command_findings(command_problems(robot, [recording]), (), 0, None, lambda message: None)
    if len(effect.target) < robot.n:
        assert findings.named == ()
        return
    [(named, instance)] = findings.named
    assert (instance.name, instance.target, instance.axis) == (effect.name, robot.caster_names, "steer")
    estimate = named.estimates["time_constant"]
    assert estimate.low < 0.006 < estimate.high < 0.01
    assert named.probability > 0.9 and named.loss > 9.0


def test_nothing_is_named_where_commands_are_followed():
    assert found().named == ()


def test_torques_logged_with_the_state_they_were_computed_from_are_no_dead_time():
    """Another simulator's recordings: every drive was said to answer one period late, with certainty."""
    recording = simulate(World(ROBOT, ROBOT, "reduced"), Run("run", "identification", 15.0, 3), ())
    commands, joints = recording.joint_commands, recording.joint_states
    held = np.searchsorted(commands.stamp, joints.stamp + 1e-6) - 1
    noise = 0.02 * np.random.default_rng(1).standard_normal(joints.effort.shape)
    logged = dataclasses.replace(joints, effort=commands.effort[held] + noise)
    recording = dataclasses.replace(recording, joint_states=logged)
    problems = command_problems(ROBOT, [recording])
    assert command_findings(problems, (), 0, None, lambda message: None).named == ()
    for problem in problems:
        assert np.std(problem.residual) == pytest.approx(0.02, rel=0.05)


@pytest.mark.parametrize("later", [0.0, 1.0])
def test_stamps_that_tremble_are_no_dead_time(later):
    """Half of the commands seem to come before the state that they answer, and the drives to obey some intervals late."""
    recording = simulate(World(ROBOT, ROBOT, "reduced"), Run("run", "identification", 15.0, 3), ())
    commands, joints = recording.joint_commands, recording.joint_states
    held = np.searchsorted(commands.stamp, joints.stamp + (2.0 * later - 1.0) * 1e-6) - 1
    rng = np.random.default_rng(1)

    def tremble(stamp):
        return np.maximum.accumulate(stamp + 5e-5 * rng.standard_normal(len(stamp)))

    effort = commands.effort[held] + 0.02 * rng.standard_normal(joints.effort.shape)
    joints = dataclasses.replace(joints, stamp=tremble(joints.stamp), effort=effort)
    commands = dataclasses.replace(commands, stamp=tremble(commands.stamp))
    recording = dataclasses.replace(recording, joint_states=joints, joint_commands=commands)
    assert command_findings(command_problems(ROBOT, [recording]), (), 0, None, lambda message: None).named == ()


def recorded(effects):
    return simulate(World(ROBOT, ROBOT, "reduced"), Run("run", "identification", 15.0, 3), effects)


def through_a_busy_network(recording, part, lost, seed=2):
    """The recording with stamps that tremble by up to so much of a cycle either way, and with a part of its messages lost."""
    rng = np.random.default_rng(seed)
    joints, commands = recording.joint_states, recording.joint_commands

    def received(series, fields):
        cycle = np.median(np.diff(series.stamp))
        stamp = np.maximum.accumulate(series.stamp + part * cycle * rng.uniform(-1.0, 1.0, len(series)))
        kept = rng.random(len(series)) >= lost
        values = {name: getattr(series, name)[kept] for name in fields}
        return dataclasses.replace(series, stamp=stamp[kept], stamp_ns=series.stamp_ns[kept], **values)

    return dataclasses.replace(
        recording, joint_states=received(joints, ("position", "velocity", "effort")),
        joint_commands=received(commands, ("effort",)),
    )  # fmt: skip


@pytest.mark.parametrize(("part", "lost"), [(0.0, 0.02), (0.25, 0.0), (0.25, 0.03)])
def test_a_busy_network_is_no_drive_that_lags(part, lost):
    """A command that took the place of the next, or of one that was lost, was a lag of all drives by half a cycle."""
    recording = through_a_busy_network(recorded(()), part, lost)
    held, joints = held_commands(ROBOT, recording), recording.joint_states
    problems = command_problems(ROBOT, [recording])
    assert len(problems) == 2 * ROBOT.n
    # What was lost is known to be, but for few of which tremble hides it, and the rest is what was reported.
    assert np.mean(np.isnan(held[1:])) == pytest.approx(lost, abs=0.004)
    rest = joints.effort - held
    noise = np.sqrt(np.nanmean((joints.effort - np.roll(joints.effort, 1, axis=0)) ** 2))
    assert np.nanmean(np.abs(rest) > noise) < 0.01
    for problem in problems:
        assert problem.valid.mean() == pytest.approx((1.0 - lost) ** 3, abs=0.01)
    findings = command_findings(problems, (), 0, None, lambda message: None)
    assert not findings.named and not findings.leftovers


def test_stamps_of_arrival_that_scatter_do_not_tell_what_a_drive_makes_of_its_commands():
    """Delays of a period as a rule: which command a report answers is open, and a dead time of all drives was named."""
    plain = recorded(())
    assert doubtful_reports(ROBOT, through_a_busy_network(plain, 0.25, 0.03)) == {}
    rng = np.random.default_rng(3)

    def arrived(series):
        late = rng.exponential(np.median(np.diff(series.stamp)), len(series))
        return dataclasses.replace(series, stamp=np.maximum.accumulate(series.stamp + late) + 1e-7 * np.arange(len(series)))

    for late in ({"joint_states", "joint_commands"}, {"joint_commands"}):
        recording = dataclasses.replace(plain, **{name: arrived(getattr(plain, name)) for name in late})
        doubtful = doubtful_reports(ROBOT, recording)
        assert set(doubtful) == set(np.ndindex(ROBOT.n, 2))
        [told] = told_of(ROBOT, doubtful)
        assert "scatter by" in told and (("joint_states scatter" in told) == ("joint_states" in late))
        assert command_problems(ROBOT, [recording]) == []


def test_a_drive_that_lags_is_found_through_a_busy_network():
    lag = EffectInstance("actuator_lag", ROBOT.caster_names, {"time_constant": 0.004}, "drive")
    recording = through_a_busy_network(recorded([lag]), 0.25, 0.03)
    findings = command_findings(command_problems(ROBOT, [recording]), (), 0, None, lambda message: None)
    [(named, instance)] = findings.named
    assert (named.term.effect, instance.target, instance.axis) == ("actuator_lag", ROBOT.caster_names, "drive")
    assert named.estimates["time_constant"].value == pytest.approx(0.004, rel=0.1)


@pytest.mark.parametrize(("controller", "told"), [("computed_torque", False), ("velocity_loops", True)])
def test_where_speeds_are_commanded_the_report_says_what_nobody_sees(controller, told):
    """A dead time of four drives that hold speeds was "nothing is missing", and no word that it could not have been seen."""
    recording = simulate(World(ROBOT, ROBOT, "reduced", controller), Run("run", "identification", 12.0, 3), ())
    absent = dict(RobotSubject(ROBOT).absent([SimpleNamespace(recording=recording)]))
    assert ("effort in joint_commands" in absent) == told


@pytest.mark.parametrize(("step", "coarse"), [(0.05, True), (0.5, True), (2.0, True), (1e-3, False), (0.0, False)])
def test_torques_in_steps_as_large_as_themselves_are_no_evidence(step, coarse):
    """Of drives that were asked for less than such a step nearly all reports were zero: a saturation at 3 mN m, p = 1."""
    torque = 0.17 * np.sin(np.linspace(0.0, 30.0, 2000))
    reported = np.round(torque / step) * step if step else torque
    assert (coarse_step(reported) > 0.0) == (coarse and np.any(reported != 0.0))
    assert coarse_step(np.where(np.arange(2000) % 7, reported, np.nan)) == pytest.approx(coarse_step(reported))


@pytest.mark.parametrize(
    ("reported", "factor"),
    [
        (lambda command: -command, -1.0),
        (lambda command: 0.05 * command, 0.05),
        (lambda command: 37.0 * command, 37.0),
        (lambda command: 0.4 * command, None),  # a motor that is weak
        (lambda command: np.clip(command, -0.05, 0.05), None),  # or limited
        (lambda command: np.zeros_like(command), None),  # or off
        (lambda command: np.roll(command, 300), None),
    ],
)
def test_what_no_motor_makes_of_its_commands_is_told_from_what_one_does(reported, factor):
    """With the sign of all reports turned about two saturations were named, p = 1."""
    rng = np.random.default_rng(1)
    command = 0.2 * np.sin(np.linspace(0.0, 40.0, 3000)) + 0.1 * rng.standard_normal(3000)
    torque = reported(command) + 0.005 * rng.standard_normal(3000)
    found = unlikely_factor(command, np.where(rng.random(3000) < 0.1, np.nan, torque))
    assert found is None if factor is None else found == pytest.approx(factor, rel=0.05)
    assert unlikely_factor(command[:100], torque[:100]) is None


def test_joints_with_such_reports_are_left_out_and_told_of():
    """Their commands and torques say nothing of a motor."""
    recording = simulate(World(ROBOT, ROBOT, "reduced"), Run("run", "identification", 10.0, 3), [])
    assert doubtful_reports(ROBOT, recording) == {}
    effort = recording.joint_states.effort.copy()
    step = float(np.abs(effort[:, 0, 0]).max())
    effort[:, 0, 0] = np.round(effort[:, 0, 0] / step) * step
    effort[:, 1:3, 0] *= -1.0
    recording = dataclasses.replace(recording, joint_states=dataclasses.replace(recording.joint_states, effort=effort))
    names = {problem.channels[0].name for problem in command_problems(ROBOT, [recording])}
    left_out = [f"{name}_drive" for name in ROBOT.caster_names[:3]]
    assert len(names) == 2 * ROBOT.n - 3 and not names & {f"command_tracking/{name}" for name in left_out}
    coarse, opposite = told_of(ROBOT, doubtful_reports(ROBOT, recording))
    assert f"effort of {left_out[0]} comes in steps of {step:.2g} N m and never reached 4" in coarse
    assert f"effort of {', '.join(left_out[1:])} is opposite to what was commanded" in opposite
