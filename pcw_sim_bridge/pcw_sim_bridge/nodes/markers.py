"""Shows in RViz and Foxglove what the wheels feel: contact force, load and slip as arrows, slippery ground as patches."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

from geometry_msgs.msg import WrenchStamped
from rclpy.clock import Clock, ClockType
from rclpy.duration import Duration
from rclpy.node import Node
from sensor_msgs.msg import JointState
from visualization_msgs.msg import Marker, MarkerArray

from pcw_description import PcwError, load_robot
from pcw_description.nodes.diagnostics import OK, WARN, Diagnostics, Problems, Status
from pcw_description.nodes.node_tools import (
    SENSOR,
    SENSOR_SOURCE,
    all_declared,
    declare,
    joint_state_arrays,
    run_node,
)

from ..ground_patch import ground_patches
from ..wheel_arrows import Arrow, force_arrows, slip_arrows
from .marker_messages import arrow_marker, patch_markers

# Patches do not move: they are sent again for viewers that come late, and last over one that gets lost [s].
PATCH_PERIOD, PATCH_LIFETIME = 1.0, 3.0


class MarkersNode(Node):
    """Draws the newest contact force and slip of each wheel at a lower rate, and the ground patches of the robot file.

    An arrow is drawn once for each measurement, so that it vanishes `lifetime` after the measurements have ended. What is
    not a number is not drawn and said on /diagnostics.
    """

    def __init__(self) -> None:
        super().__init__("markers")
        self.robot = load_robot(declare(self, "robot", "thesis", "robot file, or the name of a shipped robot", read_only=True))
        rate = declare(self, "rate", 20.0, "rate at which arrows are drawn, real time", "Hz", (1.0, 100.0), read_only=True)
        declare(self, "force_scale", 0.002, "length of an arrow per force", "m/N", (1e-6, 1.0))
        declare(self, "slip_scale", 2.0, "length of an arrow per slip velocity", "m per m/s", (1e-3, 1e3))
        declare(self, "lifetime", 0.5, "an arrow vanishes so long after the last measurement", "s", (0.02, 60.0))
        world = declare(self, "world_frame", "map", "frame that the ground patches are in", read_only=True)
        all_declared(self)
        self._forces: dict[int, WrenchStamped] = {}  # the newest by caster, until drawn
        self._slip: JointState | None = None
        self._drawn, self._problems = 0, Problems(self)
        names = [f"{caster}_{direction}" for caster in self.robot.caster_names for direction in ("longitudinal", "lateral")]
        self._slip_index = {name: i for i, name in enumerate(names)}
        self._patches = patch_markers(ground_patches(self.robot), world, Duration(seconds=PATCH_LIFETIME).to_msg())
        self._markers = self.create_publisher(MarkerArray, "markers", SENSOR_SOURCE)
        for i, name in enumerate(self.robot.caster_names):
            self.create_subscription(WrenchStamped, f"contact/{name}/wrench", partial(self._on_force, i), SENSOR)
        self.create_subscription(JointState, "slip/encoder", self._on_slip, SENSOR)
        # Real time: a viewer looks on in real time, however fast the simulation runs.
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(1.0 / rate, self._draw_arrows, clock=steady)
        if self._patches:
            self.create_timer(PATCH_PERIOD, lambda: self._markers.publish(MarkerArray(markers=self._patches)), clock=steady)
        self._diagnostics = Diagnostics(self, self.robot.name, self._status, aspect="markers")

    def _on_force(self, index: int, message: WrenchStamped) -> None:
        self._forces[index] = message

    def _on_slip(self, message: JointState) -> None:
        self._slip = message

    def _draw_arrows(self) -> None:
        markers: list[Marker] = []
        force_scale, slip_scale = (self.get_parameter(name).value for name in ("force_scale", "slip_scale"))
        for i, message in self._forces.items():
            force = message.wrench.force
            markers += self._markers_of(force_arrows, i, (force.x, force.y, force.z), force_scale, message)
        if self._slip is not None and self._slip.velocity:  # a field that is not estimated is empty
            _, slip_velocity, _ = joint_state_arrays(self._slip, self._slip_index, (self.robot.n, 2))
            for i in range(self.robot.n):
                markers += self._markers_of(slip_arrows, i, slip_velocity[i], slip_scale, self._slip)
        self._forces.clear()
        self._slip = None
        if markers:
            self._markers.publish(MarkerArray(markers=markers))
            self._drawn += len(markers)

    def _markers_of(
        self, arrows: Callable[..., list[Arrow]], index: int, values: Sequence[float], scale: float,
        measured: WrenchStamped | JointState,
    ) -> list[Marker]:  # fmt: skip
        """What `arrows` makes of one wheel's values, as markers; none, and a note, where they are no numbers."""
        lifetime = Duration(seconds=self.get_parameter("lifetime").value).to_msg()
        try:
            drawn = arrows(self.robot, index, values, scale)
        except PcwError as error:
            self._problems.add(str(error))
            return []
        name = self.robot.caster_names[index]
        return [arrow_marker(arrow, name, index, measured.header.stamp, lifetime) for arrow in drawn]

    def _status(self) -> Status:
        problems, drawn = self._problems.take(), self._drawn
        self._drawn = 0
        level, text = (WARN, problems) if problems else (OK, "drawing" if drawn else "nothing to draw since the last report")
        return Status(level, text, {"arrows_since_last_report": drawn, "ground_patches": len(self._patches) // 3})


def main(args: Sequence[str] | None = None) -> int:
    """Run the node until it is told to stop."""
    return run_node(MarkersNode, args)


if __name__ == "__main__":
    raise SystemExit(main())
