"""A steering whose zero is so far off that drives work against each other: by what the forces do to the robot."""

import math
from pathlib import Path

import pytest

from pcw_description import load_robot
from pcw_sim_bridge.mismatch.analysis import analyse
from pcw_sim_bridge.mismatch.findings.findings import Findings
from pcw_sim_bridge.mismatch.subjects.robot_subject import RobotSubject
from pcw_sim_bridge.simulate import main as simulate


def found_in(path: Path, robot: str, excitation: str, controller: str, plant: str, physics: str) -> Findings:
    run = ["--robot", robot, "--excite", excitation, "--controller", controller, "--plant", plant, "--physics", physics]
    assert simulate([*run, "--duration", "29", "--seed", "5", "--out", str(path)]) == 0
    return analyse(RobotSubject(load_robot(robot)), [path], [], {}, 0, lambda message: None).findings


@pytest.mark.parametrize(
    ("robot", "excitation", "controller", "plant", "caster", "offset"),
    [
        # Friction is used up, and nothing was judged.
        ("thesis", "figure8", "velocity_loops", "reduced", "front_left", 0.2),
        # It is not where a wheel slides at all speeds: a rolling resistance was named, and a friction of the steering.
        ("thesis", "circle", "velocity_loops", "reduced", "front_left", 0.7),
        ("flow_base", "random_goals", "velocity_loops", "mujoco", "rear_left", 0.9),
        pytest.param("xr4000", "steps", "velocity_loops", "pybullet", "rear", -2.2, marks=pytest.mark.nightly),
        # Under torques a wheel that points backwards rolls, and contradicts all others.
        ("thesis", "figure8", "computed_torque", "reduced", "front_left", math.pi),
    ],
)
def test_a_zero_far_off(
    tmp_path: Path, robot: str, excitation: str, controller: str, plant: str, caster: str, offset: float
) -> None:
    physics = f"{{name: steer_zero_offset, target: [{caster}], offset: {offset}}}"
    found = found_in(tmp_path / "run", robot, excitation, controller, plant, physics)
    [named] = found.effects
    assert (found.verdict, named.name, named.target) == ("explained", "steer_zero_offset", (caster,))
    told = named.parameters["offset"]
    assert abs(math.remainder(told.value - offset, math.tau)) < 0.02 + 0.02 * abs(offset)
    assert told.low < told.value < told.high < told.value + 0.5
    assert named.probability > 0.9
    assert found.fit is not None and found.fit.gap_closed > 0.6
    assert f"steering of {caster} turned by" in found.notes[0] and "degrees" in found.notes[0]


@pytest.mark.parametrize(
    "physics",
    [
        # All other wheels drag this one along, as if it were driven backwards.
        "{name: drive_coulomb_friction, target: [rear_right], coulomb: 2.0, asymmetry: 0.4}",
        "{name: constant_load, target: [front_right], load: 2.0}",
    ],
)
def test_a_wheel_that_is_dragged_along_is_not_turned(tmp_path: Path, physics: str) -> None:
    robot, excitation = ("thesis", "circle") if "coulomb" in physics else ("dyros_pcv", "spin")
    found = found_in(tmp_path / "run", robot, excitation, "computed_torque", "reduced", physics)
    assert "steer_zero_offset" not in [effect.name for effect in found.effects]
    assert {effect.name for effect in found.effects} <= {"drive_coulomb_friction", "constant_load"}


def test_a_small_zero_is_left_to_the_search(tmp_path: Path) -> None:
    physics = "{name: steer_zero_offset, target: [front_left], offset: 0.03}"
    found = found_in(tmp_path / "run", "thesis", "figure8", "velocity_loops", "reduced", physics)
    [named] = found.effects
    assert named.parameters["offset"].value == pytest.approx(0.03, abs=0.002)
    assert any(channel.name.startswith("rolling_consistency") for channel in found.channels)
