"""The base exception of pcw_estimation."""

from pcw_description.errors import PcwError


class EstimationError(PcwError):
    """An estimator's parameter or measurement that is not allowed; the message says what is."""
