"""The controllers that share a wrench as the ground allows."""

import dataclasses
import importlib.util
from pathlib import Path

import numpy as np
import pytest

from pcw_control import CONTROLLERS, ControlError, TwistReference, make_controller
from pcw_control.friction_sharing import TractionLimitAvoidance, TractionLimitParameters
from pcw_description import load_robot, wheel_jacobian

_spec = importlib.util.spec_from_file_location("controller_contract", Path(__file__).with_name("controller_contract.py"))
contract = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(contract)

NAMES = ("friction_optimal", "jacobian_pseudo_inverse", "traction_limit_avoidance", "weighted_pseudo_inverse")
ROBOTS = ("thesis", "tidybot2", "xr4000")


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("robot_name", ROBOTS)
def test_keeps_the_controllers_contract(name, robot_name):
    robot = load_robot(robot_name)
    contract.check_contract(make_controller(name, robot), robot, np.random.default_rng(5))


@pytest.mark.parametrize("name", ("friction_optimal", "weighted_pseudo_inverse"))
def test_makes_the_wrench_and_spares_the_wheel_on_ice(name):
    robot = load_robot("thesis")
    steer_angle = np.array([0.3, -0.4, 2.0, 1.0])
    measurement = contract.rolling_measurement(robot, [0.1, 0.0, 0.1], steer_angle)
    friction = np.array([0.1, 0.8, 0.8, 0.8])
    controller = make_controller(name, robot)
    reference = TwistReference(np.array([0.5, 0.2, 0.3]))
    used = {}
    for kind, measured in (("even", measurement), ("ice", dataclasses.replace(measurement, friction=friction))):
        _, output = controller.step(controller.initial_state(np.array([0.1, 0.0, 0.1])), measured, reference, 0.002)
        A = wheel_jacobian(robot, steer_angle)
        np.testing.assert_allclose(A.T @ output.contact_force.ravel(), output.wrench, atol=1e-9)
        used[kind] = np.linalg.norm(output.contact_force[0])
    assert used["ice"] < 0.3 * used["even"]


def test_traction_limit_avoidance_keeps_all_limits_and_meets_the_wrench_while_it_can():
    """1000 random demands: |F| within a f_m and the torques within a tau_max; the wrench to 1e-9 or not at all

    That it is met whenever it can be is shown of `limited_forces` against a linear program..
    """
    rng = np.random.default_rng(8)
    met = 0
    for robot_name in ROBOTS:
        robot = load_robot(robot_name)
        controller = TractionLimitAvoidance(robot, TractionLimitParameters(traction_share=0.7))
        for _ in range(300):
            steer_angle = rng.uniform(-3.0, 3.0, robot.n)
            measurement = dataclasses.replace(
                contract.rolling_measurement(robot, rng.normal(0.0, 0.05, 3), steer_angle),
                friction=rng.uniform(0.05, 0.9, robot.n),
            )
            reference = TwistReference(rng.normal(0.0, 1.0, 3))
            _, output = controller.step(controller.initial_state(), measurement, reference, 0.002)
            load = controller._loads.normal_force(
                steer_angle, np.linalg.solve(controller._model.evaluate(steer_angle, output.twist)[0], output.wrench)
            )
            held = 0.7 * measurement.friction * load
            assert np.all(np.abs(output.contact_force[:, 0]) <= held * (1 + 1e-12))
            assert np.all(np.abs(output.torque) <= 0.7 * robot.torque_limit * (1 + 1e-12))
            shortfall = np.abs(
                wheel_jacobian(robot, steer_angle).T @ output.contact_force.ravel() - output.wrench
            ).max()
            met += shortfall < 1e-9
    assert 100 < met < 900  # both cases were met


def test_without_need_it_is_the_pseudo_inverse():
    robot = load_robot("thesis")
    measurement = contract.rolling_measurement(robot, [0.1, 0.0, 0.0], np.zeros(4))
    reference = TwistReference(np.array([0.11, 0.0, 0.0]))
    outputs = []
    for name in ("computed_torque", "traction_limit_avoidance"):
        controller = make_controller(name, robot)
        outputs.append(controller.step(controller.initial_state(np.array([0.1, 0.0, 0.0])), measurement, reference, 0.002)[1])
    np.testing.assert_allclose(outputs[0].torque, outputs[1].torque, atol=1e-9)
    assert np.abs(outputs[0].internal_force).max() < 1e-9


def test_the_registry_names_what_it_does_not_know():
    robot = load_robot("thesis")
    with pytest.raises(ControlError, match="controller 'computed_tork' is not known"):
        make_controller("computed_tork", robot)
    with pytest.raises(ControlError, match="allowed: TractionLimitParameters"):
        make_controller("traction_limit_avoidance", robot, CONTROLLERS["computed_torque"].parameters())
    with pytest.raises(ControlError, match="traction_share = 0.0 is not allowed; allowed: a finite number, above 0"):
        TractionLimitParameters(traction_share=0.0)
