"""Checks of a flown survey by estimates and plan alone, as for a real one: path kept, and asked area mapped."""

from dataclasses import replace

import numpy as np

from twin.core.height_field import map_height_field, nearest_echo_m
from twin.core.quality import Finding, LengthScale
from twin.core.records import Array, ElevationMap, StereoRig, SurveyResult
from twin.estimate.self_check import MAX_ROW_OFFSET_PX, check_survey
from twin.world.mission import Mission

MIN_AREA_MAPPED = 0.9  # smallest fraction of the asked area that the map may cover
MAX_OFF_COURSE = 0.25  # largest ratio of distance from the planned path to shorter side of the image footprint
_OFF_COURSE_S = 1.0  # shorter departures from the path are ignored
_EXPECTED = 3.0  # largest rotation of the right camera that its calibration leads to expect [standard deviations]


def survey_findings(
    mission: Mission, result: SurveyResult, elevation: ElevationMap | None, reference_m: Array
) -> list[Finding]:
    """Returns reasons not to trust a survey; `reference_m` (n, 3) are planned positions of the left camera [m]."""
    found = check_survey(result, mission.rig, elevation)
    return [*found, *_off_course(mission, result, reference_m), *_area(mission, elevation)]


def with_altimeter_scale(mission: Mission, result: SurveyResult, elevation: ElevationMap | None) -> SurveyResult:
    """Returns a result whose scale along the optical axis is that by the altimeter, if it has been read."""
    # the mean ratio of the distances to the map along the beam of the altimeter to its readings
    quality, beam_deg = result.quality, mission.scenario.navigation.altimeter_beam_deg
    if elevation is None or not np.isfinite(elevation.height_m).any():
        return result
    floor, poses = map_height_field(elevation.height_m, elevation.grid), result.final.world_from_camera
    ratios = [nearest_echo_m(floor, poses[row], beam_deg) / read_m for row, read_m in quality.altimeter_m.items()]
    known = np.array(ratios)[np.isfinite(ratios)]
    if len(known) < 2:
        return result
    scale = LengthScale(float(known.mean()), float(known.std(ddof=1) / np.sqrt(len(known))), "the altimeter")
    return replace(result, quality=quality._replace(depth_scale=scale))


def calibration_notes(result: SurveyResult, rig: StereoRig) -> list[str]:
    """Returns a sentence on the rectification errors that were removed, if they exceed those stated for the rig."""
    epipolar = result.quality.epipolar
    if epipolar is None or not epipolar.removed.any():
        return []
    pitch, _, roll = np.rad2deg(epipolar.removed[:3])
    shift_px = rig.focal_px * epipolar.removed[3]
    expected_deg = _EXPECTED * np.rad2deg(rig.yaw_sigma_rad)
    if max(abs(pitch), abs(roll)) <= expected_deg and abs(shift_px) <= MAX_ROW_OFFSET_PX:
        return []
    return [
        f"The right camera is misaligned: a pitch of {pitch:+.3f} deg, a roll of {roll:+.3f} deg and a row offset of"
        f" {shift_px:+.2f} px were estimated and removed."
    ]


def off_course_limit_m(mission: Mission) -> float:
    """Returns the distance from the planned path beyond which a survey is degraded [m]."""
    return mission.scenario.control.off_course_m or MAX_OFF_COURSE * min(mission.plan.request.footprint_m)


def _off_course(mission: Mission, result: SurveyResult, reference_m: Array) -> list[Finding]:
    n = min(len(result.online), len(reference_m))
    limit_m = off_course_limit_m(mission)
    distance_m = np.linalg.norm(result.online.positions[:n] - reference_m[:n], axis=1)
    n_long = max(1, round(_OFF_COURSE_S * mission.rig.frame_rate_hz))
    if n < n_long:
        return []
    lasting_m = float(np.lib.stride_tricks.sliding_window_view(distance_m, n_long).min(axis=1).max())
    if lasting_m <= limit_m:
        return []
    text = f"the vehicle was {lasting_m:.2f} m off the planned path for {_OFF_COURSE_S:g} s ({limit_m:.2f} m allowed)"
    return [Finding("off_course", lasting_m, limit_m, text)]


def _area(mission: Mission, elevation: ElevationMap | None) -> list[Finding]:
    """Returns a finding if the map covers less than `MIN_AREA_MAPPED` of an asked area that has any cell centre."""
    asked = mission.asked(*np.meshgrid(*mission.grid.centres()))
    if not asked.any():
        return []
    mapped = 0.0 if elevation is None else float(np.isfinite(elevation.height_m[asked]).mean())
    if mapped >= MIN_AREA_MAPPED:
        return []
    return [Finding("area_mapped", mapped, MIN_AREA_MAPPED, f"only {100 * mapped:.0f} % of the asked area is mapped")]
