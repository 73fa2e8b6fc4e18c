"""Writer of KITTI odometry sequences: colour images, calib.txt, times.txt, and the true poses of the left camera."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from twin.core import geometry
from twin.core.records import StereoRig
from twin.exchange.image_copy import copy_image
from twin.exchange.run_contents import RunContents

SEQUENCE = "00"


def export(contents: RunContents, folder: Path) -> list[Path]:
    """Writes the stereo pairs as sequence 00 and, if the truth is known, its true poses.

    The layout is that of the odometry benchmark: `sequences/00` with `image_2` (left) and `image_3` (right), numbered
    from 000000, `calib.txt` and `times.txt` [s], and `poses/00.txt` with the first three rows of each pose of the left
    camera. As in the benchmark, poses are relative to the first one, in its axes (x right, y down, z forward).

    Returns:
        The folder of the sequence and, if written, the file of the poses.

    Raises:
        TwinError: an image is truncated or not a PNG image.
        OSError: a file cannot be read or written.
    """
    sequence = folder / "sequences" / SEQUENCE
    pairs = contents.pairs
    for name in ("image_2", "image_3"):
        (sequence / name).mkdir(parents=True, exist_ok=True)
    for k, frame in enumerate(pairs):
        assert frame.right is not None
        copy_image(frame.left, sequence / "image_2" / f"{k:06d}", contents.jpeg_quality)
        copy_image(frame.right, sequence / "image_3" / f"{k:06d}", contents.jpeg_quality)
        contents.progress((k + 1) / len(pairs))
    (sequence / "times.txt").write_text("".join(f"{frame.time_s:.9f}\n" for frame in pairs), encoding="utf-8")
    (sequence / "calib.txt").write_text(_calibration(contents.rig), encoding="utf-8")
    written = [sequence]
    if "truth" in contents.trajectories:
        poses = contents.trajectories["truth"].world_from_camera[[frame.index for frame in pairs]]
        written.append(write_poses(folder / "poses" / f"{SEQUENCE}.txt", poses))
    return written


def write_poses(file: Path, world_from_camera: np.ndarray) -> Path:
    """Writes poses (n, 4, 4), n > 0, relative to the first one, 12 numbers per line, and returns the file."""
    file.parent.mkdir(parents=True, exist_ok=True)
    relative = geometry.inverse(world_from_camera[0]) @ world_from_camera
    np.savetxt(file, relative[:, :3].reshape(-1, 12), fmt="%.12e")
    return file


def _calibration(rig: StereoRig) -> str:
    """Returns the text of calib.txt: P0 and P2 are the projection matrix of the left camera, P1 and P3 of the right."""
    left = np.column_stack([rig.matrix, np.zeros(3)])
    right = np.column_stack([rig.matrix, [-rig.fx_px * rig.baseline_m, 0.0, 0.0]])
    rows = [left, right, left, right]
    return "".join(f"P{k}: " + " ".join(f"{value:.12e}" for value in p.ravel()) + "\n" for k, p in enumerate(rows))
