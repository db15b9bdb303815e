"""Force-guided driving: a measured push moves the robot; unified force and motion control, UFM-SCFC, table 5.5 [Li2009].

    F_u = Lambda (Omega F_m + (I - Omega) F_f) + theta + F_sensor,      F_p = (A^T)^+ F_u + (I - (A^T)^+ A^T) f_o

Omega selects the axes of base_link in which motion is controlled, by computed torque; the others follow the push f. There the
robot behaves like a body of mass M with friction D, whose twist V_f is the thesis's virtual velocity, the integral of F_f:

    M V_f_dot = f + u - D V_f,      F_f = V_f_dot + k_v (V_f - V),      u = -f_d + k_fi int (f - f_d) dt

F_sensor = -f, because the push acts on the robot as well. What differs from the table:

* f_o = k (A V_f - B q_dot) is projected to internal forces, and (I - A A^+) A V_f = 0: the table's virtual slip velocity is
  what encoders see of slip. So f_o is the slip constraint force, and V_f is followed by k_v instead, on and off the ground.
* k_fi and f_d make the robot push back with a motor's energy. They draw it from a tank that only the friction D fills, and
  get nothing when it is empty.

Energy is never injected. A step takes V_f at its middle, where f . V_f dt = d(M V_f^2 / 2) + D V_f^2 dt - u . V_f dt holds
exactly, and u . V_f dt comes out of the tank T; so M V_f^2 / 2 + T never grows by more than f puts in. What the robot makes of
V_f is watched by an energy observer, W += f . V dt with the odometric twist V, never more than what a passive robot would have
stored: should W be used up, the robot stops giving way backwards.

The guards: a push beyond `force_limit` is a collision or a broken sensor, and stops the robot until the push has gone;
`speed_limit`, `yaw_rate_limit` and the joints' own limits bound V_f, and `power_limit` bounds f . V_f. Whatever slows V_f down
takes energy out. Without a measured push the robot comes to rest.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any, ClassVar, Self

import numpy as np

from pcw_description.compiled import compiled
from pcw_description.robot_description import FloatArray, RobotDescription

from .computed_torque import ComputedTorque, ComputedTorqueParameters, ComputedTorqueState, Demand
from .controller_interface import (
    ControllerMeasurement,
    ControllerOutput,
    ForceReference,
    Reference,
    choice,
    output_kernel,
    parameter,
    replaced,
)
from .delay_margin import DELAY
from .force_distribution import solve_kernel
from .reference_motion import largest_joint_speed_kernel
from .slip_constraint_force import SlipConstraintForce, SlipConstraintParameters

# What guards V_f in a cycle; the last in this order that acted is reported.
GUARDS = ("none", "speed", "power", "energy", "no_push", "force")
_NONE, _SPEED, _POWER, _ENERGY, _NO_PUSH, _FORCE = range(len(GUARDS))
# Share of the robot's own mass that the operator feels, where nothing else is said.
FELT_SHARE = 1.0 / 3.0
# A tripped force guard is released when the push falls below this part of its limit.
RELEASED = 0.1
_TANK, _STORED, _TRIPPED, _GUARD = range(4)
_ZERO = np.zeros(3)


@dataclasses.dataclass(frozen=True)
class ForceGuidedParameters(ComputedTorqueParameters):
    """Gains of computed torque, and how the robot gives way.

    Attributes:
        virtual_mass: M of the translation [kg]; 0: a third of the robot's own.
        virtual_inertia: M of the rotation [kg m^2]; 0: a third of the robot's own.
        coasting_time: M / D, in which a robot that is let go loses most of its speed [s].
        tracking_gain: k_v [1/s].
        force_integral: k_fi [1/s]; 0: none, and no energy is ever asked for.
        deadband: push that does not move the robot [N], [N m] alike.
        tank: largest energy that is kept for u [J].
        force_limit: push that trips the guard [N].
        speed_limit, yaw_rate_limit: of V_f [m/s], [rad/s].
        power_limit: largest power that the operator may put in [W].
        force_controlled: 1 for the axes x, y, yaw of base_link that follow the push, 0 for those that follow motion.
        slip: how slip is held.
    """

    uses: ClassVar[frozenset[str]] = frozenset({"external_wrench"})

    virtual_mass: float = parameter(0.0, "kg", "mass that the operator feels; 0: a third of the robot's")
    virtual_inertia: float = parameter(0.0, "kg m^2", "inertia that the operator feels; 0: a third of the robot's")
    coasting_time: float = parameter(1.0, "s", "time constant of coasting", above=0.0, maximum=100.0)
    tracking_gain: float = parameter(20.0, "1/s", "gain on the error of the guided twist", maximum=200.0)
    force_integral: float = parameter(0.0, "1/s", "integral gain on the push, paid from the tank", maximum=100.0)
    deadband: float = parameter(1.0, "N", "push that does not move the robot", maximum=1e3)
    tank: float = parameter(2.0, "J", "largest energy kept for what the friction has taken out", maximum=1e3)
    force_limit: float = parameter(150.0, "N", "push that stops the robot", above=0.0)
    speed_limit: float = parameter(0.8, "m/s", "largest guided speed", above=0.0, maximum=10.0)
    yaw_rate_limit: float = parameter(1.0, "rad/s", "largest guided yaw rate", above=0.0, maximum=10.0)
    power_limit: float = parameter(60.0, "W", "largest power of the push", above=0.0)
    force_controlled: tuple[float, float, float] = choice(
        (1.0, 1.0, 1.0), (0.0, 1.0), "1 for each of x, y, yaw that follows the push, 0 for each that follows motion"
    )
    slip: SlipConstraintParameters = dataclasses.field(default_factory=SlipConstraintParameters)

    @classmethod
    def of_robot(cls, robot: RobotDescription, delay: float = DELAY) -> Self:
        """Return the gains of a robot; k_v closes the same loop as k_d does, so it is the same number."""
        plain = super().of_robot(robot, delay)
        return dataclasses.replace(plain, tracking_gain=plain.velocity_gain)


@dataclasses.dataclass(frozen=True)
class ForceGuidedState(ComputedTorqueState):
    """What is remembered besides what computed torque does.

    Attributes:
        guided_twist: V_f (3,).
        impulse: integral of f - f_d (3,) [N s, N s, N m s].
        energy: in the tank and of the energy observer [J], whether the force guard has tripped, index of GUARDS (4,).
    """

    guided_twist: FloatArray
    impulse: FloatArray
    energy: FloatArray


@dataclasses.dataclass(frozen=True)
class SlipHoldingGuidedState(ForceGuidedState):
    """As `ForceGuidedState`, and the integral of the slip (n, 2) [m]."""

    slip_integral: FloatArray


@dataclasses.dataclass(frozen=True)
class ForceGuidedOutput(ControllerOutput):
    """As every controller's.

    Attributes:
        guided_twist: V_f (3,).
        stored_energy: what the operator could have back [J]; never below zero by more than one cycle brings.
        guard: what held V_f back, one of GUARDS.
    """

    guided_twist: FloatArray
    stored_energy: float
    guard: str


class UnifiedForceMotion(ComputedTorque):
    """UFM: gives way to a push in the axes that are force controlled, without holding slip.

    Of a `ForceReference` the wrench is f_d; any other reference is one of motion, with f_d = 0.
    """

    parameters: ForceGuidedParameters
    _state_type: type[Any] = ForceGuidedState

    def __init__(self, robot: RobotDescription, parameters: ForceGuidedParameters | None = None) -> None:
        p = parameters or ForceGuidedParameters.of_robot(robot)
        super().__init__(robot, p)
        # Wheels ahead: the robot's own inertia hardly depends on how they stand.
        own, _ = self._model.evaluate(np.zeros(robot.n), np.zeros(3))
        mass = p.virtual_mass or FELT_SHARE * own[0, 0]
        inertia = p.virtual_inertia or FELT_SHARE * own[2, 2]
        self.virtual_mass = np.array([mass, mass, inertia])
        self._follows = np.array(p.force_controlled)
        guards = np.array(
            [
                p.coasting_time, p.force_integral, p.deadband, p.tank, p.force_limit, p.speed_limit, p.yaw_rate_limit,
                p.power_limit,
            ]
        )  # fmt: skip
        # What `_guided_force` takes first.
        self._guiding_numbers = (
            self.virtual_mass, self._follows, p.force_limit / self.virtual_mass, p.tracking_gain, guards, self._B_inverse,
            robot.speed_limit * p.joint_speed_fraction,
        )  # fmt: skip

    def initial_state(self, twist: FloatArray | None = None) -> Any:
        """Return the state of a controller that takes over at a twist (3,), or at rest."""
        plain = ComputedTorque.initial_state(self, twist)
        guided = plain.reference_twist * self._follows
        stored = 0.5 * float(guided @ (self.virtual_mass * guided))
        return ForceGuidedState(
            plain.reference_twist, plain.error_integral, guided, np.zeros(3), np.array([0.0, stored, 0.0, 0.0])
        )

    def _demand(
        self, state: ComputedTorqueState, measurement: ControllerMeasurement, reference: Reference, dt: float
    ) -> tuple[ComputedTorqueState, Demand]:
        """Return the state, and F_u."""
        motion, wanted, push = reference, _ZERO, measurement.external_wrench
        if isinstance(reference, ForceReference):
            motion, wanted = reference.motion, reference.wrench
        before: Any = state
        V_d, e, demand = self._motion_demand(state, measurement, motion, dt)
        F, V, steer_angle, A, normal_inverse, inertia, bias = demand
        F_u, followed, V_f, impulse, energy = _guided_force(
            self._guiding_numbers, before.guided_twist, before.impulse, before.energy, _ZERO if push is None else push,
            wanted, push is not None, V_d, F, V, A, inertia, bias, dt,
        )  # fmt: skip
        state = replaced(
            before, reference_twist=followed, error_integral=e, guided_twist=V_f, impulse=impulse, energy=energy
        )
        return state, Demand(F_u, V, steer_angle, A, normal_inverse, inertia, bias)

    def _output(self, state: ComputedTorqueState, demand: Demand, F_con: FloatArray) -> ForceGuidedOutput:
        guided: Any = state
        tau, internal = output_kernel(self._B, *self._geometry, demand.steer_angle, F_con)
        return ForceGuidedOutput(
            tau, F_con, demand.wrench, demand.twist, state.reference_twist, internal, guided.guided_twist,
            float(guided.energy[_STORED]), GUARDS[int(guided.energy[_GUARD])],
        )  # fmt: skip


class ForceGuided(SlipConstraintForce, UnifiedForceMotion):
    """UFM-SCFC, table 5.5: unified force and motion control whose internal forces hold slip."""

    parameters: ForceGuidedParameters  # type: ignore[assignment]
    _state_type: type[Any] = SlipHoldingGuidedState

    def __init__(self, robot: RobotDescription, parameters: ForceGuidedParameters | None = None) -> None:
        super().__init__(robot, parameters or ForceGuidedParameters.of_robot(robot))  # type: ignore[arg-type]


@compiled
def _guided_force(  # type: ignore[no-untyped-def]
    numbers, before, impulse, energy, push, wanted, known, V_d, F, V, A, inertia, theta, dt
):
    """Return F_u (3,) and the twist that is followed (3,), and what `_give_way` does: one call in a control cycle."""
    mass, follows, largest_change, gain, guards, B_inverse, joint_speed_limit = numbers
    V_f, impulse, energy = _give_way(
        before, impulse, energy, push, wanted, V, known, mass, follows, guards, A, B_inverse, joint_speed_limit, dt
    )
    F_u, followed = _unified_force(F, inertia, theta, push, V, V_f, before, V_d, follows, largest_change, gain, dt)
    return F_u, followed, V_f, impulse, energy


@compiled
def _unified_force(  # type: ignore[no-untyped-def]
    F, inertia, theta, push, V, V_f, V_f_before, V_d, follows, largest_change, gain, dt
):
    """Return F_u (3,) and the twist that is followed (3,): Lambda (Omega F_m + (I - Omega) F_f) + theta + F_sensor.

    F = Lambda F_m + theta is what computed torque asks for.
    """
    right, F_f, followed = np.empty(3), np.zeros(3), V_d.copy()
    guided = False
    for i in range(3):
        right[i] = F[i] - theta[i]
        if follows[i] > 0.0:
            change = min(max((V_f[i] - V_f_before[i]) / dt, -largest_change[i]), largest_change[i])
            F_f[i] = change + gain * (V_f[i] - V[i])
            followed[i] = V_f[i]
            guided = True
    if not guided:
        return F - push, followed
    acceleration = solve_kernel(inertia, right)
    F_u = np.empty(3)
    for i in range(3):
        if follows[i] > 0.0:
            acceleration[i] = F_f[i]
    for i in range(3):
        F_u[i] = theta[i] - push[i]
        for j in range(3):
            F_u[i] += inertia[i, j] * acceleration[j]
    return F_u, followed


@compiled
def _give_way(  # type: ignore[no-untyped-def]
    V_f, impulse, energy, push, wanted, V, known, mass, follows, numbers, A, B_inverse, joint_speed_limit, dt
):
    """Return the guided twist (3,), the impulse (3,) and the energies and guard (4,) after one cycle."""
    coasting, integral, deadband, tank_limit, force_limit = numbers[0], numbers[1], numbers[2], numbers[3], numbers[4]
    speed_limit, yaw_limit, power_limit = numbers[5], numbers[6], numbers[7]
    tank, stored, tripped, guard = energy[_TANK], energy[_STORED], energy[_TRIPPED] > 0.0, _NONE
    f, u, impulse = follows * push, np.zeros(3), impulse.copy()
    size = math.hypot(push[0], push[1])
    if size > force_limit:
        tripped = True
    elif size < RELEASED * force_limit and not np.any(V_f != 0.0):
        tripped = False
    gives_way = known and not tripped
    felt = np.zeros(3)
    for i in range(3):
        # A push against the motion always counts: leaving it out would let the robot push back.
        if f[i] * V_f[i] < 0.0:
            felt[i] = f[i]
        elif gives_way:
            felt[i] = math.copysign(max(abs(f[i]) - deadband, 0.0), f[i])
        if gives_way:
            impulse[i] += dt * follows[i] * (f[i] - wanted[i])
            u[i] = follows[i] * (-wanted[i] + integral * impulse[i])
        else:
            impulse[i] = 0.0
    found = np.empty(3)
    for attempt in range(2):
        taken, lost = 0.0, 0.0
        for i in range(3):
            friction = mass[i] / coasting
            found[i] = ((mass[i] / dt - 0.5 * friction) * V_f[i] + felt[i] + u[i]) / (mass[i] / dt + 0.5 * friction)
            middle = 0.5 * (V_f[i] + found[i])
            taken += u[i] * middle * dt
            lost += friction * middle * middle * dt
        if taken <= tank + lost or attempt == 1:
            tank = min(max(tank + lost - taken, 0.0), tank_limit)
            break
        # The tank has not that much: without what it pays for.
        u[:] = 0.0
        impulse[:] = 0.0
    free = found.copy()
    if not gives_way:
        guard = _FORCE if tripped else _NO_PUSH
        slower = max(1.0 - dt / (0.1 * coasting), 0.0)
        for i in range(3):
            found[i] *= slower
            if abs(found[i]) < 1e-3:
                found[i] = 0.0
    shrink = max(1.0, math.hypot(found[0], found[1]) / speed_limit, abs(found[2]) / yaw_limit)
    shrink = max(shrink, largest_joint_speed_kernel(A, found, B_inverse, joint_speed_limit))
    if shrink > 1.0:
        found /= shrink
        guard = max(guard, _SPEED)
    power = f[0] * found[0] + f[1] * found[1] + f[2] * found[2]
    if power > power_limit:
        found *= power_limit / power
        guard = max(guard, _POWER)
    # The energy observer: what came in through the push, at most what a passive robot could have kept of it.
    kept = tank_limit
    for i in range(3):
        stored += dt * f[i] * V[i]
        kept += 0.5 * mass[i] * found[i] * found[i]
    stored = min(stored, kept)
    if stored < 0.0:
        guard = max(guard, _ENERGY)
        for i in range(3):
            if f[i] * found[i] < 0.0:
                found[i] = 0.0
    for i in range(3):
        # To slow down takes energy out, but not in a cycle in which the motion turns round.
        if free[i] * V_f[i] < 0.0 and abs(found[i]) < abs(V_f[i]):
            found[i] = math.copysign(min(abs(free[i]), abs(V_f[i])), free[i])
    after = np.empty(4)
    after[_TANK], after[_STORED], after[_TRIPPED], after[_GUARD] = tank, stored, 1.0 if tripped else 0.0, guard
    return found, impulse, after
