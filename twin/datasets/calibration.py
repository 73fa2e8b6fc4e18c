"""Calibration of a recorded stereo rig: camera models and the relative pose of the cameras, checked."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from twin.core import geometry
from twin.core.geometry import Array
from twin.errors import TwinError

_MOST_PX = 16384  # largest side of an image
_LONGEST_BASELINE_M = 10.0
_SHORTEST_FOCAL = 0.05  # smallest focal length as a fraction of the image size; a fisheye lens of 180 degrees has 0.3
_ORTHONORMAL = 1e-3  # largest deviation of a rotation matrix from an orthonormal one (calibration files round)
_SKEW_PX = 0.01  # largest skew of a camera matrix, which the camera models do not have
_OFF_CENTRE = 0.1  # largest distance of a principal point from the image centre, if no image size is stated [sides]
_FISHEYE = ("fisheye", "equidistant", "equi", "kannalabrandt", "kannala_brandt")
_RADTAN = ("radtan", "plumb_bob", "radial-tangential", "rational_polynomial", "pinhole", "none", "opencv")


@dataclass(frozen=True)
class RecordedCamera:
    """Intrinsic calibration of one camera.

    Args:
        size_px: (width, height) of the image; None if the calibration file does not state it.
        matrix: (3, 3) camera matrix [px]; the centre of the first pixel is at (0, 0).
        distortion: (n,) coefficients in the order of OpenCV; empty or zero for images without distortion.
        kind: "radtan" (k1, k2, p1, p2, k3, ...; the pinhole model of OpenCV) or "fisheye" (k1 to k4; the equidistant
            model of Kalibr).
    """

    size_px: tuple[int, int] | None
    matrix: Array
    distortion: Array
    kind: Literal["radtan", "fisheye"] = "radtan"


@dataclass(frozen=True)
class StereoCalibration:
    """Calibration of a stereo rig.

    Args:
        left, right: the two cameras.
        right_from_left: (4, 4) pose of the left camera in the axes of the right one.
        file: file of the calibration, for messages.
    """

    left: RecordedCamera
    right: RecordedCamera
    right_from_left: Array
    file: Path

    @property
    def baseline_m(self) -> float:
        """Returns the distance between the two cameras [m]."""
        return float(np.linalg.norm(self.right_from_left[:3, 3]))

    def for_images(self, width_px: int, height_px: int) -> StereoCalibration:
        """Returns the calibration with the size of the images set, which a calibration file need not state.

        Raises:
            TwinError: the calibration does not fit images of this size.
        """
        size = width_px, height_px
        for name, camera in (("left", self.left), ("right", self.right)):
            given = camera.size_px
            if given is not None and given != size:
                problem = f"the {name} camera is calibrated for images of {given[0]} x {given[1]} px"
                raise TwinError(str(self.file), problem, f"{width_px} x {height_px} px, the size of the images")
            fx, fy = camera.matrix[0, 0], camera.matrix[1, 1]
            if min(fx / width_px, fy / height_px) < _SHORTEST_FOCAL:
                problem = f"the focal length of the {name} camera is {fx:g}, {fy:g} px"
                raise TwinError(str(self.file), problem, f"at least {_SHORTEST_FOCAL:g} of the image size")
            cx, cy = camera.matrix[0, 2], camera.matrix[1, 2]
            if not (0 < cx < width_px and 0 < cy < height_px):
                problem = f"the principal point ({cx:.1f}, {cy:.1f}) px of the {name} camera is outside the images"
                raise TwinError(str(self.file), problem, f"a calibration of {width_px} x {height_px} px")
            if given is None and max(abs(cx / width_px - 0.5), abs(cy / height_px - 0.5)) > _OFF_CENTRE:
                implied = f"{2 * cx + 1:.0f} x {2 * cy + 1:.0f} px"
                problem = f"states no image size, and the principal point of the {name} camera implies about {implied}"
                allowed = f"{width_px} x {height_px} px, the size of the images, or image_width and image_height"
                raise TwinError(str(self.file), problem, allowed)
        return replace(self, left=replace(self.left, size_px=size), right=replace(self.right, size_px=size))


def checked(calibration: StereoCalibration) -> StereoCalibration:
    """Returns the calibration after checks of its values, with an exactly orthonormal rotation between the cameras.

    Raises:
        TwinError: there is no baseline, the cameras are swapped or not side by side, or a value is impossible; the
            message names the file.
    """
    file = str(calibration.file)
    for name, camera in (("left", calibration.left), ("right", calibration.right)):
        _check_camera(file, name, camera)
    pose = calibration.right_from_left
    if not is_rigid(pose):
        raise TwinError(file, "the rotation between the cameras is not a rotation matrix")
    _check_baseline(file, calibration)
    return replace(calibration, right_from_left=geometry.nearest_rigid(pose))


def is_rigid(pose: Array) -> bool:
    """Returns whether a pose (4, 4) is finite and has a rotation matrix, up to the rounding of calibration files."""
    deviation = np.abs(pose[:3, :3] @ pose[:3, :3].T - np.eye(3)).max() if np.isfinite(pose).all() else np.inf
    return bool(deviation < _ORTHONORMAL and np.linalg.det(pose[:3, :3]) > 0)


def _check_baseline(file: str, calibration: StereoCalibration) -> None:
    """Raises TwinError unless the right camera is to the right of the left one, at 0.1 mm to 10 m from it."""
    baseline_m = calibration.baseline_m
    # position of the right camera in the axes of the left one
    x, y, z = -(calibration.right_from_left[:3, :3].T @ calibration.right_from_left[:3, 3])
    if baseline_m < 1e-4:
        raise TwinError(file, "has no baseline: both cameras are at the same place", "a distance between the cameras")
    if baseline_m > _LONGEST_BASELINE_M:
        raise TwinError(file, f"the baseline is {baseline_m:g} m", f"up to {_LONGEST_BASELINE_M:g} m; units are metres")
    if abs(x) < max(abs(y), abs(z)):
        raise TwinError(file, "the cameras are not side by side", "a right camera along +x of the left one")
    if x < 0:
        problem = f"the baseline is negative ({x:.4f} m): the left and the right camera are swapped"
        raise TwinError(file, problem, "a right camera along +x of the left one")


def _check_camera(file: str, name: str, camera: RecordedCamera) -> None:
    """Raises TwinError unless focal lengths, distortion and image size of a camera are possible."""
    matrix, distortion = camera.matrix, camera.distortion
    if matrix.shape != (3, 3) or not np.isfinite(matrix).all() or not np.isfinite(distortion).all():
        raise TwinError(file, f"the matrix or the distortion of the {name} camera is not a set of finite numbers")
    if not (0 < matrix[0, 0] < 1e6 and 0 < matrix[1, 1] < 1e6):
        shown = f"{matrix[0, 0]:g}, {matrix[1, 1]:g}"
        raise TwinError(file, f"the focal length of the {name} camera is {shown} px", "positive numbers up to 1e6 px")
    other = matrix - np.array([[matrix[0, 0], 0, matrix[0, 2]], [0, matrix[1, 1], matrix[1, 2]], [0, 0, 1]])
    if np.abs(other).max() > _SKEW_PX:
        is_skew = np.abs(other).max() == abs(matrix[0, 1])
        problem = f"has a skew of {matrix[0, 1]:g} px" if is_skew else "has no camera matrix"
        raise TwinError(file, f"the {name} camera {problem}", "[[fx, 0, cx], [0, fy, cy], [0, 0, 1]]")
    allowed = (0, 4) if camera.kind == "fisheye" else (0, 4, 5, 8, 12, 14)
    if len(distortion) not in allowed:
        counts = ", ".join(map(str, allowed))
        raise TwinError(file, f"the {name} camera has {len(distortion)} coefficients of distortion", counts)
    if camera.size_px is not None and not all(16 <= side <= _MOST_PX for side in camera.size_px):
        raise TwinError(file, f"the image size of the {name} camera is {camera.size_px}", f"16 to {_MOST_PX} px")


def distortion_kind(name: Any, file: Path) -> Any:
    """Returns the kind of distortion that a calibration names: "radtan" or "fisheye".

    Args:
        name: name of the lens model, for example "plumb_bob".
        file: file or topic of the calibration, for messages.

    Raises:
        TwinError: the lens model is not supported.
    """
    text = str(name).lower()
    if text in _FISHEYE or text in _RADTAN:
        return "fisheye" if text in _FISHEYE else "radtan"
    raise TwinError(str(file), f"distortion model {text[:40]!r} is not supported", "radtan or equidistant (fisheye)")
