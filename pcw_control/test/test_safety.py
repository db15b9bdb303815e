"""The gate before the motors, and the handing over between controllers: all without ROS."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from pcw_control import handover
from pcw_control.errors import ControlError
from pcw_control.safety import HAZARDS, Reaction, SafetyGate
from pcw_control.torque_limits import TorqueLimits, limit_torque
from pcw_description import load_robot

THESIS = load_robot("thesis")
GATE = SafetyGate(TorqueLimits.of_robot(THESIS))
TORQUE, AT_REST = np.full((4, 2), 2.0), np.zeros((4, 2))


@pytest.mark.parametrize("name", sorted(HAZARDS))
def test_each_hazard_has_the_reaction_of_the_table(name):
    state, gated = GATE.pass_torque(GATE.initial_state(), TORQUE, AT_REST, 0.002, {name})
    reaction = HAZARDS[name].reaction
    assert gated.reaction is reaction and gated.hazards == (name,)
    if reaction is Reaction.DO_WITHOUT:
        np.testing.assert_array_equal(gated.torque, TORQUE)
    else:
        assert not gated.torque.any()
    _, after = GATE.pass_torque(state, TORQUE, AT_REST, 0.002, set())
    if reaction is Reaction.LATCH:
        assert not after.torque.any() and after.reaction is Reaction.LATCH
        _, fresh = GATE.pass_torque(GATE.initial_state(), TORQUE, AT_REST, 0.002, set())
        np.testing.assert_array_equal(fresh.torque, TORQUE)
    else:
        np.testing.assert_array_equal(after.torque, TORQUE)


@settings(deadline=None, max_examples=60)
@given(
    arrays(float, (4, 2), elements=st.floats(allow_nan=True, allow_infinity=True)),
    st.sets(st.sampled_from(sorted(HAZARDS))), st.floats(allow_nan=True),
)
def test_whatever_comes_what_leaves_is_finite_and_limited_and_zero_where_it_must_be(torque, hazards, dt):
    with np.errstate(all="ignore"):
        _, gated = GATE.pass_torque(GATE.initial_state(), torque, AT_REST, dt, hazards)
    assert np.all(np.abs(gated.torque) <= THESIS.torque_limit)
    bad = not (np.isfinite(torque).all() and np.isfinite(dt))
    if bad or any(HAZARDS[name].reaction >= Reaction.LET_GO for name in hazards):
        assert not gated.torque.any()
    if bad:
        assert "torque_not_finite" in gated.hazards


def test_a_hazard_that_is_not_in_the_table_is_refused():
    with pytest.raises(ControlError, match="'meteorite'"):
        GATE.pass_torque(GATE.initial_state(), TORQUE, AT_REST, 0.002, {"meteorite"})


@pytest.mark.parametrize("mode", ["scale", "clip"])
def test_power_limit_bounds_what_the_driving_joints_draw(mode):
    limits = TorqueLimits.of_robot(THESIS, mode=mode, power=20.0)
    velocity = np.array([[10.0, 1.0], [8.0, -1.0], [-5.0, 0.0], [6.0, 2.0]])
    torque = np.array([[5.0, 1.0], [4.0, 1.0], [3.0, -2.0], [2.0, 1.0]])
    found = limit_torque(limits, AT_REST, torque, velocity, 0.002)
    assert np.maximum(found.torque * velocity, 0.0).sum() == pytest.approx(20.0)
    assert found.saturated
    braking = torque * velocity < 0.0
    if mode == "clip":
        np.testing.assert_array_equal(found.torque[braking], torque[braking])
    slow = limit_torque(limits, AT_REST, torque, 0.1 * velocity, 0.002)
    np.testing.assert_array_equal(slow.torque, torque)


def test_jerk_limit_is_a_slew_that_suits_the_robot():
    """A wheel centre of the thesis robot has 26.1 kg along: (0.0042 + 0.016) / 0.075^2 and a quarter of 90 kg."""
    limits = TorqueLimits.of_robot(THESIS, jerk=10.0)
    found = limit_torque(limits, AT_REST, np.full((4, 2), 5.0), AT_REST, 0.002)
    np.testing.assert_allclose(found.torque[:, 0], 10.0 * 0.075 * (22.5 + 0.0202 / 0.075**2) * 0.002)
    both = TorqueLimits.of_robot(THESIS, jerk=10.0, slew=1.0)
    np.testing.assert_allclose(limit_torque(both, AT_REST, np.full((4, 2), 5.0), AT_REST, 0.002).torque, 0.002)
    with pytest.raises(ControlError, match="power = 0.0 is not allowed"):
        TorqueLimits.of_robot(THESIS, power=0.0)


def test_a_handover_begins_at_the_old_torque_and_fades_to_the_new_one():
    state = handover.begin_handover(TORQUE)
    new = np.full((4, 2), -1.0)
    state, first = handover.step(state, new, 0.002)
    np.testing.assert_array_equal(first, TORQUE)
    for _ in range(50):
        before = first
        state, first = handover.step(state, new, 0.002)
        assert np.abs(first - before).max() <= 3.0 * 0.002 / handover.FADE
    np.testing.assert_allclose(first, new + 3.0 * np.exp(-0.1 / handover.FADE))
    _, torque = handover.step(handover.begin_handover(TORQUE), np.full((4, 2), np.nan), 0.002)
    assert np.isnan(torque).all()  # left for the gate to catch
