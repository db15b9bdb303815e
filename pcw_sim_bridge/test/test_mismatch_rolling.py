"""Recordings of joint angles and a tracked pose alone: of a real tricycle, and made ones with and without faults."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from pcw_description import RobotDescription, load_robot
from pcw_description.column_mapping import ColumnMapping, load_column_mapping
from pcw_description.import_columns import import_columns
from pcw_description.robot_description import DRIVE, STEER
from pcw_sim_bridge.mismatch.analysis import Analysis, analyse
from pcw_sim_bridge.mismatch.robot import rolling_cases
from pcw_sim_bridge.mismatch.robot.robot_motion import base_pose
from pcw_sim_bridge.mismatch.robot.sudden_slip import spinning, sudden_slip
from pcw_sim_bridge.mismatch.subjects.robot_subject import RobotSubject

RECORDINGS = Path(__file__).parents[1] / "config" / "recordings"
# In the recording with the published numbers: the steering of this robot stands so far from its counter's zero.
PUBLISHED_OFFSET, OFFSET_MARGIN = -0.051, 0.005  # [rad]
RADIUS_MARGIN = 0.02
SWING_PHASE = 0.6  # [rad]
Made = tuple[RobotDescription, Path]  # as it is described, and the recording


def tricycle() -> RobotDescription:
    """The robot of the public recording."""
    return load_robot(RECORDINGS / "tricycle.yaml")


def analysed(robot: RobotDescription, path: Path) -> Analysis:
    """Analyse one recording."""
    return analyse(RobotSubject(robot), [path], [], {}, 0, lambda _: None)


def named(analysis: Analysis) -> list[str]:
    """Names and targets of the effects found."""
    return [f"{effect.name}/{'+'.join(effect.target)}" for effect in analysis.findings.effects]


# --- The public recording ------------------------------------------------------------------------------------------------


@pytest.fixture
def real(tmp_path: Path) -> Callable[[Callable[[ColumnMapping], ColumnMapping]], Path]:
    """Import the public recording with its mapping changed."""
    places = [Path(os.environ["PCW_DATA"])] if "PCW_DATA" in os.environ else []
    found = [place / "tricycle" / "dataset.txt" for place in places if (place / "tricycle" / "dataset.txt").is_file()]
    if not found:
        pytest.skip("the recording of the tricycle is not here; set PCW_DATA to the folder that holds tricycle/dataset.txt")

    def imported(change: Callable[[ColumnMapping], ColumnMapping]) -> Path:
        mapping = change(load_column_mapping(RECORDINGS / "tricycle_columns.yaml"))
        import_columns(found[0], mapping, tmp_path / "bag")
        return tmp_path / "bag"

    return imported


def with_position(mapping: ColumnMapping, joint: str, **changes: float) -> ColumnMapping:
    """The mapping with the column of a joint's angle changed."""
    old = mapping.joints[joint]
    assert old.position is not None
    joints = {**mapping.joints, joint: dataclasses.replace(old, position=dataclasses.replace(old.position, **changes))}
    return dataclasses.replace(mapping, joints=joints)


def test_of_the_calibrated_tricycle_nothing_is_named(real: Callable[..., Path]) -> None:
    analysis = analysed(tricycle(), real(lambda mapping: mapping))
    assert analysis.findings.verdict == "no_mismatch"
    assert [channel.name for channel in analysis.findings.channels] == ["pose/x", "pose/y", "pose/yaw"]


def test_the_concealed_zero_of_its_steering_is_found(real: Callable[..., Path]) -> None:
    """The effect says reported minus true heading: the offset that calibrations add, with the other sign."""
    analysis = analysed(tricycle(), real(lambda mapping: with_position(mapping, "front_steer", offset=0.0)))
    assert named(analysis) == ["steer_zero_offset/front"]
    offset = analysis.findings.effects[0].parameters["offset"]
    assert offset.value == pytest.approx(-PUBLISHED_OFFSET, abs=OFFSET_MARGIN)
    assert offset.low < -PUBLISHED_OFFSET < offset.high


@pytest.mark.parametrize("part", [0.9, 0.95, 1.1])
def test_its_concealed_way_per_count_is_found(real: Callable[..., Path], part: float) -> None:
    """With a part of the way per count the wheel seems smaller: the radius that is found makes up for it."""
    robot = tricycle()

    def concealed(mapping: ColumnMapping) -> ColumnMapping:
        position = mapping.joints["front_drive"].position
        assert position is not None
        return with_position(mapping, "front_drive", scale=part * position.scale)

    analysis = analysed(robot, real(concealed))
    assert named(analysis) == ["wheel_radius_error/front"]
    radius = robot.wheel_radius[0] + analysis.findings.effects[0].parameters["error"].value
    assert radius * part == pytest.approx(robot.wheel_radius[0], rel=RADIUS_MARGIN)


def test_patched_with_what_was_found_nothing_is_left(real: Callable[..., Path]) -> None:
    path = real(lambda mapping: with_position(mapping, "front_steer", offset=0.0))
    patched = analysed(tricycle(), path).patched
    assert isinstance(patched, RobotSubject)
    assert analysed(patched.robot, path).findings.verdict == "no_mismatch"


# --- Made recordings -----------------------------------------------------------------------------------------------------


def made_tricycle(
    path: Path, seed: int, steer_offset: float = 0.0, radius_error: float = 0.0, eccentricity: float = 0.0, swing: float = 0.0
) -> Made:
    """A tricycle that differs from its description within its tolerances, and by a fault; description and recording."""
    described, rng = tricycle(), np.random.default_rng(seed)
    tracker = described.sensors.tracker
    assert tracker is not None and tracker.position is not None

    def deviation(name: str) -> float:
        return float(rng.standard_normal()) * described.tolerance(name).value

    place = tracker.position[0] + deviation("tracker.position"), tracker.position[1] + deviation("tracker.position")
    mounted = dataclasses.replace(tracker, position=place, yaw=tracker.yaw + deviation("tracker.yaw"))
    true = dataclasses.replace(described, sensors=dataclasses.replace(described.sensors, tracker=mounted))
    radius = described.wheel_radius[0] * (1.0 + deviation("wheel_radius")) + radius_error
    wheelbase = described.steer_axis[0, 0] + deviation("steer_axis")
    zero = steer_offset + deviation("steer_zero")
    joints, pose = rolling_cases.tricycle_motion(wheelbase, radius, 60.0, rng)
    roll = joints[:, 0, DRIVE].copy()
    joints[:, 0, DRIVE] -= eccentricity / radius * np.sin(roll)  # to first order, of a radius that swings by its cosine
    joints[:, 0, STEER] += swing * np.sin(joints[:, 0, STEER] + SWING_PHASE)
    return described, rolling_cases.write(path, true, joints, pose, rng, {"front": zero})


def made_swerve(path: Path, seed: int, steer_offset: float = 0.0, radius_error: float = 0.0) -> Made:
    """The same on four wheels that steer on the spot; the fault is at one of them."""
    rng = np.random.default_rng(seed)
    base = load_robot("mpo700")
    described = base.with_casters(base.caster_names, lambda c: dataclasses.replace(c, caster_offset=(0.0, 0.0)))
    tracker = base.sensors.tracker
    assert tracker is not None
    slow = dataclasses.replace(tracker, rate=25.0, position_noise=0.001)
    described = dataclasses.replace(described, sensors=dataclasses.replace(base.sensors, imu=None, tracker=slow))
    true = described.with_casters(
        described.caster_names,
        lambda c: dataclasses.replace(c, wheel_radius=c.wheel_radius * (1.0 + 0.001 * float(rng.standard_normal()))),
    )
    true = true.with_casters(["rear_left"], lambda c: dataclasses.replace(c, wheel_radius=c.wheel_radius + radius_error))
    joints, pose = rolling_cases.swerve_motion(true, 60.0, rng)
    offsets = {name: 0.002 * float(rng.standard_normal()) for name in described.caster_names}
    offsets["front_left"] += steer_offset
    return described, rolling_cases.write(path, described, joints, pose, rng, offsets)


def made_axle(path: Path, seed: int, track_error: float = 0.0, radius_error: float = 0.0) -> Made:
    """Two driven wheels beside each other that never steer, as of a skid-steered robot; the track is that of both."""
    rng = np.random.default_rng(seed)
    base = tricycle()
    wheels = [
        dataclasses.replace(base.casters[0], name=name, steer_axis=(0.0, y), wheel_radius=0.15)
        for name, y in (("left", 0.3), ("right", -0.3))
    ]
    described = dataclasses.replace(base, casters=tuple(wheels), fixed_wheels=())
    true = described.with_casters(["left"], lambda c: dataclasses.replace(c, steer_axis=(0.0, 0.3 + track_error)))
    true = true.with_casters(
        ["right"],
        lambda c: dataclasses.replace(c, steer_axis=(0.0, -0.3 - track_error), wheel_radius=0.15 + radius_error),
    )
    joints, pose = rolling_cases.axle_motion(true, 60.0, rng)
    return described, rolling_cases.write(path, described, joints, pose, rng)


@pytest.mark.parametrize(("make", "seed"), [(made_tricycle, 0), (made_tricycle, 1), (made_swerve, 0), (made_axle, 0)])
def test_of_a_healthy_robot_nothing_is_named(make: Callable[..., Made], seed: int, tmp_path: Path) -> None:
    assert analysed(*make(tmp_path / "bag", seed)).findings.verdict == "no_mismatch"


@pytest.mark.parametrize("seed", [0])
@pytest.mark.parametrize(
    ("fault", "effect", "parameter"),
    [({"steer_offset": 0.03}, "steer_zero_offset", "offset"), ({"radius_error": 0.01}, "wheel_radius_error", "error")],
)
def test_a_tricycles_fault_is_named(fault: dict[str, float], effect: str, parameter: str, seed: int, tmp_path: Path) -> None:
    analysis = analysed(*made_tricycle(tmp_path / "bag", seed, **fault))
    assert named(analysis) == [f"{effect}/front"]
    estimate = analysis.findings.effects[0].parameters[parameter]
    assert estimate.low < next(iter(fault.values())) < estimate.high


@pytest.mark.parametrize("seed", [0])
def test_a_wheel_that_runs_out_of_true_is_told_from_all_but_its_encoder(seed: int, tmp_path: Path) -> None:
    """Without torques nothing tells whether the tread or the disc of the encoder is off its middle."""
    analysis = analysed(*made_tricycle(tmp_path / "bag", seed, eccentricity=0.003))
    (effect,) = analysis.findings.effects
    assert {effect.name, *effect.ambiguous_with} == {"wheel_eccentricity", "encoder_eccentricity"}


@pytest.mark.parametrize("seed", [0])
def test_the_encoder_of_a_steering_that_turns_by_a_third_of_a_turn_is_no_zero(seed: int, tmp_path: Path) -> None:
    """It was not asked for below half a turn: a zero offset was named in its place, for sure."""
    analysis = analysed(*made_tricycle(tmp_path / "bag", seed, swing=0.04))
    assert named(analysis) == ["encoder_eccentricity/front"]
    estimates = analysis.findings.effects[0].parameters
    assert estimates["amplitude"].low < 0.04 < estimates["amplitude"].high
    assert estimates["phase"].value == pytest.approx(SWING_PHASE, abs=0.3)


@pytest.mark.parametrize(
    ("fault", "found"),
    [({"steer_offset": 0.02}, "steer_zero_offset/front_left"), ({"radius_error": 0.001}, "wheel_radius_error/rear_left")],
)
@pytest.mark.parametrize("seed", [0])
def test_the_wheel_of_a_swerve_drive_is_named(fault: dict[str, float], found: str, seed: int, tmp_path: Path) -> None:
    """The size too: as much of it may be the tolerance of that wheel, and no more."""
    analysis = analysed(*made_swerve(tmp_path / "bag", seed, **fault))
    assert named(analysis) == [found]
    (estimate,) = analysis.findings.effects[0].parameters.values()
    assert estimate.low < next(iter(fault.values())) < estimate.high
    channels = [channel.name for channel in analysis.findings.channels]
    assert "rolling_consistency/front_left_lateral" in channels and "pose/yaw" in channels


def test_the_smaller_one_of_two_wheels_that_never_steer_is_named(tmp_path: Path) -> None:
    """Wheels in a line, which cannot contradict each other: it ended in a traceback."""
    analysis = analysed(*made_axle(tmp_path / "bag", 0, radius_error=-0.01))
    assert named(analysis) == ["wheel_radius_error/right"]
    estimate = analysis.findings.effects[0].parameters["error"]
    assert estimate.low < -0.01 < estimate.high
    assert not any(c.flagged for c in analysis.findings.channels if c.name.startswith("rolling_consistency"))
    # A wheel that slips by as much on its way looks the same.
    assert analysis.findings.effects[0].probability <= 0.5
    assert any("slip in proportion to the motion" in note for note in analysis.findings.notes)


@pytest.mark.parametrize("error", [0.05, 0.2])
def test_a_track_that_is_wider_than_described_is_found_and_can_be_simulated(error: float, tmp_path: Path) -> None:
    """As of a robot that scrubs when it turns. Beyond 0.16 m the module's inertia made it a robot that cannot be."""
    robot, path = made_axle(tmp_path / "bag", 0, track_error=error)
    analysis = analysed(robot, path)
    assert {tuple(effect.target): effect.name for effect in analysis.findings.effects} == {
        ("left",): "caster_offset_error", ("right",): "caster_offset_error",
    }  # fmt: skip
    for effect in analysis.findings.effects:
        assert abs(effect.parameters["y"].value) == pytest.approx(error, rel=0.05)
    patched = analysis.patched
    assert isinstance(patched, RobotSubject)
    assert analysed(patched.robot, path).findings.verdict == "no_mismatch"


# --- Parts ---------------------------------------------------------------------------------------------------------------


def test_the_pose_of_base_link_follows_from_what_is_tracked() -> None:
    robot = tricycle()
    tracker = robot.sensors.tracker
    assert tracker is not None and tracker.position is not None
    base = np.array([[1.0, 2.0, 0.7], [-3.0, 0.5, -2.0]])
    c, s = np.cos(base[:, 2]), np.sin(base[:, 2])
    (x, y), yaw = tracker.position, tracker.yaw
    tracked = base + np.stack([c * x - s * y, s * x + c * y, np.full(2, yaw)], axis=1)
    np.testing.assert_allclose(base_pose(robot, tracked), base, atol=1e-12)


def test_a_robot_that_spins_its_wheels_most_of_the_time_is_no_usual_one_and_a_wrong_axis_is_no_slip() -> None:
    """On ice for twelve seconds of eighteen all wheels agreed, and their way was that of the robot."""
    time = np.arange(0.0, 18.0, 0.02)
    rolled = np.zeros((len(time), 3))
    rolled[:, 1] = 0.5 * np.sin(2.0 * time)
    least = np.full(len(time), 0.1)
    on_ice = time > 6.0
    tracked = np.where(on_ice[:, None], 0.02 * rolled, rolled)
    fast = np.abs(rolled[:, 1]) > 0.1
    np.testing.assert_array_equal(spinning(tracked, rolled, 0.3, least), on_ice & fast)
    tracked[:50] = np.nan
    assert not spinning(tracked, rolled, 0.3, least)[:50].any()
    assert not spinning(np.where(on_ice[:, None], -rolled, rolled), rolled, 0.3, least).any()
    assert not spinning(0.02 * rolled, rolled, 0.3, least).any()


def test_what_comes_and_goes_in_a_moment_is_sudden_and_a_wrong_number_is_not() -> None:
    """A counter that loses its place, of which the public recording has four, must not be taken for a radius."""
    rng = np.random.default_rng(5)
    rate, time = 25.0, np.arange(0.0, 40.0, 0.04)
    rolled = np.stack([0.3 + 0.2 * np.sin(0.5 * time), np.zeros_like(time), 0.2 * np.cos(0.4 * time)], axis=1)
    tracked = 1.15 * rolled + 0.005 * rng.standard_normal(rolled.shape)
    allowed = 0.03 + 0.15 * rolled[:, 0]
    assert not sudden_slip(tracked, rolled, rate, 1.5, allowed).any()
    rolled[500:506, 0] -= 0.8
    tracked[200:220] = np.nan
    np.testing.assert_array_equal(np.flatnonzero(sudden_slip(tracked, rolled, rate, 1.5, allowed)), np.arange(500, 506))
