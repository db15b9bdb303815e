"""Slip on purpose: one caster at a time is made to slip briefly, while the others keep the robot on its way.

2n - 3 of the 2n contact forces are internal: they lie in the null space of A^T and do not move the robot, A^T dF = 0 (5.3)
[Li2009]. The caster under test is held at a slip ratio that grows from little to much; what the ground gives it, F_i, is more
than the controller asked of it, F_i,ct, and the others take the rest, so that no wheel comes near what it can hold,

    min max_j |dF_j| / (mu_p F_N)_j     where     A_others^T dF_others = -a_i (F_i - F_i,ct),     so that A^T dF = 0,

and d_tau = B^T dF. F_i counts at once, F_i,ct slowly: it is feedback that the others get besides their own, and by which the
controller would bear less delay than without a test. Nobody has what it asks of the wheel under test faster than that.

The increment is added to the controller's torque. The controller must not take the slipping wheel for motion: instead of
the joints that are measured it is given those of wheels that roll (`controller_position`, `controller_velocity`). The others
creep under the forces they take, by the lower root of mu(lambda); where the ground is not known, as much as the first slip of
the test tells. It is taken off too, and casters are driven or braked so that what is left of it cancels out.

That creep is V lambda + L lambda_dot. Its second part, the shear of a tyre as it is loaded, is taken off positions and off the
twist that is told, not off the velocities that controller and wheel are led by. Less their shear these are the body's and no
longer the joints': tyre and observer lie between motor and sensor. With a creep c per friction and the controller's gains k_d
and k_p, that loop has the gain k_d L c s / g, which a soft tyre brings to about 1, and past it an observer that believes in
a stiffer one: the robot shakes at 8 Hz. In the positions the shear is only k_p L c / g, a few percent.

Slip grows exponentially, so that a peak is passed equally slowly wherever it lies. It ends where the ground is known, or at
`greatest_slip`. It does not begin, and ends at once, where it is not safe; see `Refusal` for the reasons. Torques that come
too late for the gains shake the wheels to and fro by more and more, and their mean, by which slip of another wheel is told,
says nothing of it: how far they swing is followed by itself. No wheel is brought back then, as that would be done by the loops
that shake.
"""

from __future__ import annotations

import dataclasses
import enum
import math

import numpy as np

from pcw_description.differential_kinematics import joint_matrix_blocks, wheel_jacobian_kernel
from pcw_description.robot_description import DRIVE, STEER, FloatArray, RobotDescription

from .errors import TerrainError, require, require_dt

# Up to which what the controller asks of the wheel under test is shared among the others [rad/s].
SHARE_RATE = 30.0
# At which the growth of a creep is followed [rad/s].
CREEP_RATE = 100.0
# At which slip that no creep explains is followed; differences of encoder angles are rough [rad/s].
STRAY_RATE = 50.0
# Above which wheel speeds count as going to and fro, and at which their size is followed [rad/s].
SHAKE_RATE, SHAKE_MEMORY = 50.0, 20.0
# Part of a wheel's slip that the twist does not take for motion and by which it is scaled up, at least: noise grows with one
# over its root, and is no more than doubled [1].
LEAST_SHARE = 0.25
# Slip up to which friction is taken as proportional to it [1], and squared friction times speed needed [m^2/s^2].
CREEP_SLIP, LEAST_CREEP = 0.04, 0.01
# How much more a turn counts than a way, at the place of the outermost caster.
TURNING_WEIGHT = 3.0
# Part of what the wheel that holds most can hold, as which one counts that holds next to nothing [1]. How often forces are
# shared anew among the others.
LEAST_HOLD, SHARINGS = 1e-3, 4
# A slip ratio that is commanded is no larger than this [1].
GREATEST_LEAD = 0.7


class Phase(enum.Enum):
    """What is going on."""

    IDLE = "idle"
    WAIT = "wait"
    SLIP = "slip"
    RETURN = "return"
    DONE = "done"
    REFUSED = "refused"


class Refusal(enum.Enum):
    """Why it did not begin, or ended early."""

    NONE = ""
    TOO_FEW_CASTERS = "fewer than three casters: nobody can take the force"
    TOO_SLOW = "too slow for a slip ratio to mean anything"
    TOO_FAST = "too fast to let a wheel go"
    TURNING = "turning, or a caster is"
    TORQUE = "the motors have not enough torque left"
    OTHERS_NEAR_LIMIT = "the other wheels would come too near their own limit"
    DISTURBANCE = "the base would leave its path too far"
    OTHERS_SLIP = "another wheel slips"
    SHAKES = "the wheels shake: torques come too late for the controller's gains"
    TOO_LONG = "it took too long"
    CANCELLED = "cancelled"


# What keeps one caster from being tested, where another one may be.
OF_ONE_CASTER = frozenset(
    {Refusal.TOO_SLOW, Refusal.TOO_FAST, Refusal.TORQUE, Refusal.OTHERS_NEAR_LIMIT, Refusal.DISTURBANCE}
)


@dataclasses.dataclass(frozen=True)
class ActiveParameters:
    """How slip is made, and when it is safe.

    Attributes:
        first_slip, greatest_slip: slip ratio at which it begins to grow, and at which it ends at the latest [1].
        growth: rate at which it grows [1/s].
        enough: it ends once the ground is known and the slip has passed this many times its lambda_p [1].
        return_time: in which the slip goes back to nothing [s].
        settle_time: for which the wheel is held there until the controller has it again [s].
        rest_time: between two casters [s].
        wheel_rate: of the wheel's speed loop, gain over inertia [rad/s]; a wheel that slips shakes where torques come later
            than about 1.5 / wheel_rate.
        wheel_gain: the same as a part of 1 / dt, at most [1].
        wheel_reset: of the same loop's integral [1/s].
        least_speed, greatest_speed: of the wheel that is to slip [m/s].
        greatest_turn_rate: of the robot [rad/s].
        greatest_steer_rate: of any caster [rad/s].
        assumed_friction: peak that a prediction reckons with where none is given [1].
        others_use: part of their friction, as it is believed to be, up to which others may be loaded [1].
        others_slip: slip ratio of another wheel at which it ends, for good or as a root mean square to and fro [1].
        torque_reserve: part of a motor's torque that may be needed by what is believed, which is known to some percent [1].
        longest: of one caster [s].
        force_error: part of a force that is not compensated, for the prediction of the disturbance [1].
        stiffness: k_p of the controller's pose feedback, for the same [1/s^2]; 0: none.
        greatest_path: predicted disturbance of the base's path beyond which it does not begin [m].
    """

    first_slip: float = 0.03
    greatest_slip: float = 0.5
    growth: float = 4.0
    enough: float = 1.8
    return_time: float = 0.1
    settle_time: float = 0.1
    rest_time: float = 0.05
    wheel_rate: float = 100.0
    wheel_gain: float = 0.3
    wheel_reset: float = 20.0
    least_speed: float = 0.12
    greatest_speed: float = 0.8
    greatest_turn_rate: float = 0.4
    greatest_steer_rate: float = 1.5
    assumed_friction: float = 0.8
    others_use: float = 0.85
    others_slip: float = 0.15
    torque_reserve: float = 1.05
    longest: float = 1.5
    force_error: float = 0.15
    stiffness: float = 100.0
    greatest_path: float = 0.005

    def __post_init__(self) -> None:
        """Check the parameters.

        Raises:
            TerrainError: names the field, its value and what is allowed.
        """
        require("first_slip", self.first_slip, above=0.0, maximum=0.2)
        require("greatest_slip", self.greatest_slip, above=self.first_slip, maximum=0.8)
        for name in ("growth", "return_time", "wheel_rate", "wheel_gain", "least_speed", "assumed_friction", "longest"):
            require(name, getattr(self, name), above=0.0)
        require("greatest_speed", self.greatest_speed, above=self.least_speed)
        require("enough", self.enough, minimum=1.0)
        for name in ("settle_time", "rest_time", "wheel_reset", "force_error", "stiffness"):
            require(name, getattr(self, name), minimum=0.0)
        for name in ("greatest_turn_rate", "greatest_steer_rate", "greatest_path"):
            require(name, getattr(self, name), above=0.0)
        for name in ("others_use", "others_slip"):
            require(name, getattr(self, name), above=0.0, maximum=1.0)
        require("torque_reserve", self.torque_reserve, above=0.0, maximum=1.5)


@dataclasses.dataclass(frozen=True)
class ActiveMeasurement:
    """What is known at one cycle.

    Attributes:
        position, velocity: of the joints (n, 2) [rad], [rad/s].
        force: of the ground on the wheels (n, 2) [N], from a slip observer.
        controller_torque: what the controller asked for in the cycle before, without an increment (n, 2) [N m].
        normal_force: (n,) [N].
        known: of which casters the ground is known (n,).
        mu_p, lambda_p: of the ground, as it is believed to be where it is not known (n,) [1].
    """

    position: FloatArray
    velocity: FloatArray
    force: FloatArray
    controller_torque: FloatArray
    normal_force: FloatArray
    known: np.ndarray
    mu_p: FloatArray
    lambda_p: FloatArray


@dataclasses.dataclass(frozen=True)
class ActiveState:
    """What it remembers.

    Attributes:
        phase: what is going on.
        queue: casters still to be tested, the first one now.
        elapsed: in this phase [s].
        slip: wanted slip ratio, with its sign [1].
        integral: of the wheel's speed loop [N m].
        asked: by the controller of the wheel under test, slowly: what the others take over of it [N].
        rolled_ahead: by how much the joints have turned further than wheels that roll would have (n, 2) [rad].
        creep: slip ratios that the forces take, filtered (n, 2) [1].
        smooth: speeds of the wheels, along and across, without what is fast of them (n, 2) [m/s].
        swings: mean squares of what is fast, forwards and back (2, n, 2) [m^2/s^2].
        strays: what the common twist leaves of the velocities of the others, creep taken off, filtered (n,) [m/s].
        creep_sums: of slip and of what friction feigns, each times the wanted slip, at the beginning of the test, and the
            relaxed slip (3,).
        spent: sum of the wrenches so far of the casters under test, for a force of 1 (3,) [1, 1, m].
        backwards: whether the one under test is braked.
        refusal: why it ended early.
        tested: casters whose test has begun; refused: those that were left out, each with its reason.
    """

    phase: Phase
    queue: tuple[int, ...]
    elapsed: float
    slip: float
    integral: float
    asked: float
    rolled_ahead: FloatArray
    creep: FloatArray
    smooth: FloatArray
    swings: FloatArray
    strays: FloatArray
    creep_sums: FloatArray
    spent: FloatArray
    backwards: bool
    refusal: Refusal
    tested: tuple[int, ...] = ()
    refused: tuple[tuple[int, Refusal], ...] = ()


@dataclasses.dataclass(frozen=True)
class ActiveOutput:
    """What one cycle gives.

    Attributes:
        torque: to be added to the controller's (n, 2) [N m].
        controller_position, controller_velocity: joints as the controller should see them (n, 2) [rad], [rad/s]; the
            velocity is not the derivative of the position, see the module's docstring.
        twist: of base_link, from the casters that are not under test, less the slip that their forces take (3,).
        testing: index of the caster under test, or -1.
        net_wrench: A^T dF, with F_i,ct as slow as the others get it, which is nothing but rounding (3,) [N, N, N m].
        others_use: greatest part of their friction that the others are asked for [1].
    """

    torque: FloatArray
    controller_position: FloatArray
    controller_velocity: FloatArray
    twist: FloatArray
    testing: int
    net_wrench: FloatArray
    others_use: float


@dataclasses.dataclass(frozen=True)
class Disturbance:
    """What a test of one caster is expected to do to the base.

    Attributes:
        force: greatest internal force [N].
        path: by which the base leaves its path [m].
        yaw: by which it turns [rad].
        others_use: greatest part of their friction that the others need [1].
    """

    force: float
    path: float
    yaw: float
    others_use: float


class ActiveIdentification:
    """Makes one caster after another slip; see the module's docstring.

    Args:
        robot: the robot.
        parameters: how, and when it is safe.

    Raises:
        KinematicsError: a caster without offset, which cannot push sideways.
        TerrainError: fewer than three casters.
    """

    def __init__(self, robot: RobotDescription, parameters: ActiveParameters | None = None) -> None:
        robot.require_torque_control()
        if robot.n < 3:
            raise TerrainError(f"{robot.name} has {robot.n} casters; allowed: at least 3, {Refusal.TOO_FEW_CASTERS.value}")
        self.robot, self.parameters, self.n = robot, parameters or ActiveParameters(), robot.n
        self._B = joint_matrix_blocks(robot)
        self._B_inverse = np.linalg.inv(self._B)
        self._inertia = np.array(
            [c.wheel.inertia_axle + float(robot.armature[i, DRIVE, DRIVE]) for i, c in enumerate(robot.casters)]
        )

        self._relaxation = np.array([tyre.relaxation_length for tyre in robot.tyres])

    def initial_state(self) -> ActiveState:
        """Return the state in which nothing goes on."""
        return ActiveState(
            Phase.IDLE,
            (),
            0.0,
            0.0,
            0.0,
            0.0,
            np.zeros((self.n, 2)),
            np.zeros((self.n, 2)),
            np.zeros((self.n, 2)),
            np.zeros((2, self.n, 2)),
            np.zeros(self.n),
            np.zeros(3),
            np.zeros(3),
            False,
            Refusal.NONE,
        )

    def request(self, state: ActiveState, casters: tuple[int, ...] | None = None) -> ActiveState:
        """Return the state with the test of some casters, all by default, asked for.

        One that cannot be tested as the robot stands and drives waits until the others have been, which tell of the ground; if
        it cannot be tested then either it is left out, with its reason in `refused`.

        Raises:
            TerrainError: a caster that the robot does not have.
        """
        queue = tuple(range(self.n)) if casters is None else tuple(casters)
        if not queue or any(not 0 <= index < self.n for index in queue):
            raise TerrainError(f"casters = {queue!r} is not allowed; allowed: indices 0 to {self.n - 1}, at least one")
        return dataclasses.replace(
            state, phase=Phase.WAIT, queue=queue, elapsed=0.0, slip=0.0, spent=np.zeros(3), refusal=Refusal.NONE, tested=(),
            refused=(),
        )  # fmt: skip

    def cancel(self, state: ActiveState) -> ActiveState:
        """Return the state with everything asked for taken back; a wheel that slips returns first."""
        if state.phase in (Phase.IDLE, Phase.DONE, Phase.REFUSED):
            return state
        if state.phase is Phase.SLIP:
            return self._ended(state, Refusal.CANCELLED)
        return dataclasses.replace(state, queue=state.queue[:1], refusal=Refusal.CANCELLED)

    def drop(self, state: ActiveState) -> ActiveState:
        """Return the state with all ended at once and no wheel brought back: for where the torque is taken away.

        Joints are seen as before, without a jump: `rolled_ahead` stays.
        """
        if state.phase in (Phase.IDLE, Phase.DONE, Phase.REFUSED):
            return state
        return self._dropped(state, Refusal.CANCELLED)

    def reason_against(self, state: ActiveState, measurement: ActiveMeasurement, caster: int) -> Refusal:
        """Return why the test of a caster would not begin now; `Refusal.NONE` where it would.

        Args:
            state: as it is, without a request.
            measurement: what is known now.
            caster: its index.

        Raises:
            TerrainError: as `request` and `step`.
        """
        p = self.parameters
        asked = dataclasses.replace(self.request(state, (caster,)), elapsed=p.rest_time)
        after, _ = self.step(asked, measurement, 1e-6)
        return Refusal.NONE if after.phase is Phase.SLIP else dict(after.refused).get(caster, after.refusal)

    def predict(
        self, steer_angle: FloatArray, caster: int, normal_force: FloatArray, mu_p: float | None = None
    ) -> Disturbance:
        """Return what the test of a caster will do to the base.

        The force that is not compensated, `force_error` of the peak, works against the controller's stiffness; without one
        it works for the time of the test, and against the mass alone.
        """
        p = self.parameters
        mu = p.assumed_friction if mu_p is None else mu_p
        A = wheel_jacobian_kernel(self.robot.steer_axis, self.robot.caster_offset, np.ascontiguousarray(steer_angle))
        force = np.array([mu * float(normal_force[caster]), 0.0])
        others = self._others(A, caster, force, normal_force)
        left = p.force_error * (A[2 * caster : 2 * caster + 2].T @ force)
        mass = self.robot.total_mass
        reach = float(np.mean(np.sum(self.robot.steer_axis**2, axis=1)))
        inertia = self.robot.chassis.inertia_zz + (mass - self.robot.chassis.mass) * reach
        time = math.log(p.greatest_slip / p.first_slip) / p.growth
        gain = 1.0 / p.stiffness if p.stiffness > 0.0 else 0.5 * time * time
        use = np.linalg.norm(others, axis=1) / np.maximum(np.delete(normal_force, caster) * mu, 1e-9)
        return Disturbance(
            force=float(np.abs(force).max()), path=float(np.hypot(left[0], left[1]) / mass * gain),
            yaw=float(abs(left[2]) / inertia * gain), others_use=float(use.max()),
        )  # fmt: skip

    def step(self, state: ActiveState, measurement: ActiveMeasurement, dt: float) -> tuple[ActiveState, ActiveOutput]:
        """Compute one cycle.

        Args:
            state: after the cycle before; it is not changed.
            measurement: what is known now.
            dt: measured time since the cycle before [s].

        Returns:
            New state, and the increment; it is zero where nothing goes on.

        Raises:
            TerrainError: a number that is not finite or of a wrong shape, or dt is not positive. The caller keeps its state
                and adds no increment, which lets the wheel grip again.
        """
        require_dt(dt)
        self._check(measurement)
        p, m = self.parameters, self._with_creep(state, measurement)
        steer_angle = np.ascontiguousarray(m.position[:, STEER])
        A = wheel_jacobian_kernel(self.robot.steer_axis, self.robot.caster_offset, steer_angle)
        sensed = np.einsum("nij,nj->ni", self._B, m.velocity)
        state, steady, shear = self._creep(self._followed(state, sensed, dt), m, sensed, dt)
        busy = state.phase in (Phase.WAIT, Phase.SLIP, Phase.RETURN)
        rolled = sensed - steady if busy else sensed
        moved = rolled - shear if busy else sensed
        testing = state.queue[0] if state.phase in (Phase.SLIP, Phase.RETURN) else -1
        twist = self._twist(A, moved, testing)
        state = dataclasses.replace(state, elapsed=state.elapsed + dt)
        if testing >= 0 and self._shakes(np.delete(state.swings, testing, axis=1), float(A[2 * testing] @ twist)):
            # Nothing is brought back by the loops that shake.
            state, testing = self._dropped(state, Refusal.SHAKES), -1
        if state.phase is Phase.WAIT and (state.refusal is Refusal.CANCELLED or state.elapsed >= p.rest_time):
            state = self._begin(state, m, A, twist)
            testing = state.queue[0] if state.phase is Phase.SLIP else -1
        if testing < 0:
            seen = np.einsum("nij,nj->ni", self._B_inverse, rolled)
            rolls = np.einsum("nij,nj->ni", self._B_inverse, moved)
            state = dataclasses.replace(state, rolled_ahead=state.rolled_ahead + (m.velocity - rolls) * dt)
            return state, ActiveOutput(np.zeros((self.n, 2)), self._seen_position(state, m), seen, twist, -1, np.zeros(3), 0.0)
        return self._slip(state, m, A, sensed, rolled, moved, testing, dt)

    def _begin(self, state: ActiveState, m: ActiveMeasurement, A: FloatArray, twist: FloatArray) -> ActiveState:
        refusal = state.refusal if state.refusal is Refusal.CANCELLED else self._unsafe(state, m, A, twist)
        before = tuple(entry for entry in state.refused if entry[0] != state.queue[0])
        if refusal in OF_ONE_CASTER:
            refused = (*before, (state.queue[0], refusal))
            # Once the others have told of the ground more may be possible.
            again = state.queue[:1] if len(before) == len(state.refused) else ()
            if queue := (*state.queue[1:], *again):
                return dataclasses.replace(state, queue=queue, refused=refused)
            phase = Phase.DONE if state.tested else Phase.REFUSED
            return dataclasses.replace(state, phase=phase, queue=(), elapsed=0.0, refusal=refusal, refused=refused)
        if refusal is not Refusal.NONE:
            return dataclasses.replace(state, phase=Phase.REFUSED, queue=(), elapsed=0.0, refusal=refusal)
        # Driven or braked: whichever makes up for what those before have left, turning first.
        wrench = A[2 * state.queue[0]]
        weight = np.array([1.0, 1.0, TURNING_WEIGHT / max(float(np.abs(self.robot.steer_axis).max()), 1e-6)])
        sizes = [float(np.linalg.norm(weight * (state.spent + sign * wrench))) for sign in (1.0, -1.0)]
        backwards = sizes[1] < sizes[0]
        spent = state.spent + (-wrench if backwards else wrench)
        return dataclasses.replace(
            state,
            phase=Phase.SLIP,
            elapsed=0.0,
            slip=0.0,
            integral=0.0,
            asked=self._asked(m, state.queue[0]),
            strays=np.zeros(self.n),
            creep_sums=np.zeros(3),
            backwards=backwards,
            spent=spent,
            tested=(*state.tested, state.queue[0]),
            refused=before,
        )

    def _unsafe(self, state: ActiveState, m: ActiveMeasurement, A: FloatArray, twist: FloatArray) -> Refusal:
        p, caster = self.parameters, state.queue[0]
        speed = abs(float(A[2 * caster] @ twist))
        if self._shakes(state.swings, speed):
            return Refusal.SHAKES
        if speed < p.least_speed:
            return Refusal.TOO_SLOW
        if speed > p.greatest_speed:
            return Refusal.TOO_FAST
        if abs(twist[2]) > p.greatest_turn_rate or np.abs(m.velocity[:, STEER]).max() > p.greatest_steer_rate:
            return Refusal.TURNING
        force = np.array([float(m.mu_p[caster] * m.normal_force[caster]), 0.0])
        if force[0] * self.robot.wheel_radius[caster] > p.torque_reserve * self.robot.torque_limit[caster, DRIVE]:
            return Refusal.TORQUE
        loads, mu_p = m.normal_force, float(m.mu_p[caster])
        if self.predict(np.ascontiguousarray(m.position[:, STEER]), caster, loads, mu_p).path > p.greatest_path:
            return Refusal.DISTURBANCE
        others = self._others(A, caster, force, m.mu_p * m.normal_force)
        index = np.delete(np.arange(self.n), caster)
        use = np.linalg.norm(others, axis=1) / np.maximum(m.mu_p[index] * m.normal_force[index], 1e-9)
        return Refusal.OTHERS_NEAR_LIMIT if use.max() > p.others_use else Refusal.NONE

    def _slip(
        self, state: ActiveState, m: ActiveMeasurement, A: FloatArray, sensed: FloatArray, rolled: FloatArray,
        moved: FloatArray, testing: int, dt: float,
    ) -> tuple[ActiveState, ActiveOutput]:  # fmt: skip
        p = self.parameters
        twist, guide = self._twist(A, moved, testing), self._twist(A, rolled, testing)
        velocity, slip_before = float(A[2 * testing] @ guide), state.slip
        if state.phase is Phase.SLIP:
            size = p.first_slip * math.expm1(p.growth * state.elapsed)
            known = bool(m.known[testing]) and size > p.enough * float(m.lambda_p[testing])
            stray = (moved - (A @ twist).reshape(-1, 2))[:, 0]
            stray[testing] = 0.0
            strays = state.strays - math.expm1(-STRAY_RATE * dt) * (stray - state.strays)
            state = dataclasses.replace(state, strays=strays)
            if self._slip_of_another(A, strays, testing) > p.others_slip * max(abs(velocity), p.least_speed):
                state = self._ended(state, Refusal.OTHERS_SLIP)
            elif state.elapsed > p.longest:
                state = self._ended(state, Refusal.TOO_LONG)
            elif size > p.greatest_slip or known:
                state = dataclasses.replace(state, phase=Phase.RETURN, elapsed=0.0)
            else:
                state = dataclasses.replace(state, slip=-size if state.backwards else size)
        else:
            slip = state.slip * max(0.0, 1.0 - dt / max(p.return_time - state.elapsed + dt, dt))
            state = dataclasses.replace(state, slip=slip)
        if state.phase is Phase.SLIP and abs(state.slip) <= CREEP_SLIP:
            state = self._learn_creep(state, m, A, sensed, testing, velocity, dt)
        # The tyre follows over its relaxation length: to let go in time the wheel goes ahead of what is wanted of the tyre.
        lead = self._relaxation[testing] / max(abs(velocity), p.least_speed) * (state.slip - slip_before) / dt
        lead = lead if state.phase is Phase.RETURN else 0.0
        slip = min(max(state.slip + lead, -GREATEST_LEAD), GREATEST_LEAD)
        # (3.43): driving, v = (1 - lambda) r rho_dot; braking, r rho_dot = (1 + lambda) v.
        rolling = velocity / (1.0 - slip) if slip >= 0.0 else velocity * (1.0 + slip)
        led = float((self._B_inverse[testing] @ A[2 * testing : 2 * testing + 2] @ guide)[DRIVE])
        wanted = led + (rolling - velocity) / self.robot.wheel_radius[testing]
        error = wanted - m.velocity[testing, DRIVE]
        gain = min(p.wheel_rate, p.wheel_gain / dt) * self._inertia[testing]
        limit = self.robot.torque_limit[testing, DRIVE]
        integral = float(np.clip(state.integral + gain * p.wheel_reset * error * dt, -limit, limit))
        torque = np.zeros((self.n, 2))
        # What the ground takes is given to the wheel at once: past its peak it lets go faster than a loop could follow.
        carried = self.robot.wheel_radius[testing] * float(m.force[testing, 0])
        torque[testing, DRIVE] = gain * error + integral + carried - m.controller_torque[testing, DRIVE]
        asked = state.asked - math.expm1(-SHARE_RATE * dt) * (self._asked(m, testing) - state.asked)
        more = np.array([float(m.force[testing, 0]) - asked, 0.0])
        others = self._others(A, testing, more, m.mu_p * m.normal_force)
        index = np.delete(np.arange(self.n), testing)
        torque[index] = np.einsum("nji,nj->ni", self._B[index], others)
        force = np.zeros((self.n, 2))
        force[testing], force[index] = more, others
        use = np.linalg.norm(others, axis=1) / np.maximum(m.normal_force[index] * m.mu_p[index], 1e-9)
        seen = np.einsum("nij,nj->ni", self._B_inverse, rolled)
        seen[testing, DRIVE] = led
        rolls = np.einsum("nij,nj->ni", self._B_inverse, moved)
        rolls[testing] = self._B_inverse[testing] @ A[2 * testing : 2 * testing + 2] @ twist
        ahead = state.rolled_ahead + (m.velocity - rolls) * dt
        state = dataclasses.replace(state, integral=integral, asked=asked, rolled_ahead=ahead)
        output = ActiveOutput(
            torque, self._seen_position(state, m), seen, twist, testing, A.T @ force.ravel(), float(use.max())
        )
        if state.phase is Phase.RETURN and state.elapsed >= p.return_time + p.settle_time:
            state = self._next(state)
        return state, output

    def _next(self, state: ActiveState) -> ActiveState:
        queue = state.queue[1:]
        if state.refusal is not Refusal.NONE:
            return dataclasses.replace(state, phase=Phase.REFUSED, queue=(), elapsed=0.0, slip=0.0)
        phase = Phase.WAIT if queue else Phase.DONE
        return dataclasses.replace(state, phase=phase, queue=queue, elapsed=0.0, slip=0.0)

    @staticmethod
    def _ended(state: ActiveState, refusal: Refusal) -> ActiveState:
        return dataclasses.replace(state, phase=Phase.RETURN, elapsed=0.0, refusal=refusal)

    @staticmethod
    def _dropped(state: ActiveState, refusal: Refusal) -> ActiveState:
        return dataclasses.replace(state, phase=Phase.REFUSED, queue=(), elapsed=0.0, slip=0.0, integral=0.0, refusal=refusal)

    @staticmethod
    def _followed(state: ActiveState, sensed: FloatArray, dt: float) -> ActiveState:
        """Return the state with one more reading of how far wheel speeds go to and fro."""
        smooth = state.smooth - math.expm1(-SHAKE_RATE * dt) * (sensed - state.smooth)
        fast = sensed - smooth
        squares = np.maximum([fast, -fast], 0.0) ** 2
        swings = state.swings - math.expm1(-SHAKE_MEMORY * dt) * (squares - state.swings)
        return dataclasses.replace(state, smooth=smooth, swings=swings)

    def _shakes(self, swings: FloatArray, speed: float) -> bool:
        """Return whether one of some wheels goes to and fro by more than a wheel may slip that is not under test.

        Root mean square. The body is too heavy to follow: what wheels do so fast is slip. One that lets go, or grips again,
        swings one way; so twice the lesser of both mean squares counts, which of what goes to and fro is all of it.

        Args:
            swings: as in `ActiveState`, of these wheels.
            speed: of the one that is under test, or would be [m/s].
        """
        p = self.parameters
        size = math.sqrt(2.0 * float(swings.min(axis=0).max()))
        return size > p.others_slip * max(abs(speed), p.least_speed)

    def _asked(self, m: ActiveMeasurement, caster: int) -> float:
        """Return the force along its wheel that the controller asks of a caster [N]."""
        return float((self._B_inverse[caster].T @ m.controller_torque[caster])[DRIVE])

    def _others(self, A: FloatArray, caster: int, force: FloatArray, hold: FloatArray) -> FloatArray:
        """Return the forces of the others (n - 1, 2) [N] that leave no wrench with `force` (2,) of a caster.

        Those of which the greatest is least, in proportion to what each wheel can hold, `hold` (n,): least squares with
        weights that grow with what each takes (Lawson, 1961), a few times over.
        """
        rows = np.ones(2 * self.n, dtype=bool)
        rows[2 * caster : 2 * caster + 2] = False
        wrench = A[2 * caster : 2 * caster + 2].T @ force
        rest, hold = A[rows], np.delete(np.maximum(hold, LEAST_HOLD * hold.max()), caster)
        weight, others = np.ones(self.n - 1), np.zeros((self.n - 1, 2))
        for _ in range(SHARINGS):
            give = np.repeat(hold**2 / weight, 2)[:, None]
            others = -(give * rest @ np.linalg.solve(rest.T @ (give * rest), wrench)).reshape(-1, 2)
            weight *= np.linalg.norm(others, axis=1) / hold
            weight = np.maximum(weight / max(float(weight.max()), 1e-300), LEAST_HOLD)
        return others

    def _learn_creep(
        self, state: ActiveState, m: ActiveMeasurement, A: FloatArray, sensed: FloatArray, testing: int, velocity: float,
        dt: float,
    ) -> ActiveState:  # fmt: skip
        """Return the state with one more reading of slip over friction, while both are small and proportional.

        The others' creep per friction, c, is that of the wheel under test: eps_i = s_i + c a_i . T, where s_i is its slip
        against the others as they are measured and T the twist that their friction would feign with c = 1. As eps_i is also
        c |v| mu_i, c follows from s_i = c (|v| mu_i - a_i . T).
        """
        friction = m.force / np.maximum(m.normal_force, 1e-9)[:, None] * np.linalg.norm(sensed, axis=1)[:, None]
        apart = float(sensed[testing, 0] - A[2 * testing] @ self._twist(A, sensed, testing))
        feigned = float(friction[testing, 0] - A[2 * testing] @ self._twist(A, friction, testing))
        # Forces answer over the tyre's relaxation length, and so the slip has to.
        rate = max(abs(velocity), self.parameters.least_speed) / max(self._relaxation[testing], 1e-6)
        product, square, relaxed = state.creep_sums
        relaxed -= math.expm1(-rate * dt) * (apart - relaxed)
        # The slip that is wanted goes along with both and has no noise: an instrument, by which c is not biased.
        sums = np.array([product + state.slip * relaxed, square + state.slip * feigned, relaxed])
        return dataclasses.replace(state, creep_sums=sums)

    def _with_creep(self, state: ActiveState, m: ActiveMeasurement) -> ActiveMeasurement:
        """Return the measurement with the ground that is only believed in made to fit the creep that was felt."""
        product, square, _ = state.creep_sums
        if state.phase not in (Phase.SLIP, Phase.RETURN) or square <= LEAST_CREEP or product <= 0.0:
            return m
        lambda_p = np.where(m.known, m.lambda_p, np.clip(2.0 * m.mu_p * product / square, 0.01, 1.0))
        return dataclasses.replace(m, lambda_p=lambda_p)

    def twist_of_others(
        self, state: ActiveState, measurement: ActiveMeasurement, testing: int, dt: float
    ) -> tuple[ActiveState, FloatArray]:
        """Return the twist (3,) by the casters that are not under test, and the state with their creep."""
        A = wheel_jacobian_kernel(
            self.robot.steer_axis, self.robot.caster_offset, np.ascontiguousarray(measurement.position[:, STEER])
        )
        sensed = np.einsum("nij,nj->ni", self._B, measurement.velocity)
        state, steady, shear = self._creep(state, measurement, sensed, dt)
        return state, self._twist(A, sensed - steady - shear, testing)

    def _creep(
        self, state: ActiveState, m: ActiveMeasurement, sensed: FloatArray, dt: float
    ) -> tuple[ActiveState, FloatArray, FloatArray]:
        """Return the creep V lambda and the shear L lambda_dot (n, 2) [m/s] that the forces take on the lower root of (3.47).

        The slip velocity is their sum, with the tyre's relaxation length L; see `pcw_description.contact.contact_model`.
        """
        force = np.linalg.norm(m.force, axis=1)
        use = np.minimum(force / np.maximum(m.mu_p * m.normal_force, 1e-9), 0.95)
        size = m.lambda_p * use / (1.0 + np.sqrt(1.0 - use * use))
        slip = (size / np.maximum(force, 1e-9))[:, None] * m.force
        grows = CREEP_RATE * (slip - state.creep)
        state = dataclasses.replace(state, creep=state.creep + -math.expm1(-CREEP_RATE * dt) * (slip - state.creep))
        speed = np.linalg.norm(sensed, axis=1)
        return state, speed[:, None] * slip, self._relaxation[:, None] * grows

    def _twist(self, A: FloatArray, sensed: FloatArray, testing: int) -> FloatArray:
        rows = np.ones(2 * self.n, dtype=bool)
        if testing >= 0:
            rows[2 * testing : 2 * testing + 2] = False
        rest = A[rows]
        return np.asarray(np.linalg.solve(rest.T @ rest, rest.T @ sensed.ravel()[rows]), dtype=np.float64)

    def _slip_of_another(self, A: FloatArray, strays: FloatArray, testing: int) -> float:
        """Return how fast one of the others slips against the rest of them [m/s], from what the twist leaves of each (n,).

        A wheel that slips by eps also draws the twist after it: of eps is left the share 1 - h_ii, with the projection
        H = A (A^T A)^-1 A^T of those that the twist is from, and -h_ij of it at the others. The one that slips is that of
        the greatest |stray| / sqrt(1 - h_ii), the outlier of least squares; stray / (1 - h_ii) is its eps.
        """
        drive, rest = A[::2], np.delete(A, (2 * testing, 2 * testing + 1), axis=0)
        share = 1.0 - np.einsum("ij,ji->i", drive, np.linalg.solve(rest.T @ rest, drive.T))
        share = np.maximum(share, LEAST_SHARE)
        outlier = int(np.argmax(np.abs(strays) / np.sqrt(share)))
        return float(abs(strays[outlier]) / share[outlier])

    @staticmethod
    def _seen_position(state: ActiveState, m: ActiveMeasurement) -> FloatArray:
        position = m.position.copy()
        # The heading is what it is, however the caster came there.
        position[:, DRIVE] -= state.rolled_ahead[:, DRIVE]
        return position

    def _check(self, m: ActiveMeasurement) -> None:
        per_joint = ("position", "velocity", "force", "controller_torque")
        for name in (*per_joint, "normal_force", "mu_p", "lambda_p"):
            values, shape = getattr(m, name), (self.n, 2) if name in per_joint else (self.n,)
            if values.shape != shape or not np.isfinite(values).all():
                raise TerrainError(f"{name} = {values.tolist()} is not allowed; allowed: finite numbers, shape {shape}")
