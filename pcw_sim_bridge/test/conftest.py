"""The plants that a test runs in."""

import pytest

from pcw_sim_bridge.plants.plant import PLANT_NAMES


def installed(plant_name: str) -> str:
    """Return the name of a plant, or skip the test where its engine is not installed."""
    if plant_name == "mujoco":
        pytest.importorskip("mujoco", reason="MuJoCo, which is optional, is not installed")
    return plant_name


@pytest.fixture(params=PLANT_NAMES)
def plant_name(request: pytest.FixtureRequest) -> str:
    """Every plant in turn."""
    return installed(request.param)


@pytest.fixture(params=[name for name in PLANT_NAMES if name != "reduced"])
def engine(request: pytest.FixtureRequest) -> str:
    """Every plant in space in turn."""
    return installed(request.param)
