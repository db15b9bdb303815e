"""Energy in the reduced plant: it stays where nothing takes it, and only falls where effects dissipate it."""

import dataclasses

import numpy as np
import pytest
from test_reduced_plant import TORQUE_ROBOTS, kinetic_energy, tyre_energy

from pcw_description import load_robot
from pcw_description.differential_kinematics import inverse_kinematics
from pcw_description.effects.registry import read_physics
from pcw_description.robot_description import RobotDescription
from pcw_sim_bridge.plants.reduced import ReducedPlant

DISSIPATIVE = (
    {"name": "drive_coulomb_friction", "coulomb": 0.3},
    {"name": "drive_viscous_friction", "viscous": 0.05},
    {"name": "drive_stribeck_friction", "stribeck": 0.2, "stribeck_speed": 1.0},
    {"name": "steer_coulomb_friction", "coulomb": 0.1},
    {"name": "steer_viscous_friction", "viscous": 0.02},
    {"name": "load_dependent_friction", "fraction": 0.1},
    {"name": "rolling_resistance", "arm": 1e-3},
    {"name": "scrub_torque", "radius": 0.01},
    {"name": "aerodynamic_drag", "coefficient": 2.0},
)
# Per step, relative to the energy at the start.
GROWTH = 1e-9
# Relative, over ten seconds.
CONSERVATION = 1e-6


def energies(plant: ReducedPlant, robot: RobotDescription, steps: int) -> np.ndarray:
    """Return the mechanical energy after every step without motors: of motion, and held by the tyres as springs."""
    found = [kinetic_energy(robot, plant.state()) + tyre_energy(plant)]
    for _ in range(steps):
        plant.step(np.zeros((robot.n, 2)))
        found.append(kinetic_energy(robot, plant.state()) + tyre_energy(plant))
    return np.array(found)


@pytest.mark.parametrize(
    "entries", [(), *((entry,) for entry in DISSIPATIVE), DISSIPATIVE], ids=lambda es: "+".join(e["name"] for e in es) or "none"
)
def test_dissipation_never_adds_energy(entries: tuple[dict[str, float], ...]) -> None:
    """A robot rolls on from a random twist, its wheels swinging round behind it; the energy falls in every single step."""
    nominal = load_robot("thesis")
    robot = dataclasses.replace(nominal, physics=read_physics(list(entries), nominal.caster_names))
    for seed in range(3):
        rng = np.random.default_rng(seed)
        plant = ReducedPlant(robot)
        headings = rng.uniform(-np.pi, np.pi, robot.n)
        plant.reset(steer_angle=headings)
        twist = rng.normal(size=3) * [0.4, 0.4, 0.8]
        plant.set_motion(twist, plant.state().joint_position, inverse_kinematics(robot, headings, twist))
        found = energies(plant, robot, 4000)
        assert np.max(np.diff(found)) <= GROWTH * found[0]
        assert found[-1] < 0.99 * found[0], "it does dissipate"


@pytest.mark.parametrize("name", TORQUE_ROBOTS)
def test_rolling_straight_keeps_its_energy(name: str) -> None:
    """No effect, no slip: nothing takes energy in ten seconds."""
    robot = load_robot(name)
    plant = ReducedPlant(robot)
    # Trailing wheels, as they are after a while of rolling.
    headings = np.where(robot.caster_offset[:, 0] < 0.0, 0.0, np.pi)
    plant.reset(steer_angle=headings)
    twist = np.array([0.7, 0.0, 0.0])
    plant.set_motion(twist, plant.state().joint_position, inverse_kinematics(robot, headings, twist))
    before = kinetic_energy(robot, plant.state())
    plant.step(np.zeros((robot.n, 2)), 10_000)
    assert kinetic_energy(robot, plant.state()) == pytest.approx(before, rel=CONSERVATION)


@pytest.mark.parametrize("name", TORQUE_ROBOTS)
def test_free_bodies_keep_their_energy(name: str) -> None:
    """On perfect ice chassis and casters turn and swing about each other, which no force of the ground slows."""
    robot = load_robot(name)
    ice = dataclasses.replace(
        robot.contact, mu_p=1e-12, lateral=dataclasses.replace(robot.contact.lateral, mu_p=1e-12), scrub_radius=0.0
    )
    robot = dataclasses.replace(robot, contact=ice)
    rng = np.random.default_rng(4)
    plant = ReducedPlant(robot)
    plant.reset(steer_angle=rng.uniform(-np.pi, np.pi, robot.n))
    rates = rng.normal(size=(robot.n, 2)) * [5.0, 1.0]
    plant.set_motion(np.array([0.4, -0.3, 0.8]), plant.state().joint_position, rates)
    before, started = kinetic_energy(robot, plant.state()), plant.state()
    for _ in range(100):
        plant.step(np.zeros((robot.n, 2)), 100)
        assert kinetic_energy(robot, plant.state()) == pytest.approx(before, rel=CONSERVATION)
    assert np.abs(plant.state().joint_velocity[:, 1] - started.joint_velocity[:, 1]).max() > 1e-3, "they do interact"
