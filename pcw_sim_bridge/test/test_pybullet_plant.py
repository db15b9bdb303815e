"""The PyBullet plant: its tyres, its rotors, and its agreement with the reduced plant."""

import dataclasses

import numpy as np
import pytest

from pcw_description import load_robot
from pcw_description.effect_instance import EffectInstance
from pcw_description.robot_description import DRIVE, STEER
from pcw_sim_bridge.plants.factory import make_plant
from pcw_sim_bridge.plants.plant import PlantError
from pcw_sim_bridge.traction_test import measure_traction, traction_rig

# The springs of the PyBullet plant pitch and roll by a fraction of a milliradian, the reduced plant does not.
SUSPENSION_TOLERANCE = 0.02


@pytest.mark.parametrize("speed", [0.2, 0.5, 1.0, 2.0])
def test_traction_test_measures_the_peak_friction(speed: float) -> None:
    """One wheel of the rig spun against two: the peak is mu_p within 1 % at 0.2 m/s and above, where it should be."""
    robot = load_robot("thesis")
    plant = make_plant("pybullet", traction_rig(robot))
    try:
        curve = measure_traction(
            plant, speed, np.array([0.08, 0.09, 0.1, 0.11, 0.12, 0.3]), settle=max(0.5, 0.5 / speed)
        )
    finally:
        plant.close()
    slip, friction = curve.peak
    assert friction == pytest.approx(robot.contact.mu_p, rel=0.01)
    assert slip == pytest.approx(robot.contact.lambda_p, abs=0.011)
    expected = 2 * 0.8 * 0.1 * curve.slip_ratio / (0.1**2 + curve.slip_ratio**2)
    np.testing.assert_allclose(curve.friction, expected, rtol=0.01)


def test_acceleration_loads_the_rear_and_does_not_depend_on_the_heading() -> None:
    """Turning the whole world leaves body-frame results as they are: wrenches go to the engine in the right frame."""
    plant = make_plant("pybullet", load_robot("thesis"))
    torque = np.zeros((4, 2))
    torque[:, DRIVE] = 2.0
    results = []
    for yaw in (0.0, 1.0, -2.5):
        plant.reset(pose=np.array([0.3, -0.2, yaw]))
        plant.step(torque, 300)
        state = plant.state()
        results.append(np.concatenate([state.twist, state.normal_force, state.slip.ravel()]))
    plant.close()
    np.testing.assert_allclose(results[1], results[0], atol=1e-4)
    np.testing.assert_allclose(results[2], results[0], atol=1e-4)
    height = (74.0 * 0.25 + 16.0 * 0.075) / 90.0
    transfer = 90.0 * height * state.acceleration[0] / 0.5
    at_rest = make_plant("reduced", load_robot("thesis"))
    at_rest.step(np.zeros((4, 2)))
    expected = at_rest.state().normal_force[2:].sum() + transfer
    assert state.normal_force[2:].sum() == pytest.approx(expected, rel=SUSPENSION_TOLERANCE)


def test_follows_the_reduced_plant_in_open_loop() -> None:
    """Equal torques for 0.3 s from turned wheels: rates that agree within a few percent, rotors and all."""
    robot = load_robot("thesis")
    headings = np.array([0.3, -0.2, 0.1, 0.7])
    torque = 0.5 * np.random.default_rng(2).normal(size=(4, 2))
    states = {}
    for name in ("reduced", "pybullet"):
        plant = make_plant(name, robot)
        plant.reset(steer_angle=headings)
        plant.step(torque, 300)
        states[name] = plant.state()
        plant.close()
    reduced, bullet = states["reduced"], states["pybullet"]
    scale = np.abs(reduced.joint_velocity).max(axis=0)
    np.testing.assert_allclose(
        bullet.joint_velocity / scale, reduced.joint_velocity / scale, atol=SUSPENSION_TOLERANCE
    )
    np.testing.assert_allclose(
        bullet.twist, reduced.twist, atol=SUSPENSION_TOLERANCE * np.abs(reduced.twist).max()
    )


def test_effects_act_as_in_the_reduced_plant() -> None:
    """Coulomb friction on one drive and a payload change both plants alike."""
    nominal = load_robot("thesis")
    robot = dataclasses.replace(
        nominal,
        physics=(
            EffectInstance(
                "drive_coulomb_friction",
                ("rear_left",),
                {"coulomb": 1.0, "asymmetry": 0.0, "smoothing_speed": 0.05},
            ),
            EffectInstance("payload_mass", ("chassis",), {"mass": 10.0, "x": 0.0, "y": 0.0, "z": 0.3}),
        ),
    )
    torque = np.zeros((4, 2))
    torque[:, DRIVE] = 1.0
    speeds = {}
    for name in ("reduced", "pybullet"):
        for label, described in (("nominal", nominal), ("changed", robot)):
            plant = make_plant(name, described)
            plant.step(torque, 300)
            speeds[name, label] = plant.state().twist
            plant.close()
    for label in ("nominal", "changed"):
        np.testing.assert_allclose(speeds["pybullet", label], speeds["reduced", label], atol=2e-3)
    assert speeds["reduced", "changed"][0] < 0.75 * speeds["reduced", "nominal"][0]
    assert abs(speeds["pybullet", "changed"][2]) > 1e-4


def test_stands_still_without_torque_and_resets_where_asked() -> None:
    """After a reset the robot is settled: no bounce, hardly a drift, yaw continuous beyond half a turn.

    Hardly: it leans on its springs by a fraction of a milliradian, and without any friction trailing wheels give way to that.
    """
    plant = make_plant("pybullet", load_robot("thesis"))
    pose = np.array([1.0, -2.0, 3.0])
    plant.reset(pose=pose, steer_angle=np.array([0.5, -0.5, 1.5, 3.0]))
    plant.step(np.zeros((4, 2)), 1000)
    state = plant.state()
    np.testing.assert_allclose(state.pose, pose, atol=1e-3)
    assert np.abs(state.twist).max() < 2e-3
    assert state.normal_force.sum() == pytest.approx(90.0 * 9.81, rel=1e-3)
    torque = np.zeros((4, 2))
    torque[:, DRIVE] = [-1.5, 1.5, -1.5, 1.5]
    plant.reset(pose=pose)
    plant.step(torque, 3000)
    assert plant.state().pose[2] > np.pi
    assert plant.state().joint_position[:, STEER].max() < 100.0
    plant.close()


def test_two_casters_cannot_stand() -> None:
    """The error says what to use instead; NaN torque is refused."""
    robot = load_robot("thesis")
    with pytest.raises(PlantError, match="has 2 casters; a plant in space needs at least 3"):
        make_plant("pybullet", dataclasses.replace(robot, casters=robot.casters[:2]))
    plant = make_plant("pybullet", robot)
    with pytest.raises(PlantError, match="NaN"):
        plant.step(np.full((4, 2), np.nan))
    plant.close()
    plant.close()
