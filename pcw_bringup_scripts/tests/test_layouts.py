"""The layouts for RViz and Foxglove name only topics, fields, frames and kinds of markers that there are."""

from __future__ import annotations

import fnmatch
import json
import re
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import pytest
import yaml

from pcw_description import load_robot
from pcw_description.urdf import robot_urdf

REPOSITORY = Path(__file__).resolve().parents[2]
CONFIG = REPOSITORY / "pcw_bringup_scripts/config"
RVIZ = yaml.safe_load((CONFIG / "pcw.rviz").read_text(encoding="utf-8"))
FOXGLOVE = json.loads((CONFIG / "pcw_foxglove.json").read_text(encoding="utf-8"))
DISPLAYS = {display["Class"].partition("/")[2]: display for display in RVIZ["Visualization Manager"]["Displays"]}
PANELS = FOXGLOVE["configById"]


def mappings(tree):
    """Every mapping in a tree of mappings and lists, itself included."""
    if isinstance(tree, dict):
        yield tree
    for part in tree.values() if isinstance(tree, dict) else tree if isinstance(tree, list) else ():
        yield from mappings(part)


def published():
    """Full names, * for a caster, of what the nodes publish and of what the contract names, which is what is recorded."""
    sources = "".join(path.read_text(encoding="utf-8") for path in REPOSITORY.glob("pcw_*/pcw_*/nodes/*.py"))
    found = re.findall(r'create_publisher\(\s*\w+,\s*f?"([^"]+)"', sources)
    [contract] = re.findall(r"^DEFAULT_TOPICS = \((.*?)^\)", sources, flags=re.DOTALL | re.MULTILINE)
    names = {*found, *re.findall(r'"([^"]+)"', contract)}
    return {"/" + re.sub(r"\{.*?\}", "*", name).removeprefix("/") for name in names}


def rviz_topics():
    return {part["Value"] for tree in mappings(RVIZ) for key, part in tree.items() if key.endswith("Topic")}


def foxglove_paths():
    """(topic, field) of everything that is plotted."""
    values = [path["value"] for panel in PANELS.values() for path in panel.get("paths", ())]
    return [re.fullmatch(r"(/[\w/]+)\.(\w+)\[\d\]", value).groups() for value in values]


def foxglove_topics():
    scene = {topic for panel in PANELS.values() for topic in panel.get("topics", ())}
    others = {panel["topicToRender"] for panel in PANELS.values() if "topicToRender" in panel}
    return scene | others | {topic for topic, _ in foxglove_paths()}


def rviz_frames():
    places = ("Fixed Frame", "Reference Frame", "Target Frame")
    named = {value for tree in mappings(RVIZ) for key, value in tree.items() if key in places}
    return (named | set(DISPLAYS["TF"]["Frames"])) - {"All Enabled", "<Fixed Frame>"}


def foxglove_frames():
    named = {value for tree in mappings(FOXGLOVE) for key, value in tree.items() if key in ("followTf", "frameId")}
    return named | {name.removeprefix("frame:") for name in PANELS["3D!robot"]["transforms"]}


def test_published_topics_are_found():
    """Otherwise the next test would compare with nothing."""
    assert {"/markers", "/robot_description", "/tf", "/contact/*/wrench", "/terrain", "/mismatch"} <= published()


@pytest.mark.parametrize("topics", [rviz_topics, foxglove_topics])
def test_every_topic_is_one_that_somebody_publishes(topics):
    known = published()
    assert {"/robot_description", "/markers", "/odom"} <= topics()
    assert [topic for topic in topics() if not any(fnmatch.fnmatchcase(topic, pattern) for pattern in known)] == []


@pytest.mark.parametrize("frames", [rviz_frames, foxglove_frames])
def test_every_frame_is_in_the_urdf_or_above_it(frames):
    links = {link.get("name") for link in ElementTree.fromstring(robot_urdf(load_robot("thesis"))).iter("link")}
    assert {"map", "odom", "base_link"} <= frames()
    assert frames() - links - {"map", "odom"} == set()


def test_plots_show_fields_of_joint_states():
    sensor_msgs = pytest.importorskip("sensor_msgs.msg")
    fields = sensor_msgs.JointState.get_fields_and_field_types()
    assert {topic for topic, _ in foxglove_paths()} == {"/slip/encoder", "/joint_states", "/terrain", "/mismatch"}
    assert {field for _, field in foxglove_paths()} <= {name for name, kind in fields.items() if kind == "sequence<double>"}


def test_drive_and_steer_are_told_apart():
    for panel, joint in (("Plot!drive", "drive"), ("Plot!steer", "steer")):
        names = load_robot("thesis").joint_names
        indices = [int(path["value"].partition("[")[2].rstrip("]")) for path in PANELS[panel]["paths"]]
        assert [names[index].rpartition("_")[2] for index in indices] == [joint] * 4


def test_rviz_names_the_kinds_of_markers_that_are_sent():
    pytest.importorskip("visualization_msgs.msg")
    from rclpy.duration import Duration

    from pcw_sim_bridge.ground_patch import GroundPatch
    from pcw_sim_bridge.nodes.marker_messages import patch_markers
    from pcw_sim_bridge.wheel_arrows import force_arrows, slip_arrows

    robot = load_robot("thesis")
    arrows = [*force_arrows(robot, 0, [50.0, 0.0, 200.0], 0.002), *slip_arrows(robot, 0, [0.1, 0.0], 2.0)]
    patches = patch_markers([GroundPatch("ice", 0.0, 0.0, 1.0, 1.0)], "map", Duration(seconds=1).to_msg())
    assert set(DISPLAYS["MarkerArray"]["Namespaces"]) == {arrow.kind for arrow in arrows} | {marker.ns for marker in patches}


def test_rviz_asks_for_the_description_that_was_sent_before_it_came():
    assert DISPLAYS["RobotModel"]["Description Topic"]["Durability Policy"] == "Transient Local"
    assert DISPLAYS["RobotModel"]["Description Source"] == "Topic"


def test_foxglove_shows_every_panel_once():
    shown = [part for tree in mappings(FOXGLOVE["layout"]) for part in tree.values() if isinstance(part, str)]
    assert sorted(name for name in shown if "!" in name) == sorted(PANELS)
