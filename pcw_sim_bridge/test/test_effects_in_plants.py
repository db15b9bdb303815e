"""Every effect of the vocabulary does in a plant what its definition says, in each plant, to a stated tolerance.

The wheels hang free (`lifted`) where one joint is looked at: its acceleration is then its torque over its inertia. On the
ground a rolling robot has the mass m_eff = m + sum (I_wheel + rotor) / r^2 along its heading.
"""

import dataclasses
import math

import numpy as np
import pytest

from pcw_description import load_robot
from pcw_description.augmented_object_model import AugmentedObjectModel
from pcw_description.effects.registry import all_effects, read_physics
from pcw_description.recording import Recording
from pcw_description.robot_description import DRIVE, GRAVITY, STEER
from pcw_sim_bridge.plants.factory import make_plant
from pcw_sim_bridge.plants.plant import PlantError
from pcw_sim_bridge.sensors import ImuReading, JointReading
from pcw_sim_bridge.simulated_robot import SimulatedRobot
from pcw_sim_bridge.simulated_run import record_run

THESIS = load_robot("thesis")
XR4000 = load_robot("xr4000")  # turning a steering rolls the drive's motor
# No steer/drive coupling, equal wheels: what one joint does is not hidden by another.
RADIUS = float(THESIS.wheel_radius[0])
WEIGHT = THESIS.total_mass * GRAVITY
DRIVE_INERTIA = THESIS.casters[0].wheel.inertia_axle + float(THESIS.armature[0, DRIVE, DRIVE])
ROLLING_MASS = THESIS.total_mass + 4.0 * DRIVE_INERTIA / RADIUS**2
ZERO = np.zeros((4, 2))
# Where waves of 1 m lift one diagonal of the wheels and lower the other.
UNEVEN_PLACE = np.array([0.0, 0.25, 0.0])


def steer_inertia(robot=THESIS) -> float:
    """Return the inertia of fork and wheel about the steering axis, with the rotor [kg m^2]."""
    caster = robot.casters[0]
    module = caster.module
    return module.inertia_zz + module.mass * float(np.dot(module.com, module.com)) + float(robot.armature[0, STEER, STEER])


def turning_inertia(headings) -> float:
    """Return the inertia about base_link's vertical of the whole rolling robot [kg m^2]."""
    return AugmentedObjectModel(THESIS).evaluate(headings, np.zeros(3))[0][2, 2]


class Rig:
    """A plant with effects, and a few ways to move it."""

    def __init__(self, plant_name, *entries, robot=THESIS, lifted=False, dt=1e-3, pose=None):
        self.robot = dataclasses.replace(robot, physics=read_physics(list(entries), robot.caster_names))
        self.plant = make_plant(plant_name, self.robot, dt, lifted=lifted)
        self.dt = dt
        if pose is not None:
            self.plant.reset(pose=pose)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.plant.close()

    def spin(self, drive=0.0, steer=0.0, angle=0.0):
        """Let all joints turn, the base at rest."""
        rates = np.tile([drive, steer], (self.robot.n, 1))
        self.plant.set_motion(np.zeros(3), np.tile([0.0, angle], (self.robot.n, 1)), rates)

    def roll(self, speed, radius=RADIUS):
        """Let the robot roll straight ahead."""
        rates = np.tile([speed / radius, 0.0], (self.robot.n, 1))
        self.plant.set_motion(np.array([speed, 0.0, 0.0]), ZERO, rates)

    def turn(self, omega):
        """Let the robot turn on the spot, every wheel rolling along its circle; return the headings."""
        twist = np.array([0.0, 0.0, omega])
        position, velocity = ZERO.copy(), ZERO.copy()
        for i, (x, y) in enumerate(self.robot.steer_axis):
            reach, b = math.hypot(x, y), self.robot.caster_offset[i, 0]
            # The wheel centre is on the circle where its heading is tangential: r_p^2 = reach^2 - b^2, trailing by |b|.
            heading = math.atan2(y, x) + math.pi / 2.0 + math.asin(b / reach)
            position[i, STEER] = heading
            velocity[i, DRIVE] = omega * math.sqrt(reach**2 - b**2) / self.robot.wheel_radius[i]
        self.plant.set_motion(twist, position, velocity)
        return position[:, STEER]

    def run(self, seconds, torque=ZERO, hold_heading=False):
        """Step with torques, an array or a function of time; return the states after each step."""
        states = []
        state = self.plant.state()
        for k in range(round(seconds / self.dt)):
            now = np.array(torque(k * self.dt) if callable(torque) else torque)
            if hold_heading:
                inertia = steer_inertia()
                now[:, STEER] -= inertia * (3600.0 * state.joint_position[:, STEER] + 120.0 * state.joint_velocity[:, STEER])
            self.plant.step(now)
            state = self.plant.state()
            states.append(state)
        return states


def along(states, name, *index):
    """Return one number of every state."""
    return np.array([getattr(state, name)[index] for state in states])


def drive_acceleration(rig, torque=ZERO, caster=0, seconds=0.01):
    """Return the mean acceleration of a drive over a short while [rad/s^2]."""
    before = rig.plant.state().joint_velocity[caster, DRIVE]
    return (rig.run(seconds, torque)[-1].joint_velocity[caster, DRIVE] - before) / seconds


def test_every_effect_of_the_vocabulary_has_a_test_here():
    source = open(__file__, encoding="utf-8").read()
    missing = [name for name in all_effects() if f'"{name}"' not in source]
    assert not missing


# --- Torques on joints -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("speed", [20.0, -20.0])
def test_coulomb_friction_slows_a_drive_linearly(plant_name, speed):
    """0.1 %: the smoothing of the sign at 20 rad/s is nothing."""
    friction, asymmetry = 0.3, 0.1
    with Rig(plant_name, {"name": "drive_coulomb_friction", "coulomb": friction, "asymmetry": asymmetry}, lifted=True) as rig:
        rig.spin(drive=speed)
        expected = -(friction * math.copysign(1.0, speed) + asymmetry) / DRIVE_INERTIA
        assert drive_acceleration(rig, seconds=0.2) == pytest.approx(expected, rel=1e-3)


def test_coulomb_friction_holds_only_the_targeted_wheel(plant_name):
    with Rig(
        plant_name, {"name": "drive_coulomb_friction", "coulomb": 0.3, "target": ["rear_left"]}, lifted=True
    ) as rig:
        rig.spin(drive=20.0)
        last = rig.run(0.2)[-1].joint_velocity[:, DRIVE]
    lost = 20.0 - last
    assert lost[2] == pytest.approx(0.2 * 0.3 / DRIVE_INERTIA, rel=1e-3)
    assert np.abs(np.delete(lost, 2)).max() < 1e-6


def test_viscous_friction_slows_exponentially(plant_name):
    """0.2 %: an implicit first-order step of 1 ms at a time constant of 0.4 s."""
    viscous = 0.05
    with Rig(plant_name, {"name": "drive_viscous_friction", "viscous": viscous}, lifted=True) as rig:
        rig.spin(drive=10.0)
        rates = along(rig.run(0.5), "joint_velocity", 0, DRIVE)
    assert -math.log(rates[-1] / 10.0) / 0.5 == pytest.approx(viscous / DRIVE_INERTIA, rel=2e-3)


@pytest.mark.parametrize("speed", [0.3, 1.0, 2.0])
def test_stribeck_friction_fades_with_speed(plant_name, speed):
    """2 %: the speed changes a little while it is measured."""
    stribeck, width = 0.2, 1.0
    with Rig(
        plant_name, {"name": "drive_stribeck_friction", "stribeck": stribeck, "stribeck_speed": width}, lifted=True
    ) as rig:
        rig.spin(drive=speed)
        expected = -stribeck * math.exp(-((speed / width) ** 2)) / DRIVE_INERTIA
        assert drive_acceleration(rig, seconds=0.002) == pytest.approx(expected, rel=2e-2)


def test_steering_friction_slows_the_steering(plant_name):
    with Rig(plant_name, {"name": "steer_coulomb_friction", "coulomb": 0.1}, lifted=True) as rig:
        rig.spin(steer=10.0)
        rates = along(rig.run(0.2), "joint_velocity", 1, STEER)
    assert (10.0 - rates[-1]) / 0.2 == pytest.approx(0.1 / steer_inertia(), rel=2e-3)
    with Rig(plant_name, {"name": "steer_viscous_friction", "viscous": 0.05}, lifted=True) as rig:
        rig.spin(steer=5.0)
        rates = along(rig.run(0.3), "joint_velocity", 1, STEER)
    assert -math.log(rates[-1] / 5.0) / 0.3 == pytest.approx(0.05 / steer_inertia(), rel=3e-3)


def test_load_dependent_friction_takes_its_part_of_the_torque(plant_name):
    with Rig(plant_name, {"name": "load_dependent_friction", "fraction": 0.2}, lifted=True) as rig:
        rig.spin(drive=5.0)
        torque = np.tile([0.5, 0.0], (4, 1))
        assert drive_acceleration(rig, torque) == pytest.approx(0.8 * 0.5 / DRIVE_INERTIA, rel=2e-3)


def test_constant_load_pulls_at_rest_too(plant_name):
    with Rig(plant_name, {"name": "constant_load", "load": 0.4}, lifted=True) as rig:
        assert drive_acceleration(rig, seconds=0.1) == pytest.approx(-0.4 / DRIVE_INERTIA, rel=1e-6)


@pytest.mark.parametrize(("axis", "inertia"), [("drive", DRIVE_INERTIA), ("steer", None)])
def test_a_wrong_torque_constant_scales_the_torque_and_not_its_report(plant_name, axis, inertia):
    entry = {"name": "torque_constant_error", "error": -0.25, "axis": axis}
    column = ("drive", "steer").index(axis)
    torque = np.zeros((4, 2))
    torque[:, column] = 0.4
    with Rig(plant_name, entry, lifted=True) as rig:
        last = rig.run(0.05, torque)[-1]
    found = last.joint_velocity[0, column] / 0.05
    assert found == pytest.approx(0.75 * 0.4 / (inertia or steer_inertia()), rel=1e-4)
    np.testing.assert_array_equal(last.motor_torque, torque)


def test_cogging_has_its_order_and_size(plant_name):
    """Fourier coefficients of the torque over whole turns; 1 %: the wheel's speed ripples by 3 %."""
    order, cosine, sine = 8.0, 0.05, -0.02  # 8 periods per radian are 50.3 per turn
    entry = {"name": "motor_cogging", "cosine": cosine, "sine": sine, "order": order}
    with Rig(plant_name, entry, lifted=True) as rig:
        rig.spin(drive=3.0)
        states = rig.run(2.5)
    rate, angle = along(states, "joint_velocity", 0, DRIVE), along(states, "joint_position", 0, DRIVE)
    torque = DRIVE_INERTIA * np.gradient(rate, 1e-3)
    inside = angle < 2.0 * math.pi
    angle, torque = angle[inside], torque[inside]

    def coefficients(k):
        basis = np.column_stack([np.cos(k * angle), np.sin(k * angle), np.ones_like(angle)])
        return np.linalg.lstsq(basis, torque, rcond=None)[0][:2]

    np.testing.assert_allclose(coefficients(order), [cosine, sine], atol=0.01 * math.hypot(cosine, sine))
    for other in (order / 2, order - 3.0, order + 3.0, 2 * order):
        assert np.hypot(*coefficients(other)) < 0.05 * math.hypot(cosine, sine)


def test_what_a_motor_does_of_itself_reaches_both_joints_of_coupled_gears(plant_name):
    """A torque constant and a cogging are a motor's, whose angle and torque are those of neither joint; with gears uncoupled
    such robots had tenths of a drive's torque on their steerings that nothing explained.
    """
    coupling, angle, order = XR4000.gear_coupling[0], 0.4, 3.0
    assert coupling[DRIVE, STEER] == pytest.approx(-0.5)
    torque = np.tile([0.4, -0.1], (4, 1))
    motor = torque[0] @ np.linalg.inv(coupling)
    ripple = 0.3 * math.cos(order * float(coupling[DRIVE] @ [0.0, angle]))
    for entry, size in (
        ({"name": "torque_constant_error", "error": -0.25}, -0.25 * motor[DRIVE]),
        ({"name": "torque_constant_error", "error": 0.5, "axis": "steer"}, 0.5 * motor[STEER]),
        ({"name": "motor_cogging", "cosine": 0.3, "sine": 0.0, "order": order}, ripple),
    ):
        rates = []
        row = coupling[STEER if entry.get("axis") == "steer" else DRIVE]
        for entries, given in ([entry], torque), ([], torque + size * row):
            with Rig(plant_name, *entries, robot=XR4000, lifted=True, dt=1e-4) as rig:
                rig.spin(angle=angle)
                rates.append(rig.run(1e-4, given)[-1].joint_velocity)
        np.testing.assert_allclose(rates[0], rates[1], rtol=1e-3)
        assert np.abs(rates[0]).min() > 1e-4


def test_rolling_resistance_follows_the_load(plant_name):
    """Deceleration arm W / (r m_eff); 1 %."""
    arm = 2e-3
    with Rig(plant_name, {"name": "rolling_resistance", "arm": arm}) as rig:
        rig.roll(1.0)
        rig.run(0.2)
        speeds = along(rig.run(0.3), "twist", 0)
    assert (speeds[0] - speeds[-1]) / 0.299 == pytest.approx(arm * WEIGHT / RADIUS / ROLLING_MASS, rel=1e-2)


# --- Actuators and gears ---------------------------------------------------------------------------------------


def sine_response(plant_name, entry, frequency, dt=1e-3):
    """Return the complex ratio of motor torque to command at a frequency [Hz], from whole periods."""
    periods = 4
    with Rig(plant_name, entry, lifted=True, dt=dt) as rig:
        states = rig.run(
            (periods + 2) / frequency, lambda t: np.tile([0.3 * math.sin(math.tau * frequency * t), 0.0], (4, 1))
        )
    torque = along(states, "motor_torque", 0, DRIVE)
    count = round(periods / frequency / dt)
    # A torque reported after step k is that of the step, which began at k dt.
    time = np.arange(len(torque)) * dt
    wave = np.exp(-1j * math.tau * frequency * time[-count:])
    return 2.0 * np.mean(torque[-count:] * wave) / (0.3 / 1j)


@pytest.mark.parametrize("frequency", [5.0, 20.0])
def test_lag_has_the_gain_and_phase_of_a_first_order_low_pass(plant_name, frequency):
    """3 %: the torque of a step is that at its end, half a step ahead of the command that is held over it."""
    time_constant = 0.01
    found = sine_response(plant_name, {"name": "actuator_lag", "time_constant": time_constant}, frequency, 5e-4)
    expected = 1.0 / (1.0 + 1j * math.tau * frequency * time_constant)
    assert abs(found) == pytest.approx(abs(expected), rel=0.03)
    assert np.angle(found) == pytest.approx(np.angle(expected), abs=math.tau * frequency * 5e-4)


@pytest.mark.parametrize("delay", [0.0, 0.003, 0.0045])
def test_delay_turns_the_phase_and_keeps_the_gain(plant_name, delay):
    frequency = 10.0
    found = sine_response(plant_name, {"name": "actuator_delay", "delay": delay}, frequency)
    assert abs(found) == pytest.approx(1.0, rel=1e-3)
    assert np.angle(found) == pytest.approx(-math.tau * frequency * delay, abs=1e-3)


def test_delay_and_lag_act_one_after_the_other(plant_name):
    delay = {"name": "actuator_delay", "delay": 0.01}
    lag = {"name": "actuator_lag", "time_constant": 0.02}
    with Rig(plant_name, lag, delay, lifted=True) as rig:
        torque = along(rig.run(0.05, np.tile([1.0, 0.0], (4, 1))), "motor_torque", 2, DRIVE)
    assert np.all(torque[:10] == 0.0)
    time = 1e-3 * np.arange(1, 41)
    np.testing.assert_allclose(torque[10:], 1.0 - np.exp(-time / 0.02), atol=1e-9)


def test_saturation_is_a_wall_and_falls_with_speed(plant_name):
    """Driving: full up to the knee, half way to the no-load speed half; braking: full."""
    entry = {"name": "torque_saturation", "torque": 0.5, "knee_speed": 10.0, "no_load_speed": 30.0}
    with Rig(plant_name, entry, lifted=True) as rig:
        for speed, command, expected in (
            (0.0, 0.4, 0.4), (0.0, 2.0, 0.5), (0.0, -2.0, -0.5), (20.0, 2.0, 0.25), (20.0, 0.2, 0.2), (20.0, -2.0, -0.5),
            (-20.0, -2.0, -0.25), (40.0, 2.0, 0.0), (40.0, -2.0, -0.5),
        ):  # fmt: skip
            rig.spin(drive=speed)
            state = rig.run(0.001, np.tile([command, 0.0], (4, 1)))[-1]
            assert state.motor_torque[0, DRIVE] == pytest.approx(expected, abs=1e-9), (speed, command)


def test_an_elastic_gear_twists_by_torque_over_stiffness(plant_name):
    """The wheel is blocked by friction; 1 %."""
    elastic = {"name": "gear_elasticity", "stiffness": 400.0, "damping": 2.0}
    blocked = {"name": "drive_coulomb_friction", "coulomb": 1e3}
    with Rig(plant_name, elastic, blocked, lifted=True) as rig:
        state = rig.run(1.0, np.tile([6.0, 0.0], (4, 1)))[-1]
    twist = state.motor_position[:, DRIVE] - state.joint_position[:, DRIVE]
    np.testing.assert_allclose(twist, 6.0 / 400.0, rtol=1e-2)
    assert np.abs(state.joint_position[:, DRIVE]).max() < 1e-3


def test_motor_and_wheel_swing_against_each_other_at_their_frequency(plant_name):
    """Two inertias on a spring, f = sqrt(K (1/J + 1/I)) / (2 pi); 3 % with the damping of implicit steps of 0.1 ms."""
    rotor, wheel, stiffness = float(THESIS.armature[0, DRIVE, DRIVE]), THESIS.casters[0].wheel.inertia_axle, 100.0
    elastic = {"name": "gear_elasticity", "stiffness": stiffness, "damping": 0.0}
    with Rig(plant_name, elastic, lifted=True, dt=1e-4) as rig:
        rig.run(0.003, np.tile([3.0, 0.0], (4, 1)))
        states = rig.run(0.25)
    twist = along(states, "motor_position", 0, DRIVE) - along(states, "joint_position", 0, DRIVE)
    crossings = np.flatnonzero(np.diff(np.sign(twist)) != 0)
    period = 2.0 * (crossings[-1] - crossings[0]) / (len(crossings) - 1) * 1e-4
    assert 1.0 / period == pytest.approx(math.sqrt(stiffness * (1.0 / rotor + 1.0 / wheel)) / math.tau, rel=0.03)


@pytest.mark.parametrize("axis", ["drive", "steer"])
def test_backlash_is_a_dead_band_between_motor_and_joint(plant_name, axis):
    """Pushed one way and the other, motor and joint differ by the play, less the known twist of the teeth; 2 %."""
    play, stiffness = 0.01, 2e4
    column = ("drive", "steer").index(axis)
    entry = {"name": "gear_backlash", "play": play, "axis": axis, "tooth_stiffness": stiffness, "tooth_damping": 5.0}
    torque = np.zeros((4, 2))
    torque[:, column] = 0.2
    gaps = []
    with Rig(plant_name, entry, lifted=True) as rig:
        for sign in (1.0, -1.0, 1.0):
            state = rig.run(1.0, sign * torque)[-1]
            gaps.append(state.motor_position[0, column] - state.joint_position[0, column])
    teeth = 2.0 * 0.2 / stiffness
    assert gaps[0] - gaps[1] == pytest.approx(play, abs=0.02 * play + teeth)
    assert gaps[2] - gaps[1] == pytest.approx(play, abs=0.02 * play + teeth)


def test_a_gear_keeps_momentum(plant_name):
    """The impulse of the motor is in motor and wheel together, whatever the gear does; 0.1 %."""
    rotor, wheel = float(THESIS.armature[0, DRIVE, DRIVE]), THESIS.casters[0].wheel.inertia_axle
    entries = [{"name": "gear_backlash", "play": 0.02}, {"name": "gear_elasticity", "stiffness": 300.0}]
    with Rig(plant_name, *entries, lifted=True) as rig:
        state = rig.run(0.3, np.tile([0.5, 0.0], (4, 1)))[-1]
    found = rotor * state.motor_velocity[0, DRIVE] + wheel * state.joint_velocity[0, DRIVE]
    assert found == pytest.approx(0.5 * 0.3, rel=1e-3)


def test_gears_without_a_rotor_are_refused(plant_name):
    light = dataclasses.replace(
        THESIS, casters=tuple(dataclasses.replace(c, rotors=dataclasses.replace(c.rotors, drive=0.0)) for c in THESIS.casters)
    )
    with pytest.raises(PlantError, match=r"gear_backlash .* casters\[0\].rotors.drive above 0"):
        Rig(plant_name, {"name": "gear_backlash", "play": 0.01}, robot=light)


# --- Wheels and ground -----------------------------------------------------------------------------------------


def rolling_radius(rig, speed=0.5, radius=RADIUS):
    """Return the distance that the robot rolls per radian of its wheels, freely."""
    rig.roll(speed, radius)
    rig.run(0.3)
    states = rig.run(0.5)
    way = states[-1].pose[0] - states[0].pose[0]
    return way / (states[-1].joint_position[0, DRIVE] - states[0].joint_position[0, DRIVE])


def test_a_wheel_of_another_radius_rolls_another_way(plant_name):
    with Rig(plant_name, {"name": "wheel_radius_error", "error": 1.5e-3}) as rig:
        assert rolling_radius(rig) == pytest.approx(RADIUS + 1.5e-3, rel=1e-5)


def test_a_loaded_tyre_rolls_on_a_smaller_radius(plant_name):
    stiffness = 1e5
    entry = {"name": "tyre_radial_compliance", "stiffness": stiffness, "load": 100.0}
    with Rig(plant_name, entry) as rig:
        found = rolling_radius(rig) - RADIUS
        load = rig.plant.state().normal_force[0]
    assert found == pytest.approx(-(load - 100.0) / (3.0 * stiffness), rel=0.02)


@pytest.mark.parametrize("error", [-0.075, -0.2])
def test_a_radius_of_nothing_is_refused(plant_name, error):
    with pytest.raises(PlantError, match=r"physics\[0\]: wheel_radius_error (leaves a wheel|makes a robot that)"):
        Rig(plant_name, {"name": "wheel_radius_error", "error": error})


def test_an_eccentric_wheel_goes_fast_and_slow_once_per_turn(plant_name):
    """v / rho_dot = r + e cos(rho + phase), at creep speed; 3 % of e."""
    eccentricity, phase = 1e-3, 0.7
    entry = {"name": "wheel_eccentricity", "eccentricity": eccentricity, "phase": phase}
    with Rig(plant_name, entry) as rig:
        # Driven, because the weight rolls an eccentric wheel to its lowest point.
        rig.roll(0.1)
        target = 0.1 / RADIUS

        def hold(_):
            rate = rig.plant.state().joint_velocity[:, DRIVE]
            return np.column_stack([0.5 * (target - rate), np.zeros(4)])

        rig.run(0.5, hold, hold_heading=True)
        states = rig.run(5.0, hold, hold_heading=True)
    angle, rate = along(states, "joint_position", 0, DRIVE), along(states, "joint_velocity", 0, DRIVE)
    radius = along(states, "twist", 0) / rate
    basis = np.column_stack([np.cos(angle + phase), np.sin(angle + phase), np.ones_like(angle)])
    cosine, sine, mean = np.linalg.lstsq(basis, radius, rcond=None)[0]
    assert cosine == pytest.approx(eccentricity, rel=0.03)
    assert abs(sine) < 0.05 * eccentricity
    assert mean == pytest.approx(RADIUS, rel=1e-3)


def test_an_eccentric_wheel_has_to_be_lifted_over_its_top(plant_name):
    """The weight turns it with the torque F_z e sin(rho + phase), the slope of the potential F_z e cos(rho + phase)."""
    eccentricity = 2e-3
    entry = {"name": "wheel_eccentricity", "eccentricity": eccentricity, "phase": math.pi / 2.0}
    with Rig(plant_name, entry) as rig:
        rig.roll(0.0)
        speeds = along(rig.run(0.2), "twist", 0)
    # Behind the spring of the tyre the robot starts with a swing; 3 %.
    assert (speeds[199] - speeds[99]) / 0.1 == pytest.approx(WEIGHT * eccentricity / RADIUS / ROLLING_MASS, rel=0.03)


def test_another_caster_offset_is_where_the_wheel_rolls_sideways_without_slip(plant_name):
    """Sliding sideways at v_y, a wheel with b_x + x has no lateral slip if phi_dot = -v_y / (b_x + x)."""
    change, speed = -0.012, 0.2
    b = float(THESIS.caster_offset[0, 0])
    slips = []
    for entries in ([], [{"name": "caster_offset_error", "x": change}]):
        with Rig(plant_name, *entries) as rig:
            rates = np.tile([0.0, -speed / (b + change)], (4, 1))
            rig.plant.set_motion(np.array([0.0, speed, 0.0]), ZERO, rates)
            slips.append(np.abs(rig.run(0.001)[-1].slip[:, 1]).max())
    expected = speed * abs(1.0 - b / (b + change))
    assert slips[0] == pytest.approx(expected, rel=0.1)
    assert slips[1] < 0.03 * expected


def steady_traction(rig, torque=1.0):
    """Return friction coefficient over slip ratio of a wheel that accelerates gently."""
    rig.roll(1.0)
    state = rig.run(0.4, np.tile([torque, 0.0], (4, 1)), hold_heading=True)[-1]
    ratio = state.slip[0, 0] / (RADIUS * state.joint_velocity[0, DRIVE])
    return state.contact_force[0, 0] / state.normal_force[0] / ratio


def test_a_stiffer_tyre_slips_less_along(plant_name):
    """mu / lambda = 2 mu_p / lambda_p (1 + error) at small slip; 1 %."""
    slope = 2.0 * THESIS.contact.mu_p / THESIS.contact.lambda_p
    with Rig(plant_name, {"name": "tyre_longitudinal_stiffness", "error": 0.5}) as rig:
        assert steady_traction(rig) == pytest.approx(1.5 * slope, rel=0.01)
    with Rig(plant_name, {"name": "tyre_lateral_stiffness", "error": 0.5}) as rig:
        assert steady_traction(rig) == pytest.approx(slope, rel=0.01)


def test_a_stiffer_tyre_slips_less_across(plant_name):
    """A steady side force by a slope across the way; 2 %."""
    slope = 2.0 * THESIS.contact.lateral.mu_p / THESIS.contact.lateral.lambda_p
    across = {"name": "ground_slope", "angle": 0.02, "direction": math.pi / 2.0}
    for name, factor in (("tyre_lateral_stiffness", 1.5), ("tyre_longitudinal_stiffness", 1.0)):
        with Rig(plant_name, across, {"name": name, "error": 0.5}) as rig:
            rig.roll(1.0)
            state = rig.run(0.5, ZERO, hold_heading=True)[-1]
        angle = state.slip[:, 1] / (RADIUS * state.joint_velocity[:, DRIVE])
        found = state.contact_force[:, 1].sum() / state.normal_force.sum() / angle.mean()
        assert found == pytest.approx(factor * slope, rel=0.02)
        assert state.contact_force[:, 1].sum() == pytest.approx(-WEIGHT * math.sin(0.02), rel=0.02)


def test_relaxation_is_a_distance(plant_name):
    """A wheel that starts to slip at constant speed: its force reaches 1 - exp(-x / L); 3 %."""
    length = 0.2
    # Rotors so heavy that no force changes the slip within a step.
    flywheels = tuple(dataclasses.replace(c, rotors=dataclasses.replace(c.rotors, drive=1.0)) for c in THESIS.casters)
    robot = dataclasses.replace(THESIS, casters=flywheels)
    with Rig(plant_name, {"name": "tyre_relaxation", "length": length}, robot=robot, dt=2.5e-4) as rig:
        speed, slip = 1.0, 1e-3
        heavy_hand = np.tile([(speed + slip) / RADIUS, 0.0], (4, 1))
        forces, way = [], []
        for k in range(1200):
            # The motion is kept: what is measured is the tyre.
            position = np.column_stack([np.full(4, heavy_hand[0, 0] * k * 2.5e-4), np.zeros(4)])
            rig.plant.set_motion(np.array([speed, 0.0, 0.0]), position, heavy_hand)
            state = rig.run(2.5e-4)[-1]
            forces.append(state.contact_force[0, 0] / state.normal_force[0])
            way.append(speed * (k + 1) * 2.5e-4)
    forces, way = np.array(forces), np.array(way)
    final = forces[-1] / (1.0 - math.exp(-way[-1] / length))
    for distance in (0.1, 0.2):
        k = int(np.searchsorted(way, distance - 1e-9))
        # The bristles' damping (2 ms) makes it 2 ms ahead.
        assert forces[k] / final == pytest.approx(1.0 - math.exp(-(distance + 0.002) / length), rel=0.03)


def test_scrub_brakes_a_turn_on_the_spot(plant_name):
    """Each patch resists with mu F_z R s / sqrt(1 + s^2), s = sigma R / V / lambda_p; 10 %."""
    omega, patch = 1.0, 0.02
    accelerations = []
    for entries in ([], [{"name": "scrub_torque", "radius": patch}]):
        with Rig(plant_name, *entries) as rig:
            headings = rig.turn(omega)
            states = rig.run(0.05)
            accelerations.append((states[-1].twist[2] - states[9].twist[2]) / 0.040)
            reach = states[0].joint_velocity[0, DRIVE] * RADIUS / omega
    slip = omega * patch / (omega * reach) / THESIS.contact.lambda_p
    torque = THESIS.contact.mu_p * WEIGHT * patch * slip / math.sqrt(1.0 + slip**2)
    inertia = turning_inertia(headings)
    # Turning the fork about the contact pulls at the steering as well: the headings give way a little.
    assert accelerations[1] - accelerations[0] == pytest.approx(-torque / inertia, rel=0.1)


def test_on_a_patch_friction_is_less_and_beside_it_is_not(plant_name):
    """A wheel that spins reaches factor mu_p at the most, the others mu_p; 2 %."""
    x, y = THESIS.steer_axis[0] + [THESIS.caster_offset[0, 0], 0.0]
    patch = {"name": "low_friction_patch", "factor": 0.4, "x": x, "y": y, "length": 0.3, "width": 0.1, "roundness": 0.0}
    strong = dataclasses.replace(
        THESIS,
        casters=tuple(
            dataclasses.replace(c, limits=dataclasses.replace(c.limits, drive_torque=100.0)) for c in THESIS.casters
        ),
    )
    with Rig(plant_name, patch, robot=strong) as rig:
        # Just above what each wheel can hold, so that it passes its peak slowly; two pull against two.
        load = rig.run(0.001)[-1].normal_force
        torque = np.zeros((4, 2))
        torque[:, DRIVE] = 1.03 * THESIS.contact.mu_p * load * RADIUS * [0.4, -1.0, -1.0, 1.0]
        states = rig.run(0.3, torque, hold_heading=True)
    use = np.array([np.abs(state.contact_force[:, 0]) / state.normal_force for state in states]).max(axis=0)
    mu = THESIS.contact.mu_p
    assert use[0] == pytest.approx(0.4 * mu, rel=0.02)
    np.testing.assert_allclose(use[1:], mu, rtol=0.03)


@pytest.mark.parametrize(("roundness", "corner"), [(0.0, 0.5), (1.0, 1.0)])
def test_a_patch_has_its_place_and_shape(roundness, corner):
    """Inside, outside, turned, and at a corner that only the rectangle has."""
    effect = all_effects()["low_friction_patch"]
    numbers = effect.values(
        {"factor": 0.5, "x": 1.0, "y": 2.0, "length": 0.8, "width": 0.4, "yaw": math.pi / 2, "roundness": roundness}
    )

    def friction(x, y):
        result = np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0])
        effect.contact(np.array([0.0, x, y, 0.0, 100.0]), numbers, result)
        return result[0]

    assert friction(1.0, 2.0) == 0.5
    assert friction(1.0, 2.38) == 0.5 and friction(1.18, 2.0) == 0.5
    assert friction(1.0, 2.42) == 1.0 and friction(1.22, 2.0) == 1.0
    assert friction(1.17, 2.36) == pytest.approx(corner)


# --- Load, slope, unevenness -----------------------------------------------------------------------------------


def test_a_payload_weighs_where_it_lies(plant_name):
    mass, x, y = 12.0, 0.1, -0.05
    with Rig(plant_name, {"name": "payload_mass", "mass": mass, "x": x, "y": y, "z": 0.3}) as rig:
        forces = rig.run(0.5, hold_heading=True)[-1].normal_force
    with Rig(plant_name) as rig:
        nominal = rig.run(0.5, hold_heading=True)[-1].normal_force
    places = THESIS.steer_axis + THESIS.caster_offset
    more = forces - nominal
    assert more.sum() == pytest.approx(mass * GRAVITY, rel=5e-3)
    np.testing.assert_allclose(places.T @ more, mass * GRAVITY * np.array([x, y]), atol=0.02 * mass * GRAVITY * 0.1)


def test_a_displaced_mass_loads_the_wheels_on_its_side(plant_name):
    x, y = 0.05, 0.03
    with Rig(plant_name, {"name": "payload_offset", "x": x, "y": y, "z": 0.0}) as rig:
        forces = rig.run(0.5, hold_heading=True)[-1].normal_force
    with Rig(plant_name) as rig:
        nominal = rig.run(0.5, hold_heading=True)[-1].normal_force
    moment = (THESIS.steer_axis + THESIS.caster_offset).T @ (forces - nominal)
    np.testing.assert_allclose(moment, THESIS.chassis.mass * GRAVITY * np.array([x, y]), rtol=0.02)
    assert forces.sum() == pytest.approx(nominal.sum(), rel=1e-3)


@pytest.mark.parametrize("direction", [0.0, math.pi])
def test_a_robot_rolls_down_a_slope(plant_name, direction):
    """Acceleration m g sin(angle) / m_eff, weight m g cos(angle), and load transfer to the lower wheels; 1 %."""
    angle = 0.1
    with Rig(plant_name, {"name": "ground_slope", "angle": angle, "direction": direction}) as rig:
        rig.roll(0.0)
        rig.run(0.3, hold_heading=True)
        states = rig.run(0.2, hold_heading=True)
    found = (states[-1].twist[0] - states[0].twist[0]) / 0.199
    expected = math.copysign(WEIGHT * math.sin(angle) / ROLLING_MASS, math.cos(direction))
    assert found == pytest.approx(expected, rel=0.01)
    assert states[-1].normal_force.sum() == pytest.approx(WEIGHT * math.cos(angle), rel=0.01)
    # Rolling freely, only what accelerates the wheels' spin goes through the ground: the centre of mass hardly tilts it.
    # On the springs of a plant in space it stands askew by less than a milliradian.
    askew = 1e-9 if plant_name == "reduced" else 1e-3 * GRAVITY
    np.testing.assert_allclose(states[-1].gravity[:2], [GRAVITY * math.sin(angle) * math.cos(direction), 0.0], atol=askew)


def test_a_braked_robot_on_a_slope_stands_on_its_lower_wheels(plant_name):
    """Moment of the weight about the contact line: W sin(angle) h = sum F_z x; 3 %."""
    angle = 0.15
    slope = {"name": "ground_slope", "angle": angle, "direction": 0.0}
    brake = {"name": "drive_coulomb_friction", "coulomb": 200.0}
    with Rig(plant_name, slope, brake) as rig:
        forces = rig.run(0.8, hold_heading=True)[-1].normal_force
    with Rig(plant_name, brake) as rig:
        level = rig.run(0.8, hold_heading=True)[-1].normal_force
    places = THESIS.steer_axis[:, 0] + THESIS.caster_offset[:, 0]
    mass = THESIS.chassis.mass
    height = (mass * THESIS.chassis.com[2] + (THESIS.total_mass - mass) * RADIUS) / THESIS.total_mass
    moment = places @ (forces - level * math.cos(angle))
    assert moment == pytest.approx(WEIGHT * math.sin(angle) * height, rel=0.03)


def test_a_long_wave_is_a_slope(plant_name):
    """On the flank of a wave of 100 m the robot rolls down as on a plane; 3 %."""
    amplitude, wavelength = 0.1, 100.0
    slope = amplitude * math.tau / wavelength
    with Rig(plant_name, {"name": "uneven_ground", "amplitude": amplitude, "wavelength": wavelength}) as rig:
        rig.roll(0.0)
        rig.run(0.3, hold_heading=True)
        states = rig.run(0.4, hold_heading=True)
    found = (states[-1].twist[0] - states[0].twist[0]) / 0.399
    assert found == pytest.approx(-WEIGHT * slope / ROLLING_MASS, rel=0.03)


def test_on_uneven_ground_the_higher_wheels_carry_more(plant_name):
    """Four equal springs under a rigid body: a twist w of the ground moves w k / 4 from one diagonal to the other; 3 %."""
    amplitude = 2e-4
    wave = {"name": "uneven_ground", "amplitude": amplitude, "wavelength": 1.0}
    brake = {"name": "drive_coulomb_friction", "coulomb": 200.0}
    with Rig(plant_name, wave, brake, pose=UNEVEN_PLACE) as rig:
        state = rig.run(1.0, hold_heading=True)[-1]
    places = THESIS.steer_axis + THESIS.caster_offset
    effect = all_effects()["uneven_ground"]
    numbers = effect.values({"amplitude": amplitude, "wavelength": 1.0})
    heights = []
    for x, y in places + UNEVEN_PLACE[:2]:
        result = np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0])
        effect.contact(np.array([0.0, x, y, 0.0, 0.0]), numbers, result)
        heights.append(result[3])
    basis = np.column_stack([np.ones(4), places])
    warp = np.array(heights) - basis @ np.linalg.lstsq(basis, np.array(heights), rcond=None)[0]
    assert np.abs(warp).max() > 0.3 * amplitude, "the wave must twist the ground under the wheels"
    even = basis @ np.linalg.lstsq(basis, state.normal_force, rcond=None)[0]
    np.testing.assert_allclose(state.normal_force - even, THESIS.wheel_suspension.stiffness * warp, rtol=0.03, atol=0.3)


def test_a_wheel_that_would_pull_is_off_the_ground(plant_name):
    """Three wheels stand, as a tripod: their loads follow from statics alone; 3 %."""
    far = {"name": "payload_offset", "x": 0.1, "y": 0.1, "z": 0.0}
    wave = {"name": "uneven_ground", "amplitude": 4e-3, "wavelength": 1.0}
    brake = {"name": "drive_coulomb_friction", "coulomb": 200.0}
    with Rig(plant_name, far, wave, brake, pose=UNEVEN_PLACE) as rig:
        forces = rig.run(1.5, hold_heading=True)[-1].normal_force
    standing = forces > 1.0
    assert standing.sum() == 3 and np.all(forces >= 0.0)
    assert forces.sum() == pytest.approx(WEIGHT, rel=0.03)


# --- Forces on the chassis -------------------------------------------------------------------------------------


def test_drag_grows_with_the_square_of_the_speed(plant_name):
    for speed in (0.5, 1.5):
        with Rig(plant_name, {"name": "aerodynamic_drag", "coefficient": 4.0}) as rig:
            rig.roll(speed)
            rig.run(0.1)
            states = rig.run(0.1)
        middle = 0.5 * (states[0].twist[0] + states[-1].twist[0])
        found = (states[0].twist[0] - states[-1].twist[0]) / 0.099
        assert found == pytest.approx(4.0 * middle**2 / ROLLING_MASS, rel=0.01)


def test_a_push_begins_and_ends(plant_name):
    """The impulse is force times duration over m_eff; nothing before and after; 1 %."""
    push = {"name": "external_push", "force_x": 30.0, "start": 0.3, "duration": 0.2, "z": 0.1}
    with Rig(plant_name, push) as rig:
        rig.roll(0.0)
        speeds = along(rig.run(0.8, hold_heading=True), "twist", 0)
    assert abs(speeds[298]) < 1e-6
    gained = 30.0 * 0.2 / ROLLING_MASS
    assert speeds[-1] == pytest.approx(gained, rel=0.01)
    assert speeds[560] == pytest.approx(gained, rel=0.02)


def test_a_push_beside_the_middle_turns_the_robot(plant_name):
    push = {"name": "external_push", "force_x": 0.0, "force_y": 10.0, "start": 0.0, "duration": 1.0, "x": 0.2}
    with Rig(plant_name, push) as rig:
        headings = rig.turn(1e-9)
        omega = rig.run(0.02)[-1].twist[2]
    torque = 10.0 * (0.2 - 0.0)
    # The wheels of a robot that turns on the spot roll freely; sideways they hold: about the middle only the moment acts.
    assert omega / 0.02 == pytest.approx(torque / turning_inertia(headings), rel=0.15)


# --- Sensors ---------------------------------------------------------------------------------------------------


def readings(plant_name, *entries, kind, seconds=0.3):
    """Return (truth, reading) pairs of one sensor of a robot that drives a curve, noise off."""
    sensors = THESIS.sensors
    quiet = dataclasses.replace(
        sensors,
        encoders=dataclasses.replace(
            sensors.encoders, velocity_noise=0.0, torque_noise=0.0, drive_counts=1e7, steer_counts=1e7
        ),
        imu=dataclasses.replace(sensors.imu, gyro_noise=0.0, accelerometer_noise=0.0),
    )
    robot = dataclasses.replace(THESIS, sensors=quiet)
    with Rig(plant_name, *entries, robot=robot) as rig:
        simulated = SimulatedRobot(rig.plant)
        rig.turn(1.0)
        pairs = []
        while simulated.time_ns < seconds * 1e9:
            for sample in simulated.advance():
                if isinstance(sample.reading, kind):
                    pairs.append((rig.plant.state(), sample.reading))
    return pairs


def test_imu_bias_and_scale_act_on_the_reading(plant_name):
    bias = {"name": "imu_bias", "gyro": 0.05, "accelerometer_x": 0.3, "accelerometer_y": -0.2}
    for truth, reading in readings(plant_name, bias, kind=ImuReading):
        assert reading.angular_velocity[2] == pytest.approx(truth.twist[2] + 0.05, abs=1e-12)
    plain = readings(plant_name, kind=ImuReading)[-1][1]
    biased = readings(plant_name, bias, kind=ImuReading)[-1][1]
    np.testing.assert_allclose(biased.linear_acceleration - plain.linear_acceleration, [0.3, -0.2, 0.0], atol=1e-9)
    scale = {"name": "imu_scale", "gyro": 0.1, "accelerometer_x": -0.2, "accelerometer_y": 0.3}
    scaled = readings(plant_name, scale, kind=ImuReading)[-1][1]
    assert scaled.angular_velocity[2] == pytest.approx(1.1 * plain.angular_velocity[2], rel=1e-9)
    np.testing.assert_allclose(
        scaled.linear_acceleration, plain.linear_acceleration * [0.8, 1.3, 1.0], rtol=1e-9, atol=1e-12
    )


def test_a_displaced_imu_feels_another_centripetal_acceleration(plant_name):
    x, y = 0.1, -0.06
    moved = readings(plant_name, {"name": "imu_lever_arm", "x": x, "y": y}, kind=ImuReading)
    plain = readings(plant_name, kind=ImuReading)
    for (truth, reading), (_, nominal) in zip(moved[5:], plain[5:], strict=True):
        omega, alpha = truth.twist[2], truth.acceleration[2]
        roll, pitch = truth.swing_acceleration
        expected = [-alpha * y - omega**2 * x, alpha * x - omega**2 * y, roll * y - pitch * x]
        np.testing.assert_allclose(reading.linear_acceleration - nominal.linear_acceleration, expected, atol=1e-9)


def test_an_accelerometer_on_a_slope_reads_the_pull(plant_name):
    """At rest, an accelerometer reads minus gravity, along the floor too."""
    slope = {"name": "ground_slope", "angle": 0.1, "direction": 0.0}
    brake = {"name": "drive_coulomb_friction", "coulomb": 200.0}
    with Rig(plant_name, slope, brake) as rig:
        simulated = SimulatedRobot(rig.plant)
        found = []
        while simulated.time_ns < 1.0e9:
            for sample in simulated.advance():
                if isinstance(sample.reading, ImuReading) and sample.time_ns > 0.5e9:
                    found.append(sample.reading.linear_acceleration)
    expected = [-GRAVITY * math.sin(0.1), 0.0, GRAVITY * math.cos(0.1)]
    np.testing.assert_allclose(np.mean(found, axis=0), expected, atol=0.02)


def test_a_steering_zero_is_off_in_the_reading_alone(plant_name):
    entry = {"name": "steer_zero_offset", "offset": 0.03, "target": ["front_right"]}
    for truth, reading in readings(plant_name, entry, kind=JointReading)[1:]:
        np.testing.assert_allclose(reading.position - truth.joint_position, [[0, 0], [0, 0.03], [0, 0], [0, 0]], atol=1e-6)


def test_an_eccentric_encoder_swings_around_the_angle(plant_name):
    entry = {"name": "encoder_eccentricity", "amplitude": 0.02, "phase": 0.4, "axis": "drive"}
    pairs = readings(plant_name, entry, kind=JointReading)
    angles = np.array([truth.joint_position[:, DRIVE] for truth, _ in pairs])
    errors = np.array([reading.position[:, DRIVE] for _, reading in pairs]) - angles
    np.testing.assert_allclose(errors, 0.02 * np.sin(angles + 0.4), atol=1e-6)
    reported = np.array([reading.position for _, reading in pairs])[:, 0, DRIVE]
    rates = np.array([reading.velocity for _, reading in pairs])[:, 0, DRIVE]
    np.testing.assert_allclose(np.gradient(reported, 0.002)[2:-2], rates[2:-2], rtol=0.01, atol=0.02)


def test_stamps_of_another_clock_are_shifted_and_nothing_else(plant_name, tmp_path):
    """A recorded run with shifted clocks has the same readings, each topic's stamps off by its clock."""
    recordings = []
    for name, physics in (
        ("plain", []),
        ("shifted", [{"name": "clock_offset", "offset": 0.0125, "tracker_offset": -0.05}]),
    ):
        robot = dataclasses.replace(THESIS, physics=read_physics(physics, THESIS.caster_names))
        record_run(robot, lambda t: np.array([0.3, 0.0, 0.5 * t]), 0.5, 3, tmp_path / name, plant_name)
        recordings.append(Recording.open(tmp_path / name, THESIS))
    plain, shifted = recordings
    np.testing.assert_allclose(shifted.imu.stamp - plain.imu.stamp, 0.0125, atol=1e-6)
    np.testing.assert_allclose(shifted.ground_truth.stamp - plain.ground_truth.stamp, -0.05, atol=1e-6)
    np.testing.assert_array_equal(shifted.joint_states.stamp, plain.joint_states.stamp)
    np.testing.assert_array_equal(shifted.joint_states.position, plain.joint_states.position)
    np.testing.assert_array_equal(shifted.imu.gyro, plain.imu.gyro)
