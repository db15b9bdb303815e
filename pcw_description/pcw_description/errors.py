"""Exceptions of the whole package set. Each package derives its own base from `PcwError`."""

from __future__ import annotations

import dataclasses
import difflib
import math
from collections.abc import Iterable

# A value longer than this is cut in a message, a suggestion among more names than this does without their list.
LONGEST_VALUE = 100
MOST_NAMES = 16


class PcwError(ValueError):
    """Base of all PCW errors."""


class DescriptionError(PcwError):
    """A robot or axis description that is not valid.

    The message names the key, the value found and what is allowed, and the file where there is one; all are attributes too.
    """

    def __init__(self, key: str, value: object, allowed: str, file: str = "") -> None:
        self.key = key
        self.value = value
        self.allowed = allowed
        self.file = file
        found = repr(value)
        if len(found) > LONGEST_VALUE:
            found = found[:LONGEST_VALUE] + "..."
        said = f"{key} is missing; {allowed}" if value is None else f"{key}: {found} is not allowed; {allowed}"
        super().__init__(f"{file}: {said}" if file else said)


class KinematicsError(PcwError):
    """A kinematic question that has no answer, such as the steering rate of a wheel without offset."""


class RecordingError(PcwError):
    """A recording that cannot be written or read; the message names the path and a remedy."""


@dataclasses.dataclass(frozen=True)
class NumberChecks:
    """Checks of numbers that a package raises its own error for.

    Attributes:
        error: the package's base error.
    """

    error: type[PcwError]

    def number(
        self, name: str, value: float, minimum: float = -math.inf, above: float = -math.inf, maximum: float = math.inf
    ) -> None:
        """Check a number.

        Raises:
            PcwError: as `error`; it is none, not finite or out of range.
        """
        if not (_is_number(value) and math.isfinite(value) and minimum <= value <= maximum and value > above):
            lowest = f"above {above:g}" if above > -math.inf else f"at least {minimum:g}"
            raise self.error(f"{name} = {value!r} is not allowed; allowed: {lowest}, at most {maximum:g}")

    def time_step(self, dt: float) -> None:
        """Check a measured time step [s].

        Raises:
            PcwError: as `error`; it is no number, or not positive and finite.
        """
        if not (_is_number(dt) and math.isfinite(dt) and dt > 0.0):
            raise self.error(f"dt = {dt!r} s is not allowed; allowed: above 0, measured from stamps")


def _is_number(value: object) -> bool:
    return hasattr(value, "__float__")


def nearest_name(name: str, known: Iterable[str]) -> str:
    """Return "did you mean 'x'? allowed: w, x, y", or the list alone where no known name is near."""
    names = sorted(known)
    close = difflib.get_close_matches(name, names, n=1, cutoff=0.5)
    everything = "allowed: " + ", ".join(names)
    if not close:
        return everything
    suggestion = f"did you mean {close[0]!r}?"
    return f"{suggestion} {everything}" if len(names) <= MOST_NAMES else suggestion
