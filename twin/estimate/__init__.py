"""Estimators as a library, independent of the simulator; see docs/estimators.md."""

from twin.core.records import (
    ElevationMap,
    Estimate,
    Frame,
    MapGrid,
    Readings,
    SensorNoise,
    StereoRig,
    SurveyResult,
    Trajectory,
)
from twin.core.settings import EstimatorSettings
from twin.estimate.pipeline import Navigator

__all__ = [
    "ElevationMap",
    "Estimate",
    "EstimatorSettings",
    "Frame",
    "MapGrid",
    "Navigator",
    "Readings",
    "SensorNoise",
    "StereoRig",
    "SurveyResult",
    "Trajectory",
]
