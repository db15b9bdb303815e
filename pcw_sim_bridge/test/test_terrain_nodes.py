"""The terrain node with the real slip observer and a plant, as processes over real DDS: from torques to the ground."""

import dataclasses
import math

import numpy as np
import pytest

pytest.importorskip("rclpy")

from diagnostic_msgs.msg import DiagnosticArray  # noqa: E402
from sensor_msgs.msg import JointState  # noqa: E402

from pcw_description import load_robot  # noqa: E402
from pcw_description.nodes.node_testing import RosTest  # noqa: E402
from pcw_description.nodes.node_tools import stamp_to_ns  # noqa: E402
from pcw_description.robot_file import save_robot  # noqa: E402
from pcw_sim_bridge.split_friction import slippery  # noqa: E402

THESIS = load_robot("thesis")
NAMES = list(THESIS.joint_names)
MU, CRITICAL = 0.2, 0.1  # under the first wheel; all nodes believe in the robot file's 0.8 and 0.1
SPEED, PERIOD = 0.6, 1.0 / 500.0
PATIENCE = 180.0  # four processes hand 3500 readings round; beside as many others that took 46 s [s]


class SlippingDriver:
    """Answers every joint_states: drives along, and lets the first wheel slip to and fro beyond its peak where told to.

    It stands until observer and terrain are there, and answers a reading when the ground of that reading has been told: so
    the plant, in lock-step with the answers, runs no faster than the nodes on a computer that has other work. A node that
    lags behind loses readings, and after a gap the estimators begin anew.
    """

    def __init__(self, ros, slips=True):
        self.slips, self.count, self.reading, self.told = slips, 0, None, None
        ros.peer.create_subscription(JointState, "joint_states", self._read, 1000)
        ros.peer.create_subscription(JointState, "terrain/grip", self._hear, 1000)
        ros.peer.create_timer(0.5, self._answer_anyway)
        # Last: the bridge begins when somebody commands and somebody, not always this, hears.
        self.publisher = ros.peer.create_publisher(JointState, "joint_commands", 10)

    def _read(self, state):
        self.reading = state
        if self.told is None:
            self._answer(state, np.zeros((4, 2)))
        elif self.told == state.header.stamp:
            self._drive(state)

    def _hear(self, grip):
        self.told = grip.header.stamp
        if self.reading is not None and self.told == self.reading.header.stamp:
            self._drive(self.reading)

    def _answer_anyway(self):
        """Go on although nothing is told of the last reading: a lost one must not end the test."""
        if self.told is not None and self.reading is not None:
            self._drive(self.reading)

    def _drive(self, state):
        self.count += 1
        t = self.count * PERIOD
        rolls = SPEED * min(t / 2.0, 1.0)
        wanted = np.full(4, rolls)
        if self.slips and t > 2.5:
            wanted[0] = rolls * (1.0 + 0.2 * (1.0 - math.cos(5.0 * (t - 2.5))))
        position, velocity = np.reshape(state.position, (4, 2)), np.reshape(state.velocity, (4, 2))
        effort = np.zeros((4, 2))
        effort[:, 0] = np.clip(np.array([6.0, 3.0, 3.0, 3.0]) * (wanted / 0.075 - velocity[:, 0]), -10.0, 10.0)
        effort[:, 1] = np.clip(-40.0 * position[:, 1] - 2.0 * velocity[:, 1], -8.0, 8.0)
        self._answer(state, effort)

    def _answer(self, state, effort):
        self.reading = None
        message = JointState(name=NAMES, effort=effort.ravel().tolist())
        message.header.stamp = state.header.stamp
        self.publisher.publish(message)


@pytest.fixture
def nodes(tmp_path):
    """Bridge with ice under one wheel, in lock-step with the driver; observer and terrain as they are started."""
    save_robot(dataclasses.replace(THESIS, physics=(slippery(THESIS, ("front_left",), MU),)), tmp_path / "real.yaml")
    with RosTest() as ros:
        ros.start("pcw_estimation.nodes.slip_observer", "-p", "publish_rate:=500.0")
        ros.start("pcw_terrain.nodes.terrain", "-p", "publish_rate:=500.0")
        ros.start(
            "pcw_sim_bridge.nodes.bridge", "-p", f"robot:={tmp_path / 'real.yaml'}", "-p", "lockstep:=true",
            # Should the first joint_states reach the other nodes alone all the same.
            "-p", "real_time_factor:=1.0", "-p", "lockstep_timeout:=3.0",
        )  # fmt: skip
        yield ros


def finite(messages):
    return all(np.isfinite([*m.position, *m.velocity, *m.effort]).all() for m in messages)


def test_a_wheel_that_slips_tells_its_ground_and_the_others_say_nothing(nodes):
    """The wheel's own slip is known from the others, which grip; theirs is what the file says, and is not vouched for."""
    terrain, grip = nodes.listen(JointState, "terrain"), nodes.listen(JointState, "terrain/grip")
    driver = SlippingDriver(nodes)
    nodes.wait_for(lambda: terrain and "front_left" in terrain[-1].name and driver.count > 3500, deadline=PATIENCE)
    known = [m for m in terrain if list(m.name) == ["front_left"]]
    assert len(known) > 10 and all(set(m.name) <= {"front_left"} for m in terrain)
    assert known[-1].effort[0] == pytest.approx(MU, rel=0.06)
    assert known[-1].position[0] == pytest.approx(CRITICAL, rel=0.15)
    assert grip[-1].effort[0] < 0.5 * min(grip[-1].effort[1:])
    assert finite(terrain) and finite(grip) and all(list(m.name) == list(THESIS.caster_names) for m in grip)
    # Readings and slips are paired in the order of time; whether this test hears every slip is up to discovery.
    stamps = [stamp_to_ns(m.header.stamp) for m in terrain]
    assert stamps == sorted(set(stamps))


@pytest.mark.nightly  # three processes more
def test_a_robot_that_only_rolls_learns_nothing_of_its_ground(nodes):
    terrain, diagnostics = nodes.listen(JointState, "terrain"), nodes.listen(DiagnosticArray, "/diagnostics")
    driver = SlippingDriver(nodes, slips=False)
    nodes.wait_for(lambda: driver.count > 2000 and len(terrain) > 50, deadline=PATIENCE)
    assert all(len(m.name) == 0 for m in terrain)
    assert any("ground known under 0 of 4 casters" in s.message for d in diagnostics for s in d.status)
