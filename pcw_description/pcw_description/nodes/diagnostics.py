"""What a node says of itself on /diagnostics (REP-107)."""

from __future__ import annotations

import dataclasses
import math
import re
import time
from collections.abc import Callable, Mapping

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.clock import Clock, ClockType
from rclpy.node import Node

OK, WARN, ERROR, STALE = DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR, DiagnosticStatus.STALE


@dataclasses.dataclass(frozen=True)
class Status:
    """One statement: a level of REP-107, one line for people, and named numbers."""

    level: bytes
    message: str
    values: Mapping[str, object] = dataclasses.field(default_factory=dict)


# A number on its own: no part of a name, such as the 1 of wheel_1.
_NUMBER = re.compile(r"(?<![\w.])[-+]?(?:\d+\.?\d*(?:e[-+]?\d+)?|nan|inf)(?!\w)", re.IGNORECASE)


class Problems:
    """What went wrong since the last report: logged once, reported once, however often it happens.

    Texts that differ in nothing but their numbers are one problem, or a hundred measurements a second would be news each.
    """

    def __init__(self, node: Node) -> None:
        self._logger = node.get_logger()
        self._current: dict[str, str] = {}  # the newest text by what it says but for its numbers
        self._reported: dict[str, str] = {}

    def add(self, text: str) -> bool:
        """Note a problem; returns whether it is news."""
        kind = _NUMBER.sub("#", text)
        news = kind not in self._current and kind not in self._reported
        if news:
            self._logger.warning(text)
        self._current[kind] = text
        return news

    def take(self) -> str:
        """Return all problems since the last call as one line, "" when there were none."""
        self._reported, self._current = self._current, {}
        return "; ".join(self._reported.values())


# News are told so long after the report before at the earliest [s]: flags may come and go with every measurement.
NEWS_PERIOD = 0.25


class Diagnostics:
    """Publishes a node's status on demand, and regularly where there was no demand.

    Args:
        node: the node; its name and `aspect` name the status.
        hardware_id: what the status is about, such as the robot's name.
        status: asked for the status each time.
        parts: asked for the statuses of parts, by what follows the node's name; they go out in the same message.
        period: wall time between two reports [s]; wall time, because a status matters most when /clock has stopped.
    """

    def __init__(
        self, node: Node, hardware_id: str, status: Callable[[], Status], aspect: str = "status", period: float = 1.0,
        parts: Callable[[], Mapping[str, Status]] | None = None,
    ) -> None:  # fmt: skip
        self._node, self._status, self._parts = node, status, parts
        # Robots that share a domain share the topic.
        self._node_name = node.get_name() if node.get_namespace() == "/" else node.get_fully_qualified_name()
        self._name, self._hardware_id = f"{self._node_name}: {aspect}", hardware_id
        self._publisher = node.create_publisher(DiagnosticArray, "/diagnostics", 10)
        self._news, self._reported = False, -math.inf
        self._timer = node.create_timer(period, self.report, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def report_news(self, news: bool) -> None:
        """Say, as often as there is something to look at, whether it was news; they are published soon, and not too often."""
        self._news |= news
        if self._news and time.monotonic() >= self._reported + NEWS_PERIOD:
            self.report()

    def report(self) -> None:
        """Publish the status now."""
        # What is told "since the last report" needs time to happen.
        self._timer.reset()
        self._news, self._reported = False, time.monotonic()
        statuses = {self._name: self._status()}
        for name, part in (self._parts() if self._parts is not None else {}).items():
            statuses[f"{self._node_name}: {name}"] = part
        message = DiagnosticArray()
        message.header.stamp = self._node.get_clock().now().to_msg()
        message.status = [
            DiagnosticStatus(
                level=status.level, name=name, message=status.message, hardware_id=self._hardware_id,
                values=[KeyValue(key=key, value=_text(value)) for key, value in status.values.items()],
            )
            for name, status in statuses.items()
        ]
        self._publisher.publish(message)


def _text(value: object) -> str:
    return f"{value:.6g}" if isinstance(value, float) else str(value)
