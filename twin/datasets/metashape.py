"""Stereo rigs of Agisoft Metashape: the file of Export Cameras (XML) with a master and a slave sensor."""

from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np

from twin.core import geometry
from twin.datasets.calibration import RecordedCamera, StereoCalibration, rigid
from twin.datasets.calibration_values import numbers_of, refuse_unknown, size_of
from twin.errors import TwinError

ROOTS = ("document", "calibration")  # of the file of cameras, and of Agisoft's file of one camera
_COEFFICIENTS = ("f", "cx", "cy", "b1", "b2", "k1", "k2", "k3", "p1", "p2")


def read_cameras(root: Element, file: Path) -> StereoCalibration:
    """Returns the rig of a master and a slave sensor; raises TwinError for other sensors, models or keys.

    rotation and location of the slave sensor are its pose in the axes of the master. The camera on the left is the left
    one. The unit is unknown: without a reference, the scale of a chunk is arbitrary.
    """
    sensors = sorted(root.findall(".//sensor"), key=lambda sensor: "master_id" in sensor.attrib)
    if [sensor.get("master_id") for sensor in sensors] != [None, sensors[0].get("id") if sensors else None]:
        problem, allowed = f"has {len(sensors)} sensors, not a master and its slave sensor", "Export Cameras of a rig"
        raise TwinError(str(file), problem, allowed)
    cameras = [_camera(sensor, file) for sensor in sensors]
    rotation, location = (
        numbers_of((sensors[1].findtext(key) or "").split(), file, f"{key} of the slave sensor", shape)
        for key, shape in (("rotation", (3, 3)), ("location", (3,)))
    )
    left_from_right = rigid(geometry.pose(rotation, location), "rotation of the slave sensor", file)
    if location[0] < 0:
        cameras, left_from_right = cameras[::-1], geometry.inverse(left_from_right)
    return StereoCalibration(cameras[0], cameras[1], geometry.inverse(left_from_right), file, unit="unknown")


def _camera(sensor: Element, file: Path) -> RecordedCamera:
    """Returns a sensor by the frame model of the manual: p1, p2 are p2, p1 of OpenCV, b2 the skew; others must be 0."""
    # The corner of the first pixel is at (0, 0), and cx, cy count from the image centre.
    table, resolution = sensor.find("calibration[@class='adjusted'][@type='frame']"), sensor.find("resolution")
    if table is None or resolution is None:
        raise TwinError(str(file), "has a sensor without an adjusted calibration of type frame", "two frame cameras")
    size = size_of([resolution.get("width"), resolution.get("height")], file) or (0, 0)
    texts = {one.tag: one.text for one in table if one.tag not in ("resolution", "date")}
    values = {key: float(numbers_of(text, file, key, ())) for key, text in texts.items()}
    refuse_unknown((key for key, value in values.items() if value and key not in _COEFFICIENTS), file)
    f, cx, cy, b1, b2, k1, k2, k3, p1, p2 = (values.get(key, 0.0) for key in _COEFFICIENTS)
    matrix = np.array([[f + b1, b2, size[0] / 2 + cx - 0.5], [0, f, size[1] / 2 + cy - 0.5], [0, 0, 1]])
    return RecordedCamera(size, matrix, np.array([k1, k2, p2, p1, k3]))
