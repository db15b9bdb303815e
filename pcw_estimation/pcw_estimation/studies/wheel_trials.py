"""Trials of slip observers on one wheel: grip, spin, grip again, brake; with an observer that believes wrong numbers."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from pcw_description.robot_description import FloatArray

from ..slip_estimate import WheelModel
from .one_wheel import WheelRun, WheelSensors, run_wheel

DURATION = 1.8  # of a trial [s]
# A velocity has settled once its error stays within this part of it.
SETTLED = 0.05
# By then, errors in grip and in spin are counted [s]; an observer has this long to settle.
COUNTED_FROM, SETTLING_UNTIL = 0.2, 0.5
# Relative errors refer to at least this speed [m/s].
LEAST_SPEED = 0.2
# An error beyond this part of the speed is called divergence.
DIVERGED = 0.5

Maker = Callable[[WheelModel], Any]


@dataclasses.dataclass(frozen=True)
class Beliefs:
    """How far the numbers that an observer is given may be off.

    Attributes:
        error: of M, I, mu_p and lambda_p: uniform, relative [1].
        radius_error: of r, relative [1].
        radius_sign: whether r is off by exactly that, one way or the other, instead of by anything up to it.
    """

    error: float = 0.1
    radius_error: float = 0.01
    radius_sign: bool = False

    def about(self, wheel: WheelModel, rng: np.random.Generator) -> WheelModel:
        """Return what the observer believes of a wheel."""
        mass, inertia, mu_p, lambda_p = 1.0 + rng.uniform(-self.error, self.error, 4)
        sign = rng.choice([-1.0, 1.0]) if self.radius_sign else rng.uniform(-1.0, 1.0)
        contact = dataclasses.replace(
            wheel.contact, mu_p=wheel.contact.mu_p * mu_p, lambda_p=wheel.contact.lambda_p * lambda_p
        )
        return dataclasses.replace(
            wheel,
            mass=wheel.mass * mass,
            inertia=wheel.inertia * inertia,
            radius=wheel.radius * (1.0 + sign * self.radius_error),
            contact=contact,
        )


@dataclasses.dataclass(frozen=True)
class TrialScore:
    """What one trial says of one observer.

    Attributes:
        settling: time after which the error stays within 5 % up to `SETTLING_UNTIL` [s].
        grip, spin: RMS of the relative error while |lambda| is below and above lambda_p [1].
        wrong_root: the trial ends, in grip, more than 5 % off: on the other root.
        diverged: not finite, or off by more than half the speed after the settling time.
    """

    settling: float
    grip: float
    spin: float
    wrong_root: bool
    diverged: bool


def trial_torque(wheel: WheelModel, rng: np.random.Generator, rate: float) -> FloatArray:
    """Return drive torques (T,) [N m]: driving, more than the ground holds, driving or coasting, braking."""
    time = np.arange(round(DURATION * rate)) / rate
    peak = wheel.contact.mu_p * wheel.normal_force * wheel.radius
    peak *= 1.0 + wheel.inertia / (wheel.mass * wheel.radius**2)  # the wheel itself takes its part
    lets_go = rng.uniform(0.5, 0.8)
    grips_again = lets_go + rng.uniform(0.1, 0.3)
    driving = rng.uniform(0.25, 0.7) * (1.0 + 0.15 * np.sin(2.0 * np.pi * rng.uniform(1.0, 4.0) * time))
    part = np.where(time < lets_go, driving, rng.uniform(1.1, 1.4))
    part = np.where(time < grips_again, part, rng.uniform(-0.1, 0.4))
    part = np.where(time < grips_again + 0.5, part, rng.uniform(-0.6, -0.3))
    return part * peak


def random_wheel(wheel: WheelModel, rng: np.random.Generator) -> WheelModel:
    """Return another wheel on another ground."""
    mass, radius = rng.uniform(8.0, 40.0), rng.uniform(0.04, 0.12)
    contact = dataclasses.replace(wheel.contact, mu_p=rng.uniform(0.2, 1.0), lambda_p=rng.uniform(0.05, 0.25))
    return WheelModel(
        inertia=mass * radius**2 * rng.uniform(0.03, 0.4),
        radius=radius,
        mass=mass,
        normal_force=9.81 * mass * rng.uniform(0.8, 1.2),
        contact=contact,
    )


def run_trial(wheel: WheelModel, seed: int, beliefs: Beliefs, sensors: WheelSensors) -> tuple[WheelRun, WheelModel]:
    """Return one run of a wheel, and what an observer believes of it."""
    rng = np.random.default_rng(seed)
    velocity, torque = rng.uniform(0.4, 1.5), trial_torque(wheel, rng, sensors.rate)
    run = run_wheel(wheel, torque, velocity, 0.2 * wheel.contact.lambda_p, sensors, rng)
    return run, beliefs.about(wheel, rng)


def score(run: WheelRun, velocity: FloatArray, critical_slip: float) -> TrialScore:
    """Judge estimated velocities (T,) [m/s]."""
    error = (velocity - run.velocity) / np.maximum(np.abs(run.velocity), LEAST_SPEED)
    period = run.time[1] - run.time[0]
    unsettled = np.nonzero(~(np.abs(error) <= SETTLED) & (run.time < SETTLING_UNTIL))[0]
    loose, counted = np.abs(run.slip_ratio) > critical_slip, run.time >= COUNTED_FROM

    def rms(where: np.ndarray) -> float:
        return float(np.sqrt(np.mean(error[where] ** 2))) if where.any() else 0.0

    return TrialScore(
        settling=float(run.time[unsettled[-1]] + period) if len(unsettled) else 0.0,
        grip=rms(counted & ~loose),
        spin=rms(counted & loose),
        wrong_root=bool(not loose[-1] and not abs(error[-1]) <= SETTLED),
        diverged=not bool(np.all(np.abs(error[counted]) <= DIVERGED)),
    )


@dataclasses.dataclass(frozen=True)
class Summary:
    """Many trials of one observer; RMS values are those of all trials together."""

    trials: int
    settling_median: float
    settling_p95: float
    grip_rms: float
    spin_rms: float
    worst_grip: float
    worst_spin: float
    wrong_roots: int
    diverged: int


def summarise(scores: Sequence[TrialScore]) -> Summary:
    """Return the figures of many trials."""
    settling = np.array([s.settling for s in scores])
    grip, spin = np.array([s.grip for s in scores]), np.array([s.spin for s in scores])
    spun = spin[spin > 0.0]
    return Summary(
        trials=len(scores),
        settling_median=float(np.median(settling)),
        settling_p95=float(np.quantile(settling, 0.95)),
        grip_rms=float(np.sqrt(np.mean(grip**2))),
        spin_rms=float(np.sqrt(np.mean(spun**2))) if len(spun) else 0.0,
        worst_grip=float(grip.max()),
        worst_spin=float(spin.max()),
        wrong_roots=sum(s.wrong_root for s in scores),
        diverged=sum(s.diverged for s in scores),
    )


def summarise_trials(
    maker: Maker,
    wheel: WheelModel,
    seeds: Sequence[int],
    beliefs: Beliefs | None = None,
    sensors: WheelSensors | None = None,
    velocity: float | None = 0.0,
    other_wheels: bool = False,
) -> Summary:
    """Run trials of one observer.

    Args:
        maker: makes the observer from what it believes of the wheel.
        wheel: as it really is.
        seeds: one trial each.
        beliefs: how far off what it believes is.
        sensors: what measures the wheel.
        velocity: the observer's guess at the start [m/s]; None: its own.
        other_wheels: another wheel on another ground in every trial.
    """
    scores = []
    for seed in seeds:
        real = random_wheel(wheel, np.random.default_rng([seed, 1])) if other_wheels else wheel
        sensing = sensors or WheelSensors()
        run, believed = run_trial(real, seed, beliefs or Beliefs(), sensing)
        observer = maker(believed)
        guess = {} if velocity is None else {"velocity": velocity}
        found, _, _ = observer.run(run.angle, run.rate, run.torque, 1.0 / sensing.rate, **guess)
        scores.append(score(run, found, real.contact.lambda_p))
    return summarise(scores)
