"""Error model of the surrogate: standard errors and success rates of the image measurements of a survey.

Most of them are functions of one number, the Cramer-Rao lower bound of a patch's position in an image
(see `matchability`). The parameters are fitted to rendered surveys.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np


class SigmaLaw(NamedTuple):
    """Standard deviation as a function of the Cramer-Rao bound c: sqrt(floor_px^2 + (slope c)^2).

    Args:
        floor_px: standard deviation in noise-free images [px].
        slope: asymptotic ratio of the standard deviation to the bound.
    """

    floor_px: float
    slope: float

    def __call__(self, bound_px: float) -> float:
        """Returns the standard deviation [px]."""
        return float(np.hypot(self.floor_px, self.slope * bound_px))


class FractionLaw(NamedTuple):
    """Fraction as a function of the Cramer-Rao bound c: maximum / (1 + (c / half_px)^exponent).

    Args:
        maximum: fraction in noise-free images.
        half_px: bound at which the fraction is half the maximum [px].
        exponent: steepness of the decrease.
    """

    maximum: float
    half_px: float
    exponent: float

    def __call__(self, bound_px: float) -> float:
        """Returns the fraction, 0 to 1."""
        return float(self.maximum / (1 + (bound_px / self.half_px) ** self.exponent))


class ErrorModel(NamedTuple):
    """Parameters of the measurement errors.

    An estimator reports a standard deviation (sigma) that may differ from the standard deviation of its errors. Fields
    named `..._sigma_px` model the reported one, fields named `..._error_ratio` the ratio of the true one to it.

    Args:
        bound_range_px: smallest and largest Cramer-Rao bound of the surveys that the model was fitted to.
        point_fraction: number of matched stereo points of a keyframe, as a fraction of `estimate.points`.
        match_sigma_px: reported standard deviation of a patch's position in one image.
        match_error_ratio: ratio of the true to the reported standard deviation of a patch's position in one image.
        lamp_error_growth: growth of the match error in the light of the lamps on the vehicle: the square of
            `match_error_ratio` is multiplied by 1 + (lamp_error_growth * lamp_share)^2, with
            lamp_share the fraction of the reflected light that comes from the lamps.
        match_fraction: fraction of the points in view of another keyframe that are matched there.
        match_covariance_inflation: factor on the covariance of a link, because matches of overlapping patches are
            correlated; see `matching.variance_inflation`.
        match_bias_fraction: fraction of the standard deviation in the earlier stereo pair of a link that is a bias of
            that pair, common to all of its links. The remainder is independent from link to link.
        distance_growth: growth of the reported match variance with the distance between two keyframes: the variance
            is multiplied by 1 + (distance_growth * distance / depth)^2.
        relief_gain: error of a match due to relief within the patch, per pixel of unevenness (see `matchability`) and
            per unit of distance / depth. The error is the same for all matches of one patch of floor, so it accumulates
            along a path. With g the image gradient and d the parallax of a pixel relative to the patch's plane, least
            squares matching shifts a patch by (sum g g')^-1 sum g g' d times the baseline. Stereo matching weights d
            by the squared row component of g and thereby explains the column shift due to a baseline along the rows.
            The remainder is a shift across the baseline, of equal gain for both directions, and a row shift due to a
            baseline across the rows, of twice that gain for isotropic texture.
        common_bias_px: standard deviation of a bias that all points of a link share [px].
        f2f_sigma_px: reported standard deviation of a frame-to-frame flow vector.
        f2f_error_ratio: ratio of the true to the reported standard deviation of a frame-to-frame motion.
        f2f_anticorrelation: fraction of a frame's error that the next frame cancels (a moving-average process of order
            one), because both motions are measured relative to the same points.
        mosaic_sigma_px: reported standard deviation of a registration with the mosaic, expressed as the standard
            deviation of a flow vector, for as many flow vectors as in F2F.
        mosaic_error_ratio: ratio of the true to the reported standard deviation of a registration.
        depth_sigma_px: reported standard deviation of a pixel's filtered depth [px of disparity].
        depth_error_ratio: ratio of the true to the reported standard deviation of a pixel's filtered depth.
        lateral_sigma_px: standard deviation of the lateral shift of a mapped surface, common to all views of it.
        map_completeness: fraction of the map cells in view for which the depth filter provides a depth.
    """

    bound_range_px: tuple[float, float] = (0.0, 1.0)
    point_fraction: FractionLaw = FractionLaw(0.9, 1.0, 4.0)
    match_sigma_px: SigmaLaw = SigmaLaw(0.02, 1.0)
    match_error_ratio: float = 1.05
    lamp_error_growth: float = 0.0
    match_fraction: FractionLaw = FractionLaw(0.97, 1.0, 4.0)
    match_covariance_inflation: float = 1.5
    match_bias_fraction: float = 0.8
    distance_growth: float = 0.0
    relief_gain: float = 0.0
    common_bias_px: float = 0.005
    f2f_sigma_px: SigmaLaw = SigmaLaw(0.05, 1.0)
    f2f_error_ratio: float = 1.4
    f2f_anticorrelation: float = 0.3
    mosaic_sigma_px: SigmaLaw = SigmaLaw(0.2, 1.0)
    mosaic_error_ratio: float = 2.0
    depth_sigma_px: SigmaLaw = SigmaLaw(0.05, 1.0)
    depth_error_ratio: float = 1.0
    lateral_sigma_px: float = 0.2
    map_completeness: FractionLaw = FractionLaw(0.999, 2.0, 4.0)
