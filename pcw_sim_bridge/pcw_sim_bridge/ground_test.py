"""A test of the ground by slip on purpose, whole: from joint readings to torques to add, and to what is known of the ground.

One cycle, in this order:

    joints, torques    -> contact forces      sliding-mode observer
    forces, headings   -> loads
    casters tested     -> ground believed in  what their tests said; elsewhere their mean, and before any the robot file
    all of these       -> torques to add      `pcw_terrain.active_identification`
    readings of a test -> the ground          `pcw_terrain.active_record`, once the test is over

What a finished test says takes six passes over all its readings, a third of a second of work and more. In a study that is
done at once; where a robot waits for its torques, a few readings are gone over in every cycle (`replay`) and the next caster
waits until that is done. The result is the same.

The core lies here and not in pcw_terrain, as it needs an observer of pcw_estimation; study and node both step it.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from pcw_description.odometry import OdometryState
from pcw_description.robot_description import DRIVE, STEER, FloatArray, RobotDescription
from pcw_estimation.robot_sliding_mode_observer import RobotObserverState, RobotSlidingModeObserver
from pcw_estimation.sliding_mode_observer import MEASURED, SlidingModeParameters
from pcw_estimation.slip_estimate import JointMeasurement
from pcw_terrain.active_identification import (
    ActiveIdentification,
    ActiveMeasurement,
    ActiveOutput,
    ActiveParameters,
    ActiveState,
    Disturbance,
    Phase,
    Refusal,
)
from pcw_terrain.active_record import ROUNDS, ActiveRecord, Instant, Replay
from pcw_terrain.errors import TerrainError
from pcw_terrain.robot_terrain import RobotTerrain, RobotTerrainEstimate
from pcw_terrain.terrain_estimator import TerrainState

BUSY = (Phase.WAIT, Phase.SLIP, Phase.RETURN)
# Controllers of pcw_control that have been shown to work with it, in the reduced plant by this package's tests. All feed back
# the pose by `position_gain`, from which the disturbance of the base is predicted. Others that follow motion have no such
# gain, or look at the slip that is made here.
WORKS_WITH = (
    "computed_torque", "friction_optimal", "friction_optimal_slip_constraint", "jacobian_pseudo_inverse",
    "slip_constraint_force", "traction_limit_avoidance", "weighted_pseudo_inverse",
)  # fmt: skip
# Speed and time step of the motion by which everything is compiled [m/s], [s].
WARM_UP_SPEED, WARM_UP_STEP = 0.3, 0.01


@dataclasses.dataclass(frozen=True)
class GroundTestParameters:
    """How the ground is tested.

    Attributes:
        measured: "speed", as the drives report them, or "angle", speeds from joint angles; for observer and test.
        replay: readings of a finished test that are gone over in one cycle; 0: all, and all passes, at once.
        active: how slip is made, and when it is safe.
    """

    measured: str = MEASURED[0]
    replay: int = 0
    active: ActiveParameters = dataclasses.field(default_factory=ActiveParameters)

    def __post_init__(self) -> None:
        """Check the parameters.

        Raises:
            TerrainError: names the field, its value and what is allowed.
        """
        if self.measured not in MEASURED:
            raise TerrainError(f"measured = {self.measured!r} is not allowed; allowed: {', '.join(MEASURED)}")
        if isinstance(self.replay, bool) or not isinstance(self.replay, int) or self.replay < 0:
            raise TerrainError(f"replay = {self.replay!r} is not allowed; allowed: a whole number, at least 0")


@dataclasses.dataclass(frozen=True)
class FoundGround:
    """What tests have said of the ground under each caster, and what is believed where they have said nothing.

    Attributes:
        mu_p, lambda_p: per caster (n,) [1]; NaN where no test has told.
        covariance: of their logarithms (n, 2, 2); inf where no test has told.
        valid: of which casters a test has told (n,).
        said: per caster, why its test has told nothing; "" where one has told or none was made.
    """

    mu_p: FloatArray
    lambda_p: FloatArray
    covariance: FloatArray
    valid: np.ndarray
    said: tuple[str, ...]

    @classmethod
    def nothing(cls, n: int) -> FoundGround:
        """Return that nothing is known of n casters."""
        return cls(np.full(n, np.nan), np.full(n, np.nan), np.full((n, 2, 2), np.inf), np.zeros(n, dtype=bool), ("",) * n)

    def believed(self, robot: RobotDescription) -> tuple[FloatArray, FloatArray]:
        """Return mu_p and lambda_p to believe in (n,): of a caster's own test, else the others' mean, else the file's."""
        mu_p = np.array([tyre.mu_p for tyre in robot.tyres])
        lambda_p = np.array([tyre.lambda_p for tyre in robot.tyres])
        if self.valid.any():
            mu_p[:] = np.exp(np.mean(np.log(self.mu_p[self.valid])))
            lambda_p[:] = np.exp(np.mean(np.log(self.lambda_p[self.valid])))
        return np.where(self.valid, self.mu_p, mu_p), np.where(self.valid, self.lambda_p, lambda_p)

    def with_test(self, caster: int, found: RobotTerrainEstimate) -> FoundGround:
        """Return what is known after the test of a caster."""
        if not found.valid[caster]:
            return self.without_test(caster, found.reason[caster])
        at = np.arange(len(self.valid)) == caster
        return dataclasses.replace(
            self, mu_p=np.where(at, found.mu_p, self.mu_p), lambda_p=np.where(at, found.lambda_p, self.lambda_p),
            covariance=np.where(at[:, None, None], found.covariance, self.covariance), valid=self.valid | at,
        )  # fmt: skip

    def without_test(self, caster: int, reason: str) -> FoundGround:
        """Return what is known after a test of a caster that has told nothing, for a reason."""
        return dataclasses.replace(self, said=(*self.said[:caster], reason, *self.said[caster + 1 :]))

    def interval(self, caster: int) -> tuple[FloatArray, FloatArray]:
        """Return the lower and the upper ends (2,) of the 95 % intervals of mu_p and lambda_p of a caster that is known."""
        middle = np.log([self.mu_p[caster], self.lambda_p[caster]])
        half = 1.96 * np.sqrt(np.diag(self.covariance[caster]))
        return np.exp(middle - half), np.exp(middle + half)


@dataclasses.dataclass(frozen=True)
class GroundTestState:
    """What it remembers.

    Attributes:
        observed: state of the observer.
        testing: what is going on, which casters have been tested, and which were left out.
        live: of the estimators while a test goes on.
        ground: what the tests have said.
        position: joint angles of the cycle before (n, 2) [rad]; None before the first.
        under_test: caster that was under test in the cycle before, or -1.
        twist: of base_link in the cycle before, by the casters that were not under test (3,).
        measurement: of the cycle before; None before the first.
        instants: cycles of the test that goes on, or of that which `replay` goes over.
        replay: what is made of the last test; None where nothing is left to do.
    """

    observed: RobotObserverState
    testing: ActiveState
    live: TerrainState
    ground: FoundGround
    position: FloatArray | None = None
    under_test: int = -1
    twist: FloatArray = dataclasses.field(default_factory=lambda: np.zeros(3))
    measurement: ActiveMeasurement | None = None
    instants: tuple[Instant, ...] = ()
    replay: Replay | None = None

    @property
    def busy(self) -> bool:
        """Whether a request is being dealt with."""
        return self.testing.phase in BUSY or self.under_test >= 0 or self.replay is not None


@dataclasses.dataclass(frozen=True)
class GroundTestOutput:
    """What one cycle gives.

    Attributes:
        torque: to be added to the controller's (n, 2) [N m]; zero where no wheel is under test.
        position, velocity: joints as odometry and controller are to see them (n, 2) [rad], [rad/s].
        missed: motion (3,) [m, m, rad] in base_link that odometry has missed, to be added to it now (`shifted`).
        testing: caster under test, or -1.
        found: caster whose test has been evaluated in this cycle, or -1; see `GroundTestState.ground`.
        normal_force: loads (n,) [N].
    """

    torque: FloatArray
    position: FloatArray
    velocity: FloatArray
    missed: FloatArray
    testing: int
    found: int
    normal_force: FloatArray


@dataclasses.dataclass(frozen=True)
class Forecast:
    """What a request made now would lead to.

    Attributes:
        begins: casters whose test would begin as the robot stands and drives.
        left_out: the others, each with its reason.
        disturbance: of the base per caster of `begins`.
    """

    begins: tuple[int, ...]
    left_out: tuple[tuple[int, Refusal], ...]
    disturbance: tuple[Disturbance, ...]

    @property
    def path(self) -> float:
        """By which the base is expected to leave its path, the greatest of all tests [m]."""
        return max((each.path for each in self.disturbance), default=0.0)


class GroundTest:
    """Slip on purpose for one robot; see the module's docstring.

    Args:
        robot: as its file says.
        parameters: how.

    Raises:
        KinematicsError: a caster without offset, which cannot push sideways.
        TerrainError: fewer than three casters.
    """

    def __init__(self, robot: RobotDescription, parameters: GroundTestParameters | None = None) -> None:
        self.robot, self.n = robot, robot.n
        self.parameters = parameters or GroundTestParameters()
        self.active = ActiveIdentification(robot, self.parameters.active)
        self.observer = RobotSlidingModeObserver(robot, SlidingModeParameters(measured=self.parameters.measured))
        self.terrain = RobotTerrain(robot)

    def initial_state(self) -> GroundTestState:
        """Return the state before the first reading, in which nothing is asked for."""
        return GroundTestState(
            self.observer.initial_state(), self.active.initial_state(), self.terrain.initial_state(),
            FoundGround.nothing(self.n),
        )  # fmt: skip

    def warm_up(self) -> None:
        """Have everything compiled: an imagined robot rolls along and is tested until one test has been evaluated."""
        joints = JointMeasurement(np.zeros((self.n, 2)), np.zeros((self.n, 2)), np.zeros((self.n, 2)))
        joints.velocity[:, DRIVE] = WARM_UP_SPEED / self.robot.wheel_radius
        state = self.request(self.initial_state())
        for _ in range(200):
            joints = dataclasses.replace(joints, position=joints.position + WARM_UP_STEP * joints.velocity)
            state, output = self.step(state, joints, np.zeros((self.n, 2)), WARM_UP_STEP)
            self.forecast(state)
            if output.found >= 0 or not state.busy:
                break

    def request(self, state: GroundTestState) -> GroundTestState:
        """Return the state with the test of all casters asked for, and with what earlier tests have said forgotten."""
        testing = self.active.request(state.testing)
        return dataclasses.replace(
            state, testing=testing, ground=FoundGround.nothing(self.n), live=self.terrain.initial_state(), instants=(),
            replay=None,
        )  # fmt: skip

    def cancel(self, state: GroundTestState) -> GroundTestState:
        """Return the state with the rest of the request taken back; a wheel that slips returns first."""
        return dataclasses.replace(state, testing=self.active.cancel(state.testing))

    def drop(self, state: GroundTestState) -> GroundTestState:
        """Return the state with everything ended at once, where the torque is taken away or the readings have a gap.

        Earlier tests of the same request count; that which went on, or which was still gone over, does not. The observer
        begins anew.
        """
        return dataclasses.replace(
            state, observed=self.observer.initial_state(), testing=self.active.drop(state.testing),
            live=self.terrain.initial_state(), position=None, under_test=-1, measurement=None, instants=(), replay=None,
        )  # fmt: skip

    def seen(self, state: GroundTestState, position: FloatArray) -> FloatArray:
        """Return joint angles (n, 2) [rad] as odometry and controller are to see them where there is no step."""
        seen = position.copy()
        seen[:, DRIVE] -= state.testing.rolled_ahead[:, DRIVE]
        return seen

    def forecast(self, state: GroundTestState) -> Forecast | None:
        """Return what a request would lead to now; None before the first reading."""
        m = state.measurement
        if m is None:
            return None
        mu_p, lambda_p = FoundGround.nothing(self.n).believed(self.robot)
        m = dataclasses.replace(m, known=np.zeros(self.n, dtype=bool), mu_p=mu_p, lambda_p=lambda_p)
        reasons = [(i, self.active.reason_against(state.testing, m, i)) for i in range(self.n)]
        begins = tuple(i for i, reason in reasons if reason is Refusal.NONE)
        steer_angle = np.ascontiguousarray(m.position[:, STEER])
        return Forecast(
            begins, tuple((i, reason) for i, reason in reasons if reason is not Refusal.NONE),
            tuple(self.active.predict(steer_angle, i, m.normal_force, float(mu_p[i])) for i in begins),
        )  # fmt: skip

    def step(
        self, state: GroundTestState, joints: JointMeasurement, controller_torque: FloatArray, dt: float
    ) -> tuple[GroundTestState, GroundTestOutput]:
        """Compute one cycle.

        Args:
            state: after the cycle before; it is not changed.
            joints: measured now, with the torques since the cycle before.
            controller_torque: what the controller asked for in the cycle before, without what was added (n, 2) [N m].
            dt: measured time since the cycle before [s].

        Returns:
            New state and output.

        Raises:
            EstimationError, TerrainError: a number that is not finite or of a wrong shape, or dt is not positive. The caller
                adds nothing and goes on with `drop`.
        """
        velocity = joints.velocity
        if self.parameters.measured == "angle":
            at_rest = np.zeros((self.n, 2))
            velocity = at_rest if state.position is None else (joints.position - state.position) / dt
        observed, estimate = self.observer.step(state.observed, joints, dt)
        loads = self.terrain.normal_force(np.ascontiguousarray(joints.position[:, STEER]), estimate.force)
        mu_p, lambda_p = state.ground.believed(self.robot)
        m = ActiveMeasurement(
            joints.position, velocity, estimate.force, controller_torque, loads, state.ground.valid.copy(), mu_p, lambda_p
        )
        state = dataclasses.replace(state, observed=observed, position=joints.position, measurement=m)
        state, now = self._tested(state, m, joints, dt)
        state, missed, found = self._evaluated(state)
        output = GroundTestOutput(
            now.torque, now.controller_position, self._speeds(now, joints), missed, now.testing, found, loads
        )
        return state, output

    def _tested(
        self, state: GroundTestState, m: ActiveMeasurement, joints: JointMeasurement, dt: float
    ) -> tuple[GroundTestState, ActiveOutput]:
        """Go on with the test, and note the cycle."""
        caster, testing = state.under_test, state.testing
        live, told = state.live, m
        if caster >= 0:
            live, found = self.terrain.step_with_twist(
                live, joints.position, m.velocity, joints.effort, state.twist, dt, np.arange(self.n) == caster
            )
            told = _with_live(m, found, caster)
        if state.replay is not None and testing.phase is Phase.WAIT:
            testing = dataclasses.replace(testing, elapsed=0.0)  # until the ground of the caster before is known
        testing, now = self.active.step(testing, told, dt)
        instants, replay, ground = state.instants, state.replay, state.ground
        if caster >= 0:
            instants = (*instants, Instant(m, joints.effort.copy(), now.twist.copy(), dt))
            if now.testing != caster:
                live = self.terrain.initial_state()
                if testing.refusal is Refusal.SHAKES:  # the mean of what a friction curve gives is not on the curve
                    instants, ground = (), ground.without_test(caster, testing.refusal.value)
                else:
                    replay = ActiveRecord(self.terrain, self.active, instants).begin(caster)
        state = dataclasses.replace(
            state, testing=testing, live=live, ground=ground, under_test=now.testing, instants=instants, replay=replay,
            twist=now.twist,
        )  # fmt: skip
        return state, now

    def _evaluated(self, state: GroundTestState) -> tuple[GroundTestState, FloatArray, int]:
        """Go over what is left of the last test; returns what odometry has missed (3,), and the caster if that was all."""
        if state.replay is None:
            return state, np.zeros(3), -1
        record = ActiveRecord(self.terrain, self.active, state.instants)
        replay = record.advance(state.replay, self.parameters.replay or ROUNDS * len(state.instants))
        if not replay.finished:
            return dataclasses.replace(state, replay=replay), np.zeros(3), -1
        caster = replay.caster
        assert replay.estimate is not None
        ground = state.ground.with_test(caster, replay.estimate)
        missed = replay.missed if replay.estimate.valid[caster] else np.zeros(3)
        return dataclasses.replace(state, ground=ground, instants=(), replay=None), missed, caster

    def _speeds(self, now: ActiveOutput, joints: JointMeasurement) -> FloatArray:
        """Return the joint speeds that the controller is given; its own drives measure them, whatever the observer does."""
        if self.parameters.measured == "speed" or now.testing >= 0:
            return now.controller_velocity
        return joints.velocity


def shifted(odometry: OdometryState, missed: FloatArray) -> OdometryState:
    """Return the odometry after a motion (3,) [m, m, rad] in base_link that it had missed."""
    c, s = np.cos(odometry.pose[2]), np.sin(odometry.pose[2])
    shift = np.array([c * missed[0] - s * missed[1], s * missed[0] + c * missed[1], missed[2]])
    return dataclasses.replace(odometry, pose=odometry.pose + shift)


def _with_live(measurement: ActiveMeasurement, found: RobotTerrainEstimate, caster: int) -> ActiveMeasurement:
    """Return the measurement with what is known already of the caster under test, so that its test ends in time."""
    if not found.valid[caster]:
        return measurement
    at = np.arange(len(measurement.known)) == caster
    return dataclasses.replace(
        measurement, known=measurement.known | at, mu_p=np.where(at, found.mu_p, measurement.mu_p),
        lambda_p=np.where(at, found.lambda_p, measurement.lambda_p),
    )  # fmt: skip
