"""What a motion needs of the friction, and that no more than a part of it is asked for."""

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pcw_control import (
    CONTROLLERS,
    ControlError,
    ControllerMeasurement,
    FrictionBudget,
    MotionLimits,
    TrajectoryPoint,
    TwistReference,
    make_controller,
    plan_point_to_point,
    plan_within_friction,
)
from pcw_description import load_robot
from pcw_description.augmented_object_model import AugmentedObjectModel
from pcw_description.robot_description import GRAVITY

ROBOT = load_robot("thesis")
REST = TrajectoryPoint(np.zeros(3))
LIMITS = MotionLimits(speed=1.0, acceleration=2.0, yaw_rate=2.0, yaw_acceleration=4.0)


def point(acceleration, velocity=(0.0, 0.0, 0.0), yaw=0.0):
    return TrajectoryPoint(np.array([0.0, 0.0, yaw]), np.array(velocity), np.array(acceleration))


@pytest.mark.parametrize("direction", [0.0, 0.7, 2.0, -2.5])
def test_a_push_straight_on_needs_its_part_of_the_weight(direction):
    """u = Lambda a / (mu m g) where all wheels can give alike; the polygon within the circle takes up to 2 %."""
    along = np.array([math.cos(direction), math.sin(direction), 0.0])
    inertia, _ = AugmentedObjectModel(ROBOT).evaluate(np.full(4, direction), np.zeros(3))
    acceleration, mu = 0.5, 0.2
    expected = float(along @ inertia @ along) * acceleration / (mu * ROBOT.total_mass * GRAVITY)
    found = FrictionBudget(ROBOT).use(point(acceleration * along), np.full(4, mu))
    # Load that the acceleration shifts and wheels behind their axes make it a little more than even sharing.
    assert expected * 0.999 <= found <= 1.08 * expected


def test_the_need_does_not_ask_where_the_robot_is_turned_and_grows_as_friction_falls():
    budget = FrictionBudget(ROBOT)
    one = budget.use(point((0.3, 0.1, 0.2), (0.4, 0.2, 0.3)), np.full(4, 0.3))
    c, s = math.cos(1.1), math.sin(1.1)
    turned = point((0.3 * c - 0.1 * s, 0.3 * s + 0.1 * c, 0.2), (0.4 * c - 0.2 * s, 0.4 * s + 0.2 * c, 0.3), 1.1)
    assert budget.use(turned, np.full(4, 0.3)) == pytest.approx(one, rel=1e-9)
    assert budget.use(point((0.3, 0.1, 0.2), (0.4, 0.2, 0.3)), np.full(4, 0.1)) == pytest.approx(3.0 * one, rel=1e-6)


@settings(max_examples=15, deadline=None)
@given(
    goal=st.tuples(st.floats(-2.0, 2.0), st.floats(-2.0, 2.0), st.floats(-3.0, 3.0)),
    mu=st.lists(st.floats(0.05, 0.8), min_size=4, max_size=4), share=st.floats(0.2, 1.0),
)
def test_from_rest_no_more_than_the_share_is_needed_and_no_longer_taken_than_that(goal, mu, share):
    budget, friction, target = FrictionBudget(ROBOT), np.array(mu), TrajectoryPoint(np.array(goal))
    plain = plan_point_to_point(REST, target, LIMITS)
    paced = plan_within_friction(budget, REST, target, LIMITS, share, friction)
    need = budget.largest_use(plain, friction) if plain.duration > 0.0 else 0.0
    if need <= share:
        assert np.array_equal(paced.coefficients, plain.coefficients) and paced.duration == plain.duration
        return
    found = budget.largest_use(paced, friction)
    # Not slower than it has to be: within what the load that shifts less changes of the need.
    assert 0.9 * share <= found <= 1.002 * share
    np.testing.assert_allclose(paced.sample(paced.duration).pose, plain.sample(plain.duration).pose, atol=1e-9)
    # The same path at another pace.
    np.testing.assert_allclose(
        paced.sample(0.3 * paced.duration).pose, plain.sample(0.3 * plain.duration).pose, atol=1e-9
    )


def test_a_robot_under_way_keeps_its_speed_at_the_start_and_needs_less_than_the_plain_plan():
    budget, friction = FrictionBudget(ROBOT), np.full(4, 0.05)
    start = TrajectoryPoint(np.zeros(3), np.array([0.5, 0.0, 0.0]))
    goal = TrajectoryPoint(np.array([2.0, 0.5, 0.0]))
    plain, paced = (
        plan_point_to_point(start, goal, LIMITS), plan_within_friction(budget, start, goal, LIMITS, 0.5, friction)
    )
    np.testing.assert_allclose(paced.sample(0.0).velocity, start.velocity)
    assert budget.largest_use(paced, friction) < budget.largest_use(plain, friction)


@pytest.mark.parametrize("share", [0.0, -0.1, 1.1, math.nan])
def test_a_share_that_is_none_is_refused(share):
    with pytest.raises(ControlError, match="share"):
        plan_within_friction(FrictionBudget(ROBOT), REST, point((0.0, 0.0, 0.0)), LIMITS, share)


GOVERNED = sorted(
    name for name, entry in CONTROLLERS.items() if hasattr(entry.parameters, "ground_share")
)


@pytest.mark.parametrize("name", GOVERNED)
def test_the_reference_of_a_twist_waits_for_the_ground(name):
    """On mu 0.02 the reference speeds up at half of what the ground gives; where nobody says, as it ever did."""
    controller, plain = make_controller(name, ROBOT), make_controller("computed_torque", ROBOT)
    measurement = ControllerMeasurement(np.zeros((4, 2)), np.zeros((4, 2)), np.zeros(3))
    slippery = dataclasses.replace(measurement, friction=np.full(4, 0.02))
    reference, dt = TwistReference(np.array([1.0, 0.0, 0.0])), 0.002
    _, told = controller.step(controller.initial_state(), slippery, reference, dt)
    inertia, _ = AugmentedObjectModel(ROBOT).evaluate(np.zeros(4), np.zeros(3))
    most = 0.5 * 0.02 * ROBOT.total_mass * GRAVITY / inertia[0, 0] * dt
    assert 0.85 * most <= told.reference_twist[0] <= most
    _, free = controller.step(controller.initial_state(), measurement, reference, dt)
    _, other = plain.step(plain.initial_state(), measurement, reference, dt)
    np.testing.assert_allclose(free.reference_twist, other.reference_twist)
