"""Frames against libraries that are not ours: `canopen` as master and as slave, `cantools` with the DBC."""

import struct
import threading
import time

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

can = pytest.importorskip("can")
canopen = pytest.importorskip("canopen")
pytest.importorskip("cantools")

from pcw_description import load_robot  # noqa: E402
from pcw_sim_bridge.can.can_file import can_file_from, read_can_file  # noqa: E402
from pcw_sim_bridge.can.can_robot import CanRobot  # noqa: E402
from pcw_sim_bridge.can.cia402 import Cia402Drive, error_name, status_name  # noqa: E402
from pcw_sim_bridge.can.drive import DriveState, Mode, Want, shorter_angle  # noqa: E402
from pcw_sim_bridge.can.drive_set import make_drives  # noqa: E402
from pcw_sim_bridge.can.emulated_cia402 import OBJECTS, STRINGS, EmulatedCia402  # noqa: E402
from pcw_sim_bridge.can.emulated_odrive import EmulatedODrive  # noqa: E402
from pcw_sim_bridge.can.errors import CanError  # noqa: E402
from pcw_sim_bridge.can.frame import Frame  # noqa: E402
from pcw_sim_bridge.can.odrive import ODriveDrive, database, error_names, layout  # noqa: E402
from pcw_sim_bridge.can.python_can import to_frame, to_message  # noqa: E402
from pcw_sim_bridge.can.starting_file import starting_content  # noqa: E402
from pcw_sim_bridge.can.trial_rig import Rig  # noqa: E402

THESIS = load_robot("thesis")


def made(protocol="cia402"):
    return read_can_file(f"thesis_{protocol}", THESIS)


def object_dictionary():
    """The objects of the profile that we use, for canopen."""
    dictionary = canopen.ObjectDictionary()
    types = {
        (1, False): canopen.objectdictionary.UNSIGNED8, (2, False): canopen.objectdictionary.UNSIGNED16,
        (4, False): canopen.objectdictionary.UNSIGNED32, (1, True): canopen.objectdictionary.INTEGER8,
        (2, True): canopen.objectdictionary.INTEGER16, (4, True): canopen.objectdictionary.INTEGER32,
    }  # fmt: skip
    by_index = {}
    for (index, sub), (size, signed, writable) in OBJECTS.items():
        by_index.setdefault(index, []).append((sub, types[size, signed], writable))
    for index, entries in by_index.items():
        if len(entries) == 1:
            holder = canopen.objectdictionary.ODVariable(f"object {index:04X}", index, 0)
            holder.data_type, holder.access_type = entries[0][1], "rw" if entries[0][2] else "ro"
        else:
            holder = canopen.objectdictionary.ODRecord(f"object {index:04X}", index)
            for sub, kind, writable in entries:
                member = canopen.objectdictionary.ODVariable(f"sub {sub}", index, sub)
                member.data_type, member.access_type = kind, "rw" if writable else "ro"
                holder.add_member(member)
        dictionary.add_object(holder)
    for (index, sub), _ in STRINGS.items():
        variable = canopen.objectdictionary.ODVariable(f"object {index:04X}", index, sub)
        variable.data_type = canopen.objectdictionary.VISIBLE_STRING
        dictionary.add_object(variable)
    return dictionary


class Serving:
    """An emulated drive on a virtual bus of python-can, in a thread."""

    def __init__(self, drive, channel):
        self._bus, self._drive = can.Bus(interface="virtual", channel=channel), drive
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._serve, daemon=True)

    def _serve(self):
        while not self._stop.is_set():
            message = self._bus.recv(0.005)
            now = time.monotonic()
            frames = self._drive.receive(to_frame(message), now) if message is not None else []
            for frame in frames + self._drive.tick(now):
                self._bus.send(to_message(frame))

    def __enter__(self):
        self._thread.start()
        return self._drive

    def __exit__(self, *_):
        self._stop.set()
        self._thread.join()
        self._bus.shutdown()


def test_canopens_master_configures_and_drives_the_emulated_drive():
    """SDO up and down, segmented strings, aborts, PDO mapping read back, NMT, heartbeat, SYNC and PDOs: by `canopen`."""
    drive = EmulatedCia402(made().joints[0], 250.0, 0.02, 0.5, 4096)
    drive.position, drive.velocity, drive.torque = 12.5, 3.0, 0.1
    network = canopen.Network()
    with Serving(drive, "master_test"):
        network.connect(interface="virtual", channel="master_test")
        try:
            node = network.add_node(1, object_dictionary())
            assert node.sdo[0x1000].raw & 0xFFFF == 402
            assert node.sdo[0x1008].raw == "PCW emulated CiA 402 drive"
            assert node.sdo[0x6076].raw == 500
            with pytest.raises(canopen.SdoAbortedError) as refused:
                node.sdo[0x6041].raw = 1
            assert refused.value.code == 0x06010002
            with pytest.raises(canopen.SdoAbortedError) as refused:
                node.sdo.upload(0x5FFF, 0)
            assert refused.value.code == 0x06020000
            node.sdo[0x1017].raw = 20

            node.nmt.state = "PRE-OPERATIONAL"
            node.tpdo.read()
            node.rpdo.read()
            node.tpdo[1].clear()
            for index in (0x6041, 0x6064, 0x6077):
                node.tpdo[1].add_variable(index)
            node.tpdo[1].trans_type, node.tpdo[1].enabled = 1, True
            node.rpdo[1].clear()
            for index in (0x6040, 0x6071, 0x6060):
                node.rpdo[1].add_variable(index)
            node.rpdo[1].trans_type, node.rpdo[1].enabled = 255, True
            node.tpdo.save()
            node.rpdo.save()
            node.nmt.state = "OPERATIONAL"
            node.nmt.wait_for_heartbeat(timeout=5.0)
            assert node.nmt.state == "OPERATIONAL"

            for word in (0x06, 0x07, 0x0F):
                node.rpdo[1][0x6040].raw, node.rpdo[1][0x6071].raw, node.rpdo[1][0x6060].raw = word, 250, 10
                node.rpdo[1].transmit()
            deadline = time.monotonic() + 5.0
            while drive.want() is None and time.monotonic() < deadline:
                time.sleep(0.005)
            mode, torque = drive.want()
            assert mode is Mode.TORQUE and torque == pytest.approx(0.125)  # 250 per mille of 0.5 N m
            network.sync.transmit()
            assert node.tpdo[1].wait_for_reception(timeout=5.0) is not None
            assert node.tpdo[1][0x6041].raw & 0x6F == 0x27
            assert node.tpdo[1][0x6064].raw == round(12.5 / (2 * np.pi) * 4096)
            assert node.tpdo[1][0x6077].raw == 200
        finally:
            network.disconnect()


def run_procedure(procedure, ask, deadline=20.0):
    """Do a drive's procedure with `ask(frame, accept)`, which returns the answer or None."""
    end = time.monotonic() + deadline
    question = next(procedure)
    while time.monotonic() < end:
        answer = ask(question)
        try:
            question = procedure.send(answer)
        except StopIteration:
            return
    raise AssertionError("the procedure does not end")


def test_our_drive_configures_canopens_slave():
    """The other way round: `canopen`'s LocalNode answers our SDO client, and holds afterwards what we asked for."""
    network = canopen.Network()
    network.connect(interface="virtual", channel="slave_test")
    bus = can.Bus(interface="virtual", channel="slave_test")
    try:
        slave = network.create_node(1, object_dictionary())
        for (index, sub), value in {
            (0x1000, 0): 0x00020192, (0x1018, 1): 7, (0x1018, 2): 8, (0x1018, 3): 9, (0x6076, 0): 500, (0x6075, 0): 10000,
            (0x6502, 0): 1 << 9 | 1 << 2, (0x6041, 0): 0x0240, (0x603F, 0): 0,
        }.items():  # fmt: skip
            size, signed, _ = OBJECTS[index, sub]
            slave.set_data(index, sub, value.to_bytes(size, "little", signed=signed))
        slave.set_data(0x100A, 0, b"firmware of the slave, longer than one segment")
        [drive, *_] = make_drives(THESIS, made())

        def ask(question):
            if question.frame is not None:
                bus.send(to_message(question.frame))
            end = time.monotonic() + question.timeout * 10
            while time.monotonic() < end:
                message = bus.recv(0.01)
                if message is not None:
                    drive.receive(to_frame(message), time.monotonic()) if message.arbitration_id in drive.identifiers else None
                    if question.accept(to_frame(message)):
                        return to_frame(message)
                elif question.what == "NMT":
                    return None
            return None

        run_procedure(drive.configure(), ask)
        assert drive.firmware == "firmware of the slave, longer than one segment"
        assert drive.identity == "vendor 0x7, product 0x8"

        def held(index, sub):
            return int.from_bytes(slave.get_data(index, sub), "little")

        assert held(0x1400, 1) == 0x201 and held(0x1400, 2) == 255
        assert [held(0x1600, sub) for sub in range(4)] == [3, 0x60400010, 0x60710010, 0x60600008]
        assert held(0x1801, 1) == 0x281 and held(0x1801, 2) == 1
        assert [held(0x1A01, sub) for sub in range(4)] == [3, 0x606C0020, 0x60610008, 0x603F0010]
        assert held(0x1016, 1) == 127 << 16 | 40 and held(0x1017, 0) == 20
        assert held(0x6072, 0) == 1500  # 15 N m / 20 of 0.5 N m
    finally:
        bus.shutdown()
        network.disconnect()


def test_canopens_profile_reads_our_statuswords_and_codes():
    """`canopen`'s own table of the state machine names the same states."""
    from canopen.profiles.p402 import State402

    ours = {"SWITCH ON DISABLED", "READY TO SWITCH ON", "SWITCHED ON", "OPERATION ENABLED", "FAULT", "QUICK STOP ACTIVE",
            "FAULT REACTION ACTIVE", "NOT READY TO SWITCH ON"}  # fmt: skip
    for name, (mask, bits) in State402.SW_MASK.items():
        if name not in ours:
            continue
        for other in (0, 0xFFFF):
            word = (other & ~mask & ~0x6F) | bits
            assert status_name(word).upper() == name, hex(word)
    assert error_name(0x4310) == "over_temperature" and error_name(0x2399) == "over_current"
    assert error_name(0x0000) == "" and error_name(0xFF12) == "drive_fault"


@given(st.integers(0, 2**32 - 1), st.integers(-(2**20), 2**20))
def test_a_counter_that_wraps_is_followed(count, change):
    assert shorter_angle((count + change) % 2**32, count) == change


@settings(max_examples=50)
@given(st.integers(-(2**31), 2**31 - 1), st.integers(-32768, 32767), st.integers(-(2**31), 2**31 - 1))
def test_pdos_come_out_as_they_went_in(count, torque, velocity):
    drive = Cia402Drive(made().joints[0], 250.0, 0.02, 0.04, 4096, 127, 0.75, 100.0)
    [frame] = drive.output(Want(True, Mode.TORQUE, 0.1234), 1.0)
    assert frame.data[:4] == b"\x06\x00\x00\x00"  # the first step towards torque, with none
    drive.receive(Frame(0x181, struct.pack("<Hih", 0x0627, count, torque)), 1.0)
    drive.receive(Frame(0x281, struct.pack("<ibH", velocity, 10, 0)), 1.0)
    assert drive.feedback.position == pytest.approx(count / 4096 * 2 * np.pi)
    assert drive.feedback.torque == pytest.approx(torque * 0.0005)
    assert drive.feedback.velocity == pytest.approx(velocity / 4096 * 2 * np.pi)
    assert drive.feedback.state is DriveState.ENABLED
    [frame] = drive.output(Want(True, Mode.TORQUE, 0.1234), 1.0)
    assert drive.decode_command(frame).value == pytest.approx(0.123)  # towards zero, in steps of 0.5 mN m
    assert frame.data[:2] == b"\x0f\x00" and frame.data[4] == 10


# --- CANSimple ---------------------------------------------------------------------------------------------


finite = st.floats(-1e6, 1e6, width=32)


@settings(max_examples=50)
@given(finite, finite, st.integers(0, 63))
def test_layouts_are_those_of_cantools(first, second, node):
    for name in ("Get_Encoder_Estimates", "Get_Iq", "Get_Temperature", "Set_Input_Vel", "Set_Limits", "Get_Torques"):
        ours = layout(name).frame(node, first, second)
        message = database().get_message_by_name(name)
        decoded = database().decode_message(ours.id & 0x1F, ours.data, decode_choices=False)
        assert list(decoded.values()) == [first, second] and list(decoded) == layout(name).names
        assert message.encode(decoded) == ours.data
        assert ours.id >> 5 == node


def test_identifiers_and_widths_are_those_of_the_protocol():
    """Numbers of the public description of CANSimple, firmware 0.6."""
    published = {
        "Get_Version": (0x00, 8), "Heartbeat": (0x01, 8), "Estop": (0x02, 0), "Get_Error": (0x03, 8),
        "Set_Axis_State": (0x07, 4), "Get_Encoder_Estimates": (0x09, 8), "Set_Controller_Mode": (0x0B, 8),
        "Set_Input_Vel": (0x0D, 8), "Set_Input_Torque": (0x0E, 4), "Set_Limits": (0x0F, 8), "Get_Iq": (0x14, 8),
        "Get_Temperature": (0x15, 8), "Get_Bus_Voltage_Current": (0x17, 8), "Clear_Errors": (0x18, 1),
        "Get_Torques": (0x1C, 8),
    }  # fmt: skip
    assert {m.name: (m.frame_id, m.length) for m in database().messages} == published


def test_signals_stand_where_the_protocol_has_them():
    """First byte, type and unit of each signal, from ODrive's documentation of CANSimple and two published databases."""
    published = {
        "Heartbeat": {"Axis_Error": (0, "I", ""), "Axis_State": (4, "B", ""), "Procedure_Result": (5, "B", ""),
                      "Trajectory_Done_Flag": (6, "B", "")},
        "Get_Error": {"Active_Errors": (0, "I", ""), "Disarm_Reason": (4, "I", "")},
        "Set_Axis_State": {"Axis_Requested_State": (0, "I", "")},
        "Get_Encoder_Estimates": {"Pos_Estimate": (0, "f", "rev"), "Vel_Estimate": (4, "f", "rev/s")},
        "Set_Controller_Mode": {"Control_Mode": (0, "I", ""), "Input_Mode": (4, "I", "")},
        "Set_Input_Vel": {"Input_Vel": (0, "f", "rev/s"), "Input_Torque_FF": (4, "f", "Nm")},
        "Set_Input_Torque": {"Input_Torque": (0, "f", "Nm")},
        "Set_Limits": {"Velocity_Limit": (0, "f", "rev/s"), "Current_Limit": (4, "f", "A")},
        "Get_Iq": {"Iq_Setpoint": (0, "f", "A"), "Iq_Measured": (4, "f", "A")},
        "Get_Temperature": {"FET_Temperature": (0, "f", "degC"), "Motor_Temperature": (4, "f", "degC")},
        "Get_Bus_Voltage_Current": {"Bus_Voltage": (0, "f", "V"), "Bus_Current": (4, "f", "A")},
        "Get_Torques": {"Torque_Target": (0, "f", "Nm"), "Torque_Estimate": (4, "f", "Nm")},
    }  # fmt: skip
    letter = {(True, 32): "f", (False, 32): "I", (False, 8): "B"}
    for name, signals in published.items():
        found = database().get_message_by_name(name).signals
        ours = {s.name: (s.start // 8, letter[s.is_float, s.length], s.unit or "") for s in found}
        assert ours == signals, name
        assert all(s.byte_order == "little_endian" and s.scale == 1 and s.offset == 0 for s in found)
    # Whole frames, byte by byte: -2.5 turns a second with 0.25 N m, and an axis in closed loop whose watchdog has expired.
    assert layout("Set_Input_Vel").frame(1, -2.5, 0.25) == Frame(0x02D, bytes.fromhex("000020c00000803e"))
    assert layout("Heartbeat").unpack(bytes.fromhex("0000000108000000")) == (0x01000000, 8, 0, 0)
    assert error_names(0x01000000 | 0x4000) == ("over_temperature", "drive_watchdog")


def test_an_odrive_goes_through_its_states():
    joint = made("odrive").joints[0]
    emulated, drive = EmulatedODrive(joint, 250.0, 0.02, 0.04), ODriveDrive(joint, 250.0, 0.02, 0.04, 100.0)
    now = 0.0

    def exchange(want, seconds=0.05):
        nonlocal now
        for _ in range(round(seconds / 0.004)):
            now += 0.004
            for frame in drive.output(want, now):
                for answer in emulated.receive(frame, now):
                    drive.receive(answer, now)
            for frame in emulated.tick(now):
                drive.receive(frame, now)

    exchange(Want(False))
    assert drive.feedback.state is DriveState.DISABLED and emulated.want() is None
    exchange(Want(True, Mode.TORQUE, 0.2))
    assert drive.feedback.state is DriveState.ENABLED and emulated.want() == (Mode.TORQUE, pytest.approx(0.2))
    exchange(Want(True, Mode.VELOCITY, 5.0))
    assert emulated.want() == (Mode.VELOCITY, pytest.approx(5.0))
    now += 0.05  # nobody feeds the watchdog
    for frame in emulated.tick(now):
        drive.receive(frame, now)
    assert emulated.want() is None
    exchange(Want(True, Mode.TORQUE, 0.2))
    assert drive.feedback.error_names == ("drive_watchdog",) and emulated.want() is None
    assert drive.feedback.state is DriveState.FAULT


@pytest.mark.parametrize("protocol", ["cia402", "odrive"])
@settings(max_examples=60)
@given(st.data())
def test_no_frame_crashes_a_drive_or_makes_its_numbers_nan(protocol, data):
    drive = make_drives(THESIS, made(protocol))[0]
    emulated = (
        EmulatedCia402(drive.joint, 250.0, 0.02, 0.04, 4096)
        if protocol == "cia402"
        else EmulatedODrive(drive.joint, 250.0, 0.02, 0.04)
    )
    for _ in range(data.draw(st.integers(1, 8))):
        identifier = data.draw(st.sampled_from([*drive.identifiers, *drive.command_identifiers, 0x000, 0x080, 0x601, 0x77F]))
        frame = Frame(identifier, data.draw(st.binary(max_size=8)), data.draw(st.booleans()))
        emulated.receive(frame, 0.0)
        if identifier in drive.identifiers:
            drive.receive(frame, 0.0)
            assert not np.isinf(drive.feedback.position) and not np.isinf(drive.feedback.velocity)
        for sent in drive.output(Want(False), 0.0):
            want = drive.decode_command(sent)
            assert want is None or want.value == 0.0
    assert all(abs(value) < 2**32 for value in getattr(emulated, "objects", {}).values())


def test_wrong_drives_are_refused_in_words():
    driven = Rig(THESIS, made())
    wrong = starting_content(THESIS)
    wrong["joint_defaults"]["rated_torque"] = 0.6
    with pytest.raises(CanError, match=r"rated_torque = 0\.6 N m is not allowed; allowed: 0\.5"):
        CanRobot(THESIS, can_file_from(wrong, THESIS), driven.transport).configure()
    driven.emulated.drives[2].objects[0x1000, 0] = 401
    driven.emulated.drives[5].dead = True
    with pytest.raises(CanError) as refused:
        driven.can.configure()
    assert "front_right_drive: device type 0x1000 = 401" in str(refused.value)
    assert "rear_left_steer: 0x1000:0 has no answer" in str(refused.value)
    assert len(str(refused.value).splitlines()) == 2
