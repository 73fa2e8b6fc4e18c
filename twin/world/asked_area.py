"""Placement of the survey area in the scene: centre, heading, and polygon from a list or a GeoJSON file."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import shapely

from twin.controllers.survey_area import Corner, SurveyArea, polygon_area
from twin.core.georeference import Georeference
from twin.core.records import Array
from twin.core.user_files import read_json
from twin.errors import TwinError
from twin.scenario.model import PlanConfig
from twin.terrains import Terrain

_MAX_GEOJSON_BYTES = 10_000_000
_ONE_POLYGON = "GeoJSON with one Polygon without holes"
#: CRS of a GeoJSON file without a member "crs", if its coordinates are longitude and latitude (RFC 7946).
_LONGITUDE_LATITUDE = "OGC:CRS84"


def survey_area(plan: PlanConfig, terrain: Terrain) -> SurveyArea:
    """Returns the area of a survey in the scene.

    Raises TwinError if keys of the plan contradict each other, the polygon is invalid, or the terrain lacks the
    coordinates that the plan needs or does not contain the polygon or the centre.
    """
    heading = math.radians(plan.heading_deg)
    if plan.polygon is None:
        shape = "disc" if plan.pattern == "loops" else "rectangle"
        return SurveyArea(shape, plan.area_m, _centre(plan, terrain), heading)
    for key, given in (("pattern", plan.pattern == "loops"), ("centre_m", any(plan.centre_m)),
                       ("centre_crs", plan.centre_crs is not None)):  # fmt: skip
        if given:
            raise TwinError(f"plan.{key}", f"{getattr(plan, key)!r} has no effect with plan.polygon", "one of the two")
    corners = plan.polygon if not isinstance(plan.polygon, str) else read_geojson(Path(plan.polygon), terrain)
    area = polygon_area(corners, heading)
    _check_inside("plan.polygon", area.outline(), terrain)
    return area


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


def read_geojson(file: Path, terrain: Terrain) -> Array:
    """Returns the corners (n, 2) of the polygon in a GeoJSON file, in the scene [m], in the order of the file.

    The coordinates are in the CRS of the member "crs". Without it they are longitude and latitude (RFC 7946) if the DEM
    names its CRS, all lie within +-180 and +-90 degrees and, read in the CRS of the DEM, none lies on the DEM;
    otherwise they are in the CRS of the DEM. Raises TwinError unless the file contains exactly one polygon without
    holes, whose coordinates can be transformed, and the terrain has coordinates.
    """
    tree = read_json(file, "plan.polygon", _ONE_POLYGON, _MAX_GEOJSON_BYTES)
    corners = shapely.get_coordinates(_polygon(tree, file).exterior)
    if not np.isfinite(corners).all():
        raise TwinError("plan.polygon", f"{file.name!r} has a coordinate that is not finite", _ONE_POLYGON)
    origin = _georeference("plan.polygon", terrain)
    crs = _named_crs(tree)
    if crs is None and _is_longitude_latitude(corners, terrain, origin):
        crs = _LONGITUDE_LATITUDE
    if crs is not None:
        corners = _projected(corners, crs, origin)
    return np.column_stack(origin.to_scene(*corners.T))


def _polygon(tree: Any, file: Path) -> shapely.Polygon:
    try:
        parts = shapely.get_parts(shapely.get_parts(shapely.from_geojson(json.dumps(tree))))
    except shapely.errors.ShapelyError:
        raise TwinError("plan.polygon", f"{file.name!r} is not valid GeoJSON", _ONE_POLYGON) from None
    if len(parts) != 1 or not isinstance(parts[0], shapely.Polygon):
        raise TwinError("plan.polygon", f"{file.name!r} does not hold exactly one polygon", _ONE_POLYGON)
    if parts[0].is_empty or len(parts[0].interiors):
        raise TwinError("plan.polygon", f"{file.name!r} has a polygon with holes or without corners", _ONE_POLYGON)
    return parts[0]


def _named_crs(tree: Any) -> str | None:
    try:
        return str(tree["crs"]["properties"]["name"])
    except (KeyError, TypeError):
        return None


def _is_longitude_latitude(corners: Array, terrain: Terrain, origin: Georeference) -> bool:
    within = (np.abs(corners) <= [180.0, 90.0]).all()
    x, y = origin.to_scene(*corners.T)
    return bool(within and origin.crs_wkt is not None and np.isnan(terrain.height_at(x, y)).all())


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
