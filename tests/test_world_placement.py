"""The survey area in the coordinates of a measured DEM, and maps that return in them."""

import json

import numpy as np
import pytest
import rasterio
from rasterio.transform import from_origin
from rasterio.warp import transform

from twin import survey
from twin.core.georeference import Georeference
from twin.core.records import ElevationMap, MapGrid
from twin.errors import ScenarioError, TwinError
from twin.exchange import geotiff
from twin.report.run_folder import load_run, read_raster
from twin.scenario.file import load_scenario
from twin.scenario.model import PlanConfig
from twin.world.asked_area import read_area, survey_area
from twin.world.mission import prepare

UTM = "EPSG:32755"
WEST, NORTH, CELL = 412_345.25, 8_345_678.5, 0.05
SIZE = 160  # cells: 8 m
EAST, SOUTH = WEST + SIZE * CELL, NORTH - SIZE * CELL
CENTRE = ((WEST + EAST) / 2, (SOUTH + NORTH) / 2)


def elevation_at(east, north):
    """Returns the elevation of a smooth floor 12 m below the datum."""
    x, y = np.asarray(east) - CENTRE[0], np.asarray(north) - CENTRE[1]
    return -12.0 + 0.05 * x + 0.2 * np.exp(-((x - 0.5) ** 2) - (y + 0.3) ** 2)


@pytest.fixture
def dem(tmp_path):
    """Writes a DEM in EPSG:32755 with depths, positive downwards, and a scenario over it."""
    cells = (np.arange(SIZE) + 0.5) * CELL
    depth = -elevation_at(*np.meshgrid(WEST + cells, NORTH - cells)).astype(np.float32)
    with rasterio.open(
        tmp_path / "dem.tif", "w", driver="GTiff", count=1, height=SIZE, width=SIZE, dtype="float32", crs=UTM,
        transform=from_origin(WEST, NORTH, CELL, CELL),
    ) as file:  # fmt: skip
        file.write(depth[None])
        file.set_band_description(1, "depth")
    scenario = tmp_path / "site.toml"
    scenario.write_text(
        f'extends = "{load_scenario("reef").source.path}"\n[imaging]\nfidelity = "surrogate"\n'
        '[terrain]\nkind = "file"\nheight_file = "dem.tif"\ntexture_px_m = 0.02\n[control]\nhold_s = 0.5\n'
        "[plan]\narea_m = [1.2, 0.8]\n"
    )
    return scenario


def mission(file, *overrides):
    return prepare(load_scenario(file, list(overrides)))


def test_the_area_lies_at_its_coordinates_in_the_dem(dem):
    east, north = CENTRE[0] + 0.7, CENTRE[1] - 0.4
    m = mission(dem, f"plan.centre_crs=[{east}, {north}]")
    np.testing.assert_allclose(m.plan.area.centre_m, (0.7, -0.4), atol=1e-9)
    assert m.plan.outline()[:, :2].mean(axis=0) == pytest.approx((0.7, -0.4), abs=0.3)


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (
            ["plan.centre_crs=[400000.0, 8345674.0]"],
            "plan.centre_crs: [400000.00, 8345674.00] lies outside the DEM (allowed: easting 412345.28 to 412353.22, "
            "northing 8345670.53 to 8345678.47)",
        ),
        (["plan.centre_crs=[412349.0, 8345674.0]", "plan.centre_m=[1.0, 0.0]"], "plan.centre_crs: replaces plan.cen"),
        (["plan.centre_m=[9.0, 0.0]"], "plan.centre_m: (9.00, 0.00) lies outside the terrain (allowed: x -3.98 to"),
        (["plan.centre_m=[3.7, 0.0]"], "plan.area_m: the path leaves the terrain"),
        (["plan.area_m=[7.9, 2.0]", "plan.heading_deg=20"], "plan.area_m: 7.9 x 2 m at a heading of 20 deg is larger"),
        (["plan.polygon=[[0, 0], [9, 0], [0, 9]]"], "plan.polygon: (9.00, 0.00) lies outside the terrain"),
        (["plan.polygon=[[0, 0], [1, 1], [1, 0], [0, 1]]"], "plan.polygon: is not simple: Self-intersection[0.5 0.5]"),
        (["plan.polygon=[[0, 0], [1, 0], [1, 1]]", "plan.centre_m=[1, 0]"], "plan.centre_m: (1.0, 0.0) has no effect"),
        (["plan.polygon=[[0, 0], [1, 0], [1, 1]]", "plan.pattern=loops"], "plan.pattern: 'loops' has no effect with"),
        (["plan.polygon=none.geojson"], "plan.polygon: no such file"),
        (["plan.turns=bow_first", "vehicle.dynamics=kinematic"], "plan.turns: 'bow_first': a kinematic vehicle does"),
        (["terrain.z=up"], "plan.altitude_m: "),  # upside down: the asked side is flown, and the floor is another
    ],
)
def test_an_area_that_cannot_be_placed_is_rejected_with_its_key(dem, overrides, message):
    if overrides == ["terrain.z=up"]:
        overrides = [*overrides, "plan.altitude_m=0.5"]
    with pytest.raises(ScenarioError) as caught:
        mission(dem, *overrides)
    assert any(message in line for line in caught.value.lines), caught.value.lines


@pytest.mark.parametrize("value", ["[[0, 0], [1, 0, 2]]", "3", "[[0, 0], [1, true]]", "[1, 2, 3]", "{a = 1}"])
def test_a_polygon_that_is_no_list_of_corners_gives_one_error(tmp_path, value):
    file = tmp_path / "bad.toml"
    file.write_text(f"[plan]\npolygon = {value}\n")
    with pytest.raises(ScenarioError) as caught:
        load_scenario(file)
    assert len(caught.value.lines) == 1 and "a list of corners [x, y], or a GeoJSON file" in caught.value.lines[0]


def test_a_generated_floor_has_no_coordinates():
    with pytest.raises(ScenarioError, match="plan.centre_crs: the terrain has no coordinates"):
        mission("reef", "plan.centre_crs=[1.0, 2.0]", "terrain.texture_px_m=0.2")


CORNERS = np.array([[-1.0, -0.5], [1.0, -0.5], [0.5, 0.8], [-1.0, -0.5]])


@pytest.mark.parametrize("form", ["dem", "named", "degrees", "feature", "byte order mark"])
def test_a_geojson_polygon_is_read_in_the_crs_of_the_dem_or_its_own(dem, tmp_path, form):
    points = CORNERS + CENTRE
    tree = {"type": "Polygon", "coordinates": [points.tolist()]}
    if form in ("degrees", "named"):
        crs = "EPSG:4326" if form == "degrees" else "EPSG:28355"  # GDA94 / MGA zone 55
        tree["coordinates"] = [np.column_stack(transform(UTM, crs, *points.T.tolist())).tolist()]
    if form == "named":
        tree["crs"] = {"type": "name", "properties": {"name": "urn:ogc:def:crs:EPSG::28355"}}
    if form == "feature":
        tree = {"type": "FeatureCollection", "features": [{"type": "Feature", "geometry": tree}]}
    (tmp_path / "area.geojson").write_text(json.dumps(tree), "utf-8-sig" if form == "byte order mark" else "utf-8")
    terrain = mission(dem).terrain
    np.testing.assert_allclose(read_area(tmp_path / "area.geojson", terrain)[0][0], CORNERS, atol=1e-3)
    area = survey_area(PlanConfig(polygon=str(tmp_path / "area.geojson"), heading_deg=20), terrain)
    np.testing.assert_allclose(area.outline(), CORNERS, atol=1e-3)


def test_holes_and_parts_of_a_geojson_file_are_parts_of_the_area(dem, tmp_path):
    square = np.array([[0, 0], [1, 0], [1, 1], [0, 1], [0, 0]])
    rings = [[2 * square - 2.5, square * 0.5 - 2], [square + 1]]
    tree = {"type": "MultiPolygon", "coordinates": [[(ring + CENTRE).tolist() for ring in part] for part in rings]}
    (tmp_path / "area.geojson").write_text(json.dumps(tree))
    m = mission(dem, f"plan.polygon={tmp_path}/area.geojson", "plan.cross_lines=1", "plan.altitude_m=3.0")
    x, y = np.meshgrid(*m.grid.centres())
    assert m.asked(x, y).sum() * m.grid.cell_m**2 == pytest.approx(4 - 0.25 + 1, rel=0.02)


@pytest.mark.parametrize(
    "content",
    [
        "{",
        "[]",
        "7",
        '{"type": "Point"}',
        '{"type": "Polygon", "coordinates": [[[1]]]}',
        '{"type": "Polygon", "coordinates": [[[0, 0], [1, 0], [1, 1], [0, 1]]]}',  # not closed
        '{"type": "Polygon", "coordinates": {"ring": []}}',
        '{"type": "FeatureCollection", "features": {"first": {}}}',
    ],
)
def test_a_damaged_geojson_file_is_an_error(dem, tmp_path, content):
    (tmp_path / "bad.geojson").write_text(content)
    with pytest.raises(TwinError) as caught:
        read_area(tmp_path / "bad.geojson", mission(dem).terrain)
    assert caught.value.field == "plan.polygon"


def _with_datum(folder, datum):
    """Writes a small georeferenced layer whose vertical datum is known, and returns its path."""
    origin = Georeference(0.0, 0.0, vertical_datum=datum)
    geotiff.write_layer(folder / "datum.tif", np.zeros((2, 2), np.float32), MapGrid(0, 0, 1.0, 2, 2), "", origin)
    return folder / "datum.tif"


@pytest.mark.parametrize("metres_per_unit", [1.0, 0.3048])
def test_a_georeferenced_map_is_read_back_in_scene_coordinates(tmp_path, metres_per_unit):
    crs = rasterio.crs.CRS.from_user_input(UTM if metres_per_unit == 1 else "EPSG:2222").to_wkt()
    origin = Georeference(*CENTRE, -3000.123456, crs, metres_per_unit)
    grid = MapGrid(-3.1, 4.7, 0.02, 30, 40)
    height = np.random.default_rng(0).random((30, 40), np.float32)
    height[2, 3] = np.nan
    mosaic = np.full((30, 40, 3), 7, np.uint8)
    geotiff.write_map(tmp_path, ElevationMap(grid, height, height / 10, mosaic), origin)
    for name, values in {"dem": height, "dem_sigma": height / 10, "mosaic": mosaic}.items():
        read = read_raster(tmp_path / f"{name}.tif")
        assert read.grid == grid
        np.testing.assert_allclose(read.values, values, atol=1e-9)
    with rasterio.open(tmp_path / "dem.tif") as file:
        east, north = origin.from_scene(-3.09, 4.69)  # the centre of the north-western cell
        assert next(file.sample([(float(east), float(north))]))[0] == pytest.approx(float(height[0, 0]) - 3000.123456)
        assert file.tags()["SCENE_ORIGIN_ELEVATION_M"] == "-3000.123456"
    assert geotiff.read_georeference(tmp_path / "dem.tif").vertical_datum == ""
    assert geotiff.read_georeference(_with_datum(tmp_path, "EGM96 height")).vertical_datum == "EGM96 height"


def test_a_survey_over_a_dem_returns_its_maps_in_the_coordinates_of_the_dem(dem, tmp_path):
    overrides = ["plan.tracks=1", "plan.heading_deg=25", f"plan.centre_crs=[{CENTRE[0] + 0.3}, {CENTRE[1] - 0.2}]"]
    result = survey.run(load_scenario(dem, overrides), tmp_path / "run", outputs=())
    assert result.status == "complete"
    for name in ("dem", "dem_sigma", "dem_truth", "dem_error", "mosaic"):
        with rasterio.open(tmp_path / "run" / f"{name}.tif") as file:
            assert file.crs.to_epsg() == 32755
    for name, tolerance_m in {"dem_truth": 1e-3, "dem": 0.02}.items():  # linear interpolation; errors of the survey
        with rasterio.open(tmp_path / "run" / f"{name}.tif") as file:
            values = file.read(1)
            rows, cols = np.nonzero(np.isfinite(values))
            east, north = (np.asarray(c) for c in rasterio.transform.xy(file.transform, rows, cols))
        error = values[rows, cols] - elevation_at(east, north)
        assert len(error) > 1000 and np.quantile(np.abs(error), 0.95) < tolerance_m
    # the position of the hill, from the phase of the truth raster: a shift of half a cell would change the error
    shifted = np.abs(values[rows, cols] - elevation_at(east + CELL / 2, north + CELL / 2))
    assert np.quantile(np.abs(error), 0.95) < np.quantile(shifted, 0.95)
    run = load_run(tmp_path / "run")
    assert np.nanmin(run.rasters["dem_truth"].values) >= 0 and abs(run.rasters["dem"].grid.west_m) < 5


def test_a_survey_with_the_bow_first_is_as_accurate_as_one_that_flies_backwards(tmp_path):
    small = ['imaging.fidelity="surrogate"', "plan.tracks=1", "plan.area_m=[1.2, 0.8]", "control.hold_s=0.5"]
    runs = {
        turns: survey.run(load_scenario("reef", [*small, f"plan.turns={turns}"]), tmp_path / turns, outputs=())
        for turns in ("reverse", "bow_first")
    }
    reverse, bow_first = (runs[turns].metrics for turns in ("reverse", "bow_first"))
    assert runs["bow_first"].status == "complete"
    assert bow_first["trajectory"]["final"]["ate_rmse_m"] < 2 * reverse["trajectory"]["final"]["ate_rmse_m"]
    assert bow_first["map"]["le90_m"] < 1.5 * reverse["map"]["le90_m"]
    assert bow_first["overlap"]["along_median"] == pytest.approx(reverse["overlap"]["along_median"], abs=0.02)
    planned = load_run(tmp_path / "bow_first").trajectories["reference"].world_from_camera
    true = load_run(tmp_path / "bow_first").trajectories["truth"].world_from_camera
    top = np.einsum("ni,ni->n", planned[:, :3, 1], true[:, :3, 1])  # cosine between planned and true heading
    assert (planned[-1, :2, 1] @ planned[0, :2, 1]) == pytest.approx(-1) and np.quantile(top, 0.05) > 0.97
