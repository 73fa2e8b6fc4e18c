"""Planned height of the camera on a path that follows the floor: a smooth surface z(x, y)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import RectBivariateSpline
from scipy.ndimage import gaussian_filter, map_coordinates, uniform_filter1d

from twin.controllers.segments import Reference
from twin.core.geometry import Array
from twin.kernels import kernel


@dataclass(frozen=True)
class CameraSurface:
    """Planned height z of the camera as a function of x and y: a bicubic spline with continuous second derivatives."""

    spline: RectBivariateSpline  # z [m] as a function of x and y [m]; constant beyond the outermost knots

    def height_at(self, x_m: Array, y_m: Array) -> Array:
        return self.spline.ev(x_m, y_m)

    def follow(self, level: Reference) -> Reference:
        """Lifts the references of a level path, given at n times, to the surface; returns the new references.

        With the surface z(x, y), horizontal velocity v and acceleration a, the vertical velocity is grad(z)' v and the
        vertical acceleration grad(z)' a + v' H(z) v, with the Hessian H.
        """
        x, y = level.position[:, 0], level.position[:, 1]
        slope = np.stack([self.spline.ev(x, y, dx=1), self.spline.ev(x, y, dy=1)], axis=1)
        xx, xy, yy = (self.spline.ev(x, y, dx=i, dy=2 - i) for i in (2, 1, 0))
        v, a = level.velocity[:, :2], level.acceleration[:, :2]
        bend = xx * v[:, 0] ** 2 + 2 * xy * v[:, 0] * v[:, 1] + yy * v[:, 1] ** 2
        climb, lift = (slope * v).sum(axis=1), (slope * a).sum(axis=1) + bend
        return level._replace(
            position=np.column_stack([x, y, self.height_at(x, y)]),
            velocity=np.column_stack([v, climb]),
            acceleration=np.column_stack([a, lift]),
        )


def surface_above_floor(
    height_m: NDArray[np.floating],
    spacing_m: float,
    corner_m: tuple[float, float],
    altitude_m: float,
    footprint_m: tuple[float, float],
    max_slope: float,
) -> CameraSurface:
    """Returns the surface that the camera follows at an altitude above the smoothed floor.

    The floor is averaged twice over the footprint, along x and y, and sampled at nodes about 1/8 of the shorter side of
    the footprint apart, but not closer than `spacing_m`. Around steep parts it is raised, by as little as possible,
    until its slope is at most `max_slope`; a Gaussian filter of one node distance then rounds the edges.

    Args:
        height_m: (ny, nx) heights of the floor, at least 4 x 4, row 0 = south.
        corner_m: position (x, y) of node (0, 0).
        footprint_m: extent of an image on the floor along x and y.
        max_slope: greatest slope (rise over run) of the surface along x, y and the diagonals.
    """
    size = [max(1, round(side / spacing_m)) for side in footprint_m[::-1]]
    smooth = np.asarray(height_m, np.float64)
    for _ in range(2):
        for axis, side in enumerate(size):
            smooth = np.asarray(uniform_filter1d(smooth, side, axis, mode="nearest"), np.float64)
    ny, nx = height_m.shape
    step_m = max(min(footprint_m) / 8, spacing_m)
    rows, cols = (np.linspace(0, n - 1, max(4, round((n - 1) * spacing_m / step_m) + 1)) for n in (ny, nx))
    coarse = map_coordinates(smooth, np.meshgrid(rows, cols, indexing="ij"), order=1)
    coarse = _limit_slope(coarse, rows[1] * spacing_m, cols[1] * spacing_m, max_slope)
    coarse = gaussian_filter(coarse, 1.0, mode="nearest")
    x, y = corner_m[0] + cols * spacing_m, corner_m[1] + rows * spacing_m
    return CameraSurface(RectBivariateSpline(x, y, coarse.T + altitude_m))


@kernel
def _limit_slope(height_m, step_y_m, step_x_m, max_slope):
    """Returns heights raised as little as possible to limit slopes to 8 neighbours (chamfer sweeps, Borgefors 1986)."""
    result = height_m.copy()
    rows, cols = result.shape
    for sweep in range(2):
        back = 1 - 2 * sweep  # the visited neighbours precede the node in the first sweep and follow it in the second
        for i in range(rows):
            r = i if sweep == 0 else rows - 1 - i
            for k in range(cols):
                c = k if sweep == 0 else cols - 1 - k
                for dr, dc in ((0, -1), (-1, -1), (-1, 0), (-1, 1)):
                    nr, nc = r + back * dr, c + back * dc
                    if 0 <= nr < rows and 0 <= nc < cols:
                        least = result[nr, nc] - max_slope * np.hypot(dr * step_y_m, dc * step_x_m)
                        result[r, c] = max(result[r, c], least)
    return result
