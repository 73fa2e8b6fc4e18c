"""Calibration of a stereo rig in files of OpenCV: M1, D1, M2, D2, R, T and the image size.

1 is the left camera, 2 the right one; R and T are the pose of the left camera in the axes of the right one.
"""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from twin.core import geometry
from twin.datasets.calibration import RecordedCamera, StereoCalibration, distortion_kind
from twin.datasets.calibration_values import metres_of, numbers_of, refuse_unknown, size_of
from twin.errors import TwinError


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
