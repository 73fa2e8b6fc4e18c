"""Heights, grid, coordinate reference system (CRS) and vertical axis of a GeoTIFF, or of a grid as text."""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
from numpy.typing import NDArray
from rasterio.crs import CRS
from rasterio.enums import ColorInterp
from rasterio.warp import transform

from twin.core.georeference import Georeference
from twin.core.user_files import open_raster
from twin.terrains.file_header import HEIGHT_FIELD, HEIGHT_FORMATS, check_count, height_error
from twin.terrains.holes import check_no_undeclared_holes
from twin.terrains.vertical_axis import ASSUMED, HeightFile, VerticalAxis, cf_direction, unit_length_m

Part = dict[str, Any] | None  #: horizontal or vertical part of a CRS as PROJJSON; None: the CRS has no such part

_LEAST_CELL, _MOST_CELL, _MOST_COORDINATE = 1e-4, 1e5, 1e9  # of a plausible grid, in units of its CRS
#: Tags of a raster band and of a file that may name the quantity of the values, e.g. depth.
_BAND_TAGS = ("long_name", "standard_name")
_FILE_TAGS = ("TIFFTAG_IMAGEDESCRIPTION", "TIFFTAG_DOCUMENTNAME", "title")
#: Largest |ground scale - 1| of a grid whose distances are used as they are: 0.001 in a UTM zone.
_MAX_SCALE_ERROR = 0.005
_EQUATOR_M, _ECCENTRICITY2 = 6_378_137.0, 0.00669438  #: ellipsoid WGS 84


def read_raster_heights(file: Path, height_spacing_m: float, driver: str = "GTiff") -> HeightFile:
    """Reads a raster with one band of heights, and possibly an alpha band, which is 0 where there is no height.

    The grid spacing is `height_spacing_m` without coordinates. Raises TwinError if the file cannot be read, is an image
    or too large, or its grid or unit of height is not supported.
    """
    with open_raster(file, HEIGHT_FIELD, HEIGHT_FORMATS, [driver]) as source:
        if source.count > 2 or source.dtypes[0] in ("uint8", "int8"):
            raise height_error(file, f"is an image, not heights: {source.count} band(s) of {source.dtypes[0]}")
        check_count(source.width, source.height, file, HEIGHT_FIELD)
        horizontal, vertical = _crs_parts(source.crs)
        axis = _vertical_axis(source, horizontal, vertical, file)
        georeference, spacing_m, ground_scale = None, height_spacing_m, None
        if not source.transform.is_identity:
            _check_grid(source, file)
            factor = _axis_unit_m(horizontal)
            ground_scale = _checked_ground_scale(source, factor, file)
            spacing_m = float(source.transform.a * factor)
            wkt = _output_crs(source.crs, horizontal, vertical)
            georeference = Georeference(*_centre(source), 0.0, wkt, factor, axis.datum)
        values, doubts = _values(source, file, axis.metres_per_unit)
        name = "" if horizontal is None else str(horizontal["name"])
        nodata = "" if source.nodatavals[0] is None else f"{source.nodatavals[0]:g}"
        nodata = " and ".join(filter(None, [nodata, "the second band" if source.count == 2 else ""]))
        return HeightFile(values, spacing_m, axis, georeference, name, ground_scale, nodata, tuple(doubts))


def _values(source: rasterio.DatasetReader, file: Path, unit_m: float) -> tuple[NDArray[np.float64], list[str]]:
    """Returns the heights (rows, cols), scaled and offset as stated, NaN in holes; and the doubts about holes."""
    scale, offset = source.scales[0], source.offsets[0]
    if not (math.isfinite(scale) and math.isfinite(offset) and scale != 0):
        problem = f"has the band scale {scale:g} and offset {offset:g}"
        raise height_error(file, problem, "a finite scale other than 0, a finite offset")
    values = np.ma.filled(source.read(1, masked=True).astype(np.float64), np.nan)
    if source.count == 2:
        alpha = source.read(2)
        if source.colorinterp[1] != ColorInterp.alpha and not np.isin(alpha, [0, alpha.max()]).all():
            raise height_error(file, "has a second band that is not a mask")
        values[~(alpha > 0)] = np.nan
    remedy = "gdal_edit.py -a_nodata {} " if source.driver == "GTiff" else "gdal_translate -a_nodata {} -of GTiff "
    doubts = check_no_undeclared_holes(values, file, remedy + file.name, abs(scale) * unit_m)
    return values * scale + offset, doubts


def _crs_parts(crs: CRS | None) -> tuple[Part, Part]:
    if crs is None:
        return None, None
    tree = crs.to_dict(projjson=True)
    tree = tree.get("source_crs", tree)  # a BoundCRS: a CRS with a transformation to another
    parts = tree.get("components", [tree])
    vertical = next((part for part in parts if part["type"] == "VerticalCRS"), None)
    return next((part for part in parts if part["type"] != "VerticalCRS"), None), vertical


def _axis_unit_m(crs: Part) -> float:
    """Returns the length of the unit of the first axis of a CRS [m]; 1 for metres and without a CRS."""
    unit = crs["coordinate_system"]["axis"][0].get("unit", "metre") if crs is not None else "metre"
    return float(unit["conversion_factor"]) if isinstance(unit, dict) else 1.0


def _vertical_axis(source: rasterio.DatasetReader, horizontal: Part, vertical: Part, file: Path) -> VerticalAxis:
    """Returns the vertical axis that the vertical CRS, the unit of the band (it comes first) and the tags describe."""
    tags, file_tags = source.tags(1), source.tags()
    names = [source.descriptions[0] or "", *(tags.get(key, "") for key in _BAND_TAGS)]
    direction = vertical["coordinate_system"]["axis"][0]["direction"] if vertical is not None else None
    unit = source.units[0] or tags.get("units", "")
    if not unit and vertical is None and (unit_m := _axis_unit_m(horizontal)) != 1.0 and not _in_degrees(source):
        remedy = f"a unit of the band, e.g. by gdal_edit.py -units ft {file.name} or -units m"
        raise height_error(file, f"has a CRS in units of {unit_m:.7g} m, and no unit of its heights", remedy)
    return VerticalAxis(
        direction if direction in ("up", "down") else cf_direction(tags),
        unit_length_m(unit, file) if unit else _axis_unit_m(vertical), next(filter(None, names), ""),
        (file.stem, *names, *(file_tags.get(key, "") for key in _FILE_TAGS)),
        "" if vertical is None else str(vertical["name"]), source.crs is not None,
        "vertical CRS or unit of the band" if vertical is not None else "unit of the band" if unit else ASSUMED,
    )  # fmt: skip


def _output_crs(crs: CRS | None, horizontal: Part, vertical: Part) -> str | None:
    """Returns the CRS of the output rasters as WKT, or None; the vertical part only if in metres and upwards."""
    if crs is None or horizontal is None:
        return None
    upward = vertical is None or vertical["coordinate_system"]["axis"][0]["direction"] == "up"
    kept = upward and _axis_unit_m(vertical) == 1.0
    return (crs if kept else CRS.from_user_input(json.dumps(horizontal))).to_wkt()


def _check_grid(source: rasterio.DatasetReader, file: Path) -> None:
    t = source.transform
    if _in_degrees(source):
        remedy = f"gdalwarp -t_srs EPSG:{_utm_epsg(*_centre(source))} -tr CELL_M CELL_M {file.name} projected.tif"
        raise height_error(file, "is in degrees", f"a projected or local grid in metres, e.g. by {remedy}")
    if max(abs(t.b), abs(t.d)) > 1e-6 * abs(t.a) or t.a <= 0 or t.e >= 0 or abs(t.a + t.e) > 1e-3 * t.a:
        remedy = f"north up, square cells, e.g. by gdalwarp -tr CELL_M CELL_M {file.name} square.tif"
        raise height_error(file, "is rotated, or its cells are not square", remedy)
    if not _LEAST_CELL <= t.a <= _MOST_CELL or max(abs(c) for c in _centre(source)) > _MOST_COORDINATE:
        allowed = f"cells of {_LEAST_CELL:g} to {_MOST_CELL:g} within {_MOST_COORDINATE:g} of the origin"
        raise height_error(file, f"has cells of {t.a:g} at {_centre(source)}", allowed)


def _in_degrees(source: rasterio.DatasetReader) -> bool:
    return source.crs is not None and source.crs.is_geographic


def _checked_ground_scale(source: rasterio.DatasetReader, unit_m: float, file: Path) -> float | None:
    """Returns the ground scale of a projected CRS at the centre, or None; TwinError if far from 1 (EPSG:3857)."""
    if source.crs is None or not source.crs.is_projected:
        return None
    scale, longitude, latitude = _ground_scale(source, unit_m)
    if np.abs(scale - 1).max() > _MAX_SCALE_ERROR:
        remedy = f"gdalwarp -t_srs EPSG:{_utm_epsg(longitude, latitude)} -tr CELL_M CELL_M {file.name} projected.tif"
        raise height_error(
            file, f"is in a CRS with the ground scale {np.sqrt(scale.prod()):.3f} (m on the ground / m in the CRS)"
            " there", f"a CRS with true distances, e.g. by {remedy}",
        )  # fmt: skip
    return float(np.sqrt(scale.prod()))


def _ground_scale(source: rasterio.DatasetReader, unit_m: float) -> tuple[NDArray[np.float64], float, float]:
    """Returns m on the ellipsoid / m in the CRS along easting and northing (2,), or 1; and lon, lat [deg]."""
    east, north = _centre(source)
    step = 100.0 / unit_m
    xs, ys = [east, east + step, east], [north, north, north + step]
    longitude, latitude = (np.array(part) for part in transform(source.crs, "OGC:CRS84", xs, ys)[:2])
    if not np.isfinite([longitude, latitude]).all():
        return np.ones(2), 0.0, 0.0
    phi, root = math.radians(latitude[0]), math.sqrt(1 - _ECCENTRICITY2 * math.sin(math.radians(latitude[0])) ** 2)
    east_m = np.radians(longitude[1:] - longitude[0]) * _EQUATOR_M / root * math.cos(phi)
    north_m = np.radians(latitude[1:] - latitude[0]) * _EQUATOR_M * (1 - _ECCENTRICITY2) / root**3
    return np.hypot(east_m, north_m) / 100.0, float(longitude[0]), float(latitude[0])


def _centre(source: rasterio.DatasetReader) -> tuple[float, float]:
    t = source.transform
    return float(t.c + t.a * source.width / 2), float(t.f + t.e * source.height / 2)


def _utm_epsg(longitude_deg: float, latitude_deg: float) -> int:
    zone = min(max(math.floor((longitude_deg + 180) / 6) + 1, 1), 60)
    return (32600 if latitude_deg >= 0 else 32700) + zone
