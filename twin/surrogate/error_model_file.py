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
from twin.surrogate.error_model import ErrorModel

_KEY, _ALLOWED = "imaging.error_model", "a file written by `twin fit-surrogate`"
DEFAULT_FILE = Path(__file__).with_name("error_model.toml")


@dataclass(frozen=True)
class FittedErrorModel:
    """Error model with the record of its fit."""

    model: ErrorModel  #: fitted parameters
    n_surveys: int  #: number of rendered surveys to which the model was fitted
    #: root mean square over the surveys of ln(reported / fitted standard deviation), for each fitted parameter that is
    #: a reported standard deviation of a motion or match (see `surrogate_fit.fit.log_misfit`)
    misfit: Mapping[str, float]
    #: smallest and largest value of each of `coverage.QUANTITIES` in these surveys, by name. The upper end of the
    #: Cramér-Rao bound is infinite if a survey with a larger bound than all fitted ones lost too many frames or links
    #: to be fitted. Without an entry for the bound, its range is `ErrorModel.bound_range_px`.
    fitted_range: Mapping[str, Range] = field(default_factory=dict)

    def quantities_outside_fit(self, conditions: Mapping[str, Range]) -> list[QuantityOutsideFit]:
        """Returns the quantities of a survey (`coverage.survey_conditions`) in which the model may not be used."""
        return quantities_outside_fit(conditions, {"bound_px": self.model.bound_range_px, **self.fitted_range})


def load(path: str | Path | None = None) -> FittedErrorModel:
    """Reads an error model from a TOML file; None: the error model supplied with this package.

    Raises:
        TwinError: the file does not exist or is not an error model.
    """
    path = DEFAULT_FILE if path is None else Path(path)
    text = read_text(path, _KEY, _ALLOWED, 4 * MAX_CHARACTERS, "utf-8")
    with reading(path, _KEY, _ALLOWED):
        tree = parse_toml(text)
        for error in value_errors(tree):
            raise TwinError(_KEY, f"{path}: {error}", _ALLOWED)
        for name in tree.get("fitted_range", {}):
            if name not in QUANTITIES:
                raise TwinError(_KEY, f"{path}: fitted_range.{name}: unknown quantity", _ALLOWED)
        ranges = {name: (float(low), float(high)) for name, (low, high) in tree.get("fitted_range", {}).items()}
        model = ErrorModel(**{name: _value(name, tree["model"][name]) for name in ErrorModel._fields})
        return FittedErrorModel(model, int(tree["n_surveys"]), dict(tree["misfit"]), ranges)


def save(fitted: FittedErrorModel, path: Path) -> None:
    """Writes an error model to a file that `load` reads.

    Raises:
        OSError: the file cannot be written.
    """
    ranges = [f"{name} = {_text(limits)}" for name, limits in fitted.fitted_range.items()]
    lines = [
        "# Error model of the surrogate, fitted to rendered surveys by `twin fit-surrogate`; see error_model.py.",
        f"n_surveys = {fitted.n_surveys}",
        "",
        "[misfit]  # root mean square of ln(reported / fitted)",
        *(f"{name} = {value:.4g}" for name, value in fitted.misfit.items()),
        *(["", "[fitted_range]  # smallest and largest value in the surveys of the fit", *ranges] if ranges else []),
        "",
        "[model]",
        *(f"{name} = {_text(value)}" for name, value in fitted.model._asdict().items()),
    ]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _value(name: str, given: Any) -> Any:
    """Converts a TOML value to the type of the parameter `name`; keys of a law that have a default may be missing."""
    default = ErrorModel._field_defaults[name]
    if isinstance(default, float):
        return float(given)
    if not isinstance(given, dict):
        return tuple(map(float, given))
    return type(default)(**{key: float(given[key]) for key in given if key in default._fields})


def _text(value: Any) -> str:
    """Returns the value of a parameter in TOML syntax."""
    if isinstance(value, float):
        return f"{value:.4g}"
    if hasattr(value, "_asdict"):
        return "{ " + ", ".join(f"{key} = {number:.4g}" for key, number in value._asdict().items()) + " }"
    return str([float(f"{v:.4g}") for v in value])
