"""The elevation map as a point cloud with colour and standard deviation: PLY (binary) and LAZ (LAS 1.4).

Points are the centres of the mapped cells, in the CRS of the georeference or, without one, in scene coordinates [m].
"""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from twin.core.geometry import Array
from twin.core.georeference import Georeference
from twin.core.optional_packages import optional
from twin.core.records import Image
from twin.datasets.run_contents import RunContents
from twin.exchange import geotiff

_FINEST, _STEPS = 1e-6, 2**30  # finest resolution of LAS coordinates [unit of the CRS], and largest extent in steps
_POINT_FORMAT = 7  # LAS 1.4 with RGB
_EIGHT_TO_SIXTEEN_BITS = 257  # 255 * 257 = 65535
#: Fields of a point in a PLY file: name, type in NumPy, type in PLY.
_PLY_FIELDS = [
    ("x", "<f8", "double"), ("y", "<f8", "double"), ("z", "<f8", "double"), ("red", "u1", "uchar"),
    ("green", "u1", "uchar"), ("blue", "u1", "uchar"), ("sigma", "<f4", "float"),
]  # fmt: skip


class PointCloud(NamedTuple):
    """Centres of the mapped cells, row by row from the north-west."""

    points: Array  #: (n, 3) easting and northing in the unit of the CRS, and elevation [m]; or scene coordinates [m]
    colours: Image  #: (n, 3) RGB
    sigma_m: NDArray[np.float32]  #: (n,) standard deviations of the elevations
    crs_wkt: str


def point_cloud(contents: RunContents) -> PointCloud:
    """Returns the point cloud of the map of a run."""
    elevation = contents.elevation
    assert elevation is not None  # by `ExportFormat.needs`
    known = np.isfinite(elevation.height_m)
    x, y = np.meshgrid(*elevation.grid.centres())
    origin = contents.georeference or Georeference(0.0, 0.0)
    cells = np.column_stack([x[known], y[known], elevation.height_m[known].astype(np.float64)])
    east, north, up = elevation.to_world(cells).T
    easting, northing = origin.from_scene(east, north)
    points = np.column_stack([easting, northing, up + origin.elevation_m])
    sigma_m = elevation.sigma_m[known].astype(np.float32)
    return PointCloud(points, elevation.mosaic[known], sigma_m, geotiff.crs_of(contents.georeference).to_wkt())


def export_ply(contents: RunContents, folder: Path) -> list[Path]:
    """Writes map.ply (binary) with x, y, z, red, green, blue, sigma [m]; a comment in the header has the CRS as WKT."""
    cloud, path = point_cloud(contents), folder / "map.ply"
    fields = [(name, kind) for name, kind, _ in _PLY_FIELDS]
    rows = np.rec.fromarrays([*cloud.points.T, *cloud.colours.T, cloud.sigma_m], dtype=fields)
    crs = " ".join(cloud.crs_wkt.split())
    lines = ["ply", "format binary_little_endian 1.0", f"comment crs {crs}", f"element vertex {len(rows)}"]
    lines += [f"property {kind} {name}" for name, _, kind in _PLY_FIELDS]
    path.write_bytes("\n".join([*lines, "end_header", ""]).encode() + rows.tobytes())
    return [path]


def export_laz(contents: RunContents, folder: Path) -> list[Path]:
    """Writes map.laz (LAS 1.4, point format 7) with the extra dimension `sigma` and the CRS as WKT.

    LAS stores coordinates as integer multiples of a resolution: 1e-6 units of the CRS, or coarser by a power of ten for
    clouds of more than about 1074 units extent. Raises TwinError if laspy is not installed.
    """
    cloud, path = point_cloud(contents), folder / "map.laz"
    laspy = optional("laspy", "exchange", "--to laz")
    header: Any = laspy.LasHeader(point_format=_POINT_FORMAT, version="1.4")
    header.add_extra_dim(laspy.ExtraBytesParams("sigma", np.float32, "standard deviation [m]"))
    extent = np.ptp(cloud.points, axis=0).max() if len(cloud.points) else 0.0
    header.scales = np.full(3, _FINEST * 10 ** np.ceil(max(0.0, np.log10(max(extent, 1e-9) / (_FINEST * _STEPS)))))
    header.offsets = np.floor(cloud.points.mean(axis=0)) if len(cloud.points) else np.zeros(3)
    known = optional("laspy.vlrs.known", "exchange", "--to laz")
    header.vlrs.append(known.WktCoordinateSystemVlr(cloud.crs_wkt))
    header.global_encoding.wkt = True
    cloud_file = laspy.LasData(header)
    cloud_file.x, cloud_file.y, cloud_file.z = cloud.points.T
    colours = cloud.colours.astype(np.uint16) * _EIGHT_TO_SIXTEEN_BITS
    cloud_file.red, cloud_file.green, cloud_file.blue = colours.T
    cloud_file.sigma = cloud.sigma_m
    cloud_file.return_number = cloud_file.number_of_returns = np.ones(len(cloud.points), np.uint8)
    cloud_file.write(str(path))
    return [path]
