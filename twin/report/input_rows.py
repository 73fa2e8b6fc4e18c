"""Input statement of a floor (`input` of metrics.json) as a table."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any


def input_rows(stated: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Returns what is stated of a floor as text: pairs (name, value with evidence); [] for a generated floor."""
    if not stated:
        return []
    scale = stated["ground_scale"]
    unit = f"in units of {stated['metres_per_unit']:.6g} m ({stated['unit_evidence']})"
    direction = f"increasing {stated['direction']}wards ({stated['direction_evidence']})"
    return [
        ("floor", f"{stated['file']}, nodes every {stated['spacing_m']:.4g} m ({stated['spacing_evidence']})"),
        ("coordinates", (stated["crs"] or "no CRS") + (f", ground scale {scale:.4f}" if scale is not None else "")),
        ("values", f"{stated['least']:.6g} to {stated['greatest']:.6g} {unit}, {direction}"),
        (
            "nodes without a height",
            f"{100 * stated['share_without_height']:.3g} %, declared: {stated['nodata'] or 'none'}",
        ),
        ("texture", stated["texture"]),
    ]
