"""Stamps and losses: their statistics, their order, and that topics do not disturb each other."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pcw_description import load_robot
from pcw_sim_bridge.plants.plant import PlantError
from pcw_sim_bridge.stamping import BURST_LENGTH, StampingParameters, TopicStamps, stamp_after

PERIOD_NS = 2_000_000
THESIS = load_robot("thesis")


def stamped(count=20_000, topic="joint_states", seed=1, **parameters):
    """Stamps (T,) [ns] and losses (T,) of messages made every 2 ms."""
    stamps = TopicStamps(StampingParameters(**parameters), seed, THESIS)
    found = [stamps.stamp(topic, 1_000_000_000 + k * PERIOD_NS) for k in range(count)]
    return np.array([stamp for stamp, _ in found]), np.array([lost for _, lost in found])


def test_without_jitter_and_loss_a_stamp_is_the_time():
    stamp, lost = stamped(100)
    np.testing.assert_array_equal(stamp, 1_000_000_000 + np.arange(100) * PERIOD_NS)
    assert not lost.any()


def test_jitter_has_its_deviation_and_no_bias():
    stamp, lost = stamped(stamp_jitter=2e-4)
    error = (stamp - 1_000_000_000 - np.arange(len(stamp)) * PERIOD_NS) * 1e-9
    assert error.std() == pytest.approx(2e-4, rel=0.03)
    assert abs(error.mean()) < 5.0 * 2e-4 / math.sqrt(len(error))
    assert np.corrcoef(error[1:], error[:-1])[0, 1] == pytest.approx(0.0, abs=0.03)
    assert not lost.any()


@pytest.mark.parametrize("loss", [0.01, 0.1, 0.5])
def test_loss_has_its_fraction_and_comes_in_bursts(loss):
    stamp, lost = stamped(200_000, loss=loss)
    bursts = np.diff(np.flatnonzero(np.diff(np.concatenate([[0], lost.astype(int), [0]])) != 0))[::2]
    # The number of bursts is what varies; a burst's length is geometric.
    assert lost.mean() == pytest.approx(loss, rel=6.0 * math.sqrt(2.0 / len(bursts)))
    assert bursts.mean() == pytest.approx(BURST_LENGTH, rel=6.0 / math.sqrt(len(bursts)))
    np.testing.assert_array_equal(np.diff(stamp), PERIOD_NS)


@settings(derandomize=True, deadline=None, max_examples=40, database=None)
@given(st.floats(0.0, 0.1), st.floats(0.0, 0.5), st.integers(0, 2**31 - 1))
def test_stamps_of_a_topic_never_go_back_nor_repeat(jitter, loss, seed):
    """Also where the jitter is much longer than the period, and from time zero on."""
    stamps = TopicStamps(StampingParameters(jitter, loss), seed, THESIS)
    found = np.array([stamps.stamp("imu/data", k * PERIOD_NS)[0] for k in range(200)])
    assert np.all(np.diff(found) > 0) and found[0] >= 0


def test_a_topic_is_not_disturbed_by_another_nor_its_jitter_by_loss():
    alone, _ = stamped(500, stamp_jitter=1e-3)
    stamps = TopicStamps(StampingParameters(stamp_jitter=1e-3), 1, THESIS)
    together = []
    for k in range(500):
        stamps.stamp("imu/data", 1_000_000_000 + k * PERIOD_NS)
        together.append(stamps.stamp("/joint_states", 1_000_000_000 + k * PERIOD_NS)[0])
    np.testing.assert_array_equal(alone, together)
    np.testing.assert_array_equal(alone, stamped(500, stamp_jitter=1e-3, loss=0.2)[0])
    assert not np.array_equal(alone, stamped(500, topic="imu/data", stamp_jitter=1e-3)[0])
    assert not np.array_equal(alone, stamped(500, seed=2, stamp_jitter=1e-3)[0])


def test_reset_repeats():
    stamps = TopicStamps(StampingParameters(1e-3, 0.2), 5, THESIS)
    first = [stamps.stamp("joint_states", k * PERIOD_NS) for k in range(300)]
    stamps.reset()
    assert first == [stamps.stamp("joint_states", k * PERIOD_NS) for k in range(300)]
    assert any(lost for _, lost in first)


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        ({"stamp_jitter": -1e-3}, r"stamp_jitter = -0.001 s is not allowed; allowed: 0 to 0.1 s"),
        ({"stamp_jitter": math.nan}, "stamp_jitter = nan s"),
        ({"loss": 0.6}, r"loss = 0.6 is not allowed; allowed: 0 to 0.5"),
        ({"loss": -0.1}, "loss = -0.1"),
    ],
)
def test_what_cannot_be_is_refused(parameters, message):
    with pytest.raises(PlantError, match=message):
        StampingParameters(**parameters)


def test_a_reading_that_comes_late_is_stamped_after_the_last_and_a_clock_that_is_set_back_is_followed():
    """The CAN driver gave stamps 1 ns apart until a clock that was set back by a minute had made up for it."""
    assert stamp_after(10**12, 10**12 + 4_000_000) == 10**12 + 4_000_000
    assert stamp_after(10**12, 10**12) == stamp_after(10**12, 10**12 - 3_000_000) == 10**12 + 1
    assert stamp_after(10**12, 10**12 - 60 * 10**9) == 10**12 - 60 * 10**9
