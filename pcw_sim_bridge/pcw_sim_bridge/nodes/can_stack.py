"""The whole stack in processes of its own: emulated drives, the driver, a controller, and somebody who wants to go about."""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import TwistStamped
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger

from pcw_description.nodes.node_testing import NodeProcess, RosTest

from ..can.can_file import find_can_file, udp_port_beside
from ..can.steer_zero import calibration_twist

EMULATOR, CONTROLLER = "pcw_sim_bridge.can.drive_emulator", "pcw_control.nodes.computed_torque"
DRIVER, FAULTY_DRIVER = "pcw_sim_bridge.nodes.can_driver", "pcw_sim_bridge.nodes.can_faulty_driver"
MOVING = 0.3  # the fastest joint of a robot that drives [rad/s]


class Stack:
    """Emulator, driver and controller, and a cmd_vel that goes to and fro and round and round.

    Args:
        ros: where they live.
        folder: for the file of the drives and what is measured.
        options: `can_file`, `rate`, `timeouts`, `priority`.
        driver: module of the driver.
        watch: listen to joint_states too, which costs processor time.

    Attributes:
        status: the newest of /diagnostics by name: message and values.
        stopped_at: when the driver first said that it has stopped, by the monotonic clock [s]; None since `forget`.
        states: the newest joint_states, with `watch`.
    """

    def __init__(
        self, ros: RosTest, folder: Path, options: argparse.Namespace, driver: str = DRIVER, watch: bool = False
    ) -> None:
        self.ros, self.options, self._folder, self._module = ros, options, folder, driver
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
        self.port = str(udp_port_beside(ros.domain))
        self.status: dict[str, tuple[str, dict[str, str]]] = {}
        self.stopped_at: float | None = None
        self.states: JointState | None = None
        self._twist = ros.peer.create_publisher(TwistStamped, "cmd_vel", 1)
        ros.peer.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, 100)
        if watch:
            ros.peer.create_subscription(JointState, "joint_states", self._on_states, 1)
        self._begun = self._now()
        self._priority = options.priority
        self._names = 0
        self._pipes: list[int] = []
        self._printed = 0
        self.start_emulator()
        self.start_driver()
        self.start_controller()

    def _now(self) -> float:
        return self.ros.peer.get_clock().now().nanoseconds * 1e-9

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            self.status[status.name] = (status.message, {value.key: value.value for value in status.values})
        if self.stopped_at is None and self.drives[0].startswith("stopped"):
            self.stopped_at = time.monotonic()

    def _on_states(self, message: JointState) -> None:
        self.states = message

    # --- Processes ---------------------------------------------------------------------------------------

    def start_emulator(self) -> None:
        """Start the drives, with a pipe as their standard input."""
        pipe = self._folder / f"orders_{len(self._pipes)}"
        os.mkfifo(pipe)
        self._pipes.append(os.open(pipe, os.O_RDWR))
        arguments = f"--can-file {self.file} --udp-port {self.port} --stats {self.stats}"
        command = f"exec {sys.executable} -m {EMULATOR} {arguments} < {pipe}"
        self.emulator = self.ros.run(["bash", "-c", command])
        self._printed = 0
        self.ros.wait_for(lambda: "drives of" in self.emulator.log)
        self._prefer(self.emulator)

    def start_driver(self) -> None:
        """Start a driver that configures and activates itself; of another name, as a killed one's services seem to stay."""
        self._names += 1
        self.driver_name = f"can_driver_{self._names}"
        self.driver = self.ros.run(
            [sys.executable, "-m", self._module, "--ros-args", "-r", f"__node:={self.driver_name}",
             "-p", f"can_file:={self.file}", "-p", f"udp_port:={self.port}", "-p", "autostart:=true"]
        )  # fmt: skip
        self.ros.wait_for(lambda: self.drives[0] != "" or self.driver.process.poll() is not None)
        self._prefer(self.driver)
        peer = self.ros.peer
        self._change = peer.create_client(ChangeState, f"{self.driver_name}/change_state")
        self._clear = peer.create_client(Trigger, f"{self.driver_name}/clear_faults")

    def start_controller(self) -> None:
        """Start the controller and wait until it is there."""
        for name in [name for name in self.status if "computed_torque" in name]:
            del self.status[name]
        self.controller = self.ros.run([sys.executable, "-m", CONTROLLER])
        self.ros.wait_for(lambda: any("computed_torque" in name for name in self.status), while_doing=self.move, every=0.05)
        self._prefer(self.controller)

    def _prefer(self, process: NodeProcess) -> None:
        """Give all threads of a process the priority, as the page on CAN advises for a robot: when it is up, not before."""
        if self._priority and process.process.poll() is None:
            subprocess.run(["chrt", "-a", "-f", "-p", str(self._priority), str(process.process.pid)], check=True)

    def close(self) -> None:
        """Close the pipes."""
        for pipe in self._pipes:
            os.close(pipe)
        self._pipes = []

    # --- What is said ------------------------------------------------------------------------------------

    @property
    def drives(self) -> tuple[str, dict[str, str]]:
        """What the driver last said of itself."""
        return self.status.get(f"{self.driver_name}: drives", ("", {}))

    @property
    def is_driving(self) -> bool:
        """Whether the driver is armed and the robot moves with torque."""
        if self.states is None or not self.drives[0].startswith("armed"):
            return False
        return bool(np.abs(self.states.velocity).max() > MOVING and np.abs(self.states.effort).max() > 0.1)

    def forget(self) -> None:
        """Forget when the driver said that it has stopped."""
        self.stopped_at = None

    def order(self, line: str) -> None:
        """Tell the emulator something."""
        os.write(self._pipes[-1], f"{line}\n".encode())

    def measured(self) -> dict[str, Any]:
        """Ask the emulator what it has measured."""
        before = self.emulator.log.count("\n{")
        self.order("stats")
        self.wait_for(lambda: self.emulator.log.count("\n{") > before and self.emulator.log.endswith("\n"))
        lines = [line for line in self.emulator.log.splitlines() if line.startswith("{")]
        found: dict[str, Any] = json.loads(lines[-1])
        return found

    # --- What is done ------------------------------------------------------------------------------------

    def move(self) -> None:
        """Command the twist of now."""
        twist = calibration_twist(2.0 + self._now() - self._begun, 1e6)
        message = TwistStamped()
        message.header.stamp = self.ros.peer.get_clock().now().to_msg()
        message.twist.linear.x, message.twist.linear.y, message.twist.angular.z = twist.tolist()
        self._twist.publish(message)

    def drive_for(self, duration: float) -> None:
        """Drive for so long [s]."""
        self.ros.spin_for(duration, self.move, every=0.05)

    def wait_for(self, condition: Any, deadline: float = 60.0) -> None:
        """Drive until something is true."""
        self.ros.wait_for(condition, deadline, self.move, every=0.05)

    def change(self, transition: int) -> bool:
        """Ask for a transition of the driver; whether it was carried out."""
        return bool(self._call(self._change, ChangeState.Request(transition=Transition(id=transition))).success)

    def activate(self) -> bool:
        """Ask for torque."""
        given = self.change(Transition.TRANSITION_ACTIVATE)
        if given:
            self.status[f"{self.driver_name}: drives"] = ("armed", {})  # it says so itself once a second
        return given

    def clear_faults(self) -> bool:
        """Clear the driver's faults."""
        return bool(self._call(self._clear, Trigger.Request()).success)

    def _call(self, client: Any, request: Any) -> Any:
        self.wait_for(client.service_is_ready)
        future = client.call_async(request)
        self.wait_for(future.done)
        return future.result()
