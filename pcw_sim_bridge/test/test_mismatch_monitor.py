"""The mismatch monitor as a process over real DDS: it says what departs and where, keeps the last minutes, only listens."""

import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rclpy")

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus  # noqa: E402
from nav_msgs.msg import Odometry  # noqa: E402
from sensor_msgs.msg import Imu, JointState  # noqa: E402
from std_srvs.srv import Trigger  # noqa: E402

from pcw_control.excitation import make_excitation  # noqa: E402
from pcw_description import load_robot  # noqa: E402
from pcw_description.nodes.node_testing import NodeProcess, RosTest  # noqa: E402
from pcw_description.nodes.node_tools import SENSOR_STREAM_SOURCE, SETTING_UP, stamp_to_ns  # noqa: E402
from pcw_description.recording import Recording  # noqa: E402
from pcw_description.recording_files import RawMessage  # noqa: E402
from pcw_sim_bridge.mismatch.live.live_channels import LiveChannels, LiveParameters  # noqa: E402
from pcw_sim_bridge.mismatch.live.live_trials import (  # noqa: E402
    faults,
    judgements,
    messages,
    with_effects,
    within_tolerance,
)

MONITOR = "pcw_sim_bridge.nodes.mismatch_monitor"
THESIS = load_robot("thesis")
TYPES = {"joint_states": JointState, "joint_commands": JointState, "imu/data": Imu, "ground_truth/odom": Odometry}
LEARNING, FAULT_TIME, DURATION, CHIRPS_FROM = 8.0, 12.0, 15.0, 18.0  # [s]


@pytest.fixture(scope="module")
def sent() -> list[RawMessage]:
    """What a healthy robot sends in whose drive friction begins."""
    healthy = within_tolerance(THESIS, np.random.default_rng(5))
    faulty = with_effects(healthy, [faults(THESIS)[0].physics])
    twist = make_excitation("chirps", THESIS, 60.0).twist
    stages = [(healthy, FAULT_TIME), (faulty, DURATION)]
    return list(messages(THESIS, stages, lambda t: twist(t + CHIRPS_FROM), 3))


@pytest.fixture(scope="module")
def calibration(sent: list[RawMessage], tmp_path_factory: pytest.TempPathFactory) -> Path:
    live = LiveChannels(THESIS, LiveParameters(learning=LEARNING))
    for _, judgement, _ in judgements(live, iter(sent)):
        if judgement.ready:
            break
    path = tmp_path_factory.mktemp("monitor") / "calibration.json"
    assert live.tuning is not None
    live.tuning.save(path)
    return path


class Robot:
    """Publishes recorded messages in their order, several times faster than real time."""

    def __init__(self, ros: RosTest, sent: list[RawMessage]) -> None:
        self._waiting = iter(sent)
        self._publishers = {
            f"/{topic}": ros.peer.create_publisher(kind, topic, SENSOR_STREAM_SOURCE) for topic, kind in TYPES.items()
        }
        ros.wait_for(lambda: all(p.get_subscription_count() == 1 for p in self._publishers.values()))

    def send(self, count: int = 60) -> None:
        """Send the next messages; about 50 ms of them."""
        for _, message in zip(range(count), self._waiting, strict=False):
            self._publishers[message.topic].publish(bytes(message.cdr))


def after(sent: list[RawMessage], start: float) -> list[RawMessage]:
    return [message for message in sent if message.log_time_ns >= (start + 1.0) * 1e9]


def statuses(received: list[DiagnosticArray], name: str) -> list[DiagnosticStatus]:
    return [status for array in received for status in array.status if status.name == f"mismatch_monitor: {name}"]


def start(ros: RosTest, *parameters: str) -> NodeProcess:
    return ros.start(MONITOR, *(word for parameter in parameters for word in ("-p", parameter)))


def test_it_says_what_departs_and_where_and_keeps_it(sent: list[RawMessage], calibration: Path, tmp_path: Path) -> None:
    with RosTest() as ros:
        kept = tmp_path / "kept"
        node = start(
            ros, f"calibration:={calibration}", f"keep_folder:={kept}", "pre_roll:=3.0", "post_roll:=0.5", "rate:=8.0"
        )  # fmt: skip
        mismatch, diagnostics = ros.listen(JointState, "mismatch"), ros.listen(DiagnosticArray, "/diagnostics")
        robot = Robot(ros, after(sent, FAULT_TIME - 6.0))
        ros.wait_for(lambda: mismatch, while_doing=robot.send, every=0.03)
        told = f"looks most like {THESIS.caster_names[0]}: friction in the drive"

        def suspected() -> list[DiagnosticStatus]:
            # Where messages were lost or the robot has stopped sending, a later report may only warn of what departed.
            errors = [s for s in statuses(diagnostics, "mismatch") if s.level == DiagnosticStatus.ERROR]
            return [s for s in errors if told in s.message]

        [summary, *_] = ros.wait_for(suspected, while_doing=robot.send, every=0.03)
        assert "departs by" in summary.message
        values = {entry.key: entry.value for entry in summary.values}
        assert float(values["rate of joint_states [Hz]"]) > 100.0 and values["missing"] == "none"
        assert float(values["share_of_core"]) > 0.0
        wrench = [s for name in ("force/x", "force/y", "torque/z") for s in statuses(diagnostics, f"chassis_{name}")]
        assert {status.level for status in wrench} >= {DiagnosticStatus.OK, DiagnosticStatus.ERROR}
        assert {status.level for status in statuses(diagnostics, "gyro")} == {DiagnosticStatus.OK}

        ros.wait_for(lambda: "kept /" in node.log, while_doing=robot.send, every=0.03)
        assert node.interrupt() == 0
        [folder] = kept.iterdir()
        recording = Recording.open(folder, THESIS)
        assert recording.t0_ns * 1e-9 - 1.0 < FAULT_TIME < recording.t0_ns * 1e-9 - 1.0 + recording.duration
        assert recording.imu is not None and recording.joint_commands is not None

        assert set(mismatch[0].name) >= {
            "chassis_force/x", "chassis_force/y", "chassis_torque/z", "gyro", "accelerometer/x", "accelerometer/y", "pose/yaw",
        }  # fmt: skip
        stamps = np.array([stamp_to_ns(message.header.stamp) for message in mismatch]) * 1e-9 - 1.0
        worst = np.array([max(message.position) for message in mismatch])
        assert np.all(np.diff(stamps) > 0.0)
        assert np.all(worst[stamps < FAULT_TIME - 0.1] < 4.0) and (stamps < FAULT_TIME - 0.1).any()
        assert worst.max() > 8.0
        assert all(np.isfinite([*message.position, *message.effort]).all() and not message.velocity for message in mismatch)


def test_it_learns_saves_learns_again_and_only_listens(sent: list[RawMessage], tmp_path: Path) -> None:
    with RosTest() as ros:
        path = tmp_path / "calibration.json"
        node = start(ros, f"save_calibration:={path}", "learning:=5.0")
        diagnostics = ros.listen(DiagnosticArray, "/diagnostics")
        ros.wait_for(lambda: [s for s in statuses(diagnostics, "mismatch") if s.message == "waiting for joint_states"])
        robot = Robot(ros, sent)
        ros.wait_for(path.exists, while_doing=robot.send, every=0.03)
        ros.wait_for(lambda: statuses(diagnostics, "chassis_torque/z"), while_doing=robot.send, every=0.03)
        publishers = dict(ros.peer.get_publisher_names_and_types_by_node("mismatch_monitor", "/"))
        assert set(publishers) - {"/parameter_events", "/rosout"} == {"/mismatch", "/diagnostics"}
        answer = ros.call(Trigger, "mismatch_monitor/learn")
        assert answer.success and "5 s of motion" in answer.message
        diagnostics.clear()
        ros.wait_for(
            lambda: [s for s in statuses(diagnostics, "mismatch") if s.message.startswith("learning: ")],
            while_doing=robot.send, every=0.03,
        )  # fmt: skip
        assert node.interrupt() == 0


@pytest.mark.nightly
def test_after_an_installation_it_compiles_before_it_runs(sent: list[RawMessage], tmp_path: Path) -> None:
    """It compiled when it had learned, and neither said anything nor ended on SIGINT for as long."""
    pytest.importorskip("numba")
    with RosTest() as ros:
        ros.environment["NUMBA_CACHE_DIR"] = str(tmp_path)
        node = start(ros, "learning:=5.0")
        diagnostics = ros.listen(DiagnosticArray, "/diagnostics")
        ros.wait_for(lambda: statuses(diagnostics, "mismatch"))
        assert SETTING_UP in node.log
        robot, heard = Robot(ros, sent), [time.monotonic()]

        def send() -> None:
            robot.send()
            if diagnostics:
                heard.append(time.monotonic())
                told.extend(statuses(diagnostics, "chassis_torque/z"))
                diagnostics.clear()

        told: list[DiagnosticStatus] = []
        ros.wait_for(lambda: told, while_doing=send, every=0.03)
        assert max(np.diff(heard)) < 5.0
        assert node.interrupt(deadline=5.0) == 0 and "Traceback" not in node.log


@pytest.mark.parametrize(
    ("parameter", "reason"),
    [
        ("calibration:=/no/such.json", "/no/such.json cannot be read"),
        ("robot:=/no/such.yaml", "/no/such.yaml"),
        ("learning:=1.0", "learning: 1.0 is outside 5.0 .. 600.0 s"),
        ("error:=2.0", "error = 2"),
        ("pre_roll:=.nan", "pre_roll: nan is not a finite number"),
        (f"keep_folder:={__file__}", "is no folder"),
        ("save_calibration:=/no/such/folder/file.json", "there is no folder /no/such/folder"),
    ],
)
def test_bad_input_ends_it_with_one_line(parameter: str, reason: str) -> None:
    result = subprocess.run(
        [sys.executable, "-m", MONITOR, "--ros-args", "-p", parameter], capture_output=True, text=True, timeout=120
    )
    assert result.returncode == 2
    assert reason in result.stderr and "Traceback" not in result.stderr
