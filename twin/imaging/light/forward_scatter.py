"""Forward scatter: light of the floor, scattered on its way to the camera, arrives blurred.

The fraction exp(-b r) arrives unscattered; the rest is blurred by a kernel with a sharp core and a long tail
(`spread.camera_mixture`), a mixture of the levels of an image pyramid with weights by band and range. Over relief, the
range of a wide level is that of its light: of the bright near side of an edge, not of the far pixels beside it. Off the
axis a small angle covers k = 1 / cos(theta)^1.5 more pixels, so a fraction log2(k) of the light of each level moves
to the next, except for the widest (`WIDENED_TAN`). Outside the image, the floor is the plane that fits the depth, with
the mean albedo of the image.
"""

from functools import lru_cache
from typing import NamedTuple, TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from twin.core.records import Array, Depth, Radiance, StereoRig
from twin.core.threads import QUICK, in_row_bands
from twin.core.vector_math import sum_of_entries
from twin.imaging.light.phase_function import BandWater
from twin.imaging.light.shading import FAR_M, RANGE_SCALE_M
from twin.imaging.light.spread import NODES_M, camera_mixture, over_path
from twin.imaging.light.water import Medium
from twin.kernels import kernel

#: Fractional row index of the table `ForwardScatter.kept`, for each pixel.
Place: TypeAlias = NDArray[np.float32]

SHARE_STEPS = 512  # number of steps of r / (r + RANGE_SCALE_M) from 0 to 1
#: Lengths "as a tangent" are in units of the focal length.
SURROUNDINGS_TAN = 1.6  # half the extent of the surroundings along the longer side of the image, as a tangent
SURROUNDINGS_STEP_TAN = 0.035  # side of a pixel of the surroundings, as a tangent, within a factor of 1.4
WIDENING = 1.5  # exponent of 1 / cos(theta) in the pixels that an angle covers
WIDENED_TAN = 0.1  # largest standard deviation of a level that is widened, as a tangent; cos(theta) hardly varies in it
WIDEST_TAN = 1.2  # upper limit of the standard deviation of a level, as a tangent
LEVEL_STEPS = 8.0  # largest distance from the plane of an image that counts as level, in steps of `place_of`
PLANE_STEP_PX = 8  # spacing of the pixels to whose depth the plane is fitted


class Surroundings(NamedTuple):
    """Coarse grid that covers the image and the floor around it."""

    level: int  # level of the image pyramid with the same pixel size as this grid
    pad: int  # number of grid pixels before the first one of the image, in both directions
    shape: tuple[int, int]  # rows and columns of the grid
    # focal length in pixels of the grid; the optical axis is in its centre, within a quarter of a pixel
    focal_px: float


class ForwardScatter:
    """Blur of the light of the floor by scattering on its way to the camera.

    `range_per_depth` is that of the pixels of the `surroundings`, the grid on which `add` expects the light of the
    floor around the image; `kept` (SHARE_STEPS + 1, 4) the share of the light that arrives without blur (unscattered,
    or scattered by less than a pixel), for R, G, B and a zero, at even steps of r / (r + RANGE_SCALE_M).
    """

    def __init__(self, rig: StereoRig, water: Medium):
        self.surroundings = _surroundings(rig)
        levels = max(int(np.log2(WIDEST_TAN * rig.focal_px)), self.surroundings.level)
        x = np.linspace(0.0, 1.0, SHARE_STEPS + 1)[:-1]
        range_m = RANGE_SCALE_M * x / (1 - x)
        range_m = np.append(range_m, range_m[-1])
        unscattered = np.exp(-water.scattering_per_m * range_m[:, None])
        weights = level_weights(water.bands, rig.focal_px, levels, range_m)
        self._core = weights[0]
        self._tables = _tables(weights[1:], rig.focal_px)
        self.kept = np.zeros((SHARE_STEPS + 1, 4), np.float32)
        self.kept[:, :3] = unscattered + weights[0]
        v, u = (np.arange(0.0, n, PLANE_STEP_PX) - (n - 1) / 2 for n in (rig.height_px, rig.width_px))
        self._fit = np.linalg.pinv(_plane_terms(u / rig.focal_px, v / rig.focal_px))
        rows, cols = (np.arange(0.0, n) - (n - 1) / 2 for n in self.surroundings.shape)
        focal = self.surroundings.focal_px
        self._terms = _plane_terms(cols / focal, rows / focal)
        self.range_per_depth = np.sqrt((self._terms**2).sum(1)).reshape(self.surroundings.shape).astype(np.float32)
        self._widening = _widening(rig, self.surroundings, self.range_per_depth, levels)

    def plane(self, depth: Depth) -> tuple[Depth, Place]:
        """Returns depth [m] and fractional row of `kept` of the plane fitted to the floor, on the grid `surroundings`.

        In an image of a plane, 1 / depth is linear in column and row. Depths beyond `FAR_M` are inf.
        """
        shape = self.surroundings.shape
        plane, place = np.empty(shape, np.float32), np.empty(shape, np.float32)
        _fit_plane(depth, self._fit, self._terms, self.range_per_depth, plane, place)
        return plane, place

    def add(self, floor: Radiance, place: Place, around: tuple[Radiance, Place], light: Radiance) -> None:
        """Adds the blurred light of the floor, without the core of the kernel (see `kept`), to `light` in place.

        `floor` (H, W, 3) is attenuated by absorption alone [cd/m2], `place` the fractional row of `kept` for every
        second pixel in both directions, `around` both for the surroundings, overwritten inside the image.
        """
        grid = self.surroundings
        images: list[Radiance] = [np.asarray(cv2.pyrDown(floor), np.float32)]
        places, by_light = [place], False
        while len(images) < len(self._tables):
            if len(images) == grid.level:
                inner = np.s_[grid.pad : grid.pad + len(images[-1]), grid.pad : grid.pad + images[-1].shape[1]]
                outer, outer_place = around
                by_light = np.abs(outer_place[inner] - places[-1]).max() > LEVEL_STEPS
                outer[inner], outer_place[inner] = images[-1], places[-1]
                images[-1], places[-1] = outer, outer_place
            images.append(np.asarray(cv2.pyrDown(images[-1]), np.float32))
            mean = _place_of_light if by_light else _mean_place
            places.append(mean(images[-2], images[-1], places[-1]))
        tables = tuple(zip(self._tables, self._widening, strict=True))
        _weigh(images[-1], places[-1], *tables[-1], np.zeros_like(images[-1]))
        for k in reversed(range(len(images) - 1)):
            height, width = places[k].shape
            wider = cv2.pyrUp(images[k + 1], dstsize=(width, height))
            _weigh(images[k], places[k], *tables[k], wider)
            if k + 1 == grid.level:
                height, width = (n_px_at(n, grid.level) for n in floor.shape[:2])
                images[k] = images[k][grid.pad : grid.pad + height, grid.pad : grid.pad + width]
        rows, cols = images[0].shape[:2]
        finest = images[0].reshape(rows, 3 * cols), light.reshape(len(light), -1)
        in_row_bands(lambda first, end: _add_upsampled(*finest, first, end), len(light), QUICK)

    def spread(self, floor: Radiance, range_m: Array, around: tuple[Radiance, Place]) -> Radiance:
        """Returns all light (H, W, 3) of the floor scattered between floor and camera [cd/m2], see `add`."""
        light = (floor * self.core(range_m)).astype(np.float32)
        self.add(floor, np.ascontiguousarray(place_of(range_m)[::2, ::2]), around, light)
        return light

    def core(self, range_m: Array) -> Array:
        """Returns the share (H, W, 3) of the floor's light that is scattered by less than a pixel."""
        place, rows = place_of(range_m), np.arange(SHARE_STEPS + 1)
        return np.stack([np.interp(place, rows, of_band) for of_band in self._core.T], axis=-1)


def place_of(range_m: Array) -> Place:
    """Returns the fractional row of the table `ForwardScatter.kept` for ranges of any shape [m]; inf is valid."""
    near = np.minimum(range_m, FAR_M)
    return (SHARE_STEPS * near / (near + RANGE_SCALE_M)).astype(np.float32)


def level_sigma_px(level: int) -> float:
    """Returns the standard deviation of the blur of a pyramid level [px], the sum of the variances of its filters."""
    return float(np.sqrt(2 * (4.0**level - 1) / 3))


@lru_cache(maxsize=64)
def level_weights_of(bands: tuple[BandWater, ...], focal_px: float, levels: int) -> Array:
    """Returns the weights (levels + 1, 3, nodes) of the levels of the kernel at `NODES_M`; level 0: below a pixel."""
    sigmas = tuple(level_sigma_px(level) / focal_px for level in range(levels + 1))
    return np.array([camera_mixture(band, NODES_M, sigmas).T for band in bands]).swapaxes(0, 1)


def level_weights(bands: tuple[BandWater, ...], focal_px: float, levels: int, range_m: Array) -> Array:
    """Returns the weights (levels + 1, n, 3) of the levels of the kernel of scattered light at ranges (n,) [m]."""
    nodes = level_weights_of(bands, focal_px, levels)
    rows = [
        over_path(nodes[:, k], band.scattering_per_m, range_m) if band.scattering_per_m else nodes[:, k, :1] * range_m
        for k, band in enumerate(bands)
    ]
    return np.stack(rows, axis=-1)


def n_px_at(n_px: int, level: int) -> int:
    for _ in range(level):
        n_px = (n_px + 1) // 2
    return n_px


def _surroundings(rig: StereoRig) -> Surroundings:
    level = max(round(np.log2(SURROUNDINGS_STEP_TAN * rig.focal_px)), 1)
    side = 2.0**level
    half = max(rig.width_px, rig.height_px) / 2 / side
    pad = max(int(np.ceil(SURROUNDINGS_TAN * rig.focal_px / side - half)), 2)
    # at least the pixels of the image at this level; (n - 1) / 2 is its centre
    rows, cols = (
        max(round((n - 1) / side), n_px_at(n, level) - 1) + 1 + 2 * pad for n in (rig.height_px, rig.width_px)
    )
    return Surroundings(level, pad, (rows, cols), rig.focal_px / side)


def _plane_terms(x: NDArray[np.floating], y: NDArray[np.floating]) -> Array:
    """Returns 1, x and y of each pixel (n, 3) of a grid with columns at x and rows at y."""
    across, down = np.meshgrid(x, y)
    return np.column_stack([np.ones(across.size), across.ravel(), down.ravel()]).astype(np.float64)


def _tables(weights: Array, focal_px: float) -> NDArray[np.float32]:
    """Returns the tables (levels, n, 8) of `_weigh`: weights (levels, n, 3) and 0, their changes and 0."""
    # changes if all light of levels up to `WIDENED_TAN` focal lengths, not the last, moves to the next
    leaves = np.array([level_sigma_px(k + 1) <= WIDENED_TAN * focal_px for k in range(len(weights))])
    leaves[-1] = False
    leaving = weights * leaves[:, None, None]
    tables = np.zeros((*weights.shape[:2], 8), np.float32)
    tables[..., :3] = weights
    tables[..., 4:7] = np.concatenate([np.zeros_like(weights[:1]), leaving[:-1]]) - leaving
    return tables


def _widening(rig: StereoRig, grid: Surroundings, per_depth: Depth, levels: int) -> list[Radiance]:
    """Returns the share of the light of narrow levels that moves to the next level, for each level of the pyramid."""
    v, u = ((np.arange(0.0, n, 2) - (n - 1) / 2) / rig.focal_px for n in (rig.height_px, rig.width_px))
    secants = [np.sqrt(1 + v[:, None] ** 2 + u**2)]
    for level in range(2, levels + 1):
        secants.append(per_depth[::2, ::2] if level == grid.level + 1 else secants[-1][::2, ::2])
    if grid.level <= levels:
        secants[grid.level - 1] = per_depth
    return [np.ascontiguousarray(np.clip(WIDENING * np.log2(one), 0.0, 1.0), np.float32) for one in secants]


def _mean_place(image: Radiance, smaller: Radiance, place: Place) -> Place:
    return np.asarray(cv2.pyrDown(place), np.float32)


def _place_of_light(image: Radiance, smaller: Radiance, place: Place) -> Place:
    """Returns the place of a smaller level of the pyramid: the mean weighted with the green light of the level."""
    mean, green = _mean_place(image, smaller, place), smaller[..., 1]
    of_light = np.asarray(cv2.pyrDown(np.ascontiguousarray(image[..., 1] * place)), np.float32)
    return np.divide(of_light, green, out=mean, where=green > 0)


@kernel(error_model="numpy")
def _fit_plane(depth, fit, terms, range_per_depth, plane, place):
    one, two, three, k = 0.0, 0.0, 0.0, 0
    for v in range(0, depth.shape[0], PLANE_STEP_PX):
        for u in range(0, depth.shape[1], PLANE_STEP_PX):
            per_m = 1 / np.float64(depth[v, u])
            one, two, three = one + fit[0, k] * per_m, two + fit[1, k] * per_m, three + fit[2, k] * per_m
            k += 1
    steps, scale, far = np.float32(SHARE_STEPS), np.float32(RANGE_SCALE_M), np.float32(FAR_M)
    cols = plane.shape[1]
    for v in range(plane.shape[0]):
        for u in range(cols):
            i = v * cols + u
            per_m = max(terms[i, 0] * one + terms[i, 1] * two + terms[i, 2] * three, 1e-9)
            z = np.float32(1 / per_m if per_m > 1 / FAR_M else np.inf)
            near = min(z * range_per_depth[v, u], far)
            plane[v, u], place[v, u] = z, steps * near / (near + scale)


@kernel(error_model="numpy", fastmath={"contract"})
def _weigh(image, place, table, widening, wider):
    """Multiplies one level by its weights and adds the wider levels, in place."""
    last, one = np.int32(table.shape[0] - 2), np.float32(1.0)
    flat, cols = table.reshape(-1), place.shape[1]
    cell, part = np.empty(cols, np.int32), np.empty(cols, np.float32)
    for v in range(place.shape[0]):
        at, moves, filled, added = place[v], widening[v], image[v].reshape(-1), wider[v].reshape(-1)
        for u in range(cols):
            k = min(np.int32(at[u]), last)
            cell[u], part[u] = np.int32(8) * k, at[u] - np.float32(k)
        for u in range(cols):
            i, w, s = np.uint32(cell[u]), part[u], moves[u]
            places = i, i + np.uint32(8), i + np.uint32(4), i + np.uint32(12)
            shares = one - w, w, s * (one - w), s * w
            red, green, blue = sum_of_entries(flat, places, shares)  # pyright: ignore
            filled[3 * u] = filled[3 * u] * red + added[3 * u]
            filled[3 * u + 1] = filled[3 * u + 1] * green + added[3 * u + 1]
            filled[3 * u + 2] = filled[3 * u + 2] * blue + added[3 * u + 2]


@kernel(error_model="numpy", fastmath={"contract"})
def _add_upsampled(small, light, first, end):
    """Adds an image, upsampled to twice its size as by `cv2.pyrUp`, to rows of `light` (H, 3 W)."""
    # filters (1, 6, 1) / 8 and (1, 1) / 2; rows and columns before the first are mirrored, the last is repeated
    last, width = small.shape[0] - 1, light.shape[1] // 3
    cols = small.shape[1] // 3
    wide = np.empty(3 * (cols + 2), np.float32)
    of_side, of_middle, half = np.float32(1 / 8), np.float32(6 / 8), np.float32(0.5)
    middle = wide[3:-3]
    for v in range(first, end):
        k = v // 2
        here, below = small[k], small[min(k + 1, last)]
        if v % 2:
            for i in range(middle.size):
                middle[i] = half * (here[i] + below[i])
        else:
            above = small[k - 1 if k else min(1, last)]
            for i in range(middle.size):
                middle[i] = of_side * (above[i] + below[i]) + of_middle * here[i]
        for band in range(3):
            wide[band], wide[3 * (cols + 1) + band] = wide[3 * min(2, cols) + band], wide[3 * cols + band]
        filled = light[v]
        for u in range(width // 2):
            for band in range(3):
                i = 3 * u + band
                left, centre, right = wide[i], wide[i + 3], wide[i + 6]
                filled[6 * u + band] += of_side * (left + right) + of_middle * centre
                filled[6 * u + 3 + band] += half * (centre + right)
        if width % 2:
            for band in range(3):
                i = 3 * (cols - 1) + band
                filled[6 * (cols - 1) + band] += of_side * (wide[i] + wide[i + 6]) + of_middle * wide[i + 3]
