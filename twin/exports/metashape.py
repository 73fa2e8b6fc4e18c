"""Writer of reference files of Agisoft Metashape: position and attitude of each image as CSV."""

from pathlib import Path

from twin.core.georeference import Georeference
from twin.datasets.image_copy import copy_all
from twin.datasets.run_contents import RunContents
from twin.exports.geographic_place import yaw_pitch_roll_deg

_HEADER = "#Label,X/Easting,Y/Northing,Z/Altitude,Yaw,Pitch,Roll"


def export(contents: RunContents, folder: Path) -> list[Path]:
    """Writes the images to `images`, and reference_truth.csv and reference_final.csv if these trajectories exist.

    The label of an image is the name of its file. Positions are in the CRS of the export or, without one, in scene
    coordinates [m]; angles are in degrees (`yaw_pitch_roll_deg`).
    """
    origin = contents.georeference or Georeference(0.0, 0.0)
    images = copy_all(contents, folder / "images")
    written = [folder / "images"]
    for name in ("truth", "final"):
        if name in contents.trajectories:
            file = folder / f"reference_{name}.csv"
            poses, rig = contents.trajectories[name].world_from_camera, contents.believed
            lines = [_HEADER]
            for image in images:
                pose = poses[image.frame.index] @ rig.left_from(image.camera)
                x, y, z = pose[:3, 3]
                values = [*map(float, origin.from_scene(x, y)), z + origin.elevation_m]
                angles = [f"{angle:.8f}" for angle in yaw_pitch_roll_deg(pose)]
                lines.append(",".join([image.file.name, *(f"{value:.6f}" for value in values), *angles]))
            file.write_text("\n".join(lines) + "\n", encoding="utf-8")
            written.append(file)
    return written
