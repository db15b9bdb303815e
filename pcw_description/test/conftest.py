"""Robots for the tests: any number of casters, every number drawn from a seed."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import hypothesis
import numpy as np
import pytest

from pcw_description import RobotDescription, parse_robot

# Derandomised: a red run is red again on the next machine. No deadline: the first call of a kernel compiles it.
hypothesis.settings.register_profile("pcw", derandomize=True, deadline=None, max_examples=60, database=None)
hypothesis.settings.load_profile("pcw")


def random_robot_mapping(
    rng: np.random.Generator, n: int, *, lateral_offset: bool = True, coupling: bool = True
) -> dict[str, Any]:
    """Return a physical robot of n casters, no two alike.

    The steering axes lie at distinct bearings 0.15 m to 0.5 m from the origin, so that no two are one axis; forks and wheels
    are bodies that can exist, which an engine checks when it loads them.
    """
    bearings = 2.0 * np.pi * (np.arange(n) + rng.uniform(-0.3, 0.3, n)) / n
    casters = []
    for index in range(n):
        reach = rng.uniform(0.15, 0.5)
        radius = float(rng.uniform(0.04, 0.12))
        b_x = float(rng.choice([-1.0, 1.0], p=[0.8, 0.2]) * rng.uniform(0.012, 0.06))
        b_y = float(rng.uniform(-0.02, 0.02)) if lateral_offset else 0.0
        wheel_mass, fork_mass = float(rng.uniform(0.3, 2.0)), float(rng.uniform(0.5, 4.0))
        fork_com, fork_zz = rng.uniform(-0.03, 0.03, 2), float(rng.uniform(0.002, 0.02))
        axle = wheel_mass * radius**2 * float(rng.uniform(0.4, 0.9))
        wheel_zz = axle * float(rng.uniform(0.5, 0.7))
        mass = wheel_mass + fork_mass
        com = (wheel_mass * np.array([b_x, b_y]) + fork_mass * fork_com) / mass
        apart = float(np.sum((fork_com - [b_x, b_y]) ** 2)) * wheel_mass * fork_mass / mass
        casters.append(
            {
                "name": f"caster_{index}",
                "steer_axis": [
                    float(reach * np.cos(bearings[index])),
                    float(reach * np.sin(bearings[index])),
                ],
                "caster_offset": [b_x, b_y],
                "wheel_radius": radius,
                "module": {"mass": mass, "com": com.tolist(), "inertia_zz": wheel_zz + fork_zz + apart},
                "wheel": {"mass": wheel_mass, "inertia_axle": axle, "width": 0.03},
                "gears": {
                    "drive": float(rng.choice([-1, 1]) * rng.uniform(5.0, 30.0)),
                    "steer": float(rng.uniform(5.0, 30.0)),
                    "drive_per_steer": float(rng.uniform(-6.0, 6.0)) if coupling else 0.0,
                    "steer_per_drive": float(rng.uniform(-2.0, 2.0)) if coupling else 0.0,
                },
                "rotors": {"drive": float(rng.uniform(1e-5, 1e-4)), "steer": float(rng.uniform(1e-5, 1e-4))},
                "limits": {
                    "drive_torque": 15.0,
                    "steer_torque": 10.0,
                    "drive_speed": 40.0,
                    "steer_speed": 15.0,
                },
            }
        )
    mass = float(rng.uniform(20.0, 120.0))
    return {
        "format": "pcw_robot/1",
        "name": f"random_{n}",
        "provenance": {"all": "drawn at random for a test"},
        "chassis": {
            "mass": mass,
            "inertia_zz": mass * float(rng.uniform(0.03, 0.15)),
            "com": [*rng.uniform(-0.1, 0.1, 2).tolist(), 0.3],
            "size": [0.8, 0.8, 0.3],
        },
        "casters": casters,
        "contact": {
            "model": "kiencke",
            "mu_p": 0.8,
            "lambda_p": 0.1,
            "lateral": {"mu_p": 0.8, "lambda_p": 0.1},
            "relaxation_length": 0.02,
        },
        "sensors": {"encoders": {"drive_counts": 4096, "steer_counts": 4096, "rate": 500.0}},
    }


@pytest.fixture(scope="session")
def random_robot() -> Callable[..., RobotDescription]:
    """Return a maker of random robots: `random_robot(rng, n, lateral_offset=True, coupling=True)`."""

    def make(rng: np.random.Generator, n: int, **options: bool) -> RobotDescription:
        return parse_robot(random_robot_mapping(rng, n, **options))

    return make
