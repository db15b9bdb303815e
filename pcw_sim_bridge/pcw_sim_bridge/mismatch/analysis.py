"""From recordings and a description to findings: search, look-alikes, leftovers, locations, held-out proof."""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pcw_description.effect_instance import EffectInstance
from pcw_description.effects.registry import all_effects, also_known, get

from .all_cores import side_by_side
from .findings.command_findings import CommandFindings, command_findings
from .findings.explanation import (
    OF_ROLLING,
    OF_THE_BALANCE,
    Explanation,
    NamedTerm,
    cannot_contradict,
    explain,
    explanation_by,
    explanation_instead,
    strained_of_the_balance,
)
from .findings.findings import (
    FLAG_PROBABILITY,
    ChannelFinding,
    EffectFinding,
    Findings,
    LadderFinding,
    ParameterFinding,
    ResidualMap,
    RetunedFinding,
    Trace,
    UnknownFinding,
)
from .findings.late_torques import TORQUE_LAG, with_late_torques, without_late_reports
from .findings.locations import locate, locate_leftover, walked
from .findings.nearest_effect import with_the_nearest
from .findings.ripple_findings import beside_ripples, ripple_findings, with_ripples
from .laws.generated_effect import NoSuchKernelError, generate
from .laws.unknown_law import Law
from .proof.proof import Proof, Prover, with_channels
from .regression.regression_problem import HEALTHY, STRAINED, TAKEN_OVER, FloatArray, RegressionProblem
from .regression.whitened_regression import Fit, predicted
from .robot.turned_steering import FIGHTING
from .search.open_set import Leftover
from .search.selection_settings import SelectionSettings
from .search.set_growth import LadderStep
from .subjects.subject import Subject
from .subjects.turned_findings import instance_of, turned_findings

Progress = Callable[[str], None]

# The scraps between shaking are no sample of the motion: they look like every kind of effect.
LEAST_UNDISTURBED = 0.2
# Least to say anything: usable samples per channel and unknown, and time of usable motion.
LEAST_DURATION = 5.0  # [s]
# A number of the description is reported where it moves by this many of its own standard errors and a tenth of its
# tolerance, or where its standard error is below this part of its tolerance: then the recordings have measured it.
RETUNED_SIGNIFICANCE = 2.0
DETERMINED_PART = 0.3
# More different effects than this at once are hardly what one robot has: who has its description mixed up gets them, too.
MOST_AT_ONCE = 4
FAR_TURNED = 0.1  # [rad], of a steering
# What names all that is missing closes the gap; of names that leave more than this part of it something else is at work, too.
LEAST_CLOSED = 0.5


@dataclasses.dataclass(frozen=True)
class Analysis:
    """What an analysis gives: findings for people, and the patched subject for programs.

    Attributes:
        with_laws: the patched description with the laws outside the library that help, for simulators that know the files of
            their effects; None where there are none.
    """

    findings: Findings
    patched: Subject
    with_laws: Mapping[str, Any] | None = None


def analyse(
    subject: Subject,
    fit: Sequence[Path],
    holdout: Sequence[Path],
    topics: Mapping[str, str],
    seed: int,
    progress: Progress,
    settings: SelectionSettings | None = None,
) -> Analysis:
    """Analyse recordings.

    Args:
        subject: the description.
        fit: recordings to learn from; holdout: recordings to prove it on, never looked at before.
        topics: contract topic -> topic in the recordings.
        seed: of the surrogates; the same seed gives the same findings.
        progress: is told what is being done.
        settings: of the search.

    Raises:
        PcwError: a recording cannot be read.
    """
    begun = time.monotonic()
    once = "; its model is compiled on the way, once after an installation" if subject.awaits_compiling() else ""
    progress(f"reading {len(fit) + len(holdout)} recording(s){once}")
    opened, of_fit = subject.part_of([subject.open(path, "fit", topics) for path in fit], "searched")
    held_out, of_holdout = subject.part_of([subject.open(path, "holdout", topics) for path in holdout], "held out")
    for one in (*opened, *held_out):
        for warning in one.finding.warnings:
            progress(f"{one.finding.path}: {warning}")
    lengths = tuple(told for told in (of_fit, of_holdout) if told)
    for told in lengths:
        progress(told)
    progress("building the channels")
    problem, sizes = side_by_side(lambda: subject.problem(opened), lambda: subject.ripples(opened))
    known = [*opened, *held_out]
    right = subject.put_right(problem, known)
    if right is not known:
        opened, held_out = right[: len(opened)], right[len(opened) :]
        progress(f"{', '.join(one.finding.path for one in right)}: {right[0].finding.warnings[-1]}")
        problem, sizes = subject.problem(opened), subject.ripples(opened)
    plain, ripples = subject, CommandFindings()
    if sizes:
        # The channels judge what is left: what they show of it where joints turn slowly would pass for something else.
        ripples = ripple_findings(sizes, subject.with_ripples(sizes, held_out), subject.band(), seed)
        for _, instance in ripples.named:
            progress(f"above {subject.band():.3g} Hz: {plain.statement(instance)}")
        subject = plain.describing([instance for _, instance in ripples.named])
        problem = subject.problem(opened)
    inputs = tuple(o.finding for o in (*opened, *held_out))
    judged = problem.valid.any(axis=1)
    usable = float(judged.sum()) / problem.rate
    turned = subject.turned_steering(problem, opened)
    if turned is not None and (turned.fighting > FIGHTING or usable < LEAST_DURATION):
        found = turned_findings(subject, turned, problem, inputs, (*lengths, *problem.remarks), time.monotonic() - begun)
        return Analysis(found, plain.patched([instance_of(turned)], {}))
    if usable < LEAST_DURATION or (problem.shaken and judged.mean() < LEAST_UNDISTURBED):
        note = (
            f"only {usable:.1f} s of usable motion (moving, no gross slip), {100 * judged.mean():.0f} % of what was recorded; "
            f"at least {LEAST_DURATION:g} s are needed, and {100 * LEAST_UNDISTURBED:.0f} % where wheels shake"
        )
        rippling = [plain.statement(instance) for _, instance in ripples.named]
        notes = (note, *lengths, *problem.remarks, *ripples.notes, *rippling)
        empty = Findings(
            subject.name, "insufficient_data", inputs, (), (), (), (), (), None, (), (), notes, time.monotonic() - begun
        )
        return Analysis(empty, plain)
    samples, channels = problem.residual.shape
    progress(f"searching {len(problem.terms)} candidates in {samples} samples of {channels} channels")

    def needs_no_explanation() -> tuple[CommandFindings, Sequence[RegressionProblem], Prover, tuple[str, ...]]:
        fitted, others = subject.command_problems(opened), subject.command_problems(held_out, searched=False)
        rng = np.random.default_rng(seed)
        prover = Prover(subject, opened, held_out, _reported_numbers, explanation_by, explanation_instead, rng)
        return command_findings(fitted, others, seed, settings, progress), fitted, prover, subject.responses(opened)

    explanation, (commands, commanded, prover, responses) = side_by_side(
        lambda: with_the_nearest(explain(problem, np.random.default_rng(seed), settings, progress)), needs_no_explanation
    )
    commands = without_late_reports(with_late_torques(commands, commanded, explanation), commanded, explanation)
    progress("proving it on held-out data")
    proof = prover.prove(explanation, bool(commands.named or ripples.named))
    explanation, shaken = beside_ripples(proof.explanation, ripples)
    problem = explanation.search.problem
    pairs, gaping = doubted_in_a_gap(
        [(named, named.effect) for named in explanation.named], 0.0 if proof.untuned else proof.finding.gap_closed
    )
    pairs, ripples = with_ripples(pairs, ripples)
    pairs, turned_far = doubted_beside_a_turn(pairs)
    everything, crowded = doubted_in_a_crowd([*pairs, *commands.named])
    commands = ripples.and_also(commands)
    instances = [instance for _, instance in everything]
    retuned = _retuned(problem, explanation.fit)
    numbers = {name: value for name, value in _reported_numbers(explanation).items() if name not in proof.untuned}
    patched = plain.patched(instances, numbers) if instances else plain
    leftovers = (*explanation.leftovers, *commands.leftovers)
    unknown = _unknown(leftovers, proof.laws, [str(path) for path in fit])
    verdict = {
        (True, False): "explained",
        (True, True): "partly_explained",
        (False, True): "unexplained",
        (False, False): "no_mismatch",
    }[bool(instances), bool(leftovers)]
    path = walked(problem, [subject.path(o) for o in opened])
    arguments = [name for instance in explanation.fit.instances for name in problem.terms[instance.term].arguments]
    # The prediction belongs to the residual that is exact where the patch is, not to that of the description.
    other = None if prover.other is None else proof.held_out.problem
    findings = Findings(
        subject=subject.name,
        verdict=verdict,
        inputs=inputs,
        channels=(*_channels(explanation), *commands.channels),
        locations=(
            *(locate(explanation, named) for named in explanation.named),
            *commands.locations,
            *(locate_leftover(explanation, leftover, path) for leftover in explanation.leftovers),
        ),
        effects=tuple(_effect_finding(subject, named, e) for named, e in everything),
        unknown=unknown,
        retuned=retuned,
        fit=with_channels(proof.finding, commands.proofs),
        ladder=(*_ladder(explanation.selection.ladder), *proof.dropped, *commands.ladder),
        traces=(
            *_traces(problem, predicted(problem, explanation.fit), arguments, "fit"),
            *(_traces(other, proof.predicted, arguments, "holdout") if other is not None else ()),
        ),
        notes=(
            *lengths, *gaping, *turned_far, *crowded,
            *_notes(explanation, retuned, other is not None, proof, fit, commands.numbers),
            *commands.notes, *shaken, *responses,
        ),
        seconds=time.monotonic() - begun,
        residual_map=_residual_map(explanation, path),
        absent=subject.absent(opened),
    )
    return Analysis(findings, patched, _with_laws(plain, instances, numbers, unknown))


def doubted_in_a_gap(
    named: Sequence[tuple[NamedTerm, EffectInstance]], closed: float
) -> tuple[Sequence[tuple[NamedTerm, EffectInstance]], tuple[str, ...]]:
    """Return the effects, half as sure if they close but a small part of the gap, and what to know of that.

    What is at work once, or in one recording, need not be so in what is held out, and where there is no gap none is closed: 0.
    """
    elsewhere = any(entry.term.once or entry.term.recording is not None for entry, _ in named)
    if not 0.0 < closed < LEAST_CLOSED or elsewhere or not named:
        return named, ()
    return _half_as_sure(named), (
        f"What is named closes {100 * closed:.0f} % of the gap on what was held out: something else is missing, besides or "
        "instead. All names are half as sure.",
    )


def _half_as_sure(named: Sequence[tuple[NamedTerm, EffectInstance]]) -> Sequence[tuple[NamedTerm, EffectInstance]]:
    return [(dataclasses.replace(entry, probability=0.5 * entry.probability), instance) for entry, instance in named]


def doubted_beside_a_turn(
    named: Sequence[tuple[NamedTerm, EffectInstance]]
) -> tuple[Sequence[tuple[NamedTerm, EffectInstance]], tuple[str, ...]]:
    """Return the effects, half as sure those beside a steering whose zero is far off, and what to know of that.

    From the description to there everything is curved. What errors of that leave has the clearest names, and wrong ones.
    """
    turned = [pair for pair in named if _is_far_turned(pair[1])]
    if not turned or len(turned) == len(named):
        return named, ()
    casters = " and ".join("+".join(instance.target) for _, instance in turned)
    return [pair if _is_far_turned(pair[1]) else _half_as_sure([pair])[0] for pair in named], (
        f"The steering of {casters} is so far off that what else is named may be what it leaves: half as sure. Mend it and "
        "record anew, or put its steer_zero_offset under `physics:` of the robot file as it stands in robot_patched.yaml, and "
        "analyse again.",
    )


def _is_far_turned(instance: EffectInstance) -> bool:
    return instance.name == "steer_zero_offset" and abs(instance.parameters["offset"]) > FAR_TURNED


def doubted_in_a_crowd(
    named: Sequence[tuple[NamedTerm, EffectInstance]]
) -> tuple[Sequence[tuple[NamedTerm, EffectInstance]], tuple[str, ...]]:
    """Return the effects, half as sure if they are of more kinds than a robot is likely to have, and what to know of that."""
    kinds = len({entry.term.effect for entry, _ in named})
    if kinds <= MOST_AT_ONCE:
        return named, ()
    return _half_as_sure(named), (
        f"{kinds} different effects at once are more than one robot is likely to have: is this its description? All names are "
        "half as sure.",
    )


def _with_laws(
    subject: Subject, instances: Sequence[EffectInstance], numbers: Mapping[str, float], unknown: Sequence[UnknownFinding]
) -> Mapping[str, Any] | None:
    """The patched description with the laws that are effects; see `Analysis`."""
    made = [left.effect for left in unknown if left.helps and left.effect is not None]
    laws = [EffectInstance(effect.name, effect.target, effect.parameters, None) for effect in made]
    with also_known(effect.loaded for effect in made):
        return subject.patched([*instances, *laws], numbers).mapping() if laws else None


def _reported_numbers(explanation: Explanation) -> dict[str, float]:
    """Numbers of the description that the recordings move, by name, within what makes sense.

    Beyond it a first order leads on, and tyres like stone lead a simulation astray.
    """
    problem = explanation.search.problem
    bounds = {n.name: (n.nominal + n.changes[0], n.nominal + n.changes[1]) for n in problem.nuisances}
    return {n.name: float(np.clip(n.value, *bounds[n.name])) for n in _retuned(problem, explanation.fit)}


def _unknown(
    leftovers: Sequence[Leftover], proved: Sequence[Law], recordings: Sequence[str]
) -> tuple[UnknownFinding, ...]:
    """What is left, with a file for every law that the kernel of an effect can hold."""
    found: list[UnknownFinding] = []
    for left in leftovers:
        effect, reason = None, ""
        if left.law is not None:
            taken = [*all_effects(), *(other.effect.name for other in found if other.effect is not None)]
            try:
                effect = generate(left.law, left.weights, recordings, taken)
            except NoSuchKernelError as error:
                reason = str(error)
        variables = left.depends_on or (left.variable,)
        share = float(min(left.share, 1.0))
        helps = any(left.law is law for law in proved)
        found.append(UnknownFinding(left.channel, variables, left.expression, share, effect, reason, helps))
    return tuple(found)


def _effect_finding(subject: Subject, named: NamedTerm, instance: EffectInstance) -> EffectFinding:
    effect = get(named.term.effect)
    # A smoothing of a sign is a numerical means, not a finding.
    parameters = {}
    for name, estimate in named.estimates.items():
        declared = effect.parameter(name)
        searched = {*(p.name for p in effect.searched_parameters), *(p.name for p in named.term.parameters)}
        if name in searched or declared.default is None or name in named.term.resolution:
            turns = math.tau * round(estimate.value / math.tau) if declared.is_direction else 0.0
            value, low, high = (number - turns for number in (estimate.value, estimate.low, estimate.high))
            parameters[name] = ParameterFinding(value, subject.unit(declared.unit), low, high)
    return EffectFinding(
        name=named.term.effect,
        target=named.term.target,
        probability=named.probability,
        parameters=parameters,
        statement=subject.statement(instance),
        ambiguous_with=tuple(dict.fromkeys(named.ambiguous_with)),
        experiment=_experiment(named),
    )


def _experiment(named: NamedTerm) -> str | None:
    """What would tell an effect from those it is ambiguous with: what each of them asks for."""
    if not named.ambiguous_with:
        return None
    effects = (named.term.effect, *(name.partition("/")[0] for name in named.ambiguous_with))
    asked = dict.fromkeys(get(name).separating_experiment for name in effects)
    return "; ".join(text for text in asked if text) or None


def _rms(values: FloatArray, valid: np.ndarray) -> FloatArray:
    """Root mean square per channel over valid samples, (C,)."""
    counts = np.maximum(valid.sum(axis=0), 1)
    rms: FloatArray = np.sqrt(np.sum(np.where(valid, values, 0.0) ** 2, axis=0) / counts)
    return rms


def _channels(explanation: Explanation) -> tuple[ChannelFinding, ...]:
    """Findings on the channels of which anything could be judged."""
    problem = explanation.search.problem
    nominal = _rms(problem.nominal_residual, problem.valid)
    return tuple(
        ChannelFinding(
            channel.name, channel.unit, float(nominal[c]), float(explanation.floor[c]), float(explanation.p_values[c]),
            bool(explanation.p_values[c] < FLAG_PROBABILITY),
        )
        for c, channel in enumerate(problem.channels) if problem.valid[:, c].any()
    )


def _retuned(problem: RegressionProblem, fit: Fit) -> tuple[RetunedFinding, ...]:
    """Numbers of the description that the recordings move, or determine better than its tolerance states them."""
    found = []
    deviations = np.sqrt(np.diag(fit.covariance)[: len(problem.nuisances)] * max(fit.scale, 1e-12))
    # A red residual makes its own intervals narrow, and those of tolerances that it says nothing about.
    known = deviations * max(1.0, 1.0 / math.sqrt(max(fit.scale, 1e-12)))
    for nuisance, change, deviation, least in zip(problem.nuisances, fit.mean, deviations, known, strict=False):
        if nuisance.narrowed == TAKEN_OVER:
            continue
        moved = abs(change) > max(RETUNED_SIGNIFICANCE * deviation, 0.1 * nuisance.deviation)
        if moved or least < DETERMINED_PART * nuisance.deviation:
            value = nuisance.nominal + float(change)
            # Masses are weighed against the torques: no better than these are known.
            scale = problem.scale_deviation * value if nuisance.unit.startswith("kg") else 0.0
            half = 1.96 * math.hypot(float(deviation), scale)
            found.append(
                RetunedFinding(
                    nuisance.name, nuisance.unit, nuisance.nominal, value, value - half, value + half, nuisance.deviation,
                    math.inf if nuisance.loose else STRAINED * nuisance.deviation,
                )
            )
    return tuple(found)


def _ladder(steps: Sequence[LadderStep]) -> tuple[LadderFinding, ...]:
    return tuple(LadderFinding(s.description, s.gain, s.held_out_gain, s.outcome) for s in steps)


def _traces(problem: RegressionProblem, explained: FloatArray, arguments: Sequence[str], role: str) -> tuple[Trace, ...]:
    """One trace per channel, over all recordings on end, against the first argument of what was found or else the motion."""
    wanted = [name for name in (*arguments, "velocity", "speed", "time") if name in problem.variables]
    variable = wanted[0] if wanted else next(iter(problem.variables))
    time_on_end = _on_end(problem)
    traces = []
    for c, channel in enumerate(problem.channels):
        nominal = problem.measured[:, c] - problem.nominal_residual[:, c]
        blank = np.where(problem.valid[:, c], 1.0, np.nan)
        traces.append(
            Trace(
                channel.name, channel.unit, role, time_on_end, problem.measured[:, c] * blank, nominal * blank,
                (problem.measured[:, c] - problem.residual[:, c] + explained[:, c]) * blank,
                variable, problem.variables[variable],
            )
        )
    return tuple(traces)


def _on_end(problem: RegressionProblem) -> FloatArray:
    """Stamps (T,) with the recordings one after another, half a second apart."""
    time_on_end, elapsed = problem.time.copy(), 0.0
    for index in np.unique(problem.recording):
        own = problem.recording == index
        time_on_end[own] += elapsed
        elapsed += float(problem.time[own].max()) + 0.5
    return time_on_end


def _residual_map(explanation: Explanation, path: FloatArray | None) -> ResidualMap:
    """What is left of all channels together, over the variables that a map is drawn for."""
    problem = explanation.search.problem
    floor = np.maximum(explanation.floor, 1e-300)
    blank = np.where(problem.valid, 1.0, np.nan)
    any_valid = problem.valid.any(axis=1)
    sides = []
    for left in (problem.nominal_residual, problem.residual - predicted(problem, explanation.fit)):
        counts = np.maximum(problem.valid.sum(axis=1), 1)
        power = np.nansum((left * blank / floor) ** 2, axis=1) / counts
        sides.append(np.where(any_valid, np.sqrt(power), np.nan))
    wanted = ["speed", "velocity", "position", *(name for name in problem.variables if name.startswith("steer_angle/"))]
    shown = [name for name in wanted if name in problem.variables][:2]
    variables = {name: problem.variables[name] for name in shown}
    return ResidualMap(sides[0], sides[1], _on_end(problem), variables, path)


def _far_off(number: RetunedFinding) -> str:
    """Say of a number that no healthy system has it; of one that no description holds, what it means."""
    far = f"{number.name} comes out {number.times:.1f} tolerances"
    late = f"{1e3 * abs(number.value):.2g} ms {'later' if number.value < 0.0 else 'earlier'}"
    if number.name == TORQUE_LAG:
        return f"{far} off: torques act {late} than joint_states report them. The fit allows for it."
    if number.name == "clock_offset":
        return f"{far} off: the force acts {late} than it is recorded, by the motor or by a filter. The fit allows for it."
    if number.name == "contact.mu_p":
        return (
            f"{far} off: slips bend otherwise with forces than described. That is the friction only if the curve has the "
            "described shape: where wheels use most of their friction nothing is judged."
        )
    if number.name == "heading_lead":
        return f"{far} off: wheels follow their headings {late} than rigid ones do. The fit allows for it."
    return f"{far} from the description: check it or its tolerance."


def _notes(
    explanation: Explanation,
    retuned: Sequence[RetunedFinding],
    has_holdout: bool,
    proof: Proof,
    recordings: Sequence[Path],
    told: Collection[str],
) -> tuple[str, ...]:
    """What a reader has to know to judge the findings; of some numbers they say it themselves."""
    notes = list(proof.notes)
    problem, unfinished = explanation.search.problem, bool(explanation.leftovers)
    for label, variable in explanation.withdrawn:
        notes.append(f"{label} was withdrawn: what is left depends on {variable}, which that effect does not.")
    notes.extend(explanation.remarks)
    notes.extend(problem.remarks)
    for named in explanation.named:
        if named.term.recording is not None:
            notes.append(f"{named.term.effect} was at work in one recording alone: {recordings[named.term.recording]}.")
    notes += [_far_off(number) for number in retuned if number.times > HEALTHY and number.name not in told]
    geometry = sorted({named.term.effect for named in explanation.named if named.term.effect in OF_ROLLING})
    if geometry and cannot_contradict(problem):
        notes.append(
            f"Wheels of one axle that never steer cannot contradict each other: {', '.join(geometry)} may stand for a slip in "
            "proportion to the motion, as of a robot that scrubs when it turns: half as sure."
        )
    doubted = sorted({named.term.effect for named in explanation.named if named.term.effect in OF_THE_BALANCE})
    strained = strained_of_the_balance(problem, explanation.fit)
    if doubted and strained:
        notes.append(f"{', '.join(doubted)} may stand for what {', '.join(strained)} show to be missing: half as sure.")
    if not explanation.named and not unfinished and not proof.dropped:
        nearest = explanation.nearest()
        if nearest is not None:
            effect = nearest.description.removeprefix("drop ")
            notes.append(f"Nearest to an effect came {effect}: {nearest.gain:.0f} nats, but {nearest.outcome}.")
    if not has_holdout:
        notes.append(
            "No hold-out recording was given: the proof leaves out manoeuvres of the fitted ones, which the choice of the "
            "effects has seen."
        )
    if unfinished:
        notes.append("What is left is not noise; the names above explain their part of it and no more.")
    if unfinished and explanation.refinement is not None:
        notes.append(f"First suspect for what is left: {explanation.refinement.describe()}.")
    numbers = {nuisance.name for nuisance in problem.nuisances}
    rotary = problem.channels[0].name == "axis_force" and problem.channels[0].unit == "N m"
    if rotary and "gravity_moment" not in numbers and any(left.variable == "position" for left in explanation.leftovers):
        notes.append("What depends on the angle may be gravity on an arm: give the description a gravity_arm.")
    share = float(problem.valid[:, problem.valid.any(axis=0)].mean()) if problem.valid.any() else 0.0
    if share < 0.9:
        notes.append(f"{100 * (1 - share):.0f} % of the samples could not be judged (standstill, gross slip or missing data).")
    return tuple(notes)
