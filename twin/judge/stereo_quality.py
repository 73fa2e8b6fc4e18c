"""Image quality of the stereo observations: matched points and contrast."""

from __future__ import annotations

from typing import Any

from twin.core.records import SurveyResult
from twin.judge.summary_statistics import percentile


def stereo_quality(result: SurveyResult) -> dict[str, Any]:
    """Returns `vision` of metrics.json, over all stereo observations, including those that gave no keyframe.

    points_median and points_p10 are the median and the 10th percentile of the number of matched points.
    contrast_median and saturated_median are the medians of the contrast and of the saturated fraction of the pixel
    values; both are None without images. blind_looks is the number of frames that have a stereo observation but
    did not become keyframes, because they had too few matched points.
    """
    points = [observation.n_points for observation in result.stereo_observations]
    contrast = [observation.contrast for observation in result.stereo_observations if observation.contrast is not None]
    saturated = [pair.saturated for pair in result.stereo_observations if pair.saturated is not None]
    observed, keyframes = {observation.row for observation in result.stereo_observations}, result.keyframe_rows
    return {
        "points_median": percentile(points, 50),
        "points_p10": percentile(points, 10),
        "contrast_median": percentile(contrast, 50),
        "saturated_median": percentile(saturated, 50),
        "blind_looks": len(observed - {int(row) for row in keyframes}),
    }
