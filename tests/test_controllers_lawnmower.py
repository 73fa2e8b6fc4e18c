"""Lawnmower plans: the paper's formulas, coverage of the area, speed and acceleration limits."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import cumulative_trapezoid

from twin.controllers import lawnmower
from twin.controllers.forecast import forecast, least_clearance
from twin.controllers.survey_plan import SurveyRequest
from twin.errors import TwinError

PAPER = {
    "area_m": (30.48, 30.48),
    "altitude_m": 3.353,
    "speed_mps": 0.61,
    "overlap_along": 0.9,
    "overlap_across": 0.8,
    "tracks": 25,
    "image_width_px": 640,
    "image_height_px": 480,
    "focal_px": 320 / np.tan(np.deg2rad(25)),
    "frame_rate_hz": 30.0,
}
SMALL = PAPER | {"area_m": (4.0, 3.0), "altitude_m": 2.0, "speed_mps": 0.3, "tracks": 0}


def plan(**request):
    return lawnmower.plan(SurveyRequest(**request))


def test_the_paper_mission_has_the_figures_of_the_paper():
    numbers = forecast(plan(**PAPER), baseline_m=0.3048, disparity_sigma_px=0.2)
    assert numbers.n_frames_per_keyframe == 15
    assert numbers.n_tracks == 25
    assert 0.60 < numbers.swath_spacing_m < 0.63  # 2 ft
    assert numbers.keyframes_per_swath == 100
    assert numbers.n_tracks == pytest.approx(numbers.keyframes_per_swath / 4, abs=1)  # L = M/4
    assert 25 * 204 == pytest.approx(numbers.n_keyframes, rel=0.12)  # this plan also stops at every corner
    assert numbers.disparity_px == pytest.approx(686.24 * 0.3048 / 3.353, rel=1e-4)
    assert numbers.depth_sigma_m == pytest.approx(3.353 / numbers.disparity_px * 0.2)


def test_25_tracks_fill_the_area_of_the_paper():
    paper = plan(**PAPER)
    assert replace(plan(**PAPER | {"tracks": 0}), request=paper.request) == paper


@pytest.mark.parametrize("width_m", [0.2, 1.0, 2.9, 3.0, 7.7, 30.48])
@pytest.mark.parametrize("overlap", [0.3, 0.8])
def test_swaths_have_the_required_sidelap_and_cover_the_area(width_m, overlap):
    p = plan(**SMALL | {"area_m": (4.0, width_m), "overlap_across": overlap})
    legs = np.array([p.waypoints(t)[k, 1] for t in range(1, p.n_tracks + 1) for k in (0, 2)])
    assert np.all(np.diff(legs) > 0)
    np.testing.assert_allclose(legs, -legs[::-1], atol=1e-12)  # centred
    assert np.diff(legs).max() <= (1 - overlap) * p.request.footprint_m[0] * (1 + 1e-9)
    assert legs[0] - p.request.footprint_m[0] / 2 <= -width_m / 2


def test_fewer_tracks_are_the_first_tracks_of_the_full_survey():
    whole, part = plan(**PAPER), plan(**PAPER | {"tracks": 2})
    np.testing.assert_array_equal(part.waypoints(1), whole.waypoints(1))
    np.testing.assert_array_equal(part.waypoints(2), whole.waypoints(2)[:4])  # the last track ends after its return leg


def test_the_survey_starts_in_the_south_west_and_its_tracks_are_connected():
    p = plan(**SMALL)
    np.testing.assert_allclose(p.waypoints(1)[0], [-2, -1.5 + p.swath_spacing_m / 2, 2.0])
    assert p.reference(1, 1.0).velocity[0] > 0
    for track in range(1, p.n_tracks):
        end = p.reference(track, p.track_duration_s(track))
        np.testing.assert_allclose(end.position, p.reference(track + 1, 0.0).position, atol=1e-12)
        np.testing.assert_allclose(end.velocity, 0, atol=1e-12)


def test_the_reference_is_the_integral_of_its_own_velocity_and_acceleration():
    p = plan(**SMALL)
    t = np.linspace(0, p.track_duration_s(1), 8001)
    references = [p.reference(1, s) for s in t]
    position, velocity, acceleration = (
        np.array([getattr(r, k) for r in references]) for k in ("position", "velocity", "acceleration")
    )
    assert np.linalg.norm(velocity, axis=1).max() == pytest.approx(0.3)
    assert np.linalg.norm(acceleration, axis=1).max() == pytest.approx(p.request.acceleration_mps2)
    # error of the trapezoidal rule: half a time step times the step in acceleration, at each of 14 discontinuities
    step = t[1]
    np.testing.assert_allclose(cumulative_trapezoid(velocity, t, axis=0), position[1:] - position[0], atol=0.3 * step)
    np.testing.assert_allclose(cumulative_trapezoid(acceleration, t, axis=0), velocity[1:], atol=14 * 0.2 * step)
    assert p.track_length_m(1) == pytest.approx(np.linalg.norm(np.diff(position, axis=0), axis=1).sum(), rel=1e-6)


def test_before_and_after_a_track_the_reference_is_at_rest_at_its_ends():
    p = plan(**SMALL)
    for time_s, corner in ((-1.0, 0), (1e4, -1)):
        r = p.reference(1, time_s)
        np.testing.assert_allclose(r.position, p.waypoints(1)[corner], atol=1e-12)
        assert not r.velocity.any() and not r.acceleration.any()


def test_the_forecast_has_the_overlap_along_the_image_height_and_the_sidelap_along_its_width():
    p = plan(**PAPER)
    numbers = forecast(p, 0.3048, 0.2)
    height_m = 480 * 3.353 / PAPER["focal_px"]
    assert numbers.overlap_along == pytest.approx(1 - 15 * 0.61 / 30 / height_m)
    assert numbers.overlap_across >= 0.8


def test_clearance_is_at_the_highest_point_in_view():
    p = plan(**SMALL)

    def pinnacle(x, y):
        return 1.2 * np.exp(-((x - 0.31) ** 2 + (y + 0.44) ** 2) / 0.02)

    clearance = least_clearance(p, pinnacle)
    assert clearance.inside
    assert clearance.least_m == pytest.approx(0.8, abs=0.01)  # a sample is within 1.4 cm of the summit
    assert (clearance.x_m, clearance.y_m) == pytest.approx((0.31, -0.44), abs=0.02)


def test_clearance_ignores_the_floor_out_of_view_and_reports_a_path_outside_the_terrain():
    p = plan(**SMALL)
    out_of_view = least_clearance(p, lambda x, y: np.where(x > 2.75, 1.9, 0.0))  # 2 m + half of 1.4 m
    assert out_of_view.least_m == pytest.approx(2.0)
    assert not least_clearance(p, lambda x, y: np.where(np.abs(x) < 1.5, 0.1, np.nan)).inside
    assert least_clearance(p, lambda x, y: np.where(np.abs(x) < 1.5, 0.1, np.nan)).least_m == pytest.approx(1.9)


@pytest.mark.parametrize(
    ("change", "field", "message"),
    [
        (
            {"speed_mps": 60.0},
            "plan.speed_mps",
            "plan.speed_mps: 60 is too fast: less than one frame per keyframe (allowed: below ",
        ),
        ({"altitude_m": 0.0}, "plan.altitude_m", "plan.altitude_m: the camera has no footprint (allowed: above 0)"),
        ({"focal_px": np.inf}, "rig.hfov_deg", "rig.hfov_deg: the camera has no footprint (allowed: above 0)"),
        (
            {"overlap_along": 1.0},
            "plan.overlap_along",
            "plan.overlap_along: 1 (allowed: between 0 and 1, both excluded)",
        ),
        ({"overlap_across": 0.0}, "plan.overlap_across", "plan.overlap_across: 0 (allowed: between 0 and 1"),
        ({"area_m": (4.0, -1.0)}, "plan.area_m", "plan.area_m: -1 (allowed: above 0)"),
        (
            {"tracks": 26},
            "plan.tracks",
            "plan.tracks: 26 is too many: 25 fill the area at this overlap (allowed: 0 to 25)",
        ),
    ],
)
def test_a_plan_that_cannot_be_flown_is_rejected_with_its_scenario_key(change, field, message):
    with pytest.raises(TwinError) as caught:
        plan(**PAPER | change)
    assert caught.value.field == field
    assert str(caught.value).startswith(message)


def test_a_speed_just_below_the_reported_limit_is_accepted():
    with pytest.raises(TwinError) as caught:
        plan(**PAPER | {"speed_mps": 60.0})
    limit_mps = float(caught.value.allowed.removeprefix("below "))
    assert plan(**PAPER | {"speed_mps": limit_mps * 0.99}).n_frames_per_keyframe == 1
