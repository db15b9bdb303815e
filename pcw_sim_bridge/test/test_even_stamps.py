"""Readings at even times with stamps that tremble, and readings that came when their stamps say."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from pcw_description import load_robot
from pcw_description.recording import Recording
from pcw_sim_bridge.mismatch.readings.even_stamps import EvenStamps
from pcw_sim_bridge.mismatch.subjects.robot_subject import RobotSubject
from pcw_sim_bridge.simulated_run import record_run
from pcw_sim_bridge.stamping import StampingParameters

STEP, JITTER = 0.002, 2e-4


def even_stamps(stamp: np.ndarray, signals: np.ndarray) -> np.ndarray:
    return EvenStamps().even("joints", stamp, signals)


def motion(time: np.ndarray) -> np.ndarray:
    return np.stack([3.0 * np.sin(1.3 * time), 2.0 * np.sin(0.7 * time) + time], axis=1)


def readings(
    seed: int, jitter: float = JITTER, drift: float = 0.0, when_stamped: bool = False, noise: float = 5e-5
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Even times (T,), stamps (T,) and signals (T, 2) of 20 s of which one in fifty readings is lost."""
    rng = np.random.default_rng(seed)
    even = np.flatnonzero(rng.random(10_000) > 0.02) * STEP
    stamp = np.maximum.accumulate(even + drift * np.sin(0.2 * even) + jitter * rng.standard_normal(len(even)))
    signals = motion(stamp if when_stamped else even) + noise * rng.standard_normal((len(even), 2))
    return even, stamp, signals


@pytest.mark.parametrize(("jitter", "drift"), [(JITTER, 0.0), (JITTER, 0.005), (0.2 * STEP, 0.0)])
def test_trembling_stamps_of_even_readings_are_made_even(jitter: float, drift: float) -> None:
    """Also those of a clock that wanders by more than a step, and where some are nearer to the turn of the next."""
    even, stamp, signals = readings(1, jitter, drift)
    found = even_stamps(stamp, signals)
    apart = found - even - drift * np.sin(0.2 * even)
    assert np.std(stamp - even - drift * np.sin(0.2 * even)) == pytest.approx(jitter, rel=0.1)
    assert np.std(apart[500:-500]) < (0.1 if jitter == JITTER else 0.2) * jitter
    assert np.all(np.diff(found) > 0.0)


def test_who_was_silent_may_go_on_at_times_of_another_phase() -> None:
    even, stamp, signals = readings(6)
    later = np.where(np.arange(len(stamp)) < 4000, 0.0, 0.7 + 0.5 * STEP)
    apart = even_stamps(stamp + later, signals) - even - later
    assert np.abs(apart).max() < JITTER
    assert np.std(apart) < 0.15 * JITTER


@pytest.mark.parametrize("known", [0, 1])
def test_a_signal_that_was_not_recorded_leaves_the_others_theirs(known: int) -> None:
    _, stamp, signals = readings(2)
    signals[:, 1 - known] = np.nan
    assert even_stamps(stamp, signals) is not stamp


def test_readings_that_came_when_stamped_keep_their_stamps() -> None:
    _, stamp, signals = readings(3, when_stamped=True)
    assert even_stamps(stamp, signals) is stamp


def test_nobody_can_tell_of_what_stands_still_or_comes_at_any_time() -> None:
    _, stamp, signals = readings(4)
    assert even_stamps(stamp, 0.0 * signals) is stamp
    assert even_stamps(stamp, np.full_like(signals, np.nan)) is stamp
    few = stamp[:100]
    assert even_stamps(few, signals[:100]) is few
    _, wild, signals = readings(5, jitter=0.5 * STEP)
    assert even_stamps(wild, signals) is wild
    bursts = np.repeat(wild[::5], 5)[: len(wild)] + 1e-6 * (np.arange(len(wild)) % 5)
    assert even_stamps(bursts, signals) is bursts


def test_what_was_said_before_counts_in_a_moment_that_tells_nothing() -> None:
    _, stamp, signals = readings(7)
    stamps = EvenStamps()
    still = 0.0 * signals[:500]
    assert np.all(stamps.even("joints", stamp[:500], still) == stamp[:500])
    assert stamps.even("joints", stamp, signals) is not stamp
    assert np.any(stamps.even("joints", stamp[:500], still) != stamp[:500])
    assert np.all(stamps.even("imu", stamp[:500], still) == stamp[:500])


def test_a_driver_that_begins_to_stamp_what_it_reads_is_believed() -> None:
    stamps = EvenStamps()
    _, stamp, signals = readings(8)
    assert stamps.even("joints", stamp, signals) is not stamp
    for seed in range(9, 29):
        _, stamp, signals = readings(seed, when_stamped=True)
        found = stamps.even("joints", stamp, signals)
    assert found is stamp


@pytest.mark.parametrize(("states", "commands_kept"), [(1, 1), (2, 1), (1, 2)])
def test_a_recording_is_opened_so_and_commands_keep_the_stamps_of_their_states(
    states: int, commands_kept: int, tmp_path: Path
) -> None:
    """With every second state left out the commands kept stamps that no state had any more: a lag and a delay were found."""
    robot = load_robot("thesis")

    def twist(time: float) -> np.ndarray:
        return min(time, 1.0) * np.array([0.4 * np.cos(time), 0.3 * np.sin(1.3 * time), 0.5 * np.sin(0.9 * time)])

    record_run(robot, twist, 8.0, 1, tmp_path / "run", "reduced", stamping=StampingParameters(stamp_jitter=JITTER, loss=1e-3))
    read = Recording.open(tmp_path / "run", robot)
    read.joint_states = every(read.joint_states, states)
    read.joint_commands = every(read.joint_commands, commands_kept)
    moved = EvenStamps().evenly_stamped(read)
    joints, commands = moved.joint_states, moved.joint_commands
    steps = np.diff(joints.stamp) / (states * STEP)
    assert np.abs(steps - np.round(steps)).max() < 0.01
    fewer, more = sorted((joints.stamp, commands.stamp), key=len)
    assert np.mean(np.isin(fewer, more)) > 0.98
    assert np.all(np.diff(commands.stamp) >= 0.0)


def every(series, step: int):  # type: ignore[no-untyped-def]
    """Every so many of the messages of a topic."""
    columns = {f.name: getattr(series, f.name) for f in dataclasses.fields(series)}
    return dataclasses.replace(series, **{k: v[::step] for k, v in columns.items() if isinstance(v, np.ndarray)})


def test_a_subject_opens_recordings_so(tmp_path: Path) -> None:
    robot = load_robot("thesis")

    def twist(time: float) -> np.ndarray:
        return min(time, 1.0) * np.array([0.4, 0.0, 0.2 * np.sin(time)])

    record_run(robot, twist, 4.0, 1, tmp_path / "run", "reduced", stamping=StampingParameters(stamp_jitter=JITTER))
    joints = RobotSubject(robot).open(tmp_path / "run", "recording", {}).recording.joint_states
    assert np.abs(np.diff(joints.stamp) - STEP).max() < 0.01 * STEP
