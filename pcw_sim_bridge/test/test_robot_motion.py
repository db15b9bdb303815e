"""Where the channels end: at what torques tell beyond their noise."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from pcw_control.excitation import make_excitation
from pcw_description import load_robot
from pcw_description.recording import Recording
from pcw_sim_bridge.mismatch.robot_motion import SMALLEST_CUTOFF, choose_cutoff
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
