"""Stereo at a key point: well-textured points with their disparity, each with its own covariance."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from twin.estimate import matching, patches
from twin.geometry import Array
from twin.records import StereoRig

_EPIPOLAR_PX = 1.0
_FLOOR_PX = 0.005  # what interpolation leaves: no match is better


class StereoPoints(NamedTuple):
    """Points of one stereo pair.

    Args:
        pixels: (n, 2) whole pixels in the left image.
        slope: (n, 2) of the disparity around them, by column and row.
        measured: (n, 3) normalised (x, y, disparity).
        cov: (n, 3, 3) of these.
        xyz: (n, 3) in the left camera [m].
    """

    pixels: NDArray[np.float32]
    slope: Array
    measured: Array
    cov: Array
    xyz: Array

    def subset(self, keep: NDArray[np.bool_]) -> StereoPoints:
        return StereoPoints(self.pixels[keep], self.slope[keep], self.measured[keep], self.cov[keep], self.xyz[keep])


def normalised(pixels: NDArray[np.floating], rig: StereoRig) -> Array:
    """(x, y) = (pixel - principal point) / focal length. (n, 2) -> (n, 2)"""
    return (pixels.astype(np.float64) - [rig.cx_px, rig.cy_px]) / rig.focal_px


def fuse(left: Array, right: Array, cov: Array, rig: StereoRig) -> tuple[Array, Array]:
    """(x, y, disparity) and its covariance from a patch's place in both images, given that both show it on one row.

    Each image errs by `cov`; the disparity is the difference of two columns, x is one of them: they err together. The
    rows' difference must be zero, and observing that (a Kalman update) also tells the columns what they share with it.

    Args:
        left, right: (n, 2) [px].
        cov: (n, 2, 2) of a place in one image [px^2].

    Returns:
        (n, 3) and (n, 3, 3), normalised.
    """
    xx, xy, yy = cov[:, 0, 0] + _FLOOR_PX**2, cov[:, 0, 1], cov[:, 1, 1] + _FLOOR_PX**2
    state = np.column_stack([left, left[:, 0] - right[:, 0]])
    joint = np.stack([np.stack([xx, xy, xx], 1), np.stack([xy, yy, xy], 1), np.stack([xx, xy, 2 * xx], 1)], axis=1)
    with_rows = np.column_stack([xy, yy, 2 * xy])  # covariance with the rows' difference, whose variance is 2 yy
    state = state - with_rows * ((left[:, 1] - right[:, 1]) / (2 * yy))[:, None]
    joint = joint - with_rows[:, :, None] * with_rows[:, None, :] / (2 * yy)[:, None, None]
    measured = np.column_stack([normalised(state[:, :2], rig), state[:, 2] / rig.focal_px])
    return measured, joint / rig.focal_px**2


def on_one_row(left: NDArray[np.floating], right: NDArray[np.floating]) -> NDArray[np.bool_]:
    """Which matches (n, 2), (n, 2) [px] a rectified pair can show: rows alike, disparity positive."""
    return (np.abs(right[:, 1] - left[:, 1]) < _EPIPOLAR_PX) & (left[:, 0] - right[:, 0] > 0.5)


def corners_with_disparity(
    left: matching.Image, dense_px: NDArray[np.float32], count: int, patch_px: int
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Whole pixels (n, 2) of well-textured points whose disparity (n,) [px] a dense map knows."""
    pixels = np.round(matching.corners(left, count, patch_px)).astype(np.float32)
    columns, rows = pixels.astype(int).T
    known = np.isfinite(dense_px[rows, columns])
    return pixels[known], dense_px[rows, columns][known]


def points_of_pair(
    left: matching.Image,
    right: matching.Image,
    dense_px: NDArray[np.float32],
    rig: StereoRig,
    count: int,
    patch_px: int,
) -> StereoPoints:
    """Corners of the left image with their disparity, started from a dense disparity map (NaN where unknown)."""
    pixels, disparity_px = corners_with_disparity(left, dense_px, count, patch_px)
    slope = patches.disparity_slope(dense_px, pixels, patch_px)
    warp = np.tile(np.eye(2), (len(pixels), 1, 1))
    warp[:, 0] -= slope
    guess = pixels - np.column_stack([disparity_px, np.zeros(len(pixels))])
    match = patches.register(patches.cut([left], pixels, patch_px), patches.splines([right]), guess, warp)
    ok = match.ok & on_one_row(pixels, match.points)
    measured, cov = fuse(pixels[ok].astype(np.float64), match.points[ok], match.cov[ok], rig)
    xyz = np.column_stack([measured[:, :2], np.ones(len(measured))]) * (rig.baseline_m / measured[:, 2:])
    return StereoPoints(pixels[ok], slope[ok], measured, cov, xyz)
