"""Paths over a floor that is not known: the chart, the floor measured in flight, and the path that follows it."""

import numpy as np
import pytest

from twin import survey
from twin.controllers.camera_surface import surface_above_floor
from twin.controllers.segments import Reference
from twin.core import geometry
from twin.core.height_field import cast_pixels, height_field, ray_grid
from twin.errors import ScenarioError
from twin.scenario.file import load_scenario
from twin.simulate.echo_sounders import Altimeter
from twin.world.floor_following import EchoCorrection, FloorFollower
from twin.world.mission import prepare
from twin.world.mission_flight import PathChange
from twin.world.planning import floor_of, smoothed_over

HILLS = ["terrain.kind=fractal", "terrain.relief_m=1.2", "terrain.size_m=[12.0, 10.0]", "plan.area_m=[5.0, 3.0]",
         "plan.altitude_m=2.0", "imaging.fidelity=surrogate", "imaging.extrapolate=true"]  # fmt: skip


def scenario(*overrides):
    return load_scenario("reef", [*HILLS, *overrides])


def level_pose(x, y, z):
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = geometry.rotations_of_down_camera(np.array(0.0)), (x, y, z)
    return pose


def test_the_path_changes_to_new_heights_without_a_step():
    dt = 1e-3
    still = Reference(*(np.zeros((5000, 3)) for _ in range(2)), np.zeros(5000), np.zeros((5000, 3)))
    up = np.array([0.0, 0.0, 1.0])
    changed = PathChange(0.3 * up, -0.2 * up, 10).added_to(still, 10, 1 / dt)
    z, velocity, acceleration = (part[:, 2] for part in (changed.position, changed.velocity, changed.acceleration))
    assert (z[0], velocity[0]) == (0.3, -0.2)
    np.testing.assert_allclose(np.gradient(z, dt)[1:-1], velocity[1:-1], atol=1e-6)
    np.testing.assert_allclose(np.gradient(velocity, dt)[1:-1], acceleration[1:-1], atol=1e-6)
    assert abs(z[-1]) < 3e-3 and (changed.position[:, :2] == 0).all()


@pytest.mark.parametrize("gradient", [0.0, 0.2, 0.6])
def test_an_altimeter_returns_the_nearest_echo_which_the_mean_slope_corrects(gradient):
    x = np.arange(-100, 101) * 0.1
    floor = height_field(np.tile(gradient * x, (201, 1)), 0.1, x[0], x[0])
    settings = scenario("navigation.altimeter_beam_deg=12", "navigation.altimeter_sigma=0").navigation
    altimeter, echoes, half = Altimeter(settings, floor, np.random.default_rng(0)), EchoCorrection(12.0), np.deg2rad(6)

    def factor(slope):
        angle = min(half, np.arctan(slope))
        return np.cos(angle) + slope * np.sin(angle)

    for k in range(40):
        at = 0.1 * k - 2.0
        pose = level_pose(at, 0.0, 2.0 + gradient * at)
        distance_m = altimeter.read(pose)
        assert distance_m == pytest.approx(2.0 / factor(gradient), rel=1e-3)
        found = echoes.floor_point(pose, distance_m)
    # a plane rises along this path only; in all directions alike, its mean gradient would be sqrt(pi / 2) times this
    expected = 2.0 * factor(np.sqrt(np.pi / 2) * gradient) / factor(gradient)
    assert 2.0 + gradient * at - found[2] == pytest.approx(expected, rel=2e-3)


def test_an_altimeter_has_no_reading_outside_its_range():
    floor = height_field(np.zeros((3, 3)), 10.0, -10.0, -10.0)
    altimeter = Altimeter(scenario().navigation, floor, np.random.default_rng(0))
    assert altimeter.read(level_pose(0, 0, 0.2)) is None and altimeter.read(level_pose(0, 0, 60.0)) is None
    assert altimeter.read(level_pose(0, 0, 3.0)) == pytest.approx(3.0, rel=0.03)


def test_the_measured_floor_gives_the_surface_of_the_known_floor():
    mission = prepare(scenario("control.height=map", "terrain.prior=none"))
    follower, pixels, sides = (
        FloorFollower(mission),
        ray_grid(mission.rig, 60),
        smoothed_over(mission.scenario, mission.plan.request),
    )
    true = surface_above_floor(mission.terrain.height_near, mission.plan.area, 0.05, 2.0, sides, (1e6, 1e6))
    for x in np.arange(-1.6, 1.7, 0.4):
        for y in np.arange(-1.6, 1.7, 0.4):
            pose = level_pose(x, y, 2.5)
            depth = cast_pixels(floor_of(mission.terrain), pose[None], mission.rig, pixels)[0]
            rays = np.column_stack([mission.rig.normalised(pixels), np.ones(len(pixels))])
            follower.add(geometry.transform(pose, rays * depth[:, None]))
    at = np.array([[0.0, 0.0], [0.3, -0.2]])
    found = follower.surface(np.zeros(2)).height_at(*at.T)
    np.testing.assert_allclose(found, true.height_at(*at.T), atol=0.02)


def test_the_path_rises_over_a_measured_obstacle():
    mission = prepare(scenario("control.height=map", "terrain.prior=none", "plan.clearance_m=0.5"))
    follower, z = FloorFollower(mission), float(mission.chart.height_near(0.0, 0.0))
    ground = np.random.default_rng(0).uniform(-3, 3, (20_000, 2))
    follower.add(np.column_stack([ground, np.full(len(ground), z)]))
    before = float(follower.surface(np.zeros(2)).height_at(np.zeros(1), np.zeros(1))[0])
    pole = np.random.default_rng(1).uniform(-0.1, 0.1, (400, 2))
    follower.add(np.column_stack([pole, np.full(len(pole), z + 2.2)]))
    after = float(follower.surface(np.zeros(2)).height_at(np.zeros(1), np.zeros(1))[0])
    assert before == pytest.approx(z + 2.0, abs=0.01) and after > z + 2.2 + 0.4


def test_far_off_the_path_the_floor_is_that_of_its_edge():
    mission = prepare(scenario("control.height=map", "terrain.prior=none"))
    follower, far = FloorFollower(mission), np.array([500.0, -500.0])
    follower.add(np.array([[0.0, 0.0, 0.3]]))
    assert np.isfinite(follower.surface(far).height_at(*far[:, None])).all()


@pytest.mark.parametrize(("prior", "mean_m", "std_share"), [
    (["terrain.prior_offset_m=0.3"], 0.3, 1.0), (["terrain.prior_smoothing_m=1.0"], 0.0, 0.95),
])  # fmt: skip
def test_a_chart_is_smoothed_and_offset(prior, mean_m, std_share):
    mission = prepare(scenario("plan.height=floor", *prior))
    difference = mission.chart.height_m - mission.terrain.height_m
    assert difference.mean() == pytest.approx(mean_m, abs=0.02)
    assert mission.chart.height_m.std() <= std_share * mission.terrain.height_m.std() + 1e-6
    lifted = mission.plan.all_references().position[:, 2].mean()
    known = prepare(scenario("plan.height=floor")).plan.all_references().position[:, 2].mean()
    assert lifted - known == pytest.approx(mean_m, abs=0.05)


def test_without_a_chart_the_path_is_level_above_the_floor_at_its_start():
    mission = prepare(scenario("terrain.prior=none", "control.height=altimeter"))
    z = mission.plan.all_references().position[:, 2]
    x, y, _ = mission.plan.reference(1, 0.0).position
    known = prepare(scenario("terrain.kind=flat", "plan.height=floor")).plan.request.footprint_m
    assert known == mission.plan.request.footprint_m
    assert mission.plan.request.across_scale == pytest.approx(1 / (1 + 0.3 * np.tan(np.deg2rad(30))), rel=0.02)
    assert np.ptp(z) < 1e-6 and abs(z[0] - 2.0 - float(mission.terrain.height_near(x, y))) < 0.2


@pytest.mark.parametrize(("height", "largest_m"), [("map", 0.1), ("altimeter", 0.22)])
@pytest.mark.long
def test_a_vehicle_follows_a_floor_that_nobody_knew(height, largest_m, tmp_path):
    rough = ["terrain.relief_m=4.0", "plan.area_m=[8.0,3.0]", "plan.tracks=1"]
    given = [*rough, "terrain.prior=none", "plan.height=floor"]
    blind = survey.run(scenario(*given), tmp_path / "blind", outputs=None).metrics["control"]
    found = survey.run(scenario(*given, f"control.height={height}"), tmp_path / "found", outputs=None).metrics
    assert blind["height_error_rmse_m"] > 0.25 > largest_m > found["control"]["height_error_rmse_m"]
    assert found["status"] == "complete" and found["control"]["altitude_rmse_m"] < 0.02


@pytest.mark.parametrize(("overrides", "line"), [
    (["terrain.prior=none", "terrain.prior_offset_m=1.0"], "has no effect without a prior"),
    (["terrain.prior=none"], '"plane" lies at a height above an unknown floor'),
    (["terrain.prior_file=chart.tif"], "has no effect on terrain.kind = 'fractal'"),
    (["control.height=map", "vehicle.dynamics=kinematic", "current.velocity_mps=[0.0,0.0,0.0]"], "horizontal plane"),
])  # fmt: skip
def test_a_chart_that_cannot_be_used_is_refused(overrides, line):
    with pytest.raises(ScenarioError, match=line.replace("(", r"\(")):
        prepare(scenario(*overrides))


def test_noisy_readings_of_an_altimeter_lie_in_its_range():
    floor = height_field(np.zeros((3, 3)), 10.0, -10.0, -10.0)
    altimeter = Altimeter(scenario("navigation.altimeter_sigma=0.5").navigation, floor, np.random.default_rng(0))
    found = [altimeter.read(level_pose(0, 0, 2.0)) for _ in range(500)]
    assert all(reading is None or 0.3 <= reading <= 50.0 for reading in found) and 0 < found.count(None) < 100
