"""A map in tiles: GeoTIFF files of its parts, and virtual rasters (GDAL VRT) that show them as one."""

from pathlib import Path

import numpy as np

from twin.core.records import ElevationMap, MapGrid
from twin.core.templates import filled
from twin.exchange import geotiff
from twin.exchange.geotiff import LOCAL_METRES

#: Layers of a tile and the types of their bands in a virtual raster.
LAYERS = {"dem": ("Float32",), "dem_sigma": ("Float32",), "mosaic": ("Byte", "Byte", "Byte")}


class TiledMapFolder:
    """Writer of a map in tiles, in local metres: `dem_ROW_COL.tif` etc. for each tile, and `dem.vrt` etc. for all."""

    def __init__(self, folder: Path):
        self.folder, self._tiles = folder, dict[str, MapGrid]()

    def add(self, row: int, col: int, elevation: ElevationMap) -> None:
        """Writes the map of the tile with these numbers, if it has a height; raises OSError if it cannot."""
        if not np.isfinite(elevation.height_m).any():
            return
        self.folder.mkdir(parents=True, exist_ok=True)
        name, grid = f"{row}_{col}", elevation.grid
        geotiff.write_elevations(self.folder / f"dem_{name}.tif", elevation.height_m, grid, "elevation [m]")
        geotiff.write_layer(self.folder / f"dem_sigma_{name}.tif", elevation.sigma_m, grid, "standard deviation [m]")
        geotiff.write_mosaic(self.folder / f"mosaic_{name}.tif", elevation.mosaic, grid)
        self._tiles[name] = grid

    @property
    def n_tiles(self) -> int:
        return len(self._tiles)

    def finish(self) -> None:
        for layer, bands in LAYERS.items():
            if self._tiles:
                (self.folder / f"{layer}.vrt").write_text(_virtual_raster(layer, bands, self._tiles), encoding="utf-8")


def _virtual_raster(layer: str, bands: tuple[str, ...], tiles: dict[str, MapGrid]) -> str:
    cell = next(iter(tiles.values())).cell_m
    west, north = min(t.west_m for t in tiles.values()), max(t.north_m for t in tiles.values())
    places = {name: (round((t.west_m - west) / cell), round((north - t.north_m) / cell)) for name, t in tiles.items()}
    width = max(places[name][0] + t.cols for name, t in tiles.items())
    height = max(places[name][1] + t.rows for name, t in tiles.items())
    context = {
        "width": width, "height": height, "crs": LOCAL_METRES.to_wkt(), "west": west, "north": north, "cell": cell,
        "bands": bands, "places": places, "tiles": tiles, "layer": layer,
    }  # fmt: skip
    return filled("twin.exchange", "virtual_raster.vrt.j2", context)
