"""Estimators, slopes and belief together: slip against the wheels that grip, whatever the observer believes."""

import numpy as np
import pytest

from pcw_description import load_robot
from pcw_terrain import ObservedGround, RobotReading, TerrainError, shared_friction
from pcw_terrain.observed_ground import creep

THESIS = load_robot("thesis")
DT = 0.002


def test_creep_is_the_lower_root_of_the_curve():
    told = shared_friction(THESIS, None, None)
    sensed, loads = np.tile([0.5, 0.0], (4, 1)), np.full(4, 200.0)
    slip = creep(THESIS, sensed, np.tile([80.0, 0.0], (4, 1)), loads, told)
    ratio = slip[:, 0] / 0.5
    np.testing.assert_allclose(2.0 * 0.8 * 0.1 * ratio / (0.1**2 + ratio**2), 0.4)
    np.testing.assert_allclose(creep(THESIS, sensed, -np.tile([80.0, 0.0], (4, 1)), loads, told), -slip)
    assert not creep(THESIS, sensed, np.zeros((4, 2)), loads, told).any()


def reading(observed_slip, known=None):
    """The first wheel slips at 0.3 m/s against three that roll at 0.5 m/s without force; the observer has its own idea."""
    sensed = np.tile([0.5, 0.0], (4, 1))
    sensed[0, 0] = 0.8
    slip, force = np.zeros((4, 2)), np.zeros((4, 2))
    slip[0, 0], force[0, 0] = observed_slip, 40.0
    return RobotReading(sensed, slip, force, np.zeros(4), known)


def test_a_wheel_that_has_let_go_is_measured_against_those_that_grip():
    """The observer says 0.2 of 0.3 m/s; the others say 0.3."""
    ground = ObservedGround(THESIS)
    state = ground.initial_state()
    for _ in range(300):
        state, found = ground.step(state, reading(0.2), DT)
    assert found.ground.slip[0] == pytest.approx(0.3 / 0.8, rel=0.02)
    assert (found.ground.slip[1:] == 0.0).all()


def test_slip_that_the_observer_does_not_vouch_for_is_no_evidence():
    ground = ObservedGround(THESIS)
    state = ground.initial_state()
    for _ in range(300):
        state, found = ground.step(state, reading(0.2, np.zeros(4, bool)), DT)
    assert not found.ground.slip.any() and not np.isfinite(found.ground.mu_p).any()
    assert found.told.mu_p[0] < 0.5 * found.told.mu_p[1:].min()  # its creep is told by the joints alone


def test_bad_readings_are_refused_and_the_state_stays():
    ground = ObservedGround(THESIS)
    state, _ = ground.step(ground.initial_state(), reading(0.2), DT)
    before = state.terrain.numbers.copy()
    bad = reading(0.2)
    bad.force[1, 0] = np.nan
    with pytest.raises(TerrainError, match="allowed"):
        ground.step(state, bad, DT)
    with pytest.raises(TerrainError, match="dt"):
        ground.step(state, reading(0.2), 0.0)
    np.testing.assert_array_equal(state.terrain.numbers, before)
