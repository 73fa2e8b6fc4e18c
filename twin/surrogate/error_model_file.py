"""TOML file of an error model: fitted parameters, number of surveys of the fit, its misfit, and the fitted range."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from twin.core.user_files import read_text, reading
from twin.errors import TwinError
from twin.scenario.toml_text import MAX_CHARACTERS, parse_toml, value_errors
from twin.surrogate.coverage import QUANTITIES, Range, quantities_outside_fit
from twin.surrogate.error_model import ErrorModel

_KEY, _ALLOWED = "imaging.error_model", "a file written by `twin fit-surrogate`"
DEFAULT_FILE = Path(__file__).with_name("error_model.toml")


@dataclass(frozen=True)
class FittedErrorModel:
    """Error model with the record of its fit."""

    model: ErrorModel
    n_surveys: int  #: number of rendered surveys of the fit
    largest_bound_px: float  #: largest Cramér-Rao bound of these surveys; that of a survey is its median over keyframes
    #: root mean square of ln(measured / fitted) over the surveys, for each kind of measurement; of fractions, that of
    #: measured - fitted in tenths
    misfit: Mapping[str, float]
    #: smallest and largest value of each of `coverage.QUANTITIES` in these surveys, by name. The upper end of the
    #: Cramér-Rao bound is infinite if a survey with a larger bound than all fitted ones lost too many frames or links
    #: to be fitted.
    fitted_range: Mapping[str, Range] = field(default_factory=dict)

    def quantities_outside_fit(self, conditions: Mapping[str, Range]) -> list[tuple[str, str]]:
        """Returns what `coverage.quantities_outside_fit` finds in the conditions of a survey."""
        return quantities_outside_fit(conditions, {"bound_px": (0.0, self.largest_bound_px), **self.fitted_range})


def load(path: str | Path | None = None) -> FittedErrorModel:
    """Reads an error model from a TOML file, by default `DEFAULT_FILE`; raises TwinError if the file is none."""
    path = DEFAULT_FILE if path is None else Path(path)
    text = read_text(path, _KEY, _ALLOWED, 4 * MAX_CHARACTERS, "utf-8")
    with reading(path, _KEY, _ALLOWED):
        tree = parse_toml(text)
        for error in value_errors(tree):
            raise TwinError(_KEY, f"{path}: {error}", _ALLOWED)
        ranges = {name: (float(low), float(high)) for name, (low, high) in tree.get("fitted_range", {}).items()}
        for name in ranges.keys() - QUANTITIES:
            raise TwinError(_KEY, f"{path}: fitted_range.{name}: unknown quantity", _ALLOWED)
        model = ErrorModel(**{name: float(tree["model"][name]) for name in ErrorModel._fields})
        n_surveys, largest_px = int(tree["n_surveys"]), float(tree["largest_bound_px"])
        return FittedErrorModel(model, n_surveys, largest_px, dict(tree["misfit"]), ranges)


def save(fitted: FittedErrorModel, path: Path) -> None:
    lines = [
        "# Error model of the surrogate, fitted to rendered surveys by `twin fit-surrogate`; see error_model.py.",
        f"n_surveys = {fitted.n_surveys}",
        f"largest_bound_px = {fitted.largest_bound_px:.4g}",
        "",
        "[misfit]  # root mean square of ln(measured / fitted), of fractions in tenths",
        *(f"{name} = {value:.4g}" for name, value in fitted.misfit.items()),
        "",
        "[fitted_range]  # smallest and largest value in the surveys of the fit",
        *(f"{name} = [{low:.4g}, {high:.4g}]" for name, (low, high) in fitted.fitted_range.items()),
        "",
        "[model]",
        *(f"{name} = {value:.4g}" for name, value in fitted.model._asdict().items()),
    ]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
