"""What a model misjudges of slips, and what a residual shows of it."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from pcw_control.excitation import make_excitation
from pcw_description import load_robot
from pcw_description.effect_instance import EffectInstance
from pcw_description.recording import Recording
from pcw_sim_bridge.mismatch.regression.noise_model import LEAST_SLIPS, reliability, seen_misjudged
from pcw_sim_bridge.mismatch.regression.regression_problem import Channel
from pcw_sim_bridge.mismatch.regression.whitened_regression import Instance
from pcw_sim_bridge.mismatch.robot.robot_channels import RobotProblemBuilder
from pcw_sim_bridge.mismatch.search.evidence_selection import EffectSearch
from pcw_sim_bridge.simulated_run import record_run

THESIS = load_robot("thesis")
COUNT = 4000
NOISE = 1e-5  # [m/s]


def slipping(rng: np.random.Generator, part: float, slips: np.ndarray | None = None) -> tuple[SimpleNamespace, np.ndarray]:
    """A problem of one channel whose model misjudges this part of what it may of slips, and what it leaves."""
    may_be = np.exp(rng.normal(np.log(5.0 * NOISE), 1.0, (COUNT, 1))) if slips is None else slips
    problem = SimpleNamespace(
        valid=np.ones((COUNT, 1), dtype=bool), channels=[Channel("rolling", "m/s", ("a",), "drive")],
        misjudged=np.hypot(may_be, NOISE), misjudged_slips=may_be,
    )
    return problem, NOISE * rng.standard_normal((COUNT, 1)) + part * may_be * rng.standard_normal((COUNT, 1))


@pytest.mark.parametrize("part", [0.5, 0.8])
def test_what_is_misjudged_of_slips_is_seen_in_what_is_left_where_there_are_more(part: float) -> None:
    """Outliers are held down, so that of slips of all sizes a little less is seen than there is."""
    problem, residual = slipping(np.random.default_rng(1), part)
    seen = seen_misjudged(problem, residual, LEAST_SLIPS)
    found = np.sqrt(np.mean(seen**2 - NOISE**2) / np.mean(problem.misjudged_slips**2))
    assert 0.6 * part < found < 1.1 * part


def test_a_residual_that_does_not_grow_with_slips_leaves_the_least_and_what_is_no_slip() -> None:
    """By what might be, patches that change slips by a quarter were noise, whatever the recording said of it."""
    problem, residual = slipping(np.random.default_rng(2), 0.0)
    seen = seen_misjudged(problem, residual, LEAST_SLIPS)
    np.testing.assert_allclose(seen, np.hypot(LEAST_SLIPS * problem.misjudged_slips, NOISE), rtol=1e-9)
    assert np.all(reliability(problem, residual, robust=False) > reliability(of_nothing_seen(problem), residual, robust=False))


def test_no_more_is_misjudged_than_may_be() -> None:
    """What an effect leaves that is not named yet is no reason to trust a channel less than in any case."""
    problem, residual = slipping(np.random.default_rng(3), 20.0)
    np.testing.assert_allclose(seen_misjudged(problem, residual, LEAST_SLIPS), problem.misjudged, rtol=1e-12)


@pytest.mark.parametrize("slips", [np.zeros((COUNT, 1)), np.full((COUNT, 1), 5.0 * NOISE)])
def test_slips_that_are_all_alike_tell_nothing(slips: np.ndarray) -> None:
    """Nor do those of a channel without a sample."""
    problem, residual = slipping(np.random.default_rng(4), 0.0, slips)
    np.testing.assert_array_equal(seen_misjudged(problem, residual, LEAST_SLIPS), problem.misjudged)
    problem, residual = slipping(np.random.default_rng(4), 0.0)
    problem.valid[:] = False
    np.testing.assert_array_equal(seen_misjudged(problem, residual, LEAST_SLIPS), problem.misjudged)


def test_problems_that_misjudge_no_slips_are_as_they_were() -> None:
    """Those of bench axes, and of robots off the ground."""
    problem, residual = slipping(np.random.default_rng(5), 0.0)
    assert seen_misjudged(of_nothing_seen(problem), residual, LEAST_SLIPS) is problem.misjudged
    assert seen_misjudged(SimpleNamespace(misjudged=None, misjudged_slips=None), residual, LEAST_SLIPS) is None


def test_a_patch_that_changes_slips_by_a_third_is_no_noise(tmp_path: Path) -> None:
    """Where the recording shows that slips are judged well; one of factor 0.81 was silent with 2500 nats."""
    outline = {"x": 0.5, "y": 0.3, "length": 0.6, "width": 0.4, "yaw": 0.0, "roundness": 1.0}
    patch = EffectInstance("low_friction_patch", THESIS.caster_names, {"factor": 0.75, **outline})
    excitation = make_excitation("identification", THESIS, 25.0, 11)
    true = dataclasses.replace(THESIS, physics=(patch,))
    record_run(true, excitation.twist, excitation.duration, 11, tmp_path / "run", "reduced", controlled_as=THESIS)
    problem = RobotProblemBuilder(THESIS, [Recording.open(tmp_path / "run", THESIS)]).build()
    term = next(k for k, term in enumerate(problem.terms) if term.effect == patch.name)
    found = (Instance(term, tuple(sorted(outline.items())), (0,)),)
    gains = []
    for doubted in (problem, dataclasses.replace(problem, misjudged_slips=None)):
        regression = EffectSearch(doubted, np.random.default_rng(0)).whiten_beside(found)
        gains.append(regression.fit(found).log_evidence - regression.fit(()).log_evidence)
    assert gains[0] > 4.0 * gains[1] > 0.0


def of_nothing_seen(problem: SimpleNamespace) -> SimpleNamespace:
    """The same without knowing which of it is slips."""
    return SimpleNamespace(**vars(problem) | {"misjudged_slips": None})
