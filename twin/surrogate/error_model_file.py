"""The error model on disk: a TOML file with the fit, how well it fits, and the range in which it holds."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from twin.errors import TwinError
from twin.surrogate.error_model import ErrorModel, Law, Share

SHIPPED = Path(__file__).with_name("error_model.toml")
_SLACK = 1.5  # the bound may be so many times outside before the surrogate warns


@dataclass(frozen=True)
class FittedErrorModel:
    """An error model and where it comes from.

    Args:
        model: of the errors.
        surveys: rendered surveys that it was fitted to.
        misfit: by name, the root mean square of the logarithm of what was measured over what the model says.
    """

    model: ErrorModel
    surveys: int
    misfit: Mapping[str, float]

    def outside(self, nearest_px: float, farthest_px: float) -> str:
        """Why a survey whose Cramer-Rao bounds lie in this range is not covered; "" if it is."""
        least, most = self.model.bound_px
        if least / _SLACK <= nearest_px and farthest_px <= most * _SLACK:
            return ""
        return (
            f"images whose patches can be placed to {nearest_px:.3g} to {farthest_px:.3g} px: the surrogate was "
            f"calibrated from {least:.3g} to {most:.3g} px"
        )


def load(path: str | Path | None = None) -> FittedErrorModel:
    """Reads a calibration; the shipped one if None.

    Raises:
        TwinError: no such file, or it is not a calibration.
    """
    path = SHIPPED if path is None else Path(path)
    try:
        tree = tomllib.loads(path.read_text(encoding="utf-8"))
        model = ErrorModel(**{name: _value(name, tree["model"][name]) for name in ErrorModel._fields})
        return FittedErrorModel(model, int(tree["surveys"]), dict(tree["misfit"]))
    except (OSError, tomllib.TOMLDecodeError, KeyError, TypeError, ValueError) as error:
        raise TwinError("imaging.error_model", f"{path}: {error!r}", "a file that `twin fit-surrogate` wrote") from None


def save(calibration: FittedErrorModel, path: Path) -> None:
    """Writes what `load` reads."""
    lines = [
        "# Errors of what images tell, fitted to rendered surveys by `twin fit-surrogate`; see error_model.py.",
        f"surveys = {calibration.surveys}",
        "",
        "[misfit]  # root mean square of ln(measured / model)",
        *(f"{name} = {value:.4g}" for name, value in calibration.misfit.items()),
        "",
        "[model]",
        *(f"{name} = {_text(value)}" for name, value in calibration.model._asdict().items()),
    ]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _value(name: str, given: Any) -> Any:
    kind = type(ErrorModel._field_defaults[name])
    if kind in (Law, Share):
        return kind(**{key: float(given[key]) for key in kind._fields})
    return tuple(map(float, given)) if kind is tuple else float(given)


def _text(value: Any) -> str:
    if isinstance(value, Law | Share):
        return "{ " + ", ".join(f"{key} = {number:.4g}" for key, number in value._asdict().items()) + " }"
    return str([float(f"{v:.4g}") for v in value]) if isinstance(value, tuple) else f"{value:.4g}"
