"""The commands of the CAN part as a user runs them: helps, bad input in one line, logs there and back, signals."""

import importlib
import io
import os
import signal
import subprocess
import sys
import threading
import time

import numpy as np
import pytest
import yaml

pytest.importorskip("can")
pytest.importorskip("msgpack", reason="udp_multicast of python-can needs it")

from pcw_description import load_robot  # noqa: E402
from pcw_description.recording import Recording  # noqa: E402
from pcw_sim_bridge.can.can_file import Bus, on_udp, read_can_file  # noqa: E402
from pcw_sim_bridge.can.errors import CanError  # noqa: E402
from pcw_sim_bridge.can.frame import Frame  # noqa: E402
from pcw_sim_bridge.can.frame_log import frames_of_file  # noqa: E402
from pcw_sim_bridge.can.python_can import (  # noqa: E402
    FrameLogWriter,
    PythonCanTransport,
    free_log_name,
    read_log,
)
from pcw_sim_bridge.can.starting_file import starting_content, with_joints  # noqa: E402
from pcw_sim_bridge.can.trial_rig import Rig  # noqa: E402

THESIS = load_robot("thesis")
COMMANDS = {name: f"pcw_sim_bridge.can.{name}" for name in ("drive_emulator", "can_doctor", "can_steer_zero", "can_log")}
PORT = 7640  # and those of further buses


def run(command, *arguments):
    """Run a command in this process; returns its exit code."""
    module = importlib.import_module(COMMANDS[command])
    previous = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        return module.main([str(argument) for argument in arguments])
    except SystemExit as end:
        return end.code
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


def refused(capsys, command, *arguments):
    """Return the one line with which a command refuses its input."""
    capsys.readouterr()
    assert run(command, *arguments) == 2
    said = capsys.readouterr().err
    assert "Traceback" not in said and said.startswith(f"{command}: ")
    return said


# --- Bad input ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_explains_itself(command, capsys):
    assert run(command, "--help") == 0
    assert "--can-file" in capsys.readouterr().out or command == "can_log"


BAD_FILES = [
    (lambda c: {**c, "raet": 250}, ["raet", "did you mean 'rate'"]),
    (lambda c: {**c, "rate": "fast"}, ["rate", "'fast'", "a number in Hz"]),
    (lambda c: with_joints(c, ["front_left_steer"], node_id=1), ["joints[1].node_id", "that of front_left_drive already"]),
    (lambda c: with_joints(c, ["front_left_steer"], node_id="two"), ["joints[1].node_id", "'two'", "a number"]),
    (lambda c: with_joints(c, ["front_left_steer"], current_limit=-3), ["joints[1].current_limit", "-3", "above 0"]),
    (lambda c: with_joints(c, ["front_left_steer"], zero=[0]), ["joints[1].zero", "[0]", "a number in rad"]),
    (lambda c: with_joints(c, ["front_left_steer"], unwatched="yes"), ["joints[1].unwatched", "'yes'", "true or false"]),
    (lambda c: {**c, "buses": "can0"}, ["buses", "'can0'", "a list"]),
    (lambda c: {**c, "buses": [{"name": "can0"}]}, ["buses[0].interface", "missing"]),
    (lambda c: {**c, "joints": [{**j, "bus": "can9"} for j in c["joints"]]}, ["joints[0].bus", "can9", "can0"]),
    (lambda c: {**c, "format": "pcw_can/2"}, ["format", "pcw_can/2", "pcw_can/1"]),
    (lambda c: {**c, "timeouts": 3}, ["timeouts", "3", "a mapping"]),
    (lambda c: {**c, "name": 7}, ["name", "7"]),
    (lambda c: {**c, "buses": [{**c["buses"][0], "options": 3}]}, ["buses[0].options", "3", "a mapping"]),
]


@pytest.mark.parametrize(("change", "words"), BAD_FILES)
def test_a_wrong_file_is_refused_by_field_value_and_what_is_allowed(change, words, tmp_path, capsys):
    path = tmp_path / "drives.yaml"
    path.write_text(yaml.safe_dump(change(starting_content(THESIS))))
    said = refused(capsys, "can_doctor", "--can-file", path, "--no-nudge")
    assert all(word in said for word in words) and said.count("\n") == 1, said


def test_more_axes_than_a_bus_can_carry_is_refused_with_the_arithmetic_by_every_command(tmp_path, capsys):
    path = tmp_path / "fast.yaml"
    path.write_text(yaml.safe_dump(starting_content(THESIS, rate=500.0)))
    for command, arguments in (("can_doctor", ["--no-nudge"]), ("can_steer_zero", ["--yes"])):
        said = refused(capsys, command, "--can-file", path, "--udp-port", PORT, *arguments)
        assert "bus load of can0 is not allowed" in said and "8 x   500.0 Hz x 125 bit" in said


def test_an_interface_that_is_not_there_is_named(tmp_path, capsys):
    said = refused(capsys, "can_doctor", "--can-file", "thesis_cia402", "--no-nudge")
    assert "bus can0 (socketcan, can0) cannot be opened" in said and said.count("\n") == 1
    content = starting_content(THESIS)
    content["buses"][0]["interface"] = "socketcn"
    path = tmp_path / "drives.yaml"
    path.write_text(yaml.safe_dump(content))
    said = refused(capsys, "can_log", "record", tmp_path / "x.log", "--can-file", path)
    assert "interface 'socketcn' of bus can0 is not allowed" in said and "socketcan," in said
    assert not (tmp_path / "x.log").exists()


@pytest.mark.parametrize(
    ("command", "arguments", "words"),
    [
        ("drive_emulator", ["--fault", "ded all 3"], ["'ded'", "over_temperature"]),
        ("drive_emulator", ["--fault", "dead nose 3"], ["'nose'", "front_left_drive"]),
        ("drive_emulator", ["--fault", "dead all nan"], ["'dead all nan'", "NAME WHERE SECONDS"]),
        ("drive_emulator", ["--fault", "dead all -1"], ["'dead all -1'", "NAME WHERE SECONDS"]),
        ("drive_emulator", ["--faults", "/no/such"], ["/no/such", "a file of lines"]),
        ("drive_emulator", ["--duration", "-1"], ["--duration -1", "above 0"]),
        ("drive_emulator", ["--watchdog", "0"], ["--watchdog 0", "above 0.005"]),
        ("drive_emulator", ["--udp-port", "70000"], ["70000", "65535"]),
        ("drive_emulator", ["--robot", "thesi"], ["thesi", "did you mean 'thesis'"]),
        ("drive_emulator", ["--stats", "/no/such/folder/x.json"], ["/no/such/folder", "a folder that exists"]),
        ("can_doctor", ["--can-file", "/no/such.yaml"], ["/no/such.yaml"]),
        ("can_doctor", ["--can-file", "thesis_cia40"], ["thesis_cia40", "did you mean 'thesis_cia402'"]),
        ("can_steer_zero", ["--can-file", "thesis_cia402", "--yes"], ["a shipped file", "--out"]),
        ("can_steer_zero", ["--can-file", "thesis_cia402", "--dry-run", "--duration", "1"], ["--duration 1", "5 to 600"]),
        ("can_log", ["record", "x.txt", "--can-file", "thesis_cia402"], ["x.txt", ".log, .asc, .blf"]),
        ("can_log", ["record", "x.log", "--duration", "-1"], ["--duration -1", "above 0"]),
        ("can_log", ["record", "x.log", "--udp-port", "-5"], ["udp port -5", "at least 1"]),
        ("can_doctor", ["--udp-port", "-5", "--no-nudge"], ["udp port -5", "at least 1"]),
        ("can_log", ["replay", "/no/such.log", "--yes"], ["/no/such.log", "cannot be read"]),
        ("can_log", ["recording", "/no/such.log", "--out", "x"], ["/no/such.log", "cannot be read"]),
    ],
)
def test_bad_arguments_are_refused_in_one_line(command, arguments, words, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    said = refused(capsys, command, *arguments)
    assert all(word in said for word in words) and said.count("\n") == 1, said
    assert list(tmp_path.iterdir()) == []


def test_without_drives_the_doctor_says_which_are_missing(capsys):
    assert run("can_doctor", "--can-file", "thesis_odrive", "--udp-port", PORT + 4, "--no-nudge") == 1
    said = capsys.readouterr().out
    assert said.count("Get_Version has no answer") == 8 and "8 findings are wrong" in said


# --- Logs --------------------------------------------------------------------------------------------------


def frames_of_a_run(protocol, buses=1):
    """Return file and frames (bus, frame, time, sent) of a robot that drives for a fifth of a second."""
    content = starting_content(THESIS, protocol)
    if buses == 2:
        content["buses"].append({"name": "rear", "interface": "virtual", "channel": "other"})
        content["buses"][0]["name"] = content["joint_defaults"]["bus"] = "front"
        content = with_joints(content, THESIS.joint_names[4:], bus="rear")
    from pcw_sim_bridge.can.can_file import can_file_from

    file = can_file_from(content, THESIS)
    driven = Rig(THESIS, file)
    driven.can.configure()
    driven.torque[:, 0] = 0.7
    driven.can.enable()
    frames = driven.transport.log()
    driven.cycles(50)
    return content, file, frames


@pytest.mark.parametrize("suffix", [".log", ".asc", ".blf"])
def test_a_log_keeps_which_bus_a_frame_was_on_and_when(suffix, tmp_path):
    """Two buses without a number in their names: ASC and BLF know numbers alone."""
    _, file, frames = frames_of_a_run("cia402", buses=2)
    path = tmp_path / f"two{suffix}"
    writer = FrameLogWriter(path, [bus.name for bus in file.buses])
    for bus, frame, at, sent in frames:
        writer.write(bus, frame, 1.7e9 + at, sent)
    writer.close()
    read = list(frames_of_file(read_log(path), file))
    assert [(bus, frame.id, frame.data) for bus, frame, _ in read] == [(b, f.id, f.data) for b, f, _, _ in frames]
    assert {bus for bus, _, _ in read} == {"front", "rear"}
    times = np.array([at for _, _, at in read]) - np.array([1.7e9 + at for _, _, at, _ in frames])
    # Of ASC python-can reads the time of its beginning to a second; within the log all are good to 10 us.
    assert np.abs(times).max() < (1.0 if suffix == ".asc" else 2e-5) and np.ptp(times) < 2e-5


def test_a_log_of_another_can_file_is_refused_and_leaves_no_folder(tmp_path, capsys):
    """It had become an empty recording, with exit code 0."""
    _, _, frames = frames_of_a_run("cia402")
    writer = FrameLogWriter(tmp_path / "run.blf", ["can0"])
    for bus, frame, at, sent in frames:
        writer.write(bus, frame, 1.7e9 + at, sent)
    writer.close()
    said = refused(
        capsys, "can_log", "recording", tmp_path / "run.blf", "--can-file", "thesis_odrive", "--out", tmp_path / "bag"
    )
    assert "no whole set of joints" in said and "of nobody in thesis_odrive" in said
    assert not (tmp_path / "bag").exists()


def test_a_driver_that_is_configured_again_gets_a_log_of_its_own(tmp_path):
    path = tmp_path / "run.blf"
    assert free_log_name(path) == path
    path.touch()
    (tmp_path / "run_2.blf").touch()
    assert free_log_name(path) == tmp_path / "run_3.blf"


def test_a_full_disk_ends_the_log_and_not_the_robot(tmp_path):
    transport = PythonCanTransport([Bus("can0", "virtual", "full_disk")], log=tmp_path / "x.log")
    other = PythonCanTransport([Bus("can0", "virtual", "full_disk")])

    def full(message):
        raise OSError(28, "No space left on device")

    transport._log._logger = type("Full", (), {"__call__": lambda self, message: full(message), "stop": lambda self: None})()
    for _ in range(3):
        transport.send("can0", Frame(1, b"x"))
    assert len(other.receive(1.0)) == 3 and "No space left" in transport.log_problem
    transport.close()
    other.close()


def test_an_adapter_that_is_pulled_out_is_a_bus_that_is_off():
    transport = PythonCanTransport([Bus("can0", "virtual", "pulled")])

    def gone(timeout):
        raise OSError(19, "No such device")

    transport._buses["can0"].recv = gone
    arrived = transport.receive(0.01)
    assert [one.frame.error for one in arrived] == [True] and arrived[0].frame.id == 0x40
    transport.close()


@pytest.mark.parametrize("protocol", ["cia402", "odrive"])
def test_what_is_replayed_can_be_recorded_and_becomes_the_same_recording(protocol, tmp_path, capsys):
    """`can_log replay` on one side of a bus, `can_log record` on the other, `can_log recording` of both."""
    content, file, frames = frames_of_a_run(protocol)
    port = PORT + (1 if protocol == "odrive" else 2)
    path, log, again = tmp_path / "drives.yaml", tmp_path / "run.log", tmp_path / "again.blf"
    path.write_text(yaml.safe_dump(content))
    writer = FrameLogWriter(log, ["can0"])
    for bus, frame, at, sent in frames:
        writer.write(bus, frame, 1.7e9 + at, sent)
    writer.close()
    recorder = PythonCanTransport(on_udp(file, port).buses, log=again)
    stop = threading.Event()

    def listen():
        while not stop.is_set() or recorder.receive(0.2):
            recorder.receive(0.02)

    listener = threading.Thread(target=listen)
    listener.start()
    assert run("can_log", "replay", log, "--can-file", path, "--udp-port", port, "--yes") == 0
    stop.set()
    listener.join()
    recorder.close()
    assert f"{len(frames)} frames sent" in capsys.readouterr().out
    assert [(f.id, f.data, f.remote) for _, f, _ in read_log(again)] == [(f.id, f.data, f.remote) for _, f, _, _ in frames]
    made = []
    for name in (log, again):
        assert run("can_log", "recording", name, "--can-file", path, "--out", tmp_path / f"{name.stem}_bag") == 0
        made.append(Recording.open(tmp_path / f"{name.stem}_bag", THESIS))
    one, other = made
    assert len(one.joint_states) > 40 and len(one.joint_commands) > 40
    np.testing.assert_array_equal(one.joint_states.position, other.joint_states.position)
    np.testing.assert_array_equal(one.joint_commands.effort, other.joint_commands.effort)


def test_logged_commands_are_replayed_to_drives_only_when_somebody_agrees(tmp_path, capsys, monkeypatch):
    content, file, frames = frames_of_a_run("odrive")
    path, log = tmp_path / "drives.yaml", tmp_path / "run.log"
    content["buses"][0]["channel"] = "agreed"
    path.write_text(yaml.safe_dump(content))
    writer = FrameLogWriter(log, ["can0"])
    for bus, frame, at, sent in frames:
        writer.write(bus, frame, 1.7e9 + at, sent)
    writer.close()
    monkeypatch.setattr("sys.stdin", io.StringIO("\n"))
    assert run("can_log", "replay", log, "--can-file", path) == 1
    assert "Go on? [y/N]" in capsys.readouterr().out
    bus = PythonCanTransport([Bus("can0", "virtual", "agreed")])
    assert run("can_log", "replay", log, "--can-file", path, "--sent-by", "drives") == 0
    got = [one.frame for one in bus.receive(0.1)]
    while more := bus.receive(0.0):
        got += [one.frame for one in more]
    bus.close()
    said = [frame for _, frame, _, sent in frames if not sent and not frame.remote]
    assert [(f.id, f.data) for f in got] == [(f.id, f.data) for f in said]


def test_a_recording_of_frames_ends_in_order_on_sigterm(tmp_path):
    log = tmp_path / "x.blf"
    command = [sys.executable, "-m", COMMANDS["can_log"], "record", str(log), "--can-file", "thesis_cia402",
               "--udp-port", str(PORT + 6)]  # fmt: skip
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    assert process.stdout.readline().startswith("recording can0")
    bus = PythonCanTransport(on_udp(read_can_file("thesis_cia402", THESIS), PORT + 6).buses)
    for k in range(5):
        bus.send("can0", Frame(0x181, bytes([k] * 8)))
    time.sleep(0.3)
    process.send_signal(signal.SIGTERM)
    said = process.communicate(timeout=20)[0]
    bus.close()
    assert process.returncode == 0 and "5 frames of can0" in said
    assert len(list(read_log(log))) == 5


def test_a_log_in_use_is_refused_before_anything_is_opened(tmp_path):
    (tmp_path / "x.log").touch()
    with pytest.raises(CanError, match="exists already"):
        FrameLogWriter(tmp_path / "x.log")


def test_a_list_of_buses_without_the_program_that_shows_them_says_so(tmp_path):
    """python-can logs a traceback where `ip` is not installed, as in a small container."""
    command = [sys.executable, "-m", COMMANDS["can_doctor"], "--list"]
    done = subprocess.run(command, env=os.environ | {"PATH": str(tmp_path)}, capture_output=True, text=True, timeout=60.0)
    assert (done.returncode, done.stderr) == (0, "")
    assert "`ip` (iproute2) is not installed" in done.stdout
