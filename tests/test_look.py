"""One look: its layers add up, its figures are what they claim, a bad place is told."""

import json
import sys

import cv2
import numpy as np
import pytest

from twin import cli
from twin.app import look_sheet
from twin.app.look import figures, look, noise_of, parse_place, table
from twin.errors import TwinError
from twin.imaging.optics import range_of
from twin.imaging.photo_sensor import PhotoSensor
from twin.imaging.photons import electrons_per_cd
from twin.imaging.water import medium
from twin.scenario.file import load_scenario
from twin.world.mission import prepare

SMALL = ["rig.image_width_px=128", "rig.image_height_px=96", "terrain.grid_m=0.1", "terrain.texture_px_m=0.02"]


def mission(*overrides):
    return prepare(load_scenario("quickstart", [*SMALL, *overrides]))


@pytest.fixture(scope="module")
def seen():
    return look(mission("water.jerlov=3C"))


def test_the_light_is_that_from_the_floor_and_the_veil(seen):
    layers = seen.anatomy.layers
    np.testing.assert_allclose(layers.total, layers.direct + layers.veil, rtol=1e-6)
    # what the floor sends back, on its way through the water
    way_m = range_of(seen.anatomy.depth, mission().rig)[..., None]
    water = medium(mission("water.jerlov=3C").scenario.water)
    albedo = seen.anatomy.albedo / 255
    expected = albedo / np.pi * layers.floor_lx * np.exp(-water.attenuation_per_m * way_m)
    np.testing.assert_allclose(layers.direct, expected, rtol=1e-4, atol=1e-6)


def test_light_that_single_precision_has_lost_is_not_told():
    layers = look(mission("water.jerlov=9C", "water.turbidity=20.0")).anatomy.layers
    assert np.isnan(layers.floor_lx[..., 2]).all() and np.isfinite(layers.veil).all()


def test_looking_twice_shows_the_same_and_the_left_image_is_the_taken_apart_one_with_noise(seen):
    again = look(mission("water.jerlov=3C"))
    np.testing.assert_array_equal(seen.shot.left, again.shot.left)
    signal = np.clip(seen.anatomy.layers.total * seen.anatomy.gain * 255 + 0.5, 0, 255).astype(int)
    assert np.abs(signal - seen.anatomy.clean).max() <= 1
    imaging = mission().scenario.imaging
    level = signal[..., 1].mean() / 255
    expected = 255 * np.sqrt(imaging.noise_sd**2 + imaging.shot_noise**2 * level)
    # 12,288 draws: one sigma of a deviation is 0.6 %; both images are rounded
    assert noise_of(seen)[..., 1].std() == pytest.approx(np.hypot(expected, 0.41), rel=0.03)


def test_figures_follow_the_water():
    clear, murky = (figures(look(mission(f"water.jerlov={name}"))) for name in ("clear", "7C"))
    assert clear["veil_share"] == [0, 0, 0] and min(murky["veil_share"]) > 0.2
    assert all(a > b for a, b in zip(clear["contrast"], murky["contrast"], strict=True))
    assert murky["at_m"] == [0, 0, 2.0] and 1.3 < murky["depth_median_m"] < 2.0


def test_a_dark_sea_has_no_contrast_to_tell():
    dark = figures(look(mission("lamps.0.intensity_cd=0.0", "lamps.1.intensity_cd=0.0")))
    assert dark["contrast"] == [None] * 3 and dark["saturated_share"] == [0.0] * 3
    assert "–" in table(dark)[2]  # noqa: RUF001
    json.dumps(dark, allow_nan=False)


@pytest.mark.parametrize("text", ["1,2", "1,2,3,4", "a,b,c", "", "1,2,inf"])
def test_what_is_no_place_is_told(text):
    with pytest.raises(TwinError, match=r"--at: .* is no place"):
        parse_place(text)


@pytest.mark.parametrize(
    ("at_m", "fault"),
    [
        (
            (0.0, 0.0, -1.0),
            r"--at: the left camera at z -1.000 m lies in the floor or on it \(.*\.\.\., *0\.\d+ or more",
        ),
        ((9.0, 0.0, 2.0), r"--at: the left camera at \(9, 0\) lies outside the terrain .*x -4\.50 to 4\.50"),
        ((0.0, -3.45, 2.0), r"--at: the right camera at \(0, -3\.6\) lies outside"),
        ((0.0, 3.3, 2.0), r"lamps\.0\.position_m: lamp 0 at .* lies outside the terrain"),
    ],
)
def test_a_place_where_nobody_can_look_from_is_told(at_m, fault):
    with pytest.raises(TwinError, match=fault):
        look(mission(), at_m)


def test_a_lamp_in_the_floor_is_told_with_the_height_that_frees_it():
    deep = mission("lamps.0.position_m=[0.25, 0.35, -1.4]")  # clear of the floor where the survey flies
    with pytest.raises(TwinError, match=r"lamps\.0\.position_m: lamp 0 at z .* lies in the floor") as told:
        look(deep, (0.0, 0.0, 1.2))
    height_m = float(told.value.allowed.split(",")[1].split()[0])
    assert look(deep, (0.0, 0.0, height_m + 0.01)).shot.right is not None


PHYSICAL = ["sensor.vignetting_power=0.0", "sensor.motion_blur=true"]


def test_the_noise_of_a_physical_sensor_is_that_of_its_electrons():
    here = mission("water.jerlov=clear", "terrain.kind=flat", "terrain.relief_m=0.0", "sensor.bayer=false", *PHYSICAL)
    seen = look(here)
    a, told = seen.anatomy, figures(seen)
    assert (told["exposure_ms"], told["analogue_gain"]) == (1000 * a.setting.exposure_s, a.setting.analogue_gain)
    sensor = PhotoSensor(here.scenario, here.scenario.sensor)
    np.testing.assert_array_equal(sensor.develop(a.raw), seen.shot.left)  # the numbers are those of the image
    electrons = a.layers.total[..., 1] * electrons_per_cd(here.scenario.sensor, 1.339)[1] * a.setting.exposure_s
    per_e = a.setting.analogue_gain * 255 / here.scenario.sensor.full_well_e
    expected = per_e * np.sqrt(electrons.mean() + here.scenario.sensor.read_noise_e**2)
    assert noise_of(seen)[..., 1].std() == pytest.approx(np.hypot(expected, 0.41), rel=0.03)


EFFECTS = ["imaging.shadows=true", "imaging.forward_scatter=true", "snow.density_per_m3=200.0"]


def test_with_every_effect_the_light_is_still_the_sum_of_its_layers():
    layers = look(mission("water.jerlov=II", *EFFECTS)).anatomy.layers
    assert layers.forward is not None and layers.snow is not None and layers.snow.max() > 0
    np.testing.assert_allclose(layers.total, layers.direct + layers.forward + layers.veil + layers.snow, rtol=1e-4)


@pytest.mark.parametrize("settings", [["water.jerlov=clear"], ["water.jerlov=9C"], EFFECTS, PHYSICAL])
def test_the_sheet_is_a_picture(tmp_path, settings):
    here = mission(*settings)
    file = look_sheet.draw(here.scenario, look(here), tmp_path / "below" / "sheet.png")
    picture = cv2.imread(str(file))
    assert picture is not None and picture.shape[1] > 1000


def test_the_command_prints_figures_and_writes_the_sheet(monkeypatch, tmp_path, capsys):
    monkeypatch.chdir(tmp_path)
    words = [word for setting in SMALL for word in ("--set", setting)]
    monkeypatch.setattr(sys, "argv", ["twin", "look", "quickstart", *words, "--at", "-0.5,0.2,2", "--json"])
    with pytest.raises(SystemExit) as end:
        cli.main()
    told = json.loads(capsys.readouterr().out)
    assert end.value.code == 0 and told["at_m"] == [-0.5, 0.2, 2.0] and (tmp_path / told["sheet"]).is_file()
    monkeypatch.setattr(sys, "argv", ["twin", "look", "quickstart", *words, "--at", "0,0,0"])
    with pytest.raises(SystemExit) as end:
        cli.main()
    assert end.value.code == 2 and "lies in the floor" in capsys.readouterr().err
