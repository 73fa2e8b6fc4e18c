"""Plans over slopes, ridges and walls: altitude, speed, spacing of the legs and their heading, by closed forms."""

import numpy as np
import pytest

from twin.core.height_field import image_overlap
from twin.core.records import StereoRig, Trajectory
from twin.errors import ScenarioError
from twin.judge.swaths import image_pairs
from twin.scenario.file import load_scenario
from twin.survey import run
from twin.terrains import Terrain
from twin.world.floor_forecast import forecast_over_floor
from twin.world.mission import Mission, prepare
from twin.world.path_checks import climb_slope, highest_near
from twin.world.planning import floor_of, planned_keyframes

FOLLOW = ["plan.height=floor", "plan.altitude_m=1.8"]
WALL = np.tan(np.deg2rad(60))


def floor(height_at, known=None):
    """Returns a terrain of 12 m x 12 m with heights given as a function of x and y, lowered to a least height of 0."""
    x, y = np.meshgrid(np.arange(-120, 121) * 0.05, np.arange(-120, 121) * 0.05)
    height = np.broadcast_to(height_at(x, y), x.shape)
    texture = np.zeros((2, 2, 3), np.uint8)
    return Terrain((height - height.min()).astype(np.float32), 0.05, -6.0, -6.0, texture, 6.0, known=known)


def over(terrain, monkeypatch, *overrides) -> Mission:
    monkeypatch.setattr("twin.world.mission.load_terrain", lambda _: terrain)
    return prepare(load_scenario("reef", ["terrain.texture_px_m=0.2", "plan.area_m=[2.0, 1.5]", *overrides]))


def altitudes(mission):
    x, y, z = mission.plan.all_references().position.T
    return z - mission.terrain.height_at(x, y)


@pytest.mark.parametrize(("grade", "heading_deg"), [(0.25, 0), (0.25, 90), (0.5, 37)])
def test_over_a_slope_in_any_direction_the_altitude_is_kept(heading_deg, grade, monkeypatch):
    """The mean of a plane over a footprint is the plane: its slope is below the limit, so the altitude is exact."""
    mission = over(floor(lambda x, y: grade * x), monkeypatch, *FOLLOW, f"plan.heading_deg={heading_deg}")
    np.testing.assert_allclose(altitudes(mission), 1.8, atol=0.01)


def test_over_a_ridge_along_the_legs_the_path_is_lower_by_the_mean_of_a_triangle(monkeypatch):
    """Two averages over a width w weigh the floor by a triangle, and the mean of |y| under it is w / 3."""
    mission = over(floor(lambda x, y: -0.4 * np.abs(y)), monkeypatch, *FOLLOW)
    x, y, z = mission.plan.all_references().position.T
    width_m, surface = mission.plan.request.footprint_m[0], mission.plan.request.surface
    assert surface is not None
    crest_m = float(surface.height_at(np.zeros(1), np.zeros(1))[0]) - mission.terrain.highest_m
    assert crest_m == pytest.approx(1.8 - 0.4 * width_m / 3, abs=0.03)
    assert altitudes(mission).min() > 1.8 - 0.4 * width_m / 3 - 0.03


@pytest.mark.parametrize("steps", ["plane", pytest.param("terrace", marks=pytest.mark.long)])
def test_a_wall_of_60_deg_is_flown_along_its_contours_and_slowly_between_them(steps, monkeypatch):
    def wall(x, y):
        height = WALL * (y + 0.3 * x) / np.hypot(1, 0.3)  # its contours have a heading of -16.7 deg
        return height if steps == "plane" else np.clip(height, -2.0, 2.0)

    mission = over(floor(wall), monkeypatch, *FOLLOW, "plan.along_contours=true", "plan.overlap_across=0.55")
    plan, reference = mission.plan, mission.plan.all_references()
    assert np.degrees(plan.area.heading) == pytest.approx(-np.degrees(np.arctan(0.3)), abs=2.5)
    above_m = altitudes(mission)
    if steps == "plane":
        np.testing.assert_allclose(above_m, 1.8, atol=0.02)
    assert above_m.min() > 0.8  # at the upper edge of a terrace, the averages over an image are lower
    climb_mps = climb_slope(mission.scenario.vehicle, plan.speed_mps) * plan.speed_mps
    assert np.abs(reference.velocity[:, 2]).max() <= climb_mps * 1.05
    legs = planned_keyframes(plan, "lawnmower").swath
    assert legs.max() + 1 == 2 * plan.n_tracks
    forecast = forecast_over_floor(mission)
    assert np.percentile(forecast.overlap_across, 5) > 0.5 and forecast.coverage > 0.95


def test_a_wall_across_the_legs_is_not_flown_through(monkeypatch):
    """Legs up the wall exceed the slope limit: the path climbs before the wall, and is never nearer than asked."""
    mission = over(floor(lambda x, y: np.clip(WALL * x, -1.0, 1.0)), monkeypatch, *FOLLOW)
    assert altitudes(mission).min() > 1.0
    speed = np.linalg.norm(mission.plan.all_references().velocity[:, :2], axis=1)
    climb = np.abs(mission.plan.all_references().velocity[:, 2])
    assert (climb <= climb_slope(mission.scenario.vehicle, mission.plan.speed_mps) * 1.03 * speed + 1e-6).all()


def sidelap(height_m, grade, spacing_m, rig: StereoRig):
    """Returns the share of an image, over a plane that rises towards the other camera, that the other shows too.

    At t = tan of the angle from the vertical, the depth is D = h / (1 + g t); the other camera, level with the first at
    the distance s, sees the point at t - s / D, which must be at least -T.
    """
    edge = rig.width_px / 2 / rig.focal_px
    least = (spacing_m / height_m - edge) / (1 - grade * spacing_m / height_m)
    return (edge - least) / (2 * edge)


def test_legs_are_nearer_to_each_other_where_the_floor_is_nearer(monkeypatch):
    """A level path over a slope across the legs: all sidelaps are as required, with fewer tracks than equal spacing."""
    grade = 0.25
    slope = floor(lambda x, y: grade * y)
    asked = ["plan.altitude_m=3.6", "plan.area_m=[2.0, 8.0]", "plan.overlap_across=0.7"]
    mission = over(slope, monkeypatch, *asked)
    plan, rig = mission.plan, mission.rig
    v = np.array([plan.waypoints(t)[k, 1] for t in range(1, plan.n_tracks + 1) for k in (0, 2)])
    gaps, heights = np.diff(v), 3.6 - slope.height_at(0 * v, v)
    expected = sidelap(heights[:-1], grade, gaps, rig)
    assert expected.min() > 0.69 and np.ptp(expected) < 0.03
    np.testing.assert_allclose(gaps / heights[:-1], np.mean(gaps / heights[:-1]), rtol=0.06)
    along, across = image_pairs(planned_keyframes(plan, "lawnmower"))
    found = image_overlap(floor_of(slope), across.first, across.second, rig)
    row = np.abs(across.first[:, 1, 3, None] - v[:-1]).argmin(axis=1)
    np.testing.assert_allclose(found, expected[row], atol=0.02)
    equal = int(np.ceil(8.0 / (0.3 * rig.width_px / rig.focal_px * (3.6 - slope.height_at(0.0, 4.0))) / 2))
    assert plan.n_tracks < equal and plan.request.leg_spacing


def test_over_a_level_floor_the_legs_are_equally_spaced(monkeypatch):
    plan = over(floor(lambda x, y: 0 * x), monkeypatch).plan
    assert plan.request.leg_spacing == () and plan.least_spacing_m == plan.swath_spacing_m


def test_the_highest_floor_near_a_point_is_that_in_a_circle():
    rng = np.random.default_rng(0)
    terrain = floor(lambda x, y: rng.random(x.shape))
    nodes = np.stack(np.meshgrid(*[np.arange(-120, 121) * 0.05] * 2), axis=-1)
    x, y = rng.uniform(-5, 5, (2, 200))
    for east, north, found in zip(x, y, highest_near(terrain, x, y, 0.4), strict=True):
        distance = np.hypot(nodes[..., 0] - east, nodes[..., 1] - north)
        assert terrain.height_m[distance < 0.8 * 0.4 - 0.05].max() <= found
        assert found <= terrain.height_m[distance < 0.4 + 0.1].max()
    coarse = Terrain(0.5 * np.arange(9, dtype=np.float32) * np.ones((9, 1), np.float32), 2.0, -8.0, -8.0,
                     np.zeros((2, 2, 3), np.uint8), 8.0)  # fmt: skip
    assert highest_near(coarse, np.zeros(1), np.zeros(1), 0.7)[0] == pytest.approx(2.0 + 0.25 * 0.7)


@pytest.mark.parametrize("direction_deg", [20.0, 130.0])
def test_contours_are_perpendicular_to_the_slope_of_the_floor_that_has_heights(direction_deg, monkeypatch):
    east, north = np.cos(np.deg2rad(direction_deg)), np.sin(np.deg2rad(direction_deg))
    known = np.ones((241, 241), np.bool_)
    known[:, 128:] = False  # a fifth of the area
    terrain = floor(lambda x, y: 0.2 * (east * x + north * y), known)
    terrain.height_m[:, 128:] = terrain.height_m[:, 127:128]  # the nearest height
    mission = over(terrain, monkeypatch, *FOLLOW, "plan.along_contours=true", "plan.area_m=[1.5, 1.5]")
    heading = mission.plan.area.heading
    assert -np.pi / 2 <= heading <= np.pi / 2
    assert abs(np.cos(heading) * east + np.sin(heading) * north) < 1e-6


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["plan.heading_deg=10"], r"plan.heading_deg: 10.0 contradicts plan.along_contours \(allowed: one of the two"),
        (["plan.pattern=loops"], "plan.pattern: 'loops' contradicts plan.along_contours"),
    ],
)
def test_contours_replace_the_heading_of_legs(overrides, message, monkeypatch):
    with pytest.raises(ScenarioError, match=message):
        over(floor(lambda x, y: 0 * x), monkeypatch, "plan.along_contours=true", *overrides)


def test_a_level_path_below_a_slope_is_refused_with_the_key_that_helps(monkeypatch):
    message = r"plan.altitude_m: 1.8: the cameras lie below the floor at .*at least .* of clearance, or plan.height"
    with pytest.raises(ScenarioError, match=message):
        over(floor(lambda x, y: 0.25 * x), monkeypatch, "plan.altitude_m=1.8")


FLOORS = {
    "slope": lambda x, y: 0.25 * x,
    "ridge": lambda x, y: -0.4 * np.abs(x),
    "wall": lambda x, y: np.clip(WALL * y, -2.0, 2.0),
}


@pytest.mark.long
@pytest.mark.parametrize("name", FLOORS)
def test_slopes_ridges_and_walls_are_flown_as_planned(name, tmp_path):
    x, y = np.meshgrid(np.arange(-80, 81) * 0.05, np.arange(80, -81, -1) * 0.05)
    np.save(tmp_path / "floor.npy", FLOORS[name](x, y) + 0.02 * np.sin(9 * x) * np.sin(11 * y))
    values = ["terrain.kind=file", f"terrain.height_file={tmp_path}/floor.npy", "terrain.height_spacing_m=0.05",
              "imaging.fidelity=surrogate", "plan.along_contours=true", "plan.area_m=[1.4, 1.0]", "plan.tracks=1",
              "plan.overlap_across=0.55", "plan.overlap_along=0.8"]  # fmt: skip
    scenario = load_scenario("reef", [*values, *FOLLOW])
    metrics = run(scenario, tmp_path / "run", outputs=()).metrics
    assert metrics["status"] == "complete" and metrics["map"]["completeness_area"] > 0.95
    path = Trajectory.load(tmp_path / "run" / "trajectory_truth.tum").positions
    planned = altitudes(prepare(scenario))
    flown = path[:, 2] - prepare(scenario).terrain.height_at(*path[:, :2].T)
    assert planned.min() - 0.05 < flown.min() and flown.max() < planned.max() + 0.05
    assert metrics["control"]["altitude_rmse_m"] < 0.02
