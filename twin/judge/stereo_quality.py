"""What the stereo_observations with both cameras had to go by: matched points, and the contrast of the images."""

from __future__ import annotations

from typing import Any

from twin.core.records import SurveyResult
from twin.judge.summary_statistics import percentile


def stereo_quality(result: SurveyResult) -> dict[str, Any]:
    """`vision` of metrics.json, over all stereo_observations, also those that made no keyframe.

    Points: median, and what nine in ten stereo_observations had at least. Contrast: median; None where no image is rendered.
    """
    points = [look.n_points for look in result.stereo_observations]
    contrast = [look.contrast for look in result.stereo_observations if look.contrast is not None]
    return {
        "points_median": percentile(points, 50),
        "points_p10": percentile(points, 10),
        "contrast_median": percentile(contrast, 50),
        "blind_looks": len(
            {look.row for look in result.stereo_observations} - {int(row) for row in result.keyframe_rows}
        ),
    }
