"""Loop plans: closed loops, coverage of the disc, speed and acceleration limits."""

import numpy as np
import pytest
from scipy.integrate import cumulative_trapezoid

from twin.controllers import loops
from twin.controllers.forecast import forecast, least_clearance
from twin.controllers.survey_plan import SurveyRequest
from twin.errors import TwinError

REQUEST = {
    "area_m": (10.0, 10.0),
    "altitude_m": 3.353,
    "speed_mps": 0.61,
    "overlap_along": 0.9,
    "overlap_across": 0.8,
    "tracks": 0,
    "image_width_px": 320,
    "image_height_px": 240,
    "focal_px": 160 / np.tan(np.deg2rad(25)),
    "frame_rate_hz": 30.0,
}


def plan(**changes):
    return loops.plan(SurveyRequest(**REQUEST | changes))


def sample_reference(p, track, n=20001):
    """Returns times (n,), positions, velocities and accelerations (n, 3) of the reference along a track."""
    t = np.linspace(0, p.track_duration_s(track), n)
    references = [p.reference(track, s) for s in t]
    return t, *(np.array([getattr(r, k) for r in references]) for k in ("position", "velocity", "acceleration"))


def test_every_loop_begins_and_ends_at_rest_at_the_start_point_and_reaches_the_rim():
    p = plan()
    for track in range(1, p.n_tracks + 1):
        duration_s = p.track_duration_s(track)
        for time_s in (-1.0, 0.0, duration_s, duration_s + 9.0):
            r = p.reference(track, time_s)
            np.testing.assert_allclose(r.position, [0, 0, 3.353], atol=1e-12)
            np.testing.assert_allclose(r.velocity, 0, atol=1e-12)
        assert np.linalg.norm(p.reference(track, duration_s / 2).position[:2]) == pytest.approx(5.0)
        assert np.linalg.norm(p.waypoints(track)[:, :2], axis=1).max() == pytest.approx(5.0)


def test_the_bow_points_east_and_the_altitude_is_constant():
    p = plan()
    references = [p.reference(2, t) for t in np.linspace(0, p.track_duration_s(2), 50)]
    assert {r.yaw for r in references} == {0.0}
    assert {round(float(r.position[2]), 12) for r in references} == {3.353}


@pytest.mark.parametrize("diameter_m", [0.3, 1.0, 4.0, 10.0, 33.0])
@pytest.mark.parametrize("overlap", [0.1, 0.5, 0.8])
def test_the_distance_of_neighbouring_loops_is_within_the_required_sidelap(diameter_m, overlap):
    p = plan(area_m=(diameter_m, diameter_m), overlap_across=overlap)
    here, there = p.waypoints(1)[:, :2], p.waypoints(2)[:, :2]
    to_next = np.linalg.norm(here[:, None] - there, axis=2).min(axis=1)
    # the waypoints are 2 degrees apart: a chord is within 1.5e-4 radii of the circle
    assert to_next.max() == pytest.approx(p.swath_spacing_m, rel=1e-3, abs=1e-3 * diameter_m)
    max_spacing_m = (1 - overlap) * min(p.request.footprint_m)
    assert p.swath_spacing_m <= max_spacing_m * (1 + 1e-9)
    fewer = p.n_tracks - 1
    assert fewer < 2 or diameter_m / 2 * np.sin(np.pi / fewer) > max_spacing_m  # one loop fewer is not enough


@pytest.mark.parametrize("diameter_m", [0.3, 2.5, 10.0])
@pytest.mark.parametrize("overlap", [0.05, 0.3, 0.8])
def test_the_images_at_keyframes_cover_the_disc(diameter_m, overlap):
    p = plan(area_m=(diameter_m, diameter_m), overlap_across=overlap)
    keys = [
        p.reference(track, time_s).position[:2]
        for track in range(1, p.n_tracks + 1)
        for time_s, is_keyframe in zip(*p.frames_of_track(track), strict=True)
        if is_keyframe
    ]
    angle, fraction = np.random.default_rng(0).uniform(0, [2 * np.pi, 1], (2000, 2)).T
    disc = diameter_m / 2 * np.sqrt(fraction)[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    off = np.abs(disc[:, None] - np.array(keys)) / (
        np.array(p.request.footprint_m[::-1]) / 2
    )  # the image height lies along x
    assert (off.max(axis=2).min(axis=1) <= 1).all()


@pytest.mark.parametrize("diameter_m", [1.0, 10.0, 30.0])
def test_speed_and_acceleration_are_within_their_limits_on_every_loop(diameter_m):
    p = plan(area_m=(diameter_m, diameter_m))
    _, _, velocity, acceleration = sample_reference(p, 1, 4001)
    fastest = np.linalg.norm(velocity, axis=1).max()
    assert fastest <= 0.61 * (1 + 1e-9)
    assert np.linalg.norm(acceleration, axis=1).max() <= 0.2 * (1 + 1e-9)
    assert fastest == pytest.approx(p.speed_mps)
    # v^2 / r = a / sqrt(2) with r = D / 4: full speed requires D = 10.5 m
    assert p.speed_mps == pytest.approx(min(0.61, np.sqrt(diameter_m / 4 * 0.2 / np.sqrt(2))))


def test_the_reference_is_the_integral_of_its_own_velocity_and_acceleration():
    p = plan()
    t, position, velocity, acceleration = sample_reference(p, 3)
    step = t[1]
    # error of the trapezoidal rule: half a time step times the step in acceleration (0.2) at each of 4 discontinuities,
    # and T h^2 / 12 times the second derivative elsewhere, about 1e-7
    np.testing.assert_allclose(cumulative_trapezoid(velocity, t, axis=0), position[1:] - position[0], atol=1e-5)
    np.testing.assert_allclose(cumulative_trapezoid(acceleration, t, axis=0), velocity[1:], atol=4 * 0.2 * step / 2)
    assert p.track_length_m(3) == pytest.approx(np.linalg.norm(np.diff(position, axis=0), axis=1).sum(), rel=1e-6)
    assert p.track_length_m(3) == pytest.approx(5 * np.pi)


def test_fewer_loops_are_the_first_loops_of_the_full_survey_and_plans_are_reproducible():
    whole, part = plan(), plan(tracks=3)
    assert part.paths == whole.paths[:3] and part.swath_spacing_m == whole.swath_spacing_m
    assert plan() == whole


def test_a_slower_loop_has_the_required_overlap_of_keyframes():
    tight = forecast(plan(area_m=(2.0, 2.0)), 0.3, 0.2)
    assert tight.speed_mps < 0.3
    assert tight.keyframe_spacing_m <= 0.1 * tight.footprint_m[0] * 1.05  # N is a whole number
    assert tight.n_frames_per_keyframe > forecast(plan(), 0.3, 0.2).n_frames_per_keyframe


def test_the_forecast_counts_the_frames_and_keyframes_of_the_plan():
    p = plan(tracks=2)
    numbers = forecast(p, 0.3048, 0.2)
    assert numbers.path_m == pytest.approx(2 * np.pi * 5)
    assert numbers.n_frames == sum(len(p.frames_of_track(t)[0]) for t in (1, 2))
    # M assumes cruise speed; each ramp of 0.59 / 0.14 s takes twice as long as at cruise speed; plus start and end
    assert numbers.n_keyframes / 2 == pytest.approx(numbers.keyframes_per_swath + 0.595 / 0.141 * 30 / 16 + 2, abs=1.5)
    assert numbers.overlap_across == pytest.approx(1 - p.swath_spacing_m / p.request.footprint_m[1])  # the shorter side


def test_clearance_ignores_the_corners_of_the_square_but_not_the_inside_of_a_loop():
    p = plan(overlap_across=0.3)

    def pinnacle(x0, y0):
        return lambda x, y: np.where(np.hypot(x - x0, y - y0) < 0.1, 3.0, 0.0)

    # the corner of an image at the rim reaches 5 (cos, sin) + (1.17, 1.56)
    assert least_clearance(p, pinnacle(5.2, 5.2)).least_m == pytest.approx(3.353)
    assert least_clearance(p, pinnacle(4.6, 4.9)).least_m == pytest.approx(0.353)
    assert least_clearance(p, pinnacle(0.9, -2.1)).least_m == pytest.approx(0.353)
    assert least_clearance(p, lambda x, y: np.zeros_like(x)).inside
    assert not least_clearance(p, lambda x, y: np.where(y > 4.8, np.nan, 0.0)).inside


def test_clearance_covers_the_whole_loop_where_its_waypoints_are_farther_apart_than_an_image():
    p = plan(area_m=(200.0, 200.0), altitude_m=0.5, tracks=1)  # waypoints 1.7 m apart, images 0.35 x 0.47 m

    def ridge(x, y):  # crosses the loop, of radius 50 m about (50, 0), at its sides, where it runs along y
        return np.where(np.abs(y - 0.87) < 0.1, 0.3, 0.0)

    assert least_clearance(p, ridge).least_m == pytest.approx(0.2)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            {"area_m": (10.0, 8.0)},
            "plan.area_m: 10 x 8 m: loops need a square area (allowed: the disc's diameter for both, as in [8, 8])",
        ),
        ({"tracks": 35}, "plan.tracks: 35 is too many: 34 fill the area at this overlap (allowed: 0 to 34)"),
        ({"altitude_m": 0.0}, "plan.altitude_m: the camera has no footprint (allowed: above 0)"),
        ({"overlap_across": 1.0}, "plan.overlap_across: 1 (allowed: between 0 and 1, both excluded)"),
        (
            {"frame_rate_hz": 0.1},
            "plan.speed_mps: 0.594604 is too fast: less than one frame per keyframe (allowed: below 0.0625)",
        ),
    ],
)
def test_loops_that_cannot_be_flown_are_rejected_with_their_scenario_key(change, message):
    with pytest.raises(TwinError) as caught:
        plan(**change)
    assert str(caught.value) == message
