"""Law of the height errors of a map, for the surrogate's maps, the expected error of a plan and the fit.

The Kalman depth filter measures the disparity of each pixel in every keyframe. Its noise has the precision of the
median window of dense matching; further keyframes reduce it. Errors due to relief within the matching window, near
walls and of lateral shifts are common to all views of a floor point.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from twin.core.geometry import Array
from twin.core.records import StereoRig
from twin.surrogate.error_model import ErrorModel, surviving
from twin.surrogate.floor_relief import FloorRelief
from twin.surrogate.matchability import TEXTURE_WINDOW_PX, Matchability

#: Errors near walls decrease with the number of keyframes to the power of minus this.
_EDGE_VIEWS_EXPONENT = 0.2
#: Errors near walls are larger at the border of the images by this share, which decreases by the factor 1 / e over
#: 1 / 6 of the image height: towards the border, cameras see the relief from the side, and each camera sees other parts
#: of it. Measured over the horseshoe reef and fractal floors.
_EDGE_BORDER_SHARE, _EDGE_BORDER_DECAY = 1.2, 6.0


class CellConditions(NamedTuple):
    """Conditions under which n points of the floor are mapped; (n,) each."""

    bound_px: Array  #: Cramér-Rao bound of the image at the depth of the point
    window_px: Array  #: bound of the median window of dense matching at the positions of the point in the images
    metres_per_px: Array  #: height error per pixel of disparity [m/px]
    roughness_px: Array  #: `FloorRelief.roughness_m` [px of disparity]
    edge_m: Array  #: `FloorRelief.edge_m`
    lateral_m: Array  #: height error per pixel of a lateral shift of the surface [m/px]
    views: Array  #: number of consecutive keyframes that observe the point
    step_baselines: Array  #: distance between neighbours of these keyframes [stereo baselines]
    border_px: Array  #: largest distance from the border of their images
    border_heights: Array  #: the same distance in image heights
    texture_scatter: Array  #: `WindowTexture.scatter`
    lamp_share: Array  #: fraction of the reflected light that comes from the lamps
    binned: Array  #: 1 for binned images, else 0


class KeyframeRuns(NamedTuple):
    """Keyframes that observe n points of the floor in a row; (n,) each."""

    depth_m: Array  #: depth along the optical axis, in the last keyframe
    number: Array  #: number of keyframes
    step_baselines: Array  #: distance between neighbouring keyframes [stereo baselines]
    border_px: Array  #: largest distance from the border of the images
    #: Cramér-Rao bound at the positions of the point in the images, relative to that of the whole image
    bound_ratio: Array


def cell_conditions(
    matchability: Matchability, rig: StereoRig, relief: FloorRelief, index: NDArray[np.int64], views: KeyframeRuns
) -> CellConditions:
    """Returns the conditions of the cells `index` (n,), numbered row by row; `rig` is that of the matched images."""
    slope = relief.slope.reshape(-1, 2)[index].astype(np.float64)
    bound_px = matchability.bound_at(views.depth_m)
    metres_per_px = views.depth_m**2 / (rig.focal_px * rig.baseline_m)
    lateral_m = np.nan_to_num(np.hypot(*slope.T)) * views.depth_m / rig.focal_px
    roughness_m, edge_m = (values.ravel()[index].astype(np.float64) for values in (relief.roughness_m, relief.edge_m))
    of_survey = matchability.texture.scatter, matchability.lamp_share, float(matchability.binning > 1)
    return CellConditions(
        bound_px, bound_px * matchability.texture.median_ratio * views.bound_ratio, metres_per_px,
        roughness_m / metres_per_px, edge_m, lateral_m, views.number, views.step_baselines, views.border_px,
        views.border_px / rig.height_px, *(np.full(len(index), value) for value in of_survey),
    )  # fmt: skip


class HeightSigmas(NamedTuple):
    """Standard deviations of the height errors at n points [m]; (n,) each."""

    noise_m: Array  #: noise of the depth filter: median over cells with equal conditions
    scatter: Array  #: standard deviation of the logarithm of this noise over cells with equal conditions
    relief_m: Array  #: error due to roughness of the floor within the matching window
    edge_m: Array  #: error near walls
    lateral_m: Array  #: error due to the lateral shift of the surface
    known: Array  #: fraction of the points for which the depth filter provides a depth

    def total_m(self, normal: Array | float = 0.0) -> Array:
        """Returns the standard deviation of the sum of all errors, at normal deviates of the logarithm of the noise."""
        noise_m = self.noise_m * np.exp(self.scatter * normal)
        return np.sqrt(noise_m**2 + self.relief_m**2 + self.edge_m**2 + self.lateral_m**2)


def height_sigmas(model: ErrorModel, cells: CellConditions) -> HeightSigmas:
    """Returns the standard deviations of the height errors."""
    # with n keyframes at distances B, the variance is divided by 1 + g (n - 1), with g = depth_gain B^2 / (B^2 +
    # depth_half_step^2) + s, s the fraction of the variance that image noise causes: noise is independent between
    # keyframes at any distance, other errors only if the distance changes the images. At the border half of the texture
    # window is outside, and the standard deviation is twice as large. Small roughness r is resolved: its error is a q^2
    # / sqrt(1 + q^4) with q = r / a and the limit a.
    noise_share, lamps = model.noise_share(cells.window_px), model.lamp_factor(cells.lamp_share)
    squared_step = np.square(cells.step_baselines)
    gain = model.depth_gain * squared_step / (squared_step + model.depth_half_step**2) + noise_share
    border = 1 + np.exp(-cells.border_px / (TEXTURE_WINDOW_PX / 2))
    binned = model.binned_factor**cells.binned
    noise_px = model.difference_sigma_px(cells.window_px) * lamps * border * binned
    edge_border = 1 + _EDGE_BORDER_SHARE * np.exp(-_EDGE_BORDER_DECAY * cells.border_heights)
    hole_width_px = np.maximum(model.border_holes * cells.bound_px * lamps, 1e-9)
    return HeightSigmas(
        cells.metres_per_px * noise_px / np.sqrt(1 + gain * (cells.views - 1)),
        model.texture_scatter * cells.texture_scatter * noise_share,
        cells.metres_per_px * relief_error_px(cells.roughness_px, model.relief_error_px),
        model.edge_error * cells.edge_m * edge_border / cells.views**_EDGE_VIEWS_EXPONENT,
        model.lateral_sigma_px * cells.lateral_m,
        surviving(cells.bound_px, model.map_half_px)
        / (1 + (cells.roughness_px / model.edge_half_px) ** 2)
        * (1 - np.exp(-cells.border_px * np.sqrt(cells.views) / hole_width_px)),
    )


def relief_error_px(roughness_px: Array, limit_px: float) -> Array:
    """Returns the standard deviation of the error due to relief within the matching window [px of disparity]."""
    share = np.square(roughness_px / np.maximum(limit_px, 1e-9))
    return limit_px * share / np.sqrt(1 + share**2)
