"""The markers node as a process over real DDS: what a viewer gets to see of forces, slip and ground patches."""

import math
import os
import subprocess
import sys

import numpy as np
import pytest
import yaml

pytest.importorskip("rclpy")

from diagnostic_msgs.msg import DiagnosticArray  # noqa: E402
from geometry_msgs.msg import WrenchStamped  # noqa: E402
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue  # noqa: E402
from rcl_interfaces.srv import SetParameters  # noqa: E402
from sensor_msgs.msg import JointState  # noqa: E402
from visualization_msgs.msg import Marker, MarkerArray  # noqa: E402

from pcw_description import load_robot, save_robot  # noqa: E402
from pcw_description.nodes.node_testing import RosTest  # noqa: E402
from pcw_description.nodes.node_tools import ns_to_stamp, stamp_to_ns  # noqa: E402
from pcw_sim_bridge.wheel_arrows import contact_point  # noqa: E402

MARKERS = "pcw_sim_bridge.nodes.markers"
THESIS = load_robot("thesis")
SLIP_NAMES = [f"{caster}_{direction}" for caster in THESIS.caster_names for direction in ("longitudinal", "lateral")]
ARROWS = {"contact_force", "vertical_load", "slip_velocity"}
PATCH = {"x": 2.0, "y": -1.0, "length": 1.5, "width": 0.5, "yaw": 0.2, "roundness": 1.0, "factor": 0.3}
# An effect of another package, so that the node is shown to know no effect by its name.
EFFECT = """
from pcw_description.effects.effect import Effect, EffectParameter

EFFECT = Effect(
    name="test_ice", target_kind="caster", axis="drive", summary="ice", sentence="ice under {target}", sensors=(),
    parameters=tuple(EffectParameter(name, "1", name, -10.0, 10.0, 1.0) for name in %r),
)
"""


@pytest.fixture
def ros():
    with RosTest() as ros:
        yield ros


class Wheels:
    """Publishes the contact force of front_right and the slip of all wheels, each at a time of its own."""

    def __init__(self, ros):
        self.ros, self.force, self.slip = ros, [60.0, -80.0, 200.0], np.zeros(8)
        self.slip[4:6] = 0.1, -0.05  # rear_left
        self.contact = ros.peer.create_publisher(WrenchStamped, "contact/front_right/wrench", 10)
        self.encoder = ros.peer.create_publisher(JointState, "slip/encoder", 10)
        self.markers = ros.listen(MarkerArray, "markers")

    def publish(self):
        wrench = WrenchStamped()
        wrench.header.stamp, wrench.header.frame_id = ns_to_stamp(5_000_000_000), "front_right_fork"
        wrench.wrench.force.x, wrench.wrench.force.y, wrench.wrench.force.z = self.force
        self.contact.publish(wrench)
        slip = JointState(name=SLIP_NAMES, velocity=self.slip.tolist())
        slip.header.stamp = ns_to_stamp(6_000_000_000)
        self.encoder.publish(slip)

    def all(self):
        return [marker for message in self.markers for marker in message.markers]

    def wait_for(self, condition):
        """Wait for an array that fulfils the condition, with the kinds of its markers as names."""

        def found():
            for message in self.markers:
                by_kind = {marker.ns: marker for marker in message.markers}
                if condition(by_kind):
                    return by_kind
            return None

        return self.ros.wait_for(found, while_doing=self.publish)


def vector(marker):
    start, end = ([point.x, point.y, point.z] for point in marker.points)
    return np.array(start), np.array(end) - start


def set_parameter(ros, name, value):
    number = ParameterValue(type=ParameterType.PARAMETER_DOUBLE, double_value=value)
    request = SetParameters.Request(parameters=[Parameter(name=name, value=number)])
    [result] = ros.call(SetParameters, "markers/set_parameters", request).results
    return result.successful


def test_arrows_of_force_load_and_slip_until_the_measurements_end(ros):
    node = ros.start(MARKERS, "-p", "force_scale:=0.004", "-p", "slip_scale:=3.0", "-p", "lifetime:=0.25")
    wheels = Wheels(ros)
    seen = wheels.wait_for(lambda by_kind: by_kind.keys() == ARROWS)

    contact, load, slip = seen["contact_force"], seen["vertical_load"], seen["slip_velocity"]
    for marker, caster, seconds in ((contact, "front_right", 5), (load, "front_right", 5), (slip, "rear_left", 6)):
        assert (marker.header.frame_id, stamp_to_ns(marker.header.stamp)) == (f"{caster}_fork", seconds * 1_000_000_000)
        assert (marker.type, marker.action, marker.id) == (Marker.ARROW, Marker.ADD, THESIS.caster_index(caster))
        assert marker.lifetime.sec == 0 and marker.lifetime.nanosec == 250_000_000
        assert marker.color.a > 0.0 and marker.scale.x > 0.0 and marker.pose.orientation.w == 1.0
        assert 0.0 < marker.scale.z < np.linalg.norm(vector(marker)[1])  # the head ends where the arrow does
    for marker, expected in ((contact, [0.24, -0.32, 0.0]), (load, [0.0, 0.0, 0.8])):
        start, along = vector(marker)
        np.testing.assert_allclose(start, contact_point(THESIS, 1))
        np.testing.assert_allclose(along, expected)
    np.testing.assert_allclose(vector(slip)[1], [0.3, -0.15, 0.0])
    assert {marker.id for marker in wheels.all() if marker.ns == "slip_velocity"} == {2}  # no arrow where nothing slips

    # Nothing is measured any more: nothing is drawn again, and the lifetime takes away what is there.
    ros.spin_for(1.0)
    drawn = len(wheels.markers)
    ros.spin_for(1.0)
    assert len(wheels.markers) == drawn
    assert node.interrupt() == 0


def test_scales_change_while_it_runs_and_a_bad_one_is_refused(ros):
    ros.start(MARKERS)
    wheels = Wheels(ros)
    wheels.wait_for(lambda by_kind: by_kind.keys() == ARROWS)
    assert not set_parameter(ros, "force_scale", 0.0) and not set_parameter(ros, "force_scale", math.nan)
    assert set_parameter(ros, "force_scale", 0.01)
    wheels.markers.clear()
    wheels.wait_for(lambda by_kind: "vertical_load" in by_kind and math.isclose(vector(by_kind["vertical_load"])[1][2], 2.0))


def test_what_is_no_number_is_not_drawn_but_said(ros):
    ros.start(MARKERS)
    wheels, diagnostics = Wheels(ros), ros.listen(DiagnosticArray, "/diagnostics")
    wheels.force[0] = math.nan
    wheels.slip[0] = math.inf
    wheels.wait_for(lambda by_kind: "slip_velocity" in by_kind)
    said = lambda: " ".join(s.message for d in diagnostics for s in d.status)  # noqa: E731
    for quantity in ("contact force of front_right", "slip velocity of front_left"):
        ros.wait_for(lambda: quantity in said(), while_doing=wheels.publish)  # noqa: B023
    everything = wheels.all()
    assert {(marker.ns, marker.id) for marker in everything} == {("slip_velocity", 2)}  # the others go on
    assert all(np.isfinite([*vector(marker)[0], *vector(marker)[1]]).all() for marker in everything)


def test_ground_patches_are_sent_to_whoever_comes_late(ros, tmp_path):
    (tmp_path / "test_ice_effect.py").write_text(EFFECT % (tuple(PATCH),))
    (tmp_path / "test_ice-1.0.dist-info").mkdir()
    (tmp_path / "test_ice-1.0.dist-info/METADATA").write_text("Metadata-Version: 2.1\nName: test-ice\nVersion: 1.0\n")
    (tmp_path / "test_ice-1.0.dist-info/entry_points.txt").write_text(
        "[pcw_description.effects]\ntest_ice = test_ice_effect:EFFECT\n"
    )
    save_robot(THESIS, tmp_path / "nominal.yaml")
    description = yaml.safe_load((tmp_path / "nominal.yaml").read_text())
    description["physics"] = [{"name": "test_ice", **PATCH}]
    (tmp_path / "icy.yaml").write_text(yaml.safe_dump(description))
    ros.environment["PYTHONPATH"] = os.pathsep.join(filter(None, [str(tmp_path), ros.environment.get("PYTHONPATH")]))
    ros.start(MARKERS, "-p", f"robot:={tmp_path / 'icy.yaml'}")

    first = ros.listen(MarkerArray, "markers")
    ros.wait_for(lambda: first)
    late = ros.listen(MarkerArray, "markers")
    ros.wait_for(lambda: late)
    fill, outline, label = late[0].markers
    assert {marker.header.frame_id for marker in late[0].markers} == {"map"}
    assert (fill.type, outline.type, label.type) == (Marker.TRIANGLE_LIST, Marker.LINE_STRIP, Marker.TEXT_VIEW_FACING)
    assert label.text == "friction x 0.3"
    assert (label.pose.position.x, label.pose.position.y) == (2.0, -1.0)
    corners = np.array([[point.x, point.y] for point in fill.points]).reshape(-1, 3, 2)
    a, b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    area = 0.5 * float(np.sum(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]))
    assert area == pytest.approx(0.25 * math.pi * 1.5 * 0.5, rel=1e-3)
    assert outline.points[0] == outline.points[-1] and len(outline.points) == len(corners) + 1
    # Long enough to last until the next, short enough to go when the node has gone.
    assert 1.0 < fill.lifetime.sec < 10.0 and stamp_to_ns(fill.header.stamp) == 0


def test_bad_robot_ends_it_with_one_line():
    result = subprocess.run(
        [sys.executable, "-m", MARKERS, "--ros-args", "-p", "robot:=/no/such/robot.yaml"],
        capture_output=True, text=True, timeout=120,
    )  # fmt: skip
    assert result.returncode == 2
    assert "/no/such/robot.yaml" in result.stderr and len(result.stderr.strip().splitlines()) == 1
