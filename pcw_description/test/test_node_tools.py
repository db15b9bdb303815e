"""What every node shares: parameters that are refused with a reason, stamps, joint states without NaN, an orderly end."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

rclpy = pytest.importorskip("rclpy")

from rclpy.context import Context  # noqa: E402
from rclpy.node import Node  # noqa: E402
from rclpy.parameter import Parameter  # noqa: E402
from sensor_msgs.msg import JointState  # noqa: E402

from pcw_description.errors import PcwError  # noqa: E402
from pcw_description.nodes.node_tools import (  # noqa: E402
    Silence,
    StampWatch,
    all_declared,
    declare,
    fill_joint_state,
    joint_state_arrays,
    ns_to_stamp,
    stamp_to_ns,
)

DOMAIN = 1 + os.getpid() % 18  # below those of `RosTest`
DEADLINE = 60.0


@pytest.fixture(scope="module")
def context() -> Iterator[Context]:
    with pytest.MonkeyPatch.context() as environment:
        environment.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
        context = Context()
        rclpy.init(context=context, domain_id=DOMAIN)
        yield context
        rclpy.try_shutdown(context=context)


def make_node(context: Context, **overrides: object) -> Node:
    parameters = [Parameter(name, value=value) for name, value in overrides.items()]
    return Node("test_node_tools", context=context, parameter_overrides=parameters, start_parameter_services=False)


# --- Parameters -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "value", "reason"),
    [
        ("rate", 2000.0, "out of range"),
        ("rate", float("nan"), "out of range"),
        ("rate", 5, "Wrong parameter type"),
        ("free", float("inf"), "free: inf is not a finite number"),
        ("count", 9, "out of range"),
        ("mode", "fats", "mode: 'fats' is not known; did you mean 'fast'?"),
        ("gains", [1.0, 9.0], "gains: 9.0 is outside 0.0 .. 5.0 1/s"),
        ("gains", [1.0, float("nan")], "gains: nan is not a finite number"),
        ("even", 3, "even: 3 is odd"),
        ("fixed", 2.0, "read-only"),
    ],
)
def test_a_bad_value_is_refused_with_a_reason_and_the_old_one_stays(
    context: Context, name: str, value: object, reason: str
) -> None:
    node = make_node(context)
    declare(node, "rate", 100.0, "how often", unit="Hz", range=(1.0, 1000.0))
    declare(node, "free", 1.0, "any number")
    declare(node, "count", 3, "how many", range=(1, 5))
    declare(node, "mode", "slow", "how", choices=("slow", "fast"))
    declare(node, "gains", [1.0, 2.0], "gains", unit="1/s", range=(0.0, 5.0))
    declare(node, "even", 2, "an even number", check=lambda number: "3 is odd" if number % 2 else None)
    declare(node, "fixed", 1.0, "set once", read_only=True)
    before = node.get_parameter(name).value
    (result,) = node.set_parameters([Parameter(name, value=value)])
    assert not result.successful
    assert reason in result.reason
    assert node.get_parameter(name).value == before
    (result,) = node.set_parameters([Parameter("rate", value=200.0)])
    assert result.successful and node.get_parameter("rate").value == 200.0
    node.destroy_node()


def test_descriptors_say_unit_and_range(context: Context) -> None:
    node = make_node(context)
    declare(node, "rate", 100.0, "how often", unit="Hz", range=(1.0, 1000.0))
    declare(node, "mode", "slow", "how", choices=("slow", "fast"), read_only=True)
    rate, mode = node.describe_parameters(["rate", "mode"])
    assert rate.description == "how often [Hz]" and not rate.read_only
    assert (rate.floating_point_range[0].from_value, rate.floating_point_range[0].to_value) == (1.0, 1000.0)
    assert mode.additional_constraints == "one of slow, fast" and mode.read_only
    node.destroy_node()


def test_overrides_are_taken_or_refused_when_declared(context: Context) -> None:
    node = make_node(context, rate=50.0, names=["a"], mode="fats", count=1.0, far=9.0, whole=7)
    assert declare(node, "rate", 100.0, "how often") == 50.0
    assert declare(node, "names", Parameter.Type.STRING_ARRAY, "names") == ["a"]
    assert declare(node, "others", Parameter.Type.STRING_ARRAY, "names") == []
    with pytest.raises(PcwError, match="parameter mode: 'fats' is not known; did you mean 'fast'"):
        declare(node, "mode", "slow", "how", choices=("slow", "fast"))
    with pytest.raises(PcwError, match="parameter count: 1.0 is of type double; allowed: integer$"):
        declare(node, "count", 1, "how many")
    with pytest.raises(PcwError, match=r"parameter far: 9.0 is outside 0.0 .. 5.0 m$"):
        declare(node, "far", 1.0, "how far", "m", (0.0, 5.0))
    with pytest.raises(PcwError, match="parameter whole: 7 is of type integer; allowed: double; write 7.0$"):
        declare(node, "whole", 1.0, "a number")
    node.destroy_node()


# --- Stamps and joint states ----------------------------------------------------------------------------


@pytest.mark.parametrize("nanoseconds", [0, 1, 999_999_999, 1_000_000_000, 1_700_000_000_123_456_789, -1])
def test_stamps_are_exact_both_ways(nanoseconds: int) -> None:
    assert stamp_to_ns(ns_to_stamp(nanoseconds)) == nanoseconds


def test_a_stamp_watch_measures_and_counts() -> None:
    watch = StampWatch(longest_gap=0.5)
    steps = [watch.update(ns_to_stamp(int(t * 1e9))) for t in (1.0, 1.25, 1.25, 1.5, 1.0, 1.125, 3.0, 3.25)]
    assert steps == [None, 0.25, None, 0.25, None, 0.125, None, 0.25]
    assert (watch.repeats, watch.backward_jumps, watch.gaps) == (1, 1, 1)


def test_a_stamp_watch_leaves_out_what_was_of_no_use() -> None:
    watch = StampWatch(longest_gap=0.5)
    watch.update(ns_to_stamp(0))
    assert watch.update(ns_to_stamp(100_000_000)) == 0.1
    watch.take_back()
    assert watch.update(ns_to_stamp(300_000_000)) == pytest.approx(0.3)
    assert (watch.repeated, watch.last_gap) == (False, 0.0)
    watch.update(ns_to_stamp(300_000_000))
    assert watch.repeated
    assert watch.update(ns_to_stamp(2_300_000_000)) is None
    assert (watch.repeated, watch.last_gap) == (False, 2.0)


def test_silence_is_what_came_to_nobody_since_the_last_report() -> None:
    watch = StampWatch()
    silence = Silence(watch)
    assert silence.since_last_report()
    watch.update(ns_to_stamp(0))
    assert not silence.since_last_report()
    assert silence.since_last_report()


def test_joint_states_are_filled_in_order_and_nan_never_leaves() -> None:
    message = JointState(name=["a_drive", "a_steer", "b_drive", "b_steer"])
    position = np.array([[1.0, 2.0], [3.0, 4.0]])
    broken = np.array([[1.0, np.nan], [3.0, 4.0]])
    # a transposed array lies otherwise in memory, and must not come out otherwise
    assert fill_joint_state(message, position, broken, np.asfortranarray(position)) == ("velocity",)
    assert list(message.position) == [1.0, 2.0, 3.0, 4.0] == list(message.effort)
    assert list(message.velocity) == []
    assert fill_joint_state(message, effort=-position) == ()
    assert list(message.position) == [] and list(message.effort) == [-1.0, -2.0, -3.0, -4.0]
    with pytest.raises(PcwError, match="position: 3 values for 4 names"):
        fill_joint_state(message, [1.0, 2.0, 3.0])


def test_joint_states_are_read_by_name() -> None:
    message = JointState(name=["b_steer", "gripper", "a_drive"], position=[4.0, 9.0, 1.0], effort=[0.4, 0.9, 0.1])
    index = {"a_drive": 0, "a_steer": 1, "b_drive": 2, "b_steer": 3}
    position, velocity, effort = joint_state_arrays(message, index, (2, 2))
    np.testing.assert_array_equal(position, [[1.0, np.nan], [np.nan, 4.0]])
    np.testing.assert_array_equal(effort, [[0.1, np.nan], [np.nan, 0.4]])
    assert np.isnan(velocity).all()


# --- Running --------------------------------------------------------------------------------------------

PROGRAM = """
import gc
import inspect
import sys
import time
from pcw_description.errors import PcwError
from pcw_description.nodes import node_tools
from pcw_description.nodes.node_tools import all_declared, declare, run_node
from rclpy.node import Node
from std_msgs.msg import String

class Probe(Node):
    def __init__(self):
        super().__init__("probe")
        kind = declare(self, "kind", "runs", "what to do", choices=("runs", "slow", "ends", "breaks", "bad input"))
        declare(self, "speed", 1.0, "how fast", "m/s", (0.0, 2.0), read_only=True)
        all_declared(self)
        if kind == "slow":
            time.sleep(1.0)
        print("made", flush=True)
        self.finished = False
        self.words = self.create_publisher(String, "words", 10)
        if kind == "bad input":
            raise PcwError("robot.yaml: mass is negative")
        self.create_timer(0.01, lambda: self.work(kind))

    def work(self, kind):
        if kind == "breaks":
            raise RuntimeError("broken on purpose")
        if kind in ("ends", "slow"):
            self.finished = True
            print(gc.get_freeze_count(), len(gc.get_objects()), len(inspect.modulesbyfile), len(sys.modules))
        print("working", flush=True)

    def close(self):
        self.words.publish(String(data="last words"))
        print("closed", flush=True)

node_tools.PATIENCE = 0.1 if "kind:=slow" in sys.argv else 1e3  # [s]
sys.exit(run_node(Probe))
"""


def start_probe(*arguments: str, before: tuple[str, ...] = ()) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-c", PROGRAM, *before, "--ros-args", *arguments],
        env={**os.environ, "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST", "ROS_DOMAIN_ID": str(DOMAIN)},
        text=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        start_new_session=True,
        cwd=Path(__file__).parent,
    )


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_a_node_in_order(number: signal.Signals) -> None:
    """It can still publish in close(), and the exit code is 0; a Ctrl-C delivered twice changes nothing."""
    process = start_probe("-p", "knd:=typo")
    assert process.stdout is not None and process.stdout.readline() == "made\n" and process.stdout.readline() == "working\n"
    process.send_signal(number)
    process.send_signal(number)
    output, errors = process.communicate(timeout=DEADLINE)
    assert process.returncode == 0, errors
    assert output.endswith("closed\n")
    assert "Traceback" not in errors
    assert "parameter 'knd' is unknown to this node and ignored; did you mean 'kind'?" in errors


@pytest.mark.parametrize(
    ("kind", "code", "said", "closed"),
    [
        ("ends", 0, "", True),
        ("breaks", 1, "broken on purpose", True),
        ("bad input", 2, "robot.yaml: mass is negative\n", False),
    ],
)
def test_exit_codes(kind: str, code: int, said: str, closed: bool) -> None:
    process = start_probe("-p", f"kind:={kind}")
    output, errors = process.communicate(timeout=DEADLINE)
    assert process.returncode == code, errors
    assert said in errors
    assert ("Traceback" in errors) == (code == 1)
    assert output.endswith("closed\n") == closed


def test_a_node_says_that_it_runs_and_that_setting_up_takes_long() -> None:
    """The first start compiles for a minute, without a word, and a first Ctrl-C seemed to do nothing."""
    _, errors = start_probe("-p", "kind:=slow").communicate(timeout=DEADLINE)
    first, running = errors.splitlines()
    assert "still setting up: inner loops are compiled" in first and "a second Ctrl-C ends it at once" in first
    assert running.endswith("[probe]: running")


def test_nothing_that_can_be_done_before_is_done_in_the_middle_of_a_period() -> None:
    """What a node needs all its life is left out of garbage collections, and a first warning need not search all modules."""
    output, errors = start_probe("-p", "kind:=ends").communicate(timeout=DEADLINE)
    kept, collected, found, modules = map(int, output.split("\n")[1].split())
    assert kept > 20 * collected, errors
    assert found > 0.5 * modules


# --- The command line -----------------------------------------------------------------------------------


@pytest.mark.parametrize("argument", ["-h", "--help"])
def test_help_names_every_parameter_and_makes_no_node(argument: str) -> None:
    process = start_probe("-p", "kind:=breaks", before=(argument,))
    output, errors = process.communicate(timeout=DEADLINE)
    assert (process.returncode, errors) == (0, "")
    assert "made" not in output
    assert "--ros-args -p NAME:=VALUE" in output
    assert "  kind   string  default runs; one of runs, slow, ends, breaks, bad input\n                 what to do\n" in output
    assert "  speed  double  default 1.0 m/s; 0 to 2; fixed\n                 how fast\n" in output


@pytest.mark.parametrize(
    ("before", "after", "said"),
    [
        (("--kind", "ends"), (), "argument '--kind' is not allowed; did you mean --ros-args -p kind:=ends ?"),
        (("--kind=ends",), (), "argument '--kind=ends' is not allowed; did you mean --ros-args -p kind:=ends ?"),
        (("-p", "knd:=ends"), (), "argument '-p' is not allowed; did you mean --ros-args -p kind:=ends ?"),
        (("speed:=2",), (), "argument 'speed:=2' is not allowed; did you mean --ros-args -p speed:=2.0 ?"),
        (("words:=said",), (), "argument 'words:=said' is not allowed; did you mean --ros-args -r words:=said ?"),
        (("x",), (), "argument 'x' is not allowed; allowed: parameters, as --ros-args -p NAME:=VALUE; --help lists them"),
        ((), ("-p", "kind"), "arguments after --ros-args: "),
        ((), ("--kind",), "arguments after --ros-args: "),
        ((), ("--params-file", "is_not_there.yaml"), "is_not_there.yaml"),
        ((), ("-p", "kind:=bad"), "parameter kind: 'bad' is not known; did you mean 'bad input'?"),
    ],
)
def test_an_argument_that_is_none_is_refused_with_the_form_that_was_meant(
    before: tuple[str, ...], after: tuple[str, ...], said: str
) -> None:
    """They were ignored without a word, and those after --ros-args gave a traceback."""
    process = start_probe(*after, before=before)
    output, errors = process.communicate(timeout=DEADLINE)
    assert (process.returncode, output) == (2, ""), errors
    assert said in errors and errors.count("\n") == 1


def test_a_parameter_that_help_would_not_show_is_a_mistake(context: Context) -> None:
    node = make_node(context)
    all_declared(node)
    with pytest.raises(TypeError, match="'late' is declared after all_declared"):
        declare(node, "late", 1.0, "too late")
    node.destroy_node()
