"""Contents of a run for the writers of other programs' formats: images, poses, calibration, maps, readings.

A writer is a function `export(contents, folder)` that writes to an existing folder and returns the written files, or
the folders with many written files. It raises TwinError if an image is truncated or not a PNG image, and OSError if a
file cannot be read or written.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from twin.core.georeference import Georeference
from twin.core.records import ElevationMap, Exposure, Image, ImuReadings, Readings, StereoRig, Trajectory
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
    exposure: Exposure | None = None  #: `Frame.exposure`; None if not recorded


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


class FrameTruth(NamedTuple):
    """True layers of one recorded left image, rendered again at its true pose.

    The layers are those of a pinhole camera with the believed calibration at the true pose of the left camera. They
    are aligned with the recorded image if the scenario has no calibration error, lens distortion or port; otherwise,
    the image deviates from them by the error of its rectification.
    """

    frame: RecordedFrame  #: the recorded frame
    depth_m: NDArray[np.float32]  #: (H, W) depth along the optical axis; inf where there is neither floor nor object
    #: (H, W, 3) unit normals of floor and objects, towards the camera, in the axes of the left camera; zero where there
    #: is neither.
    normals: NDArray[np.float32]
    albedo: Image  #: (H, W, 3), 255 = white
    clean: Image  #: (H, W, 3) image in clear water without marine snow, by the same lamps and sensor, without noise
    #: components (H, W, 3) of the light by name, for the bands R, G, B: "lamp" (illuminance of the floor by lamps and
    #: daylight [lx]; NaN where there is no floor or the water transmits too little light to compute it), and the
    #: radiances [cd/m2] "direct" (light from the floor, not scattered on its way to the camera), "forward" (scattered
    #: on its way), "veil" (backscatter) and "snow" (change by marine snow). "forward" and "snow" exist only if the
    #: scenario has forward scatter and marine snow.
    light: Mapping[str, NDArray[np.float32]]
    labels: NDArray[np.uint16]  #: (H, W) number of the object at each pixel, from 1; 0: the floor, or nothing
    #: (H, W, 2) displacement (columns, rows) of each point to the next recorded image; NaN where there is no point, or
    #: it is outside the next image, hidden in it, or belongs to a swaying object; None for the last frame.
    flow_px: NDArray[np.float32] | None
    #: RMS of the recorded image minus f times the image rendered again without noise [grey levels], with the factor of
    #: exposure f that makes it smallest; values at full scale are left out.
    difference: float
    #: whether the image rendered again with its noise equals the recorded image; None if this was not compared.
    identical: bool | None


class TrueLayers(NamedTuple):
    """True layers of a run."""

    object_names: tuple[str, ...]  #: name of the object of each label, from 1
    #: layers of the recorded frames in the order of time, computed when requested; raises TwinError if a recorded image
    #: cannot be read.
    frames: Iterator[FrameTruth]


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
    #: renders the world again; None for recorded data, for runs with the surrogate, and without recorded true poses.
    true_layers: Callable[[], TrueLayers] | None = None
    imu: RecordedImu | None = None  #: readings of the IMU, if recorded
    true_map: Path | None = None  #: file of the true heights (dem_truth.tif)
    jpeg_quality: int | None = None  #: quality of the exported images as JPEG, 1 to 100; None: the PNG files are copied
    #: called with the completed fraction of the format that is being written, 0 to 1.
    progress: Callable[[float], None] = field(default=lambda _: None)
    notes: tuple[str, ...] = ()  #: sentences on files of the run that are missing

    @property
    def pairs(self) -> tuple[RecordedFrame, ...]:
        """Returns the recorded frames that have a right image."""
        return tuple(frame for frame in self.frames if frame.right is not None)

    @property
    def believed(self) -> StereoCalibration:
        """Returns the believed calibration as camera models."""
        return rectified_calibration(self.rig)

    @property
    def best_calibration(self) -> StereoCalibration:
        """Returns the true calibration if it is known, otherwise the believed one."""
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
