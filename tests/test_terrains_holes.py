"""Floor without a height: it is neither planned over nor judged, and the user is told."""

from dataclasses import replace

import numpy as np
import pytest
import rasterio
from rasterio.transform import from_origin

from twin import terrains
from twin.core.records import MapGrid
from twin.core.timing import Stopwatch
from twin.errors import ScenarioError
from twin.planning.drawing import draw
from twin.planning.summary import as_json, summarise
from twin.report.style import COLOURS
from twin.scenario.file import load_scenario
from twin.session.assembly import open_world
from twin.survey import run
from twin.terrains.holes import known_nodes
from twin.world.floor_forecast import forecast_over_floor
from twin.world.mission import Mission, prepare


def write(file, holes, spacing_m=0.05, n=121):
    """Writes heights over n x n nodes as .npy, row 0 = north, without heights where `holes` of x and y is true."""
    x, y = np.meshgrid(*(sign * (np.arange(n) - n // 2) * spacing_m for sign in (1, -1)))
    height = 0.1 * np.sin(3 * x) * np.cos(2 * y)
    np.save(file, np.where(holes(x, y), np.nan, height))
    return file


def terrain(file):
    return terrains.load(file, terrains.TextureSource(0.1), 0.05, 1.0, 0)


def mission(file, *overrides) -> Mission:
    values = ["terrain.kind=file", f"terrain.height_file={file}", "terrain.height_spacing_m=0.05", "plan.tracks=1",
              "plan.area_m=[0.8, 0.8]", "terrain.texture_px_m=0.05"]  # fmt: skip
    return prepare(load_scenario("reef", [*values, *overrides]))


def test_a_hole_is_small_if_it_is_enclosed_and_narrow():
    given = np.ones((30, 40), np.bool_)
    given[5:8, 5:30] = False  # 3 nodes wide: the middle is 2 spacings from a height
    given[15:20, 5:10] = False  # 5 nodes wide
    given[25, :2] = False  # open at the border
    known = known_nodes(given)
    assert known is not None and known[5:8, 5:30].all()
    assert not known[15:20, 5:10].any() and not known[25, :2].any()
    assert (~known).sum() == 25 + 2
    assert known_nodes(np.ones((3, 3), np.bool_)) is None
    given[15:, :] = True
    assert known_nodes(given) is None  # only the small hole is left


@pytest.mark.parametrize("share", [0.10, 0.50])
def test_gaps_between_scattered_heights_are_small_though_they_are_connected(share):
    """Nodes are unknown at the border and around places without any of 13 heights: 0.5^13 of all places."""
    given = np.random.default_rng(0).random((200, 200)) >= share
    given[60:90, 80:120] = False
    known = known_nodes(given)
    assert known is not None and not known[62:88, 82:118].any()
    away = np.ones_like(known)
    away[55:95, 75:125] = False
    assert known[3:-3, 3:-3][away[3:-3, 3:-3]].mean() > 0.99


def test_a_straight_edge_and_a_wide_strip_stay_what_they_are():
    given = np.ones((40, 60), np.bool_)
    given[:, 30:] = False
    np.testing.assert_array_equal(known_nodes(given), given)
    given[:, 36:] = True  # a strip of 6 nodes
    np.testing.assert_array_equal(known_nodes(given), given)


def test_the_notes_name_the_number_of_cells_and_their_share(tmp_path):
    whole = terrain(write(tmp_path / "whole.npy", lambda x, y: x > 99))
    assert whole.known is None and whole.hole_notes == [] and not whole.in_hole(0.0, 0.0)
    half = terrain(write(tmp_path / "half.npy", lambda x, y: (x > 0.01) | (np.hypot(x + 2, y) < 0.06)))
    assert [note.split(":")[0] for note in half.hole_notes] == [
        "7260 of 14641 cells of the floor (49.6 %) have no height",
        "5 cells of the floor, in small holes, have the nearest height.",
    ]
    x = np.array([-2.0, -0.06, -0.01, 0.01, 2.9, 3.1, np.nan])
    np.testing.assert_array_equal(half.in_hole(x, 0.0), [False, False, False, True, True, False, False])


def test_the_asked_area_and_its_forecast_exclude_floor_without_a_height(tmp_path):
    """Half of the area has no height: the other half is all that is asked for, and all of it is covered."""
    survey = mission(write(tmp_path / "half.npy", lambda x, y: x > 0.01))
    cells = np.meshgrid(*survey.grid.centres())
    assert survey.asked(*cells).sum() == pytest.approx(survey.plan.inside_area(*cells).sum() / 2, rel=0.08)
    assert not survey.asked(*cells)[cells[0] > 0.05].any()
    forecast = forecast_over_floor(survey)
    assert forecast.coverage > 0.99
    unknown = forecast.keyframes.position_m[:, 0] > 0.05
    assert unknown.any() and np.isnan(forecast.altitude_m[unknown]).all()
    assert np.isfinite(forecast.altitude_m[~unknown]).any()


@pytest.mark.parametrize("height", ["plane", "floor"])
def test_a_path_far_over_floor_without_a_height_is_refused(tmp_path, height):
    file = write(tmp_path / "half.npy", lambda x, y: x > 0.01)
    with pytest.raises(ScenarioError, match=r"plan.area_m: the path leads over floor without a height, up to 1.\d+ m"):
        mission(file, "plan.centre_m=[1.0, 0.0]", f"plan.height={height}")
    with pytest.raises(ScenarioError) as caught:  # no overlap in images without floor
        mission(file, "plan.centre_m=[1.3, 0.0]", "plan.area_m=[2.4, 2.4]", f"plan.height={height}", "plan.tracks=0")
    assert len(caught.value.lines) == 1 and "the path leads over floor without a height" in caught.value.lines[0]
    mission(file, "plan.centre_m=[-1.0, 0.0]", f"plan.height={height}")


def test_the_truth_has_no_height_no_colour_and_no_coverage_in_a_hole(tmp_path):
    survey = mission(write(tmp_path / "half.npy", lambda x, y: x > 0.01))
    with open_world(survey, Stopwatch()) as world:
        world.coverage.seen[:] = True  # pyright: ignore
        truth = world.truth()
    assert truth.albedo is not None and truth.in_area is not None
    colours = truth.albedo(survey.grid)
    x, y = np.meshgrid(*survey.grid.centres())
    hole = survey.terrain.in_hole(x, y)
    assert hole.any() and np.isnan(truth.height_m[hole]).all() and np.isnan(colours[hole]).all()
    assert not truth.seen[hole].any() and not truth.asked[hole].any() and not truth.in_area(x, y)[hole].any()
    on_floor = ~hole & np.isfinite(survey.terrain.height_at(x, y))
    assert truth.seen[on_floor].all() and np.isfinite(truth.height_m[on_floor]).all()
    assert np.isfinite(colours[on_floor]).all()


@pytest.mark.long
@pytest.mark.parametrize("share", [0.10, 0.50, 0.76])
def test_the_share_of_nodata_is_that_of_rasterio_in_plan_truth_picture_and_notes(tmp_path, share, monkeypatch):
    """The hole is a half-plane at an angle, as beside a swath; 40 single cells have no height, too."""
    file, (x, y) = tmp_path / "floor.tif", np.meshgrid(np.arange(200) * 0.05, np.arange(199, -1, -1) * 0.05)
    beyond = x + 0.4 * y
    hole = beyond > np.quantile(beyond, 1 - share)
    single = np.zeros_like(hole)
    single[5:-5:24, 5:55:12] = True
    with rasterio.open(
        file, "w", "GTiff", 200, 200, 1, "EPSG:32755", from_origin(4e5, 8e6, 0.05, 0.05), "float32", nodata=-9999
    ) as raster:
        raster.write(np.where(hole | single, -9999, 0.1 * np.sin(x)).astype(np.float32), 1)
    with rasterio.open(file) as raster:
        nodata = float((raster.read_masks(1) == 0).mean())
    survey = mission(file, "plan.centre_m=[-3.3, 0.0]", "plan.area_m=[1.6, 1.6]", "plan.tracks=0")
    floor = survey.terrain
    n_single = int((single & ~hole).sum())
    assert floor.unknown_share == pytest.approx(nodata - n_single / 40000) and n_single > 20
    assert f"({100 * floor.unknown_share:.3g} %) have no height" in survey.hole_notes[0]
    assert survey.hole_notes[1].startswith(f"{n_single} cells of the floor, in small holes")
    cells = MapGrid(floor.west_m, floor.north_m, 0.05, 199, 199)
    surface = replace(survey, grid=cells)
    x, y = np.meshgrid(*cells.centres())
    assert np.mean(floor.in_hole(x, y)) == pytest.approx(floor.unknown_share, abs=0.01)
    with open_world(surface, Stopwatch()) as world:
        world.coverage.seen[:] = True  # pyright: ignore
        truth = world.truth()
    assert np.mean(np.isnan(truth.height_m)) == np.mean(~truth.seen) == np.mean(floor.in_hole(x, y))
    summary = summarise(survey)
    asked = survey.plan.inside_area(x, y)
    share_asked = floor.in_hole(x, y)[asked].mean()
    holes = as_json(summary, "")["holes"]
    assert holes["floor"] == floor.unknown_share and holes["filled"] == pytest.approx(n_single / 40000)
    assert holes["asked_area"] == pytest.approx(share_asked, abs=0.02) and (share_asked > 0.03) == (share == 0.76)
    assert [w for w in summary.warnings if w.endswith("of the asked area has no height and is not part of it")] == [
        note.removesuffix(".") for note in survey.hole_notes[2:]
    ]
    drawn = []
    monkeypatch.setattr("matplotlib.axes.Axes.imshow", lambda self, shown, **style: drawn.append((shown, style)))
    draw(summary, tmp_path / "plan.png")
    shown = {style["cmap"].colors[0]: np.isfinite(mask) for mask, style in drawn if style["cmap"] != "gray"}
    hole = shown[COLOURS["hole"]]
    assert hole.mean() == pytest.approx(floor.unknown_share, abs=0.01) and shown[COLOURS["filled"]].any()
    assert (hole[0, 0], hole[-1, -1]) == (False, share > 0.1)  # north-west and south-east


def test_an_area_without_any_cell_of_floor_is_refused(tmp_path):
    file = write(tmp_path / "sparse.npy", lambda x, y: (np.round(x / 0.05) % 8 != 0) | (np.round(y / 0.05) % 8 != 0))
    message = (
        r"plan.area_m: no cell of the floor in the area has a height \(98.\d % of the floor has none\) \(allowed: an"
    )
    with pytest.raises(ScenarioError, match=message):
        mission(file)


@pytest.mark.long
def test_a_survey_at_a_hole_is_judged_on_the_floor_with_heights_and_says_so(tmp_path):
    survey = mission(write(tmp_path / "half.npy", lambda x, y: x > 0.01), "imaging.fidelity=surrogate")
    metrics = run(survey.scenario, tmp_path / "run", outputs=None).metrics
    assert metrics["warnings"][0].startswith("7260 of 14641 cells of the floor (49.6 %) have no height: they are")
    assert metrics["map"]["completeness_area"] > 0.95
