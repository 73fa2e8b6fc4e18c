"""Image formation in water: light of the floor and backscatter of lamps and daylight.

Radiance of a pixel that shows a floor of albedo rho at range r, for a camera and lamps on the same vehicle (Jaffe 1990,
McGlamery 1979, in the form of Song et al. 2021, doi 10.1007/978-3-030-68790-8_29):

    L = rho/pi * (sum_i I_i(theta_i)/d_i^2 * max(cos, 0) * exp(-c d_i) + E_day) * exp(-c r)  +  B(r)
    B(r) = sum_i integral_0^r b p(psi_i) I_i(theta_i)/d_i^2 * exp(-c d_i) exp(-c s) ds  +  B_day(r)

with I_i the intensity of lamp i at the angle theta_i from its axis, d_i its distance, cos the cosine of incidence,
psi_i the scattering angle at the distance s from the camera, E_day and B_day illuminance and backscatter of daylight
(`daylight`), and a, b, c, p of `water.Medium`. With multiple scattering, scattered light arrives too: as a softer beam
(`lamp_light`), a blur of the floor (`forward_scatter`) and blurred backscatter (`backscatter`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache
from typing import NamedTuple, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from twin.core.records import Image, StereoRig
from twin.core.threads import in_row_bands
from twin.imaging.light.backscatter import backscatter_table, grid_of, grid_rays, table_range_m
from twin.imaging.light.daylight import DaylightVeil, Sky, floor_daylight, world_axes
from twin.imaging.light.forward_scatter import ForwardScatter, Place
from twin.imaging.light.illumination import Illumination
from twin.imaging.light.lamp_light import LampLight, floor_tables, with_a_zero
from twin.imaging.light.lamps import LightSources, beam_share, light_sources_in_camera
from twin.imaging.light.shading import shade
from twin.imaging.light.water import Medium
from twin.imaging.scene.facets import FacetView
from twin.imaging.scene.materials import Material
from twin.imaging.scene.mesh_raster import ObjectView
from twin.scenario.model import LampConfig

Array = NDArray[np.float64]
Radiance = NDArray[np.float32]
Depth = NDArray[np.float32]
Lit = NDArray[np.uint8]
Value = TypeVar("Value")

LEAST_TRANSMISSION = 1e-25  # at a smaller transmission, single precision does not represent the light of the floor
ALBEDO_STEP_PX = 16  # spacing of the pixels whose mean albedo is that of the floor around the image
#: Arguments of `shading.shade` for effects that an image does not have.
_NO_BACKSCATTER, _NO_SOFT_LAMPS = np.zeros((0, 0, 0, 4), np.float32), np.zeros((0, 2, 0, 0, 4), np.float32)
_NO_FACETS = FacetView(
    np.zeros((0, 0, 2), np.int32), np.zeros(2, np.int32), np.zeros((2, 4), np.float32), np.zeros((3, 3), np.float32)
)
_NO_SHADOWS = np.zeros((0, 0, 0), np.uint8)
_NO_OBJECTS = ObjectView(np.zeros((0, 0, 3), np.float32), np.zeros((0, 0), np.uint16))
BEAM_STEPS = 2048  # number of steps of sqrt(1 - cos(angle)) from 0 to 1, which are nearly even in the angle


class WaterSurface(NamedTuple):
    """The water surface above a camera: its caustics, and its position relative to the camera."""

    # (n + 1, n + 1) daylight relative to its mean, n a power of two; the last row and column repeat the first row and
    # column. None if daylight is uniform.
    caustics: NDArray[np.float32] | None
    # (3, 4) map from a point in the camera axes to column and row in `caustics`, which grow towards east and north, and
    # depth below the surface [m]
    from_camera: Array


def calm_surface(world_from_camera: Array, reference_depth_m: float) -> WaterSurface:
    """Returns the water surface above a camera without caustics, in metres east and north; see `WaterSurface`."""
    east, north, up = world_from_camera[:3]
    from_camera = np.array([east, north, -up])
    from_camera[2, 3] += reference_depth_m
    return WaterSurface(None, from_camera)


class FloorView(NamedTuple):
    """Properties of the floor that the shading of a camera needs besides its depth."""

    facets: FacetView | None = None  # triangles of the floor; None = the normals are computed from the depth
    # (lamps, H, W) uint8, 0 where floor or objects block the light of the lamp, else 1; the last one is for the sun if
    # it casts shadows; None = no shadows
    lit: Lit | None = None
    material: Material | None = None  # reflection of the unscattered light of lamps; None = Lambertian
    objects: ObjectView | None = None  # normals of the pixels that show objects; None = the image shows the floor alone


class LightParts(NamedTuple):
    """Parts of the light that reaches a camera, per band in photometric units [cd/m2]; (H, W, 3) float32 each."""

    direct: Radiance  # light of the floor that was not scattered between floor and camera
    # light of the floor that was scattered between floor and camera; None without multiple scattering
    forward: Radiance | None
    backscatter: Radiance  # light that the water scattered into the camera without reflection by the floor


class WhiteFloor(NamedTuple):
    """Light of an image of a white floor, from which the light of a floor of any albedo follows."""

    # (H, W, 3) light of the white floor at the camera [cd/m2]. With multiple scattering, the path to the camera
    # attenuates it by absorption alone; otherwise by absorption and scattering.
    floor: Radiance
    backscatter: Radiance  # (H, W, 3) light that the water scatters into the camera [cd/m2]
    unscattered: Array  # (H, W, 3) share of `floor` that is not scattered; ones (3,) without multiple scattering
    # (H, W, 3) share of `floor` that is scattered, but not blurred by more than a pixel; zeros (3,) without multiple
    # scattering
    core: Array
    # returns the scattered light (H, W, 3) of the floor, given its light (H, W, 3) attenuated by absorption alone, and
    # its albedo (H, W, 3), 1 = white; the floor around the image has the mean of this albedo. None without multiple
    # scattering.
    spread: Callable[[Radiance, Radiance], Radiance] | None


class _Tables(NamedTuple):
    """Lookup tables of the shading kernel (`shading.shade`) for one camera."""

    # (lamps, n) intensity relative to `intensity_cd`, at equal steps of sqrt(1 - cos(angle)) in [0, 1]
    beams: NDArray[np.float32]
    # (lamps, 2, n, m, 4) light of each lamp on the floor, see `lamp_light.floor_tables`; empty without multiple
    # scattering or without lamps
    soft: NDArray[np.float32]
    # (rows, cols, ranges, 4) radiance on a coarse pixel grid, at equal steps of r / (r + `RANGE_SCALE_M`), with r the
    # range; R, G, B and a zero
    backscatter: NDArray[np.float32]


class _Output(NamedTuple):
    """Arrays that the shading kernel fills, and `kept`: the arguments of `shading.shade` with the same names."""

    out: Radiance
    other: Radiance = np.zeros((0, 0, 3), np.float32)
    kept: NDArray[np.float32] = np.zeros((0, 4), np.float32)
    place: Place = np.zeros((0, 0), np.float32)


class Optics:
    """Model of the light that reaches each camera, for R, G, B.

    Attributes:
        light_sources: lamps and daylight in the axes of the left and of the right camera.
        lamp_light: light of the lamps in the water, in the axes of the left and of the right camera.
    """

    def __init__(self, rig: StereoRig, illumination: Illumination, lamps: Sequence[LampConfig]):
        self._rig, self._medium = rig, illumination.water
        daylight = illumination.daylight
        self.light_sources = [light_sources_in_camera(rig, lamps, daylight, camera) for camera in (0, 1)]
        self.lamp_light = [LampLight(sources, self._medium) for sources in self.light_sources]
        scatters = self._medium.scatters_repeatedly
        sunny = scatters and bool(daylight.surface_lx.any())
        # computed on demand, as some callers need one camera, or the light of the floor only
        self._veil = cache(lambda: DaylightVeil(daylight, table_range_m()) if sunny else None)
        self._tables_of = cache(lambda camera: _tables(rig, self._medium, self.lamp_light[camera]))
        self._forward = ForwardScatter(rig, self._medium) if scatters else None
        # working memory of each camera, as both images may be computed at the same time
        light_shape, half_shape = (rig.height_px, rig.width_px, 3), ((rig.height_px + 1) // 2, (rig.width_px + 1) // 2)
        self._memory = cache(lambda camera: (np.empty(light_shape, np.float32), np.empty(half_shape, np.float32)))
        self._lamp_loss_per_m = self._medium.attenuation_per_m.astype(np.float32)
        loss_per_m = np.stack([self._medium.camera_loss_per_m, daylight.camera_loss_per_m])
        self._sky = Sky(floor_daylight(daylight), loss_per_m)
        self._lamps = [_lamp_rows(sources) for sources in self.light_sources]
        self._grid_rays = [grid_rays(rig, grid_of(sources.beam)) for sources in self.light_sources]
        level = np.array([[1.0, 0, 0, 0], [0, -1, 0, 0], [0, 0, 1, daylight.camera_depth_m]])
        self._calm_surface = WaterSurface(None, level)

    def radiance(
        self,
        albedo: Image,
        depth: Depth,
        camera: int,
        floor: FloorView | None = None,
        surface: WaterSurface | None = None,
    ) -> Radiance:
        """Returns the light (H, W, 3) float32 that reaches a camera, per colour band in photometric units [cd/m2].

        Args:
            albedo: (H, W, 3) uint8 albedo of the floor, 255 = white.
            depth: (H, W) float32 depth along the optical axis [m]; inf where there is no floor (backscatter only).
            camera: 0 left, 1 right.
            floor: None = normals from the depth, no shadows, Lambertian, no objects.
            surface: None = a calm surface above a camera that points straight down at the planned altitude, east on its
                right.
        """
        out = np.empty(albedo.shape, np.float32)
        if self._forward is None:
            self._run((albedo, depth), camera, floor, surface, _Output(out))
        else:
            light, place = self._memory(camera)
            self._run((albedo, depth), camera, floor, surface, _Output(light, out, self._forward.kept, place))
            self._forward.add(light, place, self.around(albedo, depth, camera, surface), out)
        return out

    def parts(
        self,
        albedo: Image,
        depth: Depth,
        camera: int,
        floor: FloorView | None = None,
        surface: WaterSurface | None = None,
    ) -> LightParts:
        """Returns the parts of the light that reaches a camera; their sum is `radiance`, with the same arguments."""
        light, backscatter = self._floor_and_backscatter(albedo, depth, camera, floor, surface)
        if self._forward is None:
            return LightParts(light, None, backscatter)
        range_m = range_of(depth, self._rig)
        unscattered = np.exp(-self._medium.scattering_per_m * range_m[..., None])
        forward = self._forward.spread(light, range_m, self.around(albedo, depth, camera, surface))
        return LightParts((light * unscattered).astype(np.float32), forward, backscatter)

    def floor_lx(
        self, depth: Depth, camera: int, floor: FloorView | None = None, surface: WaterSurface | None = None
    ) -> Radiance:
        """Returns the illuminance of the floor (H, W, 3) [lx]; the arguments are those of `radiance`.

        It is NaN without floor, and where the transmission to the camera is `LEAST_TRANSMISSION` or less.
        """
        matt = None if floor is None else floor._replace(material=None)
        white, shape = np.full((*depth.shape, 3), 255, np.uint8), (*depth.shape, 3)
        light, loss = np.empty(shape, np.float32), self._medium.camera_loss_per_m
        other, focal_px = np.empty(shape, np.float32), self._rig.focal_px  # with a focal length: without backscatter
        self._run((white, depth), camera, matt, surface, _Output(light, other), focal_px, loss)
        with np.errstate(divide="ignore", invalid="ignore"):
            back = np.exp(-loss * range_of(depth, self._rig)[..., None])
            return np.where(back > LEAST_TRANSMISSION, np.pi * light / back, np.nan).astype(np.float32)

    def white_floor(
        self, depth: Depth, camera: int, floor: FloorView | None = None, surface: WaterSurface | None = None
    ) -> WhiteFloor:
        """Returns the light of an image of a white floor; the arguments are those of `radiance`."""
        white = np.full((*depth.shape, 3), 255, np.uint8)
        light, backscatter = self._floor_and_backscatter(white, depth, camera, floor, surface)
        forward, range_m = self._forward, range_of(depth, self._rig)
        if forward is None:
            return WhiteFloor(light, backscatter, np.ones(3), np.zeros(3), None)
        around, place = self.around(white, depth, camera, surface)

        def spread(floor_light: Radiance, albedo: Radiance) -> Radiance:
            mean = np.mean(albedo, axis=(0, 1)).astype(np.float32)
            return forward.spread(floor_light, range_m, (around * mean, place.copy()))

        unscattered = np.exp(-self._medium.scattering_per_m * range_m[..., None])
        return WhiteFloor(light, backscatter, unscattered, forward.core(range_m), spread)

    def around(
        self, albedo: Image, depth: Depth, camera: int, surface: WaterSurface | None = None
    ) -> tuple[Radiance, Place]:
        """Returns the argument `around` of `ForwardScatter.add`, which describes the floor around the image.

        The other arguments are those of `radiance`. With single scattering, there is no such argument.
        """
        assert self._forward is not None
        grid, (plane, place) = self._forward.surroundings, self._forward.plane(depth)
        light, uniform = np.empty((*grid.shape, 3), np.float32), np.empty((*grid.shape, 3), np.uint8)
        some = np.ascontiguousarray(albedo[::ALBEDO_STEP_PX, ::ALBEDO_STEP_PX])
        mean = np.round(cv2.mean(some)[:3]).astype(np.uint8)
        uniform.reshape(len(uniform), -1)[:] = np.tile(mean, grid.shape[1])
        self._run((uniform, plane), camera, None, surface, _Output(light, np.empty_like(light)), grid.focal_px)
        return light, place

    def _floor_and_backscatter(
        self, albedo: Image, depth: Depth, camera: int, floor: FloorView | None, surface: WaterSurface | None
    ) -> tuple[Radiance, Radiance]:
        """Returns the light of the floor at the camera and the backscatter [cd/m2]."""
        light, backscatter = np.empty(albedo.shape, np.float32), np.empty(albedo.shape, np.float32)
        self._run((albedo, depth), camera, floor, surface, _Output(light, backscatter))
        return light, backscatter

    def _run(
        self,
        image: tuple[Image, Depth],
        camera: int,
        floor: FloorView | None,
        surface: WaterSurface | None,
        out: _Output,
        focal_px: float | None = None,
        day_loss_per_m: Array | None = None,
    ) -> None:
        """Fills `out` by `shading.shade`."""
        albedo, depth = image
        focal = np.float32(focal_px or self._rig.focal_px)
        above = self._calm_surface if surface is None else surface
        sky = self._sky.in_camera(above.from_camera, above.caustics, day_loss_per_m)
        lamps, tables = self._lamps[camera], self._tables_of(camera)
        backscatter = _NO_BACKSCATTER if focal_px else self._backscatter(camera, above)
        seen = FloorView() if floor is None else floor
        light = lamps, tables.beams, tables.soft, self._lamp_loss_per_m, backscatter, sky
        scene = np.ascontiguousarray(albedo), depth, focal, *light
        facets, objects = _or(seen.facets, _NO_FACETS), _or(seen.objects, _NO_OBJECTS)
        view = facets, _or(seen.lit, _NO_SHADOWS), seen.material, objects
        in_row_bands(lambda first, end: shade(*scene, *view, *out, first, end), len(depth))

    def _backscatter(self, camera: int, surface: WaterSurface) -> NDArray[np.float32]:
        """Returns the backscatter of lamps and daylight, in the form of `_Tables.backscatter`."""
        of_lamps = self._tables_of(camera).backscatter
        veil = self._veil()
        if veil is None:
            return of_lamps
        rays = self._grid_rays[camera] @ world_axes(surface.from_camera)
        return veil.added_to(of_lamps, rays, float(surface.from_camera[2, 3]))


def _or(value: Value | None, substitute: Value) -> Value:
    """Returns the value; the substitute if the value is None."""
    return substitute if value is None else value


def range_of(depth: Depth, rig: StereoRig) -> Array:
    """Returns the distance (H, W) from the camera to the floor [m], given the depth along the optical axis [m]."""
    x = (np.arange(rig.width_px) - rig.cx_px) / rig.focal_px
    y = (np.arange(rig.height_px) - rig.cy_px) / rig.focal_px
    return depth.astype(np.float64) * np.sqrt(1 + x**2 + y[:, None] ** 2)


def _lamp_rows(sources: LightSources) -> NDArray[np.float32]:
    """Returns the lamps (n, 10) as the argument `lamps` of `shading.shade`."""
    rows = np.column_stack([sources.position_m, sources.axis, sources.intensity_cd, sources.colour])
    return np.ascontiguousarray(rows, np.float32)


def _tables(rig: StereoRig, water: Medium, lamps: LampLight) -> _Tables:
    """Returns the lookup tables for one camera."""
    cosines, sources = 1 - np.linspace(0.0, 1.0, BEAM_STEPS + 1) ** 2, lamps.sources
    beams = np.array([beam_share(cosines, beam) for beam in sources.beam]).reshape(-1, cosines.size)
    backscatter = with_a_zero(backscatter_table(rig, water, lamps))
    soft = _or(floor_tables(sources, water), _NO_SOFT_LAMPS)
    return _Tables(beams.astype(np.float32), soft, backscatter)
