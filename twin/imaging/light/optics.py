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

from collections.abc import Callable, Sequence
from functools import cache
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from twin.core.records import Array, Depth, Image, Radiance, StereoRig
from twin.core.threads import in_row_bands
from twin.imaging.light.backscatter import backscatter_table, grid_of, grid_rays, table_range_m
from twin.imaging.light.daylight import DaylightVeil, floor_daylight, world_axes
from twin.imaging.light.forward_scatter import ForwardScatter, Place
from twin.imaging.light.illumination import Illumination
from twin.imaging.light.lamp_light import LampLight, floor_tables, with_a_zero
from twin.imaging.light.lamps import beam_share, light_sources_in_camera
from twin.imaging.light.shading import RANGE_SCALE_M, shade
from twin.imaging.light.water import Medium
from twin.imaging.scene.facets import NO_FACETS, FacetView
from twin.imaging.scene.materials import Material
from twin.imaging.scene.mesh_raster import NO_OBJECTS, ObjectView
from twin.scenario.model import LampConfig

Lit = NDArray[np.uint8]

LEAST_TRANSMISSION = 1e-25  # at a smaller transmission, single precision does not represent the light of the floor
ALBEDO_STEP_PX = 16  # spacing of the pixels whose mean albedo is that of the floor around the image
#: Arguments of `shading.shade` for effects that an image does not have.
NO_BACKSCATTER, NO_CAUSTICS = np.zeros((0, 0, 0, 4), np.float32), np.zeros((0, 0), np.float32)
NO_SHADOWS = np.zeros((0, 0, 0), np.uint8)
BEAM_STEPS = 2048  # number of steps of sqrt(1 - cos(angle)) from 0 to 1, which are nearly even in the angle


class WaterSurface(NamedTuple):
    """The water surface above a camera: its caustics, and its position relative to the camera."""

    caustics: NDArray[np.float32] | None  # `Caustics.closed_pattern`; None if daylight is uniform
    # (3, 4) map from camera axes to column (east) and row (north) of `caustics`, and depth below the surface [m]
    from_camera: Array


def calm_surface(world_from_camera: Array, reference_depth_m: float) -> WaterSurface:
    """Returns the water surface above a camera without caustics, in metres east and north."""
    east, north, up = world_from_camera[:3]
    from_camera = np.array([east, north, -up])
    from_camera[2, 3] += reference_depth_m
    return WaterSurface(None, from_camera)


class SceneView(NamedTuple):
    """What the light of an image depends on besides albedo and depth."""

    facets: FacetView = NO_FACETS  # triangles of the floor; none: the normals are computed from the depth
    # (lamps, H, W), and one for the sun if it casts shadows; empty = no shadows. Bit 0: 0 where the light is blocked,
    # else 1; the other bits: share of the lamp's scattered light that relief hides, in `shading.HIDDEN_STEPS`
    lit: Lit = NO_SHADOWS
    material: Material | None = None  # reflection of the unscattered light of lamps; None = Lambertian
    objects: ObjectView = NO_OBJECTS  # normals of the pixels that show objects; empty: the image shows the floor alone
    # None = a calm surface above a camera that points straight down at the planned altitude, east on its right
    surface: WaterSurface | None = None


#: A Lambertian floor without facets, shadows and objects, under a calm surface.
BARE_FLOOR = SceneView()


class LightParts(NamedTuple):
    """Parts of the light that reaches a camera, per band in photometric units [cd/m2]; (H, W, 3) float32 each."""

    direct: Radiance  # light of the floor that was not scattered between floor and camera
    # light of the floor that was scattered between floor and camera; None without multiple scattering
    forward: Radiance | None
    backscatter: Radiance  # light that the water scattered into the camera without reflection by the floor


class WhiteFloor(NamedTuple):
    """Light of an image of a white floor, from which the light of a floor of any albedo follows."""

    # (H, W, 3) light of the white floor at the camera, with multiple scattering attenuated by absorption alone [cd/m2]
    floor: Radiance
    backscatter: Radiance  # (H, W, 3) light that the water scatters into the camera [cd/m2]
    unscattered: Array  # (H, W, 3) share of `floor` that is not scattered; ones (3,) without multiple scattering
    core: Array  # (H, W, 3) share that is scattered by less than a pixel; zeros (3,) without multiple scattering
    # returns the scattered light (H, W, 3) of a floor, given its light, attenuated by absorption alone, and its albedo
    # (H, W, 3), 1 = white, whose mean the floor around the image has; None without multiple scattering
    spread: Callable[[Radiance, Radiance], Radiance] | None


class _Output(NamedTuple):
    """Arrays that the shading kernel fills, and `kept`: the arguments of `shading.shade` with the same names."""

    out: Radiance
    other: Radiance = np.zeros((0, 0, 3), np.float32)
    kept: NDArray[np.float32] = np.zeros((0, 4), np.float32)
    place: Place = np.zeros((0, 0), np.float32)


class Optics:
    """Model of the light that reaches each camera, for R, G, B; `light_sources` and `lamp_light`: one per camera."""

    def __init__(self, rig: StereoRig, illumination: Illumination, lamps: Sequence[LampConfig]):
        self._rig, self._medium = rig, illumination.water
        daylight = illumination.daylight
        self.light_sources = [light_sources_in_camera(rig, lamps, daylight, camera) for camera in (0, 1)]
        self.lamp_light = [LampLight(sources, self._medium) for sources in self.light_sources]
        scatters = self._medium.scatters_repeatedly
        sunny = scatters and bool(daylight.surface_lx.any())
        # computed on demand, as some callers need one camera, or the light of the floor only
        self._veil = cache(lambda: DaylightVeil(daylight, table_range_m()) if sunny else None)
        self._tables = cache(lambda camera: _tables_of(rig, self._medium, self.lamp_light[camera]))
        self._forward = ForwardScatter(rig, self._medium) if scatters else None
        # working memory of each camera, as both images may be computed at the same time
        light_shape, half_shape = (rig.height_px, rig.width_px, 3), ((rig.height_px + 1) // 2, (rig.width_px + 1) // 2)
        self._memory = cache(lambda camera: (np.empty(light_shape, np.float32), np.empty(half_shape, np.float32)))
        self._lamp_loss_per_m = self._medium.attenuation_per_m.astype(np.float32)
        loss_per_m = self._medium.camera_loss_per_m, daylight.camera_loss_per_m  # of lamp light and of daylight
        self._loss_per_m, self._daylight = np.array(loss_per_m, np.float32), floor_daylight(daylight)
        level = np.array([[1.0, 0, 0, 0], [0, -1, 0, 0], [0, 0, 1, daylight.camera_depth_m]])
        self._calm_surface = WaterSurface(None, level)

    def radiance(self, albedo: Image, depth: Depth, camera: int, scene: SceneView = BARE_FLOOR) -> Radiance:
        """Returns the light (H, W, 3) that reaches a camera (0 left, 1 right), per band in photometric units [cd/m2].

        `albedo` (H, W, 3) is uint8, `depth` (H, W) along the optical axis [m]; inf where there is no floor.
        """
        out = np.empty(albedo.shape, np.float32)
        if self._forward is None:
            self._run((albedo, depth), camera, scene, _Output(out))
        else:
            light, place = self._memory(camera)
            self._run((albedo, depth), camera, scene, _Output(light, out, self._forward.kept, place))
            self._forward.add(light, place, self.around(albedo, depth, camera, scene), out)
        return out

    def parts(self, albedo: Image, depth: Depth, camera: int, scene: SceneView = BARE_FLOOR) -> LightParts:
        """Returns the parts of the light that reaches a camera; their sum is `radiance`, with the same arguments."""
        light, backscatter = self._floor_and_backscatter(albedo, depth, camera, scene)
        if self._forward is None:
            return LightParts(light, None, backscatter)
        forward = self._forward.spread(light, range_of(depth, self._rig), self.around(albedo, depth, camera, scene))
        return LightParts((light * self._unscattered(depth)).astype(np.float32), forward, backscatter)

    def direct(self, albedo: Image, depth: Depth, camera: int, scene: SceneView = BARE_FLOOR) -> Radiance:
        """Returns `LightParts.direct` of `parts`, with the same arguments."""
        light, _ = self._floor_and_backscatter(albedo, depth, camera, scene)
        return light if self._forward is None else (light * self._unscattered(depth)).astype(np.float32)

    def _unscattered(self, depth: Depth) -> Array:
        """Returns the share (H, W, 3) of the floor's light that is not scattered on its way to the camera."""
        return np.exp(-self._medium.scattering_per_m * range_of(depth, self._rig)[..., None])

    def floor_lx(self, depth: Depth, camera: int, scene: SceneView = BARE_FLOOR) -> Radiance:
        """Returns the illuminance of the floor (H, W, 3) [lx]; the arguments are those of `radiance`.

        It is NaN without floor, and where the transmission to the camera is `LEAST_TRANSMISSION` or less.
        """
        white, shape = np.full((*depth.shape, 3), 255, np.uint8), (*depth.shape, 3)
        light, loss = np.empty(shape, np.float32), self._medium.camera_loss_per_m
        other, focal_px = np.empty(shape, np.float32), self._rig.focal_px  # with a focal length: without backscatter
        self._run((white, depth), camera, scene._replace(material=None), _Output(light, other), focal_px, loss)
        with np.errstate(divide="ignore", invalid="ignore"):
            back = np.exp(-loss * range_of(depth, self._rig)[..., None])
            return np.where(back > LEAST_TRANSMISSION, np.pi * light / back, np.nan).astype(np.float32)

    def white_floor(self, depth: Depth, camera: int, scene: SceneView = BARE_FLOOR) -> WhiteFloor:
        """Returns the light of an image of a white floor; the arguments are those of `radiance`."""
        white = np.full((*depth.shape, 3), 255, np.uint8)
        light, backscatter = self._floor_and_backscatter(white, depth, camera, scene)
        forward, range_m = self._forward, range_of(depth, self._rig)
        if forward is None:
            return WhiteFloor(light, backscatter, np.ones(3), np.zeros(3), None)
        around, place = self.around(white, depth, camera, scene)

        def spread(floor_light: Radiance, albedo: Radiance) -> Radiance:
            mean = np.mean(albedo, axis=(0, 1)).astype(np.float32)
            return forward.spread(floor_light, range_m, (around * mean, place.copy()))

        return WhiteFloor(light, backscatter, self._unscattered(depth), forward.core(range_m), spread)

    def veil(self, camera: int, surface: WaterSurface | None, pixel: Array, range_m: Array) -> Array:
        """Returns the backscatter (n, 3) between a camera and ranges (n,) [m] at pixels (n, 2), column and row [cd/m2].

        `surface` is that of `SceneView`.
        """
        *_, of_lamps, rays = self._tables(camera)
        table = self._with_veil(of_lamps, rays, self._calm_surface if surface is None else surface)
        rows, cols, ranges, _ = table.shape
        if not ranges:
            return np.zeros((len(pixel), 3))
        last_px = np.array([self._rig.width_px - 1, self._rig.height_px - 1])
        across, down = (pixel * np.array([cols - 1, rows - 1]) / last_px).T
        at = np.stack([down, across, range_m / (range_m + RANGE_SCALE_M) * (ranges - 1)])
        return np.stack([map_coordinates(table[..., k], at, order=1, mode="nearest") for k in range(3)], axis=-1)

    def around(self, albedo: Image, depth: Depth, camera: int, scene: SceneView = BARE_FLOOR) -> tuple[Radiance, Place]:
        """Returns the argument `around` of `ForwardScatter.add`; with single scattering, there is none."""
        assert self._forward is not None
        grid, (plane, place) = self._forward.surroundings, self._forward.plane(depth)
        light, uniform = np.empty((*grid.shape, 3), np.float32), np.empty((*grid.shape, 3), np.uint8)
        some = np.ascontiguousarray(albedo[::ALBEDO_STEP_PX, ::ALBEDO_STEP_PX])
        mean = np.round(cv2.mean(some)[:3]).astype(np.uint8)
        uniform.reshape(len(uniform), -1)[:] = np.tile(mean, grid.shape[1])
        bare, out = BARE_FLOOR._replace(surface=scene.surface), _Output(light, np.empty_like(light))
        self._run((uniform, plane), camera, bare, out, grid.focal_px)
        return light, place

    def _floor_and_backscatter(
        self, albedo: Image, depth: Depth, camera: int, scene: SceneView
    ) -> tuple[Radiance, Radiance]:
        light, backscatter = np.empty(albedo.shape, np.float32), np.empty(albedo.shape, np.float32)
        self._run((albedo, depth), camera, scene, _Output(light, backscatter))
        return light, backscatter

    def _run(
        self, image: tuple[Image, Depth], camera: int, scene: SceneView, out: _Output,
        focal_px: float | None = None, day_loss_per_m: Array | None = None,
    ) -> None:  # fmt: skip
        """Fills `out` by `shading.shade`; with a focal length, without backscatter."""
        albedo, depth = image
        surface = self._calm_surface if scene.surface is None else scene.surface
        lamps, beams, soft, of_lamps, rays = self._tables(camera)
        backscatter = NO_BACKSCATTER if focal_px else self._with_veil(of_lamps, rays, surface)
        loss = self._loss_per_m
        if day_loss_per_m is not None:
            loss = np.stack([loss[0], day_loss_per_m.astype(np.float32)])
        caustics = NO_CAUSTICS if surface.caustics is None else surface.caustics
        sky = *self._daylight.in_camera(surface.from_camera), loss, caustics, surface.from_camera.astype(np.float32)
        light = lamps, beams, soft, self._lamp_loss_per_m, backscatter, sky
        seen = scene.facets, scene.lit, scene.material, scene.objects
        image = np.ascontiguousarray(albedo), depth
        focal = np.float32(focal_px or self._rig.focal_px)
        in_row_bands(lambda first, end: shade(*image, focal, *light, *seen, *out, first, end), len(depth))

    def _with_veil(self, of_lamps: NDArray[np.float32], rays: Array, surface: WaterSurface) -> NDArray[np.float32]:
        """Returns the backscatter of lamps, a table of `_tables_of`, with that of daylight added."""
        veil = self._veil()
        if veil is None:
            return of_lamps
        return veil.added_to(of_lamps, rays @ world_axes(surface.from_camera), float(surface.from_camera[2, 3]))


def range_of(depth: Depth, rig: StereoRig) -> Array:
    """Returns the distance (H, W) from the camera to the floor [m], given the depth along the optical axis [m]."""
    x = (np.arange(rig.width_px) - rig.cx_px) / rig.focal_px
    y = (np.arange(rig.height_px) - rig.cy_px) / rig.focal_px
    return depth.astype(np.float64) * np.sqrt(1 + x**2 + y[:, None] ** 2)


def _tables_of(
    rig: StereoRig, water: Medium, light: LampLight
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32], NDArray[np.float32], Array]:
    """Returns `lamps`, `beams`, `soft` and `scatter_table` (of lamps) of `shading.shade`, and the rays of the last."""
    sources, cosines = light.sources, 1 - np.linspace(0.0, 1.0, BEAM_STEPS + 1) ** 2
    lamps = np.column_stack([sources.position_m, sources.axis, sources.intensity_cd, sources.colour])
    beams = np.array([beam_share(cosines, beam) for beam in sources.beam]).reshape(-1, cosines.size)
    of_lamps = with_a_zero(backscatter_table(rig, water, light))
    rays = grid_rays(rig, grid_of(sources.beam))
    lamps, beams = np.ascontiguousarray(lamps, np.float32), beams.astype(np.float32)
    return lamps, beams, floor_tables(sources, water), of_lamps, rays
