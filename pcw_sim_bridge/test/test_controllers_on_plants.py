"""The bars of figs. 5.2, 5.3 and 5.6 in the reduced plant, and random runs; the studies do both plants and more."""

import math

import numpy as np
import pytest

from pcw_control import CONTROLLERS, TwistReference
from pcw_control.computed_torque import ComputedTorque
from pcw_control.friction_sharing import BasicSolution, JacobianPseudoInverse
from pcw_control.quintic_trajectory import MotionLimits
from pcw_control.resolved_motion_rate import ResolvedMotionRate, SlidingModeRate, SlidingModeRateParameters
from pcw_description import load_robot
from pcw_description.augmented_object_model import AugmentedObjectModel
from pcw_sim_bridge.closed_loop import run_closed_loop
from pcw_sim_bridge.controller_robustness import random_run
from pcw_sim_bridge.controller_study import (
    _TakenOver,
    chatter,
    incompatibility,
    overloaded,
    peak_torques,
    rms,
    straight,
    true_incompatibility,
)


@pytest.mark.parametrize("name", ["thesis", pytest.param("dyros_pcv", marks=pytest.mark.nightly)])
def test_the_filtered_sliding_mode_is_quiet_and_within_its_bound_from_the_first_sample(name):
    """Fig. 5.2: at most 5 % of the chatter of the plain law; |s| within 1.02 of its bound."""
    robot = load_robot(name)
    target, found = TwistReference(np.array([0.1, 0.0, 0.0])), {}
    for law in ("plain", "low_pass_integral"):
        controller = SlidingModeRate(robot, SlidingModeRateParameters(law=law))
        run = run_closed_loop(
            overloaded(robot), _TakenOver(controller, target.twist), lambda _: target, 1.0, seed=1
        )
        found[law] = chatter(run)
    s = np.array([state.sliding.sliding for state in run.states]) if law == "low_pass_integral" else None
    assert np.all(np.abs(s) <= 1.02 * controller.sliding_bound(float(np.median(np.diff(run.time)))))
    assert found["low_pass_integral"] <= 0.05 * found["plain"]


@pytest.mark.parametrize("name", ["thesis", pytest.param("tidybot2", marks=pytest.mark.nightly)])
def test_sliding_mode_follows_closer_under_unknown_load(name):
    """Fig. 5.3: at most 0.35 of the error of RMRC."""
    robot = load_robot(name)
    reference, duration = straight(0.6, MotionLimits(0.5, 0.5))
    errors = []
    for controller in (ResolvedMotionRate(robot), SlidingModeRate(robot)):
        run = run_closed_loop(overloaded(robot), controller, reference, duration, seed=2)
        wanted = np.array([reference(t).pose[0] for t in run.time])[:, None] / robot.wheel_radius
        errors.append(rms(run.joint_position[:, :, 0] - run.joint_position[0, :, 0] - wanted))
    assert errors[1] <= 0.35 * errors[0]


def test_least_internal_force_keeps_the_wheels_together():
    """Fig. 5.6: less spread of the true speeds than through J, at most half of a basic solution's; from random headings."""
    robot = load_robot("thesis")
    reference, duration = straight(1.0, MotionLimits(0.8, 0.8))
    steer_angle = np.random.default_rng(56).uniform(-math.pi, math.pi, robot.n)
    spreads = []
    for make in (ComputedTorque, JacobianPseudoInverse, BasicSolution):
        run = run_closed_loop(robot, make(robot), reference, duration, seed=3, steer_angle=steer_angle)
        spreads.append(rms(true_incompatibility(robot, run)))
        # What encoders show is the truth and their noise: 0.005 rad/s on each joint.
        noise = 0.005 * math.sqrt((0.075**2 + 0.03**2) / 2.0 * 5.0 / 8.0)
        assert rms(incompatibility(robot, run)) == pytest.approx(math.hypot(spreads[-1], noise), rel=0.1)
    assert spreads[0] < spreads[1] and spreads[0] <= 0.5 * spreads[2]


def test_peak_torques_are_alike_where_all_wheels_stand_along():
    """Straight on with all wheels ahead there is nothing to choose: tau = r Lambda a / n at the quintic's peak."""
    robot = load_robot("thesis")
    through_A, through_J = peak_torques(robot, np.zeros(4), 2.0, MotionLimits(9.0, 0.8))
    inertia, _ = AugmentedObjectModel(robot).evaluate(np.zeros(4), np.zeros(3))
    assert through_A == pytest.approx(0.075 * inertia[0, 0] * 0.8 / 4.0, rel=1e-4)
    assert through_J == pytest.approx(through_A, rel=1e-6)


DAILY = ("cross_coupling", "sliding_mode_rate", "slip_constraint_force")


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=() if name in DAILY else pytest.mark.nightly) for name in CONTROLLERS]
)
def test_random_runs_are_stable(name):
    """One of each controller; 200 are made by `controller_robustness`."""
    outcome = random_run(300, names=(name,))
    assert not outcome.unstable, outcome
