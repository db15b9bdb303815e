"""What an analysis says of a steering whose zero is so far off that nothing else can be judged; see `turned_steering`."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from pcw_description.effect_instance import EffectInstance

from ..findings.findings import (
    FLAG_PROBABILITY,
    ChannelFinding,
    EffectFinding,
    Findings,
    FitFinding,
    InputFinding,
    LocationFinding,
    ParameterFinding,
)
from ..found_effect import effect_instance
from ..regression.regression_problem import RegressionProblem
from ..robot.rolling_model import WRENCH
from ..robot.turned_steering import TurnedSteering
from .subject import Subject

EFFECT = "steer_zero_offset"


def instance_of(turned: TurnedSteering) -> EffectInstance:
    """Return the effect, within its range of one turn."""
    return effect_instance(EFFECT, (turned.caster,), {"offset": turned.offset})


def turned_findings(
    subject: Subject,
    turned: TurnedSteering,
    problem: RegressionProblem,
    inputs: tuple[InputFinding, ...],
    notes: Sequence[str],
    seconds: float,
) -> Findings:
    """Return the findings: one effect, with the forces that tell it.

    Args:
        subject: the description; turned: what was found in its recordings; problem: of these.
        notes: what else there is to say; seconds: that it took.
    """
    before, after = (
        float(np.linalg.norm(side / turned.measured)) / math.sqrt(len(WRENCH)) for side in (turned.before, turned.after)
    )
    first = problem.recording == problem.recording[0]
    times = problem.time[first]
    angle = problem.variables[f"steer_angle/{turned.caster}"]
    units = {channel.name: channel.unit for channel in problem.channels}
    low, high = turned.interval
    return Findings(
        subject=subject.name,
        verdict="explained",
        inputs=inputs,
        channels=tuple(
            ChannelFinding(name, units[name], float(rms), float(floor), float(p_value), bool(p_value < FLAG_PROBABILITY))
            for name, rms, floor, p_value in zip(WRENCH, turned.before, turned.after, turned.p_values, strict=True)
        ),
        locations=(
            LocationFinding(
                WRENCH, (turned.caster,), "steer", ((float(times[0]), float(times[-1])),),
                {f"steer_angle/{turned.caster}": (float(angle.min()), float(angle.max()))},
            ),
        ),
        effects=(
            EffectFinding(
                name=EFFECT, target=(turned.caster,), probability=turned.probability,
                parameters={"offset": ParameterFinding(turned.offset, "rad", low, high)},
                statement=subject.statement(instance_of(turned)), ambiguous_with=(), experiment=None,
            ),
        ),
        unknown=(),
        retuned=(),
        fit=FitFinding(
            source="stretches of the fitted recordings, forces and moment, each by the zero that the others tell",
            inverse_nrmse=(before, after), rollout={}, gap_closed=float(np.clip(1.0 - after / before, 0.0, 1.0)),
        ),
        ladder=(),
        traces=(),
        notes=(
            f"The wheels work against each other: forces that should move the robot leave {100 * turned.part[0]:.0f} % of all "
            f"of them, and {100 * turned.part[1]:.0f} % with the steering of {turned.caster} turned by "
            f"{math.degrees(turned.offset):+.1f} degrees. Nothing else was judged: put the zero right and record anew.",
            *notes,
        ),
        seconds=seconds,
    )  # fmt: skip
