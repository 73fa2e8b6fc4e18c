"""Rendering of one stereo pair without a survey; light components and quality measures of its left image."""

from __future__ import annotations

from typing import Any, NamedTuple

import cv2
import numpy as np

from twin.core import geometry
from twin.core.geometry import Array
from twin.core.timing import Stopwatch
from twin.errors import TwinError
from twin.imaging.scene.renderer import NEAR_M
from twin.imaging.stereo_camera import AT_REST, DecomposedImage, StereoCapture
from twin.report.wording import DASH, percent
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
    """Stereo pair at one pose, with the light components of the left image.

    Args:
        world_from_left: (4, 4) pose of the left camera.
        stereo_pair: the stereo pair, with noise.
        decomposed: the left image without noise, with albedo, depth, exposure and light components.
    """

    world_from_left: Array
    stereo_pair: StereoCapture
    decomposed: DecomposedImage


def render_view(
    mission: Mission, at_m: tuple[float, float, float] | None = None, twist_body: Array | None = None
) -> ViewLayers:
    """Renders a stereo pair and the light components of its left image.

    The cameras look straight down, and the bow has the heading of the survey area (`SurveyArea.heading`).

    Args:
        mission: the survey.
        at_m: position of the left camera in the world [m]; None: above the centre of the survey area, at the
            planned altitude above the reference plane.
        twist_body: (6,) [angular, linear] velocity of the body in its own axes during the exposure [rad/s, m/s];
            None: at rest.

    Raises:
        TwinError: a camera or a lamp is outside the terrain, or less than `NEAR_M` above the sea floor, or a velocity
            is given without a section [sensor], which has the exposure time.
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
    """Returns the position (x, y, z) [m] of a text X,Y,Z. Raises TwinError unless it is three finite numbers."""
    try:
        x, y, z = (float(part) for part in text.split(","))
    except ValueError:
        raise TwinError("--at", f"{text!r} is not a position", "X,Y,Z of the left camera [m], as in 0.5,-1,2") from None
    if not np.isfinite([x, y, z]).all():
        raise TwinError("--at", f"{text!r} is not a position", "finite numbers")
    return x, y, z


def parse_twist(text: str) -> Array:
    """Returns the twist (6,) [angular, linear] in [rad/s, m/s] of a text VX,VY,VZ,WX,WY,WZ in [m/s] and [deg/s].

    Raises:
        TwinError: the text is not six finite numbers.
    """
    try:
        values = np.array([float(part) for part in text.split(",")])
    except ValueError:
        values = np.empty(0)
    if len(values) != 6 or not np.isfinite(values).all():
        raise TwinError(
            "--twist", f"{text!r} is not a velocity", "VX,VY,VZ,WX,WY,WZ [m/s, deg/s], as in 0.5,0,0,0,0,20"
        )
    return np.concatenate([np.deg2rad(values[3:]), values[:3]])


def _check_rig(mission: Mission, world_from_left: Array) -> None:
    """Raises TwinError unless both cameras and all lamps are over the terrain, at least `NEAR_M` above the floor."""
    rig = mission.rig
    world_from_body = world_from_left @ geometry.inverse(rig.body_from_camera)
    cameras = [world_from_left[:3, 3], (world_from_left @ rig.left_from_right)[:3, 3]]
    for name, position in zip(("the left camera", "the right camera"), cameras, strict=True):
        _check_above(mission, "--at", name, position, world_from_left)
    for k, lamp in enumerate(mission.scenario.lamps):
        position = geometry.transform(world_from_body, np.array([lamp.position_m]))[0]
        _check_above(mission, f"lamps.{k}.position_m", f"lamp {k}", position, world_from_left)


def _check_above(mission: Mission, field: str, name: str, position: Array, world_from_left: Array) -> None:
    """Raises TwinError unless a position is over the terrain and at least `NEAR_M` above the sea floor.

    Args:
        mission: the survey.
        field, name: option or scenario key, and name of the camera or lamp, for the error.
        position: (3,) position of the camera or lamp in the world [m].
        world_from_left: (4, 4) pose of the left camera, from which the error computes the lowest allowed `--at`.
    """
    terrain = mission.terrain
    x, y, z = position
    floor_m = float(terrain.height_at(x, y))
    if np.isnan(floor_m):
        raise TwinError(
            field, f"{name} at ({x:g}, {y:g}) is outside the terrain",
            f"x {terrain.west_m:.2f} to {terrain.east_m:.2f}, y {terrain.south_m:.2f} to {terrain.north_m:.2f} m",
        )  # fmt: skip
    if z < floor_m + NEAR_M:
        lift = world_from_left[2, 3] + floor_m + NEAR_M - z
        raise TwinError(
            field, f"{name} at z {z:.3f} m is not above the sea floor ({floor_m:.3f} m)", f"--at ...,{lift:.2f} or more"
        )


def image_quality(view: ViewLayers) -> dict[str, Any]:
    """Computes measures of the quality of the left image.

    Returns:
        Position of the left camera in the world [m] and median depth [m]; with a section [sensor], exposure time [ms]
        and analogue gain; and lists of three values for R, G, B, where None is an undefined value. `gray_level`: mean,
        as a fraction of full scale. `contrast`: median over the image of local standard deviation / local mean, without
        noise, in windows of about `WINDOW_SHARE` of the image width. `veil_share`: fraction of the light that is
        backscatter. `saturated_share`: fraction of saturated pixels. `snr`: mean / standard deviation of the noise.
        `texture_snr`: median local standard deviation of the image without noise / standard deviation of the noise; a
        low value limits matching.
    """
    a = view.decomposed
    signal = a.components.total.astype(np.float64) * a.gain if a.linear else a.noise_free / 255
    side = max(3, round(signal.shape[1] * WINDOW_SHARE) | 1)
    mean = cv2.blur(signal, (side, side))
    local_sigma = np.sqrt(np.maximum(cv2.blur(signal**2, (side, side)) - mean**2, 0))
    noise = noise_image(view).std(axis=(0, 1)) / 255
    with np.errstate(divide="ignore", invalid="ignore"):
        values = {
            "gray_level": view.stereo_pair.left.mean(axis=(0, 1)) / 255,
            "contrast": np.median(local_sigma / mean, axis=(0, 1)),
            "veil_share": a.components.backscatter.mean(axis=(0, 1), dtype=np.float64)
            / a.components.total.mean(axis=(0, 1), dtype=np.float64),
            "saturated_share": (view.stereo_pair.left >= SATURATED).mean(axis=(0, 1)),
            "snr": view.stereo_pair.left.mean(axis=(0, 1)) / 255 / noise,
            "texture_snr": np.median(local_sigma, axis=(0, 1)) / noise,
        }
    range_m = float(np.median(view.stereo_pair.depth_left))
    position = {"at_m": view.world_from_left[:3, 3].tolist(), "depth_median_m": _number(range_m)}
    return position | _exposure(a) | {name: [_number(v) for v in bands] for name, bands in values.items()}


def _exposure(decomposed: DecomposedImage) -> dict[str, float]:
    """Returns exposure time [ms] and analogue gain of a physical sensor; empty without a section [sensor]."""
    if decomposed.raw is None:
        return {}
    return {"exposure_ms": 1000 * decomposed.setting.exposure_s, "analogue_gain": decomposed.setting.analogue_gain}


def quality_rows(quality: dict[str, Any]) -> list[tuple[str, ...]]:
    """Returns the R, G, B values of `image_quality` as the rows of a table: label, red, green, blue."""
    percent_of = {"gray_level", "veil_share", "saturated_share"}
    rows = [
        (label, *(DASH if v is None else percent(v) if name in percent_of else f"{v:.3g}" for v in quality[name]))
        for name, label in _LABELS.items()
    ]
    return [("", "red", "green", "blue"), *rows]


def noise_image(view: ViewLayers) -> Array:
    """Returns the image noise (H, W, 3): left image minus the same image without noise [grey levels of 8 bits]."""
    return view.stereo_pair.left.astype(np.float64) - view.decomposed.noise_free


def _number(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
