"""`simulate` and `record_run`: repeatable, complete or not there, and refused in one line."""

import hashlib
import os
import pty
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import yaml

from pcw_control import EXCITATIONS, make_excitation
from pcw_description import load_robot
from pcw_description.effects.registry import all_effects
from pcw_description.recording import Recording
from pcw_description.robot_file import robot_to_mapping
from pcw_sim_bridge import simulate
from pcw_sim_bridge.plants.plant import PlantError
from pcw_sim_bridge.simulated_run import record_run
from pcw_sim_bridge.stamping import HEALTHY, StampingParameters

THESIS = load_robot("thesis")


def digest(bag: Path) -> str:
    [data] = bag.glob("*.mcap")
    return hashlib.sha256(data.read_bytes()).hexdigest()


def simulated(folder: Path, *arguments: str, excite="chirps", duration="10", seed="7") -> Recording:
    out = folder / "bag"
    code = simulate.main(["--excite", excite, "--duration", duration, "--seed", seed, "--out", str(out), *arguments])
    assert code == 0
    return Recording.open(out, THESIS)


@pytest.fixture(scope="module")
def ideal(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    """The default run without noise of stamps and losses."""
    return simulated(tmp_path_factory.mktemp("ideal"), "--ideal")


@pytest.mark.parametrize(
    "arguments",
    [
        [],
        pytest.param(["--controller", "velocity_loops"], marks=pytest.mark.nightly),
        pytest.param(["--plant", "pybullet", "--ideal"], marks=pytest.mark.nightly),
    ],
)
def test_the_same_arguments_give_the_same_bytes(tmp_path, arguments):
    for folder in ("first", "second", "other"):
        seed = "8" if folder == "other" else "7"
        simulated(tmp_path / folder, *arguments, excite="random_goals", seed=seed)
    first, second, other = (digest(tmp_path / folder / "bag") for folder in ("first", "second", "other"))
    assert first == second and first != other


def test_it_holds_what_a_real_robot_leaves_and_says_so(tmp_path, capsys):
    recording = simulated(tmp_path, "--ideal")
    out = capsys.readouterr().out.strip()
    counts = {name: topic.count for name, topic in recording.topics.items()}
    assert set(counts) == {"/joint_states", "/joint_commands", "/imu/data", "/ground_truth/odom", "/cmd_vel"}
    assert recording.warnings == []
    assert len(recording.joint_states) == pytest.approx(5000, abs=2) and recording.duration == pytest.approx(10.0, abs=0.01)
    assert len(out.splitlines()) == 1
    assert str(tmp_path / "bag") in out and f"{sum(counts.values())} messages" in out and "times as fast" in out
    assert {path.name for path in tmp_path.rglob("*")} == {"bag", "bag_0.mcap", "metadata.yaml"}


def test_a_robot_without_an_imu_leaves_no_imu_topic(tmp_path):
    out = tmp_path / "bag"
    assert simulate.main(["--robot", "xr4000", "--excite", "spin", "--duration", "10", "--out", str(out)]) == 0
    assert Recording.open(out, load_robot("xr4000")).imu is None


def test_by_default_stamps_jitter_and_messages_are_lost(ideal, tmp_path):
    real = simulated(tmp_path, "--loss", "0.01")
    lost = 1.0 - len(real.joint_states) / len(ideal.joint_states)
    assert 0.001 < lost < 0.03
    # The readings themselves are those of the ideal run: only stamps and losses are added.
    near = np.round(real.joint_states.stamp / 0.002).astype(int)
    error = real.joint_states.stamp - 0.002 * near  # from the first joint state, which jitters as well
    np.testing.assert_array_equal(real.joint_states.effort, ideal.joint_states.effort[near])
    assert error.std() == pytest.approx(HEALTHY.stamp_jitter, rel=0.1)
    assert np.all(np.diff(real.joint_states.stamp) > 0.0)
    # A command bears the stamp of the reading that it answers.
    assert np.isin(real.joint_commands.stamp, real.joint_states.stamp).mean() > 0.97


def test_a_coast_down_lets_go(tmp_path):
    recording = simulated(tmp_path, "--ideal", excite="coast_down", duration="20")
    off = recording.cmd_vel.stamp[-1] + 0.01
    assert 8.0 < off < 12.0
    rolling = recording.joint_states.stamp > off
    assert np.abs(recording.joint_commands.effort[recording.joint_commands.stamp > off]).max() == 0.0
    assert np.abs(recording.joint_states.effort[rolling]).mean() < 2.0 * THESIS.sensors.encoders.torque_noise
    speed = recording.ground_truth.twist[:, 0]
    assert speed.max() > 0.9 and speed[-1] > 0.9 * speed.max()  # nothing brakes this robot


def test_physics_is_at_work_and_the_controller_does_not_know(tmp_path):
    friction = "{name: drive_coulomb_friction, target: [front_left], coulomb: 1.0}"
    file = tmp_path / "effects.yaml"
    file.write_text(yaml.safe_dump({"physics": [yaml.safe_load(friction)]}), encoding="utf-8")
    inline, from_file, listed = (
        simulated(tmp_path / name, "--ideal", "--physics", given)
        for name, given in (("inline", friction), ("file", str(file)), ("list", f"[{friction}]"))
    )
    assert digest(tmp_path / "inline/bag") == digest(tmp_path / "file/bag") == digest(tmp_path / "list/bag")
    runs = [simulated(tmp_path / "healthy", "--ideal", excite="circle", duration="20")]
    runs.append(simulated(tmp_path / "rubbing", "--ideal", "--physics", friction, excite="circle", duration="20"))
    middle = (runs[0].joint_states.stamp > 8.0) & (runs[0].joint_states.stamp < 12.0)
    before, after = (recording.joint_states.effort[middle, :, 0].sum(axis=1).mean() for recording in runs)
    assert abs(before) < 0.1
    assert after == pytest.approx(1.0, rel=0.2)  # shared by wheels that do not all turn at one speed
    assert from_file.warnings == listed.warnings == []


def test_effects_of_the_robot_file_are_kept_and_added_to(tmp_path):
    own = {"name": "drive_viscous_friction", "viscous": 0.05}
    robot = tmp_path / "robot.yaml"
    robot.write_text(yaml.safe_dump({**robot_to_mapping(THESIS), "physics": [own]}), encoding="utf-8")
    friction = "{name: drive_coulomb_friction, coulomb: 1.0}"
    simulated(tmp_path / "own", "--robot", str(robot), "--ideal")
    simulated(tmp_path / "both", "--robot", str(robot), "--ideal", "--physics", friction)
    simulated(tmp_path / "two", "--ideal", "--physics", yaml.safe_dump(own), "--physics", friction)
    assert digest(tmp_path / "own/bag") != digest(tmp_path / "both/bag") == digest(tmp_path / "two/bag")


def test_velocity_loops_are_the_worse_controller(tmp_path):
    """They command joint speeds, follow, and need more torque for the same motion, as nothing tells them of masses."""
    good, mediocre = (
        simulated(tmp_path / name, "--ideal", "--controller", name, excite="chirp_y")
        for name in ("computed_torque", "velocity_loops")
    )
    assert np.isnan(mediocre.joint_commands.effort).all() and np.isfinite(mediocre.joint_commands.velocity).all()
    assert np.isnan(good.joint_commands.velocity).all()
    errors = []
    for recording in (good, mediocre):
        truth = recording.ground_truth
        wanted = np.interp(truth.stamp, recording.cmd_vel.stamp, recording.cmd_vel.twist[:, 1])
        errors.append(np.std(truth.twist[:, 1] - wanted) / np.std(wanted))
    assert errors[1] < 0.5
    assert errors[1] > errors[0]


REFUSED = [
    (["--excite", "figur8"], "excitation 'figur8' is not allowed; did you mean 'figure8'?"),
    (["--excite", "circle", "--duration", "5"], "duration = 5.0 s of excitation circle is not allowed; allowed: 1"),
    (["--excite", "circle", "--duration", "nan"], "duration = nan s"),
    (["--excite", "circle", "--duration", "long"], "--duration: invalid float value: 'long'"),
    (["--excite", "circle", "--robot", "thesos"], "did you mean 'thesis'?"),
    (["--excite", "circle", "--robot", "mpo700"], "torque control needs at least"),
    (["--excite", "circle", "--plant", "bullet"], "--plant 'bullet' is not allowed; did you mean 'pybullet'?"),
    (["--excite", "circle", "--controller", "compute_torque"], "--controller 'compute_torque' is not allowed; did you mean"),
    (["--excite", "wheels_off_ground", "--controller", "computed_torque"], "allowed: velocity_loops with wheels_off_ground"),
    (["--excite", "circle", "--seed", "-1"], "--seed -1 is not allowed; allowed: 0 and above"),
    (["--excite", "circle", "--loss", "0.9"], "loss = 0.9 is not allowed; allowed: 0 to 0.5"),
    (["--excite", "circle", "--stamp-jitter", "-1"], "stamp_jitter = -1.0 s is not allowed; allowed: 0 to 0.1 s"),
    (["--excite", "circle", "--ideal", "--loss", "0.1"], "--ideal with --stamp-jitter or --loss is not allowed"),
    (["--excite", "circle", "--physics", "{name: drive_coulom, coulomb: 1}"], "did you mean 'drive_coulomb_friction'?"),
    (["--excite", "circle", "--physics", "{name: drive_coulomb_friction}"], "physics[0].coulomb is missing; allowed: 0 to"),
    (["--excite", "circle", "--physics", "{name: drive_coulomb_friction, coulomb: -1}"], "physics[0].coulomb: -1 is not"),
    (["--excite", "circle", "--physics", "{name: drive_coulomb_friction, target: [front], coulomb: 1}"], "target: 'front'"),
    (["--excite", "circle", "--physics", "{name: actuator_lag, axis: front, time_constant: 0.1}"], "allowed: drive, steer"),
    (["--excite", "circle", "--physics", "{name: payload_mass, axis: drive, mass: 1}"], "no axis for payload_mass"),
    (["--excite", "circle", "--physics", "{name: wheel_radius_error, error: -0.2}"], "leaves a wheel without a radius"),
    (["--excite", "circle", "--physics", "{name: [}"], "it is not YAML"),
    (["--excite", "circle", "--physics", "no_such.yaml"], "no_such.yaml"),
    ([], "--excite is missing; allowed: circle, figure8"),
    (["--no-such-option"], "unrecognized arguments: --no-such-option"),
]


@pytest.mark.parametrize(("arguments", "complaint"), REFUSED, ids=[str(number) for number in range(len(REFUSED))])
def test_bad_input_is_one_line_and_leaves_nothing(tmp_path, capsys, arguments, complaint):
    try:
        code = simulate.main([*arguments, "--out", str(tmp_path / "bag")])
    except SystemExit as end:
        code = end.code
    captured = capsys.readouterr()
    assert code == 2 and captured.out == ""
    assert complaint in captured.err and len(captured.err.strip().splitlines()) == 1
    assert list(tmp_path.iterdir()) == []


def test_an_existing_folder_is_left_as_it_is(tmp_path, capsys):
    with pytest.raises(SystemExit, match="2"):
        simulate.main(["--excite", "circle", "--out", str(tmp_path)])
    assert "exists already and is left as it is" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(SystemExit, match="2"):
        simulate.main(["--excite", "circle"])
    assert "--out is missing" in capsys.readouterr().err


def test_lists_every_effect_with_its_parameters_and_every_excitation(capsys):
    assert simulate.main(["--list-effects"]) == 0
    text = capsys.readouterr().out
    for effect in all_effects().values():
        axes = f", axis {' or '.join(effect.axes)} (default {effect.axis})" if effect.axes else ""
        block = text.partition(f"{effect.name} ({effect.target_kind}{axes}): {effect.summary}\n")[2]
        assert all(name in block.splitlines()[0] for name in (*effect.sensors, *effect.look_alikes))
        for parameter, line in zip(effect.parameters, block.splitlines()[1:]):
            default = "must be given" if parameter.default is None else f"default {parameter.default:g}"
            expected = f"{parameter.lower:g} to {parameter.upper:g}, {default}, typical {parameter.typical:g}"
            assert line == f"    {parameter.name} [{parameter.unit}]: {parameter.help}; {expected}"
    assert simulate.main(["--list-excitations"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines] == list(EXCITATIONS)
    assert all(line.endswith(plan.summary) for line, plan in zip(lines, EXCITATIONS.values()))


@pytest.mark.parametrize("signum", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupted_run_leaves_no_folder_and_a_terminal_sees_how_far_it_is(tmp_path, signum):
    out = tmp_path / "bag"
    terminal, its_end = pty.openpty()
    arguments = ["--excite", "circle", "--duration", "3600", "--out", str(out)]
    with subprocess.Popen([sys.executable, "-m", "pcw_sim_bridge.simulate", *arguments], stderr=its_end) as process:
        os.close(its_end)
        seen = b""
        deadline = time.monotonic() + 120.0
        while b" of 3600 s" not in seen and time.monotonic() < deadline:
            seen += os.read(terminal, 1000)
        assert out.is_dir()
        process.send_signal(signum)
        assert process.wait(timeout=60.0) == 130
    assert not out.exists()
    os.close(terminal)


def test_a_run_that_fails_leaves_no_folder(tmp_path):
    def until_two(time):
        if time > 2.0:
            raise PlantError("it broke")
        return np.array([0.1, 0.0, 0.0])

    with pytest.raises(PlantError, match="it broke"):
        record_run(THESIS, until_two, 5.0, 1, tmp_path / "bag")
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(PlantError, match="did you mean 'velocity_loops'?"):
        record_run(THESIS, until_two, 5.0, 1, tmp_path / "bag", controller_name="velocity_loop")
    assert list(tmp_path.iterdir()) == []


def test_stamps_do_not_change_the_run(tmp_path):
    excitation = make_excitation("chirp_x", THESIS, 10.0)
    counts = [
        record_run(THESIS, excitation.twist, 2.0, 1, tmp_path / name, stamping=stamping)
        for name, stamping in (("a", None), ("b", StampingParameters()), ("c", StampingParameters(1e-3)))
    ]
    assert counts[0] == counts[1] == counts[2]
    efforts = [Recording.open(tmp_path / name, THESIS).joint_states.effort for name in "abc"]
    np.testing.assert_array_equal(efforts[0], efforts[1])
    np.testing.assert_array_equal(efforts[0], efforts[2])


def test_the_readme_names_every_option():
    readme = (Path(__file__).parents[1] / "README.md").read_text(encoding="utf-8")
    named = re.findall(r"^\| `(--[\w-]+)[^|]*\|", readme.partition("## simulate\n")[2].partition("\n## ")[0], re.MULTILINE)
    known = [option for action in simulate.parser()._actions for option in action.option_strings if option.startswith("--")]
    assert sorted(named) == sorted(set(known) - {"--help"})
