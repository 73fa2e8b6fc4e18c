"""Fit of the error model to the statistics of rendered surveys.

The laws of the reported standard deviations of matching, F2F and F2M (`SigmaLaw`) are fitted to the ratios of the
standard deviations reported for image measurements to those reported by the surrogate. The error ratios are fitted to
squared errors normalised by reported covariances. Medians and trimmed means make the fit robust against a few failed
measurements. Every survey has the same weight, except in the fits of `match_bias_fraction`, `border_error` and
`edge_half_px`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import least_squares

from twin.surrogate.error_model import (
    BinnedDepthLaw,
    BorderErrorLaw,
    BorderLaw,
    DepthLaw,
    ErrorModel,
    FractionLaw,
    ScatterLaw,
    SigmaLaw,
)
from twin.surrogate.map_model import relief_error_px
from twin.surrogate.vision import match_sigma_px
from twin.surrogate_fit.comparison import BIAS_FRACTION, RELIEF_GAIN, ROUGH_PX, UNIT_PX

_NORMAL_MAD = 1.4826  # standard deviation of a normal distribution, divided by its median absolute value
_PRIOR = 0.01  # weight of the relative departure of a parameter from its value in the compared model
_HOLE_OUTLIER = 0.01  # residual of a fraction without a height beyond which a bin of cells has less weight
_OUTLIER = 0.3  # residual of the logarithm of a standard deviation beyond which it has less weight
_LEVEL = ("map_scatter_smooth", "map_scatter_rough")  # first parts of the names of the statistics of level cells
_LEVEL_TAILS = ("map_tail_smooth", "map_tail_rough")
_NORMAL_TAIL = 2.4387  # 90th percentile of the absolute value of a normal variable, divided by the median
_FAR_PX = 20.0  # distance from the image border beyond which matching windows are complete
#: Limits and typical values of the parameters of a `DepthLaw`.
_LOWEST_LAW = (0.0, 0.0, 0.0, 0.0, 0.1, 0.01, 0.0)
_HIGHEST_LAW = (1.0, 20.0, 3.0, 0.9, 100.0, 10.0, 10.0)
_TYPICAL_LAW = (0.05, 1.0, 1.0, 0.1, 3.0, 1.0, 1.0)
#: Limits and typical values of the parameters of a `BinnedDepthLaw`.
_BINNED_LIMITS = (0.3, 0.3, 0.0, 0.0, 0.0), (5.0, 5.0, 0.9, 20.0, 10.0), (1.0, 1.0, 0.1, 3.0, 1.0)
_SOURCES = ("images", "patches", "relief")

#: Samples of each statistic of one survey, by name; see `ComparisonVision.statistics`.
SurveyStatistics = Mapping[str, Sequence[float]]


def fit_error_model(surveys: Sequence[SurveyStatistics], compared: ErrorModel) -> ErrorModel:
    """Returns the error model that reproduces the statistics of rendered surveys.

    `match_parallax_px` and `common_bias_px` are not fitted; they are those of the compared model.
    """
    bounds = np.array([np.median(s["bound_px"]) for s in surveys])

    def median(name: str) -> np.ndarray:
        return np.array([np.median(s[name]) for s in surveys])

    f2f_ratios = np.sqrt(median("f2f_nees") / median("f2f_nees_surrogate"))
    parallax = median("stereo_parallax_px")
    compared_px = [match_sigma_px(compared, b, p) for b, p in zip(bounds, parallax, strict=True)]
    sigma_law, stereo_relief_gain = _fit_match_sigma(bounds, parallax, median("match_sigma_ratio") * compared_px)
    f2f_sigma_px = _fit_sigma_law(bounds, median("f2f_sigma_ratio") * [compared.f2f_sigma_px(b) for b in bounds])
    mosaic_sigmas_px = median("mosaic_sigma_ratio") * [compared.mosaic_sigma_px(b) for b in bounds]
    mosaic_sigma_px = _fit_sigma_law(bounds, mosaic_sigmas_px)
    distance_growth, link_ratios = _fit_distance_growth(surveys, compared.distance_growth)
    compared_lamps = np.hypot(1, compared.lamp_sigma_growth * median("lamp_share"))
    inflation, lamp_sigma_growth = _fit_lamp_growth(
        link_ratios / median("match_sigma_ratio") * compared_lamps, median("lamp_share")
    )
    links = _fit_link_errors(surveys, median("match_sigma_ratio"), median("lamp_share"), compared)
    errors, reported = (_fit_map_variances(surveys, quantity, compared) for quantity in ("error", "sigma"))
    completeness = _fit_completeness(surveys, compared.map_completeness)
    compared_fractions = np.array([compared.match_fraction(b) * compared.point_fraction(b) for b in bounds])
    match_fractions = _matched_without_relief(surveys) * compared_fractions / median("point_fraction")
    mosaic_chi2 = median("mosaic_difference_nees") - compared.mosaic_error_ratio**2
    return compared._replace(
        bound_range_px=(float(bounds.min()), float(bounds.max())),
        point_fraction=_fit_fraction_law(bounds, median("point_fraction")),
        match_sigma_px=sigma_law,
        stereo_relief_gain=stereo_relief_gain,
        match_error_ratio=links.match_error_ratio,
        lamp_error_growth=links.lamp_error_growth,
        lamp_sigma_growth=lamp_sigma_growth,
        match_fraction=_fit_fraction_law(bounds, np.minimum(match_fractions, 1.0)),
        match_covariance_inflation=compared.match_covariance_inflation * inflation**2,
        match_bias_fraction=links.match_bias_fraction,
        distance_growth=distance_growth,
        relief_gain=links.relief_gain,
        f2f_sigma_px=f2f_sigma_px,
        f2f_error_ratio=compared.f2f_error_ratio * float(np.median(f2f_ratios)),
        f2f_anticorrelation=float(np.median([_fit_anticorrelation(s) for s in surveys])),
        mosaic_sigma_px=mosaic_sigma_px,
        depth_error=errors.depth,
        depth_sigma=reported.depth,
        depth_texture_scatter=_fit_texture_scatter(surveys, compared.depth_texture_scatter),
        error_scatter_share=_fit_error_scatter(surveys, compared.error_scatter_share),
        depth_binned_error=errors.binned,
        depth_binned_sigma=reported.binned,
        depth_survey_scatter=_robust_scatter(reported.departures),
        depth_ratio_scatter=_robust_scatter(errors.departures - reported.departures),
        lateral_sigma_px=errors.lateral_sigma_px,
        border_error=_fit_border_errors(surveys, compared.border_error),
        map_completeness=completeness,
        border_holes=_fit_border_holes(surveys, compared.border_holes),
        relief_error_gain=errors.relief_gain,
        relief_error_limit_px=errors.relief_limit_px,
        edge_error=errors.edge,
        edge_sigma_gain=reported.edge.floor_px,
        edge_half_px=_fit_edge_holes(surveys, compared.edge_half_px),
        mosaic_error_ratio=float(np.sqrt(np.median(np.maximum(mosaic_chi2, 0.01) / median("mosaic_sigma_ratio") ** 2))),
    )


def log_misfit(surveys: Sequence[SurveyStatistics], compared: ErrorModel, fitted: ErrorModel) -> dict[str, float]:
    """Returns the RMS over surveys of ln(reported / fitted standard deviation), by name of the error model's field."""

    def sigma_px(name: str, model: ErrorModel, s: SurveyStatistics) -> float:
        bound_px = float(np.median(s["bound_px"]))
        if name == "match_sigma_px":
            return match_sigma_px(model, bound_px, float(np.median(s["stereo_parallax_px"])))
        return getattr(model, name)(bound_px)

    def misfit(name: str) -> float:
        ratio = name.replace("_px", "_ratio")
        logs = [np.log(np.median(s[ratio]) * sigma_px(name, compared, s) / sigma_px(name, fitted, s)) for s in surveys]
        return float(np.sqrt(np.mean(np.square(logs))))

    return {name: misfit(name) for name in ("match_sigma_px", "f2f_sigma_px", "mosaic_sigma_px")}


def _solve(
    residuals: Callable[[np.ndarray], np.ndarray],
    start: ArrayLike,
    limits: tuple[ArrayLike, ArrayLike],
    outlier: float | None = None,
) -> list[float]:
    """Returns the parameters, within limits, of least squares; residuals beyond `outlier` have less weight."""
    loss: dict[str, Any] = {} if outlier is None else {"loss": "soft_l1", "f_scale": outlier}
    return least_squares(residuals, start, bounds=limits, **loss).x.tolist()


def _fit_sigma_law(bounds: np.ndarray, sigmas: np.ndarray) -> SigmaLaw:
    """Returns the `SigmaLaw` fitted to standard deviations (n,) [px] at Cramér-Rao bounds (n,) [px]."""

    def residuals(x: np.ndarray) -> np.ndarray:
        return np.log(np.hypot(x[0], x[1] * bounds) / sigmas)

    return SigmaLaw(*_solve(residuals, [sigmas.min() / 2, 1.0], ([1e-4, 0.0], [10.0, 100.0])))


def _fit_match_sigma(bounds: np.ndarray, parallax: np.ndarray, sigmas: np.ndarray) -> tuple[SigmaLaw, float]:
    """Returns `match_sigma_px` and `stereo_relief_gain` of the error model, fitted to reported standard deviations."""

    def residuals(x: np.ndarray) -> np.ndarray:
        return np.log(np.sqrt(x[0] ** 2 + (x[1] * bounds) ** 2 + (x[2] * parallax) ** 2) / sigmas)

    limits = [1e-4, 0.0, 0.0], [10.0, 100.0, 10.0]
    floor_px, slope, gain = _solve(residuals, [sigmas.min() / 2, 1.0, 0.3], limits)
    return SigmaLaw(floor_px, slope), gain


def _fit_fraction_law(bounds: np.ndarray, fractions: np.ndarray, outlier: float = 1.0) -> FractionLaw:
    """Returns the `FractionLaw` with exponent 4 fitted to fractions (n,) at Cramér-Rao bounds (n,) [px]."""

    def residuals(x: np.ndarray) -> np.ndarray:
        return np.array([FractionLaw(x[0], np.exp(x[1]), 4.0)(b) for b in bounds]) - fractions

    start = [min(float(fractions.max()), 0.9999), np.log(4 * bounds.max())]
    limits = ([0.01, np.log(bounds.min())], [1.0, np.log(100 * bounds.max())])
    maximum, log_half_px = _solve(residuals, start, limits, outlier)
    return FractionLaw(maximum, float(np.exp(log_half_px)), 4.0)


def _fit_anticorrelation(statistics: SurveyStatistics) -> float:
    """Returns the anticorrelation u of consecutive frame-to-frame motions, fitted to the summed error of n motions.

    If each motion cancels the fraction u of the independent error of the previous motion, the variance of the sum of n
    motions is (1 + (n - 1) (1 - u)^2) / (n (1 + u^2)) times that of n uncorrelated motions of equal variance.
    """
    n = float(np.median(statistics["f2f_interval_frames"]))
    ratio = np.median(statistics["f2f_interval_nees"]) / np.median(statistics["f2f_nees"])
    u = np.linspace(-1.0, 1.0, 2001)
    return float(u[np.argmin(np.abs((1 + (n - 1) * (1 - u) ** 2) / (n * (1 + u**2)) - ratio))])


class _LinkErrors(NamedTuple):
    """Parameters of the true errors of links; see `ErrorModel`."""

    match_error_ratio: float
    lamp_error_growth: float
    relief_gain: float
    match_bias_fraction: float


def _fit_link_errors(
    surveys: Sequence[SurveyStatistics], match_ratios: np.ndarray, lamp_share: np.ndarray, compared: ErrorModel
) -> _LinkErrors:
    """Separates link errors into contributions of patch matching, of relief, and of a bias of each keyframe.

    Errors due to relief grow with unevenness and with the distance between the keyframes. Match error ratio, relief
    gain and their growth under lamps are therefore fitted to the mean squared errors of the thirds of each survey's
    links, sorted by distance; a relief gain is a weak prior, for smooth floors do not determine it. The bias of a
    keyframe, which ends one link and starts the next, makes consecutive errors cancel partly, relief makes them equal:
    the bias fraction is fitted to the scalar products of the errors of consecutive links.
    """
    images, by_patches, by_relief = np.array([_squared_errors_by_distance(s) for s in surveys]).transpose(2, 0, 1)
    reported, share = np.square(match_ratios)[:, None], lamp_share[:, None]
    by_relief = by_relief / (RELIEF_GAIN**2 * (1 + (compared.lamp_error_growth * share) ** 2))

    def residuals(x: np.ndarray) -> np.ndarray:
        lamps = 1 + (x[1] * share) ** 2
        logs = np.log(lamps * (x[0] ** 2 * reported * by_patches + x[2] ** 2 * by_relief) / images) / 2
        return np.append(logs.ravel(), _PRIOR * (x[2] / max(compared.relief_gain, RELIEF_GAIN) - 1))

    start, limits = [1.0, 0.5, max(compared.relief_gain, RELIEF_GAIN)], ([1e-3, 0.0, 0.0], [100.0, 10.0, 100.0])
    ratio, growth, gain = _solve(residuals, start, limits, _OUTLIER)
    relief = gain**2 * (1 + (growth * share) ** 2)
    patches = np.median(np.maximum(images - relief * by_relief, images / 10) / by_patches, axis=1)
    products = np.array([[np.mean(s[f"consecutive_product_{name}"]) for name in _SOURCES] for s in surveys])
    products[:, 2] *= (relief / (RELIEF_GAIN**2 * (1 + (compared.lamp_error_growth * share) ** 2)))[:, 0]
    n_products = np.array([len(s["consecutive_product_images"]) for s in surveys])
    measured = n_products @ ((products[:, 0] - products[:, 2]) / patches)
    bias = BIAS_FRACTION * measured / (n_products @ products[:, 1])
    return _LinkErrors(ratio, growth, gain, float(np.clip(bias, 0.0, 0.98)))


def _fit_lamp_growth(ratios: np.ndarray, lamp_share: np.ndarray) -> tuple[float, float]:
    """Fits c and k of the law c sqrt(1 + (k lamp_share)^2) to ratios of standard deviations."""

    def residuals(x: np.ndarray) -> np.ndarray:
        return x[0] + np.log1p((x[1] * lamp_share) ** 2) / 2 - np.log(ratios)

    start = [float(np.median(np.log(ratios))), 0.5]
    log_ratio, growth = _solve(residuals, start, ([-10.0, 0.0], [10.0, 10.0]), _OUTLIER)
    return float(np.exp(log_ratio)), growth


def _squared_errors_by_distance(statistics: SurveyStatistics) -> np.ndarray:
    """Returns mean normalised squared link errors (3, 3), with a row per third of the links and a column per source."""
    errors = np.column_stack([statistics[f"link_nees_{name}"] for name in _SOURCES])
    order = np.argsort(statistics["link_distance"])
    thirds = (np.sort(errors[third], axis=0) for third in np.array_split(order, 3))
    return np.array([third[: len(third) - len(third) // 20].mean(axis=0) for third in thirds])


def _fit_distance_growth(surveys: Sequence[SurveyStatistics], compared_growth: float) -> tuple[float, np.ndarray]:
    """Fits the growth of the reported link covariance with the distance between the keyframes.

    At distance zero, both stereo pairs of a link contribute the same variance. The contribution of the earlier pair is
    multiplied by 1 + (growth * distance)^2, so the variance of the link is multiplied by
    1 + (growth * distance)^2 / 2. The distance is computed by `KeyframeTruth.distance_in_depths`.
    """
    half_squares = [np.square(s["link_distance"]) / 2 for s in surveys]
    log_variances = [
        2 * np.log(s["link_sigma_ratio"]) + np.log1p(compared_growth**2 * half_square)
        for s, half_square in zip(surveys, half_squares, strict=True)
    ]

    def log_ratios(x: np.ndarray) -> list[np.ndarray]:
        return [log - np.log1p(x[0] ** 2 * half) for log, half in zip(log_variances, half_squares, strict=True)]

    def residuals(x: np.ndarray) -> np.ndarray:
        return np.concatenate([(ratios - np.median(ratios)) / np.sqrt(len(ratios)) for ratios in log_ratios(x)])

    solution = np.array(_solve(residuals, [max(compared_growth, 1.0)], ([0.0], [30.0]), 0.02))
    return float(solution[0]), np.exp([np.median(ratios) / 2 for ratios in log_ratios(solution)])


def _matched_without_relief(surveys: Sequence[SurveyStatistics]) -> np.ndarray:
    """Returns the median ratio (n,) of matched points, images / surrogate, of the links with the least parallax."""
    ratios = []
    for s in surveys:
        parallax, matched = np.array(s["link_parallax_px"]), np.array(s["link_matched"])
        ratios.append(np.median(matched[parallax <= np.median(parallax)]))
    return np.array(ratios)


def _known_smooth_fraction(statistics: SurveyStatistics) -> float | None:
    """Returns the fraction of smooth cells, far from the image borders, that have a height; None without such cells."""
    if not len(statistics.get("hole_px", ())) or statistics["hole_px"][0] >= ROUGH_PX:
        return None
    return max(statistics["hole_known"][0], 1e-6)


def _fit_completeness(surveys: Sequence[SurveyStatistics], compared: FractionLaw) -> FractionLaw:
    """Fits `map_completeness` to the surveys with smooth cells; returns the compared law if there are none."""
    rows = [(np.median(s["bound_px"]), known) for s in surveys if (known := _known_smooth_fraction(s)) is not None]
    if not rows:
        return compared
    bounds, known = np.array(rows).T
    return _fit_fraction_law(bounds, known, _HOLE_OUTLIER / 10)


def _fit_edge_holes(surveys: Sequence[SurveyStatistics], compared_px: float) -> float:
    """Fits `edge_half_px` to the fractions of cells with a height, relative to the smooth cells of the same survey."""
    roughness, fractions, weights = [np.zeros(0)], [np.zeros(0)], [np.zeros(0)]
    for s in surveys:
        if (smooth := _known_smooth_fraction(s)) is None:
            continue
        known = np.array(s["hole_known"]) / smooth
        roughness.append(np.array(s["hole_px"])[1:])
        fractions.append(np.minimum(known[1:], 1.0))
        weights.append(np.sqrt(np.array(s["hole_cells"])[1:] / np.sum(s["hole_cells"])))
    r, known, weight = (np.concatenate(part) for part in (roughness, fractions, weights))
    if len(r) == 0:
        return compared_px
    half = np.geomspace(0.3, 100.0, 400)
    misfit = [np.sum((weight * (1 / (1 + (r / h) ** 2) - known)) ** 2) for h in half]
    return float(half[np.argmin(misfit)])


def _fit_border_errors(surveys: Sequence[SurveyStatistics], compared: BorderErrorLaw) -> BorderErrorLaw:
    """Fits the `BorderErrorLaw` to errors and reported standard deviations of cells near the image borders."""
    rows = []
    for s in surveys:
        distance = np.array(s.get("border_distance_px", ()))
        far = distance > _FAR_PX
        for name in ("border_error_ratio", "border_sigma_ratio") if far.any() else ():
            logs = np.log(s[name])
            rows += list(zip(distance[~far], logs[~far] - np.median(logs[far]), strict=True))
    if not rows:
        return compared
    distance, log_ratio = np.array(rows).T
    target = log_ratio + np.log(compared(distance))

    def residuals(x: np.ndarray) -> np.ndarray:
        return np.log(BorderErrorLaw(*x)(distance)) - target

    return BorderErrorLaw(*_solve(residuals, [1.0, 3.0], ([0.0, 0.5], [10.0, 20.0]), _OUTLIER))


def _fit_border_holes(surveys: Sequence[SurveyStatistics], compared: BorderLaw) -> BorderLaw:
    """Fits the `BorderLaw` to the fractions of smooth cells without a height, by distance from the image border."""
    rows: list[tuple[float, ...]] = []
    for s in surveys:
        if (smooth := _known_smooth_fraction(s)) is None:
            continue
        cells = np.array(s.get("border_cells", ()))
        for distance, known, weight in zip(s.get("border_px", ()), s.get("border_known", ()), cells, strict=True):
            hole = 1 - min(known / smooth, 1.0)
            conditions = float(np.median(s["bound_px"])), float(np.median(s["lamp_share"]))
            rows.append((distance, hole, float(np.sqrt(weight / cells.sum())), *conditions))
    if not rows:
        return compared
    distance, hole, weight, bounds, lamps = np.array(rows).T

    def residuals(x: np.ndarray) -> np.ndarray:
        return weight * (x[0] * np.exp(-distance / BorderLaw(*x).width_px(bounds, lamps)) - hole)

    limits = [0.0, 0.05, 1.0, 0.0], [1.0, 20.0, 1000.0, 3.0]
    return BorderLaw(*_solve(residuals, [0.5, 1.0, 50.0, 1.0], limits, _HOLE_OUTLIER))


class _Limits(NamedTuple):
    """Limits, typical values and start values of the n parameters of a fit."""

    lowest: tuple[float, ...]
    highest: tuple[float, ...]
    typical: tuple[float, ...]
    start: tuple[float, ...]


class _MapErrors(NamedTuple):
    """Parameters of the errors of maps, or of their reported variances."""

    depth: DepthLaw  #: law of the standard deviation of depth
    lateral_sigma_px: float  #: standard deviation of the lateral shift [px]
    relief_gain: float  #: gain of the error due to relief (`map_model.relief_error_px`)
    relief_limit_px: float  #: limit of this error [px of disparity]
    edge: SigmaLaw  #: law of the standard deviation per `map_model.edge_strength`
    binned: BinnedDepthLaw  #: change of the law for binned images
    #: (n,) logarithm of measured / modelled standard deviation of each survey, the median over its classes of cells,
    #: because a class may consist of a few cells at one spot of the floor
    departures: np.ndarray

    def variance(self, classes: _MapClasses) -> np.ndarray:
        """Returns the modelled variance (m,) of the classes [m^2]."""
        relief_px2 = relief_error_px(classes.roughness_px, self.relief_gain, self.relief_limit_px) ** 2
        common = classes.metres_per_px**2 * relief_px2 + self.lateral_sigma_px**2 * classes.lateral
        edge = (self.edge.floor_px**2 + (self.edge.slope * classes.bound_px) ** 2) * classes.edge
        by_binning = [classes.depth_of(self.binned.changed(self.depth, binning)) for binning in (1, 2, 4)]
        depth = np.select([classes.binning == binning for binning in (1, 2, 4)], by_binning)
        return classes.pose + depth + common + edge


class _MapClasses(NamedTuple):
    """Variances of maps [m^2] and conditions, of m classes of cells."""

    images: np.ndarray  #: (m,) variance in the map from images
    sampled: np.ndarray  #: (m,) variance in the map sampled from the compared model
    pose: np.ndarray  #: (m,) variance due to pose errors alone
    depth: np.ndarray  #: (m,) variance that an error of depth of 1 px adds
    lateral: np.ndarray  #: (m,) variance that a lateral shift of 1 px adds
    edge: np.ndarray  #: (m,) variance that errors near walls add if their gain is 1
    views: np.ndarray  #: (m,) mean number of keyframes
    step_baselines: np.ndarray  #: (m,) mean distance between keyframes [stereo baselines]
    roughness_px: np.ndarray  #: (m,) roughness of the cells [px of disparity]
    bound_px: np.ndarray  #: (m,) Cramér-Rao bound of the image [px]
    window_px: np.ndarray  #: (m,) Cramér-Rao bound of the median window [px]
    lamp_share: np.ndarray  #: (m,) fraction of the reflected light that comes from the lamps
    metres_per_px: np.ndarray  #: (m,) height per pixel of disparity
    binning: np.ndarray  #: (m,) binning of the images
    survey: np.ndarray  #: (m,) number of the survey
    weight: np.ndarray  #: (m,) weights of the residuals, with which every survey has the same total weight

    def depth_of(self, law: DepthLaw) -> np.ndarray:
        """Returns the variance (m,) that errors of depth with the given law add [m^2]."""
        share = law.relative_variance(self.views, self.step_baselines, self.window_px)
        return self.depth * law.sigma_px(self.window_px, self.lamp_share) ** 2 * share

    def where(self, chosen: np.ndarray) -> _MapClasses:
        """Returns the classes that a mask (m,) selects."""
        return _MapClasses(*(values[chosen] for values in self))


def _map_classes(surveys: Sequence[SurveyStatistics], quantity: str) -> _MapClasses:
    """Returns the classes of cells of all surveys, with the quantities of `comparison.MAP_STATISTICS`."""
    rows, conditions = [], []
    for number, s in enumerate(surveys):
        classes = [name for name in s if name.startswith(f"map_{quantity}_")]
        rows += [s[name] for name in classes]
        bound, lamp_share = float(np.median(s["bound_px"])), float(np.median(s["lamp_share"]))
        condition = bound, bound * s["window_ratio"][0], lamp_share, s["metres_per_px"][0], s["binning"][0], number
        conditions += [(*condition, 1 / np.sqrt(max(len(classes), 1)))] * len(classes)
    images, pose, depth, lateral, edge, sampled, views, step, rough = np.array(rows).T
    of_depth, of_lateral, of_edge = (np.maximum(x - pose, 0) for x in (depth, lateral, edge))
    condition = np.array(conditions).T
    return _MapClasses(
        images, sampled, pose, of_depth / UNIT_PX**2, of_lateral, of_edge, views, step, rough, *condition
    )  # fmt: skip


def _fit_map_variances(surveys: Sequence[SurveyStatistics], quantity: str, compared: ErrorModel) -> _MapErrors:
    """Fits the parameters of the map errors to the variances in the maps from images, in all classes of cells.

    The model variance of a class is that of the map with pose errors alone, plus terms for depth, lateral shift and
    walls (the variance that a unit error adds to a sampled map, times a fitted factor) and for relief, which the
    fusion of several tracks does not reduce. The sum is not exact, because a map computes part of its variance from the
    heights around a cell. It is therefore multiplied by the ratio of the variance in the map sampled from the compared
    model to the model variance with the compared parameters; repeated fits, each compared with the result of the one
    before, converge. Images without binning determine all parameters but `_MapErrors.binned`.
    """
    is_error = quantity == "error"
    edge_law = compared.edge_error if is_error else SigmaLaw(compared.edge_sigma_gain, 0.0)
    laws = (compared.depth_error, compared.depth_binned_error) if is_error else (
        compared.depth_sigma, compared.depth_binned_sigma
    )  # fmt: skip
    gains = compared.lateral_sigma_px, compared.relief_error_gain, compared.relief_error_limit_px
    now = _MapErrors(laws[0], *(gains if is_error else (0.0, 0.0, 1.0)), edge_law, laws[1], np.zeros(0))
    classes = _map_classes(surveys, quantity)
    ratio = classes.sampled / now.variance(classes)

    def departures(found: _MapErrors, chosen: np.ndarray) -> np.ndarray:
        part = classes.where(chosen)
        return np.log(found.variance(part) * ratio[chosen] / part.images) / 2

    def fitted(model_of: Callable[[np.ndarray], _MapErrors], limits: _Limits, chosen: np.ndarray) -> _MapErrors:
        lowest, highest, typical, values = (np.array(x) for x in limits)
        margin = np.minimum(1e-3, (highest - lowest) / 4)
        start, weight = np.clip(values, lowest + margin, highest - margin), classes.weight[chosen]

        def residuals(x: np.ndarray) -> np.ndarray:
            prior = _PRIOR * (x - start) / np.maximum(start, typical)
            return np.concatenate([weight * departures(model_of(x), chosen), prior])

        return model_of(np.array(_solve(residuals, start, (lowest, highest), _OUTLIER)))

    def full(x: np.ndarray) -> _MapErrors:
        lateral_px, gain, limit_px = x[7:10].tolist() if is_error else (0.0, 0.0, 1.0)
        law, edge = DepthLaw(*x[:7].tolist()), SigmaLaw(*x[10:].tolist())
        return _MapErrors(law, lateral_px, gain, limit_px, edge, laws[1], np.zeros(0))

    limits = _Limits(
        (*_LOWEST_LAW, 0.0, 0.0, 0.01, 0.0, 0.0),
        (*_HIGHEST_LAW, 5.0, 3.0, 1.0, 10.0, 200.0 if is_error else 1e-6),
        (*_TYPICAL_LAW, 0.2, 0.5, 0.05, 1.0, 10.0),
        (*laws[0], *gains, *edge_law),
    )
    result = fitted(full, limits, classes.binning == 1)
    if (binned := classes.binning > 1).any():

        def with_binned(x: np.ndarray) -> _MapErrors:
            return result._replace(binned=BinnedDepthLaw(*x.tolist()))

        result = fitted(with_binned, _Limits(*_BINNED_LIMITS, laws[1]), binned)
    logs = -departures(result, np.ones(len(ratio), np.bool_))
    flown = sorted(set(classes.survey))
    return result._replace(departures=np.array([np.median(logs[classes.survey == number]) for number in flown]))


def _robust_scatter(departures: np.ndarray) -> float:
    """Returns the standard deviation of departures (n,) from zero, from the median of their absolute values."""
    return float(_NORMAL_MAD * np.median(np.abs(departures)))


def _fit_texture_scatter(surveys: Sequence[SurveyStatistics], compared: ScatterLaw) -> ScatterLaw:
    """Fits the `ScatterLaw` of the reported standard deviation of depth over the cells of a map."""
    rows = [
        (np.median(s["bound_px"]), s["texture_scatter"][0], np.median([s[x][0] for x in s if x.startswith(_LEVEL)]))
        for s in surveys
        if any(name.startswith(_LEVEL) for name in s)
    ]
    if not rows:
        return compared
    bounds, textures, scatters = np.array(rows).T

    def residuals(x: np.ndarray) -> np.ndarray:
        return ScatterLaw(*x)(bounds, textures) - scatters

    return ScatterLaw(*_solve(residuals, [2.0, 0.02], ([0.0, 1e-3], [20.0, 1.0]), _OUTLIER))


def _fit_error_scatter(surveys: Sequence[SurveyStatistics], compared: float) -> float:
    """Fits `error_scatter_share` to the tails of the height errors of level cells.

    If the logarithm of the standard deviation of normal errors varies with the standard deviation s, the logarithm of
    the ratio of the 90th percentile of their absolute values to the median grows in proportion to s^2 for small s. The
    tail of a survey is the median of this logarithm over its classes, minus that of normal errors. Returns the compared
    value if no sampled map has heavier tails than normal errors.
    """
    tails = [
        np.median([np.log(np.divide(s[name], _NORMAL_TAIL)) for name in s if name.startswith(_LEVEL_TAILS)], axis=0)
        for s in surveys
        if any(name.startswith(_LEVEL_TAILS) for name in s)
    ]
    images, sampled = np.maximum(np.array(tails).reshape(-1, 2), 0.0).sum(axis=0)
    return float(compared * np.sqrt(images / sampled)) if sampled > 0 else compared
