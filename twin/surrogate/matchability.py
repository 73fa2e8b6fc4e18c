"""Matchability of the floor: the Cramér-Rao bound of image matching, and the unevenness of the floor under a patch.

The bound is computed from images of a level floor, simulated with the scenario's texture, light and sensor. Let g be
the gradient along a row of the part of the grey image that the texture causes, and s the standard deviation of the
image noise. The standard deviation of the measured shift between two patches of p x p pixels is at least
c = sqrt(2) s / (p rms(g)) pixels (Cramér-Rao bound). Veil and unevenness of the light do not move with the floor, so
their gradients do not count: the image of a floor with the same mean albedo, but without texture, is subtracted.

Lamps light the centre of the images more than their border, so the bound depends on the position in the image. Its
ratio to the bound of the whole image is computed in blocks of the image, from the gradients of a random texture.

In turbid water most corners of the full image are noise. The estimators then bin the images (`image_scale`), and the
bound is that of the binned images, in their pixels.

Matching models the floor under a patch as a plane. Relief above or below that plane causes parallax and thus a matching
error. The unevenness is the RMS of this parallax over the patches, in pixels per unit of baseline / depth. Patches
with an edge have a far larger parallax, but they are not matched or have little weight, so their contribution is
limited.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from twin import terrains
from twin.core.geometry import BODY_FROM_DOWN_CAMERA, Array, pose
from twin.core.records import Image, StereoRig
from twin.estimate.vision import matching
from twin.estimate.vision.image_scale import BINNINGS
from twin.imaging.camera.photo_sensor import sensor_of
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
_GRAY, _CONTRAST = (
    90,
    12,
)  # mean and standard deviation per octave of the random texture of `position_dependence`, 0 to 255
_OCTAVES = 5  # number of octaves of this texture
_PATCHES = 300  # number of patches sampled to estimate the unevenness
_SAMPLES = 9  # number of height samples along each side of a patch (9 x 9 in total)


class PositionDependence(NamedTuple):
    """Dependence of matching on the position in the image, in blocks that divide the image evenly.

    Args:
        bounds: (rows, cols) Cramér-Rao bound in a block, divided by that of the whole image.
        gradients: (rows, cols) RMS gradient of an even texture in a block, divided by that of the whole image.
    """

    bounds: Array
    gradients: Array


NO_DEPENDENCE = PositionDependence(np.ones((1, 1)), np.ones((1, 1)))


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
        self._set_image_scale(scenario, illumination, terrain)
        self.dependence = position_dependence(scenario, illumination, self.medium_depth_m, self.binning)
        signal = texture_signal(scenario, illumination, terrain, self.medium_depth_m, self.binning)
        self.texture = window_texture(signal, self.dependence.gradients)
        self.unevenness_px = unevenness_px(scenario, terrain, self.depths_m, locate, self.binning)
        self.lamp_share = lamp_share(scenario, illumination)

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

    def _set_image_scale(self, scenario: Scenario, illumination: Illumination, terrain: terrains.Terrain) -> None:
        """Sets `binning`, `bounds_px` and `clear_share`.

        As in `image_scale.choose_binning`, the binning is the smallest one at which enough corners are matched, i.e.
        whose bound at the medium depth is below `_CORNERS_BOUND_PX`, or else the one with the smallest such bound; 1 if
        these bounds are infinite.
        """
        rig, best_px = scenario.believed_rig(), np.inf
        for binning in BINNINGS:
            if rig.width_px % binning or rig.height_px % binning:
                break
            bounds_px, clear_share = precision(scenario, illumination, terrain, self.depths_m, binning)
            medium_px = float(np.interp(self.medium_depth_m, self.depths_m, bounds_px))
            if binning == BINNINGS[0] or medium_px < best_px:
                best_px = medium_px
                self.binning, self.bounds_px, self.clear_share = binning, bounds_px, clear_share
            if medium_px < _CORNERS_BOUND_PX:
                break

    def bound_at(self, depth_m: float) -> float:
        """Returns the Cramér-Rao bound of a patch's position [px of the binned images] at a depth [m]."""
        return float(np.interp(depth_m, self.depths_m, self.bounds_px))

    def clear_share_at(self, depth_m: float) -> float:
        """Returns the fraction of the matches that remain in the presence of marine snow, at a depth [m]."""
        return float(np.interp(depth_m, self.depths_m, self.clear_share))

    def unevenness_at(self, depth_m: float) -> float:
        """Returns the unevenness [px of the binned images per unit of baseline / depth] at a depth [m]."""
        return float(np.interp(depth_m, self.depths_m, self.unevenness_px))


def precision(
    scenario: Scenario, illumination: Illumination, terrain: terrains.Terrain, depths_m: Array, binning: int = 1
) -> tuple[Array, Array]:
    """Returns the Cramér-Rao bound (n,) [px] and the fraction (n,) of matches that remain in snow, at depths (n,).

    Args:
        scenario: description of the survey.
        illumination: optical properties of the water, and daylight in the water.
        terrain: true floor.
        depths_m: (n,) depths of the floor along the optical axis [m].
        binning: side of the squares of pixels that are averaged to one pixel [px]; the bound is in binned pixels.
    """
    scenario = _with_linear_images(scenario)
    clear = _without_unmodelled_effects(scenario)
    rig, rng = scenario.believed_rig(), np.random.default_rng(0)
    formation = ImageFormation(clear, illumination, None, rng)
    texture, texel_m = _texture(scenario, terrain, float(max(depths_m)) * rig.width_px / rig.focal_px)
    albedos = [_albedo(texture, texel_m, rig, z) for z in depths_m]
    if not scenario.snow.density_per_m3:
        bounds = [
            _bound_px(clear, rig, formation, albedo, z, rng, binning)
            for albedo, z in zip(albedos, depths_m, strict=True)
        ]
        return np.array(bounds), np.ones(len(depths_m))
    with_snow = scenario.model_copy(update={"imaging": clear.imaging})
    formations = formation, ImageFormation(with_snow, illumination, None, rng)
    both = [
        _in_snow(scenario, rig, formations, albedo, z, binning) for albedo, z in zip(albedos, depths_m, strict=True)
    ]
    return np.array([bound for bound, _ in both]), np.array([share for _, share in both])


def _in_snow(
    scenario: Scenario,
    rig: StereoRig,
    formations: tuple[ImageFormation, ImageFormation],
    albedo: Image,
    depth_m: float,
    binning: int,
) -> tuple[float, float]:
    """Returns the Cramér-Rao bound [px] and the fraction of matches that remain in marine snow, at one depth.

    Args:
        scenario: description of the survey.
        rig: believed calibration.
        formations: image formation without and with snow.
        albedo: albedo image of the floor.
        depth_m: depth of the floor.
        binning: see `precision`.
    """
    depth, camera_pose = _level_floor(scenario, depth_m)
    clean, snowy = (
        [formation.radiance(albedo, depth, 0, pose) for pose in snow_poses(camera_pose)] for formation in formations
    )
    sensor, rng = sensor_of(scenario, rig), np.random.default_rng(0)
    setting = sensor.meter(snowy[0])
    first, second = (matching.gray(sensor.image(clean[0], setting, rng).astype(np.float32), binning) for _ in range(2))
    clean_signals, snowy_signals = (
        [matching.gray(np.minimum(255 * setting.gain * light, 255).astype(np.float32), binning) for light in lights]
        for lights in (clean, snowy)
    )
    noise = float((first - second).std()) / np.sqrt(2)
    effect = snow_effect(clean_signals, snowy_signals, noise, scenario.estimate.patch_px)
    return float(np.sqrt(effect.variance_px2)), effect.matched_share


def lamp_share(scenario: Scenario, illumination: Illumination) -> float:
    """Returns the fraction of the light reflected by a level floor at the planned altitude that is due to the lamps."""
    if not scenario.lamps or scenario.sun.illuminance_lx == 0:
        return float(bool(scenario.lamps))
    without_lamps = scenario.model_copy(update={"lamps": ()})
    sunlit, both = (_reflected_radiance(s, illumination) for s in (without_lamps, scenario))
    return 1 - sunlit / max(both, np.finfo(float).tiny)


def position_dependence(
    scenario: Scenario, illumination: Illumination, depth_m: float, binning: int = 1
) -> PositionDependence:
    """Returns the dependence of matching on the position in the image, for a level floor.

    Light, veil and blur vary over the image, and with them the gradients of a texture and the noise. The floor has a
    random texture whose statistics are the same everywhere, so the details of the true floor do not count. The squares
    of gradients and noise are averaged over each block, and their logarithms are smoothed by a polynomial in the
    position, because a block of binned images has few pixels. The result is `NO_DEPENDENCE` if a block shows no texture
    or no noise.

    Args:
        scenario: description of the survey.
        illumination: optical properties of the water, and daylight in the water.
        depth_m: depth of the floor along the optical axis.
        binning: see `precision`.
    """
    scenario = _without_unmodelled_effects(_with_linear_images(scenario))
    rig, rng = scenario.believed_rig(), np.random.default_rng(0)
    formation, sensor = ImageFormation(scenario, illumination, None, rng), sensor_of(scenario, rig)
    gradients, noise = np.zeros(_BLOCKS), np.zeros(_BLOCKS)
    for _ in range(binning):
        albedo = _random_albedo((rig.height_px, rig.width_px), binning, rng)
        radiance, untextured = _radiance_of_texture(scenario, formation, albedo, depth_m)
        setting = sensor.meter(radiance)
        signal = _texture_signal(radiance, untextured, setting.gain, binning)
        first, second = (
            matching.gray(sensor.image(radiance, setting, rng).astype(np.float32), binning) for _ in range(2)
        )
        gradients += _block_means(np.diff(signal, axis=1) ** 2)
        noise += _block_means((first - second) ** 2)
    if not gradients.min() > 1e-12 * binning or not noise.min() > 0:
        return NO_DEPENDENCE
    noise, gradients = (_smooth(values) / values.mean() for values in (noise, gradients))
    return PositionDependence(np.sqrt(noise / gradients), np.sqrt(gradients))


def _random_albedo(shape: tuple[int, int], binning: int, rng: np.random.Generator) -> Image:
    """Returns an albedo image (height_px, width_px, 3) of a grey random texture with equal variance in each octave.

    Args:
        shape: height and width [px].
        binning: side of the smallest structures [px].
        rng: random generator.
    """
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


def texture_signal(
    scenario: Scenario, illumination: Illumination, terrain: terrains.Terrain, depth_m: float, binning: int = 1
) -> NDArray[np.floating]:
    """Returns the part (rows, cols) of the grey image of a level floor that its texture causes [grey levels].

    Noise, shadows and marine snow are absent.

    Args:
        scenario: description of the survey.
        illumination: optical properties of the water, and daylight in the water.
        terrain: true floor.
        depth_m: depth of the floor along the optical axis.
        binning: see `precision`.
    """
    clear = _without_unmodelled_effects(_with_linear_images(scenario))
    rig = clear.believed_rig()
    formation = ImageFormation(clear, illumination, None, np.random.default_rng(0))
    texture, texel_m = _texture(clear, terrain, depth_m * rig.width_px / rig.focal_px)
    albedo = _albedo(texture, texel_m, rig, depth_m)
    radiance, untextured = _radiance_of_texture(clear, formation, albedo, depth_m)
    gain = sensor_of(clear, rig).meter(radiance).gain
    return _texture_signal(radiance, untextured, gain, binning)


def _reflected_radiance(scenario: Scenario, illumination: Illumination) -> float:
    """Returns the radiance due to light reflected by a white floor at the planned altitude [cd/m2].

    It is the difference between the images of a white and a black floor, which removes the veil, averaged over pixels
    and colour channels.
    """
    scenario = _without_unmodelled_effects(scenario)
    formation = ImageFormation(scenario, illumination, None, np.random.default_rng(0))
    depth, camera_pose = _level_floor(scenario, scenario.plan.altitude_m)
    albedos = (np.full((*depth.shape, 3), level, np.uint8) for level in (255, 0))
    white, black = (formation.radiance(albedo, depth, 0, camera_pose) for albedo in albedos)
    return float(np.mean(white - black))


def _level_floor(scenario: Scenario, depth_m: float) -> tuple[Depth, StampedPose]:
    """Returns a depth image (height_px, width_px) of constant depth [m], and a camera pose at the planned altitude.

    The depth image is that of a level floor seen vertically from above.
    """
    rig, altitude_m = scenario.believed_rig(), scenario.plan.altitude_m
    world_from_left = pose(BODY_FROM_DOWN_CAMERA, np.array([0.0, 0.0, altitude_m]))
    return np.full((rig.height_px, rig.width_px), depth_m, np.float32), StampedPose(world_from_left, 0.0)


def _with_linear_images(scenario: Scenario) -> Scenario:
    """Returns the scenario with a linear tone curve and the white balance of white light.

    Tone curve and white balance scale texture and noise of a pixel alike, so they do not change the bound.
    """
    if scenario.sensor is None:
        return scenario
    linear = {"tone_curve": "linear", "white_balance": "white_light"}
    return scenario.model_copy(update={"sensor": scenario.sensor.model_copy(update=linear)})


def _without_unmodelled_effects(scenario: Scenario) -> Scenario:
    """Returns the scenario without shadows, which the surrogate does not model, and without marine snow."""
    imaging = scenario.imaging.model_copy(update={"shadows": False})
    snow = scenario.snow.model_copy(update={"density_per_m3": 0.0})
    return scenario.model_copy(update={"imaging": imaging, "snow": snow})


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
        scenario: description of the survey.
        terrain: true floor.
        depths_m: (n,) depths of the floor along the optical axis [m].
        locate: maps fractions (..., 2) of the planned area's extent along and across the legs, -0.5 to 0.5 from its
            centre, to world (x, y) (..., 2) [m]; None: the area is centred at the origin, with legs along x.
        binning: see `precision`.
    """
    focal_px, patch_px = scenario.believed_rig().binned(binning).focal_px, scenario.estimate.patch_px
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


def _bound_px(
    scenario: Scenario,
    rig: StereoRig,
    formation: ImageFormation,
    albedo: Image,
    depth_m: float,
    rng: np.random.Generator,
    binning: int,
) -> float:
    """Returns the Cramér-Rao bound [px of the binned images] for a level floor at a depth, with an albedo image."""
    radiance, untextured = _radiance_of_texture(scenario, formation, albedo, depth_m)
    sensor = sensor_of(scenario, rig)
    setting = sensor.meter(radiance)
    signal = _texture_signal(radiance, untextured, setting.gain, binning)
    first, second = (matching.gray(sensor.image(radiance, setting, rng).astype(np.float32), binning) for _ in range(2))
    noise = float((first - second).std()) / np.sqrt(2)
    gradient = float(np.sqrt(np.mean(np.diff(signal, axis=1) ** 2)))
    return np.sqrt(2) * noise / (scenario.estimate.patch_px * max(gradient, 1e-6))


def _radiance_of_texture(
    scenario: Scenario, formation: ImageFormation, albedo: Image, depth_m: float
) -> tuple[Radiance, Radiance]:
    """Returns the radiances (H, W, 3) of a level floor at a depth: with an albedo image, and with its mean colour."""
    depth, camera_pose = _level_floor(scenario, depth_m)
    textured, untextured = (formation.radiance(image, depth, 0, camera_pose) for image in (albedo, _untextured(albedo)))
    return textured, untextured


def _texture_signal(textured: Radiance, untextured: Radiance, gain: float, binning: int) -> NDArray[np.floating]:
    """Returns the difference (rows, cols) that the texture makes in the binned grey image [grey levels].

    Args:
        textured: radiance (H, W, 3) of the floor.
        untextured: radiance (H, W, 3) of a floor of its mean colour.
        gain: pixel value per unit of radiance; a saturated pixel has the value 1.
        binning: see `precision`.
    """
    lit, smooth = (
        matching.gray(np.minimum(255 * gain * light, 255).astype(np.float32), binning)
        for light in (textured, untextured)
    )
    return lit - smooth


def _untextured(albedo: Image) -> Image:
    """Returns an albedo image of constant colour, the mean of the given image (height_px, width_px, 3)."""
    return np.broadcast_to(albedo.mean(axis=(0, 1)).round().astype(np.uint8), albedo.shape).copy()


def _texture(scenario: Scenario, terrain: terrains.Terrain, extent_m: float) -> tuple[Image, float]:
    """Returns the texture of the floor's photos or mesh, or else a generated one, and its texel size [m].

    Args:
        scenario: description of the survey.
        terrain: true floor.
        extent_m: side length of the generated texture, limited by the size of the terrain.
    """
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
    """Returns the generated texture of the central part of a floor from a file, and its texel size [m].

    The part has at least 5 x 5 nodes, where the floor has as many.
    """
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
