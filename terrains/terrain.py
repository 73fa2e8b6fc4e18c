"""Seafloor model: a triangulated height grid with a texture."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from twin.core.geometry import Array
from twin.core.georeference import Georeference
from twin.core.records import Image
from twin.errors import TwinError
from twin.terrains.ground_cover import Painting, Part


class InputStatement(NamedTuple):
    """Interpretation of the files of a floor; evidence is a key of the scenario, a part of the file, or assumed."""

    file: str  #: name of the file of the floor
    crs: str  #: as `HeightFile.crs`
    ground_scale: float | None  #: as `HeightFile.ground_scale`
    spacing_m: float  #: distance between the nodes of the height grid
    spacing_evidence: str
    metres_per_unit: float  #: length of the unit of the values
    unit_evidence: str
    direction: str  #: "up" or "down", the direction in which the values of the file increase
    direction_evidence: str
    least: float  #: least and greatest value of the file, in its unit
    greatest: float
    nodata: str  #: as `HeightFile.nodata`
    share_without_height: float  #: share of the nodes of the height grid that have no height in the file
    texture: str  #: origin of the colours
    doubts: tuple[str, ...] = ()  #: as `HeightFile.doubts`


Index = NDArray[np.int64]

#: Limits set by memory: a world with images takes about 70 bytes per node while it opens, and 4 bytes per texel.
MAX_NODES = 6_000_000
MAX_TEXELS = 250_000_000


@dataclass(frozen=True)
class PaintedTexture:
    """Texture each part of which is painted when it is first asked for: plans and surrogate surveys need none."""

    shape: tuple[int, int, int]  #: (h, w, 3) of the image
    begin: Callable[[], Painting | Image]
    rng: np.random.Generator  #: from which `begin` takes random numbers

    @cached_property
    def begun(self) -> Painting | Image:
        return self.begin()

    def within(self, part: Part) -> Image:
        """Returns the image, which is painted at least in a part."""
        return self.begun.within(part) if isinstance(self.begun, Painting) else self.begun

    @property
    def image(self) -> Image:
        return self.within((0, self.shape[0], 0, self.shape[1]))


class Walls(NamedTuple):
    """Texture of the walls of a floor, and its weights (module `walls`).

    A weight belongs to a corner of a cell and is interpolated bilinearly. Its sign is that of the normal, so that
    opposite walls differ: where it is positive, the columns of the texture run along +y (projection along x) or +x
    (projection along y) from the south-west corner of the floor; where it is negative, they run from right to left.
    """

    #: (ny - 1, nx - 1) int32 index in `weights` of each cell, row 0 = south; -1 where all weights are 0
    number: NDArray[np.int32]
    #: (n, 2, 2, 2) float32 weights at the corners of a cell: south and north, west and east, projection along x and y;
    #: the rest to 1 is the weight of the texture of the floor
    weights: NDArray[np.float32]
    texture: PaintedTexture  #: (h, w, 3) uint8 RGB albedo; rows run down from the highest to the lowest point
    length_m: float  #: length of the texture along its columns, the longer side of the floor
    low_m: float  #: heights of the lower and the upper edge of the texture
    high_m: float


@dataclass(frozen=True)
class Terrain:
    """Seafloor over a rectangle with its south-west corner at (west_m, south_m); x east, y north, z up [m].

    The height is linear on the two triangles of each cell, split along the diagonal from node (r, c) to (r + 1, c + 1).
    """

    #: (ny, nx) float32 heights of the grid nodes, the outermost on the edges; row 0 = SOUTH, column 0 = west
    height_m: NDArray[np.float32]
    spacing_m: float  #: distance between neighbouring nodes along x and y
    west_m: float  #: position of node (0, 0), as `south_m`
    south_m: float
    colours: Image | PaintedTexture  #: (h, w, 3) uint8 RGB albedo of exactly the rectangle; row 0 = NORTH
    texture_px_m: float  #: side of a texel along x; along y, it may differ by rounding
    #: (ny, nx) bool, nodes without a height in the source, which have the nearest height, for rendering; None: no node
    filled: NDArray[np.bool_] | None = None
    georeference: Georeference | None = None  #: of the scene in the CRS of the source; None without coordinates
    orthophoto_share: float | None = None  #: share of the texels that an orthophoto covers; None without one
    walls: Walls | None = None  #: texture of the steep parts; None: the texture is projected from above everywhere
    #: (ny, nx) bool, nodes with a height in the source or in a small hole of it (`holes.known_nodes`); only over these
    #: is a survey planned and judged. None: all nodes.
    known: NDArray[np.bool_] | None = None
    stated: InputStatement | None = None  #: how the files of the floor were read; None for a generated floor

    @property
    def texture(self) -> Image:
        """Returns `colours` as an image, painted at the first call."""
        return self.colours.image if isinstance(self.colours, PaintedTexture) else self.colours

    def texture_within(self, low_m: Array, high_m: Array) -> Image:
        """Returns `colours` as an image, painted at least between two corners (x, y) [m] and 4 texels around."""
        if not isinstance(self.colours, PaintedTexture):
            return self.colours
        (rows, cols, _), corner_m = self.colours.shape, [self.west_m, self.south_m]
        place = (np.array([low_m, high_m]) - corner_m) / self.size_m * [cols, rows]
        (left, south), (right, north) = np.clip(np.round(place) + [[-4], [4]], 0, [cols, rows]).astype(int).tolist()
        return self.colours.within((rows - north, rows - south, left, right))

    def free_texture(self) -> None:
        """Frees a painted texture, which cannot be painted again, as its random numbers are used up."""
        if isinstance(self.colours, PaintedTexture):
            vars(self.colours)["begun"] = None

    @property
    def size_m(self) -> tuple[float, float]:
        ny, nx = self.height_m.shape
        return (nx - 1) * self.spacing_m, (ny - 1) * self.spacing_m

    @property
    def east_m(self) -> float:
        return self.west_m + self.size_m[0]

    @property
    def north_m(self) -> float:
        return self.south_m + self.size_m[1]

    @property
    def lowest_m(self) -> float:
        return float(self.height_m.min())

    @property
    def highest_m(self) -> float:
        return float(self.height_m.max())

    @property
    def n_filled(self) -> int:
        return 0 if self.filled is None else int(self.filled.sum())

    @property
    def unknown_share(self) -> float:
        """Returns the share of the nodes that are not `known`."""
        return 0.0 if self.known is None else float(np.mean(~self.known))

    @property
    def _in_small_hole(self) -> NDArray[np.bool_] | None:
        return self.filled if self.filled is None or self.known is None else self.filled & self.known

    @property
    def extent(self) -> str:
        """Returns the extent as text, for errors."""
        return f"x {self.west_m:.2f} to {self.east_m:.2f}, y {self.south_m:.2f} to {self.north_m:.2f} m"

    @property
    def hole_notes(self) -> list[str]:
        n, n_unknown = self.height_m.size, 0 if self.known is None else int((~self.known).sum())
        n_small = 0 if self._in_small_hole is None else int(self._in_small_hole.sum())
        unknown = (
            f"{n_unknown} of {n} cells of the floor ({100 * n_unknown / n:.3g} %) have no height: they are"
            " neither planned over nor judged, and drawn with the nearest height."
        )
        small = f"{n_small} cells of the floor, in small holes, have the nearest height."
        doubts = () if self.stated is None else self.stated.doubts
        return [*doubts, *(note for note, count in ((unknown, n_unknown), (small, n_small)) if count)]

    def in_hole(self, x_m: ArrayLike, y_m: ArrayLike) -> NDArray[np.bool_]:
        """Returns whether each point lies in a cell with an unknown node; false outside the terrain."""
        r, c, _, _, inside = self._cells(x_m, y_m)
        if self.known is None:
            return np.zeros(inside.shape, np.bool_)
        whole = self.known[1:, 1:] & self.known[1:, :-1] & self.known[:-1, 1:] & self.known[:-1, :-1]
        return inside & ~whole[r, c]

    def in_filled(self, x_m: ArrayLike, y_m: ArrayLike) -> NDArray[np.bool_]:
        """Returns whether the node that is nearest to each point lies in a small hole, filled with a height."""
        r, c, u, v, inside = self._cells(x_m, y_m)
        if (small := self._in_small_hole) is None:
            return np.zeros(inside.shape, np.bool_)
        return inside & small[r + (v >= 0.5), c + (u >= 0.5)]

    def height_near(self, x_m: ArrayLike, y_m: ArrayLike) -> NDArray[np.float64]:
        """Returns the height of the floor at points, or at the nearest point of the terrain if they lie outside it."""
        return self.height_at(np.clip(x_m, self.west_m, self.east_m), np.clip(y_m, self.south_m, self.north_m))

    def height_at(self, x_m: ArrayLike, y_m: ArrayLike) -> NDArray[np.float64]:
        """Returns the height of the floor at points (x, y) of any shape [m]; NaN outside the terrain."""
        r, c, u, v, inside = self._cells(x_m, y_m)
        h00, h01, h10, h11 = (self.height_m[r + i, c + j].astype(np.float64) for i in (0, 1) for j in (0, 1))
        south_east = h00 + u * (h01 - h00) + v * (h11 - h01)
        north_west = h00 + v * (h10 - h00) + u * (h11 - h10)
        return np.where(inside, np.where(u >= v, south_east, north_west), np.nan)

    def _cells(self, x_m: ArrayLike, y_m: ArrayLike) -> tuple[Index, Index, Array, Array, NDArray[np.bool_]]:
        """Returns row and column of the cells of points, their positions east and north in them; whether inside."""
        ny, nx = self.height_m.shape
        x, y = np.broadcast_arrays(np.asarray(x_m, np.float64), np.asarray(y_m, np.float64))
        col, row = (x - self.west_m) / self.spacing_m, (y - self.south_m) / self.spacing_m
        inside = (col >= 0) & (col <= nx - 1) & (row >= 0) & (row <= ny - 1)
        c, r = (np.clip(np.nan_to_num(k), 0, n - 2).astype(np.int64) for k, n in ((col, nx), (row, ny)))
        return r, c, col - c, row - r, inside


def texture_shape(height_shape: tuple[int, ...], spacing_m: float, texture_px_m: float) -> tuple[int, int]:
    """Returns rows and columns, at least 2, of a texture of a grid (ny, nx); TwinError above MAX_NODES, MAX_TEXELS."""
    ny, nx = height_shape
    if nx * ny > MAX_NODES:
        raise TwinError("terrain.grid_m", f"{nx} x {ny} height nodes", f"at most {MAX_NODES} nodes")
    rows, cols = (max(2, round((n - 1) * spacing_m / texture_px_m)) for n in (ny, nx))
    if rows * cols > MAX_TEXELS:
        raise TwinError("terrain.texture_px_m", f"{cols} x {rows} texels", f"at most {MAX_TEXELS} texels")
    return rows, cols
