"""One wheel of a robot held at a slip ratio, driving and braking, on three grounds of the catalogue; section 5.3.1
[Li2009].

The wheel carries its share of the robot. It speeds up from rest with half of the friction that is believed to be there,
as robots get to their speed by driving; then it is held at 0.2, or at the ground's critical slip ratio. Its velocity
comes from the truth, or from the sliding-mode observer of `pcw_estimation`, which begins at rest and learns the mass
while the wheel grips. 0.2 is beyond the peak of all three grounds. There the observer's root of mu(lambda) is the wrong
one, and the controller knows that it goes there: the observer is told to integrate its force (its correction rate is
zero) from the moment the set-point is held. What it believes of mass, inertia and ground is exact, or off by up to 1 %
(the tolerance of a healthy robot's mass), or by up to 10 %.

Braking ends at 1 m/s, because a fixed error of a velocity is an error of the slip ratio that grows without bound as the
wheel stops.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

import numpy as np

from pcw_control.slip_ratio_control import SlidingWheel, SlipRatioControl, SlipRatioMeasurement
from pcw_description.compiled import compiled
from pcw_description.contact.contact_model import friction_coefficient, tyre_parameters, tyre_step
from pcw_description.robot_description import ContactDescription, FloatArray, RobotDescription
from pcw_description.robot_file import load_robot
from pcw_description.wheel_dynamics import slip_ratio
from pcw_estimation.sliding_mode_observer import SlidingModeObserver, SlidingModeParameters
from pcw_estimation.slip_estimate import WheelMeasurement, WheelModel
from pcw_terrain.ground_catalogue import contact_on, ground

GROUNDS = ("dry_asphalt", "wet_cobblestone", "snow")
# The bench's motor can take the wheel past its peak on all grounds, which the robot's own cannot on dry asphalt.
MOTOR = 2.0
DT, SUBSTEPS, DURATION = 1e-3, 10, 1.0  # [s], [1], [s]
SPEEDING_UP = 0.5  # part of the believed friction that the wheel gets to its speed with
START = {"drive": 1.0, "brake": 5.0}  # [m/s]
LEAST_SPEED = 1.0  # at which braking ends [m/s]
SET_POINT, REACHED_WITHIN, SETTLED_AT = 0.2, 0.05, 0.15
RATE_NOISE, TORQUE_NOISE = 0.005, 0.02  # [rad/s], [N m]
# Errors of what the observer believes; None is the true velocity.
SOURCES = {"truth": None, "observer, exact": 0.0, "observer, 1 %": 0.01, "observer, 10 %": 0.1}
# Faster than its default: nothing but the lag of the force stands between the observer and the velocity once it integrates.
HOLDING = SlidingModeParameters(correction_rate=1e-9, bandwidth=900.0, layer=3.0)
COLUMNS = ("robot", "ground", "set_point", "motion", "source", "seed", "reached", "rms", "worst")


@dataclasses.dataclass(frozen=True)
class RatioRun:
    """A run from the moment on at which the set-point is held; arrays (k,).

    Attributes:
        time: [s].
        slip_ratio: the truth (3.43) [1].
        velocity, estimate: of the wheel centre, true and as the controller was given it [m/s].
        torque: [N m].
    """

    time: FloatArray
    slip_ratio: FloatArray
    velocity: FloatArray
    estimate: FloatArray
    torque: FloatArray

    def score(self, wanted: float) -> tuple[float, float, float]:
        """Return when the set-point was first reached to 5 % [s], RMS and largest error after 0.15 s [1]."""
        error = np.abs(self.slip_ratio - wanted)
        inside = np.nonzero(error <= REACHED_WITHIN * abs(wanted))[0]
        later = error[self.time > SETTLED_AT]
        reached = float(self.time[inside[0]]) if len(inside) else float("inf")
        return reached, float(np.sqrt(np.mean(later**2))), float(later.max())


@compiled
def _roll(tyre, inertia, radius, mass, load, torque, motion, dt, substeps):  # type: ignore[no-untyped-def]
    """Advance motion (rho, rho_dot, v, z) in place."""
    for _ in range(substeps):
        speed = max(abs(radius * motion[1]), abs(motion[2]))
        z, _, force, _ = tyre_step(tyre, motion[3], 0.0, radius * motion[1] - motion[2], 0.0, speed, load, dt)
        motion[3] = z
        motion[1] += dt * (torque - radius * force) / inertia
        motion[2] += dt * force / mass
        motion[0] += dt * motion[1]


def believed_model(wheel: SlidingWheel, load: float, contact: ContactDescription, error: float, seed: int) -> WheelModel:
    """Return the wheel as the observer believes it to be."""
    mass, inertia, mu, slip = 1.0 + np.random.default_rng(seed).uniform(-error, error, 4)
    wrong = dataclasses.replace(contact, mu_p=contact.mu_p * mu, lambda_p=contact.lambda_p * slip)
    return WheelModel(wheel.inertia * inertia, wheel.radius, wheel.mass * mass, load, wrong)


def hold_slip_ratio(
    robot: RobotDescription, place: str, wanted: float, start: float, belief: float | None, seed: int
) -> RatioRun:
    """Hold a slip ratio.

    Args:
        robot: whose first wheel it is.
        place: name of the ground.
        wanted: slip ratio, negative to brake.
        start: velocity from which on it is held [m/s].
        belief: error of what the observer believes; None is the true velocity and the true curve.
        seed: of noise and beliefs.
    """
    contact = contact_on(robot.contact, ground(place), "kiencke")
    wheel = SlidingWheel.of_robot(robot, 0)
    wheel = dataclasses.replace(wheel, torque_limit=MOTOR * wheel.torque_limit)
    load, tyre, rng = 9.81 * wheel.mass, tyre_parameters(contact), np.random.default_rng(seed)
    model = believed_model(wheel, load, contact, belief or 0.0, seed)
    controller = SlipRatioControl(dataclasses.replace(wheel, inertia=model.inertia, mass=model.mass))
    gripping, holding = SlidingModeObserver(model), SlidingModeObserver(model, HOLDING)
    state, observed = controller.initial_state(), gripping.initial_state()
    # r F, and what the wheel itself takes to speed up with the mass.
    pull = SPEEDING_UP * model.contact.mu_p * load * (model.radius + model.inertia / (model.radius * model.mass))
    motion, torque, rows, held, speed = np.zeros(4), min(pull, wheel.torque_limit), [], 0, 0.0
    while held < round(DURATION / DT):
        _, rate, velocity, _ = motion
        rate_seen = rate + RATE_NOISE * rng.standard_normal()
        torque_seen = torque + TORQUE_NOISE * rng.standard_normal()
        held += held > 0 or speed >= start
        observer = holding if held else gripping
        observed, found = observer.step(observed, WheelMeasurement(motion[0], rate_seen, torque_seen), DT)
        speed = found.velocity if belief is not None else float(velocity)
        if held:
            given = float(velocity) if belief is None else found.velocity
            curve = friction_coefficient(tyre, slip_ratio(wheel.radius * rate_seen, velocity), 0.0)[0] * load
            force = curve if belief is None else found.force
            state, output = controller.step(state, SlipRatioMeasurement(rate_seen, given, force), wanted, DT)
            torque = output.torque
            rows.append(((held - 1) * DT, slip_ratio(wheel.radius * rate, velocity), velocity, given, torque))
        _roll(tyre, wheel.inertia, wheel.radius, wheel.mass, load, torque, motion, DT / SUBSTEPS, SUBSTEPS)
        if held and wanted < 0.0 and motion[2] < LEAST_SPEED:
            break
    return RatioRun(*(np.array(column) for column in zip(*rows, strict=True)))


def rows(robot_name: str, seeds: int) -> Iterator[tuple[object, ...]]:
    """Yield the rows of the study, see COLUMNS."""
    robot = load_robot(robot_name)
    for place in GROUNDS:
        for set_point in (SET_POINT, round(ground(place).lambda_p, 4)):
            for motion, start in START.items():
                wanted = set_point if motion == "drive" else -set_point
                for source, belief in SOURCES.items():
                    for seed in range(seeds):
                        score = hold_slip_ratio(robot, place, wanted, start, belief, seed).score(wanted)
                        yield robot_name, place, set_point, motion, source, seed, *(f"{value:.6f}" for value in score)
