"""True calibration of the images of a scenario, as camera models of OpenCV."""

from dataclasses import replace

import numpy as np
from scipy.optimize import least_squares

from twin.core import geometry
from twin.core.geometry import Array
from twin.core.records import StereoRig
from twin.datasets.calibration import RecordedCamera, StereoCalibration, camera_matrix, rectified_calibration
from twin.imaging.camera.true_cameras import TrueCameras, make_true_cameras
from twin.scenario.model import Scenario

_N_COLUMNS = 13  # columns, and rows, of the grid of pixels for the fit
_RANGES = (0.6, 1.0, 1.4)  # depths of the points for the fit, as multiples of the planned altitude


def true_calibration(scenario: Scenario) -> StereoCalibration:
    """Returns the true calibration of the delivered images, which are rectified with the believed calibration.

    Camera matrix, distortion (k1, k2, p1, p2, k3) and, for the right camera, its rotation are fitted by least squares
    to the true pixels (`TrueCameras.project`: port, lens, rectification) of points at 0.6, 1 and 1.4 times the planned
    altitude; `residual_px` is the RMS distance that remains. It is zero, and the result exact, for cameras without lens
    distortion, port and calibration errors (except that of the baseline). Raises TwinError as `make_true_cameras` does.
    """
    cameras = make_true_cameras(scenario)
    rig = scenario.believed_rig()
    rendered_from_left = geometry.inverse(cameras.rendered_rig.left_from_right)
    if cameras.sampling is None:
        return replace(rectified_calibration(rig), right_from_left=rendered_from_left)
    points_m = _points(rig, scenario.plan.altitude_m)
    left, _, left_px = _fitted(cameras, 0, points_m, rig)
    right, right_from_rendered, right_px = _fitted(cameras, 1, points_m, rig)
    residual_px = float(np.sqrt(np.mean(np.concatenate([left_px, right_px]) ** 2) * 2))
    right_from_left = geometry.pose(right_from_rendered, np.zeros(3)) @ rendered_from_left
    return StereoCalibration(left, right, right_from_left, residual_px=residual_px)


def _points(rig: StereoRig, altitude_m: float) -> Array:
    """Returns points (n, 3) [m] in camera axes that fill the image at depths of `_RANGES` times the altitude."""
    columns = np.linspace(0, rig.width_px - 1, _N_COLUMNS)
    rows = np.linspace(0, rig.height_px - 1, _N_COLUMNS)
    pixels = np.stack(np.meshgrid(columns, rows), -1).reshape(-1, 2)
    directions = np.column_stack([rig.normalised(pixels), np.ones(len(pixels))])
    return np.concatenate([directions * (share * altitude_m) for share in _RANGES])


def _fitted(cameras: TrueCameras, side: int, points_m: Array, rig: StereoRig) -> tuple[RecordedCamera, Array, Array]:
    """Returns the model fitted to one camera, its rotation (3, 3) camera_from_rendered, and residuals (2 n,) [px]."""
    # the left one (`side` 0) is not turned, as in the true poses; points (n, 3) without an image are left out
    seen = cameras.project(points_m, side)
    known = np.isfinite(seen).all(axis=1)
    points_m, seen = points_m[known], seen[known]

    def model(p: Array) -> tuple[RecordedCamera, Array]:
        rotation = geometry.so3_exp(p[9:]) if side else np.eye(3)
        return RecordedCamera((rig.width_px, rig.height_px), camera_matrix(*p[:4]), p[4:9]), rotation

    def residuals(p: Array) -> Array:
        camera, rotation = model(p)
        return (camera.project(points_m @ rotation.T) - seen).ravel()

    start = np.array([rig.fx_px, rig.fy_px, rig.cx_px, rig.cy_px, *np.zeros(5 + 3 * side)])
    p = least_squares(residuals, start, x_scale=np.r_[np.full(4, 1.0), np.full(5 + 3 * side, 1e-3)]).x
    return *model(p), residuals(p)
