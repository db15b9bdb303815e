"""Errors of the CAN part."""

from __future__ import annotations

from pcw_description.errors import PcwError


class CanError(PcwError):
    """A bus, a drive or a request to them that is not as it must be; names field, value and what is allowed."""


class DriveError(CanError):
    """A drive that does not answer, or answers what it must not; names the joint."""
