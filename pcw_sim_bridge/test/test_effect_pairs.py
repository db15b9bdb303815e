"""Effects together, two by two and all at once, at small and large magnitudes: nothing breaks."""

import dataclasses
import itertools

import numpy as np
import pytest

from pcw_description import load_robot
from pcw_description.differential_kinematics import inverse_kinematics
from pcw_description.effects.effect import Effect
from pcw_description.effects.registry import all_effects, read_physics
from pcw_description.robot_description import DRIVE, STEER
from pcw_sim_bridge.plants.factory import make_plant
from pcw_sim_bridge.plants.plant import PlantError

THESIS = load_robot("thesis")
DURATION, PERIOD = 30.0, 0.005
PAIRS = list(itertools.combinations(all_effects(), 2))
SEED = 20
CHOSEN = [PAIRS[i] for i in sorted(np.random.default_rng(SEED).choice(len(PAIRS), 30, replace=False))]
DAILY = CHOSEN[::3]


def magnitude(effect: Effect, rng: np.random.Generator) -> dict[str, float]:
    """Return parameters from a tenth of to ten times the typical size, within the allowed range."""
    values = {}
    for parameter in effect.parameters:
        size = parameter.typical if parameter.default is None else parameter.default
        value = size * 10.0 ** rng.uniform(-1.0, 1.0) if parameter.default is None else size
        values[parameter.name] = float(np.clip(value, parameter.lower, parameter.upper))
    return values


def drive_about(plant_name: str, names: tuple[str, ...], seed: int, duration: float = DURATION) -> None:
    """Drive curves both ways, spins and stops with simple joint loops, and check all that the plant reports."""
    rng = np.random.default_rng(seed)
    effects = [all_effects()[name] for name in names]
    entries = [{"name": effect.name, **magnitude(effect, rng)} for effect in effects]
    robot = dataclasses.replace(THESIS, physics=read_physics(entries, THESIS.caster_names))
    try:
        plant = make_plant(plant_name, robot)
    except PlantError as error:
        pytest.skip(f"{entries}: {error}")
    gain = np.array([3.0, 1.0])
    try:
        for k in range(round(duration / PERIOD)):
            state, time = plant.state(), k * PERIOD
            twist = np.array([0.6 * np.sin(0.7 * time), 0.3 * np.sin(0.9 * time), 0.8 * np.sin(0.4 * time)])
            steer = np.ascontiguousarray(state.joint_position[:, STEER])
            target = inverse_kinematics(THESIS, steer, twist)
            plant.step(np.clip(gain * (target - state.joint_velocity), -robot.torque_limit, robot.torque_limit), 5)
            for field in dataclasses.fields(state):
                assert np.all(np.isfinite(getattr(state, field.name))), (entries, time, field.name)
            assert np.abs(state.twist).max() < 10.0, (entries, time)
            assert np.abs(state.joint_velocity[:, DRIVE]).max() < 500.0, (entries, time)
            assert np.all(state.normal_force >= 0.0) and state.normal_force.max() < 1e5, (entries, time)
    finally:
        plant.close()


@pytest.mark.parametrize(
    "names",
    [pytest.param(names, id="+".join(names), marks=() if names in DAILY else pytest.mark.nightly) for names in CHOSEN],
)
def test_a_pair_of_effects_runs(names: tuple[str, str]) -> None:
    """A seeded choice of thirty pairs."""
    drive_about("reduced", names, seed=1)


@pytest.mark.nightly
@pytest.mark.parametrize("names", PAIRS, ids="+".join)
def test_every_pair_of_effects_runs(names: tuple[str, str]) -> None:
    """All pairs, with other magnitudes."""
    drive_about("reduced", names, seed=2)


def test_all_effects_run_together(plant_name: str) -> None:
    """Five seconds of everything, in three sizes."""
    for seed in range(3):
        drive_about(plant_name, tuple(all_effects()), seed, duration=5.0)
