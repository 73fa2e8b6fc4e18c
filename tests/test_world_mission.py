"""Errors of a scenario that depend on its floor are reported by line, before anything is flown."""

import numpy as np
import pytest

from twin.errors import ScenarioError
from twin.scenario.file import load_scenario
from twin.surrogate import matchability
from twin.world.height_floor import load_terrain
from twin.world.mission import prepare

BAD_BEACONS = [
    (
        '[navigation]\naiding = ["beacons"]',
        ["3: navigation.aiding: 'beacons': the scenario defines no beacon (allowed: with a [[beacons]] section)"],
    ),
    (
        "[[beacons]]\nposition_m = [0, 0, 1]\n[[beacons]]\nposition_m = [5, 1, 1]\n"
        "[[beacons]]\nposition_m = [1, 1, 0.4]",
        [
            "5: beacons.1.position_m: (5, 1) lies outside the terrain (allowed: x -4.50 to 4.50, y -3.50 to 3.50 m)",
            "7: beacons.2.position_m: z 0.4 is below the floor (allowed: above 0.500 m)",
        ],
    ),
]


BAD_SENSORS = [
    (
        "[sensor]\nexposure_min_ms = 20.0",
        [
            "3: sensor.exposure_min_ms: 20: longer than the longest exposure"
            " (allowed: up to sensor.exposure_max_ms = 15)"
        ],
    ),
    (
        "[sensor]\nexposure_min_ms = 60\nexposure_max_ms = 50\nreadout_ms = 34.0",
        [
            "3: sensor.exposure_min_ms: 60: longer than the longest exposure"
            " (allowed: up to sensor.exposure_max_ms = 50)",
            "4: sensor.exposure_max_ms: 50: longer than a frame (allowed: up to 33.33 at rig.frame_rate_hz = 30)",
            "5: sensor.readout_ms: 34: longer than a frame (allowed: up to 33.33 at rig.frame_rate_hz = 30)",
        ],
    ),
    (
        "[sensor]\n[rig]\nframe_rate_hz = 120.0",
        ["2: sensor.exposure_max_ms: 15: longer than a frame (allowed: up to 8.33 at rig.frame_rate_hz = 120)"],
    ),
]


@pytest.mark.parametrize(
    ("overrides", "error"),
    [
        (["terrain.texture_tiling=repeat"], "terrain.texture_tiling: has no effect without a photo"),
        (
            ["terrain.kind=file", "terrain.height_file=x.npy", "terrain.texture_file=y.png", "terrain.cover=sand"],
            "terrain.cover: has no effect on a floor with terrain.texture_file",
        ),
    ],
)
def test_texture_keys_without_effect_are_rejected(overrides, error):
    with pytest.raises(ScenarioError, match=error):
        prepare(load_scenario("quickstart", overrides))


@pytest.mark.parametrize("fidelity", ["surrogate", "rendered"])
def test_a_floor_without_photo_is_painted_in_full_only_for_images(tmp_path, fidelity):
    np.save(tmp_path / "dem.npy", np.random.default_rng(1).random((50, 60)))
    overrides = [f"imaging.fidelity={fidelity}", "terrain.kind=file", f"terrain.height_file={tmp_path}/dem.npy"]
    scenario = load_scenario("quickstart", [*overrides, "terrain.height_spacing_m=0.05", "terrain.texture_px_m=0.005"])
    terrain = load_terrain(scenario)
    assert terrain.texture.shape[:2] == ((490, 590) if fidelity == "rendered" else (49, 59))
    texture, texel_m = matchability._texture(scenario, terrain, 1.0)  # the surrogate paints what an image shows
    assert texture.shape == (200, 200, 3) and texel_m == 0.005


@pytest.mark.parametrize(("text", "errors"), BAD_SENSORS)
def test_invalid_sensors_are_reported_by_line_all_at_once(tmp_path, text, errors):
    file = tmp_path / "sensor.toml"
    (tmp_path / "ideal.toml").write_text('extends = "reef"\nrig.model = "ideal"\n')
    file.write_text(f'extends = "ideal.toml"\n{text}\n')
    with pytest.raises(ScenarioError) as caught:
        prepare(load_scenario(file))
    assert caught.value.lines == [f"{file}:{error}" for error in errors]


@pytest.mark.parametrize(("text", "errors"), BAD_BEACONS)
def test_invalid_beacons_are_reported_by_line_all_at_once(tmp_path, text, errors):
    file = tmp_path / "beacons.toml"
    file.write_text(f'extends = "{load_scenario("reef").source.path}"\n{text}\n')
    flat = ["terrain.kind=flat", "terrain.relief_m=0.0", "terrain.base_m=0.5"]
    with pytest.raises(ScenarioError) as caught:
        prepare(load_scenario(file, flat))
    assert caught.value.lines == [f"{file}:{error}" for error in errors]


FLAT = ["terrain.kind=flat", "terrain.relief_m=0", "terrain.size_m=[40,40]", "objects=[]", "imaging.fidelity=surrogate"]


@pytest.mark.parametrize(
    ("overrides", "error"),
    [
        (
            ["plan.area_m=[16,16]", "plan.altitude_m=8", "plan.overlap_across=0.3", "plan.speed_mps=0.73"],
            "plan.speed_mps: .*up to 0.6",  # ahead 0.73 m/s, but sideways less
        ),
        (["waves.height_m=1", "waves.depth_m=3", "plan.altitude_m=5"], "waves.depth_m: 3: the cameras are above"),
        (
            ["terrain.base_m=5", "sun.depth_m=3", "plan.height=floor", "plan.altitude_m=2"],
            "sun.depth_m: 3: the cameras are above the surface",
        ),
        (
            ['tasks=[{name="t",after_track=1,position_m=[0,0],size_m=[15,15],altitude_m=2,cell_m=0.0015}]',
             "plan.area_m=[16,16]", "plan.altitude_m=8", "plan.overlap_across=0.3", "plan.speed_mps=0.3"],
            "map.cell_m",
        ),
        (["waves.fetch_m=1000", "sun.depth_m=30"], "waves.wind_mps: missing, as there is a waves.fetch_m"),
        (
            ["waves.fetch_m=1000", "waves.wind_mps=9", "waves.period_s=5", "sun.depth_m=30"],
            "waves.period_s: is unused: it follows from waves.wind_mps",
        ),
        (["vehicle.dynamics=kinematic", "current.gust_vertical_mps=0.2"], "current.gust_vertical_mps: has no effect"),
        (["vehicle.thrust_coefficients=[0.1]"], "vehicle.buoyancy_n: the thrusters cannot hold the depth"),
        (["vehicle.buoyancy_n=20", "vehicle.thrust_coefficients=[4]"], "vehicle.buoyancy_n: the thrusters cannot hold"),
        (["navigation.dvl_range_m=[50,0.3]", 'navigation.aiding=["dvl"]'], "navigation.dvl_range_m: .*: no range"),
        (["navigation.altimeter_range_m=[9,0.3]"], r"navigation.altimeter_range_m: \[9, 0.3\]: no range"),
        (
            ["plan.pattern=loops", "plan.area_m=[16,16]", "plan.altitude_m=3",
             'tasks=[{name="t",within_leg=true,position_m=[0,0],size_m=[1,1],altitude_m=2}]'],
            "tasks.0.within_leg: has no effect on arcs",
        ),
        (
            ['tasks=[{name="t",position_m=[0,0],size_m=[3,2],altitude_m=1.2,overlap_across=0.995,speed_mps=0.011}]',
             "plan.area_m=[4,3]", "plan.altitude_m=2"],
            r"plan.area_m: [\d.e+]+ frames",
        ),
    ],
)  # fmt: skip
def test_what_cannot_be_flown_is_refused(overrides, error):
    with pytest.raises(ScenarioError, match=error):
        prepare(load_scenario("reef", [*FLAT, *overrides]))


@pytest.mark.parametrize("kind, relief_m, altitude_m", [("fractal", 10, 2), ("cliffs", 6, 1)])
@pytest.mark.parametrize("seed", range(4))
def test_a_path_that_meets_a_steep_floor_between_its_corners_is_planned_or_refused(kind, relief_m, altitude_m, seed):
    floor = [f"terrain.kind={kind}", f"terrain.relief_m={relief_m}", "terrain.size_m=[12,12]", "terrain.grid_m=0.2"]
    plan = ["plan.height=floor", f"plan.altitude_m={altitude_m}", "plan.area_m=[8,6]", "plan.tracks=1"]
    overlap = ["plan.overlap_along=0.5", "plan.overlap_across=0.3"]
    try:
        assert prepare(load_scenario("reef", [*FLAT, *floor, *plan, *overlap, f"seed={seed}"])).n_frames > 0
    except ScenarioError as error:
        assert "the cameras lie below the floor" in str(error)


def test_a_vehicle_without_drag_is_limited_by_no_speed():
    drag = [f"vehicle.{kind}_drag=[0,0,0,0,0,0]" for kind in ("linear", "quadratic")]
    assert prepare(load_scenario("reef", [*FLAT, *drag, "plan.area_m=[4,2]", "plan.tracks=1"])).n_frames > 0


def test_the_frames_of_a_sequence_that_ends_early_take_no_memory_of_the_rest():
    mission = prepare(load_scenario("reef", FLAT))
    whole = mission.planned_frames(1)
    first = whole.first(3)
    parts = *first.reference, first.keyframe, first.path_times_s
    assert all(part.base is None or part.base.nbytes <= part.nbytes for part in parts) and len(first) == 3
    assert np.array_equal(first.reference.position, whole.reference.position[:3])


def test_a_map_of_a_low_task_has_cells():
    tasks = 'tasks=[{name="t",position_m=[0,0],size_m=[0.02,0.02],altitude_m=0.05}]'
    far = ["plan.area_m=[4,3]", "plan.altitude_m=40", "plan.clearance_m=0", "map.cell_m=0.03", tasks]
    assert prepare(load_scenario("reef", [*FLAT, *far])).details[0].grid.cell_m >= 1e-5
