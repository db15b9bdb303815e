"""Sets of effects by evidence, step by step: which effect to add, to drop, to exchange for another, to split in two.

Every step refits everything jointly, and asks for evidence in which each further parameter has to pay for itself.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence

import numpy as np

from ..regression.noise_model import channel_deviations
from ..regression.regression_problem import RegressionProblem, contiguous_blocks
from ..regression.whitened_regression import Candidate, Fit, Instance, WhitenedRegression
from .exact_problem import ExactProblem
from .gathered_terms import gatherings
from .selection_settings import SelectionSettings
from .shape_search import refined_shape

Progress = Callable[[str], None]
SPLIT_AMONG = 12  # candidates that a term may have taken in
GATHERED_AMONG = 2  # candidates that several terms may be parts of
# So many times the noise is estimated again, until no channel's falls by more than this.
SETTLING_ROUNDS, SETTLED = 8, 0.9


@dataclasses.dataclass(frozen=True)
class LadderStep:
    """One line of the report's ladder: what was tried, what it gained, what became of it; and what it was, if refused."""

    description: str
    gain: float
    held_out_gain: float | None
    outcome: str
    refused: Instance | None = None


class SetGrowth(ExactProblem):
    """The steps from set to set on one problem; each is told to `progress` and noted on the `ladder`."""

    def __init__(
        self, problem: RegressionProblem, settings: SelectionSettings | None = None, progress: Progress = lambda message: None
    ) -> None:
        """Take a problem that is exact at the description."""
        self.settings = settings or SelectionSettings()
        super().__init__(problem, contiguous_blocks(problem.segment, self.settings.blocks))
        self.progress = progress
        self.ladder: list[LadderStep] = []

    def over_complete(self, instances: tuple[Instance, ...] = ()) -> tuple[Instance, ...]:
        """A set that explains more than there is, by plain least squares: what it leaves is the first idea of the noise.

        Every residual that still holds a large effect looks like strong slow noise, under which nothing could be found.

        Args:
            instances: to begin with.
        """
        regression = self.whiten_at(self.problem.residual, white=True, by_channel=True)
        settled = False
        while len(instances) < self.settings.largest_set:
            step = self.best_addition(regression, instances)
            if step is None or step.gain < self.settings.lenient_gain:
                if settled:
                    break
                # Only now: the shapes of a grid fit no signal that stands far above its noise.
                self._settle(regression, instances)
                settled = True
                continue
            if sum(i.term == step.instance.term for i in instances) >= self.settings.first_repeats:
                break
            instances = (*instances, refined_shape(regression, instances, step.instance))
            instances = self.improve(regression, instances)
            left = regression.unwhitened_residual(regression.fit(instances))
            regression.rescale(channel_deviations(left, self.problem.valid))
        return instances

    def _settle(self, regression: WhitenedRegression, instances: tuple[Instance, ...]) -> None:
        """Take for noise what a set and the tolerances leave, which is less the less noise is taken for granted.

        Else many numbers, each well within its tolerance, would do for one effect: little as they explain, it would be enough.
        """
        deviations = regression.noise.taps[:, 0] ** -1.0
        for _ in range(SETTLING_ROUNDS):
            before = deviations
            deviations = channel_deviations(regression.unwhitened_residual(regression.fit(instances)), self.problem.valid)
            regression.rescale(deviations)
            if np.all(deviations > SETTLED * before):
                break

    def thin(self, regression: WhitenedRegression, instances: tuple[Instance, ...]) -> tuple[Instance, ...]:
        """Drop terms as long as that costs less than the lenient gain."""
        while instances:
            fit = regression.fit(instances)
            losses = [
                fit.log_evidence - regression.fit(instances[:i] + instances[i + 1 :]).log_evidence
                for i in range(len(instances))
            ]
            index = int(np.argmin(losses))
            if losses[index] >= self.settings.lenient_gain and regression.within_bounds(fit):
                break
            instances = instances[:index] + instances[index + 1 :]
        return instances

    def grow(
        self, regression: WhitenedRegression, instances: tuple[Instance, ...], least_gain: float, settling: bool = False
    ) -> tuple[Instance, ...]:
        """Forward selection of all that gains so much, exchanging terms where that helps, unless the set is settling."""
        while len(instances) < self.settings.largest_set:
            step = self.best_addition(regression, instances)
            if step is None or step.gain < least_gain:
                break
            instances = (*instances, refined_shape(regression, instances, step.instance))
            self.progress(f"+ {self.label(instances[-1])}: gain {step.gain:.1f} nats")
            self.ladder.append(LadderStep(f"add {self.label(instances[-1])}", step.gain, None, "tried"))
            if not settling:
                instances = self.improve(regression, instances)
        return instances

    def best_addition(
        self, regression: WhitenedRegression, instances: Sequence[Instance]
    ) -> Candidate | None:
        """The candidate of largest gain with which every parameter of the joint fit stays within its bounds."""
        best: Candidate | None = None
        for candidate in regression.scan(instances)[0][:12]:
            if not math.isfinite(candidate.gain) or (best is not None and candidate.gain < best.gain):
                break
            if self.repeats(candidate.instance, instances):
                continue
            if regression.within_bounds(regression.fit([*instances, candidate.instance])):
                best = candidate
        return best

    def repeats(self, candidate: Instance, instances: Sequence[Instance]) -> bool:
        """Whether a repeatable term is already there with practically the same shape."""
        term = self.problem.terms[candidate.term]
        for instance in instances:
            if instance.term != candidate.term:
                continue
            if not term.repeatable:
                return True
            mine, theirs = dict(candidate.shape), dict(instance.shape)
            if all(
                abs(mine[name] - theirs[name]) < step
                for name, (kind, step) in term.resolution.items()
                if kind == "linear"
            ):
                return True
        return False

    def improve(
        self, regression: WhitenedRegression, instances: tuple[Instance, ...]
    ) -> tuple[Instance, ...]:
        """Exchange a term for another one, or drop it, wherever the evidence of the whole set rises."""
        for _ in range(2 * self.settings.largest_set):
            fit = regression.fit(instances)
            change = self.best_exchange(regression, instances, fit)
            if change is None:
                break
            description, instances = change
            self.progress(description)
            self.ladder.append(
                LadderStep(
                    description, regression.fit(instances).log_evidence - fit.log_evidence, None, "done"
                )
            )
        return instances

    def best_exchange(
        self, regression: WhitenedRegression, instances: tuple[Instance, ...], fit: Fit
    ) -> tuple[str, tuple[Instance, ...]] | None:
        """The first exchange or removal that raises the evidence by more than half a nat, if any."""
        for others, wider in gatherings(self.problem, instances):
            for candidate in regression.scan(others, only=wider)[0][:GATHERED_AMONG]:
                gathered = (*others, refined_shape(regression, others, candidate.instance))
                trial = regression.fit(gathered)
                if trial.log_evidence > fit.log_evidence + 0.5 and regression.within_bounds(trial):
                    return f"gather into {self.label(gathered[-1])}", gathered
        for index, instance in enumerate(instances):
            others = instances[:index] + instances[index + 1 :]
            without = regression.fit(others)
            if without.log_evidence > fit.log_evidence and regression.within_bounds(without):
                return f"drop {self.label(instance)}", others
            for candidate in regression.scan(others)[0][:3]:
                other_shape = candidate.instance.term != instance.term
                if not other_shape or without.log_evidence + candidate.gain < fit.log_evidence + 0.5:
                    continue
                if self.repeats(candidate.instance, others):
                    continue
                refined = refined_shape(regression, others, candidate.instance)
                trial = regression.fit([*others, refined])
                if trial.log_evidence > fit.log_evidence + 0.5 and regression.within_bounds(trial):
                    return f"exchange {self.label(instance)} for {self.label(refined)}", (*others, refined)
            reshaped = self.best_split(regression, others, instance, fit)
            if reshaped is not None:
                return reshaped
        return None

    def best_split(
        self, regression: WhitenedRegression, others: tuple[Instance, ...], instance: Instance, fit: Fit
    ) -> tuple[str, tuple[Instance, ...]] | None:
        """Whether an instance stands for two causes: another shape of it together with one more term.

        A single step cannot find this. A wide Stribeck curve passes for Coulomb plus a narrow one, and at its width
        adding Coulomb friction gains nothing.
        """
        own = self.problem.terms[instance.term]
        if len(own.shapes) < 2 or own.once or own.turning:  # places, times and phases do not widen to take in another cause
            return None
        for candidate in regression.scan(others)[0][:SPLIT_AMONG]:
            term = self.problem.terms[candidate.instance.term]
            if (
                candidate.instance.term == instance.term
                or term.repeatable
                or not math.isfinite(candidate.gain)
            ):
                continue
            again = regression.scan([*others, candidate.instance], only=[instance.term])[0]
            if not again or not math.isfinite(again[0].gain):
                continue
            split = (
                *others,
                candidate.instance,
                refined_shape(regression, [*others, candidate.instance], again[0].instance),
            )
            trial = regression.fit(split)
            if (
                trial.log_evidence > fit.log_evidence + self.settings.lenient_gain
                and regression.within_bounds(trial)
            ):
                return (
                    f"split {self.label(instance)} into {self.label(split[-2])} and {self.label(split[-1])}",
                    split,
                )
        return None

    def label(self, instance: Instance) -> str:
        """Effect, target and shape in one short text."""
        term = self.problem.terms[instance.term]
        shape = ", ".join(f"{name} {value:.4g}" for name, value in instance.shape if name in term.resolution)
        return f"{term.key} ({shape})" if shape else term.key
