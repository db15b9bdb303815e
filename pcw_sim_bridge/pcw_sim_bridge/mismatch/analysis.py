"""From recordings and a description to findings: search, look-alikes, leftovers, locations, held-out proof."""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np

from pcw_description.effect_instance import EffectInstance
from pcw_description.effects.registry import get

from .evidence_selection import LadderStep, SelectionSettings
from .explanation import Explanation, NamedTerm, explain
from .findings import (
    ChannelFinding,
    EffectFinding,
    Findings,
    FitFinding,
    LadderFinding,
    LocationFinding,
    ParameterFinding,
    RetunedFinding,
    Trace,
    UnknownFinding,
)
from .generated_effect import NoSuchKernelError, generate
from .open_set import Leftover, names_only
from .regression_problem import FloatArray, RegressionProblem
from .subject import Opened, Subject
from .whitened_regression import Fit, WhitenedRegression, predicted

Progress = Callable[[str], None]

FLAG_PROBABILITY = 1e-3
# Least to say anything: usable samples per channel and unknown, and time of usable motion.
LEAST_DURATION = 5.0  # [s]
# Part of a recording held out at its end where none was given for it.
HELD_OUT_PART = 0.3
# A number of the description is reported where it moves by this many of its own standard errors and a tenth of its
# tolerance, or where its standard error is below this part of its tolerance: then the recordings have measured it.
RETUNED_SIGNIFICANCE = 2.0
DETERMINED_PART = 0.3


@dataclasses.dataclass(frozen=True)
class Analysis:
    """What an analysis gives: findings for people, and the patched subject for programs."""

    findings: Findings
    patched: Subject


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
    progress(f"reading {len(fit) + len(holdout)} recording(s)")
    opened = [subject.open(path, "fit", topics) for path in fit]
    held_out = [subject.open(path, "holdout", topics) for path in holdout]
    progress("building the channels")
    problem = subject.problem(opened)
    inputs = tuple(o.finding for o in (*opened, *held_out))
    usable = float(problem.valid.any(axis=1).sum()) / problem.rate
    if usable < LEAST_DURATION:
        note = f"only {usable:.1f} s of usable motion (moving, no gross slip); at least {LEAST_DURATION:g} s are needed"
        empty = Findings(
            subject.name, "insufficient_data", inputs, (), (), (), (), (), None, (), (), (note,), time.monotonic() - begun
        )
        return Analysis(empty, subject)
    samples, channels = problem.residual.shape
    progress(f"searching {len(problem.terms)} candidates in {samples} samples of {channels} channels")
    explanation = explain(problem, np.random.default_rng(seed), settings, progress)
    instances = [effect_instance(named) for named in explanation.named]
    leftovers = explanation.leftovers
    retuned = _retuned(problem, explanation.fit)
    patched = subject.patched(instances, {r.name: r.value for r in retuned})
    progress("proving it on held-out data")
    fit_finding, held_out_problem, held_out_fit, ran_away = _prove(subject, patched, explanation, opened, held_out)
    verdict = {
        (True, False): "explained",
        (True, True): "partly_explained",
        (False, True): "unexplained",
        (False, False): "no_mismatch",
    }[bool(instances), bool(leftovers)]
    findings = Findings(
        subject=subject.name,
        verdict=verdict,
        inputs=inputs,
        channels=_channels(explanation),
        locations=tuple(_location(explanation, named) for named in explanation.named),
        effects=tuple(_effect_finding(subject, named, e) for named, e in zip(explanation.named, instances, strict=True)),
        unknown=_unknown(leftovers, [str(path) for path in fit]),
        retuned=retuned,
        fit=fit_finding,
        ladder=_ladder(explanation.selection.ladder),
        traces=(
            *_traces(explanation.search.problem, explanation.fit, "fit"),
            *(_traces(held_out_problem, held_out_fit, "holdout") if held_out else ()),
        ),
        notes=_notes(explanation, retuned, bool(held_out), bool(leftovers), ran_away),
        seconds=time.monotonic() - begun,
    )
    return Analysis(findings, patched)


def effect_instance(named: NamedTerm) -> EffectInstance:
    """Return a named effect with all its parameters, as it stands under `physics:`."""
    effect = get(named.term.effect)
    values = {p.name: float(p.default or 0.0) for p in effect.parameters}
    values |= {name: estimate.value for name, estimate in named.estimates.items()}
    # Rounding of an estimate at its bound must not make a file that its own reader refuses.
    bounded = {p.name: min(max(values[p.name], p.lower), p.upper) for p in effect.parameters}
    return EffectInstance(named.term.effect, named.term.target, bounded, named.term.axis)


def _unknown(leftovers: Sequence[Leftover], recordings: Sequence[str]) -> tuple[UnknownFinding, ...]:
    """What is left, with a file for every law that the kernel of an effect can hold."""
    found: list[UnknownFinding] = []
    for left in leftovers:
        effect, reason = None, ""
        if left.law is not None:
            taken = [other.effect.name for other in found if other.effect is not None]
            try:
                effect = generate(left.law, left.weights, recordings, taken)
            except NoSuchKernelError as error:
                reason = str(error)
        variables = left.depends_on or (left.variable,)
        share = float(min(left.share, 1.0))
        found.append(UnknownFinding(left.channel, variables, left.expression, share, effect, reason))
    return tuple(found)


def _effect_finding(subject: Subject, named: NamedTerm, instance: EffectInstance) -> EffectFinding:
    effect = get(named.term.effect)
    # A smoothing of a sign is a numerical means, not a finding.
    parameters = {}
    for name, estimate in named.estimates.items():
        declared = effect.parameter(name)
        if declared in effect.searched_parameters or declared.default is None or name in named.term.resolution:
            parameters[name] = ParameterFinding(estimate.value, subject.unit(declared.unit), estimate.low, estimate.high)
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
    problem = explanation.search.problem
    nominal = _rms(problem.residual, problem.valid)
    return tuple(
        ChannelFinding(
            channel.name, channel.unit, float(nominal[c]), float(explanation.floor[c]), float(explanation.p_values[c]),
            bool(explanation.p_values[c] < FLAG_PROBABILITY),
        )
        for c, channel in enumerate(problem.channels)
    )


def _location(explanation: Explanation, named: NamedTerm) -> LocationFinding:
    """Where an effect shows: channels that it moves, when, and at which speeds and directions."""
    problem = explanation.search.problem
    part = np.where(problem.valid, named.contribution, 0.0)
    floor = np.maximum(explanation.floor, 1e-300)
    moved = _rms(part, problem.valid) / floor
    channels = [c for c in range(len(problem.channels)) if moved[c] > 0.5] or [int(np.argmax(moved))]
    active = np.any(np.abs(part[:, channels]) > floor[channels], axis=1)
    effect = get(named.term.effect)
    region = {}
    if active.any():
        for name in named.term.arguments[:2]:
            if name in problem.variables:
                low, high = np.quantile(problem.variables[name][active], [0.01, 0.99])
                region[name] = (float(low), float(high))
    return LocationFinding(
        channels=tuple(problem.channels[c].name for c in channels),
        casters=named.term.target if effect.target_kind == "caster" and named.term.target != ("axis",) else (),
        axis=named.term.axis or effect.axis,
        intervals=_intervals(problem.time[active], problem.recording[active]),
        region=region,
    )


def _intervals(
    times: FloatArray, recording: np.ndarray, pause: float = 1.0, most: int = 50
) -> tuple[tuple[float, float], ...]:
    """Join instants less than `pause` apart in the first recording that has any; the longest `most` of them."""
    if not len(times):
        return ()
    times = times[recording == recording[0]]
    cuts = np.flatnonzero(np.diff(times) > pause)
    starts, stops = np.r_[0, cuts + 1], np.r_[cuts, len(times) - 1]
    found = sorted(((float(times[a]), float(times[b])) for a, b in zip(starts, stops, strict=True)), key=lambda s: s[0] - s[1])
    return tuple(sorted(found[:most]))


def _retuned(problem: RegressionProblem, fit: Fit) -> tuple[RetunedFinding, ...]:
    """Numbers of the description that the recordings move, or determine better than its tolerance states them."""
    found = []
    deviations = np.sqrt(np.diag(fit.covariance)[: len(problem.nuisances)] * max(fit.scale, 1e-12))
    for nuisance, change, deviation in zip(problem.nuisances, fit.mean, deviations, strict=False):
        moved = abs(change) > max(RETUNED_SIGNIFICANCE * deviation, 0.1 * nuisance.deviation)
        if moved or deviation < DETERMINED_PART * nuisance.deviation:
            value = nuisance.nominal + float(change)
            # Masses are weighed against the torques: no better than these are known.
            scale = problem.scale_deviation * value if nuisance.unit.startswith("kg") else 0.0
            half = 1.96 * math.hypot(float(deviation), scale)
            found.append(
                RetunedFinding(
                    nuisance.name, nuisance.unit, nuisance.nominal, value, value - half, value + half, nuisance.deviation
                )
            )
    return tuple(found)


def _prove(
    subject: Subject,
    patched: Subject,
    explanation: Explanation,
    opened: Sequence[Opened],
    held_out: Sequence[Opened],
) -> tuple[FitFinding, RegressionProblem, Fit, tuple[str, ...]]:
    """Errors on data that the fit has not seen: given recordings, or the last part of the fitted ones after a refit.

    The last value names signals whose simulation ran away, with the description or with its patch.
    """
    problem, selection = explanation.search.problem, explanation.selection
    regression = selection.regression
    if held_out:
        proof = subject.problem(held_out)
        fit, rows = names_only(problem, selection.fit), proof.valid
        source = "held-out recording" + ("s" if len(held_out) > 1 else "")
    else:
        last = np.zeros(len(problem.time), dtype=bool)
        for index in np.unique(problem.recording):
            own = problem.recording == index
            last |= own & (problem.time > np.quantile(problem.time[own], 1.0 - HELD_OUT_PART))
        seen = dataclasses.replace(problem, valid=problem.valid & ~last[:, None])
        weights = np.ones_like(problem.residual)
        refit = WhitenedRegression(seen, regression.noise, weights, np.zeros(len(problem.time), dtype=np.int64))
        fit = names_only(problem, refit.fit(selection.fit.instances))
        proof, rows = problem, problem.valid & last[:, None]
        source = f"last {100 * HELD_OUT_PART:.0f} % of each recording, refitted without it"
    spread = np.maximum(_rms(proof.measured - _mean(proof.measured, rows), rows), 1e-300)
    before = _nrmse(proof.residual, rows, spread)
    after = _nrmse(proof.residual - predicted(proof, fit), rows, spread)
    floor = float(np.sqrt(np.mean((explanation.floor / spread) ** 2)))
    closed = (before - after) / (before - floor) if before > floor else 0.0
    data = held_out or opened
    nominal_rollout, patched_rollout = subject.rollout(data), patched.rollout(data)
    both = {name: (nominal_rollout[name], patched_rollout[name]) for name in nominal_rollout}
    rollout = {name: pair for name, pair in both.items() if np.isfinite(pair).all()}
    finding = FitFinding(source, (before, after), rollout, float(min(max(closed, 0.0), 1.0)))
    return finding, proof, fit, tuple(sorted(set(both) - set(rollout)))


def _mean(values: FloatArray, rows: np.ndarray) -> FloatArray:
    mean: FloatArray = np.sum(np.where(rows, values, 0.0), axis=0) / np.maximum(rows.sum(axis=0), 1)
    return mean


def _nrmse(residual: FloatArray, rows: np.ndarray, spread: FloatArray) -> float:
    """Root mean square over channels of each channel's error relative to the spread of its measured side."""
    return float(np.sqrt(np.mean((_rms(residual, rows) / spread) ** 2)))


def _ladder(steps: Sequence[LadderStep]) -> tuple[LadderFinding, ...]:
    return tuple(LadderFinding(s.description, s.gain, s.held_out_gain, s.outcome) for s in steps)


def _traces(problem: RegressionProblem, fit: Fit, role: str) -> tuple[Trace, ...]:
    """One trace per channel, over all recordings on end, against the variable that tells most."""
    explained = predicted(problem, fit)
    instance_arguments = [name for i in fit.instances for name in problem.terms[i.term].arguments]
    wanted = [name for name in (*instance_arguments, "velocity", "speed", "time") if name in problem.variables]
    variable = wanted[0] if wanted else next(iter(problem.variables))
    # Recordings follow one another on the time axis, half a second apart.
    offset, elapsed = np.zeros(len(problem.time)), 0.0
    for index in np.unique(problem.recording):
        own = problem.recording == index
        offset[own] = elapsed
        elapsed += float(problem.time[own].max()) + 0.5
    traces = []
    for c, channel in enumerate(problem.channels):
        nominal = problem.measured[:, c] - problem.residual[:, c]
        blank = np.where(problem.valid[:, c], 1.0, np.nan)
        traces.append(
            Trace(
                channel.name, channel.unit, role, problem.time + offset, problem.measured[:, c] * blank, nominal * blank,
                (nominal + explained[:, c]) * blank, variable, problem.variables[variable],
            )
        )
    return tuple(traces)


def _notes(
    explanation: Explanation,
    retuned: Sequence[RetunedFinding],
    has_holdout: bool,
    unfinished: bool,
    ran_away: Sequence[str],
) -> tuple[str, ...]:
    """What a reader has to know to judge the findings."""
    notes = []
    problem = explanation.search.problem
    for label, variable in explanation.withdrawn:
        notes.append(f"{label} was withdrawn: what is left depends on {variable}, which that effect does not.")
    notes.extend(explanation.remarks)
    names = {channel.name for channel in problem.channels}
    if "axis_force" not in names:
        if not any(name.startswith("chassis") for name in names):
            notes.append("No motor torques were usable: forces, friction and masses cannot be judged.")
        if "gyro" not in names:
            notes.append("No inertial sensor was recorded: slip of all wheels together, and its own faults, cannot be seen.")
    for number in retuned:
        if abs(number.value - number.nominal) > 3.0 * number.tolerance:
            times = abs(number.value - number.nominal) / number.tolerance
            notes.append(f"{number.name} comes out {times:.1f} tolerances from the description: check it or its tolerance.")
    if not has_holdout:
        notes.append("No hold-out recording was given: the proof uses the end of the fitted ones.")
    if unfinished:
        notes.append("What is left is not noise; the names above explain their part of it and no more.")
    if unfinished and explanation.refinement is not None:
        notes.append(f"First suspect for what is left: {explanation.refinement.describe()}.")
    numbers = {nuisance.name for nuisance in problem.nuisances}
    rotary = problem.channels[0].name == "axis_force" and problem.channels[0].unit == "N m"
    if rotary and "gravity_moment" not in numbers and any(left.variable == "position" for left in explanation.leftovers):
        notes.append("What depends on the angle may be gravity on an arm: give the description a gravity_arm.")
    if ran_away:
        notes.append(f"Driven by the measured torques the simulation ran away in {', '.join(ran_away)}.")
    share = float(problem.valid.mean())
    if share < 0.9:
        notes.append(f"{100 * (1 - share):.0f} % of the samples could not be judged (standstill, gross slip or missing data).")
    return tuple(notes)
