"""Writes the file of an effect that simulators and analyser can use from a law that was found outside the library.

The file is a module with a module-level `EFFECT`, as those of `pcw_description.effects`: a torque at one joint of each
targeted caster, or a force on the chassis. Its kernel sees the position, speed, motor torque and load of its own joint,
or time, pose and twist of the chassis. A law that depends on anything else cannot be written so, and is not.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from pcw_description.effects.effect import Effect

from ..errors import MismatchError
from ..regression.regression_problem import FloatArray
from .leftover_expression import LINEAR, ONE, Atom, ClosedForm
from .unknown_law import Basis, Factor, Law, Place

# What the kernel of a torque calls the quantities of its own joint, and of a chassis force its inputs.
BENCH = {"position": "position", "velocity": "velocity", "force": "motor_torque"}
CHASSIS = {
    "time": "at[FORCE_TIME]", "x": "at[POSE_X]", "y": "at[POSE_Y]", "yaw": "at[POSE_YAW]", "v_x": "at[TWIST_X]",
    "v_y": "at[TWIST_Y]", "omega": "at[TWIST_YAW]", "speed": "sqrt(at[TWIST_X]**2 + at[TWIST_Y]**2)",
}  # fmt: skip
ROWS = {"chassis_force/x": 0, "chassis_force/y": 1, "chassis_torque/z": 5}
LOOK_ALIKES = {
    "drive": ("drive_coulomb_friction", "drive_viscous_friction"),
    "steer": ("steer_coulomb_friction", "steer_viscous_friction"),
    "chassis": ("aerodynamic_drag", "external_push"),
}
LARGEST_FACTOR = 100.0  # how far a number may lie from the one found
SCALE = "scale"  # what a curve or map as a whole is multiplied by


class NoSuchKernelError(MismatchError):
    """A law that depends on what the kernel of an effect does not see."""


@dataclasses.dataclass(frozen=True)
class GeneratedEffect:
    """An effect as a file.

    Attributes:
        name: of the effect and, with .py, of the file.
        target: where it was found.
        parameters: as found.
        source: text of the file.
    """

    name: str
    target: tuple[str, ...]
    parameters: Mapping[str, float]
    source: str

    @functools.cached_property
    def loaded(self) -> Effect:
        """What a reader of the file gets, without a file."""
        module: dict[str, Any] = {"__name__": self.name}
        exec(compile(self.source, f"<{self.name}>", "exec"), module)
        effect = module["EFFECT"]
        assert isinstance(effect, Effect)
        return effect


def generate(law: Law, weights: FloatArray, recordings: Sequence[str], taken: Sequence[str] = ()) -> GeneratedEffect:
    """Write the file of a law.

    Args:
        law: where and of which kind.
        weights: of its basis (K,).
        recordings: what it was found in, for the docstring.
        taken: names that it must not have.

    Raises:
        NoSuchKernelError: it depends on what no kernel sees, or acts at several kinds of places.
    """
    if all(place.site in ROWS for place in law.places):
        return _chassis_force(law, weights, recordings, taken)
    axes = {place.site.partition("_torque/")[0] for place in law.places}
    if len(axes) > 1:
        raise NoSuchKernelError("it acts at drives and steerings at once")
    if len(law.sites) < len(law.places) or any(place.weight != 1.0 for place in law.places):
        raise NoSuchKernelError("it couples joints, and the kernel of a torque sees its own joint alone")
    return _joint_torque(law, weights, recordings, taken)


# -- a torque at a joint ------------------------------------------------------------------------------------------------


def _joint_torque(law: Law, weights: FloatArray, recordings: Sequence[str], taken: Sequence[str]) -> GeneratedEffect:
    first = law.places[0]
    bench = first.site == "axis_force"
    axis = "drive" if bench else first.site.partition("_torque/")[0]
    seen = [BENCH if bench else _own(axis, place.site.partition("/")[2]) for place in law.places]
    arguments = [_seen(place, names) for place, names in zip(law.places, seen, strict=True)]
    if len(set(arguments)) > 1:
        raise NoSuchKernelError("its places depend on different things")
    argument, factor = arguments[0], first.factor
    body = _body(law.basis, (argument,))
    if factor.kind == "sign":
        width = f"{factor.width:.9g}"
        lines = [f"sign = smooth_sign(velocity, {width})", f"factor, factor_slope = sign, (1.0 - sign * sign) / {width}"]
    else:
        value = "1.0" if factor.kind == "one" else _name_of(factor.variable, seen[0])
        lines = [f"factor, factor_slope = {value}, {1.0 if value == 'velocity' else 0.0}"]
    slope = "factor_slope * size" + (" + factor * slope" if argument == "velocity" else "")
    lines += [*body.lines, *(body.slope if argument == "velocity" else ()), f"return factor * size, -({slope})"]
    parts, found = _Parts.of(law, axis, body, taken), parameters_of(law.basis, weights)
    imports = ["from pcw_description.compiled import compiled, compiled_joint_torque" if body.helper else
               "from pcw_description.compiled import compiled_joint_torque"]  # fmt: skip
    if factor.kind == "sign":
        imports.append("from pcw_description.effects.drive_coulomb_friction import smooth_sign")
    imports += [
        "from pcw_description.effects.effect import EffectParameter",
        "from pcw_description.effects.kinds import JointTorqueEffect",
    ]
    kernel = [
        "@compiled_joint_torque",
        "def torque(position, velocity, motor_torque, normal_force, parameters):  # type: ignore[no-untyped-def]",
        f'    """Return the torque {parts.formula} [N m], and minus its slope over the speed."""',
        *(f"    {line}" for line in lines),
    ]
    target = ("axis",) if bench else tuple(site.partition("/")[2] for site in law.sites)
    source = parts.source(
        imports, body, found, kernel, "JointTorqueEffect", "caster", axis, "torque=torque", recordings, ("joint_states",)
    )
    return GeneratedEffect(parts.name, target, found, source)


def _own(axis: str, caster: str) -> dict[str, str]:
    return {
        f"{axis}_angle/{caster}": "position", f"{axis}_velocity/{caster}": "velocity",
        f"{axis}_torque/{caster}": "motor_torque", f"drive_normal_force/{caster}": "normal_force",
    }  # fmt: skip


def _seen(place: Place, names: Mapping[str, str]) -> str:
    """Return the one quantity of its own joint that a law depends on there."""
    if len(place.arguments) > 1 or len(place.arguments[0]) > 1:
        raise NoSuchKernelError("it depends on several things at once, and the kernel of a torque sees its own joint alone")
    if place.factor.variable:
        _name_of(place.factor.variable, names)
    return _name_of(place.arguments[0][0][0], names)


def _name_of(variable: str, names: Mapping[str, str]) -> str:
    if variable not in names:
        raise NoSuchKernelError(f"it depends on {variable}, which the kernel of a torque at that joint does not see")
    return names[variable]


# -- a force on the chassis ---------------------------------------------------------------------------------------------


def _chassis_force(law: Law, weights: FloatArray, recordings: Sequence[str], taken: Sequence[str]) -> GeneratedEffect:
    arguments = law.places[0].arguments
    for place in law.places:
        if place.arguments != arguments or any(len(a) > 1 or a[0][0] not in CHASSIS for a in arguments):
            raise NoSuchKernelError("it depends on what the kernel of a force on the chassis does not see")
    body = _body(law.basis, tuple(CHASSIS[a[0][0]] for a in arguments))
    lines = list(body.lines)
    for place in law.places:
        sign = "-" if place.weight < 0 else "+"
        lines.append(f"result[{ROWS[place.site]}] {sign}= {_chassis_factor(place.factor)} * size")
    text = "\n".join([*lines, *body.helper])
    inputs = sorted({name for name in ("FORCE_TIME", "POSE_X", "POSE_Y", "POSE_YAW", "TWIST_X", "TWIST_Y", "TWIST_YAW")
                     if name in text})  # fmt: skip
    parts, found = _Parts.of(law, "chassis", body, taken), parameters_of(law.basis, weights)
    imports = [
        f"from pcw_description.compiled import {'compiled, ' if body.helper else ''}compiled_array_kernel",
        "from pcw_description.effects.effect import EffectParameter",
        f"from pcw_description.effects.kinds import {', '.join([*inputs, 'ChassisForceEffect'])}",
    ]
    kernel = [
        "@compiled_array_kernel",
        "def wrench(at, parameters, result):  # type: ignore[no-untyped-def]",
        f'    """Add {parts.formula}."""',
        *(f"    {line}" for line in lines),
    ]
    source = parts.source(
        imports, body, found, kernel, "ChassisForceEffect", "chassis", "chassis", "wrench=wrench", recordings,
        ("joint_states", "ground_truth/odom"),
    )
    return GeneratedEffect(parts.name, ("chassis",), found, source)


def _chassis_factor(factor: Factor) -> str:
    if factor.kind == "one":
        return "1.0"
    if factor.kind == "direction":
        return f"{CHASSIS[factor.variable]} / max({CHASSIS['speed']}, {factor.width:.9g})"
    if factor.kind == "value":
        return CHASSIS[factor.variable]
    return f"{factor.kind}({CHASSIS[factor.variable]})"


# -- the function -------------------------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class _Body:
    """The function f in Python.

    Attributes:
        helper: lines before the kernel; lines: of the kernel, which set `size`; slope: those that set `slope`.
        formula: in short; clipped: whether it stays what it is at the ends of what was seen.
    """

    helper: tuple[str, ...]
    lines: tuple[str, ...]
    slope: tuple[str, ...]
    formula: str
    clipped: bool = True


def parameters_of(basis: Basis, weights: FloatArray) -> dict[str, float]:
    """Return the numbers of the effect that holds a law with weights (K,): gains of a closed form, or a curve at its knots."""
    if isinstance(basis, ClosedForm):
        return {f"gain_{k}": float(weight) for k, weight in enumerate(weights)}
    values = basis.values_at_knots(weights)
    values = np.append(values, weights[len(values) :])  # the sign of a "speed"
    return {SCALE: 1.0} | {f"value_{k}": float(value) for k, value in enumerate(values)}


def _body(basis: Basis, arguments: tuple[str, ...]) -> _Body:
    if isinstance(basis, ClosedForm):
        return _closed(basis, arguments[0])
    if len(arguments) == 2:
        return _map_of_two(basis, arguments)
    if basis.kind == "periodic":
        raise AssertionError("a Fourier series is a closed form")
    knots = basis.knots[0]
    helper = (
        f"KNOTS = np.array({_numbers(knots)})", "", "",
        "@compiled",
        "def curve(z, values):  # type: ignore[no-untyped-def]",
        '    """Return the curve at z, through `values` at the knots, and its slope; constant beyond its ends."""',
        "    if z <= KNOTS[0]:",
        "        return values[0], 0.0",
        "    for k in range(1, len(KNOTS)):",
        "        if z < KNOTS[k]:",
        "            slope = (values[k] - values[k - 1]) / (KNOTS[k] - KNOTS[k - 1])",
        "            return values[k - 1] + slope * (z - KNOTS[k - 1]), slope",
        "    return values[len(KNOTS) - 1], 0.0",
    )  # fmt: skip
    lines = [f"size, slope = curve({arguments[0]}, parameters[1:])"]
    if basis.kind == "speed":
        lines += [
            f"sign = tanh({arguments[0]} / {basis.width:.9g})",
            "size += parameters[-1] * sign",
            f"slope += parameters[-1] * (1.0 - sign * sign) / {basis.width:.9g}",
        ]
    lines.append("size *= parameters[0]")
    return _Body(helper, tuple(lines), ("slope *= parameters[0]",), "scale times a curve")


def _map_of_two(basis: Basis, arguments: tuple[str, ...]) -> _Body:
    first, second = basis.knots
    helper = (
        f"KNOTS_1 = np.array({_numbers(first)})", f"KNOTS_2 = np.array({_numbers(second)})", "", "",
        "@compiled",
        "def place(z, knots):  # type: ignore[no-untyped-def]",
        '    """Return the knot below z and how far z is on the way to the next, within the map."""',
        "    k = 0",
        "    while k < len(knots) - 2 and z >= knots[k + 1]:",
        "        k += 1",
        "    return k, min(max((z - knots[k]) / (knots[k + 1] - knots[k]), 0.0), 1.0)",
    )  # fmt: skip
    lines = (
        f"i, p = place({arguments[0]}, KNOTS_1)", f"j, q = place({arguments[1]}, KNOTS_2)",
        f"values = parameters[1:].reshape({len(first)}, {len(second)})",
        "low = (1.0 - q) * values[i, j] + q * values[i, j + 1]",
        "high = (1.0 - q) * values[i + 1, j] + q * values[i + 1, j + 1]",
        "size = parameters[0] * ((1.0 - p) * low + p * high)",
    )  # fmt: skip
    return _Body(helper, lines, (), "scale times a map")


def _closed(basis: ClosedForm, argument: str) -> _Body:
    names = [f"gain_{k}" for k in range(len(basis.atoms))]
    lines, inside = [f"z = {argument}"], ""
    if basis.clipped:
        low, high = basis.knots[0][0], basis.knots[0][-1]
        lines = [f"z = min(max({argument}, {low:.9g}), {high:.9g})"]
        inside = f" if {low:.9g} < {argument} < {high:.9g} else 0.0"
    sizes = [f"parameters[{k}]" + _times(atom) for k, atom in enumerate(basis.atoms)]
    slopes = [f"parameters[{k}] * ({atom.slope('z')})" for k, atom in enumerate(basis.atoms) if atom.shape is not ONE]
    lines.append(f"size = {' + '.join(sizes)}")
    formula = " + ".join(
        name + ("" if atom.shape is ONE else f" {atom.written('z')}") for name, atom in zip(names, basis.atoms, strict=True)
    )
    slope = f"slope = ({' + '.join(slopes) or '0.0'}){inside}"
    return _Body((), tuple(lines), (slope,), formula, basis.clipped)


def _times(atom: Atom) -> str:
    if atom.shape is ONE:
        return ""
    return " * z" if atom.shape is LINEAR else f" * {atom.precise('z')}"


def _numbers(values: Sequence[float] | FloatArray) -> str:
    return "[" + ", ".join(f"{float(value):.6g}" for value in values) + "]"


def _tuple(words: Sequence[str]) -> str:
    quoted = ", ".join(f'"{word}"' for word in words)
    return f"({quoted}{',' if len(words) == 1 else ''})"


# -- the file -----------------------------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class _Parts:
    name: str
    what: str
    formula: str
    unit: str

    @classmethod
    def of(cls, law: Law, axis: str, body: _Body, taken: Sequence[str]) -> _Parts:
        first = law.places[0]
        quantities = [a[0][0].partition("/")[0] for a in first.arguments]
        kind = {"sign": "friction", "value": "factor", "direction": "drag"}.get(first.factor.kind, "torque")
        if axis == "chassis" and kind in ("torque", "factor"):
            kind = "moment" if first.site == "chassis_torque/z" else "force"
            quantities += [first.factor.variable] if first.factor.kind == "value" else []
        name = f"unknown_{axis}_{kind}_by_{'_and_'.join(quantities)}"
        plain, number = name, 1
        while name in taken:
            number += 1
            name = f"{plain}_{number}"
        factor = {"sign": "sign(velocity) ", "value": "velocity " if "velocity" in first.factor.variable else "motor_torque "}
        unit = {"one": "N m", "sign": "N m", "value": "1"}.get(first.factor.kind, "N")
        if axis == "chassis":
            unit = "N m" if first.site == "chassis_torque/z" else "N"
            factor["value"] = f"{first.factor.variable} "
        what = f"{kind} in {'the chassis' if axis == 'chassis' else f'the {axis}'} that depends on {' and '.join(quantities)}"
        return cls(name, what, f"{factor.get(first.factor.kind, '')}({body.formula})", unit)

    def source(
        self, imports: Sequence[str], body: _Body, found: Mapping[str, float], kernel: Sequence[str], kind: str,
        target_kind: str, axis: str, law: str, recordings: Sequence[str], sensors: tuple[str, ...],
    ) -> str:
        """Return the whole file."""
        text = "\n".join([*body.helper, *kernel])
        functions = sorted(name for name in ("cos", "exp", "sin", "sqrt", "tanh") if f"{name}(" in text.replace(".tanh(", ""))
        origin = [f"    {name}" for name in recordings]
        ends = ["", "Beyond the range that these cover it is continued by its value at the end."] if body.clipped else []
        lines = [
            f'"""{self.what[0].upper() + self.what[1:]}, as the mismatch analyser found it.', "",
            "It is no known physics: a closed form or a curve fitted to what named effects leave in the recordings", "",
            *origin, *ends, '"""', "",
        ]  # fmt: skip
        if functions:
            lines += [f"from math import {', '.join(functions)}", ""]
        if body.helper:
            lines += ["import numpy as np", ""]
        lines += [*imports, ""]
        if body.helper:
            lines += [*body.helper, ""]
        where = " at {target}" if target_kind == "caster" else ""
        main, bound = next(iter(found)), LARGEST_FACTOR * max(1e-6, *map(abs, found.values()))
        lines += [
            "", *kernel, "", "", f"EFFECT = {kind}(",
            f'    name="{self.name}",', f'    target_kind="{target_kind}",', f'    axis="{axis}",',
            f'    summary="{self.what[0].upper() + self.what[1:]}, found by the mismatch analyser.",',
            f'    sentence="{self.what[0].upper() + self.what[1:]}{where}, {main} {{{main}:.3g}}.",',
            "    parameters=(", *(f"        {line}" for name, value in found.items()
                                  for line in self._parameter(name, value, bound, SCALE not in found or name == SCALE)),
            "    ),",
            f"    sensors={_tuple(sensors)},", f"    look_alikes={_tuple(LOOK_ALIKES[axis])},",
            f'    separating_experiment="repeat the manoeuvre with {self.what.rpartition("depends on ")[2]} held still",',
            f"    {law},", ")", "",
        ]  # fmt: skip
        return "\n".join(lines)

    def _parameter(self, name: str, value: float, bound: float, linear: bool) -> list[str]:
        unit = "1" if name == SCALE else self.unit
        numbers = f"{-bound:.6g}, {bound:.6g}, {value:.9g}, default={value:.9g}"
        return [
            "EffectParameter(",
            f'    "{name}", "{unit}", "as found: {value:.4g}", {numbers},',
            *(["    linear=True,"] if linear else []),
            "),",
        ]
