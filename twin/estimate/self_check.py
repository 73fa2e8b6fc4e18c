"""Checks of a survey that need no truth; a failed check is a reason not to trust the result.

The limits lie between the values of ordinary surveys and those of surveys with gross errors (docs/findings.md, section
9). An error of disparities is a finding only if positions or heights are wrong by more than their standard deviations.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from twin.core.quality import DistortionError, EstimationQuality, Finding
from twin.core.records import ElevationMap, StereoRig, SurveyResult
from twin.estimate.calibration_errors import SIGNIFICANT, contradicts, row_pattern
from twin.estimate.vision.image_quality import MAX_REPETITION

MAX_FRAMES_LOST = 0.02  # fraction of the frames
MAX_LINKS_FAILED = 0.15  # fraction of the links
MAX_LINK_CHI2 = 2.5  # mean chi-square per degree of freedom
MAX_LINK_RESIDUAL = 2.0  # median residual / expected residual
MAX_ROW_OFFSET_PX = 0.1  # median row difference that remains after the correction
MAX_ROW_PATTERN_PX = 0.1  # systematic row difference that pitch, yaw, roll and a row offset do not explain, RMS
MAX_YAW_PX = 0.08  # disparity error that the estimated yaw of the right camera would cause
MAX_DISPARITY_OFFSET_PX = 0.08  # offset of all disparities, estimated from the motions between keyframes
MAX_DISTORTION_PX = 0.2  # disparity error by a radial distortion, and by the yaw that is estimated in its place
MAX_LASTING = 1.0  # RMS of the residuals that successive readings of a sensor share / standard deviation of a reading
MAX_SCALE_ERROR = 0.01  # relative difference of lengths from the images and from navigation sensors
_SCALE_SIGMAS = 3.0  # the same in standard deviations; with 4, a third of the focal errors of 3 % would pass
MIN_POINTS = 60  # matched points of a stereo pair, 10th percentile
MAX_SCATTER = 2.0  # RMS difference of heights from two sets of keyframes / its standard deviation
MAX_SIGMA_DEPTHS = 0.02  # standard deviation of a position / depth of the floor
ROW_PATTERN = "row_pattern"  #: name of the check of systematic row differences
_COVERED = 3.0  # largest effect of a calibration error that the standard deviation of a result covers [its sigmas]


def check_survey(result: SurveyResult, rig: StereoRig, elevation: ElevationMap | None = None) -> list[Finding]:
    """Returns the failed checks: tracking, navigation sensors, stereo, rectification and consistency, in this order."""
    damage = _Damage(result, rig, elevation)
    checks = _tracking(result), _stereo(result), _rectification(result, damage), _consistency(result, damage)
    scatter = None if elevation is None else elevation.scatter
    text = f"heights from legs there and back differ by {scatter or 0:.1f} times their standard deviation"
    return [finding for findings in checks for finding in findings] + _above("scatter", scatter, MAX_SCATTER, text)


def with_length_error(
    result: SurveyResult, elevation: ElevationMap | None, findings: Sequence[Finding]
) -> tuple[SurveyResult, ElevationMap | None]:
    """Returns the results with covariances that include the errors of all lengths which the findings imply.

    With a relative error s, a position at a distance d from the first keyframe is off by s d along d, and a height by s
    times the depth of the floor. Unchanged if no finding implies such an error. The alignment has already taken account
    of the effect of a row pattern on positions (`image_errors`).
    """
    share, of_positions = (
        float(np.sqrt(sum(finding.length_error**2 for finding in findings if finding.check not in known)))
        for known in ((), (ROW_PATTERN,))
    )
    rows = result.keyframe_rows[: len(result.node_cov)]
    if not share or not len(rows):
        return result, elevation
    poses, cov = result.final.world_from_camera[rows], result.node_cov.copy()
    offsets_m = np.einsum("nji,nj->ni", poses[:, :3, :3], poses[:, :3, 3] - poses[0, :3, 3])  # in camera axes
    cov[:, 3:, 3:] += of_positions**2 * offsets_m[:, :, None] * offsets_m[:, None, :]
    if elevation is not None:
        depth_m = np.float32(share * np.median(result.keyframe_depth_m))
        parts = elevation.variances
        parts = parts._replace(calibration=parts.calibration + float(depth_m) ** 2)
        elevation = replace(elevation, sigma_m=np.hypot(elevation.sigma_m, depth_m), variances=parts)
    return replace(result, node_cov=cov), elevation


def _above(check: str, value: float | None, limit: float, text: str) -> list[Finding]:
    return [] if value is None or value <= limit else [Finding(check, value, limit, text)]


class _Damage(NamedTuple):
    """Effect of errors of all disparities on the positions and heights of a survey."""

    result: SurveyResult
    rig: StereoRig
    elevation: ElevationMap | None

    def check(self, check: str, error: float, limit_px: float, text: str) -> list[Finding]:
        """Returns a finding if an error [focal lengths] is above its limit and the largest of its effects damages."""
        if not abs(error) * self.rig.focal_px > limit_px or not len(self.result.keyframe_depth_m):
            return []
        error_m, limit_m, effect = max(self._effects(abs(error)), key=lambda one: one[0] / max(one[1], 1e-9))
        found = _above(check, error_m, limit_m, f"{text}; {effect}")
        return [finding._replace(length_error=self._share(abs(error))) for finding in found]

    def _share(self, error: float) -> float:
        """Returns the relative error of lengths by an error of all disparities [focal lengths], Z e / b."""
        return error * float(np.median(self.result.keyframe_depth_m)) / self.rig.baseline_m

    def _effects(self, error: float) -> Iterator[tuple[float, float, str]]:
        """Yields the effects of an error e (of positions or heights, largest tolerable one [m], both in words)."""
        # depths Z = b / d, and all lengths, change by Z e / b
        result, _, elevation = self
        depth_m, share = float(np.median(result.keyframe_depth_m)), self._share(error)
        positions = result.final.positions[result.keyframe_rows]
        reach_m = float(np.linalg.norm(positions - positions[0], axis=1).max())
        effects = [("positions", share * reach_m, _largest_sigma_m(result, 0.0), f"over {reach_m:.3g} m")]
        if elevation is not None and np.isfinite(elevation.sigma_m).any():
            sigma_m = float(np.nanmedian(elevation.sigma_m))
            effects.append(("heights", share * depth_m, sigma_m, f"at {depth_m:.3g} m"))
        for name, error_m, sigma_m, where in effects:
            text = f"{name} may be off by {1000 * error_m:.2g} mm {where}, "
            yield error_m, _COVERED * sigma_m, f"{text}their standard deviation is {1000 * sigma_m:.2g} mm"


def _largest_sigma_m(result: SurveyResult, initial: float) -> float:
    """Returns the largest standard deviation (3-D) of the position of a keyframe [m], at least `initial`."""
    variances = np.trace(result.node_cov[:, 3:, 3:], axis1=1, axis2=2)
    return float(np.sqrt(variances.max(initial=initial)))


def _tracking(result: SurveyResult) -> Iterator[Finding]:
    quality, n = result.quality, len(result.online)
    text = f"the motion of {quality.frames_lost} of {n} frames was predicted, not measured"
    yield from _above("frames_lost", quality.frames_lost / max(n, 1), MAX_FRAMES_LOST, text)
    for status, rows in quality.repeats.items():
        yield from _above("frames_repeated", len(rows) / n, MAX_FRAMES_LOST, f"{status} in {len(rows)} of {n} frames")
    text = f"{quality.nodes_bridged} keyframes could not be linked to the keyframe before them"
    yield from _above("nodes_bridged", quality.nodes_bridged, 0, text)
    unlinked = int(result.unlinked.sum())
    text = f"{unlinked} keyframes are linked to no other; their poses are dead reckoning, and the map is without them"
    yield from _above("keyframes_unlinked", unlinked, 0, text)
    text = f"{quality.links_failed} of {quality.links_tried} links between keyframes failed"
    yield from _above("links_failed", quality.links_failed / max(quality.links_tried, 1), MAX_LINKS_FAILED, text)
    for sensor, count in quality.readings_disputed.items():
        believed = quality.readings_believed.get(sensor, 0)
        end = f"{believed} were believed in the end" if believed else f"{count} more were not used"
        text = f"{sensor} readings contradicted the estimates for long, and {end}"
        yield from _above(f"readings_{sensor}", count, 0, text)
    for sensor, ratio in quality.lasting_residuals.items():
        text = f"the path differs from the {sensor} readings for long, by {ratio:.1f} times their standard deviation"
        yield from _above(f"lasting_{sensor}", ratio, MAX_LASTING, text)


def _stereo(result: SurveyResult) -> Iterator[Finding]:
    pairs = result.stereo_observations
    if not pairs:
        return
    points = float(np.percentile([pair.n_points for pair in pairs], 10))
    if points < MIN_POINTS:
        text = f"one stereo pair in ten has {points:.0f} matched points or fewer"
        yield Finding("points", points, MIN_POINTS, text)
    repeated = _median(pair.repetition for pair in pairs)
    text = f"the texture repeats (autocorrelation {repeated:.2f}), so matches are ambiguous" if repeated else ""
    yield from _above("repetition", repeated, MAX_REPETITION, text)


def _rectification(result: SurveyResult, damage: _Damage) -> Iterator[Finding]:
    offset = _median(pair.row_offset_px for pair in result.stereo_observations)
    if offset is not None:
        text = f"the rows of the right image are offset by {offset:+.2f} px"
        yield from _above("row_offset", abs(offset), MAX_ROW_OFFSET_PX, text)
    epipolar, focal_px = result.quality.epipolar, damage.rig.focal_px
    if epipolar is None:
        return
    yaw, sigma = float(epipolar.estimate[1]) - result.quality.calibration.yaw_rad, float(epipolar.sigma[1])
    offset = result.quality.disparity_offset
    if not contradicts(offset, yaw) and abs(yaw) > SIGNIFICANT * sigma:
        text = (
            f"row differences imply a yaw of {np.rad2deg(yaw):+.3f} deg between the cameras, or a distortion error:"
            f" disparities may be off by {abs(yaw) * focal_px:.1f} px"
        )
        # an estimator that does not calibrate itself is left with the yaw that the calibration leads to expect
        expected_px = 0.0 if result.quality.calibration.cov.any() else _COVERED * damage.rig.yaw_sigma_rad * focal_px
        yield from damage.check("yaw", yaw, max(MAX_YAW_PX, expected_px), text)
    pattern = row_pattern(epipolar, result.quality.calibration, offset, damage.rig)
    text = (
        f"row differences of stereo matches vary systematically over the image by {pattern * focal_px:.2f} px,"
        " which no rotation of a camera explains: the distortion or the port is not as calibrated"
    )
    yield from damage.check(ROW_PATTERN, pattern, MAX_ROW_PATTERN_PX, text)


def _consistency(result: SurveyResult, damage: _Damage) -> Iterator[Finding]:
    quality, residual, chi2 = result.quality, result.quality.link_residual, result.quality.link_chi2
    text = f"residuals of points matched between keyframes are {residual or 0:.1f} times their noise"
    yield from _above("link_residual", residual, MAX_LINK_RESIDUAL, text)
    offset = quality.disparity_offset
    if offset is not None and abs(offset.estimate) > SIGNIFICANT * offset.sigma:
        text = (
            "the motions of near and far points imply that all disparities are off by "
            f"{offset.estimate * damage.rig.focal_px:+.2f} px: a principal point or the yaw of a camera is not as"
            " calibrated"
        )
        yield from damage.check("disparity_offset", offset.estimate, MAX_DISPARITY_OFFSET_PX, text)
    if quality.distortion is not None and len(result.keyframe_depth_m):
        yield from _distortion(quality.distortion, damage)
    yield from _scale(quality)
    text = f"the motions between keyframes contradict each other (chi-square {chi2 or 0:.1f}, 1 expected)"
    yield from _above("link_chi2", chi2, MAX_LINK_CHI2, text)
    text = "the last global alignment ended before it converged, so its poses do not fit the motions best"
    yield from _above("alignment", int(not quality.alignment_converged), 0, text)
    if not len(result.keyframe_depth_m):
        return
    depth_m = float(np.median(result.keyframe_depth_m))
    if (sigma_m := quality.frame_sigma_m) is not None:
        text = f"the standard deviation of positions between keyframes reaches {sigma_m * 100:.1f} cm"
        yield from _above("frame_sigma", sigma_m / depth_m, MAX_SIGMA_DEPTHS, text)
    if len(result.node_cov):
        sigma_m = _largest_sigma_m(result, -np.inf)
        text = f"the standard deviation of a keyframe position reaches {sigma_m * 100:.1f} cm"
        yield from _above("sigma", sigma_m / depth_m, MAX_SIGMA_DEPTHS, text)


def _distortion(k1: DistortionError, damage: _Damage) -> list[Finding]:
    """Returns a finding if the motions show a radial distortion that changes disparities d by 2 k1 d, as a yaw does."""
    if abs(k1.estimate) <= SIGNIFICANT * k1.sigma:
        return []
    disparity = damage.rig.baseline_m / float(np.median(damage.result.keyframe_depth_m))
    text = (
        f"the motions between keyframes imply that k1 is off by {k1.estimate:+.3f} +- {k1.sigma:.3f}: the distortion or"
        " the port is not as calibrated"
    )
    return damage.check("distortion", 2 * k1.estimate * disparity, MAX_DISTORTION_PX, text)


def _scale(quality: EstimationQuality) -> list[Finding]:
    """Returns a finding if lengths from the images differ from those of the navigation sensors."""
    # along the optical axis only where the scale across it is right, as the rotation is wrong otherwise
    for check, scale, which, cause in (
        ("length_scale", quality.length_scale, "", "the baseline or the scale of the sensors"),
        ("depth_scale", quality.depth_scale, " along the optical axis", "the baseline or the focal length"),
    ):
        if scale is not None and abs(scale.estimate - 1) > max(MAX_SCALE_ERROR, _SCALE_SIGMAS * scale.sigma):
            ratio = f"{scale.estimate:.3f} +- {scale.sigma:.3f} times those of {scale.sensors}"
            text = f"the lengths{which} from the images are {ratio}: {cause} is not as calibrated"
            return [Finding(check, abs(scale.estimate - 1), MAX_SCALE_ERROR, text)]
    return []


def _median(values: Iterator[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return float(np.median(known)) if known else None
