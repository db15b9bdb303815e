"""Slip-ratio control of one wheel: its dynamics against finite differences of the wheel's own, then the loop on a tyre."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pcw_control.errors import ControlError
from pcw_control.slip_ratio_control import (
    SlidingWheel,
    SlipRatioControl,
    SlipRatioMeasurement,
    SlipRatioParameters,
    slip_ratio_dynamics,
)
from pcw_description import load_robot
from pcw_description.contact.contact_model import friction_coefficient, tyre_parameters, tyre_step
from pcw_description.wheel_dynamics import slip_ratio

WHEEL = dataclasses.replace(SlidingWheel.of_robot(load_robot("thesis"), 0), torque_limit=30.0)
LOAD = 9.81 * WHEEL.mass
DT = 1e-3


@settings(max_examples=200, deadline=None)
@given(
    rolling=st.floats(-5.0, 5.0), velocity=st.floats(-5.0, 5.0), force=st.floats(-200.0, 200.0), torque=st.floats(-20.0, 20.0)
)
def test_dynamics_are_the_derivative_of_the_slip_ratio_driving_and_braking_both_ways(rolling, velocity, force, torque):
    """lambda_dot = f + g tau against (lambda(t + h) - lambda(t - h)) / 2 h of (3.43) along the motion of (3.45), (5.9)."""
    if rolling * velocity <= 0.0 or min(abs(rolling), abs(velocity)) < 0.3 or abs(abs(rolling) - abs(velocity)) < 1e-3:
        return  # the ratio has a kink where the branches meet, and is singular at rest
    ratio, f, g = slip_ratio_dynamics(
        WHEEL.inertia, WHEEL.radius, WHEEL.mass, rolling / WHEEL.radius, velocity, force, 0.1
    )
    assert ratio == pytest.approx(slip_ratio(rolling, velocity))
    h = 1e-7
    rolling_dot = WHEEL.radius * (torque - WHEEL.radius * force) / WHEEL.inertia
    ahead, behind = (
        slip_ratio(rolling + step * rolling_dot, velocity + step * force / WHEEL.mass) for step in (h, -h)
    )
    expected = (ahead - behind) / (2.0 * h)
    # Differences of numbers near 1 over 2e-7: 1e-16 / 1e-7 and the third derivative times h^2.
    assert f + g * torque == pytest.approx(expected, rel=1e-5, abs=1e-6)


def test_thesis_prints_the_driving_branch_of_a_solid_disc():
    """f = -(3 - 2 lambda) F_z mu / (rho_dot m r), (5.10), is I = m r^2 / 2; its g lacks nothing but a factor r."""
    m, r, rate, ratio, force = 1.5, 0.075, 20.0, 0.2, 30.0
    _, f, g = slip_ratio_dynamics(0.5 * m * r * r, r, m, rate, r * rate * (1.0 - ratio), force, 0.1)
    assert f == pytest.approx(-(3.0 - 2.0 * ratio) * force / (rate * m * r))
    assert g == pytest.approx(r * (1.0 - ratio) / (0.5 * m * r * r * rate * r))


def test_dynamics_stay_finite_at_rest():
    for rolling, velocity in ((0.0, 0.0), (1e-12, 0.0), (0.0, 1e-12), (0.05, -0.05), (-3.0, 3.0)):
        found = slip_ratio_dynamics(WHEEL.inertia, WHEEL.radius, WHEEL.mass, rolling / WHEEL.radius, velocity, 50.0, 0.1)
        assert np.isfinite(found).all()


def hold(wanted, velocity, mu_p, lambda_p, believed=(1.0, 1.0), late=0, duration=1.0):
    """Hold a slip ratio on a Kiencke ground from rolling at `velocity`; returns slip ratios and torques until 0.5 m/s."""
    contact = load_robot("thesis").contact
    tyre = tyre_parameters(dataclasses.replace(contact, mu_p=mu_p, lambda_p=lambda_p))
    curve = tyre_parameters(dataclasses.replace(contact, mu_p=mu_p * believed[0], lambda_p=lambda_p * believed[1]))
    controller = SlipRatioControl(WHEEL)
    state, rate, z, force = controller.initial_state(), velocity / WHEEL.radius, 0.0, 0.0
    waiting, ratios, torques, sliding = [0.0] * late, [], [], []
    for _ in range(round(duration / DT)):
        ratio = slip_ratio(WHEEL.radius * rate, velocity)
        ratios.append(ratio)
        force_seen = friction_coefficient(curve, ratio, 0.0)[0] * LOAD
        state, output = controller.step(state, SlipRatioMeasurement(rate, velocity, force_seen), wanted, DT)
        waiting.append(output.torque)
        torque = waiting.pop(0)
        torques.append(torque)
        sliding.append(output.sliding_variable)
        for _ in range(10):
            speed = max(abs(WHEEL.radius * rate), abs(velocity))
            z, _, force, _ = tyre_step(tyre, z, 0.0, WHEEL.radius * rate - velocity, 0.0, speed, LOAD, DT / 10)
            rate += DT / 10 * (torque - WHEEL.radius * force) / WHEEL.inertia
            velocity += DT / 10 * force / WHEEL.mass
        if abs(velocity) < 0.5:
            break
    return np.array(ratios), np.array(torques), np.array(sliding)


@pytest.mark.parametrize(("wanted", "velocity"), [(0.2, 1.0), (-0.2, 4.0), (0.2, -1.0), (-0.2, -4.0)])
@pytest.mark.parametrize(("mu_p", "lambda_p"), [(1.17, 0.17), (0.38, 0.14), (0.19, 0.06), (0.9, 0.4)])
def test_holds_a_slip_ratio_below_at_and_beyond_the_peak(wanted, velocity, mu_p, lambda_p):
    """0.2 within 0.15 s and 0.01 RMS, forwards and backwards, driving and braking, with curves that are 20 % wrong too."""
    target = wanted if velocity > 0.0 else -wanted
    for believed in ((1.0, 1.0), (1.2, 0.8)):
        ratios, torques, _ = hold(target, velocity, mu_p, lambda_p, believed)
        time = DT * np.arange(len(ratios))
        assert time[np.argmax(np.abs(ratios - target) <= 0.01)] <= 0.15
        assert np.sqrt(np.mean((ratios[time > 0.15] - target) ** 2)) <= 0.01
        assert np.abs(ratios).max() < 0.25  # and not much beyond on the way
        # No chattering: after the start, torque moves from cycle to cycle by less than 1 % of the motor's limit.
        assert np.abs(np.diff(torques[150:])).max() < 0.01 * WHEEL.torque_limit


def test_two_milliseconds_of_delay_are_borne():
    ratios, _, _ = hold(0.2, 1.0, 0.38, 0.14, (1.2, 0.8), late=2)
    assert np.sqrt(np.mean((ratios[150:] - 0.2) ** 2)) <= 0.01


def test_sliding_variable_begins_at_zero_and_finds_an_unknown_force():
    """No reaching phase; told nothing of the ground (F = 0), the average of the sliding mode takes the whole force up."""
    controller = SlipRatioControl(WHEEL)
    state, rate, velocity, force = controller.initial_state(), 20.0, 1.3, 40.0
    sliding, ratios = [], []
    for _ in range(1000):
        state, output = controller.step(state, SlipRatioMeasurement(rate, velocity), 0.2, DT)
        sliding.append(output.sliding_variable)
        ratios.append(output.slip_ratio)
        rate += DT * (output.torque - WHEEL.radius * force) / WHEEL.inertia
        velocity += DT * force / WHEEL.mass
    assert sliding[0] == 0.0
    assert np.abs(ratios[300:] - np.float64(0.2)).max() < 0.005


def test_motor_at_its_limit_does_not_wind_up():
    """A wheel held by a force that the motor cannot overcome for a second, then let go: back without more overshoot."""
    weak = dataclasses.replace(WHEEL, torque_limit=5.0)
    controller = SlipRatioControl(weak)
    state = controller.initial_state()
    rate = velocity = 0.0
    overshoot = []
    for held in (0.3, 1.5):
        state, rate, velocity = controller.initial_state(), 20.0, 1.45
        worst = 0.0
        for k in range(2500):
            force = 80.0 if k * DT < held else 20.0
            state, output = controller.step(state, SlipRatioMeasurement(rate, velocity), 0.2, DT)
            rate = max(rate + DT * (output.torque - weak.radius * force) / weak.inertia, velocity / weak.radius)
            velocity += DT * (force / weak.mass if k * DT >= held else 0.0)
            worst = max(worst, output.slip_ratio)
        overshoot.append(worst)
    assert overshoot[1] <= overshoot[0] + 0.005


@pytest.mark.parametrize("field", ["roll_rate", "velocity", "force"])
def test_refuses_what_is_no_number(field):
    controller = SlipRatioControl(WHEEL)
    good = SlipRatioMeasurement(10.0, 0.7, 5.0)
    with pytest.raises(ControlError, match=field):
        controller.step(controller.initial_state(), dataclasses.replace(good, **{field: np.nan}), 0.2, DT)
    with pytest.raises(ControlError, match="wanted slip ratio"):
        controller.step(controller.initial_state(), good, 1.0, DT)
    with pytest.raises(ControlError, match="dt"):
        controller.step(controller.initial_state(), good, 0.2, 0.0)
    with pytest.raises(ControlError, match="gain"):
        SlipRatioParameters(gain=0.0)
    with pytest.raises(ControlError, match="inertia"):
        dataclasses.replace(WHEEL, inertia=0.0)
