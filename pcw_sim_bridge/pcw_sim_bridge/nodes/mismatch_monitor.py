"""Watches a running robot for what its description does not hold: residual channels, diagnostics, and the last minutes kept.

It only listens: no command leaves this node.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from geometry_msgs.msg import TwistStamped
from nav_msgs.msg import Odometry
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from sensor_msgs.msg import Imu, JointState
from std_srvs.srv import Trigger

from pcw_description import PcwError, load_robot
from pcw_description.nodes.diagnostics import OK, WARN, Diagnostics, Problems, Status
from pcw_description.nodes.node_tools import SENSOR_SOURCE, SENSOR_STREAM, all_declared, declare, run_node
from pcw_description.ros_messages import IMU, JOINT_STATE, ODOMETRY, TWIST_STAMPED

from ..mismatch.live.departure_keeper import RANGES as KEEP_RANGES
from ..mismatch.live.departure_keeper import DepartureKeeper, KeepParameters
from ..mismatch.live.live_channels import RANGES as LIVE_RANGES
from ..mismatch.live.live_channels import Judgement, Level, LiveChannels, LiveParameters
from ..mismatch.live.live_tuning import Tuning
from .mismatch_messages import LEVELS, channel_statuses, departure_text, mismatch_message

# Topic -> message class, its name, and whether the channels are computed from it; the others are only kept.
TOPICS: Mapping[str, tuple[type, str, bool]] = {
    "joint_states": (JointState, JOINT_STATE, True),
    "joint_commands": (JointState, JOINT_STATE, True),
    "imu/data": (Imu, IMU, True),
    "ground_truth/odom": (Odometry, ODOMETRY, True),
    "odom": (Odometry, ODOMETRY, False),
    "cmd_vel": (TwistStamped, TWIST_STAMPED, False),
}
# Field of the dataclass, name of the parameter, meaning, unit.
Table = Sequence[tuple[str, str, str, str]]
LIVE_PARAMETERS: Table = (
    ("learning", "learning", "motion of a healthy robot to learn from", "s"),
    ("memory", "memory", "time constant with which healthy motion is forgotten", "s"),
    ("horizon", "horizon", "what is judged at once", "s"),
    ("warn", "warn", "deviations from which a channel warns", "1"),
    ("error", "error", "deviations from which a channel is an error", "1"),
)
KEEP_PARAMETERS: Table = (
    ("pre_roll", "pre_roll", "kept from before a departure", "s"),
    ("post_roll", "post_roll", "kept from after it", "s"),
    ("pause", "keep_pause", "at least between two recordings", "s"),
    ("most", "keep_most", "largest number of recordings", ""),
)


class MismatchMonitorNode(Node):
    """Takes messages without deserialising them, and judges what has come a few times a second."""

    def __init__(self) -> None:
        super().__init__("mismatch_monitor")
        self.robot = load_robot(declare(self, "robot", "thesis", "robot file, or the name of a shipped robot", read_only=True))
        rate = declare(self, "rate", 4.0, "how often it is judged, real time", "Hz", (0.5, 10.0), read_only=True)
        calibration = declare(self, "calibration", "", "calibration file to begin with, instead of learning", read_only=True)
        self._save_to = declare(
            self, "save_calibration", "", "calibration file to write when learning ends; none by default", read_only=True
        )
        parameters = LiveParameters(**self._declared(LIVE_PARAMETERS, LiveParameters(), LIVE_RANGES))
        self._keeper = self._make_keeper()
        tuning = Tuning.load(calibration, self.robot) if calibration else None
        self._live = LiveChannels(self.robot, parameters, tuning)
        self._live.warm_up()
        self._saved = bool(calibration)
        self._judgement: Judgement | None = None
        self._departed = ""  # what departed when there was last something to judge
        self._counts = dict.fromkeys(TOPICS, 0)
        self._reported = (time.monotonic(), time.process_time(), dict(self._counts))
        self._fresh = False  # joint_states since the last judgement
        self._problems = Problems(self)
        self._publisher = self.create_publisher(JointState, "mismatch", SENSOR_SOURCE)
        for topic, (message_class, type_name, judged) in TOPICS.items():
            if judged or self._keeper is not None:
                on_message = self._message_callback(topic, type_name)
                self.create_subscription(message_class, topic, on_message, SENSOR_STREAM, raw=True)
        self.create_service(Trigger, "~/learn", self._on_learn)
        # Real time: the stamps in the messages say how much there is to judge, whatever the pace of a simulation.
        self.create_timer(1.0 / rate, self._judge, clock=Clock(clock_type=ClockType.STEADY_TIME))
        self._diagnostics = Diagnostics(
            self, self.robot.name, self._status, aspect="mismatch", parts=lambda: channel_statuses(self._judgement)
        )

    def _declared(self, table: Table, defaults: object, ranges: Mapping[str, tuple[float, float]]) -> dict[str, Any]:
        """Declare the parameters of a table with the defaults of a dataclass; values by the dataclass's names."""
        return {
            field: declare(self, name, getattr(defaults, field), what, unit, ranges[field], read_only=True)
            for field, name, what, unit in table
        }

    def _make_keeper(self) -> DepartureKeeper | None:
        what = "folder for recordings of departures; none are kept by default"
        folder = declare(self, "keep_folder", "", what, read_only=True)
        parameters = KeepParameters(folder, **self._declared(KEEP_PARAMETERS, KeepParameters(folder), KEEP_RANGES))
        all_declared(self)
        # Told now, and not when something departs after hours, or when learning ends.
        if folder and Path(folder).exists() and not Path(folder).is_dir():
            raise PcwError(f"keep_folder {folder} is no folder; allowed: a folder, or a new one")
        if self._save_to and not Path(self._save_to).resolve().parent.is_dir():
            raise PcwError(f"save_calibration {self._save_to}: there is no folder {Path(self._save_to).resolve().parent}")
        return DepartureKeeper(parameters) if folder else None

    # --- Messages ---------------------------------------------------------------------------------------

    def _message_callback(self, topic: str, type_name: str) -> Callable[[bytes], None]:
        name, judged = f"/{topic}", TOPICS[topic][2]

        def on_message(cdr: bytes) -> None:
            self._counts[topic] += 1
            message = self._live.receive(name, type_name, cdr, judged)
            if message is not None and self._keeper is not None:
                self._keeper.receive(message)
            self._fresh = self._fresh or topic == "joint_states"

        return on_message

    def _on_learn(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self._live.learn_again()
        self._judgement, self._departed = None, ""
        response.success = True
        response.message = f"learning from the next {self._live.parameters.learning:g} s of motion"
        return response

    # --- Judging ----------------------------------------------------------------------------------------

    def _judge(self) -> None:
        if self._fresh:
            self._fresh = False
            before = _news(self._judgement)
            self._judgement = judgement = self._live.update()
            for problem in judgement.problems:
                self._problems.add(problem)
            if judgement.channels and judgement.stamp is not None:
                self._departed = "" if judgement.level is Level.OK else departure_text(judgement)
                self._publisher.publish(mismatch_message(judgement.channels, judgement.stamp))
            if judgement.ready and not self._saved:
                self._save()
            if _news(judgement) != before:
                self._diagnostics.report()
        self._keep()

    def _save(self) -> None:
        self._saved = True
        if self._save_to and self._live.tuning is not None:
            try:
                self._live.tuning.save(self._save_to)
                self.get_logger().info(f"calibration written to {self._save_to}")
            except PcwError as error:
                self._problems.add(str(error))

    def _keep(self) -> None:
        if self._keeper is None:
            return
        try:
            if self._judgement is not None and self._judgement.level is not Level.OK:
                begun = self._keeper.departs()
                if begun is not None:
                    self.get_logger().warning(f"{self._departed}; keeping {begun}")
            finished = self._keeper.work()
            if finished is not None:
                self.get_logger().info(f"kept {finished}")
        except PcwError as error:
            self._problems.add(str(error))

    def close(self) -> None:
        """Finish a recording in progress."""
        if self._keeper is not None:
            self._keeper.close()

    # --- Diagnostics ------------------------------------------------------------------------------------

    def _status(self) -> Status:
        now, before = (time.monotonic(), time.process_time(), dict(self._counts)), self._reported
        self._reported = now
        elapsed = max(now[0] - before[0], 1e-9)
        rates = {topic: (now[2][topic] - before[2][topic]) / elapsed for topic in TOPICS if TOPICS[topic][2]}
        values: dict[str, object] = {f"rate of {topic} [Hz]": value for topic, value in rates.items()}
        values["missing"] = ", ".join(topic for topic in rates if not self._counts[topic]) or "none"
        values["clock_restarts"] = self._live.restarts
        values["share_of_core"] = (now[1] - before[1]) / elapsed
        if self._keeper is not None:
            values["kept"] = len(self._keeper.kept)
        judgement, problems = self._judgement, self._problems.take()
        if judgement is not None:
            values["learned_motion"] = judgement.learned
        if self._live.tuning is not None:
            values["beyond_tolerance"] = "; ".join(self._live.tuning.beyond_tolerance()) or "none"
        if not rates["joint_states"]:
            text = "joint_states is silent" if self._counts["joint_states"] else "waiting for joint_states"
            return Status(WARN, text, values)
        if judgement is not None and judgement.level is not Level.OK:
            return Status(LEVELS[judgement.level], self._departed, values)
        if problems:
            return Status(WARN, problems, values)
        if judgement is None or not judgement.ready:
            learned = 0.0 if judgement is None else judgement.learned
            return Status(OK, f"learning: {learned:.0f} of {self._live.parameters.learning:g} s of motion", values)
        if judgement.channels:
            return Status(OK, "nothing departs", values)
        if self._departed:
            return Status(WARN, f"nothing to judge now; before: {self._departed}", values)
        return Status(OK, "standing still, or nothing to judge", values)


def _news(judgement: Judgement | None) -> tuple[Level, bool]:
    """What is said at once when it changes, and not only when the next report is due."""
    return (Level.OK, False) if judgement is None else (judgement.level, judgement.suspect is not None)


def main(args: Sequence[str] | None = None) -> int:
    """Run the node until it is told to stop."""
    return run_node(MismatchMonitorNode, args)


if __name__ == "__main__":
    raise SystemExit(main())
