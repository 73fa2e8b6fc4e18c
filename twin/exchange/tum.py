"""Writer of the TUM RGB-D layout: lists of images with times, and trajectories."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from twin.core import geometry
from twin.core.records import Trajectory
from twin.exchange.image_copy import copy_image
from twin.exchange.run_contents import RunContents


def export(contents: RunContents, folder: Path) -> list[Path]:
    """Writes the trajectories of the left camera, and the images if any were recorded; returns the text files.

    The truth is written to `groundtruth.txt`, each other trajectory to a file of its name, for example `final.txt`.
    Each line of a trajectory is: time [s], x, y, z [m], quaternion x, y, z, w (world_from_camera). Images are written
    to the folders `rgb` (left) and `right`; `rgb.txt` and `right.txt` list them with their times [s].

    Raises:
        TwinError: an image is truncated or not a PNG image.
        OSError: a file cannot be read or written.
    """
    names = {"truth": "groundtruth.txt"}
    written = [
        _write_trajectory(folder / names.get(name, f"{name}.txt"), path)
        for name, path in contents.trajectories.items()
        if len(path)
    ]
    lists = ("rgb", "right")
    if contents.frames:
        for name in lists:
            (folder / name).mkdir(exist_ok=True)
            (folder / f"{name}.txt").write_text("# time [s], file\n", encoding="utf-8")
        for k, frame in enumerate(contents.frames):
            for name, file in (("rgb", frame.left), ("right", frame.right)):
                if file is not None:
                    stem = folder / name / f"{frame.time_s:.6f}"
                    copied = copy_image(file, stem, contents.jpeg_quality)
                    with (folder / f"{name}.txt").open("a", encoding="utf-8") as lines:
                        lines.write(f"{frame.time_s:.6f} {name}/{copied.name}\n")
            contents.progress((k + 1) / len(contents.frames))
        written += [folder / f"{name}.txt" for name in lists]
    return written


def _write_trajectory(file: Path, path: Trajectory) -> Path:
    """Writes a trajectory in the TUM format, and returns the file."""
    rows = np.column_stack([path.positions, geometry.quaternions_xyzw(path.world_from_camera[:, :3, :3])])
    lines = ["# time x y z qx qy qz qw"] + [
        f"{time_s:.6f} " + " ".join(f"{value:.12g}" for value in row)
        for time_s, row in zip(path.times_s, rows, strict=True)
    ]
    file.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return file
