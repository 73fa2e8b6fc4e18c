"""TUM RGB-D layout: trajectories, read and written, and lists of images with times, written."""

from pathlib import Path

from twin.core.records import Trajectory
from twin.datasets.dataset import trajectory_of
from twin.datasets.image_copy import copy_images
from twin.datasets.run_contents import RunContents
from twin.datasets.text_files import read_table
from twin.errors import TwinError

_FILES = {"truth": "groundtruth.txt"}  # names of files that are not those of their trajectories
_IMAGES = {"left": "rgb", "right": "right"}  # folders of the cameras


def read_trajectory(file: Path) -> Trajectory:
    """Returns the poses in a file: time [s], x, y, z [m], quaternion x, y, z, w; raises TwinError if it is damaged."""
    rows = read_table(file, 8)
    found = trajectory_of(rows[:, 0], rows[:, 1:4], rows[:, [7, 4, 5, 6]])
    if found is None:
        raise TwinError(str(file), "has quaternions that are not of unit length", "time x y z qx qy qz qw")
    return found


def export(contents: RunContents, folder: Path) -> list[Path]:
    """Writes each trajectory of the left camera as NAME.txt, the truth as `groundtruth.txt`; returns the text files.

    Images, if any were recorded, are written to `rgb` (left) and `right`; `rgb.txt` and `right.txt` list them with
    times [s].
    """
    written = []
    for name, path in contents.trajectories.items():
        if len(path):
            written.append(folder / _FILES.get(name, f"{name}.txt"))
            path.save(written[-1], digits=12, header="# time x y z qx qy qz qw\n")
    lists = {name: ["# time [s], file\n"] for name in _IMAGES.values()} if contents.frames else {}
    for name in lists:
        (folder / name).mkdir(exist_ok=True)
    for image in copy_images(contents, lambda camera, frame: folder / _IMAGES[camera] / f"{frame.time_s:.6f}"):
        name = _IMAGES[image.camera]
        lists[name].append(f"{image.frame.time_s:.6f} {name}/{image.file.name}\n")
    for name, lines in lists.items():
        written.append(folder / f"{name}.txt")
        written[-1].write_text("".join(lines), encoding="utf-8")
    return written
