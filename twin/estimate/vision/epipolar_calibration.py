"""Estimation of small errors of the rectification from the row differences of matched points.

With the rotation vector w [rad] of the right camera from its ideal attitude and an offset e of the row of its principal
point [focal lengths], the normalised row of a point at (x, y) changes by

    dy = w_x (1 + y^2) - w_y x y - w_z x + e

(Hartley & Zisserman 2004, section 6.1). Pitch, roll and offset are removed from the right image; this estimate of the
yaw is not, because a distortion error looks nearly the same and a wrong yaw would shift all disparities (that of the
motions is, see `self_calibration`). `_pattern` separates matching noise, which averages out in a region of the image,
from errors of the calibration.
"""

import numpy as np
from numpy.typing import NDArray

from twin.core import geometry, resample
from twin.core.geometry import Array
from twin.core.quality import EpipolarError
from twin.core.records import Image, StereoRig
from twin.estimate.vision import matching
from twin.estimate.vision.stereo import StereoPoints
from twin.kernels import kernel

CORRECTED = np.array([True, False, True, True])  #: the estimates that are removed from right images
#: Prior standard deviations of pitch, yaw, roll [rad] and offset (normalised): 20 times those of a poor calibration.
_PRIOR_SIGMA = np.array([0.02, 0.02, 0.02, 0.02])
_SIGNIFICANT = 4.0  # smallest change of a row by an update of the correction [standard deviations]
NOTICEABLE_PX = 0.02  #: smallest change of a row by an update of the correction [px]
_HUBER = 1.5
_ITERATIONS = 5
_MAD_TO_SIGMA = 1.4826
_REGIONS = (4, 3)  # regions of the image along columns and rows


def _pattern(regions: Array, estimate: Array) -> float:
    """Returns the weighted RMS over m regions of the mean row difference that `estimate` does not explain."""
    # `regions` (m, 6): sums of weights, weighted normalised row differences and derivatives (`row_jacobian`); m - 4 is
    # the expectation of the weighted sum of the squared means due to matching noise
    regions = regions[regions[:, 0] > 0]
    weight, rows, jacobian = regions[:, 0].copy(), regions[:, 1], regions[:, 2:].copy()
    mean = (rows - jacobian @ estimate) / weight
    excess = float(np.sum(weight * mean**2)) - max(len(weight) - len(estimate), 0)
    return float(np.sqrt(max(excess, 0.0) / np.sum(weight))) if len(weight) else 0.0


@kernel
def _robust_weights(jacobian, rows, sigma, inflation, information, vector):
    """Returns the weights (n,) of normalised row differences in the estimate, on which they depend themselves."""
    estimate, weight = np.linalg.solve(information, vector), np.empty(len(rows))
    for _ in range(_ITERATIONS):
        size = np.abs(rows - jacobian @ estimate) / sigma
        scale = max(1.0, _MAD_TO_SIGMA * np.median(size))
        matrix, right = information.copy(), vector.copy()
        for i in range(len(rows)):
            weight[i] = min(1.0, _HUBER * scale / max(size[i], 1e-12)) / (scale * sigma[i]) ** 2 / inflation
            for p in range(4):
                right[p] += weight[i] * jacobian[i, p] * rows[i]
                for q in range(4):
                    matrix[p, q] += weight[i] * jacobian[i, p] * jacobian[i, q]
        estimate = np.linalg.solve(matrix, right)
    return weight


class EpipolarCalibration:
    """Errors of the rectification, estimated from all stereo pairs so far (recursive weighted least squares).

    `removed` (4,) are the pitch, yaw (`correct_yaw`), roll [rad] and row offset (normalised) that `rectify` removes.
    """

    def __init__(self) -> None:
        self._information = np.diag(_PRIOR_SIGMA**-2)
        self._vector = np.zeros(4)
        self._regions = np.zeros((_REGIONS[0] * _REGIONS[1], 6))  # see `_pattern`
        self.removed = np.zeros(4)

    def add(self, points: StereoPoints, rig: StereoRig, patch_px: int) -> None:
        """Adds the row differences of one stereo pair whose right image was rectified with `removed`."""
        x, y = points.measured[:, 0] - points.measured[:, 2], points.measured[:, 1]
        jacobian = row_jacobian(x, y)
        rows = points.row_difference_px / rig.focal_px + jacobian @ self.removed
        sigma, inflation = row_sigma(points), matching.variance_inflation(points.pixels, patch_px)
        weight = _robust_weights(jacobian, rows, sigma, inflation, self._information, self._vector)
        self._information = self._information + jacobian.T @ (weight[:, None] * jacobian)
        self._vector = self._vector + jacobian.T @ (weight * rows)
        terms, sums = np.column_stack([weight, weight * rows, weight[:, None] * jacobian]), np.zeros_like(self._regions)
        np.add.at(sums, _region(points.pixels, rig), terms)
        self._regions = self._regions + sums

    @property
    def estimate(self) -> Array:
        """Returns the estimated pitch, yaw, roll [rad] and row offset (normalised), (4,)."""
        return np.asarray(np.linalg.solve(self._information, self._vector), np.float64)

    def update(self, rig: StereoRig) -> bool:
        """Sets pitch, roll and offset of `removed` to their estimates; returns whether they were changed."""
        # if this changes a row by more than 4 standard deviations and 0.02 px in a corner of the image
        change = (self.estimate - self.removed) * CORRECTED
        x, y = np.meshgrid(
            *(
                (np.array([0, side - 1]) - centre) / rig.focal_px
                for side, centre in ((rig.width_px, rig.cx_px), (rig.height_px, rig.cy_px))
            )
        )
        shift = row_jacobian(x.ravel(), y.ravel()) * CORRECTED
        cov = np.linalg.inv(self._information)
        shift_sigma = np.sqrt(np.einsum("ni,ij,nj->n", shift, cov, shift))
        size = np.abs(shift @ change)
        if not np.any((size > _SIGNIFICANT * shift_sigma) & (size * rig.focal_px > NOTICEABLE_PX)):
            return False
        self.removed = self.removed + change
        self._regions = np.zeros_like(self._regions)  # before, matches with large row differences were rejected
        return True

    def correct_yaw(self, yaw_rad: float, sigma_rad: float, rig: StereoRig) -> None:
        """Sets the yaw of `removed`, if it changes disparities by more than a standard deviation and 0.02 px."""
        change = abs(yaw_rad - self.removed[1])
        if change > sigma_rad and change * rig.focal_px > NOTICEABLE_PX:
            self.removed = np.array([self.removed[0], yaw_rad, *self.removed[2:]])

    def rectify(self, right: Image, rig: StereoRig) -> Image:
        """Returns the full right image (H, W, 3) corrected for the errors `removed`; itself if these are zero."""
        if not self.removed.any():
            return right
        matrix = rig.matrix
        offset = np.eye(3)
        offset[1, 2] = self.removed[3] * rig.focal_px
        source_from_result = offset @ matrix @ geometry.exp(np.append(-self.removed[:3], np.zeros(3)))[:3, :3]
        source_from_result = source_from_result @ np.linalg.inv(matrix)
        v, u = np.mgrid[: rig.height_px, : rig.width_px]
        at = np.stack([u, v, np.ones_like(u)], axis=-1) @ source_from_result.T
        return resample.interpolate(right, (at[..., :2] / at[..., 2:]).astype(np.float32))

    def report(self) -> EpipolarError:
        sigma = np.sqrt(np.diag(np.linalg.inv(self._information)))
        return EpipolarError(self.estimate, sigma, self.removed.copy(), _pattern(self._regions, self.estimate))


def row_jacobian(x: Array, y: Array) -> Array:
    """Returns the derivatives (n, 4) of normalised rows by pitch, yaw, roll [rad] and normalised row offset."""
    return np.column_stack([1 + y**2, -x * y, -x, np.ones_like(x)])


def _region(pixels: NDArray[np.floating], rig: StereoRig) -> NDArray[np.int64]:
    columns, rows = _REGIONS
    column = np.clip(pixels[:, 0] * columns / rig.width_px, 0, columns - 1).astype(np.int64)
    return column + columns * np.clip(pixels[:, 1] * rows / rig.height_px, 0, rows - 1).astype(np.int64)


def row_sigma(points: StereoPoints) -> Array:
    """Returns the standard deviation (n,) of normalised row differences; `points.cov` has that of the mean row."""
    return 2 * np.sqrt(points.cov[:, 1, 1])


def spread(points: StereoPoints) -> float:
    """Returns the robust standard deviation (1.4826 MAD) of the row differences [px]; 0 without points."""
    rows = points.row_difference_px
    return float(_MAD_TO_SIGMA * np.median(np.abs(rows - np.median(rows)))) if len(rows) else 0.0
