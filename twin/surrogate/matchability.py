"""Matchability of the floor: the Cramér-Rao bound of image matching, and the unevenness of the floor under a patch.

The bound is computed from images of a level floor, simulated with the scenario's texture, light and sensor. Let g be
the gradient along a row of the part of the grey image that the texture causes, and s the standard deviation of the
image noise. The standard deviation of the measured shift between two patches of p x p pixels is at least
c = sqrt(2) s / (p rms(g)) pixels (Cramér-Rao bound). Veil and unevenness of the light do not move with the floor, so
the image of a floor with the same mean albedo, but without texture, is subtracted.

In turbid water most corners of the full image are noise. The estimators then bin the images (`choose_binning`), and the
bound is that of the binned images, in their pixels.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cached_property
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from twin import terrains
from twin.core.geometry import BODY_FROM_DOWN_CAMERA, Array, pose
from twin.core.records import Image, StereoRig
from twin.estimate.vision import matching
from twin.estimate.vision.stereo import BINNINGS
from twin.imaging.camera.photo_sensor import Sensor, sensor_of
from twin.imaging.camera.sensor import ExposureSetting
from twin.imaging.image_formation import ImageFormation, StampedPose
from twin.imaging.light.illumination import Illumination
from twin.imaging.light.optics import Radiance
from twin.imaging.stereo_camera import Depth
from twin.scenario.model import Scenario
from twin.surrogate.snow_noise import snow_effect, snow_poses
from twin.surrogate.window_texture import window_texture
from twin.terrains.ground_cover import DEFAULT_COVERS
from twin.terrains.terrain import texture_shape
from twin.terrains.textures import generate_texture

#: Bound above which fewer than two thirds of the corners are matched, so that the estimators bin the images [px]. In
#: rendered surveys they binned at 0.111 px (full image) and 0.13 px (binned by 2), and did not at 0.108 and 0.101 px.
_CORNERS_BOUND_PX = 0.11
_DEPTHS = 6  # number of tabulated depths
_LARGEST_UNEVENNESS = 2.0  # largest unevenness with which a patch is counted, relative to the median of the patches
_BLOCKS = (6, 8)  # rows and columns of blocks of the image in `PositionDependence`
_GRAY, _CONTRAST, _OCTAVES = 90, 12, 5  # random texture: mean, standard deviation per octave (0 to 255), octaves
_PATCHES, _SAMPLES = 300, 9  # patches sampled for the unevenness; height samples along each side of a patch


class PositionDependence(NamedTuple):
    """Dependence of matching on the position in the image, in blocks (rows, cols) that divide the image evenly."""

    bounds: Array  #: Cramér-Rao bound in a block, divided by that of the whole image
    gradients: Array  #: RMS gradient of an even texture in a block, divided by that of the whole image


NO_DEPENDENCE = PositionDependence(np.ones((1, 1)), np.ones((1, 1)))


class Precision(NamedTuple):
    """Cramér-Rao bound (m,) [px of the binned images] and fraction (m,) of matches that remain in snow, at m depths."""

    bounds_px: Array
    clear_share: Array


class FloorImages:
    """Simulated images of a level floor under the vehicle, without shadows, which the surrogate does not model.

    Tone curve and white balance scale texture and noise of a pixel alike, so that images are linear, in white light.
    The tables of the light are computed once, here.

    Args:
        scenario: description of the survey.
        illumination: optical properties of the water, and daylight in the water.
    """

    def __init__(self, scenario: Scenario, illumination: Illumination):
        imaging = scenario.imaging.model_copy(update={"shadows": False})
        linear = {"tone_curve": "linear", "white_balance": "white_light"}
        sensor = scenario.sensor and scenario.sensor.model_copy(update=linear)
        self._with_snow = scenario.model_copy(update={"imaging": imaging, "sensor": sensor})
        no_snow = scenario.snow.model_copy(update={"density_per_m3": 0.0})
        self.scenario = self._with_snow.model_copy(update={"snow": no_snow})
        self.rig, self.illumination = scenario.believed_rig(), illumination
        self._formation = self._formation_of(self.scenario)

    @property
    def snowy(self) -> bool:
        """Returns whether there is marine snow in the scenario."""
        return self._with_snow.snow.density_per_m3 > 0

    def pair(self, albedo: Image, depth_m: float) -> tuple[Radiance, Radiance]:
        """Returns the radiances (H, W, 3) of a floor at a depth: with an albedo image, and with its mean colour."""
        mean = albedo.mean(axis=(0, 1)).round().astype(np.uint8)
        return self._radiance(albedo, depth_m), self._radiance(np.broadcast_to(mean, albedo.shape).copy(), depth_m)

    def sensor(self) -> Sensor:
        """Returns the sensor in its initial state: the first frame that it meters has its own exposure."""
        return sensor_of(self.scenario, self.rig)

    def snow_views(self, albedo: Image, depth_m: float) -> tuple[list[Radiance], list[Radiance]]:
        """Returns views (H, W, 3) of a floor without snow, and the same with different particles of marine snow."""
        formations = self._formation, self._snow_formation
        depth, camera_pose = self._level_floor(depth_m)
        clean, snowy = ([one.radiance(albedo, depth, 0, p) for p in snow_poses(camera_pose)] for one in formations)
        return clean, snowy

    @cached_property
    def _snow_formation(self) -> ImageFormation:
        return self._formation_of(self._with_snow)

    def reflected(self, lamps: bool) -> float:
        """Returns the radiance that a white floor at the planned altitude reflects, with or without lamps [cd/m2].

        It is the mean difference between the images of a white and a black floor, which removes the veil.
        """
        unlit = self.scenario.model_copy(update={"lamps": ()})
        formation = self._formation if lamps else self._formation_of(unlit)
        depth, camera_pose = self._level_floor(self.scenario.plan.altitude_m)
        albedos = (np.full((*depth.shape, 3), level, np.uint8) for level in (255, 0))
        white, black = (formation.radiance(albedo, depth, 0, camera_pose) for albedo in albedos)
        return float(np.mean(white - black))

    def _formation_of(self, scenario: Scenario) -> ImageFormation:
        return ImageFormation(scenario, self.illumination, None, np.random.default_rng(0))

    def _radiance(self, albedo: Image, depth_m: float) -> Radiance:
        depth, camera_pose = self._level_floor(depth_m)
        return self._formation.radiance(albedo, depth, 0, camera_pose)

    def _level_floor(self, depth_m: float) -> tuple[Depth, StampedPose]:
        """Returns the depth image of a level floor seen from above, and the camera's pose at the planned altitude."""
        world_from_left = pose(BODY_FROM_DOWN_CAMERA, np.array([0.0, 0.0, self.scenario.plan.altitude_m]))
        depth = np.full((self.rig.height_px, self.rig.width_px), depth_m, np.float32)
        return depth, StampedPose(world_from_left, 0.0)


class Matchability:
    """Cramér-Rao bound of image matching and unevenness of the floor, tabulated over the range of floor depths.

    Args:
        scenario: description of the survey.
        illumination: optical properties of the water, and daylight in the water.
        terrain: true floor.
        locate: see `unevenness_px`.

    Attributes:
        depths_m: (m,) ascending depths of the floor along the optical axis [m].
        binning: side of the squares of pixels that the estimators average to one pixel [px].
        bounds_px: (m,) Cramér-Rao bound c at these depths [px of the binned images]; infinite where marine snow
            prevents all matches.
        dependence: dependence of the bound on the position in the image, at the medium depth.
        texture: distribution of the bound over the windows of dense matching, at the medium depth.
        unevenness_px: (m,) unevenness of the floor under a patch at these depths [px of the binned images per unit of
            baseline / depth].
        lamp_share: fraction of the light reflected by the floor that comes from the lamps.
        clear_share: (m,) fraction of the matches that remain in the presence of marine snow, at these depths.
    """

    @np.errstate(invalid="raise")
    def __init__(
        self,
        scenario: Scenario,
        illumination: Illumination,
        terrain: terrains.Terrain,
        locate: Callable[[Array], Array] | None = None,
    ):
        nearest = max(scenario.plan.altitude_m - terrain.highest_m, 0.3)
        highest_m = scenario.plan.altitude_m  # of the cameras
        if scenario.plan.height == "floor":
            highest_m += terrain.highest_m
        self.depths_m = np.geomspace(0.8 * nearest, 1.2 * (highest_m - terrain.lowest_m), _DEPTHS)
        images = FloorImages(scenario, illumination)
        self._set_image_scale(images, floor_albedos(images, terrain, self.depths_m))
        self.dependence = position_dependence(images, self.medium_depth_m, self.binning)
        self.texture = window_texture(self._texture_signal(images, terrain), self.dependence.gradients)
        self.unevenness_px = unevenness_px(scenario, terrain, self.depths_m, locate, self.binning)
        self.lamp_share = lamp_share(images)

    @property
    def medium_bound_px(self) -> float:
        """Returns the Cramér-Rao bound of a patch's position at `medium_depth_m` [px of the binned images]."""
        return self.bound_at(self.medium_depth_m)

    @property
    def window_bounds_px(self) -> Array:
        """Returns the bound (m,) of the median window of dense matching at `depths_m` [px of the binned images]."""
        return self.bounds_px * self.texture.median_ratio

    @property
    def medium_depth_m(self) -> float:
        """Returns the geometric mean of the smallest and the largest of `depths_m` [m]."""
        return float(np.sqrt(self.depths_m[0] * self.depths_m[-1]))

    def _set_image_scale(self, images: FloorImages, albedos: list[Image]) -> None:
        """Sets `binning`, `bounds_px` and `clear_share`."""
        best_px = np.inf
        for binning in BINNINGS:
            if images.rig.width_px % binning or images.rig.height_px % binning:
                break
            found = precision(images, albedos, self.depths_m, binning)
            medium_px = float(np.interp(self.medium_depth_m, self.depths_m, found.bounds_px))
            if binning == BINNINGS[0] or medium_px < best_px:
                best_px, self.binning, (self.bounds_px, self.clear_share) = medium_px, binning, found
            if medium_px < _CORNERS_BOUND_PX:
                break

    def _texture_signal(self, images: FloorImages, terrain: terrains.Terrain) -> NDArray[np.floating]:
        """Returns the part (rows, cols) of the grey image at the medium depth that the texture causes [grey levels]."""
        (albedo,) = floor_albedos(images, terrain, np.array([self.medium_depth_m]))
        radiance, untextured = images.pair(albedo, self.medium_depth_m)
        gain = images.sensor().meter(radiance).gain
        return _grey(radiance, gain, self.binning) - _grey(untextured, gain, self.binning)

    def bound_at(self, depth_m: float) -> float:
        """Returns the Cramér-Rao bound of a patch's position [px of the binned images] at a depth [m]."""
        return float(np.interp(depth_m, self.depths_m, self.bounds_px))

    def clear_share_at(self, depth_m: float) -> float:
        """Returns the fraction of the matches that remain in the presence of marine snow, at a depth [m]."""
        return float(np.interp(depth_m, self.depths_m, self.clear_share))

    def unevenness_at(self, depth_m: float) -> float:
        """Returns the unevenness [px of the binned images per unit of baseline / depth] at a depth [m]."""
        return float(np.interp(depth_m, self.depths_m, self.unevenness_px))


def precision(images: FloorImages, albedos: list[Image], depths_m: Array, binning: int = 1) -> Precision:
    """Returns the precision of matching a floor with an albedo image for each of its depths (m,).

    `binning` is the side of the squares of pixels that are averaged to one pixel [px].
    """
    rng = np.random.default_rng(0)
    if images.snowy:
        found = [_in_snow(images, albedo, z, binning) for albedo, z in zip(albedos, depths_m, strict=True)]
        return Precision(*np.array(found).T)
    bounds = [_bound_px(images, albedo, z, rng, binning) for albedo, z in zip(albedos, depths_m, strict=True)]
    return Precision(np.array(bounds), np.ones(len(depths_m)))


class _MatchedImages(NamedTuple):
    """Binned grey images (rows, cols) [grey levels]: the part that texture causes; difference of two with noise."""

    signal: NDArray[np.floating]
    difference: NDArray[np.floating]


def _matched_images(
    sensor: Sensor, textured: Radiance, untextured: Radiance, binning: int, rng: np.random.Generator
) -> _MatchedImages:
    setting = sensor.meter(textured)
    signal = _grey(textured, setting.gain, binning) - _grey(untextured, setting.gain, binning)
    return _MatchedImages(signal, _noise_difference(sensor, textured, setting, binning, rng))


def _noise_difference(
    sensor: Sensor, light: Radiance, setting: ExposureSetting, binning: int, rng: np.random.Generator
) -> NDArray[np.floating]:
    first, second = (matching.gray(sensor.image(light, setting, rng).astype(np.float32), binning) for _ in range(2))
    return first - second


def _bound_px(images: FloorImages, albedo: Image, depth_m: float, rng: np.random.Generator, binning: int) -> float:
    """Returns the Cramér-Rao bound [px of the binned images] for a level floor at a depth, with an albedo image."""
    matched = _matched_images(images.sensor(), *images.pair(albedo, depth_m), binning, rng)
    noise = float(matched.difference.std()) / np.sqrt(2)
    gradient = float(np.sqrt(np.mean(np.diff(matched.signal, axis=1) ** 2)))
    return np.sqrt(2) * noise / (images.scenario.estimator_settings().patch_px * max(gradient, 1e-6))


def _in_snow(images: FloorImages, albedo: Image, depth_m: float, binning: int) -> tuple[float, float]:
    """Returns the bound [px of the binned images] and the fraction of matches that remain in snow, at one depth."""
    clean, snowy = images.snow_views(albedo, depth_m)
    sensor = images.sensor()
    setting = sensor.meter(snowy[0])
    difference = _noise_difference(sensor, clean[0], setting, binning, np.random.default_rng(0))
    noise = float(difference.std()) / np.sqrt(2)
    signals = [[_grey(light, setting.gain, binning) for light in lights] for lights in (clean, snowy)]
    effect = snow_effect(signals[0], signals[1], noise, images.scenario.estimator_settings().patch_px)
    return float(np.sqrt(effect.variance_px2)), effect.matched_share


def _grey(light: Radiance, gain: float, binning: int) -> NDArray[np.floating]:
    """Returns the binned grey image (rows, cols) of a radiance (H, W, 3) without noise [grey levels]."""
    return matching.gray(np.minimum(255 * gain * light, 255).astype(np.float32), binning)


def lamp_share(images: FloorImages) -> float:
    """Returns the fraction of the light reflected by a level floor at the planned altitude that is due to the lamps."""
    scenario = images.scenario
    if not scenario.lamps or scenario.sun.illuminance_lx == 0:
        return float(bool(scenario.lamps))
    return 1 - images.reflected(lamps=False) / max(images.reflected(lamps=True), np.finfo(float).tiny)


def position_dependence(images: FloorImages, depth_m: float, binning: int = 1) -> PositionDependence:
    """Returns the dependence of matching on the position in the image, for a level floor at a depth [m].

    Light, veil and blur vary over the image, and with them the gradients of a texture and the noise. The floor has a
    random texture whose statistics are the same everywhere. The squares of gradients and noise are averaged over each
    block, and their logarithms are smoothed by a polynomial in the position, because a block of binned images has few
    pixels. The result is `NO_DEPENDENCE` if a block shows no texture or no noise.
    """
    rng, sensor, shape = np.random.default_rng(0), images.sensor(), (images.rig.height_px, images.rig.width_px)
    gradients, noise = np.zeros(_BLOCKS), np.zeros(_BLOCKS)
    for _ in range(binning):
        lights = images.pair(_random_albedo(shape, binning, rng), depth_m)
        matched = _matched_images(sensor, *lights, binning, rng)
        gradients += _block_means(np.diff(matched.signal, axis=1) ** 2)
        noise += _block_means(matched.difference**2)
    if not gradients.min() > 1e-12 * binning or not noise.min() > 0:
        return NO_DEPENDENCE
    noise, gradients = (_smooth(values) / values.mean() for values in (noise, gradients))
    return PositionDependence(np.sqrt(noise / gradients), np.sqrt(gradients))


def _random_albedo(shape: tuple[int, int], binning: int, rng: np.random.Generator) -> Image:
    """Returns an albedo image (H, W, 3) of a grey random texture: equal variance in octaves from `binning` px up."""
    albedo = np.full(shape, _GRAY, np.float32)
    for octave in range(_OCTAVES):
        side_px = binning * 2**octave
        coarse = rng.standard_normal([-(-n // side_px) for n in shape], np.float32)
        albedo += _CONTRAST * cv2.resize(coarse, shape[::-1], interpolation=cv2.INTER_LINEAR)
    return np.repeat(np.clip(albedo, 0, 255).round().astype(np.uint8)[..., None], 3, axis=2)


def _block_means(values: NDArray[np.floating]) -> Array:
    """Returns the means of an image (rows, cols) over the blocks of a `PositionDependence`."""
    return np.asarray(cv2.resize(values.astype(np.float64), _BLOCKS[::-1], interpolation=cv2.INTER_AREA), np.float64)


def _smooth(values: Array) -> Array:
    """Returns positive values (rows, cols) smoothed by a polynomial of fourth degree fitted to their logarithm."""
    v, u = (part.ravel() for part in np.meshgrid(*(np.linspace(-1, 1, n) for n in values.shape), indexing="ij"))
    terms = np.column_stack([u**i * v**k for i in range(5) for k in range(5 - i)])
    fitted = terms @ np.linalg.lstsq(terms, np.log(values).ravel(), rcond=None)[0]
    return np.exp(fitted).reshape(values.shape)


def unevenness_px(
    scenario: Scenario,
    terrain: terrains.Terrain,
    depths_m: Array,
    locate: Callable[[Array], Array] | None = None,
    binning: int = 1,
) -> Array:
    """Returns the unevenness (n,) of the floor under a patch at depths (n,) [m], an RMS over the planned area.

    The unevenness of a patch is the RMS parallax relative to its best-fit plane, in pixels per unit of
    baseline / depth: f rms(z) / depth, with z the height above that plane [m] and f the focal length [px]. Each patch
    contributes at most `_LARGEST_UNEVENNESS` times the median over the patches, because the weights of the estimators
    limit the influence of matches with large residuals.

    Args:
        depths_m: (n,) depths of the floor along the optical axis [m].
        locate: maps fractions (..., 2) of the planned area's extent along and across the legs, -0.5 to 0.5 from its
            centre, to world (x, y) (..., 2) [m]; None: the area is centred at the origin, with legs along x.
        binning: see `precision`.
    """
    focal_px, patch_px = scenario.believed_rig().binned(binning).focal_px, scenario.estimator_settings().patch_px
    side = np.linspace(-0.5, 0.5, _SAMPLES)
    x, y = (part.ravel() for part in np.meshgrid(side, side))
    plane = np.column_stack([np.ones_like(x), x, y])
    residual_of = np.eye(len(x)) - plane @ np.linalg.pinv(plane)
    rng = np.random.default_rng(0)
    fractions = rng.random((_PATCHES, 1, 2)) - 0.5
    centres = fractions * scenario.plan.area_m if locate is None else locate(fractions)
    unevenness = []
    for depth_m in depths_m:
        points = centres + np.column_stack([x, y]) * (patch_px * depth_m / focal_px)
        height_m = terrain.height_at(points[..., 0], points[..., 1])
        mean_squares = np.nanmean((height_m @ residual_of) ** 2, axis=-1)
        limit = _LARGEST_UNEVENNESS**2 * np.nanmedian(mean_squares)
        unevenness.append(focal_px * np.sqrt(np.nanmean(np.minimum(mean_squares, limit))) / depth_m)
    return np.array(unevenness)


def floor_albedos(images: FloorImages, terrain: terrains.Terrain, depths_m: Array) -> list[Image]:
    """Returns the albedo image (H, W, 3) of the texture of a true floor for each of its depths (m,) [m]."""
    rig = images.rig
    texture, texel_m = _texture(images.scenario, terrain, float(max(depths_m)) * rig.width_px / rig.focal_px)
    return [_albedo(texture, texel_m, rig, z) for z in depths_m]


def _texture(scenario: Scenario, terrain: terrains.Terrain, extent_m: float) -> tuple[Image, float]:
    """Returns the texture of the floor's photos or mesh, or else a generated one, and its texel size [m]."""
    t = scenario.terrain
    if t.texture_file is not None or t.orthophoto_file is not None or t.kind == "mesh":
        return terrain.texture, terrain.texture_px_m
    if t.kind == "file":
        return _painted_centre(scenario, terrain, extent_m)
    extent_m = float(min(max(extent_m, 4 * t.grid_m), *t.size_m))
    source = terrains.TextureSource(scenario.texel_m, cover=t.cover, coarsen=True)
    generated = terrains.generate(t.kind, (extent_m, extent_m), t.relief_m, t.base_m, t.grid_m, source, scenario.seed)
    return generated.texture, generated.texture_px_m


def _painted_centre(scenario: Scenario, terrain: terrains.Terrain, extent_m: float) -> tuple[Image, float]:
    """Returns the generated texture of the central part of a floor from a file, and its texel size [m]."""
    n_cells = max(4, math.ceil(extent_m / terrain.spacing_m))
    first = [max(0, (n - 1 - n_cells) // 2) for n in terrain.height_m.shape]
    height_m = terrain.height_m[first[0] :, first[1] :][: n_cells + 1, : n_cells + 1]
    size_m = tuple((n - 1) * terrain.spacing_m for n in reversed(height_m.shape))
    texel_m = terrains.TextureSource(scenario.texel_m, coarsen=True).texel_m((size_m[0], size_m[1]))
    shape = texture_shape(height_m.shape, terrain.spacing_m, texel_m)
    cover = scenario.terrain.cover or DEFAULT_COVERS["file"]
    return generate_texture(cover, height_m, shape, texel_m, np.random.default_rng(scenario.seed)), texel_m


def _albedo(texture: Image, texel_m: float, rig: StereoRig, depth_m: float) -> Image:
    """Returns the albedo image (height_px, width_px, 3) of the texture's centre for a camera at the given distance."""
    texels_per_px = depth_m / rig.focal_px / texel_m
    height, width = texture.shape[:2]
    rows, cols = (min(round(n * texels_per_px), most) for n, most in ((rig.height_px, height), (rig.width_px, width)))
    rows, cols = max(rows, 2), max(cols, 2)
    top, left = (height - rows) // 2, (width - cols) // 2
    method = cv2.INTER_AREA if texels_per_px > 1 else cv2.INTER_LINEAR
    centre = texture[top : top + rows, left : left + cols]
    return np.asarray(cv2.resize(centre, (rig.width_px, rig.height_px), interpolation=method), np.uint8)
