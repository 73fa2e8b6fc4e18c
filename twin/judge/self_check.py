"""Section `self_check` of metrics.json: checks that the estimators compute without the truth."""

from __future__ import annotations

from typing import Any

import numpy as np

from twin.core.records import SurveyResult
from twin.judge.summary_statistics import percentile


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
    quality, pairs = result.quality, result.stereo_observations
    offsets = [pair.row_offset_px for pair in pairs if pair.row_offset_px is not None]
    ratios = [pair.row_spread_ratio for pair in pairs if pair.row_spread_ratio is not None]
    repeated = [pair.repetition for pair in pairs if pair.repetition is not None]
    epipolar = quality.epipolar
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
        "row_offset_px": percentile(offsets, 50),
        "row_spread_ratio": percentile(ratios, 50),
        "repetition": percentile(repeated, 50),
        "pitch_deg": pitch,
        "yaw_deg": yaw,
        "roll_deg": roll,
        "row_shift": None if epipolar is None else float(epipolar.estimate[3]),
        "row_pattern": None if epipolar is None else epipolar.pattern,
        "disparity_offset": None if quality.disparity_offset is None else quality.disparity_offset.estimate,
        "sigma_max_m": float(np.sqrt(variances.max())) if len(variances) else None,
        "frame_sigma_m": quality.frame_sigma_m,
        "length_scale": None if across is None else across.estimate,
        "length_scale_sigma": None if across is None else across.sigma,
        "depth_scale": None if along is None else along.estimate,
        "depth_scale_sigma": None if along is None else along.sigma,
        "readings_rejected": dict(quality.readings_rejected),
        "readings_disputed": dict(quality.readings_disputed),
    }
