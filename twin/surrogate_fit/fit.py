"""Fit of the error model to the statistics of rendered surveys.

The functions that model reported standard deviations (`SigmaLaw`) are fitted to the ratios of the standard deviations
reported for image measurements and by the surrogate. The error ratios are fitted to squared errors normalised by the
reported covariance. Medians and trimmed means make the fit robust against a few failed measurements. Every survey has
the same weight.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from scipy.optimize import least_squares, nnls

from twin.surrogate.error_model import ErrorModel, FractionLaw, SigmaLaw, ViewsLaw
from twin.surrogate_fit.comparison import BIAS_FRACTION, RELIEF_GAIN

_CELL_CLASSES = ("few", "many", "steep", "edge")  # see `ComparisonVision`
_NOTICEABLE = 0.1  # smallest fraction of the variance of a class of cells that determines a factor
_SMOOTH_PX = 0.25  # roughness [px of disparity] that no class of cells of a smooth floor reaches
_SOURCES = ("images", "patches", "relief")
_RELATIVE_SIGMA = 0.1  # assumed relative standard error of the mean squared error over a third of a survey's links

#: Samples of each statistic of one survey, by name; see `ComparisonVision.statistics`.
SurveyStatistics = Mapping[str, Sequence[float]]


def fit_error_model(surveys: Sequence[SurveyStatistics], compared: ErrorModel) -> ErrorModel:
    """Returns the error model that reproduces the statistics of rendered surveys.

    Args:
        surveys: statistics of each survey.
        compared: error model of the surrogate with which the surveys were compared.
    """
    bounds = np.array([np.median(s["bound_px"]) for s in surveys])

    def median(name: str) -> np.ndarray:
        return np.array([np.median(s[name]) for s in surveys])

    f2f_ratios = np.sqrt(median("f2f_nees") / median("f2f_nees_surrogate"))
    match_sigmas_px = median("match_sigma_ratio") * [compared.match_sigma_px(b) for b in bounds]
    match_sigma_px = _fit_sigma_law(bounds, match_sigmas_px)
    f2f_sigma_px = _fit_sigma_law(bounds, median("f2f_sigma_ratio") * [compared.f2f_sigma_px(b) for b in bounds])
    mosaic_sigmas_px = median("mosaic_sigma_ratio") * [compared.mosaic_sigma_px(b) for b in bounds]
    mosaic_sigma_px = _fit_sigma_law(bounds, mosaic_sigmas_px)
    distance_growth, link_ratios = _fit_distance_growth(surveys, compared.distance_growth)
    inflation = float(np.median(link_ratios / median("match_sigma_ratio")))
    patch_ratios, relief_gain, bias_fraction = _fit_link_errors(surveys, compared.relief_gain)
    match_error_ratio, lamp_error_growth = _fit_lamp_growth(
        patch_ratios / median("match_sigma_ratio"), median("lamp_share")
    )
    error_views, errors = _fit_map_variances(surveys, "error", compared.depth_error_views)
    sigma_views, reported = _fit_map_variances(surveys, "sigma", compared.depth_sigma_views)
    smooth = _is_smooth(surveys)
    depth_sigmas_px = np.array([compared.depth_sigma_px(b) for b in bounds]) * np.sqrt(reported[:, 0])
    depth_sigmas_px = np.maximum(depth_sigmas_px, np.median(depth_sigmas_px[smooth]) / 10)
    depth_ratios = np.sqrt(errors[:, 0] / np.maximum(reported[:, 0], 1e-6))
    known_fractions = np.array([s["hole_known"][0] for s in surveys])
    match_fractions = [compared.match_fraction(b) for b in bounds]
    mosaic_chi2 = median("mosaic_difference_nees") - compared.mosaic_error_ratio**2
    return compared._replace(
        bound_range_px=(float(bounds.min()), float(bounds.max())),
        point_fraction=_fit_fraction_law(bounds, median("point_fraction")),
        match_sigma_px=match_sigma_px,
        match_error_ratio=match_error_ratio,
        lamp_error_growth=lamp_error_growth,
        match_fraction=_fit_fraction_law(bounds, np.minimum(_matched_without_relief(surveys) * match_fractions, 1.0)),
        match_parallax_px=compared.match_parallax_px,
        match_covariance_inflation=compared.match_covariance_inflation * inflation**2,
        match_bias_fraction=bias_fraction,
        distance_growth=distance_growth,
        relief_gain=relief_gain,
        f2f_sigma_px=f2f_sigma_px,
        f2f_error_ratio=compared.f2f_error_ratio * float(np.median(f2f_ratios)),
        f2f_anticorrelation=float(np.median([_fit_anticorrelation(s) for s in surveys])),
        mosaic_sigma_px=mosaic_sigma_px,
        depth_sigma_px=_fit_sigma_law(bounds[smooth], depth_sigmas_px[smooth]),
        depth_error_ratio=compared.depth_error_ratio * float(np.median(depth_ratios[smooth])),
        depth_error_views=error_views,
        depth_sigma_views=sigma_views,
        lateral_sigma_px=compared.lateral_sigma_px * _root_median(errors[:, 1], 1.0),
        map_completeness=_fit_fraction_law(bounds[smooth], known_fractions[smooth]),
        edge_error_gain=_root_median(errors[:, 2], compared.edge_error_gain),
        edge_sigma_gain=_root_median(reported[:, 2], compared.edge_sigma_gain),
        edge_half_px=_fit_edge_holes(surveys, compared.edge_half_px),
        mosaic_error_ratio=float(np.sqrt(np.median(np.maximum(mosaic_chi2, 0.01) / median("mosaic_sigma_ratio") ** 2))),
    )


def log_misfit(surveys: Sequence[SurveyStatistics], compared: ErrorModel, fitted: ErrorModel) -> dict[str, float]:
    """Returns the RMS over surveys of ln(reported / fitted standard deviation), by name of the error model's field.

    Args:
        surveys: statistics of each survey.
        compared: error model of the surrogate with which the surveys were compared.
        fitted: error model fitted to the surveys.
    """
    ratios = {
        "match_sigma_px": "match_sigma_ratio",
        "f2f_sigma_px": "f2f_sigma_ratio",
        "mosaic_sigma_px": "mosaic_sigma_ratio",
    }
    return {
        field: _rms_log_ratio(surveys, ratio, getattr(compared, field), getattr(fitted, field))
        for field, ratio in ratios.items()
    }


def _rms_log_ratio(surveys: Sequence[SurveyStatistics], ratio: str, compared: SigmaLaw, fitted: SigmaLaw) -> float:
    """Returns the RMS over surveys of ln(reported / fitted standard deviation) for the statistic named `ratio`."""
    bounds = [np.median(s["bound_px"]) for s in surveys]
    logs = [np.log(np.median(s[ratio]) * compared(b) / fitted(b)) for s, b in zip(surveys, bounds, strict=True)]
    return float(np.sqrt(np.mean(np.square(logs))))


def _fit_sigma_law(bounds: np.ndarray, sigmas: np.ndarray) -> SigmaLaw:
    """Fits a `SigmaLaw` to standard deviations (n,) [px] at Cramer-Rao bounds (n,) [px]; residuals are log ratios."""

    def residuals(x: np.ndarray) -> np.ndarray:
        return np.log(np.hypot(x[0], x[1] * bounds) / sigmas)

    solution = least_squares(residuals, [sigmas.min() / 2, 1.0], bounds=([1e-4, 0.0], [10.0, 100.0]))
    return SigmaLaw(float(solution.x[0]), float(solution.x[1]))


def _fit_fraction_law(bounds: np.ndarray, fractions: np.ndarray) -> FractionLaw:
    """Fits a `FractionLaw` with exponent 4 to fractions (n,) at Cramer-Rao bounds (n,) [px] by least squares."""

    def residuals(x: np.ndarray) -> np.ndarray:
        return np.array([FractionLaw(x[0], np.exp(x[1]), 4.0)(b) for b in bounds]) - fractions

    start = [min(float(fractions.max()), 0.999), np.log(4 * bounds.max())]
    limits = ([0.01, np.log(bounds.min())], [1.0, np.log(100 * bounds.max())])
    solution = least_squares(residuals, start, bounds=limits)
    return FractionLaw(float(solution.x[0]), float(np.exp(solution.x[1])), 4.0)


def _fit_anticorrelation(statistics: SurveyStatistics) -> float:
    """Fits the anticorrelation u of consecutive frame-to-frame motions to the error accumulated over n frames.

    If each motion cancels the fraction u of the independent error of the previous motion, the variance of the sum of n
    motions is (1 + (n - 1) (1 - u)^2) / (n (1 + u^2)) times that of n uncorrelated motions of equal variance.
    """
    n = float(np.median(statistics["f2f_interval_frames"]))
    ratio = np.median(statistics["f2f_interval_nees"]) / np.median(statistics["f2f_nees"])
    u = np.linspace(-1.0, 1.0, 2001)
    return float(u[np.argmin(np.abs((1 + (n - 1) * (1 - u) ** 2) / (n * (1 + u**2)) - ratio))])


def _fit_link_errors(surveys: Sequence[SurveyStatistics], compared_gain: float) -> tuple[np.ndarray, float, float]:
    """Separates link errors into contributions of patch matching, of relief and of a bias of each keyframe.

    Errors due to relief grow with the distance between the keyframes; errors of patch matching do not. The links of
    each survey are therefore sorted by distance and divided into thirds, and one relief gain is fitted to the mean
    squared errors of all thirds of all surveys. Over a smooth floor the errors do not determine the relief gain, so
    the gain of the compared model, or a larger minimum value, is added as an observation.

    A keyframe's bias makes the errors of two consecutive links cancel partly, because the keyframe ends the first link
    and starts the second. Relief makes the two errors equal. The bias fraction is fitted to the scalar products of the
    errors of consecutive links.
    (Loops of three keyframes do not determine the bias, because links from the same keyframe have correlated errors.)

    Args:
        surveys: statistics of n surveys.
        compared_gain: relief gain of the compared model.

    Returns:
        Ratio (n,) of each survey's patch-matching errors to those of the "patches" model of `single_error_models`;
        relief gain; bias fraction.
    """
    thirds = np.array([_squared_errors_by_distance(s) for s in surveys])
    images, by_patches, by_relief = thirds.transpose(2, 0, 1)
    prior = max(compared_gain / RELIEF_GAIN, 0.5) ** 2
    effects, observed = [np.array([_RELATIVE_SIGMA / prior])], [np.array([_RELATIVE_SIGMA])]
    for patch, relief_effect in zip(by_patches / images, by_relief / images, strict=True):
        projection = np.eye(3) - np.outer(patch, patch) / (patch @ patch)  # eliminates the patch errors
        effects.append(projection @ relief_effect)
        observed.append(projection.sum(axis=1))
    effect = np.concatenate(effects)
    relief = max(float(effect @ np.concatenate(observed) / (effect @ effect)), 0.0)
    patches = np.median(np.maximum(images - relief * by_relief, images / 10) / by_patches, axis=1)
    products = np.array([[np.mean(s[f"consecutive_product_{name}"]) for name in _SOURCES] for s in surveys])
    bias = BIAS_FRACTION * np.sum((products[:, 0] - relief * products[:, 2]) / patches) / np.sum(products[:, 1])
    return np.sqrt(patches), RELIEF_GAIN * float(np.sqrt(relief)), float(np.clip(bias, 0.0, 0.98))


def _fit_lamp_growth(error_ratios: np.ndarray, lamp_share: np.ndarray) -> tuple[float, float]:
    """Fits `match_error_ratio` (without lamps) and `lamp_error_growth` of the error model.

    Both are fitted to the squared error ratios by least squares of relative residuals.

    Args:
        error_ratios: (n,) ratio of the true to the reported standard deviation of a match, one per survey.
        lamp_share: (n,) fraction of the reflected light that comes from the lamps, one per survey.
    """
    effects = np.column_stack([np.ones_like(error_ratios), lamp_share**2]) / error_ratios[:, None] ** 2
    constant, growth = nnls(effects, np.ones(len(error_ratios)))[0]
    return float(np.sqrt(constant)), float(np.sqrt(growth / max(constant, 1e-6)))


def _squared_errors_by_distance(statistics: SurveyStatistics) -> np.ndarray:
    """Returns mean normalised squared link errors (3, 3), with a row per third of the links and a column per source.

    The links are divided into thirds by distance. The sources are those of `_SOURCES`. The largest 5 % of the squared
    errors in each third are excluded.
    """
    errors = np.column_stack([statistics[f"link_nees_{name}"] for name in _SOURCES])
    order = np.argsort(statistics["link_distance"])
    thirds = (np.sort(errors[third], axis=0) for third in np.array_split(order, 3))
    return np.array([third[: len(third) - len(third) // 20].mean(axis=0) for third in thirds])


def _fit_distance_growth(surveys: Sequence[SurveyStatistics], compared_growth: float) -> tuple[float, np.ndarray]:
    """Fits the growth of the reported link covariance with the distance between the keyframes.

    At distance zero, both stereo pairs of a link contribute the same variance. The contribution of the earlier pair is
    multiplied by 1 + (growth * distance)^2, so the variance of the link is multiplied by
    1 + (growth * distance)^2 / 2. The distance is in units of the mean depth.

    Returns:
        Growth; and the ratio (n,) of the standard deviation reported for a survey's links from images to the one that
        the surrogate reports, extrapolated to distance zero.
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

    start = [max(compared_growth, 1.0)]
    solution = least_squares(residuals, start, bounds=([0.0], [30.0]), loss="soft_l1", f_scale=0.02).x
    return float(solution[0]), np.exp([np.median(ratios) / 2 for ratios in log_ratios(solution)])


def _matched_without_relief(surveys: Sequence[SurveyStatistics]) -> np.ndarray:
    """Returns the median ratio (n,) of matched points, images / surrogate, of the links with the least parallax.

    These are the links up to the median parallax of the survey.
    """
    ratios = []
    for s in surveys:
        parallax, matched = np.array(s["link_parallax_px"]), np.array(s["link_matched"])
        ratios.append(np.median(matched[parallax <= np.median(parallax)]))
    return np.array(ratios)


def _fit_edge_holes(surveys: Sequence[SurveyStatistics], compared_px: float) -> float:
    """Fits `edge_half_px` to the fractions of cells with a height, relative to the smooth cells of the same survey.

    Returns the value of the compared model if no survey has rough cells.
    """
    roughness, fractions, weights = [], [], []
    for s in surveys:
        known = np.array(s["hole_known"]) / max(s["hole_known"][0], 1e-6)
        roughness.append(np.array(s["hole_roughness_px"])[1:])
        fractions.append(np.minimum(known[1:], 1.0))
        weights.append(np.sqrt(np.array(s["hole_cells"])[1:] / np.sum(s["hole_cells"])))
    r, known, weight = (np.concatenate(part) for part in (roughness, fractions, weights))
    if len(r) == 0:
        return compared_px
    half = np.geomspace(0.3, 100.0, 400)
    misfit = [np.sum((weight * (1 / (1 + (r / h) ** 2) - known)) ** 2) for h in half]
    return float(half[np.argmin(misfit)])


def _fit_map_variances(
    surveys: Sequence[SurveyStatistics], quantity: str, compared: ViewsLaw
) -> tuple[ViewsLaw, np.ndarray]:
    """Fits the variances of the maps from images, in all classes of cells, by those of the sampled maps.

    The decrease of the variance due to depth with the number of keyframes is common to all surveys and found by a grid
    search; for each `ViewsLaw`, the other variances of each survey follow by non-negative least squares of relative
    residuals.

    Args:
        surveys: statistics of n surveys.
        quantity: "error" for the variances of the height errors, "sigma" for the reported variances.
        compared: the law of the error model with which the surveys were compared.

    Returns:
        The law; and factors (n, 3) on the variances of one keyframe's depth, of the lateral shift and, for a gain of 1,
        of roughness. A factor on the lateral shift or on roughness that a survey does not determine, because its cells
        have no such error, is NaN.
    """
    laws = [ViewsLaw(float(r), float(g)) for r in np.linspace(0.0, 0.9, 19) for g in np.geomspace(0.1, 20.0, 24)]
    smooth = [s for s, is_smooth in zip(surveys, _is_smooth(surveys), strict=True) if is_smooth]
    misfits = [sum(_fit_survey(s, quantity, compared, law)[1] for s in smooth) for law in laws]
    best = laws[int(np.argmin(misfits))]
    return best, np.array([_fit_survey(s, quantity, compared, best)[0] for s in surveys])


def _is_smooth(surveys: Sequence[SurveyStatistics]) -> np.ndarray:
    """Returns the mask (n,) of the surveys without edges, to which the depth of smooth cells is fitted.

    Next to walls, the cells with few views are those that a wall hid from the other keyframes: their errors are not
    those of cells with few views elsewhere. If all surveys have edges, the mask is True for all.
    """
    rough_px = [max(s.get("hole_roughness_px", (0.0,))) for s in surveys]
    smooth = np.array(rough_px) < _SMOOTH_PX
    return smooth if smooth.any() else ~smooth


def _fit_survey(
    statistics: SurveyStatistics, quantity: str, compared: ViewsLaw, law: ViewsLaw
) -> tuple[np.ndarray, float]:
    """Returns the factors (3,) of `_fit_map_variances` for one survey and a law, and the norm of the residuals."""
    names = [name for name in _CELL_CLASSES if f"map_{quantity}_{name}_images" in statistics]
    images, pose, depth, lateral, edge = (
        np.array([statistics[f"map_{quantity}_{name}_{source}"][0] for name in names])
        for source in ("images", "pose", "depth", "lateral", "edge")
    )
    views = [np.array(statistics[f"map_views_{name}_images"]) for name in names]
    factor = np.array([np.mean(law(n)) / np.mean(compared(n)) for n in views])
    effects = np.stack([(depth - pose) * factor, lateral - pose, edge - pose], axis=1) / images[:, None]
    effects = np.maximum(effects, 0)
    factors, misfit = nnls(effects, np.maximum(1 - pose / images, 0))
    determined = effects.max(axis=0) > _NOTICEABLE
    determined[0] = True
    return np.where(determined, factors, np.nan), float(misfit)


def _root_median(factors: np.ndarray, default: float) -> float:
    """Returns the root of the median of the factors (n,) on a variance, without NaN; `default` if all are NaN."""
    known = factors[np.isfinite(factors)]
    return float(np.sqrt(np.median(known))) if len(known) else default
