"""Conditions of a survey compared with the conditions of the surveys to which the error model was fitted."""

from collections.abc import Iterable, Mapping
from typing import Literal, NamedTuple

from twin.errors import TwinError, UnmodelledError
from twin.surrogate.matchability import Matchability
from twin.world.floor_forecast import planned_overlap
from twin.world.mission import Mission

Range = tuple[float, float]
RENDERED = 'imaging.fidelity = "rendered"'  #: what flies surveys that the surrogate cannot simulate
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
    """Returns smallest and largest value of each quantity in a survey; no overlap if no planned pair has one."""
    overlap = planned_overlap(mission, _OVERLAP_PAIRS)._asdict()
    single = {"bound_px": matchability.medium_bound_px, "lamp_share": matchability.lamp_share}
    single |= {f"overlap_{name}": value for name, value in overlap.items() if value is not None}
    unevenness_px = matchability.unevenness_px
    ranges = {"unevenness_px": (float(unevenness_px.min()), float(unevenness_px.max()))}
    return ranges | {name: (value, value) for name, value in single.items()}


def quantities_outside_fit(conditions: Mapping[str, Range], fitted: Mapping[str, Range]) -> list[tuple[str, str]]:
    """Returns, as texts, each quantity outside the allowed range with its values in a survey, and the allowed range."""
    # the fitted one, extended by `Quantity.factor` at the ends that `Quantity.limits` names, unlimited at others and
    # without a fit
    found = []
    for name in [name for name in fitted if name in conditions]:
        (label, unit, factor, limits), (low, high) = QUANTITIES[name], conditions[name]
        lowest, highest = fitted[name][0] / factor, fitted[name][1] * factor
        allowed = {
            "both": _text((lowest, highest)), "lower": f"at least {lowest:.3g}", "upper": f"at most {highest:.3g}",
        }  # fmt: skip
        if not ((limits == "upper" or lowest <= low) and (limits == "lower" or high <= highest)):
            found.append((f"{label} of {_text((low, high))}{unit}", allowed[limits] + unit))
    return found


def unmodelled(mission: Mission, faults: Iterable[tuple[str, str]]) -> UnmodelledError:
    """Returns the error of a survey that the surrogate cannot simulate, given each problem and what is allowed."""
    describe = mission.scenario.source.describe
    return UnmodelledError([describe(TwinError("imaging.fidelity", *fault)) for fault in faults])


def _text(values: Range) -> str:
    """Returns a range as text; one number if both ends are equal when rounded."""
    low, high = (f"{value:.3g}" for value in values)
    return low if low == high else f"{low} to {high}"
