"""Lambda and theta, (3.36)-(3.39), against two independent rigid-body engines, and the laws they must obey.

The engines know nothing of casters: they get bodies, joints and rotors, and give the mass matrix M(q) and the bias
h(q, q_dot) of the robot floating over the ground. Rolling without slip comes in afterwards, from the engine's own Jacobian of
the rubber at the ground: q_dot = G(q) V. Then Lambda = G^T M G and theta = G^T (M G_dot V + h), with V in body axes.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import mujoco
import numpy as np
import pinocchio
import pytest
import scipy.integrate

from pcw_description import (
    AugmentedObjectModel,
    KinematicsError,
    inverse_kinematics,
    load_robot,
    parse_robot,
    shipped_robots,
)
from pcw_description.robot_description import MINIMUM_CASTER_OFFSET, RobotDescription
from pcw_description.robot_file import robot_to_mapping

ROBOTS = tuple(
    name
    for name in shipped_robots()
    if np.all(np.abs(load_robot(name).caster_offset[:, 0]) >= MINIMUM_CASTER_OFFSET)
)
# Must show: agreement with the engines, relative to the largest entry.
ENGINE_AGREEMENT = 1e-10
# Must show: V . theta = 1/2 V' Lambda_dot V, relative.
POWER_BALANCE = 1e-9


@dataclasses.dataclass(frozen=True)
class Bodies:
    """Fork and wheel of one caster as two bodies; together they are the module of the description."""

    fork_mass: float
    fork_com: np.ndarray
    fork_zz: float
    wheel_zz: float

    @staticmethod
    def of(caster) -> Bodies:
        """Split the module: what is not wheel is fork."""
        wheel, module, offset = caster.wheel, caster.module, np.array(caster.caster_offset)
        wheel_zz = 0.55 * wheel.inertia_axle  # a disc with a little width
        mass = module.mass - wheel.mass
        com = (module.mass * np.array(module.com) - wheel.mass * offset) / mass
        apart = wheel.mass * mass / module.mass * float(np.sum((com - offset) ** 2))
        return Bodies(mass, com, module.inertia_zz - wheel_zz - apart, wheel_zz)


class MujocoEngine:
    """The robot in MuJoCo; rotors are tendons with armature over both joints of a caster."""

    def __init__(self, robot: RobotDescription) -> None:
        self.robot = robot
        self.model = mujoco.MjModel.from_xml_string(self._xml(robot))
        self.data = mujoco.MjData(self.model)
        self.wheels = [self.model.body(f"{name}_wheel").id for name in robot.caster_names]
        self.size = 3 + 2 * robot.n

    @staticmethod
    def _xml(robot: RobotDescription) -> str:
        chassis, casters, motors = robot.chassis, [], []
        for caster in robot.casters:
            bodies = Bodies.of(caster)
            (x, y), (b_x, b_y), r, name = (
                caster.steer_axis,
                caster.caster_offset,
                caster.wheel_radius,
                caster.name,
            )
            tilt = 2.0 * bodies.fork_zz  # about horizontal axes: out of the plane, of no consequence
            casters.append(
                f"""<body pos="{x:.17g} {y:.17g} 0"><joint name="{name}_steer" axis="0 0 1"/>
                <inertial pos="{bodies.fork_com[0]:.17g} {bodies.fork_com[1]:.17g} {r:.17g}"
                  mass="{bodies.fork_mass:.17g}" diaginertia="{tilt:.17g} {tilt:.17g} {bodies.fork_zz:.17g}"/>
                <body name="{name}_wheel" pos="{b_x:.17g} {b_y:.17g} {r:.17g}"><joint name="{name}_drive" axis="0 1 0"/>
                  <inertial pos="0 0 0" mass="{caster.wheel.mass:.17g}"
                    diaginertia="{bodies.wheel_zz:.17g} {caster.wheel.inertia_axle:.17g} {bodies.wheel_zz:.17g}"/>
                </body></body>"""
            )
            for motor, inertia, by_drive, by_steer in (
                ("drive", caster.rotors.drive, caster.gears.drive, caster.gears.drive_per_steer),
                ("steer", caster.rotors.steer, caster.gears.steer_per_drive, caster.gears.steer),
            ):
                motors.append(
                    f"""<fixed name="{name}_{motor}_motor" armature="{inertia:.17g}">
                    <joint joint="{name}_drive" coef="{by_drive:.17g}"/>
                    <joint joint="{name}_steer" coef="{by_steer:.17g}"/></fixed>"""
                )
        x, y, z = chassis.com
        xx, yy, zz = chassis.principal_inertias()
        return f"""<mujoco><option gravity="0 0 0"/><worldbody><body><joint type="slide" axis="1 0 0"/>
            <joint type="slide" axis="0 1 0"/><joint axis="0 0 1"/>
            <inertial pos="{x:.17g} {y:.17g} {z:.17g}" mass="{chassis.mass:.17g}" diaginertia="{xx:.17g} {yy:.17g} {zz:.17g}"/>
            {"".join(casters)}</body></worldbody><tendon>{"".join(motors)}</tendon></mujoco>"""

    def inertia_and_bias(self, q: np.ndarray, rates: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return M (nv, nv) and h (nv,), joints in the order x, y, yaw, then steering and drive of each caster."""
        self.data.qpos, self.data.qvel = q, rates
        mujoco.mj_forward(self.model, self.data)
        inertia = np.empty((self.size, self.size))
        for column, unit in zip(inertia.T, np.eye(self.size), strict=True):
            product = np.empty(self.size)
            mujoco.mj_mulM(self.model, self.data, product, unit)
            column[:] = product
        return inertia, self.data.qfrc_bias.copy()

    def rolling(self, q: np.ndarray) -> np.ndarray:
        """Return G (nv, 3): joint rates from the twist in body axes that leave the rubber on the ground at rest."""
        self.data.qpos = q
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_comPos(self.model, self.data)
        c, s = np.cos(q[2]), np.sin(q[2])
        rolling = np.zeros((self.size, 3))
        rolling[:3] = [[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]
        jacobian = np.empty((3, self.size))
        for i, wheel in enumerate(self.wheels):
            lowest = self.data.xpos[wheel] - [0.0, 0.0, self.robot.wheel_radius[i]]
            mujoco.mj_jac(self.model, self.data, jacobian, None, lowest, wheel)
            own = slice(3 + 2 * i, 5 + 2 * i)
            rolling[own] = -np.linalg.solve(jacobian[:2, own], jacobian[:2, :3] @ rolling[:3])
        return rolling


class PinocchioEngine(MujocoEngine):
    """The same robot in Pinocchio, built with its own calls; rotors are added as the block N^T J N."""

    def __init__(self, robot: RobotDescription) -> None:
        super().__init__(robot)
        self.pin = pinocchio.Model()
        self.pin.gravity = pinocchio.Motion.Zero()
        base = self.pin.addJoint(0, pinocchio.JointModelPX(), pinocchio.SE3.Identity(), "x")
        base = self.pin.addJoint(base, pinocchio.JointModelPY(), pinocchio.SE3.Identity(), "y")
        base = self.pin.addJoint(base, pinocchio.JointModelRZ(), pinocchio.SE3.Identity(), "yaw")
        chassis = robot.chassis
        self._append(base, chassis.mass, chassis.com, chassis.principal_inertias())
        for caster in robot.casters:
            bodies, r = Bodies.of(caster), caster.wheel_radius
            at_axis = pinocchio.SE3(np.eye(3), np.array([*caster.steer_axis, 0.0]))
            fork = self.pin.addJoint(base, pinocchio.JointModelRZ(), at_axis, f"{caster.name}_steer")
            self._append(fork, bodies.fork_mass, [*bodies.fork_com, r], 3 * [bodies.fork_zz])
            at_wheel = pinocchio.SE3(np.eye(3), np.array([*caster.caster_offset, r]))
            wheel = self.pin.addJoint(fork, pinocchio.JointModelRY(), at_wheel, f"{caster.name}_drive")
            axle = caster.wheel.inertia_axle
            self._append(wheel, caster.wheel.mass, np.zeros(3), [bodies.wheel_zz, axle, bodies.wheel_zz])
        self.pin_data = self.pin.createData()

    def _append(self, joint: int, mass: float, com, principal) -> None:
        body = pinocchio.Inertia(mass, np.array(com, dtype=float), np.diag(principal))
        self.pin.appendBodyToJoint(joint, body, pinocchio.SE3.Identity())

    def inertia_and_bias(self, q: np.ndarray, rates: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return M and h as the base class does."""
        inertia = np.triu(pinocchio.crba(self.pin, self.pin_data, q))
        inertia += np.triu(inertia, 1).T
        for i, armature in enumerate(self.robot.armature):
            own = slice(3 + 2 * i, 5 + 2 * i)
            inertia[own, own] += armature[::-1, ::-1]  # the engine has steering before drive
        return inertia, pinocchio.nonLinearEffects(self.pin, self.pin_data, q, rates)


def along(function: Callable[[float], np.ndarray], step: float) -> np.ndarray:
    """Return d/dt at t = 0 by the eighth-order central difference, whose error is the rounding where rates x step is
    0.03.
    """
    weights = {1: 4.0 / 5.0, 2: -1.0 / 5.0, 3: 4.0 / 105.0, 4: -1.0 / 280.0}
    return sum(weight * (function(k * step) - function(-k * step)) for k, weight in weights.items()) / step


def operational_space(
    engine: MujocoEngine, heading: np.ndarray, twist: np.ndarray, rng
) -> tuple[np.ndarray, np.ndarray]:
    """Return Lambda and theta by projection, at any place, yaw and roll angles, none of which may matter."""
    q = np.empty(engine.size)
    q[:3] = rng.uniform(-3.0, 3.0, 3)
    q[3::2], q[4::2] = heading, rng.uniform(-3.0, 3.0, engine.robot.n)
    rolling = engine.rolling(q)
    rates = rolling @ twist
    step = 0.03 / np.abs(rates).max()
    rolling_rate = along(lambda t: engine.rolling(q + t * rates), step)
    inertia, bias = engine.inertia_and_bias(q, rates)
    return rolling.T @ inertia @ rolling, rolling.T @ (inertia @ (rolling_rate @ twist) + bias)


def assert_agreement(
    robot: RobotDescription, engine: MujocoEngine, rng: np.random.Generator, states: int
) -> None:
    """Compare the model with the engine in random states."""
    model = AugmentedObjectModel(robot)
    for _ in range(states):
        heading, twist = rng.uniform(-np.pi, np.pi, robot.n), rng.uniform(-1.5, 1.5, 3)
        inertia, bias = model.evaluate(heading, twist)
        expected_inertia, expected_bias = operational_space(engine, heading, twist, rng)
        np.testing.assert_allclose(
            inertia, expected_inertia, atol=ENGINE_AGREEMENT * np.abs(expected_inertia).max(), rtol=0.0
        )
        np.testing.assert_allclose(
            bias, expected_bias, atol=ENGINE_AGREEMENT * np.abs(expected_bias).max(), rtol=0.0
        )


@pytest.mark.parametrize("n", [2, 3, 4, 6])
def test_random_robots_agree_with_mujoco(random_robot, n: int) -> None:
    """Must show: 100 random states each for n = 2, 3, 4, 6; five robots of 20 states, offsets and gear coupling
    included.
    """
    rng = np.random.default_rng(n)
    for _ in range(5):
        robot = random_robot(rng, n)
        assert_agreement(robot, MujocoEngine(robot), rng, states=20)


@pytest.mark.parametrize("name", ROBOTS)
def test_shipped_robots_agree_with_mujoco(name: str) -> None:
    """Must show: every shipped robot that can be torque controlled, 100 random states each."""
    robot = load_robot(name)
    assert_agreement(robot, MujocoEngine(robot), np.random.default_rng(7), states=100)


def test_a_random_robot_agrees_with_pinocchio(random_robot) -> None:
    """A second engine, another algorithm and another set of calls, so that one engine's habit cannot hide an error."""
    rng = np.random.default_rng(8)
    robot = random_robot(rng, 4)
    assert_agreement(robot, PinocchioEngine(robot), rng, states=20)


def test_the_comparison_would_see_a_missing_rotor(random_robot) -> None:
    """Reflected rotors are no small part, and the coupling makes an off-diagonal block: leaving it out shows at
    once.
    """
    rng = np.random.default_rng(9)
    robot = random_robot(rng, 3)
    mapping = robot_to_mapping(robot)
    for caster in mapping["casters"]:
        caster["gears"] = {"drive": caster["gears"]["drive"], "steer": caster["gears"]["steer"]}
    with pytest.raises(AssertionError):
        assert_agreement(robot, MujocoEngine(parse_robot(mapping)), rng, states=1)


def random_states(robot: RobotDescription, rng: np.random.Generator, count: int):
    """Yield headings and twists."""
    for _ in range(count):
        yield rng.uniform(-np.pi, np.pi, robot.n), rng.uniform(-1.5, 1.5, 3)


def robots_to_check(random_robot) -> list[RobotDescription]:
    """Return the shipped robots and one random robot of each size."""
    rng = np.random.default_rng(10)
    return [load_robot(name) for name in ROBOTS] + [random_robot(rng, n) for n in range(2, 7)]


def test_lambda_is_symmetric_and_positive_definite(random_robot) -> None:
    """And heavier than the chassis alone in every direction: casters can only add."""
    rng = np.random.default_rng(11)
    for robot in robots_to_check(random_robot):
        model = AugmentedObjectModel(robot)
        m, x, y = robot.chassis.mass, *robot.chassis.com[:2]
        chassis = np.array(
            [
                [m, 0.0, -m * y],
                [0.0, m, m * x],
                [-m * y, m * x, robot.chassis.inertia_zz + m * (x * x + y * y)],
            ]
        )
        for heading, twist in random_states(robot, rng, 20):
            inertia, _ = model.evaluate(heading, twist)
            np.testing.assert_array_equal(inertia, inertia.T)
            assert np.linalg.eigvalsh(inertia - chassis).min() > 0.0


def test_theta_does_the_work_of_the_changing_inertia(random_robot) -> None:
    """Must show: V . theta = 1/2 V' Lambda_dot V to 1e-9, along the headings' motion of slip-free rolling."""
    rng = np.random.default_rng(12)
    for robot in robots_to_check(random_robot):
        model = AugmentedObjectModel(robot)
        for heading, twist in random_states(robot, rng, 20):
            steer_rate = inverse_kinematics(robot, heading, twist)[:, 1]
            step = 0.03 / np.abs(steer_rate).max()
            inertia_rate = along(lambda t: model.evaluate(heading + t * steer_rate, twist)[0], step)  # noqa: B023
            _, bias = model.evaluate(heading, twist)
            work, expected = twist @ bias, 0.5 * twist @ inertia_rate @ twist
            assert abs(work - expected) <= POWER_BALANCE * np.linalg.norm(twist) * np.linalg.norm(bias)


def test_theta_is_quadratic_in_the_twist_and_lambda_does_not_know_it(random_robot) -> None:
    """Coriolis and centrifugal forces grow with the square of speed and do not depend on its sign."""
    rng = np.random.default_rng(13)
    for robot in robots_to_check(random_robot):
        model = AugmentedObjectModel(robot)
        heading, twist = rng.uniform(-np.pi, np.pi, robot.n), rng.uniform(-1.5, 1.5, 3)
        inertia, bias = model.evaluate(heading, twist)
        for factor in (-1.0, 3.0):
            same, scaled = model.evaluate(heading, factor * twist)
            np.testing.assert_array_equal(same, inertia)
            np.testing.assert_allclose(scaled, factor**2 * bias, rtol=1e-12, atol=1e-12 * np.abs(bias).max())


@pytest.mark.parametrize("n", [2, 4])
def test_a_robot_left_alone_keeps_its_energy(random_robot, n: int) -> None:
    """Lambda V_dot + theta = 0 for 10 s: kinetic energy constant to 1e-8, while casters swing round behind the
    motion.
    """
    rng = np.random.default_rng(20 + n)
    robot = random_robot(rng, n)
    model = AugmentedObjectModel(robot)

    def rate(_: float, state: np.ndarray) -> np.ndarray:
        heading, twist = state[:n].copy(), state[n:].copy()
        inertia, bias = model.evaluate(heading, twist)
        return np.concatenate(
            [inverse_kinematics(robot, heading, twist)[:, 1], -np.linalg.solve(inertia, bias)]
        )

    def energy(state: np.ndarray) -> float:
        return 0.5 * state[n:] @ model.evaluate(state[:n].copy(), state[n:].copy())[0] @ state[n:]

    start = np.concatenate([rng.uniform(-np.pi, np.pi, n), [0.6, -0.3, 0.5]])
    path = scipy.integrate.solve_ivp(
        rate, (0.0, 10.0), start, method="DOP853", rtol=1e-11, atol=1e-11, dense_output=True
    )
    energies = [energy(state) for state in path.sol(np.linspace(0.0, 10.0, 200)).T]
    assert path.success
    # The twist itself must have changed, or nothing was shown.
    assert np.linalg.norm(path.y[n:, -1] - start[n:]) > 0.1
    np.testing.assert_allclose(energies, energies[0], rtol=1e-8)


def test_a_symmetric_robot_has_a_symmetric_lambda() -> None:
    """The thesis robot, mirrored: the coupling of x with y and of x with yaw changes sign, the rest stays."""
    robot = load_robot("thesis")
    model = AugmentedObjectModel(robot)
    mirror = [robot.caster_index(name) for name in ("front_right", "front_left", "rear_right", "rear_left")]
    sign = np.array([1.0, -1.0, -1.0])
    for heading, twist in random_states(robot, np.random.default_rng(14), 20):
        inertia, bias = model.evaluate(heading, twist)
        mirrored_inertia, mirrored_bias = model.evaluate(-heading[mirror], sign * twist)
        np.testing.assert_allclose(
            mirrored_inertia, inertia * np.outer(sign, sign), atol=1e-12 * np.abs(inertia).max()
        )
        np.testing.assert_allclose(mirrored_bias, sign * bias, atol=1e-12 * np.abs(bias).max())


def test_straight_rolling_carries_mass_and_rolling_inertia() -> None:
    """All wheels trailing straight: Lambda_xx = total mass + sum (I_axle + N^2 J) / r^2, and no force is needed to
    keep rolling.
    """
    robot = load_robot("thesis")
    inertia, bias = AugmentedObjectModel(robot).evaluate(np.zeros(4), np.array([1.0, 0.0, 0.0]))
    rolling = 4 * (0.0042 + 20.0**2 * 4.0e-5) / 0.075**2
    assert inertia[0, 0] == pytest.approx(robot.total_mass + rolling, rel=1e-14)
    np.testing.assert_allclose(bias, np.zeros(3), atol=1e-12)


def test_a_robot_without_offset_is_refused_with_the_reason() -> None:
    """b_x = 0: the message names the caster, the value and why torque control needs a lever arm."""
    mapping = robot_to_mapping(load_robot("thesis"))
    mapping["casters"][1]["caster_offset"] = [0.0, 0.045]
    with pytest.raises(
        KinematicsError,
        match=r"'front_right' has caster_offset\[0\] = 0 m; torque control needs at least 0\.001 m",
    ):
        AugmentedObjectModel(parse_robot(mapping))
