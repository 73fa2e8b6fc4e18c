"""Calibration files of other programs (`READ`): the file is recognised by its suffix and its keys.

An unknown key is refused: a dropped one (a distortion under another name) leaves a wrong calibration that looks right.
"""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import cv2
import numpy as np

from twin.core import geometry
from twin.datasets import colmap, kalibr, metashape, vio_calibration
from twin.datasets.calibration import RecordedCamera, StereoCalibration, checked, distortion_kind
from twin.datasets.calibration_values import READ, metres_of, numbers_of, refuse_unknown, size_of, table_of
from twin.datasets.ros2.camera_info import read_pair
from twin.datasets.run_contents import RunContents
from twin.datasets.text_files import read_text, read_yaml
from twin.errors import TwinError

#: Keys by which files of other programs are recognised that are not read.
_DIALECTS = {
    "projection_parameters": "one camera of VINS (CamOdoCal); give the file with body_T_cam0 and body_T_cam1",
    "parameters": "one camera of Calibmar",
    "Camera.fx": "ORB-SLAM2 or a single camera of ORB-SLAM3",
    "T_BS": "one camera of an ASL data set (sensor.yaml)",
}


def _sides(*stems: str) -> list[tuple[str, ...]]:
    return [
        tuple(name for stem in stems for name in (f"{stem}{k}", f"{side}{stem}", f"{stem}{side}"))
        for k, side in ((1, "left"), (2, "right"))
    ]


_MATRICES = _sides("m", "k", "cameramatrix")
_DISTORTIONS = _sides("d", "dist", "distcoeffs", "distortion", "distortioncoeffs", "distortioncoefficients")
#: Keys in lower case without separators.
_KEYS = {
    **dict(zip(("M1", "M2", "D1", "D2"), (*_MATRICES, *_DISTORTIONS), strict=True)),
    "R": ("r",), "T": ("t",), "model": ("distortionmodel",), "unit": ("tunit",),
    "size": ("imagesize", "size", "resolution"), "width": ("imagewidth",), "height": ("imageheight",),
}  # fmt: skip
#: Irrelevant keys: results of rectification (computed anew), how the calibration was made.
_IRRELEVANT = re.compile(
    "[rp][12]|[qef]|(valid)?(pix)?roi[12]?|.*(rms|errors?)|residual.*|.*date|.*time|comment|flags?(value)?|n(r?of)?frames.*|board.*"
    "|square.*"
)
_TANGENTIAL = 0.05  # largest tangential coefficients of a lens without a stated model, as a fraction of k1


def read_calibration(file: Path) -> StereoCalibration:
    """Returns the calibration of a file of one of the programs in `READ`.

    The rig of the cameras in cameras.txt is read from rigs.txt beside it; the other camera of a ROS pair from the file
    whose name has "right" in place of "left". Raises TwinError if the file cannot be read, is of an unknown kind, has
    an unknown key, or its values are impossible.
    """
    if file.suffix == ".txt":
        return checked(colmap.read_rig(file))
    tree = _read_tree(file)
    for key, read in _PROGRAMS.items():
        if key in tree:
            return checked(read(tree, file))
    for key, program in _DIALECTS.items():
        if key in tree:
            raise TwinError(str(file), f"is a calibration of {program}, which is not read (key {key!r})", READ)
    return checked(read_opencv(tree, file))


def _read_tree(file: Path) -> Mapping[Any, Any]:
    """Returns the keys and values of a file; the root element of an XML file of Metashape has the key `Element`."""
    if file.suffix.lower() == ".mat":
        raise TwinError(str(file), "is a MAT-file, which is not read", "JSON: jsonencode(toStruct(stereoParams))")
    if file.suffix.lower() != ".xml":
        return read_yaml(file)  # JSON is YAML
    text = read_text(file, 2**20)
    try:
        root = None if "<!" in text.replace("<!--", "") else ElementTree.fromstring(text)
    except ElementTree.ParseError:
        root = None
    if root is None or root.tag not in ("opencv_storage", *metashape.ROOTS):
        raise TwinError(str(file), "is not valid XML of OpenCV or Metashape", "XML without a document type")
    if root.tag in metashape.ROOTS:
        return {ElementTree.Element: root}
    values = {child.tag: (child.findtext("data") or child.text or "").split() for child in root}
    refuse_unknown([child.tag for child in root][len(values) :], file)  # not empty if tags are repeated
    return {key: value[0] if len(value) == 1 else value for key, value in values.items()}


def find_calibration(folder: Path) -> Path | None:
    """Returns the calibration file of a folder, or None if it has none.

    It is calibration.yaml (.yml, .xml, .json), otherwise the left of two ROS files, otherwise the only YAML file,
    otherwise cameras.txt. Raises TwinError if the folder has several YAML files, and not exactly one of them is called
    calibration.
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


def read_opencv(tree: Mapping[str, Any], file: Path) -> StereoCalibration:
    """Returns the calibration in the keys and values of an OpenCV file.

    R may be a rotation matrix or a rotation vector; without R, the cameras are parallel; without D1 or D2, its camera
    has no distortion. T is in metres or in T_unit. Raises TwinError if M1, M2 or T is missing, a key is unknown, a
    value is not of the expected form, or the lens model is not supported or has to be stated.
    """
    keys = {re.sub(r"[\W_]", "", str(key)).lower(): key for key in tree}
    found = {role: next((keys.pop(name) for name in names if name in keys), None) for role, names in _KEYS.items()}
    refuse_unknown((key for name, key in keys.items() if not _IRRELEVANT.fullmatch(name)), file)
    value = {role: None if key is None else tree[key] for role, key in found.items()}
    size = [value["width"], value["height"]] if value["size"] is None and value["width"] is not None else value["size"]
    cameras = [
        RecordedCamera(
            size_of(size, file),
            numbers_of(value[f"M{k}"], file, f"M{k}", (3, 3)),
            numbers_of([] if found[f"D{k}"] is None else value[f"D{k}"], file, f"D{k}").ravel(),
            distortion_kind(value["model"] or "radtan", file),
        )
        for k in (1, 2)
    ]
    if value["model"] is None:
        _ask_for_model(cameras, file)
    if found["T"] is None:
        raise TwinError(str(file), "has no baseline", "T, the translation between the cameras [m]")
    rotation = numbers_of(np.eye(3) if found["R"] is None else value["R"], file, "R")
    rotation = geometry.so3_exp(rotation.ravel()) if rotation.size == 3 else rotation
    if rotation.size != 9:
        raise TwinError(str(file), f"R has {rotation.size} numbers", "a rotation matrix or a rotation vector")
    metres, unit = (1.0, "assumed") if found["unit"] is None else (metres_of(value["unit"], "T_unit", file), "stated")
    pose = geometry.pose(rotation.reshape(3, 3), metres * numbers_of(value["T"], file, "T", (3,)))
    return StereoCalibration(cameras[0], cameras[1], pose, file, unit=unit)


def _ask_for_model(cameras: list[RecordedCamera], file: Path) -> None:
    """Raises TwinError if four coefficients of a camera may be k1 to k4 of a fisheye lens as well as k1, k2, p1, p2."""
    for camera in cameras:
        tangential = np.abs(camera.distortion[2:]).max(initial=0.0)
        if len(camera.distortion) == 4 and camera.distortion.any():
            if not 0 < tangential <= _TANGENTIAL * abs(camera.distortion[0]):
                problem = "four coefficients of distortion may be those of a fisheye lens (k1 to k4) or k1, k2, p1, p2"
                raise TwinError(str(file), problem, "a key distortion_model: fisheye or radtan")


def read_matlab(tree: Mapping[str, Any], file: Path) -> StereoCalibration:
    """Returns the calibration; raises TwinError for a missing or a wrong field."""
    # MATLAB multiplies row vectors, x2 = x1 R + t, so that R is the transposed rotation of OpenCV.
    tables = [table_of(tree.get(key), file) for key in ("CameraParameters1", "CameraParameters2")]
    rotation = numbers_of(tree.get("RotationOfCamera2"), file, "RotationOfCamera2", (3, 3)).T
    translation = numbers_of(tree.get("TranslationOfCamera2"), file, "TranslationOfCamera2", (3,))
    metres = metres_of(tables[0].get("WorldUnits"), "WorldUnits", file)
    left, right = (_camera(table, file) for table in tables)
    return StereoCalibration(left, right, geometry.pose(rotation, metres * translation), file, unit="stated")


def _camera(table: Mapping[str, Any], file: Path) -> RecordedCamera:
    """Returns a camera of MATLAB, where the centre of the first pixel is at (1, 1)."""
    key = "K" if "K" in table else "IntrinsicMatrix"  # K: since R2022b; the other one is transposed
    given = numbers_of(table.get(key), file, key, (3, 3))
    matrix = (given if key == "K" else given.T) - [[0, 0, 1], [0, 0, 1], [0, 0, 0]]
    radial = numbers_of(table.get("RadialDistortion"), file, "RadialDistortion").ravel()
    p1, p2 = numbers_of(table.get("TangentialDistortion"), file, "TangentialDistortion", (2,))
    height, width = numbers_of(table.get("ImageSize"), file, "ImageSize", (2,)).astype(int).tolist()
    return RecordedCamera((width, height), matrix, np.array([*radial[:2], p1, p2, *radial[2:]]))


#: Readers of files, by a key by which each is recognised.
_PROGRAMS = {
    "cam0": kalibr.read_camchain, "projection_matrix": read_pair, "Camera1.fx": vio_calibration.read_orbslam,
    "cameras": vio_calibration.read_okvis, "body_T_cam0": vio_calibration.read_vins,
    "value0": vio_calibration.read_basalt, "CameraParameters1": read_matlab,
    ElementTree.Element: lambda tree, file: metashape.read_cameras(tree[ElementTree.Element], file),
}  # fmt: skip


def export(contents: RunContents, folder: Path) -> list[Path]:
    """Writes the calibration for OpenCV, Kalibr and COLMAP to the folders `believed` and, if it is known, `true`.

    Both describe the images as the estimators rectified them: with calibration errors, the true one still has
    distortion and a relative rotation. With an IMU, imu.yaml (Kalibr) is written, too.
    """
    written = []
    for name, rig in (("believed", contents.believed), ("true", contents.true)):
        if rig is not None:
            target = folder / name
            target.mkdir(exist_ok=True)
            write_opencv(target / "opencv.yaml", rig)
            body_from_left = None if contents.imu is None else contents.rig.body_from_camera
            kalibr.write_camchain(target / "kalibr.yaml", rig, body_from_left)
            colmap.write_rig(target, rig)
            if contents.imu is not None:
                kalibr.write_imu(target / "imu.yaml", contents.imu)
            written.append(target)
    return written


def write_opencv(file: Path, rig: StereoCalibration) -> None:
    assert rig.left.size_px is not None
    storage = cv2.FileStorage(str(file), cv2.FILE_STORAGE_WRITE)
    try:
        storage.write("image_width", rig.left.size_px[0])
        storage.write("image_height", rig.left.size_px[1])
        for k, (_, camera) in enumerate(rig.sides, 1):
            storage.write(f"M{k}", camera.matrix)
            storage.write(f"D{k}", camera.distortion.reshape(1, -1))
        storage.write("R", np.ascontiguousarray(rig.right_from_left[:3, :3]))
        storage.write("T", np.ascontiguousarray(rig.right_from_left[:3, 3:]))
        storage.write("residual_px", rig.residual_px)
    finally:
        storage.release()
