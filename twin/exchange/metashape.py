"""Writer of reference files of Agisoft Metashape: position and attitude of each image as CSV."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from twin.core.georeference import Georeference
from twin.core.records import Trajectory
from twin.exchange.attitude import yaw_pitch_roll_deg
from twin.exchange.image_copy import copy_image
from twin.exchange.run_contents import RunContents

_HEADER = "#Label,X/Easting,Y/Northing,Z/Altitude,Yaw,Pitch,Roll"


def export(contents: RunContents, folder: Path) -> list[Path]:
    """Writes the images, and `reference_NAME.csv` for the true and the final trajectory, whichever exist.

    The label is the name of the image file. Positions are in the CRS of the export, or in local coordinates [m]; angles
    are in degrees (`yaw_pitch_roll_deg`).
    """
    origin = contents.georeference or Georeference(0.0, 0.0)
    (folder / "images").mkdir(exist_ok=True)
    images = []
    for k, frame in enumerate(contents.frames):
        sides = (("left", frame.left, np.eye(4)), ("right", frame.right, contents.rig.left_from_right))
        for side, file, left_from_camera in sides:
            if file is not None:
                stem = folder / "images" / f"{side}_{frame.index:06d}"
                copied = copy_image(file, stem, contents.jpeg_quality)
                images.append((copied.name, frame.index, left_from_camera))
        contents.progress((k + 1) / len(contents.frames))
    written = [folder / "images"]
    for name in ("truth", "final"):
        if name in contents.trajectories:
            file = folder / f"reference_{name}.csv"
            lines = [_line(image, contents.trajectories[name], origin) for image in images]
            file.write_text("\n".join([_HEADER, *lines]) + "\n", encoding="utf-8")
            written.append(file)
    return written


def _line(image: tuple[str, int, np.ndarray], path: Trajectory, origin: Georeference) -> str:
    """Returns the line of one image in the reference file.

    Args:
        image: label, row in the trajectory, and pose (4, 4) of the camera of the image in the left camera.
        path: trajectory of the left camera.
        origin: position of the scene in the CRS.
    """
    label, row, left_from_camera = image
    pose = path.world_from_camera[row] @ left_from_camera
    x, y, z = pose[:3, 3]
    easting, northing = origin.from_scene(x, y)
    angles = ",".join(f"{angle:.8f}" for angle in yaw_pitch_roll_deg(pose))
    return f"{label},{float(easting):.6f},{float(northing):.6f},{z + origin.elevation_m:.6f},{angles}"
