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

from twin.imaging.bands import in_bands
from twin.imaging.optics import Depth, Radiance
from twin.imaging.shading import FAR_M, PATH_MAX_M
from twin.imaging.water import FORWARDNESS, Medium, phase_function
from twin.records import StereoRig

Array = NDArray[np.float64]

FORWARD_DEG = 15.0  # scattering by more takes light out of the image
LEVELS = 4  # of the variance: 1, 2, 4, 8 times the least; between two levels light is shared
STEP_M = 0.02  # of the tables over range
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
        range_m = np.arange(0.0, PATH_MAX_M, STEP_M)
        thickness = max(lobe.share - water.kept_share, 0.0) * water.scattering_per_m * range_m[:, None]
        times = np.where(thickness > 1e-9, thickness / -np.expm1(-np.maximum(thickness, 1e-9)), 1.0)
        self._gain = np.expm1(np.minimum(thickness, MAX_LOG_GAIN)).astype(np.float32)
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
        in_bands(lambda first, end: _add(light[first:end], spread[first:end], direct[first:end]), len(light))

    def _draw(self, direct: Radiance, depth: Depth) -> Radiance:
        """The same as `spread`, in memory of its own until the next call: to get fresh one takes as long as to fill."""
        size, (height, width) = self._bin_px, depth.shape
        bins = np.zeros((LEVELS, height // size, width // size, 3), np.float32)
        scene = direct, depth, np.float32(self._focal_px), self._gain, self._level, size, bins
        in_bands(lambda first, end: _collect(*scene, first, end), height // size)
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
def _collect(direct, depth, focal, gain, level, size, bins, first, end):
    """Adds the light that is scattered forward of each pixel to its bin, shared between the two levels of its range.

    Of the bins' rows from `first` to `end`. Light is counted pixel by pixel; its width is that of the last pixel of a
    bin's row.
    """
    levels, _, cols, _ = bins.shape
    last, far, half = gain.shape[0] - 1, np.float32(FAR_M), np.float32(0.5)
    for v in range(first * size, end * size):
        y = (np.float32(v) - half * np.float32(depth.shape[0] - 1)) / focal
        row = v // size
        for col in range(cols):
            red = green = blue = np.float32(0.0)
            at = -1
            for u in range(col * size, (col + 1) * size):
                z = depth[v, u]
                if z < far:
                    x = (np.float32(u) - half * np.float32(depth.shape[1] - 1)) / focal
                    way = z * np.sqrt(x * x + y * y + np.float32(1.0))
                    at = min(int(way * np.float32(1 / STEP_M) + half), last)
                    red += direct[v, u, 0] * gain[at, 0]
                    green += direct[v, u, 1] * gain[at, 1]
                    blue += direct[v, u, 2] * gain[at, 2]
            if at < 0:
                continue
            for c, light in enumerate((red, green, blue)):
                k = min(int(level[at, c]), levels - 2)
                above = light * (level[at, c] - np.float32(k))
                bins[k, row, col, c] += light - above
                bins[k + 1, row, col, c] += above


@njit(cache=True, nogil=True)
def _add(light, one, other):
    """Adds two images to a third (H, W, 3)."""
    for v in range(light.shape[0]):
        for u in range(light.shape[1]):
            for c in range(3):
                light[v, u, c] = light[v, u, c] + one[v, u, c] + other[v, u, c]
