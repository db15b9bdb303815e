"""What a regression baseline may choose from.

Two libraries. `variable_columns` is what somebody would write down who knows the robot and not this package: joint rates,
their signs and powers, loads, torques and accelerations of every caster, turned into the axes of the chassis, and the
same for the chassis itself. `effect_columns` hands over this package's own physics: the very columns that the analyser
chooses from, with the numbers of the description among them.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

import numpy as np

from ..regression.regression_problem import FloatArray, RegressionProblem, Shape, Term, segment_slices

# Over this part of its largest value a rate changes sign: the variables have passed the channels' filter.
SIGN_WIDTH = 0.02
# Orders of a ripple over a turn that are offered on a rotary axis.
RIPPLE_ORDERS = range(1, 31)
# So many orders of a cogging are offered of this package's own, whose grid holds a thousand.
LONG_GRID = 20
# Columns that are this parallel cannot be told apart by any data.
PARALLEL = 0.9995
# What a number of the description says where it leaves its tolerance: effect, and the target where it names none itself.
EFFECT_OF_NUMBER: Mapping[str, tuple[str, str]] = {
    "chassis.mass": ("payload_mass", "chassis"),
    "chassis.com.x": ("payload_offset", "chassis"),
    "chassis.com.y": ("payload_offset", "chassis"),
    "wheel_radius": ("wheel_radius_error", ""),
    "steer_zero": ("steer_zero_offset", ""),
    "caster_offset.x": ("caster_offset_error", ""),
    "torque_constant": ("torque_constant_error", ""),
    "imu.gyro_scale": ("imu_scale", "imu"),
    "imu.gyro_bias": ("imu_bias", "imu"),
    "imu.accelerometer_bias.x": ("imu_bias", "imu"),
    "imu.accelerometer_bias.y": ("imu_bias", "imu"),
    "imu.position.x": ("imu_lever_arm", "imu"),
    "imu.position.y": ("imu_lever_arm", "imu"),
    "ground.slope.x": ("ground_slope", "chassis"),
    "ground.slope.y": ("ground_slope", "chassis"),
}


@dataclasses.dataclass(frozen=True)
class Candidate:
    """One column of a library.

    Attributes:
        label: its expression.
        effect: `effect/target` that it stands for; empty where none would be honest.
        column: (T, C), what it adds to each channel.
        tolerance: of the number of the description that it is the column of; 0 for anything else. Within three of it
            the number is re-tuned and nothing is named.
        shape: shaping parameters of the effect that it is of.
    """

    label: str
    effect: str
    column: FloatArray
    tolerance: float = 0.0
    shape: tuple[tuple[str, float], ...] = ()


def number_as_effect(name: str) -> str:
    """Return `effect/target` of a number of the description, or the number's own name."""
    number, _, place = name.partition("/")
    if number not in EFFECT_OF_NUMBER:
        return name
    effect, target = EFFECT_OF_NUMBER[number]
    return f"{effect}/{target or place.removesuffix('_drive').removesuffix('_steer')}"


def effect_columns(problem: RegressionProblem) -> list[Candidate]:
    """Columns of all numbers of the description and of all effects on single targets, none twice."""
    candidates = [
        Candidate(nuisance.name, number_as_effect(nuisance.name), nuisance.column, nuisance.deviation)
        for nuisance in problem.nuisances
    ]
    for index, term in enumerate(problem.terms):
        # On all casters alike is the sum of the single ones.
        if len(term.target) > 1:
            continue
        for shape in _offered_shapes(problem, term):
            key = tuple(sorted(shape.items()))
            columns = problem.columns(index, key)
            for k, parameter in enumerate(term.parameters):
                candidates.append(Candidate(f"{term.key}.{parameter.name}", term.key, columns[:, :, k], 0.0, key))
    return _without_repeats(problem, candidates)


def _offered_shapes(problem: RegressionProblem, term: Term) -> list[Shape]:
    """All shapes of a term; of a long grid those that fit the residual best on their own, which is a gift to the baseline."""
    if term.scan is None:
        return list(term.shapes)
    scanned, target = term.scan(), np.where(problem.valid, problem.residual, 0.0)
    overlap = np.einsum("tcsp,tc->sp", scanned, target) ** 2
    size = np.maximum(np.einsum("tcsp,tcsp->sp", scanned, scanned), 1e-300)
    leading = np.argsort(-np.sum(overlap / size, axis=1))[:LONG_GRID]
    return [term.shapes[index] for index in leading]


def column_in(problem: RegressionProblem, candidate: Candidate) -> FloatArray:
    """Return the column (T, C) of a candidate of `effect_columns` in another problem; zero where it has none."""
    for nuisance in problem.nuisances:
        if nuisance.name == candidate.label:
            return nuisance.column
    for index, term in enumerate(problem.terms):
        if term.key == candidate.effect and candidate.label.startswith(f"{term.key}."):
            names = [parameter.name for parameter in term.parameters]
            parameter = candidate.label.removeprefix(f"{term.key}.")
            if parameter in names:
                column: FloatArray = problem.columns(index, candidate.shape)[:, :, names.index(parameter)]
                return column
    return np.zeros_like(problem.residual)


def _without_repeats(problem: RegressionProblem, candidates: list[Candidate]) -> list[Candidate]:
    """Leave out columns that vanish or repeat an earlier one."""
    scale = np.maximum(np.std(problem.residual, axis=0), 1e-300)
    kept: list[Candidate] = []
    units: list[FloatArray] = []
    for candidate in candidates:
        flat = np.where(problem.valid, candidate.column / scale, 0.0).ravel()
        size = float(np.linalg.norm(flat))
        if size < 1e-12:
            continue
        flat = flat / size
        if units and float(np.max(np.abs(np.asarray(units) @ flat))) > PARALLEL:
            continue
        kept.append(candidate)
        units.append(flat)
    return kept


def variable_columns(problem: RegressionProblem) -> list[Candidate]:
    """Columns made of the measured variables; the same (T, C) for every channel."""
    named = _of_an_axis(problem) if problem.channels[0].name == "axis_force" else _of_a_robot(problem)
    width = len(problem.channels)
    return [Candidate(label, effect, np.repeat(values[:, None], width, axis=1)) for label, effect, values in named]


def features(problem: RegressionProblem) -> dict[str, FloatArray]:
    """Variables (T,) for a method that makes its own functions of them: angles as cosine and sine, rates differentiated.

    The time is left out: no other recording has it.
    """
    found = {}
    for name, values in problem.variables.items():
        if name.startswith(("steer_angle", "drive_angle")):
            found[f"cos({name})"], found[f"sin({name})"] = np.cos(values), np.sin(values)
        elif name != "time":
            found[name] = values
        if name == "position":
            found["position within a turn"] = np.mod(values, 2.0 * np.pi)
        if "velocity" in name or name in ("v_x", "v_y", "omega"):
            found[f"d/dt {name}"] = rate_of(problem, values)
    return found


def rate_of(problem: RegressionProblem, values: FloatArray) -> FloatArray:
    """Derivative (T,) of a variable along each contiguous piece."""
    rate = np.zeros_like(values)
    for piece in segment_slices(problem.segment):
        if piece.stop - piece.start > 1:
            rate[piece] = np.gradient(values[piece], 1.0 / problem.rate)
    return rate


def _smooth_sign(values: FloatArray) -> FloatArray:
    top = max(float(np.quantile(np.abs(values), 0.99)), 1e-12)
    sign: FloatArray = np.tanh(values / (SIGN_WIDTH * top))
    return sign


Named = tuple[str, str, FloatArray]


def _of_an_axis(problem: RegressionProblem) -> list[Named]:
    variables = problem.variables
    position, speed, acceleration = (variables[name] for name in ("position", "velocity", "acceleration"))
    # The force that the nominal model explains: the measured one holds the residual's own noise.
    force = (problem.measured - problem.residual)[:, 0]
    sign = _smooth_sign(speed)
    named = [
        ("1", "constant_load/axis", np.ones_like(speed)),
        ("velocity", "drive_viscous_friction/axis", speed),
        ("sign(velocity)", "drive_coulomb_friction/axis", sign),
        ("|velocity|", "drive_viscous_friction/axis", np.abs(speed)),
        ("velocity |velocity|", "", speed * np.abs(speed)),
        ("velocity^3", "", speed**3),
        ("acceleration", "inertia", acceleration),
        ("|force| sign(velocity)", "load_dependent_friction/axis", np.abs(force) * sign),
        ("position", "", position),
        ("position^2", "", position**2),
    ]
    for order in RIPPLE_ORDERS:
        for function in (np.cos, np.sin):
            label = f"{function.__name__}({order} position)"
            named.append((label, "motor_cogging/axis", function(order * position)))
    return named


def _of_a_robot(problem: RegressionProblem) -> list[Named]:
    variables = problem.variables
    speed = variables["speed"]
    named: list[Named] = [("1", "", np.ones_like(speed))]
    for name in ("v_x", "v_y", "omega"):
        named += [
            (name, "", variables[name]),
            (f"sign({name})", "", _smooth_sign(variables[name])),
            (f"speed {name}", "aerodynamic_drag/chassis", speed * variables[name]),
            (f"d/dt {name}", "payload_mass/chassis", rate_of(problem, variables[name])),
        ]
    named += [
        ("omega v_x", "", variables["omega"] * variables["v_x"]),
        ("omega v_y", "", variables["omega"] * variables["v_y"]),
        ("omega^2", "", variables["omega"] ** 2),
    ]
    for key, angle in variables.items():
        quantity, _, caster = key.partition("/")
        if quantity == "steer_angle":
            for label, effect, values in _of_a_caster(problem, caster):
                # What a wheel pushes along or across its heading, seen by the chassis.
                for function in (np.cos, np.sin):
                    named.append((f"{label} {function.__name__}({key})", effect, values * function(angle)))
    return named


def _of_a_caster(problem: RegressionProblem, caster: str) -> list[Named]:
    variables = problem.variables
    load = variables[f"drive_normal_force/{caster}"]
    named: list[Named] = [("1", f"constant_load/{caster}", np.ones_like(load))]
    for axis in ("drive", "steer"):
        rate, torque = f"{axis}_velocity/{caster}", f"{axis}_torque/{caster}"
        sign = _smooth_sign(variables[rate])
        named += [
            (rate, f"{axis}_viscous_friction/{caster}", variables[rate]),
            (f"sign({rate})", f"{axis}_coulomb_friction/{caster}", sign),
            (f"{rate} |{rate}|", "", variables[rate] * np.abs(variables[rate])),
            (torque, f"torque_constant_error/{caster}", variables[torque]),
            (f"d/dt {rate}", "", rate_of(problem, variables[rate])),
        ]
        if axis == "drive":
            named.append((f"load sign({rate})", f"rolling_resistance/{caster}", load * sign))
    return named
