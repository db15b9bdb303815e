"""What wheels hold against each other from creep alone, and what a controller is told of friction."""

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pcw_description import load_robot
from pcw_terrain import (
    RobotReading,
    RobotTerrain,
    SlipSlope,
    SlipSlopeParameters,
    TerrainError,
    shared_friction,
)
from pcw_terrain.terrain_estimator import LEAST_FRICTION

THESIS = load_robot("thesis")
DT = 0.002
LOADS = np.full(4, THESIS.total_mass * 9.81 / 4.0)


def creep(mu, lambda_p, mu_p):
    """Slip ratio on the lower root of Kiencke's curve."""
    use = np.minimum(np.abs(mu) / mu_p, 0.999)
    return np.sign(mu) * lambda_p * use / (1.0 + np.sqrt(1.0 - use**2))


def drive(mu_p, seconds=1.5, use=0.5, noise=4e-4, robot=THESIS, slopes=None, seed=0, radius=None, state=None):
    """Speed up and brake along a line while every wheel carries the same force: `use` of what the weakest one holds."""
    slopes = slopes or SlipSlope(robot)
    rng, state = np.random.default_rng(seed), state or slopes.initial_state()
    n, mu_p = robot.n, np.asarray(mu_p, dtype=float)
    z, found = np.zeros(n), None  # relaxed slip
    for k in range(round(seconds / DT)):
        t = k * DT
        velocity = 0.5 * (1.0 - math.cos(math.tau * t / seconds))
        mu = np.full(n, use * mu_p.min() * math.sin(math.tau * t / seconds))
        wanted = creep(mu, robot.contact.lambda_p, mu_p)
        slip = velocity * wanted + robot.contact.relaxation_length * (wanted - z) / DT
        z = wanted
        sensed = np.column_stack([velocity + slip, np.zeros(n)]) * (1.0 if radius is None else radius[:, None])
        sensed += rng.normal(0.0, noise, (n, 2))
        force = np.column_stack([mu * LOADS, np.zeros(n)])
        reading = RobotReading(sensed, np.zeros((n, 2)), force, np.zeros(n))
        state, found = slopes.step(state, reading, LOADS, DT)
    return state, found


def test_a_wheel_on_ice_is_found_by_its_creep_long_before_it_slips():
    """It uses half of what it holds, a quarter of its critical slip."""
    _, found = drive([0.1, 0.8, 0.8, 0.8])
    ratio = found.friction / found.friction[1:].mean()
    assert ratio[0] == pytest.approx(0.125, rel=0.2)  # the secant at half use is 7 % flatter than the slope
    np.testing.assert_allclose(ratio[1:], 1.0, rtol=0.1)
    assert found.friction[1:].mean() == pytest.approx(0.8, rel=0.1)  # the best are taken to be as the file says
    assert found.spread[0] < 0.1


def test_two_wheels_on_ice_and_a_third_ground():
    _, found = drive([0.1, 0.8, 0.1, 0.4])
    np.testing.assert_allclose(found.friction / found.friction[1], [0.125, 1.0, 0.125, 0.5], rtol=0.25)


@pytest.mark.parametrize("mu_p", [0.1, 0.8])
def test_ground_that_is_even_is_shared_evenly_whichever_it_is(mu_p):
    """What all wheels have in common is not seen, and nothing is made of it."""
    _, found = drive(4 * [mu_p])
    np.testing.assert_allclose(found.friction, found.friction.mean(), rtol=0.15)


def test_before_anything_is_felt_it_says_what_the_file_says():
    """Rolling along steadily, with noise: no force, no evidence."""
    _, found = drive(4 * [0.8], use=0.0)
    np.testing.assert_allclose(found.friction, 0.8, rtol=1e-6)
    assert (found.spread > 0.2).all()


def test_wheel_radii_that_are_off_are_no_ice():
    """Half a percent, five times the tolerance of the robot file: slip that goes with speed and not with force."""
    _, found = drive(4 * [0.8], radius=np.array([1.005, 0.995, 1.005, 0.995]), use=0.3)
    assert found.friction.min() > 0.3 * found.friction.max()


def test_a_wheel_that_comes_off_the_ice_is_trusted_again():
    slopes = SlipSlope(THESIS)
    state, found = drive([0.1, 0.8, 0.8, 0.8], slopes=slopes)
    assert found.friction[0] < 0.3 * found.friction[1]
    _, found = drive(4 * [0.8], slopes=slopes, state=state, seed=1, seconds=3.0)
    assert found.friction[0] > 0.6 * found.friction[1:].mean()


def test_braking_is_the_mirror_of_driving():
    slopes, found = SlipSlope(THESIS), []
    for sign in (1.0, -1.0):
        state, rng = slopes.initial_state(), np.random.default_rng(0)
        for k in range(400):
            mu = sign * np.array([0.05, 0.05, 0.05, 0.05]) * math.sin(0.02 * k)
            wanted = creep(mu, 0.1, np.array([0.1, 0.8, 0.8, 0.8]))
            sensed = sign * np.column_stack([0.5 * np.ones(4) + 0.5 * sign * wanted, np.zeros(4)])
            sensed += sign * rng.normal(0.0, 4e-4, (4, 2))
            reading = RobotReading(sensed, sensed, np.column_stack([mu * LOADS, np.zeros(4)]), np.zeros(4))
            state, last = slopes.step(state, reading, LOADS, DT)
        found.append(last.friction)
    np.testing.assert_allclose(found[0], found[1], rtol=1e-9)


def test_a_step_does_not_change_the_state_before_and_bad_readings_change_nothing():
    slopes = SlipSlope(THESIS)
    state, _ = drive([0.1, 0.8, 0.8, 0.8], seconds=0.1, slopes=slopes)
    before = {field.name: getattr(state, field.name).copy() for field in dataclasses.fields(state)}
    good, still = np.full((4, 2), 0.1), np.zeros(4)
    slopes.step(state, RobotReading(good, good, good, still), LOADS, DT)
    for bad in (np.full((4, 2), np.nan), np.full((4, 2), np.inf), np.zeros((3, 2))):
        for reading in (RobotReading(bad, good, good, still), RobotReading(good, good, bad, still)):
            with pytest.raises(TerrainError, match="allowed"):
                slopes.step(state, reading, LOADS, DT)
    with pytest.raises(TerrainError, match="dt"):
        slopes.step(state, RobotReading(good, good, good, still), LOADS, 0.0)
    for name, values in before.items():
        np.testing.assert_array_equal(getattr(state, name), values)


@settings(max_examples=25, deadline=None)
@given(st.lists(st.lists(st.floats(-1e6, 1e6), min_size=20, max_size=20), min_size=1, max_size=30), st.floats(1e-6, 10.0))
def test_whatever_finite_readings_come_it_stays_within_what_is_possible(rows, dt):
    """Or it says that they are none of a robot."""
    slopes = SlipSlope(THESIS)
    state = slopes.initial_state()
    for row in rows:
        sensed, force = np.array(row[:8]).reshape(4, 2), np.array(row[8:16]).reshape(4, 2)
        state, found = slopes.step(state, RobotReading(sensed, sensed, force, np.array(row[16:])), LOADS, dt)
        assert np.isfinite(found.friction).all() and np.isfinite(found.spread).all()
        assert (found.friction >= LEAST_FRICTION - 1e-12).all() and (found.friction <= 2.0 + 1e-12).all()


@pytest.mark.parametrize(("field", "value"), [("cut_off", 0.0), ("memory", -1.0), ("accuracy", 0.0), ("accuracy_share", 0.9)])
def test_parameters_that_are_not_allowed_are_named(field, value):
    with pytest.raises(TerrainError, match=field):
        SlipSlopeParameters(**{field: value})


# --- What a controller is told ----------------------------------------------------------------------------


def estimate(mu_p, valid, suspect=(False,) * 4):
    terrain = RobotTerrain(THESIS)
    rest = np.zeros((4, 2))
    _, nothing = terrain.step(terrain.initial_state(), RobotReading(rest, rest, rest, np.zeros(4)), DT)
    return dataclasses.replace(
        nothing, mu_p=np.array(mu_p), lambda_p=np.full(4, 0.05), valid=np.array(valid), suspect=np.array(suspect)
    )


def test_nothing_known_is_the_robot_file():
    told = shared_friction(THESIS, None, None)
    np.testing.assert_array_equal(told.mu_p, 0.8)
    np.testing.assert_array_equal(told.lambda_p, 0.1)
    assert not told.known.any()


def test_wheels_that_creep_like_one_on_ice_are_taken_to_stand_on_ice():
    """One wheel is known, the others creep as it does: the file's 0.8 would ask eight times as much of them."""
    told = shared_friction(THESIS, estimate([0.1, np.nan, np.nan, np.nan], [True, False, False, False]), None)
    np.testing.assert_allclose(told.mu_p, 0.1)
    np.testing.assert_allclose(told.lambda_p, [0.05, 0.1, 0.1, 0.1])
    np.testing.assert_array_equal(told.known, [True, False, False, False])


def test_slopes_tell_those_that_are_not_known_apart():
    _, slopes = drive([0.1, 0.8, 0.8, 0.8])
    told = shared_friction(THESIS, estimate([0.1, np.nan, np.nan, np.nan], [True, False, False, False]), slopes)
    assert told.mu_p[0] == 0.1
    np.testing.assert_allclose(told.mu_p[1:], 0.8, rtol=0.3)


def test_an_estimate_that_is_contradicted_does_not_count():
    told = shared_friction(THESIS, estimate([0.1, 0.5, 0.5, 0.5], [True] * 4, (True, False, False, False)), None)
    np.testing.assert_array_equal(told.known, [False, True, True, True])
    np.testing.assert_allclose(told.mu_p, 0.5)
