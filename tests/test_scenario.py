"""The scenario file: every fault told at once, exactly, with file and line; what is right survives a round trip."""

from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from twin.errors import ScenarioError, TwinError
from twin.scenario.file import dump_toml, load_scenario
from twin.scenario.model import Scenario

PLAN_KEYS = "pattern, area_m, altitude_m, speed_mps, overlap_along, overlap_across, tracks, clearance_m"
TOP_KEYS = (
    "name, seed, terrain, vehicle, rig, imaging, sensor, lens, port, calibration_error, water, lamps, sun, snow, "
    "current, navigation, plan, control, estimate, map, beacons, require"
)
SENSOR_KEYS = (
    "exposure_min_ms, exposure_max_ms, exposure_lag_s, gain_max_db, f_number, pixel_um, quantum_efficiency, "
    "full_well_e, read_noise_e, bits, bayer, vignetting_power, motion_blur, readout_ms"
)

BAD_FILES = [
    ('nme = "x"', [f"1: nme: unknown key (did you mean name?) (allowed: {TOP_KEYS})"]),
    ("[plan]\naltitude = 2.0", [f"2: plan.altitude: unknown key (did you mean altitude_m?) (allowed: {PLAN_KEYS})"]),
    ("[plan]\nplan.x = 3", [f"1: plan.plan: unknown key (allowed: {PLAN_KEYS})"]),
    (
        "# a survey\n[plan]\noverlap_along = 0\noverlap_across = 1.0",
        [
            "3: plan.overlap_along: 0: not allowed (allowed: greater than 0)",
            "4: plan.overlap_across: 1.0: not allowed (allowed: less than 1)",
        ],
    ),
    (
        '[plan]\nalitude_m = 2.0\n[rig]\nhfov_deg = 170.0\n\n[watr]\njerlov = "I"',
        [
            "4: rig.hfov_deg: 170.0: not allowed (allowed: less than 150)",
            f"2: plan.alitude_m: unknown key (did you mean altitude_m?) (allowed: {PLAN_KEYS})",
            f"6: watr: unknown key (did you mean water?) (allowed: {TOP_KEYS})",
        ],
    ),
    ("seed = -1", ["1: seed: -1: not allowed (allowed: greater than or equal to 0)"]),
    ('name = ""', ["1: name: '': not allowed (allowed: a text that is not empty)"]),
    ("[imaging]\nshadows = 2", ["2: imaging.shadows: 2: not allowed (allowed: true or false)"]),
    ("[snow]\nalbedo = 1.2", ["2: snow.albedo: 1.2: not allowed (allowed: less than or equal to 1)"]),
    ("[snow]\ndensity_per_m3 = -1", ["2: snow.density_per_m3: -1: not allowed (allowed: greater than or equal to 0)"]),
    ("[snow]\ndiameter_m = 0", ["2: snow.diameter_m: 0: not allowed (allowed: greater than or equal to 0.0001)"]),
    ("sensor = 3", ["1: sensor: 3: not allowed (allowed: a section)"]),
    (
        "[sensor]\nexposure_min_ms = 0\nquantum_efficiency = [0.4, 1.5, 0.3]\nfull_well_e = 0\nbits = 10\niso = 100",
        [
            "2: sensor.exposure_min_ms: 0: not allowed (allowed: greater than 0)",
            "3: sensor.quantum_efficiency.1: 1.5: not allowed (allowed: less than or equal to 1)",
            "4: sensor.full_well_e: 0: not allowed (allowed: greater than or equal to 100)",
            "5: sensor.bits: 10: not allowed (allowed: 8 or 12)",
            f"6: sensor.iso: unknown key (allowed: {SENSOR_KEYS})",
        ],
    ),
    ("[rig]\nimage_width_px = 320.5", ["2: rig.image_width_px: 320.5: not allowed (allowed: a whole number)"]),
    ("[rig]\nframe_rate_hz = 3", ["2: rig.frame_rate_hz: 3: not allowed (allowed: greater than or equal to 5)"]),
    ('[rig]\nbaseline_m = "wide"', ["2: rig.baseline_m: 'wide': not allowed (allowed: a number)"]),
    ("[estimate]\nuse_f2m = 2", ["2: estimate.use_f2m: 2: not allowed (allowed: true or false)"]),
    ("[plan]\nspeed_mps = nan", ["2: plan.speed_mps: nan: not allowed (allowed: a finite number)"]),
    (
        '[plan]\npattern = "spiral"',
        ["2: plan.pattern: 'spiral': not allowed (allowed: 'lawnmower' or 'loops')"],
    ),
    ("[plan]\narea_m = [0.0, 2.0]", ["2: plan.area_m.0: 0.0: not allowed (allowed: greater than 0)"]),
    ("plan = 3", ["1: plan: 3: not allowed (allowed: a section)"]),
    ("lamps = 3", ["1: lamps: 3: not allowed (allowed: a list)"]),
    ("[[lamps]]\nintensity_cd = 3.0", ["1: lamps.0.position_m: missing (allowed: a value must be given)"]),
    (
        "[[lamps]]\nposition_m = [0, 0, 0]\n[[lamps]]\nposition_m = [0, 0, 0]\ntilt_deg = 91",
        ["5: lamps.1.tilt_deg: 91: not allowed (allowed: less than or equal to 90)"],
    ),
    (
        '[navigation]\naiding = ["pressure", "sonar"]',
        ["2: navigation.aiding.1: 'sonar': not allowed (allowed: 'pressure', 'ahrs', 'dvl', 'usbl' or 'beacons')"],
    ),
    ("[navigation]\nusbl_interval_s = 0", ["2: navigation.usbl_interval_s: 0: not allowed (allowed: greater than 0)"]),
    (
        "[navigation]\ndvl_sigma_mps = 0.0\ndvl_scale_sigma = 0.2",
        [
            "2: navigation.dvl_sigma_mps: 0.0: not allowed (allowed: greater than 0)",
            "3: navigation.dvl_scale_sigma: 0.2: not allowed (allowed: less than or equal to 0.1)",
        ],
    ),
    (
        "[[beacons]]\nposition_m = [0, 0, 1]\n[[beacons]]\nposition_m = [0, nan, 1]\n[[beacons]]\ncolour = 3",
        [
            "4: beacons.1.position_m.1: nan: not allowed (allowed: a finite number)",
            "5: beacons.2.position_m: missing (allowed: a value must be given)",
            "6: beacons.2.colour: unknown key (allowed: position_m)",
        ],
    ),
    (
        '[water]\njerlov = "X"',
        [
            "2: water.jerlov: 'X': not allowed"
            " (allowed: 'clear', 'I', 'IA', 'IB', 'II', 'III', '1C', '3C', '5C', '7C' or '9C')"
        ],
    ),
    (
        '[terrain]\nkind = "lava"',
        ["2: terrain.kind: 'lava': not allowed (allowed: 'flat', 'ripples', 'fractal', 'reef' or 'file')"],
    ),
    ('[require]\n"map.le90_m" = "x"', ["2: require.map.le90_m: 'x': not allowed (allowed: a number)"]),
    ('extends = "none.toml"', ["1: extends: no such file 'none.toml'"]),
    ('extends = "bad.toml"', ["1: extends: the file extends itself (allowed: another file)"]),
    ('name = "a"\nseed = = 1', ["2: not TOML: Invalid value (at line 2, column 8)"]),
]

SCENES = sorted(file.stem for file in (Path(__file__).parent.parent / "scenes").glob("*.toml"))

BAD_OVERRIDES = [
    ("plan.tracks", "--set plan.tracks: not of the form key=value (for instance plan.tracks=2)"),
    ("=3", "--set =3: not of the form key=value (for instance plan.tracks=2)"),
    ("plan.tracks=x", "--set: plan.tracks: 'x': not allowed (allowed: a whole number)"),
    ("plan.overlap_along=1.0", "--set: plan.overlap_along: 1.0: not allowed (allowed: less than 1)"),
    ("nme=3", f"--set: nme: unknown key (did you mean name?) (allowed: {TOP_KEYS})"),
    ("name.x=3", "--set name.x=3: name is a value, not a section"),
    ("lamps.0.intensity_cd=-1", "--set: lamps.0.intensity_cd: -1: not allowed (allowed: greater than or equal to 0)"),
    ("lamps.tilt_deg=1", "--set lamps.tilt_deg=1: name one of the list, as in lamps.0.tilt_deg=..."),
]


def written(folder, text, name="bad.toml"):
    file = folder / name
    file.write_text(text)
    return file


@pytest.mark.parametrize(("text", "faults"), BAD_FILES, ids=[text.replace("\n", " ")[:40] for text, _ in BAD_FILES])
def test_a_bad_file_is_told_by_line_all_faults_at_once(tmp_path, text, faults):
    file = written(tmp_path, text)
    with pytest.raises(ScenarioError) as told:
        load_scenario(file)
    assert told.value.lines == [f"{file}:{fault}" for fault in faults]


@pytest.mark.parametrize(("override", "fault"), BAD_OVERRIDES)
def test_a_bad_override_is_told_as_such(override, fault):
    with pytest.raises(ScenarioError) as told:
        load_scenario("quickstart", [override])
    assert told.value.lines == [fault]


def test_a_missing_scenario_is_told_with_the_names_there_are():
    with pytest.raises(ScenarioError) as told:
        load_scenario("quikstart")
    assert told.value.lines == [
        f"quikstart: no such scenario (did you mean quickstart?) (allowed: a file, or one of {', '.join(SCENES)})"
    ]


def test_an_unreadable_file_is_told(tmp_path):
    file = tmp_path / "latin.toml"
    file.write_bytes(b'name = "\xe9"')
    with pytest.raises(ScenarioError, match=r"latin.toml:1: cannot be read: .*utf-8"):
        load_scenario(file)


def test_faults_found_later_are_told_by_the_line_of_their_key_or_of_its_section(tmp_path):
    source = load_scenario(written(tmp_path, "[rig]\n\n[plan]\naltitude_m = 2.0"), ["plan.tracks=1"]).source
    fault = TwinError("plan.altitude_m", "too low", "3")
    assert source.fault(fault) == f"{source.path}:4: plan.altitude_m: too low (allowed: 3)"
    assert source.fault(TwinError("rig.hfov_deg", "no")) == f"{source.path}:1: rig.hfov_deg: no"
    assert source.fault(TwinError("water.jerlov", "no")) == f"{source.path}:1: water.jerlov: no"
    assert source.fault(TwinError("plan.tracks", "no")) == "--set: plan.tracks: no"


@pytest.mark.parametrize("name", SCENES)
def test_the_scenes_survive_a_round_trip_through_toml(tmp_path, name):
    scenario = load_scenario(name)
    again = load_scenario(written(tmp_path, dump_toml(scenario)))
    assert again.model_dump() == scenario.model_dump() and again.fingerprint() == scenario.fingerprint()


@settings(max_examples=40, deadline=None)
@given(
    name=st.text(st.characters(blacklist_categories=("C",)), min_size=1, max_size=20),
    seed=st.integers(0, 2**32 - 1),
    tilt=st.floats(-90, 90),
    drag=st.floats(0.05, 20),
    aiding=st.lists(st.sampled_from(["pressure", "ahrs", "dvl", "usbl", "beacons"]), max_size=5),
    beacons=st.lists(st.tuples(*[st.floats(-1e3, 1e3)] * 3), max_size=3),
    limit=st.floats(1e-9, 1e9),
)
def test_any_scenario_survives_a_round_trip_through_toml(
    tmp_path_factory, name, seed, tilt, drag, aiding, beacons, limit
):
    scenario = Scenario.model_validate(
        {
            "name": name,
            "seed": seed,
            "vehicle": {"drag_factor": drag},
            "lamps": [{"position_m": (0.1, -0.2, 0.0), "tilt_deg": tilt}, {"position_m": (1, 2, 3)}],
            "navigation": {"aiding": aiding},
            "beacons": [{"position_m": position} for position in beacons],
            "require": {"map.le90_m": limit},
        }
    )
    file = written(tmp_path_factory.mktemp("round"), dump_toml(scenario))
    assert load_scenario(file).model_dump() == scenario.model_dump()


def test_a_sensor_is_there_where_its_section_is_and_survives_a_round_trip(tmp_path):
    assert load_scenario("quickstart").sensor is None
    scenario = load_scenario(written(tmp_path, "[sensor]\nbits = 8\nreadout_ms = 12.5"))
    assert scenario.sensor.bits == 8 and scenario.sensor.bayer
    assert load_scenario(written(tmp_path, dump_toml(scenario))).sensor == scenario.sensor


def test_a_scenario_extends_another_key_by_key(tmp_path):
    written(tmp_path, 'name = "base"\n[plan]\naltitude_m = 3.0\nspeed_mps = 0.5\n[water]\njerlov = "II"', "base.toml")
    scenario = load_scenario(written(tmp_path, 'extends = "base.toml"\nseed = 4\n[plan]\naltitude_m = 2.5', "top.toml"))
    assert (scenario.name, scenario.seed, scenario.water.jerlov) == ("base", 4, "II")
    assert (scenario.plan.altitude_m, scenario.plan.speed_mps) == (2.5, 0.5)


def test_overrides_win_over_the_file_and_are_read_as_toml():
    scenario = load_scenario("quickstart", ["plan.tracks=2", "water.jerlov=II", "name=mine", "lamps.1.tilt_deg=5"])
    assert (scenario.plan.tracks, scenario.water.jerlov, scenario.name) == (2, "II", "mine")
    assert (scenario.lamps[0].tilt_deg, scenario.lamps[1].tilt_deg) == (0.0, 5.0)
    assert load_scenario("quickstart", ["require.map.le90_m=0.1"]).require == {"map.le90_m": 0.1}
    assert load_scenario("quickstart", ["navigation.aiding=[]"]).navigation.aiding == ()


def test_paths_are_relative_to_the_file_that_names_them(tmp_path, monkeypatch):
    (tmp_path / "sub").mkdir()
    written(tmp_path / "sub", '[terrain]\nkind = "file"\nheight_file = "dem.tif"', "base.toml")
    top = written(
        tmp_path, 'extends = "sub/base.toml"\n[terrain]\ntexture_file = "${TWIN_DATA}/gravel.png"', "top.toml"
    )
    monkeypatch.setenv("TWIN_DATA", str(tmp_path / "data"))
    terrain = load_scenario(top).terrain
    assert Path(terrain.height_file) == tmp_path / "sub" / "dem.tif"
    assert Path(terrain.texture_file) == tmp_path / "data" / "gravel.png"


def test_equal_scenarios_have_equal_fingerprints_and_others_do_not():
    one, two, other = (load_scenario("quickstart", [f"seed={k}"]) for k in (1, 1, 2))
    assert one.fingerprint() == two.fingerprint() != other.fingerprint()


def test_the_believed_rig_keeps_the_field_of_view_and_straddles_the_mount():
    scenario = load_scenario("quickstart", ["rig.hfov_deg=90.0", "rig.baseline_m=0.2", "rig.mount_m=[0.1,0.0,-0.3]"])
    rig = scenario.believed_rig()
    assert rig.focal_px == pytest.approx(160.0)  # half the width over tan 45 deg
    left, right = rig.body_from_camera[:3, 3], (rig.body_from_camera @ rig.left_from_right)[:3, 3]
    assert (left + right) / 2 == pytest.approx([0.1, 0.0, -0.3])
    assert left - right == pytest.approx([0.0, 0.2, 0.0])  # the left camera is to port
