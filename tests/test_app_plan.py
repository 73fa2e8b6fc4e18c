"""Summary of a plan: expected errors, requirements, warnings, cost, JSON."""

import json
import subprocess
import sys
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.special import ndtri

from twin.bench.measurement import child_ms
from twin.planning import expected_error
from twin.planning import summary as plan_summary
from twin.planning.cost import computing_cost
from twin.planning.expected_error import ExpectedError
from twin.scenario.file import load_scenario
from twin.surrogate import error_model_file
from twin.surrogate.matchability import EVEN_TEXTURE, WindowTexture, _generated
from twin.terrains.ground_cover import Painting
from twin.world.floor_forecast import forecast_over_floor
from twin.world.mission import prepare

SMALL = ["terrain.texture_px_m=0.02", "plan.tracks=1", "plan.area_m=[2.0, 1.6]"]


def summary_of(*overrides):
    return plan_summary.summarise(prepare(load_scenario("reef", ["rig.model=ideal", *SMALL, *overrides])))


@pytest.fixture(scope="module")
def summary():
    return summary_of('require={"map.le90_m"=0.05, "map.le95_m"=0.0001, "overlap.across_p05"=0.5}')


def test_percentiles_of_equal_sigmas_are_those_of_the_normal_distribution():
    error = ExpectedError(np.full(100, 0.02), 1.0, 0.05, 0.1)
    assert error.percentile_m(90) == pytest.approx(0.02 * ndtri(0.95), rel=1e-6)
    assert error.percentile_m(90, holes=0.05) == pytest.approx(0.02 * ndtri((1 + 0.9 / 0.95) / 2), rel=1e-6)
    assert error.percentile_m(90, holes=0.1) is None
    assert error.rmse_m == pytest.approx(0.02)


def test_percentiles_of_a_mixture_are_those_of_its_samples():
    rng = np.random.default_rng(0)
    sigma = rng.uniform(0.001, 0.05, 200_000)
    drawn = np.abs(rng.normal(0, sigma))
    found = ExpectedError(sigma, 1.0, 0.05, 0.1).percentile_m(90)
    assert found == pytest.approx(np.percentile(drawn, 90), rel=0.01)  # standard error 0.4 %


def test_requirements_that_the_plan_is_expected_to_miss_are_named(summary):
    verdicts = {name: row["passed"] for name, row in summary.require.items()}
    assert verdicts == {"map.le90_m": True, "map.le95_m": False, "overlap.across_p05": True}
    assert not summary.meets_requirements
    assert any(w.startswith("map.le95_m is expected to miss its limit: ") for w in summary.warnings)


def test_requirements_that_cannot_be_predicted_are_left_out():
    assert summary_of('require={"trajectory.final.ate_rmse_m"=0.001}').require == {}


def test_over_a_level_floor_the_expected_sigma_is_that_of_the_disparity_times_z2_over_f_b(tmp_path):
    """The error model has no scatter over cells, and further keyframes, which depend on the baseline, add nothing."""
    fitted = error_model_file.load()
    model = fitted.model._replace(depth_gain=0.0, efficiency=0.0, texture_scatter=0.0)  # without noise of the images
    error_model_file.save(replace(fitted, model=model), tmp_path / "one.toml")
    flat = (
        "terrain.kind=flat",
        "terrain.relief_m=0.0",
        "terrain.base_m=0.0",
        f"imaging.error_model={tmp_path}/one.toml",
    )
    narrow, wide = (summary_of(*flat, f"rig.baseline_m={b}") for b in (0.15, 0.3))
    per_px = 2.0**2 / (narrow.mission.rig.focal_px * 0.15)
    sigma_px = narrow.error.sigma_m / per_px
    assert np.ptp(sigma_px) < 1e-6 * sigma_px.mean()
    assert np.median(narrow.error.sigma_m) == pytest.approx(2 * np.median(wide.error.sigma_m), rel=0.02)


FITTED = error_model_file.load()


def _expected_over_a_flat_floor(binning, model, monkeypatch, texture=EVEN_TEXTURE):
    """Returns the expected error where the estimators bin the images, with a bound of 0.05 px of the matched images."""
    mission = prepare(load_scenario("reef", [*SMALL, "terrain.kind=flat", "terrain.relief_m=0.0"]))
    fitted = replace(FITTED, model=model)
    monkeypatch.setattr(expected_error.error_model_file, "load", lambda _: fitted)
    matching = SimpleNamespace(
        binning=binning, bound_at=lambda depth_m: np.full(np.shape(depth_m), 0.05), lamp_share=1.0, texture=texture
    )
    monkeypatch.setattr(expected_error, "Matchability", lambda *_: matching)
    return expected_error.expected_error(mission, forecast_over_floor(mission))


@pytest.mark.parametrize("binning", [1, 2])
def test_the_expected_error_scatters_over_cells_as_the_texture_over_windows(binning, monkeypatch):
    """The logarithm of the error, over a level floor at one depth, has the standard deviation 1.2 times 0.2."""
    model = FITTED.model._replace(texture_scatter=1.2, flow_floor_px=1e-9)
    found = _expected_over_a_flat_floor(binning, model, monkeypatch, WindowTexture(1.0, 0.2))
    assert np.log(found.sigma_m).std() == pytest.approx(1.2 * 0.2, rel=0.01)  # 20,000 even quantiles


def test_the_expected_error_is_that_of_the_bound_of_the_median_window(monkeypatch):
    """The depth error is proportional to the bound here, and all other errors of a level floor are zero."""
    model = FITTED.model._replace(flow_floor_px=0.0, texture_scatter=0.0)
    even, uneven = (
        _expected_over_a_flat_floor(1, model, monkeypatch, WindowTexture(ratio, 0.4)).sigma_m for ratio in (1.0, 1.3)
    )
    np.testing.assert_allclose(uneven / even, 1.3, rtol=1e-9)


def test_the_expected_error_of_binned_images_has_the_factor_of_the_error_model(monkeypatch):
    """A pixel of binned images is two pixels wide, so the same error in pixels is twice as large in metres."""
    model = FITTED.model._replace(binned_factor=1.5, texture_scatter=0.0)
    full, binned = (_expected_over_a_flat_floor(by, model, monkeypatch).sigma_m for by in (1, 2))
    np.testing.assert_allclose(binned / full, 2 * 1.5, rtol=1e-9)


def test_a_plan_on_the_plane_warns_of_the_overlap_that_the_floor_lacks(summary):
    assert not [w for w in summary.warnings if "have an overlap" in w]
    short = summary_of("plan.overlap_reference=plane", "plan.overlap_along=0.9", "plan.overlap_across=0.8")
    assert [w for w in short.warnings if w.startswith("5 % of the keyframes have an overlap along the swaths below")]


def test_effects_that_the_error_model_leaves_out_are_named():
    given = summary_of("calibration_error.focal_error=0.01").warnings
    assert "the expected error does not include the effects of [calibration_error]" in given


def test_the_summary_counts_the_objects_and_names_a_surrogate_that_leaves_them_out():
    crate = 'objects=[{shape="crate", position_m=[0.0, 0.0], size_m=0.3}]'
    for fidelity, left_out in (("rendered", False), ("surrogate", True)):
        given = summary_of(crate, f"imaging.fidelity={fidelity}")
        assert plan_summary.as_json(given, "")["objects"] == 1
        assert dict(plan_summary.rows(given))["objects"].startswith("1, not included" if left_out else "1, included")
        assert any(w.endswith("both leave out [[objects]]") for w in given.warnings) == left_out


@pytest.mark.parametrize("fidelity", ["rendered", "surrogate"])
def test_a_plan_does_not_paint_its_floor(fidelity, monkeypatch):
    """The matching precision needs the texture of a part of it, as large as an image."""
    painted = []
    monkeypatch.setattr(
        "twin.terrains.textures.Painting", lambda *given: painted.append(given[0].size) or Painting(*given)
    )
    _generated.cache_clear()
    given = summary_of(f"imaging.fidelity={fidelity}", "terrain.texture_px_m=0.02")
    assert given.cost.memory_mb > 0 and given.mission.terrain.size_m == (9.0, 7.0)
    assert len(painted) == 1 and painted[0] < 0.5 * 450 * 350


def test_the_table_has_four_statistics_in_ascending_order(summary):
    spreads = plan_summary.floor_spreads(summary)
    assert [row[0] for row in plan_summary.floor_rows(summary)[1:]] == [p[0] for p in plan_summary._PROPERTIES.values()]
    for values in spreads.values():
        assert list(values) == sorted(values)


def test_the_cost_grows_with_frames_keyframes_and_pixels(summary):
    more = summary_of("plan.overlap_along=0.95")
    larger = summary_of("rig.image_width_px=640", "rig.image_height_px=480")
    for bigger in (more, larger):
        assert bigger.cost.wall_s > summary.cost.wall_s and bigger.cost.disk_mb > summary.cost.disk_mb
        assert bigger.cost.memory_mb > summary.cost.memory_mb
    assert summary_of("imaging.fidelity=surrogate").cost.wall_s < summary.cost.wall_s


@pytest.mark.long
@pytest.mark.parametrize(
    ("fidelity", "floor"),
    [("rendered", []), ("rendered", ["terrain.size_m=[20.0,20.0]", "terrain.grid_m=0.02"]), ("surrogate", [])],
    ids=["rendered", "large floor", "surrogate"],
)
def test_time_memory_and_disk_of_a_run_are_about_those_expected(tmp_path, fidelity, floor):
    """Within 30 %; the time within a factor of two, as it depends on the processor and its load."""
    short = ["plan.tracks=1", "control.hold_s=0.5", f"imaging.fidelity={fidelity}", *floor]
    overrides = [*short, "plan.area_m=[1.6,0.8]"]
    expected, folder = plan_summary.summarise(prepare(load_scenario("reef", overrides))).cost, tmp_path / "run"
    smaller = [*short, "plan.area_m=[0.6,0.4]"]
    child_ms("-c", f"import twin; twin.run('reef', '{tmp_path / 'first'}', {smaller})")  # compiles what is not on disk
    code = f"""
import time, twin
twin.run('reef', '{folder}', {overrides})
print(time.process_time(), open('/proc/self/status').read().split('VmHWM:')[1].split()[0])
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    processor_s, peak_kib = map(float, done.stdout.split()[-2:])
    assert expected.wall_s / 2 < processor_s < expected.wall_s * 2
    assert peak_kib * 1024 / 1e6 == pytest.approx(expected.memory_mb, rel=0.3)
    size_mb = sum(file.stat().st_size for file in folder.rglob("*") if file.is_file()) / 1e6
    assert size_mb == pytest.approx(expected.disk_mb, rel=0.3)


def test_memory_and_disk_of_the_whole_mission_are_those_measured():
    """Measured once, in 113 minutes: 1054 MB of memory; 150 MB of disk without images, 3730 MB until the end."""
    small = ["rig.image_width_px=320", "rig.image_height_px=240"]
    costs = [
        computing_cost(prepare(load_scenario("paper", [*small, f"record={one}"])), 5693)
        for one in ("none", "keyframes", "all")
    ]
    assert costs[0].memory_mb == pytest.approx(1054, rel=0.3)
    assert costs[0].disk_mb == pytest.approx(150, rel=0.3)
    assert costs[0].flight_disk_mb == pytest.approx(3730, rel=0.3)
    assert costs[0].disk_mb < costs[1].disk_mb / 5 < costs[2].disk_mb / 50


def test_the_summary_is_json(summary):
    tree = json.loads(json.dumps(plan_summary.as_json(summary, "plan.png"), allow_nan=False))
    assert tree["schema"] == "twin.plan/1" and tree["picture"] == "plan.png"
    assert tree["water"].startswith("Jerlov IB (Solonenko & Mobley 2015), turbidity 1; b at 550 nm is 2.3 times as")
    assert set(tree["floor"]) == set(plan_summary._PROPERTIES)
    assert set(tree["floor"]["overlap_along"]) == {"minimum", "p05", "median", "maximum"}
    assert tree["plan"]["n_frames"] == summary.mission.n_frames
    assert 0 < tree["coverage"] <= 1 and len(tree["warnings"]) == len(summary.warnings)


def test_a_plan_states_the_largest_stable_latency_and_warns_beyond_it(monkeypatch):
    """The limit itself is that of `twin vehicle`."""
    monkeypatch.setattr(plan_summary, "largest_latency_s", lambda _: 0.15)
    shown = {latency: summary_of(f"control.latency={latency}") for latency in (0.2, "stated")}
    assert {k: any("too long for a stable" in w for w in found.warnings) for k, found in shown.items()} == {
        0.2: True, "stated": False,
    }  # fmt: skip
    assert ("latency", "0.20 s from image to command; stable up to 0.15 s") in plan_summary.rows(shown[0.2])
