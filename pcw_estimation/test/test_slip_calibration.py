"""Noise learned from a healthy recording: fewer false alarms on a sloppy robot, and no silent nonsense."""

import dataclasses
import re

import numpy as np
import pytest
import yaml

from pcw_description import load_robot
from pcw_description.recording_writer import RecordingWriter
from pcw_description.ros_messages import joint_state
from pcw_estimation import EstimationError, calibrate, load_slip_noise, slip_calibration
from pcw_estimation.studies.drawn_drives import DriveStyle, as_built, drawn_twist, drive
from pcw_estimation.studies.encoder_study import run

THESIS = load_robot("thesis")


def driven(seed, built=None, duration=25.0, slip=None):
    rng = np.random.default_rng(seed)
    twist = drawn_twist(rng, duration, DriveStyle())
    amount = np.zeros((len(twist), 4, 2))
    if slip is not None:
        amount[5000:9000, 1, 0] = slip
    return drive(THESIS, twist, amount, rng, built=built)


@pytest.fixture(scope="module")
def sloppy():
    """The thesis robot with geometry twice as far off as the DYROS PCV's: twenty times what its own file says."""
    tolerances = {k: dataclasses.replace(t, value=2.0 * t.value) for k, t in load_robot("dyros_pcv").tolerances.items()}
    loose = dataclasses.replace(THESIS, tolerances=tolerances)
    return as_built(loose, np.random.default_rng(4))


def alarms(case, noise):
    flags = run("consensus", case, noise).flagged.any(axis=(1, 2))
    return int(np.count_nonzero(np.diff(flags.astype(int)) > 0))


def record(path, case):
    with RecordingWriter(path, flush_interval=None) as writer:
        for k, stamp in enumerate(case.stamp):
            now = 1_000_000_000 + round(stamp * 1e9)
            writer.write("/joint_states", joint_state(now, THESIS.joint_names, case.position[k], case.velocity[k], None), now)


def test_learned_noise_silences_false_alarms_on_other_drives(sloppy):
    case = driven(20, sloppy)
    result = calibrate(THESIS, case.stamp, case.position, case.velocity)
    others = [driven(seed, sloppy) for seed in (21, 22, 23)]
    assert sum(alarms(other, None) for other in others) > 0
    assert sum(alarms(other, result.noise) for other in others) == 0
    # And slip is still found.
    assert run("consensus", driven(24, sloppy, slip=0.3), result.noise).flagged[2600:4400, 1, 0].mean() > 0.9


def test_well_made_robot_is_found_to_be_one():
    case = driven(30, (THESIS, np.zeros(4)))
    result = calibrate(THESIS, case.stamp, case.position, case.velocity)
    assert result.noise.rolling_fraction < 1e-3 and result.noise.gate == 5.0
    assert result.noise.drive_noise == pytest.approx(0.005, rel=0.25)  # velocity_noise of the file


def test_what_was_not_driven_keeps_the_number_of_the_file():
    rng = np.random.default_rng(3)
    steps = 15000
    twist = np.zeros((steps, 3))
    twist[:, 0] = 0.5 * np.clip(np.arange(steps) / 1000.0, 0.0, 1.0)
    case = drive(THESIS, twist, np.zeros((steps, 4, 2)), rng)
    rows = slice(2000, None)  # the headings have settled: nothing steers, nothing turns
    result = calibrate(THESIS, case.stamp[rows], case.position[rows], case.velocity[rows])
    assert {"steering_length", "heading_delay", "turning_length"} <= set(result.kept)


def test_refuses_a_robot_file_that_does_not_match_slip_and_a_robot_at_rest():
    case = driven(40)
    other = dataclasses.replace(
        THESIS, casters=tuple(dataclasses.replace(c, caster_offset=(-c.caster_offset[0], 0.0)) for c in THESIS.casters)
    )
    with pytest.raises(EstimationError, match="_length = .* is not allowed; allowed: at most .*does not match"):
        calibrate(other, case.stamp, case.position, case.velocity)
    with pytest.raises(EstimationError, match="driving = 0 s above 0.05 m/s is not allowed; allowed: at least 10 s"):
        calibrate(THESIS, case.stamp, case.position, 0.0 * case.velocity)
    with pytest.raises(EstimationError, match="joint_states = all incomplete"):
        calibrate(THESIS, case.stamp, case.position, np.nan * case.velocity)


def test_the_command_reads_a_recording_and_writes_what_the_node_takes(tmp_path, capsys):
    record(tmp_path / "healthy", driven(50, duration=16.0))
    out = tmp_path / "noise.yaml"
    arguments = [str(tmp_path / "healthy"), "--robot", "thesis", "--out", str(out)]
    assert slip_calibration.main(arguments) == 0
    noise = load_slip_noise(out, THESIS)
    assert 0.0 < noise.rolling_fraction < 0.02 and "healthy" in yaml.safe_load(out.read_text())["provenance"]
    assert "rolling_fraction" in capsys.readouterr().out
    learned = out.read_text(encoding="utf-8")
    assert slip_calibration.main(arguments) == 2
    assert "exists already and is left as it is" in capsys.readouterr().err and out.read_text(encoding="utf-8") == learned
    out = tmp_path / "other.yaml"
    arguments[-1] = str(out)
    for bad, said in (
        (["/no/such", "--robot", "thesis", "--out", str(out)], "/no/such"),
        ([arguments[0], "--robot", "thesiss", "--out", str(out)], "thesiss"),
        ([arguments[0], "--robot", "tidybot2", "--out", str(out)], "_length = .*does not match"),
        ([arguments[0], "--robot", "thesis", "--out", "/no/such/folder/noise.yaml"], "no folder /no/such/folder;"),
        ([*arguments, "--confirm-time", "-1"], "confirm_time = -1.0 s is not allowed; allowed: 0 to 10"),
    ):
        assert slip_calibration.main(bad) == 2
        error = capsys.readouterr().err
        assert re.search(said, error), error
