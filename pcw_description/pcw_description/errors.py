"""Exceptions of the whole package set. Each package derives its own base from `PcwError`."""

from __future__ import annotations

import difflib
from collections.abc import Iterable


class PcwError(ValueError):
    """Base of all PCW errors."""


class DescriptionError(PcwError):
    """A robot or axis description that is not valid.

    The message names the key, the value found and what is allowed; the three are attributes too.
    """

    def __init__(self, key: str, value: object, allowed: str) -> None:
        self.key = key
        self.value = value
        self.allowed = allowed
        super().__init__(f"{key}: {value!r} is not allowed; {allowed}")


class KinematicsError(PcwError):
    """A kinematic question that has no answer, such as the steering rate of a wheel without offset."""


class RecordingError(PcwError):
    """A recording that cannot be written or read; the message names the path and a remedy."""


def nearest_name(name: str, known: Iterable[str]) -> str:
    """Return `"; did you mean 'x'?"` for the known name nearest to `name`, or the list of all of them."""
    names = sorted(known)
    close = difflib.get_close_matches(name, names, n=1, cutoff=0.5)
    if close:
        return f"did you mean {close[0]!r}?"
    return "known: " + ", ".join(names)
