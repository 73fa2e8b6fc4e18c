"""Planned paths for other programs, and survey areas from them."""

import csv
import json
import math
from xml.etree import ElementTree

import numpy as np
import pytest
import shapely
from rasterio.warp import transform
from test_terrains_input import EAST, NORTH, write

from twin.core import geometry
from twin.errors import TwinError
from twin.exports.command import ExportOptions, export_any
from twin.exports.planned_path import TOLERANCE_M, planned_path
from twin.scenario.file import load_scenario
from twin.world.asked_area import read_area
from twin.world.mission import prepare

KEYS = ["plan.area_m=[2.0, 1.6]", "plan.altitude_m=1.5", "plan.clearance_m=0.2", "plan.heading_deg=30"]
KEYS += ["terrain.texture_px_m=0.05", "rig.model=ideal", "terrain.kind=file", "plan.tracks=2", "control.hold_s=3"]
A, E2 = 6_378_137.0, 0.00669437999014  # WGS 84


@pytest.fixture(scope="module")
def scenario(tmp_path_factory):
    file = write(tmp_path_factory.mktemp("floor") / "dem.tif", east=EAST + 150_000)  # 1.4 deg from the meridian
    return load_scenario("reef", [f"terrain.height_file={file}", *KEYS])


@pytest.fixture(scope="module")
def written(scenario, tmp_path_factory):
    overrides = [f"terrain.height_file={scenario.terrain.height_file}", *KEYS]
    files = export_any("reef", ["qgc,kml", "gpx", "csv"], tmp_path_factory.mktemp("plans"), overrides)
    return {name: file.read_text() for name, (file,) in files.items()}


def metres(longitude_latitude):
    """Returns positions east and north of the first point, by the radii of curvature of the ellipsoid."""
    degrees = np.asarray(longitude_latitude)
    phi = math.radians(degrees[0, 1])
    root = math.sqrt(1 - E2 * math.sin(phi) ** 2)
    per_radian = np.array([A / root * math.cos(phi), A * (1 - E2) / root**3])
    return np.radians(degrees - degrees[0]) * per_radian


def test_the_planned_path_of_the_vehicle_is_within_the_tolerance_of_the_lines_between_waypoints(scenario):
    mission = prepare(scenario)
    path = planned_path(mission, mission.terrain.georeference)
    assert len(path.track) < 60
    np.testing.assert_allclose(path.scene_m[0], mission.start_of_body[:3, 3], atol=1e-9)
    for track in mission.tracks:
        reference = mission.plan.references(track, mission.plan.frames_of_track(track)[0])
        camera = geometry.rotations_of_down_camera(np.asarray(reference.yaw))
        body = [
            (geometry.pose(turn, at) @ geometry.inverse(mission.rig.body_from_camera))[:2, 3]
            for turn, at in zip(camera, reference.position, strict=True)
        ]
        line = shapely.LineString(path.scene_m[path.track == track, :2])
        assert shapely.distance(line, shapely.points(body)).max() <= TOLERANCE_M


def test_positions_and_headings_are_those_of_the_ellipsoid(scenario):
    """A bow along the leg points to the next waypoint; the grid of the CRS is turned by 0.4 deg from true north."""
    mission = prepare(scenario)
    path = planned_path(mission, mission.terrain.georeference)
    place = metres(path.longitude_latitude)
    flat = path.scene_m[:, :2] - path.scene_m[0, :2]
    np.testing.assert_allclose(np.hypot(*place.T), np.hypot(*flat.T), rtol=5e-4, atol=1e-3)  # scale of UTM
    east, north = place[1]
    assert path.heading_deg[0] == pytest.approx(math.degrees(math.atan2(east, north)), abs=0.02)
    assert abs(path.heading_deg[0] - 60) > 0.3
    dem = mission.terrain.georeference
    assert dem is not None
    np.testing.assert_allclose(path.crs[:, 2], dem.elevation_m + path.scene_m[:, 2])


def test_a_mission_of_qgroundcontrol_has_what_its_loader_demands(written, scenario):
    """Keys and types are those of `MissionItem::load`, `SimpleMissionItem::load` and `MissionController::load`."""
    plan = json.loads(written["qgc"])
    mission, items = plan["mission"], plan["mission"]["items"]
    assert (plan["fileType"], plan["version"], mission["version"]) == ("Plan", 1, 2)
    assert (mission["firmwareType"], mission["vehicleType"]) == (3, 12)  # ArduPilot, submarine
    assert [len(mission["plannedHomePosition"]), plan["geoFence"]["version"], plan["rallyPoints"]["version"]] == [
        3,
        2,
        2,
    ]
    for number, item in enumerate(items, 1):
        assert item["type"] == "SimpleItem" and item["doJumpId"] == number and item["autoContinue"] is True
        assert len(item["params"]) == 7 and all(isinstance(value, int | float) for value in item["params"])
    speed, *points = items
    assert (speed["command"], speed["frame"], speed["params"][:2]) == (178, 2, [1, scenario.plan.speed_mps])
    assert {(p["command"], p["frame"], p["AltitudeMode"]) for p in points} == {(16, 3, 1)}
    assert all(p["Altitude"] == p["params"][6] < 0 for p in points)
    holds = [p["params"][0] for p in points]
    assert holds[-1] == 3 and holds.count(3) == 2 and set(holds) == {0, 3}


def test_all_formats_have_the_same_waypoints(written):
    rows = list(csv.DictReader(written["csv"].splitlines()))
    points = np.array([[float(row[key]) for key in ("longitude_deg", "latitude_deg", "elevation_m")] for row in rows])
    items = json.loads(written["qgc"])["mission"]["items"][1:]
    np.testing.assert_allclose(np.array([item["params"][4:] for item in items])[:, [1, 0, 2]], points, atol=2e-9)
    route = ElementTree.fromstring(written["gpx"]).iter("{http://www.topografix.com/GPX/1/1}rtept")
    found = [[float(p.attrib["lon"]), float(p.attrib["lat"]), float(p[0].text or "")] for p in route]
    np.testing.assert_allclose(found, points, atol=2e-9)
    lines = ElementTree.fromstring(written["kml"]).iter("{http://www.opengis.net/kml/2.2}coordinates")
    triples = [triple.split(",") for line in lines for triple in (line.text or "").split()]
    np.testing.assert_allclose(np.array(triples, float), points, atol=2e-9)
    grid = np.array([[float(row["easting"]), float(row["northing"])] for row in rows])
    back = np.column_stack(transform("EPSG:4326", "EPSG:32755", *points[:, :2].T.tolist()))
    np.testing.assert_allclose(back, grid, atol=1e-3)


@pytest.mark.parametrize(
    ("names", "options", "problem"),
    [
        (["qgc", "euroc"], {}, "has formats of a planned path and of a run"),
        (["qgx"], {}, "'qgx' is not a format"),
        (["kml"], {}, "reef has no place on the Earth"),
        (["qgc"], {"crs": "EPSG:32633", "origin": "432000,5571000,-1"}, r"the path is up to 1.\d+ m above the zero"),
        (["qgc"], {"crs": "EPSG:32633"}, "--crs: is given without --origin"),
    ],
)
def test_a_path_that_cannot_be_exported_is_refused_and_nothing_written(tmp_path, names, options, problem):
    reef = ["plan.area_m=[1.0, 1.0]", "plan.tracks=1", "terrain.texture_px_m=0.05", "rig.model=ideal"]
    with pytest.raises(TwinError, match=problem):
        export_any("reef", names, tmp_path / "out", reef, ExportOptions(**options))
    assert not list(tmp_path.glob("out/*"))


SQUARE = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0], [0.0, 0.0]])
RINGS = [[2 * SQUARE - 2.5, SQUARE * 0.5 - 2], [SQUARE + 1]]  # a square with a hole, and another one


def degrees(ring):
    place = ring + (EAST + 4.0, NORTH - 3.0)  # the centre of the DEM
    return np.column_stack(transform("EPSG:32755", "EPSG:4326", *place.T.tolist())).tolist()


def kml(rings):
    def ring(side, points):
        text = "\n".join(f"{longitude:.12f},{latitude:.12f},0" for longitude, latitude in degrees(points))
        return f"<{side}><LinearRing><coordinates>\n{text}\n</coordinates></LinearRing></{side}>"

    shapes = [
        f"<Placemark><Polygon>{ring('outerBoundaryIs', first)}{''.join(ring('innerBoundaryIs', r) for r in others)}"
        "</Polygon></Placemark>" for first, *others in rings
    ]  # fmt: skip
    return f'<kml xmlns="http://www.opengis.net/kml/2.2"><Document>{"".join(shapes)}</Document></kml>'


def qgc(rings):
    corners = [[[latitude, longitude] for longitude, latitude in degrees(ring)[:-1]] for ring in rings]
    items = [{"type": "ComplexItem", "complexItemType": "survey", "polygon": ring} for ring in corners]
    return json.dumps({"mission": {"items": [{"type": "SimpleItem"}, *items]}})


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("area.kml", kml(RINGS)),
        ("area.plan", qgc([RINGS[0][0], RINGS[1][0]])),
    ],
)
def test_an_area_of_kml_or_qgroundcontrol_is_that_of_its_corners(tmp_path, name, text):
    (tmp_path / name).write_text(text)
    floor = prepare_floor(tmp_path)
    polygons = [shapely.Polygon(outline, holes) for outline, *holes in read_area(tmp_path / name, floor)]
    holes = [others if name.endswith("kml") else [] for _, *others in RINGS]  # a survey has none
    expected = [shapely.Polygon(rings[0], inner) for rings, inner in zip(RINGS, holes, strict=True)]
    assert shapely.MultiPolygon(polygons).symmetric_difference(shapely.MultiPolygon(expected)).area < 1e-5


def prepare_floor(folder):
    from twin import terrains

    return terrains.load(write(folder / "dem.tif"), terrains.TextureSource(0.1), 0.1, 1.0, 0)


@pytest.mark.parametrize(
    ("name", "text", "problem"),
    [
        ("a.kml", "<kml/>", "no polygon"),
        ("a.kml", "<kml>", "no element found"),
        ("a.kml", '<!DOCTYPE k [<!ENTITY e SYSTEM "file:///etc/passwd">]><kml>&e;</kml>', "a document type"),
        ("a.kml", kml(RINGS).replace(",0", ""), ""),
        ("a.kml", "<a>" * 30_000 + "</a>" * 30_000, "no polygon"),
        ("a.plan", "[]", "TypeError"),
        ("a.plan", qgc([]), "no survey"),
    ],
)
def test_a_file_without_an_area_is_one_error(tmp_path, name, text, problem):
    (tmp_path / name).write_text(text)
    floor = prepare_floor(tmp_path)
    if not problem:
        assert len(read_area(tmp_path / name, floor)) == 2  # altitudes may be left out
        return
    with pytest.raises(TwinError, match=f"^plan.polygon: '{name}' cannot be read: [^\n]*{problem}[^\n]*$"):
        read_area(tmp_path / name, floor)
