"""Light from the lamps and the sun to the floor and back to the eye, through water.

Radiance of a pixel whose floor lies at range r, with albedo rho, seen by an eye that moves with the lamps
(Jaffe 1990, McGlamery 1979, in the form of Song et al. 2021, doi 10.1007/978-3-030-68790-8_29):

    L = rho/pi * (sum_i I_i(theta_i)/d_i^2 * max(cos, 0) * exp(-c d_i) + E_sun) * exp(-c r)  +  veil(r)
    veil(r) = integral_0^r b p(psi_i) I_i(theta_i)/d_i^2 * exp(-c d_i) exp(-c s) ds, summed over lamps, and the sun's

with d_i the distance to lamp i and psi_i the angle of scattering; c is the effective attenuation of `water`. No free
factors. Left out here: shadows, waves and light scattered forward into neighbouring pixels, which have modules of their
own, and that the light in the veil was scattered more than once.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from twin.core.records import Image, StereoRig
from twin.imaging.lamps import Lights, beam_share, daylight_at, lights_of_eye
from twin.imaging.row_parallel import in_row_bands
from twin.imaging.shading import PATH_MAX_M, PATH_STEP_M, RANGE_SCALE_M, shade
from twin.imaging.water import Medium, medium, phase_function
from twin.scenario.model import LampConfig, SunConfig, WaterConfig

Array = NDArray[np.float64]
Radiance = NDArray[np.float32]
Depth = NDArray[np.float32]
Lit = NDArray[np.uint8]

LAMP_RADIUS_M = 0.03  # nothing comes nearer to the source than its housing
LEAST_TRANSMISSION = 1e-25  # what is left of less is lost in single precision
VEIL_GRID, VEIL_RANGES, VEIL_SUBSTEPS = (16, 20), 48, 8
BEAM_STEPS = 2048  # of sqrt(1 - cos(angle)), from 0 to 1: about even in the angle


class Overhead(NamedTuple):
    """The surface above an eye.

    Args:
        waves: (n + 1, n + 1) light against the mean, n a power of two; the last row and column repeat the first. None
            where it is even.
        ground: (3, 4) column and row in `waves`, and depth below the surface [m], by place in the eye.
    """

    waves: NDArray[np.float32] | None
    ground: Array


class _Tables(NamedTuple):
    """What the kernel looks up.

    Args:
        beams: (lamps, n) share of the axial intensity over even steps of sqrt(1 - cos(angle)) in [0, 1].
        transmission: (3, n) exp(-c s) over even steps of path length.
        veil: (rows, cols, 3, ranges) radiance of the veil over a coarse grid of pixels and even r / (r + scale).
    """

    beams: NDArray[np.float32]
    transmission: NDArray[np.float32]
    veil: NDArray[np.float32]


class Optics:
    """Turns albedo and depth of each eye (0 left, 1 right) into radiance [cd/m2] for R, G, B.

    Args:
        altitude_m: height that is flown above the reference plane, on which `sun.depth_m` is told.
    """

    def __init__(
        self, rig: StereoRig, water: WaterConfig, lamps: Sequence[LampConfig], sun: SunConfig, altitude_m: float = 0.0
    ):
        self._rig, self._medium = rig, medium(water)
        daylight = daylight_at(sun, self._medium, altitude_m)
        self._lights = [lights_of_eye(rig, lamps, daylight, eye) for eye in (0, 1)]
        self._tables_of = cache(lambda eye: _tables(rig, self._medium, self._lights[eye]))  # some need one camera only
        falls = bool(daylight.per_m.any())
        self._surface_lx = np.full(3, sun.illuminance_lx) if falls else daylight.eye_lx
        self._loss_per_m = np.array([daylight.per_m, self._medium.attenuation_per_m], np.float32)
        self._level = Overhead(None, np.array([[0.0, 0, 0, 0], [0, 0, 0, 0], [0, 0, 1, sun.depth_m - altitude_m]]))

    def radiance(
        self, albedo: Image, depth: Depth, eye: int, lit: Lit | None = None, overhead: Overhead | None = None
    ) -> Radiance:
        """Light that reaches an eye.

        Args:
            albedo: (H, W, 3) uint8, 255 = white.
            depth: (H, W) float32 along the optical axis [m]; inf where there is no floor, which shows the veil alone.
            eye: 0 left, 1 right.
            lit: (lamps, H, W) uint8, 0 where the floor is in the shadow of a lamp; None without shadows.
            overhead: the surface; None where the eye looks straight down from the height that is flown, without waves.

        Returns:
            (H, W, 3) float32 [cd/m2].
        """
        out = np.empty(albedo.shape, np.float32)
        self._run(albedo, depth, eye, lit, overhead, out, None)
        return out

    def split(
        self,
        albedo: Image,
        depth: Depth,
        eye: int,
        lit: Lit | None = None,
        overhead: Overhead | None = None,
        direct: Radiance | None = None,
    ) -> tuple[Radiance, Radiance]:
        """The same light in two parts: from the floor (in `direct`, where memory for it is given), and the veil."""
        direct = np.empty(albedo.shape, np.float32) if direct is None else direct
        veil = np.empty(albedo.shape, np.float32)
        self._run(albedo, depth, eye, lit, overhead, direct, veil)
        return direct, veil

    def floor_lx(self, depth: Depth, eye: int, lit: Lit | None = None, overhead: Overhead | None = None) -> Radiance:
        """Illuminance of the floor (H, W, 3): what a white one shows without its way back; NaN where none is left."""
        white, _ = self.split(np.full((*depth.shape, 3), 255, np.uint8), depth, eye, lit, overhead)
        back = np.exp(-self._medium.attenuation_per_m * range_of(depth, self._rig)[..., None])
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.where(back > LEAST_TRANSMISSION, np.pi * white / back, np.nan).astype(np.float32)

    def _run(
        self,
        albedo: Image,
        depth: Depth,
        eye: int,
        lit: Lit | None,
        overhead: Overhead | None,
        out: Radiance,
        veil_out: Radiance | None,
    ) -> None:
        lights, focal = self._lights[eye], np.float32(self._rig.focal_px)
        waves, ground = self._level if overhead is None else overhead
        sky = self._surface_lx.astype(np.float32), self._loss_per_m, waves, np.asarray(ground, np.float32)
        lamps = np.column_stack([lights.position_m, lights.axis, lights.intensity_cd, lights.colour])
        beams, transmission, veil = self._tables_of(eye)
        scene = np.ascontiguousarray(albedo), depth, focal, lamps.astype(np.float32), beams, transmission, veil, sky
        in_row_bands(lambda first, end: shade(*scene, out, lit, veil_out, first, end), len(depth))


def range_of(depth: Depth, rig: StereoRig) -> Array:
    """Distance (H, W) of the floor from the eye [m], from its depth along the optical axis."""
    x = (np.arange(rig.width_px) - rig.cx_px) / rig.focal_px
    y = (np.arange(rig.height_px) - rig.cy_px) / rig.focal_px
    return depth.astype(np.float64) * np.sqrt(1 + x**2 + y[:, None] ** 2)


def scattered_per_m(lights: Lights, water: Medium, ray: Array, range_m: Array) -> Array:
    """Light added to the veil per metre of range: the integrand of `veil`.

    Args:
        lights: lamps and daylight in the axes of the eye.
        water: optical properties.
        ray: (..., 3) unit direction of view in the eye.
        range_m: (..., n) distances along the ray [m].

    Returns:
        (..., n, 3) radiance per metre [cd/m3].
    """
    scattering, attenuation = water.scattering_per_m, water.attenuation_per_m
    points = ray[..., None, :] * range_m[..., None]
    # Daylight comes from above, along the optical axis, and falls off that way.
    phase = phase_function(-ray[..., 2], water.mean_cosine)[..., None, None]
    day = lights.daylight.eye_lx * np.exp(-lights.daylight.per_m * points[..., 2:])
    total = day * phase * scattering * np.exp(-attenuation * range_m[..., None])
    for position, axis, intensity, colour, beam in zip(*lights[:5], strict=True):
        way = points - position
        distance = np.maximum(np.linalg.norm(way, axis=-1), LAMP_RADIUS_M)
        way /= distance[..., None]
        strength = intensity * beam_share(way @ axis, beam) / distance**2
        strength *= phase_function(-np.einsum("...nk,...k->...n", way, ray), water.mean_cosine)
        reach = np.exp(-attenuation * (distance + range_m)[..., None])
        total = total + strength[..., None] * colour * scattering * reach
    return total


def _tables(rig: StereoRig, water: Medium, lights: Lights) -> _Tables:
    cosines = 1 - np.linspace(0.0, 1.0, BEAM_STEPS + 1) ** 2
    beams = np.array([beam_share(cosines, beam) for beam in lights.beam]).reshape(-1, cosines.size)
    veil = np.ascontiguousarray(np.moveaxis(_veil_table(rig, water, lights), -1, 2), np.float32)
    return _Tables(beams.astype(np.float32), _transmission(water.attenuation_per_m), veil)


def _transmission(per_m: Array) -> NDArray[np.float32]:
    """(3, n) share of light that is left over even steps of path."""
    return np.exp(-per_m[:, None] * np.arange(0.0, PATH_MAX_M, PATH_STEP_M)).astype(np.float32)


def _veil_table(rig: StereoRig, water: Medium, lights: Lights) -> Array:
    """The veil over a coarse grid of pixels and of range; empty in water that does not scatter."""
    if not water.scattering_per_m.any():
        return np.zeros((0, 0, 0, 3))
    rows, cols = VEIL_GRID
    u, v = np.meshgrid(np.linspace(0, rig.width_px - 1, cols), np.linspace(0, rig.height_px - 1, rows))
    ray = np.stack([(u - rig.cx_px) / rig.focal_px, (v - rig.cy_px) / rig.focal_px, np.ones_like(u)], -1)
    ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
    # Midpoints of even steps of x = r / (r + scale), which reaches infinite range at x = 1; dr/dx = scale / (1 - x)^2.
    n = VEIL_RANGES * VEIL_SUBSTEPS
    x = (np.arange(n) + 0.5) / n
    per_x = RANGE_SCALE_M / (1 - x) ** 2
    light = scattered_per_m(lights, water, ray, np.broadcast_to(RANGE_SCALE_M * x / (1 - x), (rows, cols, n)))
    steps = (light * per_x[:, None] / n).reshape(rows, cols, VEIL_RANGES, VEIL_SUBSTEPS, 3).sum(3)
    return np.concatenate([np.zeros((rows, cols, 1, 3)), steps.cumsum(2)], axis=2)
