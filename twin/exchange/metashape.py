"""Writer of reference files of Agisoft Metashape: position and attitude of each image as CSV."""

from __future__ import annotations

from pathlib import Path

from twin.core.georeference import Georeference
from twin.core.records import Trajectory
from twin.exchange.attitude import yaw_pitch_roll_deg
from twin.exchange.image_copy import CopiedImage, copy_images
from twin.exchange.run_contents import RunContents

_HEADER = "#Label,X/Easting,Y/Northing,Z/Altitude,Yaw,Pitch,Roll"


def export(contents: RunContents, folder: Path) -> list[Path]:
    """Writes the images to `images`, and reference_truth.csv and reference_final.csv if these trajectories exist.

    The label of an image is the name of its file. Positions are in the CRS of the export or, without one, in scene
    coordinates [m]; angles are in degrees (`yaw_pitch_roll_deg`).

    Returns:
        The folder of the images and the CSV files.

    Raises:
        TwinError: an image is truncated or not a PNG image.
        OSError: a file cannot be read or written.
    """
    origin = contents.georeference or Georeference(0.0, 0.0)
    images = list(copy_images(contents, folder / "images", contents.rig.left_from_right))
    written = [folder / "images"]
    for name in ("truth", "final"):
        if name in contents.trajectories:
            file = folder / f"reference_{name}.csv"
            lines = [_line(image, contents.trajectories[name], origin) for image in images]
            file.write_text("\n".join([_HEADER, *lines]) + "\n", encoding="utf-8")
            written.append(file)
    return written


def _line(image: CopiedImage, path: Trajectory, origin: Georeference) -> str:
    """Returns the line of one image in the reference file.

    Args:
        image: the image; its name is the label.
        path: trajectory of the left camera in the world.
        origin: position of the scene in the CRS; the zero position for scene coordinates.
    """
    pose = path.world_from_camera[image.frame.index] @ image.left_from_camera
    x, y, z = pose[:3, 3]
    easting, northing = origin.from_scene(x, y)
    angles = ",".join(f"{angle:.8f}" for angle in yaw_pitch_roll_deg(pose))
    return f"{image.name},{float(easting):.6f},{float(northing):.6f},{z + origin.elevation_m:.6f},{angles}"
