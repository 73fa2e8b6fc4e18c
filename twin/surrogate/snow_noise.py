"""Effect of marine snow on matching, from images of a level floor with and without snow.

Let g be the gradient of a patch along the rows, and n the change of its grey levels by particles. Least-squares
matching shifts the patch by sum(g n) / sum(g^2), summed over its pixels. The match has a larger residual, so its
weight, 1 / variance, is smaller. A patch that particles change too much is not matched: the correlation between its two
images is too low. Images, defocus and illumination of the particles are computed by `imaging.snow`.
"""

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from twin.core.geometry import Array
from twin.imaging.image_formation import StampedPose
from twin.imaging.snow import BOX_M

Gray = NDArray[np.float32]

_MIN_CORRELATION = 0.7  # least correlation of a match, as in `estimate.vision.patches`
_LEAST_VARIANCE_PX2 = 1e-12  # of a match that neither noise nor a particle disturbs
_VIEWS = 3  # number of views with different particles


def snow_poses(pose: StampedPose) -> list[StampedPose]:
    """Returns poses of the camera that show different particles, shifted by fractions of the periodic snow box."""
    poses = []
    for k in range(_VIEWS):
        shifted = pose.world_from_left.copy()
        shifted[0, 3] += k * BOX_M / _VIEWS
        poses.append(StampedPose(shifted, pose.time_s))
    return poses


def snow_effect(clean: Sequence[Gray], snowy: Sequence[Gray], noise: float, patch_px: int) -> tuple[float, float]:
    """Returns the effect of snow on matches between views with different particles."""
    # variance of the weighted mean of n matches, times n [px^2], with the image noise, infinite without a match;
    # fraction of matched patches. `clean`: noise-free images of the same floor without snow, one for each view;
    # `noise`: standard deviation of the image noise [grey levels]
    weights, errors, n_patches = [], [], 0
    for k in range(len(clean)):
        other = (k + 1) % len(clean)
        first, second = snowy[k] - clean[k], snowy[other] - clean[other]
        variance_px2, error_px, matched = _patches(clean[k], (first, second), noise, patch_px)
        n_patches += matched.size
        weights.append(1 / variance_px2[matched])
        errors.append(error_px[matched])
    weight, error = np.concatenate(weights), np.concatenate(errors)
    if not len(weight):
        return np.inf, 0.0
    noise_px2 = 2 * noise**2 / _information(clean[0], patch_px)
    mean = float(np.mean(weight**2 * (noise_px2 + error**2)) / np.mean(weight) ** 2)
    return mean, len(weight) / n_patches


def _patches(
    clean: Gray, snow: tuple[Gray, Gray], noise: float, patch_px: int
) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Returns, of patches at every second pixel, variance of the matched position, its error, whether it is matched."""
    n = patch_px**2
    gradient = np.gradient(clean, axis=1)
    information = np.maximum(n * _mean(gradient**2, patch_px), _information(clean, patch_px))
    change = snow[1] - snow[0]
    change = change - _mean(change, patch_px)  # a match allows for a difference of brightness
    error_px = n * _mean(gradient * change, patch_px) / information
    spread = [_variance(part, patch_px) for part in snow]
    texture = _variance(clean, patch_px)
    correlation = texture / np.sqrt((texture + spread[0]) * (texture + spread[1]) + 1e-9)
    variance_px2 = np.maximum((2 * noise**2 + spread[0] + spread[1]) / information, _LEAST_VARIANCE_PX2)
    inside = np.zeros(clean.shape, np.bool_)
    inside[patch_px : -patch_px or None : 2, patch_px : -patch_px or None : 2] = True
    return variance_px2[inside], error_px[inside], correlation[inside] > _MIN_CORRELATION


def _information(clean: Gray, patch_px: int) -> float:
    """Returns the sum over a patch of the squared gradient along the rows, averaged over the image."""
    return max(patch_px**2 * float(np.mean(np.diff(clean, axis=1) ** 2)), 1e-12)


def _mean(image: NDArray[np.floating], side_px: int) -> Array:
    """Returns the mean of an image over a square around each pixel."""
    return np.asarray(cv2.boxFilter(image.astype(np.float64), -1, (side_px, side_px)), np.float64)


def _variance(image: NDArray[np.floating], side_px: int) -> Array:
    values = image.astype(np.float64)
    return np.maximum(_mean(values**2, side_px) - _mean(values, side_px) ** 2, 0.0)
