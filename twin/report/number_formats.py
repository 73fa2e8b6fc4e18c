"""Numbers with units as texts in reports."""

import math
from collections.abc import Mapping
from typing import Any

DASH = "–"  # noqa: RUF001
#: Units by the suffix of a metric's name.
_UNITS = {
    "_m": "m", "_s": "s", "_ms": "ms", "_deg": "deg", "_px": "px", "_percent": "%", "_mb": "MiB",
}  # fmt: skip


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
    return DASH if value_ms is None else f"{value_ms:.3g} ms" if value_ms < 1e3 else f"{value_ms / 1e3:.2f} s"


def plain(value: Any) -> str:
    """Returns a value as text, a float with at most four significant digits; a dash for None."""
    return DASH if value is None else f"{value:.4g}" if isinstance(value, float) else str(value)


def with_unit(name: str, value: float | None) -> str:
    """Returns a number as `plain` with the unit that its dotted name ends with, e.g. "0.02 m"; a dash for None."""
    return DASH if value is None else f"{plain(value)} {unit_of(name)}".rstrip()


def unit_of(name: str) -> str:
    """Returns the unit of a metric, which its dotted name ends with; "" if it has none."""
    return next((unit for suffix, unit in _UNITS.items() if name.endswith(suffix)), "")


def area_le90(elevation: Mapping[str, Any]) -> str:
    """Returns LE90 over the asked area from `map` of the metrics; "infinite (holes)", or a dash without a map."""
    value, known = elevation.get("le90_area_m"), elevation.get("completeness_area")
    return length(value) if value is not None or known is None else "infinite (holes)"
