"""For tests of nodes: real processes and a peer that talks to them over real DDS, alone in a domain of their own.

    with RosTest() as ros:
        node = ros.start("pcw_estimation.nodes.odometry", "-p", "robot:=thesis")
        states = ros.peer.create_publisher(JointState, "joint_states", 10)
        odom = ros.listen(Odometry, "odom")
        ros.wait_for(lambda: odom, while_doing=lambda: states.publish(message))
        assert node.interrupt() == 0

Nothing sleeps for a fixed time, but before the first question to a service: everything waits for what it needs and fails at a
deadline, with what the nodes said.
"""

from __future__ import annotations

import fcntl
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, TextIO

import rclpy
from rclpy.client import Client
from rclpy.context import Context
from rclpy.node import Node
from rclpy.qos import QoSProfile

from .node_tools import RUNNING, SETTING_UP, EventsExecutor

# First contact takes seconds on a busy machine; waits end as soon as they can [s].
DEADLINE = 60.0
# The longest that a wait stands still for nodes that compile: three at once, cold, beside other tests, took 75 s [s].
SETTING_UP_DEADLINE = 240.0
# A service is known before it knows who asks; the middleware gives up an answer that it cannot deliver within 0.1 s [s].
FOUND_BY_SERVER = 0.3
POLITENESS = 5.0  # in which a process that was asked to end may do so [s]


class NodeProcess:
    """One process that was started by a test."""

    def __init__(self, command: Sequence[str], environment: dict[str, str], log: Path) -> None:
        self._log_path = log
        with log.open("w") as output:
            # A session of its own: a signal to the test must reach the child through the test alone.
            self.process = subprocess.Popen(
                command, env=environment, stdout=output, stderr=subprocess.STDOUT, start_new_session=True
            )

    @property
    def log(self) -> str:
        """What it has printed so far."""
        return self._log_path.read_text(errors="replace")

    @property
    def sets_up(self) -> bool:
        """Whether it has said that setting up takes long, as where kernels are compiled, and not yet that it runs."""
        return self.process.poll() is None and SETTING_UP in (said := self.log) and RUNNING not in said

    def wait(self, deadline: float = DEADLINE) -> int:
        """Wait for its end and return the exit code."""
        try:
            return self.process.wait(timeout=deadline)
        except subprocess.TimeoutExpired:
            raise AssertionError(f"still running after {deadline:g} s; it said:\n{self.log}") from None

    def interrupt(self, number: signal.Signals = signal.SIGINT, deadline: float = DEADLINE) -> int:
        """Send a signal, wait for the end and return the exit code."""
        self.process.send_signal(number)
        return self.wait(deadline)

    def ask_to_end(self) -> None:
        """Interrupt it unless it has ended: a killed process leaves its part of the shared memory as it was."""
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGINT)

    def end(self) -> None:
        """Wait for its end a moment, then kill it."""
        try:
            self.process.wait(timeout=POLITENESS)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()


class RosTest:
    """A ROS domain that no other test uses, processes in it, and one node of our own: `peer`."""

    def __init__(self) -> None:
        self.domain, self._lock = _own_domain()
        self._folder = tempfile.TemporaryDirectory()
        self._processes: list[NodeProcess] = []
        self.environment = {**os.environ, "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST", "ROS_DOMAIN_ID": str(self.domain)}
        previous = os.environ.get("ROS_AUTOMATIC_DISCOVERY_RANGE")
        os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
        try:
            self._context = Context()
            rclpy.init(context=self._context, domain_id=self.domain)
        finally:
            if previous is None:
                del os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"]
            else:
                os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = previous
        self.peer = Node("test_peer", context=self._context)
        self._executor = EventsExecutor(context=self._context)
        self._executor.add_node(self.peer)
        self._clients: dict[str, Client[Any, Any]] = {}

    def __enter__(self) -> RosTest:
        """Return itself."""
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        """End every process and leave the domain."""
        for process in self._processes:
            process.ask_to_end()
        for process in self._processes:
            process.end()
            if error is not None:
                print(f"--- {process.process.args}\n{process.log}", file=sys.stderr)
        self._executor.shutdown()
        self.peer.destroy_node()
        rclpy.try_shutdown(context=self._context)
        self._folder.cleanup()
        self._lock.close()

    def start(self, module: str, *ros_arguments: str, before: Sequence[str] = ()) -> NodeProcess:
        """Run `python -m module before... --ros-args ros_arguments...`."""
        command = [sys.executable, "-m", module, *before]
        if ros_arguments:
            command += ["--ros-args", *ros_arguments]
        return self.run(command)

    def run(self, command: Sequence[str]) -> NodeProcess:
        """Run a command in this domain."""
        process = NodeProcess(command, self.environment, Path(self._folder.name) / f"{len(self._processes)}.log")
        self._processes.append(process)
        return process

    def listen(self, message_type: type, topic: str, qos: QoSProfile | int = 1000) -> list[Any]:
        """Return a list to which every message of a topic is appended."""
        received: list[Any] = []
        self.peer.create_subscription(message_type, topic, received.append, qos)
        return received

    def spin_once(self) -> None:
        """Handle what has arrived, or wait 20 ms for something."""
        self._executor.spin_once(timeout_sec=0.02)

    def wait_for(
        self,
        condition: Callable[[], Any],
        deadline: float = DEADLINE,
        while_doing: Callable[[], object] | None = None,
        every: float = 0.02,
    ) -> Any:
        """Return what `condition()` returns once that is true; call `while_doing` every so often [s] meanwhile.

        The time in which a process is still setting up does not count, up to `SETTING_UP_DEADLINE`.
        """
        begun = time.monotonic()
        end, next_call = begun + deadline, 0.0
        while True:
            found = condition()
            if found:
                return found
            now = time.monotonic()
            if now > end and now < begun + SETTING_UP_DEADLINE and any(process.sets_up for process in self._processes):
                end = now + deadline
            if now > end:
                said = "\n".join(f"--- {process.process.args}\n{process.log}" for process in self._processes)
                raise AssertionError(f"not within {deadline:g} s\n{said}")
            if while_doing is not None and now >= next_call:
                while_doing()
                next_call = now + every
            self.spin_once()

    def spin_for(self, duration: float, while_doing: Callable[[], object] | None = None, every: float = 0.02) -> None:
        """Handle what arrives for so long [s]; for showing that something does not happen."""
        end = time.monotonic() + duration
        self.wait_for(lambda: time.monotonic() > end, duration + DEADLINE, while_doing, every)

    def client(self, service_type: Any, name: str) -> Any:
        """Return the client of a service, once both know each other; for calls during which nothing may wait."""
        client = self._clients.get(name)
        is_new = client is None
        if client is None:
            client = self._clients[name] = self.peer.create_client(service_type, name)
        # To a new client a service that the peer knew before is ready at once, and knows nothing of it.
        if is_new or not client.service_is_ready():
            self.wait_for(client.service_is_ready)
            self.spin_for(FOUND_BY_SERVER)
        return client

    def call(self, service_type: Any, name: str, request: Any = None) -> Any:
        """Call a service and return its response."""
        client = self.client(service_type, name)
        future = client.call_async(request if request is not None else service_type.Request())
        self.wait_for(future.done)
        return future.result()


def _own_domain() -> tuple[int, TextIO]:
    """Return a domain id that no other test on this machine uses, and the lock that says so while it is open."""
    # Up to 101: above, the ports of DDS may meet those the system gives to others.
    for domain in range(20, 102):
        lock = (Path(tempfile.gettempdir()) / f"pcw_test_domain_{os.getuid()}_{domain}.lock").open("w")
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            return domain, lock
        except BlockingIOError:
            lock.close()
    raise RuntimeError("all ROS domains for tests are in use")
