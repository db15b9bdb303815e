"""What encoders miss of a joint that moves by less than a count."""

import math

import numpy as np
import pytest

from pcw_description import load_robot
from pcw_sim_bridge.mismatch.readings.unresolved_motion import resolution, unresolved_rate
from pcw_sim_bridge.mismatch.regression.signal_filter import SignalFilter, derivative

RATE, CUTOFF, STEP = 500.0, 3.0, 1e-3


@pytest.mark.parametrize(("speed", "swing"), [(0.0, 4e-4), (0.002, 0.0), (0.05, 1e-3)])
def test_rates_are_missed_by_about_what_is_said(speed: float, swing: float) -> None:
    """A joint that swings within a count, one that crosses two counts a second, and one that crosses fifty."""
    time = np.arange(20000) / RATE
    truth = speed * time + swing * np.sin(2.0 * np.pi * 0.7 * time + np.sin(0.3 * time))
    read = STEP * np.round(truth / STEP)
    own = SignalFilter(RATE, CUTOFF)
    missed = derivative(own.smooth(read - truth), RATE)[2000:-2000]
    said = unresolved_rate(np.full((1, 1, 2), speed), np.full((1, 2), STEP), CUTOFF)[0, 0, 0]
    assert 0.3 * said < np.std(missed) < 1.2 * said


def test_a_joint_that_never_moved_has_the_step_of_the_others() -> None:
    thesis = load_robot("thesis")
    angle = np.zeros((1000, 4, 2))
    angle[:, :, 0] = np.random.default_rng(0).standard_normal((1000, 4)).cumsum(axis=0)  # never twice the same
    angle[:, 2, 1] = STEP * np.repeat(np.arange(100), 10)
    steps = resolution(thesis, angle)
    assert steps[:, 0] == pytest.approx(0.0)
    assert steps[:, 1] == pytest.approx(STEP)
    described = math.tau / thesis.sensors.encoders.steer_counts / thesis.casters[0].gears.steer
    assert resolution(thesis, np.zeros((10, 4, 2)))[:, 1] == pytest.approx(described)
