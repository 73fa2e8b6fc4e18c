"""Plans over the true floor: spacing, height, forecast, clearance and thrust."""

import dataclasses
import json

import numpy as np
import pytest

from twin import terrains
from twin.controllers.camera_surface import surface_above_floor
from twin.controllers.survey_area import SurveyArea
from twin.core.georeference import Georeference
from twin.core.records import SurveyResult, Trajectory, Truth
from twin.errors import ScenarioError, TwinError
from twin.judge.swaths import image_pairs, overlap_metrics, swath_numbers
from twin.scenario.file import load_scenario
from twin.simulate.autopilot import thrust_loads, top_speed_mps
from twin.simulate.sea import make_sea
from twin.terrains import Terrain, TextureSource
from twin.world.energy import planned_energy
from twin.world.floor_forecast import forecast_over_floor, planned_overlap, spread
from twin.world.mission import prepare
from twin.world.path_checks import check_thrust, climb_slope
from twin.world.planning import MAX_FRAMES, check_plan_size, plan_survey, planned_keyframes, survey_request
from twin.world.top_surface import true_heights

SMALL = ["terrain.texture_px_m=0.2", "plan.area_m=[3.0, 1.6]", "plan.altitude_m=2.0"]


def scenario(*overrides):
    return load_scenario("reef", [*SMALL, *overrides])


def floor(height_at, spacing_m=0.05):
    """Returns a terrain of 9 m x 7 m with heights given as a function of x and y."""
    x, y = np.meshgrid(np.arange(-90, 91) * 0.05, np.arange(-70, 71) * 0.05)
    height = np.broadcast_to(height_at(x, y), x.shape).astype(np.float32)
    return Terrain(height, spacing_m, -4.5, -3.5, np.zeros((2, 2, 3), np.uint8), 4.5)


def over(terrain, monkeypatch, *overrides):
    """Returns the mission of a scenario over the given terrain."""
    monkeypatch.setattr("twin.world.mission.load_terrain", lambda _: terrain)
    return prepare(scenario(*overrides))


def raised(height_m):
    return floor(lambda x, y: np.full_like(x, height_m))


@pytest.mark.parametrize("height", ["plane", "floor"])
def test_the_map_contains_the_footprints_on_a_floor_below_the_reference_plane(height, monkeypatch):
    mission = over(raised(-1.0), monkeypatch, f"plan.height={height}")
    cameras, rig, grid = planned_keyframes(mission.plan, "lawnmower").world_from_camera, mission.rig, mission.grid
    corners = [[0, 0], [rig.width_px, 0], [0, rig.height_px], [rig.width_px, rig.height_px]]
    rays = np.column_stack([rig.normalised(np.array(corners, float)), np.ones(4)]) @ cameras[:, :3, :3].mT
    on_floor = cameras[:, None, :2, 3] - rays[..., :2] * ((cameras[:, 2, 3, None] + 1.0) / rays[..., 2])[..., None]
    west_south = [grid.west_m, grid.north_m - grid.rows * grid.cell_m]
    east_north = [grid.west_m + grid.cols * grid.cell_m, grid.north_m]
    assert (on_floor >= west_south).all() and (on_floor <= east_north).all()


def test_over_the_reference_plane_both_references_give_the_same_plan():
    flat = raised(0.0)
    for pattern in ("plan.pattern=lawnmower", "plan.pattern=loops"):
        area = ["plan.area_m=[3.0, 3.0]"] if pattern.endswith("loops") else []
        plans = [
            plan_survey(scenario(pattern, *area, f"plan.overlap_reference={reference}"), flat)
            for reference in ("floor", "plane")
        ]
        assert plans[0] == plans[1]


def test_over_a_raised_plane_the_spacing_is_that_of_the_remaining_altitude():
    over_floor = plan_survey(scenario("plan.overlap_reference=floor"), raised(0.8))
    nearer = plan_survey(scenario("plan.overlap_reference=plane", "plan.altitude_m=1.2"), raised(0.0))
    assert over_floor.swath_spacing_m == nearer.swath_spacing_m
    # the steps of the search reduce the spacing by at least 1 %
    assert 0.97 * nearer.n_frames_per_keyframe <= over_floor.n_frames_per_keyframe <= nearer.n_frames_per_keyframe
    assert over_floor.request.altitude_m == 2.0


@pytest.mark.parametrize("kind", ["reef", "fractal", "step"])
def test_all_but_5_percent_of_the_keyframes_keep_the_required_overlap_over_the_floor(kind, monkeypatch):
    if kind == "step":
        terrain = floor(lambda x, y: np.where(x > 0.3, 0.7, 0.0))
    else:
        terrain = terrains.generate(kind, (9.0, 7.0), 0.8, 0.0, 0.05, TextureSource(0.2), 3)
    asked = ("plan.overlap_along=0.8", "plan.overlap_across=0.7")
    kept = forecast_over_floor(over(terrain, monkeypatch, *asked))
    plane = forecast_over_floor(over(terrain, monkeypatch, *asked, "plan.overlap_reference=plane"))
    along = 1 - 0.2 * 320 / 240  # overlap_along is a fraction of the image width (see frames_per_keyframe)
    assert spread(kept.overlap_along).p05 >= along - 0.01  # N is a whole number of frames
    assert spread(kept.overlap_across).p05 >= 0.7 - 0.001
    assert spread(plane.overlap_along).p05 < along - 0.02


@pytest.mark.parametrize("height_m", [0.0, 0.9])
def test_the_forecast_over_a_level_floor_has_its_closed_form(height_m, monkeypatch):
    mission = over(raised(height_m), monkeypatch, "plan.overlap_reference=plane")
    forecast, plan, rig = forecast_over_floor(mission), mission.plan, mission.rig
    range_m = 2.0 - height_m
    step_m = plan.n_frames_per_keyframe * plan.speed_mps / plan.request.frame_rate_hz
    assert spread(forecast.overlap_along).p05 == pytest.approx(1 - step_m * rig.focal_px / (240 * range_m), abs=1e-3)
    sidelap = 1 - plan.swath_spacing_m * rig.focal_px / (320 * range_m)
    assert spread(forecast.overlap_across).median == pytest.approx(sidelap, abs=0.01)  # frames on the corners
    assert spread(forecast.overlap_across).maximum == pytest.approx(sidelap, abs=0.01)
    np.testing.assert_allclose(forecast.clearance_m, range_m, atol=1e-6)
    np.testing.assert_allclose(forecast.altitude_m, range_m, atol=1e-6)
    np.testing.assert_allclose(forecast.gsd_m, range_m / rig.focal_px, rtol=1e-6)
    np.testing.assert_allclose(forecast.stereo_share, 1 - rig.focal_px * rig.baseline_m / range_m / 320, atol=1e-6)
    assert forecast.coverage == 1


def test_coverage_counts_the_asked_area_only(monkeypatch):
    wide = "rig.baseline_m=1.0"  # the second leg does not reach the northern edge of its strip
    one = over(raised(0.0), monkeypatch, "plan.tracks=1", "plan.area_m=[3.0, 4.0]", "plan.overlap_across=0.5", wide)
    strip_m = 2 * one.plan.swath_spacing_m  # the part of the area that one track is to cover
    reached_m = 1.5 * one.plan.swath_spacing_m + 320 / one.rig.focal_px  # second leg and half of its image
    reached_m -= one.rig.baseline_m  # the right camera is displaced to the south
    assert forecast_over_floor(one).coverage == pytest.approx(reached_m / strip_m, abs=0.02)  # at 80 columns
    assert reached_m < strip_m


@pytest.mark.parametrize("area_m", ["[3.0, 1.6]", "[0.01, 0.01]"])
def test_the_coverage_of_a_small_plot_does_not_depend_on_the_size_of_the_terrain(area_m, monkeypatch):
    large = Terrain(np.zeros((601, 601), np.float32), 5.0, -1500.0, -1500.0, np.zeros((2, 2, 3), np.uint8), 1500.0)
    assert forecast_over_floor(over(large, monkeypatch, f"plan.area_m={area_m}")).coverage == 1


def test_a_survey_flown_as_planned_has_the_planned_overlap(monkeypatch):
    mission = over(terrains.generate("reef", (9.0, 7.0), 0.8, 0.0, 0.05, TextureSource(0.2), 5), monkeypatch)
    sequences = [mission.planned_frames(track) for track in mission.tracks]
    reference = np.concatenate([c.reference.position for c in sequences])
    keyframe = np.flatnonzero(np.concatenate([c.keyframe for c in sequences]))
    track = np.repeat(list(mission.tracks), [len(c) for c in sequences])
    poses = np.tile(mission.start, (len(reference), 1, 1))
    poses[:, :3, 3] = reference
    path = Trajectory(np.arange(len(reference)) / 30, poses)
    heights = true_heights(mission.grid, mission.terrain.height_at)
    truth = Truth(path, reference, np.zeros(len(reference), bool), track, heights, *np.zeros((2, *heights.shape), bool))
    result = SurveyResult(path, path, path, keyframe, track[keyframe], np.zeros((len(keyframe), 6, 6)))
    found = overlap_metrics(result, truth, mission.rig, mission.grid, {})
    planned = planned_overlap(mission)
    assert found["along_median"] == pytest.approx(planned.along, abs=0.002)  # map cells against nodes of the terrain
    assert found["across_median"] == pytest.approx(planned.across, abs=0.002)


def test_a_path_over_the_floor_keeps_its_altitude_and_the_slope_limit(monkeypatch):
    hill = floor(lambda x, y: 1.2 * np.exp(-(x**2 + y**2) / 1.5))
    level, following = (
        over(hill, monkeypatch, f"plan.height={h}", "plan.area_m=[5.0, 1.6]") for h in ("plane", "floor")
    )
    z = planned_keyframes(following.plan, "lawnmower").position_m[:, 2]
    assert np.ptp(z) > 0.3
    spreads = [spread(forecast_over_floor(m).altitude_m) for m in (level, following)]
    assert spreads[1].maximum - spreads[1].minimum < 0.7 * (spreads[0].maximum - spreads[0].minimum)
    reference = following.planned_frames(1).reference
    speed = np.linalg.norm(reference.velocity[:, :2], axis=1)
    assert (
        np.abs(reference.velocity[:, 2])
        <= climb_slope(following.scenario.vehicle, following.scenario.plan.speed_mps) * speed + 1e-6
    ).all()
    corner, opposite = following.grid, level.grid
    assert corner.cols >= opposite.cols and corner.rows >= opposite.rows


def test_the_references_on_a_surface_are_consistent_derivatives(monkeypatch):
    hill = floor(lambda x, y: 1.2 * np.exp(-(x**2 + y**2) / 1.5))
    plan = over(hill, monkeypatch, "plan.height=floor").plan
    t = np.arange(0.5, plan.track_duration_s(1) - 0.5, 0.01)
    r = plan.references(1, t)
    corners = np.abs(np.diff(r.acceleration[:, :2], axis=0)).max(axis=1) > 1e-6
    smooth = ~(corners[1:] | corners[:-1])
    rate = (r.position[2:] - r.position[:-2]) / 0.02
    np.testing.assert_allclose(rate[smooth], r.velocity[1:-1][smooth], atol=2e-3)
    change = (r.velocity[2:] - r.velocity[:-2]) / 0.02
    np.testing.assert_allclose(change[smooth][:, 2], r.acceleration[1:-1][smooth][:, 2], atol=5e-3)


def surface(height_at, footprint_m, slopes, heading=0.0, spacing_m=0.1):
    area = SurveyArea("rectangle", (7.9, 5.9), heading=heading)
    return surface_above_floor(height_at, area, spacing_m, 2.0, footprint_m, slopes)


def test_a_surface_above_a_level_floor_is_level_and_a_cliff_is_climbed_before_it():
    level = surface(lambda x, y: np.full(np.broadcast(x, y).shape, 0.3), (1.7, 2.3), (0.3, 0.3), heading=0.4)
    np.testing.assert_allclose(level.height_at(np.array([-3, 0, 3.1]), np.array([0, 1, 2])), 2.3)
    x, zero = np.linspace(-3.9, 3.9, 400), np.zeros(400)

    def cliff(x, y):
        return np.where(x > 0, 2.0, 0.0) + 0 * y

    z = surface(cliff, (0.6, 0.8), (0.3, 0.3)).height_at(x, zero)
    assert np.abs(np.diff(z) / np.diff(x)).max() <= 0.3 * 1.02  # the spline between its knots
    foot = np.interp(-1.0, x, z)  # 1 m before the cliff, whose smoothed top begins about 0.6 m behind its edge
    assert 4.0 - 0.3 * 1.9 < foot < 4.0 - 0.3 * 1.0
    across = surface(cliff, (0.8, 0.6), (0.3, 1.5), heading=np.pi / 2).height_at(x, zero)  # legs along the cliff
    assert 1.0 < np.abs(np.diff(across) / np.diff(x)).max() <= 1.5 * 1.02
    assert np.interp(-1.0, x, across) == pytest.approx(2.0, abs=0.01)  # it is not climbed before it is in view


def test_the_clearance_of_a_following_path_is_checked_where_it_flies(monkeypatch):
    pillar = floor(lambda x, y: np.where(np.hypot(x - 0.5, y) < 0.15, 1.8, 0.0))
    with pytest.raises(ScenarioError, match=r"plan.altitude_m: 2: the cameras come within 0\.\d+ m of the floor"):
        over(pillar, monkeypatch, "plan.height=floor", "plan.overlap_reference=plane")


@pytest.mark.parametrize("grade", [0.25, 0.45, -0.45])
def test_a_path_over_a_slope_higher_than_the_altitude_follows_it(grade, monkeypatch):
    """The level path at 1.2 m would lie below the upper part of the slope."""
    slope = floor(lambda x, y: 1.0 + grade * x)
    mission = over(slope, monkeypatch, "plan.height=floor", "plan.altitude_m=1.2", "plan.area_m=[5.0, 1.0]")
    x, y, z = mission.plan.all_references().position.T
    assert np.ptp(z) > 4.9 * abs(grade)
    assert z - slope.height_at(x, y) == pytest.approx(1.2, abs=0.03)


def test_cross_lines_belong_to_no_swath_and_change_no_overlap(monkeypatch):
    """Their long lines are perpendicular to the legs, and the short ones between them parallel."""
    with_lines, without = (over(raised(0.0), monkeypatch, f"plan.cross_lines={n}") for n in (6, 0))
    plan, last = with_lines.plan, with_lines.plan.n_tracks
    assert planned_overlap(with_lines) == planned_overlap(without)
    swath = planned_keyframes(plan, "lawnmower").swath
    assert swath.max() + 1 == 2 * without.plan.n_tracks
    n_cross = plan.frames_of_track(last)[1].sum()
    assert (swath[-n_cross:] == -1).all() and n_cross > 20
    position = plan.all_references().position
    track = np.repeat(np.arange(last) + 1, [len(plan.frames_of_track(k + 1)[0]) for k in range(last)])
    numbers = swath_numbers(position, None, track, plan.swath_notes)
    assert numbers.max() + 1 == 2 * without.plan.n_tracks and (numbers[track == last] == -1).all()
    assert swath_numbers(position, None, track, {}).max() + 1 > 2 * without.plan.n_tracks


def test_legs_beside_a_gap_of_the_area_are_no_neighbours(tmp_path, monkeypatch):
    """The two parts have the spacing of one alone, and the sidelap of all pairs is the closed form."""
    part = np.array([[-1.5, -2.6], [1.5, -2.6], [1.5, -1.0], [-1.5, -1.0], [-1.5, -2.6]])
    rings = [[part.tolist()], [(part * [1, -1])[::-1].tolist()]]
    (tmp_path / "area.geojson").write_text(json.dumps({"type": "MultiPolygon", "coordinates": rings}))
    terrain = dataclasses.replace(raised(0.0), georeference=Georeference(0.0, 0.0))
    two = over(terrain, monkeypatch, f"plan.polygon={tmp_path}/area.geojson").plan
    one = over(terrain, monkeypatch, f"plan.polygon={part.tolist()}").plan
    assert two.n_tracks == 2 * one.n_tracks and two.swath_spacing_m == pytest.approx(one.swath_spacing_m)
    assert two.legs_after_gaps == (2 * one.n_tracks,)
    pairs = [image_pairs(planned_keyframes(plan, "lawnmower"))[1] for plan in (one, two)]
    assert len(pairs[1].first) == 2 * len(pairs[0].first) > 0


def test_a_kinematic_vehicle_cannot_follow_the_floor():
    with pytest.raises(ScenarioError, match="plan.height: 'floor': a kinematic vehicle moves in a horizontal plane"):
        prepare(scenario("plan.height=floor", "vehicle.dynamics=kinematic"))


def test_a_floor_that_comes_too_near_for_the_required_overlap_is_rejected():
    ridge = floor(lambda x, y: np.where(np.abs(x) < 1.2, 1.93, 0.0))
    with pytest.raises(TwinError, match="keeps the required overlap|too fast: less than one frame"):
        plan_survey(scenario("plan.overlap_along=0.5"), ridge)


def test_thrust_loads_reach_one_at_the_top_speed():
    vehicle = scenario().vehicle
    for direction in np.eye(3)[:2]:
        speed = top_speed_mps(vehicle, direction)
        assert thrust_loads(vehicle, np.array([speed * direction]))[0] == pytest.approx(1, abs=0.01)


@pytest.mark.parametrize(
    ("current", "field", "message"),
    [
        ([1.5, 0.0, 0.0], "current.velocity_mps", "1.50 m/s: the thrusters cannot hold station against it"),
        ([-0.6, 0.0, 0.0], "plan.speed_mps", "0.35: too fast for the thrusters in a current of 0.60 m/s"),
        ([0.0, 0.8, 0.0], "current.velocity_mps", "0.80 m/s: the thrusters cannot hold station"),
    ],
)
def test_a_current_beyond_the_thrusters_is_rejected_with_the_greatest_allowed_value(current, field, message):
    with pytest.raises(ScenarioError) as refused:
        prepare(scenario(f"current.velocity_mps={current}"))
    assert f"{field}: {message}" in str(refused.value)
    limit = float(str(refused.value).split("up to ")[1].split()[0].rstrip(")"))
    if field == "plan.speed_mps":
        prepare(scenario(f"current.velocity_mps={current}", f"plan.speed_mps={limit}"))
    else:
        share = 0.95 * limit / np.linalg.norm(current)  # a little is needed to move
        prepare(scenario(f"current.velocity_mps={[float(share * c) for c in current]}", "plan.speed_mps=0.02"))


def test_without_a_current_a_level_plan_needs_no_check():
    mission = prepare(scenario())
    check_thrust(mission.scenario.vehicle, make_sea(mission.scenario), mission.plan)
    hopeless = dataclasses.replace(mission.plan, speed_mps=9.0)
    check_thrust(mission.scenario.vehicle, make_sea(mission.scenario), hopeless)  # that is `check_speed`'s
    assert survey_request(mission.scenario, mission.terrain).along_scale == 1


def test_the_time_at_the_start_of_each_track_counts_in_the_size_of_a_plan():
    hold_s = 0.7 * MAX_FRAMES / 30.0
    check_plan_size(plan_survey(scenario("plan.tracks=1"), None), hold_s)
    with pytest.raises(TwinError, match="frames"):
        check_plan_size(plan_survey(scenario("plan.tracks=2"), None), hold_s)


def test_the_energy_of_a_plan_is_that_in_the_current_at_each_time(tmp_path):
    """A current that runs for half of the time takes the mean of the energies without it and with it."""
    file, keys = tmp_path / "current.csv", ("vehicle.dynamics=rigid", "imaging.fidelity=surrogate")
    still, always = (planned_energy(prepare(scenario(*keys, f"current.velocity_mps=[{v},0,0]"))) for v in (0.0, 0.25))
    mission = prepare(scenario(*keys))
    half_s = mission.n_frames / mission.rig.frame_rate_hz / 2
    rows = [(0, 0), (half_s - 0.05, 0), (half_s + 0.05, 0.25), (9999, 0.25)]
    lines = [f"{t},{z},{east},0" for t, east in rows for z in (0, 9)]
    file.write_text("time_s,height_m,east_mps,north_mps\n" + "\n".join(lines))
    found = planned_energy(prepare(scenario(*keys, f"current.file={file}")))
    assert still.survey_wh < always.survey_wh
    assert found.survey_wh == pytest.approx((still.survey_wh + always.survey_wh) / 2, rel=0.15)
