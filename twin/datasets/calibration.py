"""Calibration of a stereo rig: camera models and the relative pose of the cameras, checked."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np

from twin.core import geometry
from twin.core.geometry import Array
from twin.core.records import StereoRig
from twin.errors import TwinError

#: Fields of a `StereoCalibration` that say how far it can be from the truth, and their largest values.
SIGMAS = {"rotation_sigma_deg": 2.0, "baseline_sigma_mm": 20.0}
_MOST_PX = 16384  # largest side of an image
_BELIEVED_M = 0.01, 1.0  # shortest and longest baseline whose unit need not be stated
_POSSIBLE_M = 0.001, 10.0  # the same of any baseline
_SHORTEST_FOCAL = 0.05  # smallest focal length as a fraction of the image size; a fisheye lens of 180 degrees has 0.3
_ORTHONORMAL = 1e-3  # largest deviation of a rotation matrix from an orthonormal one (calibration files round)
_SKEW_PX = 0.01  # largest skew of a camera matrix, which the camera models do not have
_OFF_CENTRE = 0.1  # largest distance of a principal point from the image centre, if no image size is stated [sides]
_FISHEYE = ("fisheye", "equidistant", "equi", "kannalabrandt", "kannala_brandt")
_RADTAN = ("radtan", "plumb_bob", "radialtangential", "rational_polynomial", "pinhole", "none", "opencv")
#: Numbers of coefficients of distortion.
_COUNTS = {"fisheye": (0, 4), "radtan": (0, 4, 5, 8, 12, 14), "double_sphere": (2,)}


@dataclass(frozen=True)
class RecordedCamera:
    """Intrinsic calibration of one camera."""

    size_px: tuple[int, int] | None  #: (width, height) of the images; None if the calibration does not state it
    matrix: Array  #: (3, 3) camera matrix [px]; the centre of the first pixel is at (0, 0)
    distortion: Array  #: (n,) coefficients in the order of OpenCV; empty or zero for images without distortion
    #: "radtan" (k1, k2, p1, p2, k3, ...: the pinhole model of OpenCV), "fisheye" (k1 to k4: equidistant, as Kalibr) or
    #: "double_sphere" (xi, alpha; with xi = 0, it is the unified camera model)
    kind: Literal["radtan", "fisheye", "double_sphere"] = "radtan"

    def project(self, points_m: Array) -> Array:
        """Returns the pixels (n, 2) of points (n, 3) in camera axes.

        The models are those of OpenCV (radtan), Kannala & Brandt 2006, eq. 6 (fisheye), and Usenko et al. 2018, eq. 40
        (double sphere); the last two also hold beyond 90 degrees from the optical axis.
        """
        if self.kind == "radtan":
            points = np.vstack([points_m, [0, 0, 1]])  # OpenCV needs at least one
            pixels = cv2.projectPoints(points, np.zeros(3), np.zeros(3), self.matrix, self.distortion)[0]
            return np.asarray(pixels, np.float64).reshape(-1, 2)[:-1]
        x, y, z = points_m.T
        r = np.hypot(x, y)
        if self.kind == "fisheye":
            angle = np.arctan2(r, z)
            polynomial = np.polynomial.Polynomial([1.0, *self.distortion])
            scale = angle * polynomial(angle**2) / np.maximum(r, 1e-300)
        else:
            xi, alpha = self.distortion
            ahead = xi * np.hypot(r, z) + z
            scale = 1 / (alpha * np.hypot(r, ahead) + (1 - alpha) * ahead)
        return points_m[:, :2] * scale[:, None] * np.diag(self.matrix)[:2] + self.matrix[:2, 2]


@dataclass(frozen=True)
class StereoCalibration:
    """Calibration of a stereo rig."""

    left: RecordedCamera
    right: RecordedCamera
    right_from_left: Array  #: (4, 4) pose of the left camera in the axes of the right one
    file: Path = Path()  #: file of the calibration, for messages
    #: RMS distance between image points by these models and by the cameras to which they were fitted; 0: exact.
    residual_px: float = 0.0
    #: standard deviations of the rotation between the cameras about each axis, and of their distance, since the
    #: calibration; 0: exact
    rotation_sigma_deg: float = 0.0
    baseline_sigma_mm: float = 0.0
    #: unit of the translation: metres as is usual in the format ("assumed"), stated by the file, or unknown
    unit: Literal["assumed", "stated", "unknown"] = "assumed"

    @property
    def baseline_m(self) -> float:
        return float(np.linalg.norm(self.right_from_left[:3, 3]))

    @property
    def left_from_right(self) -> Array:
        return geometry.inverse(self.right_from_left)

    @property
    def baseline_sigma(self) -> float:
        """Returns the standard deviation of the relative change of the baseline."""
        return self.baseline_sigma_mm / 1000 / self.baseline_m

    def left_from(self, side: str) -> Array:
        """Returns the pose (4, 4) of the "left" or the "right" camera in the axes of the left one."""
        return np.eye(4) if side == "left" else self.left_from_right

    @property
    def sides(self) -> tuple[tuple[str, RecordedCamera], tuple[str, RecordedCamera]]:
        return ("left", self.left), ("right", self.right)

    def with_baseline(self, baseline_m: float | None) -> "StereoCalibration":
        """Returns the calibration with this baseline or, for None, with its own if that is in metres beyond doubt.

        Raises TwinError for an impossible one, and for one of its own without a stated unit beyond `_BELIEVED_M`.
        """
        shortest, longest = _POSSIBLE_M if self.unit == "stated" or baseline_m is not None else _BELIEVED_M
        length_m = self.baseline_m if baseline_m is None else baseline_m
        if not shortest <= length_m <= longest or (baseline_m is None and self.unit == "unknown"):
            unit = "in an unknown unit" if self.unit == "unknown" else "m (or in mm, inches or squares of a board?)"
            allowed = f"{shortest:g} to {longest:g} m; --baseline states it, or T_unit in a file of OpenCV"
            source = str(self.file) if baseline_m is None else "--baseline"
            raise TwinError(source, f"the baseline is {length_m:g} {unit}", allowed)
        pose = self.right_from_left.copy()
        pose[:3, 3] *= length_m / self.baseline_m
        return replace(self, right_from_left=pose)

    def for_images(self, width_px: int, height_px: int) -> "StereoCalibration":
        """Returns the calibration with the size of the images set; raises TwinError if it does not fit this size."""
        size = width_px, height_px
        for name, camera in self.sides:
            if fault := _misfit(name, camera, size):
                raise TwinError(str(self.file), *fault)
        return replace(self, left=replace(self.left, size_px=size), right=replace(self.right, size_px=size))


def rectified_calibration(rig: StereoRig) -> StereoCalibration:
    """Returns the calibration of rectified images: two equal pinhole cameras without distortion."""
    camera = RecordedCamera((rig.width_px, rig.height_px), rig.matrix, np.zeros(5))
    return StereoCalibration(camera, camera, geometry.inverse(rig.left_from_right))


def _misfit(name: str, camera: RecordedCamera, size: tuple[int, int]) -> tuple[str, str] | None:
    given, (width, height) = camera.size_px, size
    if given is not None and given != size:
        problem = f"the {name} camera is calibrated for images of {given[0]} x {given[1]} px"
        return problem, f"{width} x {height} px, the size of the images"
    (fx, _, cx), (_, fy, cy) = camera.matrix[:2]
    if min(fx / width, fy / height) < _SHORTEST_FOCAL:
        problem = f"the focal length of the {name} camera is {fx:g}, {fy:g} px"
        return problem, f"at least {_SHORTEST_FOCAL:g} of the image size"
    if not (0 < cx < width and 0 < cy < height):
        problem = f"the principal point ({cx:.1f}, {cy:.1f}) px of the {name} camera is outside the images"
        return problem, f"a calibration of {width} x {height} px"
    if given is None and max(abs(cx / width - 0.5), abs(cy / height - 0.5)) > _OFF_CENTRE:
        implied = f"{2 * cx + 1:.0f} x {2 * cy + 1:.0f} px"
        problem = f"states no image size, and the principal point of the {name} camera implies about {implied}"
        return problem, f"{width} x {height} px, the size of the images, or image_width and image_height"
    return None


def checked(calibration: StereoCalibration) -> StereoCalibration:
    """Returns the calibration with an orthonormal rotation; raises TwinError, naming the file, for a wrong value."""
    pose = rigid(calibration.right_from_left, "the rotation between the cameras", calibration.file)
    faults = [*(_impossible(name, camera) for name, camera in calibration.sides), _wrong_baseline(pose)]
    for key, most in SIGMAS.items():
        if not 0 <= (sigma := getattr(calibration, key)) <= most:
            faults.append((f"{key}: {sigma:g}", f"0 to {most:g}"))
    if fault := next(filter(None, faults), None):
        raise TwinError(str(calibration.file), *fault)
    return replace(calibration, right_from_left=pose)


def rigid(pose: Array, key: str, file: Path) -> Array:
    """Returns a pose (4, 4) with an orthonormal rotation, up to rounding; else TwinError, which names `key`."""
    deviation = np.abs(pose[:3, :3] @ pose[:3, :3].T - np.eye(3)).max() if np.isfinite(pose).all() else np.inf
    deviation = max(deviation, np.abs(pose[3] - [0, 0, 0, 1]).max())
    if not (deviation < _ORTHONORMAL and np.linalg.det(pose[:3, :3]) > 0):
        raise TwinError(str(file), f"{key} is not a rotation matrix, or no pose by rows", "[R, t], [0, 0, 0, 1]")
    return geometry.nearest_rigid(pose)


def _wrong_baseline(right_from_left: Array) -> tuple[str, str] | None:
    """Returns what is wrong unless the right camera is to the right of the left one, by at least 0.1 mm."""
    baseline_m = float(np.linalg.norm(right_from_left[:3, 3]))
    x, y, z = -(right_from_left[:3, :3].T @ right_from_left[:3, 3])  # of the right camera in the axes of the left one
    if baseline_m < 1e-4:
        return "has no baseline: both cameras are at the same place", "a distance between the cameras"
    if abs(x) < max(abs(y), abs(z)):
        return "the cameras are not side by side", "a right camera along +x of the left one"
    if x < 0:
        problem = f"the baseline is negative ({x:.4f} m): the left and the right camera are swapped"
        return problem, "a right camera along +x of the left one"
    return None


def _impossible(name: str, camera: RecordedCamera) -> tuple[str, str] | None:
    matrix, distortion = camera.matrix, camera.distortion
    if matrix.shape != (3, 3) or not np.isfinite(matrix).all() or not np.isfinite(distortion).all():
        return f"the matrix or the distortion of the {name} camera is not a set of finite numbers", ""
    (fx, skew, cx), (_, fy, cy) = matrix[:2]
    if not (0 < fx < 1e6 and 0 < fy < 1e6):
        return f"the focal length of the {name} camera is {fx:g}, {fy:g} px", "positive numbers up to 1e6 px"
    other = np.abs(matrix - camera_matrix(fx, fy, cx, cy))
    if other.max() > _SKEW_PX:
        problem = f"has a skew of {skew:g} px" if other.max() == abs(skew) else "has no camera matrix"
        return f"the {name} camera {problem}", "[[fx, 0, cx], [0, fy, cy], [0, 0, 1]]"
    if len(distortion) not in _COUNTS[camera.kind]:
        counts = ", ".join(map(str, _COUNTS[camera.kind]))
        return f"the {name} camera has {len(distortion)} coefficients of distortion", counts
    if camera.size_px is not None and not all(16 <= side <= _MOST_PX for side in camera.size_px):
        return f"the image size of the {name} camera is {camera.size_px}", f"16 to {_MOST_PX} px"
    return None


def camera_matrix(fx: float, fy: float, cx: float, cy: float) -> Array:
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])


def distortion_kind(name: Any, file: Path) -> Any:
    """Returns "radtan" or "fisheye" for a lens model such as "plumb_bob"; raises TwinError if it is not supported."""
    text = (
        "missing" if name is None else str(name).lower().replace("radial-t", "radialt").replace("tial8", "tial")
    )  # OKVIS: of 8 coefficients
    if text in _FISHEYE or text in _RADTAN:
        return "fisheye" if text in _FISHEYE else "radtan"
    raise TwinError(str(file), f"distortion model {text[:40]!r} is not supported", "radtan or equidistant (fisheye)")
