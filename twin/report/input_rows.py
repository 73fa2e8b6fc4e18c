"""Input statement of a floor (`input` of metrics.json) as a table."""

from collections.abc import Mapping
from typing import Any

from twin.report.html import render_rows


def input_rows(stated: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Returns what is stated of a floor as text: pairs (name, value with evidence); [] for a generated floor."""
    return render_rows("input.txt.j2", {"stated": stated}) if stated else []
