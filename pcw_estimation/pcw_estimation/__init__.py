"""Estimators for powered-caster robots: encoder-consistency slip and odometry."""

from .encoder_slip import EncoderSlipOutput, EncoderSlipParameters, EncoderSlipState
from .errors import EstimationError

__all__ = ["EncoderSlipOutput", "EncoderSlipParameters", "EncoderSlipState", "EstimationError"]
