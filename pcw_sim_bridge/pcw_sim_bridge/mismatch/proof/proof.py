"""Proves a patch on data that its fit has not seen: inverse residual and forward simulation, before and after.

Every error has a 95 % interval from a bootstrap over blocks of time, and a floor: what would be left of a model that is
right, from the noise of the sensors. An effect that takes nothing from the held-out error, though it is at work there, is
not proposed; nor is one with which the simulation follows less well than without.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Collection, Mapping, Sequence

import numpy as np

from pcw_description.effects.kinds import TransmissionEffect
from pcw_description.effects.registry import also_known, get
from pcw_description.errors import PcwError

from ..all_cores import on_all_cores
from ..errors import MismatchError
from ..findings.explanation import AMBIGUOUS, Explanation
from ..findings.findings import REFUSED, ChannelProof, FitFinding, LadderFinding, RolloutProof
from ..findings.law_models import LawModels
from ..findings.paired_errors import PairedErrors, blocks_of, gap_closed, interval
from ..found_effect import effect_instance
from ..laws.unknown_law import Law
from ..regression.regression_problem import HEALTHY, FloatArray, IntArray, RegressionProblem
from ..regression.whitened_regression import Instance
from ..rollout import HORIZONS, MAIN_HORIZON, RAN_AWAY, Windows
from ..search.acting_torques import acting_part, is_reported
from ..search.open_set import FAR_FROM_FLOOR
from ..subjects.subject import Opened, Subject
from .held_out import HeldOut

LEAST_PROBABILITY = 0.01  # of a name: below it stands for another one
# An effect that moves held-out data by less [nats] was not at work there: nothing speaks for it or against it.
AT_WORK = 5.0
# Standard errors by which held-out data have to fall short of what an effect, if it is there, does for them on average.
SHORT_OF = 3.0
# By so much [nats] has held-out data to be foretold better with an effect that the fitted ones may speak against a little.
BORNE_OUT = 10.0
LEAST_WINDOWS = 5  # of which a simulation must have stayed within bounds to speak against an effect
# Of the description's error in a simulation; what adds less to the error is not told from numbers that were re-tuned.
TELLING_PART = 0.1
LEAST_DURATION = 2.0  # [s] of usable motion, to prove anything on
# A patch may be followed less well than the description by this part before it is given up: chance does so much.
ALLOWED_HARM = 0.01
# Part of what no name explained from which a law is told of though other data contradict it.
MOST_OF_IT = 0.5
# Kinds of numbers that move a simulated robot, by how their names begin. One kind may lead it astray, and foretell its own
# channels well: what is wrong with the forces of tyres and bodies is put into masses.
KINDS = (
    ("chassis.", "module.", "wheel.inertia", "rotors."), ("torque_constant/",), ("contact.",),
    ("wheel_radius", "caster_offset", "steer_axis", "steer_zero"),
)  # fmt: skip
ASTRAY = 4.0  # times the mean square of what the description leaves a simulation
# Of its channel's floor; an event that moves a channel by less is over.
EVENT_SHARE = 0.1

Retune = Callable[[Explanation], Mapping[str, float]]
Reduce = Callable[[Explanation, Sequence[Instance]], Explanation]
Exchange = Callable[[Explanation, Instance, Instance], Explanation]


@dataclasses.dataclass(frozen=True)
class Proof:
    """What the held-out data say.

    Attributes:
        explanation: with the effects that stay.
        finding: errors before and after.
        held_out: what was judged; predicted: what the fits take of its residual (T, C).
        untuned: re-tuned numbers that stay in the patch as they are described.
        laws: those outside the library that are part of the patch.
        dropped: ladder lines of the effects that do not help.
        notes: what a reader has to know of the proof.
    """

    explanation: Explanation
    finding: FitFinding
    held_out: HeldOut
    predicted: FloatArray
    untuned: frozenset[str]
    laws: tuple[Law, ...]
    dropped: tuple[LadderFinding, ...]
    notes: tuple[str, ...]


def is_event(effect_name: str) -> bool:
    """Whether an effect comes once, from outside, and says nothing of another time."""
    return "start" in {parameter.name for parameter in get(effect_name).parameters}


def moves_the_robot(effect_name: str) -> bool:
    """Whether a simulation can tell for or against an effect.

    No error of an IMU or of a clock moves a robot, and of what winds up a simulation does not know how it begins.
    """
    return get(effect_name).target_kind not in ("imu", "clock") and not winds_up(effect_name)


def winds_up(effect_name: str) -> bool:
    """Whether an effect keeps something that a simulation would have to begin with.

    How far a gear or a tyre is wound up, and how fast, cannot be read from filtered signals: a tyre may take up its force over
    more than a window's whole way.
    """
    return isinstance(get(effect_name), TransmissionEffect) or effect_name == "tyre_relaxation"


class Prover:
    """Judges explanations of one problem on held-out data."""

    def __init__(
        self,
        subject: Subject,
        opened: Sequence[Opened],
        held_out: Sequence[Opened],
        retune: Retune,
        reduce: Reduce,
        exchange: Exchange,
        rng: np.random.Generator,
    ) -> None:
        """Open the held-out data.

        Args:
            subject: the nominal description.
            opened: what was fitted.
            held_out: other recordings, or nothing: then manoeuvres of the fitted ones are held out.
            retune: explanation -> numbers of the description that go into the patch.
            reduce: explanation, effects that stay -> the explanation by these alone.
            exchange: explanation, an effect, one in its place -> the explanation with that.
            rng: of bootstrap and noise.
        """
        self.besides = False
        self.subject, self.retune, self.reduce, self.exchange, self.rng = subject, retune, reduce, exchange, rng
        self._problem_with = subject.problem_with(held_out) if held_out else None
        # Candidates that nothing is found of would be most of the work.
        self._made: set[str] = set()
        self.other = self._problem_with(self._made) if self._problem_with else None
        self.unusable = self.other is not None and self.other.valid.any(axis=1).sum() < LEAST_DURATION * self.other.rate
        if self.unusable:
            self.other, held_out = None, ()
        self.windows = subject.windows(held_out or opened)
        if self.windows is not None and not len(self.windows.begin):
            self.windows = None
        self.before = None if self.windows is None else subject.rollout(self.windows)
        # Numbers of the description that were re-tuned, and do not go into the patch all the same.
        self.untuned: frozenset[str] = frozenset()
        self.laws: LawModels

    def prove(self, explanation: Explanation, besides: bool = False) -> Proof:
        """Drop what does not help, and hold the rest against the data.

        Args:
            explanation: to be judged.
            besides: other effects are found by other channels, so that there is a patch in any case.

        Raises:
            MismatchError: the held-out recordings fill other channels than the fitted ones.
        """
        self.besides = besides
        dropped: list[LadderFinding] = []
        notes: list[str] = []
        refused: set[Instance] = set()
        contradicted: list[Law] = []
        while True:
            self.untuned = frozenset()
            self.laws = LawModels(explanation, refused)
            held_out = self._held_out(explanation)
            after = None
            useless, simulated = self._impossible(explanation, held_out), None
            if useless is None and (useless := self._useless(explanation, held_out)) is not None:
                instead = self._instead(explanation, held_out, useless[0], refused)
                if instead is not None:
                    explanation, step, note = instead
                    dropped.append(step)
                    notes.append(note)
                    continue
            if useless is None:
                after = self._rollout(explanation, held_out)
                simulated = self._misleading(explanation, held_out, after)
                self.untuned = self._not_helping(explanation, held_out, after)
                useless = simulated or self._no_better(explanation, held_out)
            if useless is None:
                break
            index, reason = useless
            label, nats = explanation.search.label(held_out.instances[index]), held_out.help_of(index)[0]
            dropped.append(LadderFinding(f"drop {label}", nats, nats, f"{REFUSED}: {reason}"))
            notes.append(f"{label} was {REFUSED}: {reason}. It is not proposed.")
            kept = [i for i in explanation.selection.fit.instances if i != held_out.instances[index]]
            if held_out.instances[index] in self.laws.laws:  # what was fitted has it all the same
                refused.add(held_out.instances[index])
                if simulated is None:
                    contradicted.append(self.laws.laws[held_out.instances[index]])
            else:
                explanation = self.reduce(explanation, kept)
        predicted = _of_description(held_out.problem)
        if self._is_patched(explanation):
            predicted = self._prediction(held_out)
            if self.untuned:
                after = self._rollout(explanation, held_out)
                stay = sorted(self.untuned & self.retune(explanation).keys())
                which = "" if self.untuned == _names(explanation) else f" {', '.join(stay)}"
                notes.append(
                    f"The description's numbers{which} as re-tuned beside the effects do not help held out: in the patch they "
                    "stay."
                )
        # A small part of what was left, which forces and slips of other data contradict, is a detail of what was fitted; most
        # of it was there. A simulation that goes astray says less: the law may be the wrong one for something that is there.
        # Where none of it can stand, what is left is far more than noise, and is told of whatever it depends on.
        far = bool(contradicted) and _times_floor(explanation, refused) > FAR_FROM_FLOOR
        left = tuple(
            found for found in explanation.leftovers
            if far or found.share >= MOST_OF_IT or not any(found.law is law for law in contradicted)
        )
        explanation = dataclasses.replace(explanation, leftovers=left)
        notes += self._remarks(explanation, held_out, after)
        finding = self._finding(explanation, held_out, predicted, after)
        laws = tuple(self.laws.laws.values())
        return Proof(explanation, finding, held_out, predicted, self.untuned, laws, tuple(dropped), tuple(notes))

    def _not_helping(self, explanation: Explanation, held_out: HeldOut, after: FloatArray | None) -> frozenset[str]:
        """Re-tuned numbers that do not help held out or lead a simulation astray, of as few kinds as there are."""
        everything = _names(explanation)
        if not self._is_patched(explanation):
            return frozenset()
        bare = self._error(explanation, held_out, _predicted_without(held_out, everything))
        strictly = self._goes_astray(explanation, after)
        if strictly:  # where the effects do so by themselves, that is no reason to do without the numbers
            self.untuned = everything
            strictly = not self._goes_astray(explanation, self._rollout(explanation, held_out))

        def helps(left_out: frozenset[str], simulated: FloatArray | None) -> bool:
            own = self._error(explanation, held_out, _predicted_without(held_out, left_out))
            astray = strictly and self._goes_astray(explanation, simulated)
            return own <= bare and not astray and not self._simulates_worse(explanation, simulated)

        left_out: frozenset[str] = frozenset()
        kinds = [kind for k in KINDS if (kind := frozenset(name for name in everything if name.startswith(k)))]
        while not helps(left_out, after):
            trials = []
            for kind in kinds if self.before is not None and after is not None else []:
                self.untuned = left_out | kind
                simulated = self._rollout(explanation, held_out)
                trials.append((self._simulated_error(explanation, simulated), kind, simulated))
            if not trials:
                left_out = everything
                break
            _, kind, after = min(trials, key=lambda trial: trial[0])
            kinds.remove(kind)
            left_out |= kind
        return left_out

    def _simulated_error(self, explanation: Explanation, after: FloatArray | None) -> float:
        """Mean square of what a patched description leaves of all signals at the main horizon; infinite where nothing is."""
        windows = self._quiet_windows(explanation)
        if windows is None or self.before is None or after is None:
            return math.inf
        errors = _rollout_errors(windows, self.before, after, self.rng, [MAIN_HORIZON]).pooled()
        return float(errors.after[0]) if len(errors.judged) else math.inf

    def _prediction(self, held_out: HeldOut) -> FloatArray:
        """What the patch takes of the held-out residual (T, C), with the re-tuned numbers that go into it."""
        return _predicted_without(held_out, self.untuned)

    def _simulates_worse(self, explanation: Explanation, after: FloatArray | None) -> bool:
        """Whether the patched description is followed less well than the nominal one, all signals together."""
        windows = self._quiet_windows(explanation)
        if windows is None or self.before is None or after is None:
            return False
        if any(winds_up(named.term.effect) for named in explanation.named):
            return False
        errors = _rollout_errors(windows, self.before, after, self.rng, [MAIN_HORIZON]).pooled()
        return bool(len(errors.judged)) and float(errors.worse()[0]) > 0.0

    def _goes_astray(self, explanation: Explanation, after: FloatArray | None) -> bool:
        """Whether the patched description leaves far more than the nominal one, be it in a few windows alone."""
        windows = self._quiet_windows(explanation)
        if windows is None or self.before is None or after is None:
            return False
        return self._simulated_error(explanation, after) > ASTRAY * self._simulated_error(explanation, self.before)

    def _is_patched(self, explanation: Explanation) -> bool:
        """Whether there is anything beside which numbers of the description are re-tuned."""
        return bool(explanation.named or self.laws.laws) or self.besides

    def _numbers(self, explanation: Explanation) -> Mapping[str, float]:
        """Numbers of the description that go into the patch."""
        return {name: value for name, value in self.retune(explanation).items() if name not in self.untuned}

    def _error(self, explanation: Explanation, held_out: HeldOut, predicted: FloatArray) -> float:
        """Mean squared relative error of all channels, each counted by how far it can be foretold."""
        problem = held_out.problem
        blank = np.where(problem.valid, 1.0, np.nan)
        squares = ((problem.residual - predicted) * blank / _spread(problem)) ** 2
        counts = np.isfinite(squares).sum(axis=0)
        weights = np.where(counts > 0, _shares(explanation, problem), 0.0)
        return float(np.nansum(np.nansum(squares, axis=0) / np.maximum(counts, 1) * weights) / max(weights.sum(), 1e-300))

    # -- what is judged ---------------------------------------------------------------------------------------------

    def _held_out(self, explanation: Explanation) -> HeldOut:
        """The folds for the effects of an explanation that last; the time of the others is taken out of the data."""
        problem, selection = explanation.search.problem, explanation.selection
        events = {named.instance for named in explanation.named if is_event(named.term.effect)}
        modelled = {*(entry.instance for entry in explanation.named), *self.laws.laws}
        instances = selection.fit.instances
        if self.other is not None:
            if self._problem_with is not None and not (keys := _keys(explanation)) <= self._made:
                self._made |= keys
                self.other = self._problem_with(self._made)
            other = self.laws.in_problem(self.other)
            names = [[c.name for c in p.channels] for p in (problem, other)]
            if names[0] != names[1]:
                differ = ", ".join(sorted(set(names[0]) ^ set(names[1])))
                raise MismatchError(
                    f"channels {differ} are only in the fitted or only in the held-out recordings; allowed: recordings with "
                    "the same sensors in one analysis"
                )
            judged = HeldOut.recordings(problem, instances, modelled, selection, other)
            # What was staged comes at the same time of every recording.
            gone = {instance for index, instance in enumerate(instances) if instance in events and not _tells(judged, index)}
            return HeldOut.recordings(problem, instances, modelled - gone, selection, other, gone) if gone else judged
        busy = _busy(explanation)
        quiet = dataclasses.replace(problem, valid=problem.valid & ~busy[:, None]) if busy.any() else problem
        lasting = [instance for instance in instances if instance not in events]
        return HeldOut.manoeuvres(quiet, lasting, modelled, selection)

    def _quiet_windows(self, explanation: Explanation) -> Windows | None:
        """The windows, with nothing to judge in them while an event was at work."""
        windows, problem = self.windows, explanation.search.problem
        if windows is None or self.other is not None:
            return windows
        busy = _busy(explanation)
        for recording in np.unique(problem.recording[busy]):
            times = problem.time[busy & (problem.recording == recording)]
            windows = windows.without(int(recording), (float(times.min()), float(times.max())))
        return windows

    # -- what stays -------------------------------------------------------------------------------------------------

    def _useless(self, explanation: Explanation, held_out: HeldOut) -> tuple[int, str] | None:
        """The effect that adds most to the held-out error, if one adds to it.

        Where one that makes the error smaller has little to do, data that hold it are often foretold no better. Against one
        that is said to be ambiguous the held-out data have to speak as clearly as look-alikes are separated.
        """
        doubted = {named.instance for named in explanation.named if named.ambiguous_with}
        believed = {named.instance: named.probability for named in explanation.named}
        found = []
        for index in held_out.proposed:
            if believed.get(held_out.instances[index], 1.0) < LEAST_PROBABILITY:
                return index, "an effect that is not proposed explains by far more"
            nats, work = held_out.help_of(index)
            if held_out.instances[index] in explanation.doubtful and nats <= AMBIGUOUS:
                return index, "it is too small to be proposed unless held-out data bear it out"
            least = -AMBIGUOUS if held_out.instances[index] in doubted else 0.0
            if work > AT_WORK and nats <= least and held_out.is_smaller_with(index):
                # Noise spreads what data that hold it say for it, its work on average, by the root of twice that.
                least = min(work - SHORT_OF * math.sqrt(2.0 * work), least)
            if work > AT_WORK and nats <= least:
                found.append((nats, index))
        return (min(found)[1], "the error is no smaller with it") if found else None

    def _instead(
        self, explanation: Explanation, held_out: HeldOut, index: int, refused: Collection[Instance]
    ) -> tuple[Explanation, LadderFinding, str] | None:
        """The explanation with another effect in the place of one that held-out data contradict, where they bear that out.

        Two that the fitted recordings cannot tell apart others may: frictions at one speed, borders of a patch that few wheels
        crossed. None where none helps as clearly as fitted ones may speak against it, or something else would be left there.
        """
        own, search = held_out.instances[index], explanation.search
        nats, work = held_out.help_of(index)
        if self.other is None or work < AT_WORK or own in self.laws.laws:
            return None
        here, laws, label = search.place, self.laws, search.label(own)
        search.contradicted.add(own.term)
        for rival in search.stand_ins(explanation.selection, own):
            instead = self.exchange(explanation, own, rival)
            self.laws = LawModels(instead, refused)
            judged = self._held_out(instead)
            found = [k for k in judged.proposed if judged.instances[k].term == rival.term]
            helps = judged.help_of(found[0])[0] if found else -math.inf
            leaves_more = len(instead.leftovers) > len(explanation.leftovers)
            if helps > BORNE_OUT and not leaves_more and not self._useless(instead, judged):
                named = search.label(judged.instances[found[0]])
                step = LadderFinding(f"exchange {label} for {named}", helps, helps - nats, "borne out held out")
                said = (
                    f"{label} does as well as {named} where it was fitted. Held out {named} helps, and it does not: that is "
                    "proposed, and the errors after it are of data that chose it."
                )
                return instead, step, said
            search.place, self.laws = here, laws
        return None

    def _impossible(self, explanation: Explanation, held_out: HeldOut) -> tuple[int, str] | None:
        """An effect with which the patched robot cannot be, and without which it can; the first if that is none of them."""
        if self._can_be(explanation, held_out, None) or not held_out.proposed:
            return None
        guilty = [index for index in held_out.proposed if self._can_be(explanation, held_out, index)]
        return (guilty or list(held_out.proposed))[0], "no robot can be so"

    def _can_be(self, explanation: Explanation, held_out: HeldOut, without: int | None) -> bool:
        """Whether there is such a robot, by all that was fitted and by every fold of it."""
        problem, numbers = explanation.search.problem, self._numbers(explanation)
        left_out = None if without is None else held_out.instances[without]
        effects = [named.effect for named in explanation.named if named.instance != left_out]
        try:
            self.subject.patched(effects, numbers)
            with also_known(self.laws.effects):
                for mean in held_out.means(without):
                    self._patched(problem, held_out, mean, numbers, without)
        except PcwError:
            return False
        return True

    def _misleading(
        self, explanation: Explanation, held_out: HeldOut, after: FloatArray | None
    ) -> tuple[int, str] | None:
        """An effect with which the simulation follows less well than without, the numbers re-tuned to either or left alone.

        Numbers that are re-tuned beside an effect may lead a simulation astray that the effect alone does not.
        """
        harms = self._harms(explanation, held_out, after)
        if not self.untuned and max(harms.values(), default=0.0) > 0.0:
            self.untuned = _names(explanation)
            alone = self._harms(explanation, held_out, self._rollout(explanation, held_out))
            self.untuned = frozenset()
            harms = {index: min(harm, alone.get(index, harm)) for index, harm in harms.items()}
        index = max(harms, key=lambda k: harms[k], default=0)
        return (index, "the simulation follows less well with it") if harms.get(index, 0.0) > 0.0 else None

    def _harms(self, explanation: Explanation, held_out: HeldOut, after: FloatArray | None) -> dict[int, float]:
        """By how much less well, for sure, the simulation follows with each effect that it can tell of; above 0: worse."""
        windows = self._quiet_windows(explanation)
        moving = [k for k in held_out.proposed if self._simulation_tells(explanation, held_out.instances[k])]
        if windows is None or self.before is None or after is None or not moving:
            return {}

        # One horizon alone may be met by chance: what errors of two kinds cancel after half a second they do not after two.
        harms, everywhere = {}, range(len(HORIZONS))
        floors: dict[int | None, FloatArray] = {}
        for index in moving:
            without = self._rollout(explanation, held_out, index)
            if without is None:
                continue
            # Where a simulation ran away it says nothing for or against an effect.
            away = _ran_away(windows, without) | _ran_away(windows, after)
            if np.sum(~away) < LEAST_WINDOWS:
                continue
            before, with_it = (np.where(away[:, None, None], np.nan, squares) for squares in (without, after))
            errors = _rollout_errors(windows, before, with_it, self.rng, everywhere).pooled()
            nominal = np.where(away[:, None, None], np.nan, self.before)
            described = _rollout_errors(windows, nominal, nominal, self.rng, everywhere).pooled()
            added = float(errors.after[0] - errors.before[0])
            telling = added > TELLING_PART**2 * float(described.before[0])
            harms[index] = float(errors.worse()[0]) if telling else 0.0
            if harms[index] > 0.0:
                # On softer tyres the noise of a start does more: what is no more than that is not the effect's fault.
                for one in {index, None} - floors.keys():
                    floors[one] = self._rollout_noise(explanation, held_out, one)
                noise = floors[index], floors[None]
                beyond = _rollout_errors(windows, before, with_it, self.rng, everywhere, noise).pooled()
                harms[index] = float(beyond.worse()[0])
        return harms

    def _rollout_noise(self, explanation: Explanation, held_out: HeldOut, without: int | None) -> FloatArray:
        """Mean squared relative errors (H, S) that noise alone makes in the patched description, or without one effect."""
        windows, mean = self._quiet_windows(explanation), held_out.means(without).mean(axis=0)
        assert windows is not None
        with also_known(self.laws.effects):
            model = self._patched(explanation.search.problem, held_out, mean, self._numbers(explanation), without)
            right = model if self._is_patched(explanation) else self.subject
            squares = windows.relative(right.rollout_floor(windows, self.rng))
        noise: FloatArray = np.nansum(squares, axis=0) / np.maximum(np.isfinite(squares).sum(axis=0), 1)
        return noise

    def _no_better(self, explanation: Explanation, held_out: HeldOut) -> tuple[int, str] | None:
        """The effect that helps least, where the description alone is followed better than the patch with all of them.

        Each may help beside the others and numbers far off that it makes up for; what is proposed has to do so by itself.
        """
        if not self._is_patched(explanation) or not held_out.proposed:
            return None
        patched = self._error(explanation, held_out, self._prediction(held_out))
        alone = self._error(explanation, held_out, _of_description(held_out.problem))
        if patched <= (1.0 + ALLOWED_HARM) ** 2 * alone:
            return None
        return min(held_out.proposed, key=lambda index: held_out.help_of(index)[0]), "the description alone does better"

    def _simulation_tells(self, explanation: Explanation, instance: Instance) -> bool:
        if instance in self.laws.laws:
            return instance not in self.laws.without_kernel
        return moves_the_robot(explanation.search.problem.terms[instance.term].effect)

    def _rollout(self, explanation: Explanation, held_out: HeldOut, without: int | None = None) -> FloatArray | None:
        """Squared errors (W, H, S) of the patched description, each window by the patch of its own fold; None for no robot."""
        if self.windows is None or self.before is None:
            return None
        if not self._is_patched(explanation):
            return self.before
        # Numbers re-tuned beside an effect, or an effect beside another, may make no robot alone.
        if not self._can_be(explanation, held_out, without):
            return None
        windows, fold = self.windows, _fold_of(held_out, self.windows)
        after = np.full_like(self.before, np.nan)
        problem, retuned = explanation.search.problem, self._numbers(explanation)

        def simulated(number: int) -> FloatArray:
            model = self._patched(problem, held_out, means[number], retuned, without)
            return model.rollout(windows.take(fold == number))

        numbers, means = np.unique(fold).tolist(), held_out.means(without)
        with also_known(self.laws.effects):
            for number, squares in zip(numbers, on_all_cores(simulated, numbers), strict=True):
                after[fold == number] = squares
        return after

    def _patched(
        self,
        problem: RegressionProblem,
        held_out: HeldOut,
        mean: FloatArray,
        retuned: Mapping[str, float],
        without: int | None,
    ) -> Subject:
        """The description with the effects, laws and numbers of one fold, for a simulator that knows the laws."""
        effects = []
        changes = dict(zip((n.name for n in problem.nuisances), mean.tolist(), strict=False))
        acting = acting_part(problem, held_out.instances, mean)
        for index in held_out.proposed:
            if index == without:
                continue
            instance = held_out.instances[index]
            values = mean[slice(*held_out.span(index))].copy()
            values *= acting if is_reported(problem.terms[instance.term]) else 1.0
            if instance in self.laws.laws:
                law = self.laws.simulated(instance, values)
                effects += [law] if law is not None else []
                continue
            term = problem.terms[instance.term]
            parameters = [term.parameters[k] for k in instance.active]
            found = {
                p.name: p.value(float(value) + changes.get(p.number, 0.0))
                for p, value in zip(parameters, values, strict=True)
                if not p.hidden
            }
            effects.append(effect_instance(term.effect, term.target, dict(instance.shape) | found, term.axis))
        # In place of an effect no number is stretched further than that of a healthy robot.
        widest = np.inf if without is None else HEALTHY
        numbers = {
            n.name: n.nominal + float(np.clip(change, -widest * n.deviation, widest * n.deviation))
            for n, change in zip(problem.nuisances, mean, strict=False)
            if n.name in retuned
        }
        return self.subject.patched(effects, numbers)

    # -- what is said -----------------------------------------------------------------------------------------------

    def _remarks(self, explanation: Explanation, held_out: HeldOut, after: FloatArray | None) -> list[str]:
        remarks = []
        if self.unusable:
            remarks.append(
                f"What was given to hold out has less than {LEAST_DURATION:g} s of usable motion and proves nothing: "
                "manoeuvres of the fitted recordings are held out instead."
            )
        for index in held_out.proposed:
            if held_out.help_of(index)[1] <= AT_WORK:
                label = explanation.search.label(held_out.instances[index])
                remarks.append(f"{label} was not at work in what was held out: nothing there speaks for it or against it.")
        at_work = {held_out.instances[index] for index in held_out.proposed}
        for named in explanation.named:
            if is_event(named.term.effect):
                label = explanation.search.label(named.instance)
                once = "comes once, from outside: the time in which it acts is left out of the proof"
                again = "comes at the same time in what was held out"
                remarks.append(f"{label} {again if named.instance in at_work else once}.")
        for instance, reason in self.laws.without_kernel.items():
            remarks.append(f"The simulation is without {explanation.search.label(instance)}: {reason}.")
        if self.windows is not None and after is not None:
            away = _ran_away(self.windows, after)
            if away.any():
                share = f"{away.sum()} of {len(away)}"
                remarks.append(f"Driven by the measured torques the simulation ran away in {share} windows.")
        return remarks

    def _finding(
        self, explanation: Explanation, held_out: HeldOut, predicted: FloatArray, after: FloatArray | None
    ) -> FitFinding:
        problem = held_out.problem
        spread = _spread(problem)
        blank = np.where(problem.valid, 1.0, np.nan)
        before, left = ((values * blank / spread) ** 2 for values in (problem.nominal_residual, problem.residual - predicted))
        inverse = PairedErrors.of(before, left, blocks_of(problem.recording, problem.time), self.rng)
        floors = _floors(explanation, problem) / spread
        judged = inverse.judged
        # The gap is measured in noise floors: of channels with different noise, those that an effect departs from tell most.
        relative = PairedErrors.of(
            before / floors**2, left / floors**2, blocks_of(problem.recording, problem.time), self.rng
        ).pooled()
        weights = _shares(explanation, problem)
        pooled = inverse.pooled(weights)
        floor = float(np.sqrt(np.average(floors[judged] ** 2, weights=weights[judged]))) if len(judged) else 0.0
        looked_at = len(judged) + len(np.unique(problem.recording))
        looked_at += 0 if self.windows is None else len(self.windows.signals) * len(HORIZONS)
        grown = inverse.worse(floors**2, looked_at)
        worse = {problem.channels[k].name: float(grown[k]) for k in judged}
        for recording in np.unique(problem.recording):
            rows = problem.recording == recording
            block = blocks_of(problem.recording[rows], problem.time[rows])
            own = PairedErrors.of(before[rows], left[rows], block, self.rng).pooled()
            worse[f"recording {recording + 1}"] = float(own.worse(among=looked_at)[0])
        rollouts, rollout_gap = self._rollout_findings(explanation, held_out, after, worse, looked_at)
        at = max(worse, key=lambda name: worse[name], default=None)
        harm = worse[at] if at is not None else 0.0
        main = [entry for entry in rollouts if entry.horizon == HORIZONS[MAIN_HORIZON]]
        closed = gap_closed(np.sqrt(relative.before), np.sqrt(relative.after), 1.0)
        draws = gap_closed(np.sqrt(relative.before_draws), np.sqrt(relative.after_draws), 1.0)
        return FitFinding(
            source=held_out.source,
            inverse_nrmse=(float(np.sqrt(pooled.before[0])), float(np.sqrt(pooled.after[0]))),
            rollout={entry.signal: (entry.before, entry.after) for entry in main},
            gap_closed=float(closed[0]),
            gap_closed_ci95=interval(draws[:, 0]),
            inverse_ci95=(interval(np.sqrt(pooled.before_draws[:, 0])), interval(np.sqrt(pooled.after_draws[:, 0]))),
            inverse_floor=floor,
            channels=tuple(
                ChannelProof(problem.channels[k].name, float(floors[k]), *_both(inverse, k), share=float(weights[k]))
                for k in judged
            ),
            rollouts=rollouts,
            rollout_gap_closed=rollout_gap,
            harm=harm,
            harm_at=at if harm > 0.0 else None,
        )

    def _rollout_findings(
        self, explanation: Explanation, held_out: HeldOut, after: FloatArray | None, worse: dict[str, float], looked_at: int
    ) -> tuple[tuple[RolloutProof, ...], float | None]:
        """Errors by signal and horizon, and the part of the gap that is closed at the main horizon; adds to `worse`.

        Args:
            looked_at: quantities of which the one that got worst is told.
        """
        windows = self._quiet_windows(explanation)
        if windows is None or self.before is None or after is None:
            return (), None
        floors = self._rollout_noise(explanation, held_out, None)
        found, gap = [], None
        for h, horizon in enumerate(HORIZONS):
            errors = _rollout_errors(windows, self.before, after, self.rng, [h])
            grown = errors.worse(floors[h], looked_at)  # what noise alone does to a simulation is no harm
            for k in errors.judged:
                signal = windows.signals[k]
                found.append(RolloutProof(signal, horizon, float(np.sqrt(floors[h, k])), *_both(errors, k)))
                worse[f"{signal} after {horizon:g} s"] = float(grown[k])
            if h == MAIN_HORIZON and len(errors.judged):
                pooled, floor = errors.pooled(), float(np.sqrt(np.mean(floors[h, errors.judged])))
                first, last = float(np.sqrt(pooled.before[0])), float(np.sqrt(pooled.after[0]))
                if pooled.better()[0]:
                    # Shaking that is real looks like noise of the sensors: no noise does more than a patch leaves.
                    floor = min(floor, last)
                gap = float(gap_closed(np.array(first), np.array(last), floor)) if first > floor else None
        return tuple(found), gap


def _times_floor(explanation: Explanation, refused: Collection[Instance]) -> float:
    """Largest error of a channel in its floors, without the laws that were refused."""
    problem, regression = explanation.search.problem, explanation.selection.regression
    kept = [instance for instance in explanation.selection.fit.instances if instance not in refused]
    left = np.where(problem.valid, regression.unwhitened_residual(regression.fit(kept)), 0.0)
    sizes = np.sqrt(np.sum(left**2, axis=0) / np.maximum(problem.valid.sum(axis=0), 1))
    return float(np.max(sizes / _floors(explanation, problem)))


def _floors(explanation: Explanation, problem: RegressionProblem) -> FloatArray:
    """Error of every channel (C,) that noise, and what the model itself misjudges, leave in any case."""
    floors = np.maximum(explanation.floor, 1e-300)
    if problem.misjudged is None:
        return floors
    squares = np.where(problem.valid, problem.misjudged**2, 0.0).sum(axis=0) / np.maximum(problem.valid.sum(axis=0), 1)
    result: FloatArray = np.hypot(floors, np.sqrt(squares))
    return result


def _of_description(problem: RegressionProblem) -> FloatArray:
    """What is taken of the residual (T, C) where nothing is patched."""
    return problem.residual - problem.nominal_residual


def _predicted_without(held_out: HeldOut, left_out: Collection[str]) -> FloatArray:
    """What the fits take of the residual (T, C), some numbers of the description by name as it states them."""
    means = held_out.means().copy()
    stays = [number.name in left_out for number in held_out.problem.nuisances]
    means[:, : held_out.nuisances][:, stays] = 0.0
    return held_out.predicted(means)


def _keys(explanation: Explanation) -> set[str]:
    """Keys of all terms that an explanation holds, or is exact with."""
    problem = explanation.search.problem
    held = {instance.term for instance in explanation.selection.fit.instances} | set(problem.near)
    if problem.point is not None:
        held |= {size.term for size in problem.point.sizes}
    return {problem.terms[index].key for index in held if index < len(problem.terms)}


def _names(explanation: Explanation) -> frozenset[str]:
    """Names of all numbers of the description that may be re-tuned."""
    return frozenset(number.name for number in explanation.search.problem.nuisances)


def _shares(explanation: Explanation, problem: RegressionProblem) -> FloatArray:
    """Weights of the channels (C,): how much of what they leave in any case is noise, and not the model's own."""
    shares: FloatArray = (np.maximum(explanation.floor, 1e-300) / _floors(explanation, problem)) ** 2
    return shares


def with_channels(finding: FitFinding, more: Sequence[ChannelProof]) -> FitFinding:
    """Return the finding with further channels in its errors and in the gap that is closed."""
    if not more:
        return finding
    channels = (*finding.channels, *more)

    share = [c.share for c in channels]

    def together(values: Sequence[float], weights: Sequence[float] | None = None) -> float:
        return float(np.sqrt(np.average(np.square(values), weights=weights)))

    before, after, floor = (together([getattr(c, name) for c in channels], share) for name in ("before", "after", "floor"))
    finite = [c for c in channels if math.isfinite(c.floor)]
    first, last = (
        together([getattr(c, name) / max(c.floor, 1e-300) for c in finite]) for name in ("before", "after")
    )
    worst = max(more, key=lambda c: c.after / max(c.before, 1e-300))
    grown = worst.after / max(worst.before, 1e-300) - 1.0 if worst.after_ci95[0] > worst.before_ci95[1] else 0.0
    return dataclasses.replace(
        finding,
        inverse_nrmse=(before, after),
        inverse_floor=floor,
        gap_closed=float(gap_closed(np.array(first), np.array(last), 1.0)),
        channels=channels,
        harm=max(finding.harm, grown),
        harm_at=worst.name if grown > finding.harm else finding.harm_at,
    )


def _tells(held_out: HeldOut, index: int) -> bool:
    """Whether an effect is at work in what was held out, and the error there is smaller with it.

    What comes once is at work in one manoeuvre: that manoeuvres disagree about it says nothing for it.
    """
    return held_out.help_of(index)[1] > AT_WORK and held_out.is_smaller_with(index)


def _busy(explanation: Explanation) -> np.ndarray:
    """Samples (T,) of the fitted problem at which an event is at work."""
    busy = np.zeros(len(explanation.search.problem.time), dtype=bool)
    for named in explanation.named:
        if is_event(named.term.effect):
            busy |= np.any(np.abs(named.contribution) > EVENT_SHARE * explanation.floor, axis=1)
    return busy


def _spread(problem: RegressionProblem) -> FloatArray:
    """Standard deviation of the measured side of every channel (C,)."""
    spread = np.ones(len(problem.channels))
    for c in range(len(spread)):
        values = problem.measured[problem.valid[:, c], c]
        if len(values):
            spread[c] = max(float(np.std(values)), 1e-300)
    return spread


def _both(errors: PairedErrors, k: int) -> tuple[float, float, tuple[float, float], tuple[float, float]]:
    """Root mean square before and after of quantity k, and their intervals."""
    return (
        float(np.sqrt(errors.before[k])),
        float(np.sqrt(errors.after[k])),
        interval(np.sqrt(errors.before_draws[:, k])),
        interval(np.sqrt(errors.after_draws[:, k])),
    )


def _ran_away(windows: Windows, squares: FloatArray) -> np.ndarray:
    """Windows (W,) in which a simulation left all bounds by the main horizon."""
    ran_away: np.ndarray = np.any(windows.relative(squares)[:, MAIN_HORIZON] >= RAN_AWAY**2, axis=1)
    return ran_away


def _rollout_errors(
    windows: Windows,
    before: FloatArray,
    after: FloatArray,
    rng: np.random.Generator,
    horizons: Sequence[int],
    noise: tuple[FloatArray, FloatArray] | None = None,
) -> PairedErrors:
    """Errors of all signals at some horizons, side by side, beyond what noise (H, S) makes in either."""
    sides = []
    nothing = np.zeros(before.shape[1:])
    for squares, known in zip((before, after), noise or (nothing, nothing), strict=True):
        sides.append((windows.relative(squares) - known)[:, horizons].reshape(len(windows.begin), -1))
    return PairedErrors.of(sides[0], sides[1], blocks_of(windows.recording, windows.begin), rng)


def _fold_of(held_out: HeldOut, windows: Windows) -> IntArray:
    """Fold of every window (W,): that of the sample with which it begins."""
    fold = np.zeros(len(windows.begin), dtype=np.int64)
    problem = held_out.problem
    for recording in np.unique(windows.recording):
        own, rows = windows.recording == recording, np.flatnonzero(problem.recording == recording)
        if len(rows):
            at = np.searchsorted(problem.time[rows], windows.begin[own]).clip(0, len(rows) - 1)
            fold[own] = held_out.fold[rows[at]]
    return fold
