"""Excitations: within what each robot can follow, closed where they say so, repeated by their seed."""

import math
import re
from pathlib import Path

import numpy as np
import pytest

from pcw_control import ControlError, make_excitation, read_excitation
from pcw_control.excitation import CHIRP_FREQUENCIES, EXCITATIONS, FIGURE8_ANGLE, LONGEST, SHORTEST
from pcw_control.motion_range import FORCE_SHARE, SPEED_SHARE, MotionRange
from pcw_description import DescriptionError, KinematicsError, load_robot, shipped_robots
from pcw_description.differential_kinematics import inverse_kinematics

ROBOTS = {name: load_robot(name) for name in shipped_robots() if name != "mpo700"}
THESIS = ROBOTS["thesis"]
DAILY_AND_NIGHTLY = [
    pytest.param(robot, id=name, marks=() if name in ("thesis", "tidybot2") else pytest.mark.nightly)
    for name, robot in ROBOTS.items()
]
# The two that are the same for every robot rely on the controller to slow them down.
FITTED = [name for name in EXCITATIONS if name not in ("identification", "holdout")]
STEP = 0.002


def twists(excitation, step=STEP):
    """Twists (T, 3) at instants `step` apart, up to where the motors go off for good."""
    found = [excitation.twist(t) for t in np.arange(0.0, excitation.duration, step)]
    return np.array([np.full(3, np.nan) if twist is None else twist for twist in found])


def poses(twist, step=STEP):
    """Poses (T, 3) that come of twists of base_link, by the trapezoidal rule."""
    yaw = np.concatenate([[0.0], np.cumsum(0.5 * step * (twist[1:, 2] + twist[:-1, 2]))])
    c, s = np.cos(yaw), np.sin(yaw)
    velocity = np.stack([c * twist[:, 0] - s * twist[:, 1], s * twist[:, 0] + c * twist[:, 1]], axis=1)
    place = np.concatenate([np.zeros((1, 2)), np.cumsum(0.5 * step * (velocity[1:] + velocity[:-1]), axis=0)])
    return np.column_stack([place, yaw])


def joint_speeds(robot, twist, heading, step):
    """Joint speeds (T, n, 2) of slip-free motion from headings (n,)."""
    angle, speeds = heading, []
    for wanted in twist:
        rates = inverse_kinematics(robot, angle, wanted)
        middle = inverse_kinematics(robot, angle + 0.5 * step * rates[:, 1], wanted)
        speeds.append(rates)
        angle = angle + step * middle[:, 1]
    return np.array(speeds)


@pytest.mark.parametrize("robot", DAILY_AND_NIGHTLY)
@pytest.mark.parametrize("name", FITTED)
def test_no_joint_is_asked_for_more_than_its_share_of_speed_and_torque(robot, name):
    """Every second caster begins all but the wrong way round, and has to turn at once."""
    step = 0.004
    twist = twists(make_excitation(name, robot, 30.0, seed=3), step)
    if name == "coast_down":
        twist = twist[: np.isnan(twist).any(axis=1).argmax()]
    assert np.hypot(twist[:, 0], twist[:, 1]).max() + np.abs(twist[:, 2]).max() > 0.02
    # `steps` jump: their size is limited, and how fast it is reached is the controller's business.
    smooth = name != "steps"
    acceleration, yaw_acceleration = np.hypot(*np.diff(twist[:, :2], axis=0).T) / step, np.abs(np.diff(twist[:, 2])) / step
    if smooth:
        assert acceleration.max() <= 1.15 * min(MotionRange.of_robot(robot).acceleration, 0.5)
        assert yaw_acceleration.max() <= 1.15 * 1.5
    inertia = robot.armature + [np.diag([c.wheel.inertia_axle, c.module.inertia_zz]) for c in robot.casters]
    lever = np.stack([robot.wheel_radius, np.abs(robot.caster_offset[:, 0])], axis=1)
    wheel_acceleration = np.max(acceleration + MotionRange.of_robot(robot).lever * yaw_acceleration)
    body_torque = robot.total_mass / robot.n * lever * wheel_acceleration
    speeds = joint_speeds(robot, twist, np.where(np.arange(robot.n) % 2, 0.0, 3.1), step)
    assert (np.abs(speeds) / robot.speed_limit).max() <= SPEED_SHARE * 1.01
    if smooth:
        joint_torque = np.abs(np.einsum("nij,tnj->tni", inertia, np.diff(speeds, axis=0) / step))
        assert ((joint_torque + body_torque) / robot.torque_limit).max() < 2.0 * FORCE_SHARE


@pytest.mark.parametrize("name", EXCITATIONS)
def test_begins_and_ends_at_rest(name):
    excitation = make_excitation(name, THESIS)
    assert excitation.name == name and excitation.summary.endswith(".")
    assert excitation.duration == pytest.approx(EXCITATIONS[name].duration)
    assert not excitation.twist(-0.1).any()
    if name not in ("identification", "holdout", "steps"):  # these begin with what the controller has to soften
        assert np.abs(excitation.twist(1e-6)).max() < 1e-3
    for last in (excitation.twist(excitation.duration - 1e-6), excitation.twist(excitation.duration + 0.1)):
        assert last is None if name == "coast_down" else np.abs(last).max() < 1e-3
    assert excitation.lifted == (name == "wheels_off_ground")


@pytest.mark.parametrize("robot", ROBOTS.values(), ids=ROBOTS)
@pytest.mark.parametrize("duration", [40.0, 60.0, 100.0])
@pytest.mark.parametrize("name", ["circle", "figure8"])
def test_curves_close(robot, name, duration):
    pose = poses(twists(make_excitation(name, robot, duration)))
    assert np.ptp(pose[:, 0]) > 0.3 and np.ptp(pose[:, 1]) > 0.3
    np.testing.assert_allclose(pose[-1, :2], 0.0, atol=2e-3)  # of the trapezoidal rule
    turns = pose[-1, 2] / math.tau
    assert turns == pytest.approx(round(turns), abs=1e-3)
    assert round(turns) == 0 if name == "figure8" else round(turns) >= 1


def test_figure8_crosses_itself_and_turns_both_ways():
    pose = poses(twists(make_excitation("figure8", THESIS)))
    yaw_turned = np.ptp(pose[:, 2])
    assert yaw_turned == pytest.approx(2.0 * FIGURE8_ANGLE, rel=1e-3)
    outward = np.diff(pose[:, 2])
    assert (outward > 0.0).sum() == pytest.approx((outward < 0.0).sum(), rel=0.01)


@pytest.mark.parametrize("name, axis, parts", [("chirp_x", 0, 1), ("chirp_y", 1, 1), ("chirp_yaw", 2, 1), ("chirps", 2, 3)])
def test_chirps_sweep_from_the_first_to_the_last_frequency(name, axis, parts):
    """The time between zero crossings is half a period of the frequency in its middle, from 0.1 to 1 Hz."""
    duration = 90.0
    found = twists(make_excitation(name, THESIS, duration), 0.001)
    part = duration / parts
    signal = found[round((parts - 1) * part / 0.001) :, axis]
    others = np.delete(found[round((parts - 1) * part / 0.001) :], axis, axis=1)
    assert not others.any()
    crossings = np.flatnonzero(np.diff(np.sign(signal[1:])) != 0) * 0.001
    frequency = 0.5 / np.diff(crossings[: np.searchsorted(crossings, part - 2.0)])
    time = 0.5 * (crossings[1 : len(frequency) + 1] + crossings[: len(frequency)])
    low, high = CHIRP_FREQUENCIES
    np.testing.assert_allclose(frequency, low + (high - low) * time / part, rtol=0.08)
    assert frequency[0] < 2.5 * low and frequency[-1] > 0.93 * high
    if parts == 3:
        for other in range(3):
            piece = found[round(other * part / 0.001) : round((other + 1) * part / 0.001)]
            assert np.abs(piece[:, other]).max() > 0.05 and not np.delete(piece, other, axis=1).any()


def test_coast_down_gets_up_to_speed_and_lets_go_for_good():
    excitation = make_excitation("coast_down", THESIS, 40.0)
    instants = np.arange(0.0, 41.0, 0.01)
    off = np.array([excitation.twist(t) is None for t in instants])
    first = instants[off.argmax()]
    assert 5.0 < first < 15.0 and off[off.argmax() :].all()
    assert excitation.twist(first - 0.02)[0] == pytest.approx(1.2)
    hurried = make_excitation("coast_down", THESIS, 10.0)
    assert hurried.twist(5.0) is None and 0.3 < hurried.twist(4.99)[0] < 1.2


def test_a_seed_draws_the_goals():
    first, again, other = (twists(make_excitation("random_goals", THESIS, 60.0, seed), 0.05) for seed in (7, 7, 8))
    np.testing.assert_array_equal(first, again)
    assert np.abs(first - other).max() > 0.05
    moving = np.abs(first).max(axis=1) > 1e-3
    assert moving.mean() > 0.8
    figure8 = [twists(make_excitation("figure8", THESIS, 60.0, seed), 0.05) for seed in (7, 8)]
    np.testing.assert_array_equal(*figure8)


def test_small_and_large_robots_get_motion_to_their_measure():
    speed = {name: np.abs(twists(make_excitation("chirp_x", robot), 0.02)).max() for name, robot in ROBOTS.items()}
    assert len({round(value, 3) for value in speed.values()}) >= 3
    assert all(0.1 < value < 1.0 for value in speed.values())


@pytest.mark.parametrize("duration", [10.0, 100.0])
def test_identification_is_stretched(duration):
    nominal, other = make_excitation("identification", THESIS), make_excitation("identification", THESIS, duration)
    assert other.duration == pytest.approx(duration) and len(other.segments) == len(nominal.segments)
    for t in np.linspace(0.1, 39.9, 50):
        held = nominal.segments[3:]  # chirps keep their frequencies and fit in fewer or more periods
        if t > 17.0 and held:
            np.testing.assert_allclose(other.twist(t * duration / 40.0), nominal.twist(t), atol=1e-9)


@pytest.mark.parametrize("name", ["identification", "holdout"])
def test_fixed_ones_stay_within_what_the_demonstration_needs(name):
    found = twists(make_excitation(name, THESIS), 0.01)
    assert np.hypot(found[:, 0], found[:, 1]).max() <= 0.65
    assert np.abs(found[:, 2]).max() <= 1.3
    assert not make_excitation(name, THESIS).twist(EXCITATIONS[name].duration - 0.5).any()


def test_fixed_ones_are_the_same_for_every_robot_and_have_not_changed():
    """Recordings of them exist: a number of them that changes makes two recordings of one name two experiments."""
    for robot in ROBOTS.values():
        identification, holdout = make_excitation("identification", robot), make_excitation("holdout", robot)
        assert identification.twist(3.0).tolist() == [0.3181980515339463, 0.0, 0.0]
        assert identification.twist(24.5).tolist() == [0.5, 0.0, -0.5999999999999996]
        assert identification.twist(38.0).tolist() == [-0.6, 0.0, 0.0]
        assert holdout.twist(5.0).tolist() == [-0.3910120470660388, 0.22994530955157616, -0.5865180705990581]
        assert holdout.twist(20.0).tolist() == [-0.3, 0.2, -0.6]


def test_identification_reverses_each_axis_many_times_and_drives_each_alone():
    found = twists(make_excitation("identification", THESIS), 0.01)
    for axis in range(3):
        moving = found[np.abs(found[:, axis]) > 0.05, axis]
        assert np.sum(np.diff(np.sign(moving)) != 0) >= 8
        others = np.delete(found, axis, axis=1)
        alone = (np.abs(found[:, axis]) > 0.1) & (np.abs(others).max(axis=1) == 0.0)
        assert alone.sum() * 0.01 > 3.0


def test_holdout_is_another_motion():
    """No twist of the one is held in the other for long: what fits both was not learnt by heart."""
    first, second = (twists(make_excitation(name, THESIS), 0.01) for name in ("identification", "holdout"))
    moving = second[np.abs(second).max(axis=1) > 0.0]
    nearest = np.array([np.abs(first - twist).max(axis=1).min() for twist in moving[::10]])
    assert np.mean(nearest > 0.02) > 0.7


def test_what_cannot_be_made_is_refused():
    with pytest.raises(ControlError, match="excitation 'figure9' is not allowed; did you mean 'figure8'?"):
        make_excitation("figure9", THESIS)
    for wrong in (9.0, math.nan, math.inf, 1e9, -1.0):
        with pytest.raises(ControlError, match=rf"duration = .* allowed: {SHORTEST:g} to {LONGEST:g} s"):
            make_excitation("identification", THESIS, wrong)
    with pytest.raises(KinematicsError, match="torque control"):
        make_excitation("circle", load_robot("mpo700"))


@pytest.mark.parametrize("name", EXCITATIONS)
def test_the_shortest_duration_named_in_the_refusal_can_be_driven(name):
    for robot in ROBOTS.values():
        with pytest.raises(ControlError) as refusal:
            make_excitation(name, robot, 1.0)
        shortest = float(str(refusal.value).split("allowed: ")[1].split(" to ")[0])
        excitation = make_excitation(name, robot, shortest)
        assert excitation.duration == pytest.approx(shortest)
        assert np.nanmax(np.abs(twists(excitation, 0.02))) > 0.01


def test_the_readme_lists_them_all():
    readme = (Path(__file__).parents[1] / "README.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| `(\w+)` \| ([\d.]+) s \| (\S.*) \|$", readme.partition("## Excitations")[2], re.MULTILINE)
    assert rows == [(name, f"{plan.duration:g}", plan.summary) for name, plan in EXCITATIONS.items()]


def test_a_file_asks_for_an_excitation_and_the_caller_has_the_last_word(tmp_path):
    """Name, length and seed of the file; a length given besides goes before."""
    path = tmp_path / "goals.yaml"
    path.write_text("{format: pcw_excitation/1, name: random_goals, duration: 40, seed: 3, purpose: to see what it does}")
    asked = read_excitation(str(path), THESIS)
    assert (asked.name, asked.duration) == ("random_goals", pytest.approx(40.0))
    assert np.array_equal(twists(asked), twists(make_excitation("random_goals", THESIS, 40.0, 3)))
    assert read_excitation(str(path), THESIS, 20.0).duration == pytest.approx(20.0)
    path.write_text("{format: pcw_excitation/1, name: random_goals}")
    by_file, by_name = (read_excitation(name, THESIS, 20.0, 5) for name in (str(path), "random_goals"))
    assert np.array_equal(twists(by_file), twists(by_name))


@pytest.mark.parametrize(
    ("content", "says"),
    [
        ("{format: pcw_excitation/2, name: spin}", "format: 'pcw_excitation/2' is not allowed; allowed: pcw_excitation/1"),
        ("{name: spin}", "format is missing; allowed: pcw_excitation/1"),
        ("{format: pcw_excitation/1}", "name is missing"),
        ("{format: pcw_excitation/1, name: spinn}", "did you mean 'spin'?"),
        ("{format: pcw_excitation/1, name: spin, lenght: 20}", "lenght: 20 is not allowed; unknown key"),
        ("{format: pcw_excitation/1, name: spin, duration: long}", "duration: 'long' is not allowed; allowed: 10 to 3600 s"),
        ("{format: pcw_excitation/1, name: spin, duration: 5}", "duration = 5 s of excitation spin"),
        ("{format: pcw_excitation/1, name: spin, seed: -1}", "seed: -1 is not allowed"),
        ("[spin]", "it holds one list"),
    ],
)
def test_a_file_that_is_not_allowed_says_what_is(tmp_path, content, says):
    """Key, value and what is allowed."""
    (tmp_path / "run.yaml").write_text(content)
    with pytest.raises((ControlError, DescriptionError), match=re.escape(says)):
        read_excitation(str(tmp_path / "run.yaml"), THESIS)
