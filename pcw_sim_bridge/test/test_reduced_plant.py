"""The reduced plant against an independent engine, against energy and momentum, and against its own limits."""

import dataclasses

import mujoco
import numpy as np
import pytest

from pcw_description import AugmentedObjectModel, load_robot, parse_robot, shipped_robots
from pcw_description.differential_kinematics import inverse_kinematics
from pcw_description.effect_instance import EffectInstance
from pcw_description.effects.registry import read_physics
from pcw_description.robot_description import DRIVE, STEER, RobotDescription
from pcw_description.robot_file import robot_to_mapping
from pcw_sim_bridge.plants.factory import make_plant
from pcw_sim_bridge.plants.plant import PlantError
from pcw_sim_bridge.plants.reduced import ReducedPlant
from pcw_sim_bridge.traction_test import measure_traction, traction_rig

TORQUE_ROBOTS = [
    name for name in shipped_robots() if np.all(np.abs(load_robot(name).caster_offset[:, 0]) > 1e-3)
]
# The plant takes joint accelerations from one step; rounding of that difference sets the tolerance.
ENGINE_TOLERANCE = 1e-7

DISSIPATIVE = (
    {"name": "drive_coulomb_friction", "coulomb": 0.3},
    {"name": "drive_viscous_friction", "viscous": 0.05},
    {"name": "drive_stribeck_friction", "stribeck": 0.2, "stribeck_speed": 1.0},
    {"name": "steer_coulomb_friction", "coulomb": 0.1},
    {"name": "steer_viscous_friction", "viscous": 0.02},
    {"name": "load_dependent_friction", "fraction": 0.1},
    {"name": "rolling_resistance", "arm": 1e-3},
    {"name": "scrub_torque", "radius": 0.01},
    {"name": "aerodynamic_drag", "coefficient": 2.0},
)
# Per step, relative to the energy at the start.
GROWTH = 1e-9
# Relative, over ten seconds.
CONSERVATION = 1e-6


def random_robot(rng: np.random.Generator, n: int) -> RobotDescription:
    """Return a robot with n random casters, lateral offsets and coupled gears."""
    mapping = robot_to_mapping(load_robot("thesis"))
    template = mapping["casters"][0]
    casters = []
    for index in range(n):
        angle = 2.0 * np.pi * index / n + rng.uniform(-0.2, 0.2)
        casters.append(
            template
            | {
                "name": f"caster{index}",
                "steer_axis": [0.3 * np.cos(angle), 0.3 * np.sin(angle)],
                "caster_offset": [
                    float(rng.choice([-1, 1]) * rng.uniform(0.01, 0.05)),
                    float(rng.uniform(-0.01, 0.01)),
                ],
                "gears": {"drive": 12.0, "steer": 15.0, "drive_per_steer": float(rng.uniform(-4, 4))},
                "module": {
                    "mass": float(rng.uniform(2, 5)),
                    "com": rng.uniform(-0.03, 0.03, 2).tolist(),
                    "inertia_zz": 0.05,
                },
            }
        )
    mapping["casters"] = casters
    mapping["chassis"]["com"] = [0.03, -0.02, 0.25]
    return parse_robot(mapping)


def planar_mujoco(robot: RobotDescription) -> mujoco.MjModel:
    """Return the robot as free planar bodies in MuJoCo; the coupled part of the rotors is a fixed tendon's armature."""
    chassis = robot.chassis
    bodies, tendons = [], []
    for caster, gear in zip(robot.casters, robot.gear_matrix, strict=True):
        module, wheel = caster.module, caster.wheel
        # The wheel's mass is the module's: here it only adds its spin inertia, as a massless-but-spinning body.
        bodies.append(f"""
          <body pos="{caster.steer_axis[0]} {caster.steer_axis[1]} 0">
            <joint name="{caster.name}_steer" type="hinge" axis="0 0 1"/>
            <inertial pos="{module.com[0]} {module.com[1]} 0" mass="{module.mass}" diaginertia="1 1 {module.inertia_zz}"/>
            <body>
              <joint name="{caster.name}_drive" type="hinge" axis="0 1 0" armature="{wheel.inertia_axle}"/>
              <inertial pos="0 0 0" mass="1e-12" diaginertia="1e-12 1e-12 1e-12"/>
            </body>
          </body>""")
        for motor, row in zip((caster.rotors.drive, caster.rotors.steer), gear, strict=True):
            tendons.append(f"""
          <fixed armature="{motor}">
            <joint joint="{caster.name}_drive" coef="{row[DRIVE]}"/><joint joint="{caster.name}_steer" coef="{row[STEER]}"/>
          </fixed>""")
    xml = f"""
    <mujoco><compiler balanceinertia="false" boundmass="0" boundinertia="0"/><option gravity="0 0 0"/>
      <worldbody><body>
        <joint name="x" type="slide" axis="1 0 0"/><joint name="y" type="slide" axis="0 1 0"/>
        <joint name="yaw" type="hinge" axis="0 0 1"/>
        <inertial pos="{chassis.com[0]} {chassis.com[1]} 0" mass="{chassis.mass}" diaginertia="9 9 {chassis.inertia_zz}"/>
        {"".join(bodies)}
      </body></worldbody>
      <tendon>{"".join(tendons)}</tendon>
    </mujoco>"""
    return mujoco.MjModel.from_xml_string(xml)


@pytest.mark.parametrize("n", [2, 3, 4, 6])
def test_accelerations_agree_with_mujoco(n: int) -> None:
    """Equal state and torques give equal accelerations, contact forces of the plant handed to MuJoCo."""
    rng = np.random.default_rng(n)
    dt = 1e-6  # the plant's accelerations are those at the middle of its step
    for _ in range(10):
        robot = random_robot(rng, n)
        model = planar_mujoco(robot)
        data = mujoco.MjData(model)
        plant = ReducedPlant(robot, dt)
        twist, headings = rng.normal(size=3), rng.uniform(-3, 3, n)
        rates = np.column_stack([rng.normal(size=n) * 10.0, rng.normal(size=n)])
        plant.reset(steer_angle=headings)
        plant._body[3:6] = twist
        plant._wheels[:, 2:4] = rates
        torque = rng.normal(size=(n, 2))
        plant.step(torque)
        after = plant.state()

        names = [name for caster in robot.caster_names for name in (f"{caster}_drive", f"{caster}_steer")]
        address = [model.joint(name).dofadr[0] for name in names]
        data.qvel[:3] = twist
        data.qvel[address] = rates.ravel()
        data.qpos[address] = np.column_stack([np.zeros(n), headings]).ravel()
        generalised = np.zeros(model.nv)
        generalised[address] = torque.ravel()
        for i, caster in enumerate(robot.casters):
            c, s = np.cos(headings[i]), np.sin(headings[i])
            turn = np.array([[c, -s], [s, c]])
            force = turn @ after.contact_force[i]
            arm = turn @ np.array(caster.caster_offset)
            centre = np.array(caster.steer_axis) + arm
            generalised[:2] += force
            generalised[2] += centre[0] * force[1] - centre[1] * force[0]
            generalised[address[2 * i]] -= caster.wheel_radius * after.contact_force[i, 0]
            generalised[address[2 * i + 1]] += arm[0] * force[1] - arm[1] * force[0]
        data.qfrc_applied[:] = generalised
        mujoco.mj_forward(model, data)
        expected = data.qacc[address].reshape(n, 2)
        found = (after.joint_velocity - rates) / dt
        scale = np.abs(expected).max()
        np.testing.assert_allclose(found, expected, atol=ENGINE_TOLERANCE * scale)
        np.testing.assert_allclose(after.acceleration, data.qacc[:3], atol=ENGINE_TOLERANCE * scale)


@pytest.mark.parametrize("name", TORQUE_ROBOTS)
def test_gentle_push_follows_the_augmented_object(name: str) -> None:
    """Far below the friction limit the robot accelerates as Lambda says; what is left is the slip that carries the force."""
    robot = load_robot(name)
    plant = make_plant("reduced", robot)
    torque = np.zeros((robot.n, 2))
    torque[:, DRIVE] = 0.02 * robot.contact.mu_p * robot.total_mass * 9.81 * robot.wheel_radius / robot.n
    plant.reset(steer_angle=np.full(robot.n, 0.3))
    plant.step(torque, round(1.0 / plant.dt))
    state = plant.state()
    speed = np.hypot(*state.twist[:2])
    inertia, _ = AugmentedObjectModel(robot).evaluate(np.full(robot.n, 0.3), np.zeros(3))
    heading = np.array([np.cos(0.3), np.sin(0.3), 0.0])
    push = np.sum(torque[:, DRIVE] / robot.wheel_radius)
    assert speed == pytest.approx(push * heading @ np.linalg.solve(inertia, heading), rel=0.02)


@pytest.mark.parametrize("name", TORQUE_ROBOTS)
@pytest.mark.parametrize("dt", [0.000125, 0.001, 0.002])
def test_coasting_never_gains_energy(name: str, dt: float) -> None:
    """Without motors the energy only falls, at every step size."""
    robot = load_robot(name)
    plant = make_plant("reduced", robot, dt)
    rng = np.random.default_rng(3)
    plant.reset(steer_angle=rng.uniform(-1.0, 1.0, robot.n))
    # Different drives against each other, so that wheels slip and swing round, but no steering motor to race them.
    torque = 0.2 * rng.normal(size=(robot.n, 2)) * robot.torque_limit * np.array([1.0, 0.0])
    plant.step(torque, round(0.2 / dt))
    energies = []
    for _ in range(100):
        plant.step(np.zeros((robot.n, 2)), round(0.02 / dt))
        energies.append(kinetic_energy(robot, plant.state()) + tyre_energy(plant))
    assert np.max(np.diff(energies)) <= GROWTH * energies[0]


def kinetic_energy(robot: RobotDescription, state) -> float:  # type: ignore[no-untyped-def]
    """Return the kinetic energy [J] from positions and rates, body by body."""
    vx, vy, omega = state.twist

    def velocity(point: np.ndarray) -> np.ndarray:
        return np.array([vx - omega * point[1], vy + omega * point[0]])

    chassis = robot.chassis
    total = (
        0.5 * chassis.mass * np.sum(velocity(np.array(chassis.com[:2])) ** 2)
        + 0.5 * chassis.inertia_zz * omega**2
    )
    for i, caster in enumerate(robot.casters):
        roll, steer = state.joint_velocity[i]
        c, s = np.cos(state.joint_position[i, STEER]), np.sin(state.joint_position[i, STEER])
        arm = np.array([[c, -s], [s, c]]) @ np.array(caster.module.com)
        at_com = velocity(np.array(caster.steer_axis)) + (steer + omega) * np.array([-arm[1], arm[0]])
        total += (
            0.5 * caster.module.mass * np.sum(at_com**2)
            + 0.5 * caster.module.inertia_zz * (steer + omega) ** 2
        )
        total += 0.5 * caster.wheel.inertia_axle * roll**2
        rates = np.array([roll, steer])
        total += 0.5 * rates @ robot.armature[i] @ rates
    return float(total)


def tyre_energy(plant: ReducedPlant) -> float:
    """Return what Kiencke tyres hold as springs [J]: the integral of their force over the relaxed slip z."""
    contact = plant.robot.contact
    reach = contact.relaxation_length * np.array([contact.lambda_p, contact.lateral.lambda_p])
    stretch = np.sum((plant._wheels[:, 4:6] / reach) ** 2, axis=1)
    return float(np.sum(contact.mu_p * plant.state().normal_force * reach[0] * np.log1p(stretch)))


def test_power_balance() -> None:
    """Motor work is kinetic energy plus what slip dissipates, to the order of the step."""
    robot = load_robot("thesis")
    dt = 1e-4
    plant = make_plant("reduced", robot, dt)
    rng = np.random.default_rng(5)
    plant.reset(steer_angle=rng.uniform(-1, 1, 4))
    work = lost = 0.0
    for step in range(20000):
        torque = np.column_stack(
            [np.sin(2 * np.pi * 0.7 * step * dt + np.arange(4)), 0.5 * np.cos(5 * step * dt + np.arange(4))]
        )
        before = plant.state()
        plant.step(torque)
        after = plant.state()
        middle = 0.5 * (before.joint_velocity + after.joint_velocity)
        work += dt * np.sum(torque * middle)
        lost += dt * np.sum(after.contact_force * after.slip)
    energy = kinetic_energy(robot, plant.state())
    assert lost > 0.0
    assert energy + lost == pytest.approx(work, rel=0.02)


def test_coulomb_friction_slows_as_its_definition_says_and_holds_at_rest() -> None:
    """A coasting robot with Coulomb friction on all drives loses speed linearly, then stands."""
    robot = load_robot("thesis")
    friction = 0.4
    rubbing = dataclasses.replace(
        robot,
        physics=(
            EffectInstance(
                "drive_coulomb_friction",
                robot.caster_names,
                {"coulomb": friction, "asymmetry": 0.0, "smoothing_speed": 0.05},
            ),
        ),
    )
    plant = make_plant("reduced", rubbing)
    torque = np.zeros((4, 2))
    torque[:, DRIVE] = 2.0
    plant.step(torque, 1000)
    start = plant.state()
    plant.step(np.zeros((4, 2)), 500)
    end = plant.state()
    inertia, _ = AugmentedObjectModel(robot).evaluate(np.zeros(4), np.zeros(3))
    expected = 4 * friction / 0.075 / inertia[0, 0]
    # 1 %: the wheels' speed and the robot's differ by the slip that carries the force.
    assert (start.twist[0] - end.twist[0]) / 0.5 == pytest.approx(expected, rel=0.01)
    plant.step(np.zeros((4, 2)), 10000)
    assert np.abs(plant.state().twist).max() < 1e-3


@pytest.mark.parametrize("speed", [0.2, 0.5, 1.0, 2.0])
def test_traction_test_measures_the_friction_curve(speed: float) -> None:
    """The curve measured by torque on the rig is Kiencke's, peak within 0.1 %."""
    robot = load_robot("thesis")
    plant = make_plant("reduced", traction_rig(robot))
    # Relaxation takes its length at the travelling speed, so slow tests need longer to settle.
    curve = measure_traction(plant, speed, np.array([0.05, 0.1, 0.15, 0.4]), settle=max(1.5, 1.0 / speed))
    assert curve.peak[1] == pytest.approx(robot.contact.mu_p, rel=1e-3)
    expected = 2 * 0.8 * 0.1 * curve.slip_ratio / (0.1**2 + curve.slip_ratio**2)
    np.testing.assert_allclose(curve.friction, expected, rtol=0.02)


def test_load_moves_to_the_rear_when_accelerating() -> None:
    """The front axle loses M h a / wheelbase, and the sum stays the weight."""
    robot = load_robot("thesis")
    plant = make_plant("reduced", robot)
    torque = np.zeros((4, 2))
    torque[:, DRIVE] = 2.0
    plant.step(torque, 500)
    state = plant.state()
    height = (74.0 * 0.25 + 16.0 * 0.075) / 90.0
    assert state.normal_force.sum() == pytest.approx(90.0 * 9.81)
    shift = state.normal_force[2:].sum() - state.normal_force[:2].sum()
    at_rest = 2 * 90.0 * 9.81 / 0.5 * -(0.0 + 16 * -0.012 / 90.0 - -0.030)
    assert shift - at_rest == pytest.approx(2 * 90.0 * height * state.acceleration[0] / 0.5, rel=0.02)


def test_bad_input_is_refused_and_changes_nothing() -> None:
    """NaN torque, unknown plant and a step out of range are named; the state stays."""
    robot = load_robot("thesis")
    plant = make_plant("reduced", robot)
    torque = np.zeros((4, 2))
    torque[1, 0] = np.nan
    with pytest.raises(PlantError, match="NaN"):
        plant.step(torque)
    assert plant.state().time == 0.0
    with pytest.raises(PlantError, match="'gazebo' is not allowed; allowed: reduced, pybullet, mujoco"):
        make_plant("gazebo", robot)
    with pytest.raises(PlantError, match="dt = 0.1 s is not allowed"):
        make_plant("reduced", robot, dt=0.1)


def energies(plant: ReducedPlant, robot: RobotDescription, steps: int) -> np.ndarray:
    """Return the mechanical energy after every step without motors: of motion, and held by the tyres as springs."""
    found = [kinetic_energy(robot, plant.state()) + tyre_energy(plant)]
    for _ in range(steps):
        plant.step(np.zeros((robot.n, 2)))
        found.append(kinetic_energy(robot, plant.state()) + tyre_energy(plant))
    return np.array(found)


@pytest.mark.parametrize(
    "entries",
    [(), *((entry,) for entry in DISSIPATIVE), DISSIPATIVE],
    ids=lambda entries: "+".join(entry["name"] for entry in entries) or "none",
)
def test_dissipation_never_adds_energy(entries: tuple[dict[str, float], ...]) -> None:
    """A robot rolls on from a random twist, its wheels swinging round behind it; the energy falls in every single step."""
    nominal = load_robot("thesis")
    robot = dataclasses.replace(nominal, physics=read_physics(list(entries), nominal.caster_names))
    for seed in range(3):
        rng = np.random.default_rng(seed)
        plant = ReducedPlant(robot)
        headings = rng.uniform(-np.pi, np.pi, robot.n)
        plant.reset(steer_angle=headings)
        twist = rng.normal(size=3) * [0.4, 0.4, 0.8]
        plant.set_motion(twist, plant.state().joint_position, inverse_kinematics(robot, headings, twist))
        found = energies(plant, robot, 4000)
        assert np.max(np.diff(found)) <= GROWTH * found[0]
        assert found[-1] < 0.99 * found[0], "it does dissipate"


@pytest.mark.parametrize("name", TORQUE_ROBOTS)
def test_rolling_straight_keeps_its_energy(name: str) -> None:
    """No effect, no slip: nothing takes energy in ten seconds."""
    robot = load_robot(name)
    plant = ReducedPlant(robot)
    # Trailing wheels, as they are after a while of rolling.
    headings = np.where(robot.caster_offset[:, 0] < 0.0, 0.0, np.pi)
    plant.reset(steer_angle=headings)
    twist = np.array([0.7, 0.0, 0.0])
    plant.set_motion(twist, plant.state().joint_position, inverse_kinematics(robot, headings, twist))
    before = kinetic_energy(robot, plant.state())
    plant.step(np.zeros((robot.n, 2)), 10_000)
    assert kinetic_energy(robot, plant.state()) == pytest.approx(before, rel=CONSERVATION)


@pytest.mark.parametrize("name", TORQUE_ROBOTS)
def test_free_bodies_keep_their_energy(name: str) -> None:
    """On perfect ice chassis and casters turn and swing about each other, which no force of the ground slows."""
    robot = load_robot(name)
    ice = dataclasses.replace(
        robot.contact, mu_p=1e-12, lateral=dataclasses.replace(robot.contact.lateral, mu_p=1e-12), scrub_radius=0.0
    )
    robot = dataclasses.replace(robot, contact=ice)
    rng = np.random.default_rng(4)
    plant = ReducedPlant(robot)
    plant.reset(steer_angle=rng.uniform(-np.pi, np.pi, robot.n))
    rates = rng.normal(size=(robot.n, 2)) * [5.0, 1.0]
    plant.set_motion(np.array([0.4, -0.3, 0.8]), plant.state().joint_position, rates)
    before, started = kinetic_energy(robot, plant.state()), plant.state()
    for _ in range(100):
        plant.step(np.zeros((robot.n, 2)), 100)
        assert kinetic_energy(robot, plant.state()) == pytest.approx(before, rel=CONSERVATION)
    assert np.abs(plant.state().joint_velocity[:, 1] - started.joint_velocity[:, 1]).max() > 1e-3, "they do interact"
