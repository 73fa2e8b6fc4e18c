"""TUM RGB-D layout: trajectories, read and written, and lists of images with times, written."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from twin.core import geometry
from twin.core.records import Trajectory
from twin.datasets.dataset import trajectory_of
from twin.datasets.image_copy import copy_image
from twin.datasets.run_contents import RunContents
from twin.datasets.text_files import read_table
from twin.errors import TwinError

_FILES = {"truth": "groundtruth.txt"}  # names of files that are not those of their trajectories


def read_trajectory(file: Path) -> Trajectory:
    """Returns the poses in a file: time [s], x, y, z [m], quaternion x, y, z, w.

    Raises:
        TwinError: the file cannot be read, or a quaternion is not of unit length.
    """
    rows = read_table(file, 8)
    found = trajectory_of(rows[:, 0], rows[:, 1:4], rows[:, [7, 4, 5, 6]])
    if found is None:
        raise TwinError(str(file), "has quaternions that are not of unit length", "time x y z qx qy qz qw")
    return found


def export(contents: RunContents, folder: Path) -> list[Path]:
    """Writes the trajectories of the left camera, and the images if any were recorded; returns the text files.

    The truth is written to `groundtruth.txt`, each other trajectory to a file of its name, for example `final.txt`.
    Images are written to the folders `rgb` (left) and `right`; `rgb.txt` and `right.txt` list them with times [s].
    """
    written = [
        _write_trajectory(folder / _FILES.get(name, f"{name}.txt"), path)
        for name, path in contents.trajectories.items()
        if len(path)
    ]
    lists = {name: ["# time [s], file\n"] for name in ("rgb", "right")} if contents.frames else {}
    for name in lists:
        (folder / name).mkdir(exist_ok=True)
    for k, frame in enumerate(contents.frames):
        for name, file in (("rgb", frame.left), ("right", frame.right)):
            if file is not None:
                copied = copy_image(file, folder / name / f"{frame.time_s:.6f}", contents.jpeg_quality)
                lists[name].append(f"{frame.time_s:.6f} {name}/{copied.name}\n")
        contents.progress((k + 1) / len(contents.frames))
    for name, lines in lists.items():
        written.append(folder / f"{name}.txt")
        written[-1].write_text("".join(lines), encoding="utf-8")
    return written


def _write_trajectory(file: Path, path: Trajectory) -> Path:
    rows = np.column_stack([path.positions, geometry.quaternions_xyzw(path.world_from_camera[:, :3, :3])])
    lines = ["# time x y z qx qy qz qw"] + [
        f"{time_s:.6f} " + " ".join(f"{value:.12g}" for value in row)
        for time_s, row in zip(path.times_s, rows, strict=True)
    ]
    file.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return file
