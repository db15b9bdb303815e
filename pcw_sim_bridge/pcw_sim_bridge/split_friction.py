"""Slip of a robot that speeds up and brakes where its wheels do not hold alike: one run for each way to share the force.

A quintic of 1 m/s at its fastest, in a random direction, with headings, payload, friction of the drives and all noise
drawn from the seed. Torques take effect 2 ms late, and slip is known from encoders only. Three grounds:

* split: one wheel stands on mu = 0.1, the others on the robot's own ground;
* uniform: all wheels on mu = 0.1;
* off_centre: all wheels on mu = 0.1, and the load stands so far from the middle that one wheel carries the least.

Each below and beyond the traction limit, which is where the pseudo-inverse asks the worst wheel for all that it holds:
the peak acceleration is a part of that limit. On uniform ground "beyond" is but a little beyond, since nothing that
shares forces can help where all wheels are at their limits; "far beyond" asks there for what the others ask for.

Methods that are paced take the same path at the pace at which a part of the friction carries them (`friction_budget`).
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence

import numpy as np

from pcw_control.computed_torque import ComputedTorque, ComputedTorqueState, Demand
from pcw_control.controller_interface import Controller, ControllerMeasurement
from pcw_control.controllers import make_controller
from pcw_control.friction_budget import FrictionBudget, plan_within_friction
from pcw_control.friction_sharing import FrictionParameters
from pcw_control.quintic_trajectory import (
    REST_PEAK_ACCELERATION,
    REST_PEAK_SPEED,
    MotionLimits,
    QuinticTrajectory,
    TrajectoryPoint,
    plan_point_to_point,
)
from pcw_control.wheel_loads import WheelLoads
from pcw_description.augmented_object_model import AugmentedObjectModel
from pcw_description.differential_kinematics import wheel_jacobian
from pcw_description.effect_instance import EffectInstance
from pcw_description.effects.registry import get
from pcw_description.robot_description import FloatArray, RobotDescription

from .closed_loop import ClosedLoopRun, run_closed_loop

SPEED, LOW_FRICTION, DELAY = 1.0, 0.1, 0.002
# The robot has the time to come to rest after its trajectory [s].
AFTER = 0.3
# Part of its traction limit that TLA may use; friction and loads that a controller is told are wrong by up to this part.
TRACTION_SHARE, TOLD_WITHIN = 0.8, 0.1
CASES = ("split", "uniform", "off_centre")
# Peak acceleration relative to that at which the pseudo-inverse brings the worst wheel to its limit. Below it, creep is what
# there is to reduce; on uniform ground the wheels reach it nearly together.
LEVELS: Mapping[str, Mapping[str, tuple[float, float]]] = {
    "split": {"beyond": (1.5, 2.4), "below": (0.6, 0.85)},
    "uniform": {"far beyond": (1.5, 2.4), "beyond": (1.0, 1.1), "below": (0.6, 0.85)},
    "off_centre": {"beyond": (1.4, 1.8), "below": (0.6, 0.85)},
}
# Distance of the load from the middle as part of the reach of the wheels.
OFF_CENTRE = 0.3
_REST = TrajectoryPoint(np.zeros(3))


class ClippedForces(ComputedTorque):
    """TLA as table 5.3 prints it, which amounts to cutting every force of the pseudo-inverse at `a` times its limit."""

    def __init__(self, robot: RobotDescription) -> None:
        super().__init__(robot, FrictionParameters())
        self._loads = WheelLoads(robot)

    def _distribute(
        self, state: ComputedTorqueState, demand: Demand, measurement: ControllerMeasurement, dt: float
    ) -> tuple[ComputedTorqueState, FloatArray]:
        state, force = super()._distribute(state, demand, measurement, dt)
        acceleration = np.linalg.solve(demand.inertia, demand.wrench)
        limit = TRACTION_SHARE * self._loads.traction_limit(
            demand.steer_angle, acceleration.astype(np.float64), measurement.friction, measurement.normal_force
        )
        return state, np.clip(force, -limit, limit)


@dataclasses.dataclass(frozen=True)
class Method:
    """One way to share the force.

    Attributes:
        controller: its name in the registry; "clip" is `ClippedForces`.
        told: whether it is told friction and load under every wheel, within TOLD_WITHIN.
        paced: whether its trajectory needs no more than a part of the friction that it is told.
    """

    controller: str
    told: bool = False
    paced: bool = False


METHODS: Mapping[str, Method] = {
    "pseudo-inverse": Method("computed_torque"),
    "TLA, clip": Method("clip", told=True),
    "weighted pseudo-inverse": Method("weighted_pseudo_inverse", told=True),
    "SCFC": Method("slip_constraint_force"),
    "QP": Method("friction_optimal", told=True),
    "QP + SCFC": Method("friction_optimal_slip_constraint", told=True),
    "QP + SCFC, not told": Method("friction_optimal_slip_constraint"),
    "SCFC, paced": Method("slip_constraint_force", told=True, paced=True),
    "QP + SCFC, paced": Method("friction_optimal_slip_constraint", told=True, paced=True),
}


@dataclasses.dataclass(frozen=True)
class Manoeuvre:
    """One drawn run.

    Attributes:
        robot: as it really is.
        goal, limits: where it shall go, and how fast it may.
        trajectory: the way there.
        steer_angle: headings at the start (n,) [rad].
        friction, normal_force: under each wheel, as far as a controller may be told (n,) [1], [N].
    """

    robot: RobotDescription
    goal: TrajectoryPoint
    limits: MotionLimits
    trajectory: QuinticTrajectory
    steer_angle: FloatArray
    friction: FloatArray
    normal_force: FloatArray


def effect(name: str, target: tuple[str, ...], axis: str | None = None, **parameters: float) -> EffectInstance:
    """Return an effect with the defaults of what is not given."""
    values = {p.name: p.default for p in get(name).parameters if p.default is not None} | parameters
    return EffectInstance(name, target, values, axis)


def slippery(robot: RobotDescription, names: tuple[str, ...], friction: float) -> EffectInstance:
    """Return a floor of a friction coefficient under some wheels, everywhere."""
    return effect(
        "low_friction_patch", names, factor=friction / robot.contact.mu_p, x=0.0, y=0.0, length=1e4, width=1e4, roundness=0.0
    )


def late_torques(robot: RobotDescription) -> tuple[EffectInstance, EffectInstance]:
    """Return the delay of all motors."""
    drive, steer = (effect("actuator_delay", robot.caster_names, axis, delay=DELAY) for axis in ("drive", "steer"))
    return drive, steer


def draw_manoeuvre(robot: RobotDescription, case: str, level: str, seed: int) -> Manoeuvre:
    """Draw the manoeuvre of a seed, the same for all methods.

    Args:
        robot: as the controllers believe it to be.
        case: one of CASES.
        level: "beyond" or "below".
        seed: of everything drawn.
    """
    rng = np.random.default_rng(seed)
    names, n = robot.caster_names, robot.n
    direction = rng.uniform(-math.pi, math.pi)
    steer_angle = direction + rng.uniform(-0.4, 0.4, n)
    physics = [*late_torques(robot)]
    physics += [effect("drive_coulomb_friction", (name,), coulomb=float(rng.uniform(0.0, 0.02) * limit))
                for name, limit in zip(names, robot.torque_limit[:, 0], strict=True)]  # fmt: skip
    physics.append(effect("payload_mass", ("chassis",), mass=float(rng.uniform(0.0, 0.06) * robot.total_mass), x=0.0, z=0.25))
    mu = np.full(n, robot.contact.mu_p)
    if case == "split":
        worst = int(rng.integers(n))
        mu[worst] = LOW_FRICTION
        physics.append(slippery(robot, (names[worst],), LOW_FRICTION))
    else:
        mu[:] = LOW_FRICTION
        physics.append(slippery(robot, names, LOW_FRICTION))
    chassis = robot.chassis
    if case == "off_centre":
        reach, angle = OFF_CENTRE * np.abs(robot.steer_axis).max(axis=0), rng.uniform(-math.pi, math.pi)
        x, y = float(reach[0] * math.cos(angle)), float(reach[1] * math.sin(angle))
        physics.append(effect("payload_offset", ("chassis",), x=x, y=y))
        chassis = dataclasses.replace(chassis, com=(chassis.com[0] + x, chassis.com[1] + y, chassis.com[2]))
    along = np.array([math.cos(direction), math.sin(direction), 0.0])
    loads = WheelLoads(dataclasses.replace(robot, chassis=chassis)).normal_force(np.full(n, direction), np.zeros(3))
    limit = _limit_of_pseudo_inverse(robot, direction, along, mu * loads)
    factor = rng.uniform(*LEVELS[case][level])
    # A quintic's peaks: v = 15/8 d/T, a = 10/sqrt(3) d/T^2.
    duration = REST_PEAK_ACCELERATION / REST_PEAK_SPEED * SPEED / (factor * limit)
    goal = TrajectoryPoint(along * SPEED * duration / REST_PEAK_SPEED)
    limits = MotionLimits(SPEED, factor * limit)
    error = 1.0 + rng.uniform(-TOLD_WITHIN, TOLD_WITHIN, (2, n))
    return Manoeuvre(
        dataclasses.replace(robot, physics=tuple(physics)), goal, limits, plan_point_to_point(_REST, goal, limits),
        steer_angle, mu * error[0], loads * error[1],
    )  # fmt: skip


def _limit_of_pseudo_inverse(robot: RobotDescription, direction: float, along: FloatArray, held: FloatArray) -> float:
    """Return the acceleration along a direction at which the pseudo-inverse asks one wheel for all it holds [m/s^2]."""
    steer_angle = np.full(robot.n, direction)
    A = wheel_jacobian(robot, steer_angle)
    inertia, _ = AugmentedObjectModel(robot).evaluate(steer_angle, np.zeros(3))
    force = (A @ np.linalg.solve(A.T @ A, inertia @ along)).reshape(-1, 2)
    return float(np.min(held / np.linalg.norm(force, axis=1)))


def controller_of(method: Method, robot: RobotDescription) -> Controller:
    """Make the controller of a method."""
    return ClippedForces(robot) if method.controller == "clip" else make_controller(method.controller, robot)


def way_of(robot: RobotDescription, manoeuvre: Manoeuvre, method: Method) -> QuinticTrajectory:
    """Return the trajectory that a method follows; a paced one goes by what it is told of the ground."""
    if not method.paced:
        return manoeuvre.trajectory
    budget = FrictionBudget(robot)
    return plan_within_friction(
        budget, _REST, manoeuvre.goal, manoeuvre.limits, friction=manoeuvre.friction, normal_force=manoeuvre.normal_force
    )


def drive(robot: RobotDescription, manoeuvre: Manoeuvre, method: Method, seed: int, plant: str = "reduced") -> ClosedLoopRun:
    """Run one method on one manoeuvre; `robot` is what the controller believes."""
    trajectory = way_of(robot, manoeuvre, method)

    def tell(measured: ControllerMeasurement) -> ControllerMeasurement:
        return dataclasses.replace(measured, friction=manoeuvre.friction, normal_force=manoeuvre.normal_force)

    return run_closed_loop(
        manoeuvre.robot, controller_of(method, robot), trajectory.sample, trajectory.duration + AFTER,
        plant, seed, manoeuvre.steer_angle, measure=tell if method.told else None,
    )  # fmt: skip


def slip_of_worst_wheel(run: ClosedLoopRun) -> float:
    """Return the RMS over time of the slip velocity of the wheel that slips most, both directions [m/s]."""
    return float(np.sqrt(np.mean(np.sum(run.slip**2, axis=2), axis=0).max()))


def slip_by_method(
    robot: RobotDescription, case: str, level: str, seed: int, plant: str = "reduced", methods: Sequence[str] = tuple(METHODS)
) -> dict[str, tuple[float, float]]:
    """Return the slip of methods on the manoeuvre of a seed [m/s], and how long it took [s]."""
    manoeuvre = draw_manoeuvre(robot, case, level, seed)
    found: dict[str, tuple[float, float]] = {}
    for name in methods:
        run = drive(robot, manoeuvre, METHODS[name], seed, plant)
        found[name] = slip_of_worst_wheel(run), float(run.time[-1]) - AFTER
    return found
