"""What must not give torque, and what must not keep it from being taken away: each test was a hole once, or guards one."""

import math
import struct

import numpy as np
import pytest

from pcw_description import load_robot
from pcw_sim_bridge.can.can_file import can_file_from, joint_place, read_can_file
from pcw_sim_bridge.can.can_robot import CanRobot
from pcw_sim_bridge.can.doctor import examine
from pcw_sim_bridge.can.drive import Mode
from pcw_sim_bridge.can.emulated_robot import EmulatedRobot, EmulatedTransport
from pcw_sim_bridge.can.encoder_trials import one_encoder
from pcw_sim_bridge.can.encoder_watch import EncoderWatch
from pcw_sim_bridge.can.errors import CanError
from pcw_sim_bridge.can.frame import ERROR_BUS_OFF, Arrived, Frame
from pcw_sim_bridge.can.starting_file import starting_content, with_joints
from pcw_sim_bridge.can.transport import TransmitBufferFull
from pcw_sim_bridge.can.trial_rig import Rig
from pcw_sim_bridge.plants.factory import make_plant
from pcw_sim_bridge.simulated_robot import JointCommand

THESIS = load_robot("thesis")
PROTOCOLS = ("cia402", "odrive")
ONES = JointCommand(effort=np.ones((4, 2)))


def rig(protocol="cia402", **changes):
    content = starting_content(THESIS, protocol, **changes) if changes else None
    made = Rig(THESIS, can_file_from(content, THESIS) if content else read_can_file(f"thesis_{protocol}", THESIS))
    made.can.configure()
    return made


def driving(protocol):
    """Return a rig that has been told to drive every joint with 1 N m for five periods."""
    driven = rig(protocol)
    driven.torque[:] = 1.0
    driven.can.enable()
    driven.cycles(5)
    return driven


def torques(driven):
    return np.abs(driven.emulated.motor_torques()).max()


def names(driven):
    return [fault.name for fault in driven.can.faults]


# --- Commands ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_a_command_of_before_torque_does_not_act_when_torque_comes(protocol):
    """While drives take torque a second may pass: what was wanted then is as old when they have it."""
    driven = rig(protocol)
    driven.can.command(ONES)
    driven.can.request_enable()
    driven.can.command(ONES)
    most = 0.0
    for _ in range(60):
        driven.can.cycle(None)
        most = max(most, torques(driven))
    assert driven.can.armed and most == 0.0


def test_a_command_that_answers_an_old_reading_is_as_good_as_none():
    """It was in a buffer somewhere. Each keeps neither the torque nor the robot alive."""
    driven = rig()
    driven.can.enable()
    driven.can.cycle(lambda reading: driven.can.command(ONES, reading.time))
    first = driven.can.reading
    assert torques(driven) > 0.0
    for _ in range(20):
        driven.can.cycle(lambda _: driven.can.command(ONES, first.time))
    assert names(driven) == ["command_timeout"] and torques(driven) == 0.0
    # "none for 44 ms" sent people to look for a controller that was silent, and theirs was not.
    assert "came, but by their stamps too old, and none of use for" in driven.can.faults[0].detail
    assert 8 <= driven.can.counters.stale_commands <= 11  # those in the first 40 ms are not old yet


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, 1e308])
@pytest.mark.parametrize("velocity", [False, True])
def test_no_number_gets_through_that_is_none(value, velocity):
    driven = rig("odrive")
    driven.can.enable()
    broken = JointCommand(velocity=np.ones((4, 2))) if velocity else JointCommand(effort=np.ones((4, 2)))
    (broken.velocity if velocity else broken.effort)[2, 1] = value  # behind the back of its check
    driven.transport.sent = []
    driven.can.cycle(lambda _: driven.can.command(broken))
    for _, frame in driven.transport.sent:
        for drive in driven.can.drives:
            want = drive.decode_command(frame)
            if want is not None:
                assert math.isfinite(want.value)
                assert want.value == 0.0 or value == 1e308


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_a_speed_of_before_does_not_act_when_speeds_are_held_again(protocol):
    """An ODrive keeps its inputs over a change of mode and over the idle state."""
    driven = rig(protocol)
    fast, still = JointCommand(velocity=np.full((4, 2), 5.0)), JointCommand(velocity=np.zeros((4, 2)))
    driven.can.enable()
    for _ in range(5):
        driven.can.cycle(lambda _: driven.can.command(fast))
    driven.can.request_disable()
    driven.cycles(5, answered=False)
    seen = []
    receive = driven.emulated.receive

    def watched(bus, frame):
        receive(bus, frame)
        seen.extend(drive.want() for drive in driven.emulated.drives)

    driven.emulated.receive = watched
    driven.can.enable()
    for command in (still, JointCommand(effort=np.zeros((4, 2))), still):
        for _ in range(4):
            driven.can.cycle(lambda _, command=command: driven.can.command(command))
    wants = [want for want in seen if want is not None]
    assert {want[0] for want in wants} == {Mode.TORQUE, Mode.VELOCITY} and all(want[1] == 0.0 for want in wants)


@pytest.mark.parametrize(("protocol", "identifier"), [("cia402", 0x201), ("odrive", 1 << 5 | 0x0E)])
def test_there_is_no_torque_beside_another_computer_that_commands_the_drives(protocol, identifier):
    """Two drivers on a bus: each would have set the torques of the other."""
    driven = rig(protocol)
    driven.transport.others = [Arrived("can0", Frame(identifier, bytes(8)), 0.0)]
    driven.cycles(2, answered=False)
    with pytest.raises(CanError, match=f"another computer or program commands these drives.*0x{identifier:03X}"):
        driven.can.enable()
    driven.cycles(1, answered=False)
    assert driven.can.state == "off" and not driven.can.faults
    driven.cycles(800, answered=False)
    driven.can.enable()


# --- Stopping ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("error", [OSError("disk"), RuntimeError("bug"), TransmitBufferFull("can0: full")])
def test_a_frame_that_cannot_be_sent_does_not_keep_the_others_from_being_told_to_stop(error):
    """Whatever an interface raises: every drive but the one whose frame fails is told to let go, at once."""
    driven = driving("odrive")
    send, first = driven.transport.send, driven.can.drives[0]

    def broken(bus, frame):
        if frame.id >> 5 == first.node_id:
            raise error
        send(bus, frame)

    driven.transport.send = broken
    driven.can.cycle(driven.answer)
    assert driven.can.faults and not driven.can.armed
    assert [drive.want() is not None for drive in driven.emulated.drives] == [True] + [False] * 7
    driven.cycles(12)
    assert torques(driven) == 0.0  # the first by its watchdog


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_one_frame_too_many_for_the_buffer_stops_the_robot_within_a_period(protocol):
    driven = driving(protocol)
    send, left = driven.transport.send, [3]

    def once_full(bus, frame):
        left[0] -= 1
        if left[0] == 0:
            raise TransmitBufferFull("can0: full")
        send(bus, frame)

    driven.transport.send = once_full
    driven.can.cycle(driven.answer)
    assert names(driven) == ["transmit_buffer_full"] and driven.can.counters.transmit_full == 1
    driven.transport.receive(0.002)
    assert torques(driven) == 0.0


@pytest.mark.parametrize(
    ("protocol", "base", "what"),
    [("cia402", 0x281, "speed"), ("odrive", 0x34, "torque"), ("odrive", 0x21, "word of its state"),
     ("odrive", 0x35, "temperature")],
)  # fmt: skip
def test_a_message_that_no_longer_comes_is_missed_though_positions_come(protocol, base, what):
    """Positions alone do not tell that a drive has failed, is hot or gives too much."""
    driven = rig(protocol)
    driven.torque[:, 0] = 0.5
    driven.can.enable()
    driven.cycles(30)
    take = driven.emulated.take
    driven.emulated.take = lambda: [one for one in take() if one.frame.id != base]
    for _ in range(300):
        driven.can.cycle(driven.answer)
        if driven.can.faults:
            break
    assert [(f.name, f.where) for f in driven.can.faults] == [("missing_node", "front_left_drive")]
    assert f"no {what}" in driven.can.faults[0].detail
    assert torques(driven) == 0.0


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_a_drive_that_is_missing_ends_the_readings_until_it_speaks(protocol):
    """They had gone on at their rate with the last position and speed of the drive, like those of a robot that moves."""
    driven, times = driving(protocol), []

    def answer(reading):
        times.append(driven.transport.now())
        driven.answer(reading)

    driven.emulated.inject("dead", "front_left_drive")
    begun = driven.transport.now()
    for _ in range(100):
        driven.can.cycle(answer)
    assert names(driven) == ["missing_node"]
    assert 0.02 < times[-1] - begun < driven.can.file.timeouts.feedback + 2.0 * driven.can.period
    driven.emulated.inject("heal", "front_left_drive")
    driven.can.clear_faults()
    times.clear()
    for _ in range(10):
        driven.can.cycle(answer)
    assert len(times) == 10


@pytest.mark.parametrize("answers", [False, True])
def test_drives_that_cannot_be_set_up_again_leave_a_fault(answers):
    """None was left: the driver looked healthy, and `activate` asked for a configure that an inactive node does not have."""
    driven = rig()
    lost = driven.emulated._by_name["front_left_drive"]
    if answers:  # as beside another computer that sets up the same drives
        receive = driven.transport.receive
        driven.transport.receive = lambda timeout: [one for one in receive(timeout) if one.frame.id != 0x181]
    else:
        lost.dead = True
    with pytest.raises(CanError, match="front_left_drive: "):
        driven.can.clear_faults()
    driven.can.cycle(None)
    assert driven.can.state == "fault" and names(driven) == ["not_set_up"]
    assert "front_left_drive" in driven.can.faults[0].detail and "\n" not in str(driven.can.faults[0])
    with pytest.raises(CanError, match="allowed: clear_faults first"):
        driven.can.enable()
    if not answers:
        lost.dead = False
        driven.can.clear_faults()
        driven.can.enable()


def test_a_bus_that_fails_while_faults_are_cleared_is_not_forgotten():
    driven = rig()
    handle = driven.can._cycle_once

    def failing(on_reading):
        driven.transport.others = [Arrived("can0", Frame(ERROR_BUS_OFF, bytes(8), error=True), 0.0)]
        handle(on_reading)

    driven.can._cycle_once = failing
    with pytest.raises(CanError, match="bus_off at can0"):
        driven.can.clear_faults()
    with pytest.raises(CanError, match="bus_off at can0.*allowed: clear_faults first"):
        driven.can.enable()


def test_a_bus_that_never_falls_silent_does_not_keep_configure_from_ending():
    driven = rig()
    receive, clock = driven.transport.receive, [0.0]
    driven.transport.now = lambda: driven.emulated.time + clock[0]

    def flood(timeout):
        clock[0] += 1e-3
        driven.transport.others = [Arrived("can0", Frame(0x7FE, b"x"), 0.0)]
        return receive(timeout)

    driven.transport.receive = flood
    try:
        driven.can.configure()
    except CanError as error:
        assert "no answer" in str(error) or "no position" in str(error)
    assert clock[0] > 0.1


# --- Drives ------------------------------------------------------------------------------------------------


def test_a_drive_that_keeps_its_last_error_code_can_be_used_again():
    """0x603F is the code of the last error: many drives keep it after a reset, and it is no fault then; a new one is."""
    driven = rig()
    for drive in driven.emulated.drives:
        drive.keeps_error_code = True
    driven.can.enable()
    driven.emulated.inject("over_current", "front_left_drive")
    driven.cycles(3)
    assert names(driven) == ["over_current"]
    driven.can.clear_faults()
    driven.can.enable()
    driven.cycles(50)
    assert driven.can.armed
    driven.emulated.inject("over_current", "front_left_drive")
    driven.cycles(3)
    assert names(driven) == ["over_current"]


def test_a_drive_that_cannot_watch_the_computer_is_refused_unless_the_file_allows_it():
    driven = rig()
    driven.emulated.drives[2].lacks = {0x1016}
    with pytest.raises(CanError, match=r"front_right_drive.*0x1016.*unwatched: true"):
        driven.can.configure()
    content = with_joints(starting_content(THESIS), ["front_right_drive"], unwatched=True)
    content["joint_defaults"].update(rated_torque=0.5, torque_constant=0.05, current_limit=16.0)
    allowed = CanRobot(THESIS, can_file_from(content, THESIS), driven.transport)
    allowed.configure()
    assert any("does not watch this computer" in note for note in allowed.drives[2].notes)


def test_odrives_whose_watchdog_wants_food_when_idle_are_fed_while_the_others_are_set_up():
    driven = Rig(THESIS, read_can_file("thesis_odrive", THESIS))
    for drive in driven.emulated.drives:
        drive.watches_when_idle = True
    while driven.emulated.time < 0.2:
        driven.transport.receive(0.01)
    assert all(drive.errors for drive in driven.emulated.drives)
    driven.can.configure()
    driven.cycles(20)
    assert not driven.can.faults
    driven.can.enable()


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_whoever_configures_takes_the_torque_that_another_computer_left_on(protocol):
    driven = driving(protocol)
    for drive in driven.emulated.drives:
        drive.watchdog = 1e9
        getattr(drive, "objects", {})[0x1016, 1] = 0
    assert torques(driven) > 0.0
    successor = CanRobot(THESIS, driven.can.file, driven.transport)
    driven.emulated.inject("silent", "rear_left_drive")  # so that it does not succeed
    with pytest.raises(CanError):
        successor.configure()
    on = [drive.want() is not None for drive in driven.emulated.drives if drive.name != "rear_left_drive"]
    assert not any(on)


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_the_doctor_finds_a_drive_that_nothing_would_stop_without_the_computer(protocol):
    file = can_file_from(starting_content(THESIS, protocol), THESIS)
    emulated = EmulatedRobot(make_plant("reduced", THESIS, lifted=True), file)
    drive = emulated.drives[3]
    if protocol == "odrive":
        drive.unwatched = True
    else:
        drive.objects[0x6007, 0] = 0
        drive.lacks = {0x6007}
    found = []
    for finding in examine(THESIS, file, EmulatedTransport(emulated), lifted=True):
        found.append(str(finding))
        if "turned" in finding.text:
            break  # the joints' turn is another test's
    wrong = [text for text in found if text.startswith("WRONG") and "torque" in text]
    assert len(wrong) == 1 and wrong[0].startswith("WRONG front_right_steer: it still has torque 80 ms after"), found


# --- Encoders that stand -----------------------------------------------------------------------------------


@pytest.mark.parametrize("fault", ["encoder_stuck", "encoder_dead"])
@pytest.mark.parametrize(("protocol", "axis"), [("cia402", "drive"), ("odrive", "steer")])
def test_an_encoder_that_stands_is_found_within_50_ms_from_1_rad_per_second(fault, protocol, axis):
    """`python -m pcw_sim_bridge.can.trials encoders` says how it is at every speed."""
    rng = np.random.default_rng(11)
    driven = rig(protocol)
    found = one_encoder(driven, fault, axis, (1.0, 10.0), rng)
    assert found is not None and found.after is not None and found.after <= 0.05, found


def test_other_joints_tell_which_encoder_stands_and_no_more():
    """Kinematics alone: joints that follow a rigid motion exactly, each in turn standing, are named; none else ever is."""
    from pcw_description.differential_kinematics import inverse_kinematics

    count = np.full((4, 2), math.tau / 4096 / 20)
    for standing in [None, *range(8)]:
        watch = EncoderWatch(THESIS, np.full((4, 2), 0.01), count)
        position = np.array([[0.0, 0.4], [1.0, -0.7], [2.0, 2.0], [0.5, 1.2]])
        shown, blamed = position.copy(), set()
        for k in range(40):
            twist = np.array([0.3, 0.1 * math.sin(0.1 * k), 0.5])
            position = position + 0.004 * inverse_kinematics(THESIS, position[:, 1], twist)
            seen = np.round(position / count) * count
            keep = np.arange(8).reshape(4, 2) == standing
            shown = np.where(keep & (k >= 5), shown, seen)
            blamed |= {joint for joint, _ in watch.look(shown)}
        assert blamed == ({standing} if standing is not None else set())


def test_wheels_that_turn_in_the_air_do_not_accuse_those_that_stand():
    """On a jack: drives turn as they like, steering axes stand; no rigid motion explains it, and no encoder is to blame."""
    count = np.full((4, 2), math.tau / 4096 / 20)
    watch = EncoderWatch(THESIS, np.full((4, 2), 0.01), count)
    position = np.array([[0.0, 0.4], [0.0, -0.7], [0.0, 2.0], [0.0, 1.2]])
    for k in range(200):
        moved = position.copy()
        moved[:, 0] += k * 0.004 * np.array([3.0, 3.0, 3.0, 3.0])
        assert watch.look(moved) == []


def test_two_casters_cannot_disagree_and_are_not_judged():
    import dataclasses

    two = dataclasses.replace(THESIS, casters=THESIS.casters[:2])
    assert not EncoderWatch(two, np.full((2, 2), 0.01), np.full((2, 2), 1e-4)).usable
    assert EncoderWatch(THESIS, np.full((4, 2), 0.01), np.full((4, 2), 1e-4)).usable


def test_a_speed_that_is_noise_does_not_make_a_standing_joint_turn():
    driven = rig()
    driven.can.enable()
    rng = np.random.default_rng(2)
    zero = JointCommand(effort=np.zeros((4, 2)))
    place = joint_place(THESIS, "front_left_drive")
    assert place == (0, 0)
    for _ in range(500):
        for drive in driven.emulated.drives:
            drive.velocity = float(rng.normal(0.0, 2.0))  # 0.1 rad/s of the joint, 40 counts in a period
        driven.emulated._sampled = driven.emulated._steps
        driven.can.cycle(lambda reading: driven.can.command(zero, reading.time))
    assert not driven.can.faults, driven.can.faults


def test_frames_of_the_drives_reach_the_driver_as_packed():
    """What the tests above take for granted of the identifiers that they drop."""
    driven = rig("odrive")
    frames = driven.transport.log()
    driven.cycles(30, answered=False)
    seen = {frame.id for _, frame, _, sent in frames if not sent}
    assert {0x20 | 0x01, 0x20 | 0x09, 0x20 | 0x14, 0x20 | 0x15} <= seen
    estimates = next(frame for _, frame, _, sent in frames if not sent and frame.id == 0x29)
    assert math.isfinite(struct.unpack("<ff", estimates.data)[0])


def test_a_jump_between_two_positions_of_one_period_is_found():
    """ODrives send when they like: of two positions in a period the watch saw the step to the second alone once."""
    driven = rig("odrive")
    driven.can.enable()
    driven.cycles(20)
    receive = driven.transport.receive
    period = driven.can.period

    def late(timeout):
        """Nothing comes for two periods, as on a computer that is busy; then all of it at once."""
        driven.transport.receive = receive
        driven.emulated.advance(driven.emulated.time + 0.6 * period, driven.timer.on_step)
        driven.emulated.inject("encoder_jump", "rear_left_drive")
        driven.emulated.advance(driven.emulated.time + 2.0 * period, driven.timer.on_step)
        driven.transport._now = driven.emulated.time
        return receive(timeout)

    driven.transport.receive = late
    driven.cycles(3)
    assert [(fault.name, fault.where) for fault in driven.can.faults] == [("encoder_jump", "rear_left_drive")]


def test_the_torque_of_a_reading_is_of_the_same_instant_as_its_positions():
    """An ODrive sends its torque after its position: of the last drive it came too late once, and read a period old."""
    driven = rig("odrive")
    driven.can.enable()
    wrong = 0
    size = [0.0]

    def answer(reading):
        nonlocal wrong
        told = size[0]
        if told:
            wrong += int((np.abs(reading.joints.effort - told) > 0.3).sum())
        size[0] = 1.5 if told == 0.5 else 0.5
        driven.can.command(JointCommand(effort=np.full((4, 2), size[0])), reading.time)

    for _ in range(30):
        driven.can.cycle(answer)
    assert wrong == 0
