"""How joints follow commanded speeds: what a drive's own loop does is found, and told of joints alike in one sentence."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from pcw_description import load_robot
from pcw_sim_bridge.mismatch.robot.speed_response import responses_in_words, speed_responses

THESIS = load_robot("thesis")
PERIOD, FINE = 0.02, 1e-3  # [s] between messages, and of the integration
LENGTH = 30.0  # [s]
GAIN, DEAD, CONSTANT = 0.9, 0.06, 0.15


def recorded(drives: list[tuple[float, float, float]], seed: int = 0, pause: bool = False) -> SimpleNamespace:
    """A recording in which the drives follow steps of speed with (gain, dead time, time constant); steerings stand still."""
    rng = np.random.default_rng(seed)
    stamp = np.arange(0.0, LENGTH, PERIOD)
    wanted = np.repeat(rng.uniform(-8.0, 8.0, (len(stamp) // 40 + 1, THESIS.n)), 40, axis=0)[: len(stamp)]
    fine = np.arange(0.0, LENGTH, FINE)
    speed = np.zeros((len(stamp), THESIS.n, 2))
    for i, (gain, dead, constant) in enumerate(drives):
        late = np.clip(np.searchsorted(stamp, fine - dead, side="right") - 1, 0, None)
        value, answer = gain * wanted[0, i], np.empty_like(fine)
        for k, command in enumerate(wanted[late, i]):
            answer[k] = value
            value += FINE / constant * (gain * command - value)
        speed[:, i, 0] = np.interp(stamp, fine, answer) + 0.05 * rng.standard_normal(len(stamp))
    commands = np.zeros_like(speed)
    commands[:, :, 0] = wanted
    keep = (stamp < 12.0) | (stamp > 14.0) if pause else np.ones(len(stamp), dtype=bool)
    return SimpleNamespace(
        joint_commands=SimpleNamespace(stamp=stamp[keep], velocity=commands[keep]),
        joint_states=SimpleNamespace(stamp=stamp[keep], velocity=speed[keep]),
    )


@pytest.mark.parametrize("pause", [False, True])
def test_a_drive_is_as_slow_and_as_late_as_it_is(pause: bool) -> None:
    responses = speed_responses(THESIS, [recorded([(GAIN, DEAD, CONSTANT)] * THESIS.n, pause=pause)])  # type: ignore[list-item]
    assert [response.joint for response in responses] == [f"{name}_drive" for name in THESIS.caster_names]
    for response in responses:
        assert np.all(np.abs(response.values - [GAIN, DEAD, CONSTANT]) < [0.01, 0.01, 0.01])
        assert np.all(response.deviations < [0.01, 0.01, 0.01])
        assert response.left < 0.05
    [line] = responses_in_words(responses)
    assert all(name in line for name in THESIS.caster_names) and "dead time" in line and "time constant" in line


def test_a_drive_that_answers_between_two_messages_is_late_by_less_than_one() -> None:
    """A millisecond more of a command that is held changes no speed that is read: intervals had been as good as any."""
    drives = [(1.0, 0.004, 0.002)] * THESIS.n
    for response in speed_responses(THESIS, [recorded(drives)]):  # type: ignore[list-item]
        assert np.all(np.abs(response.values - [1.0, 0.004, 0.002]) < [0.01, PERIOD, PERIOD])
        assert np.all(response.deviations < [0.01, PERIOD, PERIOD])


def test_intervals_hold_the_truth() -> None:
    """Of 20 recordings nearly all do so with three standard deviations."""
    within = []
    for seed in range(5):
        for response in speed_responses(THESIS, [recorded([(GAIN, DEAD, CONSTANT)] * THESIS.n, seed)]):  # type: ignore[list-item]
            # Half a message period of the held command, and a step of the integration, are nobody's error.
            within.append(np.abs(response.values - [GAIN, DEAD, CONSTANT]) < 3.0 * response.deviations + [0.0, 2e-3, 2e-3])
    assert np.mean(within) > 0.9


def test_one_drive_that_is_slower_than_the_others_is_told_of() -> None:
    drives = [(1.0, 0.02, 0.05)] * THESIS.n
    drives[2] = (1.0, 0.02, 0.2)
    first, *lines = responses_in_words(speed_responses(THESIS, [recorded(drives)]))  # type: ignore[list-item]
    assert first == "The drive joints do not follow their commanded speeds alike."
    assert len(lines) == THESIS.n
    assert "time constant of 0.2" in lines[2] and not any("time constant of 0.2" in lines[k] for k in (0, 1, 3))


def test_a_loop_as_that_of_the_bridge_has_its_bandwidth() -> None:
    recording = recorded([(1.0, 0.0, 0.05)] * THESIS.n)
    bandwidth, stamp = 12.0, recording.joint_states.stamp
    for i in range(THESIS.n):
        speed, integral = float(recording.joint_commands.velocity[0, i, 0]), 0.0
        for k, command in enumerate(recording.joint_commands.velocity[:, i, 0]):
            recording.joint_states.velocity[k, i, 0] = speed
            for _ in range(round(PERIOD / FINE)):
                error = float(command) - speed
                integral += FINE * bandwidth**2 * error
                speed += FINE * (2.0 * bandwidth * error + integral)
    assert len(stamp) == round(LENGTH / PERIOD)
    for response in speed_responses(THESIS, [recording]):  # type: ignore[list-item]
        assert response.bandwidth == pytest.approx(bandwidth, rel=0.2)


def test_nothing_is_said_where_no_speeds_were_commanded_or_nobody_follows() -> None:
    silent = recorded([(1.0, 0.0, 0.05)] * THESIS.n)
    silent.joint_commands.velocity[:] = np.nan
    assert speed_responses(THESIS, [silent]) == []  # type: ignore[list-item]
    deaf = recorded([(1.0, 0.0, 0.05)] * THESIS.n)
    deaf.joint_states.velocity = np.random.default_rng(0).standard_normal(deaf.joint_states.velocity.shape)
    assert speed_responses(THESIS, [deaf]) == []  # type: ignore[list-item]
    assert responses_in_words([]) == ()
