"""Inspection of one stereo pair before a survey is estimated: matches, disparity, order of the cameras, floor plane."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from twin.core import geometry
from twin.core.geometry import Array
from twin.core.records import Frame, Image, StereoRig
from twin.core.settings import EstimatorSettings
from twin.estimate.vision import disparity, matching, stereo
from twin.estimate.vision.disparity import Disparity
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
    #: whether the plane was fitted to the points; otherwise it is perpendicular to the optical axis, at the median
    #: depth of the points.
    fitted: bool

    @property
    def world_from_camera(self) -> Array:
        """Returns the pose (4, 4) of the camera in a world whose plane z = 0 is the floor plane.

        The origin is the foot of the perpendicular from the camera to the plane; x is the x axis of the camera,
        projected onto the plane.
        """
        along = np.array([1.0, 0, 0]) - self.normal[0] * self.normal
        x = along / np.linalg.norm(along)
        rotation: Array = np.stack([x, np.cross(self.normal, x), self.normal]).astype(np.float64)
        return geometry.pose(rotation, np.array([0.0, 0.0, self.distance_m]))


def inspect_pair(frame: Frame, rig: StereoRig, settings: EstimatorSettings | None = None) -> PairInspection:
    """Matches the stereo pair of a frame over the widest range of disparities, and again with the two images exchanged.

    The images count as swapped if, exchanged, at least 30 points are matched and three times as many as in the given
    order.
    """
    chosen, square = settings or EstimatorSettings(), rig.with_square_pixels()
    left, right = square_images(frame, rig)
    dense, points = _matched(left, right, square, chosen)
    exchanged = _matched(right, left, square, chosen)[1]
    swapped = len(exchanged.xyz) >= max(_MIN_POINTS, _SWAPPED_SHARE * len(points.xyz))
    return PairInspection(left, right, square, dense, points, swapped)


def square_images(frame: Frame, rig: StereoRig) -> tuple[Image, Image]:
    """Returns the left and right image of a frame, resampled to square pixels (`rig.with_square_pixels()`)."""
    assert frame.right is not None
    scale = rig.fx_px / rig.fy_px
    left, right = (one if scale == 1 else matching.scaled_rows(one, scale) for one in (frame.left, frame.right))
    return left, right


def _matched(left: Image, right: Image, rig: StereoRig, settings: EstimatorSettings) -> tuple[Disparity, StereoPoints]:
    """Returns the dense disparity and the matched points of a stereo pair, over the widest range of disparities."""
    grays = matching.gray(left, 1), matching.gray(right, 1)
    widest_px = disparity.SearchRange(rig).max_disparity_px
    bytes_left, bytes_right = (np.round(gray).astype(np.uint8) for gray in grays)
    dense = disparity.dense_disparity(bytes_left, bytes_right, widest_px)
    points = stereo.match_stereo_points(*grays, dense.disparity_px, rig, settings.points, settings.patch_px)
    return dense, points


def floor_plane(points: StereoPoints) -> FloorPlane | None:
    """Returns the plane of the floor, fitted to the matched points of a pair; None for fewer than 30 points.

    The least median of squares (Rousseeuw 1984) over 300 random triples is refined by least squares within 2.5 robust
    standard deviations. If the points scatter by more than 15 % of their median depth or the plane is inclined by more
    than 45 degrees (a wall, a horizon), it is perpendicular to the optical axis at the median depth.
    """
    xyz = points.xyz
    if len(xyz) < _MIN_POINTS:
        return None
    depth_m = float(np.median(xyz[:, 2]))
    normal, distance_m, scatter_m = _fitted_plane(xyz)
    if scatter_m <= _ROUGHEST * depth_m and -normal[2] >= np.cos(_MAX_TILT_RAD):
        return FloorPlane(normal, distance_m, scatter_m, fitted=True)
    axis = np.array([0.0, 0.0, -1.0])
    return FloorPlane(axis, depth_m, 1.4826 * float(np.median(np.abs(xyz[:, 2] - depth_m))), fitted=False)


def _fitted_plane(xyz: Array) -> tuple[Array, float, float]:
    """Returns the plane fitted to points (n, 3) [m]: unit normal (3,) to the camera, distance and scatter [m]."""
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
    return normal, float(-centre @ normal), 1.4826 * float(np.median(np.abs((xyz - centre) @ normal)))
