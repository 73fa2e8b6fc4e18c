"""Quality of a survey as its estimators measure it, without the truth: image quality and self checks."""

from __future__ import annotations

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

    points_median and points_p10 are the median and the 10th percentile of the number of matched points.
    contrast_median and saturated_median are the medians of the contrast and of the saturated fraction of the pixel
    values; both are None without images. blind_looks is the number of frames that have a stereo observation but
    did not become keyframes, because they had too few matched points.
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

    frames_lost and links_failed are fractions; nodes_bridged is a number of nodes (see `EstimationQuality`),
    keyframes_unlinked the number of keyframes that are not in the map (`SurveyResult.unlinked`).
    link_residual is the median over the links of the residuals of their points, divided by the expected residuals;
    link_chi2 is the mean chi-square of the links per degree of freedom. row_offset_px, row_spread_ratio and repetition
    are medians over the stereo pairs: of the row difference of the matched points (right minus left) [px], of the
    standard deviation of this difference divided by the expected one, and of the largest autocorrelation of the left
    image away from its main peak. pitch_deg, yaw_deg, roll_deg and row_shift (a fraction of the focal length) are the
    estimated errors of the rectification, with the signs of `calibration_error.right_*`; row_pattern is the systematic
    row difference that they do not explain, and disparity_offset the common error of all disparities that the links
    imply (both are fractions of the focal length). sigma_max_m is the largest 3-D standard deviation (square root of
    the trace of the covariance) of a keyframe position [m]. frame_sigma_m is the 3-D standard deviation of the position
    of a keyframe relative to the previous keyframe, by frame-to-frame motion alone: the 90th percentile over the
    keyframes [m]. length_scale and depth_scale are the lengths from the images across and along the optical axis,
    divided by those of DVL, USBL and pressure; None where these do not determine them. readings_rejected and
    readings_disputed are numbers of readings of each navigation sensor.
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
        "disparity_offset": None if quality.disparity_offset is None else quality.disparity_offset.estimate,
        "sigma_max_m": float(np.sqrt(variances.max())) if len(variances) else None,
        "frame_sigma_m": quality.frame_sigma_m,
        "length_scale": across and across.estimate,
        "length_scale_sigma": across and across.sigma,
        "depth_scale": along and along.estimate,
        "depth_scale_sigma": along and along.sigma,
        "readings_rejected": dict(quality.readings_rejected),
        "readings_disputed": dict(quality.readings_disputed),
    }
