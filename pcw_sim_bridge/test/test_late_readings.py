"""Readings at even times that were stamped when they arrived: whose turn each of them is."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pcw_description import load_robot
from pcw_description.recording import Recording
from pcw_sim_bridge.mismatch.readings.even_stamps import EvenStamps, late_stamps
from pcw_sim_bridge.mismatch.readings.late_readings import late_turns
from pcw_sim_bridge.simulated_run import record_run

STEP = 0.002
SLOW = 2.0


def in_order(arrival: np.ndarray) -> np.ndarray:
    """Who is late keeps those behind waiting; between two that wait pass a few microseconds."""
    return np.maximum.accumulate(arrival - 5e-6 * np.arange(len(arrival))) + 5e-6 * np.arange(len(arrival))


def one_by_one(even: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Each waits for a period as a rule."""
    return in_order(even + rng.exponential(STEP, len(even)))


def held_up(even: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """About once a second nobody listens for some 10 ms."""
    begin = np.cumsum(rng.exponential(1.0, 2 + int(2.0 * even[-1])))
    end = begin + rng.exponential(0.01, len(begin))
    arrival = even + 5e-5 * np.abs(rng.standard_normal(len(even)))
    for a, b in zip(begin, end, strict=True):
        arrival[(arrival >= a) & (arrival < b)] = b
    return in_order(arrival)


def in_bunches(even: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A bus hands over every 16 ms what it has; its clock is not the robot's."""
    period = 0.016 * (1.0 + 1e-4 * rng.standard_normal())
    return in_order(np.ceil((even + 0.3 * STEP) / period) * period)


# And by how much turns may be off then, as a rule and in steps: in bunches they were off by 2.3.
ARRIVALS = (one_by_one, held_up, in_bunches)
OFF = {one_by_one: 0.6, held_up: 0.05, in_bunches: 1.2}


def readings(arrival, seed: int, lost: int = 0, runs: int = 1) -> tuple[np.ndarray, np.ndarray]:  # type: ignore[no-untyped-def]
    """Turns (T,) and stamps (T,) [s] of 20 s of which `lost` times `runs` in a row are missing."""
    rng = np.random.default_rng(seed)
    kept = np.ones(10_000, dtype=bool)
    for at in 200 + np.sort(rng.choice(95, lost, replace=False)) * 100:
        kept[at : at + runs] = False
    turn = np.flatnonzero(kept)
    return turn, arrival(turn * STEP, rng)


@pytest.mark.parametrize("arrival", ARRIVALS)
@pytest.mark.parametrize(("lost", "runs"), [(0, 1), (6, 2), (3, 5)])
def test_whose_turn_each_is_is_found(arrival, lost: int, runs: int) -> None:  # type: ignore[no-untyped-def]
    """But for some beside a loss, where nobody can tell which of them it was, and a loss now and then."""
    for seed in range(3):
        turn, stamp = readings(arrival, seed, lost, runs)
        found = late_turns(stamp, SLOW)
        assert found is not None
        assert found.step == pytest.approx(STEP, rel=1e-3)
        assert np.std(found.turn - turn) < OFF[arrival]


def test_single_losses_are_found_where_readings_come_one_by_one() -> None:
    turn, stamp = readings(one_by_one, 4, lost=8)
    found = late_turns(stamp, SLOW)
    assert found is not None
    assert found.turn[-1] - found.turn[0] == turn[-1] - turn[0]


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 1000))
def test_what_comes_at_any_time_has_no_turns(seed: int) -> None:
    """Of these nothing comes at even times: the sum of their waits strays from any."""
    rng = np.random.default_rng(seed)
    assert late_turns(np.cumsum(rng.exponential(STEP, 10_000)), SLOW) is None


def motion(time: np.ndarray) -> np.ndarray:
    return np.stack([3.0 * np.sin(1.3 * time), 2.0 * np.sin(0.7 * time) + time], axis=1)


@pytest.mark.parametrize("arrival", ARRIVALS)
def test_stamps_of_arrival_are_made_even(arrival) -> None:  # type: ignore[no-untyped-def]
    """They were kept, and the speeds that follow from them shook the robot: nothing could be said of it."""
    turn, stamp = readings(arrival, 5, lost=2, runs=3)
    noise = 5e-5 * np.random.default_rng(6).standard_normal((len(turn), 2))
    found = EvenStamps().even("joints", stamp, motion(turn * STEP) + noise)
    apart = found - turn * STEP
    assert np.std(apart) < 0.3 * np.std(stamp - turn * STEP)
    assert np.all(np.diff(found) > 0.0)


def test_a_recording_of_arrivals_says_so(tmp_path: Path) -> None:
    robot = load_robot("thesis")

    def twist(time: float) -> np.ndarray:
        return min(time, 1.0) * np.array([0.4, 0.0, 0.2 * np.sin(time)])

    record_run(robot, twist, 4.0, 1, tmp_path / "run", "reduced")
    read = Recording.open(tmp_path / "run", robot)
    assert late_stamps(read, EvenStamps().evenly_stamped(read)) == []
    joints = read.joint_states
    arrival = one_by_one(joints.stamp, np.random.default_rng(9))
    read.joint_states = dataclasses.replace(joints, stamp=arrival)
    (said,) = late_stamps(read, EvenStamps().evenly_stamped(read))
    assert said.startswith("joint_states: stamped when it arrived")
    assert f"{1e3 * np.std(arrival - joints.stamp):.0f} ms" in said


@pytest.mark.parametrize("arrival", [one_by_one, held_up])
def test_readings_that_were_taken_when_they_are_stamped_keep_their_stamps(arrival) -> None:  # type: ignore[no-untyped-def]
    turn, stamp = readings(arrival, 7)
    noise = 5e-5 * np.random.default_rng(8).standard_normal((len(turn), 2))
    assert EvenStamps().even("joints", stamp, motion(stamp) + noise) is stamp
