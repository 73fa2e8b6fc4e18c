"""Rendering of one stereo pair without a survey; light components and quality measures of its left image."""

from typing import Any, NamedTuple

import cv2
import numpy as np

from twin.core import geometry
from twin.core.geometry import Array
from twin.core.timing import Stopwatch
from twin.errors import TwinError
from twin.imaging.scene.renderer import NEAR_M
from twin.imaging.stereo_camera import AT_REST, DecomposedImage, StereoCapture
from twin.judge.summary_statistics import finite_tree
from twin.report.number_formats import DASH, percent
from twin.world.mission import Mission
from twin.world.rendered_world import RenderedWorld

#: Side of the window in which contrast is computed, as a fraction of the image width.
WINDOW_SHARE = 1 / 20
#: Grey level at which a channel of a pixel is saturated.
SATURATED = 255

_LABELS = {
    "gray_level": "grey level, fraction of full scale",
    "contrast": "contrast, local standard deviation / mean",
    "veil_share": "backscatter, fraction of the light",
    "saturated_share": "saturated pixels",
    "snr": "signal-to-noise ratio",
    "texture_snr": "texture-to-noise ratio",
}


class ViewLayers(NamedTuple):
    """Stereo pair at one pose, with the light components of the left image."""

    world_from_left: Array  #: (4, 4) pose of the left camera
    stereo_pair: StereoCapture  #: the stereo pair, with noise
    #: the left image without noise, with albedo, depth, exposure and light components
    decomposed: DecomposedImage

    @property
    def noise(self) -> Array:
        """Returns the noise (H, W, 3) of the left image [grey levels of 8 bits]."""
        return self.stereo_pair.left.astype(np.float64) - self.decomposed.noise_free


def render_view(
    mission: Mission, at_m: tuple[float, float, float] | None = None, twist_body: Array | None = None
) -> ViewLayers:
    """Renders a stereo pair and the light components of its left image; the arguments are those of `twin.look`.

    The cameras look straight down, and the bow has the heading of the survey area (`SurveyArea.heading`). Raises
    TwinError if a camera or a lamp is outside the terrain, or less than `NEAR_M` above the sea floor, or a velocity is
    given without a section [sensor], which has the exposure time.
    """
    if twist_body is not None and mission.scenario.sensor is None:
        raise TwinError("--twist", "the scenario has no exposure time", "with a section [sensor]: --set sensor.bits=12")
    twist = AT_REST if twist_body is None else twist_body
    area = mission.plan.area
    position_m = (*area.centre_m, mission.scenario.plan.altitude_m) if at_m is None else at_m
    world_from_left = geometry.pose(geometry.rotations_of_down_camera(np.asarray(area.heading)), np.array(position_m))
    _check_rig(mission, world_from_left)
    with RenderedWorld(mission, Stopwatch()) as world:
        decomposed = world.camera.decompose(world_from_left, twist)
        stereo_pair = world.camera.capture(world_from_left, stereo=True, twist_body=twist)
        return ViewLayers(world_from_left, stereo_pair, decomposed)


def parse_position(text: str) -> tuple[float, float, float]:
    x, y, z = _numbers(text, "--at", "position", "X,Y,Z of the left camera [m], as in 0.5,-1,2")
    return x, y, z


def parse_twist(text: str) -> Array:
    """Returns the twist (6,) [angular, linear] in [rad/s, m/s] of a text VX,VY,VZ,WX,WY,WZ in [m/s] and [deg/s]."""
    values = _numbers(text, "--twist", "velocity", "VX,VY,VZ,WX,WY,WZ [m/s, deg/s], as in 0.5,0,0,0,0,20")
    return np.concatenate([np.deg2rad(values[3:]), values[:3]])


def _numbers(text: str, option: str, meaning: str, allowed: str) -> list[float]:
    """Returns the finite numbers of a text; there must be as many as in the example at the end of `allowed`."""
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        values = []
    if len(values) != allowed.split()[-1].count(",") + 1 or not np.isfinite(values).all():
        raise TwinError(option, f"{text!r} is not a {meaning}", allowed)
    return values


def _check_rig(mission: Mission, world_from_left: Array) -> None:
    """Raises TwinError unless both cameras and all lamps are over the terrain, at least `NEAR_M` above the floor."""
    rig, lamps = mission.rig, mission.scenario.lamps
    world_from_body = world_from_left @ geometry.inverse(rig.body_from_camera)
    positions = {
        ("--at", "the left camera"): world_from_left[:3, 3],
        ("--at", "the right camera"): (world_from_left @ rig.left_from_right)[:3, 3],
    } | {
        (f"lamps.{k}.position_m", f"lamp {k}"): geometry.transform(world_from_body, np.array([lamp.position_m]))[0]
        for k, lamp in enumerate(lamps)
    }
    terrain = mission.terrain
    for (field, name), (x, y, z) in positions.items():
        floor_m = float(terrain.height_at(x, y))
        if np.isnan(floor_m):
            inside = (
                f"x {terrain.west_m:.2f} to {terrain.east_m:.2f}, y {terrain.south_m:.2f} to {terrain.north_m:.2f} m"
            )
            raise TwinError(field, f"{name} at ({x:g}, {y:g}) is outside the terrain", inside)
        if z < floor_m + NEAR_M:
            lowest = f"--at ...,{world_from_left[2, 3] + floor_m + NEAR_M - z:.2f} or more"
            raise TwinError(field, f"{name} at z {z:.3f} m is not above the sea floor ({floor_m:.3f} m)", lowest)


def image_quality(view: ViewLayers) -> dict[str, Any]:
    """Returns measures of the quality of the left image, by name.

    These are position of the left camera in the world [m] and median depth [m]; with a section [sensor], exposure time
    [ms] and analogue gain; and lists of three values for R, G, B, where None is an undefined value. `gray_level`: mean,
    as a fraction of full scale. `contrast`: median over the image of local standard deviation / local mean, without
    noise (with a linear tone curve also without motion blur), in windows of about `WINDOW_SHARE` of the image width.
    `veil_share`: fraction of the light that is backscatter. `saturated_share`: fraction of saturated pixels. `snr`:
    mean / standard deviation of the noise. `texture_snr`: median local standard deviation of the image without noise /
    standard deviation of the noise; a low value limits matching.
    """
    a, left = view.decomposed, view.stereo_pair.left
    signal = a.components.total.astype(np.float64) * a.setting.gain if a.linear else a.noise_free / 255
    side = max(3, round(signal.shape[1] * WINDOW_SHARE) | 1)
    mean = cv2.blur(signal, (side, side))
    local_sigma = np.sqrt(np.maximum(cv2.blur(signal**2, (side, side)) - mean**2, 0))
    noise, level = view.noise.std(axis=(0, 1)) / 255, left.mean(axis=(0, 1)) / 255
    backscatter, total = (x.mean(axis=(0, 1), dtype=np.float64) for x in (a.components.backscatter, a.components.total))
    quality: dict[str, Any] = {
        "at_m": view.world_from_left[:3, 3],
        "depth_median_m": np.median(view.stereo_pair.depth_left),
    }
    if a.raw is not None:
        quality |= {"exposure_ms": 1000 * a.setting.exposure_s, "analogue_gain": a.setting.analogue_gain}
    with np.errstate(divide="ignore", invalid="ignore"):
        quality |= {
            "gray_level": level,
            "contrast": np.median(local_sigma / mean, axis=(0, 1)),
            "veil_share": backscatter / total,
            "saturated_share": (left >= SATURATED).mean(axis=(0, 1)),
            "snr": level / noise,
            "texture_snr": np.median(local_sigma, axis=(0, 1)) / noise,
        }
    return finite_tree(quality)


def quality_rows(quality: dict[str, Any]) -> list[tuple[str, ...]]:
    percent_of = {"gray_level", "veil_share", "saturated_share"}
    rows = [
        (label, *(DASH if v is None else percent(v) if name in percent_of else f"{v:.3g}" for v in quality[name]))
        for name, label in _LABELS.items()
    ]
    return [("", "red", "green", "blue"), *rows]
