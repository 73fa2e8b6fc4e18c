"""Calibration files of other programs: OpenCV, Kalibr camchain, ROS camera_info, ORB-SLAM3, COLMAP cameras.txt.

Every key of a file is read or known to be irrelevant; any other is refused by its name, because a key that is dropped
(a distortion under another name) leaves a calibration that looks right and is wrong.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from xml.etree import ElementTree

import numpy as np

from twin.core import geometry
from twin.core.geometry import Array
from twin.datasets.bag_calibration import stereo_calibration
from twin.datasets.calibration import RecordedCamera, StereoCalibration, checked, distortion_kind
from twin.datasets.calibration_values import READ, camera_matrix, numbers_of, refuse_unknown, size_of, table_of
from twin.datasets.colmap_calibration import read_colmap
from twin.datasets.text_files import read_text, read_yaml
from twin.errors import TwinError

#: Keys by which files of other programs are recognised that are not read.
_DIALECTS = {
    "projection_parameters": "VINS (CamOdoCal)",
    "body_T_cam0": "VINS",
    "parameters": "Calibmar",
    "Camera.fx": "ORB-SLAM2 or a single camera of ORB-SLAM3",
    "T_BS": "one camera of an ASL data set (sensor.yaml)",
}


def _sides(*stems: str) -> list[tuple[str, ...]]:
    """Returns the names of a key of the left and of the right camera, made of stems, number and side."""
    return [
        tuple(name for stem in stems for name in (f"{stem}{k}", f"{side}{stem}", f"{stem}{side}"))
        for k, side in ((1, "left"), (2, "right"))
    ]


#: Keys of an OpenCV file, in lower case without separators.
_MATRICES = _sides("m", "k", "cameramatrix")
_DISTORTIONS = _sides("d", "dist", "distcoeffs", "distortion", "distortioncoeffs", "distortioncoefficients")
_OPENCV = {
    **dict(zip(("M1", "M2", "D1", "D2"), (*_MATRICES, *_DISTORTIONS), strict=True)),
    "R": ("r",), "T": ("t",), "model": ("distortionmodel",), "unit": ("tunit",),
    "size": ("imagesize", "size", "resolution"), "width": ("imagewidth",), "height": ("imageheight",),
}  # fmt: skip
#: Irrelevant keys: results of rectification (computed anew), how the calibration was made.
_OPENCV_IRRELEVANT = re.compile(
    "[rp][12]|[qef]|(valid)?(pix)?roi[12]?|.*(rms|errors?)|residual.*|.*date|.*time|comment|flags?(value)?|n(r?of)?frames.*|board.*"
    "|square.*"
)
_KALIBR_IRRELEVANT = (
    "cam_overlaps", "rostopic", "T_cam_imu", "timeshift_cam_imu", "sensor_type", "comment", "camera_id", "rate_hz",
    "T_BS", "T_cn_cnm1",
)  # fmt: skip
_INFO_KEYS = (
    "image_width", "image_height", "camera_name", "camera_matrix", "distortion_model", "distortion_coefficients",
    "rectification_matrix", "projection_matrix",
)  # fmt: skip
#: Lens models of ORB-SLAM3 by Camera.type, with their coefficients.
_ORBSLAM = {
    "PinHole": ("radtan", ("k1", "k2", "p1", "p2", "k3")),
    "KannalaBrandt8": ("fisheye", ("k1", "k2", "k3", "k4")),
}
_ORBSLAM_IRRELEVANT = re.compile(
    r"(File|IMU|ORBextractor|Viewer|System|LoopClosing)\..*|loopClosing|Stereo\.ThDepth|Camera\.(fps|RGB|imageScale"
    r"|newWidth|newHeight)|Camera[12]\.overlapping(Begin|End)"
)
_UNITS_M = {"m": 1.0, "cm": 0.01, "mm": 0.001, "in": 0.0254}
_LONGEST_UNASKED_M = 1.0  # longest baseline of an OpenCV file without T_unit: its T may be in squares of the board
_TANGENTIAL = 0.05  # largest tangential coefficients of a lens without a stated model, as a fraction of k1


def read_calibration(file: Path) -> StereoCalibration:
    """Returns the calibration of a file of one of the programs in `READ`.

    The rig of the cameras in cameras.txt is read from rigs.txt in the same folder; the other camera of a ROS pair from
    the file whose name has "right" in place of "left".

    Raises:
        TwinError: the file cannot be read, is of an unknown kind, has an unknown key, or its values are impossible.
    """
    if file.suffix == ".txt":
        return checked(read_colmap(file))
    tree = _read_tree(file)
    if "cam0" in tree:
        return checked(_kalibr(tree, file))
    if "projection_matrix" in tree:
        return _ros_pair(file)
    if "Camera1.fx" in tree:
        return checked(_orbslam(tree, file))
    for key, program in _DIALECTS.items():
        if key in tree:
            raise TwinError(str(file), f"is a calibration of {program}, which is not read (key {key!r})", READ)
    return checked(_opencv(tree, file))


def _read_tree(file: Path) -> Mapping[str, Any]:
    """Returns the keys and values of a YAML or JSON file, or of an XML file that OpenCV wrote.

    Raises:
        TwinError: the file cannot be read, or is of neither kind.
    """
    if file.suffix.lower() != ".xml":
        return read_yaml(file)  # JSON is YAML
    text = read_text(file, 2**20)
    try:
        root = None if "<!" in text.replace("<!--", "") else ElementTree.fromstring(text)
    except ElementTree.ParseError:
        root = None
    if root is None or root.tag != "opencv_storage":
        raise TwinError(str(file), "is not valid XML of OpenCV", "<opencv_storage> without a document type")
    values = {child.tag: (child.findtext("data") or child.text or "").split() for child in root}
    refuse_unknown([child.tag for child in root][len(values) :], file)  # not empty if tags are repeated
    return {key: value[0] if len(value) == 1 else value for key, value in values.items()}


def find_calibration(folder: Path) -> Path | None:
    """Returns the calibration file of a folder, or None if it has none.

    It is calibration.yaml (.yml, .xml, .json), otherwise the left of two ROS files, otherwise the only YAML file,
    otherwise cameras.txt.

    Raises:
        TwinError: the folder has several YAML files, and not exactly one of them is called calibration.
    """
    suffixes = (".yaml", ".yml", ".xml", ".json")
    files = sorted(file for file in folder.iterdir() if file.suffix.lower() in suffixes)
    named = [file for file in files if file.stem.lower() == "calibration"]
    files = [file for file in files if file.suffix.lower() in suffixes[:2]]
    if sorted(file.stem.lower() for file in files) == ["left", "right"]:
        return files[0]
    if len(named) > 1 or (len(files) > 1 and not named):
        names = ", ".join(file.name for file in (named or files)[:5])
        raise TwinError(str(folder), f"has several YAML files: {names}", "--calibration FILE")
    found = named or files or [file for file in (folder / "cameras.txt",) if file.is_file()]
    return found[0] if found else None


def camera_from_kalibr(table: Any, file: Path) -> RecordedCamera:
    """Returns a camera of a Kalibr camchain or of an ASL sensor.yaml (keys `intrinsics`, `distortion_coefficients`).

    Raises:
        TwinError: a value is missing or not valid, or the camera model or the lens model is not supported.
    """
    table = table_of(table, file)
    if (model := table.get("camera_model", "pinhole")) != "pinhole":
        raise TwinError(str(file), f"camera model {model!r} is not supported", "pinhole with radtan or equidistant")
    names = "distortion_coeffs", "distortion_coefficients"
    coefficients = next((table[name] for name in names if name in table), None)
    known = ("camera_model", "intrinsics", "distortion_model", "resolution", *names, *_KALIBR_IRRELEVANT)
    refuse_unknown((key for key in table if key not in known), file)
    fx, fy, cx, cy = numbers_of(table.get("intrinsics"), file, "intrinsics", (4,))
    distortion = numbers_of([] if coefficients is None else coefficients, file, "distortion_coeffs").ravel()
    kind = distortion_kind(table.get("distortion_model", "radtan"), file)
    return RecordedCamera(size_of(table.get("resolution"), file), camera_matrix(fx, fy, cx, cy), distortion, kind)


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
    value = table_of(table, file).get(key)
    return numbers_of(value, file, key, (4, 4))


def _kalibr(tree: Mapping[str, Any], file: Path) -> StereoCalibration:
    """Returns the calibration of a Kalibr camchain: cam0 is the left camera, cam1 the right one.

    Raises:
        TwinError: cam1 is missing, or a camera or T_cn_cnm1 is not valid.
    """
    if "cam1" not in tree:
        raise TwinError(str(file), "has one camera only, so it has no baseline", "cam0 and cam1 with T_cn_cnm1")
    refuse_unknown((key for key in tree if not re.fullmatch(r"cam\d", str(key))), file)
    left, right = (camera_from_kalibr(tree[name], file) for name in ("cam0", "cam1"))
    return StereoCalibration(left, right, pose_of(tree["cam1"], "T_cn_cnm1", file), file)


def _ros_pair(file: Path) -> StereoCalibration:
    """Returns the calibration of two files camera_info (camera_calibration_parsers), given either of them.

    Raises:
        TwinError: the other file is missing, or a key or a value is not valid.
    """
    names = [re.sub("left|right", side, file.name, count=1, flags=re.IGNORECASE) for side in ("left", "right")]
    if names[0] == names[1]:
        raise TwinError(str(file), "is one camera of ROS, without the other one", "files called left and right")
    left, right = (_camera_info(file.with_name(name)) for name in names)
    return stereo_calibration(left, right, False, None, file)


def _camera_info(file: Path) -> SimpleNamespace:
    """Returns the contents of a ROS file camera_info with the names of the message sensor_msgs/CameraInfo."""
    tree = read_yaml(file)
    refuse_unknown((key for key in tree if key not in _INFO_KEYS), file)
    k, d, r, p = (
        numbers_of(tree.get(key), file, key, shape).ravel()
        for key, shape in zip(_INFO_KEYS[3:4] + _INFO_KEYS[5:], ((9,), None, (9,), (12,)), strict=True)
    )
    width, height = numbers_of([tree.get(key) for key in _INFO_KEYS[:2]], file, "the image size", (2,)).astype(int)
    full = SimpleNamespace(width=0, height=0)
    return SimpleNamespace(
        k=k, d=d, r=r, p=p, width=width, height=height, roi=full, binning_x=0, binning_y=0,
        distortion_model=tree.get("distortion_model"),
    )  # fmt: skip


def _orbslam(tree: Mapping[str, Any], file: Path) -> StereoCalibration:
    """Returns the calibration of an ORB-SLAM3 file; Stereo.T_c1_c2 is the pose of the right camera in the left one.

    Raises:
        TwinError: the camera type is not supported, or a key or a value is missing or not valid.
    """
    if (model := str(tree.get("Camera.type"))) not in _ORBSLAM:
        raise TwinError(str(file), f"Camera.type {model[:40]!r} is not supported", ", ".join(_ORBSLAM))
    kind, names = _ORBSLAM[model]
    keys = [[f"Camera{k}.{name}" for name in ("fx", "fy", "cx", "cy", *names)] for k in (1, 2)]
    size = ["Camera.width", "Camera.height"]
    known = {*keys[0], *keys[1], *size, "Camera.type", "Stereo.T_c1_c2"}
    refuse_unknown((key for key in tree if key not in known and not _ORBSLAM_IRRELEVANT.fullmatch(str(key))), file)
    cameras = []
    for camera in keys:
        fx, fy, cx, cy, *lens = (float(numbers_of(tree.get(key, 0.0), file, key, ())) for key in camera)
        size_px = size_of([tree.get(key) for key in size], file)
        cameras.append(
            RecordedCamera(size_px, camera_matrix(fx, fy, cx, cy), np.array(lens), distortion_kind(kind, file))
        )
    left_from_right = numbers_of(tree.get("Stereo.T_c1_c2"), file, "Stereo.T_c1_c2", (4, 4))
    return StereoCalibration(cameras[0], cameras[1], geometry.inverse(left_from_right), file)


def _opencv(tree: Mapping[str, Any], file: Path) -> StereoCalibration:
    """Returns the calibration of an OpenCV file: M1, D1, M2, D2, R, T and the image size.

    R and T are the pose of the left camera in the axes of the right one. R may be a rotation matrix or a rotation
    vector; without R, the cameras are parallel. If D1 or D2 is missing, its camera has no distortion. T is in metres or
    in T_unit.

    Raises:
        TwinError: M1, M2 or T is missing, a key is unknown, a value is not of the expected form, the lens model is not
            supported or has to be stated, or T may have another unit.
    """
    keys = {re.sub(r"[\W_]", "", str(key)).lower(): key for key in tree}
    found = {role: next((keys.pop(name) for name in names if name in keys), None) for role, names in _OPENCV.items()}
    refuse_unknown((key for name, key in keys.items() if not _OPENCV_IRRELEVANT.fullmatch(name)), file)
    value = {role: None if key is None else tree[key] for role, key in found.items()}
    size = [value["width"], value["height"]] if value["size"] is None and value["width"] is not None else value["size"]
    cameras = [
        RecordedCamera(
            size_of(size, file),
            numbers_of(value[f"M{k}"], file, f"M{k}", (3, 3)),
            numbers_of(value[f"D{k}"] if found[f"D{k}"] is not None else [], file, f"D{k}").ravel(),
            distortion_kind(value["model"] or "radtan", file),
        )
        for k in (1, 2)
    ]
    if value["model"] is None:
        _ask_for_model(cameras, file)
    if found["T"] is None:
        raise TwinError(str(file), "has no baseline", "T, the translation between the cameras [m]")
    rotation = numbers_of(np.eye(3).tolist() if found["R"] is None else value["R"], file, "R")
    rotation = geometry.so3_exp(rotation.ravel()) if rotation.size == 3 else rotation
    if rotation.size != 9:
        raise TwinError(str(file), f"R has {rotation.size} numbers", "a rotation matrix or a rotation vector")
    translation = _in_metres(numbers_of(value["T"], file, "T", (3,)), value["unit"], file)
    return StereoCalibration(cameras[0], cameras[1], geometry.pose(rotation.reshape(3, 3), translation), file)


def _ask_for_model(cameras: list[RecordedCamera], file: Path) -> None:
    """Raises TwinError if four coefficients of a camera may be k1 to k4 of a fisheye lens as well as k1, k2, p1, p2."""
    for camera in cameras:
        tangential = np.abs(camera.distortion[2:]).max(initial=0.0)
        if len(camera.distortion) == 4 and camera.distortion.any():
            if not 0 < tangential <= _TANGENTIAL * abs(camera.distortion[0]):
                problem = "four coefficients of distortion may be those of a fisheye lens (k1 to k4) or k1, k2, p1, p2"
                raise TwinError(str(file), problem, "a key distortion_model: fisheye or radtan")


def _in_metres(translation: Array, unit: Any, file: Path) -> Array:
    """Returns a translation (3,) in metres.

    Raises:
        TwinError: the unit is unknown, or none is stated and the length is more than that of a usual rig in metres.
    """
    if unit is not None and str(unit) not in _UNITS_M:
        raise TwinError(str(file), f"T_unit {str(unit)[:40]!r} is not known", ", ".join(_UNITS_M))
    length_m = float(np.linalg.norm(translation))
    if unit is None and length_m > _LONGEST_UNASKED_M:
        allowed = f"up to {_LONGEST_UNASKED_M:g} m; units are metres, or those of a key T_unit: {', '.join(_UNITS_M)}"
        raise TwinError(str(file), f"the baseline is {length_m:g} m (in mm, inches or squares of a board?)", allowed)
    return translation * _UNITS_M[str(unit or "m")]
