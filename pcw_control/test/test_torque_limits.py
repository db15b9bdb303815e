"""The last gate before the motors."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from pcw_control.errors import ControlError
from pcw_control.torque_limits import TorqueLimits, limit_torque
from pcw_description import load_robot

THESIS = load_robot("thesis")
AT_REST = np.zeros((4, 2))
number = st.floats(allow_nan=True, allow_infinity=True)
LIMITS = TorqueLimits.of_robot(THESIS)


@settings(deadline=None)  # the first call compiles
@given(
    arrays(float, (4, 2), elements=number), arrays(float, (4, 2), elements=number), number, st.sampled_from(["scale", "clip"])
)
def test_whatever_comes_in_what_goes_out_is_finite_and_within_the_limits(torque, velocity, dt, mode):
    limits = TorqueLimits.of_robot(THESIS, mode=mode, slew=200.0)
    with np.errstate(all="ignore"):
        result = limit_torque(limits, AT_REST, torque, velocity, dt)
    assert np.all(np.abs(result.torque) <= THESIS.torque_limit)
    if not (np.isfinite(torque).all() and np.isfinite(velocity).all() and np.isfinite(dt)):
        assert result.fault
        assert not result.torque.any()


def test_within_the_limits_nothing_changes():
    torque = 0.99 * THESIS.torque_limit
    result = limit_torque(LIMITS, AT_REST, torque, AT_REST, 0.002)
    np.testing.assert_array_equal(result.torque, torque)
    assert not result.saturated and not result.fault


def test_scaling_keeps_the_direction_of_the_wrench():
    torque = np.array([[60.0, 1.0], [-5.0, 2.0], [3.0, 4.0], [1.0, -3.0]])
    result = limit_torque(LIMITS, AT_REST, torque, AT_REST, 0.002)
    np.testing.assert_allclose(result.torque, torque * 15.0 / 60.0)
    assert result.saturated


def test_clipping_cuts_one_joint_only():
    torque = np.array([[60.0, 1.0], [-5.0, 2.0], [3.0, 4.0], [1.0, -3.0]])
    result = limit_torque(TorqueLimits.of_robot(THESIS, mode="clip"), AT_REST, torque, AT_REST, 0.002)
    expected = torque.copy()
    expected[0, 0] = 15.0
    np.testing.assert_array_equal(result.torque, expected)


@pytest.mark.parametrize(
    "fraction, factor", [(0.5, 1.0), (0.9, 1.0), (0.95, 0.5), (1.0, 0.0), (1.5, 0.0)]
)
def test_near_its_speed_limit_a_joint_is_accelerated_less_and_braked_as_before(fraction, factor):
    velocity = np.zeros((4, 2))
    velocity[2, 0] = -fraction * THESIS.speed_limit[2, 0]
    driving = np.zeros((4, 2))
    driving[2, 0] = -5.0
    np.testing.assert_allclose(limit_torque(LIMITS, AT_REST, driving, velocity, 0.002).torque, factor * driving, atol=1e-12)
    np.testing.assert_array_equal(limit_torque(LIMITS, AT_REST, -driving, velocity, 0.002).torque, -driving)


def test_slew_limit_bounds_the_change_per_time():
    limits = TorqueLimits.of_robot(THESIS, slew=100.0)
    torque = np.full((4, 2), 5.0)
    first = limit_torque(limits, AT_REST, torque, AT_REST, 0.002)
    np.testing.assert_allclose(first.torque, 0.2)
    second = limit_torque(limits, first.torque, torque, AT_REST, 0.002)
    np.testing.assert_allclose(second.torque, 0.4)


def test_refuses_limits_that_are_none():
    with pytest.raises(ControlError, match=r"mode 'soft' is not allowed; allowed: scale, clip"):
        TorqueLimits.of_robot(THESIS, mode="soft")
    with pytest.raises(ControlError, match=r"slew = 0.0 is not allowed"):
        TorqueLimits.of_robot(THESIS, slew=0.0)
    with pytest.raises(ControlError, match=r"foldback_start = 1.0 is not allowed"):
        TorqueLimits(THESIS.torque_limit, THESIS.speed_limit, foldback_start=1.0)
