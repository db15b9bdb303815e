"""Where the channels end: at what torques tell beyond their noise. And what stands where samples are missing."""

from __future__ import annotations

import copy
import dataclasses
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from pcw_control.excitation import make_excitation
from pcw_description import load_robot
from pcw_description.recording import Recording
from pcw_sim_bridge.mismatch.regression.signal_filter import interpolated, uniform_segments
from pcw_sim_bridge.mismatch.robot.robot_effects import with_pose
from pcw_sim_bridge.mismatch.robot.robot_motion import (
    SMALLEST_CUTOFF,
    choose_cutoff,
    read_motions,
    seldom_read,
    seldom_tracked,
)
from pcw_sim_bridge.mismatch.robot.rolling_model import ModelNumbers
from pcw_sim_bridge.simulated_run import record_run

THESIS = load_robot("thesis")


@pytest.fixture(scope="module")
def lively(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    folder: Path = tmp_path_factory.mktemp("lively") / "run"
    excitation = make_excitation("identification", THESIS, 15.0, 0)
    record_run(THESIS, excitation.twist, excitation.duration, 3, folder, "reduced")
    return Recording.open(folder, THESIS)


def with_torques(recording: Recording, torque: np.ndarray) -> Any:
    """As much of a recording as the choice looks at."""
    joints = recording.joint_states
    return SimpleNamespace(joint_states=SimpleNamespace(stamp=joints.stamp, position=joints.position, effort=torque))


def made_of(recording: Recording, highest: float) -> Any:
    """Torques of slow sines up to a frequency, in noise."""
    stamp, effort = recording.joint_states.stamp, recording.joint_states.effort
    assert effort is not None
    rng = np.random.default_rng(1)
    slow = sum(np.sin(2.0 * np.pi * f * stamp + f) for f in np.arange(0.5, highest + 0.1, 0.5))
    return with_torques(recording, slow[:, None, None] + 0.05 * rng.standard_normal(effort.shape))


def test_a_tracked_place_counts_though_the_tracker_begins_late_and_misses_some(lively: Recording) -> None:
    """One sample before the tracker's first, and all places came from the wheels: a patch was sought a metre away."""
    [motion] = read_motions(THESIS, lively, 0, 5.0, True)
    tracked = with_pose([motion], ModelNumbers.of(THESIS))[0].pose
    part = len(tracked) // 10
    for missing in ([slice(0, 3)], [slice(-part, None)], [slice(0, part), slice(4 * part, 5 * part), slice(-3, None)]):
        pose = tracked.copy()
        for some in missing:
            pose[some] = np.nan
        larger = THESIS.with_casters(THESIS.caster_names, lambda c: dataclasses.replace(c, wheel_radius=1.2 * c.wheel_radius))
        wrong = ModelNumbers.of(larger)
        [found] = with_pose([dataclasses.replace(motion, pose=pose)], wrong)
        known = np.isfinite(pose).all(axis=1)
        assert np.array_equal(found.pose[known], tracked[known])
        # What the wheels make of the way meanwhile, too long by their radius, and ten times the noise of the tracker.
        way = np.abs(np.diff(tracked, axis=0))[~known[1:]].sum(axis=0).max()
        assert np.abs(found.pose - tracked).max() < 0.3 * way + 5e-3
    [blind] = with_pose([dataclasses.replace(motion, pose=np.full_like(tracked, np.nan))], ModelNumbers.of(THESIS))
    assert np.array_equal(blind.pose[0], np.zeros(3))
    assert np.abs(blind.pose - tracked).max() < 0.02


def test_without_a_tracker_the_way_goes_on_from_the_piece_before(lively: Recording) -> None:
    """Over a gap with the twist of its two ends: after a tracked piece, and though the robot has turned."""
    [motion] = read_motions(THESIS, lively, 0, 5.0, True)
    [whole] = with_pose([motion], ModelNumbers.of(THESIS))
    speed = np.linalg.norm(np.gradient(whole.pose, whole.time, axis=0)[:, :2], axis=1)
    quarter = len(speed) // 4
    at = quarter + int(np.argmax(np.where(np.abs(whole.pose[quarter:-quarter, 2]) > 0.5, speed[quarter:-quarter], 0.0)))
    gap = round(0.1 / np.median(np.diff(whole.time)))
    parts = [slice(0, at), slice(at + gap, None)]
    pieces = [
        dataclasses.replace(whole, **{
            f.name: value[part] for f in dataclasses.fields(whole)
            if isinstance(value := getattr(whole, f.name), np.ndarray) and len(value) == len(whole.time)
        })
        for part in parts
    ]  # fmt: skip
    pieces[1] = dataclasses.replace(pieces[1], pose=np.full_like(pieces[1].pose, np.nan))
    found = with_pose(pieces, ModelNumbers.of(THESIS))
    way = np.abs(whole.pose[at + gap] - whole.pose[at - 1]).max()
    assert way > 0.02
    assert np.abs(found[1].pose[0] - whole.pose[at + gap]).max() < 0.15 * way


def test_channels_end_where_torques_tell_nothing_more(lively: Recording) -> None:
    widest = choose_cutoff(THESIS, [lively])
    assert widest > 5.0
    assert choose_cutoff(THESIS, [made_of(lively, 4.0)]) == pytest.approx(4.0, abs=0.6)
    assert choose_cutoff(THESIS, [made_of(lively, 1.0)]) == SMALLEST_CUTOFF
    # The quieter of two recordings decides: in it noise would stand for masses.
    assert choose_cutoff(THESIS, [lively, made_of(lively, 1.0)]) == SMALLEST_CUTOFF


def test_without_torques_or_with_slow_ones_they_say_nothing(lively: Recording) -> None:
    torque = lively.joint_states.effort
    assert torque is not None
    widest = choose_cutoff(THESIS, [lively])
    assert choose_cutoff(THESIS, [with_torques(lively, np.zeros_like(torque))]) == widest
    wide = with_torques(lively, np.random.default_rng(2).standard_normal(torque.shape).cumsum(axis=0))
    assert choose_cutoff(THESIS, [wide]) == widest


def test_a_gap_is_bent_as_its_surroundings_and_a_long_one_is_left_open() -> None:
    noise, rng = 1e-4, np.random.default_rng(3)
    time = np.arange(0.0, 4.0, 0.002)
    swings = np.sin(2.0 * np.pi * np.array([1.0, 3.0]) * time[:, None])
    measured = swings + noise * rng.standard_normal(swings.shape)
    there = ~((time > 1.03) & (time < 1.07)) & ~((time > 2.0) & (time < 2.1))
    found = interpolated(time, time[there], measured[there], 0.05)
    gap, pause = (time > 1.03) & (time < 1.07), (time > 2.0005) & (time < 2.0995)
    lines = np.stack([np.interp(time, time[there], column) for column in measured[there].T], axis=1)
    error, of_lines = (np.abs(values - swings)[gap].max(axis=0) for values in (found, lines))
    assert np.all(error < [3.0 * noise, 150.0 * noise]) and np.all(of_lines > 5.0 * error)
    assert np.isnan(found[pause]).all() and np.isfinite(found[~pause]).all()
    assert np.array_equal(found[there], measured[there])
    assert np.isnan(interpolated(np.array([-1.0, 5.0]), time, measured, 0.05)).all()


def test_a_gap_is_filled_beside_what_was_not_recorded_and_left_open_among_others() -> None:
    time = np.arange(0.0, 2.0, 0.002)
    swing = np.sin(2.0 * np.pi * 3.0 * time)
    single = (time > 1.001) & (time < 1.031)
    found = interpolated(time, time[~single], np.stack([swing, np.full_like(swing, np.nan)], axis=1)[~single], 0.05)
    assert np.abs(found[:, 0] - swing).max() < 5e-3 and np.isnan(found[:, 1]).all()
    many = (time > 0.501) & (time < 1.501) & (time % 0.04 < 0.035)
    found = interpolated(time, time[~many], swing[~many, None], 0.05)
    assert np.isnan(found[many & (time > 0.6) & (time < 1.4)]).all()


def test_losses_close_to_one_another_do_not_cut_a_recording() -> None:
    """Of two messages lost beside each other one was a pause, if a third was lost nearby: 2 % cost seconds at every cut."""
    rng = np.random.default_rng(4)
    time = np.arange(0.0, 60.0, 0.002)
    swing = np.sin(2.0 * np.pi * 1.5 * time)
    there = rng.random(len(time)) > 0.05
    for start in rng.choice(len(time) - 20, 60):
        there[start : start + 6] = False
    there[:30] = there[-30:] = True
    _, pieces = uniform_segments(time[there], swing[there, None], 0.05)
    [(grid, values)] = pieces
    assert grid[[0, -1]] == pytest.approx(time[[0, -1]])
    assert np.abs(values[:, 0] - np.sin(2.0 * np.pi * 1.5 * grid)).max() < 2e-3


def test_a_slow_sensor_has_no_gap_and_missing_values_stay_missing() -> None:
    time = np.arange(0.0, 4.0, 0.1)
    values = np.stack([time, np.where(time < 2.05, np.nan, time)], axis=1)
    there = np.arange(len(time)) != 10
    found = interpolated(np.array([0.55, 0.98, 3.0]), time[there], values[there], 0.05)
    assert found[:, 0] == pytest.approx([0.55, 0.98, 3.0]) and np.isnan(found[:2, 1]).all()


def test_a_slow_sensor_sees_bends_and_a_pause_of_it_stays_open() -> None:
    time = np.arange(0.0, 6.0, 0.06)
    grid = np.arange(0.0, 5.9, 0.002)
    there = (time < 2.5) | (time > 3.2)

    def swing(at: np.ndarray) -> np.ndarray:
        return 10.0 + np.sin(2.0 * np.pi * 1.5 * at)[:, None]

    found = interpolated(grid, time[there], swing(time[there]), 0.1)
    pause = (grid > 2.47) & (grid < 3.23)
    assert np.isnan(found[pause]).all()
    well_inside = ~((grid < 0.2) | (grid > 5.7) | ((grid > 2.2) & (grid < 3.5)))
    assert np.abs(found - swing(grid))[well_inside].max() < 2e-3
    assert np.nanmax(np.abs(found - swing(grid))) < 0.02


@pytest.mark.parametrize(("period", "says"), [(0.5, ""), (1.0, "a pose every 1.0 s says too little of the motion between")])
def test_a_tracker_that_seldom_looks_says_nothing_of_what_lies_between(period: float, says: str, lively: Recording) -> None:
    """A curve through a pose a second was held against wheels that turn twice in it: a law of a steering was made of that."""
    rare, truth = copy.copy(lively), lively.ground_truth
    assert truth is not None
    kept = slice(None, None, round(period / float(np.median(np.diff(truth.stamp)))))
    rare.ground_truth = dataclasses.replace(
        truth, stamp=truth.stamp[kept], stamp_ns=truth.stamp_ns[kept], pose=truth.pose[kept], twist=truth.twist[kept]
    )
    assert says in seldom_tracked(rare)
    assert bool(seldom_tracked(rare)) == bool(says)
    [motion] = read_motions(THESIS, rare, 0, 5.0, True)
    assert np.isfinite(motion.tracked_twist).any() != bool(says)


@pytest.mark.parametrize(
    ("rate", "torques", "told"), [(500.0, True, False), (20.0, True, False), (10.0, True, True), (10.0, False, False)]
)
def test_torques_that_are_seldom_read_are_told(rate: float, torques: bool, told: bool) -> None:
    """A tenth of a second apart they balanced nothing: a friction was withdrawn for a law of all joints."""
    stamp = np.arange(0.0, 10.0, 1.0 / rate)
    effort = np.full((len(stamp), THESIS.n, 2), 1.0 if torques else np.nan)
    recording: Any = SimpleNamespace(joint_states=SimpleNamespace(stamp=stamp, effort=effort))
    assert seldom_read(recording).startswith(f"joint_states: at {rate:.2g} Hz torques change unseen" if told else "")
    assert bool(seldom_read(recording)) == told
