"""Fit of the error model to the statistics of rendered surveys: one robust least-squares problem for all parameters.

Each survey gives measured values, and the error model predicts each of them in closed form from the conditions of the
survey. Standard deviations are compared by their logarithms, fractions by their differences. Medians and trimmed means
make the values robust against a few failed measurements. Each kind of value has the same weight in every survey. What
the surveys do not determine keeps its value in the compared model.
"""

from collections.abc import Iterator, Mapping, Sequence
from itertools import chain
from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares

from twin.core.geometry import Array
from twin.surrogate.error_model import ErrorModel
from twin.surrogate.height_errors import CellConditions, height_sigmas
from twin.surrogate_fit.comparison_vision import BIAS_FRACTION, RELIEF_GAIN

_NORMAL_MAD = 1.4826  # standard deviation of a normal distribution, divided by its median absolute value
_PRIOR = 0.01  # weight of the logarithm of a parameter relative to its value in the compared model
_OUTLIER = 0.3  # residual beyond which it has less weight
_FRACTION_UNIT = 0.1  # difference of fractions that counts as much as a factor e
_TRIMMED = 20  # one in so many squared errors of links, the largest, is left out
_LARGEST = {"match_bias_fraction": 0.98, "f2f_anticorrelation": 0.95, "matched_share": 1.0}
_REACH = 100.0  # largest factor between a parameter and its value in the compared model
_START_HALF_PX = 0.2  # start of `match_half_px`, which the compared model does not know


class SurveyStatistics(NamedTuple):
    """Statistics of one survey; see `ComparisonVision`."""

    samples: Mapping[str, Sequence[float]]
    classes: Mapping[str, Sequence[Sequence[float]]]

    def median(self, name: str) -> float:
        return float(np.median(self.samples[name]))


class Comparison(NamedTuple):
    """Measured values of one kind in one survey, and those that an error model predicts."""

    kind: str
    measured: Array  #: (n,) values, or their logarithms if they are standard deviations
    predicted: Array  #: (n,) likewise

    @property
    def residuals(self) -> Array:
        """Returns the residuals (n,), whose total weight does not depend on their number."""
        return (self.predicted - self.measured) / np.sqrt(len(self.measured))


def fit_error_model(surveys: Sequence[SurveyStatistics], compared: ErrorModel) -> ErrorModel:
    """Returns the error model that reproduces the statistics of rendered surveys, sampled with the `compared` model."""
    start = np.log(np.maximum(compared._replace(match_half_px=_START_HALF_PX), 1e-6))
    highest = np.minimum(start + np.log(_REACH), [np.log(_LARGEST.get(name, np.inf)) for name in ErrorModel._fields])
    start = np.minimum(start, highest - 1e-3)

    def residuals(logs: Array) -> Array:
        model = ErrorModel(*np.exp(logs).tolist())
        rows = [row.residuals for s in surveys for row in comparisons(s, model, compared)]
        return np.concatenate([*rows, _PRIOR * (logs - start)])

    limits = start - np.log(_REACH), highest
    logs = least_squares(residuals, start, bounds=limits, loss="soft_l1", f_scale=_OUTLIER, max_nfev=100).x
    fitted = ErrorModel(*np.exp(logs).tolist())
    return fitted._replace(survey_scatter=_survey_scatter(surveys, fitted, compared))


def misfit(surveys: Sequence[SurveyStatistics], model: ErrorModel, compared: ErrorModel) -> dict[str, float]:
    """Returns the RMS over surveys of predicted - measured, of logarithms or of fractions, by kind of value."""
    found: dict[str, list[float]] = {}
    for s in surveys:
        for row in comparisons(s, model, compared):
            found.setdefault(row.kind, []).append(float(np.mean(row.residuals**2)) * len(row.measured))
    return {kind: float(np.sqrt(np.mean(squares))) for kind, squares in found.items()}


def comparisons(s: SurveyStatistics, model: ErrorModel, compared: ErrorModel) -> Iterator[Comparison]:
    """Yields the measured values of a survey with those that an error model predicts."""
    return chain(_of_frames(s, model), _of_links(s, model, compared), _of_map(s, model))


def _logs(kind: str, measured: Array | float, predicted: Array | float) -> Comparison:
    logs = (np.log(np.maximum(np.atleast_1d(values), 1e-9)) for values in (measured, predicted))
    return Comparison(kind, *logs)


def _fractions(kind: str, measured: Array | float, predicted: Array | float) -> Comparison:
    return Comparison(kind, np.atleast_1d(measured) / _FRACTION_UNIT, np.atleast_1d(predicted) / _FRACTION_UNIT)


def _of_frames(s: SurveyStatistics, model: ErrorModel) -> Iterator[Comparison]:
    bound_px, flow_px = s.median("bound_px"), float(model.difference_sigma_px(s.median("bound_px")))
    match_px = model.match_sigma_px(bound_px, s.median("stereo_parallax_px"))
    yield _logs("match_reported_px", s.median("match_reported_px"), match_px)
    yield _fractions("point_fraction", s.median("point_fraction"), model.point_fraction(bound_px))
    yield _logs("f2f_reported_px", s.median("f2f_reported_px"), flow_px)
    yield _logs("f2f_error_px", s.median("f2f_error_px"), flow_px)
    n, u = s.median("f2f_interval_frames"), model.f2f_anticorrelation
    summed = np.sqrt((1 + (n - 1) * (1 - u) ** 2) / (n * (1 + u**2)))
    yield _logs("f2f_interval_px", s.median("f2f_interval_px"), flow_px * summed)
    yield _logs("mosaic_reported_px", s.median("mosaic_reported_px"), model.mosaic_sigma_px)
    yield _logs("mosaic_error_px", s.median("mosaic_error_px"), model.mosaic_sigma_px * model.mosaic_error_ratio)


def _of_links(s: SurveyStatistics, model: ErrorModel, compared: ErrorModel) -> Iterator[Comparison]:
    """Yields the comparisons of links, in thirds sorted by the distance between their keyframes."""
    # errors of patches scale with the deviation of a match, those of relief grow with the distance; the bias of a
    # keyframe makes errors of consecutive links cancel partly, relief makes them equal: their scalar products separate
    # them
    bound_px, conditions = s.median("bound_px"), (s.median("bound_px"), s.median("stereo_parallax_px"))
    match = model.match_sigma_px(*conditions) / compared.match_sigma_px(*conditions)
    lamps = float(model.lamp_factor(s.median("lamp_share")))
    relief = (model.relief_gain / RELIEF_GAIN * lamps) ** 2
    thirds = np.array_split(np.argsort(s.samples["link_distance"]), 3)
    images, patches, by_relief = (
        np.array([_trimmed_mean(np.array(s.samples[f"link_nees_{name}"])[third]) for third in thirds])
        for name in ("images", "patches", "relief")
    )
    predicted = (match * lamps) ** 2 * patches + relief * by_relief
    yield _logs("link_error", np.sqrt(images), np.sqrt(predicted))
    reported, distance = (
        np.array([np.median(np.array(s.samples[name])[third]) for third in thirds])
        for name in ("link_reported_ratio", "link_distance")
    )
    growth, before = (1 + (one.distance_growth * distance) ** 2 / 2 for one in (model, compared))
    yield _logs("link_reported", reported, match * np.sqrt(growth / before))
    matched = model.point_fraction(bound_px) * model.rematched(bound_px) / compared.matched_share
    yield _fractions("link_matched", s.median("link_matched"), matched)
    products = [np.mean(s.samples[f"consecutive_product_{name}"]) for name in ("images", "patches", "relief")]
    of_bias = (match * lamps) ** 2 * model.match_bias_fraction / BIAS_FRACTION
    yield Comparison(
        "link_bias", np.array([products[0]]) / images[0],
        np.array([of_bias * products[1] + relief * products[2]]) / images[0],
    )  # fmt: skip


def _trimmed_mean(squares: Array) -> float:
    return float(np.mean(np.sort(squares)[: len(squares) - len(squares) // _TRIMMED]))


def _of_map(s: SurveyStatistics, model: ErrorModel) -> Iterator[Comparison]:
    for kind, n_values in (("level", 3), ("edge", 1), ("known", 1)):
        if not s.classes.get(kind):
            continue
        rows = np.array(s.classes[kind]).T
        values, sigmas = rows[:n_values], height_sigmas(model, CellConditions(*rows[n_values:]))
        if kind == "known":
            yield _fractions("map_known", values[0], sigmas.known)
            continue
        yield _logs(f"{kind}_error_m", values[0], sigmas.total_m())
        if kind == "level":
            yield _logs("level_reported_m", values[1], sigmas.noise_m)
            yield Comparison("level_scatter", values[2], sigmas.scatter)


def _survey_scatter(surveys: Sequence[SurveyStatistics], model: ErrorModel, compared: ErrorModel) -> float:
    """Returns `ErrorModel.survey_scatter`, of error / reported noise of level cells."""
    ratios = []
    for s in surveys:
        found = {row.kind: np.median(row.measured - row.predicted) for row in comparisons(s, model, compared)}
        if "level_error_m" in found:
            ratios.append(found["level_error_m"] - found["level_reported_m"])
    return float(_NORMAL_MAD * np.median(np.abs(ratios))) if ratios else model.survey_scatter
