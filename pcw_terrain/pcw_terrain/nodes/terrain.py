"""The ground under every caster: joint_states and slip/observer (or odom) in, terrain and terrain/map out."""

from __future__ import annotations

import array
from collections.abc import Mapping, Sequence

import numpy as np
from nav_msgs.msg import OccupancyGrid, Odometry
from rclpy.node import Node
from sensor_msgs.msg import JointState

from pcw_description import PcwError, load_robot
from pcw_description.differential_kinematics import joint_matrix_blocks
from pcw_description.nodes.diagnostics import OK, WARN, Diagnostics, Problems, Status
from pcw_description.nodes.node_tools import (
    LATCHED,
    SENSOR_SOURCE,
    SENSOR_STREAM,
    Decimator,
    Silence,
    StampWatch,
    declare,
    fill_joint_state,
    joint_state_arrays,
    run_node,
    stamp_to_ns,
)
from pcw_description.robot_description import STEER

from ..believed_slip import independent_slip
from ..errors import TerrainError
from ..robot_terrain import RobotReading, RobotTerrain, RobotTerrainEstimate
from ..terrain_classes import classify
from ..terrain_map import MapParameters, TerrainMap

SOURCES = ("observer", "odom")
# Slip, force and motion older than this against joint_states are not used [s].
OLDEST = 0.05


class TerrainNode(Node):
    """Steps the estimators on every joint_states and publishes at a lower rate.

    terrain holds the casters whose ground is vouched for, and those that stand on a place of the map that is known. After a
    gap or a jump back in time the estimators begin anew; the map stays.
    """

    def __init__(self) -> None:
        super().__init__("terrain")
        self.robot = load_robot(declare(self, "robot", "thesis", "robot file, or the name of a shipped robot", read_only=True))
        self._source = declare(self, "source", SOURCES[0], "where slip comes from", read_only=True, choices=SOURCES)
        rate = declare(
            self, "publish_rate", 50.0, "rate of terrain; at most that of joint_states", "Hz", (0.1, 1e4), read_only=True
        )
        map_rate = declare(self, "map_rate", 1.0, "rate of terrain/map", "Hz", (0.01, 100.0), read_only=True)
        resolution = declare(self, "map_resolution", 0.1, "side of a cell", "m", (0.01, 10.0), read_only=True)
        size = declare(self, "map_size", 40.0, "side of the map, about the origin of odom", "m", (1.0, 400.0), read_only=True)
        longest_gap = declare(
            self, "longest_gap", 0.1, "longest time between joint_states that is bridged", "s", (0.001, 1.0), read_only=True
        )
        cells = max(1, min(round(size / resolution), 4000))
        half = 0.5 * cells * resolution
        self._map = TerrainMap(MapParameters(resolution, cells, cells, (-half, -half)))
        self._terrain, self._B = RobotTerrain(self.robot), joint_matrix_blocks(self.robot)
        self._warm_up()
        self._state, self._estimate = self._terrain.initial_state(), None
        self._slip: tuple[int, np.ndarray, np.ndarray] | None = None
        self._odom: tuple[int, np.ndarray, np.ndarray] | None = None
        self._watch, self._unusable, self._problems = StampWatch(longest_gap), 0, Problems(self)
        self._silence = Silence(self._watch)
        self._due, self._map_due = Decimator(rate), Decimator(map_rate)
        self._joint_index = {name: i for i, name in enumerate(self.robot.joint_names)}
        directions = [
            f"{caster}_{direction}" for caster in self.robot.caster_names for direction in ("longitudinal", "lateral")
        ]
        self._slip_index = {name: i for i, name in enumerate(directions)}
        self._publisher = self.create_publisher(JointState, "terrain", SENSOR_SOURCE)
        self._map_publisher = self.create_publisher(OccupancyGrid, "terrain/map", LATCHED)
        self._map_frame = "odom"
        self.create_subscription(JointState, "joint_states", self._on_joint_states, SENSOR_STREAM)
        self.create_subscription(Odometry, "odom", self._on_odom, SENSOR_STREAM)
        if self._source == "observer":
            self.create_subscription(JointState, "slip/observer", self._on_slip, SENSOR_STREAM)
        self._diagnostics = Diagnostics(self, self.robot.name, self._status, aspect="ground", parts=self._parts)

    def _warm_up(self) -> None:
        """Have everything compiled before the first measurement."""
        rest, state = np.zeros((self.robot.n, 2)), self._terrain.initial_state()
        self._terrain.step(state, RobotReading(rest, rest, rest, np.zeros(self.robot.n)), 1e-3)

    def _on_slip(self, message: JointState) -> None:
        _, slip, force = joint_state_arrays(message, self._slip_index, (self.robot.n, 2))
        known = np.isfinite(slip).all() and np.isfinite(force).all()
        self._slip = (stamp_to_ns(message.header.stamp), slip, force) if known else None

    def _on_odom(self, message: Odometry) -> None:
        position, q, twist = message.pose.pose.position, message.pose.pose.orientation, message.twist.twist
        yaw = np.arctan2(2.0 * (q.w * q.z + q.x * q.y), 1.0 - 2.0 * (q.y * q.y + q.z * q.z))
        pose, speed = np.array([position.x, position.y, yaw]), np.array([twist.linear.x, twist.linear.y, twist.angular.z])
        if np.isfinite(pose).all() and np.isfinite(speed).all():
            self._odom = (stamp_to_ns(message.header.stamp), pose, speed)
            self._map_frame = message.header.frame_id or "odom"
        else:
            self._problems.add("odom is not finite; allowed: finite numbers")

    def _on_joint_states(self, message: JointState) -> None:
        dt = self._watch.update(message.header.stamp)
        if self._watch.repeated:
            return
        if dt is None:
            self._state, self._estimate = self._terrain.initial_state(), None
        position, velocity, effort = joint_state_arrays(message, self._joint_index, (self.robot.n, 2))
        try:
            if not self._step(stamp_to_ns(message.header.stamp), position, velocity, effort, dt or 1e-3):
                return
        except PcwError as error:
            self._watch.take_back()
            self._unusable += 1
            self._problems.add(str(error))
            return
        if dt is not None and self._due.due(dt):
            self._publish(message)
        if dt is not None and self._map_due.due(dt) and self._map.known:
            self._publish_map(message)

    def _step(self, now: int, position: np.ndarray, velocity: np.ndarray, effort: np.ndarray, dt: float) -> bool:
        """Step the estimators; returns whether there was something to step them with."""
        if not (np.isfinite(position).all() and np.isfinite(velocity).all()):
            missing = [
                name for name, i in self._joint_index.items() if not np.isfinite(position.ravel()[i] + velocity.ravel()[i])
            ]
            raise TerrainError(f"joint_states lacks {', '.join(missing)}; allowed: all joints, finite position and velocity")
        newest = self._slip if self._source == "observer" else self._odom
        if newest is None or abs(now - newest[0]) * 1e-9 > OLDEST:
            return False
        if self._source == "observer":
            sensed = np.einsum("nij,nj->ni", self._B, velocity)
            reading = RobotReading(sensed, newest[1], newest[2], np.ascontiguousarray(position[:, STEER]))
            loads = self._terrain.normal_force(reading.steer_angle, reading.force)
            known = independent_slip(self.robot, sensed, newest[1], newest[2], loads)
            reading = RobotReading(sensed, newest[1], newest[2], reading.steer_angle, known)
            self._state, self._estimate = self._terrain.step(self._state, reading, dt)
        else:
            self._state, self._estimate = self._terrain.step_with_twist(self._state, position, velocity, effort, newest[2], dt)
        self._pin(now)
        return True

    def _places(self, now: int) -> np.ndarray | None:
        """Return where the steering axes are in the map (n, 2) [m], None where the pose is not known."""
        if self._odom is None or abs(now - self._odom[0]) * 1e-9 > OLDEST:
            return None
        (x, y, yaw), axis = self._odom[1], self.robot.steer_axis
        c, s = np.cos(yaw), np.sin(yaw)
        return np.column_stack([x + c * axis[:, 0] - s * axis[:, 1], y + s * axis[:, 0] + c * axis[:, 1]])

    def _pin(self, now: int) -> None:
        estimate, places = self._estimate, self._places(now)
        if estimate is None or places is None:
            return
        for i in np.nonzero(estimate.felt_now)[0]:
            self._map.add(places[i, 0], places[i, 1], estimate.mu_p[i], estimate.lambda_p[i], estimate.covariance[i])

    def _known(self, estimate: RobotTerrainEstimate, now: int) -> dict[str, tuple[float, float, float]]:
        """Return lambda_p, current slip and mu_p of casters whose ground is known, from estimates or else from the map."""
        places, found = self._places(now), {}
        for i, name in enumerate(self.robot.caster_names):
            if estimate.valid[i]:
                found[name] = (estimate.lambda_p[i], estimate.slip[i], estimate.mu_p[i])
            elif places is not None and (place := self._map.at(places[i, 0], places[i, 1])) is not None:
                found[name] = (place.lambda_p, estimate.slip[i], place.mu_p)
        return found

    def _publish(self, measured: JointState) -> None:
        assert self._estimate is not None
        found = self._known(self._estimate, stamp_to_ns(measured.header.stamp))
        message = JointState(name=list(found))
        message.header.stamp = measured.header.stamp
        rows = np.array(list(found.values())).reshape(-1, 3)
        refused = fill_joint_state(message, position=rows[:, 0], velocity=rows[:, 1], effort=rows[:, 2])
        if refused:
            self._problems.add(f"terrain: {', '.join(refused)} not finite, left empty")
            self._state = self._terrain.initial_state()
        self._publisher.publish(message)

    def _publish_map(self, measured: JointState) -> None:
        p, message = self._map.parameters, OccupancyGrid()
        message.header.stamp, message.header.frame_id = measured.header.stamp, self._map_frame
        message.info.resolution, message.info.width, message.info.height = p.resolution, p.width, p.height
        message.info.origin.position.x, message.info.origin.position.y = p.origin
        message.info.origin.orientation.w = 1.0
        message.data = array.array("b", self._map.occupancy().tobytes())
        self._map_publisher.publish(message)

    def _parts(self) -> Mapping[str, Status]:
        estimate, parts = self._estimate, {}
        if estimate is None:
            return {}
        for i, name in enumerate(self.robot.caster_names):
            values = {
                "slip": float(estimate.slip[i]),
                "friction": float(estimate.friction[i]),
                "changes": int(estimate.changes[i]),
            }
            if not estimate.valid[i]:
                wrong = "wrong sign" in estimate.reason[i] or "does not fit" in estimate.reason[i]
                parts[name] = Status(WARN if wrong else OK, estimate.reason[i], values)
                continue
            spread = np.sqrt(np.diag(estimate.covariance[i]))
            values |= {"mu_p": float(estimate.mu_p[i]), "mu_p_spread": float(spread[0])}
            values |= {"lambda_p": float(estimate.lambda_p[i]), "lambda_p_spread": float(spread[1])}
            classes = classify(values["mu_p"], values["lambda_p"], estimate.covariance[i])
            values |= {f"class {c.name}": c.probability for c in classes[:3]}
            parts[name] = Status(OK, f"{classes[0].name} ({classes[0].probability:.0%})", values)
        return parts

    def _status(self) -> Status:
        values: dict[str, object] = {"gaps": self._watch.gaps, "repeated_stamps": self._watch.repeats}
        values |= {"backward_jumps": self._watch.backward_jumps, "unusable_joint_states": self._unusable}
        values |= {"known_cells": self._map.known}
        problems, estimate = self._problems.take(), self._estimate
        if estimate is not None and estimate.valid.any():
            values |= {
                "robot_mu_p": float(estimate.robot[0]),
                "robot_lambda_p": float(estimate.robot[1]),
                "uniform": estimate.uniform,
            }
        if problems:
            return Status(WARN, problems, values)
        if self._silence.since_last_report():
            return Status(WARN, "no joint_states since the last report", values)
        if estimate is None:
            topic = "slip/observer" if self._source == "observer" else "odom"
            return Status(WARN, f"no {topic} near joint_states in time", values)
        return Status(OK, f"ground known under {int(estimate.valid.sum())} of {self.robot.n} casters", values)


def main(args: Sequence[str] | None = None) -> int:
    """Run the terrain node."""
    return run_node(TerrainNode, args)


if __name__ == "__main__":
    raise SystemExit(main())
