"""Rugosity, slope, ruggedness, area and volume of one elevation map, with their uncertainty.

Noise makes a surface look rougher. Its effect is measured by adding noise with the same covariance once more, and is
subtracted (simulation extrapolation, Cook & Stefanski 1994, JASA 89, 1314): value = 2 f(z) - mean of f(z + noise).
Matching smooths the surface. The effect of this is measured by smoothing it once more; it is not corrected, because it
depends on texture and relief, but is a part of the uncertainty.
"""

from typing import NamedTuple

import numpy as np

from twin.errors import TwinError
from twin.products.error_field import ErrorField, SigmaParts
from twin.products.registration import Heights
from twin.products.surface import Layer, block_means, ruggedness, slope_deg, smoothed, surface_ratio

GRAINS = (1, 2, 4, 8)  #: sizes of the blocks that the products are computed from [map cells]
NEGLIGIBLE = 0.01  #: relative effect of noise, and of resolution, on rugosity up to which a grain is reliable
MATCHING_WINDOW_PX = 11  #: image pixels over which errors of dense matching are correlated
_BLUR_PX = 2.5  # standard deviation of the largest window of its refinement (`estimate.vision.epipolar`)
_N_FIELDS = 12  # with which noise is added
_LEAST_BLOCKS = 30
_COMMON_QUANTILE = 0.05  # of sigma: no cell has a smaller error, so the error common to all is not larger
_LEVEL_QUANTILE = 0.01  # of heights: default level of the volume


class Measured(NamedTuple):
    value: float
    sigma: SigmaParts

    def times(self, factor: float, scale_sigma: float = 0.0) -> "Measured":
        """Returns it multiplied by a number with the relative standard deviation `scale_sigma`."""
        value, (random, correlated, systematic) = self.value * factor, (part * factor for part in self.sigma)
        return Measured(value, SigmaParts(random, correlated, float(np.hypot(systematic, scale_sigma * value))))


class GrainProducts(NamedTuple):
    """Means over the map at one grain."""

    grain_m: float
    rugosity: Measured  #: surface area over the area of the cells (level plane)
    rugosity_plane: Measured  #: surface area over its projection on the fitted plane, which removes the mean slope
    slope_deg: Measured
    ruggedness: Measured  #: vector ruggedness measure
    noise_effect: float  #: what noise adds to rugosity, relative to it; it is subtracted
    resolution_effect: float  #: what the matching window takes from rugosity, at most, relative to it; not corrected

    @property
    def is_reliable(self) -> bool:
        return max(abs(self.noise_effect), abs(self.resolution_effect)) < NEGLIGIBLE


class SurveyProducts(NamedTuple):
    grains: tuple[GrainProducts, ...]  #: finest first
    chosen: int  #: index of the finest reliable grain; the last if none is
    tilt_deg: float  #: of the fitted plane
    area_m2: float  #: of all cells with a height, seen from above
    surface_m2: Measured  #: area of the surface at the chosen grain
    level_m: float  #: height of the level plane that the volume stands on
    volume_m3: Measured  #: between the surface and the level; parts below it count as negative

    @property
    def best(self) -> GrainProducts:
        return self.grains[self.chosen]


def error_field_of_map(heights: Heights, metres_per_px: float, image_width_m: float) -> ErrorField:
    """Returns the error field of a map from the size of a pixel and the width of an image on the floor.

    Matching errors are correlated over a window; those of poses, which are those of the best cells, over an image.
    """
    known, cell_m = np.isfinite(heights.height_m) & np.isfinite(heights.sigma_m), heights.grid.cell_m
    if not known.any():
        raise TwinError("RUN", "its map has no height with a standard deviation", "a map with both")
    common_m = float(np.quantile(heights.sigma_m[known], _COMMON_QUANTILE))
    sigma_m = np.sqrt(np.maximum(np.where(known, heights.sigma_m, 0.0) ** 2 - common_m**2, 0.0))
    window_m, range_m = max(MATCHING_WINDOW_PX * metres_per_px, cell_m), max(image_width_m, 2 * cell_m)
    return ErrorField(cell_m, sigma_m, window_m, np.where(known, common_m, 0.0), range_m)


def survey_products(
    heights: Heights, errors: ErrorField, scale_sigma: float = 0.0, level_m: float | None = None
) -> SurveyProducts:
    """Returns the products of a map; raises TwinError if it has too few cells.

    Args:
        scale_sigma: standard deviation of the relative error of lengths, from that of the baseline.
        level_m: height of the level of the volume; default: the 1st percentile of the heights.
    """
    z, cell_m, known = heights.height_m, heights.grid.cell_m, np.isfinite(heights.height_m)
    usable = [n for n in GRAINS if np.isfinite(slope_deg(block_means(z, n), 1.0)).sum() >= _LEAST_BLOCKS]
    if not usable:
        raise TwinError("RUN", f"its map has {known.sum()} cells with a height", f"{_LEAST_BLOCKS} with all neighbours")
    x, y = np.meshgrid(*heights.grid.centres())
    normal = np.linalg.eigh(np.cov([x[known], y[known], z[known]]))[1][:, 0]  # Friedman et al. 2012
    tilt_deg = float(np.rad2deg(np.arccos(min(abs(normal[2]), 1.0))))
    blurred = smoothed(z, _BLUR_PX / MATCHING_WINDOW_PX * errors.window_m / cell_m)
    surfaces = [z, blurred, *(z + field for field in errors.samples(_N_FIELDS, seed=1))]
    grains = tuple(_at_grain(surfaces, cell_m, n, tilt_deg) for n in usable)
    chosen = next((k for k, grain in enumerate(grains) if grain.is_reliable), len(grains) - 1)
    area_m2 = float(known.sum()) * cell_m**2
    surface = grains[chosen].rugosity.times(area_m2, 2 * scale_sigma)
    level = float(np.quantile(z[known], _LEVEL_QUANTILE)) if level_m is None else level_m
    random, correlated = (float(np.sqrt(part[0, 0])) for part in errors.covariances(known[None] * cell_m**2))
    volume_m3 = float(np.sum(z[known] - level)) * cell_m**2
    sigma = SigmaParts(random, correlated, area_m2 * float(errors.long_sigma_m.max()))  # the level has an error, too
    volume = Measured(volume_m3, sigma).times(1.0, 3 * scale_sigma)
    return SurveyProducts(grains, chosen, tilt_deg, area_m2, surface, level, volume)


def _at_grain(surfaces: list[Layer], cell_m: float, n: int, tilt_deg: float) -> GrainProducts:
    """Returns the products of blocks of n x n cells; `surfaces`: the map, the map smoothed, the map with more noise."""
    coarse = [block_means(surface, n) for surface in surfaces]
    functions = surface_ratio, slope_deg, ruggedness
    measured = [_measured([float(np.nanmean(function(z, n * cell_m))) for z in coarse]) for function in functions]
    (rugosity, noise, resolution), (slope, *_), (rugged, *_) = measured
    on_plane = rugosity.times(float(np.cos(np.deg2rad(tilt_deg))))
    return GrainProducts(n * cell_m, rugosity, on_plane, slope, rugged, noise, resolution)


def _measured(values: list[float]) -> tuple[Measured, float, float]:
    """Returns a value without the effect of noise, and the relative effects of noise and of resolution.

    The systematic part of the standard deviation is these effects: noise and resolution are not known better.
    """
    raw, blurred, *noisy = values
    noise, resolution = float(np.mean(noisy)) - raw, raw - blurred
    value = raw - noise
    sigma = SigmaParts(float(np.std(noisy, ddof=1)), 0.0, float(np.hypot(noise, resolution)))
    return Measured(value, sigma), noise / (value or 1.0), resolution / (value or 1.0)
