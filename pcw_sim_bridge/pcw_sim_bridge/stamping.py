"""Stamps as a real robot gives them, and messages that do not arrive.

A stamp is the time of the reading plus normal jitter, as a driver on a busy computer gives it; stamps of one topic never go
back and never repeat. Messages are lost in short bursts, as on a bus or by wifi: a chain of two states (E. N. Gilbert, Bell
System Technical Journal 39, 1960) that leaves the lossy one with the probability 1/L after each message and enters it with p,
so that bursts have L messages on average and

    loss = p / (p + 1/L)    =>    p = loss / (L (1 - loss)).

Every topic has a random source of its own, made from the seed and its name: jitter and loss of one topic change nothing in
another, nor in the noise of the sensors, and loss changes nothing in the jitter.
"""

from __future__ import annotations

import dataclasses
import zlib

import numpy as np

from pcw_description.effects.kinds import ClockEffect
from pcw_description.effects.registry import get
from pcw_description.robot_description import RobotDescription

from .plants.plant import PlantError

BURST_LENGTH = 3.0  # L, messages
LARGEST_JITTER = 0.1  # [s]
LARGEST_LOSS = 0.5
NANOSECONDS = 1_000_000_000
CLOCK_SET_BACK = 0.1  # a stamp further back than this is of a clock that was set, and not of a reading that came late [s]


def stamp_after(last_ns: int, time_ns: int) -> int:
    """Return the stamp [ns] of a reading of hardware: its time, or just after the last stamp where that is later.

    Where the computer's clock was set back it is the time all the same: stamps just after the last would nearly stand until
    the clock has made up for it, and whoever takes dt from them would compute with a nanosecond. Back in time they begin anew.
    """
    return time_ns if time_ns < last_ns - CLOCK_SET_BACK * NANOSECONDS else max(time_ns, last_ns + 1)


@dataclasses.dataclass(frozen=True)
class StampingParameters:
    """How bad the stamps and the way of the messages are.

    Attributes:
        stamp_jitter: standard deviation of the stamps [s].
        loss: fraction of the messages that are lost.
    """

    stamp_jitter: float = 0.0
    loss: float = 0.0

    def __post_init__(self) -> None:
        """Check the parameters.

        Raises:
            PlantError: a value out of its range, or not a number.
        """
        for name, largest, unit in (("stamp_jitter", LARGEST_JITTER, " s"), ("loss", LARGEST_LOSS, "")):
            value = getattr(self, name)
            if not 0.0 <= value <= largest:
                raise PlantError(f"{name} = {value!r}{unit} is not allowed; allowed: 0 to {largest:g}{unit}")


HEALTHY = StampingParameters(stamp_jitter=2e-4, loss=1e-3)
"""What a healthy on-board computer and a healthy network do."""


@dataclasses.dataclass(frozen=True)
class StampingState:
    """What a topic remembers.

    Attributes:
        stamp_ns: of the message before [ns]; -1 before the first.
        lossy: whether the message before was lost.
    """

    stamp_ns: int = -1
    lossy: bool = False


def step(
    parameters: StampingParameters, state: StampingState, time_ns: int, rng: np.random.Generator
) -> tuple[StampingState, bool]:
    """Stamp the next message of a topic.

    Args:
        parameters: jitter and loss.
        state: after the message before.
        time_ns: when the message was made, by the clock of who stamps it [ns].
        rng: of this topic.

    Returns:
        New state, whose `stamp_ns` is the stamp of this message, and whether the message is lost.
    """
    jitter, chance = rng.standard_normal(), rng.random()
    stamp_ns = max(time_ns + round(parameters.stamp_jitter * NANOSECONDS * jitter), state.stamp_ns + 1)
    enter = parameters.loss / (BURST_LENGTH * (1.0 - parameters.loss))
    stay = 1.0 - 1.0 / BURST_LENGTH if parameters.loss > 0.0 else 0.0
    lost = bool(chance < (stay if state.lossy else enter))
    return StampingState(stamp_ns, lost), lost


class TopicStamps:
    """The stamps of all topics of a robot.

    Args:
        parameters: jitter and loss of every topic.
        seed: of the random sources.
        robot: the robot; its `physics` may hold clocks of their own.
    """

    def __init__(self, parameters: StampingParameters, seed: int, robot: RobotDescription) -> None:
        self.parameters = parameters
        self._seed = seed
        self._clocks = [
            (effect, instance.parameters)
            for instance in robot.physics
            if isinstance(effect := get(instance.name), ClockEffect)
        ]
        self.reset()

    def reset(self) -> None:
        """Begin anew, with the same to come as the first time."""
        self._topics: dict[str, tuple[StampingState, np.random.Generator]] = {}

    def stamp(self, topic: str, time_ns: int) -> tuple[int, bool]:
        """Return the stamp [ns] of the next message of a topic, made at `time_ns`, and whether it is lost."""
        name = topic.strip("/")
        offset = sum(clock.offset(name, parameters) for clock, parameters in self._clocks)
        time_ns += round(offset * NANOSECONDS)
        if time_ns < 0:  # the sensor's clock has not begun yet
            return 0, True
        state, rng = self._topics.get(topic) or (StampingState(), self._source(topic))
        state, lost = step(self.parameters, state, time_ns, rng)
        self._topics[topic] = state, rng
        return state.stamp_ns, lost

    def _source(self, topic: str) -> np.random.Generator:
        # The name in a namespace is the name all the same; hash() of a text differs from process to process.
        return np.random.default_rng([self._seed, zlib.crc32(topic.strip("/").encode())])
