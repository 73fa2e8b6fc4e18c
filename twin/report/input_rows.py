"""Input statement of a floor (`input` of metrics.json) as a table."""

from collections.abc import Mapping
from typing import Any

from twin.report.html import render_text


def input_rows(stated: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Returns what is stated of a floor as text: pairs (name, value with evidence); [] for a generated floor."""
    lines = render_text("input.txt.j2", {"stated": stated}).splitlines() if stated else []
    return [(name, value) for name, _, value in (line.partition(" | ") for line in lines)]
