"""Torques that are known from reports alone: their noise, and what drives that hold speeds leave out of them."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest

from pcw_control.excitation import make_excitation
from pcw_description import load_robot
from pcw_description.effect_instance import EffectInstance
from pcw_description.effects.registry import read_physics
from pcw_description.recording import Recording
from pcw_description.robot_description import DRIVE, STEER, RobotDescription
from pcw_sim_bridge.mismatch.analysis import analyse
from pcw_sim_bridge.mismatch.findings.findings import Findings
from pcw_sim_bridge.mismatch.readings.held_commands import expected, held_commands, quiet_torque
from pcw_sim_bridge.mismatch.regression.signal_filter import SignalFilter
from pcw_sim_bridge.mismatch.robot.robot_channels import RobotProblemBuilder
from pcw_sim_bridge.mismatch.robot.torque_errors import FORCES, INSTRUMENTS
from pcw_sim_bridge.mismatch.subjects.robot_subject import RobotSubject
from pcw_sim_bridge.simulated_run import record_run

# Its steering has a lever of 20 mm: a little torque is a large force, and its drives hold speeds.
FLOW_BASE = load_robot("flow_base")
CUTOFF = 5.0  # [Hz]


def run(
    robot: RobotDescription, controller: str, folder: Path, excitation_name: str, duration: float,
    *effects: EffectInstance,
) -> Path:  # fmt: skip
    """Record a robot with effects that its controller knows nothing of."""
    excitation = make_excitation(excitation_name, robot, duration, 0)
    record_run(
        dataclasses.replace(robot, physics=effects), excitation.twist, excitation.duration, 5, folder / "run", "reduced",
        controlled_as=robot, controller_name=controller,
    )  # fmt: skip
    return folder / "run"


def found_in(path: Path, robot: RobotDescription = FLOW_BASE) -> Findings:
    return analyse(RobotSubject(robot), [path], [], {}, 0, lambda message: None).findings


def test_what_is_expected_of_a_noisy_signal_is_nearer_to_it_and_shrinks_no_slope() -> None:
    rng = np.random.default_rng(0)
    stamp = np.arange(8000) / 200.0
    truth = np.sin(2.0 * np.pi * 0.3 * stamp) + 0.3 * np.sin(2.0 * np.pi * 1.1 * stamp)
    noisy = truth + 0.5 * rng.standard_normal(len(truth))
    noisy[100:120] = np.nan
    there = np.isfinite(noisy)
    quiet = expected(noisy)
    assert np.array_equal(np.isfinite(quiet), there)
    assert np.std(quiet[there] - truth[there]) < 0.4 * np.std(noisy[there] - truth[there])

    def slope(regressor: np.ndarray) -> float:
        return float(regressor[there] @ truth[there] / (regressor[there] @ regressor[there]))

    assert slope(noisy) < 0.8  # what noise does to a slope
    assert slope(quiet) == pytest.approx(1.0, abs=0.02)


def test_what_is_expected_of_a_signal_without_noise_is_that_signal() -> None:
    stamp = np.arange(4000) / 200.0
    signal = np.sign(np.sin(2.0 * np.pi * 0.4 * stamp))
    assert np.std(expected(signal) - signal) < 0.05
    short = np.array([1.0, 2.0, np.nan])
    assert np.array_equal(expected(short), short, equal_nan=True)


@pytest.mark.parametrize("lag", [0.0, 0.03])
def test_a_motor_that_lags_pushes_as_it_lags(tmp_path: Path, lag: float) -> None:
    """What it pushed without noise is told by its commands and its reports together: nearer to it than either alone."""
    physics = [{"name": "actuator_lag", "target": ["front_left"], "time_constant": lag}]
    robot = dataclasses.replace(FLOW_BASE, physics=read_physics(physics, FLOW_BASE.caster_names))
    excitation = make_excitation("identification", FLOW_BASE, 20.0, 0)
    record_run(robot, excitation.twist, excitation.duration, 3, tmp_path / "run", "reduced", controlled_as=FLOW_BASE)
    recording = Recording.open(tmp_path / "run", FLOW_BASE)
    known = quiet_torque(FLOW_BASE, recording)
    assert known is not None and not known[1].any()
    reported, commanded = recording.joint_states.effort, held_commands(FLOW_BASE, recording)
    assert reported is not None and commanded is not None
    noise = FLOW_BASE.sensors.encoders.torque_noise
    rest = (known[0] - reported)[20:-20, 0, DRIVE]
    # What is not noise would be in the difference, beyond the noise of the report.
    assert np.std(rest) == pytest.approx(noise, rel=0.15)
    if lag:
        assert np.std((commanded - reported)[20:-20, 0, DRIVE]) > 2.0 * noise
    else:
        assert np.std((known[0] - commanded)[20:-20, 0, DRIVE]) < 0.3 * noise


def test_errors_of_torques_are_told_by_the_balance_of_forces(tmp_path: Path) -> None:
    """The commands that a motor obeyed are the truth; an analysis that is not told of them comes nearer to it."""
    excitation = make_excitation("identification", FLOW_BASE, 20.0, 0)
    noisy = dataclasses.replace(
        FLOW_BASE,
        sensors=dataclasses.replace(
            FLOW_BASE.sensors, encoders=dataclasses.replace(FLOW_BASE.sensors.encoders, torque_noise=0.1)
        ),
    )
    record_run(noisy, excitation.twist, excitation.duration, 3, tmp_path / "run", "reduced")

    def motions(told: bool):  # type: ignore[no-untyped-def]
        recording = Recording.open(tmp_path / "run", noisy)
        if not told:
            recording.joint_commands = None
        builder = RobotProblemBuilder(noisy, [recording], CUTOFF)
        builder.build()
        return builder.motions

    (by_commands,), (by_reports,) = motions(told=True), motions(told=False)
    cosine, sine = np.cos(by_reports.position[:, :, STEER]), np.sin(by_reports.position[:, :, STEER])
    caster = noisy.casters[0]

    def error(torque: np.ndarray) -> float:
        """What the wheels together push more than they do by the commands [N], roughly: each at its lever."""
        more = torque - by_commands.quiet_torque
        along, across = more[:, :, DRIVE] / caster.wheel_radius, -more[:, :, STEER] / caster.caster_offset[0]
        pushed = [(cosine * along - sine * across).sum(axis=1), (sine * along + cosine * across).sum(axis=1)]
        seen = SignalFilter(by_reports.rate, CUTOFF).smooth(np.array(pushed).T)
        return float(np.std(seen[50:-50]))

    assert error(by_reports.balanced_torque) < 0.7 * error(by_reports.quiet_torque)


@pytest.mark.nightly  # a whole analysis, like that of others here
@pytest.mark.parametrize("excitation", ["figure8", "identification"])
def test_a_healthy_robot_whose_drives_hold_speeds_lacks_nothing(tmp_path: Path, excitation: str) -> None:
    """Torques read once a cycle, always before the next command: less than what was given by a part of what accelerates."""
    findings = found_in(run(FLOW_BASE, "velocity_loops", tmp_path, excitation, 40.0))
    assert findings.verdict == "no_mismatch" and not findings.effects and not findings.unknown
    assert not any("comes out" in note for note in findings.notes)
    if excitation == "identification":
        report = {number.name: number for number in findings.retuned}["torque_report.drive"]
        assert 0.05 < report.value < 0.2 and report.low > 0.02


@pytest.mark.parametrize(("controller", "told", "expected_numbers"), [
    ("velocity_loops", True, {"torque_report.drive", "torque_report.drive_behind"}),
    ("velocity_loops", False, {"torque_report.drive"}), ("computed_torque", True, set()),
])  # fmt: skip
def test_drives_of_unknown_commands_may_hold_speeds(
    tmp_path: Path, controller: str, told: bool, expected_numbers: set[str]
) -> None:
    """What they leave out of their reports was a payload of 3 kg, with certainty, beside a right caster offset."""
    recording = Recording.open(run(FLOW_BASE, controller, tmp_path, "steps", 12.0), FLOW_BASE)
    if not told:
        recording.joint_commands = None
    problem = RobotProblemBuilder(FLOW_BASE, [recording], CUTOFF).build(with_terms=False)
    assert {n.name for n in problem.nuisances if n.name.startswith("torque_report.drive")} == expected_numbers


@pytest.mark.parametrize("controller", ["velocity_loops", "computed_torque"])
def test_an_accelerometer_may_be_read_in_step_with_drives_that_hold_speeds(tmp_path: Path, controller: str) -> None:
    """A healthy robot was told of an accelerometer that reads 9 % too much, for certain; torques leap once a cycle alone."""
    robot = load_robot("thesis")
    recording = Recording.open(run(robot, controller, tmp_path, "steps", 12.0), robot)
    problem = RobotProblemBuilder(robot, [recording], CUTOFF).build(with_terms=False)
    found = {n.name: n.deviation for n in problem.nuisances if n.name.startswith("imu.report")}
    assert set(found) == ({"imu.report.x", "imu.report.y"} if controller == "velocity_loops" else set())
    cycle = float(np.median(np.diff(recording.joint_states.stamp)))
    assert list(found.values()) == pytest.approx([50.0 * cycle / math.sqrt(3.0)] * len(found), rel=0.01)


@pytest.mark.parametrize("controller", ["velocity_loops", "computed_torque"])
def test_what_drives_do_not_report_while_a_caster_flips_is_no_finding(tmp_path: Path, controller: str) -> None:
    """Of 5 % of the samples a healthy robot that strafed to and fro was told of a torque by all steerings and its speed."""
    recording = Recording.open(run(FLOW_BASE, controller, tmp_path, "strafe", 29.0), FLOW_BASE)
    problem = RobotProblemBuilder(FLOW_BASE, [recording], CUTOFF).build(with_terms=False)
    assert problem.misjudged is not None
    steering = np.stack([problem.variables[f"steer_velocity/{name}"] for name in FLOW_BASE.caster_names], axis=1)
    fastest, valid = np.abs(steering).max(axis=1), problem.valid[:, FORCES].all(axis=1)
    flips, rolls = valid & (fastest > 6.0), valid & (fastest < 0.2)
    assert flips.sum() > 5 and rolls.sum() > 100
    in_flips, rolling = (np.sqrt(np.mean(problem.misjudged[rows, FORCES] ** 2, axis=0)) for rows in (flips, rolls))
    print(in_flips, rolling)
    if controller == "velocity_loops":
        assert np.all(in_flips > 5.0 * rolling)
    else:
        assert not problem.misjudged[:, FORCES].any()


def test_no_factor_of_all_torques_and_masses_takes_errors_away(tmp_path: Path) -> None:
    """Of the errors of a robot that obeys its commands half were weaker motors of a lighter robot."""
    robot = load_robot("tidybot2")
    path = run(robot, "computed_torque", tmp_path, "identification", 20.0)
    problem = RobotProblemBuilder(robot, [Recording.open(path, robot)]).build()
    rows = problem.valid[:, FORCES].all(axis=1)
    residual = problem.residual[rows, FORCES]
    deviation = residual.std(axis=0)

    def unexplained(columns: list[np.ndarray]) -> float:
        """The part of the mean square that no sum of columns (T, C) explains."""
        design = np.stack([(c[rows, FORCES] / deviation).ravel() for c in columns], axis=1)
        design /= np.linalg.norm(design, axis=0)
        target = (residual / deviation).ravel()
        left = target - design @ np.linalg.lstsq(design, target, rcond=1e-10)[0]
        return float(np.mean(left**2) / np.mean(target**2))

    masses = [number.column for number in problem.nuisances if number.name.startswith(INSTRUMENTS)]
    gains = [
        problem.columns(index, ())[:, :, 0] for index, term in enumerate(problem.terms)
        if term.effect == "torque_constant_error" and len(term.target) == robot.n
    ]  # fmt: skip
    assert len(gains) == 2
    assert unexplained([*masses, *gains]) > 0.75 * unexplained(masses)


@pytest.mark.nightly  # a whole analysis, like that of others here
@pytest.mark.parametrize(
    ("name", "controller", "mass"), [("flow_base", "velocity_loops", 5.0), ("tidybot2", "computed_torque", 15.0)]
)
def test_a_payload_is_no_weakness_of_all_motors(tmp_path: Path, name: str, controller: str, mass: float) -> None:
    """A fit that makes all torques and masses smaller makes all errors smaller, too, and would be preferred for that."""
    robot = load_robot(name)
    physics = [{"name": "payload_mass", "target": ["chassis"], "mass": mass, "x": -0.124, "y": 0.095}]
    effects = read_physics(physics, robot.caster_names)
    findings = found_in(run(robot, controller, tmp_path, "identification", 40.0, *effects), robot)
    (effect,) = findings.effects
    assert effect.name == "payload_mass" and not effect.ambiguous_with
    assert effect.parameters["mass"].value == pytest.approx(mass, rel=0.1)
