"""Estimators for powered-caster robots: encoder-consistency slip, slip observers and odometry."""

from .encoder_slip import EncoderSlipOutput, EncoderSlipParameters, EncoderSlipState
from .errors import EstimationError
from .motor_current_slip import MotorCurrentParameters, RobotCurrentDetector, WheelCurrentDetector
from .robot_sliding_mode_observer import RobotObserverState, RobotSlidingModeObserver
from .sliding_mode_observer import SlidingModeObserver, SlidingModeParameters
from .slip_estimate import JointMeasurement, SlipEstimate, WheelEstimate, WheelMeasurement, WheelModel
from .slip_kalman_filter import KalmanState, RobotKalmanFilter, SlipKalmanParameters, WheelKalmanFilter

__all__ = [
    "EncoderSlipOutput",
    "EncoderSlipParameters",
    "EncoderSlipState",
    "EstimationError",
    "JointMeasurement",
    "KalmanState",
    "MotorCurrentParameters",
    "RobotCurrentDetector",
    "RobotKalmanFilter",
    "RobotObserverState",
    "RobotSlidingModeObserver",
    "SlidingModeObserver",
    "SlidingModeParameters",
    "SlipEstimate",
    "SlipKalmanParameters",
    "WheelCurrentDetector",
    "WheelEstimate",
    "WheelKalmanFilter",
    "WheelMeasurement",
    "WheelModel",
]
