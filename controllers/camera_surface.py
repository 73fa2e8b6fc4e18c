"""Planned height of the camera on a path that follows the floor: a smooth surface over the axes (u, v) of the legs."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import RectBivariateSpline
from scipy.ndimage import gaussian_filter, map_coordinates, uniform_filter1d

from twin.controllers.segments import Point, Reference
from twin.controllers.survey_area import SurveyArea
from twin.core.geometry import Array
from twin.kernels import kernel

_NODES = 8  # nodes of the surface along the shorter side of an image
_MOST_SAMPLES = 1_000_000  # of the floor
_SLOPE_SAMPLES = 100  # of the slope along a line


@dataclass(frozen=True)
class CameraSurface:
    """Planned height z of the camera as a function of u and v: a bicubic spline with continuous second derivatives."""

    spline: RectBivariateSpline  # z [m] as a function of u and v [m]; constant beyond the outermost knots
    area: SurveyArea  # its axes are u and v
    max_climb: float  # greatest slope (rise over run) of a path at cruise speed
    altitude_m: float  # height z of level paths that coincide with the surface when they are lifted to it

    def height_at(self, x_m: Array, y_m: Array) -> Array:
        return self.spline.ev(*self.area.to_legs(x_m, y_m))

    def follow(self, level: Reference) -> Reference:
        """Lifts the references of a level path, given at n times, to the surface; returns the new references.

        With the surface z(u, v), horizontal velocity w and acceleration a, the vertical velocity is grad(z)' w and the
        vertical acceleration grad(z)' a + w' H(z) w, with the Hessian H; those of the path's own changes of height are
        added.
        """
        u, v = self.area.to_legs(level.position[:, 0], level.position[:, 1])
        slope = np.stack([self.spline.ev(u, v, dx=1), self.spline.ev(u, v, dy=1)], axis=1)
        uu, uv, vv = (self.spline.ev(u, v, dx=i, dy=2 - i) for i in (2, 1, 0))
        w, a = (self.area.vectors_to_legs(part[:, :2]) for part in (level.velocity, level.acceleration))
        bend = uu * w[:, 0] ** 2 + 2 * uv * w[:, 0] * w[:, 1] + vv * w[:, 1] ** 2
        climb, lift = (slope * w).sum(axis=1), (slope * a).sum(axis=1) + bend
        up = np.array([0.0, 0.0, 1.0])
        return level._replace(
            position=level.position + np.outer(self.spline.ev(u, v) - self.altitude_m, up),
            velocity=level.velocity + np.outer(climb, up),
            acceleration=level.acceleration + np.outer(lift, up),
        )

    def pace(self, start: Point, end: Point) -> float:
        """Returns the share of the cruise speed, at most 1, at which a line climbs no faster than with `max_climb`."""
        x, y = np.linspace(start[:2], end[:2], _SLOPE_SAMPLES).T
        rise_m, run_m = np.abs(np.diff(self.height_at(x, y))).max(), np.hypot(x[1] - x[0], y[1] - y[0])
        return min(1.0, self.max_climb * run_m / rise_m) if rise_m > 0 else 1.0


def surface_above_floor(
    height_at: Callable[[Array, Array], Array], area: SurveyArea, spacing_m: float, altitude_m: float,
    footprint_m: tuple[float, float], max_slope: tuple[float, float],
    least_at: Callable[[Array, Array], Array] | None = None,
) -> CameraSurface:  # fmt: skip
    """Returns the surface that the camera follows at an altitude above the smoothed floor.

    The floor is averaged twice over the footprint, along u and v, and sampled at nodes about 1/8 of the shorter side of
    the footprint apart, but not closer than `spacing_m`. Around steep parts it is raised, by as little as possible,
    until its slope (rise over run) along u and v is at most `max_slope`, along u that of paths at cruise speed, and to
    the least height of the camera, `least_at`; a Gaussian filter of one node distance then rounds the edges. Both
    functions return heights [m] at arrays x and y [m], also around the terrain.
    """
    reach_m = np.array(area.size_m) / 2 + footprint_m
    step_m = max(min(spacing_m, min(footprint_m) / _NODES), float(np.sqrt(4 * reach_m.prod() / _MOST_SAMPLES)))
    shape = np.ceil(2 * reach_m / step_m).astype(int) + 1
    u, v = (np.linspace(-reach, reach, n) for reach, n in zip(reach_m, shape, strict=True))
    smooth = height_at(*area.to_scene(u[:, None], v))
    for _ in range(2):
        for axis, (side_m, along) in enumerate(zip(footprint_m, (u, v), strict=True)):
            size = 2 * round(side_m / (along[1] - along[0]) / 2) + 1
            smooth = np.asarray(uniform_filter1d(smooth, size, axis, mode="nearest"), np.float64)
    n_nodes = np.maximum(4, np.round(2 * reach_m / max(min(footprint_m) / _NODES, step_m)).astype(int) + 1)
    rows, cols = (np.linspace(0, n - 1, k) for n, k in zip(shape, n_nodes, strict=True))
    coarse = map_coordinates(smooth, np.meshgrid(rows, cols, indexing="ij"), order=1)
    u, v = np.interp(rows, np.arange(len(u)), u), np.interp(cols, np.arange(len(v)), v)
    if least_at is not None:
        coarse = np.maximum(coarse, least_at(*area.to_scene(u[:, None], v)) - altitude_m)
    coarse = _limit_slope(coarse, max_slope[0] * (u[1] - u[0]), max_slope[1] * (v[1] - v[0]))
    coarse = gaussian_filter(coarse, 1.0, mode="nearest")
    return CameraSurface(RectBivariateSpline(u, v, coarse + altitude_m), area, max_slope[0], altitude_m)


@kernel
def _limit_slope(height_m, rise_u_m, rise_v_m):
    """Returns heights raised as little as possible to limit their steps (chamfer sweeps, Borgefors 1986)."""
    # Greatest steps between neighbours along u (rows) and v (columns) are given.
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
                        least = result[nr, nc] - np.hypot(dr * rise_u_m, dc * rise_v_m)
                        result[r, c] = max(result[r, c], least)
    return result
