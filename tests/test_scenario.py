"""The scenario file: all errors reported at once with file and line; exact round trip through TOML."""

import re
import tomllib
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from twin.errors import ScenarioError, TwinError
from twin.imaging.light.spectra import NM
from twin.imaging.light.water import read_spectrum
from twin.scenario.file import dump_toml, load_scenario
from twin.scenario.model import EstimateConfig, Scenario
from twin.scenario.toml_text import key_lines, value_errors
from twin.studies.study_file import load_study
from twin.studies.surveys import surveys

PLAN_KEYS = (
    "pattern, area_m, centre_m, centre_crs, heading_deg, along_contours, polygon, turns, altitude_m, speed_mps, "
    "overlap_along, overlap_across, overlap_reference, height, tracks, cross_lines, cross_rise_m, fill_gaps, "
    "clearance_m"
)
TOP_KEYS = (
    "name, seed, scene_seed, record, terrain, vehicle, rig, imaging, sensor, lens, port, calibration_error, water, "
    "lamps, sun, snow, current, waves, tether, navigation, imu, plan, control, estimate, map, beacons, objects, tasks, "
    "faults, require"
)
SENSOR_KEYS = (
    "exposure_min_ms, exposure_max_ms, exposure_lag_s, gain_max_db, f_number, pixel_um, quantum_efficiency, "
    "full_well_e, read_noise_e, bits, bayer, vignetting_power, shading_correction, motion_blur, readout_ms, "
    "tone_curve, white_balance, white_gains, white_temperature_k"
)
IMU_KEYS = (
    "rate_hz, gyroscope_noise_density, gyroscope_random_walk, gyroscope_bias_sigma_radps, accelerometer_noise_density, "
    "accelerometer_random_walk, accelerometer_bias_sigma_mps2"
)

SCENES = sorted(file.stem for file in (Path(__file__).parent.parent / "scenes").glob("*.toml"))

BAD_FILES = [
    ('nme = "x"', [f"1: nme: unknown key (did you mean name?) (allowed: {TOP_KEYS})"]),
    ("[plan]\naltitude = 2.0", [f"2: plan.altitude: unknown key (did you mean altitude_m?) (allowed: {PLAN_KEYS})"]),
    ("[plan]\nplan.x = 3", [f"2: plan.plan: unknown key (allowed: {PLAN_KEYS})"]),
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
    ('name = ""', ["1: name: '': not allowed (allowed: a non-empty string)"]),
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
    ("[rig]\nimage_width_px = 320.5", ["2: rig.image_width_px: 320.5: not allowed (allowed: an integer)"]),
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
        [
            "2: navigation.aiding.1: 'sonar': not allowed (allowed: 'pressure', 'ahrs', 'dvl', 'usbl', 'beacons' or"
            " 'imu')"
        ],
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
        "[imu]\nrate_hz = 0\ngyroscope_noise_density = -1e-3\naccelerometer_random_walk = nan\nnoise = 3",
        [
            "2: imu.rate_hz: 0: not allowed (allowed: greater than 0)",
            "3: imu.gyroscope_noise_density: -0.001: not allowed (allowed: greater than or equal to 0)",
            "4: imu.accelerometer_random_walk: nan: not allowed (allowed: a finite number)",
            f"5: imu.noise: unknown key (allowed: {IMU_KEYS})",
        ],
    ),
    ("imu = true", ["1: imu: True: not allowed (allowed: a section)"]),
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
        [
            "2: terrain.kind: 'lava': not allowed "
            "(allowed: 'flat', 'ripples', 'fractal', 'reef', 'cliffs', 'file' or 'mesh')"
        ],
    ),
    ('[require]\n"map.le90_m" = "x"', ["2: require.map.le90_m: 'x': not allowed (allowed: a number)"]),
    (
        'extends = "none.toml"',
        [
            "1: extends: no such file 'none.toml' (allowed: a path relative to this file, or one of "
            + ", ".join(SCENES)
            + ")"
        ],
    ),
    ('extends = "bad.toml"', ["1: extends: the file extends itself (allowed: another file)"]),
    ("seed = 3\n[calibration]\nfocal_error = 0.1", ["2: calibration: renamed to calibration_error"]),
    ("calibration.focal_error = 0.1", ["1: calibration: renamed to calibration_error"]),
    (
        "[plan]\narea_m = ['4', true]",
        [
            "2: plan.area_m.0: '4': not allowed (allowed: a number)",
            "2: plan.area_m.1: True: not allowed (allowed: a number)",
        ],
    ),
    ("[terrain]\ntexture_px_m = '0.01'", ["2: terrain.texture_px_m: '0.01': not allowed (allowed: a number)"]),
    ("[require]\n'map.le90_m' = '1'", ["2: require.map.le90_m: '1': not allowed (allowed: a number)"]),
    (
        '[calibration]\n[imaging]\ncalibration = "x.toml"',
        [
            "1: calibration: renamed to calibration_error",
            "3: imaging.calibration: renamed to imaging.error_model",
        ],
    ),
    (
        'imaging = { shadows = true, calibration = "x.toml" }',
        ["1: imaging.calibration: renamed to imaging.error_model"],
    ),
    (
        "[calibration]\nfocal_error = 0.1\n[plan]\naltitud_m = 2\nspeed_mps = 9",
        [
            "1: calibration: renamed to calibration_error",
            "5: plan.speed_mps: 9: not allowed (allowed: less than or equal to 2)",
            f"4: plan.altitud_m: unknown key (did you mean altitude_m?) (allowed: {PLAN_KEYS})",
        ],
    ),
    ("plan.tracks = 2\nplan.speed_mps = 9", ["2: plan.speed_mps: 9: not allowed (allowed: less than or equal to 2)"]),
    (
        'name = """\nspeed_mps = 1\n[plan]"""\n[plan]\nspeed_mps = 9',
        ["5: plan.speed_mps: 9: not allowed (allowed: less than or equal to 2)"],
    ),
    (
        "lamps = [\n  { position_m = [0, 0, 0] },  # first\n  { position_m = [\n    0, 0, nan] },\n]\nseed = -1",
        [
            "6: seed: -1: not allowed (allowed: greater than or equal to 0)",
            "4: lamps.1.position_m.2: nan: not allowed (allowed: a finite number)",
        ],
    ),
    (
        "[[lamps]]\nposition_m = [0, 0, 0]\n[plan]\ntracks = 1\n[[lamps]]\nposition_m = [0, 0, 0]\ntilt_deg = 91",
        ["7: lamps.1.tilt_deg: 91: not allowed (allowed: less than or equal to 90)"],
    ),
    ('name = "a"\nseed = = 1', ["2: not TOML: Invalid value (at line 2, column 8)"]),
]

BAD_OVERRIDES = [
    ("plan.tracks", "--set plan.tracks: not of the form key=value (for instance plan.tracks=2)"),
    ("=3", "--set =3: not of the form key=value (for instance plan.tracks=2)"),
    ("plan.tracks=x", "--set: plan.tracks: 'x': not allowed (allowed: an integer)"),
    ("plan.overlap_along=1.0", "--set: plan.overlap_along: 1.0: not allowed (allowed: less than 1)"),
    ("calibration.focal_error=0.1", "--set: calibration.focal_error: renamed to calibration_error.focal_error"),
    ("imaging.calibration=x.toml", "--set: imaging.calibration: renamed to imaging.error_model"),
    ("watr.jerlov=II", f"--set: watr: unknown key (did you mean water?) (allowed: {TOP_KEYS})"),
    ("nme=3", f"--set: nme: unknown key (did you mean name?) (allowed: {TOP_KEYS})"),
    ("name.x=3", "--set name.x=3: name is a value, not a section"),
    ("lamps.0.intensity_cd=-1", "--set: lamps.0.intensity_cd: -1: not allowed (allowed: greater than or equal to 0)"),
    ("lamps.tilt_deg=1", "--set lamps.tilt_deg=1: an item of the list must be named, as in lamps.0.tilt_deg=..."),
    ("lamps.².tilt_deg=1", "--set lamps.².tilt_deg=1: no item ² (allowed: 0 to 1)"),
    ("lamps.0=1", "--set lamps.0=1: an item cannot be replaced (allowed: a key of an item, or lamps=[...])"),
]


def written(folder, text, name="bad.toml"):
    file = folder / name
    file.write_text(text)
    return file


@pytest.mark.parametrize(("text", "errors"), BAD_FILES, ids=[text.replace("\n", " ")[:40] for text, _ in BAD_FILES])
def test_all_errors_of_a_file_are_reported_with_their_lines(tmp_path, text, errors):
    file = written(tmp_path, text)
    with pytest.raises(ScenarioError) as raised:
        load_scenario(file)
    assert raised.value.lines == [f"{file}:{error}" for error in errors]


@pytest.mark.parametrize(("override", "error"), BAD_OVERRIDES)
def test_an_error_in_an_override_is_reported_as_such(override, error):
    with pytest.raises(ScenarioError) as raised:
        load_scenario("quickstart", [override])
    assert raised.value.lines == [error]


def test_a_missing_scenario_is_reported_with_the_names_available():
    with pytest.raises(ScenarioError) as raised:
        load_scenario("quikstart")
    assert raised.value.lines == [
        f"quikstart: no such scenario (did you mean quickstart?) (allowed: a file, or one of {', '.join(SCENES)})"
    ]


def test_a_byte_order_mark_is_no_part_of_a_file(tmp_path):
    (tmp_path / "marked.toml").write_text("[plan]\naltitude_m = 2.0", "utf-8-sig")
    assert load_scenario(tmp_path / "marked.toml").plan.altitude_m == 2.0
    (tmp_path / "water.csv").write_text("400, 0.1, 0.2\n700, 0.5, 0.1", "utf-8-sig")
    assert read_spectrum(tmp_path / "water.csv")[0] == pytest.approx(0.1 + 0.4 * (NM - 400) / 300)


def test_an_unreadable_file_is_reported(tmp_path):
    file = tmp_path / "latin.toml"
    file.write_bytes(b'name = "\xe9"')
    with pytest.raises(ScenarioError, match=r"latin.toml:1: cannot be read: .*utf-8"):
        load_scenario(file)


def test_an_error_found_later_has_the_line_of_its_key_or_of_its_section(tmp_path):
    source = load_scenario(written(tmp_path, "[rig]\n\n[plan]\naltitude_m = 2.0"), ["plan.tracks=1"]).source
    error = TwinError("plan.altitude_m", "too low", "3")
    assert source.describe(error) == f"{source.path}:4: plan.altitude_m: too low (allowed: 3)"
    assert source.describe(TwinError("rig.hfov_deg", "no")) == f"{source.path}:1: rig.hfov_deg: no"
    assert source.describe(TwinError("water.jerlov", "no")) == f"{source.path}:1: water.jerlov: no"
    assert source.describe(TwinError("plan.tracks", "no")) == "--set: plan.tracks: no"


@pytest.mark.parametrize("name", SCENES)
def test_the_scenes_survive_a_round_trip_through_toml(tmp_path, name):
    scenario = load_scenario(name)
    again = load_scenario(written(tmp_path, dump_toml(scenario)))
    assert again.model_dump() == scenario.model_dump() and again.fingerprint() == scenario.fingerprint()


@pytest.mark.parametrize(
    "name", ["two\nlines", "end\r\n", "\"quoted\" \\ and 'single'", "Seegraswiese ä 深海 🐟", "\x00\x07\x1f\x7f\x85"]
)
def test_names_with_special_characters_survive_a_round_trip_through_toml(tmp_path, name):
    scenario = Scenario(name=name, require={name: 0.5, "map.le90_m": 0.1})
    again = load_scenario(written(tmp_path, dump_toml(scenario)))
    assert (again.name, again.require) == (name, scenario.require)


@settings(max_examples=40, deadline=None)
@given(
    name=st.text(st.characters(blacklist_categories=("Cs",)), min_size=1, max_size=20),
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


def test_an_imu_exists_only_with_its_section(tmp_path):
    plain, fitted = load_scenario("reef"), load_scenario("reef", ["imu={}"])
    assert plain.imu is None and "[imu]" not in dump_toml(plain)
    assert fitted.imu is not None and fitted.fingerprint() != plain.fingerprint()
    assert load_scenario(written(tmp_path, dump_toml(fitted))).imu == fitted.imu


def test_a_sensor_exists_only_with_its_section_and_survives_a_round_trip(tmp_path):
    assert load_scenario("paper").sensor is None
    scenario = load_scenario(written(tmp_path, "[sensor]\nbits = 8\nreadout_ms = 12.5"))
    assert scenario.sensor.bits == 8 and scenario.sensor.bayer
    assert load_scenario(written(tmp_path, dump_toml(scenario))).sensor == scenario.sensor


def test_a_scenario_extends_another_key_by_key(tmp_path):
    written(tmp_path, 'name = "base"\n[plan]\naltitude_m = 3.0\nspeed_mps = 0.5\n[water]\njerlov = "II"', "base.toml")
    scenario = load_scenario(written(tmp_path, 'extends = "base.toml"\nseed = 4\n[plan]\naltitude_m = 2.5', "top.toml"))
    assert (scenario.name, scenario.seed, scenario.water.jerlov) == ("base", 4, "II")
    assert (scenario.plan.altitude_m, scenario.plan.speed_mps) == (2.5, 0.5)


def test_a_scenario_extends_a_built_in_scene_by_name_unless_a_file_has_this_name(tmp_path):
    top = written(tmp_path, 'extends = "reef"\nseed = 4', "top.toml")
    assert load_scenario(top).model_dump() == load_scenario("reef", ["seed=4"]).model_dump()
    (tmp_path / "reef").write_text('name = "mine"')
    assert load_scenario(top).name == "mine"


def test_overrides_replace_values_of_the_file_and_are_read_as_toml():
    scenario = load_scenario("quickstart", ["plan.tracks=2", "water.jerlov=II", "name=mine", "lamps.1.tilt_deg=5"])
    assert (scenario.plan.tracks, scenario.water.jerlov, scenario.name) == (2, "II", "mine")
    assert (scenario.lamps[0].tilt_deg, scenario.lamps[1].tilt_deg) == (0.0, 5.0)
    assert load_scenario("quickstart", ["require.map.le90_m=0.1"]).require == {"map.le90_m": 0.1}
    assert load_scenario("quickstart", ["navigation.aiding=[]"]).navigation.aiding == ()


def test_paths_are_relative_to_the_file_that_contains_them(tmp_path, monkeypatch):
    (tmp_path / "sub").mkdir()
    written(tmp_path / "sub", '[terrain]\nkind = "file"\nheight_file = "dem.tif"', "base.toml")
    top = written(
        tmp_path, 'extends = "sub/base.toml"\n[terrain]\ntexture_file = "${TWIN_DATA}/gravel.png"', "top.toml"
    )
    monkeypatch.setenv("TWIN_DATA", str(tmp_path / "data"))
    mesh = 'shape="mesh", mesh_file="${TWIN_DATA}/wreck.ply", position_m=[0, 0]'
    for override in (f"objects=[{{{mesh}}}]", 'terrain={texture_file="${TWIN_DATA}/wreck.ply"}'):
        scenario = load_scenario("reef", [override])
        found = scenario.objects[0].mesh_file if scenario.objects else scenario.terrain.texture_file
        assert found == str(tmp_path / "data" / "wreck.ply")
    terrain = load_scenario(top).terrain
    assert Path(terrain.height_file) == tmp_path / "sub" / "dem.tif"
    assert Path(terrain.texture_file) == tmp_path / "data" / "gravel.png"


def test_only_equal_scenarios_have_equal_fingerprints():
    one, two, other = (load_scenario("quickstart", [f"seed={k}"]) for k in (1, 1, 2))
    assert one.fingerprint() == two.fingerprint() != other.fingerprint()


def test_the_calibrated_rig_has_the_field_of_view_and_is_centred_on_the_mount():
    scenario = load_scenario("quickstart", ["rig.hfov_deg=90.0", "rig.baseline_m=0.2", "rig.mount_m=[0.1,0.0,-0.3]"])
    rig = scenario.believed_rig()
    assert rig.focal_px == pytest.approx(160.0)  # half the width over tan 45 deg
    left, right = rig.body_from_camera[:3, 3], (rig.body_from_camera @ rig.left_from_right)[:3, 3]
    assert (left + right) / 2 == pytest.approx([0.1, 0.0, -0.3])
    assert left - right == pytest.approx([0.0, 0.2, 0.0])  # the left camera is to port


def test_the_settings_of_the_estimators_are_those_of_the_scenario():
    chosen = load_scenario("quickstart", ["estimate.points=77", "estimate.use_ga=false"]).estimator_settings()
    assert (chosen.points, chosen.use_ga, chosen.max_links) == (77, False, EstimateConfig().max_links)


def test_a_renamed_key_is_reported_in_the_base_file_that_contains_it(tmp_path):
    base = written(tmp_path, "seed = 1\n[calibration]\nk1_error = 0.1", "base.toml")
    with pytest.raises(ScenarioError) as raised:
        load_scenario(written(tmp_path, 'extends = "base.toml"', "top.toml"))
    assert raised.value.lines == [f"{base}:2: calibration: renamed to calibration_error"]


@pytest.mark.parametrize("text", ["imaging = {calibration = 'x'}", "calibration.focal_error = 0.1"])
def test_a_renamed_key_is_reported_with_its_line_in_a_long_file(tmp_path, text):
    file = written(tmp_path, f"#{'-' * 50_000}\n\n{text}")
    with pytest.raises(ScenarioError, match=r"bad.toml:3: (imaging.)?calibration: renamed to ") as raised:
        load_scenario(file)
    assert len(raised.value.lines) == 1


def test_an_error_in_a_base_file_is_reported_there_even_where_the_file_on_top_has_the_section(tmp_path):
    written(tmp_path, "seed = 1\n\n[plan]\nspeed_mps = 9\ntracks = 0", "base.toml")
    top = written(tmp_path, 'extends = "base.toml"\n[plan]\ntracks = -1', "top.toml")
    with pytest.raises(ScenarioError) as raised:
        load_scenario(top)
    places = {line.rpartition("/")[2].split(": ")[0] for line in raised.value.lines}
    assert places == {"base.toml:4", "top.toml:3"}


def test_a_renamed_key_is_reported_at_the_line_of_the_study_that_sets_it(tmp_path):
    file = written(tmp_path, 'scenario = "quickstart"\n[set]\nplan.tracks = 1\ncalibration.k1_error = 0.1')
    with pytest.raises(ScenarioError) as raised:
        list(surveys(load_study(file), tmp_path))
    key = "set.calibration.k1_error"
    assert raised.value.lines == [f"{file}:4: {key}: renamed to calibration_error.k1_error in sample 0"]


LAYOUT = """\
# a = 0
a = 1
"q.r" = \'\'\'
b = 2
[plan]
\'\'\'
x.y.z = 3

[[lamps]]  # first
p = [ # 1, 2
  1,  # 2
  2, {u = 1, v = [
    3]}]
w = 5
[plan]
area.b = 1

[ water . "own type" ]
k = 1
[[ lamps ]]
p = 2
[lamps.beam]
e = {i.j = 1, m = 2}
"""


def test_keys_are_located_in_every_notation_of_toml():
    assert key_lines(LAYOUT) == {
        "a": 2, "q.r": 3, "x": 7, "x.y": 7, "x.y.z": 7,
        "lamps": 9, "lamps.0": 9, "lamps.0.p": 10, "lamps.0.p.0": 11, "lamps.0.p.1": 12, "lamps.0.p.2": 12,
        "lamps.0.p.2.u": 12, "lamps.0.p.2.v": 12, "lamps.0.p.2.v.0": 13, "lamps.0.w": 14,
        "plan": 15, "plan.area": 16, "plan.area.b": 16, "water": 18, "water.own type": 18, "water.own type.k": 19,
        "lamps.1": 20, "lamps.1.p": 21, "lamps.1.beam": 22, "lamps.1.beam.e": 23, "lamps.1.beam.e.i": 23,
        "lamps.1.beam.e.i.j": 23, "lamps.1.beam.e.m": 23,
    }  # fmt: skip


def test_keys_are_located_where_the_tables_of_an_array_have_others_between_them():
    text = "[[a]]\n[[a.b]]\n[c]\n[[a.b]]\nk = 1\n[a.b.d]\n[[a]]\nk = 2\n"
    expected = {"a": 1, "a.0": 1, "a.0.b": 2, "a.0.b.0": 2, "c": 3, "a.0.b.1": 4, "a.0.b.1.k": 5, "a.0.b.1.d": 6}
    assert key_lines(text) == expected | {"a.1": 7, "a.1.k": 8}


VALUES = ["1", "'[t0]'", '"""\nk0 = 1\n[t0]\n"""', "[1, # ]\n 2]", "{ k0 = 1 }", "[{ k0 = [\n1] },\n\n{}]  # end"]


@settings(max_examples=100, deadline=None)
@given(
    st.lists(
        st.tuples(st.sampled_from(["", "[t{}]", "[[many]]", "[[more]]"]), st.lists(st.sampled_from(VALUES))), max_size=8
    )
)
def test_keys_are_located_in_any_order_of_tables_and_arrays(parts):
    rows, expected, counts, path = [], {}, {}, ""
    for number, (header, values) in enumerate(parts):
        if header:
            name = header.strip("[]").format(number)
            path = name
            if header.startswith("[["):
                counts[name] = counts.get(name, -1) + 1
                path = f"{name}.{counts[name]}"
            rows.append(header.format(number))
            expected[path] = len(rows)
        for k, value in enumerate(values):
            key = f"k{number}_{k}"
            expected[f"{path}.{key}" if path else key] = len(rows) + 1
            rows += f"{key} = {value}".split("\n")
    text = "\n".join(rows)
    tomllib.loads(text)  # the generated text is valid
    assert key_lines(text).items() >= expected.items()


def descriptions(schema):
    """Yields name and description of every key in a JSON schema; of a section, that of its model."""
    sections = {"": schema} | schema["$defs"]
    for section, model in sections.items():
        for key, value in model["properties"].items():
            reference = value.get("$ref", "").rpartition("/")[2]
            yield f"{section}.{key}", value.get("description") or sections.get(reference, {}).get("description", "")


def test_every_key_has_a_description_in_plain_words():
    odd = {"eye", "eyes", "told", "tells", "tell", "says", "said", "errs", "beside", "honest", "veil", "drawn"}
    found = dict(descriptions(Scenario.model_json_schema()))
    assert len(found) > 130
    assert not [key for key, text in found.items() if not text.strip()]
    assert not {key: text for key, text in found.items() if odd & set(re.findall(r"[a-z]+", text.lower()))}


@pytest.mark.parametrize(
    ("values", "texel_m"),
    (
        (["rig.image_width_px=1920", "plan.altitude_m=2"], 4 / 3**0.5 / 1920),
        (["rig.image_width_px=320", "plan.altitude_m=2"], 0.005),
        (["terrain.texture_px_m=0.01"], 0.01),
    ),
)
def test_texels_are_as_fine_as_the_pixels_of_the_images_by_default(values: list[str], texel_m: float) -> None:
    assert load_scenario("quickstart", ["rig.hfov_deg=60", *values]).texel_m == pytest.approx(texel_m)


@pytest.mark.parametrize(
    ("value", "valid"), [(-(2**63), True), (2**63 - 1, True), (-(2**63) - 1, False), (2**63, False)]
)
def test_integers_of_a_toml_file_have_64_bits(value, valid):
    assert (not list(value_errors({"a": {"b": [value]}}))) is valid


@pytest.mark.parametrize(
    ("text", "overrides", "inherits"),
    [
        ("[plan]\ntracks = 1", [], True),
        ('[terrain]\ncover = "sand"', [], True),
        ('[terrain]\nkind = "cliffs"', [], False),
        ('[terrain]\nkind = "file"\nheight_file = "hill.npy"', [], False),
        ("", ["terrain.kind=cliffs"], False),
        ("", ["terrain.kind=cliffs", "objects.0.size_m=0.3"], True),
        ("", ["terrain.cover=sand"], True),
    ],
)
def test_the_objects_of_a_base_file_stay_on_its_floor(tmp_path, text, overrides, inherits):
    file = tmp_path / "own.toml"
    file.write_text(f'extends = "quickstart"\n{text}\n')
    scenario = load_scenario(file, overrides)
    assert len(scenario.objects) == (len(load_scenario("quickstart").objects) if inherits else 0)
    file.write_text(f'extends = "quickstart"\n{text}\n[[objects]]\nshape = "crate"\nposition_m = [0.0, 0.0]\n')
    assert [item.shape for item in load_scenario(file).objects] == ["crate"]


def test_a_drawn_calibration_error_lies_within_the_limits_of_its_key():
    keys = ["calibration_error.rotation_sigma_deg=2", "calibration_error.baseline_sigma_mm=20", "rig.baseline_m=0.03"]
    drawn = [load_scenario("reef", [*keys, f"seed={k}"]).true_calibration_error() for k in range(40)]
    assert max(abs(one.baseline_error) for one in drawn) == 0.5
    assert max(abs(one.right_pitch_deg) for one in drawn) <= 5


@pytest.mark.parametrize("name", ["2020.10", "1_0", "0x10", "true"])
def test_a_file_may_have_the_name_of_a_number(name):
    assert Path(load_scenario("reef", [f"terrain.height_file={name}"]).terrain.height_file).name == name


@pytest.mark.parametrize(("override", "lines"), [
    ("control.latency=9", ["'none' or 'stated'", "less than or equal to 5"]),
    ("plan.polygon=[[1e6,0],[0,0],[0,1]]", ["a list of corners [x, y], or a GeoJSON file"]),
])  # fmt: skip
def test_an_error_in_a_key_with_several_types_has_the_name_of_the_key(override, lines):
    with pytest.raises(ScenarioError) as error:
        load_scenario("reef", [override])
    key = override.partition("=")[0]
    assert [line.rpartition("(allowed: ")[2][:-1] for line in error.value.lines] == lines
    assert all(line.startswith(f"--set: {key}: ") for line in error.value.lines)
