"""The path of a robot that keeps its twist."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pcw_control import ControlError, SteadyPath

NUMBER = st.floats(-2.0, 2.0)
TRIPLE = st.tuples(NUMBER, NUMBER, NUMBER)


@given(TRIPLE, TRIPLE, st.floats(0.0, 5.0))
def test_velocity_and_acceleration_are_the_derivatives_and_the_twist_stays(pose, twist, time):
    path, h = SteadyPath(np.array(pose), np.array(twist)), 1e-4
    before, now, after = (path.sample(time + k * h) for k in (-1, 0, 1))
    np.testing.assert_allclose((after.pose - before.pose) / (2.0 * h), now.velocity, atol=1e-6)
    np.testing.assert_allclose((after.velocity - before.velocity) / (2.0 * h), now.acceleration, atol=1e-6)
    c, s = math.cos(now.pose[2]), math.sin(now.pose[2])
    x, y, turn = now.velocity
    np.testing.assert_allclose([c * x + s * y, c * y - s * x, turn], twist, atol=1e-12)
    np.testing.assert_allclose(path.sample(0.0).pose, pose)


def test_a_full_circle_ends_where_it_began_and_turning_ever_slower_becomes_straight():
    circle = SteadyPath(np.array([1.0, 2.0, 0.5]), np.array([0.6, 0.2, 0.5]))
    np.testing.assert_allclose(circle.sample(2.0 * math.pi / 0.5).pose, [1.0, 2.0, 0.5 + 2.0 * math.pi], atol=1e-12)
    straight = SteadyPath(np.zeros(3), np.array([0.3, 0.1, 0.0])).sample(2.0).pose
    np.testing.assert_allclose(straight, [0.6, 0.2, 0.0])
    for omega in (4e-5, 6e-5):  # on both sides of where the series takes over
        turning = SteadyPath(np.zeros(3), np.array([0.3, 0.1, omega])).sample(2.0).pose
        np.testing.assert_allclose(turning[:2], [0.6 - 0.2 * omega, 0.2 + 0.6 * omega], rtol=0.0, atol=1e-8)


@pytest.mark.parametrize(("field", "value"), [("pose", [0.0, math.nan, 0.0]), ("twist", [0.3, 0.0])])
def test_what_is_not_finite_or_of_another_shape_is_refused(field, value):
    given = {"pose": np.zeros(3), "twist": np.zeros(3), field: np.array(value)}
    with pytest.raises(ControlError, match=rf"{field} = .*allowed: finite numbers, shape \(3,\)"):
        SteadyPath(**given)
