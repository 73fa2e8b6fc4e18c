"""Search of a link over the whole images: where the prediction is too uncertain, features give a coarse motion."""

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree
from scipy.special import chdtri

from twin.core import geometry
from twin.core.geometry import Array
from twin.core.records import Map, StereoRig
from twin.estimate.vision import matching
from twin.estimate.vision.observation_equations import image_jacobian
from twin.estimate.vision.stereo import StereoPoints

_MOST_FEATURES = 1000
_RATIO = 0.8  # largest ratio of the distances of the best and the second best descriptor (Lowe 2004)
_INLIER_PX = 2.0
_MIN_INLIERS, _MIN_INLIER_SHARE = 15, 0.3
_LEAST_DISPARITY_PX = 0.5
_CONFIDENCE, _ITERATIONS = 0.999, 500

_SIGMAS = 3.0  # errors of the predicted positions up to this number of standard deviations are expected
_CHI2 = chdtri(6, 1e-4)  # largest chi-square of the difference between a measured and the predicted motion


def may_exceed(range_px: float, points: StereoPoints, cov: Array, rig: StereoRig) -> bool:
    """Returns whether three median standard deviations of the predicted image positions exceed a search range [px]."""
    x, y, disparity = np.ascontiguousarray(points.measured.T)
    depth_m = rig.baseline_m / np.maximum(disparity, _LEAST_DISPARITY_PX / rig.focal_px)
    jacobian = image_jacobian(x, y, depth_m) * rig.focal_px
    variance_px2 = np.linalg.eigvalsh(jacobian @ cov @ jacobian.transpose(0, 2, 1))[:, -1]
    return bool(_SIGMAS**2 * np.median(variance_px2) > range_px**2)


def agrees(found: Array, found_cov: Array, predicted: Array, cov: Array) -> bool:
    """Returns whether a measured motion lies within the errors of itself and its prediction (chi-square, 99.99 %)."""
    # repeated texture may shift it by a period; negative eigenvalues of `cov`, a difference, count as zero
    error = geometry.log(geometry.inverse(predicted) @ found)
    values, axes = np.linalg.eigh((cov + cov.T) / 2)
    both = axes * np.maximum(values, 0) @ axes.T + found_cov
    return bool(error @ np.linalg.solve(both, error) <= _CHI2)


def coarse_motion(
    node: matching.Gray, other: matching.Gray, points: StereoPoints, rig: StereoRig, patch_px: int
) -> Array | None:
    """Returns the pose (4, 4) of the left camera of a node in that of another node; None if too few features agree."""
    # SIFT features (Lowe 2004) get their depth from the nearest stereo point within `patch_px`; perspective-n-point
    # with RANSAC, whose error of a pixel or two suffices to predict a link
    sift = cv2.SIFT.create(nfeatures=_MOST_FEATURES)
    node_px, node_descriptors = _features(sift, node)
    other_px, other_descriptors = _features(sift, other)
    if len(node_px) < _MIN_INLIERS or len(other_px) < _MIN_INLIERS:
        return None
    pairs = cv2.BFMatcher(cv2.NORM_L2).knnMatch(node_descriptors, other_descriptors, k=2)
    best = [pair[0] for pair in pairs if len(pair) == 2 and pair[0].distance < _RATIO * pair[1].distance]
    rows, columns = np.array([[m.queryIdx, m.trainIdx] for m in best], dtype=np.int64).reshape(-1, 2).T
    distances_px, indices = KDTree(points.pixels).query(node_px[rows])
    distance_px, nearest = np.asarray(distances_px), np.asarray(indices)
    near = distance_px <= patch_px
    xyz, pixels = _at_features(points, nearest[near], node_px[rows[near]], rig), other_px[columns[near]]
    if len(xyz) < _MIN_INLIERS:
        return None
    ok, rotation, translation, inliers = cv2.solvePnPRansac(
        xyz, pixels, rig.matrix, np.zeros(4), reprojectionError=_INLIER_PX, confidence=_CONFIDENCE,
        iterationsCount=_ITERATIONS, flags=cv2.SOLVEPNP_EPNP,
    )  # fmt: skip
    n = 0 if not ok or inliers is None else len(inliers)
    if n < max(_MIN_INLIERS, _MIN_INLIER_SHARE * len(xyz)):
        return None
    rotation, translation = (np.asarray(part, np.float64).ravel() for part in (rotation, translation))
    return geometry.pose(geometry.so3_exp(rotation), translation)


def _features(sift: cv2.SIFT, image: matching.Gray) -> tuple[Array, Map]:
    """Returns positions (n, 2) [px] and descriptors (n, 128) of the SIFT features of an image."""
    levels = np.clip(matching.normalise(np.asarray(image, np.float32)), 0, 255).astype(np.uint8)
    found, descriptors = sift.detectAndCompute(levels, None)
    pixels = np.array([feature.pt for feature in found], np.float64).reshape(-1, 2)
    return pixels, np.zeros((0, 128), np.float32) if descriptors is None else np.asarray(descriptors, np.float32)


def _at_features(points: StereoPoints, nearest: NDArray[np.int64], pixels: Array, rig: StereoRig) -> Array:
    """Returns the positions (n, 3) [m] of features; disparity is extrapolated from the `nearest` (n,) stereo points."""
    offset_px = pixels - points.pixels[nearest]
    disparity = points.measured[nearest, 2] * rig.focal_px + (points.disparity_slope[nearest] * offset_px).sum(axis=1)
    depth_m = rig.focal_px * rig.baseline_m / np.maximum(disparity, _LEAST_DISPARITY_PX)
    return np.column_stack([rig.normalised(pixels), np.ones(len(pixels))]) * depth_m[:, None]
