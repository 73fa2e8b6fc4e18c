"""Monte Carlo estimate of the radiance of one pixel in one colour band, by component, with standard errors."""

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from typing import NamedTuple, TypeVar

import numpy as np

from twin.core.height_field import HeightField
from twin.core.records import Array, StereoRig
from twin.errors import TwinError
from twin.imaging.light.lamp_light import LAMP_RADIUS_M
from twin.imaging.light.lamps import LightSources, beam_share
from twin.imaging.light.phase_function import BandWater, PhaseTable, table_of
from twin.imaging.reference import walk
from twin.imaging.reference.floor_crossings import LEVEL

BEAM_STEPS = 3600  # steps of 0.025 deg
BIN_EDGES_PX = (0.0, 0.5, 1.0, 2.0, 4.0, 8.0, 16.0, 40.0, 80.0, 160.0)


@dataclass(frozen=True)
class Sunlight:
    """Light of sun and sky that enters the water, just below the surface."""

    to_sun: tuple[float, float, float] = (0.0, 0.0, 1.0)  # (3,) unit direction to the sun under water, in world axes
    normal_lx: float = 0.0  # illuminance just below the surface by the sun, on a plane that faces it [lx]
    surface_m: float = np.inf  # height of the surface, z in world axes; light that rises above it is lost
    radius_rad: float = 0.0  # angular radius of the sun's disc under water; 0: parallel light
    # (n,) radiance of the sky below the surface, at even steps of the zenith angle's cosine from 0 to 1; empty: none
    sky_cd_m2: tuple[float, ...] | Array = ()


@dataclass(frozen=True)
class ReferenceScene:
    """Water, light and floor of a reference computation for one colour band."""

    water: BandWater  # optical properties of the water
    lamps: Array  # (n, 7) position [m], unit beam axis, both in world axes with z up, and intensity [cd]
    beams: Sequence[Array]  # for each lamp, (m, 2) angle from the axis [deg] and relative intensity
    albedo: float = 0.5  # albedo of the Lambertian floor
    relief: HeightField = LEVEL  # the floor; beyond its grid there is none
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
    # pairs of random walks, from the floor and from the water, a multiple of `batches`; of a plane, single walks
    walks: int = 100_000
    batches: int = 32  # number of batches; the standard errors are computed from the scatter of their means
    seed: int | tuple[int, ...] = 1  # seed of the random numbers, one number or several; equal seeds give equal results
    # the textbook estimator, with direct connections to the lamps and without guided directions: the same mean and a
    # much larger variance; it serves to check the default estimator
    plain: bool = False


class BatchMean(NamedTuple):
    value: float
    standard_error: float


@dataclass(frozen=True)
class PixelLight:
    """Light that reaches a pixel, by component [cd/m2]."""

    sums: Array  # (batches, FIRST_BIN + 2 n) mean light of each batch, in the order of `sums` of `walk.walk`
    # (n,) lower edges of the bins of blurred light: distances in the image of the floor point from which it came
    bin_edges_px: Array

    @property
    def total(self) -> BatchMean:
        return batch_mean(self.sums.sum(1))

    @property
    def direct(self) -> BatchMean:
        """Light that was reflected by the floor once and not scattered."""
        return batch_mean(self.sums[:, walk.DIRECT])

    @property
    def veil(self) -> BatchMean:
        """Light that was scattered into the camera without reflection by the floor."""
        return batch_mean(self.sums[:, walk.VEIL_ONCE] + self.sums[:, walk.VEIL_MORE])

    @property
    def veil_once(self) -> BatchMean:
        """Light that was scattered once and not reflected by the floor."""
        return batch_mean(self.sums[:, walk.VEIL_ONCE])

    @property
    def sharp_share(self) -> BatchMean:
        """Fraction of the total light that comes from the floor and was not scattered between floor and camera."""
        return ratio(self.sums[:, walk.DIRECT] + self.sums[:, walk.LAMP_SCATTERED], self.sums.sum(1))

    @property
    def blurred_by_bin(self) -> Array:
        """Blurred light (batches, 2, bins) [cd/m2]: 0 that reached the floor straight, 1 all other."""
        return self.sums[:, walk.FIRST_BIN :].reshape(len(self.sums), 2, -1)

    def blurred_share(self, from_px: float, to_px: float = np.inf) -> BatchMean:
        """Returns the share of the blurred light between two edges of bins; NaN if there is no blurred light."""
        edges = self.bin_edges_px
        if from_px not in edges or (to_px not in edges and np.isfinite(to_px)):
            raise ValueError(f"{from_px:g}, {to_px:g}: not among the edges {edges.tolist()}")
        light = self.blurred_by_bin.sum(1)
        return ratio(light[:, (edges >= from_px) & (edges < to_px)].sum(1), light.sum(1))


@dataclass(frozen=True)
class PlaneLight:
    """Illuminance of a plane by daylight and lamps, without direct light of lamps: means of the batches [lx]."""

    sums: Array  # (batches, 3) direct light of the sun, direct light of the sky, light that was scattered or reflected

    @property
    def total(self) -> BatchMean:
        return batch_mean(self.sums.sum(1))


class KernelScene(NamedTuple):
    """A `ReferenceScene` and `Effort.plain` for the kernels, without lamps of zero intensity."""

    absorption: float
    scattering: float
    albedo: float
    relief: HeightField
    phase: PhaseTable
    lamps: Array
    beams: Array
    lamp_radius_m: float
    to_sun: Array
    sun_lx: float
    surface_m: float
    sun_cosine: float
    sky: Array
    plain: bool


def pixel_light(
    scene: ReferenceScene, ray: PixelRay, effort: Effort, bin_edges_px: Sequence[float] = BIN_EDGES_PX
) -> PixelLight:
    """Returns the light that reaches a pixel. Raises TwinError for less than two batches, or one walk in each."""
    n_walks, rngs = _batches(effort)
    kernel, view, edges = _kernel_scene(scene, effort.plain), _view(ray), np.array(bin_edges_px, np.float64)
    return PixelLight(_in_threads(lambda rng: walk.trace_pixel(kernel, view, edges, n_walks, rng), rngs), edges)


def plane_light(scene: ReferenceScene, point_m: Array, normal: Array, effort: Effort) -> PlaneLight:
    """Returns the illuminance of a plane that does not disturb the light, on the side of its normal."""
    n_walks, rngs = _batches(effort)
    kernel, point, facing = _kernel_scene(scene, effort.plain), tuple(map(float, point_m)), tuple(map(float, normal))
    return PlaneLight(_in_threads(lambda rng: walk.trace_plane(kernel, point, facing, n_walks, rng), rngs))


Light = TypeVar("Light", PixelLight, PlaneLight)


def refined(
    light_of: Callable[[Effort], Light], enough: Callable[[Light], bool], effort: Effort, most_walks: int
) -> Light:
    """Returns the light of rounds of different seeds until `enough`, with at most `most_walks`; at least one runs."""
    light, rounds = light_of(effort), 1
    while (rounds + 1) * effort.walks <= most_walks and not enough(light):
        seed = effort.seed if isinstance(effort.seed, tuple) else (effort.seed,)
        more = light_of(replace(effort, seed=(*seed, rounds)))
        light, rounds = replace(light, sums=np.concatenate([light.sums, more.sums])), rounds + 1
    return light


def _in_threads(trace: Callable[[np.random.Generator], Array], rngs: Sequence[np.random.Generator]) -> Array:
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
    """Returns the ratio of two means over batches (n,), NaN for 0, and its standard error by the delta method."""
    if whole.mean() == 0:
        return BatchMean(np.nan, np.nan)
    value = part.mean() / whole.mean()
    return BatchMean(float(value), batch_mean((part - value * whole) / whole.mean()).standard_error)


def batch_mean(batches: Array) -> BatchMean:
    return BatchMean(float(batches.mean()), float(batches.std(ddof=1) / np.sqrt(len(batches))))


def _kernel_scene(scene: ReferenceScene, plain: bool) -> KernelScene:
    angles = np.linspace(0.0, 90.0, BEAM_STEPS + 1)
    beams = np.array([beam_share(np.cos(np.deg2rad(angles)), beam) for beam in scene.beams])
    lamps = np.ascontiguousarray(np.reshape(scene.lamps, (-1, 7)), np.float64)
    lit = lamps[:, 6] > 0
    sun = scene.sun
    return KernelScene(
        float(scene.water.absorption_per_m), float(scene.water.scattering_per_m), float(scene.albedo), scene.relief,
        table_of(scene.water.scatterer),
        np.ascontiguousarray(lamps[lit]), np.ascontiguousarray(beams.reshape(-1, BEAM_STEPS + 1)[lit]),
        float(scene.lamp_radius_m), np.array(sun.to_sun, np.float64), float(sun.normal_lx), float(sun.surface_m),
        float(np.cos(sun.radius_rad)), np.array(sun.sky_cd_m2, np.float64), plain,
    )  # fmt: skip


def _view(ray: PixelRay) -> Array:
    pose, rig = ray.world_from_camera, ray.rig
    pixel = ray.pixel[0] - rig.cx_px, ray.pixel[1] - rig.cy_px, rig.focal_px
    return np.ascontiguousarray(np.vstack([pose[:3, :3].T, pose[:3, 3], pixel]))
