"""`mismatch analyze` from the outside: real recordings, simulated robots, bad input, exit codes."""

import dataclasses
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from pcw_description import load_robot, parse_robot, ros_messages
from pcw_description.axis_recording import parse_axis_description
from pcw_description.description_fields import load_yaml_mapping
from pcw_description.effect_instance import EffectInstance
from pcw_description.recording import Recording
from pcw_description.recording_writer import RecordingWriter
from pcw_description.robot_description import DRIVE
from pcw_sim_bridge.mismatch.__main__ import main
from pcw_sim_bridge.simulated_run import record_run

LINEAR_AXIS = (Path(__file__).parent / "sled.yaml").read_text(encoding="utf-8")


def analyze(*arguments: object) -> subprocess.CompletedProcess[str]:
    """Run the command as a user without ROS does."""
    return subprocess.run(
        [sys.executable, "-m", "pcw_sim_bridge.mismatch", "analyze", *map(str, arguments)],
        capture_output=True,
        text=True,
        timeout=280,
        check=False,
    )


def shared_data() -> Path:
    """Return the folder of real recordings, or skip."""
    candidates = [Path(os.environ["PCW_DATA"])] if "PCW_DATA" in os.environ else []
    candidates += [
        parent / "shared" / "data" for parent in (Path.cwd(), *Path.cwd().parents, *Path(__file__).parents)
    ]
    for candidate in candidates:
        if (candidate / "emps" / "DATA_EMPS.mat").exists():
            return candidate
    pytest.skip("the EMPS recordings are not here; set PCW_DATA to the folder that holds emps/DATA_EMPS.mat")


def axis_file(name: str) -> Path:
    """Return a shipped axis description, in the source tree or in an installation."""
    import pcw_sim_bridge

    module = Path(pcw_sim_bridge.__file__).resolve()
    places = [module.parents[1] / "config", module.parents[4] / "share" / "pcw_sim_bridge" / "config"]
    return next(place / "axes" / name for place in places if (place / "axes" / name).exists())


def wandering(time: float) -> np.ndarray:
    """Return a twist that moves all three axes at speeds of no common period."""
    return min(time, 1.0) * np.array(
        [0.5 * np.sin(1.3 * time), 0.4 * np.sin(0.9 * time + 1.0), 0.7 * np.sin(0.7 * time)]
    )


def sled(path: Path, coulomb: float, seed: int, duration: float = 20.0) -> None:
    """Write a CSV of a 20 kg sled on a path of sines, with friction and noise."""
    rng = np.random.default_rng(seed)
    time = np.arange(0.0, duration, 0.002)
    position = 0.2 * np.sin(1.7 * time) + 0.05 * np.sin(5.3 * time)
    velocity = 0.34 * np.cos(1.7 * time) + 0.265 * np.cos(5.3 * time)
    acceleration = -0.578 * np.sin(1.7 * time) - 1.4045 * np.sin(5.3 * time)
    force = 20.0 * acceleration + coulomb * np.tanh(velocity / 1e-3) + 0.3 * rng.standard_normal(len(time))
    table = np.column_stack([time, position + 1e-6 * rng.standard_normal(len(time)), force])
    np.savetxt(path, table, delimiter=",", header="time,position,force", comments="")


def test_emps_names_what_was_published_and_nothing_else(tmp_path: Path) -> None:
    """From the inertia alone: viscous and Coulomb friction, asymmetric, within 3 % of the published values, and an offset.

    Published (Janot, Gautier, Brunot 2019, IDIM-LS): 95.1 kg, 203.5 N s/m, 20.4 N, -3.16 N; the held-out experiment has
    force pulses that the fitted one has not.
    """
    data = shared_data() / "emps"
    out = tmp_path / "report"
    done = analyze(
        data / "DATA_EMPS.mat",
        "--robot",
        axis_file("emps.yaml"),
        "--out",
        out,
        "--holdout",
        data / "DATA_EMPS_PULSES.mat",
    )
    assert done.returncode == 0, done.stderr
    report = json.loads((out / "report.json").read_text())
    found = {effect["name"]: effect["parameters"] for effect in report["effects"]}
    assert set(found) == {"drive_viscous_friction", "drive_coulomb_friction", "constant_load"}
    assert found["drive_viscous_friction"]["viscous"]["value"] == pytest.approx(203.5, rel=0.03)
    assert found["drive_coulomb_friction"]["coulomb"]["value"] == pytest.approx(20.4, rel=0.03)
    assert any("(load = -3.1" in note for note in report["notes"])
    forwards, backwards = (found["drive_viscous_friction"]["viscous"]["value"] + sign
                           * found["drive_viscous_friction"]["asymmetry"]["value"] for sign in (1, -1))
    assert (forwards, backwards) == pytest.approx((167.0, 240.0), rel=0.03)
    mass = next(number for number in report["retuned"] if number["name"] == "inertia")
    assert mass["value"] == pytest.approx(95.1, rel=0.01)
    before, after = report["fit"]["holdout"]["inverse_nrmse"]
    assert before == pytest.approx(0.67, abs=0.02)
    assert after <= 0.054
    assert report["verdict"] == "explained"
    patched = parse_axis_description(load_yaml_mapping(out / "robot_patched.yaml"))
    assert {instance.name for instance in patched.physics} == set(found)


def test_a_simulated_robot_with_concealed_friction_is_found_out(tmp_path: Path) -> None:
    """PyBullet, friction on a caster that a seed picks: effect and caster are named, the patch helps on another run."""
    nominal = load_robot("thesis")
    rng = np.random.default_rng(11)
    caster = nominal.caster_names[rng.integers(nominal.n)]
    coulomb = float(rng.uniform(0.3, 1.0))
    friction = EffectInstance(
        "drive_coulomb_friction", (caster,), {"coulomb": coulomb, "asymmetry": 0.0, "smoothing_speed": 0.05}
    )
    true_robot = dataclasses.replace(nominal, physics=(friction,))
    record_run(true_robot, wandering, 15.0, 1, tmp_path / "fit", "pybullet", controlled_as=nominal)
    record_run(
        true_robot,
        lambda t: wandering(t + 40.0) * min(t, 1.0),
        8.0,
        2,
        tmp_path / "other",
        "pybullet",
        controlled_as=nominal,
    )
    out = tmp_path / "report"
    done = analyze(tmp_path / "fit", "--robot", "thesis", "--out", out, "--holdout", tmp_path / "other")
    assert done.returncode == 0, done.stderr
    report = json.loads((out / "report.json").read_text())
    assert [(effect["name"], effect["target"]) for effect in report["effects"]] == [
        ("drive_coulomb_friction", [caster])
    ]
    found = report["effects"][0]["parameters"]["coulomb"]
    assert found["value"] == pytest.approx(coulomb, rel=0.03)
    assert found["ci95"][0] < coulomb < found["ci95"][1]
    assert report["effects"][0]["probability"] > 0.99
    fit = report["fit"]["holdout"]
    assert fit["gap_closed"] > 0.8
    for before, after in (fit["inverse_nrmse"], *fit["rollout"].values()):
        assert after < 0.5 * before
    patched = parse_robot(load_yaml_mapping(out / "robot_patched.yaml"))
    named, *small = patched.physics
    assert (named.name, named.target) == ("drive_coulomb_friction", (caster,))
    # What the description has no place for, and no more than a healthy robot's.
    largest = {"steer_zero_offset": 6e-3, "torque_constant_error": 0.03, "ground_slope": 6e-3}
    sizes = {"steer_zero_offset": "offset", "torque_constant_error": "error", "ground_slope": "angle"}
    assert all(abs(instance.parameters[sizes[instance.name]]) < largest[instance.name] for instance in small)
    lines = done.stdout.splitlines()
    assert lines[0] == str(out / "report.html")
    assert len(lines) == 6
    assert caster in done.stdout


@pytest.mark.nightly  # a whole analysis, like that of others here
@pytest.mark.parametrize("name", ["flow_base", "dyros_pcv", "xr4000", "tidybot2"])
def test_intervals_hold_the_truth_on_other_robots(name: str, tmp_path: Path) -> None:
    """Other sizes, offsets and gear couplings; the friction is 4 % of what the drive can give."""
    nominal = load_robot(name)
    coulomb = 0.04 * float(nominal.torque_limit[1, DRIVE])
    friction = EffectInstance(
        "drive_coulomb_friction",
        (nominal.caster_names[1],),
        {"coulomb": coulomb, "asymmetry": 0.0, "smoothing_speed": 0.05},
    )
    true_robot = dataclasses.replace(nominal, physics=(friction,))
    record_run(true_robot, wandering, 25.0, 3, tmp_path / "run", "pybullet", controlled_as=nominal)
    done = analyze(tmp_path / "run", "--robot", name, "--out", tmp_path / "report", "--quiet")
    assert done.returncode == 0, done.stderr
    report = json.loads((tmp_path / "report" / "report.json").read_text())
    [effect] = report["effects"]
    assert (effect["name"], effect["target"]) == ("drive_coulomb_friction", [nominal.caster_names[1]])
    low, high = effect["parameters"]["coulomb"]["ci95"]
    print(f"{name}: {coulomb:.4f} N m, found {effect['parameters']['coulomb']['value']:.4f} ({low:.4f} to {high:.4f})")
    assert low < coulomb < high
    assert high - low < 0.5 * coulomb


def test_a_healthy_robot_has_nothing_missing(tmp_path: Path) -> None:
    """A robot that differs from its file within tolerance is re-tuned, not accused."""
    nominal = load_robot("thesis")
    chassis = dataclasses.replace(
        nominal.chassis, mass=1.008 * nominal.chassis.mass, com=(0.004, -0.003, 0.25)
    )
    casters = tuple(
        dataclasses.replace(caster, wheel_radius=caster.wheel_radius * scale)
        for caster, scale in zip(nominal.casters, (1.001, 0.9995, 1.0, 0.999), strict=True)
    )
    healthy = dataclasses.replace(nominal, chassis=chassis, casters=casters)
    record_run(healthy, wandering, 12.0, 5, tmp_path / "run", "reduced", controlled_as=nominal)
    done = analyze(tmp_path / "run", "--robot", "thesis", "--out", tmp_path / "report", "--quiet")
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    report = json.loads((tmp_path / "report" / "report.json").read_text())
    assert report["effects"] == []
    assert report["verdict"] == "no_mismatch"


def test_sensors_that_only_some_recordings_have_are_refused_and_missing_ones_told(tmp_path: Path) -> None:
    """Without torques nothing is said of forces, and a hold-out with others than the fitted recordings proves nothing."""
    nominal = load_robot("thesis")
    record_run(nominal, wandering, 8.0, 5, tmp_path / "whole", "reduced")
    joints = Recording.open(tmp_path / "whole", nominal).joint_states
    with RecordingWriter(tmp_path / "no_effort") as writer:
        for stamp_ns, position, velocity in zip(joints.stamp_ns, joints.position, joints.velocity, strict=True):
            message = ros_messages.joint_state(
                int(stamp_ns), nominal.joint_names, position=position.ravel(), velocity=velocity.ravel()
            )
            writer.write("/joint_states", message, int(stamp_ns))
        imu = Recording.open(tmp_path / "whole", nominal).imu
        assert imu is not None
        for stamp_ns, gyro, acceleration in zip(imu.stamp_ns, imu.gyro, imu.acceleration, strict=True):
            writer.write("/imu/data", ros_messages.imu(int(stamp_ns), gyro, acceleration), int(stamp_ns))
    done = analyze(
        tmp_path / "whole", "--robot", "thesis", "--out", tmp_path / "report", "--holdout", tmp_path / "no_effort"
    )
    assert done.returncode == 2
    assert "no_effort has no effort in joint_states, and" in done.stderr
    assert not (tmp_path / "report").exists()
    done = analyze(tmp_path / "no_effort", "--robot", "thesis", "--out", tmp_path / "report")
    assert done.returncode == 0, done.stderr
    assert "(forces could not be judged)" in done.stdout
    assert "forces could not be judged" in (tmp_path / "report" / "report.html").read_text()


@pytest.mark.nightly  # two whole analyses
def test_same_seed_same_report(tmp_path: Path) -> None:
    """A sled with friction is found out, and twice the same way."""
    (tmp_path / "sled.yaml").write_text(LINEAR_AXIS)
    sled(tmp_path / "run.csv", coulomb=4.0, seed=1)
    reports = []
    for name in ("first", "second"):
        done = analyze(
            tmp_path / "run.csv", "--robot", tmp_path / "sled.yaml", "--out", tmp_path / name, "--seed", 3
        )
        assert done.returncode == 0, done.stderr
        report = json.loads((tmp_path / name / "report.json").read_text())
        report.pop("seconds")
        reports.append(report)
    assert reports[0] == reports[1]
    assert [effect["name"] for effect in reports[0]["effects"]] == ["drive_coulomb_friction"]
    assert reports[0]["effects"][0]["parameters"]["coulomb"]["value"] == pytest.approx(4.0, rel=0.03)


def test_a_patched_description_leaves_nothing(tmp_path: Path) -> None:
    """Analysing again with robot_patched.yaml says that nothing is missing."""
    (tmp_path / "sled.yaml").write_text(LINEAR_AXIS)
    sled(tmp_path / "run.csv", coulomb=4.0, seed=2)
    analyze(tmp_path / "run.csv", "--robot", tmp_path / "sled.yaml", "--out", tmp_path / "first")
    done = analyze(
        tmp_path / "run.csv",
        "--robot",
        tmp_path / "first" / "robot_patched.yaml",
        "--out",
        tmp_path / "second",
    )
    assert done.returncode == 0, done.stderr
    report = json.loads((tmp_path / "second" / "report.json").read_text())
    assert report["verdict"] == "no_mismatch"


def test_three_seconds_are_not_enough(tmp_path: Path) -> None:
    """Too little data is a verdict of its own, with exit code 0."""
    (tmp_path / "sled.yaml").write_text(LINEAR_AXIS)
    sled(tmp_path / "run.csv", coulomb=4.0, seed=1, duration=3.0)
    done = analyze(tmp_path / "run.csv", "--robot", tmp_path / "sled.yaml", "--out", tmp_path / "report")
    assert done.returncode == 0, done.stderr
    assert json.loads((tmp_path / "report" / "report.json").read_text())["verdict"] == "insufficient_data"


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["nowhere.csv", "--robot", "sled.yaml", "--out", "report"], "nowhere.csv: no such recording"),
        (["run.csv", "--robot", "gone.yaml", "--out", "report"], "gone.yaml"),
        (
            ["run.csv", "--robot", "other.yaml", "--out", "report"],
            "format is 'pcw_ship/1'; allowed: pcw_robot/1 or pcw_axis/1",
        ),
        (["run.csv", "--robot", "sled.yaml", "--out", "full"], "full"),
        (
            ["run.csv", "--robot", "sled.yaml", "--out", "report", "--topic", "joint_states"],
            "'joint_states' is not allowed",
        ),
        (["text.csv", "--robot", "sled.yaml", "--out", "report"], "text.csv"),
        (["run.csv", "--robot", "thesis", "--out", "report"], "run.csv"),
    ],
)
def test_bad_input_is_one_line_and_exit_code_2(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str], arguments: list[str], says: str
) -> None:
    """What is wrong is named, nothing is written, nothing is lost."""
    monkeypatch.chdir(tmp_path)
    Path("sled.yaml").write_text(LINEAR_AXIS)
    Path("other.yaml").write_text("format: pcw_ship/1\n")
    Path("text.csv").write_text("these are\nno numbers\n")
    Path("full").mkdir()
    Path("full/thesis.txt").write_text("years of work")
    sled(Path("run.csv"), coulomb=4.0, seed=1, duration=6.0)
    assert main(["analyze", *arguments]) == 2
    errors = capfd.readouterr().err
    assert says in errors
    assert len([line for line in errors.splitlines() if line.startswith("mismatch: ")]) == 1
    assert not Path("report").exists()
    assert Path("full/thesis.txt").read_text() == "years of work"


def test_it_runs_without_ros() -> None:
    """Neither the analysis nor its report imports ROS."""
    code = (
        "import sys\n"
        "class Blocked:\n"
        "    def find_spec(self, name, path=None, target=None):\n"
        "        if name.split('.')[0] in ('rclpy', 'rosidl_runtime_py', 'sensor_msgs', 'std_msgs'):\n"
        "            raise ImportError(name)\n"
        "sys.meta_path.insert(0, Blocked())\n"
        "import pcw_sim_bridge.mismatch.analysis, pcw_sim_bridge.mismatch.report.report, pcw_sim_bridge.mismatch.__main__\n"
    )
    assert subprocess.run([sys.executable, "-c", code], timeout=60, check=False).returncode == 0
