"""The whole stack in real time: emulator, driver and controller in processes of their own, frames over UDP multicast, DDS.

    python -m pcw_sim_bridge.nodes.can_trials closed_loop [--can-file FILE] [--rate 250] [--duration 600]
    python -m pcw_sim_bridge.nodes.can_trials kill [--times 5]

Reported as measured, with the load of the computer: one that is busy with other work is late, and drives rightly stop then.
`--timeouts` sets all three timeouts of the file, so that ages can be measured where the file's own would end the run.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import TwistStamped
from sensor_msgs.msg import JointState

from pcw_description import load_robot
from pcw_description.nodes.node_testing import NodeProcess, RosTest

from ..can.can_file import find_can_file, joint_place
from ..can.steer_zero import calibration_twist

EMULATOR, DRIVER, CONTROLLER = (
    "pcw_sim_bridge.can.drive_emulator", "pcw_sim_bridge.nodes.can_driver", "pcw_control.nodes.computed_torque",
)  # fmt: skip
FIRST_PORT = 43300
BOUND_MS = 8.0


class Stack:
    """Emulator, driver and controller, and a cmd_vel that goes to and fro."""

    def __init__(self, ros: RosTest, folder: Path, options: argparse.Namespace) -> None:
        self.ros, self.options, self._folder = ros, options, folder
        content = yaml.safe_load(find_can_file(options.can_file).read_text(encoding="utf-8"))
        content["rate"] = options.rate
        if options.timeouts:
            content["timeouts"] = dict.fromkeys(("command", "feedback", "watchdog"), options.timeouts)
        if options.rate > 300:  # one bus cannot carry it: half of the axes on another
            content["buses"].append({**content["buses"][0], "name": "can1", "channel": "can1"})
            for joint in content["joints"][len(content["joints"]) // 2 :]:
                joint["bus"] = "can1"
        self.file = folder / "drives.yaml"
        self.file.write_text(yaml.safe_dump(content), encoding="utf-8")
        self.stats = folder / "stats.json"
        self.port = str(FIRST_PORT + ros.domain)
        self.status: dict[str, Any] = {}
        self._twist = ros.peer.create_publisher(TwistStamped, "cmd_vel", 1)
        ros.peer.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, 100)
        self._names = 0
        self.start_emulator()
        self.start_driver()
        self.controller = ros.start(CONTROLLER)
        ros.wait_for(lambda: any("computed_torque" in name for name in self.status))

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            self.status[status.name] = (status.message, {value.key: value.value for value in status.values})

    def start_emulator(self) -> None:
        """Start the drives."""
        self.emulator = self.ros.start(
            EMULATOR, before=["--can-file", str(self.file), "--udp-port", self.port, "--stats", str(self.stats)]
        )
        self.ros.wait_for(lambda: "drives of" in self.emulator.log)

    def start_driver(self) -> None:
        """Start a driver that configures and activates itself."""
        self._names += 1
        self.driver_name = f"can_driver_{self._names}"
        self.driver = self.ros.start(
            DRIVER, "-r", f"__node:={self.driver_name}", "-p", f"can_file:={self.file}", "-p", f"udp_port:={self.port}",
            "-p", "autostart:=true",
        )  # fmt: skip
        self.ros.wait_for(lambda: self.drives[0] != "" or self.driver.process.poll() is not None)

    @property
    def drives(self) -> tuple[str, dict[str, str]]:
        """What the driver last said of itself."""
        return self.status.get(f"{self.driver_name}: drives", ("", {}))

    def move(self, time: float) -> None:
        """Command a twist."""
        twist = calibration_twist(2.0 + time, time + 10.0)
        message = TwistStamped()
        message.header.stamp = self.ros.peer.get_clock().now().to_msg()
        message.twist.linear.x, message.twist.linear.y, message.twist.angular.z = twist.tolist()
        self._twist.publish(message)

    def drive_for(self, duration: float) -> None:
        """Drive for so long [s]."""
        begun = self.ros.peer.get_clock().now().nanoseconds
        clock = self.ros.peer.get_clock()
        self.ros.spin_for(duration, lambda: self.move((clock.now().nanoseconds - begun) * 1e-9), every=0.05)


def closed_loop(options: argparse.Namespace) -> int:
    """Drive for the duration and print the ages of commands and the frames that were lost."""
    with tempfile.TemporaryDirectory() as folder, RosTest() as ros:
        before = os.getloadavg()[0]
        stack = Stack(ros, Path(folder), options)
        stack.drive_for(2.0)
        seconds = {name: -_processor_time(getattr(stack, name)) for name in ("emulator", "driver", "controller")}
        stack.drive_for(options.duration)
        message, values = stack.drives
        for name in seconds:
            seconds[name] += _processor_time(getattr(stack, name))
        stack.controller.interrupt()
        stack.driver.interrupt()
        stack.emulator.interrupt()
        measured = json.loads(stack.stats.read_text(encoding="utf-8"))
        said = next((line for line in stack.driver.log.splitlines() if "frames sent" in line), "")
    ages = measured["command_age_ms"]
    sent, received = (
        int(said.split(word)[1].split()[0].strip(",;")) if said else -1 for word in ("frames sent ", "received ")
    )
    to_drives, from_drives = measured["transport"]["received"], measured["transport"]["sent"]
    print(f"{options.can_file} at {options.rate:g} Hz for {options.duration:g} s; load of the computer {before:.1f} before, "
          f"{os.getloadavg()[0]:.1f} after, on {os.cpu_count()} cores")  # fmt: skip
    print(f"state of the driver at the end: {message}")
    print(f"age of the command at the drives: p50 {ages['p50']:.1f}, p99 {ages['p99']:.1f}, p99.9 {ages['p99.9']:.1f}, "
          f"largest {ages['largest']:.1f} ms")  # fmt: skip
    at_driver = {key.removeprefix("command_age_ms_"): float(value) for key, value in values.items() if "command_age" in key}
    print("from reading to command, at the driver: " + ", ".join(f"{key} {age:.2f} ms" for key, age in at_driver.items()))
    print(f"frames to the drives: {sent} sent, {sum(to_drives.values())} received")
    print(f"frames from the drives: {sum(from_drives.values())} sent, {received} received (the emulator begins first)")
    print(f"cycles {values.get('cycles')}, late {values.get('late_cycles')}, incomplete {values.get('incomplete')}")
    print("processor time: " + ", ".join(f"{name} {used / options.duration:.0%}" for name, used in seconds.items())
          + " of a core")  # fmt: skip
    fine = message.startswith("armed") and ages["p99.9"] <= BOUND_MS and sent == sum(to_drives.values())
    print("met" if fine else "NOT MET on this computer at this load")
    return 0 if fine else 1


def _processor_time(process: NodeProcess) -> float:
    """Return the processor time that a process has used [s]."""
    fields = Path(f"/proc/{process.process.pid}/stat").read_text(encoding="utf-8").rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def kill(options: argparse.Namespace) -> int:
    """Kill each process while driving: the others are safe, and a restart works."""
    good = done = 0
    with tempfile.TemporaryDirectory() as folder, RosTest() as ros:
        stack = Stack(ros, Path(folder), options)
        states: list[JointState] = []
        ros.peer.create_subscription(JointState, "joint_states", states.append, 1000)
        robot = load_robot("thesis")
        steer = [i for i, name in enumerate(robot.joint_names) if joint_place(robot, name)[1] == 1]
        for round_number in range(options.times):
            for victim in ("driver", "controller", "emulator"):
                stack.drive_for(2.0)
                process: NodeProcess = getattr(stack, victim)
                process.process.send_signal(signal.SIGKILL)
                process.wait()
                stack.drive_for(1.0)
                states.clear()
                if victim == "driver":
                    stack.start_driver()
                else:
                    ros.wait_for(lambda: stack.drives[0].startswith("stopped"))
                    safe = stack.drives[0].split(": ")[1].split(";")[0]
                    if victim == "controller":
                        stack.controller = ros.start(CONTROLLER)
                    else:
                        stack.start_emulator()
                    stack.driver.interrupt()
                    stack.start_driver()
                stack.drive_for(2.0)
                ok = stack.drives[0].startswith("armed")
                done, good = done + 1, good + ok
                moved = np.ptp([state.position[steer[0]] for state in states]) if states else 0.0
                what = "drives stopped by their watchdogs" if victim == "driver" else safe
                print(f"{round_number + 1}: killed the {victim}: {what}; restarted: {stack.drives[0]}, moved {moved:.3f} rad",
                      flush=True)  # fmt: skip
    print(f"{good} of {done} restarts drive again")
    return 0 if good == done else 1


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line: exit 0 when all is as it must be."""
    options = argparse.ArgumentParser(prog="can_trials", description="The CAN stack in real time.")
    actions = options.add_subparsers(dest="action", required=True)
    for action in ("closed_loop", "kill"):
        sub = actions.add_parser(action)
        sub.add_argument("--can-file", default="thesis_cia402")
        sub.add_argument("--rate", type=float, default=250.0)
        sub.add_argument("--timeouts", type=float, help="instead of those of the file [s]")
        if action == "closed_loop":
            sub.add_argument("--duration", type=float, default=600.0)
        else:
            sub.add_argument("--times", type=int, default=5)
    given = options.parse_args(arguments)
    return closed_loop(given) if given.action == "closed_loop" else kill(given)


if __name__ == "__main__":
    sys.exit(main())
