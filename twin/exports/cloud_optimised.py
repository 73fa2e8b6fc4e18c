"""Maps as cloud-optimised GeoTIFF (COG): tiled, compressed, with overviews, in a CRS or in scene coordinates.

Cells and pixels have the same scene coordinates as in the files of a run (`geotiff`), so all layers coincide exactly.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import rasterio
import rasterio.shutil

from twin.core.georeference import Georeference
from twin.core.user_files import open_raster
from twin.datasets.run_contents import RunContents
from twin.errors import TwinError
from twin.exchange import geotiff

_OPTIONS = {"compress": "DEFLATE", "bigtiff": "IF_SAFER"}


def export(contents: RunContents, folder: Path) -> list[Path]:
    """Writes dem.tif, dem_sigma.tif, dem_error.tif (if the true elevations are known) and orthomosaic.tif.

    Without a file of the orthomosaic, orthomosaic.tif has one pixel per map cell, with the colours of
    `ElevationMap.mosaic`. Raises ValueError if a georeference is given, and the orthomosaic is rotated, its pixels are
    not square, or its tags are damaged.
    """
    elevation, origin = contents.elevation, contents.georeference
    assert elevation is not None  # by `ExportFormat.needs`
    if origin is not None and not np.allclose(elevation.map_from_world, np.eye(4)):
        raise TwinError("--to cog", "the map is tilted and has no place in a CRS", "ply or laz, or no --crs")
    layers = {
        "dem.tif": (geotiff.write_elevations, elevation.height_m, "elevation [m]"),
        "dem_sigma.tif": (geotiff.write_layer, elevation.sigma_m, "standard deviation [m]"),
        "dem_error.tif": (geotiff.write_layer, contents.error_m, "estimated minus true elevation [m]"),
    }
    files = []
    for name, (write, values, description) in layers.items():
        if values is not None:
            files.append(folder / name)
            with _optimised(files[-1], predictor="FLOATING_POINT") as file:
                write(file, values, elevation.grid, description, origin)
    contents.progress(0.3)
    files.append(folder / "orthomosaic.tif")
    if contents.orthomosaic is not None and origin is None:
        _optimise(contents.orthomosaic, files[-1])
    else:
        with _optimised(files[-1]) as file:
            if contents.orthomosaic is None or origin is None:
                geotiff.write_mosaic(file, elevation.mosaic, elevation.grid, origin)
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
    with open_raster(source) as original:
        rasterio.shutil.copy(original, path, driver="COG", **_OPTIONS, **options)
    geotiff.check_written(path)
