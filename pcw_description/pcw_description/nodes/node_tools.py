"""What every PCW node shares: running it, its parameters, its stamps, its QoS and its JointStates.

A node's file needs no more than this:

    class OdometryNode(Node):
        def __init__(self) -> None:
            super().__init__("odometry")
            self._rate = declare(self, "rate", 100.0, "publishing rate", unit="Hz", range=(1.0, 1000.0))
            all_declared(self)                 # nothing is made before this, as `--help` comes so far
            self._odom = self.create_publisher(Odometry, "odom", SENSOR_SOURCE)

        def close(self) -> None:               # optional: last words while publishing still works
            self._commands.publish(zero_torque)
            wait_until_heard(self._commands)

    def main(args: list[str] | None = None) -> int:
        return run_node(OdometryNode, args)
"""

from __future__ import annotations

import array
import inspect
import math
import sys
import threading
import traceback
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager

import numpy as np
import rclpy
from builtin_interfaces.msg import Time
from numpy.typing import ArrayLike
from rclpy.duration import Duration
from rclpy.exceptions import ParameterException
from rclpy.executors import Executor, ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import remove_ros_args
from sensor_msgs.msg import JointState

from pcw_description.errors import PcwError
from pcw_description.one_thread import one_thread
from pcw_description.short_collections import short_collections
from pcw_description.stop_requests import stop_requests

from .node_help import help_text, refusal

# Declaring is what every node's file needs: it is to be had here with the rest.
from .node_parameters import all_declared as all_declared
from .node_parameters import declare as declare
from .node_parameters import says_all_declared, warn_of_unknown_overrides

try:
    from rclpy.experimental.events_executor import EventsExecutor
except ImportError:  # older Jazzy patch releases do not have it
    EventsExecutor = SingleThreadedExecutor

NANOSECONDS = 1_000_000_000
# A signal that arrives while the executor sleeps is seen when it wakes, so this is the latency of a shutdown.
SPIN_TIMEOUT = 0.1  # [s]
PATIENCE = 5.0  # after so long of setting up the node says what it is doing [s]
# What a node says where that is so, and once it has been set up.
SETTING_UP, RUNNING = "still setting up", "running"
LAST_WORDS = 1.0  # the longest that a node which ends waits for its listeners to hear them [s]


# --- Running --------------------------------------------------------------------------------------------


def run_node(factory: Callable[[], Node], args: Sequence[str] | None = None) -> int:
    """Make the node, spin it until a signal or a shutdown, close and destroy it. Returns the exit code.

    0 after SIGINT, SIGTERM or a shutdown from outside, and after `--help`; 2 with one line on stderr for bad input
    (`PcwError`, a refused parameter, an argument that ROS does not take); 1 with a traceback for anything else. A node
    that has an end of its own sets `finished`. A node's `close()` runs first of all, while it can still publish, also
    after an exception.
    """
    return run_nodes([factory], args)


def run_nodes(factories: Iterable[Callable[[], Node]], args: Sequence[str] | None = None) -> int:
    """As `run_node`, for several nodes in one process and one executor."""
    one_thread()
    factories, arguments = list(factories), list(sys.argv[1:] if args is None else args)
    exit_code = _answer_without_nodes(factories, arguments)
    if exit_code is not None:
        return exit_code
    # rclpy's own signal handlers invalidate the context at once, so that no last command (zero torque) could
    # be sent and no file be closed in order: ours only take a note.
    rclpy.init(args=arguments, signal_handler_options=SignalHandlerOptions.NO)
    nodes: list[Node] = []
    exit_code = 0
    with stop_requests() as stops:
        try:
            with _told_if_slow():
                for factory in factories:
                    nodes.append(factory())
                    if not says_all_declared(nodes[-1]):
                        raise TypeError(f"{type(nodes[-1]).__name__} does not say all_declared(self) after its parameters")
            warn_of_unknown_overrides(nodes)
            others = f": {', '.join(node.get_name() for node in nodes)}" if len(nodes) > 1 else ""
            nodes[0].get_logger().info(f"{RUNNING}{others}")
            _spin(nodes, stops)
        except (KeyboardInterrupt, ExternalShutdownException):
            pass
        except (PcwError, ParameterException) as error:
            print(f"{_program_name()}: {error}", file=sys.stderr)
            exit_code = 2
        except Exception:
            traceback.print_exc()
            exit_code = 1
        finally:
            for node in reversed(nodes):
                exit_code = max(exit_code, _close(node))
                node.destroy_node()
            rclpy.try_shutdown()
    return exit_code


def _answer_without_nodes(factories: Sequence[Callable[[], Node]], arguments: Sequence[str]) -> int | None:
    """Answer `--help` and arguments that nobody takes; None where the nodes are to be run."""
    if "-h" in arguments or "--help" in arguments:
        print(help_text(factories))
        return 0
    others = _outside_ros_args(arguments)
    if others:
        print(f"{_program_name()}: {refusal(others, factories)}", file=sys.stderr)
        return 2
    try:
        remove_ros_args(arguments)  # reads them all
    except RuntimeError as error:
        said = str(error).partition(", at /")[0]  # without the lines of the sources of ROS
        print(f"{_program_name()}: arguments after --ros-args: {said}; see --help", file=sys.stderr)
        return 2
    return None


@contextmanager
def _told_if_slow() -> Iterator[None]:
    """Say on stderr that it takes long to set up, as it does when inner loops are compiled: who waits may think it hangs."""
    said = f"{_program_name()}: {SETTING_UP}: inner loops are compiled the first time, for a minute or two"
    timer = threading.Timer(PATIENCE, lambda: print(f"{said}; a second Ctrl-C ends it at once", file=sys.stderr, flush=True))
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()


def _outside_ros_args(arguments: Sequence[str]) -> list[str]:
    """Return the arguments that are not between --ros-args and --; ROS still takes some of them, as it once did."""
    outside, ours = [], True
    for argument in arguments:
        if argument == "--ros-args":
            ours = False
        elif not ours and argument == "--":
            ours = True
        elif ours:
            outside.append(argument)
    return outside


def _spin(nodes: Sequence[Node], stops: Sequence[float]) -> None:
    executor = make_executor()
    try:
        for node in nodes:
            executor.add_node(node)
        _find_modules()
        short_collections()
        # EventsExecutor.spin() of Jazzy may spin without calling anything; spin_once() is sound.
        while rclpy.ok() and not stops and not _all_finished(nodes):
            executor.spin_once(timeout_sec=SPIN_TIMEOUT)
    finally:
        executor.shutdown()


def _find_modules() -> None:
    """Let the first line of a log find its caller as fast as the next, and not look through all modules for 40 ms.

    A warning is written in the middle of a period, and just when something is amiss.
    """
    inspect.getframeinfo(inspect.currentframe())  # type: ignore[arg-type]


def _all_finished(nodes: Sequence[Node]) -> bool:
    """Whether every node says that it has nothing left to do, by an attribute `finished`."""
    return all(getattr(node, "finished", False) for node in nodes)


def make_executor() -> Executor:
    """An EventsExecutor (at most half the cost) where this Jazzy has it, else a SingleThreadedExecutor."""
    return EventsExecutor()


def _close(node: Node) -> int:
    close = getattr(node, "close", None)
    if close is None:
        return 0
    try:
        close()
    except PcwError as error:
        print(f"{_program_name()}: {error}", file=sys.stderr)
        return 2
    except Exception:
        traceback.print_exc()
        return 1
    return 0


def wait_until_heard(publisher: Publisher) -> None:
    """Wait until all reliable listeners have what was published last, else it is lost now and then as the node goes."""
    publisher.wait_for_all_acked(Duration(seconds=LAST_WORDS))


def _program_name() -> str:
    return sys.argv[0].rsplit("/", 1)[-1].removesuffix(".py") or "node"


# --- Stamps ---------------------------------------------------------------------------------------------


def stamp_to_ns(stamp: Time) -> int:
    """Nanoseconds of a header stamp."""
    return int(stamp.sec) * NANOSECONDS + int(stamp.nanosec)


def ns_to_stamp(nanoseconds: int) -> Time:
    """Header stamp of a time in nanoseconds."""
    seconds, rest = divmod(int(nanoseconds), NANOSECONDS)
    return Time(sec=seconds, nanosec=rest)


class StampWatch:
    """Measures dt between the stamps of one stream and counts what is wrong with them."""

    def __init__(self, longest_gap: float = 0.5) -> None:
        self.longest_gap = longest_gap
        self.repeats = 0
        self.backward_jumps = 0
        self.gaps = 0
        self.count = 0
        self.repeated = False
        self.last_gap = 0.0  # [s]; the gap that the last stamp ended, 0 where it ended none
        self.last_ns: int | None = None  # that the next dt is measured from [ns]
        self._before_ns: int | None = None

    def update(self, stamp: Time) -> float | None:
        """Return dt [s] since the stamp before, or None where there is no dt to compute with.

        None for the first stamp, a repeated stamp (`repeated` says so), a jump back, and a gap longer than
        `longest_gap` [s]; the next dt is measured from this stamp.
        """
        now_ns = stamp_to_ns(stamp)
        self._before_ns = last_ns = self.last_ns
        self.last_ns = now_ns
        self.count += 1
        self.repeated, self.last_gap = now_ns == last_ns, 0.0
        if last_ns is None:
            return None
        dt = (now_ns - last_ns) * 1e-9
        if dt == 0.0:
            self.repeats += 1
        elif dt < 0.0:
            self.backward_jumps += 1
        elif dt > self.longest_gap:
            self.gaps += 1
            self.last_gap = dt
        else:
            return dt
        return None

    def take_back(self) -> None:
        """Say that the message of the last stamp was of no use: the next dt is measured from the stamp before."""
        self.last_ns = self._before_ns


class Silence:
    """Says whether a stream went silent between two reports."""

    def __init__(self, watch: StampWatch) -> None:
        self._watch, self._count = watch, 0

    def since_last_report(self) -> bool:
        """Whether nothing has come since the last call."""
        silent, self._count = self._watch.count == self._count, self._watch.count
        return silent


class Decimator:
    """Says when a message is due at a lower rate than the one at which data come, without drift of the mean rate."""

    def __init__(self, rate: float) -> None:
        self._period = 1.0 / rate
        self._elapsed = 0.0

    def due(self, dt: float) -> bool:
        """Whether, `dt` [s] after the call before, a message is due; of several missed ones only one is."""
        self._elapsed += dt
        if self._elapsed < self._period - 1e-6:  # stamps are whole nanoseconds, their differences are not
            return False
        self._elapsed = min(self._elapsed - self._period, self._period)
        return True


# --- Quality of service ---------------------------------------------------------------------------------


def _profile(reliability: ReliabilityPolicy, durability: DurabilityPolicy, depth: int) -> QoSProfile:
    return QoSProfile(
        reliability=reliability, durability=durability, history=HistoryPolicy.KEEP_LAST, depth=depth
    )


# REP-2003: who reads a sensor does not insist on old samples; who sends one offers reliable delivery, so that
# both kinds of reader connect.
SENSOR = _profile(ReliabilityPolicy.BEST_EFFORT, DurabilityPolicy.VOLATILE, 10)
SENSOR_SOURCE = _profile(ReliabilityPolicy.RELIABLE, DurabilityPolicy.VOLATILE, 10)
# Who integrates wants every sample, after a hiccup too: two seconds of them at 500 Hz; who feeds a recorder keeps as many.
SENSOR_STREAM = _profile(ReliabilityPolicy.BEST_EFFORT, DurabilityPolicy.VOLATILE, 1000)
SENSOR_STREAM_SOURCE = _profile(ReliabilityPolicy.RELIABLE, DurabilityPolicy.VOLATILE, 1000)
# Only the newest command counts.
COMMAND = _profile(ReliabilityPolicy.RELIABLE, DurabilityPolicy.VOLATILE, 1)
# The newest is what a receiver takes; a recorder that was busy may still fetch those before.
COMMAND_SOURCE = _profile(ReliabilityPolicy.RELIABLE, DurabilityPolicy.VOLATILE, 1000)
# Late joiners get the last sample (maps, descriptions, static facts).
LATCHED = _profile(ReliabilityPolicy.RELIABLE, DurabilityPolicy.TRANSIENT_LOCAL, 1)


# --- Joint states ---------------------------------------------------------------------------------------


def fill_joint_state(
    message: JointState,
    position: ArrayLike | None = None,
    velocity: ArrayLike | None = None,
    effort: ArrayLike | None = None,
) -> tuple[str, ...]:
    """Fill the three fields from (n, 2) or (2n,) arrays in the order of `message.name`.

    Names and stamp are the caller's. NaN never leaves a node: a field that holds a value that is not finite
    is left empty. Returns the names of the fields left out for that reason, () when all is well. PcwError
    when a length differs from the names.
    """
    refused = []
    for field, values in (("position", position), ("velocity", velocity), ("effort", effort)):
        if values is None:
            setattr(message, field, [])
            continue
        flat = np.asarray(values, dtype=np.float64)
        if flat.size != len(message.name):
            raise PcwError(f"JointState {field}: {flat.size} values for {len(message.name)} names")
        if not np.isfinite(flat).all():
            refused.append(field)
            setattr(message, field, [])
            continue
        # array.array passes the message's type check as a whole, a list would be checked value by value
        setattr(message, field, array.array("d", flat.tobytes()))
    return tuple(refused)


def joint_state_arrays(
    message: JointState, joint_index: Mapping[str, int], shape: tuple[int, ...]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Position, velocity and effort of a message as arrays of `shape`, e.g. (n, 2); NaN where not sent.

    `joint_index` maps a joint's name to its place in the flattened array: {name: i for i, name in
    enumerate(robot.joint_names)}. Joints that are not in it are skipped.
    """
    count = math.prod(shape)
    arrays = []
    for values in (message.position, message.velocity, message.effort):
        flat = np.full(count, np.nan)
        for name, value in zip(message.name, values):  # noqa: B905 - an empty or short field is legal
            index = joint_index.get(name)
            if index is not None:
                flat[index] = value
        arrays.append(flat.reshape(shape))
    return arrays[0], arrays[1], arrays[2]
