"""Input statement of a floor (`input` of metrics.json) as a table."""

from collections.abc import Mapping
from typing import Any


def input_rows(stated: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Returns what is stated of a floor as text: pairs (name, value with evidence); [] for a generated floor."""
    if not stated:
        return []
    scale = "" if stated["ground_scale"] is None else f", ground scale {stated['ground_scale']:.4f}"
    values = f"{stated['least']:.6g} to {stated['greatest']:.6g} in units of {stated['metres_per_unit']:.6g} m"
    evidence = f"({stated['unit_evidence']}), increasing {stated['direction']}wards ({stated['direction_evidence']})"
    share = f"{100 * stated['share_without_height']:.3g} %"
    return [
        ("floor", f"{stated['file']}, nodes every {stated['spacing_m']:.4g} m ({stated['spacing_evidence']})"),
        ("coordinates", (stated["crs"] or "no CRS") + scale),
        ("values", f"{values} {evidence}"),
        ("nodes without a height", f"{share}, declared: {stated['nodata'] or 'none'}"),
        ("texture", stated["texture"]),
    ]
