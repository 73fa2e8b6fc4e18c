"""Inspection of recorded stereo images before a survey is estimated: matches, order of the cameras, floor, light."""

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from twin.core import geometry
from twin.core.geometry import Array
from twin.core.records import Frame, Image, Map, StereoRig
from twin.core.settings import EstimatorSettings
from twin.estimate.mapping.map_builder import ImagePair
from twin.estimate.vision import disparity, matching, stereo
from twin.estimate.vision.disparity import Disparity
from twin.estimate.vision.light_pattern import MeanIllumination, light_pattern, pattern_coefficients, pattern_fit
from twin.estimate.vision.stereo import StereoPoints

_MIN_POINTS = 30  # smallest number of matched points from which anything is concluded
_SWAPPED_SHARE = 3  # the cameras are swapped if the exchanged images have at least this many times the matched points
_TRIALS, _SEED = 300, 1
_INLIER_SIGMAS = 2.5
_ROUGHEST = 0.15  # largest scatter of the points about a floor plane, as a fraction of their median depth
_MAX_TILT_RAD = np.deg2rad(45.0)  # largest angle between the normal of the floor and the optical axis


class PairInspection(NamedTuple):
    """Stereo pair, resampled to square pixels, with its matches."""

    #: left, right: (H, W, 3) resampled images.
    left: Image
    right: Image
    rig: StereoRig  #: calibration of these images
    disparity: Disparity  #: dense disparity of the left image
    points: StereoPoints  #: matched points
    swapped: bool  #: whether the left and the right image seem to be exchanged (`inspect_pair`)


class FloorPlane(NamedTuple):
    """Plane of a floor in the axes of a camera: the points x with normal . x = -distance."""

    normal: Array  #: (3,) unit normal that points from the floor to the side of the camera
    distance_m: float  #: distance of the camera from the plane [m]
    scatter_m: float  #: robust standard deviation of the points about the plane [m]
    fitted: bool  #: whether it was fitted; otherwise it is perpendicular to the optical axis at the median depth

    @property
    def world_from_camera(self) -> Array:
        """Returns the pose (4, 4) of the camera in a world whose plane z = 0 is the floor plane."""
        # the origin is the foot of the perpendicular from the camera, x that of the camera, projected onto the plane
        along = np.array([1.0, 0, 0]) - self.normal[0] * self.normal
        x = along / np.linalg.norm(along)
        rotation: Array = np.stack([x, np.cross(self.normal, x), self.normal]).astype(np.float64)
        return geometry.pose(rotation, np.array([0.0, 0.0, self.distance_m]))


def inspect_pair(frame: Frame, rig: StereoRig, settings: EstimatorSettings | None = None) -> PairInspection:
    """Matches a stereo pair and again exchanged (see `_SWAPPED_SHARE`)."""
    chosen, square = settings or EstimatorSettings(), rig.with_square_pixels()
    left, right = _square_images(frame, rig)
    dense, points = _matched(left, right, square, chosen)
    exchanged = _matched(right, left, square, chosen)[1]
    swapped = len(exchanged.xyz) >= max(_MIN_POINTS, _SWAPPED_SHARE * len(points.xyz))
    return PairInspection(left, right, square, dense, points, swapped)


def _square_images(frame: Frame, rig: StereoRig) -> ImagePair:
    assert frame.right is not None
    scale = rig.fx_px / rig.fy_px
    return matching.scaled_rows(frame.left, scale), matching.scaled_rows(frame.right, scale)


def _matched(left: Image, right: Image, rig: StereoRig, settings: EstimatorSettings) -> tuple[Disparity, StereoPoints]:
    grays = matching.gray(left, 1), matching.gray(right, 1)
    dense = disparity.match_densely(*(np.round(gray).astype(np.uint8) for gray in grays))
    return dense.fine, stereo.match_stereo_points(*grays, dense.best_px, rig, settings)


def floor_plane(points: StereoPoints) -> FloorPlane | None:
    """Returns the plane of the floor, fitted to the matched points of a pair; None for fewer than 30 points.

    The least median of squares (Rousseeuw 1984) over 300 random triples is refined by least squares within 2.5 robust
    standard deviations. If the points scatter by more than 15 % of their median depth or the plane is inclined by more
    than 45 degrees (a wall, a horizon), it is perpendicular to the optical axis at the median depth.
    """
    xyz = points.xyz
    if len(xyz) < _MIN_POINTS:
        return None
    depth_m, fitted = float(np.median(xyz[:, 2])), _fitted_plane(xyz)
    if fitted.scatter_m <= _ROUGHEST * depth_m and -fitted.normal[2] >= np.cos(_MAX_TILT_RAD):
        return fitted
    scatter_m = 1.4826 * float(np.median(np.abs(xyz[:, 2] - depth_m)))
    return FloorPlane(np.array([0.0, 0.0, -1.0]), depth_m, scatter_m, fitted=False)


def _fitted_plane(xyz: Array) -> FloorPlane:
    rng, best = np.random.default_rng(_SEED), (np.inf, np.array([0.0, 0.0, -1.0]), 0.0)
    for _ in range(_TRIALS):
        a, b, c = xyz[rng.choice(len(xyz), 3, replace=False)]
        normal = np.cross(b - a, c - a)
        length = np.linalg.norm(normal)
        if length < 1e-12:
            continue
        normal = normal / length
        median = float(np.median(np.abs((xyz - a) @ normal)))
        best = min(best, (median, normal, float(a @ normal)), key=lambda found: found[0])
    near = np.abs(xyz @ best[1] - best[2]) <= _INLIER_SIGMAS * 1.4826 * best[0] + 1e-12
    centre = xyz[near].mean(axis=0)
    normal = np.linalg.svd(xyz[near] - centre, full_matrices=False)[2][2]
    normal = normal if centre @ normal < 0 else -normal
    scatter_m = 1.4826 * float(np.median(np.abs((xyz - centre) @ normal)))
    return FloorPlane(normal, float(-centre @ normal), scatter_m, fitted=True)


class LightInspection(NamedTuple):
    """Light of a stereo camera (lamps, vignetting, backscatter), the mean of n pairs, and a pair made uniform by it."""

    n_pairs: int  #: number of pairs n
    #: mean_left, mean_right: (H, W) mean grey levels of the pairs.
    mean_left: Map
    mean_right: Map
    even_left: Image  #: (H, W, 3) left image with the gain that the colours of the map get
    subtracted: bool  #: whether the estimators subtract a light pattern before dense matching (`light_pattern`)
    #: dense disparity of the left image as the map uses it: without the light pattern if it is subtracted.
    disparity: Disparity


def inspect_light(pair: PairInspection, frames: Iterable[Frame], rig: StereoRig) -> LightInspection:
    """Returns the light of the cameras in frames of the whole recording, in their order, and its effect on one pair."""
    illumination, fits = MeanIllumination(pair.rig), []
    mean = np.zeros((2, pair.rig.height_px, pair.rig.width_px), np.float32)
    for frame in frames:
        images = _square_images(frame, rig)
        grays = matching.luma(images[0]), matching.luma(images[1])
        mean += np.array(grays)
        fits.append(pattern_fit(grays))
        illumination.add(images[0])
    coefficients, dense = pattern_coefficients(fits), pair.disparity
    if coefficients is not None:
        levels = np.array([matching.luma(image) for image in (pair.left, pair.right)])
        dense = disparity.match_densely(*(levels - light_pattern(coefficients, levels.shape[1:]))).fine
    even = np.clip(np.round(pair.left * illumination.gain()), 0, 255).astype(np.uint8)
    return LightInspection(len(fits), mean[0] / len(fits), mean[1] / len(fits), even, coefficients is not None, dense)
