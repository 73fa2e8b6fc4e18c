"""Keyframes, and their sparse stereo: well-textured points with their disparity and its covariance."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from twin.core import geometry
from twin.core.geometry import Array
from twin.core.records import Displacement, Exposure, Image, Map, Mask, Readings, StereoRig
from twin.core.settings import EstimatorSettings
from twin.estimate.vision import disparity, matching, patches

BINNINGS = (1, 2, 4)  #: numbers of pixels that may be averaged along each side
_MIN_MATCHED = 2 / 3  # smallest sufficient fraction of matched corners, see `choose_binning`
_EPIPOLAR_PX = 1.0
_BORDER_PX = 4  # margin: two pixels for interpolation, two for matching errors, which are smaller than that
_MIN_SIGMA_PX = 0.005  # interpolation error, a lower bound of the matching error
_MIN_ROW_DIFFERENCES = 30  # with fewer points, the scatter of their row differences is not evaluated


class StereoPoints(NamedTuple):
    """Matched points of one stereo pair."""

    pixels: Map  #: (n, 2) whole pixels in the left image
    disparity_slope: Array  #: (n, 2) gradient of the disparity at each point with respect to column and row [px/px]
    #: (n,) mean disparity around each point [px]. It is nearly independent of the matching error of the point and is
    #: used to predict whether the point lies inside another image.
    mean_disparity_px: Array
    measured: Array  #: (n, 3) normalised (x, y, disparity), with x and y in the left image
    cov: Array  #: (n, 3, 3) covariance of each point in `measured`
    xyz: Array  #: (n, 3) positions in the axes of the left camera [m]
    row_difference_px: Array  #: (n,) row in the right image minus row in the left image [px]
    noise_ratio: float = 1.0  #: `row_noise_ratio`, the factor on the matching noise from which `cov` was computed

    def subset(self, keep: Mask) -> StereoPoints:
        *columns, noise_ratio = self
        return StereoPoints._make([*(column[keep] for column in columns), noise_ratio])


@dataclass(slots=True)
class Keyframe:
    """Frame with a stereo pair whose pose the network estimates ("key point" in the paper); updated in place."""

    number: int  #: index of the keyframe, from 0
    row: int  #: index of its frame in the trajectories
    track: int  #: number of its track, from 1
    world_from_camera: Array  #: (4, 4) latest estimate of the pose
    points: StereoPoints | None  #: matched stereo points; None once a newer keyframe has been added
    readings: Readings  #: readings of the navigation sensors
    depth_m: float = np.nan  #: median depth of the matched points [m]
    exposure: Exposure | None = None  #: exposure of its images; None if it was not reported
    yaw_rad: float = 0.0  #: yaw of the right camera for which the measurements of links to earlier nodes are corrected
    #: displacement since the previous node, measured by the DVL; None if it was not measured, or if the link to the
    #: previous node is the F2F motion, which already includes the DVL readings.
    dvl_displacement: Displacement | None = None
    #: (6, 6) sum of the covariances of all motions since the start, minus the decreases due to registrations with the
    #: mosaic; in world axes [rotation, translation] (rad, m). The difference between the values of two keyframes is the
    #: covariance of the motion between them.
    accumulated_cov: Array = field(default_factory=lambda: np.zeros((6, 6)))

    def motion_cov(self, earlier: Keyframe, world_from_camera: Array | None = None) -> Array:
        """Returns the covariance (6, 6) of the motion since an earlier keyframe [rotation, translation] (rad, m)."""
        # in the axes of this keyframe, or of `world_from_camera` (4, 4); too large after global alignments, which do
        # not decrease `accumulated_cov`
        pose = self.world_from_camera if world_from_camera is None else world_from_camera
        from_world = geometry.adjoint(geometry.inverse(pose))
        return from_world @ (self.accumulated_cov - earlier.accumulated_cov) @ from_world.T


def fuse(left: Array, right: Array, cov: Array, rig: StereoRig) -> tuple[Array, Array]:
    """Returns normalised (x, y, disparity) (n, 3) and covariance (n, 3, 3) of points matched in a rectified pair.

    The left column is in both x and disparity, so they are correlated. Equal rows are enforced by a Kalman update,
    which also corrects the columns if the errors of column and row are correlated. Positions (n, 2) [px]; `cov` (n, 2,
    2) [px^2] is that in each image.
    """
    xx, xy, yy = cov[:, 0, 0] + _MIN_SIGMA_PX**2, cov[:, 0, 1], cov[:, 1, 1] + _MIN_SIGMA_PX**2
    state = np.column_stack([left, left[:, 0] - right[:, 0]])
    joint = np.stack([np.stack([xx, xy, xx], 1), np.stack([xy, yy, xy], 1), np.stack([xx, xy, 2 * xx], 1)], axis=1)
    cov_with_rows = np.column_stack([xy, yy, 2 * xy])  # covariance with the row difference, whose variance is 2 yy
    state = state - cov_with_rows * ((left[:, 1] - right[:, 1]) / (2 * yy))[:, None]
    joint = joint - cov_with_rows[:, :, None] * cov_with_rows[:, None, :] / (2 * yy)[:, None, None]
    measured = np.column_stack([rig.normalised(state[:, :2]), state[:, 2] / rig.focal_px])
    return measured, joint / rig.focal_px**2


def fused_shift(left: Array, right: Array, fused_cov: Array, rig: StereoRig) -> Array:
    """Returns the shifts (n, 3) of the results of `fuse` that shifts (n, 2) of its input positions [px] cause."""
    # rows move by half their difference, columns by regression on the rows, by the covariance (n, 3, 3) of `fuse`
    slope, half = fused_cov[:, 0, 1] / fused_cov[:, 1, 1], (left[:, 1] - right[:, 1]) / 2
    x, disparity = left[:, 0] - slope * half, left[:, 0] - right[:, 0] - 2 * slope * half
    return np.column_stack([x, left[:, 1] - half, disparity]) / rig.focal_px


def row_noise_ratio(left: Array, right: Array, cov: Array) -> float:
    """Returns the ratio of the measured standard deviation of row differences to the expected one; at least 1."""
    # 1.4826 times the median of the absolute normalised ones minus their median (calibration errors); 1 for fewer than
    # 30 points, or within two standard errors of 1.17 / sqrt(n)
    n = len(left)
    if n < _MIN_ROW_DIFFERENCES:
        return 1.0
    difference = left[:, 1] - right[:, 1]
    size = np.abs(difference - np.median(difference)) / np.sqrt(2 * (cov[:, 1, 1] + _MIN_SIGMA_PX**2))
    ratio = 1.4826 * float(np.median(size))
    return ratio if ratio > 1 + 2 * 1.17 / n**0.5 else 1.0


def satisfies_epipolar(left: NDArray[np.floating], right: NDArray[np.floating]) -> Mask:
    """Returns a mask (n,) of the matches (n, 2) with a row difference below 1 px and a disparity above 0.5 px."""
    return (np.abs(right[:, 1] - left[:, 1]) < _EPIPOLAR_PX) & (left[:, 0] - right[:, 0] > 0.5)


def margin_px(patch_px: int) -> int:
    return patch_px // 2 + _BORDER_PX


def well_inside(pixels: NDArray[np.floating], rig: StereoRig, patch_px: int) -> Mask:
    """Returns a mask (n,) of the patches, predicted at `pixels` (n, 2), that stay inside despite matching errors."""
    # measured positions would prefer errors away from the border (-0.02 px of disparity over coarse texture)
    return matching.inside(pixels, (rig.height_px, rig.width_px), margin_px(patch_px))


def corners_with_disparity(left: matching.Gray, dense_px: Map, settings: EstimatorSettings) -> tuple[Map, Map]:
    """Returns corners (n, 2) of the left image with known disparity, at whole pixels, and their disparities (n,)."""
    corners = matching.corners(matching.normalise(left), settings.points, settings.patch_px)
    pixels = np.round(corners).astype(np.float32)
    columns, rows = pixels.astype(int).T
    known = np.isfinite(dense_px[rows, columns])
    return pixels[known], dense_px[rows, columns][known]


def match_stereo_points(
    left: matching.Gray, right: matching.Gray, dense_px: Map, rig: StereoRig, settings: EstimatorSettings
) -> StereoPoints:
    """Matches corners of the left image in the right one, to sub-pixel accuracy, from refined disparity (H, W) [px]."""
    # grey levels are those of `matching.gray`; the rig is that of the images, with square pixels
    patch_px = settings.patch_px
    pixels, disparity_px = corners_with_disparity(left, dense_px, settings)
    slope = patches.disparity_slope(dense_px, pixels, patch_px)
    warp = np.tile(np.eye(2), (len(pixels), 1, 1))
    warp[:, 0] -= slope
    guess = pixels - np.column_stack([disparity_px, np.zeros(len(pixels))])
    templates = patches.extract_templates([left], pixels, patch_px)
    match = patches.match_templates(templates, patches.spline_coefficients([right]), guess, warp)
    mean_px = _local_mean(dense_px, 3 * patch_px)[pixels[:, 1].astype(int), pixels[:, 0].astype(int)]
    in_view = well_inside(pixels - np.column_stack([mean_px, np.zeros(len(pixels))]), rig, patch_px)
    ok = match.ok & satisfies_epipolar(pixels, match.points) & in_view
    source = pixels[ok].astype(np.float64)
    source, matched = rig.without_refraction(source, match.points[ok])
    noise_ratio = row_noise_ratio(source, matched, match.cov[ok])
    measured, cov = fuse(source, matched, match.cov[ok] * noise_ratio**2, rig)
    xyz = np.column_stack([measured[:, :2], np.ones(len(measured))]) * (rig.baseline_m / measured[:, 2:])
    rows = matched[:, 1] - source[:, 1]
    return StereoPoints(pixels[ok], slope[ok], mean_px[ok].astype(np.float64), measured, cov, xyz, rows, noise_ratio)


def choose_binning(left: Image, right: Image, rig: StereoRig, settings: EstimatorSettings) -> int:
    """Returns the smallest binning at which over two thirds of the corners are matched, else that with the most."""
    # over coarse texture many corners are noise: over texels of 12 pixels, 35 to 60 % are matched at full size, 88 to
    # 96 % with binning by 2 or 4; over fine texture 95 to 99 % without. Larger patches alone do not help.
    best, best_fraction = 1, 0.0
    for binning in BINNINGS:
        if rig.width_px % binning or rig.height_px % binning:
            break
        scaled, left_gray, right_gray = rig.binned(binning), matching.gray(left, binning), matching.gray(right, binning)
        dense_px = disparity.match_densely(left_gray, right_gray).best_px
        pixels, _ = corners_with_disparity(left_gray, dense_px, settings)
        points = match_stereo_points(left_gray, right_gray, dense_px, scaled, settings)
        fraction = len(points.xyz) / max(len(pixels), 1)
        if fraction > _MIN_MATCHED:
            return binning
        if fraction > best_fraction:
            best, best_fraction = binning, fraction
    return best


def _local_mean(dense_px: Map, side_px: int) -> Map:
    """Returns the mean (H, W) [px] of the known disparities in a square around each pixel; 0 if none is known."""
    known = np.isfinite(dense_px)
    total, count = (
        cv2.boxFilter(part, cv2.CV_32F, (side_px, side_px), normalize=False)
        for part in (np.where(known, dense_px, np.float32(0)), known.astype(np.float32))
    )
    return np.asarray(total / np.maximum(count, 1), np.float32)
