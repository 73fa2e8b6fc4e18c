"""A map in tiles: GeoTIFF files of its parts, and virtual rasters (GDAL VRT) that show them as one."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from twin.core.records import ElevationMap, MapGrid
from twin.exchange import geotiff
from twin.exchange.geotiff import LOCAL_METRES

#: Layers of a tile and the types of their bands in a virtual raster.
LAYERS = {"dem": ("Float32",), "dem_sigma": ("Float32",), "mosaic": ("Byte", "Byte", "Byte")}
_COLOURS = ("Red", "Green", "Blue")


class _Written(NamedTuple):
    """A written tile: the middle of its file names, and its cells."""

    name: str
    grid: MapGrid


class TiledMapFolder:
    """Writer of a map in tiles, in local metres: `dem_ROW_COL.tif` etc. for each tile, and `dem.vrt` etc. for all.

    The folder is created with the first tile.
    """

    def __init__(self, folder: Path):
        self.folder, self._tiles = folder, list[_Written]()

    def add(self, row: int, col: int, elevation: ElevationMap) -> None:
        """Writes the map of the tile with these numbers, if it has a height; raises OSError if it cannot."""
        if not np.isfinite(elevation.height_m).any():
            return
        self.folder.mkdir(parents=True, exist_ok=True)
        name, grid = f"{row}_{col}", elevation.grid
        geotiff.write_elevations(self.folder / f"dem_{name}.tif", elevation.height_m, grid, "elevation [m]")
        geotiff.write_layer(self.folder / f"dem_sigma_{name}.tif", elevation.sigma_m, grid, "standard deviation [m]")
        geotiff.write_mosaic(self.folder / f"mosaic_{name}.tif", elevation.mosaic, grid)
        self._tiles.append(_Written(name, grid))

    @property
    def n_tiles(self) -> int:
        """Returns the number of written tiles."""
        return len(self._tiles)

    def finish(self) -> None:
        """Writes the virtual rasters of all tiles; raises OSError if it cannot. Without tiles, writes nothing."""
        for layer, bands in LAYERS.items():
            if self._tiles:
                (self.folder / f"{layer}.vrt").write_text(_virtual_raster(layer, bands, self._tiles), encoding="utf-8")


def _virtual_raster(layer: str, bands: tuple[str, ...], tiles: list[_Written]) -> str:
    """Returns the text of a GDAL VRT that shows one layer of all tiles, whose cells have the same size."""
    cell = tiles[0].grid.cell_m
    west, north = min(t.grid.west_m for t in tiles), max(t.grid.north_m for t in tiles)
    places = [(round((t.grid.west_m - west) / cell), round((north - t.grid.north_m) / cell), t) for t in tiles]
    width, height = max(x + t.grid.cols for x, _, t in places), max(y + t.grid.rows for _, y, t in places)
    lines = [
        f'<VRTDataset rasterXSize="{width}" rasterYSize="{height}">',
        f"<SRS>{LOCAL_METRES.to_wkt().replace('&', '&amp;')}</SRS>",
        f"<GeoTransform>{west!r}, {cell!r}, 0, {north!r}, 0, {-cell!r}</GeoTransform>",
    ]
    for band, kind in enumerate(bands, start=1):
        lines.append(f'<VRTRasterBand dataType="{kind}" band="{band}">')
        lines.append(f"<NoDataValue>{'nan' if kind == 'Float32' else 0}</NoDataValue>")
        if len(bands) == len(_COLOURS):
            lines.append(f"<ColorInterp>{_COLOURS[band - 1]}</ColorInterp>")
        for x, y, tile in places:
            size = f'xSize="{tile.grid.cols}" ySize="{tile.grid.rows}"'
            lines.append(
                f'<SimpleSource><SourceFilename relativeToVRT="1">{layer}_{tile.name}.tif</SourceFilename>'
                f'<SourceBand>{band}</SourceBand><SrcRect xOff="0" yOff="0" {size}/>'
                f'<DstRect xOff="{x}" yOff="{y}" {size}/></SimpleSource>'
            )
        lines.append("</VRTRasterBand>")
    return "\n".join([*lines, "</VRTDataset>", ""])
