"""`mismatch analyze` on recordings with something wrong: it is named, the rest is used, and nothing is left half done.

One drive of a robot with a concealed friction serves all; each test spoils it in one way and runs the command.
"""

import dataclasses
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import yaml

from pcw_description import load_robot, ros_messages
from pcw_description.effect_instance import EffectInstance
from pcw_description.recording import Recording
from pcw_description.recording_writer import RecordingWriter
from pcw_description.robot_description import Caster
from pcw_description.robot_file import robot_to_mapping
from pcw_sim_bridge.mismatch.__main__ import main
from pcw_sim_bridge.simulated_run import record_run

THESIS = load_robot("thesis")
COULOMB = 0.8
FRICTION = EffectInstance(
    "drive_coulomb_friction", ("rear_left",), {"coulomb": COULOMB, "asymmetry": 0.0, "smoothing_speed": 0.05}
)
DEGREES = 180.0 / np.pi


def wandering(time_: float) -> np.ndarray:
    """Return a twist that moves all three axes at speeds of no common period."""
    return min(time_, 1.0) * np.array(
        [0.5 * np.sin(1.3 * time_), 0.4 * np.sin(0.9 * time_ + 1.0), 0.7 * np.sin(0.7 * time_)]
    )


@dataclasses.dataclass
class Drive:
    """A recording as arrays, to be spoilt and written again; joint arrays (T, 2n)."""

    names: list[str]
    stamp_ns: np.ndarray
    position: np.ndarray
    velocity: np.ndarray
    effort: np.ndarray
    imu: bool = True
    accelerometer: bool = True
    truth: bool = True
    source: Recording | None = None

    def keep(self, rows: np.ndarray) -> "Drive":
        """The drive with some of the joint messages, or with those in another order."""
        fields = ("stamp_ns", "position", "velocity", "effort")
        return dataclasses.replace(self, **{name: getattr(self, name)[rows] for name in fields})

    def write(self, path: Path) -> Path:
        """Write it as a recording."""
        assert self.source is not None
        with RecordingWriter(path) as writer:
            first = int(self.stamp_ns[0]) if len(self.stamp_ns) else 0
            for row, stamp in enumerate(self.stamp_ns.tolist()):
                values = (self.position[row], self.velocity[row], self.effort[row])
                writer.write("/joint_states", ros_messages.joint_state(stamp, self.names, *values), first + row * 2_000_000)
            imu, truth = self.source.imu, self.source.ground_truth
            if self.imu and imu is not None:
                for stamp, gyro, acceleration in zip(imu.stamp_ns.tolist(), imu.gyro, imu.acceleration, strict=True):
                    felt = acceleration if self.accelerometer else np.zeros(3)
                    writer.write("/imu/data", ros_messages.imu(stamp, gyro, felt), stamp)
            if self.truth and truth is not None:
                for stamp, pose, twist in zip(truth.stamp_ns.tolist(), truth.pose, truth.twist, strict=True):
                    writer.write("/ground_truth/odom", ros_messages.odometry(stamp, pose, twist), stamp)
        return path


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The healthy recording of a robot with friction."""
    path = tmp_path_factory.mktemp("recorded") / "run"
    record_run(dataclasses.replace(THESIS, physics=(FRICTION,)), wandering, 14.0, 1, path, controlled_as=THESIS)
    return path


@pytest.fixture
def drive(recorded: Path) -> Drive:
    """Its arrays, to be spoilt."""
    source = Recording.open(recorded, THESIS)
    joints = source.joint_states
    position, velocity, effort = (
        values.reshape(len(joints.stamp), -1).copy() for values in (joints.position, joints.velocity, joints.effort)
    )
    return Drive(list(THESIS.joint_names), joints.stamp_ns.copy(), position, velocity, effort, source=source)


def analyse(capsys: pytest.CaptureFixture[str], path: Path, out: Path, *options: str) -> tuple[int, str, dict[str, object]]:
    """Run the command: exit code, standard error, report.json."""
    code = main(["analyze", str(path), "--robot", "thesis", "--out", str(out), "--quiet", *options])
    report = json.loads((out / "report.json").read_text()) if (out / "report.json").exists() else {}
    return code, capsys.readouterr().err, report


def gap(drive: Drive) -> Drive:
    rows = np.arange(len(drive.stamp_ns))
    return drive.keep(rows[(rows < 3000) | (rows > 3600)])


def repeats(drive: Drive) -> Drive:
    drive.stamp_ns[2000:2040:2] = drive.stamp_ns[1999:2039:2]
    return drive


def backward(drive: Drive) -> Drive:
    rows = np.arange(len(drive.stamp_ns))
    rows[2500:2520] -= 100
    return drive.keep(rows)


def not_a_number(drive: Drive) -> Drive:
    drive.position[1000:1010, 3] = np.nan
    drive.effort[4000:4005] = np.inf
    return drive


def degrees(drive: Drive) -> Drive:
    drive.position *= DEGREES
    return drive


def revolutions_per_minute(drive: Drive) -> Drive:
    drive.velocity *= 60.0 / (2.0 * np.pi)
    return drive


def velocity_in_counts(drive: Drive) -> Drive:
    drive.velocity = np.round(drive.velocity * 4096.0 / (2.0 * np.pi))
    return drive


def without_truth(drive: Drive) -> Drive:
    return dataclasses.replace(drive, truth=False)


def without_imu(drive: Drive) -> Drive:
    return dataclasses.replace(drive, imu=False)


def without_accelerometer(drive: Drive) -> Drive:
    """Of an IMU with a gyro alone most drivers leave the accelerations at zero."""
    return dataclasses.replace(drive, accelerometer=False)


@pytest.mark.parametrize(
    ("spoil", "says"),
    [
        (gap, "gap"),
        pytest.param(repeats, "stamp", marks=pytest.mark.nightly),
        pytest.param(backward, "back", marks=pytest.mark.nightly),
        pytest.param(not_a_number, "NaN", marks=pytest.mark.nightly),
        pytest.param(degrees, "degrees", marks=pytest.mark.nightly),
        pytest.param(revolutions_per_minute, "rpm", marks=pytest.mark.nightly),
        pytest.param(velocity_in_counts, "counts", marks=pytest.mark.nightly),
        pytest.param(without_truth, "", marks=pytest.mark.nightly),
        pytest.param(without_imu, "", marks=pytest.mark.nightly),
        (without_accelerometer, ""),
    ],
    ids=lambda value: value.__name__ if callable(value) else "",
)
def test_what_is_wrong_is_named_and_the_rest_is_used(
    spoil: Callable[[Drive], Drive], says: str, drive: Drive, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The friction is found all the same, and the report says what the recording lacks."""
    path = spoil(drive).write(tmp_path / "run")
    code, errors, report = analyse(capsys, path, tmp_path / "report")
    assert (code, errors) == (0, "")
    [effect] = report["effects"]
    assert (effect["name"], effect["target"]) == ("drive_coulomb_friction", ["rear_left"])
    assert effect["parameters"]["coulomb"]["value"] == pytest.approx(COULOMB, rel=0.05)
    warnings = report["inputs"][0]["warnings"]
    if says:
        assert any(says in warning for warning in warnings), warnings
    else:
        lacks = {without_truth: "ground_truth/odom", without_imu: "imu/data"}.get(spoil, "linear_acceleration in imu/data")
        assert any(entry["sensor"] == lacks for entry in report["absent"])


def test_a_missing_caster_is_named_and_the_others_are_used(
    drive: Drive, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Without the force of one caster no forces can be judged; what the other wheels and the IMU say still can."""
    kept = [k for k, name in enumerate(drive.names) if not name.startswith("front_right")]
    arrays = {name: getattr(drive, name)[:, kept] for name in ("position", "velocity", "effort")}
    fewer = dataclasses.replace(drive, names=[drive.names[k] for k in kept], **arrays)
    code, errors, report = analyse(capsys, fewer.write(tmp_path / "run"), tmp_path / "report")
    assert (code, errors) == (0, "")
    assert any("caster front_right is missing" in warning for warning in report["inputs"][0]["warnings"])
    assert {channel["name"] for channel in report["channels"]} >= {"gyro", "accelerometer/x", "accelerometer/y"}
    assert not any("force" in channel["name"] for channel in report["channels"])
    assert any(entry["sensor"] == "caster front_right" for entry in report["absent"])


@pytest.mark.parametrize(
    ("joints", "value", "says"),
    [
        (slice(None), 0.0, "the effort of every joint is 0 throughout"),
        (slice(2, 3), np.nan, "effort of some joints is not known: that of front_right_drive is NaN"),
        (slice(2, 4), 0.0, "that of front_right_drive, front_right_steer is the same throughout although they move"),
    ],
    ids=["zeros", "one is NaN", "two are always zero"],
)
def test_torques_that_were_not_measured_are_named_and_the_motion_is_used(
    joints: slice, value: float, says: str, drive: Drive, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Zeros were taken for torques, which ended in an error after minutes; one NaN left no sample at all."""
    drive.effort[:, joints] = value
    code, errors, report = analyse(capsys, drive.write(tmp_path / "run"), tmp_path / "report")
    assert (code, errors) == (0, "")
    assert [says in warning for warning in report["inputs"][0]["warnings"]].count(True) == 1
    assert {channel["name"] for channel in report["channels"]} >= {"gyro", "accelerometer/x", "accelerometer/y"}
    assert not any("force" in channel["name"] for channel in report["channels"])
    assert not report["effects"]
    assert any(entry["sensor"] == "effort in joint_states" for entry in report["absent"])


def test_angles_in_counts_are_named_and_nothing_is_made_of_them(
    drive: Drive, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Nobody knows how many counts a turn has; the message says why nothing is left."""
    drive.position = np.round(drive.position * 4096.0 / (2.0 * np.pi))
    code, errors, _ = analyse(capsys, drive.write(tmp_path / "run"), tmp_path / "report")
    assert code == 2
    assert "counts" in errors
    assert len(errors.splitlines()) == 1
    assert not (tmp_path / "report").exists()


def test_an_empty_recording_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Neither an empty folder nor a recording without messages is one."""
    (tmp_path / "nothing").mkdir()
    with RecordingWriter(tmp_path / "silent"):
        pass
    for name in ("nothing", "silent"):
        code, errors, _ = analyse(capsys, tmp_path / name, tmp_path / "report")
        assert code == 2
        assert errors.startswith("mismatch: ") and name in errors and len(errors.splitlines()) == 1
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["nothing", "silent"]


def test_a_misspelt_robot_is_told_by_its_name(recorded: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["analyze", str(recorded), "--robot", "thesi", "--out", str(tmp_path / "out"), "--quiet"]) == 2
    message = capsys.readouterr().err
    assert "'thesi'" in message and "did you mean 'thesis'?" in message and message.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_a_recording_of_another_robot_is_refused(drive: Drive, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """By the names of its joints."""
    drive.names = [f"arm_{k}" for k in range(len(drive.names))]
    code, errors, _ = analyse(capsys, drive.write(tmp_path / "run"), tmp_path / "report")
    assert code == 2
    assert "not of this robot" in errors and "arm_0" in errors
    assert not (tmp_path / "report").exists()


def test_a_recording_of_a_robot_with_the_same_names_is_doubted(
    recorded: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Names alone do not tell: wheels that contradict each other by the geometry of the description do."""

    def larger(caster: Caster) -> Caster:
        return dataclasses.replace(caster, wheel_radius=2.0 * caster.wheel_radius)

    other = dataclasses.replace(THESIS, name="other", casters=(*map(larger, THESIS.casters[:2]), *THESIS.casters[2:]))
    (tmp_path / "other.yaml").write_text(yaml.safe_dump(robot_to_mapping(other)))
    code = main(
        ["analyze", str(recorded), "--robot", str(tmp_path / "other.yaml"), "--out", str(tmp_path / "report"), "--quiet"]
    )
    assert capsys.readouterr().err == ""
    report = json.loads((tmp_path / "report" / "report.json").read_text())
    assert code == 0
    assert report["verdict"] in ("insufficient_data", "unexplained", "partly_explained")
    assert any("another robot" in warning for warning in report["inputs"][0]["warnings"])


def test_three_seconds_and_standstill_are_too_little(drive: Drive, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Both are a verdict of their own, and the report says what was lacking."""
    short = drive.keep(np.arange(1500))
    code, errors, report = analyse(capsys, short.write(tmp_path / "short"), tmp_path / "report_short")
    assert (code, errors, report["verdict"]) == (0, "", "insufficient_data")
    rng = np.random.default_rng(0)
    for values, noise in ((drive.position, 1e-5), (drive.velocity, 0.0), (drive.effort, 1e-3)):
        values[:] = values[:1] + noise * rng.standard_normal(values.shape)
    code, errors, report = analyse(capsys, drive.write(tmp_path / "still"), tmp_path / "report_still")
    assert (code, errors, report["verdict"]) == (0, "", "insufficient_data")
    assert "usable motion" in report["notes"][0]
    assert (tmp_path / "report_still" / "report.html").exists()


def test_a_recording_that_was_cut_off_is_used_as_far_as_it_goes(
    recorded: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The power failed: no metadata, and the file ends in the middle."""
    data = next(recorded.glob("*.mcap")).read_bytes()
    (tmp_path / "cut.mcap").write_bytes(data[: int(0.9 * len(data))])
    code, errors, report = analyse(capsys, tmp_path / "cut.mcap", tmp_path / "report")
    assert (code, errors) == (0, "")
    assert [effect["name"] for effect in report["effects"]] == ["drive_coulomb_friction"]
    assert report["inputs"][0]["warnings"]


@pytest.mark.parametrize("signum", [signal.SIGINT, pytest.param(signal.SIGTERM, marks=pytest.mark.nightly)])
def test_interrupting_leaves_the_earlier_report_and_nothing_else(recorded: Path, tmp_path: Path, signum: int) -> None:
    """In the middle of a run that would have replaced a report, also from a shell that has its jobs ignore Ctrl-C."""
    out = tmp_path / "report"
    assert main(["analyze", str(recorded), "--robot", "thesis", "--out", str(out), "--quiet"]) == 0
    before = {path: path.read_bytes() for path in out.rglob("*") if path.is_file()}
    run = subprocess.Popen(
        [sys.executable, "-m", "pcw_sim_bridge.mismatch", "analyze", str(recorded), "--robot", "thesis", "--out", str(out),
         "--force"],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env={**os.environ, "PYTHONUNBUFFERED": "1"},
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_IGN),
    )  # fmt: skip
    assert run.stderr is not None
    assert "reading" in run.stderr.readline()
    time.sleep(0.5)
    run.send_signal(signum)
    _, errors = run.communicate(timeout=120)
    # Ctrl-C in an import from compiled code ends Python by the signal, whatever its exit code: a shell sees 130 either way.
    assert run.returncode in (130, -signal.SIGINT), errors
    assert "interrupted" in errors and "Traceback" not in errors
    assert {path: path.read_bytes() for path in out.rglob("*") if path.is_file()} == before
    assert [entry.name for entry in tmp_path.iterdir()] == ["report"]


