"""The ground under every caster: joint_states and slip/observer (or odom) in, terrain, terrain/grip and terrain/map out."""

from __future__ import annotations

import array
from collections.abc import Sequence

import numpy as np
from nav_msgs.msg import OccupancyGrid, Odometry
from rclpy.node import Node
from sensor_msgs.msg import JointState

from pcw_description import PcwError, load_robot
from pcw_description.differential_kinematics import joint_matrix_blocks
from pcw_description.nodes.diagnostics import OK, WARN, Diagnostics, Problems, Status
from pcw_description.nodes.measured_joints import MeasuredJoints
from pcw_description.nodes.node_tools import (
    LATCHED,
    SENSOR_SOURCE,
    SENSOR_STREAM,
    Decimator,
    all_declared,
    declare,
    fill_joint_state,
    joint_state_arrays,
    run_node,
    stamp_to_ns,
)
from pcw_description.robot_description import STEER

from ..ground_from_tests import GroundFromTests
from ..observed_ground import ObservedGround
from ..robot_terrain import RobotReading, RobotTerrainEstimate
from ..shared_friction import shared_friction
from ..slip_slope import SlipSlopeEstimate
from ..terrain_map import MapParameters, TerrainMap
from .caster_status import caster_status
from .same_stamp import SameStamp

SOURCES = ("observer", "odom")
# Motion older than this against joint_states is not used [s].
OLDEST = 0.05
# Tests that ended longer ago against joint_states are not used, as the way since then is not known [s].
OLDEST_TEST = 10.0


class TerrainNode(Node):
    """Steps the estimators and publishes at a lower rate.

    A step takes joint_states and slip/observer of the same stamp, whichever comes first, so that speeds and slips belong
    together; with odom, every joint_states. terrain holds the casters whose ground is vouched for, those of which a test has
    told (terrain/tested), and those that stand on a place of the map that is known; terrain/grip holds all of them, by what
    forces may be shared. After a gap or a jump back in time the estimators begin anew; the map stays.
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
        all_declared(self)
        cells = max(1, min(round(size / resolution), 4000))
        half = 0.5 * cells * resolution
        self._map = TerrainMap(MapParameters(resolution, cells, cells, (-half, -half)))
        self._ground = ObservedGround(self.robot)
        self._terrain = self._ground.terrain
        self._B = joint_matrix_blocks(self.robot)
        self._warm_up()
        self._begin_anew()
        self._longest_gap = longest_gap
        self._odom: tuple[int, np.ndarray, np.ndarray] | None = None
        self._heard: JointState | None = None  # of terrain/tested, until the next step
        needed = ["position", "velocity"] if self._source == "observer" else ["position", "velocity", "effort"]
        self._unusable, self._problems = 0, Problems(self)
        self._joints = MeasuredJoints(self.robot, needed, self._problems, longest_gap)
        self._watch = self._joints.watch
        self._due, self._map_due = Decimator(rate), Decimator(map_rate)
        directions = [
            f"{caster}_{direction}" for caster in self.robot.caster_names for direction in ("longitudinal", "lateral")
        ]
        self._caster_index = {name: i for i, name in enumerate(self.robot.caster_names)}
        self._slip_index = {name: i for i, name in enumerate(directions)}
        self._publisher = self.create_publisher(JointState, "terrain", SENSOR_SOURCE)
        self._grip_publisher = self.create_publisher(JointState, "terrain/grip", SENSOR_SOURCE)
        self._map_publisher = self.create_publisher(OccupancyGrid, "terrain/map", LATCHED)
        self._map_frame = "odom"
        self.create_subscription(JointState, "joint_states", self._on_joint_states, SENSOR_STREAM)
        self.create_subscription(Odometry, "odom", self._on_odom, SENSOR_STREAM)
        if self._source == "observer":
            self.create_subscription(JointState, "slip/observer", self._on_slip, SENSOR_STREAM)
            self.create_subscription(JointState, "terrain/tested", self._on_tested, LATCHED)
        self._diagnostics = Diagnostics(self, self.robot.name, self._status, aspect="ground", parts=self._parts)

    def _begin_anew(self) -> None:
        self._state, self._observed = self._terrain.initial_state(), self._ground.initial_state()
        self._estimate: RobotTerrainEstimate | None = None
        self._grip: SlipSlopeEstimate | None = None
        self._tests = GroundFromTests.nothing(self.robot.n)
        self._same_stamp, self._stepped_at = SameStamp(), 0

    def _warm_up(self) -> None:
        """Have everything compiled before the first measurement."""
        n = self.robot.n
        reading = RobotReading(np.zeros((n, 2)), np.zeros((n, 2)), np.zeros((n, 2)), np.zeros(n))
        self._ground.step(self._ground.initial_state(), reading, 1e-3)

    def _on_slip(self, message: JointState) -> None:
        self._take(self._same_stamp.second(stamp_to_ns(message.header.stamp), message))

    def _on_tested(self, message: JointState) -> None:
        self._heard = message

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
        if not self._joints.are_in(message):
            return
        dt = self._watch.update(message.header.stamp)
        if self._watch.repeated:
            return
        if dt is None:
            self._begin_anew()
        now = stamp_to_ns(message.header.stamp)
        if self._source == "observer":
            self._take(self._same_stamp.first(now, message))
        elif self._odom is not None and abs(now - self._odom[0]) * 1e-9 <= OLDEST:
            self._take((message, None))

    def _take(self, pair: tuple[JointState, JointState | None] | None) -> None:
        """Step with joint_states and, where that is the source, slip/observer of the same stamp; publish what is due."""
        if pair is None:
            return
        joints, slip = pair
        now = stamp_to_ns(joints.header.stamp)
        # Where nothing was vouched for in between, no time has passed for what the estimators remember.
        dt = min((now - self._stepped_at) * 1e-9, self._longest_gap) if self._stepped_at else 1e-3
        try:
            position, velocity, effort = self._joints.read(joints)
            if slip is None:
                self._by_odom(position, velocity, effort, dt)
            elif not self._by_observer(position, velocity, slip, dt, now):
                return
        except PcwError as error:
            self._watch.take_back()
            self._unusable += 1
            self._problems.add(str(error))
            return
        first, self._stepped_at = not self._stepped_at, now
        self._pin(now)
        if not first and self._due.due(dt):
            self._publish(joints)
        if not first and self._map_due.due(dt) and self._map.known:
            self._publish_map(joints)

    def _by_odom(self, position: np.ndarray, velocity: np.ndarray, effort: np.ndarray, dt: float) -> None:
        assert self._odom is not None
        self._state, self._estimate = self._terrain.step_with_twist(
            self._state, position, velocity, effort, self._odom[2], dt
        )

    def _by_observer(self, position: np.ndarray, velocity: np.ndarray, message: JointState, dt: float, now: int) -> bool:
        """Step with what the observer says; returns whether it vouches for the forces at least."""
        _, slip, force = joint_state_arrays(message, self._slip_index, (self.robot.n, 2))
        if not np.isfinite(force).all():
            return False
        slip_known = bool(np.isfinite(slip).all())
        slip = slip if slip_known else np.zeros_like(slip)
        sensed, steer_angle = np.einsum("nij,nj->ni", self._B, velocity), np.ascontiguousarray(position[:, STEER])
        reading = RobotReading(sensed, slip, force, steer_angle, np.full(self.robot.n, slip_known))
        self._observed, found = self._ground.step(self._observed, reading, dt)
        self._estimate, self._grip = found.ground, found.slopes
        self._hear_tests(np.abs(sensed[:, 0]), now)
        self._tests = self._tests.step(found.ground, force, sensed[:, 0], dt)
        return True

    def _hear_tests(self, speed: np.ndarray, now: int) -> None:
        """Take in what terrain/tested has told since the last step, at speeds (n,) of the wheels."""
        message = self._heard
        if message is None or (age := (now - stamp_to_ns(message.header.stamp)) * 1e-9) < 0.0:
            return
        self._heard = None
        if age > OLDEST_TEST:
            return
        critical, _, friction = joint_state_arrays(message, self._caster_index, (self.robot.n,))
        self._tests = self._tests.hear(friction, critical, speed * age)

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
        """Return lambda_p, current slip and mu_p of casters whose ground is known: by estimates, else tests, else the map."""
        places, found = self._places(now), {}
        for i, name in enumerate(self.robot.caster_names):
            if estimate.valid[i]:
                found[name] = (estimate.lambda_p[i], estimate.slip[i], estimate.mu_p[i])
            elif self._tests.known[i]:
                found[name] = (self._tests.lambda_p[i], estimate.slip[i], self._tests.mu_p[i])
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
            self._begin_anew()
            return
        self._publisher.publish(message)
        told = shared_friction(self.robot, self._tests.beside(self._estimate), self._grip)
        grip = JointState(name=list(self.robot.caster_names))
        grip.header.stamp = measured.header.stamp
        fill_joint_state(grip, position=told.lambda_p, effort=told.mu_p)
        self._grip_publisher.publish(grip)

    def _publish_map(self, measured: JointState) -> None:
        p, message = self._map.parameters, OccupancyGrid()
        message.header.stamp, message.header.frame_id = measured.header.stamp, self._map_frame
        message.info.resolution, message.info.width, message.info.height = p.resolution, p.width, p.height
        message.info.origin.position.x, message.info.origin.position.y = p.origin
        message.info.origin.orientation.w = 1.0
        message.data = array.array("b", self._map.occupancy().tobytes())
        self._map_publisher.publish(message)

    def _parts(self) -> dict[str, Status]:
        return {} if self._estimate is None else caster_status(self.robot.caster_names, self._estimate, self._grip)

    def _status(self) -> Status:
        values: dict[str, object] = {"gaps": self._watch.gaps, "repeated_stamps": self._watch.repeats}
        values |= {"backward_jumps": self._watch.backward_jumps, "unusable_joint_states": self._unusable}
        values |= {"known_cells": self._map.known, "known_by_tests": int(self._tests.known.sum())}
        problems, estimate = self._joints.silence() or self._problems.take(), self._estimate
        if estimate is not None and estimate.valid.any():
            values |= {
                "robot_mu_p": float(estimate.robot[0]),
                "robot_lambda_p": float(estimate.robot[1]),
                "uniform": estimate.uniform,
            }
        if problems:
            return Status(WARN, problems, values)
        if estimate is None:
            waits = "slip/observer with the stamps of" if self._source == "observer" else "odom near"
            return Status(WARN, f"no {waits} joint_states", values)
        return Status(OK, f"ground known under {int(estimate.valid.sum())} of {self.robot.n} casters", values)


def main(args: Sequence[str] | None = None) -> int:
    """Run the terrain node."""
    return run_node(TerrainNode, args)


if __name__ == "__main__":
    raise SystemExit(main())
