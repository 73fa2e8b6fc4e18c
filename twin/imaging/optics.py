"""Light from the lamps and the sun to the floor and back to the eye, through water.

Radiance of a pixel whose floor lies at range r, with albedo rho, seen by an eye that moves with the lamps
(Jaffe 1990, McGlamery 1979, in the form of Song et al. 2021, doi 10.1007/978-3-030-68790-8_29):

    L = rho/pi * (sum_i I_i(theta_i)/d_i^2 * max(cos, 0) * exp(-c d_i) + E_sun) * exp(-c r)  +  veil(r)
    veil(r) = integral_0^r b p(psi_i) I_i(theta_i)/d_i^2 * exp(-c d_i) exp(-c s) ds, summed over lamps, and the sun's

with d_i the distance to lamp i and psi_i the angle of scattering. No free factors. Left out here: shadows and light
scattered forward into neighbouring pixels, which have modules of their own, and light scattered more than once.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from twin import geometry
from twin.config import Lamp, Sun, Water
from twin.imaging.water import Medium, medium, phase_function
from twin.records import Image, StereoRig

Array = NDArray[np.float64]
Radiance = NDArray[np.float32]
Depth = NDArray[np.float32]
Lit = NDArray[np.uint8]

#: Measured beam of an LED lamp: share of the intensity on the axis by angle from it [deg] (Song et al. 2021).
BEAM_DEG = (0, 10, 20, 30, 35, 40, 45, 50, 60, 90)
BEAM_SHARE = (1, 0.96, 0.87, 0.75, 0.63, 0.5, 0.28, 0.2, 0.12, 0)

LAMP_RADIUS_M = 0.03  # nothing comes nearer to the source than its housing
PATH_STEP_M, PATH_MAX_M = 0.01, 80.0  # of the table of transmission
FAR_M = 1e6  # no floor beyond
LEAST_TRANSMISSION = 1e-25  # what is left of less is lost in single precision
RANGE_SCALE_M = 2.0  # of the table of the veil: even steps of r / (r + scale)
VEIL_GRID, VEIL_RANGES, VEIL_SUBSTEPS = (16, 20), 48, 8


class Lights(NamedTuple):
    """Lamps in the axes of one eye: position (n, 3) [m], unit axis (n, 3), intensity (n,) [cd]; daylight [lx]."""

    position_m: Array
    axis: Array
    intensity_cd: Array
    daylight_lx: float


class _Tables(NamedTuple):
    """What the kernel looks up.

    Args:
        beam: (n,) share of the axial intensity over even steps of cos(angle) in [0, 1].
        transmission: (n, 3) exp(-c s) over even steps of path length.
        veil: (rows, cols, ranges, 3) radiance of the veil over a coarse grid of pixels and even r / (r + scale).
    """

    beam: NDArray[np.float32]
    transmission: NDArray[np.float32]
    veil: NDArray[np.float32]


class Optics:
    """Turns albedo and depth of each eye (0 left, 1 right) into radiance [cd/m2] for R, G, B."""

    def __init__(self, rig: StereoRig, water: Water, lamps: Sequence[Lamp], sun: Sun):
        self._rig, self._medium = rig, medium(water)
        self._lights = [lights_of_eye(rig, lamps, sun, eye) for eye in (0, 1)]
        self._tables = [_tables(rig, self._medium, lights) for lights in self._lights]

    def radiance(self, albedo: Image, depth: Depth, eye: int, lit: Lit | None = None) -> Radiance:
        """Light that reaches an eye.

        Args:
            albedo: (H, W, 3) uint8, 255 = white.
            depth: (H, W) float32 along the optical axis [m]; inf where there is no floor, which shows the veil alone.
            eye: 0 left, 1 right.
            lit: (lamps, H, W) uint8, 0 where the floor is in the shadow of a lamp; None without shadows.

        Returns:
            (H, W, 3) float32 [cd/m2].
        """
        out = np.empty(albedo.shape, np.float32)
        self._run(albedo, depth, eye, lit, out, None)
        return out

    def split(self, albedo: Image, depth: Depth, eye: int, lit: Lit | None = None) -> tuple[Radiance, Radiance]:
        """The same light in two parts: from the floor, and the veil."""
        direct, veil = np.empty(albedo.shape, np.float32), np.empty(albedo.shape, np.float32)
        self._run(albedo, depth, eye, lit, direct, veil)
        return direct, veil

    def floor_lx(self, depth: Depth, eye: int, lit: Lit | None = None) -> Radiance:
        """Illuminance of the floor (H, W, 3): what a white one shows without its way back; NaN where none is left."""
        white, _ = self.split(np.full((*depth.shape, 3), 255, np.uint8), depth, eye, lit)
        back = np.exp(-self._medium.attenuation_per_m * range_of(depth, self._rig)[..., None])
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.where(back > LEAST_TRANSMISSION, np.pi * white / back, np.nan).astype(np.float32)

    def _run(
        self, albedo: Image, depth: Depth, eye: int, lit: Lit | None, out: Radiance, veil_out: Radiance | None
    ) -> None:
        lights, focal = self._lights[eye], np.float32(self._rig.focal_px)
        lamps = np.column_stack([lights.position_m, lights.axis, lights.intensity_cd]).astype(np.float32)
        _shade(albedo, depth, focal, lamps, np.float32(lights.daylight_lx), *self._tables[eye], out, lit, veil_out)


def range_of(depth: Depth, rig: StereoRig) -> Array:
    """Distance (H, W) of the floor from the eye [m], from its depth along the optical axis."""
    x = (np.arange(rig.width_px) - rig.cx_px) / rig.focal_px
    y = (np.arange(rig.height_px) - rig.cy_px) / rig.focal_px
    return depth.astype(np.float64) * np.sqrt(1 + x**2 + y[:, None] ** 2)


def lights_of_eye(rig: StereoRig, lamps: Sequence[Lamp], sun: Sun, eye: int) -> Lights:
    """The lamps, which move with the rig, in the axes of one eye."""
    camera_from_body = geometry.inverse(rig.body_from_camera @ (rig.left_from_right if eye else np.eye(4)))
    position = np.array([lamp.position_m for lamp in lamps]).reshape(-1, 3)
    axis = np.array([_beam_axis(lamp) for lamp in lamps]).reshape(-1, 3)
    return Lights(
        geometry.transform(camera_from_body, position),
        axis @ camera_from_body[:3, :3].T,
        np.array([lamp.intensity_cd for lamp in lamps]),
        sun.illuminance_lx,
    )


def _beam_axis(lamp: Lamp) -> Array:
    """Unit vector of a lamp's beam in the body: from straight down, tilted to the bow, panned to port."""
    tilt, pan = np.deg2rad([lamp.tilt_deg, lamp.pan_deg])
    return np.array([np.sin(tilt), np.cos(tilt) * np.sin(pan), -np.cos(tilt) * np.cos(pan)])


def beam_share(cos_angle: Array) -> Array:
    """Intensity off the axis of a lamp as a share of that on it."""
    return np.interp(np.rad2deg(np.arccos(np.clip(cos_angle, 0.0, 1.0))), BEAM_DEG, BEAM_SHARE)


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
    scattering, attenuation = water
    attenuation = water.attenuation_per_m
    points = ray[..., None, :] * range_m[..., None]
    # Daylight comes from above, along the optical axis, equally strong over the short way to the floor.
    phase = lights.daylight_lx * phase_function(-ray[..., 2])[..., None, None]
    total = phase * water.scattering_per_m * np.exp(-attenuation * range_m[..., None])
    for position, axis, intensity in zip(*lights[:3], strict=True):
        way = points - position
        distance = np.maximum(np.linalg.norm(way, axis=-1), LAMP_RADIUS_M)
        way /= distance[..., None]
        strength = intensity * beam_share(way @ axis) / distance**2
        strength *= phase_function(-np.einsum("...nk,...k->...n", way, ray))
        reach = np.exp(-attenuation * (distance + range_m)[..., None])
        total = total + strength[..., None] * water.scattering_per_m * reach
    return total


def _tables(rig: StereoRig, water: Medium, lights: Lights) -> _Tables:
    paths = np.arange(0.0, PATH_MAX_M, PATH_STEP_M)
    transmission = np.exp(-water.attenuation_per_m * paths[:, None])
    beam = beam_share(np.linspace(0.0, 1.0, 2049))
    return _Tables(*(t.astype(np.float32) for t in (beam, transmission, _veil_table(rig, water, lights))))


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


_FAST = {"contract", "arcp", "nsz", "reassoc"}  # infinities keep their meaning


@njit(cache=True, nogil=True, fastmath=_FAST, inline="always")
def _lookup(table, at):
    """Row of a table (n, 3) between its rows, the last beyond its end."""
    i = min(int(at), table.shape[0] - 2)
    w = min(at - np.float32(i), np.float32(1.0))
    red = table[i, 0] + w * (table[i + 1, 0] - table[i, 0])
    green = table[i, 1] + w * (table[i + 1, 1] - table[i, 1])
    return red, green, table[i, 2] + w * (table[i + 1, 2] - table[i, 2])


@njit(cache=True, nogil=True, fastmath=_FAST, inline="always")
def _normal(depth, v, u, x, y, focal):
    """Unit normal of the floor towards the eye, from the gradient of depth in the image.

    Of the slopes to both neighbours the smaller counts: an edge of the floor does not bend the surface beside it.
    """
    z, beyond = depth[v, u], np.float32(np.inf)
    left = z - depth[v, u - 1] if u > 0 else beyond
    right = depth[v, u + 1] - z if u + 1 < depth.shape[1] else beyond
    up = z - depth[v - 1, u] if v > 0 else beyond
    down = depth[v + 1, u] - z if v + 1 < depth.shape[0] else beyond
    nx = focal * (left if abs(left) < abs(right) else right)
    ny = focal * (up if abs(up) < abs(down) else down)
    nz = -(z + x * nx + y * ny)
    per_n = np.float32(1.0) / np.sqrt(nx * nx + ny * ny + nz * nz)
    return nx * per_n, ny * per_n, nz * per_n


@njit(cache=True, nogil=True, fastmath=_FAST, inline="always")
def _lamplight(lamp, beam, px, py, pz, normal):
    """Illuminance [lx] at a point by one lamp in clear water, and the distance between them [m]."""
    dx, dy, dz = px - lamp[0], py - lamp[1], pz - lamp[2]
    distance = np.sqrt(dx * dx + dy * dy + dz * dz)
    per_d = np.float32(1.0) / distance
    facing = -(dx * normal[0] + dy * normal[1] + dz * normal[2]) * per_d
    along = (dx * lamp[3] + dy * lamp[4] + dz * lamp[5]) * per_d
    if not (facing > 0 and along > 0):
        return np.float32(0.0), distance
    at = along * np.float32(beam.size - 1)
    i = min(int(at), beam.size - 2)
    share = beam[i] + (at - np.float32(i)) * (beam[i + 1] - beam[i])
    return lamp[6] * share * facing * per_d * per_d, distance


@njit(cache=True, nogil=True, fastmath=_FAST, inline="always")
def _blend_rows(veil, row, out):
    """The table of the veil for one row of pixels: between two rows of the grid."""
    j = min(int(row), veil.shape[0] - 2)
    w = row - np.float32(j)
    for i in range(veil.shape[1]):
        for r in range(veil.shape[2]):
            for c in range(3):
                out[i, r, c] = veil[j, i, r, c] + w * (veil[j + 1, i, r, c] - veil[j, i, r, c])


@njit(cache=True, nogil=True, fastmath=_FAST)
def _shade(albedo, depth, focal, lamps, daylight, beam, transmission, veil, out, lit, veil_out):
    """Fills `out` (H, W, 3) with radiance; the formulas are at the top of the module.

    Where `veil_out` is given, the veil goes there. What is None is compiled away: without shadows and layers nothing
    of either costs time.
    """
    one, half, per_step = np.float32(1.0), np.float32(0.5), np.float32(1 / PATH_STEP_M)
    height, width = depth.shape
    cols, ranges = veil.shape[1:3]
    veil_of_row = np.empty((cols, ranges, 3), np.float32)
    reflected = np.float32(1 / (255 * np.pi))
    for v in range(height):
        y = (np.float32(v) - half * np.float32(height - 1)) / focal
        if ranges:
            _blend_rows(veil, np.float32(v) * np.float32(veil.shape[0] - 1) / np.float32(height - 1), veil_of_row)
        for u in range(width):
            x = (np.float32(u) - half * np.float32(width - 1)) / focal
            z = depth[v, u]
            red = green = blue = np.float32(0.0)
            distance = np.float32(FAR_M)
            if z < distance:
                distance = z * np.sqrt(x * x + y * y + one)
                red, green, blue = _lookup(transmission, distance * per_step)
                red, green, blue = daylight * red, daylight * green, daylight * blue
                normal = _normal(depth, v, u, x, y, focal)
                for k in range(lamps.shape[0]):
                    if lit is not None:
                        if not lit[k, v, u]:
                            continue
                    e, way = _lamplight(lamps[k], beam, x * z, y * z, z, normal)
                    t = _lookup(transmission, (way + distance) * per_step)
                    red, green, blue = red + e * t[0], green + e * t[1], blue + e * t[2]
            red *= reflected * np.float32(albedo[v, u, 0])
            green *= reflected * np.float32(albedo[v, u, 1])
            blue *= reflected * np.float32(albedo[v, u, 2])
            if veil_out is not None:
                out[v, u, 0], out[v, u, 1], out[v, u, 2] = red, green, blue
                red = green = blue = np.float32(0.0)
            if ranges:
                at = np.float32(u) * np.float32(cols - 1) / np.float32(width - 1)
                i = min(int(at), cols - 2)
                w = at - np.float32(i)
                at = distance / (distance + np.float32(RANGE_SCALE_M)) * np.float32(ranges - 1)
                a, b = _lookup(veil_of_row[i], at), _lookup(veil_of_row[i + 1], at)
                red += a[0] + w * (b[0] - a[0])
                green += a[1] + w * (b[1] - a[1])
                blue += a[2] + w * (b[2] - a[2])
            if veil_out is not None:
                veil_out[v, u, 0], veil_out[v, u, 1], veil_out[v, u, 2] = red, green, blue
            else:
                out[v, u, 0], out[v, u, 1], out[v, u, 2] = red, green, blue
