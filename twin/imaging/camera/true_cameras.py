"""Geometry of the true cameras: maps rendered images to raw images, and raw images to rectified frames.

The floor is rendered for two parallel pinhole cameras in water. Each raw pixel has its own ray through lens and port
and gets the radiance where this ray meets the rendered floor; the raw image is rectified with the believed calibration.
If both true cameras equal the believed ones, the rendered image is used unchanged.
"""

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from twin.core import geometry, resample
from twin.core.records import Array, Depth, Image, Radiance, StereoRig
from twin.core.resample import Positions
from twin.errors import TwinError
from twin.imaging.camera import lens as lenses
from twin.imaging.camera import port as ports
from twin.imaging.camera.lens import Distortion
from twin.imaging.camera.port import Pinhole
from twin.imaging.camera.ray_sampling import RowMotion, sample_rays
from twin.imaging.camera.shutter import ExposureMotion
from twin.scenario.model import CalibrationErrorConfig, PortConfig, Scenario

NEAREST_M = 0.3  # smallest depth of the floor for which the rendered margin suffices
MARGIN_STEP_PX = 8  # margins are multiples of this; two of them add a multiple of 16 to the width or height
_MOST_BORDER = 2  # largest border of the sensor around the frame that the rectification needs [frames]
WIDEST_TANGENT = 5.0  # largest tangent of half the field of view


class CameraModel(NamedTuple):
    """Model of one camera, true or believed, in the axes of the believed camera."""

    focal_px: float  # focal length of the lens: that of the equivalent pinhole camera divided by `pinhole.focal_ratio`
    principal_px: tuple[float, float]  # column and row of the principal point
    lens: Distortion  # distortion coefficients
    port: PortConfig  # geometry and refractive indices of the port
    pinhole: Pinhole  # pinhole camera in water that is equivalent to lens and port near the optical axis
    # (3, 3) rotation from this camera to the believed camera, about the centre of `pinhole`; None: they are parallel
    believed_from_camera: Array | None = None

    def rays(self, pixels: Array) -> tuple[Array, Array]:
        """Returns origins [m] and directions (..., 3) in water, in believed axes, of pixels (..., 2); NaN if none."""
        air = lenses.undistort((pixels - self.principal_px) / self.focal_px, self.lens)
        if self.port.kind == "none":
            air = air / self.pinhole.focal_ratio
        origin, direction = ports.water_rays(self.port, air)
        origin = origin - [0.0, 0.0, self.pinhole.centre_m]
        return self.in_believed_axes(origin), self.in_believed_axes(direction)

    def in_believed_axes(self, vectors: Array) -> Array:
        return vectors if self.believed_from_camera is None else vectors @ self.believed_from_camera.T

    def pixels(self, points_m: Array) -> Array:
        """Returns the pixels (..., 2) of points (..., 3) [m] in front of the believed camera; NaN if there is none."""
        if self.believed_from_camera is not None:
            points_m = points_m @ self.believed_from_camera
        points_m = points_m + [0.0, 0.0, self.pinhole.centre_m]
        air = ports.air_coordinates(self.port, points_m)
        if self.port.kind == "none":
            air = air * self.pinhole.focal_ratio
        off_axis = np.hypot(air[..., :1], air[..., 1:])
        air = np.where(off_axis < min(lenses.fold(self.lens), WIDEST_TANGENT), air, np.nan)
        return lenses.distort(air, self.lens) * self.focal_px + self.principal_px


class SamplingMap(NamedTuple):
    positions: Positions  # (h, w, 2) position for each raw pixel if its ray meets the floor at infinity [px]
    # (h, w, 2) of a ray that meets the floor at depth z, the position is `positions` + `parallax_px_m` / z; None = 0
    parallax_px_m: Positions | None


@dataclass(frozen=True)
class TrueCameras:
    # calibration used for rendering: the believed rig with the true baseline, and images enlarged by the margin
    rendered_rig: StereoRig
    margin_px: tuple[int, int]  # (columns, rows) by which the rendered image extends beyond the frame on each side
    raw_rig: StereoRig  # calibration of the raw images: their size, the focal length of the lens, the true baseline
    # of the left and the right camera; None if the rendered images are used as raw images
    sampling: tuple[SamplingMap, SamplingMap] | None
    # (H, W, 2) position in the raw image of each pixel of the frame [px]; None if raw images are used as frames
    rectification: Positions | None
    models: tuple[CameraModel, CameraModel]  # models of the true left and right camera
    believed: CameraModel  # camera model that is used to rectify the images of both cameras
    rectified_depth_m: float  # depth of the points for which the rectification is computed

    def sample(self, light: Radiance, depth: Depth, camera: int, motion: ExposureMotion | None = None) -> Radiance:
        """Returns the radiance (h, w, 3) at the raw pixels of a camera (0 left, 1 right), from the rendered image."""
        if self.sampling is None:
            return light
        positions, parallax = self.sampling[camera]
        rows, rig = None, self.rendered_rig
        if motion is not None and motion.readout_s:
            readout_s = motion.readout_s * (len(positions) - 1) / (len(light) - 1)
            rows = RowMotion(motion.twist, readout_s, rig.focal_px, (rig.cx_px, rig.cy_px))
        return sample_rays(light, depth, positions, parallax, rows)

    def rectify(self, raw: Image) -> Image:
        """Returns the frame of either camera: its raw image, rectified with the believed calibration."""
        return raw if self.rectification is None else resample.interpolate(raw, self.rectification)

    def crop(self, rendered: NDArray[Any]) -> NDArray[Any]:
        """Returns a rendered image without its margin."""
        (x, y), (height, width) = self.margin_px, rendered.shape[:2]
        return np.ascontiguousarray(rendered[y : height - y, x : width - x]) if x or y else rendered

    def project(self, points_m: Array, camera: int = 0) -> Array:
        """Returns the pixels (n, 2) in the frame or beyond of points (n, 3) [m] in the rendered camera; NaN if none."""
        rig = self.rendered_rig
        if self.sampling is None:
            return rig.project(points_m)
        ahead = np.where(points_m[:, 2:] > 1e-3, points_m, np.nan)
        origin, direction = self.believed.rays(self.models[camera].pixels(ahead))
        on_plane = origin + direction * ((self.rectified_depth_m - origin[:, 2]) / direction[:, 2])[:, None]
        centre = [rig.cx_px - self.margin_px[0], rig.cy_px - self.margin_px[1]]
        return on_plane[:, :2] / self.rectified_depth_m * rig.focal_px + centre


def make_true_cameras(scenario: Scenario) -> TrueCameras:
    """Returns the true cameras of a scenario.

    Raises TwinError where the lens is outside its dome, the port transmits no rays to part of the image, the distortion
    folds the image back onto itself, or the field of view is too wide.
    """
    believed_rig, calibration = scenario.believed_rig(), scenario.true_calibration_error()
    port, exact = scenario.port, calibration.model_copy(update={"baseline_error": 0.0}) == CalibrationErrorConfig()
    if port.kind == "dome" and np.linalg.norm(port.offset_m) >= port.radius_m:
        reason = f"{np.linalg.norm(port.offset_m):g} m: the lens is outside its dome"
        raise TwinError("port.offset_m", reason, f"shorter than port.radius_m, {port.radius_m:g} m")
    true_rig = replace(believed_rig, baseline_m=believed_rig.baseline_m * (1 + calibration.baseline_error))
    models, believed = _models(scenario)
    calibrated = port.kind != "none" and port.calibrated_at_m > 0
    depth_m = port.calibrated_at_m if calibrated else 1.0
    if exact and port.kind == "none" and not any(lenses.true_lens(scenario.lens)) and not any(believed.lens):
        return TrueCameras(true_rig, (0, 0), true_rig, None, None, models, believed, depth_m)
    rectification = None
    border = np.zeros(2, np.int64)
    if calibrated or any(believed.lens):
        rectification = _rectification(believed, _size_px(believed_rig), believed_rig.focal_px, depth_m)
        border = _missing_px(rectification, believed_rig)
        if (border > _MOST_BORDER * np.array(_size_px(believed_rig))).any():
            raise TwinError("lens.k1", f"the sensor needs a border of {border.max()} px", "less distortion")
        rectification = rectification + border
    columns, rows = border.tolist()
    rays = [_rendered_rays(model, (columns, rows), believed_rig) for model in models]
    margin = _margin(rays, believed_rig)
    raw_rig = replace(_enlarged(true_rig, border), focal_px=models[0].focal_px)
    left, right = (
        SamplingMap(
            (at + margin).astype(np.float32), parallax.astype(np.float32) if np.abs(parallax).max() > 1e-9 else None
        )
        for at, parallax in rays
    )
    return TrueCameras(
        _enlarged(true_rig, margin), (int(margin[0]), int(margin[1])), raw_rig, (left, right),
        None if rectification is None else rectification.astype(np.float32), models, believed, depth_m,
    )  # fmt: skip


def _models(scenario: Scenario) -> tuple[tuple[CameraModel, CameraModel], CameraModel]:
    calibration, port, rig = scenario.true_calibration_error(), scenario.port, scenario.believed_rig()
    pinhole, (x_px, y_px) = ports.pinhole(port), (rig.cx_px, rig.cy_px)
    focal_px, lens = rig.focal_px / pinhole.focal_ratio, lenses.true_lens(scenario.lens)

    def true_model(error_px: tuple[float, float], rotation: Array | None = None) -> CameraModel:
        focal, principal_px = focal_px * (1 + calibration.focal_error), (x_px + error_px[0], y_px + error_px[1])
        return CameraModel(focal, principal_px, lens, port, pinhole, rotation)

    left = true_model(calibration.left_principal_point_error_px)
    right = true_model(calibration.right_principal_point_error_px, right_rotation(calibration))
    known = (port, pinhole) if port.calibrated_at_m else (PortConfig(), Pinhole(0.0, pinhole.focal_ratio))
    believed_lens = lenses.believed_lens(scenario.lens, calibration)
    return (left, right), CameraModel(focal_px, (x_px, y_px), believed_lens, *known)


def right_rotation(calibration: CalibrationErrorConfig) -> Array:
    """Returns R_y(yaw) R_x(pitch) R_z(roll) (3, 3) of the right camera, from its true axes to the believed ones."""
    roll, pitch, yaw = np.deg2rad([calibration.right_roll_deg, calibration.right_pitch_deg, calibration.right_yaw_deg])
    x, y, z = np.eye(3)
    return geometry.so3_exp(yaw * y) @ geometry.so3_exp(pitch * x) @ geometry.so3_exp(roll * z)


@lru_cache(maxsize=1)  # the surveys of a study mostly differ in other keys
def _rectification(believed: CameraModel, size_px: tuple[int, int], focal_px: float, depth_m: float) -> Array:
    """Returns the raw-image position (H, W, 2) of each pixel of the frame [px], as the image of points at `depth_m`."""
    normalised = (_grid(size_px) - believed.principal_px) / focal_px
    points_m = np.concatenate([normalised, np.ones_like(normalised[..., :1])], axis=-1) * depth_m
    positions = believed.pixels(points_m)
    if not np.isnan(positions).any():
        return positions
    if np.isnan(believed._replace(lens=Distortion()).pixels(points_m)).any():
        raise TwinError("rig.hfov_deg", "no rays reach the corners of the frame through the port", "less")
    raise TwinError(
        _strongest(believed.lens), "the believed lens folds the image back within the frame", "less distortion"
    )


def _strongest(lens: Distortion) -> str:
    return "lens." + max(lens._fields, key=lambda name: abs(getattr(lens, name)))


@lru_cache(maxsize=1)  # as of `_rectification`; both cameras mostly have the same lens and port
def _sensor_rays(camera: CameraModel, size_px: tuple[int, int], border: tuple[int, int]) -> tuple[Array, Array]:
    """Returns the `rays` of all raw pixels; raises TwinError where the lens folds the image back onto itself."""
    pixels = _grid(size_px, border)
    distorted = (pixels - camera.principal_px) / camera.focal_px
    if np.isnan(lenses.undistort(distorted, camera.lens)).any():
        raise TwinError(_strongest(camera.lens), "the lens folds the image back within the sensor", "less distortion")
    return camera.rays(pixels)


def _rendered_rays(camera: CameraModel, border: tuple[int, int], rig: StereoRig) -> tuple[Array, Array]:
    """Returns `positions` and `parallax_px_m` of `SamplingMap` for raw pixels and a rendered image without margin."""
    in_own_axes = _sensor_rays(camera._replace(believed_from_camera=None), _size_px(rig), border)
    origin, direction = (camera.in_believed_axes(vectors) for vectors in in_own_axes)
    if not (direction[..., 2] > 1 / 20).all():
        raise TwinError("port.kind", "no rays reach the image border through the port", "a smaller field of view")
    slope = direction[..., :2] / direction[..., 2:]
    offset_m = origin[..., :2] - origin[..., 2:] * slope
    return slope * rig.focal_px + [rig.cx_px, rig.cy_px], offset_m * rig.focal_px


def _enlarged(rig: StereoRig, border: NDArray[np.int64]) -> StereoRig:
    return replace(rig, width_px=rig.width_px + 2 * int(border[0]), height_px=rig.height_px + 2 * int(border[1]))


def _size_px(rig: StereoRig) -> tuple[int, int]:
    return rig.width_px, rig.height_px


def _grid(size_px: tuple[int, int], border: tuple[int, int] = (0, 0)) -> Array:
    """Returns column and row (h, w, 2) of all pixels of an image and its border, from its top left pixel."""
    columns, rows = (np.arange(-more, n + more) for n, more in zip(size_px, border, strict=True))
    return np.stack(np.meshgrid(columns, rows), axis=-1).astype(np.float64)


def _missing_px(positions: Array, rig: StereoRig) -> NDArray[np.int64]:
    """Returns the border (columns, rows) [px] that spline interpolation at `positions` [px] needs on each side."""
    last = np.array([rig.width_px - 1, rig.height_px - 1])
    least, most = np.array([(part.min(), part.max()) for part in np.moveaxis(positions, -1, 0)]).T
    missing = np.maximum(-least, most - last)
    return np.maximum(np.ceil(missing + resample.REACH_PX), 0).astype(np.int64)


def _margin(rays: list[tuple[Array, Array]], rig: StereoRig) -> NDArray[np.int64]:
    """Returns the margin (columns, rows) [px] that the rendered image needs on each side."""
    ends = [positions + parallax * per_m for positions, parallax in rays for per_m in (0.0, 1 / NEAREST_M)]
    missing = np.max([_missing_px(end, rig) for end in ends], axis=0)
    margin = -(-missing // MARGIN_STEP_PX) * MARGIN_STEP_PX
    half = (np.array([rig.width_px, rig.height_px]) / 2 + margin) / rig.focal_px
    if half.max() > WIDEST_TANGENT:
        degrees = 2 * np.rad2deg(np.arctan([half.max(), WIDEST_TANGENT]))
        raise TwinError("rig.hfov_deg", f"the true field of view is {degrees[0]:.0f} deg", f"up to {degrees[1]:.0f}")
    return margin
