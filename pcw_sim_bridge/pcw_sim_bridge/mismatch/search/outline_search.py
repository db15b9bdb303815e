"""Where the borders of a patch of floor are: searched from many outlines, since most of them fit where wheels crossed one.

A few wheels cross a patch here and there. From the place that a first look finds an outline is led to the next one that
fits there, and a disc never becomes the turned rectangle that fits better: the way from one to the other leads through what
fits worse. So ellipses and rectangles of several directions and sizes are tried, the best are moved border by border, those
between ellipse and rectangle a little way downhill in all numbers at once, and then those that differ most of what is good
to the end. A disc far too large, about all the places where a small patch was crossed, is a hill of its own too: small discs
all over it find the other one. All that is by the first order of what a patch does, which is wrong by more than there is
between outlines a few centimetres apart: the best are followed on by what the model itself makes of them.

What was tried on the way says also how well the outline is known: every one that fits nearly as well may be the true one.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Callable, Mapping, Sequence

import numpy as np
from scipy import optimize

from ..regression.regression_problem import FloatArray
from ..regression.whitened_regression import Instance, WhitenedRegression
from .shape_trials import ShapeTrials

OUTLINE = ("x", "y", "length", "width", "yaw", "roundness")
DIRECTIONS = (0.0, math.pi / 6.0, math.pi / 3.0)
SIDES = (0.6, 0.85, 1.2)  # of the sides of the outline that was found
STARTS = 6  # of them are moved
# Outlines half round, in these directions and with these parts of the sides, are followed for so many evaluations each.
HALF_ROUND, TURNS, PARTS = 0.5, tuple(k * math.pi / 12.0 for k in range(6)), (0.8, 1.1)
FIRST_STEPS, WIDE = 100, 0.1
SMALL = (0.2, 0.3)  # of the mean side: discs all over it and about it
AROUND = 0.75  # mean sides from the middle to the furthest of them
SMALL_STARTS = 2  # of each size are moved
# Borders are moved by these parts of a side, the direction by twice as many radians, as long as that gains.
STEPS = (0.4, 0.2, 0.1)
MOVES = 6
WORTH = 0.3  # nats
# So many outlines that are about as good as the best, and so many times others between and beyond them.
POPULATION, GENERATIONS = 40, 40
AS_GOOD = 1.0  # nats
# The best outlines that are so many mean sides apart are followed downhill, from a simplex of this part of a side.
FINALISTS, APART, SIMPLEX = 4, 0.3, 0.05
EVALUATIONS, CLOSE_ENOUGH = 500, 0.05  # of a descent: at most, and [nats] to the end
# Mean sides that outlines are apart which are followed on by exact columns, for so many evaluations; so many more are tried.
NEXT, SETTLING, MOST_AGAIN = 0.15, 150, 100
# Evaluations of a walk to the furthest that does as well; sides per nat that it is not worth, and of which it is the end.
REACHING, OUTSIDE, REACHED = 150, 1.0, 1e-3
# Outlines that other recordings are asked about, and mean sides that they are apart.
OTHERS, OTHERWISE = 8, 0.15
WORST = 1e12  # instead of an outline that cannot be
NARROWEST = 0.05  # [m], about a tyre's contact patch
NEARLY = 3.0  # nats below the best that an outline of an earlier search may have been
MOST_BEFORE = 200  # outlines of an earlier search that are looked at again
FAR = 50.0  # nats below the best that nobody asks for


@dataclasses.dataclass(frozen=True)
class Outlines:
    """Outlines of one patch that were tried.

    Attributes:
        outlines: (N, 6), in the order of `OUTLINE`.
        evidence: (N,) [nats].
        coefficients: of the effect's active parameters (N, P).
    """

    outlines: FloatArray
    evidence: FloatArray
    coefficients: FloatArray

    def ranges(self, drop: float) -> tuple[Mapping[str, tuple[float, float]], FloatArray]:
        """How far apart those are that are no more than this below the best [nats].

        Returns:
            Smallest and largest value of each number of the outline, by name, and of each coefficient (P, 2).
        """
        near = self.evidence >= self.evidence.max() - drop
        low, high = self.outlines[near].min(axis=0), self.outlines[near].max(axis=0)
        sizes = self.coefficients[near]
        shape = {name: (float(a), float(b)) for name, a, b in zip(OUTLINE, low, high, strict=True)}
        return shape, np.stack([sizes.min(axis=0), sizes.max(axis=0)], axis=1)

    def apart(self, own: Mapping[str, float], drop: float) -> list[dict[str, float]]:
        """Shapes of those within a drop of the best [nats] that differ from an outline and from each other, best first."""
        chosen = [np.array([own[name] for name in OUTLINE])]
        for k in np.argsort(-self.evidence):
            outline = self.outlines[k]
            side = 0.5 * float(outline[2] + outline[3])
            if len(chosen) > OTHERS or self.evidence[k] < self.evidence.max() - drop:
                break
            if all(np.abs(outline[:4] - other[:4]).sum() > OTHERWISE * side for other in chosen):
                chosen.append(outline)
        return [dict(zip(OUTLINE, outline.tolist(), strict=True)) for outline in chosen[1:]]


def has_outline(instance: Instance) -> bool:
    """Whether an effect is at work on a patch of floor."""
    return set(OUTLINE) <= dict(instance.shape).keys()


def searched_outline(
    regression: WhitenedRegression, others: Sequence[Instance], instance: Instance, before: Outlines | None = None
) -> tuple[Sequence[Instance], Outlines | None]:
    """Return the instance with the outlines that explain most beside others, best first, and all that were tried.

    Where the problem is not exact a first order decides, which may be wrong by more than what is between them.

    Where the effect itself would have to be of a size that cannot be, nothing is searched.

    Args:
        before: what an earlier search found alike, under another fit: this one goes on from the best of it.
    """
    trials = _Tried(ShapeTrials(regression, others, instance), instance)
    own = np.array([dict(instance.shape)[name] for name in OUTLINE])
    if not math.isfinite(trials.evidence([own])[0]):
        return [instance], before
    if before is None:
        trials.look_around(own)
    else:  # the fit has changed a little since, and with it which of those that were good is best
        near = before.outlines[before.evidence > before.evidence.max() - NEARLY]
        trials.evidence(list(near[:: math.ceil(len(near) / MOST_BEFORE)]))
        trials.climb(own)
    trials.settle()
    return trials.best(), trials.all_tried()


def settled_outline(
    regression: WhitenedRegression, others: Sequence[Instance], outlines: Sequence[Instance], tried: Outlines
) -> tuple[Instance, Outlines]:
    """Return the best outline that several lead to by a problem whose columns hold in any shape, and all that were tried.

    A first order misjudges outlines that are a few centimetres apart by more than what is between them.

    Args:
        tried: by a search of first order, of which those that were nearly as good as any are asked for again.
    """
    trials = _Tried(ShapeTrials(regression, others, outlines[0]), outlines[0])
    near = tried.outlines[tried.evidence > tried.evidence.max() - NEARLY]
    trials.evidence([*near[:: math.ceil(len(near) / MOST_AGAIN)]])
    for outline in outlines:
        trials.descend(np.array([dict(outline.shape)[name] for name in OUTLINE]), SIMPLEX, SETTLING)
    trials.round_otherwise()
    return trials.best()[0], trials.all_tried()


def reaching(
    regression: WhitenedRegression, others: Sequence[Instance], instance: Instance, tried: Outlines, drop: float
) -> Outlines:
    """Return outlines that reach as far in every border as any does that is no more than this below the best [nats].

    A search stays where it is best: those that do nearly as well further away it meets by chance only.

    Args:
        regression: where the problem is exact at the instance, beside the others.
        tried: by a search before, under another fit.
    """
    trials = _Tried(ShapeTrials(regression, others, instance), instance)
    near = tried.outlines[tried.evidence > tried.evidence.max() - drop]
    furthest = [*near[:, :4].argmin(axis=0), *near[:, :4].argmax(axis=0)]
    again = trials.evidence([*near[:: math.ceil(len(near) / MOST_BEFORE)], *near[furthest]])
    if not math.isfinite(max(again)):  # the effect would have to be of a size that cannot be
        return tried
    for k, way in itertools.product(range(4), (-1.0, 1.0)):
        trials.reach(k, way, drop)
    return trials.all_tried()


def _starts(own: FloatArray) -> list[FloatArray]:
    """Ellipses and rectangles about the middle of an outline."""
    found = []
    for roundness, yaw, length, width in itertools.product((0.0, 1.0), DIRECTIONS, SIDES, SIDES):
        if not (roundness == 1.0 and yaw > 0.0 and length == width and own[2] == own[3]):
            found.append(np.array([*own[:2], length * own[2], width * own[3], own[4] + yaw, roundness]))
    return found


def _half_round(own: FloatArray) -> list[FloatArray]:
    """Outlines between ellipse and rectangle about the middle of an outline."""
    turned = itertools.product(TURNS, PARTS)
    return [np.array([*own[:2], *(part * own[2:4]), own[4] + turn, HALF_ROUND]) for turn, part in turned]


def _small_discs(own: FloatArray) -> list[list[FloatArray]]:
    """Discs of each small size, half of it apart, all over an outline."""
    side, found = 0.5 * float(own[2] + own[3]), []
    for size in np.multiply(SMALL, side):
        steps = math.floor(AROUND * side / (0.5 * size))
        places = 0.5 * size * np.arange(-steps, steps + 1)
        found.append([np.array([own[0] + x, own[1] + y, size, size, 0.0, 1.0]) for x in places for y in places])
    return found


class _Tried:
    """Evidence of outlines, each asked for once."""

    def __init__(self, trials: ShapeTrials, instance: Instance) -> None:
        self._trials, self._instance = trials, instance
        self._known: dict[tuple[float, ...], float] = {}
        self._coefficients: dict[tuple[float, ...], FloatArray] = {}

    def evidence(self, outlines: Sequence[FloatArray]) -> list[float]:
        """Log evidence of each; none where the size of the effect would have to be one that cannot be."""
        keys = [tuple(outline.tolist()) for outline in outlines]
        new = [key for key in dict.fromkeys(keys) if key not in self._known]
        found = self._trials.tried([self._with(key) for key in new]) if new else []
        for key, trial in zip(new, found, strict=True):
            self._known[key] = trial.evidence if trial.allowed else -math.inf
            self._coefficients[key] = trial.coefficients
        return [self._known[key] for key in keys]

    def look_around(self, own: FloatArray) -> None:
        """Try outlines of all kinds about one, move the best border by border, and go on along all that are as good."""
        starts = [own, *_starts(own)]
        order = 1 + np.argsort([-value for value in self.evidence(starts)[1:]])
        reached = [self.climb(starts[k]) for k in (0, *order[:STARTS])]
        for small in _small_discs(own):
            best = np.argsort([-value for value in self.evidence(small)])[:SMALL_STARTS]
            reached += [self.climb(small[k]) for k in best]
        for start in _half_round(own):
            self.descend(start, WIDE, FIRST_STEPS)
        self.spread([*reached, *(starts[k] for k in order)])

    def climb(self, outline: FloatArray) -> FloatArray:
        """Move borders, middle and direction of an outline as long as one of these gains; return where it ends."""
        best = self.evidence([outline])[0]
        for step in STEPS:
            for _ in range(MOVES):
                moved = [_allowed(outline + part * step * way) for way in _ways(outline) for part in (-1.0, -0.5, 0.5, 1.0)]
                evidence = self.evidence(moved)
                k = int(np.argmax(evidence))
                gain = evidence[k] - best
                if gain > 0.0:
                    outline, best = moved[k], evidence[k]
                if not gain > WORTH:
                    break
        return outline

    def spread(self, others: Sequence[FloatArray]) -> None:
        """Go on along all that is about as good as the best: differences between outlines lead from one to the next.

        Borders make up for each other, so that what fits is a narrow ridge, which no change of one number follows.

        Args:
            others: far from each other, to begin with beside some of the best.
        """
        tried = sorted(self._known, key=lambda key: -self._known[key])
        near = [key for key in tried if self._known[key] > self._known[tried[0]] - FAR]
        some = near[:: max(1, 2 * len(near) // POPULATION)][: POPULATION // 2]
        population = np.array([*some, *(tuple(outline) for outline in others)][:POPULATION])
        middle, side = population[0, :2], float(population[:, 2:4].max())
        low = np.array([*(middle - 2.0 * side), NARROWEST, NARROWEST, -2.0 * math.pi, 0.0])
        high = np.array([*(middle + 2.0 * side), 3.0 * side, 3.0 * side, 2.0 * math.pi, 1.0])

        def cost(outlines: FloatArray) -> FloatArray:
            return np.nan_to_num(-np.array(self.evidence(list(outlines.T))), posinf=WORST)

        optimize.differential_evolution(
            cost, list(zip(low, high, strict=True)), init=np.clip(population, low, high), strategy="rand1bin",
            maxiter=GENERATIONS, mutation=(0.3, 1.9), recombination=0.9, tol=0.0, polish=False, seed=0,
            vectorized=True, updating="deferred",
        )  # fmt: skip

    def settle(self) -> None:
        """Follow the best outlines that differ to where each fits best.

        A strip of which wheels saw one end may be of any length, if its direction and that end follow: of such ridges there is
        one for every direction tried, and along each a little is lost to the next.
        """
        for outline in self._apart(FINALISTS, APART):
            self.descend(outline, SIMPLEX, EVALUATIONS)

    def round_otherwise(self) -> None:
        """Follow the best outline as an ellipse and as a rectangle of its area: with other sides these may do as well."""
        best = np.array(max(self._known, key=lambda key: self._known[key]))
        # A rectangle holds so many times what the ellipse within it does, and what is between them about as much between.
        for roundness in (0.0, 1.0):
            side = (4.0 / math.pi) ** (0.5 * (roundness - best[5]))
            self.descend(np.array([*best[:2], *(side * best[2:4]), best[4], roundness]), SIMPLEX, SETTLING)

    def _apart(self, count: int, sides: float, first: Sequence[FloatArray] = ()) -> list[FloatArray]:
        """The best outlines that are so many mean sides apart, so many with the first ones."""
        found = list(first)
        for key in sorted(self._known, key=lambda key: -self._known[key]):
            outline = np.array(upright(key))
            side = 0.5 * float(outline[2] + outline[3])
            if all(np.abs(outline[:4] - other[:4]).sum() > sides * side for other in found):
                found.append(outline)
            if len(found) == count:
                break
        return found

    def descend(self, outline: FloatArray, simplex: float, evaluations: int) -> None:
        """Follow an outline downhill in all numbers at once, from a simplex of this part of its mean side."""
        _followed(outline, lambda there: -self.evidence([there])[0], simplex, evaluations, CLOSE_ENOUGH)

    def reach(self, k: int, way: float, drop: float) -> None:
        """Follow outlines within a drop of the best [nats] to where one number is smallest or largest; `way`: -1 or 1."""
        best = max(self._known.values())
        within = [np.array(key) for key, value in self._known.items() if value >= best - drop]
        start = max(within, key=lambda outline: way * outline[k])
        unit = _units(start)[k]

        def cost(outline: FloatArray) -> float:
            lost = best - self.evidence([outline])[0]
            return float(-way * outline[k] / unit) + OUTSIDE * max(lost - drop, 0.0)

        _followed(start, cost, SIMPLEX, REACHING, REACHED)

    def best(self) -> list[Instance]:
        """The instance with the best outlines that differ.

        First the smallest of the best: where nobody came there need not be any of it.
        """
        own = tuple(dict(self._instance.shape)[name] for name in OUTLINE)
        most = max(self._known.values())
        alike = [key for key, value in self._known.items() if value >= most - AS_GOOD]
        smallest = min(alike, key=lambda key: key[2] * key[3])
        apart = self._apart(FINALISTS, NEXT, [np.array(upright(smallest))])[1:]
        others = [self._with(outline.tolist()) for outline in apart if self.evidence([outline])[0] > most - FAR]
        return [self._instance if smallest == own else self._with(upright(smallest)), *others]

    def all_tried(self) -> Outlines:
        """All that are not far below the best."""
        best = max(self._known.values())
        keys = [key for key, value in self._known.items() if value > best - FAR]
        return Outlines(
            outlines=np.array([upright(key) for key in keys]),
            evidence=np.array([self._known[key] for key in keys]),
            coefficients=np.array([self._coefficients[key] for key in keys]),
        )

    def _with(self, outline: Sequence[float]) -> Instance:
        shape = dict(self._instance.shape) | dict(zip(OUTLINE, outline, strict=True))
        return self._trials.regression.with_shape(self._instance, shape)


def _ways(outline: FloatArray) -> list[FloatArray]:
    """Changes of an outline per part of its mean side: of one border, the middle, a side about the middle, the direction."""
    side = 0.5 * (outline[2] + outline[3])
    c, s = side * math.cos(outline[4]), side * math.sin(outline[4])
    return [
        np.array(way)
        for way in (
            (0.5 * c, 0.5 * s, side, 0.0, 0.0, 0.0), (-0.5 * c, -0.5 * s, side, 0.0, 0.0, 0.0),
            (-0.5 * s, 0.5 * c, 0.0, side, 0.0, 0.0), (0.5 * s, -0.5 * c, 0.0, side, 0.0, 0.0),
            (c, s, 0.0, 0.0, 0.0, 0.0), (-s, c, 0.0, 0.0, 0.0, 0.0),
            (0.0, 0.0, side, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0, side, 0.0, 0.0),
            (0.0, 0.0, 0.0, 0.0, 2.0, 0.0),
        )
    ]  # fmt: skip


def _units(outline: FloatArray) -> FloatArray:
    """Numbers of an outline that are about as much each: mean sides for lengths, and directions and roundnesses as large."""
    return 0.5 * np.array([*[outline[2] + outline[3]] * 4, 2.0, 2.0])


def _followed(
    outline: FloatArray, cost: Callable[[FloatArray], float], simplex: float, evaluations: int, close: float
) -> None:
    """Ask for a cost along the way downhill from an outline, by a simplex that is so large at first, until it is so close."""
    unit = _units(outline)
    optimize.minimize(
        lambda parts: min(cost(_allowed(parts * unit)), WORST), outline / unit, method="Nelder-Mead",
        options={"initial_simplex": outline / unit + np.vstack([np.zeros(6), simplex * np.eye(6)]), "maxfev": evaluations,
                 "xatol": 1e-3, "fatol": close, "adaptive": True},
    )  # fmt: skip


def _allowed(outline: FloatArray) -> FloatArray:
    return np.array([*outline[:2], *np.maximum(outline[2:4], NARROWEST), outline[4], np.clip(outline[5], 0.0, 1.0)])


def upright(outline: Sequence[float]) -> tuple[float, ...]:
    """The same outline with the longer side as its length, and a direction from -pi/2 to pi/2."""
    x, y, length, width, yaw, roundness = outline
    if width > length:
        length, width, yaw = width, length, yaw + 0.5 * math.pi
    return x, y, length, width, math.remainder(yaw, math.pi), roundness

