"""Contents of a run for the writers of other programs' formats: images, poses, calibration, maps, readings."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from twin.core.georeference import Georeference
from twin.core.records import Array, ElevationMap, Exposure, Image, ImuReadings, Readings, StereoRig, Trajectory

#: Names of the trajectories that give the poses of exported images; the first one that a run has is used.
POSES = ("truth", "final")


@dataclass(frozen=True)
class RecordedFrame:
    """A frame whose left image is kept in the run folder.

    Args:
        index: number of the frame, from 0, which is its row in the trajectories.
        time_s: time of the exposure since the start of the survey [s].
        left: file of the left image, an 8-bit RGB PNG.
        right: file of the right image; None if the right camera took none.
        keyframe: whether the frame is a keyframe of the estimators.
        readings: readings of the navigation sensors at the frame.
        exposure: linear signal of R, G and B per unit of radiance (`Frame.exposure`); None if not recorded.
    """

    index: int
    time_s: float
    left: Path
    right: Path | None
    keyframe: bool
    readings: Readings = field(default_factory=Readings)
    exposure: Exposure | None = None


class ImuNoise(NamedTuple):
    """Noise densities of an inertial measurement unit (IMU), named and defined as in Kalibr.

    Args:
        gyroscope_noise_density: density of the white noise of each angular rate [rad/s/sqrt(Hz)].
        gyroscope_random_walk: density of the random walk of the bias of each angular rate [rad/s2/sqrt(Hz)].
        accelerometer_noise_density: density of the white noise of each specific force [m/s2/sqrt(Hz)].
        accelerometer_random_walk: density of the random walk of the bias of each specific force [m/s3/sqrt(Hz)].
    """

    gyroscope_noise_density: float
    gyroscope_random_walk: float
    accelerometer_noise_density: float
    accelerometer_random_walk: float


class RecordedImu(NamedTuple):
    """Readings of the IMU of a run, which is at the origin of the body.

    Args:
        readings: all readings of the run, in body axes.
        rate_hz: number of readings per second.
        noise: noise that the scenario states.
        accelerometer_bias_mps2: standard deviation of the bias of each specific force; None if not stated.
    """

    readings: ImuReadings
    rate_hz: float
    noise: ImuNoise
    accelerometer_bias_mps2: float | None = None


class CameraIntrinsics(NamedTuple):
    """Camera model of the rectified images of a run; the centre of the first pixel is at (0, 0).

    Args:
        size_px: (width, height) of the images.
        matrix: (3, 3) camera matrix [px].
        distortion: (5,) coefficients k1, k2, p1, p2, k3 of the pinhole model of OpenCV.
    """

    size_px: tuple[int, int]
    matrix: Array
    distortion: Array


def project(points_m: Array, camera: CameraIntrinsics) -> Array:
    """Returns the pixels (n, 2) of points (n, 3) [m] in camera axes; the centre of the first pixel is at (0, 0).

    The model is that of OpenCV: pinhole with radial and tangential distortion.
    """
    k1, k2, p1, p2, k3 = camera.distortion
    x, y = (points_m[:, :2] / points_m[:, 2:]).T
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    distorted = np.column_stack(
        [x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x), y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y]
    )
    return distorted * [camera.matrix[0, 0], camera.matrix[1, 1]] + camera.matrix[:2, 2]


class RigCalibration(NamedTuple):
    """Calibration of the stereo rig.

    Args:
        left, right: camera models.
        left_from_right: (4, 4) pose of the right camera in the axes of the left camera [m].
        body_from_left: (4, 4) pose of the left camera in the body frame of the vehicle [m].
        residual_px: RMS distance [px] between image points by these models and by the cameras to which the models were
            fitted; 0: exact.
    """

    left: CameraIntrinsics
    right: CameraIntrinsics
    left_from_right: Array
    body_from_left: Array
    residual_px: float = 0.0


class FrameTruth(NamedTuple):
    """True layers of one recorded left image, rendered again at its true pose.

    The layers are those of a pinhole camera with the believed calibration at the true pose of the left camera. They
    are aligned with the recorded image if the scenario has no calibration error, lens distortion or port; otherwise,
    the image deviates from them by the error of its rectification.

    Args:
        frame: the recorded frame.
        depth_m: (H, W) float32 depth along the optical axis; inf where there is neither floor nor object.
        normals: (H, W, 3) float32 unit normals of floor and objects, towards the camera, in the axes of the left
            camera; zero where there is neither.
        albedo: (H, W, 3) uint8, 255 = white.
        clean: (H, W, 3) uint8 image in clear water without marine snow, by the same lamps and sensor, without noise.
        light: components (H, W, 3) float32 of the light by name, for the bands R, G, B: "lamp" (illuminance of the
            floor by lamps and daylight [lx]; NaN where there is no floor or the water transmits too little light to
            compute it), and the radiances [cd/m2] "direct" (light from the floor, not scattered on its way to the
            camera), "forward" (light from the floor, scattered on its way), "veil" (backscatter) and "snow" (change by
            marine snow). "forward" and "snow" exist only if the scenario has forward scatter and marine snow.
        labels: (H, W) uint16, number of the object at each pixel, from 1; 0: the floor, or nothing.
        flow_px: (H, W, 2) float32 displacement (columns, rows) of each point to the next recorded image; NaN where
            there is no point, or it is outside the next image, hidden in it, or belongs to a swaying object; None for
            the last frame.
        difference: RMS of the recorded image minus f times the image rendered again without noise [grey levels], with
            the factor of exposure f that makes it smallest; values at full scale are left out.
        identical: whether the image rendered again with its noise equals the recorded image in every pixel; None if
            this was not compared.
    """

    frame: RecordedFrame
    depth_m: NDArray[np.float32]
    normals: NDArray[np.float32]
    albedo: Image
    clean: Image
    light: Mapping[str, NDArray[np.float32]]
    labels: NDArray[np.uint16]
    flow_px: NDArray[np.float32] | None
    difference: float
    identical: bool | None


class TrueLayers(NamedTuple):
    """True layers of a run.

    Args:
        object_names: name of the object of each label, from 1.
        frames: iterator over the layers of the recorded frames in the order of time, which are computed when they are
            requested. It raises TwinError if a recorded image cannot be read.
    """

    object_names: tuple[str, ...]
    frames: Iterator[FrameTruth]


@dataclass(frozen=True)
class RunContents:
    """Contents of a run folder. Trajectories are those of the left camera in the world (x east, y north, z up) [m].

    Args:
        folder: the run folder.
        name: name of the run.
        scenario: contents of scenario.resolved.toml.
        rig: believed calibration, with which the images were rectified.
        believed: the same calibration as camera models.
        true: true calibration of the delivered images; None if it is not known (recorded data).
        trajectories: by name, those of "truth", "f2f", "online", "final" and "reference" that exist.
        keyframe_rows: (n_keyframes,) row of each keyframe in the trajectories.
        frames: recorded frames in the order of time; empty if no images were kept.
        elevation: elevation map with sigma and the colours of the orthomosaic at its cells; None without a map.
        error_m: (rows, cols) estimated minus true elevation at the cells of the map, NaN where unknown; None without a
            true map.
        orthomosaic: file of the orthomosaic (GeoTIFF, RGBA or RGB); None if the run has no such file.
        georeference: position of the scene in a coordinate reference system (CRS), from the measured DEM or the options
            of the export; None: scene coordinates.
        true_layers: function that renders the world again and returns its true layers; None for recorded data, for runs
            with the surrogate, and without recorded true poses.
        imu: readings of the IMU; None if none were recorded.
        true_map: file of the true heights (dem_truth.tif); None without one.
        jpeg_quality: quality of the exported images as JPEG, 1 to 100; None: the PNG files are copied.
        progress: called with the completed fraction of the format that is being written, 0 to 1.
        notes: sentences on files of the run that are missing.
    """

    folder: Path
    name: str
    scenario: Mapping[str, Any]
    rig: StereoRig
    believed: RigCalibration
    true: RigCalibration | None
    trajectories: Mapping[str, Trajectory]
    keyframe_rows: NDArray[np.int64]
    frames: tuple[RecordedFrame, ...] = ()
    elevation: ElevationMap | None = None
    error_m: NDArray[np.float32] | None = None
    orthomosaic: Path | None = None
    georeference: Georeference | None = None
    true_layers: Callable[[], TrueLayers] | None = None
    imu: RecordedImu | None = None
    true_map: Path | None = None
    jpeg_quality: int | None = None
    progress: Callable[[float], None] = field(default=lambda _: None)
    notes: tuple[str, ...] = ()

    @property
    def pairs(self) -> tuple[RecordedFrame, ...]:
        """Returns the recorded frames that have a right image."""
        return tuple(frame for frame in self.frames if frame.right is not None)

    @property
    def poses(self) -> Trajectory:
        """Returns the best poses of the run: the truth if it is known, otherwise the final trajectory.

        Raises:
            KeyError: the run has neither, for example because its process was killed.
        """
        return self.trajectories[next((name for name in POSES if name in self.trajectories), POSES[-1])]
