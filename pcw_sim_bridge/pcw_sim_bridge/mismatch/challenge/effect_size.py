"""How large an effect is in the channels of the analyser: in a run with it, without noise in its sensors.

    size = max over channels of rms(residual - residual by a description that holds it) / noise floor

The noise floor of a channel is the rms of the healthy run's residual after re-tuning within tolerances. Both residuals are of
one run. A run without the effect is another motion as soon as wheels slip a little otherwise, and of two motions all that is
within tolerances is different, too: an effect a thousand times too small to be seen was 27 floors large, a play of two
millionths of a radian 110. Only what no description holds (torques by other joints or by time) is held against the same run
without it. What actuators do to their commands is no motion: see `command_size`.

An effect may be large and yet be no more than re-tuning within tolerances explains. `evidence` says what the run costs more
with the effect than without it, and than the same run against a description that holds it [nats], each re-tuned by itself:

    cost = min over nu of ( sum rho(W (residual - N nu)) + 1/2 |nu / tolerance|^2 ),

exact where the re-tuning comes out. W whitens the noise of the healthy run: channels share the noise of torques and angles,
and what looks like it is no evidence. rho is Huber's loss: where wheels slip hard a little other motion leaves much else.
Each run has its own columns: what two runs differ by is no change of one motion, as soon as the effect moves the robot. On its
other way the model misjudges other things, also with the effect in the description: they are no evidence of it.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from pcw_description.effect_instance import EffectInstance
from pcw_description.effects.kinds import ActuatorEffect
from pcw_description.effects.registry import all_effects
from pcw_description.robot_description import STEER, RobotDescription

from ..errors import MismatchError
from ..regression.noise_model import fit_noise_model, huber_weights
from ..regression.regression_problem import BoolArray, FloatArray, RegressionProblem
from ..robot.robot_channels import RobotProblemBuilder
from .command_size import command_size, shows_in_commands
from .healthy_deviations import tolerated_cost
from .simulated_case import SimulatedRecording, known_while_simulated

EXACT_ROUNDS = 8  # of re-tuning, each exact where the one before came out
STEPS = (1.0, 0.5, 0.2, 0.05)  # parts of the way that are tried
SETTLED = 0.2  # nats; what costs as much as was promised to this is where it was promised
REWEIGHTED = 6  # times, for Huber's loss
# Two runs whose casters are further apart than this are two motions [rad].
TURNED_OTHERWISE = 2.0
# A part of the samples in which an effect does nothing is no part of its region.
REGION_QUANTILES = (0.01, 0.99)


@dataclasses.dataclass(frozen=True)
class EffectSize:
    """How an effect shows.

    Attributes:
        size: see above; channel: the one in which it is largest.
        evidence: see above [nats].
        region: range of every variable where the effect is above the noise floor.
        retuned: how much further the run with it is re-tuned than the run without it, in the units of the analyser's
            `retuned`, by name: what hides it best.
    """

    size: float
    channel: str
    evidence: float
    region: dict[str, tuple[float, float]]
    retuned: dict[str, float]


class HealthyChannels:
    """The channels of a case's healthy runs, and their noise floor."""

    def __init__(
        self,
        nominal: RobotDescription,
        recordings: Sequence[SimulatedRecording],
        quiet: Sequence[SimulatedRecording],
    ) -> None:
        """Take the healthy runs, and the same without noise in their sensors.

        Two noisy runs that differ in nothing but a small number read other counts of their encoders, and differ by that.
        """
        self._nominal, self._recordings = nominal, recordings
        builder = RobotProblemBuilder(nominal, list(recordings))  # type: ignore[arg-type]
        self._cutoff = builder.cutoff
        self.problem = builder.build(with_terms=False)
        self._columns = self.problem.nuisance_columns()
        self._deviations = self.problem.nuisance_deviations()
        self.floor, noise = self._noise_floor()
        self._noise = fit_noise_model(noise, self.problem.valid, self.problem.segment)
        self._quiet = _build(nominal, quiet, self._cutoff)
        self._healthy_cost = self._cost(self._quiet)
        self._headings = [_headings(recording) for recording in quiet]

    def size(self, recordings: Sequence[SimulatedRecording], effects: Sequence[EffectInstance] = ()) -> EffectSize:
        """Return how large effects are that these runs without noise have and the healthy ones have not.

        Raises:
            MismatchError: with it a caster turns round the other way; what then differs is another motion, and no effect.
        """
        problem = self.problem
        for recording, healthy in zip(recordings, self._headings, strict=True):
            headings = _headings(recording)
            length = min(len(headings), len(healthy))
            apart = float(np.abs(headings[:length] - healthy[:length]).max(initial=0.0))
            if apart > TURNED_OTHERWISE:
                raise MismatchError(f"headings apart by {apart:.3g} rad; allowed: {TURNED_OTHERWISE:g} rad, the same motion")
        with_effect = _build(self._nominal, recordings, self._cutoff)
        holding = self._holding(self._nominal, recordings, effects)
        along, change, rows = self._change(with_effect, holding)
        relative = _rms(change, rows) / self.floor
        largest = int(np.argmax(relative))
        (cost, moved), described = self._costs(with_effect, holding)
        _, healthy_moved = self._healthy_cost
        retuned = {n.name: float(v) for n, v in zip(problem.nuisances, moved - healthy_moved, strict=True)}
        if shows_in_commands(effects):
            commanded = command_size(self._nominal, self._recordings, recordings, effects)
            return EffectSize(commanded.size, commanded.channel, commanded.evidence, {}, retuned)
        active = np.any(rows & (np.abs(change) > self.floor), axis=1)
        return EffectSize(
            size=float(relative[largest]),
            channel=problem.channels[largest].name,
            evidence=_evidence(self._nominal, cost - described, effects),
            region=_regions(along, active),
            retuned=retuned,
        )

    def evidence(
        self, nominal: RobotDescription, recordings: Sequence[SimulatedRecording], effects: Sequence[EffectInstance] = ()
    ) -> float:
        """The evidence of effects in these runs against another description [nats], see above."""
        if shows_in_commands(effects):
            return command_size(nominal, self._recordings, recordings, effects).evidence
        holding = self._holding(nominal, recordings, effects)
        (cost, _), described = self._costs(_build(nominal, recordings, self._cutoff), holding)
        return _evidence(nominal, cost - described, effects)

    def _holding(
        self, nominal: RobotDescription, recordings: Sequence[SimulatedRecording], effects: Sequence[EffectInstance]
    ) -> RegressionProblem | None:
        """The same runs against a description that holds the effects; None where none can."""
        with known_while_simulated(effects):
            if not effects or not all(_in_channels(instance) for instance in effects):
                return None
            return _build(dataclasses.replace(nominal, physics=(*nominal.physics, *effects)), recordings, self._cutoff)

    def _costs(
        self, problem: RegressionProblem, holding: RegressionProblem | None
    ) -> tuple[tuple[float, FloatArray], float]:
        """Cost and re-tuning of runs with effects, and what no description explains of them.

        That is the cost of the healthy runs, or of these against a description that holds the effects. Which samples can be
        judged hangs on the description, too: those that only one of them judges are no evidence.
        """
        healthy, _ = self._healthy_cost
        if holding is None:
            return self._cost(problem), healthy
        both = problem.valid & holding.valid
        described, _ = self._cost(dataclasses.replace(holding, valid=both))
        return self._cost(dataclasses.replace(problem, valid=both)), max(healthy, described)

    def _change(
        self, other: RegressionProblem, holding: RegressionProblem | None
    ) -> tuple[RegressionProblem, FloatArray, BoolArray]:
        """What the effect does to the residual (T, C), where that can be judged, and the run along which it does so."""
        if holding is not None:
            return other, other.residual - holding.residual, other.valid & holding.valid
        length = min(len(self.problem.residual), len(other.residual), len(self._quiet.residual))
        change = np.zeros_like(self.problem.residual)
        change[:length] = other.residual[:length] - self._quiet.residual[:length]
        return self.problem, change, self.problem.valid & np.isfinite(change)

    def _cost(self, problem: RegressionProblem) -> tuple[float, FloatArray]:
        """Least cost of a run, see above, reached or promised by first orders, and the re-tuning (K,) that reaches least.

        Steps go where first orders promise the least, as far as the cost itself falls. Where that is not what was promised,
        first orders are taken anew: a relaxation length half as long again is misjudged by those at the description. What
        was promised counts all the same: nobody has proved that no other way leads there, and it makes evidence no larger.
        """
        there, moved = problem, np.zeros(len(self._deviations))
        cost = least = self._cost_at(problem, moved)
        for _ in range(EXACT_ROUNDS):
            wanted = self._least(there)
            promised = self._cost_at(there, wanted)
            least = min(least, promised)
            for part in STEPS:
                tried = moved + part * (wanted - moved)
                exact = there.exact_at({n.name: float(v) for n, v in zip(problem.nuisances, tried, strict=True)}, ())
                reached = self._cost_at(exact, tried)
                if reached < cost:
                    cost, moved, there = reached, tried, exact
                    break
            else:
                if there.point is None or there.point.derived:
                    break
            if abs(cost - promised) < SETTLED:
                break
            there = there.derived()
        return min(cost, least), moved

    def _least(self, problem: RegressionProblem) -> FloatArray:
        """The re-tuning (K,) of least cost by first orders about where a problem is exact."""
        columns = self._noise.whiten(problem.nuisance_columns(), problem.valid, problem.segment)
        scaled = columns.reshape(-1, len(self._deviations)) * self._deviations
        target = self._noise.whiten(problem.residual, problem.valid, problem.segment).ravel()
        weights: FloatArray = np.ones_like(target)
        for _ in range(REWEIGHTED):
            weighted = scaled * weights[:, None]
            solution = np.linalg.solve(weighted.T @ scaled + np.eye(scaled.shape[1]), weighted.T @ target)
            weights = huber_weights(target - scaled @ solution)
        moved: FloatArray = self._deviations * solution
        return moved

    def _cost_at(self, problem: RegressionProblem, moved: FloatArray) -> float:
        """The cost of a re-tuning (K,): exactly where the problem is exact there, elsewhere by first orders."""
        rest = problem.residual - problem.nuisance_columns() @ moved
        left = self._noise.whiten(rest, problem.valid, problem.segment).ravel()
        weights = huber_weights(left)
        return float(np.sum(weights * left**2 * (1.0 - 0.5 * weights)) + 0.5 * np.sum((moved / self._deviations) ** 2))

    def _noise_floor(self) -> tuple[FloatArray, FloatArray]:
        """Noise floor of every channel (C,), and the noise itself (T, C)."""
        residual, valid = self.problem.residual, self.problem.valid
        floor = np.maximum(_rms(residual, valid), 1e-12)
        for _ in range(4):  # the weights of the re-tuning are the floor that it leaves
            rest, _ = self._retuned(residual, valid, floor)
            floor = np.maximum(_rms(rest, valid), 1e-12)
        return floor, rest

    def _retuned(self, values: FloatArray, rows: BoolArray, floor: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return what re-tuning within tolerances leaves of values (T, C), and the re-tuning (K,)."""
        columns = np.where(rows[:, :, None], self._columns / floor[:, None], 0.0).reshape(-1, len(self._deviations))
        scaled = columns * self._deviations
        wanted = np.where(rows, values / floor, 0.0).ravel()
        solution = np.linalg.solve(scaled.T @ scaled + np.eye(scaled.shape[1]), scaled.T @ wanted)
        moved = self._deviations * solution
        return values - self._columns @ moved, moved


def _evidence(robot: RobotDescription, costs_more: float, effects: Sequence[EffectInstance]) -> float:
    """What runs cost more, and no more than each of the effects has against a healthy robot that differs by just that.

    What one run costs more than another is also that a robot which slips goes another way.
    """
    return max(min([costs_more, *(tolerated_cost(robot, instance) for instance in effects)]), 0.0)


def _in_channels(instance: EffectInstance) -> bool:
    """Whether the channels of a description that holds the effect show what it does.

    What comes before the measured torque is not in them; torques by other joints or by time are in no description. Of gears
    that play or give they hold the first order, which is nearer than another motion.
    """
    effect = all_effects().get(instance.name)
    return effect is not None and not isinstance(effect, ActuatorEffect)


def _headings(recording: SimulatedRecording) -> FloatArray:
    """Steering angles (T, n) [rad]."""
    return recording.joint_states.position[:, :, STEER]


def _build(nominal: RobotDescription, recordings: Sequence[SimulatedRecording], cutoff: float) -> RegressionProblem:
    return RobotProblemBuilder(nominal, list(recordings), cutoff).build(with_terms=False)  # type: ignore[arg-type]


def _rms(values: FloatArray, rows: BoolArray) -> FloatArray:
    """Root mean square per channel, (C,)."""
    counts = np.maximum(rows.sum(axis=0), 1)
    rms: FloatArray = np.sqrt(np.sum(np.where(rows, values, 0.0) ** 2, axis=0) / counts)
    return rms


def _regions(problem: RegressionProblem, active: BoolArray) -> dict[str, tuple[float, float]]:
    if not active.any():
        return {}
    found = {}
    for name, values in problem.variables.items():
        low, high = np.quantile(values[active], REGION_QUANTILES)
        found[name] = (float(low), float(high))
    return found
