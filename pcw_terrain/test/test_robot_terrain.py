"""The estimators of a whole robot, the slips that count, and the increments that make a wheel slip."""

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize

from pcw_description import load_robot
from pcw_description.differential_kinematics import joint_matrix, wheel_jacobian
from pcw_description.robot_description import DRIVE, STEER
from pcw_terrain import (
    ActiveIdentification,
    ActiveMeasurement,
    ActiveParameters,
    ActiveRecord,
    Phase,
    Refusal,
    RobotReading,
    RobotTerrain,
    TerrainError,
)
from pcw_terrain.believed_slip import independent_slip

THESIS = load_robot("thesis")
NAMES = ("thesis", "tidybot2", "xr4000", "dyros_pcv", "flow_base")


def friction(slip, mu_p, lambda_p):
    return 2.0 * mu_p * lambda_p * slip / (lambda_p**2 + slip**2)


def drive(terrain, grounds, seconds=6.0, direction=(1.0, 0.0)):
    """Step a robot whose casters all slip to and fro, each on its own ground (mu_p, lambda_p), without noise."""
    n, dt, state = terrain.n, 0.002, terrain.initial_state()
    along = np.array(direction)
    for k in range(round(seconds / dt)):
        slip = np.array([lambda_p for _, lambda_p in grounds]) * (1.0 - math.cos(4.0 * k * dt)) * 0.8
        force = np.zeros((n, 2))
        for _ in range(3):  # loads and forces depend on each other
            loads = terrain.normal_force(np.zeros(n), force)
            force = np.array([friction(s, *g) for s, g in zip(slip, grounds, strict=True)])[:, None] * loads[:, None] * along
        velocity = 0.8
        rolling = velocity / (1.0 - slip * along[0])
        sensed = np.column_stack([rolling, np.zeros(n)])
        slips = np.column_stack([rolling - velocity, slip * along[1] * rolling])
        state, estimate = terrain.step(state, RobotReading(sensed, slips, force, np.zeros(n)), dt)
    return state, estimate


def rigid(robot):
    """Return the robot with tyres that do not relax, as the readings above do not."""
    contact = dataclasses.replace(robot.contact, relaxation_length=1e-6)
    return dataclasses.replace(robot, contact=contact)


def test_every_caster_finds_its_own_ground():
    grounds = [(0.8, 0.1), (0.3, 0.06), (0.8, 0.1), (0.5, 0.2)]
    _, found = drive(RobotTerrain(rigid(THESIS)), grounds)
    assert found.valid.all() and not found.uniform and found.felt_now.dtype == bool
    np.testing.assert_allclose(found.mu_p, [mu for mu, _ in grounds], rtol=0.01)
    np.testing.assert_allclose(found.lambda_p, [slip for _, slip in grounds], rtol=0.02)


def test_on_one_ground_the_robot_knows_it_better_than_a_caster():
    _, found = drive(RobotTerrain(rigid(THESIS)), 4 * [(0.6, 0.12)])
    assert found.uniform
    np.testing.assert_allclose(found.robot, [0.6, 0.12], rtol=0.01)
    assert found.robot_covariance[0, 0] < 0.3 * found.covariance[:, 0, 0].max()


def test_slip_across_is_slip_too():
    """Along and across in one ellipse: at 45 degrees the same ground is found."""
    _, found = drive(RobotTerrain(rigid(THESIS)), 4 * [(0.6, 0.12)], direction=(math.sqrt(0.5), math.sqrt(0.5)))
    np.testing.assert_allclose(found.robot, [0.6, 0.12], rtol=0.03)


def test_a_caster_whose_slip_is_not_known_by_itself_says_nothing():
    terrain = RobotTerrain(THESIS)
    state, steady = terrain.initial_state(), np.zeros(4)
    reading = RobotReading(
        np.full((4, 2), 0.5), np.full((4, 2), 0.05), np.full((4, 2), 50.0), steady, np.array([1, 0, 0, 0], bool)
    )
    for _ in range(500):
        state, found = terrain.step(state, reading, 0.002)
    assert np.isfinite(found.mu_p[1:]).sum() == 0 and found.slip[0] > 0.0 and (found.slip[1:] == 0.0).all()


def test_loads_carry_the_weight_and_follow_the_push():
    terrain = RobotTerrain(THESIS)
    still = terrain.normal_force(np.zeros(4), np.zeros((4, 2)))
    pushed = terrain.normal_force(np.zeros(4), np.tile([50.0, 0.0], (4, 1)))
    assert still.sum() == pytest.approx(THESIS.total_mass * 9.81) and pushed.sum() == pytest.approx(still.sum())
    assert (pushed[:2] < still[:2]).all() and (pushed[2:] > still[2:]).all()  # forwards: the rear carries more


def test_what_turns_the_wheels_themselves_does_not_shift_the_loads():
    """Wheels that spin up without holding anything: the whole torque was taken for a push, and mu_p was off by a tenth."""
    terrain, n, dt, acceleration = RobotTerrain(THESIS), THESIS.n, 0.002, 40.0
    still = terrain.normal_force(np.zeros(n), np.zeros((n, 2)))
    inertia = [c.wheel.inertia_axle + THESIS.armature[i, DRIVE, DRIVE] for i, c in enumerate(THESIS.casters)]
    state, velocity, effort = terrain.initial_state(), np.zeros((n, 2)), np.zeros((n, 2))
    effort[:, DRIVE] = np.array(inertia) * acceleration / THESIS.wheel_radius
    pushed = terrain.normal_force(np.zeros(n), np.column_stack([effort[:, DRIVE] / THESIS.wheel_radius, np.zeros(n)]))
    for k in range(100):
        velocity[:, DRIVE] = acceleration * k * dt / THESIS.wheel_radius
        state, found = terrain.step_with_twist(state, np.zeros((n, 2)), velocity, effort, np.zeros(3), dt)
    assert np.abs(pushed - still).max() > 0.1 * still.mean()
    np.testing.assert_allclose(found.normal_force, still, rtol=0.01)


def test_a_robot_reading_that_is_not_finite_or_of_a_wrong_shape_is_refused():
    terrain, good = RobotTerrain(THESIS), np.zeros((4, 2))
    state = terrain.initial_state()
    for bad in (np.zeros((3, 2)), np.full((4, 2), np.nan)):
        with pytest.raises(TerrainError, match="force"):
            terrain.step(state, RobotReading(good, good, bad, np.zeros(4)), 0.002)
        with pytest.raises(TerrainError, match="effort"):
            terrain.step_with_twist(state, good, good, bad, np.zeros(3), 0.002)
    with pytest.raises(TerrainError, match="dt"):
        terrain.step(state, RobotReading(good, good, good, np.zeros(4)), 0.0)


def test_slip_that_an_observer_takes_from_the_force_itself_is_no_evidence():
    """Below its believed peak a wheel's slip is the believed root; past it, or near the peak, it is known otherwise."""
    loads, force, slip = np.full(4, 200.0), np.zeros((4, 2)), np.zeros((4, 2))
    sensed = np.full((4, 2), [1.0, 0.0])
    force[:, 0] = [80.0, 80.0, 150.0, 80.0]
    slip[:, 0] = [0.027, 0.4, 0.08, 0.12]
    np.testing.assert_array_equal(independent_slip(THESIS, sensed, slip, force, loads), [False, True, True, True])
    assert not independent_slip(THESIS, sensed, slip, force, np.zeros(4)).any()


# --- Slip on purpose --------------------------------------------------------------------------------------


def steady(robot, speed=0.3, heading=0.0, **changes):
    """Return what is measured of a robot that rolls along without slip or force."""
    steer = np.full(robot.n, heading)
    position, velocity = np.zeros((robot.n, 2)), np.zeros((robot.n, 2))
    position[:, STEER] = steer
    velocity[:, DRIVE] = speed / robot.wheel_radius
    velocity = np.einsum("nij,nj->ni", _rolling(robot), np.column_stack([np.full(robot.n, speed), np.zeros(robot.n)]))
    values = {
        "position": position, "velocity": velocity, "force": np.zeros((robot.n, 2)),
        "controller_torque": np.zeros((robot.n, 2)), "normal_force": np.full(robot.n, robot.total_mass * 9.81 / robot.n),
        "known": np.zeros(robot.n, bool), "mu_p": np.full(robot.n, 0.3), "lambda_p": np.full(robot.n, 0.1),
    }  # fmt: skip
    return ActiveMeasurement(**(values | changes))


def _rolling(robot):
    B = joint_matrix(robot)
    return np.stack([np.linalg.inv(B[2 * i : 2 * i + 2, 2 * i : 2 * i + 2]) for i in range(robot.n)])


def slipping(active, measurement):
    """Return state and output some cycles after a wheel was let go."""
    state = active.request(active.initial_state())
    for _ in range(200):
        state, output = active.step(state, measurement, 0.002)
        if state.phase is Phase.SLIP and state.elapsed > 0.1:
            break
    assert state.phase is Phase.SLIP
    return state, output


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("heading", [0.0, 0.9])
def test_the_increment_is_internal(name, heading):
    """A^T dF = 0 to rounding, and the torques are those of dF: nothing of it moves the robot."""
    robot = load_robot(name)
    force = np.zeros((robot.n, 2))
    force[0] = 20.0, 3.0
    measured = steady(robot, heading=heading, force=force, mu_p=np.full(robot.n, 0.06))
    active = ActiveIdentification(robot)
    _, output = slipping(active, measured)
    assert output.testing == 0 and np.abs(output.net_wrench).max() < 1e-9
    others = np.einsum("nij,nj->ni", np.transpose(_rolling(robot), (0, 2, 1)), output.torque)[1:]
    A = wheel_jacobian(robot, np.full(robot.n, heading))
    np.testing.assert_allclose(A[2:].T @ others.ravel(), -A[0] * 20.0, atol=1e-9)


def test_the_controller_sees_wheels_that_roll():
    measured = steady(THESIS)
    fast = measured.velocity.copy()
    fast[0, DRIVE] += 1.0
    _, output = slipping(ActiveIdentification(THESIS), dataclasses.replace(measured, velocity=fast))
    np.testing.assert_allclose(output.controller_velocity, measured.velocity, atol=1e-9)
    np.testing.assert_allclose(output.twist, [0.3, 0.0, 0.0], atol=1e-9)


@pytest.mark.parametrize(
    ("changes", "refusal"),
    [
        ({"speed": 0.02}, Refusal.TOO_SLOW),
        ({"speed": 2.0}, Refusal.TOO_FAST),
        ({"mu_p": np.full(4, 1.5)}, Refusal.TORQUE),
        ({"mu_p": np.array([0.5, 0.1, 0.1, 0.1]), "casters": (0,)}, Refusal.OTHERS_NEAR_LIMIT),
        ({"turning": True}, Refusal.TURNING),
        ({"soft": True}, Refusal.DISTURBANCE),
    ],
)
def test_it_does_not_begin_where_it_is_not_safe(changes, refusal):
    changes = dict(changes)
    turning, soft = changes.pop("turning", False), changes.pop("soft", False)
    casters = changes.pop("casters", tuple(range(THESIS.n)))
    measured = steady(THESIS, **changes)
    if turning:
        velocity = measured.velocity.copy()
        velocity[2, STEER] = 3.0
        measured = dataclasses.replace(measured, velocity=velocity)
    # Without pose feedback nothing takes a force away that is not compensated.
    active = ActiveIdentification(THESIS, ActiveParameters(stiffness=10.0) if soft else None)
    state = active.request(active.initial_state(), casters)
    for _ in range(100):
        state, output = active.step(state, measured, 0.002)
        assert not output.torque.any()
    assert state.phase is Phase.REFUSED and state.refusal is refusal and state.tested == ()
    # What is so of one caster says nothing of the next; a robot that turns is no matter of one.
    assert state.refused == (() if turning else tuple((index, refusal) for index in casters))


def test_a_caster_that_cannot_be_tested_is_left_out_and_told():
    """Where the motor of one had not the torque, none of those after it was tested, and nobody was told which it was."""
    measured = steady(THESIS, mu_p=np.array([0.5, 1.5, 0.5, 0.5]))
    active = ActiveIdentification(THESIS, ActiveParameters(others_use=1.0))
    state, begun = active.request(active.initial_state(), (1, 0)), []
    for _ in range(100):
        state, output = active.step(state, measured, 0.002)
        begun.append(output.testing)
    assert 0 in begun and 1 not in begun
    assert state.tested == (0,) and state.refused == ((1, Refusal.TORQUE),)
    last = active.request(active.initial_state(), (0, 1))
    last = dataclasses.replace(last, queue=(1,), tested=(0,), elapsed=1.0)
    for _ in range(2):  # once, and once more after the others
        last, _ = active.step(last, measured, 0.002)
    assert last.phase is Phase.DONE and last.refused == ((1, Refusal.TORQUE),)
    assert active.request(last).refused == ()


def test_what_the_others_have_told_of_the_ground_gives_a_caster_another_chance():
    """The first one was left out for a torque that only the ground of the robot file asked for."""
    active = ActiveIdentification(THESIS, ActiveParameters(others_use=1.0))
    believed, told = steady(THESIS, mu_p=np.full(4, 1.5)), steady(THESIS, mu_p=np.full(4, 0.5))
    state = dataclasses.replace(active.request(active.initial_state(), (0, 1)), elapsed=1.0)
    state, _ = active.step(state, believed, 0.002)
    assert state.queue == (1, 0) and state.refused == ((0, Refusal.TORQUE),)
    state, _ = active.step(state, told, 0.002)
    assert state.phase is Phase.SLIP and state.tested == (1,)
    state, _ = active.step(dataclasses.replace(state, phase=Phase.WAIT, queue=(0,), elapsed=1.0), told, 0.002)
    assert state.phase is Phase.SLIP and state.tested == (1, 0) and state.refused == ()


def test_it_ends_at_once_when_another_wheel_slips_when_cancelled_and_when_it_takes_too_long():
    active, measured = ActiveIdentification(THESIS), steady(THESIS)
    velocity = measured.velocity.copy()
    velocity[3, DRIVE] += 2.5
    ends = {}
    for name, change in (
        (Refusal.OTHERS_SLIP, lambda state: (state, dataclasses.replace(measured, velocity=velocity))),
        (Refusal.CANCELLED, lambda state: (active.cancel(state), measured)),
    ):
        state, _ = slipping(active, measured)
        for _ in range(300):
            state, current = change(state)
            state, output = active.step(state, current, 0.002)
        ends[name] = state.refusal
        assert state.phase is Phase.REFUSED and not output.torque.any()
    assert all(name is refusal for name, refusal in ends.items())
    slow = ActiveIdentification(THESIS, ActiveParameters(growth=0.1, longest=0.3))
    state = slow.request(slow.initial_state())
    for _ in range(600):
        state, _ = slow.step(state, measured, 0.002)
    assert state.refusal is Refusal.TOO_LONG


def shaken(added, begun=0.1, dt=0.002):
    """Step a test until it ends, with speeds [m/s] added to those of wheels that roll from a time after the request on."""
    active, measured = ActiveIdentification(THESIS), steady(THESIS)
    state = active.initial_state()
    for cycle in range(round(-0.5 / dt), round(1.5 / dt)):
        if cycle == 0:
            state = active.request(state, (0, 1))
        velocity, late = measured.velocity.copy(), cycle * dt - begun
        velocity[:, DRIVE] += (added(late) if late > 0.0 else 0.0) / THESIS.wheel_radius
        state, output = active.step(state, dataclasses.replace(measured, velocity=velocity), dt)
        if state.phase is Phase.REFUSED or state.tested == (0, 1):
            break
    return state, output, late


@pytest.mark.parametrize("dt", [0.002, 0.005])
@pytest.mark.parametrize("frequency", [10.0, 20.0, 38.0, 60.0])
@pytest.mark.parametrize("wheels", [(1, 1, 1, 1), (1, 0.4, 0.4, 0.4)])
def test_it_ends_when_wheels_shake_before_it_costs_the_path(wheels, frequency, dt):
    """Torques 8 ms late once shook all wheels to and fro, whose mean is nothing, and the base was off by 13 mm.

    It grew by a factor of e in three periods, and the base was off by less than 1 mm when the others had come to 0.12 m/s.
    """

    def size(time):
        return 0.02 * math.exp(frequency * time / 3.0)

    def added(time):
        return size(time) * math.sin(2.0 * math.pi * frequency * time) * np.array(wheels)

    state, output, late = shaken(added, dt=dt)
    assert state.phase is Phase.REFUSED and state.refusal is Refusal.SHAKES and state.tested == (0,)
    assert output.testing == -1 and not output.torque.any()  # at once: it is the loops that shake
    assert size(late) * wheels[1] < 0.16


def test_it_does_not_begin_while_wheels_shake():
    """All alike, so that none of them slips against the others."""
    state, output, _ = shaken(lambda time: np.full(4, 0.1) * math.sin(240.0 * time), begun=-0.5)
    assert state.phase is Phase.REFUSED and state.refusal is Refusal.SHAKES and not output.torque.any()
    assert state.tested == () and state.refused == ()  # no matter of one caster


@pytest.mark.parametrize(
    "added",
    [
        lambda time: np.full(4, 0.05) * math.sin(240.0 * time),  # less than another wheel may slip
        lambda time: np.array([0.0, 0.0, 0.0, 0.04]),  # the same, for good
        lambda time: np.array([0.3 * math.exp(-(((time - 0.3) / 0.1) ** 2)), 0.0, 0.0, 0.0]),  # let go, and brought back
        lambda time: np.full(4, 0.05) * math.sin(3.0 * time),  # the robot itself
    ],
)
def test_what_is_small_slow_or_one_way_is_no_shaking(added):
    state, _, _ = shaken(added)
    assert state.tested == (0, 1) and state.refusal is Refusal.NONE


def test_the_others_get_the_feedback_of_the_wheel_under_test_slowly():
    """At once it was feedback besides their own: the loop bore less delay than without a test, and shook where it was late."""
    active, measured = ActiveIdentification(THESIS), steady(THESIS)
    state, before = slipping(active, measured)
    asking = np.zeros((4, 2))
    asking[0, DRIVE] = 2.0
    asked = dataclasses.replace(measured, controller_torque=asking)
    taken = []
    for _ in range(100):
        state, output = active.step(state, asked, 0.002)
        taken.append(float((output.torque - before.torque)[1:, DRIVE].sum() / 2.0))
        assert np.abs(output.net_wrench).max() < 1e-9
    assert taken[0] < 0.1 and taken[-1] == pytest.approx(1.0, abs=0.01)


@pytest.mark.parametrize("heading", [pytest.param(0.0, marks=pytest.mark.nightly), 0.9])
@pytest.mark.parametrize("tested", range(4))
@pytest.mark.parametrize("fraction", [0.8, -0.8, 1.25, -1.25])
def test_it_ends_at_the_slip_of_another_wheel_that_it_says_whichever_wheel_it_is(fraction, tested, heading):
    """The twist follows a wheel that slips: of the one opposite, that takes most of the force, 41 % of the slip were left.

    It was once let go on until that wheel slipped by 0.37, where it says 0.15.
    """
    active, measured = ActiveIdentification(THESIS), steady(THESIS, heading=heading)
    limit = active.parameters.others_slip * 0.3
    for slipping_wheel in set(range(4)) - {tested}:
        velocity = measured.velocity.copy()
        velocity[slipping_wheel, DRIVE] += fraction * limit / THESIS.wheel_radius[slipping_wheel]
        state = active.request(active.initial_state(), (tested,))
        while state.phase in (Phase.WAIT, Phase.SLIP):
            begun = state.phase is Phase.SLIP and state.elapsed > 0.1
            current = dataclasses.replace(measured, velocity=velocity) if begun else measured
            state, _ = active.step(state, current, 0.002)
        assert (state.refusal is Refusal.OTHERS_SLIP) == (abs(fraction) > 1.0)


def test_what_the_shear_of_tyres_feigns_is_in_the_position_and_not_in_the_velocity():
    """A velocity less the shear is that of the body: fed back it shook the robot at 8 Hz on soft tyres.

    A force comes at once. Velocity has only the creep of its slip to lose, V lambda, and the position L lambda as well.
    """
    active, measured = ActiveIdentification(THESIS), steady(THESIS)
    force = np.zeros((4, 2))
    force[2, 0] = 0.5 * 0.3 * measured.normal_force[2]  # half of what the ground holds
    slip = 0.1 * 0.5 / (1.0 + math.sqrt(0.75))  # the lower root there
    loaded = dataclasses.replace(measured, force=force)
    state = active.request(active.initial_state())
    while state.phase is Phase.WAIT:
        state, before = active.step(state, measured, 0.002)
    for cycle in range(50):
        lag_before = measured.position[2, DRIVE] - before.controller_position[2, DRIVE]
        state, output = active.step(state, loaded, 0.002)
        lost = (measured.velocity - output.controller_velocity)[2, DRIVE] * THESIS.wheel_radius[2]
        assert lost == pytest.approx(0.3 * slip, rel=1e-6), cycle
    lag = (measured.position[2, DRIVE] - output.controller_position[2, DRIVE] - lag_before) * THESIS.wheel_radius[2]
    assert lag == pytest.approx(0.3 * slip * 0.1 + THESIS.tyres[2].relaxation_length * slip, rel=0.05)


def test_all_casters_are_done_once_each_and_the_robot_is_left_alone_then():
    active, measured = ActiveIdentification(THESIS), steady(THESIS)
    state, tested = active.request(active.initial_state()), []
    for _ in range(4000):
        state, output = active.step(state, measured, 0.002)
        if output.testing >= 0 and (not tested or tested[-1] != output.testing):
            tested.append(output.testing)
    assert tested == [0, 1, 2, 3] and state.phase is Phase.DONE and not output.torque.any()


def test_a_prediction_grows_with_the_force_and_shrinks_with_the_stiffness():
    loads = np.full(4, 220.0)
    soft, stiff = (ActiveIdentification(THESIS, ActiveParameters(stiffness=k)) for k in (100.0, 400.0))
    small, large = (soft.predict(np.zeros(4), 0, loads, mu) for mu in (0.2, 0.8))
    assert 0.0 < small.path < large.path < 0.02 and large.force == pytest.approx(176.0)
    assert stiff.predict(np.zeros(4), 0, loads, 0.8).path == pytest.approx(large.path / 4.0)
    assert large.others_use == pytest.approx(small.others_use)  # of one ground: a matter of geometry


def test_requests_and_measurements_that_make_no_sense_are_refused():
    active = ActiveIdentification(THESIS)
    with pytest.raises(TerrainError, match="casters"):
        active.request(active.initial_state(), (4,))
    with pytest.raises(TerrainError, match="force"):
        active.step(active.initial_state(), steady(THESIS, force=np.full((4, 2), np.nan)), 0.002)
    with pytest.raises(TerrainError, match="growth"):
        ActiveParameters(growth=0.0)
    two = dataclasses.replace(THESIS, casters=THESIS.casters[:2])
    with pytest.raises(TerrainError, match="at least 3"):
        ActiveIdentification(two)


@settings(max_examples=25, deadline=None)
@given(st.floats(-0.7, 0.7), st.floats(-3.1, 3.1), st.integers(0, 3), st.lists(st.floats(10.0, 300.0), min_size=4, max_size=4))
def test_others_take_the_force_whatever_the_headings(speed, heading, caster, hold):
    active = ActiveIdentification(THESIS)
    A = wheel_jacobian(THESIS, np.full(4, heading) + np.array([0.0, 0.3, -0.2, 0.1]))
    force = np.array([100.0 * speed, 10.0])
    others = active._others(A, caster, force, np.array(hold))
    rows = np.delete(np.arange(8), [2 * caster, 2 * caster + 1])
    np.testing.assert_allclose(A[rows].T @ others.ravel(), -A[2 * caster : 2 * caster + 2].T @ force, atol=1e-9)


@pytest.mark.parametrize("heading", [0.0, 0.79, 1.2, 1.57, 2.0])
@pytest.mark.parametrize("caster", range(4))
def test_no_wheel_is_asked_for_much_more_of_what_it_holds_than_it_has_to_be(heading, caster):
    """Of the least forces one wheel had up to 1.09 of what it holds, and two of four casters could not be tested."""
    active = ActiveIdentification(THESIS)
    A = wheel_jacobian(THESIS, np.full(4, heading))
    hold = np.array([240.0, 200.0, 250.0, 190.0])
    force = np.array([hold[caster], 0.0])
    others, index = active._others(A, caster, force, hold), np.delete(np.arange(4), caster)
    use = np.linalg.norm(others, axis=1) / hold[index]
    rest = np.delete(A, [2 * caster, 2 * caster + 1], axis=0)
    internal = np.linalg.svd(rest.T)[2][3:].reshape(-1, 3, 2)
    best = minimize(
        lambda x: np.linalg.norm(np.linalg.norm(others + np.tensordot(x, internal, 1), axis=1) / hold[index], ord=40),
        np.zeros(len(internal)), method="BFGS",
    )  # fmt: skip
    assert use.max() <= 1.08 * best.fun
    assert use.max() < ActiveParameters().others_use


def test_a_record_of_nothing_is_refused():
    record = ActiveRecord(RobotTerrain(THESIS), ActiveIdentification(THESIS))
    for evaluate in (record.begin, record.identify):
        with pytest.raises(TerrainError, match="a record of 0 cycles is not allowed; allowed: at least 1"):
            evaluate(0)


def test_what_is_asked_for_or_goes_on_is_dropped_and_what_is_over_stays_as_it_is():
    active = ActiveIdentification(THESIS)
    idle = active.initial_state()
    assert active.drop(idle) is idle
    dropped = active.drop(active.request(idle))
    assert dropped.phase is Phase.REFUSED and dropped.refusal is Refusal.CANCELLED and dropped.queue == ()
    assert active.drop(dropped) is dropped
