"""Between command and torque: lags and dead times of single joints, and what all joints of an axis have alike."""

import dataclasses

import numpy as np
import pytest

from pcw_description import load_robot
from pcw_description.effect_instance import EffectInstance
from pcw_sim_bridge.mismatch.challenge.simulated_case import Run, World, simulate
from pcw_sim_bridge.mismatch.command_findings import command_findings
from pcw_sim_bridge.mismatch.command_tracking import command_problems

# Its joint states come at 300 Hz, so that commands are held over 3, 3 and 4 ms in turn.
ROBOT = load_robot("dyros_pcv")


def found(*effects):
    recording = simulate(World(ROBOT, ROBOT, "reduced"), Run("run", "identification", 15.0, 3), effects)
    return command_findings(command_problems(ROBOT, [recording]), (), 0, None, lambda message: None)


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


def test_one_joint_at_fault_is_named_alone():
    effects = [EffectInstance("actuator_lag", (ROBOT.caster_names[k],), {"time_constant": t}, "drive")
               for k, t in ((0, 0.004), (2, 0.012))]  # fmt: skip
    findings = found(*effects)
    assert sorted(instance.target for _, instance in findings.named) == sorted(effect.target for effect in effects)
    assert {place.casters for place in findings.locations} == {effect.target for effect in effects}


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
