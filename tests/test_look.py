"""The view of `twin look`: layers add up, quality measures match theory, bad positions are rejected."""

import json
import sys

import cv2
import numpy as np
import pytest

from twin import cli
from twin.app import look_sheet
from twin.app.look import image_quality, parse_position, parse_twist, quality_rows, render_view
from twin.errors import TwinError
from twin.imaging.camera.photo_sensor import PhotoSensor
from twin.imaging.camera.photons import electrons_per_cd
from twin.imaging.light.optics import range_of
from twin.scenario.file import load_scenario
from twin.world.mission import prepare

SMALL = ["rig.image_width_px=128", "rig.image_height_px=96", "terrain.grid_m=0.1", "terrain.texture_px_m=0.02"]


def mission(*overrides):
    return prepare(load_scenario("reef", ["rig.model=ideal", *SMALL, *overrides]))


@pytest.fixture(scope="module")
def view():
    return render_view(mission("water.jerlov=3C"))


def test_the_light_is_the_sum_of_direct_signal_forward_scatter_and_backscatter(view):
    layers = view.decomposed.components
    np.testing.assert_allclose(layers.total, layers.direct + layers.forward + layers.backscatter, rtol=1e-5)
    # radiance reflected by the sea floor, attenuated along the range
    range_m = range_of(view.decomposed.depth, mission().rig)[..., None]
    water = mission("water.jerlov=3C").illumination.water
    albedo = view.decomposed.albedo / 255
    expected = albedo / np.pi * layers.floor_lx * np.exp(-water.attenuation_per_m * range_m)
    np.testing.assert_allclose(layers.direct, expected, rtol=1e-4, atol=1e-6)


def test_light_below_single_precision_is_reported_as_undefined():
    murky = mission("water.jerlov=9C", "water.turbidity=20.0", "imaging.scattering=single")
    layers = render_view(murky).decomposed.components
    assert np.isnan(layers.floor_lx[..., 2]).all() and np.isfinite(layers.backscatter).all()


def test_the_view_is_reproducible_and_its_left_image_is_the_noise_free_image_plus_noise(view):
    again = render_view(mission("water.jerlov=3C"))
    np.testing.assert_array_equal(view.stereo_pair.left, again.stereo_pair.left)
    signal = np.clip(view.decomposed.components.total * view.decomposed.setting.gain * 255 + 0.5, 0, 255).astype(int)
    assert np.abs(signal - view.decomposed.noise_free).max() <= 1
    imaging = mission().scenario.imaging
    level = signal[..., 1].mean() / 255
    expected = 255 * np.sqrt(imaging.noise_sd**2 + imaging.shot_noise**2 * level)
    # 12,288 samples: the standard error of a standard deviation is 0.6 %; both images are rounded
    assert view.noise[..., 1].std() == pytest.approx(np.hypot(expected, 0.41), rel=0.03)


def test_image_quality_falls_with_attenuation():
    clear, murky = (image_quality(render_view(mission(f"water.jerlov={name}"))) for name in ("clear", "7C"))
    assert clear["veil_share"] == [0, 0, 0] and min(murky["veil_share"]) > 0.2
    assert all(a > b for a, b in zip(clear["contrast"], murky["contrast"], strict=True))
    assert murky["at_m"] == [0, 0, 2.0] and 1.3 < murky["depth_median_m"] < 2.0


def test_contrast_is_undefined_without_light():
    dark = image_quality(render_view(mission("lamps.0.intensity_cd=0.0", "lamps.1.intensity_cd=0.0")))
    assert dark["contrast"] == [None] * 3 and dark["saturated_share"] == [0.0] * 3
    assert "–" in quality_rows(dark)[2]  # noqa: RUF001
    json.dumps(dark, allow_nan=False)


@pytest.mark.parametrize("text", ["1,2", "1,2,3,4", "a,b,c", "", "1,2,inf"])
def test_an_invalid_position_is_rejected(text):
    with pytest.raises(TwinError, match=r"--at: .* is not a position"):
        parse_position(text)


@pytest.mark.parametrize(
    ("at_m", "message"),
    [
        (
            (0.0, 0.0, -1.0),
            r"--at: the left camera at z -1.000 m is not above the sea floor \(.*\.\.\., *0\.\d+ or more",
        ),
        ((9.0, 0.0, 2.0), r"--at: the left camera at \(9, 0\) is outside the terrain .*x -4\.50 to 4\.50"),
        ((0.0, -3.45, 2.0), r"--at: the right camera at \(0, -3\.6\) is outside"),
        ((0.0, 3.3, 2.0), r"lamps\.0\.position_m: lamp 0 at .* is outside the terrain"),
    ],
)
def test_a_position_outside_the_water_is_rejected(at_m, message):
    with pytest.raises(TwinError, match=message):
        render_view(mission(), at_m)


def test_a_lamp_below_the_sea_floor_is_rejected_with_the_lowest_allowed_height():
    deep = mission("lamps.0.position_m=[0.25, 0.35, -1.4]")  # above the sea floor along the survey
    with pytest.raises(TwinError, match=r"lamps\.0\.position_m: lamp 0 at z .* is not above the sea floor") as raised:
        render_view(deep, (0.0, 0.0, 1.2))
    height_m = float(raised.value.allowed.split(",")[1].split()[0])
    assert render_view(deep, (0.0, 0.0, height_m + 0.01)).stereo_pair.right is not None


PHYSICAL = ["sensor.vignetting_power=0.0", "sensor.motion_blur=true"]


def test_the_noise_of_a_physical_sensor_is_photon_and_read_noise():
    here = mission("water.jerlov=clear", "terrain.kind=flat", "terrain.relief_m=0.0", "sensor.bayer=false", *PHYSICAL)
    view = render_view(here)
    a, quality = view.decomposed, image_quality(view)
    assert (quality["exposure_ms"], quality["analogue_gain"]) == (1000 * a.setting.exposure_s, a.setting.analogue_gain)
    sensor = PhotoSensor(here.scenario, here.scenario.sensor)
    left = view.stereo_pair.left
    np.testing.assert_array_equal(sensor.develop(a.raw), left)
    electrons = a.components.total[..., 1] * electrons_per_cd(here.scenario.sensor, 1.339)[1] * a.setting.exposure_s
    per_e = a.setting.analogue_gain * 255 / here.scenario.sensor.full_well_e
    expected = per_e * np.sqrt(electrons.mean() + here.scenario.sensor.read_noise_e**2)
    assert view.noise[..., 1].std() == pytest.approx(np.hypot(expected, 0.41), rel=0.03)


EFFECTS = ["imaging.shadows=true", "snow.density_per_m3=200.0"]


def test_with_every_effect_the_light_is_still_the_sum_of_its_layers():
    layers = render_view(mission("water.jerlov=II", *EFFECTS)).decomposed.components
    assert layers.forward is not None and layers.snow is not None and layers.snow.max() > 0
    total = layers.direct + layers.forward + layers.backscatter + layers.snow
    np.testing.assert_allclose(layers.total, total, rtol=1e-4)


@pytest.mark.parametrize("gain", [0.7, 0.1])
def test_a_panel_states_that_its_brightness_is_that_before_tone_curve_and_white_balance(gain):
    layer = np.ones((2, 2, 3), np.float32)
    notes = [look_sheet._light("direct", "cd/m2", layer, gain, one).note for one in (True, False)]
    assert notes[0].endswith("as bright as in the image")
    assert notes[1] == notes[0] + "\nbefore tone curve and white balance"


@pytest.mark.parametrize("settings", [["water.jerlov=clear"], ["water.jerlov=9C"], [*EFFECTS, *PHYSICAL]])
def test_the_sheet_is_a_picture(tmp_path, settings):
    here = mission(*settings)
    file = tmp_path / "below" / "sheet.png"
    look_sheet.draw(here.scenario, render_view(here), file)
    picture = cv2.imread(str(file))
    assert picture is not None and picture.shape[1] > 1000


def test_the_command_prints_image_quality_and_writes_the_sheet(monkeypatch, tmp_path, capsys):
    monkeypatch.chdir(tmp_path)
    words = [word for setting in SMALL for word in ("--set", setting)]
    monkeypatch.setattr(sys, "argv", ["twin", "look", "reef", *words, "--at", "-0.5,0.2,2", "--json"])
    with pytest.raises(SystemExit) as end:
        cli.main()
    printed = json.loads(capsys.readouterr().out)
    assert end.value.code == 0 and printed["at_m"] == [-0.5, 0.2, 2.0] and (tmp_path / printed["sheet"]).is_file()
    monkeypatch.setattr(sys, "argv", ["twin", "look", "reef", *words, "--at", "0,0,0"])
    with pytest.raises(SystemExit) as end:
        cli.main()
    assert end.value.code == 2 and "is not above the sea floor" in capsys.readouterr().err


def test_a_twist_blurs_and_shears_the_single_image():
    here = mission("sensor.bits=12", "sensor.readout_ms=20.0", "sensor.exposure_max_ms=30.0", "water.jerlov=clear")
    rest, moving = render_view(here), render_view(here, twist_body=parse_twist("1.5,0,0,0,0,30"))
    a, b = (view.decomposed.noise_free[..., 1].astype(float) for view in (rest, moving))
    assert moving.decomposed.setting == rest.decomposed.setting
    np.testing.assert_array_equal(moving.decomposed.components.total, rest.decomposed.components.total)
    # the bow points up in the image: motion blur removes detail along the columns, rotation some along the rows
    along, across = (np.abs(np.diff(b, axis=k)).mean() / np.abs(np.diff(a, axis=k)).mean() for k in (0, 1))
    assert along < 0.8 and along < across
    assert np.abs(moving.noise).mean() < 5  # the decomposed image has the motion of the stereo pair


BAD_TWISTS = ["1,0,0", "1,0,0,0,0,x", "1,0,0,0,0,nan", ""]


@pytest.mark.parametrize("text", BAD_TWISTS)
def test_bad_twists_are_rejected(text):
    with pytest.raises(TwinError, match=r"--twist: .* is not a velocity \(allowed: VX,VY,VZ,WX,WY,WZ"):
        parse_twist(text)


def test_a_twist_needs_an_exposure_time():
    with pytest.raises(
        TwinError, match=r"--twist: the scenario has no exposure time \(allowed: with a section \[sensor"
    ):
        render_view(mission(), twist_body=np.ones(6))
    np.testing.assert_allclose(parse_twist("1,2,3,0,0,180"), [0, 0, np.pi, 1, 2, 3])
