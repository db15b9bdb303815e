"""The recorder node as a process of its own, over real DDS: killed, interrupted, refused, asked to stop."""

from __future__ import annotations

import contextlib
import itertools
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

rclpy = pytest.importorskip("rclpy")

from geometry_msgs.msg import TwistStamped  # noqa: E402
from rclpy.context import Context  # noqa: E402
from rclpy.executors import SingleThreadedExecutor  # noqa: E402
from rclpy.node import Node  # noqa: E402
from rclpy.publisher import Publisher  # noqa: E402
from rclpy.qos import QoSProfile  # noqa: E402
from rosbags.rosbag2 import Reader  # noqa: E402
from sensor_msgs.msg import JointState  # noqa: E402
from std_msgs.msg import String  # noqa: E402
from std_srvs.srv import Trigger  # noqa: E402

from pcw_description.nodes.node_tools import LATCHED, SENSOR, ns_to_stamp  # noqa: E402
from pcw_description.recording import Recording  # noqa: E402
from pcw_description.ros_messages import typestore  # noqa: E402

# Waits end as soon as what they wait for is there; on a busy machine it may take this long [s].
DEADLINE = 60.0
RATE = 200.0
DOMAIN = 1 + os.getpid() % 18  # below those of `RosTest`
# Nothing may be lost on the way: the counts are compared.
EVERY_MESSAGE = QoSProfile(depth=1000)
JOINTS = ["front_left_drive", "front_left_steer"]


@pytest.fixture(scope="module")
def node() -> Iterator[Node]:
    """A node in this process that publishes what the recorder records."""
    with pytest.MonkeyPatch.context() as environment:
        environment.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
        context = Context()
        rclpy.init(context=context, domain_id=DOMAIN)
        node = rclpy.create_node("test_recorder", context=context)
        executor = SingleThreadedExecutor(context=context)
        executor.add_node(node)
        running = True

        def spin() -> None:
            while running:
                executor.spin_once(timeout_sec=0.05)

        thread = threading.Thread(target=spin)
        thread.start()
        yield node
        running = False
        thread.join()
        executor.shutdown()
        node.destroy_node()
        rclpy.try_shutdown(context=context)


@contextlib.contextmanager
def recorder(output: Path, *arguments: str) -> Iterator[subprocess.Popen[str]]:
    """The node as a process; killed at the end if it still runs."""
    process = subprocess.Popen(
        [sys.executable, "-m", "pcw_sim_bridge.nodes.recorder", "--ros-args", "-p", f"output:={output}", *arguments],
        env={
            **os.environ,
            "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
            "ROS_DOMAIN_ID": str(DOMAIN),
        },
        start_new_session=True,
        text=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    )
    try:
        yield process
    finally:
        process.kill()
        process.communicate()


@contextlib.contextmanager
def publishers(node: Node, kinds: dict[str, tuple[type, QoSProfile]]) -> Iterator[dict[str, Publisher]]:
    made = {topic: node.create_publisher(kind, topic, qos) for topic, (kind, qos) in kinds.items()}
    try:
        yield made
    finally:
        for publisher in made.values():
            node.destroy_publisher(publisher)


def wait_for(condition: Callable[[], bool], what: str, process: subprocess.Popen[str]) -> None:
    deadline = time.monotonic() + DEADLINE
    while not condition():
        if process.poll() is not None:
            pytest.fail(f"the recorder ended before {what}: {process.communicate()[1]}")
        if time.monotonic() > deadline:
            pytest.fail(f"waited {DEADLINE} s in vain for {what}")
        time.sleep(0.01)


def wait_until_heard(process: subprocess.Popen[str], *made: Publisher) -> None:
    wait_for(lambda: all(publisher.get_subscription_count() > 0 for publisher in made), "the subscriptions", process)


def joint_state(number: int) -> JointState:
    """A message that carries its number and the wall time at which it is sent."""
    message = JointState(name=JOINTS, position=[float(number), 0.5], velocity=[0.1, 0.2], effort=[0.3, 0.4])
    message.header.stamp = ns_to_stamp(time.time_ns())
    return message


def publish(publisher: Publisher, until: Callable[[], bool]) -> list[int]:
    """Publish joint states at RATE until told to end; returns their stamps [ns]."""
    sent = []
    started = time.monotonic()
    deadline = started + DEADLINE
    while not until():
        assert time.monotonic() < deadline, "waited in vain while publishing"
        message = joint_state(len(sent))
        publisher.publish(message)
        sent.append(message.header.stamp.sec * 1_000_000_000 + message.header.stamp.nanosec)
        time.sleep(max(0.0, started + len(sent) / RATE - time.monotonic()))
    return sent


def after(count: int) -> Callable[[], bool]:
    """A condition that holds from when it has been asked `count` times."""
    asked = itertools.count()
    return lambda: next(asked) >= count


def finish(process: subprocess.Popen[str], number: int) -> tuple[str, str]:
    """Send a signal, wait for the end in order."""
    process.send_signal(number)
    output, errors = process.communicate(timeout=DEADLINE)
    assert process.returncode == 0, errors
    return output, errors


def positions(path: Path) -> list[float]:
    """First position of every joint state, by a reader that is not ours."""
    with Reader(path) as reader:
        return [
            typestore().deserialize_cdr(data, connection.msgtype).position[0]
            for connection, _, data in reader.messages()
            if connection.topic == "/joint_states"
        ]


def test_killed_in_mid_run_it_has_all_but_the_last_second(node: Node, tmp_path: Path) -> None:
    """SIGKILL: every message sent a second before is read back, from a file that only ever grew."""
    output = tmp_path / "killed"
    data = output / "killed_0.mcap"
    with publishers(node, {"joint_states": (JointState, EVERY_MESSAGE)}) as made, recorder(output) as process:
        wait_until_heard(process, made["joint_states"])
        looks: list[tuple[int, bytes]] = []

        def grown_three_times() -> bool:
            content = data.read_bytes()
            if not looks or len(content) > len(looks[-1][1]) + 1000:
                looks.append((data.stat().st_ino, content))
            return len(looks) > 6

        sent = publish(made["joint_states"], grown_three_times)
        process.kill()
        killed_ns = time.time_ns()
        process.wait(timeout=DEADLINE)

    final = data.read_bytes()
    for inode, content in looks:
        assert inode == data.stat().st_ino
        assert final.startswith(content)
    due = [stamp_ns for stamp_ns in sent if stamp_ns < killed_ns - 1_000_000_000]
    assert len(due) > RATE, "the run was too short to show anything"
    recording = Recording.open(output)
    assert recording.joint_states.stamp_ns[: len(due)].tolist() == due
    assert any(warning.code == "unfinished" for warning in recording.warnings)


def test_interrupted_it_leaves_a_finished_bag(node: Node, tmp_path: Path) -> None:
    """SIGINT: an independent reader finds every message; topics of every QoS and late ones are there too."""
    output = tmp_path / "bag"
    kinds: dict[str, tuple[type, Any]] = {
        "joint_states": (JointState, EVERY_MESSAGE),
        "slip/encoder": (JointState, SENSOR),  # best effort, found by the pattern slip/*
        "extra/description": (String, LATCHED),
    }
    with publishers(node, kinds) as made:
        made["extra/description"].publish(String(data="sent before the recorder was there"))
        topics = "['joint_states', 'cmd_vel', 'slip/*', '/extra/description', 'never/sent']"
        with recorder(output, "-p", f"topics:={topics}") as process:
            wait_until_heard(process, *made.values())
            with publishers(node, {"cmd_vel": (TwistStamped, EVERY_MESSAGE), "unwanted": (String, EVERY_MESSAGE)}) as late:
                wait_until_heard(process, late["cmd_vel"])
                late["cmd_vel"].publish(TwistStamped())
                sent = publish(made["joint_states"], after(100))
                assert late["cmd_vel"].wait_for_all_acked()
                assert made["joint_states"].wait_for_all_acked()
                assert late["unwanted"].get_subscription_count() == 0
            printed, errors = finish(process, signal.SIGINT)
    assert "/joint_states: 100 messages" in printed
    assert "nobody published /never/sent" in printed
    assert "Traceback" not in errors
    with Reader(output) as reader:
        counts = {topic: info.msgcount for topic, info in reader.topics.items()}
        assert counts == {"/joint_states": 100, "/cmd_vel": 1, "/slip/encoder": 0, "/extra/description": 1}
        assert reader.message_count == 102
        (qos,) = reader.topics["/extra/description"].connections[0].ext.offered_qos_profiles  # type: ignore[union-attr]
        assert (qos.durability.name, qos.reliability.name) == ("TRANSIENT_LOCAL", "RELIABLE")
        (qos,) = reader.topics["/slip/encoder"].connections[0].ext.offered_qos_profiles  # type: ignore[union-attr]
        assert qos.reliability.name == "BEST_EFFORT"
    assert positions(output) == list(range(100))
    recording = Recording.open(output)
    assert recording.joint_states.stamp_ns.tolist() == sent
    assert not any(warning.code in ("unfinished", "stale_metadata") for warning in recording.warnings)


def test_in_a_namespace_asked_to_stop_then_terminated(node: Node, tmp_path: Path) -> None:
    """Relative topics follow the namespace; ~/stop finishes the file, and the process ends by itself."""
    output = tmp_path / "bag"
    client = node.create_client(Trigger, "/robot1/recorder/stop")
    try:
        with (
            publishers(node, dict.fromkeys(("/robot1/joint_states", "/joint_states"), (JointState, EVERY_MESSAGE))) as made,
            recorder(output, "-r", "__ns:=/robot1") as process,
        ):
            wait_until_heard(process, made["/robot1/joint_states"])
            publish(made["/robot1/joint_states"], after(50))
            assert made["/robot1/joint_states"].wait_for_all_acked()
            wait_for(client.service_is_ready, "the service", process)
            future = client.call_async(Trigger.Request())
            wait_for(future.done, "its answer", process)
            assert future.result().success and str(output) in future.result().message
            process.communicate(timeout=DEADLINE)
            assert process.returncode == 0
            assert made["/joint_states"].get_subscription_count() == 0
    finally:
        node.destroy_client(client)
    assert len(Recording.open(output).joint_states) == 50


def test_terminated_before_anything_came(node: Node, tmp_path: Path) -> None:
    """SIGTERM: a finished bag, if an empty one, and exit code 0."""
    output = tmp_path / "bag"
    with recorder(output) as process:
        wait_for((output / "metadata.yaml").exists, "the folder", process)
        finish(process, signal.SIGTERM)
    with Reader(output) as reader:
        assert not any(topic.endswith("joint_states") for topic in reader.topics)


def test_it_ends_by_itself_after_its_time(tmp_path: Path) -> None:
    with recorder(tmp_path / "bag", "-p", "max_duration:=0.5") as process:
        printed, _ = process.communicate(timeout=DEADLINE)
        assert process.returncode == 0
    assert "messages in 0." in printed or "messages in 1." in printed


def test_an_existing_path_is_refused_and_left_as_it_is(tmp_path: Path) -> None:
    output = tmp_path / "mine"
    output.mkdir()
    (output / "metadata.yaml").write_text("precious")
    with recorder(output) as process:
        _, errors = process.communicate(timeout=DEADLINE)
        assert process.returncode == 2
    assert "mine exists already and is left as it is" in errors
    assert "Traceback" not in errors
    assert [file.name for file in output.iterdir()] == ["metadata.yaml"]
    assert (output / "metadata.yaml").read_text() == "precious"


@pytest.mark.parametrize(
    ("parameter", "reason"),
    [
        ("compression:=zip", "'zip' is not known"),
        ("max_duration:=-1.0", "max_duration: -1.0 is outside 0.0 .. 10000000.0 s"),
        ("max_duration:=.nan", "max_duration: nan is not a finite number"),
        ("max_duration:=5", "max_duration: 5 is of type integer; allowed: double; write 5.0"),
    ],
)
def test_a_bad_parameter_is_refused_with_the_reason(tmp_path: Path, parameter: str, reason: str) -> None:
    with recorder(tmp_path / "bag", "-p", parameter) as process:
        _, errors = process.communicate(timeout=DEADLINE)
        assert process.returncode == 2
    assert reason in errors and "Traceback" not in errors
    assert not (tmp_path / "bag").exists()
