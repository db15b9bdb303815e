"""An operator pushes the robot along a circle: how evenly the wheels turn with and without slip held, and whose energy it
is.

A push of 20 N turns once round in six seconds, felt by a force sensor with noise. The drives have friction that differs
from wheel to wheel, torques take effect 2 ms late, and the robot stands on its own ground, on the same with one wheel
on mu = 0.1, or on a jack as in fig. 5.11.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Sequence

import numpy as np

from pcw_control.controller_interface import ControllerMeasurement, ForceReference
from pcw_control.controllers import make_controller
from pcw_control.force_guided import ForceGuidedState
from pcw_description.differential_kinematics import joint_matrix_blocks, wheel_jacobian
from pcw_description.effect_instance import EffectInstance
from pcw_description.robot_description import STEER, FloatArray, RobotDescription
from pcw_description.robot_file import load_robot

from .closed_loop import ClosedLoopRun, run_closed_loop
from .split_friction import LOW_FRICTION, effect, late_torques, slippery

PUSH, TURN, DURATION, PIECE = 20.0, 6.0, 7.0, 0.1  # [N], [s], [s], [s]
SENSOR_NOISE = 0.5  # [N]
COUNTED_FROM = 0.5  # the casters have turned into the direction of travel by then [s]
GROUNDS = ("on", "slippery", "off")
CONTROLLERS = {"without": "force_guided_plain", "with": "force_guided"}
COLUMNS = ("robot", "plant", "ground", "seed", "slip_held", "spread", "least_energy", "energy", "given_back")


@dataclasses.dataclass(frozen=True)
class GuidedScore:
    """What one run shows.

    Attributes:
        spread: RMS of how far the wheels' rolling speeds are from those of one rigid motion [m/s].
        least_energy: lowest value of the energy that the operator has put in since the start [J]; never below zero if none is
            injected.
        energy: what the operator has put in at the end [J].
        given_back: most that came back from any instant on, beyond what the robot's motion held then [J]; at most zero if
            none is injected.
    """

    spread: float
    least_energy: float
    energy: float
    given_back: float


def push_at(time: float, phase: float) -> FloatArray:
    """Return the push (3,) in base_link at a time, constant over each piece."""
    angle = math.tau * math.floor(time / PIECE + 1e-6) * PIECE / TURN + phase
    return PUSH * np.array([math.cos(angle), math.sin(angle), 0.0])


def draw_robot(robot: RobotDescription, ground: str, rng: np.random.Generator, phase: float) -> RobotDescription:
    """Return the robot as it really is, pushed along the circle."""
    physics: list[EffectInstance] = [*late_torques(robot)]
    for name, limit in zip(robot.caster_names, robot.torque_limit, strict=True):
        physics.append(effect("drive_coulomb_friction", (name,), coulomb=float(rng.uniform(0.0, 0.03) * limit[0])))
        physics.append(effect("drive_viscous_friction", (name,), viscous=float(rng.uniform(0.0, 0.03) * limit[0] / 10.0)))
    worst = int(rng.integers(robot.n))
    if ground == "slippery":
        physics.append(slippery(robot, (robot.caster_names[worst],), LOW_FRICTION))
    for piece in range(round(DURATION / PIECE)):
        x, y, _ = push_at(piece * PIECE, phase)
        physics.append(
            effect("external_push", ("chassis",), force_x=float(x), force_y=float(y), start=piece * PIECE, duration=PIECE)
        )
    return dataclasses.replace(robot, physics=tuple(physics))


def guided_run(
    robot: RobotDescription, seed: int, controller_name: str, ground: str, plant: str = "reduced"
) -> tuple[ClosedLoopRun, FloatArray]:
    """Return a run, and the push at its instants (k, 3)."""
    rng = np.random.default_rng(seed)
    phase = rng.uniform(-math.pi, math.pi)
    real, noise = draw_robot(robot, ground, rng, phase), np.random.default_rng(seed + 1)
    headings = phase + rng.uniform(-0.5, 0.5, robot.n)
    cycles = [0]

    def feel(measured: ControllerMeasurement) -> ControllerMeasurement:
        now = cycles[0] / robot.sensors.encoders.rate
        cycles[0] += 1
        felt = push_at(now, phase) + SENSOR_NOISE * np.array([*noise.standard_normal(2), 0.0])
        return dataclasses.replace(measured, external_wrench=felt)

    run = run_closed_loop(
        real, make_controller(controller_name, robot), lambda time: ForceReference(np.zeros(3)), DURATION, plant, seed,
        headings, measure=feel, lifted=ground == "off",
    )  # fmt: skip
    return run, np.array([push_at(now, phase) for now in run.time])


def unevenness(robot: RobotDescription, run: ClosedLoopRun, lifted: bool) -> FloatArray:
    """Return how far the wheels' rolling speeds are from those of the rigid motion nearest to them (k, n) [m/s].

    On the ground that is a part of the true slip, free of the encoders' noise; on a jack there is no slip to tell it by.
    """
    B = joint_matrix_blocks(robot)
    uneven = []
    for position, rates, slip in zip(run.joint_position, run.joint_velocity, run.slip, strict=True):
        w = np.einsum("nij,nj->ni", B, rates) if lifted else slip
        A = wheel_jacobian(robot, np.ascontiguousarray(position[:, STEER]))
        uneven.append((w.ravel() - A @ np.linalg.solve(A.T @ A, A.T @ w.ravel())).reshape(-1, 2)[:, 0])
    return np.array(uneven)


def judge(robot: RobotDescription, run: ClosedLoopRun, push: FloatArray, lifted: bool, mass: FloatArray) -> GuidedScore:
    """Return the score of a run; on a jack the robot's motion is the guided one. `mass` is what the operator feels (3,)."""
    counted = run.time >= COUNTED_FROM
    guided = [state.guided_twist for state in run.states if isinstance(state, ForceGuidedState)]
    twist = np.array(guided) if lifted else run.twist
    power = np.sum(push * twist, axis=1)
    energy = np.concatenate([[0.0], np.cumsum(0.5 * (power[1:] + power[:-1]) * np.diff(run.time))])
    # What may come back is what the body that the operator feels moves with.
    held = 0.5 * twist**2 @ mass
    # max over t0 < t1 of E(t0) - E(t1) - held(t0), in one pass from the end.
    lowest_ahead = np.minimum.accumulate(energy[::-1])[::-1]
    return GuidedScore(
        spread=float(np.sqrt(np.mean(unevenness(robot, run, lifted)[counted] ** 2))),
        least_energy=float(energy.min()),
        energy=float(energy[-1]),
        given_back=float(np.max(energy - lowest_ahead - held)),
    )


def rows(robot_name: str, seeds: int, plants: Sequence[str]) -> Iterator[tuple[object, ...]]:
    """Yield the rows of the study, see COLUMNS."""
    robot = load_robot(robot_name)
    mass = make_controller("force_guided", robot).virtual_mass  # type: ignore[attr-defined]
    for plant in plants:
        for ground in GROUNDS:
            for seed in range(seeds):
                for label, name in CONTROLLERS.items():
                    run, push = guided_run(robot, seed, name, ground, plant)
                    score = judge(robot, run, push, ground == "off", mass)
                    yield (
                        robot_name, plant, ground, seed, label,
                        *(f"{value:.6f}" for value in vars(score).values()),
                    )  # fmt: skip
