"""Columns of all shapes from those of a few."""

import math

import numpy as np
import pytest

from pcw_sim_bridge.mismatch.regression.composed_columns import Placed, Turning

TIME = np.linspace(0.0, 10.0, 200)


class Counted:
    """Columns of shapes, and how often they were asked for."""

    def __init__(self, function):
        self.function, self.count = function, 0

    def __call__(self, shape):
        self.count += 1
        return self.function(shape)[:, None, None]


def payload(shape):
    """A mass at a place: its weight on two axes, its inertia about the middle."""
    x, y = shape["x"], shape["y"]
    return shape["size"] * (np.sin(TIME) + 3.0 * x * np.cos(TIME) - y * TIME + (x * x + y * y) * np.sin(2.0 * TIME))


def test_a_place_of_second_degree_is_asked_for_seven_times():
    direct, plain = Counted(payload), Counted(payload)
    placed = Placed(direct, np.array([0.25, 0.4]))
    for x, y in np.random.default_rng(0).uniform(-0.5, 0.5, (30, 2)):
        shape = {"x": float(x), "y": float(y), "size": 2.0}
        assert placed(shape) == pytest.approx(plain(shape), abs=1e-9)
    assert direct.count == 7
    # Another size is another effect.
    assert placed({"x": 0.1, "y": 0.2, "size": 1.0}) == pytest.approx(plain({"x": 0.1, "y": 0.2, "size": 1.0}), abs=1e-9)


def test_a_place_of_another_kind_is_asked_for_each_time():
    direct = Counted(lambda shape: np.sin(TIME + 9.0 * shape["x"]) + shape["y"])
    placed = Placed(direct, np.array([0.25, 0.4]))
    for x in (0.0, 0.1, 0.2):
        assert np.array_equal(placed({"x": x, "y": 0.1})[:, 0, 0], np.sin(TIME + 9.0 * x) + 0.1)
    assert direct.count == 7 + 3


def test_a_direction_is_asked_for_at_two_and_once_more():
    direct = Counted(lambda shape: math.cos(shape["phase"]) * TIME + math.sin(shape["phase"]) * np.sin(TIME))
    turning = Turning(direct, "phase")
    for phase in np.linspace(-3.0, 3.0, 20):
        expected = math.cos(phase) * TIME + math.sin(phase) * np.sin(TIME)
        assert turning({"phase": float(phase)})[:, 0, 0] == pytest.approx(expected, abs=1e-9)
    assert direct.count == 3
    skewed = Turning(Counted(lambda shape: np.sin(TIME + shape["phase"] ** 2)), "phase")
    assert skewed({"phase": 2.0})[:, 0, 0] == pytest.approx(np.sin(TIME + 4.0))
