"""Conditions of a survey compared with the conditions of the surveys to which the error model was fitted."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Literal, NamedTuple

from twin.surrogate.matchability import Matchability
from twin.world.floor_forecast import planned_overlap
from twin.world.mission import Mission

Range = tuple[float, float]
_OVERLAP_PAIRS = 40  # largest number of pairs of images whose overlap is computed, along and across the legs each


class Quantity(NamedTuple):
    """Condition of a survey on which the error model depends."""

    label: str  #: name in messages
    unit: str  #: unit in messages, with a leading space; "" for a ratio
    #: largest allowed ratio of a value to the upper end of the fitted range, and of the lower end to a value
    factor: float = 1.0
    #: ends of the fitted range that restrict the use of the error model. Beyond an end that is not named, the functions
    #: of the error model approach a value that the surveys of the fit determine, e.g. that of noise-free images.
    limits: Literal["both", "lower", "upper"] = "both"


#: Quantities whose fitted range may restrict the use of an error model, by name. The table [fitted_range] of the file
#: may have these names only; `survey_conditions` returns their values in a survey.
QUANTITIES = {
    "bound_px": Quantity("matching precision at medium depth (Cramér-Rao bound)", " px", 1.5, "upper"),
    "unevenness_px": Quantity(
        "unevenness of the floor under a patch", " px per unit of baseline / depth", 1.5, "upper"
    ),
    "lamp_share": Quantity("share of the light from the lamps", ""),
    "overlap_along": Quantity("median overlap along the legs", "", limits="lower"),
    "overlap_across": Quantity("median overlap across the legs", "", limits="lower"),
}


def survey_conditions(mission: Mission, matchability: Matchability) -> dict[str, Range]:
    """Returns the smallest and the largest value of each quantity in a survey, by name.

    An overlap is left out if no pair of planned images has one.
    """
    overlap = planned_overlap(mission, _OVERLAP_PAIRS)._asdict()
    overlaps = {f"overlap_{name}": (value, value) for name, value in overlap.items() if value is not None}
    unevenness_px = matchability.unevenness_px
    return {
        "bound_px": (matchability.medium_bound_px, matchability.medium_bound_px),
        "unevenness_px": (float(unevenness_px.min()), float(unevenness_px.max())),
        "lamp_share": (matchability.lamp_share, matchability.lamp_share),
        **overlaps,
    }


class QuantityOutsideFit(NamedTuple):
    """Quantity whose values in a survey lie outside the range in which the error model may be used."""

    quantity: Quantity  #: the quantity
    values: Range  #: smallest and largest value in the survey
    allowed: Range  #: smallest and largest allowed value; infinite on a side without limit

    @property
    def value_text(self) -> str:
        """Returns the quantity and its range of values in the survey as text."""
        return f"{self.quantity.label} of {_text(self.values)}{self.quantity.unit}"

    @property
    def allowed_text(self) -> str:
        """Returns the allowed range of the quantity as text."""
        if self.quantity.limits == "both":
            return f"{_text(self.allowed)}{self.quantity.unit}"
        side = "at most" if self.quantity.limits == "upper" else "at least"
        return f"{side} {self.allowed[self.quantity.limits == 'upper']:.3g}{self.quantity.unit}"


def quantities_outside_fit(conditions: Mapping[str, Range], fitted: Mapping[str, Range]) -> list[QuantityOutsideFit]:
    """Returns the quantities whose values in a survey lie outside the allowed range.

    The allowed range is the fitted one, extended by `Quantity.factor` at the ends that `Quantity.limits` names; an end
    that is not named is unlimited. Quantities without a fitted range are not checked.
    """
    found = []
    for name in [name for name in fitted if name in conditions]:
        quantity, (low, high), (smallest, largest) = QUANTITIES[name], conditions[name], fitted[name]
        lowest = -math.inf if quantity.limits == "upper" else smallest / quantity.factor
        highest = math.inf if quantity.limits == "lower" else largest * quantity.factor
        allowed = lowest, highest
        if not allowed[0] <= low <= high <= allowed[1]:
            found.append(QuantityOutsideFit(quantity, (low, high), allowed))
    return found


def _text(values: Range) -> str:
    """Returns a range as text; one number if both ends are equal when rounded."""
    low, high = (f"{value:.3g}" for value in values)
    return low if low == high else f"{low} to {high}"
