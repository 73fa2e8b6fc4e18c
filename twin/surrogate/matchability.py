"""Matchability of the floor: the Cramér-Rao bound of image matching, and the unevenness of the floor under a patch.

The bound is computed from images of a level floor, simulated with the scenario's texture, light, lens and sensor, at
the planned speed. Let g be the gradient of the part of the grey image that the texture causes, and s the standard
deviation of the image noise. The standard deviation of the measured shift between two patches of p x p pixels along
one axis is at least c = sqrt(2) s / (p rms(g)) pixels (Cramér-Rao bound), g being the gradient along this axis. Motion
blurs images along one axis, so c^2 is averaged over both. Veil and unevenness of the light do not move with the floor,
so the image of a floor with the same mean albedo, but without texture, is subtracted.

In turbid water most corners of the full image are noise. The estimators then bin the images (`choose_binning`), and the
bound is that of the binned images, in their pixels.
"""

import math
from collections.abc import Callable, Sequence
from functools import cached_property, lru_cache
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from twin import terrains
from twin.core import geometry
from twin.core.geometry import BODY_FROM_DOWN_CAMERA, Array, pose
from twin.core.records import Image, Radiance, StereoRig
from twin.estimate.vision import matching
from twin.estimate.vision.stereo import BINNINGS
from twin.imaging.camera.lens_psf import LensPsf
from twin.imaging.camera.photo_sensor import Sensor, sensor_of
from twin.imaging.camera.sensor import ExposureSetting
from twin.imaging.image_formation import ImageFormation, RenderedView, StampedPose
from twin.imaging.light.illumination import Illumination
from twin.imaging.light.optics import Optics
from twin.imaging.stereo_camera import light_after_lens
from twin.scenario.model import Scenario
from twin.surrogate.snow_noise import snow_effect, snow_poses
from twin.terrains.ground_cover import DEFAULT_COVERS
from twin.terrains.terrain import texture_shape
from twin.terrains.textures import painted_texture

TEXTURE_WINDOW_PX = 5  #: side of the windows of dense matching, with about the area of that of `epipolar`
#: Bound above which fewer than two thirds of the corners are matched, so that the estimators bin the images [px]. In
#: rendered surveys they binned at 0.111 px (full image) and 0.13 px (binned by 2), and did not at 0.108 and 0.101 px.
_CORNERS_BOUND_PX = 0.11
_DEPTHS, _MIDDLE = 3, 1  # number of tabulated depths, and the one in the middle
_LARGEST_UNEVENNESS = 2.0  # largest unevenness with which a patch is counted, relative to the median of the patches
_BLOCKS = (6, 8)  # rows and columns of blocks of the image in `PositionDependence`
_PATCHES, _SAMPLES = 300, 9  # patches sampled for the unevenness; height samples along each side of a patch
_BOUND_LIMITS_PX = 1e-9, 1e6  # bounds that replace zero and infinity between tabulated depths
_SMALL_CONTRAST = 0.01  # relative change of the light with which the slope of the tone curve is computed
_WEAKEST = 0.05  # smallest RMS gradient of a window that is counted, relative to that of the image


class PositionDependence(NamedTuple):
    """Dependence of matching on the position in the image, in blocks (rows, cols) that divide the image evenly."""

    bounds: Array  #: Cramér-Rao bound in a block, divided by that of the whole image
    gradients: Array  #: RMS gradient of an even texture in a block, divided by that of the whole image


NO_DEPENDENCE = PositionDependence(np.ones((1, 1)), np.ones((1, 1)))


class WindowTexture(NamedTuple):
    """Distribution of the Cramér-Rao bound over the windows of dense matching."""

    median_ratio: float  #: bound of the median window, divided by that of the RMS gradient of the image
    scatter: float  #: standard deviation over windows of the logarithm of the bound


EVEN_TEXTURE = WindowTexture(1.0, 0.0)


class MatchedImages(NamedTuple):
    """Images (H, W, 3) of a floor with texture, and its light with the mean colour instead."""

    signal: NDArray[np.float32]  #: part that the texture causes [grey levels]
    noise: NDArray[np.float32]  #: difference of two images by their noise [grey levels]
    even: Radiance  #: light of the floor without texture and snow [cd/m2]

    def bound_px(self, patch_px: int, binning: int) -> float:
        """Returns the Cramér-Rao bound of a patch's position [px of the images binned to `binning`]."""
        signal = matching.gray(self.signal, binning)
        gradients = [max(float(np.sqrt(np.mean(np.diff(signal, axis=axis) ** 2))), 1e-6) for axis in (0, 1)]
        noise = float(matching.gray(self.noise, binning).std())
        return noise / patch_px * math.sqrt(sum(gradient**-2 for gradient in gradients) / 2)


class FloorImages:
    """Simulated images of a level floor under the vehicle, without shadows, which the surrogate does not model."""

    def __init__(self, scenario: Scenario, illumination: Illumination):
        imaging = scenario.imaging.model_copy(update={"shadows": False})
        self.scenario = scenario.model_copy(update={"imaging": imaging})
        self.rig, self.illumination = scenario.believed_rig(), illumination
        self._formation = ImageFormation(self.scenario, illumination, None, np.random.default_rng(0))
        self._psf = LensPsf(scenario, self.rig)
        ahead = np.array([0.0, 0.0, 0.0, scenario.plan.speed_mps, 0.0, 0.0])
        self._twist = geometry.adjoint(geometry.inverse(self.rig.body_from_camera)) @ ahead

    def matched(self, albedo: Image, depth_m: float, rng: np.random.Generator) -> MatchedImages:
        view, even = self._level_floor(albedo, depth_m), self._level_floor(_mean_colour(albedo), depth_m)
        light, light_of_even = (self._formation.radiance_without_snow(one) for one in (view, even))
        sensor, setting, _ = self._metered(view, light)
        light, expected = (self._recorded(*one, sensor, setting) for one in ((view, light), (even, light_of_even)))
        signal = sensor.levels(light, setting) - sensor.levels(expected, setting)
        first, second = (sensor.image(light, setting, rng).astype(np.float32) for _ in range(2))
        return MatchedImages(signal, first - second, light_of_even)

    def contrast(self, albedo: Image, depth_m: float, light: Radiance) -> NDArray[np.float32]:
        """Returns the grey levels (H, W, 3) that a small texture of unit contrast adds to `MatchedImages.even`."""
        view = self._level_floor(_mean_colour(albedo), depth_m)
        sensor, setting, light = self._metered(view, light)
        brighter = np.asarray(light + np.float32(_SMALL_CONTRAST) * self._formation.direct(view), np.float32)
        return (sensor.levels(brighter, setting) - sensor.levels(light, setting)) / np.float32(_SMALL_CONTRAST)

    def floor_lx(self, depth_m: float) -> Radiance:
        """Returns the illuminance (H, W, 3) of the floor at a depth [lx]."""
        black = np.zeros((self.rig.height_px, self.rig.width_px, 3), np.uint8)
        return self._formation.floor_lx(self._level_floor(black, depth_m))

    def snow_levels(self, albedo: Image, depth_m: float) -> list[list[NDArray[np.float32]]]:
        """Returns noise-free images (H, W, 3) of a floor without snow, and the same with different particles."""
        view = self._level_floor(albedo, depth_m)
        views = [view._replace(pose=shifted) for shifted in snow_poses(view.pose)]
        pairs = [(one, self._formation.radiance_without_snow(one)) for one in views]
        sensor, setting, _ = self._metered(*pairs[0])
        return [
            [sensor.levels(self._recorded(*one, sensor, setting, snow), setting) for one in pairs]
            for snow in (False, True)
        ]

    def _metered(self, view: RenderedView, light: Radiance) -> tuple[Sensor, ExposureSetting, Radiance]:
        """Returns a sensor, its exposure, and the light of a view, given without snow (H, W, 3), with snow."""
        light, sensor = light.copy(), sensor_of(self.scenario, self.rig)
        self._formation.add_snow(light, view)
        return sensor, sensor.meter(light), light

    def _recorded(
        self, view: RenderedView, light: Radiance, sensor: Sensor, setting: ExposureSetting, snow: bool = False
    ) -> Radiance:
        """Returns the light (H, W, 3) of a view, given without snow, on the sensor, which moves with planned speed."""
        motion = sensor.motion(self._twist, setting, len(view.depth))
        if motion is not None:
            motion = motion._replace(rolls_later=True)  # the estimators correct the readout
        return light_after_lens(self._formation, self._psf, view, light.copy(), self.rig.focal_px, motion, snow)

    def _level_floor(self, albedo: Image, depth_m: float) -> RenderedView:
        world_from_left = pose(BODY_FROM_DOWN_CAMERA, np.array([0.0, 0.0, self.scenario.plan.altitude_m]))
        depth = np.full((self.rig.height_px, self.rig.width_px), depth_m, np.float32)
        return RenderedView(albedo, depth, 0, StampedPose(world_from_left, 0.0))


def _mean_colour(albedo: Image) -> Image:
    return np.broadcast_to(np.round(cv2.mean(albedo)[:3]).astype(np.uint8), albedo.shape).copy()


class Matchability:
    """Cramér-Rao bound of image matching and unevenness of the true floor, tabulated over the range of floor depths.

    At `depths_m` (m,) of the floor along the optical axis, ascending, `bounds_px` (m,) is the bound in images binned by
    `binning`, infinite where marine snow prevents all matches; `unevenness_px` (m,) that of the function of this name;
    `clear_share` (m,) the fraction of matches that marine snow leaves. At the medium depth, `dependence` is that of the
    bound on the position, `texture` its distribution over the windows of dense matching. `lamp_share` is the fraction
    of the reflected light that comes from the lamps.
    """

    @np.errstate(invalid="raise")
    def __init__(
        self, scenario: Scenario, illumination: Illumination, terrain: terrains.Terrain,
        locate: Callable[[Array], Array] | None = None,
    ):  # fmt: skip
        nearest = max(scenario.plan.altitude_m - terrain.highest_m, 0.3)
        highest_m = scenario.plan.altitude_m  # of the cameras
        if scenario.plan.height == "floor":
            highest_m += terrain.highest_m
        self.depths_m = np.geomspace(0.8 * nearest, 1.2 * (highest_m - terrain.lowest_m), _DEPTHS)
        images, rng = FloorImages(scenario, illumination), np.random.default_rng(0)
        albedos = floor_albedos(images, terrain, self.depths_m)
        found = [images.matched(albedo, z, rng) for albedo, z in zip(albedos, self.depths_m, strict=True)]
        self._set_image_scale(images, albedos, found)
        contrast = images.contrast(albedos[_MIDDLE], self.medium_depth_m, found[_MIDDLE].even)
        self.dependence = position_dependence(contrast, found[_MIDDLE].noise)
        signal = matching.gray(found[_MIDDLE].signal, self.binning)
        self.texture = window_texture(signal, self.dependence.gradients)
        self.unevenness_px = unevenness_px(scenario, terrain, self.depths_m, locate, self.binning)
        self.lamp_share = lamp_share(images, self.medium_depth_m)

    @property
    def medium_bound_px(self) -> float:
        """Returns the Cramér-Rao bound at `medium_depth_m` [px of the binned images]."""
        return float(self.bounds_px[_MIDDLE])

    @property
    def medium_depth_m(self) -> float:
        """Returns the geometric mean of the smallest and the largest of `depths_m`."""
        return float(self.depths_m[_MIDDLE])

    def _set_image_scale(self, images: FloorImages, albedos: list[Image], found: Sequence[MatchedImages]) -> None:
        self.bounds_px, patch_px = np.zeros(0), images.scenario.estimator_settings().patch_px
        for binning in BINNINGS:
            if images.rig.width_px % binning or images.rig.height_px % binning:
                break
            bounds, clear = np.array([one.bound_px(patch_px, binning) for one in found]), np.ones(len(found))
            if images.scenario.snow.density_per_m3 > 0:
                pairs = zip(albedos, self.depths_m, found, strict=True)
                bounds, clear = np.array([in_snow(images, *one, binning) for one in pairs]).T
            if not self.bounds_px.size or bounds[_MIDDLE] < self.medium_bound_px:
                self.binning, self.bounds_px, self.clear_share = binning, bounds, clear
            if bounds[_MIDDLE] < _CORNERS_BOUND_PX:
                break

    def bound_at(self, depth_m: Array | float) -> Array:
        """Returns the bound [px of the binned images] at depths [m]: a parabola in logarithms, constant outside."""
        depth_m, (a, b, c) = np.minimum(np.maximum(depth_m, self.depths_m[0]), self.depths_m[-1]), self._parabola
        x = np.log(depth_m / self.medium_depth_m)
        return np.exp((a * x + b) * x + c)

    @cached_property
    def _parabola(self) -> Array:
        bounds_px = np.clip(self.bounds_px, *_BOUND_LIMITS_PX)
        return np.polyfit(np.log(self.depths_m / self.medium_depth_m), np.log(bounds_px), 2)

    def clear_share_at(self, depth_m: float) -> float:
        """Returns the fraction of the matches that remain in marine snow at a depth."""
        return float(np.interp(depth_m, self.depths_m, self.clear_share))

    def unevenness_at(self, depth_m: float) -> float:
        return float(np.interp(depth_m, self.depths_m, self.unevenness_px))


def in_snow(
    images: FloorImages, albedo: Image, depth_m: float, matched: MatchedImages, binning: int
) -> tuple[float, float]:
    """Returns the bound [px of the binned images] and the fraction of matches that remain in snow, at one depth."""
    noise = float(matching.gray(matched.noise, binning).std()) / np.sqrt(2)
    clean, snowy = ([matching.gray(one, binning) for one in views] for views in images.snow_levels(albedo, depth_m))
    variance_px2, share = snow_effect(clean, snowy, noise, images.scenario.estimator_settings().patch_px)
    return float(np.sqrt(variance_px2)), share


def lamp_share(images: FloorImages, depth_m: float) -> float:
    """Returns the lamps' fraction of the light that a level floor at a depth reflects."""
    scenario = images.scenario
    if not scenario.lamps or scenario.sun.illuminance_lx == 0:
        return float(bool(scenario.lamps))
    floor_lx = images.floor_lx(depth_m)
    depth = np.full(floor_lx.shape[:2], depth_m, np.float32)
    unlit_lx = Optics(images.rig, images.illumination, ()).floor_lx(depth, 0)
    back = np.exp(-images.illumination.water.camera_loss_per_m * depth_m)
    lit, unlit = (float(np.nan_to_num(lx * back).mean()) for lx in (floor_lx, unlit_lx))
    return 1 - unlit / max(lit, np.finfo(float).tiny)


def position_dependence(contrast: Radiance, noise: NDArray[np.float32]) -> PositionDependence:
    """Returns the dependence of matching on the position; `NO_DEPENDENCE` if a block has no light or no noise."""
    # light, veil and blur vary over the image, and with them gradients, as `FloorImages.contrast` (H, W, 3) of an even
    # floor, and noise, `MatchedImages.noise`; their squares are averaged over each block, the logarithm of the noise is
    # smoothed by a polynomial
    gradients, variance = (_block_means(matching.gray(image) ** 2) for image in (contrast, noise))
    if not gradients.min() > 1e-12 * gradients.max() or not variance.min() > 0:
        return NO_DEPENDENCE
    gradients, variance = gradients / gradients.mean(), _smooth(variance) / variance.mean()
    return PositionDependence(np.sqrt(variance / gradients), np.sqrt(gradients))


def _block_means(values: NDArray[np.floating]) -> Array:
    return np.asarray(cv2.resize(values.astype(np.float64), _BLOCKS[::-1], interpolation=cv2.INTER_AREA), np.float64)


def _smooth(values: Array) -> Array:
    """Returns positive values (rows, cols) smoothed by a polynomial of fourth degree fitted to their logarithm."""
    v, u = (part.ravel() for part in np.meshgrid(*(np.linspace(-1, 1, n) for n in values.shape), indexing="ij"))
    terms = np.column_stack([u**i * v**k for i in range(5) for k in range(5 - i)])
    fitted = terms @ np.linalg.lstsq(terms, np.log(values).ravel(), rcond=None)[0]
    return np.exp(fitted).reshape(values.shape)


def window_texture(signal: NDArray[np.floating], relative_gradients: Array) -> WindowTexture:
    """Returns the distribution of the bound over the windows of dense matching.

    The bound of an image contains the RMS gradient of the whole image. Dense matching fits a plane of disparities in a
    small Gaussian window, so the bound of a pixel contains the RMS gradient in that window. Over even texture, such as
    sand, it is nearly the same in all windows; over reefs, it is several times larger at bright edges than in dark
    areas without texture. What belongs to the position in the image (`PositionDependence.gradients`) is removed from
    the gradients of the grey levels `signal` (rows, cols) that the texture causes. The result is `EVEN_TEXTURE` for an
    image that has no texture or is smaller than a window.
    """
    squares = np.diff(signal.astype(np.float64), axis=1) ** 2
    squares /= cv2.resize(np.square(relative_gradients), squares.shape[::-1], interpolation=cv2.INTER_LINEAR)
    whole, inner = float(np.sqrt(squares.mean())), TEXTURE_WINDOW_PX // 2
    # the running sums of the blur end just below zero in windows without texture
    means = np.maximum(cv2.blur(squares, (TEXTURE_WINDOW_PX,) * 2)[inner:-inner, inner:-inner], 0)
    if whole == 0 or not means.size:
        return EVEN_TEXTURE
    relative = np.maximum(np.sqrt(means) / whole, _WEAKEST)
    return WindowTexture(1 / float(np.median(relative)), float(np.std(np.log(relative))))


def unevenness_px(
    scenario: Scenario, terrain: terrains.Terrain, depths_m: Array, locate: Callable[[Array], Array] | None = None,
    binning: int = 1,
) -> Array:  # fmt: skip
    """Returns the unevenness (n,) of the floor under a patch at depths (n,) [m], an RMS over the planned area.

    The unevenness of a patch is the RMS parallax relative to its best-fit plane, in pixels per unit of baseline /
    depth: f rms(z) / depth, with z the height above that plane [m] and f the focal length [px]. Each patch contributes
    at most `_LARGEST_UNEVENNESS` times the median over the patches, because the weights of the estimators limit the
    influence of matches with large residuals. `locate` maps fractions (..., 2) of the area along and across the legs,
    -0.5 to 0.5 from its centre, to world (x, y) [m]; None: centred at the origin, legs along x.
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
    generated = _generated(t.kind, (extent_m, extent_m), t.relief_m, t.base_m, t.grid_m, source, scenario.seed_of_scene)
    return generated.texture, generated.texture_px_m


_generated = lru_cache(maxsize=1)(terrains.generate)  # surveys of a study often differ in other keys only


def _painted_centre(scenario: Scenario, terrain: terrains.Terrain, extent_m: float) -> tuple[Image, float]:
    """Returns the generated texture of the central part of a floor from a file, and its texel size [m]."""
    n_cells = max(4, math.ceil(extent_m / terrain.spacing_m))
    first = [max(0, (n - 1 - n_cells) // 2) for n in terrain.height_m.shape]
    height_m = terrain.height_m[first[0] :, first[1] :][: n_cells + 1, : n_cells + 1]
    size_m = tuple((n - 1) * terrain.spacing_m for n in reversed(height_m.shape))
    texel_m = terrains.TextureSource(scenario.texel_m, coarsen=True).texel_m((size_m[0], size_m[1]))
    shape = texture_shape(height_m.shape, terrain.spacing_m, texel_m)
    cover = scenario.terrain.cover or DEFAULT_COVERS["file"]
    rng = np.random.default_rng(scenario.seed_of_scene)
    return painted_texture(cover, height_m, shape, texel_m, rng).image, texel_m


def _albedo(texture: Image, texel_m: float, rig: StereoRig, depth_m: float) -> Image:
    texels_per_px = depth_m / rig.focal_px / texel_m
    height, width = texture.shape[:2]
    rows, cols = (min(round(n * texels_per_px), most) for n, most in ((rig.height_px, height), (rig.width_px, width)))
    rows, cols = max(rows, 2), max(cols, 2)
    top, left = (height - rows) // 2, (width - cols) // 2
    method = cv2.INTER_AREA if texels_per_px > 1 else cv2.INTER_LINEAR
    centre = texture[top : top + rows, left : left + cols]
    return np.asarray(cv2.resize(centre, (rig.width_px, rig.height_px), interpolation=method), np.uint8)
