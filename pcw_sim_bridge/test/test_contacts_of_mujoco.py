"""Robots on MuJoCo's own contacts: a simulation whose tyres, loops and sensors are none of ours."""

import math
from pathlib import Path

import numpy as np
import pytest

from pcw_description import inverse_kinematics, load_robot
from pcw_description.recording_series import ImuSeries, JointSeries, OdometrySeries
from pcw_sim_bridge.mismatch.challenge.simulated_case import SimulatedRecording
from pcw_sim_bridge.mismatch.findings.explanation import explain
from pcw_sim_bridge.mismatch.robot.robot_channels import RobotProblemBuilder

mujoco = pytest.importorskip("mujoco")

from pcw_sim_bridge.plants.mujoco_plant import mujoco_spec  # noqa: E402

THESIS = load_robot("thesis")
STEP, CYCLE, DURATION = 1e-3, 2, 20.0  # [s], steps, [s]


def on_its_wheels(robot):
    """The robot's bodies on a floor, each wheel an ellipsoid that touches it in a point."""
    spec = mujoco_spec(robot, held=False)
    for geom in spec.geoms:
        geom.contype = geom.conaffinity = 0
    touching = {"friction": [0.8, 0.0, 0.0], "condim": 3, "solref": [0.01, 1.0]}
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0.0, 0.0, 1.0], contype=0, conaffinity=1, **touching)
    for caster in robot.casters:
        wheel, radius = spec.joint(f"{caster.name}_drive").parent, caster.wheel_radius
        wheel.add_geom(
            type=mujoco.mjtGeom.mjGEOM_ELLIPSOID, size=[radius, 0.2 * radius, radius], contype=1, conaffinity=0, **touching
        )
    place = spec.body("base_link").add_site(name="imu", pos=robot.sensors.imu.position)
    for kind in (mujoco.mjtSensor.mjSENS_GYRO, mujoco.mjtSensor.mjSENS_ACCELEROMETER):
        spec.add_sensor(type=kind, objtype=mujoco.mjtObj.mjOBJ_SITE, objname=place.name)
    spec.option.timestep, spec.option.integrator = STEP, mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    return spec.compile()


def wanted_twist(t):
    """Changing along all three axes, from rest."""
    along = 0.5 * math.sin(1.1 * t) + 0.2 * math.sin(4.1 * t)
    return min(t, 1.0) * np.array([along, 0.5 * math.sin(0.8 * t + 1.0), math.sin(0.6 * t)])


def recorded(robot, friction, seed=0):
    """Run it under loops of its joints' speeds, with friction [N m] in drives and steerings (n, 2), and read its sensors."""
    rng, model = np.random.default_rng(seed), on_its_wheels(robot)
    data = mujoco.MjData(model)
    angles, rates = (
        np.array([getattr(model.joint(name), which)[0] for name in robot.joint_names]).reshape(-1, 2)
        for which in ("qposadr", "dofadr")
    )
    rows, integral, before, rate = [], np.zeros((robot.n, 2)), None, np.zeros((robot.n, 2))
    torque, gains = np.zeros((robot.n, 2)), np.array([[3.0, 3.0], [20.0, 30.0]])
    for k in range(round(DURATION / STEP)):
        if k % CYCLE == 0:
            read = data.qpos[angles] + 1e-5 * rng.standard_normal((robot.n, 2))
            rate = rate if before is None else rate + 0.4 * ((read - before) / (CYCLE * STEP) - rate)
            before = read
            error = inverse_kinematics(robot, read[:, 1], wanted_twist(k * STEP)) - rate
            integral += CYCLE * STEP * gains[1] * error
            torque = np.clip(gains[0] * error + integral, -robot.torque_limit, robot.torque_limit)
            w, z = data.qpos[3], data.qpos[6]
            pose = [*data.qpos[:2], 2.0 * math.atan2(z, w)]
            rows.append((k * STEP, read, rate, torque, pose, data.sensordata.copy()))
        data.qfrc_applied[rates] = torque - friction * np.tanh(data.qvel[rates] / 0.03)
        mujoco.mj_step(model, data)
    time, position, velocity, effort, pose, sensed = (np.array(column) for column in zip(*rows, strict=True))
    stamps = time, (1e9 * time).astype(np.int64)
    names = tuple(robot.joint_names)
    noisy = effort + 0.02 * rng.standard_normal(effort.shape)
    pose[:, 2] = np.unwrap(pose[:, 2])
    gyro = sensed[:, :3] + 0.002 * rng.standard_normal((len(time), 3))
    acceleration = sensed[:, 3:] + 0.02 * rng.standard_normal((len(time), 3))
    tracked = pose + 5e-4 * rng.standard_normal(pose.shape)
    return SimulatedRecording(
        Path("mujoco"), robot, JointSeries(*stamps, names, position, velocity, noisy),
        JointSeries(*stamps, names, *(np.full_like(effort, np.nan) for _ in range(2)), effort),
        ImuSeries(*stamps, gyro, acceleration),
        OdometrySeries(*stamps, tracked, np.full_like(tracked, np.nan), "odom", "base_link"), None,
    )  # fmt: skip


def explained(friction, seed):
    problem = RobotProblemBuilder(THESIS, [recorded(THESIS, friction, seed)]).build()
    return explain(problem, np.random.default_rng(0))


@pytest.mark.parametrize("seed", [1, pytest.param(2, marks=pytest.mark.nightly)])
def test_a_robot_as_it_is_described_misses_nothing(seed):
    """What its soft contacts do was a law outside the library; its own gyro and accelerometer feel what they should."""
    found = explained(np.zeros((THESIS.n, 2)), seed)
    assert {"gyro", "accelerometer/x", "accelerometer/y"} <= {channel.name for channel in found.search.problem.channels}
    assert not found.named and not found.leftovers


@pytest.mark.parametrize(
    ("effect", "axis"),
    [("drive_coulomb_friction", 0), pytest.param("steer_coulomb_friction", 1, marks=pytest.mark.nightly)],
)
def test_a_friction_is_found_where_it_is_and_as_large_as_it_is(effect, axis):
    friction = np.zeros((THESIS.n, 2))
    friction[2, axis] = 0.4
    [named] = explained(friction, 3).named
    assert (named.term.effect, named.term.target) == (effect, (THESIS.caster_names[2],))
    assert named.estimates["coulomb"].value == pytest.approx(0.4, rel=0.1)
