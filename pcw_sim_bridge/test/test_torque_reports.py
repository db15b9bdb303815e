"""Torques that are known from reports alone: their noise, and what drives that hold speeds leave out of them."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from pcw_control.excitation import make_excitation
from pcw_description import load_robot
from pcw_description.effect_instance import EffectInstance
from pcw_description.effects.registry import read_physics
from pcw_description.recording import Recording
from pcw_description.robot_description import DRIVE, STEER
from pcw_sim_bridge.mismatch.analysis import analyse
from pcw_sim_bridge.mismatch.findings import Findings
from pcw_sim_bridge.mismatch.held_commands import expected, held_commands, quiet_torque
from pcw_sim_bridge.mismatch.robot_channels import RobotProblemBuilder
from pcw_sim_bridge.mismatch.robot_subject import RobotSubject
from pcw_sim_bridge.mismatch.signal_filter import SignalFilter
from pcw_sim_bridge.simulated_run import record_run

# Its steering has a lever of 20 mm: a little torque is a large force, and its drives hold speeds.
FLOW_BASE = load_robot("flow_base")
CUTOFF = 5.0  # [Hz]


def held_speeds(folder: Path, excitation_name: str, duration: float, *effects: EffectInstance) -> Path:
    """Record a robot whose drives hold the speeds that they are commanded."""
    robot = dataclasses.replace(FLOW_BASE, physics=effects)
    excitation = make_excitation(excitation_name, robot, duration, 0)
    record_run(
        robot, excitation.twist, excitation.duration, 5, folder / "run", "reduced", controlled_as=FLOW_BASE,
        controller_name="velocity_loops",
    )  # fmt: skip
    return folder / "run"


def found_in(path: Path) -> Findings:
    return analyse(RobotSubject(FLOW_BASE), [path], [], {}, 0, lambda message: None).findings


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


def test_errors_of_reported_torques_are_told_by_the_balance_of_forces(tmp_path: Path) -> None:
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
    assert not by_commands.reported.any() and by_reports.reported.all()
    assert np.array_equal(by_commands.balanced_torque, by_commands.quiet_torque)
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


@pytest.mark.parametrize("excitation", ["figure8", "identification"])
def test_a_healthy_robot_whose_drives_hold_speeds_lacks_nothing(tmp_path: Path, excitation: str) -> None:
    """Torques read once a cycle, always before the next command: less than what was given by a part of what accelerates."""
    findings = found_in(held_speeds(tmp_path, excitation, 40.0))
    assert findings.verdict == "no_mismatch" and not findings.effects and not findings.unknown
    assert not any("comes out" in note for note in findings.notes)
    if excitation == "identification":
        report = {number.name: number for number in findings.retuned}["torque_report.drive"]
        assert 0.05 < report.value < 0.2 and report.low > 0.02


def test_a_payload_is_no_weakness_of_all_motors(tmp_path: Path) -> None:
    """A fit that makes all torques smaller makes their errors smaller, too, and would be preferred for that."""
    physics = [{"name": "payload_mass", "target": ["chassis"], "mass": 5.0, "x": 0.05, "y": 0.1}]
    findings = found_in(held_speeds(tmp_path, "identification", 40.0, *read_physics(physics, FLOW_BASE.caster_names)))
    (effect,) = findings.effects
    assert effect.name == "payload_mass"
    assert effect.parameters["mass"].value == pytest.approx(5.0, rel=0.1)
