"""Terrain for powered-caster robots: grounds, and what a robot learns of them while it drives."""

from .active_identification import ActiveIdentification, ActiveMeasurement, ActiveParameters, Phase, Refusal
from .active_record import ActiveRecord
from .errors import TerrainError
from .ground_catalogue import GROUNDS, Ground, contact_on, ground, robot_on
from .ground_from_tests import GroundFromTests
from .observed_ground import ObservedGround, ObservedGroundOutput, ObservedGroundState
from .robot_terrain import RobotReading, RobotTerrain, RobotTerrainEstimate
from .shared_friction import SharedFriction, shared_friction
from .slip_slope import SlipSlope, SlipSlopeEstimate, SlipSlopeParameters
from .terrain_classes import CLASSES, TerrainClass, classify
from .terrain_estimator import TerrainEstimate, TerrainEstimator, TerrainParameters, WheelReading
from .terrain_map import MapParameters, Place, TerrainMap
from .thesis_rls import ThesisRls, ThesisRlsParameters

__all__ = [
    "CLASSES",
    "GROUNDS",
    "ActiveIdentification",
    "ActiveMeasurement",
    "ActiveParameters",
    "ActiveRecord",
    "Ground",
    "GroundFromTests",
    "MapParameters",
    "ObservedGround",
    "ObservedGroundOutput",
    "ObservedGroundState",
    "Phase",
    "Place",
    "Refusal",
    "RobotReading",
    "RobotTerrain",
    "RobotTerrainEstimate",
    "SharedFriction",
    "SlipSlope",
    "SlipSlopeEstimate",
    "SlipSlopeParameters",
    "TerrainClass",
    "TerrainError",
    "TerrainEstimate",
    "TerrainEstimator",
    "TerrainMap",
    "TerrainParameters",
    "ThesisRls",
    "ThesisRlsParameters",
    "WheelReading",
    "classify",
    "contact_on",
    "ground",
    "robot_on",
    "shared_friction",
]
