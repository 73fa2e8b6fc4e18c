"""Seafloor model: a triangulated height grid with a texture."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from twin.core.georeference import Georeference
from twin.errors import TwinError
from twin.terrains.walls import Walls

#: Limits set by memory: the model for rendering takes about 400 bytes per node and 9 bytes per texel.
MAX_NODES = 6_000_000
MAX_TEXELS = 250_000_000


@dataclass(frozen=True)
class Terrain:
    """Seafloor over a rectangle with its south-west corner at (west_m, south_m); x east, y north, z up [m].

    Args:
        height_m: (ny, nx) float32 heights of the grid nodes; row 0 = SOUTH, column 0 = west. The outermost nodes lie on
            the edges of the rectangle.
        spacing_m: distance between neighbouring nodes along x and y.
        west_m, south_m: position of node (0, 0).
        texture: (h, w, 3) uint8 RGB albedo that covers the rectangle exactly; row 0 = NORTH.
        texture_px_m: side of a texel along x; along y, it may differ by rounding.
        n_filled: number of nodes without a height in the source, filled with the nearest height, for rendering.
        georeference: position of the scene in the CRS of the source; None for a floor without coordinates.
        orthophoto_share: share of the texels that an orthophoto covers; None without an orthophoto.
        walls: texture of the steep parts; None: the texture is projected from above everywhere.
        known: (ny, nx) bool, nodes with a height in the source or in a small hole of it (`holes.known_nodes`); only
            over these is a survey planned and judged. None: all nodes.
    """

    height_m: NDArray[np.float32]
    spacing_m: float
    west_m: float
    south_m: float
    texture: NDArray[np.uint8]
    texture_px_m: float
    n_filled: int = 0
    georeference: Georeference | None = None
    orthophoto_share: float | None = None
    walls: Walls | None = None
    known: NDArray[np.bool_] | None = None

    @property
    def size_m(self) -> tuple[float, float]:
        """Returns the extent along x and y [m]."""
        ny, nx = self.height_m.shape
        return (nx - 1) * self.spacing_m, (ny - 1) * self.spacing_m

    @property
    def east_m(self) -> float:
        """Returns x of the eastern edge [m]."""
        return self.west_m + self.size_m[0]

    @property
    def north_m(self) -> float:
        """Returns y of the northern edge [m]."""
        return self.south_m + self.size_m[1]

    @property
    def lowest_m(self) -> float:
        """Returns the least height [m]."""
        return float(self.height_m.min())

    @property
    def highest_m(self) -> float:
        """Returns the greatest height [m]."""
        return float(self.height_m.max())

    @property
    def hole_notes(self) -> list[str]:
        """Returns a sentence on the nodes without a height in the source, in a list; empty if there are none."""
        n, n_unknown = self.height_m.size, 0 if self.known is None else int((~self.known).sum())
        n_small = self.n_filled - n_unknown
        unknown = f"{n_unknown} of {n} cells of the floor ({100 * n_unknown / n:.3g} %) have no height: they are"
        small = f"{n_small} cells of the floor, in small holes, have the nearest height."
        return [
            *([f"{unknown} neither planned over nor judged, and drawn with the nearest height."] if n_unknown else []),
            *([small] if n_small else []),
        ]

    def in_hole(self, x_m: ArrayLike, y_m: ArrayLike) -> NDArray[np.bool_]:
        """Returns whether each point (x, y) lies in a cell with an unknown node; false outside the terrain."""
        x, y = np.broadcast_arrays(np.asarray(x_m, np.float64), np.asarray(y_m, np.float64))
        if self.known is None:
            return np.zeros(x.shape, np.bool_)
        col, row = (x - self.west_m) / self.spacing_m, (y - self.south_m) / self.spacing_m
        ny, nx = self.known.shape
        inside = (col >= 0) & (col <= nx - 1) & (row >= 0) & (row <= ny - 1)
        c, r = (np.clip(np.nan_to_num(k), 0, n - 2).astype(np.int64) for k, n in ((col, nx), (row, ny)))
        whole = self.known[1:, 1:] & self.known[1:, :-1] & self.known[:-1, 1:] & self.known[:-1, :-1]
        return inside & ~whole[r, c]

    def height_at(self, x_m: ArrayLike, y_m: ArrayLike) -> NDArray[np.float64]:
        """Returns the height of the floor at points (x, y) [m]; NaN outside the terrain.

        The height is linear on the two triangles of each cell, split along the diagonal from node (r, c) to
        (r + 1, c + 1). Rendering and ray intersection use the same surface.

        Args:
            x_m, y_m: coordinates of any shape, the same for both.
        """
        ny, nx = self.height_m.shape
        col = (np.asarray(x_m, dtype=np.float64) - self.west_m) / self.spacing_m
        row = (np.asarray(y_m, dtype=np.float64) - self.south_m) / self.spacing_m
        inside = (col >= 0) & (col <= nx - 1) & (row >= 0) & (row <= ny - 1)
        c = np.clip(np.nan_to_num(col), 0, nx - 2).astype(np.int64)
        r = np.clip(np.nan_to_num(row), 0, ny - 2).astype(np.int64)
        u, v = col - c, row - r
        h00, h01, h10, h11 = (self.height_m[r + i, c + j].astype(np.float64) for i in (0, 1) for j in (0, 1))
        south_east = h00 + u * (h01 - h00) + v * (h11 - h01)
        north_west = h00 + v * (h10 - h00) + u * (h11 - h10)
        return np.where(inside, np.where(u >= v, south_east, north_west), np.nan)


def texture_shape(height_shape: tuple[int, ...], spacing_m: float, texture_px_m: float) -> tuple[int, int]:
    """Returns the rows and columns of a texture that covers all cells of a height grid; at least 2 x 2.

    Args:
        height_shape: (ny, nx) of the height grid.
    Raises:
        TwinError: more than MAX_NODES nodes or MAX_TEXELS texels.
    """
    ny, nx = height_shape
    if nx * ny > MAX_NODES:
        raise TwinError("terrain.grid_m", f"{nx} x {ny} height nodes", f"at most {MAX_NODES} nodes")
    rows, cols = (max(2, round((n - 1) * spacing_m / texture_px_m)) for n in (ny, nx))
    if rows * cols > MAX_TEXELS:
        raise TwinError("terrain.texture_px_m", f"{cols} x {rows} texels", f"at most {MAX_TEXELS} texels")
    return rows, cols
