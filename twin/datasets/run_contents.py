"""Contents of a run for the writers of other programs' formats: images, poses, calibration, maps, readings.

A writer is a function `export(contents, folder)` that writes to an existing folder and returns the written files, or
the folders with many files. It raises TwinError for an image that is no undamaged PNG, and OSError.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from twin.core.georeference import Georeference
from twin.core.records import ElevationMap, ImuReadings, Readings, StereoRig, Trajectory
from twin.datasets.calibration import StereoCalibration, rectified_calibration

#: Names of the trajectories that give the poses of exported images; the first one that a run has is used.
POSES = ("truth", "final")


@dataclass(frozen=True)
class RecordedFrame:
    """A frame whose left image is kept in the run folder."""

    index: int  #: number of the frame, from 0, which is its row in the trajectories
    time_s: float  #: time of the exposure since the start of the survey
    left: Path  #: file of the left image, an 8-bit RGB PNG
    right: Path | None  #: file of the right image; None if the right camera took none
    keyframe: bool  #: whether the frame is a keyframe of the estimators
    readings: Readings = field(default_factory=Readings)  #: readings of the navigation sensors at the frame


class ImuNoise(NamedTuple):
    """Noise densities of an inertial measurement unit (IMU), named and defined as in Kalibr."""

    gyroscope_noise_density: float  #: of the white noise of each angular rate [rad/s/sqrt(Hz)]
    gyroscope_random_walk: float  #: of the random walk of the bias of each angular rate [rad/s2/sqrt(Hz)]
    accelerometer_noise_density: float  #: of the white noise of each specific force [m/s2/sqrt(Hz)]
    accelerometer_random_walk: float  #: of the random walk of the bias of each specific force [m/s3/sqrt(Hz)]


class RecordedImu(NamedTuple):
    """Readings of the IMU of a run, which is at the origin of the body."""

    readings: ImuReadings  #: all readings of the run, in body axes
    rate_hz: float  #: number of readings per second
    noise: ImuNoise  #: noise that the scenario states
    accelerometer_bias_mps2: float | None = None  #: standard deviation of the bias of each specific force


@dataclass(frozen=True)
class RunContents:
    """Contents of a run folder. Trajectories are those of the left camera in the world (x east, y north, z up) [m]."""

    folder: Path  #: the run folder
    name: str  #: name of the run
    scenario: Mapping[str, Any]  #: contents of scenario.resolved.toml
    rig: StereoRig  #: believed calibration, with which the images were rectified
    true: StereoCalibration | None  #: true calibration of the delivered images; None if not known (recorded data)
    trajectories: Mapping[str, Trajectory]  #: those of "truth", "f2f", "online", "final" and "reference" that exist
    frames: tuple[RecordedFrame, ...] = ()  #: recorded frames in the order of time; empty if no images were kept
    elevation: ElevationMap | None = None  #: map with sigma and the colours of the orthomosaic at its cells
    #: (rows, cols) estimated minus true elevation at the cells of the map, NaN where unknown; None without a true map.
    error_m: NDArray[np.float32] | None = None
    orthomosaic: Path | None = None  #: file of the orthomosaic (GeoTIFF, RGBA or RGB)
    #: position of the scene in a CRS, from the measured DEM or the options of the export; None: scene coordinates.
    georeference: Georeference | None = None
    imu: RecordedImu | None = None  #: readings of the IMU, if recorded
    true_map: Path | None = None  #: file of the true heights (dem_truth.tif)
    jpeg_quality: int | None = None  #: quality of the exported images as JPEG, 1 to 100; None: the PNG files are copied
    #: called with the completed fraction of the format that is being written, 0 to 1.
    progress: Callable[[float], None] = field(default=lambda _: None)
    notes: tuple[str, ...] = ()  #: sentences on files of the run that are missing
    #: whether the images can be rendered again: neither recorded data nor a surrogate survey, and true poses are kept
    renders_again: bool = False
    allow_plugins: bool = False  #: run plug-ins that the scenario names as module:Class, to render the images again

    @property
    def pairs(self) -> tuple[RecordedFrame, ...]:
        return tuple(frame for frame in self.frames if frame.right is not None)

    @property
    def believed(self) -> StereoCalibration:
        return rectified_calibration(self.rig)

    @property
    def best_calibration(self) -> StereoCalibration:
        return self.true or self.believed

    @property
    def poses(self) -> Trajectory:
        """Returns the truth if it is known, otherwise the final trajectory; raises KeyError without either."""
        return self.trajectories[next((name for name in POSES if name in self.trajectories), POSES[-1])]

    def sigmas(self, *keys: str) -> list[float]:
        """Returns standard deviations in the section [navigation] of the scenario, in SI units; 0 where not stated."""
        navigation = self.scenario.get("navigation", {})
        values = [(key, float(navigation.get(key, 0.0))) for key in keys]
        return [float(np.deg2rad(value)) if key.endswith("_deg") else value for key, value in values]
