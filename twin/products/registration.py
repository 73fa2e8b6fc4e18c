"""Co-registration of two elevation maps by their surfaces, with the covariance of its parameters."""

from typing import NamedTuple

import numpy as np
from scipy.ndimage import map_coordinates

from twin.core.records import MapGrid
from twin.errors import TwinError
from twin.products.error_field import LEAST_CELLS, ErrorField
from twin.products.surface import Layer, smoothed

PARAMETERS = ("east_m", "north_m", "up_m", "roll_rad", "pitch_rad", "yaw_rad", "scale")
_HUBER = 1.345  # standard deviations beyond which the weight of a cell falls
_LARGEST_STEP = 0.25  # cells; a larger motion is applied by resampling, a smaller one to first order
_ROUNDS = 15


class Heights(NamedTuple):
    """Elevation map with the standard deviations of its heights (rows, cols) [m], NaN where unknown."""

    grid: MapGrid
    height_m: Layer
    sigma_m: Layer


class MapRegistration(NamedTuple):
    """Motion of the second map against the first: u = t + w x (p - c) + k (p - c) at the point p; c: map centre.

    The height of c is the median. With the gradient g of the heights, their difference due to it is
    u_z - g_x u_x - g_y u_y: the equation of Nuth & Kääb (2011, Cryosphere 5, 271) with rotation and scale.
    """

    values: Layer  #: (7,) `PARAMETERS` [m, rad, 1]
    cov: Layer  #: (7, 7) their covariance
    design: Layer  #: (7, rows, cols) derivatives of the difference of heights; 0 where unknown
    difference_m: Layer  #: (rows, cols) second minus first map after the registration [m], NaN where one is unknown
    sigma_m: Layer  #: (rows, cols) standard deviation of the difference from those of both maps [m]


def register(first: Heights, second: Heights, stable: Layer, errors: ErrorField | None = None) -> MapRegistration:
    """Returns the registration of two maps by robust least squares over the `stable` cells (rows, cols) of the first.

    `errors` of the difference are for the covariance; without them, those of the cells count as independent. Raises
    TwinError if the maps have too few such cells in common, or the iteration does not converge.
    """
    motion, (x, y), z = np.zeros(7), np.meshgrid(*first.grid.centres()), np.nan_to_num(first.height_m)
    offset = np.stack([x - x.mean(), y - y.mean(), z - np.median(z[np.isfinite(first.height_m)])])
    for _ in range(_ROUNDS):
        height_m, sigma2_m = _moved(second, first.grid, offset, motion)
        design = _design(first.grid, offset, (first.height_m + height_m) / 2)
        difference_m, sigma_m = height_m - first.height_m, np.hypot(first.sigma_m, sigma2_m)
        used = stable & np.isfinite(difference_m) & np.isfinite(design).all(axis=0) & (sigma_m > 0)
        if used.sum() < LEAST_CELLS:
            raise TwinError("RUN2", f"has {used.sum()} map cells in common with RUN1", f"at least {LEAST_CELLS}")
        step, weights = _robust_fit(design[:, used], difference_m[used], sigma_m[used])
        motion += step
        if np.abs(step[:2]).max() < _LARGEST_STEP * first.grid.cell_m:
            break
    else:
        raise TwinError("RUN2", "its map does not converge to that of RUN1", "two surveys of one place")
    weighted, design = np.zeros_like(design), np.nan_to_num(design)
    weighted[:, used] = weights * design[:, used]
    cov = np.linalg.inv(weighted.reshape(7, -1) @ design.reshape(7, -1).T)
    if errors is not None:
        random, correlated = errors.covariances(weighted)
        cov = cov @ (random + correlated) @ cov
    return MapRegistration(motion, cov, design, difference_m - np.tensordot(step, design, 1), sigma_m)


def _moved(heights: Heights, grid: MapGrid, offset: Layer, motion: Layer) -> tuple[Layer, Layer]:
    """Returns heights and standard deviations (rows, cols) [m] on another grid, moved back by a motion; bilinear."""
    x, y = np.meshgrid(*grid.centres())
    shift = motion[:3, None, None] + np.cross(motion[3:6], offset, axisb=0, axisc=0) + motion[6] * offset
    col = (x + shift[0] - heights.grid.west_m) / heights.grid.cell_m - 0.5
    row = (heights.grid.north_m - y - shift[1]) / heights.grid.cell_m - 0.5
    places = np.round([row, col], 6)  # grids with common cells are not interpolated
    known = np.isfinite(heights.height_m)
    share, height_m, sigma_m = (
        map_coordinates(np.where(known, layer, 0.0), places, order=1)
        for layer in (known.astype(float), heights.height_m, heights.sigma_m)
    )
    missing = np.where(share > 1 - 1e-9, 0.0, np.nan)
    return height_m - shift[2] + missing, sigma_m + missing


def _design(grid: MapGrid, offset: Layer, height_m: Layer) -> Layer:
    """Returns the derivatives (7, rows, cols) of the difference; noise of the gradient would bias it towards zero."""
    north, east = np.gradient(smoothed(height_m, 1.0), -grid.cell_m, grid.cell_m)
    x, y, z = offset
    turns = y + north * z, -x - east * z, east * y - north * x
    return np.stack([-east, -north, np.ones_like(x), *turns, z - east * x - north * y])


def _robust_fit(design: Layer, difference_m: Layer, sigma_m: Layer) -> tuple[Layer, Layer]:
    """Returns the motion (7,) and the weights (n,) [1/m2] of reweighted least squares with Huber's function."""
    weights, motion = 1 / sigma_m**2, np.zeros(7)
    for _ in range(10):
        motion = np.linalg.solve((design * weights) @ design.T, (design * weights) @ difference_m)
        z = np.abs(difference_m - motion @ design) / sigma_m
        limit = _HUBER * 1.4826 * (float(np.median(z)) or 1.0)
        weights = np.minimum(1.0, limit / np.maximum(z, 1e-12)) / sigma_m**2
    return motion, weights
