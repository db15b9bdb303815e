"""The robot's drives on CAN, on the topics of the simulated robot: a lifecycle node."""

from __future__ import annotations

import sys
import threading
import time
import traceback
from collections import OrderedDict
from collections.abc import Mapping, Sequence
from pathlib import Path

from rclpy.clock import Clock, ClockType
from rclpy.lifecycle import State, TransitionCallbackReturn
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger

from pcw_description import PcwError, load_robot
from pcw_description.nodes.diagnostics import ERROR, OK, WARN, Diagnostics, Problems, Status
from pcw_description.nodes.lifecycle import RobustLifecycleNode
from pcw_description.nodes.node_tools import (
    COMMAND,
    SENSOR_STREAM_SOURCE,
    all_declared,
    declare,
    fill_joint_state,
    ns_to_stamp,
    run_node,
    stamp_to_ns,
)
from pcw_description.short_collections import short_collections

from ..can.can_file import on_udp, read_can_file
from ..can.can_robot import ENABLE_TIME, CanRobot, TimedReading
from ..can.python_can import PythonCanTransport, check_interface, check_log_suffix, free_log_name
from ..can.supervisor import Fault
from ..stamping import stamp_after
from .joint_command_messages import read_joint_command

READINGS_REMEMBERED = 32  # whose commands may still come
# A callback that computes keeps the thread of the bus waiting for at most so long; Python's own 5 ms exceed a period [s].
SWITCH_INTERVAL = 5e-4
AUTOSTART_WITHIN = 20.0  # that drives are waited for [s]
SETTLING = 0.2  # in which drives say that they are off [s]
SUCCESS, FAILURE = TransitionCallbackReturn.SUCCESS, TransitionCallbackReturn.FAILURE


class CanDriverNode(RobustLifecycleNode):
    """Torques from joint_commands to the drives, joint_states from them.

    configure: open the buses, check and set up every drive, without torque; joint_states begin.
    activate: torque on; zero until the first command.
    deactivate: zero torque, then none.
    A fault takes the torque, deactivates the node and stays: activate is refused until ~/clear_faults, or cleanup and
    configure. Nothing turns the torque on but activate.

    A thread does the periods of the bus (`CanRobot.cycle`); a command goes out in the callback that brings it.
    """

    def __init__(self) -> None:
        super().__init__("can_driver")
        robot = load_robot(declare(self, "robot", "thesis", "robot file, or the name of a shipped robot", read_only=True))
        name = declare(self, "can_file", "thesis_cia402", "file of the drives, or the name of a shipped one", read_only=True)
        port = declare(
            self, "udp_port", 0, "buses as UDP multicast at this port, for drive_emulator; 0: as the file says",
            range=(0, 65535), read_only=True,
        )  # fmt: skip
        autostart = declare(self, "autostart", False, "configure and activate once the drives answer", read_only=True)
        self._log_path = declare(
            self, "log", "", "write all frames to this .log, .asc or .blf; a number is added where it exists", read_only=True
        )
        all_declared(self)
        if self._log_path:
            check_log_suffix(Path(self._log_path))
        self.robot, self._file = robot, read_can_file(name, robot)
        if port:
            self._file = on_udp(self._file, port)
        for bus in self._file.buses:
            check_interface(bus)
        self._joint_index = {name: i for i, name in enumerate(robot.joint_names)}
        self._message = JointState(name=list(robot.joint_names))
        self._can: CanRobot | None = None
        self._thread: threading.Thread | None = None
        self._running = self._active = self._topics = False
        self._told: list[str] = []
        self._not_configured = ""  # why not
        self._refused: dict[str, int] = {}  # malformed frames by drive that have been told
        self._set_back_ns = 0  # by how much this computer's clock was, until it is told
        self._reading_times: OrderedDict[int, float] = OrderedDict()
        self._problems = Problems(self)
        CanRobot(robot, self._file, _NoTransport())  # refuses a bus that is too full before anything else happens
        self._diagnostics = Diagnostics(self, robot.name, self._status, aspect="drives", parts=self._parts)
        self.create_service(Trigger, "~/clear_faults", self._on_clear_faults)
        self.create_service(Trigger, "~/home", self._on_home)
        self.create_timer(0.01, self._look_after_faults, clock=Clock(clock_type=ClockType.STEADY_TIME))
        self._autostart_until = time.monotonic() + AUTOSTART_WITHIN
        self._autostart_timer = self.create_timer(0.5, self._autostart, clock=Clock(clock_type=ClockType.STEADY_TIME))
        if not autostart:
            self._autostart_timer.cancel()

    def _autostart(self) -> None:
        """Configure and activate once; drives that are switched on a little later are waited for."""
        if self._can is None and self.trigger_configure() == SUCCESS:
            self.trigger_activate()
        elif self._can is None and time.monotonic() < self._autostart_until:
            return
        elif self._can is None:
            self.get_logger().error(f"autostart: given up after {AUTOSTART_WITHIN:g} s; configure and activate by hand")
        self._autostart_timer.cancel()

    # --- Lifecycle ---------------------------------------------------------------------------------------

    def on_configure(self, state: State) -> TransitionCallbackReturn:
        """Open the buses and set up every drive."""
        self._make_topics()
        self._not_configured, self._refused = "", {}
        try:
            log = free_log_name(self._log_path) if self._log_path else None
            transport = PythonCanTransport(self._file.buses, log=log)
            self._can = CanRobot(self.robot, self._file, transport)
            short_collections()  # from configure on the drives watch for heartbeats, so that the periods begin at once
            self._can.configure()
        except PcwError as error:
            self.get_logger().error(f"not configured: {error}")
            self._not_configured = "; ".join(str(error).splitlines())
            self._close_can()
            self._remove_topics()
            return FAILURE
        self._start_cycles()
        for drive in self._can.drives:
            for note in drive.notes:
                self.get_logger().warning(f"{drive.name}: {note}")
        for load in self._can.loads.values():
            self.get_logger().info(load.arithmetic())
        return super().on_configure(state)

    def _make_topics(self) -> None:
        self._remove_topics()  # of a transition that failed
        self._states = self.create_publisher(JointState, "joint_states", SENSOR_STREAM_SOURCE)
        self._commands = self.create_subscription(JointState, "joint_commands", self._on_command, COMMAND)
        self._topics = True

    def _remove_topics(self) -> None:
        if self._topics:
            self._topics = False
            self.destroy_subscription(self._commands)
            self.destroy_publisher(self._states)

    def on_activate(self, state: State) -> TransitionCallbackReturn:
        """Give the drives torque, all or none."""
        assert self._can is not None
        try:
            self._can.request_enable()
        except PcwError as error:
            self.get_logger().error(f"not activated: {error}")
            return FAILURE
        end = time.monotonic() + ENABLE_TIME + SETTLING
        while self._can.state == "enabling" and time.monotonic() < end:
            time.sleep(0.002)
        if not self._can.armed:
            self._can.request_disable()
            self.get_logger().error(f"not activated: {'; '.join(map(str, self._can.faults)) or 'no torque in time'}")
            return FAILURE
        self._active = True
        return super().on_activate(state)

    def on_deactivate(self, state: State) -> TransitionCallbackReturn:
        """Zero torque, then none."""
        self._active = False
        self._let_go()
        return super().on_deactivate(state)

    def on_cleanup(self, state: State) -> TransitionCallbackReturn:
        """Close the buses and remove the topics."""
        self._active = False
        self._close_can()
        self._remove_topics()
        return super().on_cleanup(state)

    def close(self) -> None:
        """Zero torque, then none, and close the buses."""
        self._active = False
        self._autostart_timer.cancel()
        self._close_can()

    def _let_go(self) -> None:
        can = self._can
        if can is None:
            return
        can.request_disable()
        end = time.monotonic() + SETTLING
        while self._thread is not None and time.monotonic() < end:
            if all(drive.feedback.state.value != "enabled" for drive in can.drives):
                return
            time.sleep(0.002)

    def _close_can(self) -> None:
        if self._can is None:
            return
        self._let_go()
        self._stop_cycles()
        can, self._can = self._can, None
        can.close()
        sent, received = getattr(can.transport, "sent", {}), getattr(can.transport, "received", {})
        self.get_logger().info(f"frames sent {sum(sent.values())}, received {sum(received.values())}; {can.counters}")

    # --- The thread of the bus ---------------------------------------------------------------------------

    def _start_cycles(self) -> None:
        self._running = True
        self._thread = threading.Thread(target=self._cycles, name="can", daemon=True)
        self._thread.start()

    def _stop_cycles(self) -> None:
        self._running = False
        if self._thread is not None:
            self._thread.join(timeout=1.0)
            self._thread = None

    def _cycles(self) -> None:
        can = self._can
        while self._running and can is not None:
            try:
                can.cycle(self._publish)
            except Exception as error:
                self.get_logger().error(traceback.format_exc())
                can.stop([Fault("exception", "can_driver", f"{type(error).__name__}: {error}")])
                time.sleep(can.period)  # what fails at once shall not fail a thousand times a second

    def _publish(self, reading: TimedReading) -> None:
        age = time.monotonic() - reading.time
        stamp_ns = self.get_clock().now().nanoseconds - round(age * 1e9)
        if self._reading_times:
            last_ns = next(reversed(self._reading_times))
            stamp_ns = stamp_after(last_ns, stamp_ns)
            self._set_back_ns = max(self._set_back_ns, last_ns - stamp_ns)
        self._reading_times[stamp_ns] = reading.time
        while len(self._reading_times) > READINGS_REMEMBERED:
            self._reading_times.popitem(last=False)
        self._message.header.stamp = ns_to_stamp(stamp_ns)
        fill_joint_state(self._message, reading.joints.position, reading.joints.velocity, reading.joints.effort)
        self._states.publish(self._message)

    # --- Commands and services ---------------------------------------------------------------------------

    def _on_command(self, message: JointState) -> None:
        if not self._active or self._can is None:
            return
        try:
            command = read_joint_command(message, self._joint_index, (self.robot.n, 2))
        except PcwError as error:
            command = None
            self._problems.add(f"{error}; the torque is zero")
        try:
            self._can.command(command, self._answers(message))
        except Exception as error:
            self.get_logger().error(traceback.format_exc())
            self._can.stop([Fault("exception", "can_driver", f"{type(error).__name__}: {error}")])

    def _answers(self, message: JointState) -> float | None:
        """Return the time of the reading that a command answers [s]; of another stamp in the past, that time; else None."""
        stamp_ns = stamp_to_ns(message.header.stamp)
        known = self._reading_times.get(stamp_ns)
        if known is not None or stamp_ns == 0:
            return known
        age = (self.get_clock().now().nanoseconds - stamp_ns) * 1e-9
        if age < -self._file.timeouts.command:
            self._problems.add(f"commands bear stamps {-age:.1f} s ahead of this computer's clock: old ones go unnoticed")
        return time.monotonic() - age if age > self._file.timeouts.command else None

    def _look_after_faults(self) -> None:
        """Deactivate after a fault; the torque is off already."""
        can = self._can
        if can is None:
            return
        if self._set_back_ns:
            self._problems.add(f"the clock of this computer was set back by {self._set_back_ns * 1e-9:.1f} s")
            self._set_back_ns = 0
        faults = [str(fault) for fault in can.faults]
        if faults != self._told:
            for fault in faults[len(self._told) if faults[: len(self._told)] == self._told else 0 :]:
                self.get_logger().error(f"stopped: {fault}")
            self._told = faults
            self._diagnostics.report()
        if self._active and faults:
            self.trigger_deactivate()

    def _on_clear_faults(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """Set up every drive anew; gives no torque."""
        if self._can is None or self._active:
            response.success, response.message = False, "allowed: in the inactive state"
            return response
        self._stop_cycles()
        try:
            self._can.clear_faults()
            response.success, response.message = True, "no faults; activate gives torque"
        except PcwError as error:
            response.success, response.message = False, str(error)
        finally:
            self._start_cycles()
        return response

    def _on_home(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """Begin homing; /diagnostics and the log say how it ends."""
        if self._can is None or self._active:
            response.success, response.message = False, "allowed: in the inactive state"
            return response
        self._stop_cycles()
        try:
            self._can.start_homing()
            looking = ", ".join(self._can.homing) or "no axis has to: absolute encoders"
            response.success, response.message = True, f"looking for marks: {looking}"
        except PcwError as error:
            response.success, response.message = False, str(error)
        finally:
            self._start_cycles()
        return response

    # --- Diagnostics -------------------------------------------------------------------------------------

    def _status(self) -> Status:
        can, problems = self._can, self._problems.take()
        if can is None:
            why = self._not_configured
            return Status(ERROR, f"not configured: {why}") if why else Status(WARN, "not configured")
        counters = can.counters
        median, p99, p999, largest = (1000.0 * can.age_quantiles()).tolist()
        level, message = OK, can.state
        if can.faults:
            level, message = ERROR, "stopped until ~/clear_faults: " + "; ".join(map(str, can.faults))
        elif problems:
            level, message = WARN, problems
        elif log_problem := getattr(can.transport, "log_problem", ""):
            level, message = WARN, f"{can.state}; {log_problem}"
        others = can.others()
        if others:  # with a fault too: it may be why
            level, message = max(level, WARN), f"{message}; {others}"
        return Status(
            level, message,
            {
                **vars(counters), "command_age_ms_p50": median, "command_age_ms_p99": p99, "command_age_ms_p99.9": p999,
                "command_age_ms_largest": largest,
                **{f"homing_{name}": result for name, result in can.homing_results.items()},
            },
        )  # fmt: skip

    def _parts(self) -> Mapping[str, Status]:
        can = self._can
        if can is None:
            return {}
        parts = {}
        for name, load in can.loads.items():
            faults = [str(fault) for fault in can.faults if fault.where == name]
            message = "; ".join([f"{load.load:.1%} of {load.bitrate / 1000:g} kbit/s", *faults])
            parts[f"bus {name}"] = Status(ERROR if faults else OK, message, {"bus_load": load.load})
        for drive in can.drives:
            feedback, faults = drive.feedback, [str(fault) for fault in can.faults if fault.where == drive.name]
            level, message = ERROR if faults else OK, "; ".join(faults) or feedback.state.value
            if malformed := drive.refused_frames - self._refused.get(drive.name, 0):  # why it may seem to say nothing
                level, message = max(level, WARN), f"{message}; malformed frames since the last report: {malformed}"
            self._refused[drive.name] = drive.refused_frames
            values = {"firmware": drive.firmware, "identity": drive.identity, "errors": ", ".join(feedback.error_names)}
            if feedback.temperature == feedback.temperature:  # NaN where the drive reports none
                values["temperature_degC"] = f"{feedback.temperature:.1f}"
            parts[f"drive {drive.name}"] = Status(level, message, values)
        return parts


class _NoTransport:
    """Buses that are not there yet."""

    def now(self) -> float:
        return 0.0


def main(args: Sequence[str] | None = None) -> int:
    """Run the driver."""
    sys.setswitchinterval(SWITCH_INTERVAL)
    return run_node(CanDriverNode, args)


if __name__ == "__main__":
    raise SystemExit(main())
