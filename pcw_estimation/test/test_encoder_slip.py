"""Slip from the consistency of the encoders, (4.1)-(4.5)."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pcw_description import (
    KinematicsError,
    inverse_kinematics,
    joint_matrix,
    load_robot,
    shipped_robots,
    wheel_jacobian,
)
from pcw_estimation.encoder_slip import EncoderSlipParameters, EncoderSlipState, initial_state, step
from pcw_estimation.errors import EstimationError

THESIS = load_robot("thesis")
DEFAULT = EncoderSlipParameters()
AT_ONCE = EncoderSlipParameters(confirm_time=0.0)


def rolling(robot, twist, steer_angle):
    """Joint angles and speeds of a robot that rolls without slip."""
    position = np.zeros((robot.n, 2))
    position[:, 1] = steer_angle
    return position, inverse_kinematics(robot, position[:, 1].copy(), np.array(twist, dtype=float))


def trailing(robot, twist):
    """Headings of casters that have settled behind a motion."""
    vx, vy, omega = twist
    axis = robot.steer_axis
    return np.arctan2(vy + omega * axis[:, 0], vx - omega * axis[:, 1])


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from(shipped_robots()))
def test_a_consistent_motion_has_no_slip(seed, name):
    robot = load_robot(name)
    rng = np.random.default_rng(seed)
    try:
        position, velocity = rolling(robot, rng.normal(0.0, 1.0, 3), rng.uniform(-3.0, 3.0, robot.n))
    except KinematicsError:
        return  # no offset: the steering rate does not follow from the motion
    _, output = step(robot, AT_ONCE, initial_state(robot), position, velocity, 0.002)
    assert np.abs(output.slip).max() < 1e-12 * max(1.0, np.abs(velocity).max())
    assert not output.slipping.any() and not output.skidding.any()


def test_is_the_projection_of_the_sensed_velocities():
    """(4.5) literally: (I - A A^+) B q_dot."""
    rng = np.random.default_rng(3)
    position, velocity = rng.normal(size=(4, 2)), rng.normal(size=(4, 2))
    A, B = wheel_jacobian(THESIS, position[:, 1].copy()), joint_matrix(THESIS)
    _, output = step(THESIS, DEFAULT, initial_state(THESIS), position, velocity, 0.002)
    expected = (np.eye(8) - A @ np.linalg.pinv(A)) @ B @ velocity.ravel()
    np.testing.assert_allclose(output.slip.ravel(), expected, atol=1e-13)


def slipping_wheel(index, slip, twist=(0.5, 0.0, 0.0)):
    position, velocity = rolling(THESIS, twist, trailing(THESIS, twist))
    velocity[index, 0] += slip / THESIS.wheel_radius[index]
    return position, velocity


@pytest.mark.parametrize("index", range(4))
def test_one_wheel_that_slips_is_flagged_with_the_largest_residual(index):
    """Fig. 4.1: the slipping wheel's residual is positive, those of the others are negative and smaller."""
    position, velocity = slipping_wheel(index, 0.20)
    _, output = step(THESIS, AT_ONCE, initial_state(THESIS), position, velocity, 0.002)
    assert output.slipping[index, 0]
    assert output.slipping.sum() == 1 and not output.skidding.any()
    others = np.delete(output.slip[:, 0], index)
    assert output.slip[index, 0] > 0.0 and output.slip[index, 0] > 1.5 * np.abs(others).max()


def test_a_blocked_wheel_skids_in_either_direction_of_travel():
    for speed in (0.5, -0.5):
        position, velocity = rolling(THESIS, (speed, 0.0, 0.0), np.zeros(4))
        velocity[1, 0] = 0.0
        _, output = step(THESIS, AT_ONCE, initial_state(THESIS), position, velocity, 0.002)
        assert output.skidding[1, 0] and not output.slipping[1, 0]
        assert np.sign(output.slip[1, 0]) == -np.sign(speed)
        assert output.ratio[1, 0] == pytest.approx(-np.sign(speed))  # (3.43) of a wheel that does not turn


def test_a_wheel_that_spins_while_the_robot_stands_is_slipping():
    position, velocity = np.zeros((4, 2)), np.zeros((4, 2))
    velocity[2, 0] = -4.0
    _, output = step(THESIS, AT_ONCE, initial_state(THESIS), position, velocity, 0.002)
    assert output.slipping[2, 0] and not output.skidding[2, 0]


def test_lateral_slip_is_seen_in_the_steering_rate():
    position, velocity = rolling(THESIS, (0.5, 0.0, 0.0), np.zeros(4))
    velocity[3, 1] += 0.25 / 0.030  # the fork swings without the wheel giving way sideways
    _, output = step(THESIS, AT_ONCE, initial_state(THESIS), position, velocity, 0.002)
    assert output.slipping[3, 1] and not output.slipping[:, 0].any()
    assert 0.0 < output.ratio[3, 1] < np.pi / 2


def healthy_but_not_nominal(robot, rng, twist, steer_angle):
    """What a robot reports whose radii, offsets and steering zeros are off as on the real DYROS PCV."""
    import dataclasses

    steer_zero = np.radians(rng.uniform(0.6, 1.5, robot.n)) * rng.choice([-1, 1], robot.n)
    casters = tuple(
        dataclasses.replace(
            caster,
            wheel_radius=caster.wheel_radius * (1.0 + rng.uniform(-0.015, 0.015)),
            caster_offset=(caster.caster_offset[0] * (1.0 + rng.uniform(-0.05, 0.05)), caster.caster_offset[1]),
        )
        for caster in robot.casters
    )
    true_robot = dataclasses.replace(robot, casters=casters)
    position, velocity = rolling(true_robot, twist, steer_angle + steer_zero)
    position[:, 1] -= steer_zero
    return position, velocity


@pytest.mark.parametrize("speed", [0.02, 0.15, 0.5, 1.0, 1.5])
def test_no_false_alarm_on_a_healthy_robot_at_any_speed(speed):
    """The last entry of the published numbers: a fixed threshold that stays quiet at 1 m/s would be blind at 0.1 m/s."""
    rng = np.random.default_rng(11)
    worst, alarms = 0.0, 0
    for _ in range(200):
        direction = rng.uniform(-np.pi, np.pi)
        twist = np.array([speed * np.cos(direction), speed * np.sin(direction), rng.normal(0.0, 0.5) * speed])
        # Casters trail up to half a radian: they are still settling.
        steer_angle = trailing(THESIS, twist) + rng.uniform(-0.5, 0.5, 4)
        position, velocity = healthy_but_not_nominal(THESIS, rng, twist, steer_angle)
        _, output = step(THESIS, AT_ONCE, initial_state(THESIS), position, velocity, 0.002)
        worst = max(worst, np.abs(output.slip).max())
        alarms += (output.slipping | output.skidding).any()
    assert alarms == 0
    if speed >= 0.5:
        assert worst > DEFAULT.floor  # the floor alone would have raised alarms


def test_the_threshold_grows_with_speed_and_steering_rate():
    def threshold(twist, steer_angle):
        position, velocity = rolling(THESIS, twist, steer_angle)
        return step(THESIS, DEFAULT, initial_state(THESIS), position, velocity, 0.002)[1].threshold

    along = np.zeros(4)
    assert threshold((0.0, 0.0, 0.0), along) == pytest.approx(0.010)
    assert threshold((1.0, 0.0, 0.0), along) == pytest.approx(0.010 + 0.15)
    # Wheels across a motion of 0.3 m/s steer at v/b = 10 rad/s.
    assert threshold((0.3, 0.0, 0.0), np.full(4, np.pi / 2)) == pytest.approx(0.010 + 0.15 * 0.3 + 0.002 * 10.0)


def test_slip_counts_once_it_has_lasted():
    position, velocity = slipping_wheel(0, 0.20)
    state = initial_state(THESIS)
    flagged = []
    for _ in range(8):
        state, output = step(THESIS, DEFAULT, state, position, velocity, 0.002)
        flagged.append(bool(output.slipping[0, 0]))
    assert flagged == [False] * 4 + [True] * 4  # 10 ms at 2 ms each
    state, output = step(THESIS, DEFAULT, state, *rolling(THESIS, (0.5, 0, 0), np.zeros(4)), 0.002)
    assert not output.slipping.any() and not state.time_above.any()


def test_refuses_what_it_cannot_use_and_keeps_the_state():
    state = EncoderSlipState(np.full((4, 2), 0.5))
    position, velocity = slipping_wheel(0, 0.2)
    with pytest.raises(EstimationError, match="joint_velocity"):
        step(THESIS, DEFAULT, state, position, velocity * np.nan, 0.002)
    with pytest.raises(EstimationError, match="dt"):
        step(THESIS, DEFAULT, state, position, velocity, -0.002)
    assert (state.time_above == 0.5).all()
    with pytest.raises(EstimationError, match=r"floor = 0.0 is not allowed; allowed: a positive number"):
        EncoderSlipParameters(floor=0.0)
    with pytest.raises(EstimationError, match=r"speed_fraction = nan"):
        EncoderSlipParameters(speed_fraction=float("nan"))
