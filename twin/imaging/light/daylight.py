"""Daylight on floors of any slope, and its backscatter in the lines of sight of a camera, from the light field.

Light that floor and water send back is neglected: 8 % for albedo 0.5 in water of Jerlov type III.
"""

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from twin.core.geometry import Array
from twin.imaging.light.illumination import Daylight
from twin.imaging.light.light_field import SLOPE_MODES, LightField
from twin.imaging.light.phase_function import BandWater
from twin.imaging.light.sun_sky import SunSky
from twin.imaging.light.water import Medium
from twin.kernels import kernel

MODES = 8  # terms of the azimuth series of the upwelling light; the mean error of the series is below 1 %
VIEW_STEPS, LARGEST_VIEW_DEG = 24, 86.0  # number of angles between line of sight and straight down, and the largest one
FLOOR_STEPS, FLOOR_SCALE_M = 96, 2.0  # steps of h / (h + scale), with h the vertical distance of the floor; scale
FIT_DEPTHS = 9  # number of depths, from the cameras to below the reference plane, at which light is computed
#: Rows and columns of the terms of a quadratic form in (n, 1), in the order of the argument `sky` of `shading.shade`.
_FIRST, _SECOND = np.array([[0, 1, 2, 0, 0, 1, 0, 1, 2, 3], [0, 1, 2, 1, 2, 2, 3, 3, 3, 3]])
LEAST_LX = 1e-12  # lower limit of the illuminance by all light but the beam, per lux at the surface


class FloorDaylight(NamedTuple):
    """Daylight on the floor in the bands R, G, B.

    The light on a floor at depth z with the unit normal n is, for each band,

        beam_lx exp(-beam_per_m z) max(n . to_sun, 0) + (n, 1) rest_lx (n, 1)' exp(d k1 + clip(d, *fitted_m)^2 k2)

    with d = z - reference_depth_m and (k1, k2) = rest_per_m. A negative quadratic form counts as 0.
    """

    to_sun: Array  # (3,) unit direction to the refracted sun, east, north, up
    beam_lx: Array  # (3,) illuminance by the beam just below the surface on a plane that faces the sun
    beam_per_m: Array  # (3,) attenuation of the beam with depth [1/m]
    rest_lx: Array  # (3, 4, 4) illuminance by all other light at the reference depth, a quadratic form in (n, 1)
    rest_per_m: Array  # (3, 2) coefficients of d [1/m] and of d squared [1/m2] in the logarithm of the other light
    reference_depth_m: float  # depth below the surface at which `rest_lx` applies
    fitted_m: tuple[float, float]  # lowest and highest d of the fit

    def in_camera(self, from_camera: Array) -> tuple[NDArray[np.float32], ...]:
        """Returns the first five parts of the argument `sky` of `shading.shade`; see `optics.WaterSurface`."""
        to_sun, form = np.empty(3, np.float32), np.empty((len(self.rest_lx), len(_FIRST)), np.float32)
        _turn_to_camera(world_axes(from_camera), self.to_sun, self.rest_lx, to_sun, form)
        beam = np.stack([self.beam_lx, self.beam_per_m], 1).astype(np.float32)
        fitted = np.array([self.reference_depth_m, *self.fitted_m], np.float32)
        return to_sun, beam, form, np.ascontiguousarray(self.rest_per_m, np.float32), fitted


def floor_daylight(daylight: Daylight) -> FloorDaylight:
    """Returns the daylight on the floor. With multiple scattering, the beam is scattered into diffuse light.

    Without it, beam and diffuse light decrease at the rate of the diffuse attenuation, 0 without a surface.
    """
    source, water, east_north = daylight.source, daylight.water, _turn(daylight.source)
    beam, deep = daylight.surface_lx * source.beam_lx, daylight.reference_depth_m
    if not (deep and water.multiple and daylight.surface_lx.any()):
        clear = _field(BandWater(0.0, 0.0), source, 1)
        form = east_north @ clear.slope_form(0.0, 1e-6) @ east_north.T
        fade = -daylight.attenuation_per_m
        rest_lx = (daylight.surface_lx * np.exp(fade * deep))[:, None, None] * form
        rest_per_m = np.stack([fade, np.zeros(3)], 1)
        return FloorDaylight(np.array(source.to_sun), beam, -fade, rest_lx, rest_per_m, deep, (0.0, 0.0))
    fields = [_field(band, source, SLOPE_MODES) for band in water.bands]
    depths = np.linspace(daylight.camera_depth_m, deep + max(1.0, (deep - daylight.camera_depth_m) / 4), FIT_DEPTHS)
    forms, changes = zip(*(_rest_of(band, source, deep, tuple(depths)) for band in water.bands), strict=True)
    turned = daylight.surface_lx[:, None, None] * (east_north @ np.array(forms) @ east_north.T)
    per_m = np.array([field.beam_per_m for field in fields])
    fitted = float(depths[0] - deep), float(depths[-1] - deep)
    return FloorDaylight(np.array(source.to_sun), beam, per_m, turned, np.array(changes), deep, fitted)


@lru_cache(maxsize=64)
def _rest_of(band: BandWater, source: SunSky, deep_m: float, depths_m: tuple[float, ...]) -> tuple[Array, Array]:
    """Returns the illuminance of the floor by all light except the beam of the sun, in one band."""
    field = _field(band, source, SLOPE_MODES)
    light = np.log([max(field.illuminance(z, z)[1], LEAST_LX) for z in depths_m])
    square, slope, level = np.polyfit(np.array(depths_m) - deep_m, light, 2)
    form = field.slope_form(deep_m, deep_m)
    return form * np.exp(level) / max(field.illuminance(deep_m, deep_m)[1], LEAST_LX), np.array([slope, square])


class DaylightVeil:
    """Daylight scattered into the lines of sight of a camera, in any order, at ranges (n,) that increase from 0 [m]."""

    def __init__(self, daylight: Daylight, range_m: Array):
        self._depth_m, self._source, water = daylight.camera_depth_m, daylight.source, daylight.water
        terms = _veil_terms(self._depth_m, water, self._source, range_m) * daylight.surface_lx
        padded = np.concatenate([terms, np.zeros((*terms.shape[:-1], 1))], axis=-1).swapaxes(0, 1)
        self._terms = np.ascontiguousarray(padded.reshape(*padded.shape[:2], -1), np.float32)
        azimuth = np.arctan2(self._source.to_sun[1], self._source.to_sun[0])
        self._towards_sun = np.array([np.cos(azimuth), np.sin(azimuth)])
        fields = [_field(band, self._source, 1) for band in water.bands]
        loss = np.array([_local_attenuation(field, self._depth_m) for field in fields])
        self._loss = loss if daylight.reference_depth_m else np.zeros(3)

    def radiance(self, ray: Array, depth_m: float) -> NDArray[np.float32]:
        """Returns the radiance (..., ranges, 3) [cd/m2] along unit directions, east, north, up, above a black floor.

        At another depth of the camera, the tabulated radiance is scaled with the attenuation of the illuminance.
        """
        dark = np.zeros((*ray.shape[:-1], self._terms.shape[-1] // 4, 4), np.float32)
        return self.added_to(dark, ray, depth_m)[..., :3]

    def added_to(self, light: NDArray[np.float32], ray: Array, depth_m: float) -> NDArray[np.float32]:
        """Returns the sum (..., ranges, 4) of the radiance and of other light, each R, G, B and a zero [cd/m2]."""
        out, size = np.empty_like(light), self._terms.shape[-1]
        fade = np.zeros(4, np.float32)
        fade[:3] = np.exp(-self._loss * (depth_m - self._depth_m))
        flat = np.ascontiguousarray(ray.reshape(-1, 3))
        _add_veil(self._terms, flat, self._towards_sun, fade, light.reshape(-1, size), out.reshape(-1, size))
        return out


@kernel(error_model="numpy", fastmath={"contract"})
def _add_veil(terms, ray, towards_sun, fade, light, out):
    views, modes, size = terms.shape
    per_rad = np.rad2deg(1.0) * (views - 1) / LARGEST_VIEW_DEG
    faded = np.empty(size, np.float32)
    for k in range(size):
        faded[k] = fade[k % 4]
    for i in range(ray.shape[0]):
        x, y, z = ray[i, 0], ray[i, 1], ray[i, 2]
        at = min(np.arccos(min(max(-z, -1.0), 1.0)) * per_rad, views - 1 - 1e-9)
        view, across = int(at), np.sqrt(x * x + y * y)
        part = at - view
        cosine = (x * towards_sun[0] + y * towards_sun[1]) / across if across > 0 else towards_sun[0]
        before, turn, row = cosine, 1.0, out[i]
        row[:] = np.float32(0.0)
        for m in range(modes):
            near, far = np.float32(turn * (1 - part)), np.float32(turn * part)
            this, following = terms[view, m], terms[view + 1, m]
            for k in range(size):
                row[k] += near * this[k] + far * following[k]
            before, turn = turn, 2 * cosine * turn - before  # cos((m + 1) azimuth) from the two terms before it
        for k in range(size):
            row[k] = light[i, k] + max(row[k], np.float32(0.0)) * faded[k]


def _veil_terms(depth_m: float, water: Medium, source: SunSky, range_m: Array) -> Array:
    """Returns the radiance of the veil, per lux just below the surface, as an azimuth series [cd/m2 per lx]."""
    cosine = np.cos(np.deg2rad(np.linspace(0.0, LARGEST_VIEW_DEG, VIEW_STEPS)))
    share = np.linspace(0.0, 1.0, FLOOR_STEPS + 1)
    with np.errstate(divide="ignore", invalid="ignore"):
        height_m = np.append(FLOOR_SCALE_M * share[:-1] / (1 - share[:-1]), np.inf)
        vertical_m = cosine[:, None] * range_m
        wanted = np.where(np.isinf(vertical_m), 1.0, vertical_m / (vertical_m + FLOOR_SCALE_M))
    bands = []
    for band in water.bands:
        light = _field(band, source, MODES).veil(depth_m, cosine, depth_m + height_m)
        rows = [[np.interp(wanted[k], share, light[m, k]) for k in range(VIEW_STEPS)] for m in range(len(light))]
        bands.append(rows)
    return np.moveaxis(np.array(bands), 0, -1)


def _local_attenuation(field: LightField, depth_m: float) -> float:
    above, below = (sum(field.illuminance(z, np.inf)) for z in (max(depth_m - 0.25, 0.0), depth_m + 0.25))
    if not min(above, below) > 0:
        return 0.0  # no light is left
    return float(np.log(above / below) / (depth_m + 0.25 - max(depth_m - 0.25, 0.0)))


def _turn(source: SunSky) -> Array:
    """Returns the rotation (4, 4) of (x, y, z, 1) from the axes of the sun to the axes east, north, up."""
    east, north, _ = source.to_sun
    length = np.hypot(east, north)
    c, s = (east / length, north / length) if length > 0 else (1.0, 0.0)
    out = np.eye(4)
    out[:2, :2] = [[c, -s], [s, c]]
    return out


#: Light field of a band, with the number of terms of its Fourier series in azimuth.
_field = lru_cache(maxsize=64)(LightField)


@kernel(error_model="numpy")
def world_axes(from_camera):
    """Returns the unit vectors east, north and up in camera axes, as columns (3, 3); see `optics.WaterSurface`."""
    axes = np.empty((3, 3))
    for k in range(3):
        x, y, z = from_camera[k, 0], from_camera[k, 1], from_camera[k, 2]
        length = np.sqrt(x * x + y * y + z * z) * (-1 if k == 2 else 1)
        axes[0, k], axes[1, k], axes[2, k] = x / length, y / length, z / length
    return axes


@kernel(error_model="numpy")
def _turn_to_camera(axes, to_sun, rest_lx, sun, form):
    turn, half = np.eye(4), np.empty((4, 4))
    turn[:3, :3] = axes
    for i in range(3):
        sun[i] = axes[i, 0] * to_sun[0] + axes[i, 1] * to_sun[1] + axes[i, 2] * to_sun[2]
    for band in range(rest_lx.shape[0]):
        for i in range(4):
            for j in range(4):
                half[i, j] = 0.0
                for k in range(4):
                    half[i, j] += turn[i, k] * rest_lx[band, k, j]
        for term in range(_FIRST.size):
            i, j = _FIRST[term], _SECOND[term]
            total = 0.0
            for k in range(4):
                total += half[i, k] * turn[j, k]
            form[band, term] = total if i == j else 2 * total
