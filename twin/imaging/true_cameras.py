"""The true cameras behind the believed ones: what is rendered, what each raw pixel sees of it, how frames are made.

The floor is rendered as two parallel pinholes in water see it, wider than the frames where need be. Each pixel of a
raw image looks along a ray of its own through lens and port; the light it gathers is found where that ray meets the
rendered depth. The sensor makes a raw image of it, and a frame is that image rectified by the believed calibration.
Where truth and belief agree and both are pinholes there is nothing to do, and nothing is done.

The sensor has the rig's pixels and as many more at its border as the frames need.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from twin.core import geometry
from twin.core.records import Image, StereoRig
from twin.errors import TwinError
from twin.imaging import lens as lenses
from twin.imaging import port as ports
from twin.imaging import resample
from twin.imaging.lens import Distortion
from twin.imaging.port import Pinhole
from twin.imaging.resample import Places
from twin.scenario.model import CalibrationErrorConfig, PortConfig, Scenario

Array = NDArray[np.float64]
Radiance = NDArray[np.float32]
Depth = NDArray[np.float32]

NEAREST_M = 0.3  # what lies nearer may be cut at the border
MARGIN_STEP_PX = 8  # of what is rendered beside the frame: keeps its size as even as the frame's
WIDEST_TANGENT = 5.0  # of half a view, that of the lens and what is rendered for it


class Camera(NamedTuple):
    """One camera, true or believed, in the axes of its believed eye.

    Args:
        focal_px: of the lens, in air behind a port.
        principal_px: (2,) column and row.
        lens, port: what bends its rays.
        like: the pinhole in water that it is near its axis.
        eye_from_camera: (3, 3) its turn about that pinhole.
    """

    focal_px: float
    principal_px: Array
    lens: Distortion
    port: PortConfig
    like: Pinhole
    eye_from_camera: Array

    def rays(self, pixels: Array) -> tuple[Array, Array]:
        """Origin [m] and direction (..., 3) of what pixels (..., 2) look at; NaN where they are blind."""
        air = lenses.undistort((pixels - self.principal_px) / self.focal_px, self.lens)
        if self.port.kind == "none":
            air = air / self.like.focal_ratio
        origin, direction = ports.water_rays(self.port, air)
        origin = origin - [0.0, 0.0, self.like.centre_m]
        return origin @ self.eye_from_camera.T, direction @ self.eye_from_camera.T

    def pixels(self, points_m: Array) -> Array:
        """Where points (..., 3) are seen (..., 2) [px]; NaN where they are not, or far off the axis."""
        points_m = points_m @ self.eye_from_camera + [0.0, 0.0, self.like.centre_m]
        air = ports.air_tangents(self.port, points_m)
        if self.port.kind == "none":
            air = air * self.like.focal_ratio
        off_axis = np.hypot(air[..., :1], air[..., 1:])
        air = np.where(off_axis < min(lenses.fold(self.lens), WIDEST_TANGENT), air, np.nan)
        return lenses.distort(air, self.lens) * self.focal_px + self.principal_px


class Eye(NamedTuple):
    """What the pixels of a raw image (h, w) look at in the rendered one.

    Args:
        places: of what is infinitely far.
        shift_px_m: by how much nearer things lie beside, times their depth; None without a port.
    """

    places: Places
    shift_px_m: Places | None


@dataclass(frozen=True)
class View:
    """How an ideal rendering becomes the frames of a rig.

    Args:
        rig: what is rendered: the believed rig with the true baseline, and wider images.
        margin_px: (columns, rows) of the rendered image to each side of the frame.
        sensor: size of the raw images, and the focal length of the lens before it, in air behind a port.
        eyes: left and right; None where the rendering is the raw image.
        rectification: where the frame's pixels lie in the raw image; None where it is the frame.
        cameras, believed: the true ones, left and right, and the one that both are taken for.
        plane_m: depth for which frames are rectified.
    """

    rig: StereoRig
    margin_px: tuple[int, int]
    sensor: StereoRig
    eyes: tuple[Eye, Eye] | None
    rectification: Places | None
    cameras: tuple[Camera, Camera]
    believed: Camera
    plane_m: float

    def raw(self, light: Radiance, depth: Depth, eye: int) -> Radiance:
        """The light (h, w, 3) that the pixels of an eye's sensor gather of what is rendered."""
        if self.eyes is None:
            return light
        places, shift = self.eyes[eye]
        return resample.gather(light, places if shift is None else resample.meet(depth, places, shift))

    def frame(self, raw: Image) -> Image:
        """The raw image of either camera, rectified by the believed calibration."""
        return raw if self.rectification is None else resample.interpolate(raw, self.rectification)

    def crop(self, rendered: NDArray[Any]) -> NDArray[Any]:
        """The part of something rendered that the believed pinhole sees."""
        (x, y), (height, width) = self.margin_px, rendered.shape[:2]
        return np.ascontiguousarray(rendered[y : height - y, x : width - x]) if x or y else rendered

    def project(self, points_m: Array, eye: int = 0) -> Array:
        """Where in a frame points (n, 3) in the axes of an ideal eye are seen (n, 2); NaN where they are not."""
        rig = self.rig
        if self.eyes is None:
            return rig.project(points_m)
        ahead = np.where(points_m[:, 2:] > 1e-3, points_m, np.nan)
        origin, direction = self.believed.rays(self.cameras[eye].pixels(ahead))
        at = origin + direction * ((self.plane_m - origin[:, 2]) / direction[:, 2])[:, None]
        centre = [rig.cx_px - self.margin_px[0], rig.cy_px - self.margin_px[1]]
        return at[:, :2] / self.plane_m * rig.focal_px + centre


def make_view(scenario: Scenario) -> View:
    """The view of a scenario.

    Raises:
        TwinError: light does not come through the port, the lens folds the image, or the view is too wide.
    """
    believed_rig, calibration = scenario.believed_rig(), scenario.calibration_error
    _check_port(scenario.port)
    true_rig = replace(believed_rig, baseline_m=believed_rig.baseline_m * (1 + calibration.baseline_error))
    cameras, believed = _true_cameras(scenario), _believed_camera(scenario)
    calibrated = scenario.port.kind != "none" and scenario.port.calibrated_at_m > 0
    plane_m = scenario.port.calibrated_at_m if calibrated else 1.0
    if _is_ideal(scenario, believed):
        return View(true_rig, (0, 0), true_rig, None, None, cameras, believed, plane_m)
    rectification = None
    border = np.zeros(2, np.int64)
    if calibrated or any(believed.lens):
        rectification = _rectification(believed, believed_rig, plane_m)
        border = _beyond(rectification, believed_rig)
        rectification = rectification + border
    pixels = _grid(believed_rig, border)
    looks = [_look(camera, pixels, believed_rig) for camera in cameras]
    margin = _margin(looks, believed_rig)
    sensor = replace(_widened(true_rig, border), focal_px=cameras[0].focal_px)
    eyes = [Eye((places + margin).astype(np.float32), _or_none(shift)) for places, shift in looks]
    return View(
        _widened(true_rig, margin), (int(margin[0]), int(margin[1])), sensor, (eyes[0], eyes[1]),
        None if rectification is None else rectification.astype(np.float32), cameras, believed, plane_m,
    )  # fmt: skip


def _true_cameras(scenario: Scenario) -> tuple[Camera, Camera]:
    calibration, like, rig = scenario.calibration_error, ports.pinhole(scenario.port), scenario.believed_rig()
    focal_px = rig.focal_px / like.focal_ratio * (1 + calibration.focal_error)
    lens = lenses.true_lens(scenario.lens)
    errors = (calibration.left_principal_point_error_px, calibration.right_principal_point_error_px)
    turns = (np.eye(3), right_turn(calibration))
    left, right = (
        Camera(focal_px, np.array([rig.cx_px, rig.cy_px]) + error, lens, scenario.port, like, turn)
        for error, turn in zip(errors, turns, strict=True)
    )
    return left, right


def _believed_camera(scenario: Scenario) -> Camera:
    """The camera that frames are rectified for; a port that was not calibrated is a change of focal length."""
    rig, like = scenario.believed_rig(), ports.pinhole(scenario.port)
    lens = lenses.believed_lens(scenario.lens, scenario.calibration_error)
    port = scenario.port
    if not port.calibrated_at_m:
        port, like = PortConfig(), Pinhole(0.0, like.focal_ratio)
    return Camera(rig.focal_px / like.focal_ratio, np.array([rig.cx_px, rig.cy_px]), lens, port, like, np.eye(3))


def right_turn(calibration: CalibrationErrorConfig) -> Array:
    """(3, 3) turn of the right camera in its believed axes: yaw about y (down), pitch about x (right), roll about z."""
    roll, pitch, yaw = np.deg2rad([calibration.right_roll_deg, calibration.right_pitch_deg, calibration.right_yaw_deg])
    x, y, z = np.eye(3)
    return geometry.so3_exp(yaw * y) @ geometry.so3_exp(pitch * x) @ geometry.so3_exp(roll * z)


def _is_ideal(scenario: Scenario, believed: Camera) -> bool:
    """Whether both cameras are the believed pinholes, apart from the baseline."""
    same = scenario.calibration_error.model_copy(update={"baseline_error": 0.0}) == CalibrationErrorConfig()
    return same and scenario.port.kind == "none" and not any(lenses.true_lens(scenario.lens)) and not any(believed.lens)


def _rectification(believed: Camera, rig: StereoRig, plane_m: float) -> Array:
    """Where (H, W, 2) in the raw image the pixels of the frame lie."""
    tangents = (_grid(rig) - [rig.cx_px, rig.cy_px]) / rig.focal_px
    points_m = np.concatenate([tangents, np.ones_like(tangents[..., :1])], axis=-1) * plane_m
    places = believed.pixels(points_m)
    if not np.isnan(places).any():
        return places
    if np.isnan(believed._replace(lens=Distortion()).pixels(points_m)).any():
        raise TwinError("rig.hfov_deg", "the corners of the frame are out of what comes through the port", "less")
    raise TwinError("lens.k1", "the believed lens folds the image back within the frame", "less distortion")


def _look(camera: Camera, pixels: Array, rig: StereoRig) -> tuple[Array, Array]:
    """What raw pixels look at in a rendering of the frame's size: places and shifts of `Eye`."""
    seen = (pixels - camera.principal_px) / camera.focal_px
    if np.isnan(lenses.undistort(seen, camera.lens)).any():
        raise TwinError("lens.k1", "the lens folds the image back within the sensor", "less distortion")
    origin, direction = camera.rays(pixels)
    if not (direction[..., 2] > 1 / 20).all():
        raise TwinError("port.kind", "no light comes through the port to the border of the image", "a smaller view")
    slope = direction[..., :2] / direction[..., 2:]
    offset_m = origin[..., :2] - origin[..., 2:] * slope
    return slope * rig.focal_px + [rig.cx_px, rig.cy_px], offset_m * rig.focal_px


def _widened(rig: StereoRig, border: NDArray[np.int64]) -> StereoRig:
    """A rig with so many (columns, rows) more to each side of its images."""
    return replace(rig, width_px=rig.width_px + 2 * int(border[0]), height_px=rig.height_px + 2 * int(border[1]))


def _or_none(shift: Array) -> Places | None:
    return shift.astype(np.float32) if np.abs(shift).max() > 1e-9 else None


def _grid(rig: StereoRig, border: Any = (0, 0)) -> Array:
    """Columns and rows (h, w, 2) of an image and a border around it, from the image's first pixel."""
    columns = np.arange(-border[0], rig.width_px + border[0])
    rows = np.arange(-border[1], rig.height_px + border[1])
    return np.stack(np.meshgrid(columns, rows), axis=-1).astype(np.float64)


def _beyond(places: Array, rig: StereoRig) -> NDArray[np.int64]:
    """Pixels (columns, rows) that an image lacks at each side for these places and the reach of a spline."""
    last = np.array([rig.width_px - 1, rig.height_px - 1])
    lacking = np.maximum(-places.min(axis=(0, 1)), places.max(axis=(0, 1)) - last)
    return np.maximum(np.ceil(lacking + resample.REACH_PX), 0).astype(np.int64)


def _margin(looks: list[tuple[Array, Array]], rig: StereoRig) -> NDArray[np.int64]:
    """Pixels to be rendered beside the frame, so that all is there that the sensors see."""
    ends = [places + shift * nearness for places, shift in looks for nearness in (0.0, 1 / NEAREST_M)]
    lacking = np.max([_beyond(end, rig) for end in ends], axis=0)
    margin = -(-lacking // MARGIN_STEP_PX) * MARGIN_STEP_PX
    half = (np.array([rig.width_px, rig.height_px]) / 2 + margin) / rig.focal_px
    if half.max() > WIDEST_TANGENT:
        degrees = 2 * np.rad2deg(np.arctan([half.max(), WIDEST_TANGENT]))
        raise TwinError("rig.hfov_deg", f"lens and port see {degrees[0]:.0f} deg", f"up to {degrees[1]:.0f}")
    return margin


def _check_port(port: PortConfig) -> None:
    """The lens stands within its dome."""
    if port.kind == "dome" and np.linalg.norm(port.offset_m) >= port.radius_m:
        raise TwinError(
            "port.offset_m", f"{np.linalg.norm(port.offset_m):g} m: the lens stands outside its dome",
            f"shorter than port.radius_m, {port.radius_m:g} m",
        )  # fmt: skip
