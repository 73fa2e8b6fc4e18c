"""Writer of nerfstudio data sets: transforms.json with OpenGL camera axes, and the images."""

import json
from pathlib import Path

import numpy as np

from twin.datasets.image_copy import copy_all
from twin.datasets.run_contents import RunContents

#: Pose of OpenGL camera axes (x right, y up, z backward) in those of OpenCV (x right, y down, z forward).
OPENCV_FROM_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


def export(contents: RunContents, folder: Path) -> list[Path]:
    """Writes transforms.json and `images`, and returns the paths of both.

    Poses and intrinsics are the true ones if they are known, otherwise the final trajectory and the believed
    calibration. In nerfstudio, the corner of the first pixel is at (0, 0), so principal points are larger by 0.5 px
    than in OpenCV.
    """
    rig = contents.best_calibration
    cameras, poses = dict(rig.sides), contents.poses.world_from_camera
    frames = []
    for image in copy_all(contents, folder / "images"):
        world_from_camera = poses[image.frame.index] @ rig.left_from(image.camera) @ OPENCV_FROM_OPENGL
        camera = cameras[image.camera]
        assert camera.size_px is not None
        (width, height), matrix = camera.size_px, camera.matrix
        k1, k2, p1, p2, k3 = (float(value) for value in camera.distortion)
        frames.append(
            {
                "file_path": f"images/{image.file.name}",
                "transform_matrix": world_from_camera.tolist(),
                **{"fl_x": matrix[0, 0], "fl_y": matrix[1, 1], "cx": matrix[0, 2] + 0.5, "cy": matrix[1, 2] + 0.5},
                **{"w": width, "h": height, "k1": k1, "k2": k2, "k3": k3, "p1": p1, "p2": p2},
            }
        )
    file = folder / "transforms.json"
    file.write_text(json.dumps({"camera_model": "OPENCV", "frames": frames}, indent=1), encoding="utf-8")
    return [file, folder / "images"]
