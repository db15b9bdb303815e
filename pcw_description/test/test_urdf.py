"""The generated URDF against two independent readers, and against the description it comes from."""

from __future__ import annotations

import dataclasses
import io
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import yourdfpy
from hypothesis import given
from hypothesis import strategies as st

from pcw_description import DescriptionError, RobotDescription, load_robot, shipped_robots, wheel_centres
from pcw_description.robot_description import Chassis
from pcw_description.urdf import main, robot_urdf, split_module

ROUNDING = 1e-12  # the file holds every digit; only sums round




@pytest.fixture(params=[*shipped_robots(), 2, 3, 6])
def robot(request: pytest.FixtureRequest, random_robot: Callable[..., RobotDescription]) -> RobotDescription:
    """Each shipped robot, and random ones of some numbers of casters."""
    if isinstance(request.param, str):
        return load_robot(request.param)
    return random_robot(np.random.default_rng(request.param), request.param)


def loaded(robot: RobotDescription) -> yourdfpy.URDF:
    urdf = yourdfpy.URDF.load(io.BytesIO(robot_urdf(robot).encode()), load_meshes=False)
    assert urdf.validate()
    return urdf


def test_joints_are_those_of_the_interface(robot: RobotDescription) -> None:
    urdf = loaded(robot)
    assert urdf.robot.name == robot.name
    assert urdf.base_link == "base_link"
    assert set(urdf.actuated_joint_names) == set(robot.joint_names)
    joints = {joint.name: joint for joint in urdf.robot.joints}
    for caster, torque, speed in zip(robot.casters, robot.torque_limit, robot.speed_limit, strict=True):
        steer, drive = joints[f"{caster.name}_steer"], joints[f"{caster.name}_drive"]
        assert (steer.type, steer.axis.tolist()) == ("continuous", [0.0, 0.0, 1.0])
        assert (drive.type, drive.axis.tolist()) == ("continuous", [0.0, 1.0, 0.0])
        assert (drive.limit.effort, steer.limit.effort) == tuple(torque)
        assert (drive.limit.velocity, steer.limit.velocity) == tuple(speed)


def test_masses_add_up_to_the_description(robot: RobotDescription) -> None:
    """Mass, centre of mass and inertia about the vertical of every module, and of the chassis, by parallel axes."""
    inertials = {link.name: link.inertial for link in loaded(robot).robot.links}
    assert sum(inertial.mass for inertial in inertials.values()) == pytest.approx(robot.total_mass, rel=ROUNDING)
    base = inertials["base_link"]
    np.testing.assert_allclose(base.origin[:3, 3], robot.chassis.com, atol=ROUNDING)
    np.testing.assert_allclose(np.diag(base.inertia), robot.chassis.principal_inertias(), rtol=ROUNDING)
    for caster in robot.casters:
        fork, wheel = inertials[f"{caster.name}_fork"], inertials[f"{caster.name}_wheel"]
        fork_com, wheel_com = fork.origin[:2, 3], np.array(caster.caster_offset)
        mass = fork.mass + wheel.mass
        com = (fork.mass * fork_com + wheel.mass * wheel_com) / mass
        inertia_zz = fork.inertia[2, 2] + wheel.inertia[2, 2]
        inertia_zz += fork.mass * np.sum((fork_com - com) ** 2) + wheel.mass * np.sum((wheel_com - com) ** 2)
        assert mass == pytest.approx(caster.module.mass, rel=ROUNDING)
        np.testing.assert_allclose(com, caster.module.com, atol=ROUNDING)
        assert inertia_zz == pytest.approx(caster.module.inertia_zz, rel=ROUNDING)
        assert wheel.inertia[1, 1] == caster.wheel.inertia_axle


def test_every_body_can_exist(robot: RobotDescription) -> None:
    """Positive mass and moments, each moment below the sum of the others: engines drop inertias that break this."""
    for link in loaded(robot).robot.links:
        if link.name == "imu_link":
            assert link.inertial.mass == 0.0
            continue
        moments = np.diag(link.inertial.inertia)
        assert link.inertial.mass > 0.0
        assert np.all(moments > 0.0) and np.all(moments < moments.sum() - moments)
        assert np.count_nonzero(link.inertial.inertia - np.diag(moments)) == 0


def test_wheels_stand_where_the_kinematics_has_them(robot: RobotDescription) -> None:
    urdf = loaded(robot)
    rng = np.random.default_rng(7)
    for _ in range(5):
        steer_angle, roll_angle = rng.uniform(-np.pi, np.pi, (2, robot.n))
        angles = {f"{name}_steer": phi for name, phi in zip(robot.caster_names, steer_angle, strict=True)}
        angles |= {f"{name}_drive": rho for name, rho in zip(robot.caster_names, roll_angle, strict=True)}
        urdf.update_cfg(angles)
        for i, (name, centre) in enumerate(zip(robot.caster_names, wheel_centres(robot, steer_angle), strict=True)):
            frame = urdf.get_transform(f"{name}_wheel", "base_link")
            np.testing.assert_allclose(frame[:3, 3], [*centre, robot.wheel_radius[i]], atol=ROUNDING)
            # Positive roll carries the top of the wheel (its z axis at rest) towards the heading.
            top = np.sin(roll_angle[i]) * np.array([np.cos(steer_angle[i]), np.sin(steer_angle[i])])
            np.testing.assert_allclose(frame[:2, 2], top, atol=ROUNDING)
            np.testing.assert_allclose(frame[2, 2], np.cos(roll_angle[i]), atol=ROUNDING)


def test_imu_stands_where_the_description_says() -> None:
    thesis = load_robot("thesis")
    assert thesis.sensors.imu is not None
    frame = loaded(thesis).get_transform("imu_link", "base_link")
    np.testing.assert_allclose(frame[:3, 3], thesis.sensors.imu.position)
    assert "imu_link" not in robot_urdf(load_robot("tidybot2")), "a robot without IMU has no frame for one"


def test_wheels_have_no_collision_shape(robot: RobotDescription) -> None:
    root = ElementTree.fromstring(robot_urdf(robot))
    assert {link.get("name") for link in root.iter("link") if link.find("collision") is not None} == {"base_link"}


def test_pybullet_has_the_same_masses(robot: RobotDescription, tmp_path: Path) -> None:
    """A second reader, which invents mass for links without any: the totals must arrive."""
    pybullet = pytest.importorskip("pybullet")
    path = tmp_path / "robot.urdf"
    path.write_text(robot_urdf(robot), encoding="utf-8")
    client = pybullet.connect(pybullet.DIRECT)
    try:
        body = pybullet.loadURDF(str(path), flags=pybullet.URDF_USE_INERTIA_FROM_FILE, physicsClientId=client)
        joints = [pybullet.getJointInfo(body, i, physicsClientId=client) for i in range(pybullet.getNumJoints(body, client))]
        dynamics = {info[12].decode(): pybullet.getDynamicsInfo(body, info[0], physicsClientId=client) for info in joints}
        base = pybullet.getDynamicsInfo(body, -1, physicsClientId=client)
        assert {info[1].decode() for info in joints if info[2] == pybullet.JOINT_REVOLUTE} == set(robot.joint_names)
        np.testing.assert_allclose(base[3], robot.chassis.com, atol=1e-9)
        np.testing.assert_allclose(base[2], robot.chassis.principal_inertias(), rtol=1e-9)
        assert base[0] + sum(entry[0] for entry in dynamics.values()) == pytest.approx(robot.total_mass, rel=1e-9)
        for caster in robot.casters:
            fork, wheel = dynamics[f"{caster.name}_fork"], dynamics[f"{caster.name}_wheel"]
            assert fork[0] + wheel[0] == pytest.approx(caster.module.mass, rel=1e-9)
            assert wheel[2][1] == pytest.approx(caster.wheel.inertia_axle, rel=1e-9)
            assert fork[2][2] == pytest.approx(split_module(caster).fork_inertia_zz, rel=1e-9)
    finally:
        pybullet.disconnect(physicsClientId=client)


@given(scale=st.floats(1.0001, 100.0), width=st.floats(0.001, 1.0))
def test_split_exists_for_every_module_that_can_exist(scale: float, width: float) -> None:
    """However wide the wheel and however little inertia is left for the fork."""
    caster = load_robot("thesis").casters[0]
    thinnest = 0.0028782  # of this caster, see the message of validation
    module = dataclasses.replace(caster.module, inertia_zz=thinnest * scale)
    wheel = dataclasses.replace(caster.wheel, width=width)
    split = split_module(dataclasses.replace(caster, module=module, wheel=wheel))
    assert split.fork_inertia_zz > 0.0
    assert caster.wheel.inertia_axle < 2.0 * split.wheel_inertia_zz


def test_module_that_cannot_exist_is_refused_here_too() -> None:
    """Validation refuses it when a file is read; a caster made in a program arrives here first."""
    caster = load_robot("thesis").casters[0]
    light = dataclasses.replace(caster, wheel=dataclasses.replace(caster.wheel, mass=4.0))
    with pytest.raises(DescriptionError, match=r"module\.mass: 4\.0 is not allowed; allowed: above wheel\.mass = 4 kg"):
        split_module(light)
    flat = dataclasses.replace(caster, module=dataclasses.replace(caster.module, inertia_zz=1e-4))
    with pytest.raises(DescriptionError, match=r"module\.inertia_zz: 0\.0001 .*allowed: above 0\.002878 kg m\^2"):
        split_module(flat)


@given(
    zz=st.floats(1e-3, 1.0), length=st.floats(0.05, 5.0), width=st.floats(0.05, 5.0), height=st.floats(0.05, 5.0)
)
def test_default_inertias_are_those_of_a_body(zz: float, length: float, width: float, height: float) -> None:
    """Where the description is silent about I_xx and I_yy, whatever I_zz it states."""
    mass = 50.0
    inertia_zz = zz * mass * (length**2 + width**2)
    chassis = Chassis(mass=mass, inertia_zz=inertia_zz, com=(0.0, 0.0, 0.2), size=(length, width, height))
    moments = np.array(chassis.principal_inertias())
    assert np.all(moments <= moments.sum() - moments)


def test_command_prints_and_writes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["thesis"]) == 0
    printed = capsys.readouterr().out
    assert printed == robot_urdf(load_robot("thesis"))
    assert main(["thesis", "--out", str(tmp_path / "thesis.urdf")]) == 0
    assert (tmp_path / "thesis.urdf").read_text(encoding="utf-8") == printed
    assert capsys.readouterr().out == ""


def test_command_says_what_is_wrong_in_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["thesys"]) == 2
    complaint = capsys.readouterr().err
    assert "did you mean 'thesis'?" in complaint and complaint.count("\n") == 1
    assert main(["thesis", "--out", str(tmp_path / "no" / "folder.urdf")]) == 2
    complaint = capsys.readouterr().err
    assert "there is no folder" in complaint and complaint.count("\n") == 1
    (tmp_path / "precious.urdf").write_text("precious", encoding="utf-8")
    assert main(["thesis", "--out", str(tmp_path / "precious.urdf")]) == 2
    assert "exists already and is left as it is; allowed: a new file" in capsys.readouterr().err
    assert (tmp_path / "precious.urdf").read_text(encoding="utf-8") == "precious"
