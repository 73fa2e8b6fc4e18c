"""Backscatter: light of lamps and daylight that the water scatters into the camera, between camera and floor.

The light of a lamp (`lamp_light`), scattered with the coefficient b p(angle), is blurred on its way to the camera like
the light of the floor (`spread.camera_mixture`); with single scattering it is attenuated by a + b instead.
"""

from collections.abc import Sequence

import numpy as np

from twin.core.records import Array, StereoRig
from twin.imaging.light.forward_scatter import WIDEST_TAN, level_sigma_px, level_weights
from twin.imaging.light.lamp_light import LampLight
from twin.imaging.light.phase_function import phase_at
from twin.imaging.light.shading import RANGE_SCALE_M
from twin.imaging.light.water import Medium

#: Rows and columns of the grid of pixels for wide beams, and for beams that fall to half intensity within `NARROW_DEG`.
GRID, NARROW_GRID, NARROW_DEG = (16, 20), (48, 64), 25.0
RANGES, SUBSTEPS = 48, 2  # number of steps of range in the table, and of integration steps in each of them
FINE = 0.4  # blurs narrower than this fraction of the grid spacing are ignored
MARGIN = 6  # rows and columns of the grid outside each side of the image, whose light is blurred into the image


def backscatter_per_m(lamps: LampLight, water: Medium, ray: Array, range_m: Array) -> Array:
    """Returns the backscatter (..., n, 3) per metre along rays (..., 3) [cd/m3], unblurred; multiple: lamps alone."""
    points = ray[..., None, :] * range_m[..., None]
    total = np.zeros(points.shape)
    for lamp in range(len(lamps.sources.intensity_cd)):
        lux, from_lamp = lamps.lux(lamp, points)
        total += lux * phase_at(water.scatterers, -(from_lamp @ ray[..., None])[..., 0])
    total = total * water.scattering_per_m * np.exp(-water.camera_loss_per_m * range_m[..., None])
    if water.multiple:
        return total
    day = lamps.sources.daylight
    light = day.illuminance_lx * np.exp(-day.attenuation_per_m * points[..., 2:])
    scattered = light * phase_at(water.scatterers, -ray[..., 2])[..., None, :] * water.scattering_per_m
    return total + scattered * np.exp(-day.camera_loss_per_m * range_m[..., None])


def backscatter_table(rig: StereoRig, water: Medium, lamps: LampLight) -> Array:
    """Returns the backscatter (rows, cols, RANGES + 1, 3) between the camera and each range [cd/m2], on a coarse grid.

    With multiple scattering it is that of the lamps alone. (0, 0, 0, 3) if the water does not scatter.
    """
    if not water.scattering_per_m.any():
        return np.zeros((0, 0, 0, 3))
    margin = MARGIN if water.multiple else 0
    grid = grid_of(lamps.sources.beam)
    if water.multiple and not len(lamps.sources.beam):
        return np.zeros((*grid, RANGES + 1, 3))
    down_px = _places_px(grid[0], rig.height_px - 1.0, margin)
    across_px = _places_px(grid[1], rig.width_px - 1.0, margin)
    rows, cols = len(down_px), len(across_px)
    ray = _rays(rig, down_px, across_px)
    # Midpoints of even steps of x = r / (r + scale), which reaches infinite range at x = 1; dr/dx = scale / (1 - x)^2.
    n = RANGES * SUBSTEPS
    x = (np.arange(n) + 0.5) / n
    per_x, range_m = RANGE_SCALE_M / (1 - x) ** 2, RANGE_SCALE_M * x / (1 - x)
    light = backscatter_per_m(lamps, water, ray, np.broadcast_to(range_m, (rows, cols, n)))
    steps = (light * per_x[:, None] / n).reshape(rows, cols, RANGES, SUBSTEPS, 3).sum(3)
    if water.multiple:
        middle = (np.arange(RANGES) + 0.5) / RANGES
        steps = _spread(steps, RANGE_SCALE_M * middle / (1 - middle), (down_px, across_px), rig, water)
    return np.concatenate([np.zeros((*grid, 1, 3)), steps.cumsum(2)], axis=2)


def grid_of(beams: Sequence[Array]) -> tuple[int, int]:
    """Returns rows and columns of the grid of the backscatter: finer for narrow beams (m, 2), angle [deg] and share."""
    half_deg = [float(beam[beam[:, 1] >= beam[0, 1] / 2, 0].max()) for beam in beams]
    return NARROW_GRID if min(half_deg, default=90.0) < NARROW_DEG else GRID


def grid_rays(rig: StereoRig, grid: tuple[int, int]) -> Array:
    """Returns the unit directions (rows, cols, 3) of a pixel grid that spans the image, in the axes of the camera."""
    return _rays(rig, _places_px(grid[0], rig.height_px - 1.0, 0), _places_px(grid[1], rig.width_px - 1.0, 0))


def _rays(rig: StereoRig, down_px: Array, across_px: Array) -> Array:
    u, v = np.meshgrid(across_px, down_px)
    ray = np.stack([(u - rig.cx_px) / rig.focal_px, (v - rig.cy_px) / rig.focal_px, np.ones_like(u)], -1)
    return ray / np.linalg.norm(ray, axis=-1, keepdims=True)


def table_range_m() -> Array:
    """Returns the ranges (RANGES + 1,) at which the backscatter is tabulated [m]; the last one is infinite."""
    x = np.arange(RANGES) / RANGES
    return np.append(RANGE_SCALE_M * x / (1 - x), np.inf)


def _spread(steps: Array, range_m: Array, grid_px: tuple[Array, Array], rig: StereoRig, water: Medium) -> Array:
    """Returns the backscatter (rows, cols, ranges, 3) with the blur of the part that is scattered again on its way."""
    levels = int(np.log2(WIDEST_TAN * rig.focal_px))
    weights = level_weights(water.bands, rig.focal_px, levels, range_m)
    spacing_px = max(np.diff(grid_px[0])[MARGIN], np.diff(grid_px[1])[MARGIN])
    stays = [level for level in range(levels + 1) if level_sigma_px(level) < FINE * spacing_px]
    found = np.exp(-water.scattering_per_m * range_m[:, None]) + weights[stays].sum(0)
    found = steps[MARGIN:-MARGIN, MARGIN:-MARGIN] * found
    for level in range(len(stays), levels + 1):
        down, across = (_smoother(px, level_sigma_px(level)) for px in grid_px)
        smooth = (down @ steps.reshape(len(steps), -1)).reshape(len(down), *steps.shape[1:])
        found += weights[level] * (across @ smooth.reshape(*smooth.shape[:2], -1)).reshape(found.shape)
    return found


def _places_px(n: int, size_px: float, margin: int) -> Array:
    """Returns n evenly spaced positions from 0 to `size_px`, and `margin` positions outside of each end [px]."""
    outside = size_px * (np.arange(1.0, margin + 1) / max(margin, 1)) ** 2
    return np.concatenate([-outside[::-1], np.linspace(0.0, size_px, n), size_px + outside])


def _smoother(place_px: Array, sigma_px: float) -> Array:
    """Returns the matrix (n, n + 2 MARGIN) of a Gaussian blur on a grid, for the n positions within the image."""
    spacing = np.gradient(place_px)
    inner = place_px[MARGIN:-MARGIN]
    weights = np.exp(-((inner[:, None] - place_px) ** 2) / (2 * sigma_px**2)) * spacing
    return weights / weights.sum(1, keepdims=True)
