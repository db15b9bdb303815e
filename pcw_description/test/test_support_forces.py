"""How a body stands on ground of uneven height."""

import numpy as np
import pytest

from pcw_description.support_forces import plane_gradient, support_forces

CORNERS = np.array([[0.3, 0.2], [0.3, -0.2], [-0.3, 0.2], [-0.3, -0.2]])


def test_it_stands_as_the_plane_under_its_wheels() -> None:
    height = 0.4 + CORNERS @ [0.03, -0.02]
    assert plane_gradient(CORNERS, height) == pytest.approx((0.03, -0.02), abs=1e-9)
    assert plane_gradient(CORNERS, np.full(4, 0.7)) == (0.0, 0.0)
    # A twist of the ground about its diagonals turns no rigid body.
    assert plane_gradient(CORNERS, np.array([0.01, -0.01, -0.01, 0.01])) == pytest.approx((0.0, 0.0), abs=1e-12)


def test_it_is_the_plane_that_its_springs_leave() -> None:
    """Load over stiffness below the ground under each wheel is where the body is."""
    rng = np.random.default_rng(0)
    places, height, spring = rng.uniform(-0.5, 0.5, (3, 2)), rng.uniform(-1e-3, 1e-3, 3), 1e6
    level, load = np.empty(3), np.empty(3)
    support_forces(900.0, 10.0, -5.0, spring, places, np.zeros(3), level)
    support_forces(900.0, 10.0, -5.0, spring, places, height, load)
    assert level.min() > 0.0 and load.min() > 0.0
    lifted = height - (load - level) / spring
    slopes = np.linalg.lstsq(np.column_stack([places, np.ones(3)]), lifted, rcond=None)[0][:2]
    assert plane_gradient(places, height) == pytest.approx(tuple(slopes), abs=1e-6)


def test_wheels_in_a_line_leave_the_slope_across_it_at_zero() -> None:
    places = np.array([[-0.2, 0.0], [0.2, 0.0]])
    assert plane_gradient(places, np.array([0.0, 0.004])) == pytest.approx((0.01, 0.0), abs=1e-9)
