"""A map in tiles: GeoTIFF files of its parts, and virtual rasters (GDAL VRT) that show them as one."""

from pathlib import Path

import numpy as np

from twin.core.records import ElevationMap, MapGrid
from twin.exchange import geotiff
from twin.exchange.geotiff import LOCAL_METRES

#: Layers of a tile and the types of their bands in a virtual raster.
LAYERS = {"dem": ("Float32",), "dem_sigma": ("Float32",), "mosaic": ("Byte", "Byte", "Byte")}
_COLOURS = ("Red", "Green", "Blue")


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
        for name, (x, y) in places.items():
            size = f'xSize="{tiles[name].cols}" ySize="{tiles[name].rows}"'
            lines.append(
                f'<SimpleSource><SourceFilename relativeToVRT="1">{layer}_{name}.tif</SourceFilename>'
                f'<SourceBand>{band}</SourceBand><SrcRect xOff="0" yOff="0" {size}/>'
                f'<DstRect xOff="{x}" yOff="{y}" {size}/></SimpleSource>'
            )
        lines.append("</VRTRasterBand>")
    return "\n".join([*lines, "</VRTDataset>", ""])
