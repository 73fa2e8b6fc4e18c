"""Estimators as a library: trajectory of a stereo camera and elevation map, computed from frames alone.

`Navigator` processes frames one by one and builds the map at the end; see docs/estimators.md. The package does not
depend on the simulator, its scenarios or its missions.
"""

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
