"""Construction of the map from the stereo pairs along the final trajectory: depth filter, heights, and their test."""

from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import NamedTuple

import cv2
import numpy as np

from twin.core import geometry
from twin.core.geometry import Array
from twin.core.quality import EXACT, CalibrationEstimate
from twin.core.records import ElevationMap, HeightVariances, Image, Map, MapGrid, Mask, StereoRig
from twin.core.threads import prefetched
from twin.estimate.mapping import depth_filter, elevation, surface
from twin.estimate.mapping.depth_filter import DepthMap
from twin.estimate.mapping.surface import HeightPatch
from twin.estimate.vision import disparity
from twin.estimate.vision.disparity import Disparity
from twin.estimate.vision.light_pattern import MeanIllumination
from twin.estimate.vision.matching import luma

#: Largest standard deviation of a stereo disparity that enters the map [px]. Beyond this limit, texture is as weak as
#: noise, and half of the pixels are mismatches. A limit of 1 px doubles the number of cells with errors above 0.1 m; a
#: limit of 0.35 px reduces it to a third.
MAX_STEREO_SIGMA_PX = 0.5
#: Largest relative standard deviation of a stereo depth that enters the map; that of its disparity is the same. At 20 %
#: the interval of five standard deviations reaches to infinite depth.
MAX_RELATIVE_SIGMA = 0.2
MIN_COMMON = 200  # cells with heights from both sets that a comparison of two sets of keyframes needs
#: Part of the cells whose heights from two sets of keyframes differ least, and the RMS of that part of a standard
#: normal distribution. The others are mismatches in one set, most of which the map of both does not have.
_CENTRE, _CENTRE_RMS = 0.95, 0.871
_ONE_WAY = 0.2  # share of the keyframes in one of two directions below which a path has no legs there and back


ImagePair = tuple[Image, Image]  # left and right image (H, W, 3)
_NO_PATTERN = np.zeros((2, 1, 1), np.float32)
#: Left image (H, W, 3), and the right one or the disparity between them without the light pattern, if it is known.
MapView = tuple[Image, Image | Disparity]


class KeyframePath(NamedTuple):
    """Poses of n keyframes, and covariances [rotation, translation] (rad, m) in the axes of each left camera."""

    world_from_camera: Array  #: (n, 4, 4) poses of the left camera
    pose_cov: Array  #: (n, 6, 6) covariance of each pose
    step_cov: Array  #: (n, 6, 6) covariance of each pose relative to the previous one; the first is not used
    yaw_rad: Array | None = None  #: (n,) yaw of the right camera for which each right image is not corrected


class _FilterState(NamedTuple):
    depth: DepthMap  #: filtered depth map
    gray: Map  #: (H, W) float32 grey levels of the left image, without the light pattern
    pose: Array  #: (4, 4) world_from_camera
    patch: HeightPatch | None  #: heights of the depth map on the grid; None if the depth map does not overlap the grid


def build_map(
    views: Iterable[MapView], path: KeyframePath, rig: StereoRig, grid: MapGrid,
    progress: Callable[[int], None] = lambda _: None, pattern: Map = _NO_PATTERN,
    calibration: CalibrationEstimate = EXACT,
) -> ElevationMap:  # fmt: skip
    """Returns the map, built from keyframes in their order; `progress` is called with the number processed so far."""
    # depths are corrected for the calibration; what remains uncertain of it is part of the standard deviations
    rig = replace(rig, baseline_m=rig.baseline_m * (1 + calibration.baseline_error))
    mapper, illumination = elevation.ElevationMapper(grid), MeanIllumination(rig)
    poses, old = path.world_from_camera, None
    yaw_rad = np.zeros(len(poses)) if path.yaw_rad is None else path.yaw_rad
    turned = zip(views, yaw_rad.tolist(), strict=True)
    stereo = prefetched(_measure_depth(view, yaw, rig, pattern) for view, yaw in turned)
    for k, (left, gray, stereo_depth) in enumerate(stereo):
        depth, inherited = stereo_depth, None
        if old is not None:
            depth, inherited = _advance(old, stereo_depth, gray, poses[k], path.step_cov[k], rig)
        patch = surface.rasterise(depth, poses[k], path.pose_cov[k], rig, grid)
        if old is not None and old.patch is not None:
            mapper.fuse(old.patch, patch, inherited)
        if patch is not None:
            illumination.add(left)
            mapper.add_colours(patch, left, illumination.gain())
        old = _FilterState(depth, gray, poses[k], patch)
        progress(k + 1)
    if old is not None and old.patch is not None:
        mapper.fuse(old.patch)
    return with_calibration_sigma(mapper.result(), poses, rig, calibration)


def with_calibration_sigma(
    found: ElevationMap, poses: Array, rig: StereoRig, calibration: CalibrationEstimate
) -> ElevationMap:
    """Returns the map with the uncertainty of the calibration, common to all keyframes, in its standard deviations."""
    # a yaw e changes a depth Z = b / d by -Z^2 e / b at the image centre, a baseline error e by Z e
    if not calibration.cov.any():
        return found
    depth_m = float(np.mean(poses[:, 2, 3])) - found.height_m.astype(np.float64)
    by_error = np.stack([-(depth_m**2) / rig.baseline_m, depth_m], axis=-1)
    variance = np.einsum("...i,ij,...j->...", by_error, calibration.cov, by_error)
    parts = found.variances
    if (typical := found.typical).any():
        parts = parts._replace(calibration=float(variance[typical].mean()))
    return replace(found, sigma_m=np.sqrt(found.sigma_m**2 + variance).astype(found.sigma_m.dtype), variances=parts)


def _measure_depth(view: MapView, yaw_rad: float, rig: StereoRig, pattern: Map) -> tuple[Image, Map, DepthMap]:
    """Returns the left image, its grey levels without the light pattern, and its depth from this pair alone."""
    image, other = view
    left = luma(image) - pattern[0]
    stereo = other if isinstance(other, Disparity) else disparity.match_densely(left, luma(other) - pattern[1]).fine
    stereo = stereo.with_sigma_below(np.minimum(MAX_STEREO_SIGMA_PX, MAX_RELATIVE_SIGMA * stereo.disparity_px))
    if rig.port is not None:
        stereo = stereo._replace(disparity_px=_without_refraction(stereo.disparity_px, rig))
    if yaw_rad:
        column = (np.arange(left.shape[1]) - stereo.disparity_px - rig.cx_px) / rig.focal_px  # in the right image
        offset_px = (yaw_rad * rig.focal_px * (1 + column**2)).astype(np.float32)
        stereo = stereo._replace(disparity_px=stereo.disparity_px - offset_px)
    return image, left, depth_filter.stereo_depth(stereo, rig)


def _without_refraction(disparity_px: Map, rig: StereoRig) -> Map:
    """Returns disparities (H, W) [px] as pinhole cameras would see them."""
    row, column = np.mgrid[: rig.height_px, : rig.width_px].astype(np.float64)
    left, right = rig.without_refraction(np.stack([column, row], -1), np.stack([column - disparity_px, row], -1))
    return (left[..., 0] - right[..., 0]).astype(np.float32)


def _advance(
    old: _FilterState, stereo_depth: DepthMap, gray: Map, pose: Array, step_cov: Array, rig: StereoRig
) -> tuple[DepthMap, Mask]:
    """Returns the filtered depth of the next keyframe, and a mask (H, W) of the pixels that inherit from `old`."""
    old_from_new = geometry.inverse(old.pose) @ pose
    fused, inherited = depth_filter.propagate(old.depth, stereo_depth, geometry.inverse(old_from_new), step_cov, rig)
    motion = depth_filter.motion_depth(gray, old.gray, fused, old_from_new, step_cov, rig)
    return depth_filter.fuse(fused, motion), inherited


def flown_back(positions_m: Array) -> Mask:
    """Returns which keyframes (n,) at positions (n, 3) are on legs back, or every other one without such legs."""
    # legs there and back show a point at different field angles, where errors of distortion and pose differ
    step_m = np.gradient(positions_m, axis=0)
    back = step_m @ np.linalg.svd(step_m, full_matrices=False)[2][0] < 0
    return back if _ONE_WAY <= back.mean() <= 1 - _ONE_WAY else np.arange(len(back)) % 2 == 1


def with_scatter(elevation: ElevationMap, one: ElevationMap, other: ElevationMap) -> ElevationMap:
    """Returns a map with the RMS difference / standard deviation of heights from two sets of keyframes, on its grid.

    The part of the variance of relief that is due to noise becomes one of `HeightVariances.stereo`.
    """
    # it multiplies the standard deviations if above 1: the scale factor of Birge (Phys. Rev. 40, 207, 1932)
    ratio = ((one.height_m - other.height_m) / np.hypot(one.sigma_m, other.sigma_m)).astype(np.float64)
    size = np.sort(np.abs(ratio[np.isfinite(ratio)]))
    if len(size) < MIN_COMMON:
        return elevation
    scatter = float(np.sqrt(np.mean(size[: int(_CENTRE * len(size))] ** 2))) / _CENTRE_RMS
    factor = max(scatter, 1.0)
    parts, noise_share = elevation.variances, 1 - _relief_share(one.height_m, other.height_m, elevation.typical)
    noise_m2 = parts.relief * noise_share
    parts = parts._replace(stereo=parts.stereo + noise_m2, relief=parts.relief - noise_m2)
    parts = HeightVariances(*(factor**2 * part for part in parts))
    common_m2, sigma_m = elevation.common_m2 * np.float32(factor**2), elevation.sigma_m * np.float32(factor)
    return replace(elevation, sigma_m=sigma_m, common_m2=common_m2, scatter=scatter, variances=parts)


def _relief_share(one_m: Map, other_m: Map, chosen: Mask) -> float:
    """Returns the share of a map's roughness that is relief: equal in two half maps, while noise differs.

    With the relief T and the noise N of the whole map in the squared Laplacian of the heights, each half has T + 2 N.
    """
    one, other = (cv2.Laplacian(height_m, cv2.CV_32F).astype(np.float64) for height_m in (one_m, other_m))
    chosen = chosen & np.isfinite(one) & np.isfinite(other)
    relief, half = (one * other)[chosen].sum(), (one**2 + other**2)[chosen].sum() / 2
    return float(np.clip(2 * relief / (relief + half), 0, 1)) if half > 0 else 1.0
