"""Light that the water scatters forward on its way from the floor to the eye: a blur that grows with range.

Of the scattering b, the share whose angle stays below a limit, b_f, keeps the light in the image. A floor at range r
that sends the radiance L to an eye then arrives as L exp(-(c - b_f) r), of which exp(-b_f r) was never scattered (the
direct signal, L exp(-c r), as before) and 1 - exp(-b_f r) is spread over the image. This is McGlamery's form (1979;
Jaffe 1990), direct + (exp(-G r) - exp(-c r)) blurred, with G = c - b_f, which is a + 0.26 b here.

Width, by the theory of small angles (Wells 1969, 1973): light scattered once, at an even place of the way, by an angle
of variance s^2 (along each axis), is seen off by s^2 / 3; the number of scatterings is Poisson's of mean b_f r, which
of the scattered light is n = b_f r / (1 - exp(-b_f r)). The spread is drawn as a Gaussian of that variance, n s^2 / 3.
What `water.kept_share` keeps in the light already is not spread a second time: b_f is less by that share of b.
Nothing is lost: the borders of the image reflect, as if the floor went on beyond. The way from the lamps to the floor
is left as it is: all that is scattered there counts as lost.
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
from twin.imaging.water import FORWARDNESS, Medium, phase_function

Array = NDArray[np.float64]

FORWARD_DEG = 15.0  # scattering by more takes light out of the image
LEVELS = 4  # of the variance: 1, 2, 4, 8 times the least; between two levels light is shared
STEP_M = 0.02  # of the table of levels over range
MAX_LOG_GAIN = 60.0  # where that much is scattered forward, nothing arrives


class Lobe(NamedTuple):
    """The forward part of scattering: its share of all, and the variance of its angle along one axis [rad2]."""

    share: float
    variance_rad2: float


def forward_lobe(mean_cosine: float = FORWARDNESS) -> Lobe:
    """Scattering by less than `FORWARD_DEG`, by numbers from the phase function."""
    angle = (np.arange(20000) + 0.5) / 20000 * np.deg2rad(FORWARD_DEG)
    density = 2 * np.pi * np.sin(angle) * phase_function(np.cos(angle), mean_cosine) * (angle[1] - angle[0])
    return Lobe(float(density.sum()), float((density * angle**2).sum() / density.sum() / 2))


class ForwardScatter:
    """Makes the blurred part of a floor's light from the direct part."""

    def __init__(self, rig: StereoRig, water: Medium):
        lobe = forward_lobe(water.mean_cosine)
        scattered_per_m = max(lobe.share - water.kept_share, 0.0) * water.scattering_per_m
        thickness = scattered_per_m * np.arange(0.0, PATH_MAX_M, STEP_M)[:, None]
        times = np.where(thickness > 1e-9, thickness / -np.expm1(-np.maximum(thickness, 1e-9)), 1.0)
        self._scattered_per_m = scattered_per_m.astype(np.float32)
        self._level = _level_of(times).astype(np.float32)
        self._focal_px = rig.focal_px
        self._variance_px2 = rig.focal_px**2 * lobe.variance_rad2 / 3 * 2.0 ** np.arange(LEVELS)
        self._whole = np.empty((rig.height_px, rig.width_px, 3), np.float32)
        self._bin_px = _bin_px(rig.width_px, rig.height_px, float(np.sqrt(self._variance_px2[0])))

    def spread(self, direct: Radiance, depth: Depth) -> Radiance:
        """Radiance that arrives scattered forward.

        Args:
            direct: (H, W, 3) what arrives unscattered [cd/m2].
            depth: (H, W) along the optical axis [m].
        """
        return self._draw(direct, depth).copy()

    def add(self, direct: Radiance, depth: Depth, light: Radiance) -> None:
        """Adds to `light` (H, W, 3) what arrives from the floor, scattered forward or not."""
        spread = self._draw(direct, depth)
        parts = light.reshape(len(light), -1), spread.reshape(len(light), -1), direct.reshape(len(light), -1)
        in_row_bands(lambda first, end: _add(*parts, first, end), len(light))

    def _draw(self, direct: Radiance, depth: Depth) -> Radiance:
        """The same as `spread`, in memory of its own until the next call: to get fresh one takes as long as to fill."""
        size, (height, width) = self._bin_px, depth.shape
        bins = np.zeros((LEVELS, height // size, width // size, 3), np.float32)
        scene = direct, depth, np.float32(self._focal_px), self._scattered_per_m, self._level, size, bins
        in_row_bands(lambda first, end: _collect(*scene, first, end), height // size, size)
        # what lies in a bin has its variance already, and drawing straight lines between bins adds to it
        sigma = np.sqrt(np.maximum(self._variance_px2 / size**2 - (0.25 - 1 / (4 * size**2)), 1e-3))
        pairs = zip(bins, sigma, strict=True)
        blurred = np.zeros_like(bins[0])
        for level, deviation in pairs:
            if level.any():
                blurred += cv2.GaussianBlur(level, (0, 0), deviation, borderType=cv2.BORDER_REFLECT)
        cv2.resize(blurred / np.float32(size**2), (width, height), dst=self._whole, interpolation=cv2.INTER_LINEAR)
        return self._whole


def _level_of(times: Array) -> Array:
    """Where variances of `times` the least lie among levels that double: whole at a level, straight between."""
    below = np.minimum(np.floor(np.log2(times)), LEVELS - 2)
    return np.minimum(below + times / 2**below - 1, LEVELS - 1)


def _bin_px(width_px: int, height_px: int, sigma_px: float) -> int:
    """Side of the bins in which the blur is made: the largest that divides the image and is finer than the blur."""
    sides = [n for n in (8, 4, 2) if width_px % n == height_px % n == 0 and n < 0.8 * sigma_px]
    return sides[0] if sides else 1


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "arcp", "nsz", "reassoc"})
def _collect(direct, depth, focal, scattered_per_m, level, size, bins, first, end):
    """Puts the light that is scattered forward of each pixel into its bin, shared between the two levels of its range.

    Of the bins' rows from `first` to `end`. Light is counted pixel by pixel; its width is that of a bin's mean range.
    """
    levels, _, cols, _ = bins.shape
    width, last = depth.shape[1], level.shape[0] - 1
    one, half, zero, far = np.float32(1.0), np.float32(0.5), np.float32(0.0), np.float32(FAR_M)
    red, green, blue = np.float32(LOG2_E) * scattered_per_m
    most = np.float32(LOG2_E * MAX_LOG_GAIN)
    # light of each band, range, and number of pixels with a floor
    found, of_bins = np.empty((5, width), np.float32), np.empty((5, cols), np.float32)
    for row in range(first, end):
        found[:] = zero
        for v in range(row * size, (row + 1) * size):
            y = (np.float32(v) - half * np.float32(depth.shape[0] - 1)) / focal
            here, light = depth[v], direct[v].reshape(-1)
            for u in range(width):
                x = (np.float32(u) - half * np.float32(width - 1)) / focal
                way = here[u] * np.sqrt(x * x + y * y + one) if here[u] < far else zero
                found[0, u] += light[3 * u] * (two_to(min(red * way, most)) - one)
                found[1, u] += light[3 * u + 1] * (two_to(min(green * way, most)) - one)
                found[2, u] += light[3 * u + 2] * (two_to(min(blue * way, most)) - one)
                found[3, u] += way
                found[4, u] += one if way > zero else zero
        for k in range(5):
            of_pixels = found[k]
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
    """Adds two images to a third (H, 3 W), in its rows from `first` to `end`."""
    for v in range(first, end):
        for k in range(light.shape[1]):
            light[v, k] = light[v, k] + one[v, k] + other[v, k]
