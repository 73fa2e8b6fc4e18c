"""TOML file of an error model: fitted parameters, number of surveys of the fit, its misfit, and the fitted range."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from twin.core.user_files import read_text, reading
from twin.errors import TwinError
from twin.scenario.toml_text import MAX_CHARACTERS, parse_toml, value_errors
from twin.surrogate.coverage import QUANTITIES, QuantityOutsideFit, Range, quantities_outside_fit
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

_KEY, _ALLOWED = "imaging.error_model", "a file written by `twin fit-surrogate`"
DEFAULT_FILE = Path(__file__).with_name("error_model.toml")
_LAWS = (SigmaLaw, FractionLaw, DepthLaw, ScatterLaw, BinnedDepthLaw, BorderLaw, BorderErrorLaw)
#: Current name of each renamed key, by its former name.
_RENAMED = {
    "surveys": "n_surveys",
    "bound_px": "bound_range_px",
    "points": "point_fraction",
    "place_px": "match_sigma_px",
    "place_excess": "match_error_ratio",
    "lamps": "lamp_error_growth",
    "matched": "match_fraction",
    "correlation": "match_covariance_inflation",
    "steady": "match_bias_fraction",
    "apart": "distance_growth",
    "relief": "relief_gain",
    "common_px": "common_bias_px",
    "f2f_px": "f2f_sigma_px",
    "f2f_excess": "f2f_error_ratio",
    "f2f_undone": "f2f_anticorrelation",
    "mosaic_px": "mosaic_sigma_px",
    "mosaic_excess": "mosaic_error_ratio",
    "depth_px": "depth_sigma",
    "depth_sigma_px": "depth_sigma",
    "depth_excess": "depth_error",
    "depth_error_ratio": "depth_error",
    "depth_error_scatter": "depth_ratio_scatter",
    "depth_cell_scatter": "depth_texture_scatter",
    "depth_binned_scatter": "depth_texture_scatter",
    "lateral_px": "lateral_sigma_px",
    "complete": "map_completeness",
    "floor": "floor_px",
    "rise": "slope",
    "most": "maximum",
    "power": "exponent",
}


@dataclass(frozen=True)
class FittedErrorModel:
    """Error model with the record of its fit.

    Args:
        model: fitted parameters.
        n_surveys: number of rendered surveys to which the model was fitted.
        misfit: root mean square over the surveys of ln(reported / fitted standard deviation), for each fitted
            parameter that is a reported standard deviation of a motion or match (see `surrogate_fit.fit.log_misfit`).
        fitted_range: smallest and largest value of each quantity in these surveys, by name (names of
            `coverage.QUANTITIES`). The upper end of the Cramér-Rao bound is infinite if a survey with a larger
            bound than all fitted ones lost too many frames or links to be fitted: surveys with still larger bounds are
            expected to fail as well. Without an entry for the bound, its range is `ErrorModel.bound_range_px`.
    """

    model: ErrorModel
    n_surveys: int
    misfit: Mapping[str, float]
    fitted_range: Mapping[str, Range] = field(default_factory=dict)

    def quantities_outside_fit(self, conditions: Mapping[str, Range]) -> list[QuantityOutsideFit]:
        """Returns the quantities of a survey that lie outside the range in which the model may be used.

        Args:
            conditions: smallest and largest value of each quantity in the survey (`coverage.survey_conditions`).
        """
        return quantities_outside_fit(conditions, {"bound_px": self.model.bound_range_px, **self.fitted_range})


def load(path: str | Path | None = None) -> FittedErrorModel:
    """Reads an error model from a file.

    Args:
        path: TOML file; None for the error model supplied with this package.

    Raises:
        TwinError: the file does not exist, is not an error model, or contains the former name of a renamed key.
    """
    path = DEFAULT_FILE if path is None else Path(path)
    text = read_text(path, _KEY, _ALLOWED, 4 * MAX_CHARACTERS, "utf-8")
    with reading(path, _KEY, _ALLOWED):
        tree = parse_toml(text)
        for error in value_errors(tree):
            raise _invalid(path, str(error))
        _check_names(path, tree)
        model = ErrorModel(**{name: _value(name, tree["model"][name]) for name in ErrorModel._fields})
        return FittedErrorModel(model, int(tree["n_surveys"]), dict(tree["misfit"]), _ranges(path, tree))


def save(fitted: FittedErrorModel, path: Path) -> None:
    """Writes an error model to a file that `load` reads.

    Raises:
        OSError: the file cannot be written.
    """
    lines = [
        "# Error model of the surrogate, fitted to rendered surveys by `twin fit-surrogate`; see error_model.py.",
        f"n_surveys = {fitted.n_surveys}",
        "",
        "[misfit]  # root mean square of ln(reported / fitted)",
        *(f"{name} = {value:.4g}" for name, value in fitted.misfit.items()),
        *_range_lines(fitted.fitted_range),
        "",
        "[model]",
        *(f"{name} = {_text(value)}" for name, value in fitted.model._asdict().items()),
    ]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _ranges(path: Path, tree: Mapping[str, Any]) -> dict[str, Range]:
    """Returns the table [fitted_range] of a file; empty if there is none.

    Raises:
        TwinError: the table has a name that is not in `coverage.QUANTITIES`.
    """
    ranges: dict[str, Range] = {}
    for name, (low, high) in tree.get("fitted_range", {}).items():
        if name not in QUANTITIES:
            raise _invalid(path, f"fitted_range.{name}: unknown quantity")
        ranges[name] = float(low), float(high)
    return ranges


def _range_lines(ranges: Mapping[str, Range]) -> list[str]:
    """Returns the lines of the table [fitted_range]; none if it is empty."""
    lines = [f"{name} = {_text(limits)}" for name, limits in ranges.items()]
    return ["", "[fitted_range]  # smallest and largest value in the surveys of the fit", *lines] if lines else []


def _check_names(path: Path, tree: Mapping[str, Any]) -> None:
    """Raises a TwinError that lists the former names of renamed keys in a file, if there are any."""
    former = {name: value for name, value in tree.items() if name != "fitted_range"}
    renamed = [f"{name} was renamed to {_RENAMED[name]}" for name in dict.fromkeys(_keys(former)) if name in _RENAMED]
    if renamed:
        raise _invalid(path, ", ".join(renamed))


def _keys(tree: Mapping[str, Any]) -> list[str]:
    """Returns the keys of a table and of all tables within it."""
    return [key for name, value in tree.items() for key in (name, *(_keys(value) if isinstance(value, dict) else ()))]


def _invalid(path: Path, problem: str) -> TwinError:
    """Returns the error for a file that is not an error model."""
    return TwinError(_KEY, f"{path}: {problem}", _ALLOWED)


def _value(name: str, given: Any) -> Any:
    """Converts a TOML value to the type of the parameter `name`; keys of a law that have a default may be missing."""
    kind = type(ErrorModel._field_defaults[name])
    if kind in _LAWS:
        keys = [key for key in kind._fields if key in given or key not in kind._field_defaults]
        return kind(**{key: float(given[key]) for key in keys})
    return tuple(map(float, given)) if kind is tuple else float(given)


def _text(value: Any) -> str:
    """Returns the value of a parameter in TOML syntax."""
    if isinstance(value, _LAWS):
        return "{ " + ", ".join(f"{key} = {number:.4g}" for key, number in value._asdict().items()) + " }"
    return str([float(f"{v:.4g}") for v in value]) if isinstance(value, tuple) else f"{value:.4g}"
