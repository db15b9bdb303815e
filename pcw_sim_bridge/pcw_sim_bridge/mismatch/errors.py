"""Exceptions of the mismatch analyser."""

from pcw_description.errors import PcwError


class MismatchError(PcwError):
    """The analysis cannot run on this input; the message says what is wrong with it."""
