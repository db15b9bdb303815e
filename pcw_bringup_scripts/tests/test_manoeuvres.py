"""The manoeuvres of the demonstration."""

import numpy as np
import pytest

from pcw_bringup_scripts.manoeuvres import MANOEUVRES
from pcw_description.errors import PcwError


def sampled(manoeuvre):
    return np.array([manoeuvre.twist(t) for t in np.arange(0.0, manoeuvre.duration, 0.01)])


@pytest.mark.parametrize("name", MANOEUVRES)
def test_begins_and_ends_at_rest_and_stays_within_what_the_robot_can_do(name):
    manoeuvre = MANOEUVRES[name]
    twists = sampled(manoeuvre)
    assert np.hypot(twists[:, 0], twists[:, 1]).max() <= 0.65
    assert np.abs(twists[:, 2]).max() <= 1.3
    assert not manoeuvre.twist(-0.1).any() and not manoeuvre.twist(manoeuvre.duration + 0.1).any()
    assert not manoeuvre.twist(manoeuvre.duration - 0.5).any()


def test_identification_reverses_each_axis_many_times_and_drives_each_alone():
    twists = sampled(MANOEUVRES["identification"])
    for axis in range(3):
        moving = twists[np.abs(twists[:, axis]) > 0.05, axis]
        assert np.sum(np.diff(np.sign(moving)) != 0) >= 8
        others = np.delete(twists, axis, axis=1)
        alone = (np.abs(twists[:, axis]) > 0.1) & (np.abs(others).max(axis=1) == 0.0)
        assert alone.sum() * 0.01 > 3.0


def test_holdout_is_another_motion():
    """No twist of the one is held in the other for long: what fits both was not learnt by heart."""
    first, second = sampled(MANOEUVRES["identification"]), sampled(MANOEUVRES["holdout"])
    moving = second[np.abs(second).max(axis=1) > 0.0]
    nearest = np.array([np.abs(first - twist).max(axis=1).min() for twist in moving[::10]])
    assert np.mean(nearest > 0.02) > 0.7


@pytest.mark.parametrize("duration", [10.0, 100.0])
def test_can_be_longer_or_shorter(duration):
    nominal = MANOEUVRES["identification"]
    stretched = nominal.lasting(duration)
    assert stretched.duration == pytest.approx(duration)
    assert len(stretched.segments) == len(nominal.segments)
    for wrong in (9.0, float("nan"), 1e9):
        with pytest.raises(PcwError, match="allowed: 10 to 3600 s"):
            nominal.lasting(wrong)
