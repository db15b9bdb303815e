"""What tests of the ground have told of a caster, and when it no longer counts."""

import dataclasses
import math

import numpy as np
import pytest

from pcw_description import load_robot
from pcw_terrain import GroundFromTests, RobotTerrain, TerrainError, TerrainParameters, shared_friction

THESIS = load_robot("thesis")
NAN = math.nan
AT_REST, STILL = np.zeros((4, 2)), np.zeros(4)


def ground(load=200.0, valid=(False,) * 4):
    """Return estimates of a robot of which nothing is known but its loads."""
    terrain = RobotTerrain(THESIS)
    _, found = terrain.step_with_twist(terrain.initial_state(), AT_REST, AT_REST, AT_REST, np.zeros(3), 2e-3)
    return dataclasses.replace(found, normal_force=np.full(4, load), valid=np.array(valid))


def told(*mu_p, way=0.0):
    return GroundFromTests.nothing(4).hear(np.array(mu_p), np.full(4, 0.1), np.full(4, way))


def pushed(friction, load=200.0):
    """Return contact forces that use so much friction, along and across alike."""
    return np.tile(np.array([0.6, 0.8]) * friction * load, (4, 1))


def test_it_counts_for_the_casters_that_were_told_and_for_nobody_else():
    tests = told(0.5, NAN, 0.3, -1.0)
    assert tests.known.tolist() == [True, False, True, False]
    tests = tests.step(ground(), pushed(0.2), STILL, 0.01)
    assert tests.known.tolist() == [True, False, True, False]
    assert tests.mu_p[[0, 2]].tolist() == [0.5, 0.3] and tests.lambda_p[[0, 2]].tolist() == [0.1, 0.1]
    assert not GroundFromTests.nothing(4).known.any()


def test_an_own_estimate_takes_its_place_for_good():
    tests = told(0.5, 0.5, 0.5, 0.5).step(ground(valid=(True, False, False, False)), AT_REST, STILL, 0.01)
    assert tests.known.tolist() == [False, True, True, True]
    assert tests.step(ground(), AT_REST, STILL, 0.01).known.tolist() == [False, True, True, True]
    # What is only said again, with the news of another caster, is no news.
    again = tests.hear(np.array([0.5, 0.5, 0.5, 0.4]), np.full(4, 0.1), STILL)
    assert again.known.tolist() == [False, True, True, True] and again.mu_p[3] == 0.4


def test_a_wheel_that_holds_more_stands_on_another_ground():
    """A moment of it is noise, and what is as much above as below is no more."""
    tests = told(0.3, 0.6, 0.3, 0.6)
    for _ in range(9):
        tests = tests.step(ground(), pushed(0.4), STILL, 0.01)
    assert tests.known.all()
    for k in range(40):
        tests = tests.step(ground(), pushed(0.4 if k % 2 else 0.1), STILL, 0.01)
    assert tests.known.all()
    for _ in range(12):
        tests = tests.step(ground(), pushed(0.4), STILL, 0.01)
    assert tests.known.tolist() == [False, True, False, True]
    lifted = told(0.3, 0.3, 0.3, 0.3)
    for _ in range(30):  # a wheel without load holds nothing, whatever force is believed in
        lifted = lifted.step(ground(load=0.0), pushed(0.4), STILL, 0.01)
    assert lifted.known.all()


def test_it_counts_for_no_longer_a_way_than_an_own_estimate():
    reach = TerrainParameters().reach
    tests, speed = told(0.5, 0.5, 0.5, 0.5, way=1.0), np.array([0.0, 0.5, -0.5, 2.0])
    for _ in range(round(0.9 * (reach - 1.0) / 0.5 / 0.01)):
        tests = tests.step(ground(), AT_REST, speed, 0.01)
    assert tests.known.tolist() == [True, True, True, False]
    for _ in range(round(0.2 * (reach - 1.0) / 0.5 / 0.01)):
        tests = tests.step(ground(), AT_REST, speed, 0.01)
    assert tests.known.tolist() == [True, False, False, False]


def test_forces_are_shared_by_it_where_there_is_no_estimate():
    estimates = ground()
    shared = shared_friction(THESIS, told(0.3, NAN, NAN, 0.5).beside(estimates), None)
    assert shared.mu_p[[0, 3]].tolist() == [0.3, 0.5] and shared.known.tolist() == [True, False, False, True]
    # The others are taken to be as much worse than the file as the median of those that are known.
    np.testing.assert_allclose(shared.mu_p[[1, 2]], math.sqrt(0.3 * 0.5))
    nothing = shared_friction(THESIS, GroundFromTests.nothing(4).beside(estimates), None)
    np.testing.assert_array_equal(nothing.mu_p, shared_friction(THESIS, estimates, None).mu_p)


@pytest.mark.parametrize(
    ("force", "speed", "dt", "said"),
    [
        (np.full((4, 2), NAN), STILL, 0.01, "force"), (AT_REST, np.zeros(3), 0.01, "speed"), (AT_REST, STILL, 0.0, "dt"),
    ],
)  # fmt: skip
def test_what_cannot_be_is_refused(force, speed, dt, said):
    with pytest.raises(TerrainError, match=rf"{said}.*allowed"):
        told(0.5, 0.5, 0.5, 0.5).step(ground(), force, speed, dt)
