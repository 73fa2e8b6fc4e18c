"""Index page of `twin reproduce all`: every table and every figure of the experiments on one HTML page."""

from __future__ import annotations

from collections.abc import Sequence

from twin.report.html import render_page
from twin.reproduce.exhibit import Exhibit


def render(exhibits: Sequence[Exhibit], quick: bool) -> str:
    """Returns the page as HTML; it shows the figures from one subfolder per experiment, next to the page."""
    return render_page("twin.reproduce", "index_page.html.j2", {"exhibits": exhibits, "quick": quick})
