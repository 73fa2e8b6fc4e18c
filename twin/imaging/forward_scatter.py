"""Forward scatter: light from the floor, scattered by small angles, blurs the image; the blur increases with range.

Light scattered by angles below a limit, with coefficient b_f < b, is not lost from the image. The radiance L of a
floor at range r then arrives as L exp(-(c - b_f) r): the fraction exp(-b_f r) of this is the direct signal,
L exp(-c r), and the fraction 1 - exp(-b_f r) is blurred. This is the form of McGlamery (1979) and Jaffe (1990),
direct + (exp(-G r) - exp(-c r)) blurred, with G = c - b_f; with the default phase function, G = a + 0.26 b.

The width of the blur follows from small-angle theory (Wells 1969, 1973): light scattered once, at a uniformly
distributed position along the ray, by an angle of variance s^2 (along each axis), appears displaced with variance
s^2 / 3. The number of scatterings is Poisson distributed with mean b_f r; the mean for light scattered at least once
is n = b_f r / (1 - exp(-b_f r)). The point spread function is a Gaussian of variance n s^2 / 3. If c already excludes
the fraction `water.kept_share` of b, this fraction is subtracted from b_f, so that it is not counted twice. The image
is mirrored at its borders, so no light is lost there. Forward scatter between lamps and floor is not modelled.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from twin.core.records import StereoRig
from twin.imaging.optics import Depth, Radiance
from twin.imaging.powers import LOG2_E, two_to
from twin.imaging.row_parallel import in_row_bands
from twin.imaging.shading import FAR_M, PATH_MAX_M
from twin.imaging.water import SEA_WATER_MEAN_COSINE, Medium, phase_function

Array = NDArray[np.float64]

FORWARD_DEG = 15.0  # light scattered by a larger angle is lost from the image
LEVELS = 4  # number of blur levels, with 1, 2, 4, 8 times the smallest variance; other variances mix two levels
STEP_M = 0.02  # range step of the table of levels
MAX_LOG_GAIN = 60.0  # upper limit of b_f r, against overflow; no light arrives from such ranges


class ForwardScattering(NamedTuple):
    """Scattering by angles below `FORWARD_DEG`.

    Args:
        share: fraction of the scattering coefficient b due to these angles.
        variance_rad2: variance of the scattering angle along one axis [rad^2].
    """

    share: float
    variance_rad2: float


def forward_scattering(mean_cosine: float = SEA_WATER_MEAN_COSINE) -> ForwardScattering:
    """Integrates the phase function over angles below `FORWARD_DEG`, for a mean cosine of the scattering angle."""
    angle = (np.arange(20000) + 0.5) / 20000 * np.deg2rad(FORWARD_DEG)
    density = 2 * np.pi * np.sin(angle) * phase_function(np.cos(angle), mean_cosine) * (angle[1] - angle[0])
    return ForwardScattering(float(density.sum()), float((density * angle**2).sum() / density.sum() / 2))


class ForwardScatter:
    """Computes the forward-scattered light from the floor, given the direct signal.

    Args:
        rig: the rendered cameras.
        water: optical properties of the water.
    """

    def __init__(self, rig: StereoRig, water: Medium):
        lobe = forward_scattering(water.mean_cosine)
        scattered_per_m = max(lobe.share - water.kept_share, 0.0) * water.scattering_per_m
        thickness = scattered_per_m * np.arange(0.0, PATH_MAX_M, STEP_M)[:, None]
        n_scatterings = np.where(thickness > 1e-9, thickness / -np.expm1(-np.maximum(thickness, 1e-9)), 1.0)
        self._scattered_per_m = scattered_per_m.astype(np.float32)
        self._level = _level_of(n_scatterings).astype(np.float32)
        self._focal_px = rig.focal_px
        self._variance_px2 = rig.focal_px**2 * lobe.variance_rad2 / 3 * 2.0 ** np.arange(LEVELS)
        self._blurred = np.empty((rig.height_px, rig.width_px, 3), np.float32)
        self._bin_px = _bin_px(rig.width_px, rig.height_px, float(np.sqrt(self._variance_px2[0])))

    def spread(self, direct: Radiance, depth: Depth) -> Radiance:
        """Returns the forward-scattered light (H, W, 3) per colour band in photometric units [cd/m2].

        Args:
            direct: (H, W, 3) direct signal: light from the floor that reaches the camera without scattering [cd/m2].
            depth: (H, W) depth along the optical axis [m].
        """
        return self._blur(direct, depth).copy()

    def add(self, direct: Radiance, depth: Depth, light: Radiance) -> None:
        """Adds the direct signal and the forward-scattered light from the floor to `light` (H, W, 3), in place."""
        spread = self._blur(direct, depth)
        parts = light.reshape(len(light), -1), spread.reshape(len(light), -1), direct.reshape(len(light), -1)
        in_row_bands(lambda first, end: _add(*parts, first, end), len(light))

    def _blur(self, direct: Radiance, depth: Depth) -> Radiance:
        """Same as `spread`, but returns a buffer that the next call overwrites; a new array would double the time."""
        size, (height, width) = self._bin_px, depth.shape
        bins = np.zeros((LEVELS, height // size, width // size, 3), np.float32)
        scene = direct, depth, np.float32(self._focal_px), self._scattered_per_m, self._level, size, bins
        in_row_bands(lambda first, end: _collect(*scene, first, end), height // size, size)
        # binning and bilinear interpolation between bins add variance, which is subtracted here
        sigma = np.sqrt(np.maximum(self._variance_px2 / size**2 - (0.25 - 1 / (4 * size**2)), 1e-3))
        pairs = zip(bins, sigma, strict=True)
        blurred = np.zeros_like(bins[0])
        for level, level_sigma in pairs:
            if level.any():
                blurred += cv2.GaussianBlur(level, (0, 0), level_sigma, borderType=cv2.BORDER_REFLECT)
        cv2.resize(blurred / np.float32(size**2), (width, height), dst=self._blurred, interpolation=cv2.INTER_LINEAR)
        return self._blurred


def _level_of(ratio: Array) -> Array:
    """Returns the fractional blur level for variances `ratio` times the smallest; linear in `ratio` between levels."""
    below = np.minimum(np.floor(np.log2(ratio)), LEVELS - 2)
    return np.minimum(below + ratio / 2**below - 1, LEVELS - 1)


def _bin_px(width_px: int, height_px: int, sigma_px: float) -> int:
    """Returns the bin side [px]: the largest of 8, 4, 2 that divides width and height and is below 0.8 sigma, or 1."""
    sides = [n for n in (8, 4, 2) if width_px % n == height_px % n == 0 and n < 0.8 * sigma_px]
    return sides[0] if sides else 1


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "arcp", "nsz", "reassoc"})
def _collect(direct, depth, focal, scattered_per_m, level, size, bins, first, end):
    """Adds the forward-scattered light of each pixel to its bin, split between two levels of the blur variance.

    Fills rows `first` to `end` of the bins. The light is computed per pixel; the level per bin, from its mean range.
    """
    levels, _, cols, _ = bins.shape
    width, last = depth.shape[1], level.shape[0] - 1
    one, half, zero, far = np.float32(1.0), np.float32(0.5), np.float32(0.0), np.float32(FAR_M)
    red, green, blue = np.float32(LOG2_E) * scattered_per_m
    most = np.float32(LOG2_E * MAX_LOG_GAIN)
    # rows: forward-scattered light in R, G, B; sum of ranges; number of pixels that show the floor
    of_columns, of_bins = np.empty((5, width), np.float32), np.empty((5, cols), np.float32)
    for row in range(first, end):
        of_columns[:] = zero
        for v in range(row * size, (row + 1) * size):
            y = (np.float32(v) - half * np.float32(depth.shape[0] - 1)) / focal
            here, light = depth[v], direct[v].reshape(-1)
            for u in range(width):
                x = (np.float32(u) - half * np.float32(width - 1)) / focal
                range_m = here[u] * np.sqrt(x * x + y * y + one) if here[u] < far else zero
                of_columns[0, u] += light[3 * u] * (two_to(min(red * range_m, most)) - one)
                of_columns[1, u] += light[3 * u + 1] * (two_to(min(green * range_m, most)) - one)
                of_columns[2, u] += light[3 * u + 2] * (two_to(min(blue * range_m, most)) - one)
                of_columns[3, u] += range_m
                of_columns[4, u] += one if range_m > zero else zero
        for k in range(5):
            of_pixels = of_columns[k]
            for col in range(cols):
                total = zero
                for u in range(size):
                    total += of_pixels[col * size + u]
                of_bins[k, col] = total
        for col in range(cols):
            at = min(int(of_bins[3, col] / max(of_bins[4, col], one) * np.float32(1 / STEP_M) + half), last)
            for c in range(3):
                k = min(int(level[at, c]), levels - 2)
                above = of_bins[c, col] * (level[at, c] - np.float32(k))
                bins[k, row, col, c] = of_bins[c, col] - above
                bins[k + 1, row, col, c] = above


@njit(cache=True, nogil=True)
def _add(light, one, other, first, end):
    """Adds the images `one` and `other` to `light` (H, 3 W) in rows `first` to `end`."""
    for v in range(first, end):
        for k in range(light.shape[1]):
            light[v, k] = light[v, k] + one[v, k] + other[v, k]
