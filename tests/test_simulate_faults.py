"""Faults: when they are active, what they do to commands, images and readings, and what the survey makes of them."""

import json

import numpy as np
import pytest

import twin
from twin.core.records import Readings, StereoRig
from twin.errors import ScenarioError
from twin.imaging.image_formation import ImageFormation, RenderedView, StampedPose
from twin.imaging.light.illumination import illumination_of
from twin.scenario.file import load_scenario
from twin.scenario.model import FaultConfig, Scenario, VehicleConfig
from twin.simulate.compiled_vehicle import CompiledVehicle
from twin.simulate.faults import Faults
from twin.simulate.sea import flow_at, make_sea
from twin.survey import run
from twin.world.mission import prepare

RIG = StereoRig(320, 240, 300.0, 0.15)
HERE = np.zeros(3)
IMAGE = np.arange(48, dtype=np.uint8).reshape(4, 4, 3)
AIDED = 'navigation.aiding=["pressure","ahrs","dvl","usbl"]'


def faults_of(*given, duration_s=100.0, seed=0):
    return Faults([FaultConfig(**one) for one in given], duration_s, np.random.default_rng(seed), RIG, 2.0)


def test_a_fault_lasts_from_its_start_for_its_duration():
    faults = faults_of({"part": "pressure", "start_s": 2.0, "duration_s": 3.0})
    lost = []
    for t in range(8):
        faults.at(float(t), HERE)
        lost.append(faults.readings(Readings(pressure_z_m=1.0)).pressure_z_m is None)
    assert lost == [False, False, True, True, True, False, False, False]
    assert [(event.time_s, event.starts) for event in faults.events] == [(2.0, True), (5.0, False)]
    assert faults.sentences == ["Simulated faults: pressure off at 2.0 s."]


def test_faults_of_a_rate_are_a_poisson_process_of_that_rate():
    """Their number in an hour has the mean, here 60 / h with short faults, and about the variance of its law."""
    counts = []
    for seed in range(200):
        faults = faults_of({"part": "dvl", "per_hour": 60, "duration_s": 0.01}, duration_s=3600.0, seed=seed)
        counts.append(len(faults._spans))
    assert np.mean(counts) == pytest.approx(60, abs=4 * np.sqrt(60 / 200))
    assert np.var(counts) == pytest.approx(60, rel=0.4)


@pytest.mark.parametrize(("type_", "command", "factor"), [
    ("off", 0.2, 0.0), ("stuck", 0.1, 1.0), ("wrong", 0.2, 0.3), ("intermittent", 0.2, 0.0),
])  # fmt: skip
def test_a_thruster_fails_alone(type_, command, factor):
    size = 1.0 if type_ == "intermittent" else 0.3
    faults = faults_of({"part": "thruster", "number": 2, "type": type_, "start_s": 1.0, "size": size})
    faults.at(1.0, HERE)
    faults.thrusts(np.full(4, 0.1))
    faults.at(2.0, HERE)
    commands, factors = faults.thrusts(np.full(4, 0.2))
    assert commands.tolist() == [0.2, command, 0.2, 0.2] and factors.tolist() == [1.0, factor, 1.0, 1.0]


@pytest.mark.parametrize("type_", ["off", "stuck", "garbage", "intermittent"])
@pytest.mark.parametrize(("part", "failing"), [("cameras", (0, 1)), ("left_camera", (0,)), ("right_camera", (1,))])
def test_the_images_of_a_camera_fail(type_, part, failing):
    faults = faults_of({"part": part, "type": type_, "start_s": 0.0, "size": 1.0})
    faults.at(0.0, HERE)
    faults.images(IMAGE, IMAGE)
    faults.at(1.0, HERE)
    images = faults.images(IMAGE + 9, IMAGE + 9)
    for k in (0, 1):
        if k not in failing:
            np.testing.assert_array_equal(images[k], IMAGE + 9)
        elif type_ == "stuck":
            np.testing.assert_array_equal(images[k], IMAGE)
        elif type_ != "garbage":
            assert not images[k].any()
        assert images[k].shape == IMAGE.shape and images[k].dtype == np.uint8
    assert faults.images(IMAGE, None)[1] is None


def test_readings_fail_by_their_kind():
    truth = Readings(1.0, np.array([0.0, 0.0, 1.0]), np.array([0.3, 0.0, 0.0]), np.array([1.0, 2.0, 3.0]))
    faults = faults_of(
        {"part": "pressure", "type": "wrong", "start_s": 0, "size": 0.5},
        {"part": "ahrs", "type": "wrong", "start_s": 0, "size": 10.0},
        {"part": "dvl", "type": "stuck", "start_s": 0},
        {"part": "usbl", "type": "garbage", "start_s": 0, "size": 2.0},
    )  # fmt: skip
    faults.at(0.0, HERE)
    first = faults.readings(truth)
    faults.at(1.0, HERE)
    second = faults.readings(Readings(2.0, truth.ahrs_rpy_rad, np.ones(3), truth.usbl_m))
    assert (first.pressure_z_m, second.pressure_z_m) == (1.5, 2.5)
    np.testing.assert_allclose(first.ahrs_rpy_rad - truth.ahrs_rpy_rad, np.deg2rad(10))
    np.testing.assert_array_equal(second.dvl_mps, truth.dvl_mps)
    assert 0.1 < np.abs(second.usbl_m - truth.usbl_m).max() < 10


@pytest.mark.parametrize(("fault", "problem"), [
    ('{part="thruster"}', "faults.0.number: missing (allowed: 1 to 8)"),
    ('{part="thruster",number=9,start_s=1}', "faults.0.number: 9 (allowed: 1 to 8)"),
    ('{part="dvl",start_s=1}', "faults.0.part: dvl is not used (allowed: a sensor in navigation.aiding)"),
    ('{part="pressure"}', "faults.0.start_s: missing (allowed: either start_s, at_m or per_hour)"),
    ('{part="pressure",start_s=1,per_hour=1}', "faults.0.start_s: given together with per_hour"),
    ('{part="pressure",type="intermittent",start_s=1,size=2}', "faults.0.size: 2: not a share of the frames"),
    ('{part="thruster",number=1,type="garbage",start_s=1}', "faults.0.type: garbage: not simulated for thruster"),
    ('{part="cameras",start_s=1}', "faults.0.part: cameras: the surrogate has no images"),
    ('{part="pump",start_s=1}', "faults.0.part"),
    ('{part="water",type="silt",start_s=1,size=-0.5}', "faults.0.size: -0.5: not a share of the contrast"),
    ('{part="fish",type="school",start_s=1,size=-3}', "faults.0.size: -3: not a number of fish"),
])  # fmt: skip
def test_a_fault_that_cannot_be_is_refused_before_the_flight(fault, problem):
    with pytest.raises(ScenarioError) as raised:
        prepare(load_scenario("reef", ["imaging.fidelity=surrogate", f"faults=[{fault}]"]))
    assert any(problem in line for line in raised.value.lines), raised.value.lines


def test_all_faults_that_cannot_be_are_named_at_once():
    refused = [
        ('{part="tether",start_s=1,at_m=[0,0]}', "start_s: given together with at_m (allowed: either start_s"),
        ('{part="thruster",number=1,start_s=1,radius_m=2}', "radius_m: has no effect without a place"),
        ('{part="thruster",number=1,at_m=[3,0]}', "at_m: (3.0, 0.0): the left camera comes no nearer than"),
        ('{part="thruster",number=1,start_s=1,direction_deg=9}', "direction_deg: has no effect on off"),
        ('{part="lamp",start_s=1}', "part: lamp: the surrogate has no images"),
        ('{part="lamp",number=3,start_s=1}', "number: 3 (allowed: 1 to 2)"),
        ('{part="lamp",type="stuck",start_s=1}', "type: stuck: not simulated for lamp"),
        ('{part="water",type="silt",start_s=1}', "part: water: the surrogate has no images"),
        ('{part="pressure",type="delayed",size=0,start_s=1}', "size: 0: not a delay (allowed: above 0)"),
    ]
    faults = ",".join(fault for fault, _ in refused)
    with pytest.raises(ScenarioError) as raised:
        prepare(load_scenario("reef", ["imaging.fidelity=surrogate", f"faults=[{faults}]"]))
    for k, (_, problem) in enumerate(refused):
        assert any(f"faults.{k}.{problem}" in line for line in raised.value.lines), raised.value.lines


def flown(tmp_path, *overrides):
    short = ["imaging.fidelity=surrogate", "plan.area_m=[2.0,0.6]", "plan.tracks=1", "seed=1", *overrides]
    return run(load_scenario("reef", short), tmp_path / "run", outputs=None).metrics


FAST = [("dvl", "wrong", 0.3), ("usbl", "garbage", 3.0)]
LONG = [
    ("pressure", "wrong", 0.3), ("ahrs", "garbage", 10.0), ("usbl", "wrong", 3.0), ("dvl", "off", 1.0),
    ("pressure", "stuck", 1.0),
]  # fmt: skip


@pytest.mark.parametrize(("part", "type_", "size"), [*FAST, *(pytest.param(*f, marks=pytest.mark.long) for f in LONG)])
def test_a_sensor_that_fails_leaves_the_path_right(tmp_path, part, type_, size):
    fault = f'faults=[{{part="{part}",type="{type_}",start_s=3,size={size}}}]'
    metrics = flown(tmp_path, AIDED, fault)
    assert metrics["trajectory"]["final"]["ate_max_m"] < 0.01
    assert metrics["trajectory"]["online"]["ate_max_m"] < 0.02
    warnings = [*metrics["warnings"], metrics["reason"]]
    assert any(part in text for text in warnings if "Simulated" not in text), warnings


@pytest.mark.parametrize("number", [1, 5])
def test_a_survey_without_a_thruster_is_flown_to_its_end(tmp_path, number):
    metrics = flown(tmp_path, f'faults=[{{part="thruster",number={number},start_s=3}}]')
    assert metrics["status"] == "complete" and metrics["control"]["cross_track_rmse_m"] < 0.1
    log = [json.loads(line) for line in (tmp_path / "run" / "log.jsonl").read_text().splitlines()]
    assert [one["part"] for one in log if one["event"] == "fault"] == [f"thruster {number}"]


def test_silt_takes_contrast_at_equal_brightness_and_settles():
    image = np.random.default_rng(1).integers(20, 200, (40, 60, 3), np.uint8)
    given = faults_of({"part": "water", "type": "silt", "start_s": 2.0, "duration_s": 4.0, "size": 0.8})
    spread = {}
    for time_s in (1.9, 2.5, 5.0, 9.0, 30.0):
        given.at(time_s, HERE)
        left, _ = given.images(image, None)
        spread[time_s] = left.std() / image.std()
        assert left.mean() == pytest.approx(image.mean(), abs=0.5)
    assert spread[1.9] == spread[30.0] == 1
    assert spread[2.5] == pytest.approx(0.6, abs=0.01) and spread[5.0] == pytest.approx(0.2, abs=0.01)
    assert spread[9.0] == pytest.approx(1 - 0.8 * np.exp(-1), abs=0.01)


def test_a_cloud_that_has_ended_does_not_rise():
    image = np.random.default_rng(1).integers(20, 200, (40, 60, 3), np.uint8)
    given = faults_of({"part": "water", "type": "silt", "start_s": 2.0, "duration_s": 0.2, "size": 1.0})
    spread = []
    for time_s in (2.2, 2.5, 3.0, 4.0):
        given.at(time_s, HERE)
        spread.append(given.images(image, None)[0].std() / image.std())
    assert spread[0] == pytest.approx(0.8, abs=0.02) and spread == sorted(spread)


def test_fish_move_and_have_the_parallax_of_their_distance():
    blank = np.full((RIG.height_px, RIG.width_px, 3), 255, np.uint8)
    given = faults_of({"part": "fish", "type": "school", "start_s": 0.0, "size": 1}, seed=3)
    columns = []
    for time_s in (0.0, 0.5):
        given.at(time_s, HERE)
        views = given.images(blank, blank)
        columns.append([np.nonzero((view < 255).any(axis=2))[1].mean() for view in views])
    (left, right), (later, _) = columns
    near, far = (RIG.focal_px * RIG.baseline_m / (share * 2.0) for share in (0.3, 0.7))
    assert far - 1 < left - right < near + 1 and abs(later - left) > 3
    given = faults_of({"part": "fish", "type": "school", "start_s": 5.0, "duration_s": 1.0, "size": 3})
    given.at(7.0, HERE)
    assert (given.images(blank, None)[0] == blank).all()


def test_a_school_of_fish_stays_the_same_when_another_fault_ends():
    blank = np.full((RIG.height_px, RIG.width_px, 3), 255, np.uint8)
    school = {"part": "fish", "type": "school", "start_s": 0.0, "size": 3}
    off = {"part": "pressure", "type": "off", "at_m": [0.0, 0.0], "radius_m": 9.0, "duration_s": 2.0}
    seen = []
    for given in (faults_of(off, school, seed=3), faults_of(school, seed=3)):
        for time_s in (0.0, 1.9, 2.1):
            given.at(time_s, HERE)
            image = given.images(blank, None)[0]
        seen.append(image)
    np.testing.assert_array_equal(*seen)


def test_a_fault_of_a_place_starts_when_the_camera_first_comes_there_and_only_then():
    faults = faults_of({"part": "pressure", "at_m": [1.0, 0.0], "radius_m": 0.3, "duration_s": 2.0})
    for time_s, x in enumerate((0.0, 0.6, 0.75, 1.0, 1.2, 1.5, 1.0, 0.0)):
        faults.at(float(time_s), np.array([x, 0.1, 5.0]))
    assert [(event.time_s, event.starts) for event in faults.events] == [(2.0, True), (4.0, False)]


@pytest.mark.parametrize("fidelity", ["surrogate", pytest.param("rendered", marks=pytest.mark.long)])
def test_the_true_path_meets_the_fault_where_it_first_enters_the_radius(fidelity):
    """A vehicle that pushes forwards and then sideways, without an estimator, in both worlds."""
    given = 'faults=[{part="thruster",number=5,at_m=[-0.4,-0.2],radius_m=0.3,duration_s=1}]'
    scenario = load_scenario("reef", [f"imaging.fidelity={fidelity}", "plan.area_m=[2.0,0.6]", "plan.tracks=1", given])
    with twin.World(scenario) as world:
        world.reset()
        for k in range(150):
            ahead = 1.0 if k < 75 else -1.0
            world.step(0.5 * np.array([1, 1, ahead, ahead, 0, 0, 0, 0]))
        path, (began, ended) = world.truth().trajectory, world.world.faults.events
    inside = np.linalg.norm(path.positions[:, :2] - [-0.4, -0.2], axis=1) <= 0.3
    assert began.time_s == pytest.approx(path.times_s[np.argmax(inside)]) and 0 < began.time_s < 4
    assert ended.time_s == pytest.approx(began.time_s + 1)


def test_readings_that_are_delayed_arrive_late_and_none_is_lost():
    faults = faults_of({"part": "dvl", "type": "delayed", "start_s": 2.0, "size": 1.5})
    arrived = []
    for time_s in np.arange(0.0, 8.0):
        faults.at(time_s, HERE)
        found = faults.readings(Readings(dvl_mps=None if time_s == 5 else np.full(3, time_s))).dvl_mps
        arrived.append(None if found is None else found[0])
    assert arrived == [0, 1, None, None, 2, 3, 4, None]


def gust_flow(given, port=(0.0, 1.0, 0.0), end_s=20.0):
    """Returns the times (n,) and the flow (n, 5, 3) of a sea in which a gust blows while frames go by."""
    faults, sea = faults_of(given), make_sea(Scenario(faults=[FaultConfig(**given)]))
    times_s, flows = np.arange(0.0, end_s, 0.1), []
    for time_s in times_s:
        faults.at(time_s, HERE)
        faults.blow(sea.single_gusts, np.array(port))
        flows.append(flow_at(sea, time_s, HERE))
    return times_s, np.array(flows)


@pytest.mark.parametrize(("direction", "port", "along"), [
    ({"direction_deg": 90.0}, (1.0, 0.0, 0.0), (0, 1, 0)), ({}, (-1.0, 0.0, 0.0), (-1, 0, 0)),
])  # fmt: skip
def test_a_gust_moves_the_water_by_its_speed_in_its_direction_while_it_lasts(direction, port, along):
    given = {"part": "water", "type": "gust", "start_s": 3.0, "duration_s": 6.0, "size": 0.4, **direction}
    times_s, flow = gust_flow(given, port)
    np.testing.assert_allclose(flow[(times_s < 3) | (times_s > 10.05)], 0.0, atol=1e-12)
    full = (times_s > 4.05) & (times_s < 8.95)
    np.testing.assert_allclose(flow[full, 0], np.tile(0.4 * np.array(along), (full.sum(), 1)), atol=1e-12)
    changes = np.gradient(flow[:, 0], times_s, axis=0)
    np.testing.assert_allclose(flow[:, 1], changes, atol=0.06)  # second difference of the cubic: 6 * 0.4 * 0.1 / 4


def test_a_vehicle_without_thrust_drifts_with_a_gust():
    sea = make_sea(Scenario(faults=[FaultConfig(part="water", type="gust", start_s=0.0)]))
    sea.single_gusts[0] = 0.0, np.inf, 0.0, 0.3, 0.0
    vehicle = CompiledVehicle(VehicleConfig(buoyancy_n=0.0), sea, np.eye(4), 1 / 120)
    vehicle.step(np.zeros(8), 30.0)
    assert (vehicle.world_from_body[:3, :3] @ vehicle.twist_body[3:])[1] == pytest.approx(0.3, abs=0.005)


def test_lamps_that_go_out_take_their_share_of_the_light():
    """Light is additive: that of both lamps is the sum of those of each; without any, there is none."""
    scenario = load_scenario(
        "reef", ["rig.image_width_px=64", "rig.image_height_px=48", "water.jerlov=clear", "snow.density_per_m3=200"]
    )
    rig, light = scenario.believed_rig(), []
    depth = np.full((rig.height_px, rig.width_px), 2.0, np.float32)
    white, pose = np.full((*depth.shape, 3), 255, np.uint8), StampedPose(np.diag([1.0, -1.0, -1.0, 1.0]), 0.0)
    formation = ImageFormation(scenario, illumination_of(scenario), None, np.random.default_rng(0))
    for lit in ((True, True), (True, False), (False, True), (False, False), (True, True)):
        formation.light_lamps(lit)
        light.append(formation.radiance(RenderedView(white, depth, 0, pose)))
    both, first, second, none, again = light
    np.testing.assert_allclose(first + second, both, rtol=1e-4)
    assert not none.any() and min(first.mean(), second.mean()) > 0.3 * both.mean()
    np.testing.assert_array_equal(again, both)


@pytest.mark.long
def test_images_are_dark_while_the_lamps_are_out(tmp_path):
    given = 'faults=[{part="lamp",start_s=2,duration_s=2}]'
    scenario = load_scenario("reef", ["plan.area_m=[2.0,0.6]", "plan.tracks=1", given])
    with twin.World(scenario) as world:
        frame, command, levels = world.reset(), np.zeros(8), []
        for _ in range(150):
            levels.append((frame.time_s, frame.left.mean()))
            frame = world.step(command)
    dark = [level for time_s, level in levels if 2 <= time_s < 4 - 1e-9]
    assert max(dark) < 3 < 50 < min(level for time_s, level in levels if time_s < 2 or time_s > 6)


def test_gusts_in_quick_succession_make_no_step():
    """A gust rises and falls within 1 s: by at most 1.5 times its speed in one second (a cubic)."""
    given = {"part": "water", "type": "gust", "per_hour": 3600.0, "duration_s": 2.0, "size": 1.0, "direction_deg": 0.0}
    times_s, flow = gust_flow(given, end_s=60.0)
    assert np.ptp(flow[:, 0, 0]) > 0.9
    assert np.abs(np.diff(flow[:, 0, 0])).max() <= 1.5 * (times_s[1] - times_s[0]) + 1e-9
