"""Stereo at a key point: well-textured points with the disparity that Lucas-Kanade sees, and how noisy it is."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from twin.estimate import matching
from twin.records import StereoRig

_EPIPOLAR_PX = 1.0
_FLOOR_PX = 0.01  # no matcher on 8-bit images is better (largest bias measured on low contrast: 0.013 px)


class StereoPoints(NamedTuple):
    """Points of one stereo pair.

    Args:
        pixels: (n, 2) in the left image [px].
        measured: (n, 3) normalised (x, y, disparity).
        xyz: (n, 3) in the left camera [m].
        sigma_px: standard deviation of localising a patch in one image, from what should be zero: the vertical
            disparity, which errs by two of them.
    """

    pixels: NDArray[np.float32]
    measured: NDArray[np.float64]
    xyz: NDArray[np.float64]
    sigma_px: float

    def subset(self, keep: NDArray[np.bool_]) -> StereoPoints:
        return StereoPoints(self.pixels[keep], self.measured[keep], self.xyz[keep], self.sigma_px)


def normalised(pixels: NDArray[np.floating], rig: StereoRig) -> NDArray[np.float64]:
    """(x, y) = (pixel - principal point) / focal length. (n, 2) -> (n, 2)"""
    return (pixels.astype(np.float64) - [rig.cx_px, rig.cy_px]) / rig.focal_px


def project(xyz: NDArray[np.float64], rig: StereoRig) -> NDArray[np.float32]:
    """Pixels of points (n, 3) in front of the left camera; behind it NaN. -> (n, 2)"""
    depth = np.where(xyz[:, 2:] > 1e-3, xyz[:, 2:], np.nan)
    return (xyz[:, :2] / depth * rig.focal_px + [rig.cx_px, rig.cy_px]).astype(np.float32)


def point_cov(sigma: float) -> NDArray[np.float64]:
    """Covariance (3, 3) of (x, y, disparity) where each image localises a patch to `sigma`.

    The disparity is the difference of two places, and x is one of them: they err together.
    """
    return sigma**2 * np.array([[1.0, 0.0, 1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 2.0]])


def measure(
    left: matching.Image,
    right: matching.Image,
    pixels: matching.Points,
    disparity_guess_px: NDArray,
    rig: StereoRig,
    patch_px: int,
) -> tuple[StereoPoints, matching.Mask]:
    """Disparity of given points of the left image.

    Args:
        pixels: (n, 2) [px].
        disparity_guess_px: (n,).

    Returns:
        The m points that were matched, and which of the n they are.
    """
    guess = pixels.copy()
    guess[:, 0] -= disparity_guess_px
    found, ok = matching.track(left, right, pixels, guess, patch_px, levels=0)
    vertical_px = found[:, 1] - pixels[:, 1]
    disparity_px = (pixels[:, 0] - found[:, 0]).astype(np.float64)
    ok &= (np.abs(vertical_px) < _EPIPOLAR_PX) & (disparity_px > 0.5)
    sigma_px = max(matching.robust_sigma(vertical_px[ok]) / np.sqrt(2), _FLOOR_PX)
    measured = np.column_stack([normalised(pixels[ok], rig), disparity_px[ok] / rig.focal_px])
    depth = rig.baseline_m / measured[:, 2:]
    xyz = np.column_stack([measured[:, :2], np.ones(len(measured))]) * depth
    return StereoPoints(pixels[ok], measured, xyz, sigma_px), ok


def points_of_pair(
    left: matching.Image,
    right: matching.Image,
    dense_px: NDArray[np.float32],
    rig: StereoRig,
    count: int,
    patch_px: int,
) -> StereoPoints:
    """Corners of the left image with their disparity, started from a dense disparity map (NaN where unknown)."""
    pixels = matching.corners(left, count, patch_px)
    columns, rows = np.round(pixels).astype(int).T
    guess = dense_px[rows, columns]
    known = np.isfinite(guess)
    return measure(left, right, pixels[known], guess[known], rig, patch_px)[0]
