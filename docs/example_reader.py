"""A reader of another layout for `twin replay`: the stereo pairs of Middlebury 2014 (im0.png, im1.png, calib.txt).

The package of the reader registers it:

    [project.entry-points."twin.readers"]
    middlebury = "my_package:MiddleburyReader"
"""

import re
from pathlib import Path

import numpy as np

from twin.core import geometry
from twin.datasets.calibration import RecordedCamera, StereoCalibration, checked
from twin.datasets.dataset import Dataset, StereoImages
from twin.datasets.text_files import read_text
from twin.errors import TwinError


class MiddleburyReader:
    """Reads one rectified stereo pair; calib.txt has the camera matrices [px] and the baseline [mm]."""

    name = "middlebury"
    layout = "im0.png, im1.png and calib.txt"

    def recognises(self, folder: Path) -> bool:
        """Returns whether a folder has the three files."""
        return all((folder / name).is_file() for name in ("im0.png", "im1.png", "calib.txt"))

    def read(self, folder: Path) -> Dataset:
        """Returns the data set in a folder; raises TwinError if calib.txt is damaged."""
        file = folder / "calib.txt"
        values = dict(re.findall(r"^(\w+)=\[?([^\]\n]+)", read_text(file), re.MULTILINE))
        try:
            left, right = (np.array(re.split(r"[;\s]+", values[key]), float).reshape(3, 3) for key in ("cam0", "cam1"))
            offset = np.array([-float(values["baseline"]) / 1000, 0, 0])
        except (KeyError, ValueError):
            raise TwinError(str(file), "is not a calibration", "cam0=[..], cam1=[..], baseline=MM") from None
        cameras = [RecordedCamera(None, matrix, np.zeros(0)) for matrix in (left, right)]
        calibration = checked(StereoCalibration(cameras[0], cameras[1], geometry.pose(np.eye(3), offset), file))
        return Dataset(folder, [StereoImages(0.0, folder / "im0.png", folder / "im1.png")], calibration)
