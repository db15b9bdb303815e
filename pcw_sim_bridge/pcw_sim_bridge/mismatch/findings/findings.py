"""What an analysis found, as data: the report, the patched description and the summary are made of this alone."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Any

from ..laws.generated_effect import GeneratedEffect
from ..regression.regression_problem import FloatArray

Interval = tuple[float, float]

FORMAT = "pcw_mismatch/1"
FLAG_PROBABILITY = 1e-3  # of a channel's residual being noise and tolerances, below which it departs
VERDICTS = ("no_mismatch", "explained", "partly_explained", "unexplained", "insufficient_data")
REFUSED = "fitted but did not help held out"  # an outcome of the ladder
SURE = 0.8  # a name of more than this probability stands for itself
FEW_CHANNELS = 3  # that are told by name in a sentence
SHORT_ENOUGH = 100  # characters of a formula that stands in a plain sentence


@dataclasses.dataclass(frozen=True)
class InputFinding:
    """A recording that went in.

    Attributes:
        role: "fit" or "holdout".
        started: stamp of its first sample [s] on the clock of its headers; None where the file has no such clock.
    """

    path: str
    sha256: str
    duration: float
    role: str
    warnings: tuple[str, ...]
    started: float | None = None


@dataclasses.dataclass(frozen=True)
class ChannelFinding:
    """How far one channel is from its noise, with the description's numbers re-tuned within their tolerances.

    Attributes:
        rms: of the nominal residual (before any re-tuning), in `unit`.
        noise_floor: rms of the noise, from what the chosen model leaves, in `unit`.
        p_value: of the channel's residual being noise and tolerances alone.
        flagged: whether it is not.
    """

    name: str
    unit: str
    rms: float
    noise_floor: float
    p_value: float
    flagged: bool


@dataclasses.dataclass(frozen=True)
class Place:
    """A circle on the floor, in the frame of the tracker or of the odometry [m]."""

    x: float
    y: float
    radius: float


@dataclasses.dataclass(frozen=True)
class LocationFinding:
    """Where recordings and model part.

    Attributes:
        intervals: in the first recording that shows it [s].
        region: range of each operating variable in which it shows.
        place: on the floor, of what is tied to one.
    """

    channels: tuple[str, ...]
    casters: tuple[str, ...]
    axis: str
    intervals: tuple[tuple[float, float], ...]
    region: Mapping[str, tuple[float, float]]
    place: Place | None = None


@dataclasses.dataclass(frozen=True)
class ParameterFinding:
    """A number with its 95 % interval."""

    value: float
    unit: str
    low: float
    high: float


@dataclasses.dataclass(frozen=True)
class EffectFinding:
    """An effect that the description leaves out."""

    name: str
    target: tuple[str, ...]
    probability: float
    parameters: Mapping[str, ParameterFinding]
    statement: str
    ambiguous_with: tuple[str, ...]
    experiment: str | None


@dataclasses.dataclass(frozen=True)
class UnknownFinding:
    """A leftover that no effect of the library explains.

    Attributes:
        depends_on: variables, the leading one first.
        effect: a file by which simulators can use it, in folder `effects` of the report; None where there is none.
        without_effect: why there is none; "" where nothing acts like a torque or force.
        helps: whether it is part of the patch that is proved on held-out data.
    """

    channel: str
    depends_on: tuple[str, ...]
    expression: str | None
    share_explained: float
    effect: GeneratedEffect | None = None
    without_effect: str = ""
    helps: bool = False

    def effect_entry(self) -> dict[str, Any] | None:
        """Return what report.json says of the file."""
        if self.effect is None:
            return None
        return {
            "name": self.effect.name, "target": list(self.effect.target), "parameters": dict(self.effect.parameters),
            "file": f"effects/{self.effect.name}.py",
        }  # fmt: skip


@dataclasses.dataclass(frozen=True)
class RetunedFinding:
    """A number of the description that the recording moves, within its tolerance or (then a warning) beyond it.

    Attributes:
        healthy: change up to which it is that of a healthy system, in `unit`; infinite where a healthy one may be far off.
    """

    name: str
    unit: str
    nominal: float
    value: float
    low: float
    high: float
    tolerance: float
    healthy: float = math.inf

    @property
    def times(self) -> float:
        """How many tolerances it comes out from the description."""
        return abs(self.value - self.nominal) / self.tolerance

    @property
    def strained(self) -> bool:
        """Whether no healthy system has it."""
        return abs(self.value - self.nominal) > self.healthy


@dataclasses.dataclass(frozen=True)
class ChannelProof:
    """Held-out error of one channel over the spread of its measured side, with 95 % intervals.

    Attributes:
        floor: of its noise, and of what the model misjudges; share: by how far it can be foretold, its weight among others.
    """

    name: str
    floor: float
    before: float
    after: float
    before_ci95: Interval
    after_ci95: Interval
    share: float = 1.0


@dataclasses.dataclass(frozen=True)
class RolloutProof:
    """Error of one signal at one horizon [s] of forward simulation, over the size of its changes, likewise."""

    signal: str
    horizon: float
    floor: float
    before: float
    after: float
    before_ci95: Interval
    after_ci95: Interval


@dataclasses.dataclass(frozen=True)
class FitFinding:
    """Held-out errors before and after the patch.

    Attributes:
        source: what was held out, in words.
        inverse_nrmse: of the measured side of the channels, before and after.
        rollout: of forward simulation over half a second, by signal.
        gap_closed: (before - after) / (before - floor) of `inverse_nrmse`, the floor being noise; 0 where there is no gap.
        gap_closed_ci95, inverse_ci95: 95 % intervals, the latter before and after; inverse_floor: what noise leaves.
        channels: errors by channel; rollouts: by signal and horizon.
        rollout_gap_closed: likewise of the simulation over half a second, all signals; None where nothing was simulated, or
            where nothing but noise is left before.
        harm: the largest relative growth of the error of a channel, signal or recording that is no chance; where, in
            `harm_at`.
    """

    source: str
    inverse_nrmse: tuple[float, float]
    rollout: Mapping[str, tuple[float, float]]
    gap_closed: float
    gap_closed_ci95: Interval | None = None
    inverse_ci95: tuple[Interval, Interval] | None = None
    inverse_floor: float | None = None
    channels: tuple[ChannelProof, ...] = ()
    rollouts: tuple[RolloutProof, ...] = ()
    rollout_gap_closed: float | None = None
    harm: float = 0.0
    harm_at: str | None = None

    def to_json(self) -> dict[str, Any]:
        """Return `fit.holdout` of report.json."""
        return {
            "source": self.source,
            "inverse_nrmse": list(self.inverse_nrmse),
            "inverse_ci95": None if self.inverse_ci95 is None else [list(pair) for pair in self.inverse_ci95],
            "inverse_floor": self.inverse_floor,
            "rollout": {name: list(pair) for name, pair in self.rollout.items()},
            "gap_closed": self.gap_closed,
            "gap_closed_ci95": None if self.gap_closed_ci95 is None else list(self.gap_closed_ci95),
            "rollout_gap_closed": self.rollout_gap_closed,
            "harm": self.harm,
            "harm_at": self.harm_at,
            "per_channel": [dataclasses.asdict(entry) for entry in self.channels],
            "horizons": [
                {"horizon_s": entry.horizon, **{k: v for k, v in dataclasses.asdict(entry).items() if k != "horizon"}}
                for entry in self.rollouts
            ],
        }


@dataclasses.dataclass(frozen=True)
class LadderFinding:
    """One candidate set that was tried."""

    description: str
    gain: float
    held_out_gain: float | None
    outcome: str


@dataclasses.dataclass(frozen=True)
class Trace:
    """A channel over time, for the figures; arrays (T,).

    Attributes:
        before: what the nominal model predicts; after: what the patched one predicts.
        variable: the most telling variable to draw the residual against, its name in `variable_name`.
    """

    channel: str
    unit: str
    role: str
    time: FloatArray
    measured: FloatArray
    before: FloatArray
    after: FloatArray
    variable_name: str
    variable: FloatArray


@dataclasses.dataclass(frozen=True)
class ResidualMap:
    """What is left of all channels together, over their noise, for the figures; arrays (T,).

    Attributes:
        before, after: root mean square over the channels of residual over floor, nominal and patched; NaN: not judged.
        time: over all recordings on end [s]; variables: name -> values.
        path: position on the floor (T, 2) [m]; None on a bench.
    """

    before: FloatArray
    after: FloatArray
    time: FloatArray
    variables: Mapping[str, FloatArray]
    path: FloatArray | None


@dataclasses.dataclass(frozen=True)
class Findings:
    """Everything an analysis says; `absent` is what was not recorded, and what that costs."""

    subject: str
    verdict: str
    inputs: tuple[InputFinding, ...]
    channels: tuple[ChannelFinding, ...]
    locations: tuple[LocationFinding, ...]
    effects: tuple[EffectFinding, ...]
    unknown: tuple[UnknownFinding, ...]
    retuned: tuple[RetunedFinding, ...]
    fit: FitFinding | None
    ladder: tuple[LadderFinding, ...]
    traces: tuple[Trace, ...]
    notes: tuple[str, ...]
    seconds: float
    residual_map: ResidualMap | None = None
    absent: tuple[tuple[str, str], ...] = ()

    def to_json(self) -> dict[str, Any]:
        """Return report.json: INTERFACES section 6 and, added, retuned, ladder, absent, generated_effects and notes."""
        return {
            "format": FORMAT,
            "verdict": self.verdict,
            "inputs": [
                {"path": i.path, "sha256": i.sha256, "duration_s": i.duration, "role": i.role, "warnings": list(i.warnings)}
                for i in self.inputs
            ],
            "channels": [dataclasses.asdict(channel) for channel in self.channels],
            "locations": [
                {
                    "channels": list(place.channels),
                    "casters": list(place.casters),
                    "axis": place.axis,
                    "intervals_s": [list(interval) for interval in place.intervals],
                    "region": {name: list(span) for name, span in place.region.items()},
                    "place_m": None if place.place is None else dataclasses.asdict(place.place),
                }
                for place in self.locations
            ],
            "effects": [
                {
                    "name": effect.name,
                    "target": list(effect.target),
                    "probability": effect.probability,
                    "parameters": {
                        name: {"value": p.value, "unit": p.unit, "ci95": [p.low, p.high]}
                        for name, p in effect.parameters.items()
                    },
                    "statement": effect.statement,
                    "ambiguous_with": list(effect.ambiguous_with),
                    "experiment": effect.experiment,
                }
                for effect in self.effects
            ],
            "unknown": [
                {
                    "channel": leftover.channel,
                    "depends_on": list(leftover.depends_on),
                    "expression": leftover.expression,
                    "share_explained": leftover.share_explained,
                }
                for leftover in self.unknown
            ],
            "fit": {} if self.fit is None else {"holdout": self.fit.to_json()},
            "retuned": [
                {
                    "name": r.name, "unit": r.unit, "nominal": r.nominal, "value": r.value, "ci95": [r.low, r.high],
                    "tolerance": r.tolerance,
                }
                for r in self.retuned
            ],
            "ladder": [dataclasses.asdict(step) for step in self.ladder],
            "absent": [{"sensor": sensor, "cost": cost} for sensor, cost in self.absent],
            "generated_effects": [
                {
                    "unknown": k, "effect": leftover.effect_entry(), "without_effect": leftover.without_effect,
                    "helps_held_out": leftover.helps,
                }
                for k, leftover in enumerate(self.unknown)
                if leftover.effect is not None or leftover.without_effect
            ],
            "notes": list(self.notes),
            "seconds": self.seconds,
        }

    @property
    def is_patched(self) -> bool:
        """Whether anything is modelled that the description leaves out."""
        return bool(self.effects) or any(leftover.helps for leftover in self.unknown)

    def nothing_missing(self) -> str:
        """What "no_mismatch" says and does not say, as one sentence without its full stop."""
        where = ""
        names = [channel.name for channel in self.channels]
        if not any("force" in name for name in names):
            where = f" in {', '.join(names)} (forces could not be judged)"
            if any(name.startswith("steer_torque/") for name in names):
                where = " in the joints (off the ground nothing else could be judged)"
        labels = [step.description.removeprefix("drop ") for step in self.ladder if step.outcome.startswith(REFUSED)]
        refused = [f"a dependence on {label.partition(' by ')[2]}" if " by " in label else label for label in labels]
        if refused:  # nothing proved, which is not the same as nothing there
            where += f" that held-out data bear out; the fitted recordings alone speak for {', '.join(refused)}"
        strained = [f"{number.name} ({number.times:.1f} tolerances)" for number in self.retuned if number.strained]
        beyond = [channel.name for channel in self.channels if channel.flagged]
        if not (refused or strained or beyond):
            return f"nothing is missing{where}: what differs is within noise and tolerances"
        reasons = []
        if strained:
            reasons.append(f"the description is off by more than its tolerances in {', '.join(strained)}")
        if beyond:  # too little to name what it is, and too much for nothing
            reasons.append(f"noise and tolerances alone do not explain {some_of(beyond)}")
        what = "no effect stands out" if beyond else "no effect is missing"
        return f"{what}{where}{', but ' if reasons else ''}{', and '.join(reasons)}"

    def _doubt(self, effect: EffectFinding) -> str:
        """What else a named effect may be, and how sure it is where it is not, as words after its statement."""
        # A payload is felt by all wheels, but what is wrong with one drive is no part of what is wrong with another.
        beside = [other for other in self.effects if other is not effect]
        named = {o.name for o in beside if "chassis" in (*o.target, *effect.target) or {*o.target} & {*effect.target}}
        rivals = [f"a part of {name}" if name in named else name for name in effect.ambiguous_with]
        alike = f" (It may as well be {' or '.join(rivals)}.)" if rivals else ""
        return alike if effect.probability > SURE else f"{alike} (Probability {effect.probability:.2f}.)"

    def summary(self) -> list[str]:
        """Return five plain lines: subject, verdict, effects, held-out fit, warnings."""
        verdict = {
            "no_mismatch": self.nothing_missing(),
            "explained": "explained: the effects below account for the mismatch",
            "partly_explained": "partly explained: the effects below, and a leftover that is not in the library",
            "unexplained": "not explained by any effect of the library",
            "insufficient_data": "not enough data to judge",
        }[self.verdict]
        found = " ".join(effect.statement + self._doubt(effect) for effect in self.effects) or "none"
        for leftover in self.unknown:
            told = [f"{leftover.channel} depends on {', '.join(leftover.depends_on)}"]
            if leftover.expression and len(leftover.expression) <= SHORT_ENOUGH:
                told.append(leftover.expression)
            found += f" Unknown: {', '.join(told)}."
        if self.fit is None:
            fit = "no held-out data"
        else:
            before, after = self.fit.inverse_nrmse
            closed = f"; {100 * self.fit.gap_closed:.0f} % of the gap closed" if self.is_patched else ""
            fit = f"NRMSE {before:.3f} before, {after:.3f} after{closed} ({self.fit.source})"
        warnings = sum(len(i.warnings) for i in self.inputs)
        return [
            f"Subject:   {self.subject}",
            f"Verdict:   {verdict}",
            f"Effects:   {found}",
            f"Held out:  {fit}",
            f"Warnings:  {warnings} about the recordings; {self.seconds:.1f} s",
        ]


def some_of(channels: Sequence[str]) -> str:
    """Name a few channels, and say how many more there are."""
    more = f" and {len(channels) - FEW_CHANNELS} more channels" if len(channels) > FEW_CHANNELS else ""
    return f"{', '.join(channels[:FEW_CHANNELS])}{more}"
