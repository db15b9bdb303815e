"""The chassis on its springs: the resonator of the channel model, and what it saves on a robot in space."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest

from pcw_description import load_robot
from pcw_sim_bridge.mismatch.regression.noise_model import robust_deviation, white_noise_model
from pcw_sim_bridge.mismatch.regression.regression_problem import RegressionProblem
from pcw_sim_bridge.mismatch.regression.whitened_regression import WhitenedRegression
from pcw_sim_bridge.mismatch.robot.chassis_sway import ChassisSway
from pcw_sim_bridge.mismatch.robot.robot_channels import RobotProblemBuilder
from pcw_sim_bridge.mismatch.subjects.robot_subject import RobotSubject
from pcw_sim_bridge.simulated_run import record_run

THESIS = load_robot("thesis")
RATE = 200.0


def amplitude(frequency: float, sway: ChassisSway) -> float:
    """Of the response along x to a sine of amplitude 1, once it has settled."""
    time = np.arange(0.0, 30.0, 1.0 / RATE)
    sine = np.sin(frequency * time)
    response = sway.response(np.column_stack([sine, sine]), RATE)[:, 0]
    return float(np.abs(response[len(time) // 2 :]).max())


def test_it_follows_slow_motions_and_resonates_at_its_frequency():
    sway = ChassisSway.of(THESIS)
    frequency, damping = float(sway.frequency[0]), float(sway.damping[0])
    assert amplitude(0.02 * frequency, sway) == pytest.approx(1.0, abs=0.002)
    assert amplitude(frequency, sway) == pytest.approx(1.0 / (2.0 * damping), rel=0.01)
    # What is beyond half the sampling rate follows at once.
    stiff = dataclasses.replace(sway, frequency=np.full(2, 2.0 * math.pi * RATE))
    assert amplitude(frequency, stiff) == pytest.approx(1.0, abs=0.002)


def test_the_detuned_response_is_a_derivative():
    sway = ChassisSway.of(THESIS)
    moves = np.cumsum(np.random.default_rng(0).standard_normal((2000, 2)), axis=0)
    change = sway.response(moves, RATE, 0.01) - sway.response(moves, RATE)
    error = change - 0.01 * sway.detuned(moves, RATE)
    assert np.std(error) < 0.05 * np.std(change)


def test_a_robot_that_its_springs_do_not_hold_upright_does_not_sway():
    suspension = dataclasses.replace(THESIS.wheel_suspension, stiffness=100.0)
    assert ChassisSway.of(dataclasses.replace(THESIS, suspension=suspension)).lean.tolist() == [0.0, 0.0]


@pytest.fixture(scope="module")
def in_space(tmp_path_factory: pytest.TempPathFactory) -> RegressionProblem:
    """A run in PyBullet, which steps every millisecond."""

    def twist(time: float) -> np.ndarray:
        return np.array([0.4 * math.sin(2.0 * time), 0.3 * math.sin(3.1 * time), 0.5 * math.sin(2.3 * time)])

    path = tmp_path_factory.mktemp("in_space") / "run"
    record_run(THESIS, twist, 15.0, 5, path, "pybullet")
    recording = RobotSubject(THESIS).open(path, "fit", {}).recording
    return RobotProblemBuilder(THESIS, [recording]).build(with_terms=False)


def retuned(problem: RegressionProblem) -> tuple[dict[str, float], np.ndarray]:
    """Numbers as white noise in all channels would have them, and the deviations (C,) of what they leave."""
    white, block = white_noise_model(problem.residual, problem.valid), np.zeros(len(problem.time), dtype=np.int64)
    regression = WhitenedRegression(problem, white, np.ones_like(problem.residual), block)
    fit = regression.fit(())
    residual = regression.unwhitened_residual(fit)
    left = [robust_deviation(residual[problem.valid[:, k], k]) for k in range(residual.shape[1])]
    return dict(zip([n.name for n in problem.nuisances], fit.mean, strict=False)), np.array(left)


def without(problem: RegressionProblem, part: str) -> RegressionProblem:
    """The problem without the numbers that have this in their name."""
    return dataclasses.replace(problem, nuisances=tuple(n for n in problem.nuisances if part not in n.name))


def test_with_it_a_robot_in_space_leaves_far_less(in_space: RegressionProblem):
    """Residual forces, re-tuned, with and without the numbers of the sway."""
    left = [retuned(problem)[1][:2] for problem in (in_space, without(in_space, "suspension"))]
    print(f"residual forces {left[0]} N with it, {left[1]} N without")
    assert np.linalg.norm(left[0]) < 0.75 * np.linalg.norm(left[1])


def test_leaning_axes_and_headings_of_half_a_step_later_are_why_wheels_contradict_one_another(in_space: RegressionProblem):
    """Both engines take rates from one set of angles, and the next angles from these rates: half a millisecond between them.

    It made a third of the contradictions, which passed for tyres of one and a half times their relaxation length.
    """
    numbers, left = retuned(in_space)
    assert numbers["heading_lead"] == pytest.approx(0.5e-3, rel=0.25)
    sway = ChassisSway.of(THESIS)
    assert [numbers[f"suspension.lean.{axis}"] for axis in "xy"] == pytest.approx(sway.lean.tolist(), rel=0.3)
    assert abs(numbers["contact.relaxation_length"]) < 0.25 * THESIS.contact.relaxation_length
    contradictions = slice(3, 3 + 2 * THESIS.n)
    _, blind = retuned(without(in_space, "heading_lead"))
    assert np.linalg.norm(left[contradictions]) < 0.7 * np.linalg.norm(blind[contradictions])


def test_an_imu_leans_and_swings_as_the_chassis_does_that_carries_it(tmp_path: Path):
    """It feels of its weight what the chassis leans by, and at its height is thrown about.

    At 2 Hz and 0.2 m above the floor the latter is three times the former, and would make the sensor lean four times as far.
    """

    def twist(time: float) -> np.ndarray:
        return np.array([0.1 * math.sin(12.0 * time), 0.1 * math.sin(13.0 * time), 0.2 * math.sin(2.3 * time)])

    record_run(THESIS, twist, 15.0, 5, tmp_path / "run", "pybullet")
    recording = RobotSubject(THESIS).open(tmp_path / "run", "fit", {}).recording
    numbers, _ = retuned(RobotProblemBuilder(THESIS, [recording]).build(with_terms=False))
    assert [numbers[f"imu.lean.{axis}"] for axis in "xy"] == pytest.approx(ChassisSway.of(THESIS).lean.tolist(), rel=0.25)
