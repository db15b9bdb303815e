"""The search on bench axes drawn at random: right names and numbers, and no name where nothing is missing."""

from __future__ import annotations

import numpy as np
import pytest

from pcw_sim_bridge.mismatch.axis.axis_channels import AxisProblemBuilder
from pcw_sim_bridge.mismatch.axis.bench_cases import BenchCase, draw_bench_case
from pcw_sim_bridge.mismatch.findings.explanation import Explanation, explain
from pcw_sim_bridge.mismatch.search.open_set import smooth_basis

# The main parameter of each effect and how far from the truth it may come out. An error of the torque constant hides behind
# the tolerance of the inertia (2 % of the inertial force here), hence its width.
EFFECTS = {
    "drive_coulomb_friction": ("coulomb", 0.05),
    "drive_viscous_friction": ("viscous", 0.05),
    "drive_stribeck_friction": ("stribeck", 0.15),
    "constant_load": ("load", 0.05),
    "motor_cogging": ("order", 0.01),
    "load_dependent_friction": ("fraction", 0.15),
    "torque_constant_error": ("error", 0.35),
}


def explained(case: BenchCase) -> Explanation:
    builder = AxisProblemBuilder(case.axis, case.recordings)
    return explain(builder.build(builder.choose_smoothing()), np.random.default_rng(0))


@pytest.mark.parametrize("seed", [*range(3), *(pytest.param(seed, marks=pytest.mark.nightly) for seed in range(3, 12))])
def test_nothing_is_named_where_nothing_is_missing(seed):
    """Any motion, any colour of noise, an inertia off by as much as its tolerance says."""
    explanation = explained(draw_bench_case(np.random.default_rng([seed, 7])))
    assert [entry.term.effect for entry in explanation.named] == []


@pytest.mark.parametrize("motion", ["sines", pytest.param("chirp", marks=pytest.mark.nightly)])
@pytest.mark.parametrize("effect", EFFECTS)
def test_an_effect_alone_is_named_with_its_size(effect, motion):
    case = draw_bench_case(np.random.default_rng([len(effect), len(motion)]), [effect], 0.4, motion)
    explanation = explained(case)
    assert [entry.term.effect for entry in explanation.named] == [effect]
    name, tolerance = EFFECTS[effect]
    estimate = explanation.named[0].estimates[name]
    assert estimate.value == pytest.approx(case.truth[0].parameters[name], rel=tolerance)
    assert estimate.low <= estimate.value <= estimate.high


def test_a_variable_that_leaps_leaves_nothing_to_fit_between():
    """A wheel that only ever ran at two speeds has knots with no sample near them."""
    speeds = np.repeat([-1.0, 1.0], 500) + 0.01 * np.random.default_rng(0).standard_normal(1000)
    functions, knots = smooth_basis(speeds, periodic=False)
    assert functions.shape[1] < len(knots)
    assert (functions.std(axis=0) > 0.0).all()


@pytest.mark.parametrize(
    ("effects", "motion"),
    [
        (("drive_coulomb_friction", "drive_viscous_friction", "constant_load"), "sines"),
        (("drive_coulomb_friction", "drive_viscous_friction", "constant_load"), "moves"),
        (("drive_coulomb_friction", "motor_cogging"), "sines"),
        (("drive_coulomb_friction", "drive_stribeck_friction"), "sines"),
    ],
)
def test_effects_together_are_told_apart(effects, motion):
    """The three of the published drive, a cogging beside a friction, and two frictions that differ in creep alone."""
    explanation = explained(draw_bench_case(np.random.default_rng([3, len(motion)]), effects, 0.3, motion))
    assert sorted(entry.term.effect for entry in explanation.named) == sorted(effects)
