"""GeoTIFF files in local metric coordinates. Row 0 is the northernmost row; "no data" is NaN in float layers."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import rasterio
from numpy.typing import NDArray
from rasterio.crs import CRS
from rasterio.transform import Affine

from twin.core.records import ElevationMap, Image, MapGrid

Layer = NDArray[np.float32]

#: Local coordinate system: metres east and north of the origin of the survey.
LOCAL_METRES = CRS.from_wkt(
    'LOCAL_CS["local metres",UNIT["metre",1,AUTHORITY["EPSG","9001"]],AXIS["Easting",EAST],AXIS["Northing",NORTH]]'
)


def write_map(folder: Path, elevation_map: ElevationMap) -> None:
    """Writes dem.tif, dem_sigma.tif and mosaic.tif into a folder."""
    write_layer(folder / "dem.tif", elevation_map.height_m, elevation_map.grid, "elevation [m]")
    write_layer(folder / "dem_sigma.tif", elevation_map.sigma_m, elevation_map.grid, "standard deviation [m]")
    write_mosaic(folder / "mosaic.tif", elevation_map.mosaic, elevation_map.grid)


def write_layer(path: Path, values: Layer, grid: MapGrid, description: str) -> None:
    """Writes one layer (rows, cols) as float32; the nodata value is NaN."""
    with rasterio.open(path, "w", **_profile(grid, 1, "float32"), nodata=np.nan, predictor=3) as file:
        file.write(values.astype(np.float32), 1)
        file.set_band_description(1, description)


def write_mosaic(path: Path, mosaic: Image, grid: MapGrid) -> None:
    """Writes the orthomosaic (rows, cols, 3) as RGB; the nodata value is 0 (black)."""
    with rasterio.open(path, "w", **_profile(grid, 3, "uint8"), nodata=0, photometric="RGB") as file:
        file.write(np.moveaxis(mosaic, 2, 0))


def _profile(grid: MapGrid, bands: int, dtype: str) -> dict[str, Any]:
    """Returns the rasterio profile of a GeoTIFF file on `grid`."""
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
