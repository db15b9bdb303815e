"""A compact closed form for a function that was found as a smooth curve, where one does as well.

The curve is known as weights w of its basis with a covariance. A closed form sum_p c_p g_p is put into the same basis,
G = B^+ g, and judged by (w - G c)^T Sigma^-1 (w - G c): so hundreds of forms are compared without a look at the
recording. Groups of functions are added one at a time while each pays for its numbers; those with a number inside (a time
constant, a wave number) are refined at every step.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Sequence

import numpy as np
from scipy import optimize

from ..regression.regression_problem import FloatArray
from .unknown_law import Basis, Combination, Law

LARGEST_GROUPS = 3
# What a further number must improve the fit by, in units of the squared deviation: 10 nats, odds of a few thousand to one.
PRICE = 20.0
SAMPLES = 200
ALIKE_ENOUGH = 0.97  # part of the square of a curve that a plain function of the same variable has to do
TRAVELS = 20  # lengths over which friction may build up that are tried at first


@dataclasses.dataclass(frozen=True)
class Shape:
    """A function g(z, inner...) of the library.

    Attributes:
        text: with z for the argument and {0}, {1} for the inner numbers; valid Python and numpy.
        slope: of g over z, written likewise.
        starts: grid of inner numbers, from the range (low, high) of z.
    """

    text: str
    slope: str
    starts: Callable[[float, float], Sequence[tuple[float, ...]]] = lambda low, high: ((),)


def _waves(low: float, high: float) -> list[tuple[float, ...]]:
    return [(np.pi * k / max(high - low, 1e-12),) for k in (1.0, 1.5, 2.0, 3.0, 4.0, 6.0)]


def _times(low: float, high: float) -> list[tuple[float, ...]]:
    return [((high - low) * part,) for part in (0.05, 0.1, 0.2, 0.4, 0.8)]


def _steps(low: float, high: float) -> list[tuple[float, ...]]:
    return [(low + part * (high - low), width * (high - low)) for part in (0.2, 0.35, 0.5, 0.65, 0.8) for width in (0.05, 0.2)]


ONE = Shape("1.0", "0.0")
LINEAR, SQUARE = Shape("z", "1.0"), Shape("z**2", "2.0 * z")
CUBE = Shape("z**3", "3.0 * z**2")
ABS = Shape("abs(z)", "z / (abs(z) + 1e-12)")
DRAG, SIGN = Shape("abs(z) * z", "2.0 * abs(z)"), Shape("tanh(z / {0})", "(1.0 - tanh(z / {0})**2) / {0}")
FADE = Shape("exp(-z / {0})", "-exp(-z / {0}) / {0}", _times)
STEP = Shape("tanh((z - {0}) / {1})", "(1.0 - tanh((z - {0}) / {1})**2) / {1}", _steps)
BUMP = Shape("exp(-((z - {0}) / {1})**2)", "-2.0 * (z - {0}) / {1}**2 * exp(-((z - {0}) / {1})**2)", _steps)
COS, SIN = Shape("cos({0} * z)", "-{0} * sin({0} * z)", _waves), Shape("sin({0} * z)", "{0} * cos({0} * z)", _waves)
FUNCTIONS = {"cos": np.cos, "sin": np.sin, "exp": np.exp, "tanh": np.tanh, "abs": np.abs}


@dataclasses.dataclass(frozen=True)
class Atom:
    """A shape with its inner numbers."""

    shape: Shape
    inner: tuple[float, ...] = ()

    def written(self, argument: str) -> str:
        """Return the function as text for people, of an argument written so."""
        text = self.shape.text.format(*(f"{value:.4g}" for value in self.inner)).replace("z", argument)
        return text.replace("(1 * ", "(")

    def precise(self, argument: str) -> str:
        """Return the function as Python."""
        return self.shape.text.format(*(f"{value:.9g}" for value in self.inner)).replace("z", argument)

    def slope(self, argument: str) -> str:
        """Return its derivative as text."""
        return self.shape.slope.format(*(f"{value:.9g}" for value in self.inner)).replace("z", argument)

    def values(self, argument: FloatArray) -> FloatArray:
        """Evaluate (N,)."""
        text = self.shape.text.format(*(repr(float(value)) for value in self.inner))
        return np.broadcast_to(eval(text, {**FUNCTIONS, "z": argument}), argument.shape)  # noqa: S307 - of this file


@dataclasses.dataclass(frozen=True)
class ClosedForm(Basis):
    """A basis of a few closed functions instead of a smooth map."""

    atoms: tuple[Atom, ...] = ()
    clipped: bool = True

    def functions(self, arguments: Sequence[FloatArray]) -> FloatArray:
        """Evaluate at the values of the one argument (N,); (N, atoms). Beyond the range that was seen it stays constant."""
        low, high = self.knots[0][0], self.knots[0][-1]
        values = np.clip(arguments[0], low, high) if self.clipped else arguments[0]
        return np.stack([atom.values(values) for atom in self.atoms], axis=1)


def plain_expression(name: str, values: FloatArray, curve: FloatArray, periodic: bool = False) -> str | None:
    """Return a plain function that does nearly all that a curve does, such as "0.61 omega"; None where none does.

    Args:
        name: of the variable; values: its samples (N,), an angle if periodic.
        curve: value of the curve at each of them (N,), up to a constant.
    """
    least = ALIKE_ENOUGH * float(np.sum((curve - curve.mean()) ** 2))
    if least <= 0.0:
        return None
    plain = ((LINEAR,), (ABS,), (SQUARE,), (DRAG,), (CUBE,), (LINEAR, SQUARE), (LINEAR, CUBE))
    for shapes in ((Shape("cos(z)", ""), Shape("sin(z)", "")),) if periodic else plain:
        columns = np.stack([Atom(shape).values(values) for shape in shapes], axis=1)
        columns = columns - columns.mean(axis=0)
        weights = np.linalg.lstsq(columns, curve - curve.mean(), rcond=1e-9)[0]
        if np.sum((columns @ weights) ** 2) >= least:
            return _summed(weights, [f" {Atom(shape).written(name)}" for shape in shapes])
    return None


def fourier(basis: Basis) -> ClosedForm:
    """Return a periodic basis as a closed form with the same functions in the same order."""
    atoms = [Atom(ONE), *(Atom(shape, (float(k),)) for shape in (COS, SIN) for k in range(1, basis.harmonics + 1))]
    return ClosedForm("closed", basis.knots, basis.width, atoms=tuple(atoms), clipped=False)


def plain_forms(law: Law) -> list[Law]:
    """Return a law of one speed or torque with each of the plain functions in its place that no effect of the library is."""
    basis = law.basis
    return [
        dataclasses.replace(law, basis=ClosedForm("closed", basis.knots, basis.width, atoms=(Atom(shape),), clipped=False))
        for shape in ((SQUARE, CUBE, DRAG) if basis.kind == "speed" else (ABS,))
    ]


def closed_form(basis: Basis, weights: FloatArray, covariance: FloatArray) -> ClosedForm | None:
    """Return the closed form that comes nearest to a curve of one argument with few numbers; None for maps of two.

    Args:
        basis: of the curve.
        weights: (K,); covariance: (K, K).
    """
    if len(basis.knots) != 1:
        return None
    low, high = basis.knots[0][0], basis.knots[0][-1]
    grid = np.geomspace(low, high, SAMPLES) if basis.kind == "travel" else np.linspace(low, high, SAMPLES)
    functions = basis.functions([grid])
    inverse = np.asarray(np.linalg.pinv(functions, rcond=1e-9), dtype=np.float64)
    deviation = np.sqrt(np.maximum(np.diag(covariance), 1e-300))
    correlation = covariance / np.outer(deviation, deviation) + 1e-9 * np.eye(len(weights))
    root = np.asarray(np.linalg.cholesky(correlation), dtype=np.float64)

    def standard(values: FloatArray) -> FloatArray:
        return np.asarray(np.linalg.solve(root, (values.T / deviation).T), dtype=np.float64)

    target = standard(weights)

    def misfit(atoms: Sequence[Atom]) -> float:
        columns = standard(inverse @ np.stack([atom.values(grid) for atom in atoms], axis=1))
        scaled = columns / np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
        solution = np.linalg.lstsq(scaled, target, rcond=1e-8)[0]
        return float(np.sum((target - scaled @ solution) ** 2))

    chosen: list[Atom] = [Atom(ONE)]
    best = misfit(chosen)
    for _ in range(LARGEST_GROUPS):
        trials = []
        for group in _groups(basis, low, high):
            if all(atom in chosen for atom in group):
                continue
            numbers = len(group) + len(group[0].inner)
            trials.append((misfit([*chosen, *group]) + PRICE * numbers, group))
        cost, group = min(trials, key=lambda trial: trial[0])
        group = _refined(basis, chosen, group, misfit)
        cost = misfit([*chosen, *group]) + PRICE * (len(group) + len(group[0].inner))
        if cost >= best:
            break
        chosen, best = [*chosen, *group], misfit([*chosen, *group])
    for atom in list(chosen):
        others = [other for other in chosen if other != atom]
        if others and misfit(others) < misfit(chosen) + PRICE:
            chosen = others
    return ClosedForm("closed", basis.knots, basis.width, atoms=tuple(chosen), clipped=basis.kind != "periodic")


def _groups(basis: Basis, low: float, high: float) -> list[tuple[Atom, ...]]:
    """Functions to try, one group at a time."""
    if basis.kind == "periodic":
        return [(Atom(COS, (float(k),)), Atom(SIN, (float(k),))) for k in range(1, basis.harmonics + 1)]
    if basis.kind == "travel":
        return [(Atom(FADE, (float(part),)),) for part in np.geomspace(low, high, TRAVELS)]
    groups: list[tuple[Atom, ...]] = [(Atom(LINEAR),), (Atom(SQUARE),), (Atom(CUBE),)]
    if basis.kind == "speed":
        return [*groups, (Atom(DRAG),), (Atom(SIGN, (basis.width,)),)]
    if low < 0.0 < high:
        groups.append((Atom(ABS),))
    for shape in (FADE, STEP, BUMP):
        groups += [(Atom(shape, inner),) for inner in shape.starts(low, high)]
    groups += [(Atom(COS, inner), Atom(SIN, inner)) for inner in _waves(low, high)]
    return groups


def _refined(
    basis: Basis, chosen: Sequence[Atom], group: tuple[Atom, ...], misfit: Callable[[Sequence[Atom]], float]
) -> tuple[Atom, ...]:
    """Search the inner numbers of a group near where the grid has them."""
    low, high = basis.knots[0][0], basis.knots[0][-1]
    if not group[0].inner or group[0].shape is SIGN or len({atom.inner for atom in group}) != 1:
        return group
    start = np.array(group[0].inner)
    if group[0].shape in (COS, SIN) and np.allclose(start, np.round(start)) and high - low > 6.28:
        return group  # harmonics of an angle
    scale = np.maximum(np.abs(start), 0.1 * (high - low) if group[0].shape in (STEP, BUMP) else 1e-12)

    def moved(step: FloatArray) -> tuple[Atom, ...]:
        inner = tuple(float(v) for v in start + scale * step)
        return tuple(Atom(atom.shape, inner) for atom in group)

    def cost(step: FloatArray) -> float:
        inner = start + scale * step
        # Narrower than this or slower than that, it is another of the library's functions.
        span = high - low
        if group[0].shape in (STEP, BUMP) and not 0.02 * span < inner[1] < 2.0 * span:
            return np.inf
        if group[0].shape is FADE and not (low if basis.kind == "travel" else 0.02 * span) < inner[0] < 3.0 * span:
            return np.inf
        return misfit([*chosen, *moved(step)])

    found = optimize.minimize(cost, np.zeros(len(start)), method="Nelder-Mead", options={"maxfev": 60, "xatol": 1e-4})
    return moved(found.x) if found.fun < cost(np.zeros(len(start))) else group


def written(law: Law, weights: FloatArray) -> str | None:
    """Return what a law says as one line, such as "drive_torque/a = sign(drive_velocity/a) (-0.3 + 0.2 cos(...))".

    None where the law is a curve. Units are SI. A law at several joints is written for the first of them.
    """
    if not isinstance(law.basis, ClosedForm):
        return None
    first = law.places[0]
    argument = _sum_of(first.arguments[0])
    size = _summed(weights, ["" if atom.shape is ONE else f" {atom.written(argument)}" for atom in law.basis.atoms])
    forms = {"one": "{0}", "sign": "sign({1}) ({0})", "value": "{1} ({0})", "direction": "{1} / speed ({0})"}
    lines = []
    for place in law.places if law.sites[0].startswith("chassis") else (first,):
        minus = "-" if place.weight < 0 else ""
        form = forms.get(place.factor.kind, place.factor.kind + "({1}) ({0})")
        lines.append(f"{place.site} = {minus}{form.format(size, place.factor.variable)}")
    return "; ".join(lines)


def _summed(weights: Iterable[float], functions: Iterable[str]) -> str:
    """Write a sum of functions with their weights."""
    parts: list[str] = []
    for weight, text in zip(weights, functions, strict=True):
        sign = ("- " if weight < 0 else "+ ") if parts else ("-" if weight < 0 else "")
        parts.append(f"{sign}{abs(weight):.4g}{text}")
    return " ".join(parts)


def _sum_of(argument: Combination) -> str:
    """Write a sum of variables."""
    text = argument[0][0] if argument[0][1] > 0 else f"-{argument[0][0]}"
    for name, weight in argument[1:]:
        text += f" {'+' if weight > 0 else '-'} {name}"
    return f"({text})" if len(argument) > 1 else text
