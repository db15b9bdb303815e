"""What an analysis says of ripples that pass too fast for the channels; see `joint_ripples` and `ripple_sizes`."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from pcw_description.effect_instance import EffectInstance

from ..regression.regression_problem import FloatArray, Term
from ..regression.whitened_regression import Instance
from ..robot.joint_ripples import JointRipple
from ..robot.ripple_sizes import RippleSize
from .command_findings import CommandFindings, with_instance
from .explanation import HALF_WIDTH, Estimate, Explanation, NamedTerm
from .findings import ChannelFinding, ChannelProof, LocationFinding
from .paired_errors import PairedErrors, blocks_of, interval

EFFECT = "motor_cogging"
# A wave that keeps step with a joint whatever its speed is the joint's; that it is one of its motor is what else it may be.
SURE = 0.99


def ripple_findings(
    sizes: Sequence[RippleSize], held_out: Sequence[RippleSize | None], lowest: float, seed: int
) -> CommandFindings:
    """Return the findings, one effect per ripple.

    Args:
        sizes: of the ripples; held_out: what each leaves of held-out recordings, None where there are none that show it.
        lowest: frequency above which they were looked for [Hz]; seed: of the bootstrap.
    """
    found = CommandFindings()
    for size, other in zip(sizes, held_out, strict=True):
        ripple = size.ripple
        channel = f"{ripple.axis}_torque/{ripple.caster}"
        before, after = (float(np.sqrt(squares.mean())) for squares in (size.before, size.after))
        first = size.begin[size.recording == size.recording[0]]
        found = dataclasses.replace(
            found,
            channels=(*found.channels, ChannelFinding(channel, "N m", before, after, 0.0, True)),
            named=(*found.named, with_instance(_named(size))),
            locations=(
                *found.locations,
                LocationFinding((channel,), (ripple.caster,), ripple.axis, ((float(first.min()), float(first.max())),), {}),
            ),
            proofs=(*found.proofs, _proof(channel, other or size, np.random.default_rng(seed))),
            notes=(*found.notes, _note(ripple, lowest)),
        )
    return found


def with_ripples(
    named: Sequence[tuple[NamedTerm, EffectInstance]], ripples: CommandFindings
) -> tuple[list[tuple[NamedTerm, EffectInstance]], CommandFindings]:
    """Return all effects, what the channels say of a ripple added to what is known of it; and the findings of the others.

    Where a joint turns slowly the channels weigh a ripple themselves, by what they find beside its first size.
    """
    found, rest = [], list(zip(ripples.named, ripples.locations, strict=True))
    for entry, instance in named:
        ripple = next((other for other in rest if _same(entry, other[0][0])), None)
        if ripple is None:
            found.append((entry, instance))
            continue
        rest.remove(ripple)
        first = ripple[0][0].estimates
        both = {
            name: _plus(estimate, first[name].value) if name != "order" else first[name]
            for name, estimate in entry.estimates.items()
        }
        found.append(with_instance(dataclasses.replace(entry, estimates=both, probability=SURE, ambiguous_with=())))
    alone, places = [effect for effect, _ in rest], tuple(place for _, place in rest)
    return [*found, *alone], dataclasses.replace(ripples, named=tuple(alone), locations=places)


def beside_ripples(explanation: Explanation, ripples: CommandFindings) -> tuple[Explanation, tuple[str, ...]]:
    """Return the explanation without what is left of the joints that ripple, and what to know of that.

    A tyre that slips to and fro many times a second gives way to slow forces as the model does not know it.
    """
    shaken = {channel.name for channel in ripples.channels}
    kept = tuple(left for left in explanation.leftovers if left.channel not in shaken)
    notes = tuple(
        f"What else is left of {left.channel} depends on {', '.join(left.depends_on or (left.variable,))}. It may be what a "
        "tyre does that slips to and fro with a ripple: mend that, and record anew."
        for left in explanation.leftovers if left.channel in shaken
    )  # fmt: skip
    return dataclasses.replace(explanation, leftovers=kept), notes


def _same(entry: NamedTerm, ripple: NamedTerm) -> bool:
    """Whether an effect of the channels is that ripple."""
    of_joint = (entry.term.effect, entry.term.target, entry.term.axis) == (EFFECT, ripple.term.target, ripple.term.axis)
    return of_joint and abs(entry.estimates["order"].value / ripple.estimates["order"].value - 1.0) < 0.05


def _plus(estimate: Estimate, value: float) -> Estimate:
    return Estimate(estimate.value + value, estimate.unit, estimate.low + value, estimate.high + value)


def _named(size: RippleSize) -> NamedTerm:
    """The effect with its numbers and their intervals."""
    ripple = size.ripple

    def around(value: float, unit: str, deviation: float) -> Estimate:
        return Estimate(value, unit, value - HALF_WIDTH * deviation, value + HALF_WIDTH * deviation)

    # A line is known to a small part of its width, the better the clearer it is.
    estimates = {
        "cosine": around(size.cosine, "N m", float(size.deviations[0])),
        "sine": around(size.sine, "N m", float(size.deviations[1])),
        "order": around(ripple.order, "1/rad", ripple.width * ripple.peak**-0.5),
    }
    term = Term(EFFECT, (ripple.caster,), (), ({"order": ripple.order},), _nothing, axis=ripple.axis)
    gain = 0.5 * float(np.sum(np.log(np.maximum(size.before, 1e-300) / np.maximum(size.after, 1e-300))))
    instance = Instance(0, (("order", ripple.order),), ())
    return NamedTerm(instance, term, estimates, SURE, (), gain, gain, np.zeros((0, 0)))


def _nothing(shape: object) -> FloatArray:
    """No columns: the channels do not show what passes too fast for them."""
    return np.zeros((0, 0, 0))


def _proof(channel: str, size: RippleSize, rng: np.random.Generator) -> ChannelProof:
    """What the ripple leaves of the torque that makes up for it."""
    spread = float(np.sqrt(size.before.mean()))
    before, after = ((squares / spread**2)[:, None] for squares in (size.before, size.after))
    errors = PairedErrors.of(before, after, blocks_of(size.recording, size.begin), rng)
    first, last = (interval(np.sqrt(draws[:, 0])) for draws in (errors.before_draws, errors.after_draws))
    floor = float(np.sqrt(size.floor.mean())) / spread
    return ChannelProof(
        channel, floor, float(np.sqrt(errors.before[0])), float(np.sqrt(errors.after[0])), first, last
    )


def _note(ripple: JointRipple, lowest: float) -> str:
    return (
        f"A ripple keeps step with the {ripple.axis} of {ripple.caster}, {ripple.order:.4g} periods per turn, where it passes "
        f"faster than the {lowest:.3g} Hz that the channels are judged to. It is {100 * ripple.part:.0f} % of all that the "
        "joint does up there, and as large as makes a simulation under the measured torques do the same."
    )
