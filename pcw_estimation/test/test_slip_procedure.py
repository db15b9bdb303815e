"""The procedure of section 4.1.1 step by step, and what the consensus does beyond it."""

import numpy as np
import pytest

from pcw_description import inverse_kinematics, load_robot
from pcw_estimation import SlipProcedure, Verdict
from pcw_estimation.slip_procedure import slipping_wheels
from pcw_estimation.studies.encoder_study import drawn_scenario, judge, run

THESIS = load_robot("thesis")


@pytest.mark.parametrize(
    ("residual", "slips", "known"),
    [
        ([0.004, -0.004, 0.003, -0.002], [False] * 4, True),  # (4.6)
        ([-0.05, -0.05, 0.15, -0.05], [False, False, True, False], True),  # Fig. 4.1: positive, the rest negative
        ([-0.05, -0.05, 0.04, 0.045], [True, True, False, False], True),  # of two pairs the smaller, (4.8) for the others
        ([-0.05, -0.055, -0.048, 0.15], [False, False, False, True], True),
        ([-0.10, 0.20, -0.30, 0.40], [False] * 4, False),  # no pair
        ([-0.09, 0.03, 0.06], [False] * 3, False),  # a pair of one sign, but too far apart
    ],
)
def test_pairs_and_the_wheels_that_go_with_them(residual, slips, known):
    found, can_know = slipping_wheels(np.array(residual), np.full(len(residual), 0.010))
    assert found.tolist() == slips and can_know is known


def test_step_3_gives_twist_and_slip_without_the_wheel_that_slips():
    """Casters at right angles to each other's moment arms: the one case in which one axis does not disturb the other."""
    detector, position = SlipProcedure(THESIS), np.zeros((4, 2))
    velocity = inverse_kinematics(THESIS, np.zeros(4), np.array([0.5, 0.0, 0.0]))
    velocity[:, 0] += np.array([0.3, 0.3, 0.0, 0.0]) / THESIS.wheel_radius
    velocity[:, 0] -= np.array([0.0, 0.0, 0.02, 0.02]) / THESIS.wheel_radius
    state = detector.initial_state()
    for k in range(12):
        state, finding = detector.step(state, position, velocity, 0.002 if k else 0.0)
    assert finding.verdict is Verdict.SLIP
    rolling = ~(finding.slipping | finding.skidding)[:, 0]
    assert rolling.sum() == 2
    np.testing.assert_allclose(finding.slip[rolling, 0], 0.0, atol=1e-9)


def test_consensus_is_exact_where_the_procedure_is_not():
    scenarios = [drawn_scenario(seed) for seed in range(3000, 3025)]
    exact = {method: sum(judge(s, run(method, s.driven)).exact for s in scenarios) for method in ("consensus", "procedure")}
    assert exact["consensus"] >= 24 and exact["procedure"] < 10
