"""Several nodes in one process."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("rclpy")

from geometry_msgs.msg import TwistStamped  # noqa: E402
from nav_msgs.msg import Odometry  # noqa: E402
from sensor_msgs.msg import JointState  # noqa: E402

from pcw_bringup_scripts.compose import NODES, node_factories  # noqa: E402
from pcw_description import load_robot  # noqa: E402
from pcw_description.nodes.node_testing import RosTest  # noqa: E402
from pcw_description.recording import Recording  # noqa: E402

COMPOSE = [sys.executable, "-m", "pcw_bringup_scripts.compose"]


def test_every_name_leads_to_a_node():
    for name in NODES:
        [factory] = node_factories([name])
        assert factory.__name__ == NODES[name][1]


def test_readme_names_every_node_that_can_be_composed():
    readme = (Path(__file__).resolve().parents[1] / "README.md").read_text(encoding="utf-8")
    [sentence] = re.findall(r"It composes (.*?), each at most", readme, flags=re.DOTALL)
    assert re.findall(r"`(\w+)`", sentence) == sorted(NODES)


def test_a_whole_robot_drives_and_is_recorded_in_one_process(tmp_path):
    with RosTest() as ros:
        process = ros.run(
            [
                *COMPOSE, "bridge", "computed_torque", "odometry", "encoder_slip", "recorder", "--ros-args",
                "-p", "bridge:real_time_factor:=0.0", "-p", "bridge:lockstep:=true", "-p", "robot:=thesis",
                "-p", f"recorder:output:={tmp_path / 'run'}",
            ]
        )  # fmt: skip
        cmd_vel = ros.peer.create_publisher(TwistStamped, "cmd_vel", 1)
        odom, slip = ros.listen(Odometry, "odom"), ros.listen(JointState, "slip/encoder")
        truth = ros.listen(Odometry, "ground_truth/odom")
        command = TwistStamped()
        command.twist.linear.x = 0.4
        ros.wait_for(
            lambda: truth and odom and slip and truth[-1].pose.pose.position.x > 0.2,
            while_doing=lambda: cmd_vel.publish(command), every=0.05,
        )  # fmt: skip
        assert {"bridge", "computed_torque", "odometry", "encoder_slip", "recorder"} <= set(ros.peer.get_node_names())
        assert odom[-1].pose.pose.position.x == pytest.approx(truth[-1].pose.pose.position.x, abs=0.05)
        assert process.interrupt() == 0
    recording = Recording.open(tmp_path / "run", robot=load_robot("thesis"))
    assert recording.joint_states.position.shape[1:] == (4, 2)
    assert recording.odom is not None and recording.cmd_vel is not None and recording.ground_truth is not None


@pytest.mark.parametrize(
    ("arguments", "code", "said"),
    [
        (["brigde"], 2, "did you mean 'bridge'?"),
        (["bridge", "bridge"], 2, "given twice"),
        ([], 2, "Nodes: bridge"),
        (["--help"], 0, "Nodes: bridge"),
        (["odometry", "--ros-args", "-p", "robot:=/no/such.yaml"], 2, "/no/such.yaml"),
    ],
)
def test_says_what_it_can_do_and_what_is_wrong(arguments, code, said):
    done = subprocess.run([*COMPOSE, *arguments], capture_output=True, text=True, timeout=120)
    assert done.returncode == code
    assert said in done.stdout + done.stderr
    assert "Traceback" not in done.stderr
