"""Input statement of a floor: what its files state, what was assumed, and what is doubtful."""

import json

import numpy as np
import pytest
import rasterio
from judge_synthetic import write_folder
from rasterio.transform import from_origin

from twin import terrains
from twin.app.console import print_plan
from twin.errors import TwinError
from twin.judge.summary_statistics import finite_tree
from twin.planning.summary import as_json, summarise
from twin.report.headline import input_rows
from twin.report.run_folder import load_run
from twin.report.survey_page import context
from twin.scenario.file import load_scenario
from twin.survey import run
from twin.world.mission import prepare

EAST, NORTH = 500_000.0, 8_200_000.0  # on the central meridian of a UTM zone
HEIGHTS = (-6 + 0.1 * np.sin(np.arange(60 * 80) / 40)).reshape(60, 80).astype(np.float32)


def write(file, values=HEIGHTS, crs: str | None = "EPSG:32755", spacing=0.1, east=EAST, unit="", **profile):
    bands = np.atleast_3d(values)
    layout = {"driver": "GTiff", "height": bands.shape[0], "width": bands.shape[1], "count": bands.shape[2]}
    place = from_origin(east, NORTH, spacing, spacing)
    with rasterio.open(file, "w", **layout, dtype=bands.dtype, crs=crs, transform=place, **profile) as target:
        target.write(np.moveaxis(bands, 2, 0))
        target.units = (unit,) * bands.shape[2]
    return file


def stated(file, z=None, **texture):
    floor = terrains.load(file, terrains.TextureSource(0.1, **texture), 0.1, 3.0, 0, z)
    assert floor.stated is not None
    return floor.stated


def test_crs_scale_range_and_nodata_are_those_that_rasterio_reads(tmp_path):
    values = HEIGHTS.copy()
    values[:6, :10] = -50.0
    found = stated(write(tmp_path / "dem.tif", values, nodata=-50.0))
    assert (found.file, found.crs, found.nodata) == ("dem.tif", "WGS 84 / UTM zone 55S", "-50")
    assert found.ground_scale == pytest.approx(1 / 0.9996, abs=1e-6)  # of UTM on its central meridian
    assert (found.least, found.greatest) == (values[values > -50].min(), values.max())
    assert found.share_without_height == pytest.approx(60 / 4800) and found.doubts == ()
    assert stated(write(tmp_path / "local.tif", crs=None)).ground_scale is None


@pytest.mark.parametrize(
    ("written", "z", "unit", "direction"),
    [
        ({"unit": "m"}, None, "unit of the band", "assumed: values from -6.1"),
        ({}, "up", "assumed: it names none", "terrain.z"),
        (
            {"values": -HEIGHTS, "crs": "EPSG:32755+5831"},
            None,
            "vertical CRS or unit of the band",
            "vertical CRS or CF attributes",
        ),
    ],
)
def test_unit_and_direction_are_stated_with_their_evidence(tmp_path, written, z, unit, direction):
    found = stated(write(tmp_path / "dem.tif", **written), z)
    assert found.unit_evidence == unit and found.direction_evidence.startswith(direction)
    assert found.direction == ("up" if written.get("values") is None else "down")


def test_a_value_apart_that_may_mark_holes_is_a_doubt_and_a_far_one_an_error(tmp_path):
    values = HEIGHTS.copy()
    values[:6, :10] = 0.0
    np.save(tmp_path / "dem.npy", values)
    (doubt,) = stated(tmp_path / "dem.npy", "up").doubts
    assert doubt.startswith("'dem.npy' has the value 0 in 60 cells, far from all others (-6.1")
    values[:6, :10] = 900.0
    with pytest.raises(TwinError, match="the value 900 in 60 cells"):
        stated(write(tmp_path / "dem.tif", values))


def test_a_defective_pixel_does_not_darken_an_orthophoto_of_12_bits(tmp_path):
    photo, textures = np.random.default_rng(1).integers(500, 4000, (60, 80, 3)).astype(np.uint16), []
    for hot in (4000, 65535):
        photo[30, 40] = hot
        dem, colours = write(tmp_path / "dem.tif"), write(tmp_path / "photo.tif", photo)
        floor = terrains.load(dem, terrains.TextureSource(0.1, orthophoto_file=str(colours)), 0.1, 3.0, 0)
        textures.append(floor.texture)
    np.testing.assert_allclose(textures[0].mean(), photo.mean() * 255 / 4095, rtol=0.01)
    assert np.ptp(textures, axis=0).any(axis=2).sum() <= 9
    assert (
        floor.stated is not None and floor.stated.texture == "photo.tif over 100 % of the floor, else generated: reef"
    )


def test_pixels_without_data_do_not_darken_an_orthophoto_of_12_bits(tmp_path):
    photo = np.random.default_rng(1).integers(500, 4000, (60, 80, 3)).astype(np.uint16)
    photo[:10] = 65535
    dem, colours = write(tmp_path / "dem.tif"), write(tmp_path / "photo.tif", photo, nodata=65535)
    floor = terrains.load(dem, terrains.TextureSource(0.1, orthophoto_file=str(colours)), 0.1, 3.0, 0)
    halves = np.split(floor.texture[: len(floor.texture) // 2 * 2], 2)  # one of them is far from those pixels
    assert max(half.mean() for half in halves) == pytest.approx(photo[30:].mean() * 255 / 4095, rel=0.03)


DOUBT = "'dem.tif' has the value 0 in 4 cells, far from all others (-6.1 to -5.9), and does not declare it as nodata."


@pytest.fixture
def mission(tmp_path):
    values = HEIGHTS.copy()
    values[:2, :2] = 0.0
    file = write(tmp_path / "dem.tif", values)
    keys = ["terrain.kind=file", "plan.area_m=[1.0, 1.0]", "plan.tracks=1", "plan.altitude_m=1.5"]
    keys += [
        "terrain.texture_px_m=0.05",
        "rig.model=ideal",
        "imaging.fidelity=surrogate",
        "plan.clearance_m=0.2",
        "plan.centre_m=[1.5, -1.0]",
    ]
    return prepare(load_scenario("reef", [f"terrain.height_file={file}", *keys]))


def test_a_plan_shows_the_statement_and_warns_of_its_doubts(mission, capsys):
    summary, statement = summarise(mission), finite_tree(mission.stated_input)
    assert statement["doubts"] == [DOUBT]
    assert as_json(summary, "")["input"] == statement and DOUBT.removesuffix(".") in summary.warnings
    print_plan(summary)
    printed = capsys.readouterr()
    assert "WGS 84 / UTM zone 55S, ground scale 1.0004" in printed.out and DOUBT in printed.err


@pytest.mark.long
def test_metrics_and_report_of_a_run_have_the_statement_and_a_damaged_one_is_refused(mission, tmp_path):
    result = run(mission.scenario, tmp_path / "flown", outputs=None)
    assert result.metrics["input"] == finite_tree(mission.stated_input) and result.metrics["warnings"][0] == DOUBT
    statement, folder = finite_tree(mission.stated_input), write_folder(tmp_path / "run")
    metrics = json.loads((folder / "metrics.json").read_text())
    assert metrics["input"] == {}  # of a generated floor
    (folder / "metrics.json").write_text(json.dumps(metrics | {"input": statement}))
    assert context(load_run(folder))["input"] == input_rows(statement)
    for damaged in ({"file": "dem.tif"}, "x", statement | {"least": "low"}):
        (folder / "metrics.json").write_text(json.dumps(metrics | {"input": damaged}))
        with pytest.raises(TwinError, match="metrics.json: cannot be read: input"):
            load_run(folder)
