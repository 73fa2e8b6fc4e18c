"""Checks of a survey that need no truth; a failed check is a reason not to trust the result.

The limits lie between the values of ordinary surveys and those of surveys with gross errors (docs/findings.md, section
9). An error of disparities is a finding only if positions or heights are wrong by more than their standard deviations.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from twin.core.quality import EstimationQuality, Finding
from twin.core.records import ElevationMap, StereoRig, SurveyResult

MAX_FRAMES_LOST = 0.02  # fraction of the frames
MAX_LINKS_FAILED = 0.15  # fraction of the links
MAX_LINK_CHI2 = 2.5  # mean chi-square per degree of freedom
MAX_LINK_RESIDUAL = 2.0  # median residual / expected residual
MAX_ROW_OFFSET_PX = 0.1  # median row difference that remains after the correction
MAX_ROW_PATTERN_PX = 0.1  # systematic row difference that pitch, yaw, roll and a row offset do not explain, RMS
MAX_YAW_PX = 0.08  # disparity error that the estimated yaw of the right camera would cause
MAX_DISPARITY_OFFSET_PX = 0.08  # offset of all disparities, estimated from the motions between keyframes
MAX_SCALE_ERROR = 0.01  # relative difference of lengths from the images and from navigation sensors
MAX_REPETITION = 0.6  # highest autocorrelation of the image outside the central peak
MIN_POINTS = 60  # matched points of a stereo pair, 10th percentile
MAX_SIGMA_DEPTHS = 0.02  # standard deviation of a position / depth of the floor
_SIGNIFICANT = 4.0  # standard deviations
_COVERED = 3.0  # largest effect of a calibration error that the standard deviation of a result covers [its sigmas]


class _Effect(NamedTuple):
    """Effect of an error of all disparities on positions or heights, with its largest tolerable value [m]."""

    error_m: float
    limit_m: float
    text: str


def check_survey(result: SurveyResult, rig: StereoRig, elevation: ElevationMap | None = None) -> list[Finding]:
    """Returns the findings of all checks; an empty list if every check passes.

    The findings are in the order of tracking, navigation sensors, stereo, rectification and consistency.

    Args:
        elevation: map of the survey; None if none was built.
    """
    return [
        finding
        for findings in (
            _tracking(result),
            _readings(result),
            _stereo(result),
            _rectification(result, rig, elevation),
            _consistency(result, rig, elevation),
        )
        for finding in findings
    ]


def _disparity_error(
    check: str, error: float, limit_px: float, survey: tuple[SurveyResult, StereoRig, ElevationMap | None], text: str
) -> Iterator[Finding]:
    """Yields a finding if an error of all disparities [focal lengths] is above its limit and has a damaging effect."""
    result, rig, elevation = survey
    if not abs(error) * rig.focal_px > limit_px or not len(result.keyframe_depth_m):
        return
    effect = max(_effects(result, rig, elevation, abs(error)), key=lambda one: one.error_m / max(one.limit_m, 1e-9))
    if effect.error_m > effect.limit_m:
        yield Finding(check, effect.error_m, effect.limit_m, f"{text}; {effect.text}")


def _effects(result: SurveyResult, rig: StereoRig, elevation: ElevationMap | None, error: float) -> Iterator[_Effect]:
    """Yields the effects of an error e of all disparities: depths Z = b / d, and all lengths, change by Z e / b."""
    depth_m = float(np.median(result.keyframe_depth_m))
    share = error * depth_m / rig.baseline_m
    positions = result.final.positions[result.keyframe_rows]
    reach_m = float(np.linalg.norm(positions - positions[0], axis=1).max())
    sigma_m = float(np.sqrt(np.trace(result.node_cov[:, 3:, 3:], axis1=1, axis2=2).max(initial=0.0)))
    yield _effect("positions", share * reach_m, sigma_m, f"over {reach_m:.3g} m")
    if elevation is not None and np.isfinite(elevation.sigma_m).any():
        yield _effect("heights", share * depth_m, float(np.nanmedian(elevation.sigma_m)), f"at {depth_m:.3g} m")


def _effect(name: str, error_m: float, sigma_m: float, where: str) -> _Effect:
    text = f"{name} may be off by {1000 * error_m:.2g} mm {where}, their standard deviation is {1000 * sigma_m:.2g} mm"
    return _Effect(error_m, _COVERED * sigma_m, text)


def _tracking(result: SurveyResult) -> Iterator[Finding]:
    quality = result.quality
    lost = quality.frames_lost / max(len(result.online), 1)
    if lost > MAX_FRAMES_LOST:
        text = f"the motion of {quality.frames_lost} of {len(result.online)} frames was predicted, not measured"
        yield Finding("frames_lost", lost, MAX_FRAMES_LOST, text)
    for status, rows in quality.repeats.items():
        if len(rows) > MAX_FRAMES_LOST * len(result.online):
            text = f"{status} in {len(rows)} of {len(result.online)} frames"
            yield Finding("frames_repeated", len(rows) / len(result.online), MAX_FRAMES_LOST, text)
    if quality.nodes_bridged:
        text = f"{quality.nodes_bridged} keyframes could not be linked to the keyframe before them"
        yield Finding("nodes_bridged", quality.nodes_bridged, 0, text)
    if unlinked := int(result.unlinked.sum()):
        text = (
            f"{unlinked} keyframes are linked to no other; their poses are dead reckoning, and the map is without them"
        )
        yield Finding("keyframes_unlinked", unlinked, 0, text)
    failed = quality.links_failed / max(quality.links_tried, 1)
    if failed > MAX_LINKS_FAILED:
        text = f"{quality.links_failed} of {quality.links_tried} links between keyframes failed"
        yield Finding("links_failed", failed, MAX_LINKS_FAILED, text)


def _readings(result: SurveyResult) -> Iterator[Finding]:
    for sensor, count in result.quality.readings_disputed.items():
        if count:
            text = f"{sensor} readings contradicted the estimates for long, and {count} were believed in the end"
            yield Finding(f"readings_{sensor}", count, 0, text)


def _stereo(result: SurveyResult) -> Iterator[Finding]:
    pairs = result.stereo_observations
    if not pairs:
        return
    points = float(np.percentile([pair.n_points for pair in pairs], 10))
    if points < MIN_POINTS:
        text = f"one stereo pair in ten has {points:.0f} matched points or fewer"
        yield Finding("points", points, MIN_POINTS, text)
    repeated = _median(pair.repetition for pair in pairs)
    if repeated is not None and repeated > MAX_REPETITION:
        text = f"the texture repeats (autocorrelation {repeated:.2f}), so matches are ambiguous"
        yield Finding("repetition", repeated, MAX_REPETITION, text)


def _rectification(result: SurveyResult, rig: StereoRig, elevation: ElevationMap | None) -> Iterator[Finding]:
    """Yields a finding for each rectification error above its limit: row offset, yaw, pattern of row differences."""
    offset = _median(pair.row_offset_px for pair in result.stereo_observations)
    if offset is not None and abs(offset) > MAX_ROW_OFFSET_PX:
        text = f"the rows of the right image are offset by {offset:+.2f} px"
        yield Finding("row_offset", abs(offset), MAX_ROW_OFFSET_PX, text)
    epipolar, survey = result.quality.epipolar, (result, rig, elevation)
    if epipolar is not None:
        yaw, sigma = float(epipolar.estimate[1]), float(epipolar.sigma[1])
        shift_px, pattern_px = abs(yaw) * rig.focal_px, epipolar.pattern * rig.focal_px
        if abs(yaw) > _SIGNIFICANT * sigma:
            text = (
                f"row differences imply a yaw of {np.rad2deg(yaw):+.3f} deg between the cameras, or a distortion error:"
                f" disparities may be off by {shift_px:.1f} px"
            )
            yield from _disparity_error("yaw", yaw, MAX_YAW_PX, survey, text)
        text = (
            f"row differences of stereo matches vary systematically over the image by {pattern_px:.2f} px, which no"
            " rotation of a camera explains: the distortion or the port is not as calibrated"
        )
        yield from _disparity_error("row_pattern", epipolar.pattern, MAX_ROW_PATTERN_PX, survey, text)


def _consistency(result: SurveyResult, rig: StereoRig, elevation: ElevationMap | None) -> Iterator[Finding]:
    """Yields a finding for each quantity that shows inconsistent links or a large uncertainty."""
    quality = result.quality
    if quality.link_residual is not None and quality.link_residual > MAX_LINK_RESIDUAL:
        text = f"residuals of points matched between keyframes are {quality.link_residual:.1f} times their noise"
        yield Finding("link_residual", quality.link_residual, MAX_LINK_RESIDUAL, text)
    offset = quality.disparity_offset
    if offset is not None and abs(offset.estimate) > _SIGNIFICANT * offset.sigma:
        offset_px, survey = offset.estimate * rig.focal_px, (result, rig, elevation)
        text = (
            f"the motions of near and far points imply that all disparities are off by {offset_px:+.2f} px:"
            " a principal point or the yaw of a camera is not as calibrated"
        )
        yield from _disparity_error("disparity_offset", offset.estimate, MAX_DISPARITY_OFFSET_PX, survey, text)
    yield from _scale(quality)
    if quality.link_chi2 is not None and quality.link_chi2 > MAX_LINK_CHI2:
        text = f"the motions between keyframes contradict each other (chi-square {quality.link_chi2:.1f}, 1 expected)"
        yield Finding("link_chi2", quality.link_chi2, MAX_LINK_CHI2, text)
    if not quality.alignment_converged:
        text = "the last global alignment ended before it converged, so its poses do not fit the motions best"
        yield Finding("alignment", 1, 0, text)
    if quality.frame_sigma_m is not None and len(result.keyframe_depth_m):
        share = quality.frame_sigma_m / float(np.median(result.keyframe_depth_m))
        if share > MAX_SIGMA_DEPTHS:
            text = f"the standard deviation of positions between keyframes reaches {quality.frame_sigma_m * 100:.1f} cm"
            yield Finding("frame_sigma", share, MAX_SIGMA_DEPTHS, text)
    if len(result.node_cov) and len(result.keyframe_depth_m):
        sigma_m = float(np.sqrt(np.trace(result.node_cov[:, 3:, 3:], axis1=1, axis2=2).max()))
        share = sigma_m / float(np.median(result.keyframe_depth_m))
        if not share <= MAX_SIGMA_DEPTHS:
            text = f"the standard deviation of a keyframe position reaches {sigma_m * 100:.1f} cm"
            yield Finding("sigma", share, MAX_SIGMA_DEPTHS, text)


def _scale(quality: EstimationQuality) -> Iterator[Finding]:
    """Yields a finding if lengths from the images differ from those of the navigation sensors.

    The scale along the optical axis is judged only where that across it is right, as the rotation is wrong otherwise.
    """
    for check, scale, which, cause in (
        ("length_scale", quality.length_scale, "", "the baseline or the scale of the sensors"),
        ("depth_scale", quality.depth_scale, " along the optical axis", "the baseline or the focal length"),
    ):
        if scale is not None and abs(scale.estimate - 1) > max(MAX_SCALE_ERROR, _SIGNIFICANT * scale.sigma):
            ratio = f"{scale.estimate:.3f} +- {scale.sigma:.3f} times those of {scale.sensors}"
            text = f"the lengths{which} from the images are {ratio}: {cause} is not as calibrated"
            yield Finding(check, abs(scale.estimate - 1), MAX_SCALE_ERROR, text)
            return


def _median(values: Iterator[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return float(np.median(known)) if known else None
