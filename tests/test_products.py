"""Products of a map and change between two maps: closed forms, statistics of the errors, and other programs."""

import json

import numpy as np
import pytest
from scipy.special import ellipe

from tests.test_report_comparison import write_run
from twin import cli
from twin.core import geometry
from twin.core.georeference import Georeference
from twin.core.records import MapGrid, Trajectory
from twin.errors import TwinError
from twin.exchange import geotiff
from twin.products import pages
from twin.products.change import change_between
from twin.products.error_field import ErrorField, fitted
from twin.products.registration import Heights, register
from twin.products.surface import block_means, ruggedness, slope_deg, surface_ratio
from twin.products.survey_products import error_field_of_map, survey_products

CELL_M = 0.02
SHAPE = 120, 130


def grid(shape=SHAPE, cell_m=CELL_M):
    return MapGrid(-shape[1] * cell_m / 2, shape[0] * cell_m / 2, cell_m, *shape)


def coordinates(shape=SHAPE, cell_m=CELL_M):
    return np.meshgrid(*grid(shape, cell_m).centres())


def floor(x, y):
    """Returns the height of a smooth floor with slopes up to about 35 deg in all directions."""
    return 0.12 * np.sin(3.1 * x + 0.4) * np.cos(2.3 * y) + 0.05 * np.sin(7 * x - 4 * y) + 0.03 * np.cos(5 * y + 9 * x)


def error_field(sigma_m=0.004, window_m=0.08, long_m=0.001, range_m=0.8, shape=SHAPE):
    return ErrorField(CELL_M, np.full(shape, sigma_m), window_m, np.full(shape, long_m), range_m)


def heights_with(errors, seed, true_m):
    (noise,) = errors.samples(1, seed)
    return Heights(grid(true_m.shape), true_m + noise, np.full(true_m.shape, 0.005))


def test_slope_surface_and_ruggedness_of_a_plane_are_those_of_the_formula():
    x, y = coordinates()
    plane, inner = 0.3 * x - 0.4 * y, np.s_[2:-2, 2:-2]
    np.testing.assert_allclose(slope_deg(plane, CELL_M)[inner], np.rad2deg(np.arctan(0.5)), rtol=1e-9)
    np.testing.assert_allclose(surface_ratio(plane, CELL_M)[inner], np.sqrt(1.25), rtol=1e-9)
    np.testing.assert_allclose(ruggedness(plane, CELL_M)[inner], 0, atol=1e-12)
    assert np.isnan(slope_deg(plane, CELL_M)[0]).all() and np.isnan(surface_ratio(plane, CELL_M)[:, -1]).all()


def test_the_surface_of_waves_is_the_elliptic_integral():
    """Mean of sqrt(1 + a^2 k^2 cos^2): 2 / pi E(-a^2 k^2); triangles of 1/150 of a wave err by 1 - (k c)^2 / 24."""
    x, _ = coordinates((20, 150 * 4), 0.01)
    k, a = 2 * np.pi / 1.5, 0.2
    ratio = surface_ratio(a * np.sin(k * x), 0.01)[1:-1, 75:-75]
    assert ratio.mean() == pytest.approx(2 / np.pi * ellipe(-((a * k) ** 2)), rel=3e-4)


def test_slope_and_surface_of_a_cone_are_constant():
    x, y = coordinates((200, 200), 0.01)
    r = np.hypot(x, y)
    away = (r > 0.3) & (np.abs(x) < 0.95) & (np.abs(y) < 0.95)
    np.testing.assert_allclose(slope_deg(-0.75 * r, 0.01)[away], np.rad2deg(np.arctan(0.75)), rtol=1e-3)
    np.testing.assert_allclose(surface_ratio(-0.75 * r, 0.01)[away], 1.25, rtol=1e-3)


def test_slope_and_rugosity_are_those_of_xdem():
    xdem = pytest.importorskip("xdem", reason="xdem is not installed")
    z = floor(*coordinates())
    slope, rugosity = xdem.terrain.get_terrain_attribute(
        z, ["slope", "rugosity"], resolution=CELL_M, surface_fit="Horn", slope_method="Horn"
    )
    inner = np.s_[1:-1, 1:-1]
    np.testing.assert_allclose(slope_deg(z, CELL_M)[inner], slope[inner], rtol=1e-4)
    np.testing.assert_allclose(surface_ratio(z, CELL_M)[inner], rugosity[inner], rtol=1e-4)


def test_blocks_are_means_of_their_known_cells():
    values = np.arange(24.0).reshape(4, 6)
    values[0, 0] = values[0, 4] = values[1, 4] = np.nan
    expected = [[14 / 3, 5.5, np.nan], [15.5, 17.5, 19.5]]
    np.testing.assert_allclose(block_means(values, 2), expected)


def test_the_variance_of_a_sum_is_that_of_independent_or_of_equal_errors_at_the_limits():
    weights = np.ones((1, 30, 40))
    alone = ErrorField(CELL_M, np.full((30, 40), 0.01), CELL_M / 2, np.zeros((30, 40)), 1.0)
    assert alone.covariances(weights)[0][0, 0] == pytest.approx(1200 * 1e-4)
    equal = ErrorField(CELL_M, np.zeros((30, 40)), 0.1, np.full((30, 40), 0.01), 1e4)
    assert equal.covariances(weights)[1][0, 0] == pytest.approx(1200**2 * 1e-4, rel=1e-3)


def test_the_difference_of_two_cells_has_the_variance_of_the_spherical_model():
    """At half the range, r = 1 - 3/4 + 1/16; the variance of a difference is 2 s^2 (1 - r)."""
    weights = np.zeros((1, 20, 30))
    weights[0, 5, 4], weights[0, 5, 9] = 1.0, -1.0
    errors = ErrorField(CELL_M, np.full((20, 30), 0.01), 10 * CELL_M, np.zeros((20, 30)), 1.0)
    assert errors.covariances(weights)[0][0, 0] == pytest.approx(2e-4 * (1 - 0.3125))


@pytest.mark.long
def test_samples_have_the_covariance_of_the_field():
    """Over 160 samples a standard deviation is known to 5.6 %."""
    errors = error_field(shape=(60, 60))
    weights = np.zeros((60, 60))
    weights[10:30, 15:40] = 1.0
    sums = [float((field * weights).sum()) for field in errors.samples(160, seed=3)]
    expected = np.sqrt(sum(part[0, 0] for part in errors.covariances(weights[None])))
    assert np.std(sums) == pytest.approx(expected, rel=0.17)


def test_the_fit_finds_the_error_field():
    """The long range has only some ten independent areas in the map, hence the wide limits."""
    errors = error_field(shape=(220, 220))
    found = [
        fitted(field, np.full((220, 220), 0.005), CELL_M, np.ones((220, 220), bool)) for field in errors.samples(4, 5)
    ]
    assert np.mean([one.sigma_m.mean() for one in found]) == pytest.approx(0.004, rel=0.05)
    assert np.mean([one.window_m for one in found]) == pytest.approx(0.08, rel=0.15)
    assert np.mean([one.long_sigma_m.mean() for one in found]) == pytest.approx(0.001, rel=0.5)
    assert 0.3 < np.mean([one.long_range_m for one in found]) < 2.0


def moved_floor(motion):
    """Returns the floor (rows, cols) moved by u = t + w x p + k p, to first order in its parameters."""
    x, y = coordinates()
    z = floor(x, y)
    for _ in range(20):  # the point that moves to x, y
        px, py = x - motion[0] + motion[5] * y - motion[6] * x, y - motion[1] - motion[5] * x - motion[6] * y
        z = floor(px, py) + motion[2] + motion[3] * py - motion[4] * px
    return z


def test_the_registration_undoes_a_motion():
    motion = np.array([0.031, -0.044, 0.012, 0.002, -0.003, 0.004, 0.003])
    sigma = np.full(SHAPE, 0.002)
    found = register(
        Heights(grid(), floor(*coordinates()), sigma), Heights(grid(), moved_floor(motion), sigma), np.ones(SHAPE, bool)
    )
    np.testing.assert_allclose(found.values, motion, atol=6e-4)
    assert np.nanstd(found.difference_m) < 5e-4


@pytest.mark.long
def test_the_errors_of_the_registration_are_those_of_its_covariance():
    """The mean of error^2 / variance is 1 for each parameter; over 14 pairs and 7 parameters it is known to 14 %."""
    errors, true_m = error_field(long_m=0.0), floor(*coordinates())
    zero = Heights(grid(), true_m, np.full(SHAPE, 0.001))
    stable, ratios = np.ones(SHAPE, bool), []
    for seed in range(14):
        found = register(zero, heights_with(errors, seed, true_m), stable, errors)
        ratios.append(found.values**2 / np.diag(found.cov))
    assert np.mean(ratios) == pytest.approx(1.0, abs=0.45)


def test_the_shift_is_that_of_xdem():
    xdem, geoutils = pytest.importorskip("xdem", reason="xdem is not installed"), pytest.importorskip("geoutils")
    from rasterio.transform import from_origin

    shift = np.array([0.013, -0.009, 0.02, 0, 0, 0, 0])
    first, second = floor(*coordinates()), moved_floor(shift)
    place = from_origin(grid().west_m, grid().north_m, CELL_M, CELL_M)
    reference, other = (xdem.DEM.from_array(z, place, crs=32633, nodata=-9999) for z in (first, second))
    theirs = xdem.coreg.NuthKaab().fit(reference, other, random_state=1).meta["outputs"]["affine"]
    sigma = np.full(SHAPE, 0.002)
    ours = register(Heights(grid(), first, sigma), Heights(grid(), second, sigma), np.ones(SHAPE, bool)).values
    expected = [-theirs["shift_x"], -theirs["shift_y"], -theirs["shift_z"]]
    np.testing.assert_allclose(ours[:3], expected, atol=1e-3)
    assert geoutils.__version__


def test_the_effect_of_noise_on_rugosity_is_removed():
    """Noise adds more than 2 % at the finest grain; of that at most 15 % is left, apart from the random part."""
    errors, true_m = error_field(long_m=0.0), floor(*coordinates())
    heights = heights_with(errors, 1, true_m)
    grains = survey_products(heights, errors).grains
    raw, true = (float(np.nanmean(surface_ratio(z, CELL_M))) for z in (heights.height_m, true_m))
    assert raw / true - 1 > 0.02
    assert abs(grains[0].rugosity.value - true) < 0.15 * (raw - true) + 3 * grains[0].rugosity.sigma.random
    assert not grains[0].is_reliable and grains[-1].is_reliable


def test_area_volume_and_rugosity_of_a_tilted_plane():
    x, _ = coordinates()
    zero = np.zeros(SHAPE)
    plane = Heights(grid(), 2.0 + 0.5 * x, zero)
    products = survey_products(plane, ErrorField(CELL_M, zero, 0.08, zero, 1.0), 0.01, level_m=1.5)
    area_m2 = SHAPE[0] * SHAPE[1] * CELL_M**2
    assert products.tilt_deg == pytest.approx(np.rad2deg(np.arctan(0.5)))
    assert products.best.rugosity.value == pytest.approx(np.sqrt(1.25))
    assert products.best.rugosity_plane.value == pytest.approx(1.0)
    assert products.surface_m2.value == pytest.approx(area_m2 * np.sqrt(1.25))
    assert products.volume_m3.value == pytest.approx(0.5 * area_m2)
    assert products.volume_m3.sigma.systematic == pytest.approx(0.03 * 0.5 * area_m2)  # three times that of lengths


def test_a_map_without_heights_or_with_few_has_no_products():
    nothing = Heights(grid(), np.full(SHAPE, np.nan), np.full(SHAPE, np.nan))
    with pytest.raises(TwinError, match="RUN: its map has no height with a standard deviation"):
        error_field_of_map(nothing, 0.005, 1.0)
    few = np.full(SHAPE, np.nan)
    few[:5, :5] = 1.0
    with pytest.raises(TwinError, match=r"RUN: its map has 25 cells with a height .allowed: 30 with all neighbours"):
        survey_products(Heights(grid(), few, few), error_field())


def bump(x_m, y_m, height_m, radius_m=0.18):
    x, y = coordinates()
    return height_m * np.maximum(1 - ((x - x_m) ** 2 + (y - y_m) ** 2) / radius_m**2, 0)


def test_growth_and_loss_are_found_with_their_volumes_and_the_floor_is_not_changed():
    """A paraboloid has the volume pi r^2 h / 2; its patch may lack its rim."""
    true_m, change_m = floor(*coordinates()), bump(0.5, 0.4, 0.03) - bump(-0.6, -0.3, 0.02)
    errors = error_field()
    first, second = heights_with(errors, 1, true_m), heights_with(errors, 2, true_m + change_m)
    change = change_between(first, second, 0.16)
    growth, loss = sorted(change.patches, key=lambda patch: -patch.volume_m3)
    for patch, x_m, y_m, volume_m3 in (
        (growth, 0.5, 0.4, np.pi * 0.18**2 * 0.015),
        (loss, -0.6, -0.3, -np.pi * 0.18**2 * 0.01),
    ):
        assert np.hypot(patch.x_m - x_m, patch.y_m - y_m) < 0.05
        assert abs(patch.volume_m3 - volume_m3) < 2.6 * patch.volume_sigma.total
        assert patch.interval_m[0] < patch.change_m < patch.interval_m[1]
    judged = pages.judged(change, change_m)
    assert (judged["regions"], judged["found"], judged["false_patches"]) == (2, 2, 0)
    assert judged["expected"] > 1.9 and np.abs(judged["volume_error_over_sigma"]).max() < 2.6
    assert judged["false_cells"] == pytest.approx(0.05, abs=0.01)


def test_many_changed_areas_do_not_hide_each_other():
    """Growth of a fifth of the map, in the round in which it is not known yet which cells are unchanged."""
    change_m = sum(bump(x, y, 0.03, 0.15) for x in (-0.9, -0.3, 0.3, 0.9) for y in (-0.6, 0.6))
    errors, true_m = error_field(), floor(*coordinates())
    change = change_between(heights_with(errors, 3, true_m), heights_with(errors, 4, true_m + change_m), 0.16)
    assert pages.judged(change, change_m)["found"] == 8


def test_changes_much_larger_than_the_errors_do_not_raise_the_threshold():
    """Growth of 100 standard deviations on an eighth of the map; the threshold is that of the errors, not of these."""
    change_m = sum(bump(x, y, 0.1, 0.15) for x in (-1.0, -0.5, 0.0, 0.5, 1.0) for y in (-0.7, 0.7))
    errors, true_m = error_field(0.001, long_m=0.0), floor(*coordinates())
    change = change_between(heights_with(errors, 3, true_m), heights_with(errors, 4, true_m + change_m), 0.2)
    judged = pages.judged(change, change_m)
    assert judged["found"] == judged["regions"] == 10 and change.threshold < 6


def test_the_volume_of_a_patch_has_the_errors_that_the_maps_state():
    """Unchanged cells agree better, as errors of smoothing are equal; the sum over all cells has their errors."""
    errors, true_m = error_field(0.001, long_m=0.0), floor(*coordinates())
    pair = heights_with(errors, 1, true_m), heights_with(errors, 2, true_m + bump(0.5, 0.4, 0.03))
    change = change_between(*(heights._replace(sigma_m=np.full(SHAPE, 0.01)) for heights in pair), 0.16)
    (patch,) = change.patches
    area_m2, window_m = patch.area_m2, change.errors.window_m
    # over an area much larger than the window, the sum of the correlations of a cell is pi window^2 / 5
    expected_m3 = 0.01 * np.sqrt(2 * area_m2 * np.pi * window_m**2 / 5)
    assert patch.volume_sigma.random == pytest.approx(expected_m3, rel=0.15)
    everywhere = change.patch(np.ones(SHAPE, bool)).volume_sigma.random
    assert everywhere < 0.5 * expected_m3 * np.sqrt(np.prod(SHAPE) * CELL_M**2 / area_m2)


@pytest.mark.long
def test_one_pair_in_twenty_shows_a_patch_without_change_and_volumes_have_their_sigma():
    """Of 100 pairs, 5 are expected; at most 11 with 99 %. The standard deviation of 100 normal numbers is 1 +- 0.2."""
    errors, true_m = error_field(), floor(*coordinates())
    shown, ratios = 0, []
    for seed in range(100):
        pair = heights_with(errors, 2 * seed, true_m), heights_with(errors, 2 * seed + 1, true_m)
        change = change_between(*pair, 0.16)
        shown += bool(change.patches)
        middle = np.zeros(SHAPE, bool)
        middle[50:70, 50:70] = True
        patch = change.patch(middle)
        ratios.append(patch.volume_m3 / patch.volume_sigma.total)
    assert shown <= 11
    assert 0.75 < np.std(ratios) < 1.25


@pytest.mark.long
def test_changes_are_found_with_the_stated_probability():
    """40 pairs with growth of 4 to 16 mm: the number found is within three standard deviations of that stated."""
    errors, true_m = error_field(), floor(*coordinates())
    found = expected = variance = 0.0
    for seed in range(40):
        change_m = bump(0.5, 0.4, 0.004 + 0.012 * seed / 39)
        first, second = heights_with(errors, 2 * seed, true_m), heights_with(errors, 2 * seed + 1, true_m + change_m)
        judged = pages.judged(change_between(first, second, 0.16), change_m)
        found, expected = found + judged["found"], expected + judged["expected"]
        variance += judged["expected"] * (1 - judged["expected"])
    assert 8 < expected < 36
    assert abs(found - expected) < 3 * np.sqrt(variance) + 1


def test_the_change_of_height_is_that_of_py4dgeo(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # it writes a log
    py4dgeo = pytest.importorskip("py4dgeo", reason="py4dgeo is not installed")
    x, y = coordinates()
    change_m = bump(0.5, 0.4, 0.03)
    clouds = [np.stack([x, y, floor(x, y) + added], axis=-1).reshape(-1, 3) for added in (0 * x, change_m)]
    epochs = [py4dgeo.Epoch(cloud) for cloud in clouds]
    up = np.array([[0.0, 0.0, 1.0]])
    at = np.array([[0.5, 0.4, 0.0]])
    at[0, 2] = floor(*at[0, :2])
    m3c2 = py4dgeo.M3C2(epochs=epochs, corepoints=at, cyl_radius=0.05, corepoint_normals=up, max_distance=0.5)
    distances, _ = m3c2.run()
    errors = error_field(1e-4, long_m=0.0)
    maps = [heights_with(errors, k, cloud[:, 2].reshape(SHAPE)) for k, cloud in enumerate(clouds)]
    change = change_between(*maps, 0.1)
    near = np.hypot(x - 0.5, y - 0.4) < 0.05
    assert change.registration.difference_m[near].mean() == pytest.approx(float(distances[0]), abs=1e-3)


def write_map(folder, heights, truth=None, origin=None):
    """Writes a run folder with a map; the cameras are 2 m above its middle."""
    write_run(folder, 0.001, 1.0, seed=1)
    text = "[rig]\nimage_width_px = 320\nhfov_deg = 60.0\nbaseline_m = 0.15\n"
    (folder / "scenario.resolved.toml").write_text((folder / "scenario.resolved.toml").read_text() + text)
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[:, 2, 3] = 2.0
    Trajectory(np.arange(3.0), poses).save(folder / "trajectory_final.tum")
    geotiff.write_elevations(folder / "dem.tif", heights.height_m.astype(np.float32), heights.grid, "z", origin)
    geotiff.write_layer(folder / "dem_sigma.tif", heights.sigma_m, heights.grid, "sigma", origin)
    if truth is not None:
        geotiff.write_elevations(folder / "dem_truth.tif", truth.astype(np.float32), heights.grid, "true", origin)
    return folder


@pytest.fixture
def runs(tmp_path):
    true_m, change_m, errors = floor(*coordinates()), bump(0.5, 0.4, 0.03), error_field()
    first = write_map(tmp_path / "first", heights_with(errors, 1, true_m), true_m)
    second = write_map(tmp_path / "second", heights_with(errors, 2, true_m + change_m), true_m + change_m)
    return first, second


def run_command(monkeypatch, capsys, *arguments):
    monkeypatch.setattr("sys.argv", ["twin", *map(str, arguments)])
    with pytest.raises(SystemExit) as end:
        cli.main()
    return end.value.code, capsys.readouterr().out


def test_twin_change_says_what_grew_and_writes_page_json_and_maps(monkeypatch, capsys, tmp_path, runs):
    out = tmp_path / "change"
    status, text = run_command(monkeypatch, capsys, "change", *runs, "--out", out, "--scale", "0.16")
    assert (
        not status
        and text.startswith("1 patch of the floor changed. Growth: +")
        and "Compared with the true change: 1 of 1 changed regions found" in text
    )
    tree = json.loads((out / "change.json").read_text())
    assert len(tree["patches"]) == 1 and tree["truth"]["false_patches"] == 0
    difference = geotiff.read_raster(out / "difference.tif")
    assert difference.grid == grid() and np.nanmax(difference.values) > 0.02
    page = (out / "change.html").read_text()
    assert page.count("data:image/png;base64,") == 1 and "Growth: +" in page and "RUN1" not in page
    assert (
        page.index("Growth: +")
        < page.index("is found with a probability of 95 %")
        < page.index("What does it not see?")
    )


def test_twin_products_says_rugosity_with_grain_and_plane(monkeypatch, capsys, tmp_path, runs):
    status, text = run_command(monkeypatch, capsys, "products", runs[0], "--out", tmp_path / "p", "--json")
    tree = json.loads(text)
    best, true = tree["grains"][tree["chosen"]], tree["truth"]["grains"][tree["chosen"]]
    assert not status and abs(best["rugosity"]["value"] / true["rugosity"]["value"] - 1) < 0.01
    assert abs(tree["volume_m3"]["value"] - tree["truth"]["volume_m3"]["value"]) < 3 * np.linalg.norm(
        list(tree["volume_m3"]["sigma"].values())
    )
    page = (tmp_path / "p" / "products.html").read_text()
    assert "over the fitted plane" in page and "grain" in page
    first = f"<p>Rugosity {best['rugosity']['value']:.3f} ± "
    assert (
        page.index(first) < page.index("Can you rely on it?") < page.index("What would break it?") < page.index("<img")
    )
    assert (tmp_path / "p" / "slope.tif").is_file()


def test_products_are_compared_with_the_truth_where_it_is_known(tmp_path):
    true_m, known = floor(*coordinates()), coordinates()[0] < 0
    heights = heights_with(error_field(), 1, true_m)
    part = write_map(tmp_path / "part", heights, np.where(known, true_m, np.nan))
    results = pages.products_of(part)
    compared, truth = results.variables["compared"], results.variables["truth"]
    assert compared.area_m2 == truth.area_m2 == known.sum() * CELL_M**2
    assert abs(compared.volume_m3.value - truth.volume_m3.value) < 3 * compared.volume_m3.sigma.total
    assert any(" m2 where it is known" in item for one in results.paragraphs for item in one.items)
    none = pages.products_of(write_map(tmp_path / "none", heights, np.full(SHAPE, np.nan)))
    assert none.variables["truth"] is None and none.paragraphs


def test_a_level_true_floor_is_compared_by_its_slope_in_degrees(tmp_path):
    level = write_map(tmp_path / "run", heights_with(error_field(), 1, np.zeros(SHAPE)), np.zeros(SHAPE))
    items = [item for one in pages.products_of(level).paragraphs for item in one.items]
    assert any("Compared with the true surface" in item and " deg, volume " in item for item in items)


def test_the_height_above_a_tilted_map_is_that_along_its_axis(tmp_path):
    tilted = geometry.exp(np.array([0.8, 0.0, 0.0, 0.0, 0.0, 0.0]))
    runs = [write_map(tmp_path / name, heights_with(error_field(), 1, floor(*coordinates()))) for name in "ab"]
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[:, 2, 3] = 2.0
    Trajectory(np.arange(3.0), geometry.inverse(tilted) @ poses).save(runs[1] / "trajectory_final.tum")
    (runs[1] / "keyframes").mkdir(exist_ok=True)
    (runs[1] / "keyframes" / "index.json").write_text(json.dumps({"map_from_world": tilted.tolist()}))
    volumes = [pages.products_of(folder).tree["volume_m3"]["sigma"] for folder in runs]
    assert volumes[1] == pytest.approx(volumes[0], rel=1e-4)


def test_layers_of_other_cells_are_refused(runs):
    other = np.full((50, 50), 0.01)
    geotiff.write_layer(runs[0] / "dem_sigma.tif", other, grid((50, 50)), "sigma")
    with pytest.raises(TwinError, match="dem_sigma.tif has other cells than dem.tif"):
        pages.products_of(runs[0])


def test_where_all_cells_changed_no_share_of_false_ones_is_stated(runs):
    true_m = floor(*coordinates()) + 0.05
    geotiff.write_elevations(runs[1] / "dem_truth.tif", true_m.astype(np.float32), grid(), "true")
    results = pages.change_of(*runs, 0.2)
    assert results.tree["truth"]["false_cells"] is None
    assert not any("of the unchanged cells" in item for one in results.paragraphs for item in one.items)


def test_changes_larger_than_the_map_are_looked_for_in_the_whole_map(runs):
    results = [pages.change_of(*runs, scale_m) for scale_m in (100.0, 1000.0)]
    assert results[0].tree["patches"] == results[1].tree["patches"]


def test_a_scale_also_acts_on_heights():
    """A map with relief of 0.5 m, scaled by 1 % in all three axes about its centre."""
    rng, (x, y) = np.random.default_rng(1), coordinates()
    fx, fy = rng.uniform(2, 5, 2)
    relief = lambda x, y: 0.5 * np.sin(fx * x) * np.cos(fy * y) + 0.1 * np.sin(9 * x + 5 * y)  # noqa: E731
    first, k = relief(x, y), 0.01
    xc, yc, zc = x.mean(), y.mean(), np.median(first)
    second = zc + (1 + k) * (relief(xc + (x - xc) / (1 + k), yc + (y - yc) / (1 + k)) - zc)
    sigma = np.full(SHAPE, 0.002)
    found = register(Heights(grid(), first, sigma), Heights(grid(), second, sigma), np.ones(SHAPE, bool))
    assert found.values[6] == pytest.approx(k, rel=0.02)
    rest = np.isfinite(found.difference_m)
    assert abs(np.polyfit(first[rest], found.difference_m[rest], 1)[0]) < 1e-3


def test_a_run_without_map_trajectory_or_rig_has_no_products(runs):
    for name, message in (
        ("trajectory_final.tum", "RUN: .* has no trajectory_final.tum"),
        ("dem_sigma.tif", "RUN: .* has no dem_sigma.tif .allowed: a run with a map"),
    ):
        content = (runs[0] / name).read_bytes()
        (runs[0] / name).unlink()
        with pytest.raises(TwinError, match=message):
            pages.products_of(runs[0])
        (runs[0] / name).write_bytes(content)
    (runs[0] / "scenario.resolved.toml").write_text('name = "test"\n')
    with pytest.raises(TwinError, match="RUN: scenario.resolved.toml: rig.baseline_m: missing"):
        pages.products_of(runs[0])


def test_maps_that_cannot_be_compared_are_refused(tmp_path, runs):
    first = runs[0]
    sigma = np.full((60, 60), 0.005)
    far = write_map(tmp_path / "far", Heights(MapGrid(50.0, 50.0, CELL_M, 60, 60), sigma, sigma))
    other_cells = write_map(tmp_path / "cells", Heights(MapGrid(-1.0, 1.0, 0.03, 60, 60), sigma, sigma))
    place = Georeference(5e5, 8e6, 0.0, geotiff.georeference_in("EPSG:32755", (5e5, 8e6, 0.0)).crs_wkt)
    other_crs = write_map(tmp_path / "crs", Heights(grid(), np.zeros(SHAPE), np.full(SHAPE, 0.01)), origin=place)
    for second, message in (
        (far, "RUN2: has 0 map cells in common with RUN1 .allowed: at least 200"),
        (other_cells, r"RUN2: its map has cells of 0.03 m .allowed: those of RUN1, 0.02 m"),
        (first, "RUN2: its map equals that of RUN1 .allowed: another survey"),
        (other_crs, "RUN2: its scene has another CRS or origin than that of RUN1"),
        (write_run(tmp_path / "none", 0.001, 1.0, seed=1), "RUN2: .* has no dem.tif .allowed: a run with a map"),
    ):
        with pytest.raises(TwinError, match=message):
            pages.change_of(first, second, 0.2)
