"""The CAN file: what it refuses, and the load of buses."""

import dataclasses

import can
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pcw_description import DescriptionError, load_robot, shipped_robots
from pcw_sim_bridge.can.bus_load import BusLoad, check_loads, frame_bits
from pcw_sim_bridge.can.can_file import can_file_from, on_udp, read_can_file, shipped_can_files
from pcw_sim_bridge.can.can_robot import CanRobot
from pcw_sim_bridge.can.drive_set import bus_loads, make_drives
from pcw_sim_bridge.can.emulated_robot import EmulatedRobot, EmulatedTransport
from pcw_sim_bridge.can.errors import CanError
from pcw_sim_bridge.can.frame import PeriodicFrame
from pcw_sim_bridge.can.motor_map import MotorMap
from pcw_sim_bridge.can.output_gate import OutputGate
from pcw_sim_bridge.can.starting_file import starting_content, with_joints
from pcw_sim_bridge.can.trial_rig import Rig
from pcw_sim_bridge.plants.factory import make_plant

THESIS = load_robot("thesis")


def content(protocol="cia402", robot=THESIS, **changes):
    defaults = {"bus": "can0", "protocol": protocol, "torque_constant": 0.05, "current_limit": 16.0}
    if protocol == "cia402":
        defaults["rated_torque"] = 0.5
    return starting_content(robot, protocol, **{"joint_defaults": defaults, **changes})


def made(protocol="cia402", **changes):
    return can_file_from(content(protocol, **changes), THESIS)


STEER = ["front_left_steer"]
TWO_BUSES = [
    {"name": name, "interface": "socketcan", "channel": name, "bitrate": 1_000_000} for name in ("can0", "can1")
]
REFUSED = [
    (lambda c: {**c, "joints": c["joints"][:7]}, "joints", "missing: rear_right_steer"),
    (lambda c: {**c, "rate": 5}, "rate", "at least 10"),
    (lambda c: {**c, "master_id": 50.5}, "master_id", "a whole number 1 to 127"),
    (lambda c: {**c, "raet": 250}, "raet", "did you mean 'rate'"),
    (lambda c: {**c, "buses": []}, "buses", "at least one"),
    (lambda c: {**c, "master_id": 1.5}, "master_id", "a whole number 1 to 127"),
    (lambda c: {**c, "robot": "tidybot2"}, "robot", "the robot given is thesis"),
    (lambda c: {**c, "timeouts": {"command": 5.0}}, "timeouts.command", "at most 1"),
    (lambda c: {**c, "rate": 25}, "timeouts.command", "allowed at 25 Hz: at least 0.06 s"),
    (lambda c: {**c, "timeouts": {"watchdog": 0.005}}, "timeouts.watchdog", "at least 0.006 s"),
    (lambda c: {**with_joints(c, THESIS.joint_names, protocol="odrive"), "heartbeat": 0.1}, "heartbeat", "at most timeouts"),
    (lambda c: with_joints(c, STEER, node_id=1), "joints[1].node_id", "that of front_left_drive already"),
    (lambda c: with_joints(c, STEER, node_id=1.5), "joints[1].node_id", "a whole number 1 to 127"),
    (lambda c: with_joints(c, STEER, node_id=127), "joints[1].node_id", "master_id"),
    (lambda c: with_joints(c, STEER, protocol="odrive", node_id=64), "joints[1].node_id", "0 to 63"),
    (lambda c: with_joints(c, STEER, protocol="odrive", node_id=12), "node_id", "that of"),
    (lambda c: with_joints(c, STEER, protocol="odrive", node_id=4), "node_id", "SYNC"),
    (lambda c: with_joints(c, STEER, protocol="canopn"), "joints[1].protocol", "cia402"),
    (lambda c: with_joints(c, STEER, bus="can1"), "joints[1].bus", "can0"),
    (lambda c: with_joints(c, STEER, sign=0.5), "joints[1].sign", "1 or -1"),
    (lambda c: with_joints(c, STEER, gear=12.0), "joints[1].gear", "allowed: 20"),
    (lambda c: with_joints(c, STEER, torque_limit=11.0), "joints[1].torque_limit", "at most 10"),
    (lambda c: with_joints(c, STEER, torque_constant=0.0), "joints[1].torque_constant", "above 0"),
    (lambda c: with_joints(c, STEER, rated_torque=None), "rated_torque", "0x6076"),
    (lambda c: with_joints(c, STEER, name="nose_steer"), "joints[1].name", "front_left_steer"),
    (lambda c: with_joints(c, STEER, name="front_left_drive"), "joints[1].name", "each joint once"),
    (lambda c: with_joints(c, ["front_left_drive"], homing={"method": "index"}), "homing", "steering axes alone"),
    (lambda c: with_joints(c, STEER, homing={"method": "indx"}), "homing.method", "did you mean 'index'"),
]


@pytest.mark.parametrize(("change", "key", "allowed"), REFUSED)
def test_a_wrong_entry_is_named_with_its_value_and_what_is_allowed(change, key, allowed):
    can_file_from(content(), THESIS)
    with pytest.raises(DescriptionError) as refused:
        can_file_from(change(content()), THESIS)
    assert key in refused.value.key and allowed in str(refused.value)


def test_shipped_files_are_read_and_put_their_joints_in_the_order_of_the_robot():
    assert set(shipped_can_files()) >= {"thesis_cia402", "thesis_odrive"}
    for name in shipped_can_files():
        assert tuple(joint.name for joint in read_can_file(name, THESIS).joints) == THESIS.joint_names
    reversed_file = content()
    reversed_file["joints"].reverse()
    assert can_file_from(reversed_file, THESIS) == made()
    # Its joints have the same names: with gears and limits of another robot nothing was said.
    with pytest.raises(DescriptionError, match="robot: 'thesis' is not allowed; the robot given is tidybot2"):
        read_can_file("thesis_cia402", load_robot("tidybot2"))
    with pytest.raises(DescriptionError, match="did you mean 'thesis_odrive'"):
        read_can_file("thesis_odriv", THESIS)


def test_bits_of_a_frame():
    """Davis et al. 2007: 55 + 10 s bits at their worst with an identifier of 11 bits."""
    assert [frame_bits(size) for size in range(9)] == [55 + 10 * size for size in range(9)]
    with pytest.raises(CanError, match="0 to 8"):
        frame_bits(9)


@pytest.mark.parametrize("protocol", ["cia402", "odrive"])
def test_a_bus_that_is_too_full_is_refused_with_the_arithmetic(protocol):
    transport = EmulatedTransport(EmulatedRobot(make_plant("reduced", THESIS), made(protocol)))
    CanRobot(THESIS, made(protocol), transport)
    with pytest.raises(CanError) as refused:
        CanRobot(THESIS, made(protocol, rate=500.0), transport)
    assert "8 x   500.0 Hz" in str(refused.value) and "allowed 90%" in str(refused.value)
    two = content(protocol, rate=500.0)
    two["buses"].append({"name": "can1", "interface": "virtual", "channel": "other"})
    two = with_joints(two, THESIS.joint_names[4:], bus="can1")
    file = can_file_from(two, THESIS)
    loads = bus_loads(file, make_drives(THESIS, file))
    check_loads(loads)
    assert 0.5 < loads["can0"].load == loads["can1"].load < 0.9


def test_the_computed_load_is_what_is_sent():
    """Counted on the emulated bus over two seconds with torque on: no frame that the sum does not know, and not one less."""
    for protocol in ("cia402", "odrive"):
        driven = Rig(THESIS, made(protocol))
        driven.can.configure()
        driven.torque[:, 0] = 0.5
        driven.can.enable()
        driven.cycles(20)
        frames, begun = driven.transport.log(), driven.transport.now()
        driven.cycles(500)
        seconds = driven.transport.now() - begun
        bits = sum(frame_bits(len(frame.data)) for _, frame, _, _ in frames) / seconds
        # Velocities, which the sum takes for the worst, are longer than the torques that were sent here, by 3 and 4 bytes.
        less = 8 * 250.0 * (30 if protocol == "cia402" else 40)
        [load] = driven.can.loads.values()
        slack = less - (8 * 250.0 * 10 if protocol == "cia402" else 0)  # 5 bytes of 7, not 4
        assert bits == pytest.approx(load.bits - slack, rel=0.01)


@given(st.lists(st.tuples(st.integers(0, 8), st.floats(0.1, 2000.0)), min_size=1, max_size=20))
def test_a_load_is_refused_exactly_where_it_is_above_what_is_allowed(frames):
    load = BusLoad("bus", 1e6, tuple(PeriodicFrame("x", size, rate) for size, rate in frames), 0.9)
    assert load.load == pytest.approx(sum((55 + 10 * size) * rate for size, rate in frames) / 1e6)
    if load.load > 0.9:
        with pytest.raises(CanError):
            check_loads([load])
    else:
        check_loads([load])


@pytest.mark.parametrize("name", [name for name in shipped_robots() if name != "mpo700"])
def test_the_motor_map_is_power_preserving_and_its_own_inverse(name):
    robot = load_robot(name)
    rng = np.random.default_rng(1)
    signs = dict(zip(robot.joint_names, rng.choice([-1.0, 1.0], 2 * robot.n), strict=True))
    file = content("odrive", robot)
    for joint in file["joints"]:
        joint.update(sign=float(signs[joint["name"]]), zero=float(rng.normal()))
    motor_map = MotorMap(robot, can_file_from(file, robot))
    q, rate, torque = rng.normal(size=(3, robot.n, 2))
    np.testing.assert_allclose(motor_map.joint_position(motor_map.motor_position(q)), q, atol=1e-12)
    np.testing.assert_allclose(motor_map.joint_velocity(motor_map.motor_velocity(rate)), rate, atol=1e-12)
    np.testing.assert_allclose(motor_map.joint_torque(motor_map.motor_torque(torque)), torque, atol=1e-12)
    power = np.sum(motor_map.motor_torque(torque) * motor_map.motor_velocity(rate))
    assert power == pytest.approx(np.sum(torque * rate))


@given(
    st.lists(st.floats(allow_nan=True, allow_infinity=True, width=64), min_size=8, max_size=8), st.booleans(), st.booleans()
)
def test_the_gate_lets_nothing_out_beyond_the_limits(values, armed, velocity):
    file = dataclasses.replace(made())
    gate = OutputGate(THESIS, file, MotorMap(THESIS, file))
    wanted = np.array(values).reshape(4, 2)
    out = (gate.velocity if velocity else gate.torque)(wanted, armed)
    assert np.isfinite(out.motor).all()
    if not armed or not np.isfinite(wanted).all():
        assert not out.motor.any()
        assert out.fault == (armed and not np.isfinite(wanted).all())
    elif velocity:
        assert (np.abs(out.motor) <= THESIS.speed_limit * 20.0 * (1 + 1e-12)).all()
    else:
        assert (np.abs(out.motor) <= np.minimum(THESIS.torque_limit / 20.0, 0.8) * (1 + 1e-12)).all()


def test_a_bus_by_multicast_hears_nothing_of_the_next():
    """Linux hands a socket what comes for any group at its port; each bus has a port of its own."""
    here, other = (
        can.Bus(interface=bus.interface, channel=bus.channel, **bus.options)
        for bus in on_udp(made(buses=TWO_BUSES), 7670).buses
    )
    with here, other:
        here.send(can.Message(arbitration_id=0x123, data=b"here", is_extended_id=False))
        heard = here.recv(2.0)
        assert heard is not None and heard.arbitration_id == 0x123
        assert other.recv(0.3) is None


def test_a_port_that_leaves_none_for_the_last_bus_is_refused():
    file = made(buses=TWO_BUSES)
    with pytest.raises(CanError, match="udp port 65530 is not allowed; allowed: at most 65525"):
        on_udp(file, 65530)
