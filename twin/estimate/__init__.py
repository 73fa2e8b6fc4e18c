"""Estimators as a library, independent of the simulator; see docs/estimators.md."""

from typing import TYPE_CHECKING, Any

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

if TYPE_CHECKING:
    from twin.estimate.pipeline import Navigator

__all__ = [
    "ElevationMap", "Estimate", "EstimatorSettings", "Frame", "MapGrid", "Navigator", "Readings", "SensorNoise",
    "StereoRig", "SurveyResult", "Trajectory",
]  # fmt: skip


def __getattr__(name: str) -> Any:
    """Returns `Navigator`, whose compiled functions take long to load, when it is asked for."""
    if name == "Navigator":
        from twin.estimate.pipeline import Navigator

        return Navigator
    raise AttributeError(f"module 'twin.estimate' has no attribute {name!r}")
