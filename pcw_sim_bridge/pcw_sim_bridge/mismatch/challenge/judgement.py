"""Compares what one report says with what the case conceals."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from pcw_description.effects.registry import all_effects

from ..search.outline_search import OUTLINE, upright
from .cases import LEAST_SIZE, Answer, is_of_the_floor
from .healthy_deviations import numbers_moved
from .outside_effects import OUTSIDE_EFFECTS

Key = tuple[str, frozenset[str]]
"""An effect and its target."""

OUTCOMES = (
    "right", "in a look-alike set", "right beside others", "wrong name", "unknown only", "nothing named", "no report",
)  # fmt: skip
# Parameters that are one vector: their errors are relative to its length.
VECTORS = (
    ("x", "y"), ("force_x", "force_y"), ("cosine", "sine"), ("accelerometer_x", "accelerometer_y"), ("coulomb", "asymmetry"),
    ("viscous", "asymmetry"),
)  # fmt: skip


@dataclasses.dataclass(frozen=True)
class Named:
    """What a report calls an effect; several of one name on parts of a target are one."""

    key: Key
    probability: float
    rivals: frozenset[Key]
    entries: tuple[int, ...]  # in the report's list of effects


@dataclasses.dataclass(frozen=True)
class ParameterError:
    """Of one number of an effect that was named right.

    Attributes:
        error: relative to the true number, or to its vector; of an angle, as a part of half a turn.
        covered: whether the 95 % interval holds the true number.
    """

    effect: str
    parameter: str
    error: float
    covered: bool


@dataclasses.dataclass(frozen=True)
class Judgement:
    """A case with its report.

    Attributes:
        report: what the analyser said; None where there is no report.
        usage: `seconds`, `cpu_seconds`, `peak_bytes` of the analysis.
        baselines: what others said.
    """

    answer: Answer
    report: Mapping[str, Any] | None
    usage: Mapping[str, float]
    baselines: Sequence[Mapping[str, Any]] = ()

    @property
    def kind(self) -> str:
        """Kind of the case."""
        return str(self.answer["kind"])

    @property
    def truth(self) -> tuple[Key, ...]:
        """What is concealed."""
        return tuple((e["name"], frozenset(e["target"])) for e in self.answer["effects"])

    @property
    def size(self) -> float:
        """The least size of the effects, in noise floors; infinite where there is none."""
        return min((e["size"] for e in self.answer["effects"]), default=math.inf)

    @property
    def above_floor(self) -> bool:
        """Whether all concealed effects are above the detection floor."""
        return self.size >= LEAST_SIZE

    @property
    def named(self) -> tuple[Named, ...]:
        """What the report names."""
        if self.report is None:
            return ()
        return _merged([_read(k, effect) for k, effect in enumerate(self.report["effects"])], self.truth)

    @property
    def outcome(self) -> str:
        """One of `OUTCOMES`."""
        if self.report is None:
            return "no report"
        named, truth = self.named, self.truth
        if named and {n.key for n in named} == set(truth):
            return "right"
        if not named:
            return "unknown only" if self.report["unknown"] else "nothing named"
        if len(named) == len(truth) and any(
            all(key in {n.key, *n.rivals} for key, n in zip(truth, order, strict=True))
            for order in itertools.permutations(named)
        ):
            return "in a look-alike set"
        if truth and set(truth) <= {n.key for n in named}:
            return "right beside others"
        return "wrong name"

    @property
    def said(self) -> str:
        """What the report says, in a few words."""
        if self.report is None:
            return "no report"
        words = []
        for n in self.named:
            rivals = f", or {_list(sorted({name for name, _ in n.rivals}))}" if n.rivals else ""
            words.append(f"{_key_text(n.key)} ({n.probability:.2f}{rivals})")
        for left in sorted(self.report["unknown"], key=lambda entry: -entry["share_explained"])[:1]:
            words.append(f"unknown: {left['channel']} by {', '.join(left['depends_on'])}")
        return "; ".join(words) or "nothing"

    @property
    def concealed(self) -> str:
        """What is concealed, in a few words."""
        words = []
        for effect, key in zip(self.answer["effects"], self.truth, strict=True):
            values = ", ".join(f"{name} {value:.3g}" for name, value in _telling(effect))
            words.append(f"{_key_text(key, effect['axis'])} ({values}; {effect['size']:.1f} floors)")
        return "; ".join(words) or "nothing"

    def parameter_errors(self) -> list[ParameterError]:
        """Errors of the numbers of all effects that are named right, on their target."""
        found = []
        for effect, key in zip(map(_as_told, self.answer["effects"]), self.truth, strict=True):
            match = next((n for n in self.named if n.key == key), None)
            if match is None or effect["outside"] or len(match.entries) > 1:
                continue
            assert self.report is not None
            said = self.report["effects"][match.entries[0]]["parameters"]
            found += [
                _error(effect, name, said[name], self._tuned_in(effect, name)) for name, _ in _telling(effect) if name in said
            ]
        return found

    def _tuned_in(self, effect: Mapping[str, Any], parameter: str) -> float:
        """How much of a parameter somebody has tuned into the description already, on average over its targets."""
        names = numbers_moved(effect["name"], effect["target"], parameter, effect["axis"])
        tuned = [float(self.answer["retuned"].get(name, 0.0)) for name in names]
        return sum(tuned) / len(tuned) if tuned else 0.0

    def locations(self) -> list[tuple[Mapping[str, Any], Mapping[str, Any]]]:
        """Pairs of a concealed effect and the location that the report gives the effect of that name."""
        pairs = []
        for effect in self.answer["effects"]:
            for k, said in enumerate(self.report["effects"] if self.report is not None else ()):
                assert self.report is not None
                if said["name"] == effect["name"] and k < len(self.report["locations"]):
                    pairs.append((effect, self.report["locations"][k]))
                    break
        return pairs

    def casters_right(self) -> bool | None:
        """Whether the casters of all locations are those concealed; None where no caster is at fault or none is given."""
        truth = set()
        for effect in self.answer["effects"]:
            if _target_kind(effect) == "caster" and not is_of_the_floor(effect["name"]):
                truth |= set(effect["target"])
        if not truth or self.report is None or not self.report["locations"]:
            return None
        said = set(itertools.chain.from_iterable(place["casters"] for place in self.report["locations"]))
        return said == truth

    def leading_variable_right(self) -> bool | None:
        """Whether the leftover that explains most depends first on what the concealed effect does; None: no leftover."""
        if self.report is None or not self.report["unknown"]:
            return None
        first = max(self.report["unknown"], key=lambda left: left["share_explained"])["depends_on"][0]
        wanted = set().union(*(OUTSIDE_EFFECTS[e["name"]].variables for e in self.answer["effects"]))
        return str(first).partition("/")[0] in wanted

    def inverse_gap(self) -> float | None:
        """Part of the gap between the held-out channels and their noise that the patch closes."""
        proof = self._proof()
        return None if proof is None else float(proof["gap_closed"])

    def rollout_gap(self) -> float | None:
        """The same of the held-out forward simulation; None where nothing could be simulated."""
        proof = self._proof()
        closed = None if proof is None else proof.get("rollout_gap_closed")
        return None if closed is None else float(closed)

    def harm(self) -> float | None:
        """Largest relative increase, beyond chance, of a held-out error by the patch; 0 if none grew."""
        proof = self._proof()
        return None if proof is None else float(proof["harm"])

    def _proof(self) -> Mapping[str, Any] | None:
        return self.report["fit"].get("holdout") if self.report is not None else None


def _read(index: int, effect: Mapping[str, Any]) -> Named:
    target = frozenset(effect["target"])
    rivals = set()
    for entry in effect["ambiguous_with"]:
        name, separator, place = entry.partition("/")
        # A name alone is the other effect at the same place, or at the only one that it has.
        if separator:
            rivals.add((name, frozenset(place.split("+"))))
        else:
            kind = all_effects()[name].target_kind if name in all_effects() else "caster"
            rivals.add((name, target if kind == "caster" else frozenset([kind])))
    return Named((effect["name"], target), float(effect["probability"]), frozenset(rivals), (index,))


def _merged(named: Sequence[Named], truth: Sequence[Key]) -> tuple[Named, ...]:
    """Join findings of one name on parts of a target that is concealed as one, and those of both axes with a common rival."""
    kept: list[Named] = []
    for n in named:
        same = next((k for k in kept if k.key == n.key and k.rivals & n.rivals), None)
        if same is None:
            kept.append(n)
        else:  # torques that are all wrong by one factor, at the drives and at the steerings, are one finding: see its rivals
            probability = min(same.probability, n.probability)
            kept[kept.index(same)] = Named(n.key, probability, same.rivals & n.rivals, (*same.entries, *n.entries))
    for name, target in truth:
        parts = [n for n in kept if n.key[0] == name and n.key[1] < target]
        if len(parts) > 1 and sum(len(n.key[1]) for n in parts) == len(target):
            for part in parts:
                kept.remove(part)
            entries = tuple(itertools.chain.from_iterable(n.entries for n in parts))
            kept.append(Named((name, target), min(n.probability for n in parts), frozenset(), entries))
    return tuple(kept)


def _telling(effect: Mapping[str, Any]) -> list[tuple[str, float]]:
    """Parameters that were chosen: those that are not at their default."""
    declared = (
        OUTSIDE_EFFECTS[effect["name"]].effect if effect["outside"] else all_effects()[effect["name"]]
    ).parameters
    defaults = {p.name: p.default for p in declared}
    return [(name, value) for name, value in effect["parameters"].items() if value not in (defaults.get(name), 0.0)]


def _as_told(effect: Mapping[str, Any]) -> Mapping[str, Any]:
    """The effect with the outline of a patch as reports tell it: one outline has one name."""
    parameters = effect["parameters"]
    if not set(OUTLINE) <= set(parameters):
        return effect
    told = upright([parameters[name] for name in OUTLINE])
    return {**effect, "parameters": {**parameters, **dict(zip(OUTLINE, told, strict=True))}}


def _error(effect: Mapping[str, Any], name: str, said: Mapping[str, Any], tuned_in: float) -> ParameterError:
    """Compare a number with the true one, of which the description may hold a part."""
    true, value, (low, high) = effect["parameters"][name] - tuned_in, said["value"], said["ci95"]
    parameter = all_effects()[effect["name"]].parameter(name)
    if parameter.is_direction:
        turned = math.remainder(true - value, 2.0 * math.pi)
        return ParameterError(effect["name"], name, abs(turned) / math.pi, low <= value + turned <= high)
    vector = next((v for v in VECTORS if name in v and all(part in effect["parameters"] for part in v)), (name,))
    length = math.hypot(*(effect["parameters"][part] for part in vector))
    return ParameterError(effect["name"], name, abs(value - true) / length, low <= true <= high)


def _target_kind(effect: Mapping[str, Any]) -> str:
    name = effect["name"]
    return (OUTSIDE_EFFECTS[name].effect if effect["outside"] else all_effects()[name]).target_kind


def _key_text(key: Key, axis: str | None = None) -> str:
    name, target = key
    return f"{name}{f' ({axis})' if axis else ''} of {'+'.join(sorted(target))}"


def _list(names: Iterable[str]) -> str:
    return ", ".join(names)


def _norm(values: Iterable[float]) -> float:
    squares = [value * value for value in values]
    return math.sqrt(sum(squares) / len(squares))
