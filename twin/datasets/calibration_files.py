"""Calibration files of other programs (`READ`): the file is recognised by its suffix and its keys.

An unknown key is refused: a dropped one (a distortion under another name) leaves a wrong calibration that looks right.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from twin.datasets import colmap, kalibr, matlab_calibration, metashape, opencv_calibration, vio_calibration
from twin.datasets.calibration import StereoCalibration, checked
from twin.datasets.calibration_values import READ, refuse_unknown
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
    return checked(opencv_calibration.read_opencv(tree, file))


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


#: Readers of files, by a key by which each is recognised.
_PROGRAMS = {
    "cam0": kalibr.read_camchain, "projection_matrix": read_pair, "Camera1.fx": vio_calibration.read_orbslam,
    "cameras": vio_calibration.read_okvis, "body_T_cam0": vio_calibration.read_vins,
    "value0": vio_calibration.read_basalt, "CameraParameters1": matlab_calibration.read_struct,
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
            opencv_calibration.write_opencv(target / "opencv.yaml", rig)
            body_from_left = None if contents.imu is None else contents.rig.body_from_camera
            kalibr.write_camchain(target / "kalibr.yaml", rig, body_from_left)
            colmap.write_rig(target, rig)
            if contents.imu is not None:
                kalibr.write_imu(target / "imu.yaml", contents.imu)
            written.append(target)
    return written
