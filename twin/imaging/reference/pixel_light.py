"""Monte Carlo estimate of the radiance of one pixel in one colour band, by component, with standard errors."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from twin.core.height_field import HeightField, height_field
from twin.core.records import StereoRig
from twin.errors import TwinError
from twin.imaging.light.lamp_light import LAMP_RADIUS_M
from twin.imaging.light.lamps import LightSources, beam_share
from twin.imaging.light.phase_function import PhaseFunction, petzold, tabulate
from twin.imaging.reference.walk import (
    DIRECT,
    FIRST_BIN,
    LAMP_SCATTERED,
    VEIL_MORE,
    VEIL_ONCE,
    trace_pixel,
    trace_plane,
)

Array = NDArray[np.float64]

BEAM_STEPS = 3600  # steps of 0.025 deg
BIN_EDGES_PX = (0.0, 0.5, 1.0, 2.0, 4.0, 8.0, 16.0, 40.0, 80.0, 160.0)
NO_FLOOR = height_field(np.zeros((2, 2)), 1.0, 0.0, 0.0)  # not used by the kernels: the floor is a plane


@dataclass(frozen=True)
class BandWater:
    """Optical properties of the water in one colour band."""

    absorption_per_m: float  # absorption coefficient a [1/m]
    scattering_per_m: float  # scattering coefficient b [1/m]
    phase: PhaseFunction = petzold  # phase function


@dataclass(frozen=True)
class Sunlight:
    """Light of sun and sky that enters the water, just below the surface."""

    to_sun: tuple[float, float, float] = (0.0, 0.0, 1.0)  # (3,) unit direction to the sun under water, in world axes
    normal_lx: float = 0.0  # illuminance just below the surface by the sun, on a plane that faces it [lx]
    surface_m: float = np.inf  # height of the surface, z in world axes; light that rises above it is lost
    # angular radius of the sun's disc under water, which matters for phase functions with a sharp peak; 0: parallel
    # light
    radius_rad: float = 0.0
    # (n,) radiance of the sky just below the surface, at even steps of the cosine of the zenith angle from 0 to 1, n of
    # 2 or more; empty: no light of the sky
    sky_cd_m2: tuple[float, ...] | Array = ()


@dataclass(frozen=True)
class ReferenceScene:
    """Water, light and floor of a reference computation for one colour band."""

    water: BandWater  # optical properties of the water
    # (n, 7) position [m], unit beam axis, both in world axes with z up, and intensity [cd], by which the relative
    # intensities of `beams` are multiplied
    lamps: Array
    beams: Sequence[Array]  # for each lamp, (m, 2) angle from the axis [deg] and relative intensity
    albedo: float = 0.5  # albedo of the Lambertian floor
    relief: HeightField | None = None  # the floor; None = the plane z = 0
    sun: Sunlight = field(default_factory=Sunlight)  # sunlight and light of the sky; by default none, and no surface
    # points within this distance of a lamp neither reflect nor scatter its unscattered light
    lamp_radius_m: float = LAMP_RADIUS_M


class PixelRay(NamedTuple):
    """A pixel of a camera: pose world_from_camera (4, 4), calibration of the camera, and (column, row) [px]."""

    world_from_camera: Array
    rig: StereoRig
    pixel: tuple[float, float]


@dataclass(frozen=True)
class Effort:
    """Size of a Monte Carlo computation."""

    # number of pairs of random walks, rounded down to a multiple of `batches`; one walk of each pair starts on the
    # floor, the other in the water. In `plane_light`, it is the number of single walks.
    walks: int = 100_000
    batches: int = 32  # number of batches; the standard errors are computed from the scatter of their means
    seed: int | tuple[int, ...] = 1  # seed of the random numbers, one number or several; equal seeds give equal results
    # use the textbook estimator, which connects every vertex directly to the lamps and samples directions only from the
    # phase function (in the water) or Lambert's cosine (on the floor). It has the same mean and a much larger variance;
    # it serves to check the default estimator.
    plain: bool = False


class BatchMean(NamedTuple):
    """A mean and its standard error."""

    value: float
    standard_error: float


@dataclass(frozen=True)
class PixelLight:
    """Light that reaches a pixel, by component [cd/m2]."""

    sums: Array  # (batches, FIRST_BIN + 2 n) mean light of each batch, in the order of `sums` of `walk.walk`
    # (n,) lower edges of the bins of blurred light, which are bins of the distance in the image between the pixel and
    # the projection of the floor point from which the light came
    bin_edges_px: Array

    @property
    def total(self) -> BatchMean:
        """Total radiance."""
        return _estimate(self.sums.sum(1))

    @property
    def direct(self) -> BatchMean:
        """Light that was reflected by the floor once and not scattered."""
        return _estimate(self.sums[:, DIRECT])

    @property
    def lamp_scattered(self) -> BatchMean:
        """Light that was scattered or reflected before it reached the floor in the pixel, but not scattered afterwards.

        It includes scattered light of sun and sky.
        """
        return _estimate(self.sums[:, LAMP_SCATTERED])

    @property
    def sharp(self) -> BatchMean:
        """Light of the floor that was not scattered between floor and camera."""
        return _estimate(self._sharp)

    @property
    def blurred(self) -> BatchMean:
        """Light of the floor that was scattered between floor and camera."""
        return _estimate(self.blurred_by_bin.sum((1, 2)))

    @property
    def veil(self) -> BatchMean:
        """Light that was scattered into the camera without reflection by the floor."""
        return _estimate(self.sums[:, VEIL_ONCE] + self.sums[:, VEIL_MORE])

    @property
    def veil_once(self) -> BatchMean:
        """Light that was scattered once and not reflected by the floor."""
        return _estimate(self.sums[:, VEIL_ONCE])

    @property
    def sharp_share(self) -> BatchMean:
        """Fraction of the total light that comes from the floor and was not scattered between floor and camera."""
        return ratio(self._sharp, self.sums.sum(1))

    @property
    def blurred_by_bin(self) -> Array:
        """Blurred light (batches, 2, n) [cd/m2] in n bins.

        Index 0 of the second axis is light that reached the floor without scattering or reflection, index 1 all other.
        """
        return self.sums[:, FIRST_BIN:].reshape(len(self.sums), 2, -1)

    def blurred_share(self, from_px: float, to_px: float = np.inf) -> BatchMean:
        """Returns the share of the blurred light in the bins between two edges; NaN if there is no blurred light.

        Raises:
            ValueError: `from_px` or a finite `to_px` is not an edge.
        """
        edges = self.bin_edges_px
        if from_px not in edges or (to_px not in edges and np.isfinite(to_px)):
            raise ValueError(f"{from_px:g}, {to_px:g}: not among the edges {edges.tolist()}")
        light = self.blurred_by_bin.sum(1)
        return ratio(light[:, (edges >= from_px) & (edges < to_px)].sum(1), light.sum(1))

    @property
    def _sharp(self) -> Array:
        return self.sums[:, DIRECT] + self.sums[:, LAMP_SCATTERED]


@dataclass(frozen=True)
class PlaneLight:
    """Illuminance of a plane by daylight and by light of lamps: means of the batches [lx].

    Light that arrives from a lamp without scattering or reflection is not included.
    """

    sums: Array  # (batches, 3) direct light of the sun, direct light of the sky, light that was scattered or reflected

    @property
    def total(self) -> BatchMean:
        """Total illuminance by sun, sky, and light that was scattered or reflected."""
        return _estimate(self.sums.sum(1))

    @property
    def sun(self) -> BatchMean:
        """Illuminance by direct light of the sun."""
        return _estimate(self.sums[:, 0])

    @property
    def sky(self) -> BatchMean:
        """Illuminance by direct light of the sky."""
        return _estimate(self.sums[:, 1])


class KernelScene(NamedTuple):
    """A `ReferenceScene` and `Effort.plain` in the form of the compiled kernels, without lamps of zero intensity.

    `density_per_sr` to `beyond` are fields and properties of `PhaseTable`, `beams` (n, BEAM_STEPS + 1) has the relative
    intensities of the lamps from 0 to 90 deg, and `sun_cosine` is the cosine of the angular radius of the sun's disc.
    """

    absorption: float
    scattering: float
    albedo: float
    density_per_sr: Array
    cumulative: Array
    cumulative_angle: Array
    angle_integral: float
    beyond: Array
    lamps: Array
    beams: Array
    lamp_radius_m: float
    to_sun: Array
    sun_lx: float
    surface_m: float
    sun_cosine: float
    sky: Array
    is_plane: bool
    field: HeightField
    plain: bool


def pixel_light(
    scene: ReferenceScene, ray: PixelRay, effort: Effort, bin_edges_px: Sequence[float] = BIN_EDGES_PX
) -> PixelLight:
    """Returns the light that reaches a pixel, in components; `bin_edges_px` see `PixelLight`, the last bin is open.

    Raises:
        TwinError: there are fewer than two batches or fewer walks than batches.
    """
    n_walks, rngs = _batches(effort)
    kernel, view, edges = _kernel_scene(scene, effort.plain), _view(ray), np.array(bin_edges_px, np.float64)
    return PixelLight(_in_threads(lambda rng: trace_pixel(kernel, view, edges, n_walks, rng), rngs), edges)


def plane_light(scene: ReferenceScene, point_m: Array, normal: Array, effort: Effort) -> PlaneLight:
    """Returns the illuminance of a plane that does not disturb the light, on the side of its normal (3,).

    Raises:
        TwinError: there are fewer than two batches or fewer walks than batches.
    """
    n_walks, rngs = _batches(effort)
    kernel, point, facing = _kernel_scene(scene, effort.plain), tuple(map(float, point_m)), tuple(map(float, normal))
    return PlaneLight(_in_threads(lambda rng: trace_plane(kernel, point, facing, n_walks, rng), rngs))


Light = TypeVar("Light", PixelLight, PlaneLight)


def refined(
    light_of: Callable[[Effort], Light], enough: Callable[[Light], bool], effort: Effort, most_walks: int
) -> Light:
    """Returns the light of as many rounds as `enough` asks for, at most `most_walks` in all; the first always runs.

    The rounds differ by their seeds; the result has the batches of all.
    """
    light, rounds = light_of(effort), 1
    while (rounds + 1) * effort.walks <= most_walks and not enough(light):
        seed = effort.seed if isinstance(effort.seed, tuple) else (effort.seed,)
        more = light_of(replace(effort, seed=(*seed, rounds)))
        light, rounds = replace(light, sums=np.concatenate([light.sums, more.sums])), rounds + 1
    return light


def _in_threads(trace: Callable[[np.random.Generator], Array], rngs: Sequence[np.random.Generator]) -> Array:
    """Returns the results of a compiled kernel for each random stream, computed in parallel threads."""
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        return np.array(list(pool.map(trace, rngs)))


def _batches(effort: Effort) -> tuple[int, list[np.random.Generator]]:
    """Returns the number of walks (or pairs of walks) of a batch, and the random stream of each batch."""
    if effort.batches < 2 or effort.walks < effort.batches:
        raise TwinError("effort.batches", f"{effort.batches} for {effort.walks} walks", "2 or more, one walk in each")
    rngs = [np.random.default_rng(s) for s in np.random.SeedSequence(effort.seed).spawn(effort.batches)]
    return effort.walks // effort.batches, rngs


def lamps_in_world(sources: LightSources, world_from_camera: Array, band: int) -> Array:
    """Returns the lamps (n, 7) of a `ReferenceScene` for a band (0 red, 1 green, 2 blue), from those of a camera."""
    rotation, origin = world_from_camera[:3, :3], world_from_camera[:3, 3]
    light_cd = sources.intensity_cd * sources.colour[:, band]
    return np.column_stack([sources.position_m @ rotation.T + origin, sources.axis @ rotation.T, light_cd])


def ratio(part: Array, whole: Array) -> BatchMean:
    """Returns the ratio of two means over batches, given the batches (n,) of both; NaN if the mean of `whole` is 0.

    Its standard error is that of the linearised ratio (delta method).
    """
    if whole.mean() == 0:
        return BatchMean(np.nan, np.nan)
    value = part.mean() / whole.mean()
    return BatchMean(float(value), _estimate((part - value * whole) / whole.mean()).standard_error)


def _estimate(batches: Array) -> BatchMean:
    return BatchMean(float(batches.mean()), float(batches.std(ddof=1) / np.sqrt(len(batches))))


def _kernel_scene(scene: ReferenceScene, plain: bool) -> KernelScene:
    table = tabulate(scene.water.phase)
    angles = np.linspace(0.0, 90.0, BEAM_STEPS + 1)
    beams = np.array([beam_share(np.cos(np.deg2rad(angles)), beam) for beam in scene.beams])
    lamps = np.ascontiguousarray(np.reshape(scene.lamps, (-1, 7)), np.float64)
    lit = lamps[:, 6] > 0
    sun, floor = scene.sun, scene.relief
    return KernelScene(
        float(scene.water.absorption_per_m), float(scene.water.scattering_per_m), float(scene.albedo),
        table.density_per_sr, table.cumulative, table.cumulative_angle, table.angle_integral, table.beyond,
        np.ascontiguousarray(lamps[lit]), np.ascontiguousarray(beams.reshape(-1, BEAM_STEPS + 1)[lit]),
        float(scene.lamp_radius_m), np.array(sun.to_sun, np.float64), float(sun.normal_lx), float(sun.surface_m),
        float(np.cos(sun.radius_rad)), np.array(sun.sky_cd_m2, np.float64),
        floor is None, NO_FLOOR if floor is None else floor, plain,
    )  # fmt: skip


def _view(ray: PixelRay) -> Array:
    """Returns the camera and the pixel as the argument `view` (5, 3) of `walk.bin_of`."""
    pose, rig = ray.world_from_camera, ray.rig
    pixel = ray.pixel[0] - rig.cx_px, ray.pixel[1] - rig.cy_px, rig.focal_px
    return np.ascontiguousarray(np.vstack([pose[:3, :3].T, pose[:3, 3], pixel]))
