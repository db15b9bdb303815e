"""A law that no effect of the library holds: a torque or force at some sites that is a free function of something measured.

    torque at site s = weight_s * factor_s(t) * f(argument_s(t))

The factor says what kind of torque it is: 1, the sign of the joint's own speed (a friction), that speed (a damping), the
motor's torque (an error of its constant), or a direction on the floor. The argument is a variable, or a sum or
difference of two joints' speeds; a law of two arguments is a map over the floor. The same f may be at work at several
sites: on all drives, or with opposite signs between two joints.

`hypotheses` lists the laws that are worth trying; all are linear in the weights of f's basis.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from ..regression.regression_problem import (
    UNKNOWN,
    FloatArray,
    LinearParameter,
    RegressionProblem,
    Sites,
    Term,
)

KNOTS = 8
FLOOR_KNOTS = 5  # along each side of a map
HARMONICS = 3
SPOT_HARMONICS = 8  # of what is at one place of a wheel's turn
ALIKE = 0.3  # part of the range over which a curve is taken to change
TRAVEL = "travel_since_reversal"
LEAST_TRAVEL = 2e-3  # of the farthest: friction that builds up over less is dry
RARENESS = 4.0  # nats for every further variable, and for one of another joint
RANGE_SAMPLES = 1000  # that the range of an argument is taken from
# Below this part of the top speed a direction of motion means nothing.
DIRECTION_WIDTH = 0.02

Combination = tuple[tuple[str, float], ...]


@dataclasses.dataclass(frozen=True)
class Factor:
    """What multiplies f: `kind` is one, sign, value, cos, sin or direction (v / |v|), of a variable.

    Attributes:
        width: speed over which a sign reverses, or below which a direction fades.
    """

    kind: str = "one"
    variable: str = ""
    width: float = 0.0


@dataclasses.dataclass(frozen=True)
class Place:
    """Where a law acts, and what it depends on there.

    Attributes:
        site: name of a site.
        arguments: one or two sums of variables, each as ((name, weight), ...).
    """

    site: str
    factor: Factor
    arguments: tuple[Combination, ...]
    weight: float = 1.0


@dataclasses.dataclass(frozen=True)
class Basis:
    """Functions of one or two arguments.

    Attributes:
        kind: "map" (piecewise linear between knots), "travel" (the same over the logarithm), "periodic" (a Fourier series) or
            "speed" (a map and a sign).
        knots: of every argument.
        width: over which the sign of a "speed" reverses.
        harmonics: of a "periodic".
    """

    kind: str
    knots: tuple[tuple[float, ...], ...]
    width: float = 0.0
    harmonics: int = HARMONICS

    def functions(self, arguments: Sequence[FloatArray]) -> FloatArray:
        """Evaluate at values of the arguments, each (N,); (N, K). The constant function is in their span."""
        if self.kind == "periodic":
            angles = arguments[0][:, None] * np.arange(1, self.harmonics + 1)
            return np.concatenate([np.ones((len(angles), 1)), np.cos(angles), np.sin(angles)], axis=1)
        hats = [
            _hats(self._scale(values), self._scale(np.array(knots)))
            for values, knots in zip(arguments, self.knots, strict=True)
        ]
        columns = hats[0] if len(hats) == 1 else (hats[0][:, :, None] * hats[1][:, None, :]).reshape(len(hats[0]), -1)
        columns = columns @ self._smooth()
        if self.kind == "speed":
            columns = np.concatenate([columns, np.tanh(arguments[0] / self.width)[:, None]], axis=1)
        return columns

    def _smooth(self) -> FloatArray:
        """Root of the prior covariance of the values at the knots: neighbours are alike, as all of them may be large."""
        root: FloatArray = np.ones((1, 1))
        for knots in self.knots:
            places = self._scale(np.array(knots))
            apart = (places[:, None] - places) / (places[-1] - places[0])
            covariance = 1.0 + np.exp(-0.5 * (apart / ALIKE) ** 2) + 1e-2 * np.eye(len(places))
            root = np.asarray(np.kron(root, np.linalg.cholesky(covariance)), dtype=np.float64)
        return root

    def _scale(self, values: FloatArray) -> FloatArray:
        """Values on the scale over which the functions are smooth."""
        return np.log(np.maximum(values, 0.5 * self.knots[0][0])) if self.kind == "travel" else values

    def values_at_knots(self, weights: FloatArray) -> FloatArray:
        """Return the curve or map of weights (K,) at its knots, without the sign of a "speed"."""
        root = self._smooth()
        values: FloatArray = root @ weights[: len(root)]
        return values


def _hats(values: FloatArray, knots: FloatArray) -> FloatArray:
    clipped = np.clip(values, knots[0], knots[-1])
    index = np.clip(np.searchsorted(knots, clipped, side="right") - 1, 0, len(knots) - 2)
    part = (clipped - knots[index]) / (knots[index + 1] - knots[index])
    hats = np.zeros((len(values), len(knots)))
    rows = np.arange(len(values))
    hats[rows, index] = 1.0 - part
    hats[rows, index + 1] = part
    return hats


@dataclasses.dataclass(frozen=True)
class Law:
    """One hypothesis: where, and of which kind; the weights of f are found by a fit."""

    places: tuple[Place, ...]
    basis: Basis

    @property
    def depends_on(self) -> tuple[str, ...]:
        """Variables, leading one first: arguments before factors, the site's own before others of an argument."""
        first = self.places[0]
        names = [name for argument in first.arguments for name, _ in argument]
        names += [p.arguments[0][0][0] for p in self.places[1:]]
        names += [place.factor.variable for place in self.places if place.factor.variable]
        return tuple(dict.fromkeys(names))

    @property
    def log_prior(self) -> float:
        """How much rarer it is than a function of one thing of its own joint, as a natural logarithm."""
        first = self.places[0]
        names = [*(name for argument in first.arguments for name, _ in argument), *filter(None, [first.factor.variable])]
        foreign = sum("/" in name and name.partition("/")[2] != first.site.partition("/")[2] for name in names)
        return -RARENESS * (len(names) - 1 + foreign)

    @property
    def sites(self) -> tuple[str, ...]:
        """Names of its sites."""
        return tuple(dict.fromkeys(place.site for place in self.places))

    def torques(self, sites: Sites) -> FloatArray:
        """What every function of the basis does along the motion, (N, J, K)."""
        total: FloatArray | None = None
        for place in self.places:
            functions = self.basis.functions([combined(sites.variables, a) for a in place.arguments])
            values = place.weight * factor_values(sites.variables, place.factor)[:, None] * functions
            if total is None:
                total = np.zeros((len(values), len(sites.names), values.shape[1]))
            total[:, sites.names.index(place.site)] += values
        assert total is not None
        return total

    def term(self, problem: RegressionProblem) -> Term:
        """Return the law as a candidate of a problem, which has sites."""
        assert problem.sites is not None
        columns = problem.sites.columns(self.torques(problem.sites))
        size = float(np.sqrt(np.mean(problem.measured[problem.valid] ** 2)))
        # One scale for all, so that a curve keeps the smoothness of its prior.
        own = float(np.sqrt(np.mean(columns[problem.valid] ** 2)))
        deviation = size / max(own, 1e-9 * size, 1e-300)
        return Term(
            effect=UNKNOWN,
            target=self.sites,
            parameters=tuple(
                LinearParameter(f"weight_{k}", "", -np.inf, np.inf, deviation) for k in range(columns.shape[2])
            ),
            shapes=({},),
            columns=lambda shape: columns,
            arguments=self.depends_on,
            log_prior=self.log_prior,
            law=self,
        )


def combined(variables: Mapping[str, FloatArray], argument: Combination) -> FloatArray:
    """Return a sum of variables (N,)."""
    total: FloatArray = sum(weight * variables[name] for name, weight in argument)  # type: ignore[assignment]
    return total


def factor_values(variables: Mapping[str, FloatArray], factor: Factor) -> FloatArray:
    """Return a factor along the motion (N,)."""
    if factor.kind == "one":
        return np.ones_like(next(iter(variables.values())))
    values = variables[factor.variable]
    if factor.kind == "sign":
        return np.tanh(values / factor.width)
    if factor.kind == "direction":
        return values / np.maximum(variables["speed"], factor.width)
    return {"value": values, "cos": np.cos(values), "sin": np.sin(values)}[factor.kind]


def top_of(values: FloatArray) -> float:
    """Return a robust largest size of a signal."""
    return max(float(np.quantile(np.abs(values), 0.98)), 1e-12)


# -- what is worth trying -----------------------------------------------------------------------------------------------


def hypotheses(sites: Sites) -> list[Law]:
    """Return every law that is tried, for the variables that there are."""
    laws: list[Law] = []
    bases: dict[object, Basis | None] = {}
    for places, kinds in _all_places(sites):
        for kind in kinds:
            arguments = tuple(place.arguments for place in places)
            if (kind, arguments) not in bases:
                bases[kind, arguments] = _basis(sites, places, kind)
            basis = bases[kind, arguments]
            if basis is not None:
                laws.append(Law(places, basis))
    return laws


def _basis(sites: Sites, places: Sequence[Place], kind: str) -> Basis | None:
    """Knots over the range of the arguments at all places; None where an argument hardly changes."""
    if kind == "travel":
        far = float(np.quantile(np.concatenate([combined(sites.variables, p.arguments[0]) for p in places]), 0.995))
        return Basis(kind, (tuple(np.geomspace(LEAST_TRAVEL * far, far, KNOTS).tolist()),)) if far > 0.0 else None
    if kind in ("periodic", "spot"):
        turn = tuple(np.linspace(-np.pi, np.pi, 61).tolist())
        return Basis("periodic", (turn,), harmonics=SPOT_HARMONICS if kind == "spot" else HARMONICS)
    knots: list[tuple[float, ...]] = []
    parts = np.linspace(0.005, 0.995, FLOOR_KNOTS if len(places[0].arguments) > 1 else KNOTS)
    for index in range(len(places[0].arguments)):
        values = [combined(sites.variables, place.arguments[index]) for place in dict.fromkeys(places)]
        step = max(1, len(values[0]) // RANGE_SAMPLES)
        ordered = np.sort(np.concatenate([v[::step] for v in values]))
        quantiles = np.interp(parts * (len(ordered) - 1), np.arange(len(ordered)), ordered)
        low, high = quantiles[0], quantiles[-1]
        if high - low < 1e-3 * max(abs(low), abs(high), 1e-300):
            return None
        # Halfway between equal steps and equal numbers of samples; one where the sign changes, as many laws bend there.
        own = 0.5 * (quantiles + np.linspace(low, high, len(parts)))
        nearest = int(np.argmin(np.abs(own[1:-1]))) + 1
        if own[nearest - 1] < 0.0 < own[nearest + 1]:
            own[nearest] = 0.0
        knots.append(tuple(own.tolist()))
    return Basis(kind, tuple(knots), sites.smoothing if kind == "speed" else 0.0)


def _all_places(sites: Sites) -> Iterator[tuple[tuple[Place, ...], tuple[str, ...]]]:
    """Yield places with the kinds of basis that their argument asks for."""
    variables = sites.variables
    if sites.names == ("axis_force",):
        dry = Factor("sign", "velocity", sites.smoothing)
        for factor in (Factor(), dry, Factor("value", "velocity"), Factor("value", "force")):
            for name in variables:
                if name != factor.variable:
                    kinds = ("map", "spot") if name in sites.angles else _kinds(name)
                    # What builds up over a way turns round at once, where a plain friction does so over a speed.
                    sudden = name == TRAVEL and factor.kind == "sign"
                    acting = Factor("sign", "velocity", min(sites.smoothing, sites.slow)) if sudden else factor
                    yield (Place("axis_force", acting, (((name, 1.0),),)),), kinds
        return
    casters = [name.removeprefix("drive_torque/") for name in sites.names if name.startswith("drive_torque/")]
    shared = [name for name in ("time", "x", "y", "speed", "v_x", "v_y", "omega") if name in variables]
    for axis in ("drive", "steer"):
        for kind in ("one", "sign", "value", "torque"):

            def place(caster: str, name: str, axis: str = axis, kind: str = kind) -> Place:
                velocity = f"{axis}_velocity/{caster}"
                factor = {
                    "one": Factor(), "sign": Factor("sign", velocity, sites.smoothing), "value": Factor("value", velocity),
                    "torque": Factor("value", f"{axis}_torque/{caster}"),
                }[kind]  # fmt: skip
                return Place(f"{axis}_torque/{caster}", factor, (((name, 1.0),),))

            for quantity in _own_quantities(axis):
                names = [f"{quantity}/{caster}" for caster in casters]
                own = tuple(place(caster, name) for caster, name in zip(casters, names, strict=True))
                if own[0].factor.variable == names[0] or names[0] not in variables:
                    continue
                for places in (*((one,) for one in own), own):
                    yield places, _kinds(names[0])
            for name in shared:
                for group in (*((caster,) for caster in casters), casters):
                    yield tuple(place(caster, name) for caster in group), _kinds(name)
            if kind in ("one", "sign"):
                for one, other in itertools.permutations(casters, 2):
                    for quantity in (f"{axis}_velocity", "steer_angle"):
                        yield (place(one, f"{quantity}/{other}"),), _kinds(quantity)
            if kind == "sign" and "x" in variables and axis == "drive":
                yield tuple(
                    dataclasses.replace(place(caster, "x"), arguments=((("x", 1.0),), (("y", 1.0),))) for caster in casters
                ), ("map",)
    yield from _couplings(casters)
    if "speed" in variables:  # off the ground none says where the robot goes
        yield from _forces(shared, variables)


def _own_quantities(axis: str) -> tuple[str, ...]:
    other = "steer" if axis == "drive" else "drive"
    return (
        "steer_angle", "drive_angle", f"{axis}_velocity", f"{other}_velocity", f"{axis}_torque", f"{other}_torque",
        "drive_normal_force",
    )  # fmt: skip


def _kinds(name: str) -> tuple[str, ...]:
    if name.startswith("steer_angle"):
        return ("periodic", "map")
    if name.startswith("drive_angle"):
        return ("periodic", "spot")
    if name == TRAVEL:
        return ("travel",)
    return ("speed",) if "velocity" in name or name in ("v_x", "v_y", "omega") else ("map",)


def _couplings(casters: Sequence[str]) -> Iterator[tuple[tuple[Place, ...], tuple[str, ...]]]:
    """Yield torques by the sum or the difference of two joints' speeds: at one of them, or at both."""
    pairs = [(f"{axis}_velocity/{a}", f"{axis}_velocity/{b}") for axis in ("drive", "steer")
             for a, b in itertools.combinations(casters, 2)]  # fmt: skip
    pairs += [(f"drive_velocity/{caster}", f"steer_velocity/{caster}") for caster in casters]
    for one, other in pairs:
        for sign in (1.0, -1.0):
            forward = (((one, 1.0), (other, sign)),)
            backward = (((other, sign), (one, 1.0)),)
            first = Place(one.replace("velocity", "torque"), Factor(), forward)
            second = Place(other.replace("velocity", "torque"), Factor(), backward, sign)
            for places in ((first,), (second,), (first, second)):
                yield places, ("speed",)


def _forces(
    shared: Sequence[str], variables: Mapping[str, FloatArray]
) -> Iterator[tuple[tuple[Place, ...], tuple[str, ...]]]:
    """Yield forces on the chassis: along an axis of the world or of the robot, along the motion or with it, and a moment.

    A force or moment along an axis of the robot may also be a product of one component of the twist and a function of another,
    and a moment a function of the heading.
    """
    width = DIRECTION_WIDTH * top_of(variables["speed"])

    def along(arguments: tuple[Combination, ...]) -> Iterator[tuple[Place, ...]]:
        x, y = "chassis_force/x", "chassis_force/y"
        cos, sin = Factor("cos", "yaw"), Factor("sin", "yaw")
        yield Place(x, cos, arguments), Place(y, sin, arguments, -1.0)
        yield Place(x, sin, arguments), Place(y, cos, arguments)
        yield (Place(x, Factor(), arguments),)
        yield (Place(y, Factor(), arguments),)
        yield Place(x, Factor("direction", "v_x", width), arguments), Place(y, Factor("direction", "v_y", width), arguments)
        yield Place(x, Factor("value", "v_x"), arguments), Place(y, Factor("value", "v_y"), arguments)
        yield (Place("chassis_torque/z", Factor(), arguments),)

    for name in shared:
        for places in along((((name, 1.0),),)):
            yield places, _kinds(name)
    yield (Place("chassis_torque/z", Factor(), ((("yaw", 1.0),),)),), _kinds("yaw")  # as of a cable that winds up
    for site in ("chassis_force/x", "chassis_force/y", "chassis_torque/z"):
        for one, other in itertools.permutations(("v_x", "v_y", "omega"), 2):
            yield (Place(site, Factor("value", one), (((other, 1.0),),)),), _kinds(other)
    if "x" in variables:
        for places in along(((("x", 1.0),), (("y", 1.0),))):
            yield places, ("map",)
