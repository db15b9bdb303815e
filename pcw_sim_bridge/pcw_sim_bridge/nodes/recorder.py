"""Records topics into a rosbag2 folder that survives a kill."""

from __future__ import annotations

import fnmatch
import importlib
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from typing import Any

from rclpy.clock import Clock, ClockType
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.subscription import Subscription
from rclpy.topic_endpoint_info import TopicEndpointInfo
from std_srvs.srv import Trigger

from pcw_description.nodes.diagnostics import OK, WARN, Diagnostics, Status
from pcw_description.nodes.node_tools import all_declared, declare, run_node
from pcw_description.recording_writer import COMPRESSIONS, OfferedQos, RecordingWriter
from pcw_description.ros_messages import message_definition

# The contract's topics; `*` stands for any part of a name.
DEFAULT_TOPICS = (
    "cmd_vel",
    "wrench_cmd",
    "ft_sensor/wrench",
    "joint_states",
    "joint_commands",
    "imu/data",
    "odom",
    "ground_truth/odom",
    "slip/*",
    "contact/*/wrench",
    "terrain",
    "mismatch",
    "/diagnostics",
    "/clock",
)
# New topics are looked for this often, and written messages handed to the operating system [s].
GRAPH_PERIOD = 0.1
FLUSH_PERIOD = 0.4
# Messages of one topic that may wait while the disk is busy: two seconds at 500 Hz.
QUEUE_DEPTH = 1000


@dataclass
class _RecordedTopic:
    """A topic being recorded. A topic of an unknown type has no subscription."""

    type_name: str
    qos: QoSProfile
    subscription: Subscription | None = None
    lost: int = 0
    counted: int = field(default=0)  # at the last diagnostics


class RecorderNode(Node):
    """Subscribes to topics as they appear, without deserialising, and appends what arrives to one file."""

    def __init__(self) -> None:
        super().__init__("recorder")
        default_output = datetime.now().strftime("recording_%Y_%m_%d-%H_%M_%S")
        output = declare(self, "output", default_output, "folder to make for the recording", read_only=True)
        names = declare(
            self, "topics", list(DEFAULT_TOPICS), "topics to record, relative to the namespace; * is any text", read_only=True
        )
        self._all = declare(self, "all", False, "record every topic instead of `topics`", read_only=True)
        compression = declare(
            self, "compression", "zstd", "compression of the chunks", read_only=True, choices=tuple(COMPRESSIONS)
        )
        declare(self, "max_duration", 0.0, "stop after this long; 0 is never", "s", (0.0, 1e7))

        all_declared(self)
        self.finished = False  # nothing left to do: the process may end
        self._closed = False
        self._patterns = tuple(self._absolute(name) for name in names if name)
        self._topics: dict[str, _RecordedTopic] = {}
        self._writer = RecordingWriter(output, compression)
        self._started = self._reported = time.monotonic()
        self.create_service(Trigger, "~/stop", self._on_stop)
        # steady clocks: a simulation that is paused must not stop the flushing
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(GRAPH_PERIOD, self._look_at_graph, clock=steady)
        self.create_timer(FLUSH_PERIOD, self._flush, clock=steady)
        self._diagnostics = Diagnostics(self, str(self._writer.path), self._status, aspect="recording")
        self.get_logger().info(f"recording to {self._writer.path}")
        self._look_at_graph()

    # --- Topics -----------------------------------------------------------------------------------------

    def _absolute(self, name: str) -> str:
        """The full name of a topic or pattern, remappings included."""
        if "*" not in name:
            return self.resolve_topic_name(name)
        return name if name.startswith("/") else f"{self.get_namespace().rstrip('/')}/{name}"

    def _wanted(self, name: str) -> bool:
        if self._all:
            return True
        return any(fnmatch.fnmatchcase(name, pattern) for pattern in self._patterns)

    def _look_at_graph(self) -> None:
        """Subscribe to what has appeared, and again where a publisher offers less than was asked for."""
        if self._closed:
            return
        for name, type_names in self.get_topic_names_and_types():
            if not self._wanted(name):
                continue
            publishers = self.get_publishers_info_by_topic(name)
            if not publishers:
                continue
            known = self._topics.get(name)
            qos = _qos_to_ask_for(publishers)
            if known is None:
                self._start_topic(name, type_names, publishers, qos)
            elif known.subscription is not None and _asks_for_less(qos, known.qos):
                self.get_logger().warning(f"{name}: a publisher offers less than the ones before; subscribing again")
                self.destroy_subscription(known.subscription)
                known.qos = qos
                known.subscription = self._subscribe(name, known, _message_class(known.type_name))

    def _start_topic(
        self, name: str, type_names: Sequence[str], publishers: Sequence[TopicEndpointInfo], qos: QoSProfile
    ) -> None:
        type_name = publishers[0].topic_type
        topic = self._topics[name] = _RecordedTopic(type_name, qos)
        if len(type_names) > 1:
            self.get_logger().warning(f"{name} has several types ({', '.join(type_names)}); only {type_name} is recorded")
        try:
            message_class = _message_class(type_name)
        except (ImportError, AttributeError):
            self.get_logger().warning(f"{name} is not recorded: {type_name} is not installed here")
            return
        if message_definition(type_name) is None:
            self.get_logger().warning(f"{name}: {type_name} is not part of ROS 2 Jazzy; recorded without its definition")
        self._writer.add_topic(name, type_name, [_offered(info.qos_profile) for info in publishers])
        topic.subscription = self._subscribe(name, topic, message_class)
        self.get_logger().info(f"recording {name} ({type_name})")

    def _subscribe(self, name: str, topic: _RecordedTopic, message_class: type) -> Subscription:
        def on_lost(event: Any) -> None:
            topic.lost += event.total_count_change

        callbacks = SubscriptionEventCallbacks(message_lost=on_lost)
        on_message = self._message_callback(name, topic.type_name)
        return self.create_subscription(message_class, name, on_message, topic.qos, event_callbacks=callbacks, raw=True)

    def _message_callback(self, name: str, type_name: str) -> Callable[[bytes], None]:
        write = self._writer.write_raw
        if self.get_parameter("use_sim_time").value:
            clock = self.get_clock()
            return lambda data: write(name, type_name, data, clock.now().nanoseconds)
        return lambda data: write(name, type_name, data, time.time_ns())

    # --- Running and stopping ---------------------------------------------------------------------------

    def _flush(self) -> None:
        """Bound what a kill can lose, also for topics that have fallen silent."""
        if self._closed:
            self.finished = True  # a period after closing, so that the answer of ~/stop is out
            return
        self._writer.flush()
        longest = self.get_parameter("max_duration").value
        if 0.0 < longest <= time.monotonic() - self._started:
            self.close()

    def _on_stop(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self.close()
        response.success = True
        response.message = f"recorded {sum(self._writer.counts.values())} messages to {self._writer.path}"
        return response

    def close(self) -> None:
        """Finish the recording and say what is in it."""
        if self._closed:
            return
        self._closed = True
        for topic in self._topics.values():
            if topic.subscription is not None:
                _take_what_waits(topic.subscription)
                self.destroy_subscription(topic.subscription)
        seconds = time.monotonic() - self._started
        self._writer.close()
        counts = self._writer.counts
        lines = [f"recorded {sum(counts.values())} messages in {seconds:.1f} s to {self._writer.path}"]
        for name, count in sorted(counts.items()):
            lost = self._topics[name].lost
            lines.append(f"  {name}: {count} messages" + (f", {lost} lost" if lost else ""))
        absent = [name for name in self._patterns if "*" not in name and name not in self._topics]
        if absent and not self._all:
            lines.append(f"  nobody published {', '.join(absent)}")
        print("\n".join(lines), flush=True)

    def _status(self) -> Status:
        now = time.monotonic()
        elapsed, self._reported = max(now - self._reported, 1e-9), now
        counts, values = self._writer.counts, {}
        lost = sum(topic.lost for topic in self._topics.values())
        values["messages"], values["lost"] = sum(counts.values()), lost
        for name, count in sorted(counts.items()):
            topic = self._topics[name]
            values[f"rate of {name} [Hz]"] = (count - topic.counted) / elapsed
            topic.counted = count
        if self._closed:
            return Status(OK, "finished", values)
        if lost:
            return Status(WARN, f"{lost} messages lost", values)
        return Status(OK, f"recording to {self._writer.path}", values)


def _take_what_waits(subscription: Subscription) -> None:
    """Hand over the messages that have arrived and that no executor will take any more."""
    with subscription.handle:
        for _ in range(QUEUE_DEPTH):
            taken = subscription.handle.take_message(subscription.msg_type, subscription.raw)
            if taken is None:
                return
            subscription.callback(taken[0])


def _message_class(type_name: str) -> type:
    """The class of e.g. "sensor_msgs/msg/JointState"."""
    package, kind, name = type_name.split("/")
    message_class: type = getattr(importlib.import_module(f"{package}.{kind}"), name)
    return message_class


def _qos_to_ask_for(publishers: Sequence[TopicEndpointInfo]) -> QoSProfile:
    """The most that every publisher offers: reliable if all are, latched samples if all keep them (as rosbag2 does)."""
    reliable = all(info.qos_profile.reliability == ReliabilityPolicy.RELIABLE for info in publishers)
    latched = all(info.qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL for info in publishers)
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=QUEUE_DEPTH,
        reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
    )


def _asks_for_less(new: QoSProfile, old: QoSProfile) -> bool:
    return (old.reliability == ReliabilityPolicy.RELIABLE != new.reliability) or (
        old.durability == DurabilityPolicy.TRANSIENT_LOCAL != new.durability
    )


def _offered(qos: QoSProfile) -> OfferedQos:
    """A publisher's QoS in rosbag2's words; history and depth are not known over DDS."""
    known_history = qos.history in (HistoryPolicy.KEEP_LAST, HistoryPolicy.KEEP_ALL)
    return OfferedQos(
        history=qos.history.name.lower() if known_history else "unknown",
        depth=qos.depth,
        reliability="best_effort" if qos.reliability == ReliabilityPolicy.BEST_EFFORT else "reliable",
        durability="transient_local" if qos.durability == DurabilityPolicy.TRANSIENT_LOCAL else "volatile",
    )


def main(args: Sequence[str] | None = None) -> int:
    """Run the node; its entry point."""
    return run_node(RecorderNode, args)


if __name__ == "__main__":
    raise SystemExit(main())
