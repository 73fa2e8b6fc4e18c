"""Image formation in water: direct signal and backscatter of lamps and daylight.

Radiance of a pixel that shows a floor of albedo rho at range r, for a camera and lamps on the same vehicle
(Jaffe 1990, McGlamery 1979, in the form of Song et al. 2021, doi 10.1007/978-3-030-68790-8_29):

    L = rho/pi * (sum_i I_i(theta_i)/d_i^2 * max(cos, 0) * exp(-c d_i) + E_sun) * exp(-c r)  +  B(r)
    B(r) = integral_0^r b p(psi_i) I_i(theta_i)/d_i^2 * exp(-c d_i) exp(-c s) ds, summed over lamps and the sun

with I_i the intensity of lamp i at the angle theta_i from its beam axis, d_i the distance to the lamp, cos the cosine
of the angle of incidence, E_sun the illuminance by daylight, psi_i the scattering angle, p the phase function, b the
scattering coefficient and c the effective attenuation (`water.Medium`). The model has no free scale factors. Shadows,
caustics and forward scatter are computed in other modules. Multiple scattering is neglected in the backscatter.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from twin.core.records import Image, StereoRig
from twin.imaging.illumination import Illumination
from twin.imaging.lamps import LightSources, beam_share, light_sources_in_camera
from twin.imaging.row_parallel import in_row_bands
from twin.imaging.shading import PATH_MAX_M, PATH_STEP_M, RANGE_SCALE_M, shade
from twin.imaging.water import Medium, phase_function
from twin.scenario.model import LampConfig

Array = NDArray[np.float64]
Radiance = NDArray[np.float32]
Depth = NDArray[np.float32]
Lit = NDArray[np.uint8]

LAMP_RADIUS_M = 0.03  # shortest distance to a lamp: the radius of its housing
LEAST_TRANSMISSION = 1e-25  # at a smaller transmission, single precision does not represent the direct signal
BACKSCATTER_GRID, BACKSCATTER_RANGES, BACKSCATTER_SUBSTEPS = (16, 20), 48, 8
BEAM_STEPS = 2048  # number of steps of sqrt(1 - cos(angle)) from 0 to 1, which are nearly even in the angle


class WaterSurface(NamedTuple):
    """The water surface above a camera: the caustics that it casts, and its position relative to the camera.

    Args:
        caustics: (n + 1, n + 1) daylight relative to its mean, n a power of two; the last row and column repeat the
            first row and column. None if daylight is uniform.
        from_camera: (3, 4) map from a point in the camera axes to column and row in `caustics` and depth below the
            surface [m].
    """

    caustics: NDArray[np.float32] | None
    from_camera: Array


class _Tables(NamedTuple):
    """Lookup tables of the shading kernel (`shading.shade`) for one camera.

    Args:
        beams: (lamps, n) intensity relative to that on the axis, at even steps of sqrt(1 - cos(angle)) in [0, 1].
        transmission: (3, n) exp(-c s) at even steps of the path length s.
        backscatter: (rows, cols, 3, ranges) radiance on a coarse pixel grid, at even steps of
            r / (r + `RANGE_SCALE_M`), with r the range.
    """

    beams: NDArray[np.float32]
    transmission: NDArray[np.float32]
    backscatter: NDArray[np.float32]


class Optics:
    """Model of the direct signal and the backscatter that reach each camera, for R, G, B.

    Args:
        rig: the rendered cameras.
        illumination: water and daylight.
        lamps: lamps on the vehicle.

    Attributes:
        light_sources: lamps and daylight in the axes of the left and of the right camera.
    """

    def __init__(self, rig: StereoRig, illumination: Illumination, lamps: Sequence[LampConfig]):
        self._rig, self._medium = rig, illumination.water
        daylight = illumination.daylight
        self.light_sources = [light_sources_in_camera(rig, lamps, daylight, camera) for camera in (0, 1)]
        # computed on demand, as some callers need one camera only
        self._tables_of = cache(lambda camera: _tables(rig, self._medium, self.light_sources[camera]))
        self._surface_lx = daylight.surface_lx
        self._loss_per_m = np.array([daylight.attenuation_per_m, self._medium.attenuation_per_m], np.float32)
        level = np.array([[0.0, 0, 0, 0], [0, 0, 0, 0], [0, 0, 1, daylight.camera_depth_m]])
        self._calm_surface = WaterSurface(None, level)

    def radiance(
        self, albedo: Image, depth: Depth, camera: int, lit: Lit | None = None, surface: WaterSurface | None = None
    ) -> Radiance:
        """Returns the light (H, W, 3) float32 that reaches a camera, per colour band in photometric units [cd/m2].

        Args:
            albedo: (H, W, 3) uint8 albedo of the floor, 255 = white.
            depth: (H, W) float32 depth along the optical axis [m]; inf where there is no floor (backscatter only).
            camera: 0 left, 1 right.
            lit: (lamps, H, W) uint8, 0 where the floor blocks the light of the lamp, else 1; None = no shadows.
            surface: the water surface; None = a calm surface, for a camera that points straight down at the planned
                altitude.
        """
        out = np.empty(albedo.shape, np.float32)
        self._run(albedo, depth, camera, lit, surface, (out, None))
        return out

    def split(
        self,
        albedo: Image,
        depth: Depth,
        camera: int,
        lit: Lit | None = None,
        surface: WaterSurface | None = None,
        direct: Radiance | None = None,
    ) -> tuple[Radiance, Radiance]:
        """Returns the direct signal and the backscatter, each (H, W, 3) float32 [cd/m2]; `radiance` returns their sum.

        Args:
            albedo, depth, camera, lit, surface: see `radiance`.
            direct: (H, W, 3) float32 array to fill with the direct signal; None = a new array.
        """
        direct = np.empty(albedo.shape, np.float32) if direct is None else direct
        backscatter = np.empty(albedo.shape, np.float32)
        self._run(albedo, depth, camera, lit, surface, (direct, backscatter))
        return direct, backscatter

    def floor_lx(
        self, depth: Depth, camera: int, lit: Lit | None = None, surface: WaterSurface | None = None
    ) -> Radiance:
        """Returns the illuminance of the floor (H, W, 3) [lx]; NaN where the transmission to the camera is too small.

        It is computed from the direct signal of a white floor, divided by the transmission from floor to camera.
        """
        white, _ = self.split(np.full((*depth.shape, 3), 255, np.uint8), depth, camera, lit, surface)
        back = np.exp(-self._medium.attenuation_per_m * range_of(depth, self._rig)[..., None])
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.where(back > LEAST_TRANSMISSION, np.pi * white / back, np.nan).astype(np.float32)

    def _run(
        self,
        albedo: Image,
        depth: Depth,
        camera: int,
        lit: Lit | None,
        surface: WaterSurface | None,
        out: tuple[Radiance, Radiance | None],
    ) -> None:
        """Fills `out`: (radiance, None) or (direct signal, backscatter), arrays (H, W, 3) [cd/m2]."""
        sources, focal = self.light_sources[camera], np.float32(self._rig.focal_px)
        caustics, from_camera = self._calm_surface if surface is None else surface
        sky = self._surface_lx.astype(np.float32), self._loss_per_m, caustics, np.asarray(from_camera, np.float32)
        lamps = np.column_stack([sources.position_m, sources.axis, sources.intensity_cd, sources.colour])
        lamps, (beams, transmission, backscatter) = lamps.astype(np.float32), self._tables_of(camera)
        scene = np.ascontiguousarray(albedo), depth, focal, lamps, beams, transmission, backscatter, sky
        in_row_bands(lambda first, end: shade(*scene, out[0], lit, out[1], first, end), len(depth))


def range_of(depth: Depth, rig: StereoRig) -> Array:
    """Returns the distance (H, W) from the camera to the floor [m], given the depth along the optical axis [m]."""
    x = (np.arange(rig.width_px) - rig.cx_px) / rig.focal_px
    y = (np.arange(rig.height_px) - rig.cy_px) / rig.focal_px
    return depth.astype(np.float64) * np.sqrt(1 + x**2 + y[:, None] ** 2)


def backscatter_per_m(sources: LightSources, water: Medium, ray: Array, range_m: Array) -> Array:
    """Returns the backscatter added per metre of range: the integrand of B in the module docstring.

    Args:
        sources: lamps and daylight in the axes of the camera.
        water: optical properties of the water.
        ray: (..., 3) unit viewing direction in the axes of the camera.
        range_m: (..., n) distances along the ray [m].

    Returns:
        (..., n, 3) radiance per metre of range, per colour band in photometric units [cd/m3].
    """
    scattering, attenuation = water.scattering_per_m, water.attenuation_per_m
    points = ray[..., None, :] * range_m[..., None]
    # Daylight is assumed to propagate along the optical axis, which points down.
    phase = phase_function(-ray[..., 2], water.mean_cosine)[..., None, None]
    day = sources.daylight.illuminance_lx * np.exp(-sources.daylight.attenuation_per_m * points[..., 2:])
    total = day * phase * scattering * np.exp(-attenuation * range_m[..., None])
    for position, axis, intensity, colour, beam in zip(*sources[:5], strict=True):
        from_lamp = points - position
        distance = np.maximum(np.linalg.norm(from_lamp, axis=-1), LAMP_RADIUS_M)
        from_lamp /= distance[..., None]
        strength = intensity * beam_share(from_lamp @ axis, beam) / distance**2
        strength *= phase_function(-np.einsum("...nk,...k->...n", from_lamp, ray), water.mean_cosine)
        transmission = np.exp(-attenuation * (distance + range_m)[..., None])
        total = total + strength[..., None] * colour * scattering * transmission
    return total


def _tables(rig: StereoRig, water: Medium, sources: LightSources) -> _Tables:
    """Returns the lookup tables for one camera."""
    cosines = 1 - np.linspace(0.0, 1.0, BEAM_STEPS + 1) ** 2
    beams = np.array([beam_share(cosines, beam) for beam in sources.beam]).reshape(-1, cosines.size)
    backscatter = np.ascontiguousarray(np.moveaxis(_backscatter_table(rig, water, sources), -1, 2), np.float32)
    return _Tables(beams.astype(np.float32), _transmission(water.attenuation_per_m), backscatter)


def _transmission(per_m: Array) -> NDArray[np.float32]:
    """Returns the transmission (3, n) at even steps of path length, for attenuation coefficients `per_m` (3,)."""
    return np.exp(-per_m[:, None] * np.arange(0.0, PATH_MAX_M, PATH_STEP_M)).astype(np.float32)


def _backscatter_table(rig: StereoRig, water: Medium, sources: LightSources) -> Array:
    """Returns the backscatter (rows, cols, ranges, 3) on a coarse grid of pixels and ranges; empty in clear water."""
    if not water.scattering_per_m.any():
        return np.zeros((0, 0, 0, 3))
    rows, cols = BACKSCATTER_GRID
    u, v = np.meshgrid(np.linspace(0, rig.width_px - 1, cols), np.linspace(0, rig.height_px - 1, rows))
    ray = np.stack([(u - rig.cx_px) / rig.focal_px, (v - rig.cy_px) / rig.focal_px, np.ones_like(u)], -1)
    ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
    # Midpoints of even steps of x = r / (r + scale), which reaches infinite range at x = 1; dr/dx = scale / (1 - x)^2.
    n = BACKSCATTER_RANGES * BACKSCATTER_SUBSTEPS
    x = (np.arange(n) + 0.5) / n
    per_x = RANGE_SCALE_M / (1 - x) ** 2
    light = backscatter_per_m(sources, water, ray, np.broadcast_to(RANGE_SCALE_M * x / (1 - x), (rows, cols, n)))
    steps = (light * per_x[:, None] / n).reshape(rows, cols, BACKSCATTER_RANGES, BACKSCATTER_SUBSTEPS, 3).sum(3)
    return np.concatenate([np.zeros((rows, cols, 1, 3)), steps.cumsum(2)], axis=2)
