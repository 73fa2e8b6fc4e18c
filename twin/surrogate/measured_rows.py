"""Row differences of the stereo matches of a survey with calibration errors, and the estimates computed from them.

The deterministic row differences that remain after the removal of pitch, roll and row offset (`measured_view`)
increase the scatter of the measured row differences beyond that of the noise. The estimators measure this scatter and
increase their covariances accordingly (`stereo.row_noise_ratio`). They also estimate the yaw of the right camera and
the systematic pattern of the row differences (`epipolar_calibration`), which the self-check compares with limits.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from twin.core.geometry import Array
from twin.core.quality import EpipolarError
from twin.core.records import StereoObservation, StereoRig
from twin.estimate.vision import stereo
from twin.estimate.vision.epipolar_calibration import EpipolarCalibration
from twin.estimate.vision.stereo import StereoPoints
from twin.surrogate.measured_view import MeasuredView

_MAD_TO_SIGMA = 1.4826
_SIGNIFICANT = 2 * 1.17  # two standard errors of the noise ratio, times the root of the number of points


class MeasuredRows:
    """Row differences measured so far.

    Args:
        view: positions at which true points are measured.
        rig: believed calibration.
        patch_px: side of the matched patches.
        rng: random generator of the noise of row differences.
    """

    def __init__(self, view: MeasuredView, rig: StereoRig, patch_px: int, rng: np.random.Generator):
        self._view, self._rig, self._patch_px, self._rng = view, rig, patch_px, rng
        self._calibration = EpipolarCalibration()
        self._calibration.removed = view.removed

    def are_matched(self, points: Array) -> NDArray[np.bool_]:
        """Returns the mask (n,) of the true points whose measured positions satisfy the epipolar constraint.

        Args:
            points: (n, 3) true normalised (x, y, disparity).
        """
        left, right = self._positions_px(points)
        return stereo.satisfies_epipolar(left, right)

    def observe(
        self, observation: StereoObservation, points: Array, sigma_px: float
    ) -> tuple[StereoObservation, float]:
        """Adds the row differences of a stereo pair.

        Args:
            points: (n, 3) true normalised (x, y, disparity) of points that are matched; they represent
                `observation.n_points` points.
            sigma_px: standard deviation of a match in one image [px].

        Returns:
            The observation with the statistics of the row differences, and their noise ratio. The noise ratio is
            defined as in `stereo.row_noise_ratio`, but for any number of points.
        """
        rows_px, row_sigma_px = self._view.row_difference(points) * self._rig.focal_px, np.sqrt(2) * sigma_px
        of_raster = row_sigma_px * np.sqrt(len(points) / observation.n_points)
        self._add(points, rows_px + of_raster * self._rng.standard_normal(len(points)), of_raster)
        scatter_px = _MAD_TO_SIGMA * np.median(np.abs(rows_px - np.median(rows_px)))
        spread_px = float(np.hypot(row_sigma_px, scatter_px))
        ratio = spread_px / row_sigma_px
        described = observation._replace(
            row_offset_px=float(np.median(rows_px)), row_spread_px=spread_px, row_sigma_px=float(row_sigma_px)
        )
        return described, ratio if ratio > 1 + _SIGNIFICANT / np.sqrt(observation.n_points) else 1.0

    def report(self) -> EpipolarError:
        """Returns the errors of the rectification, estimated from all row differences so far."""
        return self._calibration.report()

    def _add(self, points: Array, rows_px: Array, sigma_px: float) -> None:
        """Updates the estimate of the rectification errors with the row differences (n,) [px] of true points (n, 3)."""
        n, (left, _) = len(points), self._positions_px(points)
        cov = np.tile(np.eye(3) * (sigma_px / 2 / self._rig.focal_px) ** 2, (n, 1, 1))
        measured, zeros = self._view.measure(points), np.zeros((n, 2))
        pair = StereoPoints(
            left.astype(np.float32), zeros, zeros[:, 0], measured, cov, np.zeros((n, 3)), rows_px
        )  # fmt: skip
        self._calibration.add(pair, self._rig, self._patch_px)

    def _positions_px(self, points: Array) -> tuple[Array, Array]:
        """Returns the measured positions (n, 2) of points in the left and the right image [px]."""
        measured, rows = self._view.measure(points), self._view.row_difference(points)
        centre = [self._rig.cx_px, self._rig.cy_px]
        left = np.column_stack([measured[:, 0], measured[:, 1] - rows / 2])
        right = np.column_stack([measured[:, 0] - measured[:, 2], measured[:, 1] + rows / 2])
        return left * self._rig.focal_px + centre, right * self._rig.focal_px + centre
