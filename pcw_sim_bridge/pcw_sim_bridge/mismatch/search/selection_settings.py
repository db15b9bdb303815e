"""What may be set of the choice of effects."""

from __future__ import annotations

import dataclasses


@dataclasses.dataclass(frozen=True)
class SelectionSettings:
    """What the user may turn.

    Attributes:
        false_alarm_rate: share of recordings with nothing missing in which something may be named.
        lenient_gain: nats to enter the first, over-complete model.
        smallest_threshold: nats below which nothing is named however quiet the surrogates are (odds of 8000 to 1): evidence
            takes the model for exact, and many small errors of it look like small effects.
        smallest_share: a term must move some channel by at least this part of the rms that remains there. Below it lie
            the details that no model of a real machine gets right, and they repeat as faithfully as an effect does.
        smallest_part: a term must also move some channel by this part of what all effects together do: the shape of a
            large effect is itself only known so well, and its error must not be named a further effect.
        least_peculiar: nats that a term smaller than what the model misjudges must have beside the model's own errors. What
            healthy robots in other simulations than the model were given wrongly stayed below half of it.
        least_peculiar_unlike: the same of what has a shape that errors of the model have not: torques at joints, errors of
            reading that turn with the joint, play, an IMU elsewhere. There healthy robots reached half of it at most.
        blocks: of the cross-validation.
        first_repeats: instances of a repeatable term in the first over-complete set; more would eat red noise line by line.
    """

    false_alarm_rate: float = 0.005
    lenient_gain: float = 2.0
    smallest_threshold: float = 9.0
    smallest_share: float = 0.25
    smallest_part: float = 0.02
    least_peculiar: float = 100.0
    least_peculiar_unlike: float = 30.0
    blocks: int = 10
    surrogates: int = 200
    largest_set: int = 16
    first_repeats: int = 4
