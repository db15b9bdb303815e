"""The CAN driver as a lifecycle node against the emulator in another process, over real frames and real DDS.

Timeouts are long: these tests share a computer with others. How fast faults are met is tested in simulated time.
"""

import json
import signal
from types import SimpleNamespace

import numpy as np
import pytest
import yaml

pytest.importorskip("rclpy")
pytest.importorskip("can")
pytest.importorskip("msgpack", reason="udp_multicast of python-can needs it")

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus  # noqa: E402
from lifecycle_msgs.msg import State, Transition  # noqa: E402
from lifecycle_msgs.srv import ChangeState, GetState  # noqa: E402
from sensor_msgs.msg import JointState  # noqa: E402
from std_srvs.srv import Trigger  # noqa: E402

from pcw_description import load_robot  # noqa: E402
from pcw_description.nodes.node_testing import RosTest  # noqa: E402
from pcw_description.nodes.node_tools import ns_to_stamp  # noqa: E402
from pcw_sim_bridge.can.can_file import Bus, on_udp, read_can_file, udp_port_beside  # noqa: E402
from pcw_sim_bridge.can.frame import Frame  # noqa: E402
from pcw_sim_bridge.can.python_can import Echoes, PythonCanTransport, read_log  # noqa: E402
from pcw_sim_bridge.can.starting_file import starting_content  # noqa: E402
from pcw_sim_bridge.can.supervisor import Fault  # noqa: E402
from pcw_sim_bridge.can.trial_rig import Rig  # noqa: E402
from pcw_sim_bridge.nodes.can_driver import CanDriverNode  # noqa: E402

DRIVER, EMULATOR = "pcw_sim_bridge.nodes.can_driver", "pcw_sim_bridge.can.drive_emulator"
THESIS = load_robot("thesis")
NAMES = list(THESIS.joint_names)


class Stack:
    """Emulator and driver with each other, and a commander that answers joint_states."""

    def __init__(self, ros, folder, protocol, log=False, start=True):
        self.ros, self.port = ros, udp_port_beside(ros.domain)
        self.file, self.stats = folder / "drives.yaml", folder / "stats.json"
        self.log = ("-p", f"log:={folder / 'frames.blf'}") if log else ()
        self.stamp_ns = None
        timeouts = {"command": 1.0, "feedback": 1.0, "watchdog": 1.0}
        content = starting_content(THESIS, protocol, rate=50.0, timeouts=timeouts)
        self.file.write_text(yaml.safe_dump(content))
        self.effort, self.states = None, []
        self.diagnostics = ros.listen(DiagnosticArray, "/diagnostics")
        self._publisher = ros.peer.create_publisher(JointState, "joint_commands", 10)
        ros.peer.create_subscription(JointState, "joint_states", self._answer, 1000)
        if start:
            self.start_emulator()
            self.start_driver()

    def start_emulator(self):
        self.emulator = self.ros.start(
            EMULATOR, before=["--can-file", str(self.file), "--udp-port", str(self.port), "--watchdog", "1.0",
                              "--stats", str(self.stats)]
        )  # fmt: skip
        self.ros.wait_for(lambda: "8 drives" in self.emulator.log)

    def start_driver(self, *further, name="can_driver"):
        """Another name for another process: the services of a killed one seem to be there for a while."""
        self.name = name
        parameters = ("-p", f"can_file:={self.file}", "-p", f"udp_port:={self.port}", *self.log, *further)
        self.driver = self.ros.start(DRIVER, "-r", f"__node:={name}", *parameters)

    def _answer(self, state):
        self.states.append(state)
        if self.effort is not None:
            message = JointState(name=NAMES, effort=self.effort)
            message.header.stamp = state.header.stamp if self.stamp_ns is None else ns_to_stamp(self.stamp_ns)
            self._publisher.publish(message)

    def change(self, transition):
        request = ChangeState.Request(transition=Transition(id=transition))
        return self.ros.call(ChangeState, f"{self.name}/change_state", request).success

    def state(self):
        return self.ros.call(GetState, f"{self.name}/get_state").current_state.id

    def drive(self):
        """Configure, activate and move."""
        self.effort = None
        assert self.change(Transition.TRANSITION_CONFIGURE) and self.change(Transition.TRANSITION_ACTIVATE)
        self.effort = [1.0, 0.0] * 4
        self.states.clear()
        self.ros.wait_for(lambda: self.states and self.torques().min() > 0.5)

    def stamp_of(self, state):
        return state.header.stamp.sec * 10**9 + state.header.stamp.nanosec

    def torques(self):
        return np.array(self.states[-1].effort[0::2])

    def said(self, text):
        return any(text in status.message for array in self.diagnostics for status in array.status)


@pytest.fixture
def ros():
    with RosTest() as ros:
        yield ros


def test_activate_drives_and_deactivate_stops_with_odrives(ros, tmp_path):
    stack = Stack(ros, tmp_path, "odrive")
    assert not stack.change(Transition.TRANSITION_ACTIVATE)  # not before configure
    stack.drive()
    assert stack.states[-1].name == NAMES and stack.state() == State.PRIMARY_STATE_ACTIVE
    ros.wait_for(lambda: stack.states[-1].velocity[0] > 0.1)
    ros.wait_for(lambda: stack.said("armed"))
    stack.effort = [np.nan] * 8
    ros.wait_for(lambda: np.abs(stack.torques()).max() < 0.2)
    ros.wait_for(lambda: stack.said("NaN or infinity"))
    stack.effort = [1.0, 0.0] * 4
    ros.wait_for(lambda: stack.torques().min() > 0.5)
    assert stack.change(Transition.TRANSITION_DEACTIVATE)
    ros.wait_for(lambda: np.abs(stack.torques()).max() < 0.2)  # joint_states go on, commands are not heard
    assert stack.driver.interrupt() == 0 and "frames sent" in stack.driver.log


def test_a_fault_stops_the_robot_by_name_and_only_the_user_starts_it_again(ros, tmp_path):
    stack = Stack(ros, tmp_path, "cia402")
    stack.drive()
    intruder = PythonCanTransport(on_udp(read_can_file(stack.file, THESIS), stack.port).buses)
    try:
        intruder.send("can0", Frame(0x181, b"\x01"))  # as from a drive whose PDOs somebody has mapped anew
    finally:
        intruder.close()
    ros.wait_for(lambda: stack.said("enabled; malformed frames since the last report: 1"))
    assert stack.state() == State.PRIMARY_STATE_ACTIVE
    stack.effort = None  # the controller falls silent
    ros.wait_for(lambda: stack.said("command_timeout at joint_commands"))
    ros.wait_for(lambda: stack.state() == State.PRIMARY_STATE_INACTIVE)
    stack.effort = [1.0, 0.0] * 4
    ros.spin_for(0.5)
    assert np.abs(stack.torques()).max() < 0.2
    assert not stack.change(Transition.TRANSITION_ACTIVATE)
    assert ros.call(Trigger, "can_driver/clear_faults").success
    ros.spin_for(0.3)
    assert np.abs(stack.torques()).max() < 0.2
    assert stack.change(Transition.TRANSITION_ACTIVATE)
    ros.wait_for(lambda: stack.torques().min() > 0.5)


def test_a_killed_driver_and_a_killed_emulator_leave_the_others_safe_and_start_again(ros, tmp_path):
    stack = Stack(ros, tmp_path, "cia402")
    stack.drive()
    stack.driver.process.kill()
    stack.driver.wait()
    stack.start_driver(name="can_driver_again")  # the drives have stopped by their watchdogs; nobody unplugs them
    stack.drive()

    stack.diagnostics.clear()
    stack.emulator.process.kill()
    stack.emulator.wait()
    ros.wait_for(lambda: stack.said("missing_node at front_left_drive"))
    ros.wait_for(lambda: stack.state() == State.PRIMARY_STATE_INACTIVE)
    assert not ros.call(Trigger, f"{stack.name}/clear_faults").success
    stack.start_emulator()
    assert ros.call(Trigger, f"{stack.name}/clear_faults").success
    stack.states.clear()
    assert stack.change(Transition.TRANSITION_ACTIVATE)
    ros.wait_for(lambda: stack.states and stack.torques().min() > 0.5)


@pytest.mark.nightly
def test_without_drives_it_is_not_configured_and_says_which_are_missing(ros, tmp_path):
    stack = Stack(ros, tmp_path, "cia402")
    stack.emulator.interrupt()
    assert not stack.change(Transition.TRANSITION_CONFIGURE)
    assert stack.state() == State.PRIMARY_STATE_UNCONFIGURED
    assert "rear_right_steer: 0x1000:0 has no answer" in stack.driver.log


def stop(stack, number):
    """Send a signal and return how long the drives had torque after their last command [ms], once they have none."""
    assert stack.driver.interrupt(number) == 0 and "Traceback" not in stack.driver.log, stack.driver.log
    stack.emulator.interrupt()
    return json.loads(stack.stats.read_text())


STATES = [("active", "SIGTERM")] + [
    pytest.param(*which, marks=pytest.mark.nightly)
    for which in (("unconfigured", "SIGTERM"), ("inactive", "SIGTERM"), ("active", "SIGINT"), ("fault", "SIGTERM"),
                  ("finalized", "SIGINT"))
]  # fmt: skip


@pytest.mark.parametrize(("state", "number"), STATES)
def test_a_signal_ends_it_in_every_state_and_takes_the_torque_at_once(ros, tmp_path, state, number):
    """The watchdogs are a second away: it is the driver that lets go, and the log of frames is whole."""
    stack = Stack(ros, tmp_path, "odrive", log=True)
    if state == "inactive":
        assert stack.change(Transition.TRANSITION_CONFIGURE)
    elif state != "unconfigured":
        stack.drive()
    else:  # a signal while Python still starts is another matter
        ros.wait_for(lambda: stack.state() == State.PRIMARY_STATE_UNCONFIGURED)
    if state == "fault":
        stack.effort = None
        ros.wait_for(lambda: stack.state() == State.PRIMARY_STATE_INACTIVE)
    elif state == "finalized":
        assert stack.change(Transition.TRANSITION_ACTIVE_SHUTDOWN)
    measured = stop(stack, getattr(signal, number))
    assert not any(measured["torque"]) and "drive_watchdog" not in measured["failures"].values()
    if state == "active":
        assert measured["stopped_after_ms"][-1] < 500.0  # by its last words, not by the watchdogs
    if state != "unconfigured":
        assert len(list(read_log(tmp_path / "frames.blf"))) > 50


@pytest.mark.nightly
def test_cleanup_and_configure_again_work_with_a_log(ros, tmp_path):
    """The first log was in the way of the second once."""
    stack = Stack(ros, tmp_path, "cia402", log=True)
    for _ in range(2):
        stack.drive()
        assert stack.change(Transition.TRANSITION_DEACTIVATE) and stack.change(Transition.TRANSITION_CLEANUP)
    stack.effort = None
    assert [len(list(read_log(tmp_path / name))) > 50 for name in ("frames.blf", "frames_2.blf")] == [True, True]


def test_autostart_waits_for_drives_that_are_switched_on_later(ros, tmp_path):
    """As a launch file starts them: driver and drives at the same time."""
    stack = Stack(ros, tmp_path, "cia402", start=False)
    stack.start_driver("-p", "autostart:=true")
    ros.wait_for(lambda: "has no answer" in stack.driver.log)
    ros.wait_for(lambda: stack.said("not configured: front_left_drive: 0x1000:0 has no answer"))  # not in the log alone
    stack.start_emulator()
    stack.effort = [1.0, 0.0] * 4
    ros.wait_for(lambda: stack.states and stack.torques().min() > 0.5)
    # Of stamps by a clock that is ahead nobody can tell how old they are; that was silent.
    stack.stamp_ns = stack.stamp_of(stack.states[-1]) + 100 * 10**9
    ros.wait_for(lambda: stack.said("ahead of this computer's clock"))
    # Commands that answer readings of long ago are refused, though they go on coming.
    stack.stamp_ns = stack.stamp_of(stack.states[0])
    ros.wait_for(lambda: stack.said("command_timeout at joint_commands"))
    ros.wait_for(lambda: np.abs(stack.torques()).max() < 0.2)


@pytest.mark.parametrize(
    ("parameters", "complaint"),
    [
        (("can_file:=/no/such.yaml",), "no/such.yaml"),
        (("udp_port:=-1",), "udp_port"),
        (("log:=frames.txt",), "'.txt' is not allowed"),
    ],
)
def test_bad_input_ends_it_with_one_line(ros, parameters, complaint):
    driver = ros.start(DRIVER, *(argument for parameter in parameters for argument in ("-p", parameter)))
    assert driver.wait() == 2
    assert complaint in driver.log and "Traceback" not in driver.log


def test_an_interface_that_python_can_does_not_have_ends_it_before_configure(ros, tmp_path):
    content = starting_content(THESIS)
    content["buses"][0]["interface"] = "socketcn"
    path = tmp_path / "drives.yaml"
    path.write_text(yaml.safe_dump(content))
    driver = ros.start(DRIVER, "-p", f"can_file:={path}")
    assert driver.wait() == 2
    assert "interface 'socketcn' of bus can0 is not allowed" in driver.log and "Traceback" not in driver.log


def test_a_bus_that_is_too_full_ends_it_with_the_arithmetic(ros, tmp_path):
    path = tmp_path / "fast.yaml"
    path.write_text(yaml.safe_dump(starting_content(THESIS, "cia402", rate=500.0)))
    driver = ros.start(DRIVER, "-p", f"can_file:={path}")
    assert driver.wait() == 2
    assert "8 x   500.0 Hz x 125 bit" in driver.log and "Traceback" not in driver.log


def test_a_bus_that_is_off_says_so_in_its_own_status():
    """It had been well, with its load, beside drives that were missing."""
    driven = Rig(THESIS, read_can_file("thesis_cia402", THESIS))
    driven.can.configure()
    driven.can.stop([Fault("bus_off", "can0", "the interface has left the bus")])
    node = SimpleNamespace(_can=driven.can, _refused={})
    bus = CanDriverNode._parts(node)["bus can0"]
    assert bus.level == DiagnosticStatus.ERROR and "bus_off at can0" in bus.message and "%" in bus.message
    driven.can.clear_faults()
    assert CanDriverNode._parts(node)["bus can0"].level == DiagnosticStatus.OK


# --- python-can --------------------------------------------------------------------------------------------


def test_frames_over_python_can_arrive_once_and_as_they_were():
    """On `virtual`, and on udp_multicast, which also gives every frame back to who sent it."""
    for interface, channel, options in (
        ("virtual", "arrive_once", {}), ("udp_multicast", "239.74.163.2", {"port": 7639, "hop_limit": 0}),
    ):  # fmt: skip
        bus = Bus("can0", interface, channel, options=options)
        one, other = PythonCanTransport([bus]), PythonCanTransport([bus])
        try:
            sent = [Frame(i, bytes(range(i % 9))) for i in range(1, 60)] + [Frame(0x20, b"", remote=True)]
            for frame in sent:
                one.send("can0", frame)
            got = []
            while len(got) < len(sent) and (arrived := other.receive(5.0)):
                got += [(frame.id, frame.data, frame.remote) for _, frame, _ in arrived]
            assert got == [(frame.id, frame.data, frame.remote) for frame in sent]
            assert one.receive(0.05) == []  # nothing of its own
        finally:
            one.close()
            other.close()


def test_an_echo_is_told_from_the_same_frame_of_another():
    echoes, frame = Echoes(), Frame(1, b"x")
    echoes.sent(frame, 0.0)
    assert echoes.is_own(frame, 0.1) and not echoes.is_own(frame, 0.2)
    echoes.sent(frame, 1.0)
    echoes.sent(Frame(2), 10.0)  # the echo of the first was lost
    assert not echoes.is_own(frame, 10.0)
