"""Whether a node keeps up with joint_states when all nodes of a robot run in one process; measured, never asserted.

    ros2 run pcw_bringup_scripts composed_rate [NODE ...] [--topic terrain] [--robot ROBOT] [--duration 20]

The nodes, by default bridge, controller and everything between them and the topic, run as `compose` runs them: the bridge in
real time, a simulated robot that drives a circle, and every node between joint_states and the topic publishing at the rate of
joint_states. This process listens and counts: the rate of both topics in the time of this computer, the part of joint_states
that was answered, and the time from a joint_states to the answer with the same stamp, as both arrive here.
"""

from __future__ import annotations

import argparse
import os
import struct
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from geometry_msgs.msg import TwistStamped
from nav_msgs.msg import Odometry
from sensor_msgs.msg import JointState

from pcw_description.errors import PcwError
from pcw_description.nodes.node_testing import RosTest
from pcw_description.nodes.node_tools import SENSOR_STREAM
from pcw_description.robot_file import load_robot

from .compose import NODES

DEFAULT_NODES = ("bridge", "computed_torque", "odometry", "slip_observer", "terrain")
# Nodes whose output comes at a `publish_rate` of their own; odometry counts only where it is what is asked for.
THINNED = ("encoder_slip", "imu_slip", "odometry", "slip_fusion", "slip_observer", "terrain")
TYPES = {"odom": Odometry}  # of topics; JointState otherwise
TWIST = (0.3, 0.0, 0.3)  # what the robot drives [m/s, m/s, rad/s]
FIRST_START = 300.0  # a new installation compiles before it answers [s]
SETTLED = 3.0  # before anything is counted [s]


class Arrivals:
    """When the messages of a topic arrived, by stamp, without unpacking them."""

    def __init__(self, ros: RosTest, message_type: type, topic: str) -> None:
        self.at: dict[int, float] = {}
        ros.peer.create_subscription(message_type, topic, self._on_message, SENSOR_STREAM, raw=True)

    def _on_message(self, data: bytes) -> None:
        # CDR: four bytes that say how it is packed, then the header's stamp.
        seconds, nanoseconds = struct.unpack_from("<iI" if data[1] else ">iI", data, 4)
        self.at.setdefault(seconds * 1_000_000_000 + nanoseconds, time.perf_counter())


def cpu_time(process: int) -> float:
    """Return the CPU time of a process so far [s], NaN where the system does not tell."""
    try:
        fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return float("nan")
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def measure(nodes: Sequence[str], topic: str, robot: str, duration: float) -> str:
    """Run the nodes and return what was counted, in words."""
    rate = load_robot(robot).sensors.encoders.rate
    arguments = [*nodes, "--ros-args", "-p", f"robot:={robot}", "-p", "bridge:real_time_factor:=1.0"]
    for name in nodes:
        if name in THINNED and (name != "odometry" or topic == "odom"):
            arguments += ["-p", f"{name}:publish_rate:={rate}"]
    with RosTest() as ros:
        process = ros.run([sys.executable, "-m", "pcw_bringup_scripts.compose", *arguments])
        asked, answered = Arrivals(ros, JointState, "joint_states"), Arrivals(ros, TYPES.get(topic, JointState), topic)
        cmd_vel = ros.peer.create_publisher(TwistStamped, "cmd_vel", 1)
        command = TwistStamped()
        command.twist.linear.x, command.twist.linear.y, command.twist.angular.z = TWIST
        ros.wait_for(lambda: answered.at, FIRST_START, while_doing=lambda: cmd_vel.publish(command), every=0.05)
        ros.spin_for(SETTLED, lambda: cmd_vel.publish(command), every=0.05)
        first, started, spent = max(asked.at), time.perf_counter(), cpu_time(process.process.pid)
        ros.spin_for(duration, lambda: cmd_vel.publish(command), every=0.05)
        last, elapsed, spent = max(asked.at), time.perf_counter() - started, cpu_time(process.process.pid) - spent
        ros.spin_for(0.2)  # the answer to the last
        load = os.getloadavg()[0] if hasattr(os, "getloadavg") else float("nan")
    stamps = [stamp for stamp in asked.at if first < stamp <= last]
    late = np.array([answered.at[stamp] - asked.at[stamp] for stamp in stamps if stamp in answered.at])
    count, expected = len(stamps), round(rate * (last - first) * 1e-9)
    lines = [
        f"composed in one process: {', '.join(nodes)}; robot {robot}, encoders at {rate:g} Hz, {elapsed:.1f} s",
        f"joint_states  {count / elapsed:8.1f} Hz   {expected - count} of {expected} lost",
        f"{topic:<12}  {len(late) / elapsed:8.1f} Hz   {count - len(late)} of {count} not answered",
    ]
    if len(late):
        p50, p99, most = np.quantile(late, [0.5, 0.99, 1.0]) * 1e3
        lines.append(f"joint_states to {topic}: median {p50:.2f} ms, 99 % {p99:.2f} ms, longest {most:.2f} ms")
    lines.append(f"CPU of the process {100.0 * spent / elapsed:.0f} % of a core; load average of the computer {load:.1f}")
    held = count >= 0.99 * rate * elapsed and len(late) >= 0.99 * count
    lines.append(f"{rate:g} Hz {'held' if held else 'NOT held'}: at least 99 % of the readings came in time and were answered")
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure and print; exit 0 whatever the figures, 2 for bad input."""
    parser = argparse.ArgumentParser(prog="composed_rate", description=str(__doc__).partition("\n")[0])
    parser.add_argument("nodes", nargs="*", default=list(DEFAULT_NODES), metavar="NODE", help="nodes to compose")
    parser.add_argument("--topic", default="terrain", help="what answers joint_states (default: %(default)s)")
    parser.add_argument("--robot", default="thesis", help="shipped robot or path of a robot file (default: %(default)s)")
    parser.add_argument("--duration", type=float, default=20.0, help="of the measurement [s] (default: %(default)s)")
    options = parser.parse_args(arguments)
    unknown = [name for name in options.nodes if name not in NODES]
    if unknown or "bridge" not in options.nodes:
        parser.error(f"nodes {options.nodes} are not allowed; allowed: bridge and any of {', '.join(NODES)}")
    if not 1.0 <= options.duration <= 3600.0:
        parser.error(f"argument --duration: {options.duration} is not allowed; allowed: 1 to 3600")
    try:
        print(measure(options.nodes, options.topic, options.robot, options.duration))
    except PcwError as error:
        parser.error(str(error))
    except AssertionError as error:  # the nodes never answered, and said why
        print(f"composed_rate: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
