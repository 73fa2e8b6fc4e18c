"""Positions that the estimators measure with a wrong calibration or an approximated port, instead of the true ones.

A true point is imaged by the true cameras (lens, port, calibration errors) and the image is rectified with the believed
calibration (`imaging.true_cameras`). The estimators then remove the pitch, the roll and the row offset of the right
image that they estimate from row differences (`estimate.vision.epipolar_calibration`). The result is a deterministic
map from the true (x, y, disparity) of a point to the measured one, tabulated once per survey on a regular grid over the
image and disparity. The row differences that remain increase the scatter of the measured ones beyond that of the noise,
and the estimators increase their covariances accordingly (`stereo.row_noise_ratio`).

All positions are normalised: (x, y) = (X, Y) / Z, and disparity = believed baseline / Z for a true point (X, Y, Z).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from twin.core import geometry
from twin.core.geometry import Array
from twin.core.quality import EpipolarError
from twin.core.records import StereoObservation, StereoRig
from twin.estimate.vision import stereo
from twin.estimate.vision.epipolar_calibration import CORRECTED, NOTICEABLE_PX, EpipolarCalibration, row_jacobian
from twin.estimate.vision.stereo import StereoPoints
from twin.imaging.camera.true_cameras import TrueCameras
from twin.kernels import kernel

_SHAPE = (5, 31, 41)  # grid points along disparity, y and x
_MARGIN = 1.3  # extent of the grid, in units of the image
_STEP_DEPTHS = 0.01  # step of the camera for the numerical Jacobian of the image motion, in units of depth and in rad
#: (6, 3, 3) rotations of the camera by this step and back, about x, y and z; a row vector times one is turned back.
_TURNED = np.array([geometry.so3_exp(step) for step in _STEP_DEPTHS * np.concatenate([np.eye(3), -np.eye(3)])])
_FIT_ITERATIONS = 3
_INVERSE_ITERATIONS = 8


class ViewTable(NamedTuple):
    """Measured values on a regular grid of true (disparity, y, x)."""

    #: (n_disparity, n_y, n_x, 4) measured x, y and disparity, and remaining row difference, right minus left; NaN where
    #: a point is not imaged. Empty if all points are measured at their true positions.
    values: Array
    first: Array  #: (3,) true disparity, y and x of the first grid point
    step: Array  #: (3,) spacing of the grid
    yaw_rad: float = 0.0  #: yaw of the right camera for which the measured positions are corrected (`self_calibration`)


class MeasuredView(NamedTuple):
    """Measured positions and row differences of true points after the estimators have removed rectification errors."""

    table: ViewTable
    #: (4,) pitch, yaw (0; see `ViewTable.yaw_rad`), roll [rad] and row offset (normalised) that the estimators remove
    removed: Array

    @property
    def is_ideal(self) -> bool:
        return not self.table.values.size and not self.table.yaw_rad

    def without_yaw(self, yaw_rad: float) -> MeasuredView:
        """Returns the view after a correction for a yaw of the right camera [rad]."""
        return self._replace(table=self.table._replace(yaw_rad=yaw_rad))

    def measure(self, points: Array) -> Array:
        """Returns the measured positions (n, 3) of true points (n, 3); NaN for points that are not imaged."""
        return np.ascontiguousarray(_measure_all(self.table, points)[:, :3])

    def measure_with_rows(self, points: Array) -> Array:
        """Returns, like `measure`, positions and remaining row differences, right minus left, (n, 4)."""
        return _measure_all(self.table, points)

    def true_directions(self, measured_xy: Array, disparity: float) -> Array:
        """Returns the true (x, y) (n, 2) of points at a true disparity that are measured at `measured_xy`."""
        if self.is_ideal:
            return measured_xy
        true = measured_xy.copy()
        for _ in range(_INVERSE_ITERATIONS):
            measured = self.measure(np.column_stack([true, np.full(len(true), disparity)]))
            true = true + np.nan_to_num(measured_xy - measured[:, :2])
        return true

    def motion_gain(self, points: Array, baseline_m: float) -> Array:
        """Returns the (6, 6) matrix that maps the twist of a small true motion to the twist estimated from images."""
        # least squares from the measured flow and depth of true points (n, 3); see `sampling.unit_motion_cov`; empty if
        # all are measured at their true positions
        if self.is_ideal:
            return np.zeros((0, 0))
        measured = self.measure(points)
        true_flow = _flow(points, baseline_m, lambda moved: self.measure(moved)[:, :2])
        model_flow = _flow(measured, baseline_m, lambda moved: moved[:, :2])
        known = np.isfinite(true_flow).all(axis=1)
        return np.asarray(np.linalg.lstsq(model_flow[known], true_flow[known], rcond=None)[0], np.float64)


IDEAL_VIEW = MeasuredView(ViewTable(np.zeros((0, 0, 0, 4)), np.zeros(3), np.ones(3)), np.zeros(4))


def measured_view(cameras: TrueCameras, rig: StereoRig, depths_m: Array) -> MeasuredView:
    """Returns the measured view of a stereo rig, over a floor with ascending depths (m,) [m]."""
    if cameras.sampling is None and cameras.rendered_rig.baseline_m == rig.baseline_m:
        return IDEAL_VIEW
    axes = _axes(rig, depths_m)
    grid = np.stack(np.meshgrid(*axes, indexing="ij")[::-1], axis=-1)  # x, y, disparity
    left, right = (rig.normalised(px) for px in rig.without_refraction(*_images_px(cameras, rig, grid)))
    removed = _removed(left, right, grid, rig)
    right = _without(right, removed)
    (x, y), (x_right, y_right) = (np.moveaxis(image, -1, 0) for image in (left, right))
    values = np.stack([x, (y + y_right) / 2, x - x_right, y_right - y], axis=-1)
    first, step = np.array([axis[0] for axis in axes]), np.array([axis[1] - axis[0] for axis in axes])
    return MeasuredView(ViewTable(values, first, step), removed)


def _axes(rig: StereoRig, depths_m: Array) -> tuple[Array, Array, Array]:
    """Returns the normalised values of disparity, y and x at the grid points, each (n,)."""
    disparity = np.linspace(rig.baseline_m / (1.5 * depths_m[-1]), rig.baseline_m / (0.7 * depths_m[0]), _SHAPE[0])
    sides = ((rig.height_px, rig.cy_px), (rig.width_px, rig.cx_px))
    y, x = (
        ((np.linspace(-_MARGIN, _MARGIN, n) + 1) * side / 2 - 0.5 - centre) / rig.focal_px
        for n, (side, centre) in zip(_SHAPE[1:], sides, strict=True)
    )
    return disparity, y, x


def _images_px(cameras: TrueCameras, rig: StereoRig, grid: Array) -> tuple[Array, Array]:
    """Returns the pixels (..., 2) of points (..., 3) in the left and the right rectified image."""
    depth_m = rig.baseline_m / grid[..., 2:]
    points_m = (np.concatenate([grid[..., :2], np.ones_like(depth_m)], axis=-1) * depth_m).reshape(-1, 3)
    to_right_m = np.array([cameras.rendered_rig.baseline_m, 0.0, 0.0])
    left, right = (
        cameras.project(points_m - offset, camera).reshape(*grid.shape[:-1], 2)
        for camera, offset in enumerate((np.zeros(3), to_right_m))
    )
    return left, right


def _removed(left: Array, right: Array, grid: Array, rig: StereoRig) -> Array:
    middle = _SHAPE[0] // 2
    left, right = left[middle].reshape(-1, 2), right[middle].reshape(-1, 2)
    half = np.array([rig.width_px, rig.height_px]) / 2 / rig.focal_px
    inside = np.all((np.abs(left) < half) & (np.abs(right) < half), axis=1)  # NaN is outside
    left, right = left[inside], right[inside]
    if len(left) < 4 * _FIT_ITERATIONS:
        return np.zeros(4)
    removed = np.zeros(4)
    for _ in range(_FIT_ITERATIONS):
        corrected = _without(right, removed)
        jacobian = row_jacobian(*corrected.T)
        change = np.linalg.lstsq(jacobian, corrected[:, 1] - left[:, 1], rcond=None)[0] * CORRECTED
        removed = removed + change
    shift = np.abs(_without(right, removed)[:, 1] - right[:, 1]).max()
    return removed if shift * rig.focal_px > NOTICEABLE_PX else np.zeros(4)


def _without(right: Array, removed: Array) -> Array:
    """Returns the normalised positions (..., 2) in the right image after `EpipolarCalibration.rectify`."""
    rotation = geometry.so3_exp(-removed[:3])
    rays = np.concatenate([right - [0.0, removed[3]], np.ones_like(right[..., :1])], axis=-1) @ rotation
    return rays[..., :2] / rays[..., 2:]


def _flow(points: Array, baseline_m: float, image_of) -> Array:
    """Returns the derivative (2 n, 6) of `image_of` points (n, 3), (n, 2), with respect to the camera's motion."""
    depth_m = baseline_m / points[:, 2:]
    xyz = np.column_stack([points[:, :2], np.ones(len(points))]) * depth_m
    scale = _STEP_DEPTHS * np.append(np.ones(3), np.full(3, float(np.median(depth_m))))
    shifts = np.concatenate([-np.diag(scale[3:]), np.diag(scale[3:])]).reshape(2, 3, 1, 3)
    turned = (xyz @ _TURNED).reshape(2, 3, -1, 3)
    moved = np.concatenate([turned, xyz + shifts], axis=1).reshape(-1, 3)
    images = image_of(np.column_stack([moved[:, :2] / moved[:, 2:], baseline_m / moved[:, 2]]))
    ahead, back = images.reshape(2, len(scale), 2 * len(points))
    return ((ahead - back) / (2 * scale[:, None])).T


@kernel(allocates=False, forceinline=True)
def measure_point(table, x, y, disparity):
    """Returns the measured x, y, disparity and row difference of a true point; the table is extrapolated linearly."""
    m0, m1, m2, m3 = x, y, disparity, 0.0
    if table.values.size:
        m0, m1, m2, m3 = _interpolated(table, x, y, disparity)
    right = m0 - m2  # column in the right image; see `observation_equations.change_by_yaw`
    turned = table.yaw_rad * right * m1
    return m0, m1 + turned / 2, m2 - table.yaw_rad * (1 + right * right), m3 + turned


@kernel(allocates=False, forceinline=True)
def _interpolated(table, x, y, disparity):
    values = table.values
    n, rows, cols, _ = values.shape
    c, a = _interval((disparity - table.first[0]) / table.step[0], n)
    r, b = _interval((y - table.first[1]) / table.step[1], rows)
    k, e = _interval((x - table.first[2]) / table.step[2], cols)
    m0 = m1 = m2 = m3 = 0.0
    for i in range(2):
        wi = a if i else 1 - a
        for j in range(2):
            wj = wi * (b if j else 1 - b)
            for h in range(2):
                w, at = wj * (e if h else 1 - e), values[c + i, r + j, k + h]
                m0, m1, m2, m3 = m0 + w * at[0], m1 + w * at[1], m2 + w * at[2], m3 + w * at[3]
    return m0, m1, m2, m3


@kernel(allocates=False, forceinline=True)
def _interval(position, n):
    """Returns the index of the grid interval that contains a position, and the relative position in it."""
    k = min(max(int(np.floor(position)), 0), n - 2)
    return k, position - k


@kernel
def _measure_all(table, points):
    measured = np.empty((len(points), 4))
    for k in range(len(points)):
        values = measure_point(table, points[k, 0], points[k, 1], points[k, 2])
        measured[k, 0], measured[k, 1], measured[k, 2], measured[k, 3] = values
    return measured


_MAD_TO_SIGMA = 1.4826
_SIGNIFICANT = 2 * 1.17  # two standard errors of the noise ratio, times the root of the number of points


class MeasuredRows:
    """Row differences measured so far, of matched patches with sides of `patch_px`, with noise from `rng`."""

    def __init__(self, view: MeasuredView, rig: StereoRig, patch_px: int, rng: np.random.Generator):
        self._view, self._rig, self._patch_px, self._rng = view, rig, patch_px, rng
        self._calibration = EpipolarCalibration()
        self._calibration.removed = view.removed

    def correct_yaw(self, yaw_rad: float, sigma_rad: float) -> MeasuredView:
        """Corrects for a yaw of the right camera as `EpipolarCalibration`; returns the view from now on."""
        self._calibration.correct_yaw(yaw_rad, sigma_rad, self._rig)
        self._view = self._view.without_yaw(float(self._calibration.removed[1]))
        return self._view

    def are_matched(self, points: Array) -> NDArray[np.bool_]:
        """Returns the mask (n,) of the true points (n, 3) whose measured positions satisfy the epipolar constraint."""
        return stereo.satisfies_epipolar(*self._positions_px(self._view.measure_with_rows(points)))

    def observe(
        self, observation: StereoObservation, points: Array, sigma_px: float
    ) -> tuple[StereoObservation, float]:
        """Adds the row differences of a stereo pair; returns the observation with statistics, and a noise ratio."""
        # the ratio of `stereo.row_noise_ratio`, but for any number of points; `points` (n, 3) are true ones that
        # represent `observation.n_points` matches, `sigma_px` is the standard deviation of a match in one image [px]
        measured, row_sigma_px = self._view.measure_with_rows(points), np.sqrt(2) * sigma_px
        rows_px = measured[:, 3] * self._rig.focal_px
        of_raster = row_sigma_px * np.sqrt(len(points) / observation.n_points)
        self._add(measured, rows_px + of_raster * self._rng.standard_normal(len(points)), of_raster)
        offset_px = float(np.median(rows_px))
        spread_px = float(np.hypot(row_sigma_px, _MAD_TO_SIGMA * np.median(np.abs(rows_px - offset_px))))
        ratio = spread_px / row_sigma_px
        described = observation._replace(
            row_offset_px=offset_px, row_spread_px=spread_px, row_sigma_px=float(row_sigma_px)
        )
        return described, ratio if ratio > 1 + _SIGNIFICANT / np.sqrt(observation.n_points) else 1.0

    def report(self) -> EpipolarError:
        return self._calibration.report()

    def _add(self, measured: Array, rows_px: Array, sigma_px: float) -> None:
        """Updates the estimate of the rectification errors with the row differences (n,) of points (n, 4)."""
        n, (left, _) = len(measured), self._positions_px(measured)
        cov = np.broadcast_to(np.eye(3) * (sigma_px / 2 / self._rig.focal_px) ** 2, (n, 3, 3))
        zeros = np.zeros((n, 3))
        pair = StereoPoints(left.astype(np.float32), zeros, zeros[:, 0], measured[:, :3], cov, zeros, rows_px)
        self._calibration.add(pair, self._rig, self._patch_px)

    def _positions_px(self, measured: Array) -> tuple[Array, Array]:
        """Returns columns and rows (n, 2) in the left and the right image of points (n, 4), see `measure_with_rows`."""
        x, y, disparity, rows = measured.T * self._rig.focal_px
        centre = [self._rig.cx_px, self._rig.cy_px]
        return np.stack([x, y - rows / 2], axis=1) + centre, np.stack([x - disparity, y + rows / 2], axis=1) + centre
