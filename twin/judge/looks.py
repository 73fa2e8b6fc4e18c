"""What the looks with both eyes had to go by: matched points, and the contrast of the images."""

from __future__ import annotations

from typing import Any

from twin.judge.numbers import percentile
from twin.records import SurveyResult


def look_metrics(result: SurveyResult) -> dict[str, Any]:
    """`vision` of metrics.json, over all looks, also those that made no key point.

    Points: median, and what nine in ten looks had at least. Contrast: median; None where no image is rendered.
    """
    points = [look.n_points for look in result.looks]
    contrast = [look.contrast for look in result.looks if look.contrast is not None]
    return {
        "points_median": percentile(points, 50),
        "points_p10": percentile(points, 10),
        "contrast_median": percentile(contrast, 50),
        "blind_looks": len({look.row for look in result.looks} - {int(row) for row in result.key_frames}),
    }
