"""Quality of a survey as its estimators measure it, without the truth: image quality and self checks."""

from typing import Any

import numpy as np

from twin.core.records import SurveyResult
from twin.judge.summary_statistics import percentile


def _over_pairs(result: SurveyResult, name: str, percent: float = 50) -> float | None:
    """Returns a percentile of an attribute over the stereo observations that have it; None if none has it."""
    values = [getattr(pair, name) for pair in result.stereo_observations]
    return percentile([value for value in values if value is not None], percent)


def stereo_quality(result: SurveyResult) -> dict[str, Any]:
    """Returns `vision` of metrics.json, over all stereo observations, including those that gave no keyframe.

    points_median and points_p10 are percentiles of the number of matched points; contrast_median and saturated_median
    medians of contrast and saturated fraction, None without images. blind_looks is the number of frames with a stereo
    observation that had too few matched points for a keyframe.
    """
    observed = {pair.row for pair in result.stereo_observations}
    return {
        "points_median": _over_pairs(result, "n_points"),
        "points_p10": _over_pairs(result, "n_points", 10),
        "contrast_median": _over_pairs(result, "contrast"),
        "saturated_median": _over_pairs(result, "saturated"),
        "blind_looks": len(observed - {int(row) for row in result.keyframe_rows}),
    }


def self_check_metrics(result: SurveyResult) -> dict[str, Any]:
    """Returns `self_check.*` of metrics.json; a value that was not measured is None.

    frames_lost and links_failed are fractions, nodes_bridged a number of nodes (`EstimationQuality`),
    keyframes_unlinked that of the keyframes not in the map. link_residual is the median over the links of the residuals
    of their points, divided by the expected ones; link_chi2 the mean chi-square of the links per degree of freedom.
    row_offset_px, row_spread_ratio and repetition are medians over the stereo pairs: row difference of the matched
    points (right minus left), its standard deviation / expected, and largest autocorrelation of the left image away
    from its main peak. pitch_deg, yaw_deg, roll_deg and row_shift (fraction of the focal length) are estimated errors
    of the rectification, with the signs of `calibration_error.right_*`; row_pattern the systematic row difference that
    they do not explain, disparity_offset the common error of all disparities (fractions of the focal length).
    sigma_max_m is the largest 3-D standard deviation of a keyframe position; frame_sigma_m that of a keyframe relative
    to the previous one by frame-to-frame motion alone, 90th percentile. length_scale and depth_scale are lengths from
    the images across and along the optical axis / those of DVL, USBL and pressure. readings_rejected, _disputed and
    _believed are numbers by navigation sensor.
    """
    quality, epipolar = result.quality, result.quality.epipolar
    pitch, yaw, roll = (None,) * 3 if epipolar is None else np.rad2deg(epipolar.estimate[:3]).tolist()
    across, along = quality.length_scale, quality.depth_scale
    variances = np.trace(result.node_cov[:, 3:, 3:], axis1=1, axis2=2)
    return {
        "frames_lost": quality.frames_lost / len(result.online) if len(result.online) else None,
        "nodes_bridged": quality.nodes_bridged,
        "keyframes_unlinked": int(result.unlinked.sum()),
        "links_failed": quality.links_failed / quality.links_tried if quality.links_tried else None,
        "link_residual": quality.link_residual,
        "link_chi2": quality.link_chi2,
        "row_offset_px": _over_pairs(result, "row_offset_px"),
        "row_spread_ratio": _over_pairs(result, "row_spread_ratio"),
        "repetition": _over_pairs(result, "repetition"),
        "pitch_deg": pitch,
        "yaw_deg": yaw,
        "roll_deg": roll,
        "row_shift": None if epipolar is None else float(epipolar.estimate[3]),
        "row_pattern": None if epipolar is None else epipolar.pattern,
        "calibration": {
            "yaw_deg": float(np.rad2deg(quality.calibration.yaw_rad)),
            "yaw_sigma_deg": float(np.rad2deg(quality.calibration.cov[0, 0] ** 0.5)),
            "baseline_error": quality.calibration.baseline_error,
            "baseline_error_sigma": float(quality.calibration.cov[1, 1] ** 0.5),
        },
        "disparity_offset": None if quality.disparity_offset is None else quality.disparity_offset.estimate,
        "sigma_max_m": float(np.sqrt(variances.max())) if len(variances) else None,
        "frame_sigma_m": quality.frame_sigma_m,
        "length_scale": across and across.estimate,
        "length_scale_sigma": across and across.sigma,
        "depth_scale": along and along.estimate,
        "depth_scale_sigma": along and along.sigma,
        "readings_rejected": dict(quality.readings_rejected),
        "readings_disputed": dict(quality.readings_disputed),
        "readings_believed": dict(quality.readings_believed),
    }
