"""The node `robot_description`, started as a process and heard over real DDS."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator

import pytest

from pcw_description import load_robot
from pcw_description.urdf import robot_urdf

rclpy = pytest.importorskip("rclpy")

# A domain of its own keeps other tests on this machine out.
ENVIRONMENT = {**os.environ, "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST", "ROS_DOMAIN_ID": "19"}
COMMAND = [sys.executable, "-m", "pcw_description.nodes.robot_description", "--ros-args"]
# First contact over DDS takes 1 to 3 s on a free machine.
DEADLINE = 30.0


@pytest.fixture
def listener(monkeypatch: pytest.MonkeyPatch) -> Iterator[object]:
    for name in ("ROS_AUTOMATIC_DISCOVERY_RANGE", "ROS_DOMAIN_ID"):
        monkeypatch.setenv(name, ENVIRONMENT[name])
    context = rclpy.Context()
    rclpy.init(context=context)
    node = rclpy.create_node("listener", context=context)
    yield node
    node.destroy_node()
    rclpy.try_shutdown(context=context)


def test_urdf_reaches_a_listener_that_comes_late_and_a_signal_ends_the_node(listener) -> None:  # type: ignore[no-untyped-def]
    from rclpy.executors import SingleThreadedExecutor
    from std_msgs.msg import String

    from pcw_description.nodes.node_tools import LATCHED

    node = subprocess.Popen([*COMMAND, "-p", "robot:=tidybot2"], env=ENVIRONMENT, stderr=subprocess.PIPE, text=True)
    try:
        assert node.stderr is not None
        line = node.stderr.readline()
        assert "tidybot2: URDF with 4 casters published" in line
        received: list[str] = []
        listener.create_subscription(String, "robot_description", lambda message: received.append(message.data), LATCHED)
        executor = SingleThreadedExecutor(context=listener.context)
        executor.add_node(listener)
        end = time.monotonic() + DEADLINE
        while not received and time.monotonic() < end:
            executor.spin_once(timeout_sec=0.2)
        executor.shutdown()
        assert received == [robot_urdf(load_robot("tidybot2"))]
        node.send_signal(signal.SIGINT)
        assert node.wait(timeout=DEADLINE) == 0
    finally:
        node.kill()
        node.wait()


@pytest.mark.parametrize(
    ("parameter", "complaint"),
    [("robot:=tidybot", "did you mean 'tidybot2'?"), ("robot:=3", "robot")],
)
def test_bad_parameter_ends_it_with_one_line(parameter: str, complaint: str) -> None:
    result = subprocess.run([*COMMAND, "-p", parameter], env=ENVIRONMENT, capture_output=True, text=True, timeout=2 * DEADLINE)
    assert result.returncode == 2
    assert complaint in result.stderr and "Traceback" not in result.stderr
