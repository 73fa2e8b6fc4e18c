"""The elevation map as a point cloud with colour and standard deviation: PLY (binary) and LAZ (LAS 1.4).

Points are the centres of the mapped cells, in the coordinate reference system (CRS) of the georeference or, without
one, in scene coordinates [m] (x east, y north, z up).
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from twin.core.geometry import Array
from twin.core.georeference import Georeference
from twin.core.optional_packages import optional
from twin.core.records import ElevationMap, Image
from twin.exchange import geotiff
from twin.exchange.run_contents import RunContents

_FINEST, _STEPS = 1e-6, 2**30  # finest resolution of LAS coordinates [unit of the CRS], and largest extent in steps
_POINT_FORMAT = 7  # LAS 1.4 with RGB
_EIGHT_TO_SIXTEEN_BITS = 257  # 255 * 257 = 65535


class PointCloud(NamedTuple):
    """Points of a map.

    Args:
        points: (n, 3) easting and northing in the unit of the CRS, and elevation [m]; or scene coordinates [m].
        colours: (n, 3) uint8 RGB.
        sigma_m: (n,) float32 standard deviations of the elevations [m].
    """

    points: Array
    colours: Image
    sigma_m: NDArray[np.float32]


def export_ply(contents: RunContents, folder: Path) -> list[Path]:
    """Writes map.ply and returns its path, as a list of one."""
    assert contents.elevation is not None  # by `ExportFormat.needs`
    path = folder / "map.ply"
    write_ply(path, point_cloud(contents.elevation, contents.georeference), contents.georeference)
    return [path]


def export_laz(contents: RunContents, folder: Path) -> list[Path]:
    """Writes map.laz and returns its path, as a list of one; raises TwinError if the package laspy is not installed."""
    assert contents.elevation is not None  # by `ExportFormat.needs`
    path = folder / "map.laz"
    write_laz(path, point_cloud(contents.elevation, contents.georeference), contents.georeference)
    return [path]


def point_cloud(elevation: ElevationMap, georeference: Georeference | None = None) -> PointCloud:
    """Returns the centres of the mapped cells, row by row from the north-west, with colours and standard deviations.

    The centres are in the CRS of `georeference` or, without one, in scene coordinates [m].
    """
    known = np.isfinite(elevation.height_m)
    x, y = np.meshgrid(*elevation.grid.centres())
    origin = georeference or Georeference(0.0, 0.0)
    cells = np.column_stack([x[known], y[known], elevation.height_m[known].astype(np.float64)])
    east, north, up = elevation.to_world(cells).T
    easting, northing = origin.from_scene(east, north)
    points = np.column_stack([easting, northing, up + origin.elevation_m])
    return PointCloud(points, elevation.mosaic[known], elevation.sigma_m[known].astype(np.float32))


def write_ply(path: Path, cloud: PointCloud, georeference: Georeference | None = None) -> None:
    """Writes a binary PLY file with x, y, z (double), red, green, blue (uchar) and sigma (float) [m].

    A comment in the header has the CRS as WKT (`geotiff.crs_of`).
    """
    fields = [("x", "<f8", "double"), ("y", "<f8", "double"), ("z", "<f8", "double"), ("red", "u1", "uchar"),
              ("green", "u1", "uchar"), ("blue", "u1", "uchar"), ("sigma", "<f4", "float")]  # fmt: skip
    rows = np.empty(len(cloud.points), dtype=[(name, kind) for name, kind, _ in fields])
    for k, name in enumerate(("x", "y", "z")):
        rows[name] = cloud.points[:, k]
    for k, name in enumerate(("red", "green", "blue")):
        rows[name] = cloud.colours[:, k]
    rows["sigma"] = cloud.sigma_m
    crs = " ".join(geotiff.crs_of(georeference).to_wkt().split())
    lines = ["ply", "format binary_little_endian 1.0", f"comment crs {crs}", f"element vertex {len(rows)}"]
    lines += [f"property {kind} {name}" for name, _, kind in fields]
    path.write_bytes("\n".join([*lines, "end_header", ""]).encode() + rows.tobytes())


def write_laz(path: Path, cloud: PointCloud, georeference: Georeference | None = None) -> None:
    """Writes LAZ (LAS 1.4, point format 7) with the extra dimension `sigma` and the CRS as WKT.

    LAS stores coordinates as integer multiples of a resolution. This is 1e-6 units of the CRS, or coarser by a power of
    ten for clouds of more than about 1074 units extent.

    Raises:
        TwinError: the package laspy is not installed.
    """
    laspy = optional("laspy", "exchange", "--to laz")
    header: Any = laspy.LasHeader(point_format=_POINT_FORMAT, version="1.4")
    header.add_extra_dim(laspy.ExtraBytesParams("sigma", np.float32, "standard deviation [m]"))
    extent = np.ptp(cloud.points, axis=0).max() if len(cloud.points) else 0.0
    header.scales = np.full(3, _FINEST * 10 ** np.ceil(max(0.0, np.log10(max(extent, 1e-9) / (_FINEST * _STEPS)))))
    header.offsets = np.floor(cloud.points.mean(axis=0)) if len(cloud.points) else np.zeros(3)
    known = optional("laspy.vlrs.known", "exchange", "--to laz")
    header.vlrs.append(known.WktCoordinateSystemVlr(geotiff.crs_of(georeference).to_wkt()))
    header.global_encoding.wkt = True
    cloud_file = laspy.LasData(header)
    cloud_file.x, cloud_file.y, cloud_file.z = cloud.points.T
    colours = cloud.colours.astype(np.uint16) * _EIGHT_TO_SIXTEEN_BITS
    cloud_file.red, cloud_file.green, cloud_file.blue = colours.T
    cloud_file.sigma = cloud.sigma_m
    cloud_file.write(str(path))
