"""Terrain for powered-caster robots: grounds, and what a robot learns of them while it drives."""

from .active_identification import ActiveIdentification, ActiveMeasurement, ActiveParameters, Phase, Refusal
from .active_record import ActiveRecord
from .errors import TerrainError
from .ground_catalogue import GROUNDS, Ground, contact_on, ground, robot_on
from .robot_terrain import RobotReading, RobotTerrain, RobotTerrainEstimate
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
    "MapParameters",
    "Phase",
    "Place",
    "Refusal",
    "RobotReading",
    "RobotTerrain",
    "RobotTerrainEstimate",
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
]
