"""Calibration files of other programs: OpenCV YAML, Kalibr camchain, COLMAP cameras.txt with rigs.txt."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from twin.core import geometry
from twin.core.geometry import Array
from twin.datasets.calibration import RecordedCamera, StereoCalibration, checked
from twin.datasets.text_files import read_yaml, text_rows
from twin.errors import TwinError

#: Names of the keys of an OpenCV file, in lower case without underscores: camera matrices and distortions.
_MATRIX_KEYS = [("m1", "k1", "cameramatrix1", "leftcameramatrix"), ("m2", "k2", "cameramatrix2", "rightcameramatrix")]
_DISTORTION_KEYS = [("d1", "distcoeffs1", "leftdistortion"), ("d2", "distcoeffs2", "rightdistortion")]
_LARGEST = 1e12  # largest absolute value of a number in a calibration file
_SIZE_KEYS = ("imagesize", "size", "resolution")
_FISHEYE = ("fisheye", "equidistant", "equi", "kannalabrandt", "kannala_brandt")
_RADTAN = ("radtan", "plumb_bob", "radial-tangential", "rational_polynomial", "pinhole", "none", "opencv")
#: COLMAP camera models: positions of fx, fy, cx, cy in their parameters, positions of the OpenCV coefficients of
#: distortion (None: zero), and kind of distortion.
_COLMAP: dict[str, tuple[tuple[int, int, int, int], tuple[int | None, ...], str]] = {
    "SIMPLE_PINHOLE": ((0, 0, 1, 2), (), "radtan"),
    "PINHOLE": ((0, 1, 2, 3), (), "radtan"),
    "SIMPLE_RADIAL": ((0, 0, 1, 2), (3, None, None, None), "radtan"),
    "RADIAL": ((0, 0, 1, 2), (3, 4, None, None), "radtan"),
    "OPENCV": ((0, 1, 2, 3), (4, 5, 6, 7), "radtan"),
    "FULL_OPENCV": ((0, 1, 2, 3), (4, 5, 6, 7, 8, 9, 10, 11), "radtan"),
    "OPENCV_FISHEYE": ((0, 1, 2, 3), (4, 5, 6, 7), "fisheye"),
}


def read_calibration(file: Path) -> StereoCalibration:
    """Returns the calibration of a file: OpenCV YAML, Kalibr camchain YAML, or COLMAP cameras.txt.

    The rig of the cameras in cameras.txt is read from rigs.txt in the same folder.

    Raises:
        TwinError: the file cannot be read, is of an unknown kind, or its values are impossible.
    """
    if file.suffix == ".txt":
        return checked(_colmap(file))
    tree = read_yaml(file)
    return checked(_kalibr(tree, file) if "cam0" in tree else _opencv(tree, file))


def find_calibration(folder: Path) -> Path | None:
    """Returns the calibration file of a folder, or None if it has none.

    It is calibration.yaml (or .yml), otherwise the only YAML file, otherwise cameras.txt.

    Raises:
        TwinError: the folder has several YAML files, and not exactly one of them is called calibration.
    """
    files = sorted(file for file in folder.iterdir() if file.suffix.lower() in (".yaml", ".yml"))
    named = [file for file in files if file.stem.lower() == "calibration"]
    if len(files) > 1 and len(named) != 1:
        names = ", ".join(file.name for file in files[:5])
        raise TwinError(str(folder), f"has several YAML files: {names}", "--calibration FILE")
    found = named or files or [file for file in (folder / "cameras.txt",) if file.is_file()]
    return found[0] if found else None


def camera_from_kalibr(table: Any, file: Path) -> RecordedCamera:
    """Returns a camera of a Kalibr camchain or of an ASL sensor.yaml (keys `intrinsics`, `distortion_coefficients`).

    Raises:
        TwinError: a value is missing or not valid, or the camera model or the lens model is not supported.
    """
    table = _table(table, file)
    if (model := table.get("camera_model", "pinhole")) != "pinhole":
        raise TwinError(str(file), f"camera model {model!r} is not supported", "pinhole with radtan or equidistant")
    coefficients = table.get("distortion_coeffs", table.get("distortion_coefficients"))
    fx, fy, cx, cy = _numbers(table.get("intrinsics"), file, "intrinsics", (4,))
    distortion = _numbers([] if coefficients is None else coefficients, file, "distortion_coeffs").ravel()
    kind = distortion_kind(table.get("distortion_model", "radtan"), file)
    return RecordedCamera(_size(table.get("resolution"), file), _matrix(fx, fy, cx, cy), distortion, kind)


def pose_of(table: Any, key: str, file: Path) -> Array:
    """Returns the matrix (4, 4) of a pose in a table: a list of rows (Kalibr), or `rows`, `cols`, `data` (ASL).

    The matrix is not checked to be a rigid motion.

    Args:
        table: table of a camera.
        key: key of the pose in the table.
        file: file of the table, for messages.

    Raises:
        TwinError: the pose is missing or not a matrix of 4 x 4 numbers.
    """
    value = _table(table, file).get(key)
    value = value.get("data") if isinstance(value, Mapping) else value
    return _numbers(value, file, key, (16,)).reshape(4, 4)


def _kalibr(tree: Mapping[str, Any], file: Path) -> StereoCalibration:
    """Returns the calibration of a Kalibr camchain: cam0 is the left camera, cam1 the right one.

    Raises:
        TwinError: cam1 is missing, or a camera or T_cn_cnm1 is not valid.
    """
    if "cam1" not in tree:
        raise TwinError(str(file), "has one camera only, so it has no baseline", "cam0 and cam1 with T_cn_cnm1")
    left, right = (camera_from_kalibr(tree[name], file) for name in ("cam0", "cam1"))
    return StereoCalibration(left, right, pose_of(tree["cam1"], "T_cn_cnm1", file), file)


def _opencv(tree: Mapping[str, Any], file: Path) -> StereoCalibration:
    """Returns the calibration of an OpenCV file: M1, D1, M2, D2, R, T and the image size.

    R and T are the pose of the left camera in the axes of the right one. R may be a rotation matrix or a rotation
    vector; without R, the cameras are parallel. If D1 or D2 is missing, its camera has no distortion.

    Raises:
        TwinError: M1, M2 or T is missing, a value is not of the expected form, or the lens model is not supported.
    """
    keys = {str(key).lower().replace("_", ""): value for key, value in tree.items()}
    size = next((keys[key] for key in _SIZE_KEYS if key in keys), None)
    if size is None and {"imagewidth", "imageheight"} <= keys.keys():
        size = [keys["imagewidth"], keys["imageheight"]]
    kind = distortion_kind(keys.get("distortionmodel", "radtan"), file)
    cameras = []
    for matrix_names, distortion_names in zip(_MATRIX_KEYS, _DISTORTION_KEYS, strict=True):
        matrix = next((keys[key] for key in matrix_names if key in keys), None)
        distortion = next((keys[key] for key in distortion_names if key in keys), [])
        cameras.append(
            RecordedCamera(
                _size(size, file),
                _numbers(matrix, file, matrix_names[0].upper(), (9,)).reshape(3, 3),
                _numbers(distortion, file, distortion_names[0].upper()).ravel(),
                kind,
            )
        )
    if "t" not in keys:
        raise TwinError(str(file), "has no baseline", "T, the translation between the cameras [m]")
    rotation = _numbers(keys.get("r", np.eye(3).tolist()), file, "R")
    rotation = geometry.so3_exp(rotation.ravel()) if rotation.size == 3 else rotation
    if rotation.size != 9:
        raise TwinError(str(file), f"R has {rotation.size} numbers", "a rotation matrix or a rotation vector")
    translation = _numbers(keys["t"], file, "T", (3,))
    return StereoCalibration(cameras[0], cameras[1], geometry.pose(rotation.reshape(3, 3), translation.ravel()), file)


def _colmap(file: Path) -> StereoCalibration:
    """Returns the calibration in COLMAP's cameras.txt and in rigs.txt, which has the pose of the second camera.

    The left camera is the reference camera of the first rig in rigs.txt, in the same folder as cameras.txt; the right
    camera is the second camera of this rig.

    Raises:
        TwinError: there are fewer than two cameras or no rigs.txt, or a line of either file is not valid.
    """
    cameras = dict(_colmap_camera(file, number, parts) for number, parts in text_rows(file))
    rigs = file.with_name("rigs.txt")
    if len(cameras) < 2 or not rigs.is_file():
        raise TwinError(str(file), "has no baseline", "two cameras, and their rig in rigs.txt beside this file")
    number, parts = next(iter(text_rows(rigs)), (1, list[str]()))
    try:
        reference, second = int(parts[3]), int(parts[5])
        quaternion, translation = np.array(parts[7:11], float), np.array(parts[11:14], float)
        pose = geometry.pose(geometry.rotation_from_wxyz(quaternion), translation)
        return StereoCalibration(cameras[reference], cameras[second], pose, file)
    except (ValueError, IndexError, KeyError):
        allowed = "RIG_ID 2 CAMERA ID CAMERA ID 1 QW QX QY QZ TX TY TZ"
        raise TwinError(f"{rigs}:{number}", "is not the rig of two cameras", allowed) from None


def _colmap_camera(file: Path, number: int, parts: list[str]) -> tuple[int, RecordedCamera]:
    """Returns the identifier and the camera in a line of cameras.txt.

    In COLMAP, the corner of the first pixel is at (0, 0); in the returned camera, the centre of this pixel is at
    (0, 0).

    Args:
        file: cameras.txt, for messages.
        number: number of the line, from 1.
        parts: columns of the line.

    Raises:
        TwinError: the line is not a camera, or its lens model is not supported.
    """
    model = parts[1] if len(parts) > 1 else ""
    if model not in _COLMAP:
        raise TwinError(f"{file}:{number}", f"camera model {model[:40]!r} is not supported", ", ".join(_COLMAP))
    focal, distorted, kind = _COLMAP[model]
    try:
        values = [float(part) for part in parts[4:]]
        fx, fy, cx, cy = (values[k] for k in focal)
        distortion = np.array([0.0 if k is None else values[k] for k in distorted])
        size = _size([int(parts[2]), int(parts[3])], file)
        camera = RecordedCamera(size, _matrix(fx, fy, cx - 0.5, cy - 0.5), distortion, distortion_kind(kind, file))
        return int(parts[0]), camera
    except (ValueError, IndexError):
        raise TwinError(f"{file}:{number}", "is not a camera", "CAMERA_ID MODEL WIDTH HEIGHT PARAMS") from None


def _matrix(fx: float, fy: float, cx: float, cy: float) -> Array:
    """Returns the camera matrix (3, 3)."""
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])


def _table(value: Any, file: Path) -> Mapping[str, Any]:
    """Returns the value if it is a table (keys and values); raises TwinError otherwise."""
    if not isinstance(value, Mapping):
        raise TwinError(str(file), "has no table of a camera", "a calibration of OpenCV, Kalibr or COLMAP")
    return value


def _numbers(value: Any, file: Path, key: str, shape: tuple[int, ...] | None = None) -> Array:
    """Returns a list of numbers as an array, reshaped to `shape` if it is given.

    Raises:
        TwinError: the value is not a list of numbers below 1e12 in absolute value, or their number does not fit
            `shape`; the message names `key`.
    """
    try:
        array = np.array(value, dtype=np.float64)
    except (TypeError, ValueError):
        array = np.array(np.nan)
    count = None if shape is None else int(np.prod(shape))
    if value is None or not (np.abs(array) < _LARGEST).all() or (count is not None and array.size != count):
        raise TwinError(str(file), f"{key} is missing or not valid", f"{count or 'finite'} numbers")
    return array if shape is None else array.reshape(shape)


def _size(value: Any, file: Path) -> tuple[int, int] | None:
    """Returns an image size [width, height] as a tuple [px]; None if the value is None.

    Raises:
        TwinError: the value is not two numbers.
    """
    if value is None:
        return None
    width, height = _numbers(value, file, "the image size", (2,))
    return int(width), int(height)


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
