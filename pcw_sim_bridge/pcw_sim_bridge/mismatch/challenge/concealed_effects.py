"""Draws effects to conceal: where, and how large, for a robot and a run.

Every effect of the vocabulary that can stand on a robot has a recipe: from which magnitude to which other it is usually seen,
and its parameters as a function of it. Torques are drawn relative to what one wheel carries, lengths relative to its radius or
offset, so that one recipe fits all robots.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from pcw_description.effect_instance import EffectInstance
from pcw_description.robot_description import AXIS_NAMES, DRIVE, GRAVITY, STEER, FloatArray, RobotDescription

from .healthy_deviations import effect_instance
from .outside_effects import OUTSIDE_EFFECTS
from .simulated_case import SimulatedRecording

# Of the effects on casters, so many are on all of them alike.
SHARE_ON_ALL = 0.3
WALKING = 0.4  # [m/s]


@dataclasses.dataclass(frozen=True)
class Scene:
    """What a recipe may look at: the robot, and a healthy run of it."""

    robot: RobotDescription
    healthy: SimulatedRecording
    rng: np.random.Generator

    def sign(self) -> float:
        """Draw a sign."""
        return float(self.rng.choice([-1.0, 1.0]))

    def angle(self) -> float:
        """Draw an angle [rad]."""
        return float(self.rng.uniform(-math.pi, math.pi))

    def pick(self, *names: str) -> str:
        """Draw a name."""
        return str(self.rng.choice(names))

    @property
    def load(self) -> float:
        """Weight on one wheel [N]."""
        return self.robot.total_mass * GRAVITY / self.robot.n

    @property
    def radius(self) -> float:
        """Radius of a wheel [m]."""
        return float(np.mean(self.robot.wheel_radius))

    @property
    def offset(self) -> float:
        """Length of a caster's offset [m]."""
        return float(np.mean(np.linalg.norm(self.robot.caster_offset, axis=1)))

    def torque(self, axis: str) -> float:
        """Torque of a joint that moves one wheel's share with the force of its weight [N m]."""
        return self.load * (self.radius if axis == "drive" else self.offset)

    def speed(self, axis: str) -> float:
        """Speed of a joint at walking pace, halved for the steering, which seldom turns so fast [rad/s]."""
        return WALKING / self.radius if axis == "drive" else 0.5 * WALKING / self.offset


@dataclasses.dataclass(frozen=True)
class Recipe:
    """How large an effect may be and what it is then.

    Attributes:
        low, high: magnitudes to begin with, hardly seen and plainly seen; limit: none is larger, whatever it takes.
        parameters: magnitude -> parameters.
        axis: "drive" or "steer" for an effect that is at another joint than its own; else None.
        target: where it has to be, if that is not free to be drawn.
    """

    low: float
    high: float
    parameters: Callable[[float], Mapping[str, float]]
    limit: float = math.inf
    axis: str | None = None
    target: tuple[str, ...] | None = None


@dataclasses.dataclass(frozen=True)
class Draft:
    """An effect with its place drawn and its magnitude open."""

    name: str
    target: tuple[str, ...]
    recipe: Recipe
    magnitude: float

    def scaled(self, factor: float) -> Draft:
        """Return it so much larger, within the recipe's limit."""
        return dataclasses.replace(self, magnitude=min(self.magnitude * factor, self.recipe.limit))

    def instance(self) -> EffectInstance:
        """Return the effect."""
        parameters = {name: float(value) for name, value in self.recipe.parameters(self.magnitude).items()}
        if self.name in OUTSIDE_EFFECTS:
            effect = OUTSIDE_EFFECTS[self.name].effect
            return EffectInstance(self.name, self.target, effect.check(parameters, self.name))
        return effect_instance(self.name, self.target, parameters, self.recipe.axis)


def draw_effect(name: str, scene: Scene, strength: float, target: Sequence[str] | None = None) -> Draft:
    """Draw an effect of the vocabulary, or from outside it; a strength of 0 to 1 leads from `low` to `high`."""
    recipe = RECIPES[name](scene)
    if target is None:
        target = recipe.target or _casters(scene)
    return Draft(name, tuple(target), recipe, recipe.low * (recipe.high / recipe.low) ** strength)


def _casters(scene: Scene) -> tuple[str, ...]:
    names = scene.robot.caster_names
    return names if scene.rng.random() < SHARE_ON_ALL else (scene.pick(*names),)


def _own_axis(axis: str, own: str) -> str | None:
    return None if axis == own else axis


# -- frictions and gains ------------------------------------------------------------------------------------------


def _coulomb(axis: str) -> Callable[[Scene], Recipe]:
    def recipe(scene: Scene) -> Recipe:
        uneven = scene.sign() * scene.rng.uniform(0.2, 0.5) if scene.rng.random() < 0.2 else 0.0
        size = scene.torque(axis)
        return Recipe(0.003, 0.06, lambda m: {"coulomb": m * size, "asymmetry": m * size * uneven}, limit=0.2)

    return recipe


def _viscous(axis: str) -> Callable[[Scene], Recipe]:
    def recipe(scene: Scene) -> Recipe:
        size = scene.torque(axis) / scene.speed(axis)
        return Recipe(0.003, 0.06, lambda m: {"viscous": m * size}, limit=0.2)

    return recipe


def _stribeck(scene: Scene) -> Recipe:
    speed = scene.rng.uniform(0.05, 0.3) * scene.speed("drive")
    return Recipe(
        0.01, 0.1, lambda m: {"stribeck": m * scene.torque("drive"), "stribeck_speed": speed}, limit=0.25
    )


def _load_friction(scene: Scene) -> Recipe:
    axis = scene.pick(*AXIS_NAMES)
    return Recipe(0.03, 0.4, lambda m: {"fraction": m}, limit=0.6, axis=_own_axis(axis, "drive"))


def _gain(scene: Scene) -> Recipe:
    axis, sign = scene.pick(*AXIS_NAMES), scene.sign()
    return Recipe(0.03, 0.35, lambda m: {"error": sign * m}, limit=0.6, axis=_own_axis(axis, "drive"))


def _cogging(scene: Scene) -> Recipe:
    axis, phase, order = scene.pick("drive", "drive", "steer"), scene.angle(), float(scene.rng.integers(3, 41))
    size = scene.torque(axis)
    return Recipe(
        0.004, 0.06,
        lambda m: {"cosine": m * size * math.cos(phase), "sine": m * size * math.sin(phase), "order": order},
        limit=0.15, axis=_own_axis(axis, "drive"),
    )


def _constant_load(scene: Scene) -> Recipe:
    sign = scene.sign()
    return Recipe(0.004, 0.06, lambda m: {"load": sign * m * scene.torque("drive")}, limit=0.2)


# -- actuators and gears ------------------------------------------------------------------------------------------


def _lag(scene: Scene) -> Recipe:
    axis = _own_axis(scene.pick(*AXIS_NAMES), "drive")
    return Recipe(0.003, 0.04, lambda m: {"time_constant": m}, limit=0.06, axis=axis)


def _delay(scene: Scene) -> Recipe:
    axis = _own_axis(scene.pick(*AXIS_NAMES), "drive")
    return Recipe(0.002, 0.02, lambda m: {"delay": m}, limit=0.03, axis=axis)


def _saturation(scene: Scene) -> Recipe:
    """A limit below the largest torque that the healthy run takes."""
    axis = scene.pick(*AXIS_NAMES)
    column = AXIS_NAMES.index(axis)
    peak = float(np.quantile(np.abs(scene.healthy.joint_states.effort[:, :, column]), 0.999))
    return Recipe(
        0.1, 0.7, lambda m: {"torque": peak * (1.0 - m)}, limit=0.85, axis=_own_axis(axis, "drive")
    )


def _backlash(scene: Scene) -> Recipe:
    axis = _own_axis(scene.pick(*AXIS_NAMES), "drive")
    return Recipe(0.002, 0.04, lambda m: {"play": m}, limit=0.08, axis=axis)


def _elasticity(scene: Scene) -> Recipe:
    axis = scene.pick(*AXIS_NAMES)
    torque = 0.1 * scene.torque(axis)
    return Recipe(
        0.002, 0.04, lambda m: {"stiffness": max(torque / m, 20.0)}, limit=0.08, axis=_own_axis(axis, "drive")
    )


# -- wheels and tyres ---------------------------------------------------------------------------------------------


def _stiffness(scene: Scene) -> Recipe:
    sign = scene.sign()
    return Recipe(0.2, 1.2, lambda m: {"error": math.expm1(sign * m)}, limit=2.0)


def _relaxation(scene: Scene) -> Recipe:
    return Recipe(
        0.5, 2.0, lambda m: {"length": min(scene.robot.contact.relaxation_length * math.exp(m), 0.5)}, limit=3.0
    )


def _compliance(scene: Scene) -> Recipe:
    return Recipe(
        0.01, 0.06, lambda m: {"stiffness": max(scene.load / (m * scene.radius), 1e4)}, limit=0.15
    )


def _rolling_resistance(scene: Scene) -> Recipe:
    return Recipe(0.003, 0.04, lambda m: {"arm": m * scene.radius}, limit=0.15)


def _scrub(scene: Scene) -> Recipe:
    return Recipe(0.002, 0.03, lambda m: {"radius": m}, limit=0.06)


def _radius_error(scene: Scene) -> Recipe:
    sign = scene.sign()
    return Recipe(0.004, 0.04, lambda m: {"error": sign * m * scene.radius}, limit=0.15)


def _offset_error(scene: Scene) -> Recipe:
    sign, across = scene.sign(), scene.sign() * (scene.rng.random() < 0.3)
    return Recipe(
        0.02, 0.2, lambda m: {"x": sign * m * scene.offset, "y": 0.5 * across * m * scene.offset}, limit=0.4
    )


def _zero_offset(scene: Scene) -> Recipe:
    sign = scene.sign()
    return Recipe(0.008, 0.1, lambda m: {"offset": sign * m}, limit=0.2)


def _encoder_eccentricity(scene: Scene) -> Recipe:
    axis, phase = _own_axis(scene.pick("steer", "steer", "drive"), "steer"), scene.angle()
    return Recipe(0.005, 0.06, lambda m: {"amplitude": m, "phase": phase}, limit=0.15, axis=axis)


def _wheel_eccentricity(scene: Scene) -> Recipe:
    phase = scene.angle()
    return Recipe(
        0.005, 0.05, lambda m: {"eccentricity": m * scene.radius, "phase": phase}, limit=0.1
    )


# -- floor and chassis --------------------------------------------------------------------------------------------


def wheel_paths(robot: RobotDescription, recording: SimulatedRecording) -> FloatArray:
    """Return where the wheel centres were in the world at the stamps of the tracker, (T, n, 2) [m]."""
    truth, joints = recording.ground_truth, recording.joint_states
    angle = np.stack([np.interp(truth.stamp, joints.stamp, joints.position[:, i, STEER]) for i in range(robot.n)], axis=1)
    c, s = np.cos(angle), np.sin(angle)
    b = robot.caster_offset
    x = robot.steer_axis[:, 0] + c * b[:, 0] - s * b[:, 1]
    y = robot.steer_axis[:, 1] + s * b[:, 0] + c * b[:, 1]
    yaw = truth.pose[:, 2:3]
    return np.stack(
        [
            truth.pose[:, :1] + np.cos(yaw) * x - np.sin(yaw) * y,
            truth.pose[:, 1:2] + np.sin(yaw) * x + np.cos(yaw) * y,
        ],
        axis=2,
    )


def first_on_patch(robot: RobotDescription, recording: SimulatedRecording, patch: Mapping[str, float]) -> float | None:
    """Return when a wheel first comes onto a `low_friction_patch` [s]; None if none does."""
    place = wheel_paths(robot, recording) - [patch["x"], patch["y"]]
    c, s = math.cos(patch["yaw"]), math.sin(patch["yaw"])
    along = np.abs(c * place[..., 0] + s * place[..., 1]) / (0.5 * patch["length"])
    across = np.abs(-s * place[..., 0] + c * place[..., 1]) / (0.5 * patch["width"])
    power = 2.0 / max(patch["roundness"], 0.04)
    inside = (np.maximum(along, across) < 1.0) & (along**power + across**power < 1.0)
    on = np.flatnonzero(inside.any(axis=1))
    return float(recording.ground_truth.stamp[on[0]]) if len(on) else None


def _patch(scene: Scene) -> Recipe:
    """A place that a wheel rolls over, and on which none stands at the start."""
    paths = wheel_paths(scene.robot, scene.healthy)
    away = np.linalg.norm(paths[:, :, None] - paths[0], axis=3).min(axis=2)  # from where any wheel stood (T, n)
    far = np.argwhere(away > 0.5 * away.max())
    row, wheel = far[int(scene.rng.integers(len(far)))]
    x, y = paths[row, wheel]
    length, width = np.minimum(scene.rng.uniform(0.25, 0.8, 2), 1.3 * away[row, wheel])
    shape = {
        "x": x, "y": y, "length": max(length, 0.02), "width": max(width, 0.02), "yaw": scene.rng.uniform(0.0, math.pi),
        "roundness": float(scene.rng.choice([0.0, 1.0])),
    }
    return Recipe(
        0.7, 3.0, lambda m: {"factor": math.exp(-m), **shape}, limit=4.0, target=scene.robot.caster_names
    )


def _slope(scene: Scene) -> Recipe:
    direction = scene.angle()
    return Recipe(
        0.005, 0.06, lambda m: {"angle": m, "direction": direction}, limit=0.1, target=("chassis",)
    )


def _waves(scene: Scene) -> Recipe:
    wavelength, direction = scene.rng.uniform(0.5, 2.0), scene.angle()
    return Recipe(
        0.0005, 0.006, lambda m: {"amplitude": m, "wavelength": wavelength, "direction": direction}, limit=0.012,
        target=scene.robot.caster_names,
    )


def _payload(scene: Scene) -> Recipe:
    reach = np.max(np.abs(scene.robot.steer_axis), axis=0)
    x, y = scene.rng.uniform(-0.7, 0.7, 2) * reach
    return Recipe(
        0.03, 0.4, lambda m: {"mass": m * scene.robot.total_mass, "x": x, "y": y}, limit=0.8, target=("chassis",)
    )


def _payload_offset(scene: Scene) -> Recipe:
    direction, reach = scene.angle(), float(np.mean(np.abs(scene.robot.steer_axis)))
    return Recipe(
        0.08, 0.5,
        lambda m: {"x": m * reach * math.cos(direction), "y": m * reach * math.sin(direction)}, limit=0.6,
        target=("chassis",),
    )


def _drag(scene: Scene) -> Recipe:
    size = scene.robot.total_mass * GRAVITY / WALKING**2
    return Recipe(0.003, 0.05, lambda m: {"coefficient": m * size}, limit=0.15, target=("chassis",))


def _push(scene: Scene) -> Recipe:
    direction, duration = scene.angle(), scene.healthy.duration
    start, length = scene.rng.uniform(0.2, 0.7) * duration, scene.rng.uniform(0.5, 5.0)
    size = scene.robot.total_mass * GRAVITY
    return Recipe(
        0.01, 0.1,
        lambda m: {
            "force_x": m * size * math.cos(direction), "force_y": m * size * math.sin(direction), "start": start,
            "duration": length,
        },
        limit=0.2, target=("chassis",),
    )


# -- sensors ------------------------------------------------------------------------------------------------------


def _imu_error(low: float, high: float, gyro: float, accelerometer: float) -> Callable[[Scene], Recipe]:
    """An error of the gyro, or now and then of an accelerometer, in multiples of these."""

    def recipe(scene: Scene) -> Recipe:
        name, size = ("gyro", gyro) if scene.rng.random() < 0.6 else (
            scene.pick("accelerometer_x", "accelerometer_y"), accelerometer
        )
        sign = scene.sign()
        return Recipe(low, high, lambda m: {"gyro": 0.0, name: sign * m * size}, limit=2.0 * high, target=("imu",))

    return recipe


def _lever_arm(scene: Scene) -> Recipe:
    direction = scene.angle()
    return Recipe(
        0.02, 0.2, lambda m: {"x": m * math.cos(direction), "y": m * math.sin(direction)}, limit=0.5, target=("imu",)
    )


def _clock(scene: Scene) -> Recipe:
    sign = scene.sign()
    return Recipe(0.004, 0.06, lambda m: {"offset": sign * m}, limit=0.15, target=("clock",))


# -- outside the library ------------------------------------------------------------------------------------------


def _outside_torque(axis: str, low: float, high: float, per_speed: float = 0.0, with_phase: bool = False):  # type: ignore[no-untyped-def]
    def recipe(scene: Scene) -> Recipe:
        size = scene.torque(axis) / scene.speed(axis) ** per_speed
        phase = {"phase": scene.angle()} if with_phase else {}
        return Recipe(low, high, lambda m: {"size": m * size, **phase}, limit=0.4)

    return recipe


def _uneven_gain(scene: Scene) -> Recipe:
    sign = scene.sign()
    return Recipe(0.05, 0.3, lambda m: {"size": sign * m}, limit=0.6)


def _place_pull(scene: Scene) -> Recipe:
    paths = scene.healthy.ground_truth.pose[:, :2]
    wavelength = max(0.7 * float(np.ptp(paths, axis=0).max()), 0.3)
    size = scene.robot.total_mass * GRAVITY
    return Recipe(0.003, 0.03, lambda m: {"size": m * size, "wavelength": wavelength}, limit=0.1, target=("chassis",))


def _growing_drag(scene: Scene) -> Recipe:
    size = scene.robot.total_mass * GRAVITY / WALKING
    times = 0.4 * scene.healthy.duration
    return Recipe(0.004, 0.05, lambda m: {"size": m * size, "time_constant": times}, limit=0.15, target=("chassis",))


def _keel(scene: Scene) -> Recipe:
    reach = float(np.mean(np.linalg.norm(scene.robot.steer_axis, axis=1)))
    size = scene.robot.total_mass * GRAVITY * reach / WALKING**2
    return Recipe(0.005, 0.06, lambda m: {"size": m * size}, limit=0.3, target=("chassis",))


def _fading(scene: Scene) -> Recipe:
    times = 0.4 * scene.healthy.duration
    return Recipe(
        0.1, 0.5, lambda m: {"size": m, "time_constant": times}, limit=0.7, target=scene.robot.caster_names
    )


RECIPES: Mapping[str, Callable[[Scene], Recipe]] = {
    "actuator_delay": _delay,
    "actuator_lag": _lag,
    "aerodynamic_drag": _drag,
    "caster_offset_error": _offset_error,
    "clock_offset": _clock,
    "constant_load": _constant_load,
    "drive_coulomb_friction": _coulomb("drive"),
    "drive_stribeck_friction": _stribeck,
    "drive_viscous_friction": _viscous("drive"),
    "encoder_eccentricity": _encoder_eccentricity,
    "external_push": _push,
    "gear_backlash": _backlash,
    "gear_elasticity": _elasticity,
    "ground_slope": _slope,
    "imu_bias": _imu_error(0.008, 0.1, 1.0, 20.0),
    "imu_lever_arm": _lever_arm,
    "imu_scale": _imu_error(0.02, 0.2, 1.0, 2.0),
    "load_dependent_friction": _load_friction,
    "low_friction_patch": _patch,
    "motor_cogging": _cogging,
    "payload_mass": _payload,
    "payload_offset": _payload_offset,
    "rolling_resistance": _rolling_resistance,
    "scrub_torque": _scrub,
    "steer_coulomb_friction": _coulomb("steer"),
    "steer_viscous_friction": _viscous("steer"),
    "steer_zero_offset": _zero_offset,
    "torque_constant_error": _gain,
    "torque_saturation": _saturation,
    "tyre_lateral_stiffness": _stiffness,
    "tyre_longitudinal_stiffness": _stiffness,
    "tyre_radial_compliance": _compliance,
    "tyre_relaxation": _relaxation,
    "uneven_ground": _waves,
    "wheel_eccentricity": _wheel_eccentricity,
    "wheel_radius_error": _radius_error,
    "heading_friction": _outside_torque("steer", 0.01, 0.1, with_phase=True),
    "uneven_gain": _uneven_gain,
    "hard_spot": _outside_torque("drive", 0.01, 0.1, with_phase=True),
    "quadratic_drag": _outside_torque("steer", 0.01, 0.1, per_speed=2.0),
    "place_pull": _place_pull,
    "growing_drag": _growing_drag,
    "keel": _keel,
    "fading_torque": _fading,
    "coupled_friction": _outside_torque("drive", 0.01, 0.1),
}
NEEDS_IMU = frozenset({"imu_bias", "imu_scale", "imu_lever_arm", "clock_offset"})
# What happens between a torque's command and its report: where speeds are commanded nothing recorded shows it.
NEEDS_TORQUE_COMMANDS = frozenset({"actuator_delay", "actuator_lag", "torque_saturation"})

# A path that a controller with fast joint loops holds however hard the joints go: these then show in the torques alone.
HIDDEN_BY_CONTROL = (
    "drive_coulomb_friction", "drive_viscous_friction", "drive_stribeck_friction", "steer_coulomb_friction",
    "steer_viscous_friction", "load_dependent_friction", "constant_load", "torque_constant_error", "rolling_resistance",
    "motor_cogging", "payload_mass", "ground_slope", "aerodynamic_drag",
)
# A manoeuvre in which an effect hardly shows; None: the effect is not there in that recording.
SILENT_IN: Mapping[str, str | None] = {
    "steer_coulomb_friction": "chirp_x",
    "steer_viscous_friction": "chirp_x",
    "scrub_torque": "chirp_x",
    "imu_lever_arm": "strafe",
    "imu_scale": "strafe",
    "aerodynamic_drag": "creep",
    "drive_viscous_friction": "creep",
    "payload_mass": "creep",
    "low_friction_patch": "spin",
    "external_push": None,
    "tyre_lateral_stiffness": "chirp_x",
    "caster_offset_error": "chirp_x",
}


@dataclasses.dataclass(frozen=True)
class Cancelling:
    """Two effects of which one takes back, on average, what the other does.

    Attributes:
        first, second: names; on two casters with opposite parameters if they are the same.
        parameters: of the second, from those of the first and the scene.
    """

    first: str
    second: str
    parameters: Callable[[Scene, Mapping[str, float]], Mapping[str, float]]


def _opposite(parameter: str) -> Callable[[Scene, Mapping[str, float]], Mapping[str, float]]:
    return lambda scene, first: {parameter: -first[parameter]}


def _stronger_motors(scene: Scene, first: Mapping[str, float]) -> Mapping[str, float]:
    return {"error": first["mass"] / scene.robot.total_mass}


def _less_rolling(scene: Scene, first: Mapping[str, float]) -> Mapping[str, float]:
    """Motors stronger by what Coulomb friction takes of the torque, on average over the run."""
    torque = float(np.mean(np.abs(scene.healthy.joint_states.effort[:, :, DRIVE])))
    return {"error": min(first["coulomb"] / max(torque, 1e-6), 0.5)}


CANCELLING: Sequence[Cancelling] = (
    Cancelling("wheel_radius_error", "wheel_radius_error", _opposite("error")),
    Cancelling("constant_load", "constant_load", _opposite("load")),
    Cancelling("steer_zero_offset", "steer_zero_offset", _opposite("offset")),
    Cancelling("torque_constant_error", "torque_constant_error", _opposite("error")),
    Cancelling("payload_mass", "torque_constant_error", _stronger_motors),
    Cancelling("drive_coulomb_friction", "torque_constant_error", _less_rolling),
)
