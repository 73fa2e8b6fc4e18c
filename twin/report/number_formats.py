"""Numbers with units as texts in reports."""

import math
from collections.abc import Mapping
from typing import Any

DASH = "–"  # noqa: RUF001
#: Units by the suffix of the name of a metric or key.
UNITS = {
    "_per_m": "per m", "_per_m3": "per m3", "_m": "m", "_mm": "mm", "_s": "s", "_ms": "ms", "_mps": "m/s",
    "_deg": "deg", "_px": "px", "_percent": "%", "_mb": "MiB", "_cd": "cd", "_lx": "lx",
}  # fmt: skip
#: Beginnings of the names of metrics and keys that are fractions.
_FRACTIONS = (
    "risk", "map.completeness", "overlap.", "plan.overlap_along", "plan.overlap_across",
    "consistency.within_", "orthomosaic.matched", "orthomosaic.coverage_", "self_check.frames_lost",
    "self_check.links_failed", "vision.saturated", "map.gross", "map.floor_gross", "map.objects_gross",
)  # fmt: skip


def length(value_m: float | None) -> str:
    """Returns a length as text in mm, cm or m; a dash for None."""
    if value_m is None:
        return DASH
    size = abs(value_m)
    if size < 0.01:
        return f"{1e3 * value_m:.2g} mm" if size < 1e-3 else f"{1e3 * value_m:.1f} mm"
    return f"{100 * value_m:.1f} cm" if size < 1 else f"{value_m:.2f} m"


def percent(fraction: float | None) -> str:
    """Returns a fraction in percent, with "< 0.1 %" and "> 99.9 %" near 0 and 1; a dash for None, NaN and infinity."""
    if fraction is None or not math.isfinite(fraction):
        return DASH
    value = 100 * fraction
    if 1e-9 < value < 0.05:
        return "< 0.1 %"
    if 1e-9 < 100 - value < 0.05:
        return "> 99.9 %"
    return f"{value:.1f}".removesuffix(".0") + " %"


def angle(value_deg: float | None) -> str:
    return DASH if value_deg is None else f"{value_deg:.2f}°"


def milliradians(value_deg: float | None) -> str:
    """Returns an angle [deg] as text in milliradians; a dash for None. 1 mm at a distance of 1 m subtends 1 mrad."""
    return DASH if value_deg is None else f"{1e3 * math.radians(value_deg):.2g} mrad"


def ratio(value: float | None) -> str:
    """Returns a ratio as text, with one decimal below ten and as an integer from ten; a dash for None."""
    return DASH if value is None else f"{value:.1f} ×" if value < 9.95 else f"{value:.0f} ×"  # noqa: RUF001


def milliseconds(value_ms: float | None) -> str:
    """Returns a duration as text, in ms if shorter than one second, otherwise in s; a dash for None."""
    return DASH if value_ms is None else f"{value_ms:.3g} ms" if value_ms < 999.5 else f"{value_ms / 1e3:.2f} s"


def duration(time_s: float) -> str:
    """Returns a duration as text, in s below 90 s, else in min or, from 90 min, in h."""
    if time_s < 90:
        return f"{time_s:.0f} s"
    return f"{time_s / 60:.0f} min" if time_s < 5400 else f"{time_s / 3600:.1f} h"


def plain(value: Any) -> str:
    """Returns a value as text, a float with at most four significant digits; a dash for None."""
    return DASH if value is None else f"{value:.4g}" if isinstance(value, float) else str(value)


def with_unit(name: str, value: float | None) -> str:
    """Returns a number as `plain` with the unit of its name, "0.02 m", a fraction in percent; a dash for None."""
    if is_fraction(name):
        return percent(value)
    return DASH if value is None else f"{plain(value)} {unit_of(name)}".rstrip()


def metric_value(metric: str, value: float | None) -> str:
    """Returns a metric, a length in mm, cm or m, an RMS angle in mrad; a dash for None, NaN and infinity."""
    if value is None or not math.isfinite(value):
        return DASH
    if metric.endswith("_rmse_deg"):
        return milliradians(value)
    return length(value) if metric.endswith("_m") else with_unit(metric, value)


def is_fraction(name: str) -> bool:
    return name.startswith(_FRACTIONS)


def unit_of(name: str) -> str:
    """Returns the unit of a metric or key, which its dotted name ends with; "" if it has none."""
    return next((unit for suffix, unit in UNITS.items() if name.endswith(suffix)), "")


def area_le90(elevation: Mapping[str, Any]) -> str:
    """Returns LE90 over the asked area from `map` of the metrics; "infinite (holes)", or a dash without a map."""
    value, known = elevation.get("le90_area_m"), elevation.get("completeness_area")
    return length(value) if value is not None or known is None else "infinite (holes)"
