"""What a healthy robot's encoders may contradict, from its file and from a file of its own."""

import dataclasses

import numpy as np
import pytest

from pcw_description import load_robot, shipped_robots
from pcw_estimation import EstimationError, SlipNoise, load_slip_noise
from pcw_estimation.slip_noise import sensed_kernel, variance_kernel

THESIS = load_robot("thesis")


def variance(noise, velocity, omega=0.0):
    sensed = sensed_kernel(THESIS.caster_offset, THESIS.wheel_radius, velocity)
    return variance_kernel(THESIS.caster_offset, THESIS.wheel_radius, velocity, sensed, omega, noise.array())


@pytest.mark.parametrize("name", shipped_robots())
def test_every_shipped_robot_has_one(name):
    noise = SlipNoise.of_robot(load_robot(name))
    assert all(value > 0.0 for value in dataclasses.asdict(noise).values())


def test_looser_tolerances_and_coarser_encoders_make_more_noise():
    robust, own = SlipNoise.of_robot(load_robot("dyros_pcv")), SlipNoise.of_robot(THESIS)
    assert robust.rolling_fraction > 3.0 * own.rolling_fraction  # radii off by 1.3 % and zeros by 0.02 rad
    encoders = dataclasses.replace(THESIS.sensors.encoders, drive_counts=1024)
    coarse = dataclasses.replace(THESIS, sensors=dataclasses.replace(THESIS.sensors, encoders=encoders))
    assert SlipNoise.of_robot(coarse).drive_noise == pytest.approx(4.0 * own.drive_noise, rel=0.1)


def test_variance_grows_with_speed_steering_and_turning():
    noise = SlipNoise.of_robot(THESIS)
    at_rest, white = variance(noise, np.zeros((4, 2)))
    np.testing.assert_array_equal(at_rest, white)
    rolling = np.zeros((4, 2))
    rolling[1, 0] = 10.0
    faster, _ = variance(noise, rolling)
    assert faster[1, 0] == pytest.approx(at_rest[1, 0] + (noise.rolling_fraction * 0.75) ** 2)
    assert (faster[[0, 2, 3]] == at_rest[[0, 2, 3]]).all()
    steering = np.zeros((4, 2))
    steering[1, 1] = 8.0
    assert (variance(noise, steering)[0][1] > at_rest[1]).all()
    assert (variance(noise, np.zeros((4, 2)), omega=1.0)[0] > at_rest).all()


def test_file_is_read_as_it_was_written(tmp_path):
    noise = dataclasses.replace(SlipNoise.of_robot(THESIS), gate=6.5)
    noise.save(tmp_path / "noise.yaml", "thesis", "a test")
    again = load_slip_noise(tmp_path / "noise.yaml", THESIS)
    np.testing.assert_allclose(again.array(), noise.array(), rtol=1e-5)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda text: text.replace("robot: thesis", "robot: tidybot2"), "robot = 'tidybot2' is not allowed"),
        (lambda text: text.replace("pcw_slip_noise/1", "pcw_slip_noise/9"), "format = 'pcw_slip_noise/9' is not allowed"),
        (lambda text: text + "steer_nose: 1.0\n", "steer_nose = 1.0 is not known; .*steer_noise"),
        (lambda text: text.replace("gate: 5.0", "gate: .nan"), "gate = nan is not allowed; allowed: a finite"),
        (lambda text: text.replace("gate: 5.0", "gate: yes"), "gate = True is not allowed"),
        (lambda text: "\n".join(line for line in text.splitlines() if "drive_noise" not in line), "drive_noise = None"),
        (lambda text: "[", "is no YAML"),
        (lambda text: "", "format = 'NoneType'"),
    ],
)
def test_refuses_what_it_cannot_use(tmp_path, change, message):
    SlipNoise.of_robot(THESIS).save(tmp_path / "noise.yaml", "thesis")
    file = tmp_path / "noise.yaml"
    file.write_text(change(file.read_text()))
    with pytest.raises(EstimationError, match=message):
        load_slip_noise(file, THESIS)
    with pytest.raises(EstimationError, match="cannot be read"):
        load_slip_noise(tmp_path / "nowhere.yaml", THESIS)
