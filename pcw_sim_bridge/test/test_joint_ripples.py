"""Ripples of joints that are too fast for the channels: found by the angle that they keep step with, weighed by simulation."""

import math
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from pcw_description import load_robot
from pcw_description.recording import Recording
from pcw_sim_bridge.mismatch.analysis import Analysis, analyse
from pcw_sim_bridge.mismatch.robot.joint_ripples import _apart, _Band, _ripple, joint_ripples
from pcw_sim_bridge.mismatch.robot.ripple_sizes import RippleScale
from pcw_sim_bridge.mismatch.subjects.robot_subject import RobotSubject
from pcw_sim_bridge.simulate import main as simulate

RATE, LOWEST, HIGHEST = 150.0, 3.0, 60.0
COGGING = "{name: motor_cogging, target: [rear_left], axis: drive, cosine: 0.4, sine: -0.3, order: 12.0}"


def recorded(path: Path, robot: str, excitation: str, physics: str = "[]", *more: str) -> Path:
    run = ["--robot", robot, "--excite", excitation, "--plant", "reduced", "--physics", physics]
    assert simulate([*run, "--duration", "29", "--seed", "7", *more, "--out", str(path)]) == 0
    return path


def analysed(path: Path, robot: str, *held_out: Path) -> Analysis:
    return analyse(RobotSubject(load_robot(robot)), [path], list(held_out), {}, 0, lambda message: None)


def band(values: Callable[[np.ndarray, np.ndarray], np.ndarray], caster: str = "a", radius: float = 1.0) -> _Band:
    """A joint that turns at changing speed, and what it does above the channels' band, with noise of a tenth."""
    rng, time = np.random.default_rng(3), np.arange(0.0, 40.0, 1.0 / RATE)
    speed = (6.0 + 3.0 * np.sin(0.4 * time)) / radius
    angle = np.cumsum(speed) / RATE
    return _Band(caster, "drive", values(angle, time) + 0.1 * rng.standard_normal(len(time)), angle, speed, LOWEST, HIGHEST)


def test_a_wave_of_the_angle_is_a_ripple() -> None:
    ripple = _ripple(band(lambda angle, time: 0.5 * np.cos(9.0 * angle + 0.3)))
    assert ripple is not None and (ripple.caster, ripple.axis, ripple.order) == ("a", "drive", 9.0)
    assert ripple.part > 0.9
    between = _ripple(band(lambda angle, time: 0.5 * np.cos(9.4 * angle)))
    assert between is not None and between.order == pytest.approx(9.4, abs=0.2 * between.width)


@pytest.mark.parametrize(
    "values",
    [
        lambda angle, time: 0.0 * angle,
        # A loop that rings, whatever the speed.
        lambda angle, time: 0.5 * np.cos(math.tau * 8.6 * time),
        # A hard spot of the turn.
        lambda angle, time: 0.5 * (np.cos(angle) > 0.97) - 0.05,
    ],
)
def test_what_keeps_no_step_or_sits_at_one_place_is_none(values: Callable[[np.ndarray, np.ndarray], np.ndarray]) -> None:
    assert _ripple(band(values)) is None


def test_a_joint_that_shakes_with_another_has_no_ripple_of_its_own() -> None:
    own = band(lambda angle, time: 0.5 * np.cos(9.0 * angle))
    # A wheel a little larger, so that its own angle is soon out of step.
    shaken = band(lambda angle, time: 0.2 * np.cos(9.0 * 1.004 * angle), "b", 1.004)
    ripples = [ripple for one in (own, shaken) if (ripple := _ripple(one)) is not None]
    assert [ripple.caster for ripple in _apart([own, shaken], ripples)] == ["a"]


def test_waves_under_all_wheels_are_those_of_the_floor() -> None:
    casters = ["a", "b", "c", "d"]
    rough = [band(lambda angle, time, k=k: 0.5 * np.cos(9.4 * angle + k), name) for k, name in enumerate(casters)]
    found = [ripple for one in rough if (ripple := _ripple(one)) is not None]
    assert len(found) == 4 and len(_apart(rough[:1], found[:1])) == 1
    assert _apart(rough, found) == []


def test_a_recording_of_next_to_nothing_has_none() -> None:
    robot = load_robot("tidybot2")
    for count in (0, 1, 2, 5):
        stamp = 0.01 * np.arange(count)
        nothing = np.zeros((count, robot.n, 2))
        joints = SimpleNamespace(stamp=stamp, position=nothing, velocity=nothing, effort=nothing)
        assert joint_ripples(robot, [SimpleNamespace(joint_states=joints)], 3.0) == ()  # type: ignore[list-item]


def test_healthy_robots_have_none(tmp_path: Path) -> None:
    robot = load_robot("tidybot2")
    path = recorded(tmp_path / "run", "tidybot2", "coast_down", "[]", "--controller", "velocity_loops")
    assert joint_ripples(robot, [Recording.open(path, robot)], 3.0) == ()


@pytest.mark.parametrize(("robot", "controller"), [("tidybot2", "velocity_loops"), ("thesis", "computed_torque")])
def test_a_motor_that_cogs_at_speed(tmp_path: Path, robot: str, controller: str) -> None:
    """In the channels nothing of it is left, and robots with half a newton metre of it were told to lack nothing.

    By computed torques tidybot2, whose gears are coupled, shakes at all wheels: whose cogging it is nobody could tell.
    """
    path = recorded(tmp_path / "run", robot, "coast_down", COGGING, "--controller", controller)
    held_out = recorded(tmp_path / "other", robot, "random_goals", COGGING, "--controller", controller)
    analysis = analysed(path, robot, held_out)
    findings = analysis.findings
    [named] = findings.effects
    assert (findings.verdict, named.name, named.target) == ("explained", "motor_cogging", ("rear_left",))
    assert named.probability > 0.95 and named.ambiguous_with == ()
    assert named.parameters["order"].value == 12.0
    for name, true in (("cosine", 0.4), ("sine", -0.3)):
        told = named.parameters[name]
        assert told.value == pytest.approx(true, abs=0.12) and told.low < true < told.high
    [channel] = [channel for channel in findings.channels if channel.name == "drive_torque/rear_left"]
    assert channel.flagged and channel.noise_floor < 0.5 * channel.rms
    assert ("rear_left",) in [place.casters for place in findings.locations]
    assert findings.fit is not None
    [proof] = [proof for proof in findings.fit.channels if proof.name == "drive_torque/rear_left"]
    assert proof.after < 0.5 * proof.before
    assert any("keeps step with the drive of rear_left, 12 periods per turn" in note for note in findings.notes)
    [patched] = [effect for effect in analysis.patched.mapping()["physics"] if effect["name"] == "motor_cogging"]
    assert (patched["axis"], patched["order"]) == ("drive", 12.0)


def test_a_size_that_is_held_against_other_recordings_is_of_the_order_that_was_found(tmp_path: Path) -> None:
    """No whole one: it is re-tuned beside the size, and would be a second time."""
    robot = load_robot("tidybot2")
    physics = COGGING.replace("12.0", "12.42")
    path = recorded(tmp_path / "run", "tidybot2", "coast_down", physics, "--controller", "velocity_loops")
    recording = Recording.open(path, robot)
    [ripple] = joint_ripples(robot, [recording], 3.0)
    assert ripple.order == pytest.approx(12.42, abs=ripple.width)
    size = RippleScale(lambda numbers: robot, [recording], ripple, 3.0).size()
    assert size is not None and size.ripple.order == pytest.approx(12.42, abs=0.1 * ripple.width)
    again = RippleScale(lambda numbers: robot, [recording], size.ripple, 3.0).again(size)
    assert again is not None and again.ripple.order == size.ripple.order
    assert again.after.mean() == pytest.approx(size.after.mean(), rel=0.01)


def test_what_the_channels_see_of_a_ripple_corrects_its_size(tmp_path: Path) -> None:
    """A motor that also turns slowly: one effect, and not a second one of what the first was off by."""
    path = recorded(tmp_path / "run", "flow_base", "random_goals", COGGING, "--controller", "computed_torque")
    findings = analysed(path, "flow_base").findings
    [named] = findings.effects
    assert (named.name, named.target) == ("motor_cogging", ("rear_left",))
    assert [place.casters for place in findings.locations] == [("rear_left",)]
    size = math.hypot(named.parameters["cosine"].value, named.parameters["sine"].value)
    assert size == pytest.approx(0.5, rel=0.1)
