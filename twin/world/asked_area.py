"""Survey area in the scene: centre, heading, and polygon from a list, KML, a plan of QGroundControl, or GeoJSON."""

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any, cast
from xml.etree import ElementTree

import numpy as np
import shapely

from twin.controllers.survey_area import Corner, SurveyArea, polygons_area
from twin.core.georeference import Georeference
from twin.core.records import Array
from twin.core.user_files import read_bytes, read_json, reading
from twin.errors import TwinError
from twin.scenario.model import PlanConfig
from twin.terrains import Terrain

KEY = "plan.polygon"
MOST_BYTES = 10_000_000  #: of a file of an area
_KML = "KML with one Polygon or more"
_QGC = "a .plan of QGroundControl with one survey or more"
_POLYGONS = "GeoJSON with one Polygon or more"
_MOST_NODES = 1_000_000  #: of the floor, from which its mean slope is computed
_LEAST_SLOPE = 1e-3  #: below it, a floor counts as level
#: CRS of a GeoJSON file without a member "crs", if its coordinates are longitude and latitude (RFC 7946).
_LONGITUDE_LATITUDE = "OGC:CRS84"


def kml_polygons(file: Path) -> list[shapely.Polygon]:
    """Returns the polygons of a KML file in longitude and latitude; points and lines are left out.

    Raises TwinError if it is not valid, has a document type (which may name other files) or no polygon.
    """
    data = read_bytes(file, KEY, _KML, MOST_BYTES)
    with reading(file, KEY, _KML):
        if b"<!" in data.replace(b"<!--", b"").replace(b"<![CDATA[", b"") or b"\0" in data:
            raise ValueError("a document type or an encoding other than UTF-8")
        polygons = [_kml_polygon(found) for found in ElementTree.fromstring(data).iterfind(".//{*}Polygon")]
        if not polygons:
            raise ValueError("no polygon")
        return polygons


def _kml_polygon(element: ElementTree.Element) -> shapely.Polygon:
    outer, inner = (
        [_kml_ring(text) for text in element.findall(f"{{*}}{side}/{{*}}LinearRing/{{*}}coordinates")]
        for side in ("outerBoundaryIs", "innerBoundaryIs")
    )
    (outline,) = outer
    return shapely.Polygon(outline, inner)


def _kml_ring(coordinates: ElementTree.Element) -> list[tuple[float, float]]:
    triples = [triple.split(",") for triple in (coordinates.text or "").split()]
    return [(float(longitude), float(latitude)) for longitude, latitude, *_ in triples]


def qgc_polygons(file: Path) -> list[shapely.Polygon]:
    """Returns the areas of the surveys in a plan of QGroundControl, in longitude and latitude.

    Raises TwinError if it is not valid or has no survey; its geofence, a limit of the vehicle, is left out.
    """
    tree = read_json(file, KEY, _QGC, MOST_BYTES)
    with reading(file, KEY, _QGC):
        surveys = [item for item in tree["mission"]["items"] if item.get("complexItemType") == "survey"]
        if not surveys:
            raise ValueError("no survey")
        return [shapely.Polygon([corner[::-1] for corner in item["polygon"]]) for item in surveys]


def survey_area(plan: PlanConfig, terrain: Terrain) -> SurveyArea:
    """Returns the area of a survey in the scene.

    Raises TwinError if keys of the plan contradict each other, the polygon is invalid, or the terrain lacks the
    coordinates that the plan needs or does not contain the polygon or the centre.
    """
    if plan.along_contours:
        for key, given in (("pattern", plan.pattern == "loops"), ("heading_deg", plan.heading_deg != 0)):
            if given:
                raise TwinError(
                    f"plan.{key}", f"{getattr(plan, key)!r} contradicts plan.along_contours", "one of the two"
                )
    heading = math.radians(plan.heading_deg)
    if plan.polygon is None:
        shape = "disc" if plan.pattern == "loops" else "rectangle"
        area = SurveyArea(shape, plan.area_m, _centre(plan, terrain), heading)
        return replace(area, heading=_contour_heading(area, terrain)) if plan.along_contours else area
    for key, given in (("pattern", plan.pattern == "loops"), ("centre_m", any(plan.centre_m)),
                       ("centre_crs", plan.centre_crs is not None)):  # fmt: skip
        if given:
            raise TwinError(f"plan.{key}", f"{getattr(plan, key)!r} has no effect with plan.polygon", "one of the two")
    polygons = [[plan.polygon]] if not isinstance(plan.polygon, str) else read_area(Path(plan.polygon), terrain)
    area = polygons_area(polygons, heading)
    _check_inside("plan.polygon", area.outline(), terrain)
    return polygons_area(polygons, _contour_heading(area, terrain)) if plan.along_contours else area


def _contour_heading(area: SurveyArea, terrain: Terrain) -> float:
    """Returns the direction of the contours of the plane fitted to the floor of an area, -pi/2 to pi/2 [rad]."""
    # 0 if fewer than three nodes are known, or level
    known = np.ones(terrain.height_m.shape, np.bool_) if terrain.known is None else terrain.known
    rows, cols = np.nonzero(known)
    x, y = terrain.west_m + cols * terrain.spacing_m, terrain.south_m + rows * terrain.spacing_m
    inside = np.flatnonzero(area.contains(x, y))
    inside = inside[:: max(1, len(inside) // _MOST_NODES)]
    if len(inside) < 3:
        return 0.0
    points = np.column_stack([x, y, terrain.height_m[rows, cols]])[inside].astype(np.float64)
    points -= points.mean(axis=0)
    (east, north), *_ = np.linalg.lstsq(points[:, :2], points[:, 2])
    if math.hypot(east, north) < _LEAST_SLOPE:
        return 0.0
    return math.atan(-east / north) if north != 0 else math.pi / 2


def _centre(plan: PlanConfig, terrain: Terrain) -> Corner:
    if plan.centre_crs is None:
        _check_inside("plan.centre_m", np.array([plan.centre_m]), terrain)
        return plan.centre_m
    if any(plan.centre_m):
        raise TwinError("plan.centre_crs", "replaces plan.centre_m, which is given too", "one of the two")
    origin = _georeference("plan.centre_crs", terrain)
    x, y = (float(c) for c in origin.to_scene(*plan.centre_crs))
    if np.isnan(terrain.height_at(x, y)):
        (west, east), (south, north) = origin.from_scene(
            [terrain.west_m, terrain.east_m], [terrain.south_m, terrain.north_m]
        )
        shown = ", ".join(f"{c:.2f}" for c in plan.centre_crs)
        allowed = f"easting {west:.2f} to {east:.2f}, northing {south:.2f} to {north:.2f}"
        raise TwinError("plan.centre_crs", f"[{shown}] lies outside the DEM", allowed)
    return x, y


def _georeference(field: str, terrain: Terrain) -> Georeference:
    if terrain.georeference is None:
        raise TwinError(field, "the terrain has no coordinates", "a GeoTIFF with coordinates as terrain.height_file")
    return terrain.georeference


def _check_inside(field: str, points: Array, terrain: Terrain) -> None:
    outside = np.isnan(terrain.height_at(*points.T))
    if outside.any():
        x, y = points[outside][0]
        raise TwinError(field, f"({x:.2f}, {y:.2f}) lies outside the terrain", terrain.extent)


def read_area(file: Path, terrain: Terrain) -> list[list[Array]]:
    """Returns, for each polygon of a file, the corners (n, 2) of its outline and of its holes in the scene [m].

    The file is KML (.kml), a plan of QGroundControl (.plan), both in longitude and latitude, or GeoJSON, of which the
    coordinates are in the CRS of the member "crs". Without it they are longitude and latitude (RFC 7946) if the DEM
    names its CRS, all lie within +-180 and +-90 degrees and, read in the CRS of the DEM, none lies on the DEM;
    otherwise they are in the CRS of the DEM. Raises TwinError unless the file contains polygons (GeoJSON: nothing
    else), whose coordinates can be transformed, and the terrain has coordinates.
    """
    suffix, crs = file.suffix.lower(), _LONGITUDE_LATITUDE
    if suffix in (".kml", ".plan"):
        polygons = kml_polygons(file) if suffix == ".kml" else qgc_polygons(file)
    else:
        tree = read_json(file, KEY, _POLYGONS, MOST_BYTES)
        polygons, crs = _polygons(tree, file), _named_crs(tree)
    rings = [[p.exterior, *p.interiors] for p in polygons]
    corners = shapely.get_coordinates([ring for polygon in rings for ring in polygon])
    if not np.isfinite(corners).all():
        raise TwinError(KEY, f"{file.name!r} has a coordinate that is not finite", "finite numbers")
    origin = _georeference(KEY, terrain)
    if crs is None and origin.crs_wkt is not None and (np.abs(corners) <= [180.0, 90.0]).all():
        is_off_the_dem = np.isnan(terrain.height_at(*origin.to_scene(*corners.T))).all()
        crs = _LONGITUDE_LATITUDE if is_off_the_dem else None
    if crs is not None:
        corners = _projected(corners, crs, origin)
    lengths = [len(ring.coords) for polygon in rings for ring in polygon]
    in_scene = iter(np.split(np.column_stack(origin.to_scene(*corners.T)), np.cumsum(lengths)[:-1]))
    return [[next(in_scene) for _ in polygon] for polygon in rings]


def _polygons(tree: Any, file: Path) -> list[shapely.Polygon]:
    try:
        parts = shapely.get_parts(shapely.get_parts(shapely.from_geojson(json.dumps(tree))))
    except shapely.errors.ShapelyError:
        raise TwinError("plan.polygon", f"{file.name!r} is not valid GeoJSON", _POLYGONS) from None
    if len(parts) == 0 or not all(isinstance(part, shapely.Polygon) for part in parts):
        raise TwinError("plan.polygon", f"{file.name!r} does not hold polygons only", _POLYGONS)
    if any(part.is_empty for part in parts):
        raise TwinError("plan.polygon", f"{file.name!r} has a polygon without corners", _POLYGONS)
    return cast(list[shapely.Polygon], list(parts))


def _named_crs(tree: Any) -> str | None:
    try:
        return str(tree["crs"]["properties"]["name"])
    except (KeyError, TypeError):
        return None


def _projected(corners: Array, crs: str, origin: Georeference) -> Array:
    from rasterio.crs import CRS  # imported here: it takes 20 MB, and few plans need it
    from rasterio.errors import RasterioError
    from rasterio.warp import transform

    try:
        target = CRS.from_wkt(origin.crs_wkt or "")
        return np.column_stack(transform(CRS.from_user_input(crs), target, *corners.T.tolist())[:2])
    except (RasterioError, ValueError, OverflowError) as error:
        problem = f"{crs[:100]!r} cannot be transformed to the CRS of the DEM: {error}"
        raise TwinError("plan.polygon", problem, "coordinates in the CRS of the DEM") from None
