"""Maps as cloud-optimised GeoTIFF (COG): tiled, compressed, with overviews, in a CRS or in scene coordinates.

Cells and pixels have the same scene coordinates as in the files of a run (`geotiff`), so all layers coincide exactly.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

import rasterio
import rasterio.shutil

from twin.core.georeference import Georeference
from twin.core.raster_files import open_raster
from twin.datasets.run_contents import RunContents
from twin.exchange import geotiff

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
    grid, files = elevation.grid, [folder / "dem.tif", folder / "dem_sigma.tif"]
    with _optimised(files[0], predictor="FLOATING_POINT") as file:
        geotiff.write_elevations(file, elevation.height_m, grid, "elevation [m]", origin)
    with _optimised(files[1], predictor="FLOATING_POINT") as file:
        geotiff.write_layer(file, elevation.sigma_m, grid, "standard deviation [m]", origin)
    contents.progress(0.3)
    if contents.error_m is not None:
        files.append(folder / "dem_error.tif")
        with _optimised(files[-1], predictor="FLOATING_POINT") as file:
            geotiff.write_layer(file, contents.error_m, grid, "estimated minus true elevation [m]", origin)
    files.append(folder / "orthomosaic.tif")
    if contents.orthomosaic is not None and origin is None:
        _optimise(contents.orthomosaic, files[-1])
    else:
        with _optimised(files[-1]) as file:
            if contents.orthomosaic is None or origin is None:
                geotiff.write_mosaic(file, elevation.mosaic, grid, origin)
            else:
                _place(contents.orthomosaic, file, origin)
    contents.progress(1.0)
    return files


def _place(source: Path, path: Path, origin: Georeference) -> None:
    """Copies an orthomosaic (RGB or RGBA), which is in scene coordinates or in another CRS, to the CRS of `origin`."""
    with open_raster(source) as original:
        rasterio.shutil.copy(original, path, driver="GTiff", bigtiff="IF_SAFER")
    with rasterio.open(path, "r+", driver="GTiff") as file:
        grid, _ = geotiff.scene_placement(file)
        placed = geotiff.profile(grid, file.count, file.dtypes[0], origin)
        file.transform, file.crs = placed["transform"], placed["crs"]
        file.update_tags(**geotiff.placement_tags(origin))


@contextmanager
def _optimised(path: Path, **options: str) -> Iterator[Path]:
    """Yields the path of a GeoTIFF to write, which is then copied to `path` as a cloud-optimised one."""
    with TemporaryDirectory(dir=path.parent) as temporary:
        source = Path(temporary) / "layer.tif"
        yield source
        _optimise(source, path, **options)


def _optimise(source: Path, path: Path, **options: str) -> None:
    """Copies a GeoTIFF with GDAL's COG driver; `options` are further options of the driver."""
    with open_raster(source) as original:
        rasterio.shutil.copy(original, path, driver="COG", **_OPTIONS, **options)
