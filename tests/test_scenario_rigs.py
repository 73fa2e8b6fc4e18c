"""Rigs as files: they replace what a scenario says about its cameras, keys beside them change single values."""

import pytest

from twin.errors import ScenarioError
from twin.scenario.file import dump_toml, load_scenario, read_toml, read_tree, with_values
from twin.scenario.model import Source
from twin.scenario.model_files import RIG, built_in

OWN = """
title = "mine"
[sources]
rig = "measured with a ruler"
[rig]
image_width_px = 400
baseline_m = 0.2
[sensor]
read_noise_e = 9.0
[[lamps]]
position_m = [0.1, 0.2, 0.0]
"""


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "mine.toml").write_text(OWN)
    (tmp_path / "base.toml").write_text(
        '[rig]\nhfov_deg = 80.0\nbaseline_m = 0.3\n[lens]\nk1 = 0.1\n[port]\nkind = "flat"\n'
    )
    return tmp_path


def scenario(folder, text, *overrides):
    (folder / "scene.toml").write_text(text)
    return load_scenario(folder / "scene.toml", overrides)


@pytest.mark.parametrize("name", built_in("rigs"))
def test_every_rig_can_be_flown_in_every_scene_and_says_where_its_numbers_come_from(name):
    for scene in ("quickstart", "paper"):
        assert load_scenario(scene, [f"rig.model={name}"]).rig.title
    tree, _ = read_toml(built_in("rigs")[name])
    for section in set(RIG.replaced) & tree.keys():
        assert any(key.split(".")[0] == section for key in tree["sources"]), section


@pytest.mark.parametrize("name", built_in("navigations"))
def test_every_set_of_navigation_sensors_fits_every_scene_and_says_where_its_numbers_come_from(name):
    for scene in ("reef", "paper"):
        found = load_scenario(scene, [f"navigation.model={name}", "navigation.dvl_rate_hz=5"]).navigation
        assert found.title and found.aiding and found.dvl_rate_hz == 5
    tree, _ = read_toml(built_in("navigations")[name])
    named = {key.strip() for keys in tree["sources"] for key in keys.split(",")}
    assert named == {*tree["navigation"], *(["imu"] if "imu" in tree else [])}


def test_a_rig_replaces_the_cameras_of_the_base_file_and_not_the_keys_beside_it(folder):
    found = scenario(
        folder, 'extends = "base.toml"\n[rig]\nmodel = "mine.toml"\nimage_height_px = 300\n[lens]\nk2 = 0.3\n'
    )
    assert (found.rig.title, found.rig.image_width_px, found.rig.image_height_px) == ("mine", 400, 300)
    assert found.rig.baseline_m == 0.2 and found.rig.hfov_deg == 60.0  # not those of the base file
    assert found.lens.k1 == 0.0 and found.lens.k2 == 0.3 and found.port.kind == "none"
    assert found.sensor.read_noise_e == 9.0 and len(found.lamps) == 1


def test_a_rig_without_lamps_keeps_those_of_the_scene():
    assert load_scenario("reef", ["rig.model=ideal"]).lamps == load_scenario("reef").lamps


@pytest.mark.parametrize("order", [1, -1])
def test_overrides_change_the_rig_in_any_order(folder, order):
    overrides = [f"rig.model={folder / 'mine.toml'}", "rig.baseline_m=0.25", "sensor.f_number=8"][::order]
    found = scenario(folder, 'extends = "base.toml"\n', *overrides)
    assert (found.rig.baseline_m, found.rig.image_width_px, found.sensor.f_number) == (0.25, 400, 8.0)


def test_a_study_varies_the_rig(folder):
    (folder / "scene.toml").write_text('extends = "base.toml"\n')
    values = {"rig.baseline_m": 0.4, "rig.model": "mine.toml"}
    found = with_values(read_tree(folder / "scene.toml"), values, Source(path=folder / "study.toml"))
    assert (found.rig.title, found.rig.baseline_m) == ("mine", 0.4)


@pytest.mark.parametrize(("model", "message"), [("nope", "'nope': no such rig"), ("bad.toml", "bad.toml:4: rig.base")])
def test_a_wrong_rig_in_a_sample_of_a_study_is_an_error_of_this_sample(folder, model, message):
    (folder / "bad.toml").write_text('title = "bad"\nsources = {}\n[rig]\nbaseline_m = -1\n')
    source = Source(path=folder / "study.toml", lines={"rig.model": 7})
    with pytest.raises(ScenarioError, match=rf"study.toml:7: rig.model: .*{message}"):
        with_values({}, {"rig.model": model}, source)


def test_a_resolved_scenario_needs_no_rig_file(folder):
    found = scenario(folder, '[rig]\nmodel = "mine.toml"\n')
    (folder / "mine.toml").unlink()
    assert scenario(folder, dump_toml(found)).model_dump() == found.model_dump()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('[rig]\nmodel = "gopro_par"\n', r"scene.toml:2: rig.model: 'gopro_par': no such rig .*gopro_pair"),
        ("[rig]\nmodel = 3\n", r"scene.toml:2: rig.model: 3: not allowed \(allowed: a string\)"),
        ('[rig]\nmodel = "nested.toml"\n', r"nested.toml:4: rig.model: 'ideal': not allowed .*load_scenario"),
        ('[rig]\nmodel = "bad.toml"\n', r"bad.toml:4: rig.baseline_m: -1: not allowed"),
    ],
)
def test_a_wrong_rig_is_reported_where_it_stands(folder, text, message):
    (folder / "nested.toml").write_text('title = "bad"\nsources = {}\n[rig]\nmodel = "ideal"\n')
    (folder / "bad.toml").write_text('title = "bad"\nsources = {}\n[rig]\nbaseline_m = -1\n')
    with pytest.raises(ScenarioError, match=message):
        scenario(folder, text)


def test_each_seed_draws_its_own_calibration_error_and_the_estimators_know_only_its_size():
    scenes = [load_scenario("reef", ["rig.model=machine_vision_flat", f"seed={seed}"]) for seed in range(200)]
    yaw = [one.true_calibration_error().right_yaw_deg for one in scenes]
    assert len(set(yaw)) == 200
    assert (sum(y * y for y in yaw) / 200) ** 0.5 == pytest.approx(0.035, rel=0.15)  # three standard errors
    assert scenes[0].true_calibration_error() == scenes[0].true_calibration_error()
    assert len({one.believed_rig().yaw_sigma_rad for one in scenes}) == 1
    assert len({one.believed_rig().baseline_m for one in scenes}) == 1
