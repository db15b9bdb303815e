"""Wheels that shake: told from noise of angles and of torques, with the speed at the ground."""

import numpy as np
import pytest

from pcw_description import load_robot
from pcw_sim_bridge.mismatch.analysis import analyse
from pcw_sim_bridge.mismatch.regression.signal_filter import SignalFilter
from pcw_sim_bridge.mismatch.robot.wheel_shaking import wheel_shaking
from pcw_sim_bridge.mismatch.subjects.robot_subject import RobotSubject
from pcw_sim_bridge.simulate import main as simulate

ROBOT = load_robot("thesis")
RATE, SAMPLES = 500.0, 4000
DRIVE_INERTIA = ROBOT.casters[0].rotors.drive + ROBOT.casters[0].wheel.inertia_axle
LOW_PASS = SignalFilter(RATE, 15.0)
NO_SPEED = np.full((SAMPLES, ROBOT.n, 2), np.nan)


def rolling() -> tuple[np.ndarray, np.ndarray]:
    """A slow motion and the torques of it (T, n, 2)."""
    time = np.arange(SAMPLES) / RATE
    angle = np.sin(2.0 * np.pi * 0.5 * time)[:, None, None] * np.ones((1, ROBOT.n, 2))
    return 3.0 * angle, 0.5 * angle


@pytest.mark.parametrize("frequency", [40.0, 110.0, 249.0])
def test_a_wheel_that_shakes_is_found_up_to_half_the_rate(frequency):
    """A torque that swings about an inertia alone: its amplitude over inertia and frequency, at the radius."""
    position, torque = rolling()
    swing = 0.05
    phase = 2.0 * np.pi * frequency * np.arange(SAMPLES) / RATE + 0.3
    torque[:, 2, 0] += DRIVE_INERTIA * swing * (2.0 * np.pi * frequency) * np.cos(phase)
    position[:, 2, 0] += swing / (2.0 * np.pi * frequency) * -np.cos(phase)
    found = wheel_shaking(ROBOT, position, NO_SPEED, torque, LOW_PASS)
    # From sample to sample a sine of the frequency f moves by 2 sin(pi f / rate) of its amplitude.
    seen = 2.0 * np.sin(np.pi * frequency / RATE) * swing / (2.0 * np.pi * frequency) * RATE
    by_torque = np.pi * frequency / RATE / np.sin(np.pi * frequency / RATE) * swing
    middle = found.speed[SAMPLES // 4 : -SAMPLES // 4]
    assert np.median(middle) == pytest.approx(ROBOT.wheel_radius[2] * min(seen, by_torque), rel=0.1)
    assert found.frequency == pytest.approx(frequency, abs=1.0)


def test_a_torque_that_changes_its_sign_with_every_sample_is_found_by_the_speeds():
    """The wheel is where it was after two samples: in its angles there is a small part of how it shakes."""
    position, torque = rolling()
    sign = (-1.0) ** np.arange(SAMPLES)
    torque[:, 2, 0] += 1.4 * DRIVE_INERTIA * RATE * 2.0 * sign
    velocity = np.gradient(position, 1.0 / RATE, axis=0)
    velocity[:, 2, 0] += 1.4 * sign
    position[:, 2, 0] += 1e-4 * sign
    middle = slice(SAMPLES // 4, -SAMPLES // 4)
    by_angles = wheel_shaking(ROBOT, position, NO_SPEED, torque, LOW_PASS)
    found = wheel_shaking(ROBOT, position, velocity, torque, LOW_PASS)
    assert np.median(found.speed[middle]) == pytest.approx(1.4 * np.sqrt(2.0) * ROBOT.wheel_radius[2], rel=0.1)
    assert found.frequency == pytest.approx(RATE / 2.0, abs=1.0)
    assert np.median(by_angles.speed[middle]) < 0.1 * np.median(found.speed[middle])


def test_a_joint_that_shakes_with_every_sample_is_read_at_a_speed_that_it_does_not_have():
    """A loop that swung at its own 300 Hz left angles still, speeds of 1.6 rad/s and torques of 4 N m."""
    position, torque = rolling()
    velocity = np.gradient(position, 1.0 / RATE, axis=0)
    velocity[:, 1, 1] = 1.6
    position[:, 1, 1] = 0.3
    torque[:, 1, 1] -= 4.0
    found = wheel_shaking(ROBOT, position, velocity, torque, LOW_PASS)
    middle = slice(SAMPLES // 4, -SAMPLES // 4)
    reach = float(np.linalg.norm(ROBOT.caster_offset[1]))
    np.testing.assert_allclose(found.speed[middle], 1.6 * reach, rtol=0.02)
    assert found.frequency == RATE


@pytest.mark.parametrize(
    "read",
    [
        lambda rate: np.zeros_like(rate),  # a field that nobody fills
        lambda rate: 20.0 * rate,  # of the motor before its gear
        lambda rate: np.apply_along_axis(lambda v: np.convolve(v, np.ones(15) / 15.0)[: len(v)], 0, rate),  # a drive's filter
        lambda rate: rate + 0.1 * np.random.default_rng(4).standard_normal(rate.shape),
    ],
)
def test_speeds_that_lag_or_are_in_other_units_are_no_shaking(read):
    position, torque = rolling()
    velocity = read(np.gradient(position, 1.0 / RATE, axis=0))
    found = wheel_shaking(ROBOT, position, velocity, torque, LOW_PASS)
    assert found.speed[SAMPLES // 8 : -SAMPLES // 8].max() < 2e-3


def test_noise_of_one_sensor_is_no_shaking():
    """Coarse encoders alone, noisy speeds and noisy torques alone, each large enough to pass for 0.1 m/s."""
    position, torque = rolling()
    rng = np.random.default_rng(0)
    coarse = position + rng.uniform(-4e-3, 4e-3, position.shape)
    noisy = torque + 20.0 * DRIVE_INERTIA * rng.standard_normal(torque.shape)
    speed = np.gradient(position, 1.0 / RATE, axis=0)
    rough = speed + 1.5 * rng.standard_normal(speed.shape)
    for one, own, other in ((coarse, NO_SPEED, torque), (position, rough, torque), (position, speed, noisy)):
        assert np.quantile(wheel_shaking(ROBOT, one, own, other, LOW_PASS).speed, 0.99) < 0.005


def test_nothing_is_said_without_torques():
    position, torque = rolling()
    found = wheel_shaking(ROBOT, position, NO_SPEED, np.full_like(torque, np.nan), LOW_PASS)
    assert not found.speed.any()
    assert found.frequency == 0.0


@pytest.mark.parametrize(("amplitude", "noise", "seen"), [(0.04, 1e-4, 0.04), (0.01, 1e-4, 0.01), (0.01, 0.05, 0.0)])
def test_a_caster_that_swings_without_torque(amplitude, noise, seen):
    """Rolling freely it does so by itself: angles alone say it, where their noise does not do the same."""
    position, torque = rolling()
    time = np.arange(SAMPLES) / RATE
    position[:, 1, 1] += amplitude * np.sin(2.0 * np.pi * 30.0 * time)
    position += noise * np.random.default_rng(1).standard_normal(position.shape)
    middle = slice(SAMPLES // 4, -SAMPLES // 4)
    for known in (torque, np.full_like(torque, np.nan)):
        swing = wheel_shaking(ROBOT, position, NO_SPEED, known, LOW_PASS).swing
        assert np.median(swing[middle]) == pytest.approx(seen, rel=0.1, abs=1e-6)


@pytest.mark.parametrize("controller", ["velocity_loops", "computed_torque"])
def test_shimmy_is_no_effect(tmp_path, controller):
    """Eight times a second, with motors off: it was named a push, and 69 % of the drives' torque that is not there."""
    run = ["--robot", "tidybot2", "--excite", "coast_down", "--plant", "reduced", "--controller", controller]
    assert simulate([*run, "--duration", "29", "--seed", "7", "--out", str(tmp_path / "run")]) == 0
    found = analyse(RobotSubject(load_robot("tidybot2")), [tmp_path / "run"], [], {}, 0, lambda message: None).findings
    assert (found.verdict, found.effects, found.unknown) == ("no_mismatch", (), ())
    assert any("casters swing about their steering axes" in note and "(shimmy)" in note for note in found.notes)
