"""The robot behind its drives, in simulated time: torque on and off, faults, homing, calibration, logs, the doctor."""

import math
import queue
import shutil
import threading

import numpy as np
import pytest

from pcw_description import DescriptionError, load_robot
from pcw_description.recording import Recording
from pcw_sim_bridge.can.can_file import can_file_from, find_can_file, joint_place, read_can_file
from pcw_sim_bridge.can.can_steer_zero import run as steer_zero
from pcw_sim_bridge.can.doctor import examine
from pcw_sim_bridge.can.drive_emulator import read_faults, serve
from pcw_sim_bridge.can.emulated_robot import EmulatedRobot, EmulatedTransport
from pcw_sim_bridge.can.errors import CanError
from pcw_sim_bridge.can.frame import ERROR_BUS_OFF, Arrived, Frame
from pcw_sim_bridge.can.simulated_can_run import record_run_over_can
from pcw_sim_bridge.can.starting_file import starting_content, with_joints
from pcw_sim_bridge.can.steer_zero import estimate_steer_zeros, write_zeros
from pcw_sim_bridge.can.trial_rig import ALLOWED_MS, ClosableTransport, Rig
from pcw_sim_bridge.can.trials import DETECTED_BY_DRIVE_ALONE, FAULT_TRIALS, fault_trial, fuzz
from pcw_sim_bridge.can.verdict_trials import run_verdict
from pcw_sim_bridge.plants.factory import make_plant
from pcw_sim_bridge.simulated_robot import JointCommand
from pcw_sim_bridge.simulated_run import record_run

THESIS = load_robot("thesis")
PROTOCOLS = ("cia402", "odrive")
NIGHTLY = pytest.mark.nightly


def rig(protocol="cia402", robot=THESIS, seed=0, **changes):
    if robot is THESIS and not changes:
        made = Rig(robot, read_can_file(f"thesis_{protocol}", robot), seed)
    else:
        made = Rig(robot, can_file_from(starting_content(robot, protocol, **changes), robot), seed)
    made.can.configure()
    return made


def torques(driven):
    return np.abs(driven.emulated.motor_torques()).max()


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_torque_is_there_from_activate_to_deactivate_and_is_the_commanded_one(protocol):
    driven = rig(protocol)
    driven.torque[:] = [[1.0, 0.2], [1.5, -0.2], [-1.0, 0.1], [2.0, 0.0]]
    driven.cycles(5)
    assert driven.can.state == "off" and torques(driven) == 0.0
    with pytest.raises(CanError, match="allowed: configure first"):
        Rig(THESIS, driven.can.file).can.enable()
    driven.can.enable()
    assert torques(driven) == 0.0  # until the first command
    driven.cycles(2)
    given = np.matmul(np.transpose(THESIS.gear_matrix, (0, 2, 1)), driven.emulated._motor_torque()[:, :, None])[:, :, 0]
    braked = driven.torque - 0.05 * driven.can.reading.joints.velocity
    np.testing.assert_allclose(given, braked, atol=0.011)  # steps of 0.5 mN m behind a gear of 20
    driven.can.request_disable()
    driven.cycles(3)
    assert torques(driven) == 0.0 and driven.can.state == "off"
    assert not driven.can.faults


@pytest.mark.parametrize("name", ["tidybot2", "xr4000", "flow_base"])
def test_joints_read_the_truth_through_couplings_signs_and_zeros(name):
    robot = load_robot(name)
    content = starting_content(robot, "odrive", rate=100.0)
    for i, joint in enumerate(content["joints"]):
        joint.update(sign=-1.0 if i % 3 else 1.0, zero=0.1 * i)
    driven = Rig(robot, can_file_from(content, robot))
    driven.can.configure()
    driven.torque[:] = 0.1 * robot.torque_limit * [[1.0, 0.5]]
    driven.can.enable()
    driven.cycles(60)
    truth, seen = driven.emulated.plant.state(), driven.can.reading.joints
    assert np.abs(truth.joint_position).max() > 0.1
    # The reading is up to a period old.
    np.testing.assert_allclose(seen.position, truth.joint_position, atol=0.02 + 0.011 * np.abs(truth.joint_velocity).max())
    np.testing.assert_allclose(seen.effort, driven.torque - 0.05 * seen.velocity, atol=0.1 * robot.torque_limit.max())


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_velocities_turn_the_wheels(protocol):
    driven = rig(protocol)
    driven.can.enable()
    wanted = np.zeros((4, 2))
    wanted[:, 0] = 3.0
    for _ in range(250):
        driven.can.cycle(lambda reading: driven.can.command(JointCommand(velocity=wanted), reading.time))
    np.testing.assert_allclose(driven.emulated.plant.state().joint_velocity[:, 0], 3.0, atol=0.1)
    assert not driven.can.faults


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_a_command_that_is_refused_is_zero_torque_until_the_next(protocol):
    driven = rig(protocol)
    driven.torque[:, 0] = 1.0
    driven.can.enable()
    driven.cycles(5)
    assert torques(driven) > 0.0
    driven.can.cycle(lambda _: driven.can.command(None))
    driven.transport.receive(0.002)
    assert torques(driven) == 0.0 and driven.can.counters.refused_commands == 1
    driven.cycles(2)
    assert torques(driven) > 0.0
    broken = JointCommand(effort=np.ones((4, 2)))
    broken.effort[1, 1] = math.nan  # behind the back of its check
    driven.can.cycle(lambda _: driven.can.command(broken))
    driven.transport.receive(0.002)
    assert torques(driven) == 0.0 and driven.can.armed


@pytest.mark.parametrize("rate", [249.0, 251.0])
def test_the_driver_keeps_the_time_of_drives_that_speak_by_their_own_clocks(rate):
    """Once in a second such clocks pass the end of a period of 250 Hz: then no reading is whole in it, or two are."""
    driven = rig("odrive")
    for drive in driven.emulated.drives:
        drive.rate = rate
    driven.can.enable()
    driven.cycles(200)
    counters, begun = driven.can.counters, driven.transport.now()
    incomplete, cycles = counters.incomplete, counters.cycles
    driven.cycles(1000)
    assert counters.incomplete == incomplete
    assert (counters.cycles - cycles) / (driven.transport.now() - begun) == pytest.approx(rate, rel=5e-4)


def test_the_newest_command_wins_and_none_queues():
    driven = rig()
    driven.can.enable()

    def three(reading):
        for size in (1.0, 2.0, 3.0):
            driven.can.command(JointCommand(effort=np.full((4, 2), 0.1 * size)))

    driven.transport.sent = []
    driven.can.cycle(three)
    driven.can.cycle(None)
    wants = [driven.can.drives[0].decode_command(frame) for _, frame in driven.transport.sent]
    values = [round(20 * want.value, 3) for want in wants if want is not None and want.enabled]
    assert values == [0.0, 0.1, 0.3]  # the first of a period at once, the newest with the next; 0.2 never
    assert driven.can.counters.held_back == 1


@pytest.mark.parametrize("protocol", PROTOCOLS)
@pytest.mark.parametrize(("fault", "kind", "names"), FAULT_TRIALS)
def test_every_fault_ends_in_zero_torque_in_time_by_its_name_and_for_good(protocol, fault, kind, names):
    """Once each; `python -m pcw_sim_bridge.can.trials faults` does each 20 times."""
    if (fault, protocol) in DETECTED_BY_DRIVE_ALONE:
        pytest.skip("nothing in this protocol says so")
    driven, rng = rig(protocol), np.random.default_rng(3)
    result = fault_trial(driven, fault, kind, names, rng)
    assert result["zero_after_ms"] is not None and result["zero_after_ms"] <= ALLOWED_MS, result
    assert result["right_name"] and result["stays_off"], result


def test_a_fault_refuses_torque_until_it_is_cleared_and_a_fault_that_stays_cannot_be():
    driven = rig()
    driven.can.enable()
    driven.emulated.inject("over_temperature", "front_left_drive")
    driven.cycles(3)
    assert [str(f) for f in driven.can.faults] == ["over_temperature at front_left_drive: the drive says so"]
    with pytest.raises(CanError, match="allowed: clear_faults first"):
        driven.can.enable()
    with pytest.raises(CanError, match="over_temperature .* stays after a reset"):
        driven.can.clear_faults()
    driven.emulated.inject("heal", "front_left_drive")
    driven.can.clear_faults()
    driven.cycles(10)
    assert torques(driven) == 0.0 and driven.can.state == "off"
    driven.can.enable()


def test_foreign_nodes_are_counted_and_change_nothing():
    driven = rig()
    driven.torque[:, 0] = 1.0
    driven.can.enable()
    driven.emulated.inject("foreign", "can0")
    driven.cycles(100)
    assert driven.can.armed and driven.can.foreign[("can0", 0x7FE)] >= 15
    driven.transport.others = [Arrived("can0", Frame(0x201, bytes(5)), 0.0)]  # another computer that commands
    driven.cycles(2)
    assert driven.can.armed and driven.can.foreign[("can0", 0x201)] == 1
    # Of two drivers on a bus it was said that their frames are nobody's; and who had gone was told for good.
    assert "another computer or program commands these drives: 0x201 on can0" in driven.can.others()
    assert "frames of nobody in the file: 0x7FE on can0" in driven.can.others()
    driven.emulated.inject("bus_heal", "can0")
    driven.cycles(800)
    assert driven.can.others() == "" and driven.can.foreign[("can0", 0x201)] == 1


def test_an_error_frame_that_is_not_bus_off_is_counted():
    driven = rig()
    driven.can.enable()
    driven.transport.others = [Arrived("can0", Frame(0x04, bytes(8), error=True), 0.0)]
    driven.cycles(2)
    assert driven.can.armed and driven.can.counters.error_frames == 1
    driven.transport.others = [Arrived("can0", Frame(ERROR_BUS_OFF, bytes(8), error=True), 0.0)]
    driven.cycles(2)
    assert [fault.name for fault in driven.can.faults] == ["bus_off"]


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_random_frames_give_no_torque_and_do_no_harm(protocol):
    """`python -m pcw_sim_bridge.can.trials fuzz` throws 100,000."""
    outcome = fuzz(THESIS, read_can_file(f"thesis_{protocol}", THESIS), 1000, np.random.default_rng(5))
    assert outcome["torque_without_command"] == outcome["beyond_limits"] == 0 and outcome["works_afterwards"]
    assert outcome["foreign_counted"] > 100


# --- Homing ------------------------------------------------------------------------------------------------


def homing_rig(protocol, method, mark=0.4, direction=1):
    content = starting_content(THESIS, protocol)
    steering = [name for name in THESIS.joint_names if name.endswith("_steer")]
    homing = {"method": method, "position": mark, "speed": 6.0, "direction": direction}
    made = Rig(THESIS, can_file_from(with_joints(content, steering, homing=homing), THESIS))
    # On a jack, so that one turning fork moves no robot; the wheels stand anyhow.
    made.emulated.plant = make_plant("reduced", THESIS, lifted=True)
    return made


@pytest.mark.parametrize(("protocol", "method"), [("cia402", "index"), ("odrive", "switch")])
def test_homing_finds_the_same_zero_again_and_again(protocol, method):
    """Three times from anywhere: what the joints read afterwards is the truth, to two counts of the encoder."""
    rng = np.random.default_rng(7)
    for k in range(3):
        driven = homing_rig(protocol, method, direction=1 if k % 2 else -1)
        driven.emulated.plant.reset(steer_angle=rng.uniform(-3.0, 3.0, 4))
        driven.emulated._sampled, driven.emulated._heading = -1, driven.emulated._headings(driven.emulated.plant.state())
        driven.emulated._sample()
        for drive in driven.emulated.drives:
            drive.offset = drive.position  # switched on here
        driven.can.configure()
        assert driven.can.home() == dict.fromkeys((n for n in THESIS.joint_names if n.endswith("steer")), "attained")
        driven.cycles(50)
        read, true = driven.can.reading.joints.position[:, 1], driven.emulated.plant.state().joint_position[:, 1]
        wrong = np.array([math.remainder(x, math.tau) for x in read - true])
        assert np.abs(wrong).max() < 2 * math.tau / 4096 / 20 + 0.01 * np.abs(driven.can.reading.joints.velocity).max()
        assert driven.can.state == "off" and torques(driven) == 0.0


def test_homing_is_refused_while_moving_or_with_torque():
    driven = homing_rig("cia402", "index")
    driven.can.configure()
    driven.torque[:, 0] = 1.0
    driven.can.enable()
    with pytest.raises(CanError, match="allowed: deactivate first"):
        driven.can.start_homing()
    driven.cycles(20)
    driven.can.request_disable()
    driven.cycles(3)
    with pytest.raises(CanError, match="not allowed while moving"):
        driven.can.start_homing()
    with pytest.raises(CanError, match="nose_steer"):
        driven.can.start_homing(["nose_steer"])


def test_homing_without_a_mark_ends_and_a_fault_ends_it_too():
    content = starting_content(THESIS, "cia402")
    homing = {"method": "index", "speed": 0.01, "timeout": 0.5, "position": 3.0}
    driven = Rig(THESIS, can_file_from(with_joints(content, ["front_left_steer"], homing=homing), THESIS))
    driven.can.configure()
    assert driven.can.home(["front_left_steer"]) == {"front_left_steer": "no mark within 0.5 s"}
    driven.cycles(5)
    assert torques(driven) == 0.0
    driven.can.start_homing(["front_left_steer"])
    driven.cycles(20)
    driven.emulated.inject("over_current", "front_left_steer")
    driven.cycles(5)
    assert driven.can.homing_results == {"front_left_steer": "stopped by a fault"} and torques(driven) == 0.0


def test_a_mark_on_a_motor_that_turns_with_the_wheel_is_refused():
    robot = load_robot("tidybot2")
    with pytest.raises(DescriptionError, match="homing"):
        can_file_from(with_joints(starting_content(robot), ["front_left_drive"], homing={"method": "index"}), robot)


# --- Steering zeros ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(("name", "protocol"), [pytest.param("thesis", "cia402", marks=NIGHTLY), ("tidybot2", "odrive")])
def test_the_calibration_finds_how_the_encoders_are_mounted(name, protocol):
    """Encoders turned by up to 0.1 rad: found within 3 mrad, a sixth of a degree, after at most three motions of 10 s."""
    robot = load_robot(name)
    true = np.array([0.08, -0.05, 0.1, 0.03])
    file = can_file_from(starting_content(robot, protocol, rate=125.0), robot)
    emulated = EmulatedRobot(make_plant("reduced", robot), file)
    emulated.zero[:, 1] += true
    found, said = steer_zero(robot, file, EmulatedTransport(emulated), 10.0)
    np.testing.assert_allclose(found, true, atol=3e-3)
    assert f"{robot.caster_names[0]}_steer" in said and np.abs(emulated.motor_torques()).max() == 0.0


def test_a_motion_without_turning_is_not_enough():
    with pytest.raises(CanError, match="allowed: at least 100"):
        estimate_steer_zeros(THESIS, np.zeros((500, 4, 2)), np.zeros((500, 4, 2)))


BLOCK_STYLE = """\
format: pcw_can/1
name: block  # a remark
buses:
  - {name: can0, interface: virtual, channel: x}
joint_defaults: {bus: can0, protocol: odrive, torque_constant: 0.05, current_limit: 16}
joints:
  - name: front_left_drive
    node_id: 1
  - name: front_left_steer  # the stiff one
    zero: 0.5
    node_id: 2
  - node_id: 3
    name: front_right_drive
  - node_id: 4
    name: front_right_steer
  - {name: rear_left_drive, node_id: 5}
  - {node_id: 6, zero: -0.25, name: "rear_left_steer"}
  - {name: rear_right_drive, node_id: 7}
  - {name: rear_right_steer, node_id: 8}  # last
"""


def test_zeros_are_written_where_they_stand_and_the_old_file_is_kept(tmp_path):
    path = tmp_path / "drives.yaml"
    path.write_text(BLOCK_STYLE)
    before = read_can_file(path, THESIS)
    kept = write_zeros(path, THESIS, np.array([0.1, 0.2, 0.3, -0.4]))
    assert kept == tmp_path / "drives.yaml.1" and kept.read_text() == BLOCK_STYLE
    after = {joint.name: joint.zero for joint in read_can_file(path, THESIS).joints}
    # The robot's casters are front_left, front_right, rear_left, rear_right.
    wanted = {"front_left_steer": 0.6, "front_right_steer": 0.2, "rear_left_steer": 0.05, "rear_right_steer": -0.4}
    assert after == {joint.name: wanted.get(joint.name, 0.0) for joint in before.joints}
    assert "# the stiff one" in path.read_text() and "# last" in path.read_text()
    assert write_zeros(path, THESIS, np.zeros(4)) == tmp_path / "drives.yaml.2"

    other = tmp_path / "new.yaml"
    write_zeros(path, THESIS, np.ones(4), out=other)
    with pytest.raises(CanError, match="exists already"):
        write_zeros(path, THESIS, np.ones(4), out=other)
    odd = tmp_path / "odd.yaml"
    odd.write_text(BLOCK_STYLE.replace("name: front_right_steer", "name:\n      front_right_steer"))
    text = odd.read_text()
    with pytest.raises(CanError, match="on one line"):
        write_zeros(odd, THESIS, np.ones(4))
    assert odd.read_text() == text and not (tmp_path / "odd.yaml.1").exists()
    for name in ("thesis_cia402", "thesis_odrive"):
        copied = tmp_path / f"{name}.yaml"
        shutil.copy(find_can_file(name), copied)
        write_zeros(copied, THESIS, np.full(4, 0.25))
        assert {joint.zero for joint in read_can_file(copied, THESIS).joints} == {0.0, 0.25}


# --- Logs and recordings -----------------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", [".log", ".asc", ".blf"])
@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_logged_frames_become_a_recording_of_what_was(tmp_path, suffix, protocol):
    pytest.importorskip("can")
    from pcw_sim_bridge.can.can_log import make_recording
    from pcw_sim_bridge.can.python_can import FrameLogWriter

    driven = rig(protocol)
    driven.torque[:] = 0.7
    driven.can.enable()
    frames = driven.transport.log()
    readings = []

    def answer(reading):
        readings.append(reading)
        driven.answer(reading)

    for _ in range(100):
        driven.can.cycle(answer)
    log = tmp_path / f"run{suffix}"
    writer = FrameLogWriter(log)
    for bus, frame, time, sent in frames:
        writer.write(bus, frame, 1000.0 + time, sent)
    writer.close()
    with pytest.raises(CanError, match="exists already"):
        FrameLogWriter(log)
    said = make_recording(log, THESIS, driven.can.file, tmp_path / "bag")
    assert "0 frames of nobody" in said
    recording = Recording.open(tmp_path / "bag", THESIS)
    states = recording.joint_states
    assert len(states) == pytest.approx(len(readings), abs=2)
    position = np.array([reading.joints.position.ravel() for reading in readings])
    found = states.position.reshape(len(states), -1)
    # Times in the log have a resolution of their own; each reading is in the recording, to the last digit.
    assert np.isclose(found[5:-5, None, 0], position[None, :, 0], atol=1e-9).any(axis=1).all()
    commands = recording.joint_commands
    assert len(commands) > 90 and np.abs(commands.effort).max() == pytest.approx(0.7, abs=0.02)


def test_a_log_that_is_none_is_refused(tmp_path):
    pytest.importorskip("can")
    from pcw_sim_bridge.can.python_can import read_log

    with pytest.raises(CanError, match=r"\.txt"):
        list(read_log(tmp_path / "x.txt"))
    for content in (b"no", bytes(range(256)) * 10):  # too short, and long enough to be looked at
        for suffix in (".log", ".asc", ".blf"):
            (tmp_path / f"x{suffix}").write_bytes(content)
            try:
                assert list(read_log(tmp_path / f"x{suffix}")) == []  # ASC passes over lines that it does not know
            except CanError as error:
                assert "cannot be read" in str(error)
            else:
                assert suffix == ".asc"


def test_a_run_over_can_leaves_the_recording_that_the_bridge_would(tmp_path):
    file = read_can_file("thesis_cia402", THESIS)
    record_run_over_can(THESIS, file, lambda time: np.array([0.2 * np.sin(3.0 * time), 0.0, 0.1]), 1.5, 1, tmp_path / "can")
    record_run(THESIS, lambda time: np.array([0.2 * np.sin(3.0 * time), 0.0, 0.1]), 1.5, 1, tmp_path / "bridge")
    over_can, bridged = (Recording.open(tmp_path / name, THESIS) for name in ("can", "bridge"))
    assert [str(warning) for warning in over_can.warnings] == [str(warning) for warning in bridged.warnings]
    assert len(over_can.joint_states) == pytest.approx(375, abs=3) and len(bridged.joint_states) == pytest.approx(750, abs=3)
    assert len(over_can.imu) == pytest.approx(len(bridged.imu), abs=2)
    assert over_can.ground_truth.pose[-1] == pytest.approx(bridged.ground_truth.pose[-1], abs=0.01)
    assert over_can.cmd_vel is not None and np.abs(over_can.joint_commands.effort).max() > 0.1


@NIGHTLY
def test_the_analyser_gives_the_same_verdicts_over_can(tmp_path):
    said, same = run_verdict(tmp_path, 3)
    assert same, said


# --- The doctor --------------------------------------------------------------------------------------------


def findings(robot=THESIS, change=None, lifted=True, protocol="cia402", nudge=True, others=()):
    """What the doctor says of drives that are as the file says, but for `change(emulated)`, with frames of others."""
    file = can_file_from(starting_content(robot, protocol), robot)
    emulated = EmulatedRobot(make_plant("reduced", robot, lifted=lifted), file)
    if change is not None:
        change(emulated)
    found = []
    transport = ClosableTransport(emulated)
    for finding in examine(robot, file, transport, nudge, lifted=lifted):
        if "node 1 on can0" in finding.text:  # the drives are set up, and it will listen
            transport.others = [Arrived("can0", frame, 0.0) for frame in others]
        found.append(finding)
    return found


@pytest.mark.parametrize("lifted", [True, pytest.param(False, marks=NIGHTLY)])
def test_the_doctor_finds_nothing_wrong_with_a_healthy_robot(lifted):
    found = findings(lifted=lifted)
    assert [str(finding) for finding in found if not finding.good] == []
    assert sum("it turned with its torque" in finding.text for finding in found) == 8


def test_the_doctor_says_that_another_computer_commands_the_drives():
    frames = [Frame(0x77F, b"\x05"), Frame(0x7FE, b"\x05")]
    found = [f.text for f in findings(nudge=False, others=frames) if not f.good]
    assert len(found) == 2
    assert "0x77F is what a computer sends to these drives" in found[0] and "0x7FE is of nobody" in found[1]
    found = [str(f) for f in findings(others=[Frame(0x201, bytes(7))]) if not f.good]
    assert "nudge: torque is not allowed while another computer or program commands these drives" in "".join(found)


def test_the_doctor_says_what_is_wrong():
    def wrong_sign(emulated):
        drive = emulated.drives[1]
        emulated.sign[joint_place(THESIS, drive.name)] = 1.0
        read = type(drive).shown_position.fget
        emulated.drives[1].__class__ = type("Turned", (type(drive),), {
            "shown_position": property(lambda self: -read(self)),
            "velocity": property(lambda self: -self.__dict__.get("_v", 0.0), lambda self, v: self.__dict__.update(_v=v)),
        })  # fmt: skip

    found = [str(f) for f in findings(change=wrong_sign) if not f.good]
    assert any("front_left_steer: it turned against its torque" in text for text in found), found

    def brake(emulated):
        emulated.drives[4].want = lambda: None

    found = [str(f) for f in findings(change=brake) if not f.good]
    assert found and "rear_left_drive: it stood still" in found[0]

    def silent(emulated):
        emulated.inject("dead", "rear_right_steer")

    found = [str(f) for f in findings(change=silent) if not f.good]
    assert len(found) == 1 and "rear_right_steer" in found[0] and "no answer" in found[0]

    def counts(emulated):
        emulated.drives[6]._per_count /= 4.0
        emulated.drives[6]._velocity_unit /= 4.0

    found = [str(f) for f in findings(change=counts) if not f.good]
    assert len(found) == 1 and "rear_right_drive" in found[0] and "gear, counts or torque constant are wrong" in found[0]


class Late:
    """A bus on which frames wait while the emulator is kept from running, and its end."""

    def __init__(self, begin, late, frames, stopped):
        self.time, self._late, self._frames, self._stopped, self.sent = begin, late, frames, stopped, []

    def now(self):
        return self.time

    def send(self, bus, frame):
        self.sent.append(frame)

    def receive(self, timeout):
        self._stopped.set()
        self.time, self._late = self.time + self._late, 0.0
        taken, self._frames = self._frames[:64], self._frames[64:]
        return [Arrived("can0", frame, self.time) for frame in taken]


def test_an_emulator_that_was_kept_waiting_answers_as_drives_in_hardware_would_have():
    """On a busy laptop drives tripped their watchdogs, and said one count to many SYNCs, as a dead encoder does."""
    driven = rig()
    driven.torque[:, 0] = 2.0
    driven.can.enable()
    driven.cycles(50)
    driven.transport.sent = []
    driven.cycles(20)
    frames, stopped = [frame for _, frame in driven.transport.sent], threading.Event()
    bus = Late(driven.emulated.time, 20 * driven.can.period, frames, stopped)
    serve(driven.emulated, bus, driven.timer, [], queue.Queue(), None, stopped)
    assert not any(drive.failure for drive in driven.emulated.drives)
    counts = [frame.data[2:6] for frame in bus.sent if frame.id == 0x181]
    assert len(counts) == 20 and len(set(counts)) == 20


def test_faults_of_the_emulator_are_read_and_refused():
    assert read_faults(["dead a_drive 3", "# none", "", "foreign can0 1.5 # soon"]) == [
        (1.5, "foreign", "can0"),
        (3.0, "dead", "a_drive"),
    ]
    with pytest.raises(CanError, match="NAME WHERE SECONDS"):
        read_faults(["dead a_drive"])
    driven = rig()
    for fault, where, allowed in (("ded", "all", "dead"), ("dead", "nose", "front_left_drive"), ("bus_off", "can7", "can0")):
        with pytest.raises(CanError, match=allowed):
            driven.emulated.inject(fault, where)
