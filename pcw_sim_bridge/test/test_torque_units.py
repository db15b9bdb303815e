"""Reported torques in other units or of the other sign, told by the motion that they make."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest

from pcw_description import load_robot
from pcw_description.effect_instance import EffectInstance
from pcw_sim_bridge.mismatch.challenge.simulated_case import Run, World, simulate
from pcw_sim_bridge.mismatch.findings.findings import InputFinding
from pcw_sim_bridge.mismatch.regression.regression_problem import term_key
from pcw_sim_bridge.mismatch.robot.robot_channels import RobotProblemBuilder
from pcw_sim_bridge.mismatch.robot.torque_units import FRICTIONS, torque_units
from pcw_sim_bridge.mismatch.subjects.robot_subject import RobotSubject
from pcw_sim_bridge.mismatch.subjects.subject import Opened

THESIS, TIDYBOT = load_robot("thesis"), load_robot("tidybot2")


def recorded(robot, effects=(), excitation="identification", duration=10.0):
    return simulate(World(robot, robot, "reduced"), Run("run", excitation, duration, 3), effects)


@pytest.fixture(scope="module")
def plain():
    return recorded(THESIS)


def found(robot, recording, factor=1.0):
    """What is found wrong with torques that were reported as so many of those at the joints."""
    joints = recording.joint_states
    recording = dataclasses.replace(recording, joint_states=dataclasses.replace(joints, effort=joints.effort * factor))
    keys = {term_key("torque_constant_error", robot.caster_names, axis, None) for axis in ("drive", "steer")}
    keys |= {term_key(name, (caster,), None, None) for name in FRICTIONS for caster in robot.caster_names}
    return torque_units(robot, RobotProblemBuilder(robot, [recording]).build(keys=keys)), recording


@pytest.mark.parametrize(
    ("reported", "factors", "said"),
    [
        ((-1.0, -1.0), (-1.0, -1.0), "the drives count the other way round and those of the steerings"),
        ((0.05, 0.05), (20.0, 20.0), "before their gears of 20"),
        ((1.0, -0.05), (1.0, -20.0), "those of the steerings are the motors'"),
        ((1000.0, 1000.0), (np.nan, np.nan), "times what moves the robot"),
        ((7.0, 1.0), (np.nan, 1.0), "the drives are 7"),
    ],
)
def test_what_is_wrong_is_told_and_put_right_where_it_is_known(plain, reported, factors, said):
    """Before the gears, the robot was told to be 24 tolerances too light; the other way round, to depend on its loads."""
    units, recording = found(THESIS, plain, np.array(reported))
    assert units is not None and said in units.warning
    np.testing.assert_array_equal(units.factors, factors)
    assert units.is_known == bool(np.all(np.isfinite(factors)))
    assert ("converted" in units.warning) == units.is_known
    if units.is_known:
        states, commands = units.put_right(THESIS, recording)
        np.testing.assert_allclose(states.effort, plain.joint_states.effort)
        # The commands of this recording are those at the joints.
        np.testing.assert_array_equal(commands.effort, plain.joint_commands.effort)


@pytest.mark.parametrize(("factor", "used"), [(-1.0, True), (0.01, False)])
def test_torques_in_unknown_units_are_not_used(plain, factor, used):
    """A hundredth of the torques left "nothing missing", with masses that were 28 tolerances off."""
    joints = plain.joint_states
    reported = SimpleNamespace(**{field.name: getattr(plain, field.name) for field in dataclasses.fields(plain)})
    reported.joint_states = dataclasses.replace(joints, effort=factor * joints.effort)
    subject = RobotSubject(THESIS)
    opened = [Opened(reported, InputFinding("run", "", 10.0, "fit", (), 0.0))]
    [right] = subject.put_right(subject.problem(opened), opened)
    assert np.isfinite(right.recording.joint_states.effort).all() == used
    assert any("force" in channel.name for channel in subject.problem([right]).channels) == used
    assert right.finding.warnings[-1].endswith("converted to torques at the joints" if used else "and are left out")


def test_commands_in_the_units_of_the_reports_go_along(plain):
    commands = dataclasses.replace(plain.joint_commands, effort=-plain.joint_commands.effort)
    units, recording = found(THESIS, dataclasses.replace(plain, joint_commands=commands), -1.0)
    _, commands = units.put_right(THESIS, recording)
    np.testing.assert_allclose(commands.effort, plain.joint_commands.effort)


def test_weak_motors_and_heavy_loads_are_no_units(plain):
    assert found(THESIS, plain)[0] is None
    assert found(THESIS, plain, 0.5)[0] is None
    heavy = recorded(THESIS, [EffectInstance("payload_mass", ("chassis",), {"mass": 60.0, "x": 0.1, "y": 0.0, "z": 0.4})])
    assert found(THESIS, heavy)[0] is None


def test_steerings_that_rub_are_no_units(plain):
    """Nearly all of their torque they need for themselves, which may look like torques in other units."""
    rubbing = EffectInstance("steer_coulomb_friction", THESIS.caster_names, {"coulomb": 4.5})
    assert found(THESIS, recorded(THESIS, [rubbing]))[0] is None


@pytest.mark.parametrize("effect", ["drive_coulomb_friction", "steer_coulomb_friction"])
def test_one_joint_that_rubs_is_no_unit(effect):
    """On a plain path steerings hardly move the robot: torques 13 times too large had seemed to explain as much."""
    rubbing = EffectInstance(effect, ("front_left",), {"coulomb": 0.5})
    assert found(THESIS, recorded(THESIS, [rubbing], "figure8", 30.0))[0] is None


def test_torques_lost_in_a_joint_are_no_unit(plain):
    """A motor that works against its own cogs: no factor makes a torque of that which moves the robot."""
    joints = plain.joint_states
    effort = joints.effort.copy()
    effort[:, 0, 1] += 10.0 * np.sin(19.0 * joints.position[:, 0, 1])
    cogging = dataclasses.replace(plain, joint_states=dataclasses.replace(joints, effort=effort))
    assert found(THESIS, cogging)[0] is None


def test_steerings_of_coupled_gears_that_count_the_other_way_round_are_told():
    """Reports are of joints; what a motor does there reaches both."""
    units, _ = found(TIDYBOT, recorded(TIDYBOT), np.array([1.0, -1.0]))
    assert units is not None and units.is_known and "those of the steerings count the other way round" in units.warning


def test_motors_behind_coupled_gears_are_told_and_left(plain):
    """A turning steering turns the drive motor too: no factor makes torques at the joints of theirs."""
    units, _ = found(TIDYBOT, recorded(TIDYBOT), np.array([1.0 / 8.14, 1.0 / 12.8]))
    assert units is not None and not units.is_known and "torques at the joints [N m]" in units.warning
