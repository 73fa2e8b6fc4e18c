"""Rectification of recorded stereo pairs: removes lens distortion and rotates both cameras to parallel axes."""

import math
from typing import Literal, NamedTuple

import cv2
import numpy as np

from twin.core import geometry, resample
from twin.core.geometry import Array
from twin.core.records import Image, StereoRig
from twin.core.resample import Positions
from twin.datasets.calibration import RecordedCamera, StereoCalibration, camera_matrix, rectified_calibration
from twin.errors import TwinError

#: Largest deviations of a pair that counts as rectified: relative rotation [rad], y and z of the right camera as
#: fractions of the baseline, differences of focal lengths and principal points [px].
_PARALLEL_RAD, _ACROSS, _EQUAL_PX = 1e-6, 1e-6, 1e-3
_KEPT = 0.8  # resolution at the centre that a wide lens keeps, as a fraction


class Rectification(NamedTuple):
    """Conversion of recorded images to a rectified pair."""

    rig: StereoRig  #: calibration of the rectified pair
    left_from_rectified: Array  #: (4, 4) pose of the rectified left camera in the axes of the recorded one (a rotation)
    #: for each camera (left, right), column and row (H, W, 2) at which the recorded image is sampled for the pixels of
    #: the rectified image [px]; None if its recorded images are used unchanged.
    maps: tuple[Positions | None, Positions | None]
    kept: str = ""  #: how much of the field of view and of the resolution is kept, as the end of a sentence

    @property
    def sentence(self) -> str:
        as_recorded = all(positions is None for positions in self.maps)
        return "rectified as recorded" if as_recorded else f"rectified by `twin replay`{self.kept}"

    def rectified(self, image: Image, side: Literal["left", "right"]) -> Image:
        """Returns a recorded image of a camera, resampled by cubic splines; black outside of it."""
        positions = self.maps[0 if side == "left" else 1]
        if positions is None:
            return image
        rectified = resample.interpolate(image, positions)
        height, width = image.shape[:2]
        rectified[((positions < -0.5) | (positions > [width - 0.5, height - 0.5])).any(axis=-1)] = 0
        return rectified


def rectification(calibration: StereoCalibration, frame_rate_hz: float, fov_deg: float | None = None) -> Rectification:
    """Returns the rectification for a calibration that states the size of the images.

    For a pair that was recorded rectified (`is_rectified`), the camera matrix is that of its left camera. Otherwise,
    the rotations are those of `cv2.stereoRectify` (Bouguet's method). The common camera matrix is that of the same
    function with alpha = 0 (all pixels of a rectified image lie in the recorded image) or, for other lenses than
    "radtan" or with `fov_deg`, the horizontal field of view of the rectified images, that of `_wide_matrix`. Raises
    TwinError if the views of the cameras do not overlap, or the field of view is not allowed.
    """
    left, right = calibration.left, calibration.right
    assert left.size_px is not None
    recorded_deg, as_recorded = _field_deg(left), is_rectified(calibration)
    if fov_deg is not None and (as_recorded or not 5 <= fov_deg <= min(recorded_deg, 160)):
        allowed = "no value for a pair recorded rectified" if as_recorded else f"5 to {min(recorded_deg, 160):.0f} deg"
        raise TwinError("--field", f"{fov_deg:g} deg", allowed)
    if as_recorded:
        rig = _rig(left.matrix, calibration, left.size_px, frame_rate_hz)
        equal = np.abs(left.matrix - right.matrix).max() < _EQUAL_PX
        return Rectification(rig, np.eye(4), (None, None if equal else _maps(right, np.eye(3), rig)))
    wide = fov_deg is not None or left.kind != "radtan" or right.kind != "radtan"
    lenses = [np.zeros(5) if wide else camera.distortion for camera in (left, right)]  # without effect on rotations
    turns = cv2.stereoRectify(
        left.matrix, lenses[0], right.matrix, lenses[1], left.size_px, calibration.right_from_left[:3, :3].copy(),
        calibration.right_from_left[:3, 3:].copy(), flags=cv2.CALIB_ZERO_DISPARITY, alpha=0.0,
    )[:3]  # fmt: skip
    left_turn, right_turn, projection = (np.asarray(turn, np.float64) for turn in turns)
    matrix = _wide_matrix(calibration, (left_turn, right_turn), fov_deg) if wide else projection[:, :3]
    if not (np.isfinite(matrix).all() and matrix[0, 0] > 1):
        raise TwinError(str(calibration.file), "the views of the two cameras do not overlap", "a stereo pair")
    rig = _rig(matrix, calibration, left.size_px, frame_rate_hz)
    maps = _maps(left, left_turn, rig), _maps(right, right_turn, rig)
    share, kept_deg = rig.focal_px / _centre_focal_px(left), _field_deg(rectified_calibration(rig).left)
    kept = f": {kept_deg:.0f} of {recorded_deg:.0f} deg across, {100 * share:.0f} % of the resolution at the centre"
    return Rectification(rig, geometry.pose(left_turn.T, np.zeros(3)), maps, kept)


def _wide_matrix(calibration: StereoCalibration, turns: tuple[Array, Array], fov_deg: float | None) -> Array:
    """Returns the common camera matrix (3, 3) of any lenses (`turns`); not finite if the views do not overlap."""
    # By default, the focal length keeps `_KEPT` of the resolution at the centre (an image of the same size that holds
    # all of a wide field is coarse there), or more if the rectified images then lie in the recorded ones.
    cameras, (width_px, height_px) = (calibration.left, calibration.right), calibration.left.size_px or (0, 0)
    principal = np.mean([camera.matrix[:2, 2] for camera in cameras], axis=0)
    ahead = np.mean([turn[:2, 2] / turn[2, 2] for turn in turns], axis=0)  # the optical axes in rectified axes
    grid = np.stack(np.meshgrid(np.linspace(0, width_px - 1, 50), np.linspace(0, height_px - 1, 50), 1.0), -1)

    def matrix(focal_px: float) -> Array:
        return camera_matrix(focal_px, focal_px, *(principal - focal_px * ahead))

    def inside(focal_px: float) -> bool:
        rays = grid.reshape(-1, 3) @ np.linalg.inv(matrix(focal_px)).T
        pixels = np.vstack([camera.project(rays @ turn) for camera, turn in zip(cameras, turns, strict=True)])
        return bool(((pixels > -0.5) & (pixels < [width_px - 0.5, height_px - 0.5])).all())

    if fov_deg is not None:
        return matrix(width_px / 2 / math.tan(math.radians(fov_deg) / 2))
    focals_px = max(map(_centre_focal_px, cameras)) * np.geomspace(_KEPT, 4, 200)
    return matrix(next(filter(inside, focals_px.tolist()), math.nan))


def _centre_focal_px(camera: RecordedCamera) -> float:
    """Returns the pixels per radian along the rows at the optical axis."""
    return float(camera.project(np.array([[1e-4, 0, 1.0]]))[0, 0] - camera.matrix[0, 2]) / 1e-4


def _field_deg(camera: RecordedCamera) -> float:
    """Returns the horizontal field of view through the principal point, up to 220 deg (radtan: 180 deg)."""
    assert camera.size_px is not None
    angles, columns, last_deg = _row_through_centre(camera)
    outside = angles[(columns < -0.5) | (columns > camera.size_px[0] - 0.5)]
    return float(outside.min(where=outside > 0, initial=last_deg) - outside.max(where=outside < 0, initial=-last_deg))


def _row_through_centre(camera: RecordedCamera) -> tuple[Array, Array, float]:
    """Returns angles (n,) of rays from the optical axis [deg], their columns (n,) [px], and the largest valid angle.

    Beyond the last [deg], the polynomial of the distortion falls, so that it shows directions that the lens does not.
    """
    widest = 90 if camera.kind == "radtan" else 110
    angles = np.linspace(-widest, widest, 20 * widest + 2)[1:-1]
    rays = np.column_stack([np.sin(np.radians(angles)), 0 * angles, np.cos(np.radians(angles))])
    columns = camera.project(rays)[:, 0]
    falls = np.abs(angles[1:])[np.diff(columns) <= 0]
    return angles, columns, float(falls.min(initial=widest))


def is_rectified(calibration: StereoCalibration) -> bool:
    """Returns whether the recorded images are rectified, but for a shift of the right one along its rows."""
    # no distortion, parallel axes, a baseline along the rows, equal focal lengths and rows of the principal points;
    # their columns may differ, as in the Middlebury data sets
    left, right = calibration.left, calibration.right
    offset = calibration.right_from_left[:3, 3]
    parallel = np.linalg.norm(geometry.so3_log(calibration.right_from_left[:3, :3])) < _PARALLEL_RAD
    aligned = float(np.abs(offset[1:]).max()) <= _ACROSS * calibration.baseline_m
    equal = np.abs(left.matrix - right.matrix)[[0, 1, 1], [0, 1, 2]].max() < _EQUAL_PX
    bent = any(camera.distortion.any() or camera.kind == "fisheye" for camera in (left, right))
    return bool(parallel and aligned and equal and not bent)


def _rig(matrix: Array, calibration: StereoCalibration, size_px: tuple[int, int], frame_rate_hz: float) -> StereoRig:
    return StereoRig(
        width_px=size_px[0], height_px=size_px[1], focal_px=float(matrix[0, 0]), baseline_m=calibration.baseline_m,
        frame_rate_hz=frame_rate_hz, focal_y_px=None if matrix[0, 0] == matrix[1, 1] else float(matrix[1, 1]),
        principal_point_px=(float(matrix[0, 2]), float(matrix[1, 2])),
        yaw_sigma_rad=math.radians(calibration.rotation_sigma_deg), baseline_sigma=calibration.baseline_sigma,
    )  # fmt: skip


def _maps(camera: RecordedCamera, turn: Array, rig: StereoRig) -> Positions:
    """Returns column and row (H, W, 2) [px] in the recorded image; `turn` is rectified_from_recorded (3, 3)."""
    ray_from_pixel, last_deg = np.linalg.inv(rig.matrix).T @ turn, _row_through_centre(camera)[2]
    positions, pixels = np.empty((rig.height_px, rig.width_px, 2), np.float32), np.ones((rig.width_px, 3))
    pixels[:, 0] = np.arange(rig.width_px)
    for row, of_row in enumerate(positions):
        pixels[:, 1] = row
        x, y, z = rays = (pixels @ ray_from_pixel).T
        of_row[:] = camera.project(rays.T)
        of_row[np.degrees(np.arctan2(np.hypot(x, y), z)) > last_deg] = -1e4  # outside
    return positions
