"""Recordings of robots on a jack: each joint is judged by itself."""

import copy
import dataclasses
from pathlib import Path

import numpy as np
import pytest
import yaml

from pcw_description import load_robot
from pcw_description.effect_instance import EffectInstance
from pcw_description.errors import PcwError
from pcw_description.recording import Recording
from pcw_description.robot_file import save_robot
from pcw_sim_bridge.mismatch.__main__ import main as mismatch
from pcw_sim_bridge.mismatch.analysis import analyse
from pcw_sim_bridge.mismatch.challenge.healthy_deviations import draw_deviations, with_deviations
from pcw_sim_bridge.mismatch.findings.findings import Findings
from pcw_sim_bridge.mismatch.robot.off_ground import wheels_off_ground
from pcw_sim_bridge.mismatch.subjects.robot_subject import RobotSubject
from pcw_sim_bridge.simulate import main as simulate

LIFTED = "wheels_off_ground"


def recorded(path: Path, robot: str, excitation: str, seconds: int, seed: int, *more: str) -> Path:
    run = ["--robot", robot, "--excite", excitation, "--duration", str(seconds), "--seed", str(seed), "--out", str(path)]
    assert simulate([*run, *more]) == 0
    return path


def found_in(path: Path, robot: str) -> Findings:
    return analyse(RobotSubject(load_robot(robot)), [path], [], {}, 0, lambda message: None).findings


def silenced(monkeypatch: pytest.MonkeyPatch, *series: str) -> None:
    """Recordings that are opened from now on are without these."""
    plain = Recording.open.__func__  # type: ignore[attr-defined]

    def opened(cls: type[Recording], *given: object) -> Recording:
        recording: Recording = plain(cls, *given)
        for name in series:
            setattr(recording, name, None)
        return recording

    monkeypatch.setattr(Recording, "open", classmethod(opened))


@pytest.mark.parametrize(
    ("robot", "plant", "seed"), [("thesis", "reduced", 17), ("xr4000", "mujoco", 18), ("dyros_pcv", "pybullet", 19)]
)
def test_healthy_joints(tmp_path: Path, robot: str, plant: str, seed: int) -> None:
    """The jack leans a little, as floors do, and weights beside their steering axes turn them: no law by the angle."""
    nominal = load_robot(robot)
    save_robot(with_deviations(nominal, draw_deviations(nominal, np.random.default_rng(seed))), tmp_path / "true.yaml")
    found = found_in(recorded(tmp_path / "run", str(tmp_path / "true.yaml"), LIFTED, 40, seed, "--plant", plant), robot)
    assert (found.verdict, found.effects) == ("no_mismatch", ())
    assert {channel.name for channel in found.channels} == {
        f"{axis}_torque/{caster}" for caster in nominal.caster_names for axis in ("drive", "steer")
    }
    assert any("off the ground" in warning for warning in found.inputs[0].warnings)
    assert "in the joints" in found.nothing_missing()


@pytest.mark.parametrize(
    ("robot", "plant", "effect", "tolerance"),
    [
        ("tidybot2", "reduced", {"name": "drive_coulomb_friction", "coulomb": 0.5}, 0.02),
        # What such a friction leaves of itself, taken for a plain one, is smooth, and was taken for strong slow noise.
        ("tidybot2", "reduced", {"name": "steer_viscous_friction", "viscous": 0.2, "asymmetry": -0.04}, 0.02),
        ("thesis", "pybullet", {"name": "motor_cogging", "axis": "steer", "cosine": 0.3, "order": 12.0}, 0.02),
        ("xr4000", "mujoco", {"name": "constant_load", "load": 1.0}, 0.02),
    ],
)
def test_what_joints_do(tmp_path: Path, robot: str, plant: str, effect: dict[str, object], tolerance: float) -> None:
    target = load_robot(robot).caster_names[1]
    physics = yaml.safe_dump(effect | {"target": [target]}, default_flow_style=True, width=1000)
    found = found_in(recorded(tmp_path / "run", robot, LIFTED, 40, 5, "--plant", plant, "--physics", physics), robot)
    [named] = found.effects
    assert (found.verdict, named.name, named.target) == ("explained", effect["name"], (target,))
    assert named.probability > 0.9
    for name, value in effect.items():
        if isinstance(value, float):
            assert named.parameters[name].value == pytest.approx(value, rel=tolerance, abs=0.005)
    assert found.fit is not None and found.fit.gap_closed > 0.9
    assert set(found.fit.rollout) == {"drive_velocity", "steer_velocity"}
    assert found.fit.rollout_gap_closed is not None and found.fit.rollout_gap_closed > 0.8


def test_a_difference_between_directions_is_no_load_besides(tmp_path: Path) -> None:
    """A constant load of a half per cent of what rubs was named, with the probability of a load as large as the difference."""
    physics = "{name: drive_coulomb_friction, target: [rear_right], coulomb: 2.0, asymmetry: -0.4}"
    run = recorded(tmp_path / "run", "thesis", LIFTED, 30, 3, "--physics", physics, "--plant", "mujoco")
    [named] = found_in(run, "thesis").effects
    assert named.name == "drive_coulomb_friction"
    assert named.parameters["asymmetry"].value == pytest.approx(-0.4, rel=0.03)


@pytest.mark.parametrize("plain", ["chirp_x", "spin", "strafe"])
def test_who_moves_is_on_the_ground(tmp_path: Path, plain: str) -> None:
    robot = load_robot("thesis")
    recording = Recording.open(recorded(tmp_path / "run", "thesis", plain, 20, 4), robot)
    assert not wheels_off_ground(robot, recording)
    for name in ("ground_truth", "imu"):
        setattr(recording, name, None)
        assert not wheels_off_ground(robot, recording)


def test_the_gyro_tells_as_well(tmp_path: Path) -> None:
    robot = load_robot("xr4000")
    recording = Recording.open(recorded(tmp_path / "run", "xr4000", LIFTED, 20, 4), robot)
    assert wheels_off_ground(robot, recording)
    recording.ground_truth = None
    assert recording.imu is None or wheels_off_ground(robot, recording)
    recording.imu = None
    assert not wheels_off_ground(robot, recording)


def test_a_tracker_that_measured_nothing_tells_nothing(tmp_path: Path) -> None:
    robot = load_robot("tidybot2")
    recording = Recording.open(recorded(tmp_path / "run", "tidybot2", LIFTED, 15, 1), robot)
    assert recording.ground_truth is not None and wheels_off_ground(robot, recording)
    blind = np.full_like(recording.ground_truth.pose, np.nan)
    recording.ground_truth = dataclasses.replace(recording.ground_truth, pose=blind)
    assert not wheels_off_ground(robot, recording)


@pytest.mark.parametrize("robot", ["thesis", "tidybot2", "xr4000"])
def test_without_sensors_the_torques_tell(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, robot: str) -> None:
    run = recorded(tmp_path / "run", robot, LIFTED, 30, 6)
    silenced(monkeypatch, "ground_truth", "imu")
    found = found_in(run, robot)
    assert (found.verdict, found.effects) == ("no_mismatch", ())
    assert any("off the ground" in warning for warning in found.inputs[0].warnings)


def test_one_kind_in_one_analysis(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    lifted, driven = (recorded(tmp_path / name, "tidybot2", name, 15, 1) for name in (LIFTED, "spin"))
    said = [str(lifted), "--holdout", str(driven), "--robot", "tidybot2", "--out", str(tmp_path / "report")]
    assert mismatch(["analyze", *said]) == 2
    assert "the wheels are off the ground" in capsys.readouterr().err
    assert not (tmp_path / "report").exists()


def test_without_torques_there_is_nothing_to_judge(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run = recorded(tmp_path / "run", "tidybot2", LIFTED, 15, 1)
    plain = Recording.open.__func__  # type: ignore[attr-defined]

    def opened(cls: type[Recording], *given: object) -> Recording:
        recording = copy.copy(plain(cls, *given))
        joints = recording.joint_states
        recording.joint_states = dataclasses.replace(joints, effort=np.full_like(joints.effort, np.nan))
        return recording

    monkeypatch.setattr(Recording, "open", classmethod(opened))
    assert mismatch(["analyze", str(run), "--robot", "tidybot2", "--out", str(tmp_path / "report")]) == 2


def test_no_patch_makes_a_robot_that_cannot_be() -> None:
    smaller = EffectInstance("wheel_radius_error", ("front_left",), {"error": -0.05}, None)
    with pytest.raises(PcwError, match="cannot be"):
        RobotSubject(load_robot("tidybot2")).patched([smaller], {})


@pytest.mark.nightly
def test_a_robot_that_cannot_be_is_not_proposed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Taken for a robot on the ground, such a recording asks for wheels without a radius; that ended the analysis."""
    physics = "{name: drive_stribeck_friction, target: [front_left], stribeck: 1.0, stribeck_speed: 0.5}"
    run = recorded(tmp_path / "run", "flow_base", LIFTED, 30, 5, "--physics", physics)
    silenced(monkeypatch, "ground_truth", "imu")
    monkeypatch.setattr("pcw_sim_bridge.mismatch.subjects.robot_subject.wheels_turn_alone", lambda problem: False)
    found = found_in(run, "flow_base")
    assert found.verdict in ("unexplained", "partly_explained", "explained")
