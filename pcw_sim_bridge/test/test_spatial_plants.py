"""The plants in space, whichever engine carries them: tyres, rotors, and agreement with the reduced plant."""

import dataclasses
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy import signal

from pcw_control.excitation import make_excitation
from pcw_description import load_robot
from pcw_description.effect_instance import EffectInstance
from pcw_description.robot_description import DRIVE, STEER, RobotDescription, Rotors
from pcw_sim_bridge.plants.factory import make_plant
from pcw_sim_bridge.plants.plant import PlantError
from pcw_sim_bridge.run_controllers import make_controller
from pcw_sim_bridge.simulated_robot import SimulatedRobot, TrackedPose
from pcw_sim_bridge.traction_test import measure_traction, traction_rig

# The springs of a plant in space pitch and roll by a fraction of a milliradian, the reduced plant does not.
SUSPENSION_TOLERANCE = 0.02


@pytest.mark.parametrize(
    "speed", [*(pytest.param(speed, marks=pytest.mark.nightly) for speed in (0.2, 1.0)), 0.5, 2.0]
)
def test_traction_test_measures_the_peak_friction(engine: str, speed: float) -> None:
    """One wheel of the rig spun against two: the peak is mu_p within 1 % at 0.2 m/s and above, where it should be."""
    robot = load_robot("thesis")
    plant = make_plant(engine, traction_rig(robot))
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


def test_the_acceleration_is_that_of_the_origin_of_base_link(engine: str) -> None:
    """Below the springs: of a chassis that swings on them its centre of mass is accelerated otherwise."""
    robot = load_robot("thesis")
    plant, torque = make_plant(engine, robot), np.zeros((4, 2))
    torque[:, DRIVE] = 2.0
    velocity, acceleration, swing = [], [], []
    for step in range(200):
        plant.step(torque * np.sign(np.sin(0.25 * step)))
        state = plant.state()
        velocity.append(state.twist[0])
        acceleration.append(state.acceleration[0])
        swing.append(state.swing_acceleration[1])
    plant.close()
    change = (np.array(velocity)[2:] - np.array(velocity)[:-2]) / (2.0 * plant.dt)
    np.testing.assert_allclose(acceleration[2:], change, atol=0.01)
    assert np.abs(swing).max() * robot.chassis.com[2] > 0.1  # m/s^2: the centre of mass is


@pytest.mark.parametrize("name", ["tidybot2", "thesis"])
def test_an_accelerometer_does_not_see_an_engine_s_single_steps(engine: str, name: str) -> None:
    """Loops of the drives make a robot in space shake by 5 % from step to step; read at every tenth, it had that much more.

    The scale is by regression of the slow part of what is read on that of the speed; the band is 0 to 3 Hz.
    """
    robot = load_robot(name)
    excitation = make_excitation("chirp_x", robot, 29.0, 1)
    simulated, controller = SimulatedRobot(make_plant(engine, robot)), make_controller("velocity_loops", robot)
    times, speeds, read = [], [], []
    while simulated.time_ns < 8_000_000_000:
        for sample in simulated.advance():
            if isinstance(sample.reading, TrackedPose) and sample.time_ns % 10_000_000 == 0:
                truth = sample.reading.truth
                times.append(sample.time_ns * 1e-9)
                speeds.append(truth.twist[0])
                read.append(truth.acceleration[0])
        twist = excitation.twist(simulated.time_ns * 1e-9)
        simulated.command(controller.command(sample.reading, twist, simulated.control_period))
    simulated.close()
    slow = signal.butter(4, 3.0, fs=1.0 / (times[1] - times[0]), output="sos")
    of_speed, of_sensor = (signal.sosfiltfilt(slow, values) for values in (np.gradient(speeds, times), read))
    scale = of_speed @ of_sensor / (of_speed @ of_speed)
    print(f"reads {scale:.4f} of the acceleration")
    assert scale == pytest.approx(1.0, abs=0.02)


def test_acceleration_loads_the_rear_and_does_not_depend_on_the_heading(engine: str) -> None:
    """Turning the whole world leaves body-frame results as they are: wrenches go to the engine in the right frame."""
    plant = make_plant(engine, load_robot("thesis"))
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


@pytest.mark.parametrize("name", ["thesis", "tidybot2"])
def test_each_wheel_carries_what_it_does_in_the_reduced_plant(engine: str, name: str) -> None:
    """At rest, wheels turned anyhow: one body on equal springs, 0.5 % (the springs give way a little more under more load)."""
    robot = load_robot(name)
    headings = np.linspace(-2.0, 2.5, robot.n)
    loads = []
    for plant_name in ("reduced", engine):
        plant = make_plant(plant_name, robot)
        plant.reset(steer_angle=headings)
        plant.step(np.zeros((robot.n, 2)))
        loads.append(plant.state().normal_force)
        plant.close()
    assert np.ptp(loads[0]) > 1.0, "they must differ"
    np.testing.assert_allclose(loads[1], loads[0], rtol=5e-3)


def test_follows_the_reduced_plant_in_open_loop(engine: str) -> None:
    """Equal torques for 0.3 s from turned wheels: rates that agree within a few percent, rotors and all."""
    robot = load_robot("thesis")
    headings = np.array([0.3, -0.2, 0.1, 0.7])
    torque = 0.5 * np.random.default_rng(2).normal(size=(4, 2))
    states = {}
    for name in ("reduced", engine):
        plant = make_plant(name, robot)
        plant.reset(steer_angle=headings)
        plant.step(torque, 300)
        states[name] = plant.state()
        plant.close()
    reduced, spatial = states["reduced"], states[engine]
    scale = np.abs(reduced.joint_velocity).max(axis=0)
    np.testing.assert_allclose(
        spatial.joint_velocity / scale, reduced.joint_velocity / scale, atol=SUSPENSION_TOLERANCE
    )
    np.testing.assert_allclose(
        spatial.twist, reduced.twist, atol=SUSPENSION_TOLERANCE * np.abs(reduced.twist).max()
    )


def test_effects_act_as_in_the_reduced_plant(engine: str) -> None:
    """Coulomb friction on one drive and a payload change a plant in space and the reduced plant alike."""
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
    for name in ("reduced", engine):
        for label, described in (("nominal", nominal), ("changed", robot)):
            plant = make_plant(name, described)
            plant.step(torque, 300)
            speeds[name, label] = plant.state().twist
            plant.close()
    for label in ("nominal", "changed"):
        np.testing.assert_allclose(speeds[engine, label], speeds["reduced", label], atol=2e-3)
    assert speeds["reduced", "changed"][0] < 0.75 * speeds["reduced", "nominal"][0]
    assert abs(speeds[engine, "changed"][2]) > 1e-4


def test_stands_still_without_torque_and_resets_where_asked(engine: str) -> None:
    """After a reset the robot is settled: no bounce, hardly a drift, yaw continuous beyond half a turn.

    Hardly: it leans on its springs by a fraction of a milliradian, and without any friction trailing wheels give way to that.
    """
    plant = make_plant(engine, load_robot("thesis"))
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


def test_stiff_tyres_under_light_wheels_do_not_chatter(engine: str) -> None:
    """3 N m at every drive, tyres twenty times as stiff as described: from step to step slips and forces change by little."""
    described = load_robot("thesis")
    stiff = dataclasses.replace(
        described.contact,
        lambda_p=0.03, relaxation_length=0.004, lateral=dataclasses.replace(described.contact.lateral, lambda_p=0.03),
    )  # fmt: skip
    plant = make_plant(engine, dataclasses.replace(described, contact=stiff))
    torque = np.zeros((4, 2))
    torque[:, DRIVE] = 3.0
    try:
        plant.step(torque, 400)
        forces, speeds = [], []
        for _ in range(20):
            plant.step(torque)
            state = plant.state()
            forces.append(state.contact_force[:, 0])
            speeds.append(state.joint_velocity[:, DRIVE])
        rolled = described.wheel_radius * np.array(speeds)
        assert np.all(np.abs(np.diff(forces, axis=0)) < 0.02 * np.mean(np.abs(forces)))
        assert np.all(np.abs(np.diff(rolled, 2, axis=0)) < 1e-4)
    finally:
        plant.close()


def swung(engine: str, robot: RobotDescription, dt: float = 1e-3) -> np.ndarray:
    """Slip (1200, n, 2) [m/s] of a robot whose joints are swung to and fro."""
    plant = make_plant(engine, robot, dt)
    slips = []
    for step in range(1500):
        torque = np.zeros((robot.n, 2))
        torque[:, DRIVE] = np.sin(2.0 * np.pi * 1.5 * step * 1e-3)
        torque[:, STEER] = 0.3 * np.sin(2.0 * np.pi * 1.1 * step * 1e-3)
        plant.step(torque, round(1e-3 / dt))
        slips.append(plant.state().slip)
    plant.close()
    return np.array(slips[300:])


def test_slips_hardly_hang_on_the_step(engine: str) -> None:
    """Steps of a millisecond made tyres 9 % too soft along and 5 % across, against steps of a tenth of that."""
    robot = load_robot("thesis")
    fine, plain = swung(engine, robot, 1e-4), swung(engine, robot)
    error = np.sqrt(np.sum((plain - fine) ** 2, axis=(0, 1)) / np.sum(fine**2, axis=(0, 1)))
    print(error)
    assert error.max() < 0.02


def test_a_gear_that_hardly_gives_way_is_none(engine: str) -> None:
    """The wheel was taken to be as light as without its motor: behind a stiff gear it slipped by 31 % more or less."""
    robot = load_robot("thesis")
    stiff = EffectInstance("gear_elasticity", (robot.caster_names[1],), {"stiffness": 1e7, "damping": 1.0}, "drive")
    without, beside = swung(engine, robot), swung(engine, dataclasses.replace(robot, physics=(stiff,)))
    apart = np.abs(beside - without).max(axis=0) / np.abs(without).max(axis=0)
    print(apart)
    assert apart.max() < 0.01


def test_two_casters_cannot_stand(engine: str) -> None:
    """The error says what to use instead; NaN torque is refused."""
    robot = load_robot("thesis")
    with pytest.raises(PlantError, match="has 2 casters; a plant in space needs at least 3"):
        make_plant(engine, dataclasses.replace(robot, casters=robot.casters[:2]))
    plant = make_plant(engine, robot)
    with pytest.raises(PlantError, match="NaN"):
        plant.step(np.full((4, 2), np.nan))
    plant.close()
    plant.close()


@pytest.mark.parametrize("lifted", [False, True])
def test_a_state_beyond_all_bounds_is_an_error_until_the_next_reset(
    engine: str, lifted: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Infinite numbers ended in a ValueError from `state`. No engine starts anew by itself, or leaves a file behind."""
    monkeypatch.chdir(tmp_path)
    plant = make_plant(engine, load_robot("thesis"), lifted=lifted)
    at_rest = plant.state()
    plant.set_motion(np.array([1e200, 0.0, 0.0]), np.zeros((4, 2)), np.full((4, 2), 1e200))
    with pytest.raises(PlantError, match=r"not finite at 0\.020 s"):
        plant.step(np.zeros((4, 2)), 20)
    plant.reset()
    np.testing.assert_allclose(plant.state().normal_force, at_rest.normal_force)
    np.testing.assert_array_equal(plant.state().twist, 0.0)
    plant.close()
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("lifted", [False, True])
def test_what_was_set_is_the_state(engine: str, lifted: bool) -> None:
    """Pose, twist of a base whose centre of mass lies off its origin, and joints come back as they were given; 1e-9."""
    robot = load_robot("thesis")
    robot = dataclasses.replace(robot, chassis=dataclasses.replace(robot.chassis, com=(0.05, -0.03, 0.2)))
    plant = make_plant(engine, robot, lifted=lifted)
    pose, twist = np.array([0.7, -0.4, 2.0]), np.array([0.3, -0.2, 0.9])
    joints, rates = np.arange(8.0).reshape(4, 2), np.linspace(-3.0, 3.0, 8).reshape(4, 2)
    plant.reset(pose=pose)
    plant.set_motion(twist, joints, rates)
    state = plant.state()
    plant.close()
    np.testing.assert_allclose(state.pose, pose, atol=1e-9)
    # The base leans by a fraction of a milliradian, and its vertical axis with it.
    np.testing.assert_allclose(state.twist, np.zeros(3) if lifted else twist, atol=1e-6)
    np.testing.assert_allclose(state.joint_position, joints, atol=1e-9)
    np.testing.assert_allclose(state.joint_velocity, rates, atol=1e-9)


@pytest.mark.parametrize("name", ["thesis", "tidybot2"])
def test_mujoco_has_the_masses_and_the_rotors_of_the_description(name: str) -> None:
    """Mass matrix in another pose: all masses, and on each caster's joints N^T J N more than without rotors."""
    mujoco = pytest.importorskip("mujoco", reason="MuJoCo, which is optional, is not installed")
    from pcw_sim_bridge.plants.mujoco_plant import mujoco_spec

    robot = load_robot(name)
    bare = dataclasses.replace(
        robot, casters=tuple(dataclasses.replace(c, rotors=Rotors(drive=0.0, steer=0.0)) for c in robot.casters)
    )
    matrices = []
    for described in (robot, bare):
        model = mujoco_spec(described, held=False).compile()
        data = mujoco.MjData(model)
        data.qpos[7:] = np.linspace(-1.0, 2.0, 2 * robot.n)
        mujoco.mj_forward(model, data)
        matrix, unit = np.empty((model.nv, model.nv)), np.eye(model.nv)
        for row, direction in zip(matrix, unit, strict=True):
            mujoco.mj_mulM(model, data, row, direction)
        matrices.append(matrix)
        assert model.body_subtreemass[0] == pytest.approx(robot.total_mass, rel=1e-12)
    rotors = np.zeros_like(matrices[0])
    places = [int(model.joint(joint).dofadr[0]) for joint in robot.joint_names]
    for i in range(robot.n):
        place = places[2 * i : 2 * i + 2]
        rotors[np.ix_(place, place)] = robot.armature[i]
    np.testing.assert_allclose(matrices[0] - matrices[1], rotors, atol=1e-12)
    if name == "tidybot2":
        assert np.abs(rotors[places[0], places[1]]) > 1e-4, "its gears couple drive and steering"


def test_without_mujoco_the_error_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    """It is optional; the other plants do not ask for it."""
    monkeypatch.setitem(sys.modules, "mujoco", None)
    monkeypatch.delitem(sys.modules, "pcw_sim_bridge.plants.mujoco_plant", raising=False)
    robot = load_robot("thesis")
    with pytest.raises(PlantError, match="'mujoco' needs MuJoCo, .*pip install mujoco"):
        make_plant("mujoco", robot)
    make_plant("reduced", robot).step(np.zeros((4, 2)))


def test_without_a_display_a_window_is_refused(engine: str) -> None:
    """The error says what is missing. In a process of its own, because left alone both engines end it without a word."""
    program = (
        "import sys; from pcw_description import load_robot; from pcw_sim_bridge.plants.factory import make_plant\n"
        "from pcw_sim_bridge.plants.plant import PlantError\n"
        "try: make_plant(sys.argv[1], load_robot('thesis'), gui=True)\n"
        "except PlantError as error: print(error)"
    )
    environment = {name: value for name, value in os.environ.items() if name not in ("DISPLAY", "WAYLAND_DISPLAY")}
    done = subprocess.run(
        [sys.executable, "-c", program, engine], env=environment, capture_output=True, text=True, timeout=100
    )
    assert "could not start its window; is a display there?" in done.stdout, done.stderr


def test_the_mujoco_window_shows_sixty_pictures_a_second_and_is_closed(monkeypatch: pytest.MonkeyPatch) -> None:
    """With something else in the place of the window, which only a display shows."""
    pytest.importorskip("mujoco", reason="MuJoCo, which is optional, is not installed")
    from pcw_sim_bridge.plants import mujoco_plant

    calls = []

    class Window:
        def sync(self) -> None:
            calls.append("sync")

        def close(self) -> None:
            calls.append("close")

    monkeypatch.setattr(mujoco_plant, "_open_viewer", lambda model, data: Window())
    plant = make_plant("mujoco", load_robot("thesis"), gui=True)
    calls.clear()
    plant.step(np.zeros((4, 2)), 1000)
    assert calls.count("sync") == pytest.approx(60, abs=3)
    plant.close()
    plant.close()
    assert calls.count("close") == 1
