"""What tests of nodes wait for, and for how long."""

import sys

import pytest

pytest.importorskip("rclpy")

from pcw_description.nodes.node_testing import RosTest  # noqa: E402
from pcw_description.nodes.node_tools import RUNNING, SETTING_UP  # noqa: E402

SLOW_NODE = f"""
import time
print("slow: {SETTING_UP}", flush=True)
time.sleep(1.5)
print("[slow]: {RUNNING}", flush=True)
time.sleep(60.0)
"""


def test_the_time_in_which_a_node_compiles_does_not_count():
    with RosTest() as ros:
        node = ros.run([sys.executable, "-c", SLOW_NODE])
        ros.wait_for(lambda: SETTING_UP in node.log)
        ros.wait_for(lambda: RUNNING in node.log, deadline=0.3)
        with pytest.raises(AssertionError, match=r"not within 0\.3 s\n(.*\n)*slow: still setting up"):
            ros.wait_for(lambda: False, deadline=0.3)
