"""Force-guided driving: what the operator feels, the guards, and that energy is never injected."""

import dataclasses
import importlib.util
import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pcw_control.controller_interface import ControllerMeasurement, ForceReference, TwistReference
from pcw_control.controllers import CONTROLLERS, make_controller
from pcw_control.errors import ControlError
from pcw_control.force_guided import ForceGuided, ForceGuidedParameters, UnifiedForceMotion
from pcw_description import KinematicsError, inverse_kinematics, load_robot, shipped_robots, wheel_jacobian

_spec = importlib.util.spec_from_file_location("controller_contract", Path(__file__).with_name("controller_contract.py"))
contract = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(contract)

DT = 0.002
ROBOT = load_robot("thesis")
STEER = np.array([0.3, -0.2, 2.0, 1.0])
NOTHING = ForceReference(np.zeros(3))


def is_torque_controlled(name):
    try:
        load_robot(name).require_torque_control()
    except KinematicsError:
        return False
    return True


def measured(push, twist, steer=STEER):
    joints = inverse_kinematics(ROBOT, steer, np.asarray(twist, dtype=float))
    position = np.stack([np.zeros(ROBOT.n), steer], axis=1)
    wrench = None if push is None else np.asarray(push, dtype=float)
    return ControllerMeasurement(position, joints, np.zeros(3), external_wrench=wrench)


def guide(controller, pushes, reference=NOTHING, steer=STEER):
    """A robot that follows V_f exactly; returns states and outputs, the state before the first push among them."""
    state, twist = controller.initial_state(), np.zeros(3)
    states, outputs = [state], []
    for push in pushes:
        state, output = controller.step(state, measured(push, twist, steer), reference, DT)
        twist = output.guided_twist
        states.append(state)
        outputs.append(output)
    return states, outputs


@pytest.mark.parametrize("name", [name for name in shipped_robots() if is_torque_controlled(name)])
@pytest.mark.parametrize("entry", ["force_guided", "force_guided_plain"])
def test_keeps_the_controllers_contract(entry, name):
    robot = load_robot(name)
    contract.check_contract(make_controller(entry, robot), robot, np.random.default_rng(5))


def test_a_push_that_is_no_number_is_refused():
    controller = ForceGuided(ROBOT)
    with pytest.raises(ControlError, match="external_wrench"):
        controller.step(controller.initial_state(), measured([np.nan, 0.0, 0.0], np.zeros(3)), NOTHING, DT)


def test_operator_feels_a_mass_with_friction():
    """V_f(t) = (f / D) (1 - exp(-t D / M)), a step of the push."""
    parameters = ForceGuidedParameters(virtual_mass=30.0, coasting_time=1.5, deadband=0.0)
    _, outputs = guide(UnifiedForceMotion(ROBOT, parameters), [[12.0, 0.0, 0.0]] * 1000, steer=np.zeros(4))
    time = DT * np.arange(1, 1001)
    expected = 12.0 * 1.5 / 30.0 * (1.0 - np.exp(-time / 1.5))
    # The middle rule is exact to second order in dt / T: 2e-7 of the speed.
    np.testing.assert_allclose([output.guided_twist[0] for output in outputs], expected, atol=1e-6)


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 2**31), integral=st.sampled_from([0.0, 5.0]), wanted=st.sampled_from([0.0, 15.0]))
def test_energy_is_never_injected_whatever_the_operator_does(seed, integral, wanted):
    """From any instant on, no more comes back than the virtual body moves with and the tank holds; at first that is zero.

    The operator pushes back and forth, lets go, loses the sensor and hits; the controller is given reasons to push back.
    """
    rng = np.random.default_rng(seed)
    controller = UnifiedForceMotion(ROBOT, ForceGuidedParameters(force_integral=integral))
    pushes = []
    for _ in range(10):
        push = rng.normal(0.0, [40.0, 40.0, 10.0]) * (rng.random() < 0.8)
        if rng.random() < 0.1:
            push[:2] = 300.0
        pushes += [None if rng.random() < 0.1 else push] * int(rng.integers(5, 60))
    states, _ = guide(controller, pushes, ForceReference(np.array([wanted, 0.0, 0.0])))
    twists = np.array([state.guided_twist for state in states])
    held = 0.5 * twists**2 @ controller.virtual_mass + np.array([state.energy[0] for state in states])
    pushed = np.array([np.zeros(3) if push is None else push for push in pushes])
    put_in = np.concatenate([[0.0], np.cumsum(np.sum(pushed * 0.5 * (twists[1:] + twists[:-1]), axis=1) * DT)])
    gain = put_in - held  # never falls: what is held never grows by more than what is put in
    assert np.diff(gain).min() >= -1e-12 * max(1.0, np.abs(put_in).max())
    assert put_in.min() >= -1e-12


def test_integral_and_wanted_force_get_nothing_from_an_empty_tank():
    controller = UnifiedForceMotion(ROBOT, ForceGuidedParameters(force_integral=10.0, deadband=0.0))
    _, outputs = guide(controller, [[0.0, 0.0, 0.0]] * 500, ForceReference(np.array([40.0, 0.0, 0.0])))
    assert all(not output.guided_twist.any() for output in outputs)
    # Moved by the operator first, the robot has something to give, but not for long.
    pushes = [[20.0, 0.0, 0.0]] * 500 + [[0.0, 0.0, 0.0]] * 1500
    _, outputs = guide(controller, pushes, ForceReference(np.array([40.0, 0.0, 0.0])))
    assert np.abs(outputs[-1].guided_twist).max() < 0.05


def test_energy_observer_stops_a_robot_that_pushes_back():
    """The odometry runs against the push although V_f does not: what is stored is used up, and the guard says so."""
    controller = UnifiedForceMotion(ROBOT)
    state = controller.initial_state(np.array([0.3, 0.0, 0.0]))
    guards, stored = [], []
    for _ in range(400):
        state, output = controller.step(state, measured([10.0, 0.0, 0.0], [-0.3, 0.0, 0.0]), NOTHING, DT)
        guards.append(output.guard)
        stored.append(output.stored_energy)
    assert guards[0] == "none" and guards[-1] == "energy"
    assert stored[-1] < 0.0 < stored[0]
    state, output = controller.step(state, measured([-10.0, 0.0, 0.0], [0.3, 0.0, 0.0]), NOTHING, DT)
    assert output.guided_twist[0] == 0.0  # not a step backwards against the push


def test_guards_of_speed_power_and_joints():
    parameters = ForceGuidedParameters(speed_limit=0.4, power_limit=1e3)
    _, outputs = guide(UnifiedForceMotion(ROBOT, parameters), [[100.0, 40.0, 0.0]] * 1500)
    assert max(math.hypot(*output.guided_twist[:2]) for output in outputs) <= 0.4 + 1e-9
    assert outputs[-1].guard == "speed"

    _, outputs = guide(UnifiedForceMotion(ROBOT, ForceGuidedParameters(power_limit=5.0)), [[40.0, 0.0, 0.0]] * 1500)
    assert max(40.0 * output.guided_twist[0] for output in outputs) <= 5.0 + 1e-9
    assert outputs[-1].guard == "power"

    controller = UnifiedForceMotion(ROBOT)
    _, outputs = guide(controller, [[0.0, 100.0, 0.0]] * 1500)
    joints = np.abs(inverse_kinematics(ROBOT, STEER, outputs[-1].guided_twist))
    assert np.max(joints / ROBOT.speed_limit) <= controller.parameters.joint_speed_fraction + 1e-9


def test_a_blow_stops_the_robot_until_it_is_let_go():
    controller = UnifiedForceMotion(ROBOT)
    pushes = [[30.0, 0.0, 0.0]] * 300 + [[200.0, 0.0, 0.0]] * 5 + [[30.0, 0.0, 0.0]] * 500
    _, outputs = guide(controller, pushes)
    speed = np.array([output.guided_twist[0] for output in outputs])
    assert speed[299] > 0.2
    assert outputs[301].guard == outputs[-1].guard == "force"
    assert np.all(np.diff(speed[300:]) <= 0.0) and speed[-1] == 0.0
    _, outputs = guide(controller, [*pushes, *[[0.0, 0.0, 0.0]] * 10, *[[30.0, 0.0, 0.0]] * 100])
    assert outputs[-1].guard == "none" and outputs[-1].guided_twist[0] > 0.05


def test_without_a_measured_push_the_robot_comes_to_rest():
    controller = UnifiedForceMotion(ROBOT)
    _, outputs = guide(controller, [[30.0, 0.0, 0.0]] * 300 + [None] * 500)
    assert outputs[-1].guard == "no_push"
    assert not outputs[-1].guided_twist.any()


def test_axes_that_are_motion_controlled_do_not_feel_the_push():
    """Omega = diag(0, 1, 1): y and yaw as computed torque would have them, less the push that is measured."""
    controller = UnifiedForceMotion(ROBOT, ForceGuidedParameters(force_controlled=(1.0, 0.0, 0.0)))
    plain = make_controller("computed_torque", ROBOT)
    motion = TwistReference(np.array([0.0, 0.2, 0.1]))
    measurement = measured([20.0, 30.0, 2.0], [0.1, 0.1, 0.0])
    _, found = controller.step(controller.initial_state(), measurement, ForceReference(np.zeros(3), motion), DT)
    _, expected = plain.step(plain.initial_state(), measurement, motion, DT)
    A = wheel_jacobian(ROBOT, STEER)
    inertia, bias = controller._model.evaluate(STEER, expected.twist)
    push = measurement.external_wrench
    acceleration = np.linalg.solve(inertia, found.wrench + push - bias)
    wanted = np.linalg.solve(inertia, expected.wrench - bias)
    np.testing.assert_allclose(acceleration[1:], wanted[1:], rtol=1e-9)
    # x follows the push alone, as a body of the virtual mass that so far moves at V = 0.1 without being asked to.
    assert acceleration[0] == pytest.approx(
        found.guided_twist[0] / DT + controller.parameters.tracking_gain * (found.guided_twist[0] - found.twist[0])
    )
    np.testing.assert_allclose(A.T @ found.contact_force.ravel(), found.wrench, atol=1e-7)


def test_virtual_slip_of_the_thesis_is_what_encoders_see_of_slip():
    """(I - A A^+) (A V_f - B q_dot) = -(I - A A^+) B q_dot: V_f cancels, and f_o is the slip constraint force."""
    held, plain = ForceGuided(ROBOT), UnifiedForceMotion(ROBOT)
    measurement = measured([20.0, 0.0, 0.0], [0.1, 0.0, 0.2])
    measurement.joint_velocity[1, 0] += 2.0
    _, with_force = held.step(held.initial_state(), measurement, NOTHING, DT)
    _, without = plain.step(plain.initial_state(), measurement, NOTHING, DT)
    scfc = make_controller("slip_constraint_force", ROBOT)
    computed = make_controller("computed_torque", ROBOT)
    _, a = scfc.step(scfc.initial_state(), measurement, TwistReference(np.zeros(3)), DT)
    _, b = computed.step(computed.initial_state(), measurement, TwistReference(np.zeros(3)), DT)
    np.testing.assert_allclose(
        with_force.contact_force - without.contact_force, a.contact_force - b.contact_force, atol=1e-9 * 500.0
    )
    assert with_force.contact_force[1, 0] < without.contact_force[1, 0] - 5.0


def test_refuses_parameters_with_their_name():
    for field, value in (("coasting_time", 0.0), ("force_limit", -1.0), ("tank", float("nan"))):
        with pytest.raises(ControlError, match=field):
            ForceGuidedParameters(**{field: value})
    with pytest.raises(ControlError, match="force_controlled"):
        ForceGuidedParameters(force_controlled=(1.0, 0.5, 0.0))


def test_takes_over_at_a_twist_without_a_jerk():
    start = np.array([0.3, 0.1, 0.1])
    controller = ForceGuided(ROBOT)
    state, output = controller.step(controller.initial_state(start), measured([0.0, 0.0, 0.0], start), NOTHING, DT)
    np.testing.assert_allclose(output.guided_twist, start, rtol=0.01)
    assert dataclasses.is_dataclass(state) and "force_guided" in CONTROLLERS
