"""Slope, surface area and ruggedness of height grids (rows, cols) [m], row 0 = north, NaN where unknown.

Each value is of a cell with its eight neighbours, NaN unless all nine are known; the grain is the size of the cells.
"""

from typing import Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

Layer = NDArray[Any]  #: numbers (rows, cols)
#: Rows and columns of the neighbours of a cell in a window of three by three, around it.
_RING = ((0, 0), (0, 1), (0, 2), (1, 2), (2, 2), (2, 1), (2, 0), (1, 0))


def block_means(values: Layer, n: int) -> Layer:
    """Returns the means of blocks of n x n cells; NaN where not more than half of them are known."""
    rows, cols = (size // n for size in values.shape)
    blocks = values[: rows * n, : cols * n].reshape(rows, n, cols, n)
    count = np.isfinite(blocks).sum(axis=(1, 3))
    return np.where(count > n * n / 2, np.nansum(blocks, axis=(1, 3)) / np.maximum(count, 1), np.nan)


def smoothed(height_m: Layer, sigma_cells: float) -> Layer:
    """Returns heights convolved with a Gaussian over the known cells; NaN where unknown."""
    known = np.isfinite(height_m)
    share = gaussian_filter(known.astype(float), sigma_cells)
    mean = gaussian_filter(np.where(known, height_m, 0.0), sigma_cells)
    return np.where(known, mean / np.where(known, share, 1.0), np.nan)


def slope_deg(height_m: Layer, cell_m: float) -> Layer:
    """Returns the steepest slope [deg] (Horn 1981, Proc. IEEE 69, 14)."""
    return np.rad2deg(np.arctan(np.hypot(*_gradient(height_m, cell_m))))


def surface_ratio(height_m: Layer, cell_m: float) -> Layer:
    """Returns the area of the surface of each cell over that of the cell (Jenness 2004, Wildl. Soc. Bull. 32, 829).

    The surface consists of eight triangles from the centre of a cell to its neighbours, of which a quarter is inside.
    """
    windows, flat = _windows(height_m), np.ones_like(height_m)
    edges = [
        np.stack([(col - 1) * cell_m * flat, (1 - row) * cell_m * flat, windows[..., row, col] - height_m], axis=-1)
        for row, col in _RING
    ]
    triangles = zip(edges, edges[1:] + edges[:1], strict=True)
    return np.sum([np.linalg.norm(np.cross(*pair), axis=-1) for pair in triangles], axis=0) / 8 / cell_m**2


def ruggedness(height_m: Layer, cell_m: float) -> Layer:
    """Returns the vector ruggedness measure 1 - |sum of nine unit normals| / 9 (Sappington et al. 2007, JWM 71, 1419).

    0 on a plane, up to 1; needs two neighbours on each side.
    """
    east, north = _gradient(height_m, cell_m)
    normals = np.stack([-east, -north, np.ones_like(east)]) / np.sqrt(1 + east**2 + north**2)
    return 1 - np.linalg.norm([_windows(part).sum(axis=(-2, -1)) for part in normals], axis=0) / 9


def _gradient(height_m: Layer, cell_m: float) -> tuple[Layer, Layer]:
    windows, weights = _windows(height_m), np.array([1.0, 2.0, 1.0]) / (8 * cell_m)
    missing = np.where(np.isfinite(height_m), 0.0, np.nan)
    east = (windows[..., 2] - windows[..., 0]) @ weights + missing
    return east, (windows[..., 0, :] - windows[..., 2, :]) @ weights + missing


def _windows(values: Layer) -> Layer:
    """Returns the neighbourhoods (rows, cols, 3, 3) of all cells, NaN beyond the border."""
    return sliding_window_view(np.pad(values, 1, constant_values=np.nan), (3, 3))
