"""Estimators for powered-caster robots: slip from encoders, IMU and torques, joints at fault, motion without slip."""

from .encoder_slip import EncoderSlipOutput, EncoderSlipParameters, EncoderSlipState, SlipProjection
from .errors import EstimationError
from .fault_isolation import Fault, FaultIsolation, FaultParameters
from .imu_slip import ImuSlip, ImuSlipParameters, Motion
from .motor_current_slip import MotorCurrentParameters, RobotCurrentDetector, WheelCurrentDetector
from .robot_sliding_mode_observer import RobotObserverState, RobotSlidingModeObserver
from .sliding_mode_observer import SlidingModeObserver, SlidingModeParameters
from .slip_calibration import Calibration, calibrate
from .slip_consensus import SlipConsensus
from .slip_estimate import JointMeasurement, SlipEstimate, WheelEstimate, WheelMeasurement, WheelModel
from .slip_kalman_filter import KalmanState, RobotKalmanFilter, SlipKalmanParameters, WheelKalmanFilter
from .slip_noise import SlipNoise, load_slip_noise
from .slip_procedure import SlipProcedure
from .slip_verdict import ConfirmParameters, SlipFinding, Verdict

__all__ = [
    "Calibration",
    "ConfirmParameters",
    "EncoderSlipOutput",
    "EncoderSlipParameters",
    "EncoderSlipState",
    "EstimationError",
    "Fault",
    "FaultIsolation",
    "FaultParameters",
    "ImuSlip",
    "ImuSlipParameters",
    "JointMeasurement",
    "KalmanState",
    "Motion",
    "MotorCurrentParameters",
    "RobotCurrentDetector",
    "RobotKalmanFilter",
    "RobotObserverState",
    "RobotSlidingModeObserver",
    "SlidingModeObserver",
    "SlidingModeParameters",
    "SlipConsensus",
    "SlipEstimate",
    "SlipFinding",
    "SlipKalmanParameters",
    "SlipNoise",
    "SlipProcedure",
    "SlipProjection",
    "Verdict",
    "WheelCurrentDetector",
    "WheelEstimate",
    "WheelKalmanFilter",
    "WheelMeasurement",
    "WheelModel",
    "calibrate",
    "load_slip_noise",
]
