"""What the command channels of a robot say: each joint searched on its own, and proved on what it has not seen.

The same effect in every drive, or in every steering, with numbers that agree is one effect of all of them.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence

import numpy as np
from scipy import stats

from pcw_description.effect_instance import EffectInstance
from pcw_description.robot_description import AXIS_NAMES

from ..found_effect import effect_instance
from ..regression.regression_problem import UNKNOWN, FloatArray, RegressionProblem
from ..regression.whitened_regression import Instance
from ..search.evidence_selection import EffectSearch
from ..search.open_set import Leftover
from ..search.selection_settings import SelectionSettings
from .common_effect import in_common
from .explanation import AMBIGUOUS, HALF_WIDTH, Estimate, Explanation, NamedTerm, explain
from .findings import REFUSED, ChannelFinding, ChannelProof, LadderFinding, LocationFinding
from .paired_errors import PairedErrors, blocks_of, interval

Progress = Callable[[str], None]
# A part of the noise that what most joints of an axis have must move another at least.
SHARE_OF_COMMON = 0.1
# So may be what one joint alone says so clearly at first sight [nats]: a limit is at work now and then, and not small then.
CLEAR = 100.0
# A first look at every so many of the numbers that are tried: what lies between two of them looks nearly like either.
FIRST_LOOK_STEP = 2
# What an effect does to held-out data at least, if they are to say anything of it [nats].
AT_WORK = 5.0
# Numbers of several joints agree where chance alone would part them further once in so many.
AGREEING = 0.999


@dataclasses.dataclass(frozen=True)
class CommandFindings:
    """Findings of all joints.

    Attributes:
        named: effects between commands and torques, each with what it is in a description.
        proofs: held-out errors of every channel.
        notes: what a reader has to know to judge them.
        numbers: re-tuned ones of the motion that they explain, by name.
    """

    channels: tuple[ChannelFinding, ...] = ()
    named: tuple[tuple[NamedTerm, EffectInstance], ...] = ()
    leftovers: tuple[Leftover, ...] = ()
    locations: tuple[LocationFinding, ...] = ()
    proofs: tuple[ChannelProof, ...] = ()
    ladder: tuple[LadderFinding, ...] = ()
    notes: tuple[str, ...] = ()
    numbers: tuple[str, ...] = ()

    def and_also(self, other: CommandFindings) -> CommandFindings:
        """Return these findings and others of joints."""
        return CommandFindings(*(
            (*getattr(self, field.name), *getattr(other, field.name)) for field in dataclasses.fields(self)
        ))  # fmt: skip


def command_findings(
    problems: Sequence[RegressionProblem],
    held_out: Sequence[RegressionProblem],
    seed: int,
    settings: SelectionSettings | None,
    progress: Progress,
) -> CommandFindings:
    """Search every joint for what happens between its command and its torque.

    Args:
        problems: one per joint, of the fitted recordings.
        held_out: the same of others; may be empty.
        seed: of surrogates and bootstrap.
        settings: of the search.
        progress: is told what is named.
    """
    others = {problem.channels[0].name: problem for problem in held_out}
    found = CommandFindings()
    explanations = _explanations(problems, seed, settings)
    against = _not_borne_out(problems, others, explanations)
    for problem, explanation in zip(problems, explanations, strict=True):
        rng = np.random.default_rng(seed)
        channel = problem.channels[0]
        other = others.get(channel.name)
        refused: tuple[LadderFinding, ...] = ()
        if explanation is not None and channel.name in against:
            nats, reason = against[channel.name], f"{REFUSED}: the error is no smaller with it"
            labels = [explanation.search.label(named.instance) for named in explanation.named]
            refused = tuple(LadderFinding(f"drop {label}", nats, nats, reason) for label in labels)
            explanation = dataclasses.replace(explanation, named=())
        added, floor = np.zeros_like(problem.residual), _size(problem, problem.residual)
        flagged = False
        if explanation is not None:
            added = _predicted(problem, problem, explanation)
            floor = float(explanation.floor[0])
            flagged = bool(explanation.named or explanation.leftovers)
            for named in explanation.named:
                progress(f"{channel.name}: {explanation.search.label(named.instance)}")
        p_value = 1.0 if explanation is None else float(explanation.p_values[0])
        finding = ChannelFinding(channel.name, channel.unit, _size(problem, problem.residual), floor, p_value, flagged)
        proof = (
            _proof(problem, added, floor, rng) if other is None
            else _proof(other, _predicted(problem, other, explanation), floor, rng)
        )
        found = CommandFindings(
            (*found.channels, finding),
            (*found.named, *(with_instance(named) for named in (explanation.named if explanation else ()))),
            (*found.leftovers, *(explanation.leftovers if explanation else ())),
            (*found.locations, *(_location(problem, named) for named in (explanation.named if explanation else ()))),
            (*found.proofs, proof),
            (*found.ladder, *_ladder(explanation), *refused),
            (*found.notes, *(f"{s.description.removeprefix('drop ')} was {s.outcome}. It is not proposed." for s in refused)),
        )
    return _shared(found, problems)


def _not_borne_out(
    problems: Sequence[RegressionProblem],
    others: Mapping[str, RegressionProblem],
    explanations: Sequence[Explanation | None],
) -> dict[str, float]:
    """Channels whose effects are at work in held-out data and make the error there no smaller, and by how much they do [nats].

    Each by itself, and all joints of an axis that say the same together. Of commands of which only every fifth or twelfth was
    recorded a lag or a limit explains a little, in one recording.
    """
    said: dict[tuple[str, ...], dict[str, tuple[float, float]]] = {}
    for problem, explanation in zip(problems, explanations, strict=True):
        channel = problem.channels[0]
        other = others.get(channel.name)
        if explanation is None or other is None or not explanation.named:
            continue
        added = _predicted(problem, other, explanation)
        rest = other.residual - added
        scale = 2.0 * max(_size(other, rest) ** 2, 1e-300)
        before, after, work = (
            float(np.sum(values[other.valid] ** 2)) / scale for values in (other.residual, rest, added)
        )
        effects = (channel.axis, *sorted(named.term.effect for named in explanation.named))
        said.setdefault(effects, {})[channel.name] = (before - after, work)
    found = {}
    for joints in said.values():
        together = [sum(values) for values in zip(*joints.values(), strict=True)]
        for name, own in joints.items():
            if any(work > AT_WORK and nats <= 0.0 for nats, work in (own, together)):
                found[name] = min(own[0], together[0])
    return found


def _explanations(
    problems: Sequence[RegressionProblem], seed: int, settings: SelectionSettings | None
) -> list[Explanation | None]:
    """What each joint says; None where it says nothing.

    All joints of an axis hang on one bus and on drives of one kind. What most of them have is looked for in the others down to
    a smaller part of the noise than where nothing is known, and so is what one says very clearly; what none of them says
    clearly enough, all together may.
    """
    looks = [_first_look(problem, settings) for problem in problems]
    plain = settings or SelectionSettings()
    small = dataclasses.replace(plain, smallest_share=SHARE_OF_COMMON)

    def said(k: int, own: SelectionSettings) -> Explanation | None:
        most = max(looks[k].values(), default=0.0)
        own = small if most > CLEAR else own
        return None if most < own.lenient_gain else with_rivals(explain(problems[k], np.random.default_rng(seed), own))

    found = [said(k, plain) for k in range(len(problems))]
    for axis in AXIS_NAMES:
        alike = [k for k, problem in enumerate(problems) if problem.channels[0].axis == axis]
        effects = {k: {named.term.effect for named in explanation.named} for k in alike if (explanation := found[k])}
        for effect in sorted(set().union(*effects.values())):
            without = [k for k in alike if effect not in effects.get(k, ())]
            if 2 * len(without) >= len(alike):
                continue
            for k in without:
                again = said(k, small)
                if again is not None and {named.term.effect for named in again.named} == {effect, *effects.get(k, ())}:
                    found[k] = again
        if not any(effects.values()) and _say_together([looks[k] for k in alike]) >= plain.smallest_threshold:
            each = [found[k] or explain(problems[k], np.random.default_rng(seed), plain) for k in alike]
            together = in_common(each, plain.smallest_threshold)
            found = [together[alike.index(k)] if together and k in alike else found[k] for k in range(len(problems))]
    return found


def _say_together(looks: Sequence[Mapping[str, float]]) -> float:
    """What the first looks at all joints of an axis say at most for one effect [nats]."""
    effects = set().union(*looks)
    return max((sum(max(look.get(e, -math.inf), -AMBIGUOUS) for look in looks) for e in effects), default=0.0)


def with_rivals(explanation: Explanation) -> Explanation:
    """The explanation, with the rivals that its effects owe their names to not being present as a whole.

    An effect is there as it is or not at all, and the search keeps to effects that come out so. But where one would explain
    more with a part of it, as a dead time of less than a sampling period among stamps that tremble, neither of the two has the
    right shape, and the name of the one that is kept is no better than that of the other.
    """
    fit, regression = explanation.selection.fit, explanation.selection.regression
    terms, named = explanation.search.problem.terms, []
    for entry in explanation.named:
        others = tuple(instance for instance in fit.instances if instance != entry.instance)
        taken = {instance.term for instance in fit.instances}
        rivals = []
        for index, term in enumerate(terms):
            if index in taken or term.effect == UNKNOWN:
                continue
            shapes = (Instance(index, tuple(sorted(shape.items())), term.base_indices()) for shape in term.shapes)
            best = max(regression.fit((*others, rival)).log_evidence for rival in shapes)
            if best > fit.log_evidence - AMBIGUOUS and term.effect not in entry.ambiguous_with:
                rivals.append(term.effect)
        named.append(
            dataclasses.replace(
                entry, ambiguous_with=(*entry.ambiguous_with, *rivals), probability=entry.probability / (1 + len(rivals))
            )
        )
    return dataclasses.replace(explanation, named=tuple(named))


def _shared(found: CommandFindings, problems: Sequence[RegressionProblem]) -> CommandFindings:
    """Make one effect of those that several joints of an axis have alike, if no other one speaks against having it, too.

    Drives of one kind that were never asked for much more than their limit have the limit of the others.
    """
    named, locations, notes = list(found.named), list(found.locations), []
    for axis in AXIS_NAMES:
        joints = {caster: p for p in problems if p.channels[0].axis == axis for caster in p.channels[0].casters}
        for effect in dict.fromkeys(n.term.effect for n, _ in named):
            own = [k for k, place in enumerate(locations) if place.axis == axis and named[k][0].term.effect == effect]
            targets = [named[k][0].term.target[0] for k in own]
            pooled = _pooled([named[k][0] for k in own]) if len(own) > 1 else None
            others = [caster for caster in joints if caster not in targets]
            if pooled is None or any(_speaks_against(joints[caster], pooled) for caster in others):
                continue
            places = [locations[k] for k in own]
            pooled = dataclasses.replace(pooled, term=dataclasses.replace(pooled.term, target=tuple(joints)))
            where = dataclasses.replace(
                places[0], casters=tuple(joints), channels=tuple(name for place in places for name in place.channels)
            )
            named = [with_instance(pooled), *(entry for k, entry in enumerate(named) if k not in own)]
            locations = [where, *(place for k, place in enumerate(locations) if k not in own)]
            if others:
                notes.append(
                    f"{effect} shows in {axis} of {' and '.join(targets)}. In {' and '.join(others)} it hardly would, and "
                    "nothing speaks against it there: that all have it is assumed of drives of one kind."
                )
    return dataclasses.replace(found, named=tuple(named), locations=tuple(locations), notes=(*found.notes, *notes))


def _speaks_against(problem: RegressionProblem, named: NamedTerm) -> bool:
    """Whether a joint did not do what it would have done with an effect that others have."""
    term = next(term for term in problem.terms if term.effect == named.term.effect)
    values = {name: estimate.value for name, estimate in named.estimates.items()}
    shape = {name: values.get(name, value) for name, value in term.shapes[0].items()}
    return _size(problem, problem.residual - term.columns(shape)[:, :, 0]) > _size(problem, problem.residual)


def _pooled(named: Sequence[NamedTerm]) -> NamedTerm | None:
    """Return one finding of several, with their numbers weighted by their intervals; None where they do not agree."""
    estimates = {}
    for name, first in named[0].estimates.items():
        values = np.array([n.estimates[name].value for n in named])
        deviations = np.array([(n.estimates[name].high - n.estimates[name].low) / (2.0 * HALF_WIDTH) for n in named])
        if np.ptp(values) == 0.0:  # a number that nobody searched for, or that was searched for all of them
            estimates[name] = first
            continue
        if not np.all(deviations > 0.0):
            return None
        weights = deviations**-2.0
        # What makes all of them uncertain, as the time a command is under way, does not average out.
        value, deviation = float(values @ weights / weights.sum()), float(deviations.min())
        if np.sum(((values - value) / deviations) ** 2) > stats.chi2.ppf(AGREEING, len(named) - 1):
            return None
        estimates[name] = Estimate(value, first.unit, value - HALF_WIDTH * deviation, value + HALF_WIDTH * deviation)
    return dataclasses.replace(
        max(named, key=lambda n: n.probability), estimates=estimates,
        ambiguous_with=tuple(name for name in named[0].ambiguous_with if all(name in n.ambiguous_with for n in named)),
        loss=sum(n.loss for n in named), held_out=sum(n.held_out for n in named),
    )  # fmt: skip


def _first_look(problem: RegressionProblem, settings: SelectionSettings | None) -> dict[str, float]:
    """What every candidate gains over noise as it is, by its effect [nats]."""
    # Where times near the best one were chosen, none of the others may come near enough to be the effect as a whole.
    thinned = (
        term if term.grid_size else dataclasses.replace(term, shapes=term.shapes[::FIRST_LOOK_STEP]) for term in problem.terms
    )
    problem = dataclasses.replace(problem, terms=tuple(thinned))
    search = EffectSearch(problem, np.random.default_rng(0), settings)
    # As white noise: a large effect would pass for slow noise here.
    candidates = search.whiten_at(problem.residual, white=True, by_channel=True).scan(())[0]
    return {problem.terms[candidate.instance.term].effect: candidate.gain for candidate in reversed(candidates)}


def _size(problem: RegressionProblem, values: FloatArray) -> float:
    """Root mean square of values (T, 1) where they can be judged."""
    return float(np.sqrt(np.mean(values[problem.valid] ** 2)))


def _predicted(fitted: RegressionProblem, problem: RegressionProblem, explanation: Explanation | None) -> FloatArray:
    """What the named effects, and the numbers re-tuned beside them, add in a problem of the same joint (T, 1)."""
    total = np.zeros_like(problem.residual)
    if explanation is None or not explanation.named:
        return total
    fit = explanation.fit
    total += problem.nuisance_columns() @ fit.mean[: len(problem.nuisances)]
    position = len(fitted.nuisances)
    for instance in fit.instances:
        # A law outside the library is a term of the fitted problem alone.
        key = fitted.terms[instance.term].key if instance.term < len(fitted.terms) else ""
        for term in problem.terms:
            if term.key == key:
                columns = term.columns(dict(instance.shape))[..., list(instance.active)]
                total += columns @ fit.mean[position : position + len(instance.active)]
        position += len(instance.active)
    return total


def _proof(problem: RegressionProblem, added: FloatArray, floor: float, rng: np.random.Generator) -> ChannelProof:
    rows = problem.valid[:, 0]
    spread = max(float(np.std(problem.measured[rows])), 1e-300)
    squares = [((values[rows] / spread) ** 2) for values in (problem.residual, problem.residual - added)]
    errors = PairedErrors.of(squares[0], squares[1], blocks_of(problem.recording[rows], problem.time[rows]), rng)
    before, after = (float(np.sqrt(values[0])) for values in (errors.before, errors.after))
    first, last = (interval(np.sqrt(draws[:, 0])) for draws in (errors.before_draws, errors.after_draws))
    return ChannelProof(problem.channels[0].name, floor / spread, before, after, first, last)


def with_instance(named: NamedTerm) -> tuple[NamedTerm, EffectInstance]:
    """Return a finding and what it is in a description."""
    values = {name: estimate.value for name, estimate in named.estimates.items()}
    return named, effect_instance(named.term.effect, named.term.target, values, named.term.axis)


def _location(problem: RegressionProblem, named: NamedTerm) -> LocationFinding:
    channel = problem.channels[0]
    first = problem.time[problem.recording == problem.recording[0]]
    whole = ((float(first.min()), float(first.max())),)
    return LocationFinding((channel.name,), channel.casters, channel.axis, whole, {})


def _ladder(explanation: Explanation | None) -> tuple[LadderFinding, ...]:
    if explanation is None:
        return ()
    return tuple(
        LadderFinding(step.description, step.gain, step.held_out_gain, step.outcome)
        for step in explanation.selection.ladder if step.outcome == "named"
    )
