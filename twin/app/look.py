"""One look through the cameras, taken apart: how water and lamps make an image, before anything is flown."""

from __future__ import annotations

from typing import Any, NamedTuple

import cv2
import numpy as np

from twin.core import geometry
from twin.core.geometry import Array
from twin.core.timing import Stopwatch
from twin.errors import TwinError
from twin.imaging.camera import Anatomy, Shot
from twin.imaging.renderer import NEAR_M
from twin.report.wording import DASH, percent
from twin.world.mission import Mission
from twin.world.rendered_world import RenderedWorld

#: Side of the window in which contrast is told, as a share of the image's width.
WINDOW_SHARE = 1 / 20
#: A channel of this value and above is full [of 255].
FULL = 255


_WORDS = {
    "gray_level": "gray level, of full scale",
    "contrast": "contrast, local deviation by mean",
    "veil_share": "share of the veil in the light",
    "saturated_share": "saturated pixels",
    "snr": "signal by noise",
    "texture_snr": "texture by noise",
}


class Look(NamedTuple):
    """The stereo pair at a place, and the left image taken apart."""

    world_from_left: Array
    shot: Shot
    anatomy: Anatomy


def look(mission: Mission, at_m: tuple[float, float, float] | None = None) -> Look:
    """Looks straight down, bow to the east.

    Args:
        at_m: position of the left camera in the world [m]; above the middle of the survey where None.
    Raises:
        TwinError: the cameras or a lamp would be in the floor, or beside it.
    """
    place = (0.0, 0.0, mission.scenario.plan.altitude_m) if at_m is None else at_m
    world_from_left = geometry.pose(geometry.BODY_FROM_DOWN_CAMERA, np.array(place))
    _check_place(mission, world_from_left)
    with RenderedWorld(mission, Stopwatch()) as world:
        anatomy = world.camera.dissect(world_from_left)
        return Look(world_from_left, world.camera.shoot(world_from_left, stereo=True), anatomy)


def parse_place(text: str) -> tuple[float, float, float]:
    """X,Y,Z in metres."""
    try:
        x, y, z = (float(part) for part in text.split(","))
    except ValueError:
        raise TwinError("--at", f"{text!r} is no place", "X,Y,Z of the left camera [m], as in 0.5,-1,2") from None
    if not np.isfinite([x, y, z]).all():
        raise TwinError("--at", f"{text!r} is no place", "finite numbers")
    return x, y, z


def _check_place(mission: Mission, world_from_left: Array) -> None:
    """Both cameras and all lamps are over the floor and above it."""
    rig = mission.rig
    world_from_body = world_from_left @ geometry.inverse(rig.body_from_camera)
    eyes = [world_from_left[:3, 3], (world_from_left @ rig.left_from_right)[:3, 3]]
    for name, eye in zip(("the left camera", "the right camera"), eyes, strict=True):
        _check_above(mission, "--at", name, eye, world_from_left)
    for k, lamp in enumerate(mission.scenario.lamps):
        position = geometry.transform(world_from_body, np.array([lamp.position_m]))[0]
        _check_above(mission, f"lamps.{k}.position_m", f"lamp {k}", position, world_from_left)


def _check_above(mission: Mission, field: str, name: str, position: Array, world_from_left: Array) -> None:
    terrain = mission.terrain
    x, y, z = position
    floor_m = float(terrain.height_at(x, y))
    if np.isnan(floor_m):
        raise TwinError(
            field, f"{name} at ({x:g}, {y:g}) lies outside the terrain",
            f"x {terrain.west_m:.2f} to {terrain.east_m:.2f}, y {terrain.south_m:.2f} to {terrain.north_m:.2f} m",
        )  # fmt: skip
    if z < floor_m + NEAR_M:
        lift = world_from_left[2, 3] + floor_m + NEAR_M - z
        raise TwinError(
            field, f"{name} at z {z:.3f} m lies in the floor or on it ({floor_m:.3f} m)", f"--at ...,{lift:.2f} or more"
        )


def figures(seen: Look) -> dict[str, Any]:
    """What the image is worth, for each band R, G, B.

    `contrast`: median over the image of local deviation by local mean, without noise; `veil_share`: share of the veil
    in all light; `saturated_share`: pixels that are full; `snr`: mean signal by deviation of the noise; `texture_snr`:
    median local deviation of the image by that of the noise, which is what matching lives on.
    """
    a = seen.anatomy
    signal = a.layers.total.astype(np.float64) * a.gain
    side = max(3, round(signal.shape[1] * WINDOW_SHARE) | 1)
    mean = cv2.blur(signal, (side, side))
    deviation = np.sqrt(np.maximum(cv2.blur(signal**2, (side, side)) - mean**2, 0))
    noise = noise_of(seen).std(axis=(0, 1)) / 255
    with np.errstate(divide="ignore", invalid="ignore"):
        table = {
            "gray_level": seen.shot.left.mean(axis=(0, 1)) / 255,
            "contrast": np.median(deviation / mean, axis=(0, 1)),
            "veil_share": a.layers.veil.mean(axis=(0, 1), dtype=np.float64)
            / a.layers.total.mean(axis=(0, 1), dtype=np.float64),
            "saturated_share": (seen.shot.left >= FULL).mean(axis=(0, 1)),
            "snr": seen.shot.left.mean(axis=(0, 1)) / 255 / noise,
            "texture_snr": np.median(deviation, axis=(0, 1)) / noise,
        }
    range_m = float(np.median(seen.shot.depth_left))
    place = {"at_m": seen.world_from_left[:3, 3].tolist(), "depth_median_m": _number(range_m)}
    return place | _exposure(a) | {name: [_number(v) for v in values] for name, values in table.items()}


def _exposure(anatomy: Anatomy) -> dict[str, float]:
    """Time and gain of a physical sensor."""
    if anatomy.raw is None:
        return {}
    return {"exposure_ms": 1000 * anatomy.setting.exposure_s, "analogue_gain": anatomy.setting.analogue_gain}


def table(told: dict[str, Any]) -> list[tuple[str, ...]]:
    """The figures in words."""
    percent_of = {"gray_level", "veil_share", "saturated_share"}
    rows = [
        (what, *(DASH if v is None else percent(v) if name in percent_of else f"{v:.3g}" for v in told[name]))
        for name, what in _WORDS.items()
    ]
    return [("", "red", "green", "blue"), *rows]


def noise_of(seen: Look) -> Array:
    """(H, W, 3) left image less the one without noise [gray levels of 255]."""
    return seen.shot.left.astype(np.float64) - seen.anatomy.clean


def _number(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
