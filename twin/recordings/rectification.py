"""Rectification of recorded stereo pairs: removes lens distortion and rotates both cameras to parallel axes."""

from __future__ import annotations

import math
from typing import Literal, NamedTuple

import cv2
import numpy as np

from twin.core import geometry, resample
from twin.core.geometry import Array
from twin.core.records import Image, StereoRig
from twin.core.resample import Positions
from twin.datasets.calibration import RecordedCamera, StereoCalibration
from twin.errors import TwinError

#: Largest deviations of a pair that counts as rectified: relative rotation [rad], y and z of the right camera as
#: fractions of the baseline, differences of focal lengths and principal points [px].
_PARALLEL_RAD, _ACROSS, _EQUAL_PX = 1e-6, 1e-6, 1e-3


class Rectification(NamedTuple):
    """Conversion of recorded images to a rectified pair."""

    rig: StereoRig  #: calibration of the rectified pair
    left_from_rectified: Array  #: (4, 4) pose of the rectified left camera in the axes of the recorded one (a rotation)
    #: for each camera (left, right), column and row (H, W, 2) at which the recorded image is sampled for the pixels of
    #: the rectified image [px]; None if its recorded images are used unchanged.
    maps: tuple[Positions | None, Positions | None]

    @property
    def sentence(self) -> str:
        as_recorded = all(positions is None for positions in self.maps)
        return "rectified as recorded" if as_recorded else "rectified by `twin replay`"

    def rectified(self, image: Image, side: Literal["left", "right"]) -> Image:
        """Returns a recorded image of a camera, resampled by cubic splines; black outside of it."""
        positions = self.maps[0 if side == "left" else 1]
        if positions is None:
            return image
        rectified = resample.interpolate(image, positions)
        height, width = image.shape[:2]
        rectified[((positions < -0.5) | (positions > [width - 0.5, height - 0.5])).any(axis=-1)] = 0
        return rectified


def rectification(calibration: StereoCalibration, frame_rate_hz: float) -> Rectification:
    """Returns the rectification for a calibration that states the size of the images.

    For a pair that was recorded rectified (`is_rectified`), the camera matrix is that of its left camera. Otherwise,
    the rotations and the common camera matrix are those of `cv2.stereoRectify` (Bouguet's method, alpha = 0: all pixels
    of a rectified image lie in the recorded image) or, for fisheye lenses, of `cv2.fisheye.stereoRectify` with balance
    = 0. Raises TwinError if the cameras have different lens models or views that do not overlap.
    """
    left, right = calibration.left, calibration.right
    assert left.size_px is not None
    width_px, height_px = left.size_px
    if is_rectified(calibration):
        rig = _rig(left.matrix, calibration, left.size_px, frame_rate_hz)
        equal = np.abs(left.matrix - right.matrix).max() < _EQUAL_PX
        return Rectification(rig, np.eye(4), (None, None if equal else _maps(right, np.eye(3), rig)))
    if left.kind != right.kind:
        raise TwinError(str(calibration.file), "the cameras have different lens models", "two radtan or two fisheye")
    rotation, translation = calibration.right_from_left[:3, :3].copy(), calibration.right_from_left[:3, 3:].copy()
    if left.kind == "fisheye":
        turns = cv2.fisheye.stereoRectify(
            left.matrix, _four(left), right.matrix, _four(right), (width_px, height_px), rotation, translation,
            flags=cv2.CALIB_ZERO_DISPARITY, balance=0.0,
        )[:4]  # fmt: skip
    else:
        turns = cv2.stereoRectify(
            left.matrix, left.distortion, right.matrix, right.distortion, (width_px, height_px), rotation, translation,
            flags=cv2.CALIB_ZERO_DISPARITY, alpha=0.0,
        )[:4]  # fmt: skip
    left_turn, right_turn, projection, _ = (np.asarray(turn, np.float64) for turn in turns)
    if not (np.isfinite(projection).all() and projection[0, 0] > 1):
        raise TwinError(str(calibration.file), "the views of the two cameras do not overlap", "a stereo pair")
    rig = _rig(projection[:, :3], calibration, left.size_px, frame_rate_hz)
    maps = _maps(left, left_turn, rig), _maps(right, right_turn, rig)
    return Rectification(rig, geometry.pose(left_turn.T, np.zeros(3)), maps)


def is_rectified(calibration: StereoCalibration) -> bool:
    """Returns whether the recorded images are a rectified pair, but for a shift of the right image along its rows.

    Such a pair has no distortion, parallel axes, a baseline along the image rows, and equal focal lengths and rows of
    the principal points. Their columns may differ, as in the Middlebury data sets.
    """
    left, right = calibration.left, calibration.right
    offset = calibration.right_from_left[:3, 3]
    parallel = np.linalg.norm(geometry.so3_log(calibration.right_from_left[:3, :3])) < _PARALLEL_RAD
    aligned = float(np.abs(offset[1:]).max()) <= _ACROSS * calibration.baseline_m
    equal = np.abs(left.matrix - right.matrix)[[0, 1, 1], [0, 1, 2]].max() < _EQUAL_PX
    return bool(parallel and aligned and equal and not left.distortion.any() and not right.distortion.any())


def _rig(matrix: Array, calibration: StereoCalibration, size_px: tuple[int, int], frame_rate_hz: float) -> StereoRig:
    return StereoRig(
        width_px=size_px[0],
        height_px=size_px[1],
        focal_px=float(matrix[0, 0]),
        baseline_m=calibration.baseline_m,
        frame_rate_hz=frame_rate_hz,
        focal_y_px=None if matrix[0, 0] == matrix[1, 1] else float(matrix[1, 1]),
        principal_point_px=(float(matrix[0, 2]), float(matrix[1, 2])),
        yaw_sigma_rad=math.radians(calibration.rotation_sigma_deg),
        baseline_sigma=calibration.baseline_sigma,
    )


def _four(camera: RecordedCamera) -> Array:
    return camera.distortion if len(camera.distortion) == 4 else np.zeros(4)


def _maps(camera: RecordedCamera, turn: Array, rig: StereoRig) -> Positions:
    """Returns column and row (H, W, 2) [px] in the recorded image; `turn` is rectified_from_recorded (3, 3)."""
    size = rig.width_px, rig.height_px
    if camera.kind == "fisheye":
        maps = cv2.fisheye.initUndistortRectifyMap(camera.matrix, _four(camera), turn, rig.matrix, size, cv2.CV_32FC1)
    else:
        maps = cv2.initUndistortRectifyMap(camera.matrix, camera.distortion, turn, rig.matrix, size, cv2.CV_32FC1)
    return np.stack(maps, axis=-1).astype(np.float32)
