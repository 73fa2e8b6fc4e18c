"""Invalid water, lamps and sun are reported with file, line, key and allowed values, before anything is flown."""

import pytest

from twin.errors import ScenarioError
from twin.scenario.file import dump_toml, load_scenario
from twin.world.mission import prepare

SMALL = ["terrain.grid_m=0.1", "terrain.texture_px_m=0.02"]


@pytest.mark.parametrize(
    ("overrides", "fault"),
    [
        (
            ["water.absorption_per_m=[-0.1, 0, 0]"],
            r"water\.absorption_per_m\.0: -0\.1: not allowed .*greater than or e",
        ),
        (["water.scattering_per_m=[0.1, 0]"], r"water\.scattering_per_m\.2: missing"),
        (["water.scattering_per_m=[0.1, 0, 0]"], r"water\.absorption_per_m: missing, as there is a water\.scatt"),
        (["water.turbidity=-1.0"], r"water\.turbidity: -1\.0: not allowed"),
        (["water.mean_cosine=1.0"], r"water\.mean_cosine: 1\.0: not allowed"),
        (["water.phase_function=mie"], r"water\.phase_function: 'mie': not allowed"),
        (["imaging.forward_scatter=true"], r"imaging\.forward_scatter: renamed to imaging\.scattering"),
        (["water.spectrum_file=none.csv"], r"water\.spectrum_file: no such file .*none\.csv"),
        (["snow.junge_exponent=0.5"], r"snow\.junge_exponent: 0\.5: not allowed .*greater than 1"),
        (["snow.diameter_max_m=0.02"], r"snow\.diameter_max_m: is unused: .* \(allowed: with snow\.junge_exponent\)"),
        (
            ["snow.junge_exponent=4.0", "snow.diameter_min_m=0.005", "snow.diameter_max_m=0.002"],
            r"snow\.diameter_min_m: 0\.005: not smaller .* \(allowed: below snow\.diameter_max_m = 0\.002\)",
        ),
        (["lens.diffraction=true"], r"lens\.diffraction: needs the f-number .* \(allowed: with \[sensor\]\)"),
        (["lens.focus_m=1.5"], r"lens\.focus_m: needs the f-number .* \(allowed: with \[sensor\]\)"),
        (["sensor.bits=12", "lens.focus_m=0.01"], r"lens\.focus_m: 0\.01: too near \(allowed: 0, or 0\.05 or more\)"),
        (["lens.blur_px=[3, 0, 0]"], r"lens\.blur_px\.0: 3: not allowed .*less than or equal to 2"),
        (["lens.lateral_colour=[0.1, 0]"], r"lens\.lateral_colour\.0: 0\.1: not allowed"),
        (['sensor.tone_curve="gamma"'], r"sensor\.tone_curve: 'gamma': not allowed .*linear"),
        (['sensor.white_balance="auto"'], r"sensor\.white_balance: 'auto': not allowed .*grey_world"),
        (["sensor.white_gains=[2, 1, 1]"], r"sensor\.white_gains: is unused: .*allowed: with .*white_balance = .gains"),
        (["sensor.white_temperature_k=5000.0"], r"sensor\.white_temperature_k: is unused: .*temperature"),
        (["rig.image_width_px=5000"], r"rig\.image_width_px: 5000: not allowed .*less than or equal to 4096"),
        (["snow.albedo=1.2"], r"snow\.albedo: 1\.2: not allowed .*less than or equal to 1"),
        (["lamps.0.intensity_cd=-5.0"], r"lamps\.0\.intensity_cd: -5\.0: not allowed"),
        (["lamps.1.beam=[[10, 1], [20, 0]]"], r"lamps\.1\.beam: angles do not increase from 0"),
        (["lamps.1.beam=[[0, 1], [20, 0.5], [20, 0]]"], r"lamps\.1\.beam: angles do not increase from 0"),
        (["lamps.1.beam=[[0, 1], [120, 0]]"], r"lamps\.1\.beam\.1\.0: 120: not allowed"),
        (["lamps.0.colour_temperature_k=100.0"], r"lamps\.0\.colour_temperature_k: 100\.0: not allowed"),
        (["sun.caustics=0.5"], r"sun\.caustics: 0\.5: there is no surface"),
        (["sun.depth_m=1.5"], r"sun\.depth_m: 1\.5: the cameras are above the surface \(allowed: more than 2\)"),
        (
            ["lamps.0.position_m=[0.25, 0.35, -2.0]"],
            r"lamps\.0\.position_m: is 0\.\d\d m below the floor at x .*allowed: -1\.\d\d or more for z \(up\)",
        ),
    ],
)
def test_invalid_light_is_reported(overrides, fault):
    with pytest.raises(ScenarioError, match=fault) as raised:
        prepare(load_scenario("reef", ["rig.model=ideal", *SMALL, *overrides]))
    assert len(raised.value.lines) == 1


def test_a_lamp_below_the_floor_is_accepted_at_the_allowed_height():
    with pytest.raises(ScenarioError) as raised:
        prepare(load_scenario("reef", [*SMALL, "lamps.0.position_m=[0.25, 0.35, -2.0]"]))
    height_m = float(raised.value.lines[0].rpartition("allowed: ")[2].split()[0])
    prepare(load_scenario("reef", [*SMALL, f"lamps.0.position_m=[0.25, 0.35, {height_m + 0.01}]"]))


def test_a_lamp_below_the_floor_of_a_task_is_refused():
    low = 'tasks=[{name="t",position_m=[0,0],size_m=[0.4,0.4],altitude_m=1.5}]'
    lamp = "lamps.0.position_m=[0.25, 0.35, -1.7]"
    flat = ["terrain.kind=flat", "plan.clearance_m=0.1"]
    prepare(load_scenario("reef", [*SMALL, *flat, lamp]))
    with pytest.raises(ScenarioError, match=r"lamps\.0\.position_m: is 0\.\d\d m below the floor"):
        prepare(load_scenario("reef", [*SMALL, *flat, lamp, low]))


def test_water_lamps_and_sun_survive_a_round_trip_with_a_relative_spectrum_file(tmp_path):
    (tmp_path / "lake.csv").write_text("400, 0.1, 0.2\n700, 0.3, 0.2\n")
    file = tmp_path / "lake.toml"
    file.write_text(
        'extends = "reef.toml"\n[water]\nspectrum_file = "lake.csv"\nphase_function = "petzold"\n'
        "[sun]\nilluminance_lx = 500.0\ndepth_m = 9.0\ncaustics = 0.7\n"
        "[[lamps]]\nposition_m = [0.2, 0.3, 0.0]\nbeam = [[0, 1], [30.5, 0.25]]\ncolour_temperature_k = 4000.0\n"
    )
    (tmp_path / "reef.toml").write_text(dump_toml(load_scenario("reef")))
    scenario = load_scenario(file)
    assert scenario.water.spectrum_file == str(tmp_path / "lake.csv")
    assert scenario.water.label == "lake.csv, turbidity 1"
    again = tmp_path / "again.toml"
    again.write_text(dump_toml(scenario))
    assert load_scenario(again).model_dump() == scenario.model_dump()
    prepare(scenario)
