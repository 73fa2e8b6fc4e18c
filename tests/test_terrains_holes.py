"""Floor without a height: it is neither planned over nor judged, and the user is told."""

import numpy as np
import pytest

from twin import terrains
from twin.core.timing import Stopwatch
from twin.errors import ScenarioError
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
    given[25, :3] = False  # open at the border
    known = known_nodes(given)
    assert known is not None and known[5:8, 5:30].all()
    assert not known[15:20, 5:10].any() and not known[25, :3].any()
    assert (~known).sum() == 25 + 3
    assert known_nodes(np.ones((3, 3), np.bool_)) is None
    given[15:, :] = True
    assert known_nodes(given) is None  # only the small hole is left


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
def test_a_survey_at_a_hole_is_judged_on_the_floor_with_heights_and_says_so(tmp_path):
    survey = mission(write(tmp_path / "half.npy", lambda x, y: x > 0.01), "imaging.fidelity=surrogate")
    metrics = run(survey.scenario, tmp_path / "run", outputs=None).metrics
    assert metrics["warnings"][0].startswith("7260 of 14641 cells of the floor (49.6 %) have no height: they are")
    assert metrics["map"]["completeness_area"] > 0.95
