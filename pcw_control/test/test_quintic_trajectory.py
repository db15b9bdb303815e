"""Quintic trajectories: boundary conditions, derivatives, limits."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pcw_control.errors import ControlError
from pcw_control.quintic_trajectory import (
    MotionLimits,
    QuinticTrajectory,
    TrajectoryPoint,
    nearest_turn,
    plan_point_to_point,
    quintic_coefficients,
)

LIMITS = MotionLimits(speed=0.6, acceleration=0.5, yaw_rate=1.0, yaw_acceleration=1.5)
coordinate = st.floats(-5.0, 5.0)
pose = st.tuples(coordinate, coordinate, st.floats(-3.0, 3.0)).map(np.array)
small = st.floats(-0.25, 0.25)
rate = st.tuples(small, small, small).map(np.array)
moving = st.builds(TrajectoryPoint, pose, rate)
accelerating = st.builds(TrajectoryPoint, pose, rate, rate)


@settings(max_examples=60, deadline=None)
@given(accelerating, accelerating, st.floats(0.1, 100.0))
def test_meets_both_boundary_conditions(start, goal, duration):
    trajectory = QuinticTrajectory(quintic_coefficients(start, goal, duration), duration)
    for wanted, found in ((start, trajectory.sample(0.0)), (goal, trajectory.sample(duration))):
        # The coefficients cancel to the end point; they grow as a T^2, up to 2500.
        np.testing.assert_allclose(found.pose, wanted.pose, atol=1e-9)
        np.testing.assert_allclose(found.velocity, wanted.velocity, atol=1e-9 * (1.0 + 10.0 / duration))
        np.testing.assert_allclose(found.acceleration, wanted.acceleration, atol=1e-9 * (1.0 + 100.0 / duration**2))


@settings(max_examples=60, deadline=None)
@given(moving, moving)
def test_keeps_every_limit_all_the_way(start, goal):
    trajectory = plan_point_to_point(start, goal, LIMITS)
    # 1e-3: the planner checks 257 instants, this test others in between.
    for t in np.linspace(0.0, trajectory.duration, 401):
        p = trajectory.sample(t)
        assert math.hypot(*p.velocity[:2]) <= LIMITS.speed * 1.001
        assert math.hypot(*p.acceleration[:2]) <= LIMITS.acceleration * 1.001
        assert abs(p.velocity[2]) <= LIMITS.yaw_rate * 1.001
        assert abs(p.acceleration[2]) <= LIMITS.yaw_acceleration * 1.001


@settings(max_examples=40, deadline=None)
@given(pose, pose)
def test_rest_to_rest_is_as_fast_as_the_limits_allow(start, goal):
    trajectory = plan_point_to_point(TrajectoryPoint(start), TrajectoryPoint(goal), LIMITS)
    if trajectory.duration < 1e-3:
        return
    points = [trajectory.sample(t) for t in np.linspace(0.0, trajectory.duration, 2001)]
    use = max(
        max(math.hypot(*p.velocity[:2]) for p in points) / LIMITS.speed,
        max(math.hypot(*p.acceleration[:2]) for p in points) / LIMITS.acceleration,
        max(abs(p.velocity[2]) for p in points) / LIMITS.yaw_rate,
        max(abs(p.acceleration[2]) for p in points) / LIMITS.yaw_acceleration,
    )
    assert use == pytest.approx(1.0, abs=1e-5)


def test_velocity_and_acceleration_are_derivatives():
    start = TrajectoryPoint(np.array([1.0, -2.0, 0.3]), np.array([0.2, 0.1, -0.1]), np.array([0.1, 0.0, 0.2]))
    trajectory = plan_point_to_point(start, TrajectoryPoint(np.array([-1.0, 2.0, 1.0])), LIMITS)
    h = 1e-5
    for t in np.linspace(0.1, trajectory.duration - 0.1, 23):
        before, here, after = trajectory.sample(t - h), trajectory.sample(t), trajectory.sample(t + h)
        np.testing.assert_allclose(here.velocity, (after.pose - before.pose) / (2 * h), atol=1e-8)
        np.testing.assert_allclose(here.acceleration, (after.velocity - before.velocity) / (2 * h), atol=1e-8)


def test_rest_to_rest_passes_the_middle_at_fifteen_eighths_of_the_mean_speed():
    start, goal = TrajectoryPoint(np.zeros(3)), TrajectoryPoint(np.array([1.0, 2.0, 3.0]))
    a = quintic_coefficients(start, goal, 2.0)
    np.testing.assert_allclose(a, np.outer([0, 0, 0, 10, -15, 6], goal.pose), atol=1e-12)


def test_stays_at_the_goal_and_before_the_start():
    goal = np.array([1.0, 0.5, -0.7])
    trajectory = plan_point_to_point(TrajectoryPoint(np.zeros(3)), TrajectoryPoint(goal), LIMITS)
    np.testing.assert_allclose(trajectory.sample(trajectory.duration + 100.0).pose, goal, atol=1e-12)
    np.testing.assert_array_equal(trajectory.sample(-1.0).pose, np.zeros(3))


def test_goes_on_with_a_final_velocity():
    goal = TrajectoryPoint(np.array([1.0, 0.0, 0.0]), np.array([0.3, 0.0, 0.0]))
    trajectory = plan_point_to_point(TrajectoryPoint(np.zeros(3)), goal, LIMITS)
    np.testing.assert_allclose(trajectory.sample(trajectory.duration + 2.0).pose, [1.6, 0.0, 0.0], atol=1e-9)


@pytest.mark.parametrize(
    "wanted, reference, turned", [(3.0, -3.0, 3.0 - math.tau), (0.1, 6.2, 0.1 + math.tau), (1.0, 0.5, 1.0)]
)
def test_takes_the_shorter_turn(wanted, reference, turned):
    assert nearest_turn(wanted, reference) == pytest.approx(turned)


def test_already_there_takes_no_time():
    here = TrajectoryPoint(np.array([1.0, 2.0, 3.0]))
    trajectory = plan_point_to_point(here, here, LIMITS)
    assert trajectory.duration == 0.0
    np.testing.assert_array_equal(trajectory.sample(5.0).pose, here.pose)


def test_says_when_no_quintic_fits():
    """A long way with a large acceleration at the start: short ones are too fast, long ones swing out too far."""
    start = TrajectoryPoint(np.zeros(3), np.zeros(3), np.array([0.0, 0.45, 0.0]))
    with pytest.raises(ControlError, match=r"no duration keeps the quintic .* within MotionLimits\(speed=0.6"):
        plan_point_to_point(start, TrajectoryPoint(np.array([30.0, 50.0, 0.0])), LIMITS)


def test_plans_with_accelerations_at_the_ends():
    start = TrajectoryPoint(np.zeros(3), np.array([0.1, 0.0, 0.0]), np.array([0.2, 0.1, 0.0]))
    goal = TrajectoryPoint(np.array([1.0, 0.5, 0.4]), np.zeros(3), np.array([-0.1, 0.0, 0.1]))
    trajectory = plan_point_to_point(start, goal, LIMITS)
    for wanted, found in ((start, trajectory.sample(0.0)), (goal, trajectory.sample(trajectory.duration))):
        np.testing.assert_allclose(found.acceleration, wanted.acceleration, atol=1e-9)
    shorter = plan_point_to_point(start, goal, MotionLimits(1.2, 1.0, 2.0, 3.0))
    assert shorter.duration < trajectory.duration


def test_refuses_what_cannot_be():
    rest = TrajectoryPoint(np.zeros(3))
    with pytest.raises(ControlError, match=r"goal pose .* allowed: three finite numbers"):
        plan_point_to_point(rest, TrajectoryPoint(np.array([0.0, np.nan, 0.0])), LIMITS)
    with pytest.raises(ControlError, match=r"start velocity .* at most 0.6 along"):
        plan_point_to_point(TrajectoryPoint(np.zeros(3), np.array([0.7, 0.0, 0.0])), rest, LIMITS)
    with pytest.raises(ControlError, match=r"speed = -1.0 .* positive"):
        MotionLimits(speed=-1.0)
