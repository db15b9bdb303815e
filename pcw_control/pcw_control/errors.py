"""The base exception of pcw_control."""

from pcw_description.errors import PcwError


class ControlError(PcwError):
    """A controller parameter, reference or trajectory that is not allowed; the message says what is."""
