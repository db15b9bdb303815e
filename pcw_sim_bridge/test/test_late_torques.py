"""Drives that report their commands: what they make of them shows in the motion alone."""

import dataclasses

import numpy as np
import pytest
from scipy import signal

from pcw_description import load_robot
from pcw_description.effect_instance import EffectInstance
from pcw_sim_bridge.mismatch.challenge.simulated_case import Run, World, simulate
from pcw_sim_bridge.mismatch.findings.command_findings import CommandFindings, command_findings
from pcw_sim_bridge.mismatch.findings.explanation import explain
from pcw_sim_bridge.mismatch.findings.late_torques import TORQUE_LAG, with_late_torques, without_late_reports
from pcw_sim_bridge.mismatch.readings.held_commands import held_commands
from pcw_sim_bridge.mismatch.robot.command_tracking import command_problems, joints_that_report_commands
from pcw_sim_bridge.mismatch.robot.robot_channels import RobotProblemBuilder

ROBOT = load_robot("thesis")
DELAY = 0.008


def silent(message: str) -> None:
    """Tell nobody."""


@pytest.fixture(scope="module")
def echoed():
    """A recording of drives with a dead time that report what they are asked for, and what its motion says."""
    effects = [EffectInstance("actuator_delay", ROBOT.caster_names, {"delay": DELAY}, axis) for axis in ("drive", "steer")]
    recording = simulate(World(ROBOT, ROBOT, "reduced"), Run("run", "identification", 15.0, 3), effects)
    noise = 0.01 * np.random.default_rng(1).standard_normal(recording.joint_states.effort.shape)
    effort = np.nan_to_num(held_commands(ROBOT, recording)) + noise
    recording = dataclasses.replace(recording, joint_states=dataclasses.replace(recording.joint_states, effort=effort))
    explanation = explain(RobotProblemBuilder(ROBOT, [recording]).build(), np.random.default_rng(0))
    return command_problems(ROBOT, [recording]), explanation


def test_a_dead_time_behind_reports_that_are_the_commands_is_found(echoed):
    """The verdict was that nothing is missing; `torque_lag` alone was off by so many tolerances."""
    problems, explanation = echoed
    between = command_findings(problems, (), 0, None, silent)
    assert not between.named
    found = with_late_torques(between, problems, explanation)
    assert [(named.term.effect, instance.axis) for named, instance in found.named] == [
        ("actuator_delay", "drive"), ("actuator_delay", "steer"),
    ]  # fmt: skip
    for named, instance in found.named:
        assert instance.target == ROBOT.caster_names
        assert named.estimates["delay"].low < DELAY < named.estimates["delay"].high < 1.3 * DELAY
        assert named.ambiguous_with == ("actuator_lag",)
    assert [place.axis for place in found.locations] == ["drive", "steer"]
    assert found.numbers == (TORQUE_LAG,)
    assert "are the commands" in found.notes[-1]


def test_nothing_is_named_where_torques_are_late_by_what_cycles_make(echoed):
    problems, explanation = echoed
    index = [number.name for number in explanation.search.problem.nuisances].index(TORQUE_LAG)
    mean = explanation.fit.mean.copy()
    mean[index] = -1.5 / problems[0].rate
    fit = dataclasses.replace(explanation.fit, mean=mean)
    selection = dataclasses.replace(explanation.selection, fit=fit)
    prompt = dataclasses.replace(explanation, selection=selection)
    assert prompt.fit.mean[index] == mean[index]
    assert with_late_torques(CommandFindings(), problems, prompt) == CommandFindings()


def test_nothing_is_named_where_reports_are_no_commands_or_some_are_missing(echoed):
    problems, explanation = echoed
    measured = [dataclasses.replace(p, residual=p.residual + 0.5 * p.measured) for p in problems]
    for others in (measured, problems[1:], ()):
        assert with_late_torques(CommandFindings(), others, explanation) == CommandFindings()


def test_of_a_drive_that_is_described_as_late_such_reports_say_nothing():
    """Else the patched description would miss what its own patch holds."""
    late = {"delay": DELAY}
    instances = tuple(EffectInstance("actuator_delay", ROBOT.caster_names, late, axis) for axis in ("drive", "steer"))
    recording = simulate(World(ROBOT, ROBOT, "reduced"), Run("run", "identification", 10.0, 3), instances)
    patched = dataclasses.replace(ROBOT, physics=instances)
    assert len(command_problems(patched, [recording])) == 2 * ROBOT.n
    effort = np.nan_to_num(held_commands(ROBOT, recording))
    echoed = dataclasses.replace(recording, joint_states=dataclasses.replace(recording.joint_states, effort=effort))
    assert command_problems(patched, [echoed]) == []
    assert joints_that_report_commands(patched, [echoed]) == list(ROBOT.joint_names)
    assert joints_that_report_commands(patched, [recording]) == []
    assert len(command_problems(ROBOT, [echoed])) == 2 * ROBOT.n


LAG = 0.004


@pytest.fixture(scope="module")
def lagging():
    """By whether drives lag: a recording in which reports follow commands late, and what its motion says."""
    found = {}
    for drives in (True, False):
        each = {"time_constant": LAG}
        effects = [EffectInstance("actuator_lag", ROBOT.caster_names, each, axis) for axis in ("drive", "steer")]
        recording = simulate(World(ROBOT, ROBOT, "reduced"), Run("run", "identification", 15.0, 3), effects if drives else ())
        if not drives:
            joints = recording.joint_states
            kept = np.exp(-np.median(np.diff(joints.stamp)) / LAG)
            start = np.nan_to_num(joints.effort[:1]) * kept
            effort, _ = signal.lfilter([1.0 - kept], [1.0, -kept], joints.effort, axis=0, zi=start)
            recording = dataclasses.replace(recording, joint_states=dataclasses.replace(joints, effort=effort))
        explanation = explain(RobotProblemBuilder(ROBOT, [recording]).build(), np.random.default_rng(0))
        problems = command_problems(ROBOT, [recording])
        found[drives] = command_findings(problems, (), 0, None, silent), problems, explanation
    return found


def test_reports_that_are_filtered_are_no_drives_that_lag(lagging):
    """The lag is between commands and reports as where drives lag; the robot moves by torques before they are reported."""
    between, problems, explanation = lagging[False]
    assert {named.term.effect for named, _ in between.named} == {"actuator_lag"}
    found = without_late_reports(between, problems, explanation)
    assert not found.named and not found.locations
    assert "it is the reports that are late" in found.notes[-1]
    assert found.numbers == (TORQUE_LAG,)
    assert [proof.after for proof in found.proofs] == [proof.before for proof in between.proofs]
    assert any(channel.flagged for channel in found.channels)


def test_drives_that_lag_stay_named_where_the_robot_lags_too(lagging):
    between, problems, explanation = lagging[True]
    assert {named.term.effect for named, _ in between.named} == {"actuator_lag"}
    assert without_late_reports(between, problems, explanation) is between


def test_reports_that_are_late_in_some_joints_say_nothing_of_all(lagging):
    """One number of the motion stands for the torques of all joints."""
    between, problems, explanation = lagging[False]
    some = dataclasses.replace(between, named=between.named[:1], locations=between.locations[:1])
    assert without_late_reports(some, problems, explanation) is some
    assert without_late_reports(CommandFindings(), problems, explanation) == CommandFindings()
