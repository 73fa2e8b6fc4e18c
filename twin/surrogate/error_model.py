"""Error model of the surrogate: 24 numbers, fitted to rendered surveys, of one law of image matching.

The precision of matching is limited by image noise, texture, contrast and range, which the Cramér-Rao lower bound c on
the standard deviation of a patch's position in one image contains (`matchability`). Every standard deviation of a
measurement in images is sqrt(floor^2 + (slope c)^2): interpolation and aliasing cause the floor, noise the slope. The
slope of a position in one image is `efficiency`, that of a difference of two positions, flow or disparity, sqrt(2)
times as large. Errors that do not come from noise, of relief, lamps and correlations, have further parameters. Unless
a field says otherwise, the standard deviations that the estimators report are the true ones.
"""

import math
from typing import NamedTuple

import numpy as np

from twin.core.geometry import Array

_EXPONENT = 4  # steepness of the loss of matches with the bound
_LARGEST_BOUND_PX = 1e6  # replaces infinite bounds, so that ratios have their limits


class ErrorModel(NamedTuple):
    """Parameters of the measurement errors of the surrogate; patches are those of `EstimatorSettings.patch_px`."""

    efficiency: float  #: ratio of the standard deviation of a patch's position in one image to its bound, if large
    match_floor_px: float  #: standard deviation of a patch's position in noise-free images of a level floor
    #: standard deviation of a flow vector of frame-to-frame tracking, and of a pixel's disparity, in noise-free images
    flow_floor_px: float
    #: increase of the standard deviation of a stereo match over relief, per pixel of RMS parallax within the patch
    stereo_relief_gain: float
    #: standard deviation of the match error of a link due to relief within the patch, per pixel of unevenness (see
    #: `matchability`) and per unit of distance / depth. The error is the same for all matches of one patch of floor, so
    #: it accumulates along a path. Let g = (g_x, g_y) be the image gradient in x (along rows) and y, t = (t_x, t_y) the
    #: translation between the images, and d the parallax of a pixel relative to the patch's plane, per unit of t.
    #: Least-squares matching displaces the patch by (sum g g')^-1 (sum g g' d) t, summed over its pixels. The
    #: displacement in x due to t_x is no error: stereo matching, with its baseline along x, averages d with the same
    #: weights g_x^2, so the depth of the patch already contains it. Three terms remain as errors: the displacement in x
    #: due to t_y and the one in y due to t_x, both with the gain `relief_gain`, and the displacement in y due to t_y,
    #: with twice this gain for isotropic texture.
    relief_gain: float
    #: growth of the true errors of links and of depths due to lamps on the vehicle, because shading and brightness of a
    #: patch change when the lamps move: their variance is multiplied by 1 + (lamp_growth * lamp_share)^2, where
    #: lamp_share is the fraction of the reflected light that comes from the lamps
    lamp_growth: float
    #: number of matched stereo points of a keyframe, as a fraction of the number of points that the estimators try to
    #: match (`vision.corner_count`), in noise-free images
    matched_share: float
    #: bound at which half of these points are matched, and half of them again in the next image [px]
    match_half_px: float
    #: correlation parameter r of the match error in the earlier stereo pair of a link. In units of its standard
    #: deviation, the error is r b + sqrt(1 - r^2) e, where b and e have unit variance, b is common to all links to that
    #: pair, and e is independent from link to link; `distance_growth` increases e only.
    match_bias_fraction: float
    #: growth of the match variance in the earlier keyframe of a link with the distance between the two keyframes: the
    #: variance is multiplied by 1 + (distance_growth * distance / depth)^2
    distance_growth: float
    #: fraction of the independent error of a frame-to-frame motion that the next motion cancels (a first-order moving
    #: average), because both motions are measured relative to the same points
    f2f_anticorrelation: float
    #: reported standard deviation of a registration with the mosaic, expressed as the standard deviation of one flow
    #: vector if the registration were estimated from c times as many flow vectors as a frame-to-frame motion, where c
    #: is the fraction of the field of view that the mosaic covers
    mosaic_sigma_px: float
    mosaic_error_ratio: float  #: ratio of the true to the reported standard deviation of a registration
    #: information that each further keyframe adds to a depth, relative to the first one, if keyframes are far apart;
    #: image noise is independent between keyframes at any distance, see `height_errors.height_errors`
    depth_gain: float
    depth_half_step: float  #: distance between consecutive keyframes at which each adds half of it [stereo baselines]
    binned_factor: float  #: factor on the standard deviation of a pixel's depth if images are binned
    #: standard deviation, over the cells of a map, of the logarithm of the standard deviation of depth, divided by the
    #: share of noise in the variance and by the scatter of the texture (`matchability.WindowTexture`)
    texture_scatter: float
    #: standard deviation, over surveys, of the logarithm of the ratio of the true to the reported deviation of depth
    survey_scatter: float
    lateral_sigma_px: float  #: standard deviation of the lateral shift of a mapped surface, common to all its views
    #: limit, for large roughness, of the standard deviation of the height error due to relief within the matching
    #: window, common to all views of the cell [px of disparity]
    relief_error_px: float
    #: standard deviation of the height error near walls, where the matching window shows two surfaces, from one
    #: keyframe, per `floor_relief.edge_strength` [px^(1/2)]
    edge_error: float
    edge_half_px: float  #: roughness at which half the cells have no depth [px of disparity]
    #: distance from the border of the images over which the fraction of cells without a depth falls by 1 / e, per
    #: pixel of the bound
    border_holes: float
    map_half_px: float  #: bound at which half of the smooth map cells have a depth [px]

    def match_sigma_px(self, bound_px: float, stereo_parallax_px: float) -> float:
        """Returns the standard deviation of a patch's position in one image [px], by the Cramér-Rao bound [px]."""
        # `stereo_parallax_px`: RMS parallax of the relief in a patch between the two cameras [px]
        relief_px = self.stereo_relief_gain * stereo_parallax_px
        return math.sqrt(self.match_floor_px**2 + (self.efficiency * bound_px) ** 2 + relief_px**2)

    def difference_sigma_px(self, bound_px: Array | float) -> Array:
        """Returns the standard deviation of a flow vector or of a disparity at Cramér-Rao bounds [px]."""
        return np.hypot(self.flow_floor_px, np.sqrt(2) * self.efficiency * np.minimum(bound_px, _LARGEST_BOUND_PX))

    def noise_share(self, bound_px: Array | float) -> Array:
        """Returns the fraction of the variance of a disparity that the image noise causes, at bounds [px]."""
        return 1 - np.square(self.flow_floor_px / np.maximum(self.difference_sigma_px(bound_px), 1e-12))

    def lamp_factor(self, lamp_share: Array | float) -> Array:
        """Returns the factor on the true standard deviations of links and depths due to the lamps."""
        return np.hypot(1, self.lamp_growth * lamp_share)

    def rematched(self, bound_px: float) -> float:
        """Returns the fraction of the points of a keyframe that are matched in another image that shows them."""
        return float(surviving(bound_px, self.match_half_px))

    def point_fraction(self, bound_px: float) -> float:
        """Returns the number of matched stereo points divided by that of the points to match."""
        return self.matched_share * self.rematched(bound_px)


def surviving(bound_px: Array | float, half_px: float) -> Array:
    """Returns the fraction of matches that survive noise, a half at the bound `half_px`."""
    return 1 / (1 + (np.minimum(bound_px, _LARGEST_BOUND_PX) / half_px) ** _EXPONENT)
