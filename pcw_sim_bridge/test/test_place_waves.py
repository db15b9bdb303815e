"""Forces finer than a map of the floor are seen by their waves."""

from types import SimpleNamespace

import numpy as np
import pytest

from pcw_sim_bridge.mismatch.laws.generated_effect import generate
from pcw_sim_bridge.mismatch.laws.place_waves import Waves, place_waves

K = 7.5  # [rad/m]


def driven(force_size: float) -> tuple[SimpleNamespace, np.ndarray]:
    """What a problem says of a robot that turns as it wanders over 4 m x 3 m, under a force along the world's x and noise."""
    time = np.arange(0.0, 80.0, 0.1)
    x, y = 2.0 * np.sin(0.31 * time), 1.5 * np.sin(0.47 * time + 0.4)
    yaw = 0.2 * time
    force = force_size * np.sin(K * x) * np.cos(K * y)
    rng = np.random.default_rng(0)
    left = np.stack([np.cos(yaw) * force, -np.sin(yaw) * force, 0.0 * time], axis=1)
    left += 0.3 * rng.standard_normal(left.shape)
    names = ("chassis_force/x", "chassis_force/y", "chassis_torque/z")
    problem = SimpleNamespace(
        channels=[SimpleNamespace(name=name) for name in names], variables={"x": x, "y": y, "yaw": yaw},
        valid=np.ones(left.shape, dtype=bool),
    )  # fmt: skip
    return problem, left


def test_a_pattern_of_squares_is_two_waves_along_its_diagonals() -> None:
    """sin(k x) cos(k y) is half the sum of waves along (k, k) and (k, -k): the first two that are found."""
    problem, left = driven(2.0)
    along_x, along_y = place_waves(problem, left)
    assert [place.factor.kind for place in along_x.places] == ["cos", "sin"]
    assert [place.factor.kind for place in along_y.places] == ["sin", "cos"]
    assert isinstance(along_x.basis, Waves)
    found = np.abs(along_x.basis.vectors[:2])
    np.testing.assert_allclose(found, K, atol=0.2)
    assert np.sign(np.prod(along_x.basis.vectors[0])) == -np.sign(np.prod(along_x.basis.vectors[1]))
    assert along_x.depends_on == ("x", "y", "yaw")


def test_waves_are_written_to_a_file_as_a_map() -> None:
    """The map has the waves' values at its knots, and a kernel of its own."""
    problem, left = driven(2.0)
    law = place_waves(problem, left)[0]
    weights = np.arange(1.0, 10.0)
    values = law.basis.values_at_knots(weights).reshape([len(knots) for knots in law.basis.knots])
    first, second = law.basis.knots[0][3], law.basis.knots[1][7]
    expected = law.basis.functions([np.array([first]), np.array([second])]) @ weights
    assert values[3, 7] == pytest.approx(expected[0])
    assert "KNOTS_1" in generate(law, weights, ["here"]).source


def test_without_a_place_or_forces_there_are_none() -> None:
    """Neither is everywhere."""
    problem, left = driven(1.0)
    assert place_waves(SimpleNamespace(channels=problem.channels, variables={}, valid=problem.valid), left) == []
    others = [SimpleNamespace(name="gyro")]
    assert place_waves(SimpleNamespace(channels=others, variables=problem.variables, valid=problem.valid), left) == []
