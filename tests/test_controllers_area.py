"""Survey areas: centre, heading, polygons and turns of a plan; their laws and closed forms."""

from dataclasses import replace

import numpy as np
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import cumulative_trapezoid

from twin.controllers import lawnmower, loops
from twin.controllers.camera_surface import surface_above_floor
from twin.controllers.forecast import least_clearance
from twin.controllers.segments import Turn
from twin.controllers.survey_area import SurveyArea, polygons_area
from twin.controllers.survey_plan import TURN_PER_KEYFRAME, TURN_RATE, SurveyRequest
from twin.errors import TwinError

REQUEST = {
    "area_m": (4.0, 3.0),
    "altitude_m": 2.0,
    "speed_mps": 0.3,
    "overlap_along": 0.9,
    "overlap_across": 0.8,
    "tracks": 0,
    "image_width_px": 320,
    "image_height_px": 240,
    "focal_px": 277.0,
    "frame_rate_hz": 30.0,
}
L_SHAPE = [(0.0, 0.0), (3.0, 0.0), (3.0, 1.0), (1.0, 1.0), (1.0, 2.5), (0.0, 2.5)]
SPIKE = [(-2.0, -1.0), (2.0, -0.9), (-1.0, 0.1), (2.5, 1.5), (-1.8, 1.2)]  # not convex, with shallow tips


def plan(area=None, **changes):
    request = REQUEST | changes | ({} if area is None else {"area": area, "area_m": area.size_m})
    return lawnmower.plan(SurveyRequest(**request))


def rectangle(size_m=(4.0, 3.0), centre_m=(0.0, 0.0), heading_deg=0.0):
    return SurveyArea("rectangle", size_m, centre_m, np.deg2rad(heading_deg))


def polygon_area(corners, heading):
    return polygons_area([[corners]], heading)


def legs_of(p):
    """Returns the end points (n, 2, 2) of the legs of a plan, in the axes of the legs."""
    tracks = [np.column_stack(p.area.to_legs(*p.waypoints(t)[:, :2].T)) for t in range(1, p.n_tracks + 1)]
    return np.array([points[k : k + 2] for points in tracks for k in (0, 2)])


TWO_PARTS = [
    [[(-3.0, -3.0), (0.0, -3.0), (0.0, -1.5), (-3.0, -1.5)]],
    [[(-1.0, 0.5), (3.0, 0.5), (3.0, 3.0), (-1.0, 3.0)], [(0.0, 1.0), (2.0, 1.0), (2.0, 2.5), (0.0, 2.5)]],
]


def distance_to_legs(u, v, legs):
    """Returns the distance of each point to the nearest leg; the legs run along u."""
    low, high = legs[..., 0].min(axis=1), legs[..., 0].max(axis=1)
    beyond = np.maximum(0, np.maximum(low - u[:, None], u[:, None] - high))
    return np.hypot(beyond, v[:, None] - legs[:, 0, 1]).min(axis=1)


def test_an_unturned_rectangle_gives_the_default_plan_exactly():
    default = plan()
    assert replace(plan(rectangle()), request=default.request) == default


@given(st.floats(-360, 360), st.floats(-50, 50), st.floats(-50, 50))
def test_scene_and_legs_are_inverse_and_keep_distances(heading_deg, x, y):
    area = rectangle(centre_m=(3.0, -2.0), heading_deg=heading_deg)
    u, v = area.to_legs(x, y)
    assert np.hypot(u, v) == pytest.approx(np.hypot(x - 3, y + 2), abs=1e-9)
    assert area.to_scene(u, v) == (pytest.approx(x, abs=1e-9), pytest.approx(y, abs=1e-9))


@pytest.mark.parametrize("pattern", [lawnmower, loops])
def test_a_heading_of_90_deg_turns_the_path_and_the_bow_exactly(pattern):
    size = (4.0, 3.0) if pattern is lawnmower else (3.0, 3.0)
    shape = "rectangle" if pattern is lawnmower else "disc"
    area = SurveyArea(shape, size, (0, 0), np.pi / 2)
    turned = pattern.plan(SurveyRequest(**REQUEST | {"area_m": size, "area": area}))
    straight = pattern.plan(SurveyRequest(**REQUEST | {"area_m": size}))
    time = np.linspace(0, straight.track_duration_s(1), 50)
    a, b = straight.references(1, time), turned.references(1, time)
    quarter = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1.0]])
    for name in ("position", "velocity", "acceleration"):
        np.testing.assert_allclose(getattr(b, name), getattr(a, name) @ quarter.T, atol=1e-12)
    np.testing.assert_allclose(b.yaw, np.asarray(a.yaw) + np.pi / 2)
    x, y = np.random.default_rng(0).uniform(-3, 3, (2, 500))
    np.testing.assert_array_equal(turned.inside_area(-y, x), straight.inside_area(x, y))


def test_the_centre_moves_the_path():
    moved = plan(rectangle(centre_m=(10.0, -5.0)))
    np.testing.assert_allclose(moved.outline(), plan().outline() + [10.0, -5.0, 0.0], atol=1e-12)


@pytest.mark.parametrize("corners", [L_SHAPE, SPIKE, SPIKE[::-1]])
@pytest.mark.parametrize("heading_deg", [0.0, 37.0, 90.0, -160.0])
def test_every_point_of_a_polygon_lies_within_half_a_spacing_of_a_leg(corners, heading_deg):
    p = plan(polygon_area(corners, np.deg2rad(heading_deg)))
    x, y = np.random.default_rng(0).uniform(-3, 3, (2, 4000))
    inside = p.inside_area(x, y)
    assert 300 < inside.sum() < 2500
    distance = distance_to_legs(*p.area.to_legs(x[inside], y[inside]), legs_of(p))
    assert distance.max() <= p.swath_spacing_m / 2 + 1e-9


@pytest.mark.parametrize("heading_deg", [0.0, 30.0])
def test_an_area_of_two_parts_with_a_hole_is_that_of_shapely_and_its_legs_fill_both_parts(heading_deg):
    area = polygons_area(TWO_PARTS, np.deg2rad(heading_deg))
    x, y = np.meshgrid(np.arange(-400, 400) * 0.01 + 0.005, np.arange(-400, 400) * 0.01 + 0.005)
    inside = area.contains(x, y)
    truth = shapely.MultiPolygon([(outline, holes) for outline, *holes in TWO_PARTS])
    assert inside.sum() * 1e-4 == pytest.approx(truth.area, rel=1e-3) and truth.area == 4.5 + 10 - 3
    np.testing.assert_array_equal(inside[::40, ::40], shapely.contains_xy(truth, x, y)[::40, ::40])
    assert [len(ring) for ring in area.outlines()] == [5, 5, 5]
    p = plan(area)
    legs = legs_of(p)
    distance = distance_to_legs(*area.to_legs(x[inside][::7], y[inside][::7]), legs)
    assert distance.max() <= p.swath_spacing_m / 2 + 1e-9
    if heading_deg == 0:  # no leg between the parts
        assert len(area.bands()) == 2
        assert not ((legs[:, 0, 1] > -1.4 - area.centre_m[1]) & (legs[:, 0, 1] < 0.4 - area.centre_m[1])).any()


def test_parts_that_touch_or_overlap_are_one():
    touching = polygons_area([[L_SHAPE], [[(3.0, 0.0), (4.0, 0.0), (4.0, 1.0), (3.0, 1.0)]]], 0.0)
    assert len(touching.outlines()) == 1 and touching.contains(3.0, 0.5)
    overlapping = polygons_area([[L_SHAPE], [[(2.0, 0.2), (4.0, 0.2), (4.0, 0.8), (2.0, 0.8)]]], 0.0)
    assert len(overlapping.outlines()) == 1 and overlapping.size_m == (4.0, 2.5)


def test_a_hole_outside_its_polygon_is_rejected():
    with pytest.raises(TwinError, match="Hole lies outside shell"):
        polygons_area([[L_SHAPE, [(5.0, 5.0), (6.0, 5.0), (6.0, 6.0)]]], 0.0)


@pytest.mark.parametrize("corners", [L_SHAPE, SPIKE])
def test_legs_end_within_one_and_a_half_spacings_of_the_polygon(corners):
    p = plan(polygon_area(corners, np.deg2rad(20)))
    outline = np.column_stack(p.area.to_legs(*p.area.outline().T))
    dense = np.concatenate([np.linspace(a, b, 400) for a, b in zip(outline[:-1], outline[1:], strict=True)])
    ends = legs_of(p).reshape(-1, 2)
    along, across = np.moveaxis(np.abs(ends[:, None] - dense[None]), -1, 0)
    to_polygon = np.where(along < 0.02, across, np.inf)  # points of the outline are 2 cm apart or less
    assert to_polygon.min(axis=1).max() <= 1.5 * p.swath_spacing_m + 0.02


def test_segments_between_legs_are_perpendicular_to_them():
    p = plan(polygon_area(SPIKE, 0.0))
    steps = np.diff(p.outline()[:, :2], axis=0)
    assert (np.abs(steps).min(axis=1) < 1e-12).all()


def test_a_rectangle_given_as_a_polygon_has_the_same_legs():
    corners = [(-2, -1.5), (2, -1.5), (2, 1.5), (-2, 1.5), (-2, -1.5)]
    np.testing.assert_allclose(plan(polygon_area(corners, 0.0)).outline(), plan().outline(), atol=1e-12)


def test_the_area_of_a_polygon_is_that_of_the_shoelace_formula():
    x, y = np.array(SPIKE).T
    shoelace = abs(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1))) / 2
    points = np.stack(np.meshgrid(np.arange(-3, 3, 0.01), np.arange(-3, 3, 0.01)))
    assert polygon_area(SPIKE, 0.7).contains(*points).sum() * 1e-4 == pytest.approx(shoelace, rel=2e-3)


@pytest.mark.parametrize(
    ("corners", "problem"),
    [
        ([(0, 0), (1, 1), (1, 0), (0, 1)], r"Self-intersection\[0.5 0.5\]"),
        ([(0, 0), (2, 0), (1, 0), (1, 1)], "is not simple"),  # turns back on itself
        ([(0, 0), (2, 2), (1, 1)], "is not simple"),  # without an area
        ([(0, 0), (2, 0), (2, 2), (1, 0), (0, 2)], "is not simple"),  # touches an edge
        ([(0, 0), (1, 0), (0, 0)], "2 corners"),
        ([(0, 0), (1, 0), (1, 1e-5)], "is 1 x 1e-05 m large"),
        ([(0, 0), (1, 0), (np.inf, 1)], "not finite"),
    ],
)
def test_a_polygon_that_is_not_simple_is_rejected(corners, problem):
    with pytest.raises(TwinError, match=problem) as caught:
        polygon_area(corners, 0.0)
    assert caught.value.field == "plan.polygon" and caught.value.allowed


def test_the_edges_and_a_repeated_corner_belong_to_a_polygon():
    area = polygon_area([(0, 0), (2, 0), (2, 0), (2, 2), (0, 2)], 0.0)
    assert area.contains([0, 1, 2, 2], [1, 0, 1, 2]).all() and not area.contains(2.001, 1)


def test_an_edge_beyond_the_end_of_another_does_not_intersect_it():
    corners = [(0, 0), (2, 2), (1.2, 2.6), (1.5, 2.8), (3.2, 1.5), (3.2, 0)]  # the line of edge 1 crosses edge 4
    assert polygon_area(corners, 0.0).contains(2.2, 2.0)


def test_fewer_tracks_have_to_cover_their_own_strip_only():
    p = plan(tracks=1)
    y = np.linspace(-1.5, 1.5, 301)
    np.testing.assert_array_equal(p.inside_area(np.zeros(301), y), y <= -1.5 + 2 * p.swath_spacing_m + 1e-9)
    assert plan().inside_area(np.zeros(301), y).all() and not plan().inside_area(2.01, 0.0)


def test_bow_first_flies_every_leg_forwards_and_turns_at_rest():
    p = plan(rectangle(heading_deg=30), turns="bow_first")
    ends = []
    for track in range(1, p.n_tracks + 1):
        times, keyframe = p.frames_of_track(track)
        reference = p.references(track, times)
        speed = np.linalg.norm(reference.velocity, axis=1)
        bow = np.column_stack([np.cos(reference.yaw), np.sin(reference.yaw)])
        along = np.einsum("ni,ni->n", bow, reference.velocity[:, :2])
        axis = np.array([np.cos(np.pi / 6), np.sin(np.pi / 6)])
        on_leg = np.abs(reference.velocity[:, :2] @ axis) > 1e-6
        np.testing.assert_allclose(along[on_leg], speed[on_leg], atol=1e-9)
        turning = np.abs(np.diff(reference.yaw)) > 1e-9
        assert speed[1:][turning & (speed[:-1] == 0)].max() < 0.01  # the next segment starts from rest
        assert np.abs(np.diff(reference.yaw)).max() <= TURN_RATE / p.request.frame_rate_hz + 1e-9
        assert np.abs(np.diff(np.asarray(reference.yaw)[keyframe])).max() <= TURN_PER_KEYFRAME + 1e-9
        ends.append((reference.yaw[0], reference.yaw[-1]))
    assert all(a[1] == pytest.approx(b[0]) for a, b in zip(ends[:-1], ends[1:], strict=True))
    np.testing.assert_allclose(p.outline(), plan(rectangle(heading_deg=30)).outline())


def test_turns_alternate_so_that_a_tether_is_not_twisted():
    p = plan(turns="bow_first")
    turns = [segment for path in p.paths for segment in path if isinstance(segment, Turn)]
    assert [turn.sense for turn in turns] == [(-1.0) ** k for k in range(2 * p.n_tracks - 1)]
    assert p.track_length_m(1) == pytest.approx(plan().track_length_m(1))
    assert p.track_duration_s(1) == pytest.approx(plan().track_duration_s(1) + 2 * (180 / 15 + 1))  # trapezoid


@pytest.mark.parametrize("change", [{"turns": "bow_first"}, {"cross_lines": 2}])
def test_loops_have_no_turns_and_no_cross_lines(change):
    with pytest.raises(TwinError, match="no effect on loops") as caught:
        loops.plan(SurveyRequest(**REQUEST | {"area_m": (3.0, 3.0)} | change))
    assert caught.value.field == f"plan.{next(iter(change))}"


@pytest.mark.parametrize("n", [1, 2, 3])
@pytest.mark.parametrize("changes", [{}, {"tracks": 1}, {"turns": "bow_first"}])
def test_cross_lines_are_flown_after_the_legs_at_equal_distances_over_all_of_them(n, changes):
    area = rectangle(heading_deg=30)
    without, p = plan(area, **changes), plan(area, cross_lines=n, **changes)
    assert p.paths[:-1] == without.paths and p.cross_track == p.n_tracks == without.n_tracks + 1
    corners = np.column_stack(area.to_legs(*p.waypoints(p.n_tracks)[:, :2].T))
    steps = np.diff(corners, axis=0)
    assert (np.abs(steps).min(axis=1) < 1e-9).all()  # along or across the legs
    lines = corners[:-1][np.abs(steps[:, 1]) > 1e-9]
    np.testing.assert_allclose(lines[:, 0], (np.arange(n) + 0.5) / n * 4.0 - 2.0, atol=1e-9)
    legs_v = legs_of(without)[:, 0, 1]
    np.testing.assert_allclose(np.abs(steps[np.abs(steps[:, 1]) > 1e-9, 1]), np.ptp(legs_v), atol=1e-9)
    last, first = p.reference(p.n_tracks - 1, 1e6), p.reference(p.n_tracks, 0.0)
    np.testing.assert_allclose(first.position, last.position, atol=1e-9)
    times, _ = p.frames_of_track(p.n_tracks)
    np.testing.assert_allclose(np.asarray(p.references(p.n_tracks, times).yaw), last.yaw)
    x, y = np.random.default_rng(0).uniform(-3, 3, (2, 500))
    np.testing.assert_array_equal(p.inside_area(x, y), without.inside_area(x, y))


@pytest.mark.parametrize("follows", [False, True])
def test_cross_lines_may_be_flown_higher_than_the_legs(follows):
    """The camera rises where the legs end; positions are the integral of velocities, and these of accelerations."""
    surface = surface_above_floor(lambda x, y: 0.2 * np.sin(x), rectangle(), 0.05, 2.0, (1.5, 2.0), (0.5, 2.0))
    changes = {"cross_lines": 2, "altitude_m": 2.0} | ({"surface": surface} if follows else {})
    level, p = plan(**changes), plan(**changes, cross_rise_m=0.5)
    last = p.n_tracks
    assert p.paths[:-1] == level.paths[:-1] and p.paths[-1][0].direction == (0.0, 0.0, 1.0)
    np.testing.assert_allclose(p.waypoints(last)[0], level.waypoints(last)[0])
    np.testing.assert_allclose(p.waypoints(last)[1:], level.waypoints(last) + [0, 0, 0.5])
    times, _ = p.frames_of_track(last)
    at = p.references(last, times)
    for value, rate, tolerance in ((at.position, at.velocity, 2e-3), (at.velocity, at.acceleration, 0.02)):
        integral = value[0] + cumulative_trapezoid(rate, times, axis=0, initial=0)
        np.testing.assert_allclose(integral, value, atol=tolerance)


def test_cross_lines_of_a_polygon_span_the_legs_that_they_cross():
    p = plan(polygon_area(L_SHAPE, 0.0), cross_lines=3)
    corners = np.column_stack(p.area.to_legs(*p.waypoints(p.n_tracks)[:, :2].T)) + p.area.centre_m
    x = corners[:-1, 0][np.abs(np.diff(corners[:, 1])) > 1e-9]
    np.testing.assert_allclose(np.unique(x.round(9)), [0.5, 1.5, 2.5])
    tops = [corners[np.abs(corners[:, 0] - u) < 1e-9, 1].max() for u in (0.5, 2.5)]
    assert tops[0] > 2.2 and tops[1] < 1.2  # a strip at the edge


def test_clearance_of_a_turned_plan_is_that_of_the_turned_floor():
    def pinnacle(x, y):
        return 1.2 * np.exp(-((x - 0.31) ** 2 + (y + 0.44) ** 2) / 0.02)

    area = rectangle(centre_m=(5.0, 1.0), heading_deg=63)
    turned = least_clearance(plan(area), lambda x, y: pinnacle(*area.to_legs(x, y)))
    straight = least_clearance(plan(), pinnacle)
    assert turned.least_m == pytest.approx(straight.least_m, abs=1e-12)
    assert (turned.x_m, turned.y_m) == pytest.approx(area.to_scene(straight.x_m, straight.y_m))
