"""Arrows and ground patches as markers."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from builtin_interfaces.msg import Duration, Time
from geometry_msgs.msg import Point
from std_msgs.msg import ColorRGBA
from visualization_msgs.msg import Marker

from pcw_description.robot_description import FloatArray

from ..ground_patch import GroundPatch
from ..wheel_arrows import Arrow, Colour

SHAFT, HEAD, HEAD_LENGTH = 0.012, 0.03, 0.04  # of an arrow, diameters and length [m]
PATCH_FILL: Colour = (0.35, 0.65, 0.95, 0.45)
PATCH_EDGE: Colour = (0.10, 0.35, 0.75, 1.0)
EDGE_WIDTH, TEXT_HEIGHT = 0.02, 0.12  # [m]
# Above the floor, or a viewer's grid at the same height would flicker through it [m].
FILL_HEIGHT, EDGE_HEIGHT, LABEL_HEIGHT = 0.001, 0.002, 0.1


def arrow_marker(arrow: Arrow, caster: str, number: int, stamp: Time, lifetime: Duration) -> Marker:
    """Return an arrow in the frame of a caster's fork, stamped as the data that it shows; `number` tells casters apart."""
    marker = _marker(f"{caster}_fork", arrow.kind, number, Marker.ARROW, arrow.colour, lifetime)
    marker.header.stamp = stamp
    marker.points = [_point(arrow.start), _point(arrow.end)]
    length = float(np.linalg.norm(arrow.end - arrow.start))
    # A head longer than its arrow would stick out beyond the end that shows the value.
    marker.scale.x, marker.scale.y, marker.scale.z = SHAFT, HEAD, min(HEAD_LENGTH, 0.5 * length)
    return marker


def patch_markers(patches: Iterable[GroundPatch], frame: str, lifetime: Duration) -> list[Marker]:
    """Return fill, outline and label of each patch in the world frame; their stamp is 0, for they are true at any time."""
    markers = []
    for number, patch in enumerate(patches):
        fill = _marker(frame, "patch_fill", number, Marker.TRIANGLE_LIST, PATCH_FILL, lifetime)
        fill.points = [_point((x, y, FILL_HEIGHT)) for x, y in patch.triangles().reshape(-1, 2)]
        fill.scale.x = fill.scale.y = fill.scale.z = 1.0
        outline = _marker(frame, "patch_outline", number, Marker.LINE_STRIP, PATCH_EDGE, lifetime)
        corners = patch.outline()
        outline.points = [_point((x, y, EDGE_HEIGHT)) for x, y in [*corners, corners[0]]]
        outline.scale.x = EDGE_WIDTH
        label = _marker(frame, "patch_label", number, Marker.TEXT_VIEW_FACING, PATCH_EDGE, lifetime)
        label.text, label.scale.z = patch.label, TEXT_HEIGHT
        label.pose.position = _point((patch.x, patch.y, LABEL_HEIGHT))
        markers += [fill, outline, label]
    return markers


def _marker(frame: str, kind: str, number: int, shape: int, colour: Colour, lifetime: Duration) -> Marker:
    """A marker that follows its frame between two messages and vanishes after `lifetime` without a further one."""
    marker = Marker(ns=kind, id=number, type=shape, action=Marker.ADD, lifetime=lifetime, frame_locked=True)
    marker.header.frame_id = frame
    marker.pose.orientation.w = 1.0
    marker.color = ColorRGBA(r=colour[0], g=colour[1], b=colour[2], a=colour[3])
    return marker


def _point(xyz: FloatArray | tuple[float, float, float]) -> Point:
    return Point(x=float(xyz[0]), y=float(xyz[1]), z=float(xyz[2]))
