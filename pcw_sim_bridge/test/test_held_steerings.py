"""Steerings that dry friction holds while they stand: what they then hold is no other effect, and their friction is whole."""

import dataclasses

import numpy as np
import pytest

from pcw_description import load_robot
from pcw_description.effect_instance import EffectInstance
from pcw_description.recording import Recording
from pcw_sim_bridge.mismatch.challenge.simulated_case import Run, World, simulate
from pcw_sim_bridge.mismatch.findings.explanation import explain
from pcw_sim_bridge.mismatch.robot.robot_channels import RobotProblemBuilder

ROBOT = load_robot("thesis")
STICKS, CREEPS = 1e-4, 0.05  # [rad/s] over which a friction is smoothed


def rubbing(casters: tuple[str, ...], smoothing_speed: float, excitation: str, duration: float) -> Recording:
    numbers = {"coulomb": 0.25, "smoothing_speed": smoothing_speed}
    effects = [EffectInstance("steer_coulomb_friction", casters, numbers)] if casters else []
    return simulate(World(ROBOT, ROBOT, "reduced"), Run("run", excitation, duration, 3), effects)


@pytest.mark.parametrize(
    ("casters", "smoothing_speed", "held"),
    [
        (("front_right",), STICKS, [False, True, False, False]),
        (ROBOT.caster_names, STICKS, [True] * 4),
        (("front_right",), CREEPS, [False] * 4),
        ((), CREEPS, [False] * 4),
    ],
)
def test_a_steering_sticks_where_it_holds_more_than_a_smoothed_friction_does(casters, smoothing_speed, held):
    builder = RobotProblemBuilder(ROBOT, [rubbing(casters, smoothing_speed, "identification", 20.0)])
    problem = builder.build()
    names = [name for name, sticks in zip(ROBOT.caster_names, held, strict=True) if sticks]
    told = [said for said in problem.remarks if said.startswith("Dry friction holds the steering of")]
    assert len(told) == bool(names) and all(name in said for name in names for said in told)
    judged = problem.valid.any(axis=1).mean()
    assert 0.2 < judged < 0.5 if names else judged > 0.9


def test_a_friction_that_is_described_sticks_all_the_same_and_so_it_does_in_other_recordings():
    numbers = {"coulomb": 0.25, "smoothing_speed": CREEPS}
    described = dataclasses.replace(ROBOT, physics=(EffectInstance("steer_coulomb_friction", ("front_right",), numbers),))
    recording = rubbing(("front_right",), STICKS, "identification", 20.0)
    builder = RobotProblemBuilder(described, [recording])
    builder.build()
    assert builder.held.tolist() == [False, True, False, False]
    # A straight line tells nothing of its friction; that it sticks is known from elsewhere.
    straight = rubbing(("front_right",), STICKS, "chirp_x", 10.0)
    alone, told = (RobotProblemBuilder(ROBOT, [straight], held=held).build() for held in (None, builder.held))
    assert told.valid.any(axis=1).sum() < 0.5 * alone.valid.any(axis=1).sum()


def test_where_steerings_that_stick_stand_nearly_all_the_time_torques_count_as_their_friction_leaves_them():
    """A dock or a corridor is driven straight on, with steerings that rub and stand.

    Too little would have been left without those samples, so that all were judged as if no steering stuck: a healthy robot,
    its friction described, had cogging steerings.
    """
    numbers = {"coulomb": 0.25, "smoothing_speed": CREEPS}
    described = dataclasses.replace(ROBOT, physics=(EffectInstance("steer_coulomb_friction", ROBOT.caster_names, numbers),))
    turning, straight = (
        rubbing(ROBOT.caster_names, STICKS, excitation, duration)
        for excitation, duration in (("identification", 20.0), ("chirp_x", 40.0))
    )
    builder = RobotProblemBuilder(described, [turning, straight])
    problem = builder.build(keys=())
    assert builder.held.all() and problem.valid.any(axis=1).mean() > 0.6
    (told,) = [said for said in problem.remarks if said.startswith("Dry friction holds the steering of")]
    assert "say little of torques" in told
    # Up to 0.25 N m of each of four steerings over 30 mm: about as much where all stand, and a part where they turn.
    doubted = problem.misjudged[:, :2].max(axis=1)
    most = 2.0 * 0.25 / 0.03
    rows = problem.valid.any(axis=1)
    assert np.median(doubted[rows & (problem.recording == 1)]) > 0.5 * most
    assert np.quantile(doubted[rows & (problem.recording == 0)], 0.2) < 0.5 * most


@pytest.mark.parametrize(
    ("casters", "excitation"),
    [
        (("front_right",), "steps"),
        pytest.param(("front_right",), "identification", marks=pytest.mark.nightly),
        pytest.param(("front_right",), "random_goals", marks=pytest.mark.nightly),
        pytest.param(ROBOT.caster_names, "identification", marks=pytest.mark.nightly),
    ],
)
def test_the_friction_of_a_steering_that_sticks_is_named_whole_and_alone(casters, excitation):
    """It was a law of the time or of the steering's speed, or two thirds of it beside a cogging that was not there."""
    problem = RobotProblemBuilder(ROBOT, [rubbing(casters, STICKS, excitation, 24.0)]).build()
    found = explain(problem, np.random.default_rng(0))
    (entry,) = found.named
    assert (entry.term.effect, entry.term.target) == ("steer_coulomb_friction", casters)
    estimate = entry.estimates["coulomb"]
    assert estimate.low < 0.25 < estimate.high and estimate.value == pytest.approx(0.25, rel=0.02)
    assert found.complete
