"""RMRC, SME-RMRC and cross-coupling: laws of the cores; what they do to a robot is in pcw_sim_bridge."""

import dataclasses
import importlib.util
from pathlib import Path

import numpy as np
import pytest

from pcw_control import ControlError, TwistReference, make_controller, sliding_mode
from pcw_control.cross_coupling import CrossCoupling, CrossCouplingParameters
from pcw_control.delay_margin import effective_mass
from pcw_control.quintic_trajectory import TrajectoryPoint
from pcw_control.resolved_motion_rate import (
    ResolvedMotionRate,
    ResolvedMotionRateParameters,
    SlidingModeRate,
    SlidingModeRateParameters,
)
from pcw_description import load_robot, wheel_jacobian

_spec = importlib.util.spec_from_file_location("controller_contract", Path(__file__).with_name("controller_contract.py"))
contract = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(contract)

THESIS = load_robot("thesis")
DT = 0.002


@pytest.mark.parametrize("name", ("resolved_motion_rate", "sliding_mode_rate", "cross_coupling"))
@pytest.mark.parametrize("robot_name", ("thesis", "tidybot2"))
def test_keeps_the_controllers_contract(name, robot_name):
    robot = load_robot(robot_name)
    contract.check_contract(make_controller(name, robot), robot, np.random.default_rng(5))


def test_rmrc_is_the_pi_law_of_each_wheel_centre():
    """u = 2 w m e + w^2 m int e with e = A V_d - B q_dot, and tau = B^T u: table 5.1, by hand for one cycle."""
    controller = ResolvedMotionRate(THESIS, ResolvedMotionRateParameters(bandwidth=8.0))
    steer_angle = np.array([0.2, -1.0, 2.5, 0.7])
    twist = np.array([0.2, 0.1, 0.1])
    measurement = contract.rolling_measurement(THESIS, twist, steer_angle)
    _, output = controller.step(controller.initial_state(twist), measurement, TwistReference(twist + 1.0), DT)
    wanted = output.reference_twist
    e = (wheel_jacobian(THESIS, steer_angle) @ (wanted - twist)).reshape(4, 2)
    assert np.abs(e).max() > 1e-4
    u = effective_mass(THESIS) * (16.0 * e + 64.0 * e * DT)
    np.testing.assert_allclose(output.contact_force, u, rtol=1e-9)
    np.testing.assert_allclose(output.torque, u * [0.075, 0.030], rtol=1e-9)


@pytest.mark.parametrize("robot_name", ("thesis", "flow_base"))
def test_slip_enters_as_5_1_says_and_only_what_is_vouched_for(robot_name):
    """e = A V_d - (B q_dot - slip): slip forward asks for more torque forward, by k_p and k_i times it."""
    robot = load_robot(robot_name)
    controller = ResolvedMotionRate(robot, ResolvedMotionRateParameters(slip_share=1.0, bandwidth=10.0))
    measurement = contract.rolling_measurement(robot, np.zeros(3), np.zeros(robot.n))
    slip = np.full((robot.n, 2), 0.02)
    valid = np.ones((robot.n, 2), dtype=bool)
    valid[1] = False
    reference, forces = TwistReference(np.zeros(3)), []
    for measured in (
        measurement, dataclasses.replace(measurement, slip=slip),
        dataclasses.replace(measurement, slip=np.where(valid, slip, 99.0), slip_valid=valid),
    ):
        forces.append(controller.step(controller.initial_state(), measured, reference, DT)[1].contact_force)
    np.testing.assert_allclose(forces[1] - forces[0], effective_mass(robot) * 0.02 * (20.0 + 100.0 * DT), rtol=1e-9)
    np.testing.assert_allclose((forces[2] - forces[0])[1], 0.0, atol=1e-12)
    np.testing.assert_array_equal(forces[2][[0, 2, 3]], forces[1][[0, 2, 3]])


def simulate(law, disturbance, seconds=1.0, e0=0.0, mass=20.0, gain=60.0):
    """A mass on its own: m e_dot = D - u, u from the sliding law alone, as `sliding_mode` has it. Returns e, u, s."""
    shape = (1, 2)
    state, e, found = sliding_mode.initial_state(1), np.full(shape, e0), []
    m, K, T = np.full(shape, mass), np.full(shape, gain), np.full(shape, 0.006)
    for k in range(round(seconds / DT)):
        state, u = sliding_mode.step(law, state, e, 200.0 * e, m, K, 0.05, T, 0.05, False, DT)
        found.append((e[0, 0], u[0, 0], state.sliding[0, 0]))
        e = e + DT / m * (disturbance(k * DT) - u)
    return np.array(found).T


def test_the_filtered_law_makes_up_for_a_disturbance_and_has_no_phase_of_reaching():
    """A constant D < K: without sliding mode e stays at D / k_p = 0.15 m/s; with it e dies out while u becomes D."""
    e, u, s = simulate("low_pass_integral", lambda t: 30.0)
    assert abs(e[-1]) < 0.15 * 0.01 and u[-1] == pytest.approx(30.0, rel=0.02)
    bound = 60.0 * 0.006 / 20.0
    assert np.abs(s).max() <= 1.02 * bound and s[0] == 0.0
    # From an error at the start s is at zero at once all the same; the layer has to be reached first.
    _, _, s = simulate("low_pass_integral", lambda t: 30.0, e0=0.2)
    assert s[0] == 0.0 and np.abs(s).max() <= 1.02 * bound
    _, _, reaching = simulate("boundary_layer", lambda t: 30.0, e0=0.2)
    assert reaching[0] == 0.2 and np.abs(reaching[:5]).min() > 0.05


def test_the_filtered_law_is_quiet_where_the_plain_one_chatters():
    def swing(t):
        return 20.0 * np.sin(3.0 * t)

    chatters = {law: np.std(np.diff(simulate(law, swing)[1][100:])) for law in ("plain", "low_pass_integral")}
    assert chatters["low_pass_integral"] < 0.05 * chatters["plain"]


def test_what_is_more_than_the_gain_is_not_stored():
    """D = 2 K for a while: s waits at its bound, and afterwards nothing is left of it after a few filter times."""
    e, u, s = simulate("low_pass_integral", lambda t: 120.0 if t < 0.5 else 0.0, seconds=1.5)
    assert np.abs(s).max() == pytest.approx(60.0 * 0.006 / 20.0)
    assert abs(e[-1]) < 1e-3 and abs(u[-1]) < 0.5


def test_sliding_waits_while_torque_is_limited():
    controller = SlidingModeRate(THESIS)
    measurement = contract.rolling_measurement(THESIS, np.zeros(3), np.zeros(4), saturated=True)
    state = controller.initial_state()
    for _ in range(500):
        state, output = controller.step(state, measurement, TwistReference(np.array([0.3, 0.0, 0.0])), DT)
    assert not state.sliding.filtered.any() and not state.error_integral.any()
    np.testing.assert_allclose(output.contact_force[:, 0], 0.3 * 20.0 * effective_mass(THESIS)[:, 0], rtol=1e-9)


def test_takes_a_pose_error_back_along_a_trajectory():
    controller = ResolvedMotionRate(THESIS)
    measurement = contract.rolling_measurement(THESIS, np.zeros(3), np.zeros(4), pose=np.array([0.0, 0.0, np.pi / 2]))
    _, output = controller.step(controller.initial_state(), measurement, TrajectoryPoint(np.array([0.0, 0.1, np.pi / 2])), DT)
    assert output.wrench[0] > 1.0 and abs(output.wrench[1]) < 1e-9  # ahead, as the robot looks along +y


def test_cross_coupling_acts_on_the_difference_between_wheels_alone():
    """With one wheel behind, coupling adds force that moves nothing: A^T of it is zero; without a difference it adds none."""
    plain, coupled = ResolvedMotionRate(THESIS), CrossCoupling(THESIS, CrossCouplingParameters(coupling=2.0))
    measurement = contract.rolling_measurement(THESIS, [0.2, 0.0, 0.0], np.zeros(4))
    reference = TwistReference(np.array([0.25, 0.0, 0.0]))

    def forces(controller, measured):
        return controller.step(controller.initial_state(np.array([0.2, 0.0, 0.0])), measured, reference, DT)[1].contact_force

    np.testing.assert_allclose(forces(coupled, measurement), forces(plain, measurement), atol=1e-9)
    behind = measurement.joint_velocity.copy()
    behind[0, 0] -= 0.5
    measured = dataclasses.replace(measurement, joint_velocity=behind)
    added = forces(coupled, measured) - forces(plain, measured)
    assert added[0, 0] > 1.0 and added[1, 0] < 0.0
    np.testing.assert_allclose(added[:, 0].sum(), 0.0, atol=1e-9)  # equal masses, all ahead: no force on the robot


def test_cross_coupling_is_no_stronger_than_delay_allows():
    """TidyBot++ bears no more gain than RMRC has already; four random runs in seventeen swung before this was derived."""
    assert CrossCoupling(THESIS).coupling == pytest.approx(2.0)
    assert CrossCoupling(load_robot("tidybot2")).coupling == 0.0


def test_parameters_are_refused_with_what_is_allowed():
    with pytest.raises(ControlError, match="slip_share = 1.5 is not allowed; allowed: a finite number, at least 0"):
        ResolvedMotionRateParameters(slip_share=1.5)
    with pytest.raises(ControlError, match="filter_time = 0.0 is not allowed"):
        SlidingModeRateParameters(filter_time=0.0)
    with pytest.raises(ControlError, match="law = 'soft' is not allowed; allowed: boundary_layer, low_pass_integral, plain"):
        SlidingModeRateParameters(law="soft")
