"""Maps as cloud-optimised GeoTIFF (COG): tiled, compressed, with overviews, in a CRS or in scene coordinates.

Cells and pixels have the same scene coordinates as in the files of a run (`geotiff`), so all layers coincide exactly.
"""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import rasterio
import rasterio.shutil

from twin.core.georeference import Georeference
from twin.core.raster_files import open_raster
from twin.core.records import MapGrid
from twin.exchange import geotiff
from twin.exchange.geotiff import Layer
from twin.exchange.run_contents import RunContents

_OPTIONS = {"compress": "DEFLATE", "bigtiff": "IF_SAFER"}


def export(contents: RunContents, folder: Path) -> list[Path]:
    """Writes dem.tif, dem_sigma.tif, dem_error.tif and orthomosaic.tif, and returns these files.

    dem_error.tif is written only if the true elevations are known. Without a file of the orthomosaic, orthomosaic.tif
    has one pixel per map cell, with the colours of `ElevationMap.mosaic`.

    Raises:
        OSError: the folder cannot be written.
        ValueError: a georeference is given, and the orthomosaic is rotated, its pixels are not square, or its tags are
            damaged.
    """
    elevation, origin = contents.elevation, contents.georeference
    assert elevation is not None  # by `ExportFormat.needs`
    files = [folder / name for name in ("dem.tif", "dem_sigma.tif")]
    write_elevations(files[0], elevation.height_m, elevation.grid, origin)
    write_layer(files[1], elevation.sigma_m, elevation.grid, "standard deviation [m]", origin)
    contents.progress(0.3)
    if contents.error_m is not None:
        files.append(folder / "dem_error.tif")
        write_layer(files[-1], contents.error_m, elevation.grid, "estimated minus true elevation [m]", origin)
    files.append(folder / "orthomosaic.tif")
    if contents.orthomosaic is None:
        with TemporaryDirectory(dir=folder) as temporary:
            source = Path(temporary) / "cells.tif"
            geotiff.write_mosaic(source, elevation.mosaic, elevation.grid)
            write_orthomosaic(files[-1], source, origin)
    else:
        write_orthomosaic(files[-1], contents.orthomosaic, origin)
    contents.progress(1.0)
    return files


def write_elevations(path: Path, height_m: Layer, grid: MapGrid, georeference: Georeference | None) -> None:
    """Writes heights (rows, cols) [m] as `geotiff.write_elevations` does, but cloud-optimised."""
    with TemporaryDirectory(dir=path.parent) as temporary:
        source = Path(temporary) / "layer.tif"
        geotiff.write_elevations(source, height_m, grid, "elevation [m]", georeference)
        _optimise(source, path, predictor="FLOATING_POINT")


def write_layer(path: Path, values: Layer, grid: MapGrid, description: str, georeference: Georeference | None) -> None:
    """Writes one layer (rows, cols) as `geotiff.write_layer` does, but cloud-optimised."""
    with TemporaryDirectory(dir=path.parent) as temporary:
        source = Path(temporary) / "layer.tif"
        geotiff.write_layer(source, np.asarray(values, np.float32), grid, description, georeference)
        _optimise(source, path, predictor="FLOATING_POINT")


def write_orthomosaic(path: Path, source: Path, georeference: Georeference | None) -> None:
    """Writes the orthomosaic of a run as cloud-optimised GeoTIFF, in the CRS of `georeference`.

    Args:
        path: file to write.
        source: orthomosaic as GeoTIFF, RGB or RGBA, in scene coordinates or in the CRS of a measured DEM (`geotiff`).
        georeference: position of the scene in the CRS; None: the coordinates are those of `source`.

    Raises:
        ValueError: a georeference is given, and the orthomosaic is rotated, its pixels are not square, or its tags are
            damaged.
    """
    if georeference is None:
        return _optimise(source, path)
    with TemporaryDirectory(dir=path.parent) as temporary:
        copy = Path(temporary) / "orthomosaic.tif"
        with open_raster(source) as original:
            rasterio.shutil.copy(original, copy, driver="GTiff", bigtiff="IF_SAFER")
        with rasterio.open(copy, "r+", driver="GTiff") as file:
            grid, _ = geotiff.scene_placement(file)
            placed = geotiff.profile(grid, file.count, file.dtypes[0], georeference)
            file.transform, file.crs = placed["transform"], placed["crs"]
            file.update_tags(**geotiff.placement_tags(georeference))
        _optimise(copy, path)


def _optimise(source: Path, path: Path, **options: str) -> None:
    """Copies a GeoTIFF as a cloud-optimised one with GDAL's COG driver; `options` are further options of the driver."""
    with open_raster(source) as original:
        rasterio.shutil.copy(original, path, driver="COG", **_OPTIONS, **options)
