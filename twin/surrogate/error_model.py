"""Error model of the surrogate: standard deviations and success rates of the image measurements of a survey.

Most of them are functions of the Cramér-Rao lower bound on the standard deviation of a matched patch's position (see
`matchability`). The parameters are fitted to rendered surveys.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from twin.core.geometry import Array

_LARGEST_BOUND_PX = 1e100  # replaces infinite bounds in ratios, which then have their limits instead of inf / inf


class SigmaLaw(NamedTuple):
    """Standard deviation as a function of the Cramér-Rao bound c [px]: sqrt(floor_px^2 + (slope c)^2)."""

    floor_px: float  #: standard deviation in noise-free images [px]
    slope: float  #: ratio of the standard deviation to the bound for large bounds

    def __call__(self, bound_px: float) -> float:
        """Returns the standard deviation [px] at a Cramér-Rao bound [px]."""
        return float(np.hypot(self.floor_px, self.slope * bound_px))


class FractionLaw(NamedTuple):
    """Fraction as a function of the Cramér-Rao bound c [px]: maximum / (1 + (c / half_px)^exponent)."""

    maximum: float  #: fraction in noise-free images
    half_px: float  #: bound at which the fraction is half the maximum [px]
    exponent: float  #: steepness of the decrease with c

    def __call__(self, bound_px: float) -> float:
        """Returns the fraction (0 to 1) at a Cramér-Rao bound [px]."""
        return float(self.maximum / (1 + (bound_px / self.half_px) ** self.exponent))


class DepthLaw(NamedTuple):
    """Standard deviation of a pixel's depth from the Kalman depth filter.

    One keyframe gives a depth from stereo, with the standard deviation of `sigma_px`. Each further one adds a depth
    from stereo and one from the motion between the keyframes. The smaller the distance B between consecutive keyframes,
    the less information it adds. Image noise is the exception: it is independent between keyframes at any distance.
    With n keyframes, the variance is multiplied by common + (1 - common) / (1 + g (n - 1)), where
    g = gain B^2 / (B^2 + half_step^2) + noise_gain s, and s is the fraction of the variance that the image noise
    causes: (slope c)^2 / (floor_px^2 + (slope c)^2) at the Cramér-Rao bound c.
    """

    floor_px: float  #: standard deviation from one keyframe in noise-free images [px of disparity]
    slope: float  #: ratio of that standard deviation to the Cramér-Rao bound for large bounds
    #: the standard deviation is multiplied by sqrt(1 + (lamp_growth * lamp_share)^2), where lamp_share is the fraction
    #: of the reflected light that comes from the lamps
    lamp_growth: float
    common: float  #: fraction of the variance that all keyframes share
    gain: float  #: information that each further keyframe adds, relative to the first one, if keyframes are far apart
    half_step: float  #: distance between consecutive keyframes at which each adds half of `gain` [stereo baselines]
    #: information that each further keyframe adds at any distance, relative to the first one, if image noise causes the
    #: whole variance
    noise_gain: float = 0.0

    def sigma_px(self, bound_px: Array | float, lamp_share: Array | float) -> Array:
        """Returns the standard deviation from one keyframe [px of disparity].

        Args:
            bound_px: Cramér-Rao bound [px].
        """
        lamp_factor = np.hypot(1, self.lamp_growth * np.asarray(lamp_share))
        return np.hypot(self.floor_px, self.slope * np.asarray(bound_px)) * lamp_factor

    def noise_share(self, bound_px: Array | float) -> Array:
        """Returns the fraction of the variance that the image noise causes, at a Cramér-Rao bound [px]."""
        noise_px2 = np.square(self.slope * np.minimum(bound_px, _LARGEST_BOUND_PX))
        return noise_px2 / np.maximum(self.floor_px**2 + noise_px2, 1e-24)

    def relative_variance(
        self, n_views: Array | float, step_baselines: Array | float, bound_px: Array | float
    ) -> Array:
        """Returns the variance after n keyframes, divided by that of one keyframe.

        Args:
            step_baselines: distance between consecutive keyframes [stereo baselines].
            bound_px: Cramér-Rao bound [px].
        """
        squared = np.square(step_baselines)
        gain = self.gain * squared / np.maximum(squared + self.half_step**2, 1e-12)
        gain = gain + self.noise_gain * self.noise_share(bound_px)
        return self.common + (1 - self.common) / (1 + gain * (np.asarray(n_views) - 1))


class ScatterLaw(NamedTuple):
    """Standard deviation, over map cells, of the logarithm of a standard deviation of depth: gain t c / (c + half_px).

    c is the Cramér-Rao bound [px], t the standard deviation of its logarithm over the windows of dense matching
    (`window_texture.WindowTexture.scatter`).
    """

    gain: float  #: standard deviation for large bounds, divided by t
    half_px: float  #: bound at which the standard deviation is half of that for large bounds [px]

    def __call__(self, bound_px: Array | float, texture_scatter: Array | float) -> Array:
        """Returns the standard deviation at a Cramér-Rao bound c [px] and a scatter t of the texture."""
        bound = np.minimum(bound_px, _LARGEST_BOUND_PX)
        return self.gain * np.asarray(texture_scatter) * bound / np.maximum(bound + self.half_px, 1e-12)


class BinnedDepthLaw(NamedTuple):
    """Parameters of a `DepthLaw` that change if images are binned; its pixels are then the binned ones.

    `common`, `gain` and `noise_gain` change because weak textures, in murky water, cause errors that further keyframes
    reduce less than they reduce noise.
    """

    by_2: float  #: factor on the standard deviation from one keyframe for images that are binned by 2 and by 4
    by_4: float  #: factor on the standard deviation from one keyframe for images that are binned by 2 and by 4
    common: float  #: replace those of the law
    gain: float  #: replace those of the law
    noise_gain: float  #: replace those of the law

    def changed(self, law: DepthLaw, binning: int) -> DepthLaw:
        """Returns the law for images that are binned by 2 or 4, or the law itself without binning."""
        if binning == 1:
            return law
        factor = {2: self.by_2, 4: self.by_4}[binning]
        return DepthLaw(
            factor * law.floor_px, factor * law.slope, law.lamp_growth, self.common, self.gain, law.half_step,
            self.noise_gain,
        )  # fmt: skip


class BorderLaw(NamedTuple):
    """Fraction of cells without a height near the border of the images: share exp(-b sqrt(n) / width).

    b is the largest distance of a cell from the border over the n consecutive keyframes that observed it. Matching
    windows at the border extend beyond the image, so their disparities are more often too uncertain for the map.
    """

    share: float  #: fraction at the border
    floor_px: float  #: width in noise-free images [px]
    slope: float  #: ratio of the width to the Cramér-Rao bound for large bounds, without lamps
    #: the part that increases with the bound is multiplied by sqrt(1 + (lamp_growth * lamp_share)^2), where lamp_share
    #: is the fraction of the reflected light that comes from the lamps
    lamp_growth: float

    def width_px(self, bound_px: Array | float, lamp_share: Array | float) -> Array:
        """Returns the width [px] at a Cramér-Rao bound [px] and a fraction of light from the lamps."""
        noise_px = self.slope * np.asarray(bound_px) * np.hypot(1, self.lamp_growth * np.asarray(lamp_share))
        return np.hypot(self.floor_px, noise_px)


class BorderErrorLaw(NamedTuple):
    """Standard deviation of depth near the border of the images, relative to that elsewhere: 1 + share exp(-b / width).

    b is the largest distance of a cell from the border over the consecutive keyframes that observed it. Matching
    windows at the border extend beyond the image, so fewer pixels determine the disparity.
    """

    share: float  #: relative increase at the border
    width_px: float  #: width [px]

    def __call__(self, border_px: Array | float) -> Array:
        """Returns the relative standard deviation at a distance from the border [px]."""
        return 1 + self.share * np.exp(-np.asarray(border_px) / self.width_px)


class ErrorModel(NamedTuple):
    """Parameters of the measurement errors of the surrogate.

    The standard deviation (sigma) that an estimator reports may differ from that of its errors. Fields named
    `..._sigma_px` model the reported standard deviation (`lateral_sigma_px` the true one), and fields named
    `..._error_ratio` the ratio of the true to the reported one.
    """

    #: smallest and largest Cramér-Rao bound of the surveys to which the model was fitted; the bound of a survey is the
    #: median over its keyframes
    bound_range_px: tuple[float, float] = (0.0, 1.0)
    #: number of matched stereo points of a keyframe, as a fraction of the number of points that the estimators try to
    #: match (`vision.corner_count`)
    point_fraction: FractionLaw = FractionLaw(0.9, 1.0, 4.0)
    #: reported standard deviation of a patch's position in one image of a level floor
    match_sigma_px: SigmaLaw = SigmaLaw(0.02, 1.0)
    #: increase of this standard deviation over relief: it becomes sqrt(match_sigma_px^2 + (stereo_relief_gain * p)^2),
    #: where p is the RMS parallax of the relief within a patch between the two cameras, i.e. its unevenness times
    #: baseline / depth (see `matchability`).
    stereo_relief_gain: float = 0.0
    #: ratio of the true to the reported standard deviation of a patch's position in one image
    match_error_ratio: float = 1.05
    #: growth of the match errors of links due to the lamps on the vehicle: the squares of `match_error_ratio` and of
    #: `relief_gain` are multiplied by 1 + (lamp_error_growth * lamp_share)^2, where lamp_share is the fraction of the
    #: reflected light that comes from the lamps. Shading and brightness of a patch change when the lamps move.
    lamp_error_growth: float = 0.0
    #: growth of the reported covariance of a link due to the lamps, which the estimators derive from residuals: it is
    #: multiplied by 1 + (lamp_sigma_growth * lamp_share)^2
    lamp_sigma_growth: float = 0.0
    #: of a keyframe's points that lie in the field of view of another keyframe, the fraction that is matched there
    match_fraction: FractionLaw = FractionLaw(0.97, 1.0, 4.0)
    #: parallax of the relief within a patch, i.e. its unevenness times distance / depth, at which half of the points
    #: that could be matched between two keyframes are matched. The fraction is 1 / (1 + (parallax /
    #: match_parallax_px)^2), because the patch then looks different from the two keyframes. Not fitted, because the
    #: surveys of the fit give contradictory values.
    match_parallax_px: float = 3.0
    #: factor on the reported covariance of a link, without the part due to the bias that all points share, in addition
    #: to the factor for overlapping patches (`vision.overlap_inflation`)
    match_covariance_inflation: float = 1.5
    #: correlation parameter r of the match error in the earlier stereo pair of a link. In units of its standard
    #: deviation, the error is r b + sqrt(1 - r^2) e, where b and e have unit variance, b is common to all links to that
    #: pair, and e is independent from link to link; `distance_growth` increases e only.
    match_bias_fraction: float = 0.8
    #: growth of the reported and of the true match variance in the earlier keyframe of a link with the distance between
    #: the two keyframes: the variance is multiplied by 1 + (distance_growth * distance / depth)^2
    distance_growth: float = 0.0
    #: standard deviation of the match error due to relief within the patch, per pixel of unevenness (see
    #: `matchability`) and per unit of distance / depth. The error is the same for all matches of one patch of floor, so
    #: it accumulates along a path. Let g = (g_x, g_y) be the image gradient in x (along rows) and y, t = (t_x, t_y) the
    #: translation between the images, and d the parallax of a pixel relative to the patch's plane, per unit of t.
    #: Least-squares matching displaces the patch by (sum g g')^-1 (sum g g' d) t, summed over its pixels. The
    #: displacement in x due to t_x is no error: stereo matching, with its baseline along x, averages d with the same
    #: weights g_x^2, so the depth of the patch already contains it. Three terms remain as errors: the displacement in x
    #: due to t_y and the one in y due to t_x, both with the gain `relief_gain`, and the displacement in y due to t_y,
    #: with twice this gain for isotropic texture.
    relief_gain: float = 0.0
    #: true standard deviation of the bias of image positions that all points of a link share [px]
    common_bias_px: float = 0.005
    #: reported standard deviation of a flow vector of frame-to-frame tracking
    f2f_sigma_px: SigmaLaw = SigmaLaw(0.05, 1.0)
    f2f_error_ratio: float = 1.4  #: ratio of the true to the reported standard deviation of a frame-to-frame motion
    #: fraction of the independent error of a frame-to-frame motion that the next motion cancels (a first-order moving
    #: average), because both motions are measured relative to the same points
    f2f_anticorrelation: float = 0.3
    #: reported standard deviation of a registration with the mosaic, expressed as the standard deviation of one flow
    #: vector if the registration were estimated from c times as many flow vectors as a frame-to-frame motion, where c
    #: is the fraction of the field of view that the mosaic covers
    mosaic_sigma_px: SigmaLaw = SigmaLaw(0.2, 1.0)
    mosaic_error_ratio: float = 2.0  #: ratio of the true to the reported standard deviation of a registration
    #: true standard deviation of a pixel's depth from the Kalman depth filter, median over cells, at the bound of the
    #: median window (`Matchability.window_bounds_px`)
    depth_error: DepthLaw = DepthLaw(0.05, 2.0, 1.0, 0.01, 4.0, 1.5)
    #: reported standard deviation of a pixel's depth from the Kalman depth filter, likewise
    depth_sigma: DepthLaw = DepthLaw(0.05, 2.0, 1.0, 0.01, 3.0, 1.0)
    #: standard deviation, over the cells of a map with equal conditions, of the logarithm of the reported standard
    #: deviation of depth: the depth filter measures how well each pixel is matched. Errors of a map are therefore a
    #: scale mixture: normal with the standard deviation of their cell, but with heavy tails over the whole map.
    depth_texture_scatter: ScatterLaw = ScatterLaw(0.0, 1.0)
    #: ratio of the scatter over cells of the logarithm of the true standard deviation of depth to that of the reported
    #: one (`depth_texture_scatter`); both vary together
    error_scatter_share: float = 1.0
    #: changes of `depth_error` for binned images
    depth_binned_error: BinnedDepthLaw = BinnedDepthLaw(1.0, 1.0, 0.01, 4.0, 0.0)
    #: changes of `depth_sigma` for binned images
    depth_binned_sigma: BinnedDepthLaw = BinnedDepthLaw(1.0, 1.0, 0.01, 3.0, 0.0)
    #: standard deviation, over surveys, of the logarithm of the true and the reported standard deviation of depth about
    #: their laws, due to properties of floor and images that the model does not contain
    depth_survey_scatter: float = 0.0
    #: standard deviation, over surveys, of the logarithm of the ratio of the true to the reported standard deviation of
    #: depth about its law
    depth_ratio_scatter: float = 0.0
    #: increase of the true and of the reported standard deviation of depth near the image borders
    border_error: BorderErrorLaw = BorderErrorLaw(0.0, 3.0)
    #: true standard deviation of the lateral shift of a mapped surface, common to all its views [px]
    lateral_sigma_px: float = 0.2
    #: fraction of the smooth map cells in view, away from the borders of the images, for which the Kalman depth filter
    #: provides a depth
    map_completeness: FractionLaw = FractionLaw(0.999, 2.0, 4.0)
    #: fraction of the cells near the borders of the images that have no depth for this reason
    border_holes: BorderLaw = BorderLaw(0.5, 1.0, 80.0, 1.3)
    #: gain g of the true standard deviation of the height error due to the roughness r of a cell, a q^2 / sqrt(1 + q^4)
    #: with q = g r / a and the limit a, `relief_error_limit_px`. The roughness is the RMS deviation of the floor from a
    #: plane within the window of dense matching. The error is common to all views of the cell.
    relief_error_gain: float = 0.3
    relief_error_limit_px: float = 0.1  #: limit of this standard deviation for large roughness [px of disparity]
    #: true standard deviation of the height error near walls, where the matching window shows two surfaces, from one
    #: keyframe, per `map_model.edge_strength` [px^(1/2)]. It grows with the bound. The errors are heavy-tailed
    #: (`map_model.heavy_tailed`).
    edge_error: SigmaLaw = SigmaLaw(0.3, 10.0)
    #: reported standard deviation of the height near walls, per `map_model.edge_strength`, in addition to the terms
    #: that the map computes from the heights around a cell
    edge_sigma_gain: float = 0.3
    edge_half_px: float = 10.0  #: roughness at which half the cells have no depth [px of disparity]

    def depth_laws(self, binning: int) -> tuple[DepthLaw, DepthLaw]:
        """Returns the laws of the true and of the reported standard deviation of depth for a binning of 1, 2 or 4."""
        changes = (self.depth_binned_error, self.depth_error), (self.depth_binned_sigma, self.depth_sigma)
        error, sigma = (change.changed(law, binning) for change, law in changes)
        return error, sigma
