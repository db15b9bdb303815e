"""What an effect has to do for a recording to be named: the gates that a set of effects passes one by one, and together."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from ..regression.noise_model import channel_deviations, seen_misjudged
from ..regression.regression_problem import BoolArray, FloatArray, RegressionProblem
from ..regression.whitened_regression import Fit, Instance, WhitenedRegression, predicted
from .selection_settings import SelectionSettings

# What happens once must explain so many times what is left anywhere: models err in bursts, and some shape fits one of them.
ABOVE_BURSTS = 3.0
# By so much more must effects stand out whose columns hold noise that the residual holds; and by so much more again where they
# are on all casters alike: what gears that wind up do to all wheels at once, a chassis that pitches on its springs does, too.
NOISY_FACTOR, COMMON_FACTOR = 3.0, 2.0
# What tyres are re-tuned by counts so little for an effect beside which they are not: what the model misjudges of slips does
# the same to them.
LOOSE_PART = 0.2
# Such an effect must do this part of what remains in some channel, and all of it where it is on all casters, as noise is.
NOISY_PART = 0.75
# What is named has to do more to slips than this part of what the model may misjudge of them, however well it foretells them:
# by a tenth of them loads differ from one lap to the next.
LEAST_DOUBT = 1.0 / 3.0


@dataclasses.dataclass(frozen=True)
class _Left:
    """What a fit leaves: of these sizes (C,); `misjudged` by the model (T, C), None: nothing is."""

    sizes: FloatArray
    misjudged: FloatArray | None


class EffectGates:
    """The gates of one problem."""

    def __init__(self, problem: RegressionProblem, settings: SelectionSettings) -> None:
        """Take the problem as it is exact now."""
        self.problem, self.settings = problem, settings

    def judge(
        self, regression: WhitenedRegression, instances: tuple[Instance, ...], fit: Fit
    ) -> tuple[list[float], list[float], list[float]]:
        """Per instance: evidence lost without it, held-out gain [nats], contribution against the smallest that counts."""
        if not instances:
            return [], [], []
        residual = regression.unwhitened_residual(fit)
        left = self._left(residual)
        remains = left.sizes
        # Outliers in full: weights that hold them down would hold down the very bursts that an event is measured against.
        trust = np.array([channel.information for channel in self.problem.channels])
        if left.misjudged is not None:
            trust = trust / (1.0 + (left.misjudged / remains) ** 2)
        white = regression.noise.whiten(residual, self.problem.valid, self.problem.segment)
        unexplained = np.sum(trust * white**2, axis=1)
        full_scores = regression.block_scores(instances)
        losses, held_out = [], []
        own: list[FloatArray] = []
        net: list[FloatArray] = []
        changes: list[FloatArray] = []
        retunings, bursts = [], []
        explained = predicted(self.problem, fit)
        for index, instance in enumerate(instances):
            others = instances[:index] + instances[index + 1 :]
            without = regression.fit(others)
            losses.append(fit.log_evidence - without.log_evidence)
            # Held-out error alone would not mind a mass far outside its tolerance; the description would.
            retuning = regression.tolerance_cost(without) - regression.tolerance_cost(fit)
            once = self.problem.terms[instance.term].once
            support = losses[-1] if once else 0.5 * float(np.sum(regression.block_scores(others) - full_scores))
            held_out.append(support + retuning)
            part = self._contribution(fit, index)
            own.append(self._sizes(part))
            # What a term does for the prediction is what the others cannot do in its place.
            change = explained - predicted(self.problem, without)
            changes.append(change)
            net.append(self._sizes(change, _at_work(part) if once else None))
            bursts.append(0.5 * self._largest_burst(unexplained, _at_work(part)) if once else 0.0)
            firm = regression.tolerance_cost(without, firm=True) - regression.tolerance_cost(fit, firm=True)
            retunings.append(firm + LOOSE_PART * (retuning - firm))
        total = np.sqrt(np.sum(np.square(own), axis=0))
        shares = []
        for index, (instance, sizes) in enumerate(zip(instances, net, strict=True)):
            share = self._share(regression, [instance], changes[index], sizes, left, self.settings.smallest_part * total)
            # A term may do nothing for the prediction and yet be needed: without it the description would be far off.
            needed = retunings[index] / (self.settings.smallest_threshold * self._noise_factor([instance]))
            if self.problem.terms[instance.term].noisy:  # by numbers that the same noise pulls at
                beside = sizes / np.maximum(self._least(instance) * remains, 1e-300)
                alone = own[index] / np.maximum(np.maximum(NOISY_FACTOR * remains, self._details([instance], left)), 1e-300)
                needed = min(needed, float(np.max(np.maximum(beside, alone))))
            share = max(share, needed)
            shares.append(min(share, losses[index] / max(ABOVE_BURSTS * bursts[index], 1e-300)))
        return losses, held_out, shares

    def _left(self, residual: FloatArray) -> _Left:
        sizes = channel_deviations(residual, self.problem.valid)
        return _Left(sizes, seen_misjudged(self.problem, residual, LEAST_DOUBT))

    def _largest_burst(self, unexplained: FloatArray, at_work: BoolArray) -> float:
        """Most that is left unexplained (T,), beyond what noise leaves, anywhere in a time as long as one at work (T,)."""
        excess = unexplained - self.problem.valid.sum(axis=1) * float(np.sum(unexplained) / max(self.problem.valid.sum(), 1))
        length = max(int(np.sum(at_work)), 1)  # a patch may lie where nobody came
        sums = np.cumsum(np.concatenate([[0.0], np.where(at_work, 0.0, excess)]))
        return float(np.max(sums[length:] - sums[:-length], initial=0.0))

    def _sizes(self, values: FloatArray, among: BoolArray | None = None) -> FloatArray:
        """Root mean square of (T, C) over valid samples, per channel; `among` some samples (T,) only."""
        valid = self.problem.valid if among is None else self.problem.valid & among[:, None]
        counts = np.maximum(valid.sum(axis=0), 1)
        sizes: FloatArray = np.sqrt(np.sum(np.where(valid, values, 0.0) ** 2, axis=0) / counts)
        return sizes

    def refinement_counts(self, regression: WhitenedRegression, fit: Fit, position: int, refined: Fit) -> bool:
        """Whether what an instance, at a position among those of a fit, does otherwise where it is refined is worth a name."""
        left = self._left(regression.unwhitened_residual(refined))
        change = predicted(self.problem, refined) - predicted(self.problem, fit)
        part = self.settings.smallest_part * self._sizes(self._contribution(refined, position))
        return self._share(regression, [fit.instances[position]], change, self._sizes(change), left, part) >= 1.0

    def _contribution(self, fit: Fit, position: int) -> FloatArray:
        """What one instance of a fit adds to the residual (T, C)."""
        instance = fit.instances[position]
        first = len(self.problem.nuisances) + sum(len(other.active) for other in fit.instances[:position])
        columns = self.problem.columns(instance.term, instance.shape)[..., list(instance.active)]
        contribution: FloatArray = columns @ fit.mean[first : first + len(instance.active)]
        return contribution

    def needed_together(
        self, regression: WhitenedRegression, instances: tuple[Instance, ...], fit: Fit
    ) -> tuple[Instance, ...]:
        """The fewest of the terms, taken as each does most, beside which all others together do too little to count.

        A payload and stronger motors undo each other: without either the other is far off, without both little is.
        """
        order: list[Instance] = []
        while len(order) < len(instances) - 1:
            rest = [instance for instance in instances if instance not in order]
            order.append(max(rest, key=lambda instance: regression.fit([*order, instance]).log_evidence))
        left = self._left(regression.unwhitened_residual(fit))
        explained, cost = predicted(self.problem, fit), regression.tolerance_cost(fit)
        for count in range(len(instances) - 1):
            left_out = [instance for instance in instances if instance not in order[:count]]
            without = regression.fit(order[:count])
            change = explained - predicted(self.problem, without)
            share = self._share(regression, left_out, change, self._sizes(change), left, np.zeros_like(left.sizes))
            retuning = regression.tolerance_cost(without) - cost
            if max(share, retuning / (len(left_out) * self.settings.smallest_threshold)) < 1.0:
                return tuple(instance for instance in instances if instance in order[:count])
        return instances

    def _share(
        self,
        regression: WhitenedRegression,
        instances: Sequence[Instance],
        change: FloatArray,
        sizes: FloatArray,
        left: _Left,
        part: FloatArray,
    ) -> float:
        """Contribution of some instances, a change (T, C) of sizes (C,), against the smallest that counts.

        That is what the model itself misjudges, unless the change does not look like it; and in any case a part of what is
        left, and `part` (C,).
        """
        least = max(self._least(instance) for instance in instances)
        floor = np.maximum(np.maximum(least * left.sizes, part), self._details(instances, left))
        share = float(np.max(sizes / np.maximum(floor, 1e-300)))
        seen = float(np.max(sizes / np.maximum(np.maximum(self.settings.smallest_share * left.sizes, part), 1e-300)))
        if share >= 1.0 or seen < 1.0 or self.problem.drifts is None:
            return share
        return max(share, min(seen, regression.peculiar(change) / self._peculiarity(instances)))

    def _peculiarity(self, instances: Sequence[Instance]) -> float:
        """Nats beside the model's own errors from which a contribution is none of them."""
        if all(self._at_joints(instance) for instance in instances):
            return self.settings.least_peculiar_unlike
        terms = [self.problem.terms[instance.term] for instance in instances]
        if all(term.at_joints or term.unlike_errors for term in terms):
            return self.settings.least_peculiar_unlike * self._noise_factor(instances)
        # One gear that winds up does to one wheel what no error of the model does to one alone.
        one_gear = all(term.axis is not None and len(term.target) == 1 for term in terms)
        return self.settings.least_peculiar * (1.0 if one_gear else self._noise_factor(instances))

    def _at_joints(self, instance: Instance) -> bool:
        """Whether an effect of the library adds torques to joints, in proportion to its numbers."""
        return self.problem.terms[instance.term].at_joints

    def _least(self, instance: Instance) -> float:
        """Part of what remains in some channel that a term must do at least.

        Columns with the residual's own noise explain a part of that noise; an effect is more than all of it.
        """
        term = self.problem.terms[instance.term]
        if not term.noisy:
            return self.settings.smallest_share
        return NOISY_PART if len(term.target) < self._most_targets() else 1.0

    def _details(self, instances: Sequence[Instance], left: _Left) -> FloatArray:
        """What the model itself misjudges (C,), which is no effect: two deviations of its scale, and its slips.

        What the wind-up of gears does to slips is like what a torque does to them: it must stand out from that several times.
        """
        scale = 2.0 * self.problem.scale_deviation * self._sizes(self.problem.measured)
        if left.misjudged is None:
            return scale
        return np.maximum(scale, self._noise_factor(instances) * self._sizes(left.misjudged))

    def _noise_factor(self, instances: Sequence[Instance]) -> float:
        """By how much more some instances must stand out because their columns hold noise that the residual holds."""
        noisy = [self.problem.terms[instance.term] for instance in instances if self.problem.terms[instance.term].noisy]
        if not noisy:
            return 1.0
        return NOISY_FACTOR * (COMMON_FACTOR if any(len(term.target) == self._most_targets() > 1 for term in noisy) else 1.0)

    def _most_targets(self) -> int:
        """At how many casters a term is at most: at all of them."""
        return max(len(term.target) for term in self.problem.terms)


def _at_work(part: FloatArray) -> BoolArray:
    """Samples (T,) in which a contribution (T, C) is a fair part of its largest in some channel."""
    largest = np.maximum(np.max(np.abs(part), axis=0), 1e-300)
    at_work: BoolArray = np.any(np.abs(part) > 0.2 * largest, axis=1)
    return at_work
