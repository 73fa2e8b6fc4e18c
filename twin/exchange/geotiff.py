"""GeoTIFF in local metres: what any GIS opens. Row 0 is north; NaN is "not seen"."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import rasterio
from numpy.typing import NDArray
from rasterio.crs import CRS
from rasterio.errors import RasterioIOError
from rasterio.transform import Affine

from twin.errors import TwinError
from twin.records import ElevationMap, Image, MapGrid

Map = NDArray[np.float32]

#: Metres east and north of the survey's own origin.
LOCAL_METRES = CRS.from_wkt(
    'LOCAL_CS["local metres",UNIT["metre",1,AUTHORITY["EPSG","9001"]],AXIS["Easting",EAST],AXIS["Northing",NORTH]]'
)


def write_map(folder: Path, elevation_map: ElevationMap) -> None:
    """Writes dem.tif, dem_sigma.tif and mosaic.tif into a folder."""
    write_layer(folder / "dem.tif", elevation_map.height_m, elevation_map.grid, "elevation [m]")
    write_layer(folder / "dem_sigma.tif", elevation_map.sigma_m, elevation_map.grid, "standard deviation [m]")
    write_mosaic(folder / "mosaic.tif", elevation_map.mosaic, elevation_map.grid)


def write_layer(path: Path, values: Map, grid: MapGrid, description: str) -> None:
    """Writes one (rows, cols) layer as float32 with NaN for no data."""
    with rasterio.open(path, "w", **_profile(grid, 1, "float32"), nodata=np.nan, predictor=3) as file:
        file.write(values.astype(np.float32), 1)
        file.set_band_description(1, description)


def write_mosaic(path: Path, mosaic: Image, grid: MapGrid) -> None:
    """Writes the photo mosaic (rows, cols, 3) as RGB; black is no data."""
    with rasterio.open(path, "w", **_profile(grid, 3, "uint8"), nodata=0, photometric="RGB") as file:
        file.write(np.moveaxis(mosaic, 2, 0))


def read_layer(path: Path) -> tuple[Map, MapGrid]:
    """The first band of a north-up GeoTIFF with square cells as float32, NaN for no data, and its grid.

    Raises:
        TwinError: the file cannot be read, or is not such a grid.
    """
    try:
        with rasterio.open(path) as file:
            values, transform = file.read(1, masked=True), file.transform
    except RasterioIOError as error:
        raise TwinError(str(path), f"cannot be read: {error}", "a GeoTIFF") from None
    return np.ma.filled(values.astype(np.float32), np.nan), _grid(path, transform, values.shape)


def _profile(grid: MapGrid, bands: int, dtype: str) -> dict[str, Any]:
    return {
        "driver": "GTiff",
        "width": grid.cols,
        "height": grid.rows,
        "count": bands,
        "dtype": dtype,
        "crs": LOCAL_METRES,
        "transform": Affine(grid.cell_m, 0, grid.west_m, 0, -grid.cell_m, grid.north_m),
        "compress": "deflate",
    }


def _grid(path: Path, transform: Affine, shape: tuple[int, int]) -> MapGrid:
    if transform.b or transform.d or transform.a <= 0 or not np.isclose(transform.a, -transform.e, rtol=1e-6):
        raise TwinError(str(path), "is rotated or has oblong cells", "a north-up grid of square cells")
    return MapGrid(transform.c, transform.f, transform.a, *shape)
